"""What is not known exactly about a site: the ``[budget]`` table, for ``rfpose layout budget``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from rfpose.scenario.records import NonNegative, Positive, Record


class Budget(Record):
    """Error sources that the rest of a scenario does not state; lengths are standard deviations in each axis."""

    transmitter_survey_sigma_m: NonNegative = 0.005
    receiver_mirror_sigma_m: NonNegative = 0.001
    """How well the receivers' places on the mirror are known."""
    receiver_plane_sigma_mrad: NonNegative = 0.5
    """Angle between the plane of the receivers and the glass, about each axis of the mirror [mrad of the normal]."""
    receiver_delay_sigma_s: NonNegative | None = None
    """How far delays between a mirror's receivers really are from what is assumed; default: as the mirror states."""
    calibration_age_s: NonNegative = 0.0
    """Time since the transmitters' phases were measured; 0: calibration receivers hear every frame."""
    drift_time_scale_s: Positive | None = None
    """Beyond this the drift of a transmitter's phase levels off; default: a random walk without end."""
    ground: Literal["ignored", "known", "estimated"] | None = None
    """What the solver does about ``[simulation.ground]``; default: as ``[reflection]`` has it."""
    ground_coefficient_sigma: NonNegative = 0.02
    """Of real and imaginary part, where the coefficient is known."""
    ground_height_sigma_m: NonNegative = 0.005
    multipath_db: Annotated[float, Field(lt=0)] | None = None
    """Strength of one more stray ray a receiver and transmitter against the direct one, which nothing foresees."""
    multipath_excess_m: Positive = 10.0
    """Mean of its exponentially distributed detour."""
    mirror_rate_mrad_per_s: NonNegative = 0.0365
    """Rate at which normals turn; default: half of the sun's."""
    latency_s: NonNegative = 0.0
    """From a frame's end to the instant for which its pose is taken."""
    refractivity_sigma_ppm: NonNegative | None = None
    """Of the air's refractive index; default: 300 where the vacuum's speed of light is used, else 20."""
