"""Where everything is in each frame: frame starts, mirror normals, receiver positions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.scenario import MAX_SAMPLE_INDEX, Scenario
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
            normal[:, i] = _tracking_normal(scenario, i)
    return normal


def _tracking_normal(scenario: Scenario, i: int) -> FloatArray:
    heliostat, suns = scenario.heliostat[i], scenario.simulated_suns_enu
    following = None if suns is None else scenario.following_enu(suns)
    if suns is None or following is None:
        raise ScenarioError(
            f"heliostat `{heliostat.id}` has no posture to simulate: give its `normal_enu`, or give "
            f"{_missing_for_sun(scenario)}"
        )
    night = np.flatnonzero(np.isnan(suns).any(axis=-1))
    if night.size:
        raise ScenarioError(
            f"at frame {night[0]} the sun is below the horizon of the site: change `simulation.start`, "
            f"`site.latitude_deg` or `site.longitude_deg`, or give heliostat `{heliostat.id}` a `normal_enu`"
        )
    if scenario.site.aim_enu_m is not None:
        to_aim = np.asarray(scenario.site.aim_enu_m) - np.asarray(heliostat.pivot_enu_m)
        if np.linalg.norm(to_aim) < _MIN_RANGE_M:
            raise ScenarioError(
                f"heliostat `{heliostat.id}` stands at `site.aim_enu_m`; move one, or give `normal_enu`"
            )
    if not np.all(np.isfinite(following[:, i])):
        raise ScenarioError(
            f"heliostat `{heliostat.id}`: sun and aim point are opposite, no normal reflects one to the other; "
            "change `simulation.sun_azimuth_deg`, or give `normal_enu`"
        )
    return following[:, i]


def _missing_for_sun(scenario: Scenario) -> str:
    simulation, site = scenario.simulation, scenario.site
    sun = {
        "simulation.sun_azimuth_deg": simulation.sun_azimuth_deg,
        "simulation.sun_elevation_deg": simulation.sun_elevation_deg,
    }
    missing = [f"`{key}`" for key, value in sun.items() if value is None]
    if len(missing) == len(sun):
        missing = [
            "`site.latitude_deg` and `site.longitude_deg` (for the sun of `simulation.start`) or "
            + " and ".join(missing)
        ]
    if scenario.simulated_suns_enu is not None:
        missing = []
    if site.aim_enu_m is None and scenario.tracking.collector != "dish":
        missing.append("`site.aim_enu_m`")
    return ", ".join(missing)


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
