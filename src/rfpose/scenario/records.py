"""What stands on a site and is recorded there: one frozen record a table of the scenario file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rfpose import geometry
from rfpose.errors import ScenarioError
from rfpose.foreign import RATE_LIMITS, exact_rate
from rfpose.scenario._words import in_words

SPEED_OF_LIGHT_MPS = 299_792_458.0
MAX_FRAME_SAMPLES = 2**24
MIN_FRAME_SAMPLES = 64
MAX_SAMPLE_INDEX = 2**63 - 2**48
"""Samples since the epoch that files count to; what is added to them, lengths of stretches, then still fits 64 bits."""
MAX_START_UNIX_S = 250_000_000_000
"""In the year 9892: dates end with 9999."""
ID_PATTERN = r"^[A-Za-z0-9_.\-]*[A-Za-z0-9_\-][A-Za-z0-9_.\-]*$"
"""Names become groups in files, and parts of file names: not `.` and `..`."""
MAX_ID_LENGTH = 100

Point = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Identifier = Annotated[str, Field(min_length=1, max_length=MAX_ID_LENGTH, pattern=ID_PATTERN)]


class Record(BaseModel):
    """Frozen, refuses unknown keys, NaN and infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def changed(self, **values: Any) -> Self:
        """Return the record with some of its values changed, and checked as a file is; see `Scenario.changed`."""
        try:
            return type(self).model_validate(merged(self.model_dump(exclude_none=True), values))
        except ValidationError as error:
            raise ScenarioError(in_words(error)) from error


def merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain values with those of ``new`` in place of the old; tables go into each other, None takes away."""
    out = dict(old)
    for key, value in new.items():
        if value is None:
            out.pop(key, None)
        elif isinstance(value, Mapping):
            inner = out.get(key, {})
            out[key] = [merged(each, value) for each in inner] if isinstance(inner, tuple) else merged(inner, value)
        else:
            out[key] = _plain(value)
    return out


def _plain(value: Any) -> Any:
    if isinstance(value, Record):
        return value.model_dump(exclude_none=True)
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    return tuple(map(_plain, value)) if isinstance(value, list | tuple) else value


class Radio(Record):
    """The recorded band and how it is cut into frames."""

    sample_rate_hz: Annotated[float, Field(ge=float(RATE_LIMITS[0]), le=float(RATE_LIMITS[1]))]
    centre_frequency_hz: NonNegative
    frame_samples: Annotated[int, Field(ge=MIN_FRAME_SAMPLES, le=MAX_FRAME_SAMPLES)]
    propagation_speed_mps: Positive = SPEED_OF_LIGHT_MPS
    clock_search_ppm: NonNegative = 50.0
    """Receiver clocks are searched within plus and minus this offset."""

    @property
    def sample_rate(self) -> Fraction:
        """Sample rate as a rational number [1/s]."""
        return exact_rate("sample_rate_hz", self.sample_rate_hz)


class Tone(Record):
    """One ranging sinusoid, common to all transmitters, given by its frequency or its wavelength."""

    frequency_hz: Positive | None = None
    wavelength_m: Positive | None = None
    modulation_index: Positive = 0.8

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.frequency_hz is None) == (self.wavelength_m is None):
            raise ValueError("give exactly one of `frequency_hz` and `wavelength_m`")
        return self


class Transmitter(Record):
    """A transmitter at a surveyed place; its carrier is given as the offset from the centre frequency."""

    id: Identifier
    position_enu_m: Point
    carrier_hz: float
    mast: Identifier | None = None
    """Another transmitter, at whose antenna it is one more carrier."""
    amplitude: Positive = 1.0
    survey_sigma_m: NonNegative = 0.0
    """How well its place is surveyed, each axis; `rfpose survey` may move it so far."""


class CalibrationReceiver(Record):
    """A receiver at a surveyed place, from which the transmitters' electronic phases are measured."""

    id: Identifier
    position_enu_m: Point
    survey_sigma_m: NonNegative = 0.0


class Mirror(Record):
    """What the mirrors have in common; a heliostat may override each entry.

    Receivers are given in the mirror frame (x to the right seen from the front, y up, z along the normal),
    whose origin is the mirror's centre. The centre lies ``arm_m`` from the pivot along the normal.
    """

    receiver_mirror_m: tuple[Point, ...] | None = None
    arm_m: NonNegative = 0.0
    width_m: Positive | None = None
    height_m: Positive | None = None
    """The mirror's outline, along its x and y; without it the mirror hides and reflects nothing."""
    oscillator: Literal["shared", "separate"] = "shared"
    receiver_delay_sigma_s: NonNegative | None = None
    """How well the delays between a mirror's receivers are known; without it they are unknown in every frame."""
    receiver_delay_drift_s_per_sqrt_min: NonNegative | None = None
    """How fast unknown delays between receivers on one oscillator drift; given, they are learned over frames."""
    pivot_sigma_m: Positive | None = None
    """How well pivots are surveyed; without it they are not used."""
    receiver_survey_sigma_m: Positive = 0.001
    """How well receivers' places on the mirror are known, each axis; `rfpose survey` may move them so far."""
    carrier_phase: bool = True
    """Whether receivers on one oscillator also compare the carriers' own phases."""
    mount: Literal["free", "azimuth_elevation"] = "free"
    """Whether orientation is held to a two-axis mount, whose mirror keeps its x axis horizontal."""


class Heliostat(Record):
    """One heliostat: a pivot and three or more receivers fixed to its mirror."""

    id: Identifier
    pivot_enu_m: Point
    receiver_mirror_m: tuple[Point, ...]
    receiver_ids: tuple[Identifier, ...]
    arm_m: NonNegative = 0.0
    width_m: Positive | None = None
    height_m: Positive | None = None
    oscillator: Literal["shared", "separate"] = "shared"
    receiver_delay_sigma_s: NonNegative | None = None
    receiver_delay_drift_s_per_sqrt_min: NonNegative | None = None
    pivot_sigma_m: Positive | None = None
    receiver_survey_sigma_m: Positive = 0.001
    carrier_phase: bool = True
    mount: Literal["free", "azimuth_elevation"] = "free"
    normal_enu: Point | None = None
    """Posture for simulation; without it the mirror reflects the simulated sun onto the aim point."""

    @model_validator(mode="after")
    def _receivers_span_a_plane(self) -> Self:
        n = len(self.receiver_mirror_m)
        if n < 3:
            raise ValueError(f"`receiver_mirror_m` must hold three or more receivers, got {n}")
        if len(self.receiver_ids) != n:
            raise ValueError(f"`receiver_ids` must name all {n} receivers, got {len(self.receiver_ids)}")
        if geometry.is_collinear(self.receiver_mirror_m):
            raise ValueError("`receiver_mirror_m` must not lie on a line: a line fixes no normal; move one aside")
        if (self.width_m is None) != (self.height_m is None):
            raise ValueError("`width_m` and `height_m` outline a mirror together: give both or neither")
        if self.normal_enu is not None and math.hypot(*self.normal_enu) < 1e-9:
            raise ValueError("`normal_enu` must not be zero")
        if self.receiver_delay_drift_s_per_sqrt_min is not None:
            if self.receiver_delay_sigma_s is not None:
                raise ValueError(
                    "give `receiver_delay_sigma_s` (delays known) or `receiver_delay_drift_s_per_sqrt_min` (delays "
                    "learned over frames), not both"
                )
            if self.oscillator != "shared":
                raise ValueError(
                    "`receiver_delay_drift_s_per_sqrt_min` learns delays between receivers on one oscillator; it needs "
                    '`oscillator = "shared"`'
                )
        return self
