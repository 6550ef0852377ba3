"""Where everything is in each frame: frame starts, mirror normals, receiver positions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.scenario import MAX_SAMPLE_INDEX, Heliostat, Scenario
from rfpose.scenario.records import MAX_START_UNIX_S

__all__ = ["frame_start_index", "mirror_normal_enu", "receiver_enu_m"]

_MIN_RANGE_M = 1e-6


def frame_start_index(scenario: Scenario) -> npt.NDArray[np.int64]:
    """Return each frame's first sample (frame,), counted from the Unix epoch at the nominal rate.

    Raises
    ------
    ScenarioError
        Frames overlap, or the count does not fit 64 bits.
    """
    simulation, radio = scenario.simulation, scenario.radio
    rate = radio.sample_rate
    interval = Fraction(simulation.frame_interval_s).limit_denominator(10**9) * rate
    if interval == 0:
        interval = Fraction(radio.frame_samples)
    elif interval < radio.frame_samples:
        raise ScenarioError(
            f"`simulation.frame_interval_s` = {simulation.frame_interval_s:g} is shorter than a frame of "
            f"{radio.frame_samples} samples ({float(radio.frame_samples / rate):g} s): frames overlap; lengthen it, "
            "or give 0 for frames back to back"
        )
    first = round(simulation.start_unix_s * rate)
    if first + (simulation.frame_count + 1) * interval > MAX_SAMPLE_INDEX:
        raise ScenarioError(
            "sample counts since the epoch exceed 64 bits; reduce `simulation.start_unix_s`, "
            "`simulation.frame_interval_s` or `radio.sample_rate_hz`"
        )
    if simulation.start_unix_s + simulation.frame_count * interval / rate > MAX_START_UNIX_S:
        raise ScenarioError(
            "the last frame lies beyond the year 9892, and dates end with 9999; reduce `simulation.start_unix_s`, "
            "`simulation.frame_count` or `simulation.frame_interval_s`"
        )
    return np.array([first + round(k * interval) for k in range(simulation.frame_count)], np.int64)


def mirror_normal_enu(scenario: Scenario) -> FloatArray:
    """Return mirror normals (frame, heliostat, xyz): as given, or such that the sun is reflected to the aim point.

    Raises
    ------
    ScenarioError
        A heliostat has no posture; names the heliostat and the keys to give.
    """
    n_frame = scenario.simulation.frame_count
    normal = np.empty((n_frame, len(scenario.heliostat), 3))
    for i, heliostat in enumerate(scenario.heliostat):
        if heliostat.normal_enu is not None:
            normal[:, i] = geometry.unit(heliostat.normal_enu)
        else:
            normal[:, i] = _tracking_normal(scenario, heliostat)
    return normal


def _tracking_normal(scenario: Scenario, heliostat: Heliostat) -> FloatArray:
    azimuth, elevation = scenario.simulation.sun_azimuth_deg, scenario.simulation.sun_elevation_deg
    aim = scenario.site.aim_enu_m
    if azimuth is None or elevation is None or aim is None:
        wanted = {
            "simulation.sun_azimuth_deg": azimuth,
            "simulation.sun_elevation_deg": elevation,
            "site.aim_enu_m": aim,
        }
        missing = ", ".join(f"`{key}`" for key, value in wanted.items() if value is None)
        raise ScenarioError(
            f"heliostat `{heliostat.id}` has no posture to simulate: give its `normal_enu`, or give {missing}"
        )
    to_aim = np.asarray(aim) - np.asarray(heliostat.pivot_enu_m)
    if np.linalg.norm(to_aim) < _MIN_RANGE_M:
        raise ScenarioError(f"heliostat `{heliostat.id}` stands at `site.aim_enu_m`; move one, or give `normal_enu`")
    n_frame = scenario.simulation.frame_count
    sun = geometry.enu_from_azimuth_elevation(_over_frames(azimuth, n_frame), _over_frames(elevation, n_frame))
    normal = geometry.bisector_enu(sun, np.broadcast_to(to_aim, sun.shape))
    if not np.all(np.isfinite(normal)):
        raise ScenarioError(
            f"heliostat `{heliostat.id}`: sun and aim point are opposite, no normal reflects one to the other; "
            "change `simulation.sun_azimuth_deg`, or give `normal_enu`"
        )
    return normal


def _over_frames(value_deg: float | tuple[float, float], n_frame: int) -> FloatArray:
    first, last = value_deg if isinstance(value_deg, tuple) else (value_deg, value_deg)
    return np.radians(np.linspace(first, last, n_frame))


def receiver_enu_m(scenario: Scenario, normal_enu: FloatArray) -> FloatArray:
    """Return receiver positions (frame, receiver, xyz) [m]; calibration receivers stand still.

    Parameters
    ----------
    scenario
    normal_enu : (frame, heliostat, xyz)
        Mirror normals.
    """
    position = np.empty((len(normal_enu), len(scenario.receivers), 3))
    for i, heliostat in enumerate(scenario.heliostat):
        rot_enu_from_mirror = geometry.rot_enu_from_mirror(normal_enu[:, i])
        from_pivot_mirror = np.asarray(heliostat.receiver_mirror_m) + np.array([0.0, 0.0, heliostat.arm_m])
        offset = np.einsum("fij,rj->fri", rot_enu_from_mirror, from_pivot_mirror)
        position[:, scenario.receiver_rows(i)] = np.asarray(heliostat.pivot_enu_m) + offset
    n_mirror_receiver = len(scenario.receivers) - len(scenario.calibration_receiver)
    position[:, n_mirror_receiver:] = scenario.calibration_enu_m
    return position
