"""A result in words and rows for people: counts, reasons, poses as CSV."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import LineStatus
from rfpose.multilat import FilterStatus, FixStatus, PoseStatus
from rfpose.multilat.integrity import IntegrityStatus, TransmitterStatus
from rfpose.multilat.rigid.integers import IntegerMethod
from rfpose.multilat.rigid.problem import PRIORS
from rfpose.pipeline.formats.choice_text import settings_of
from rfpose.pipeline.formats.result import (
    DelayTable,
    FilteredTable,
    IntegrityTable,
    ReflectionTable,
    Result,
    SiteTable,
    frame_time,
)
from rfpose.tables import write_csv

__all__ = [
    "CSV_COLUMNS",
    "DISTURBED",
    "EXPLAINED",
    "NEEDED_PROBABILITY",
    "count_reasons",
    "fix_table",
    "left_out_of",
    "pose_table",
    "summarise",
    "write_poses_csv",
]

NEEDED_PROBABILITY = 1e-3
"""Residuals of the direct ray alone that are rarer than this say that a reflection is needed."""

DISTURBED = 0.3
"""A link that counts less than this, beside one without surprises, hears more than is foreseen."""
EXPLAINED = (IntegrityStatus.EXCLUDED, IntegrityStatus.PRIOR_REJECTED, IntegrityStatus.AMBIGUOUS)
"""Where what was left out explains the residuals; elsewhere its names mean nothing."""


def count_reasons(status: npt.NDArray[Any], codes: type[IntEnum]) -> dict[str, int]:
    """Count what went wrong, most frequent first; what went well is left out."""
    counted = Counter(int(code) for code in status.ravel() if code != 0)
    return {codes(code).reason: n for code, n in counted.most_common()}  # type: ignore[attr-defined]


def summarise(result: Result) -> dict[str, Any]:
    """Return counts of what was solved and what was not, with reasons; keys are part of the command line."""
    is_mirror = np.array([row.heliostat is not None for row in result.scenario.receivers], bool)
    parts = {
        "poses": (result.poses.status, PoseStatus),
        "fixes": (result.fixes.status[:, is_mirror], FixStatus),
        "transmitters": (result.tones.status, LineStatus),
        "tones": (_status_of_tones(result), LineStatus),
    }
    summary: dict[str, Any] = {
        "frames": len(result.frame_start_index),
        "heliostats": len(result.scenario.heliostat_ids),
        "receivers": len(result.scenario.receiver_ids),
        "estimator": result.settings["estimator"],
        "pose": result.choice.pose,
    }
    for name, (status, codes) in parts.items():
        solved = int(np.count_nonzero(status == 0))
        summary[name] = {"solved": solved, "failed": status.size - solved, "reasons": count_reasons(status, codes)}
    choice = {"delays": "as the scenario says", **result.settings, **settings_of(result.choice)}
    summary["choice"] = {name: choice[name] for name in ("reflection", "integrity", "delays", "filter")}
    if result.choice.pose == "rigid":
        summary["integers"] = _summary_of_integers(result)
    if result.integrity is not None:
        summary["integrity"] = _summary_of_integrity(result, result.integrity)
    if result.reflection is not None:
        summary["reflection"] = _summary_of_reflection(result, result.reflection)
    if result.site is not None:
        summary["site"] = _summary_of_site(result.site)
    if result.delays is not None:
        summary["delays"] = _summary_of_delays(result.delays)
    if result.filtered is not None:
        summary["filtered"] = _summary_of_filtered(result.filtered)
    return summary


def _status_of_tones(result: Result) -> npt.NDArray[Any]:
    """(frame, receiver, transmitter, tone) what is wrong with each; a weak tone may fail beside a good one."""
    status = np.repeat(result.tones.status[..., None], result.tones.phase_rad.shape[-1], axis=-1)
    missing = (status == 0) & ~np.isfinite(result.tones.phase_rad)
    measured = (status == LineStatus.WEAK) & np.isfinite(result.tones.phase_rad)
    return np.where(missing, LineStatus.WEAK, np.where(measured, 0, status))


def _summary_of_integers(result: Result) -> dict[str, Any]:
    """Count, by wavelength, how integers of solved mirror-frames were found."""
    scenario = result.scenario
    names = [f"{f / 1e6:.9g} MHz" for f in np.sort(scenario.tone_hz)]
    if any(scenario.compares_carriers(h) for h in scenario.heliostat):
        names.append("carrier")
    method = result.poses.integer_method[result.poses.status == PoseStatus.OK]
    return {
        name: {IntegerMethod(code).reason: n for code, n in Counter(method[:, k].tolist()).most_common()}
        for k, name in enumerate(names)
    }


def _summary_of_site(table: SiteTable) -> dict[str, Any]:
    weight, floor = table.weight[np.isfinite(table.weight)], table.floor[np.isfinite(table.floor)]
    change = table.permittivity_change[np.isfinite(table.permittivity_change)]
    return {
        "links": weight.size,
        "disturbed": int(np.count_nonzero(weight < DISTURBED)),
        "floor": float(np.median(floor)) if floor.size else None,
        "permittivity_change": float(change[0].real) if change.size else None,
    }


def _summary_of_filtered(table: FilteredTable) -> dict[str, Any]:
    sigma = table.sigma_rad[np.isfinite(table.sigma_rad)]
    counted = Counter(table.status.ravel().tolist())
    return {
        "reasons": {FilterStatus(code).reason: n for code, n in counted.most_common()},
        "sigma_mrad": 1e3 * float(np.median(sigma)) if sigma.size else None,
    }


def _summary_of_integrity(result: Result, table: IntegrityTable) -> dict[str, Any]:
    excluded = {}
    explained = np.isin(table.status, EXPLAINED)
    for i, name in enumerate(result.scenario.transmitter_ids):
        status = np.where(explained, table.transmitter_status[..., i], 0)
        reasons = count_reasons(np.where(status > TransmitterStatus.NOT_RECEIVED, status, 0), TransmitterStatus)
        if reasons:
            excluded[name] = reasons
    level = table.protection_level_rad[np.isfinite(table.protection_level_rad)]
    return {
        "reasons": count_reasons(table.status, IntegrityStatus),
        "excluded": excluded,
        "priors_rejected": {
            name: int(np.count_nonzero(table.prior_rejected[..., k]))
            for k, name in enumerate(PRIORS)
            if np.any(table.prior_rejected[..., k])
        },
        "protected": int(level.size),
        "protection_level_mrad": 1e3 * float(np.median(level)) if level.size else None,
    }


def _summary_of_reflection(result: Result, table: ReflectionTable) -> dict[str, Any]:
    names = ("ground", *(plane.name for plane in result.scenario.reflection.plane))
    needed = table.probability_direct < NEEDED_PROBABILITY
    return {
        "needed": int(np.count_nonzero(needed)),
        "coefficients": {
            name: _summary_of_coefficient(table.coefficient[..., p], table.coefficient_sigma[..., p, :])
            for p, name in enumerate(names)
        },
    }


def _summary_of_coefficient(coefficient: npt.NDArray[np.complex128], sigma: FloatArray) -> dict[str, Any]:
    known = np.isfinite(coefficient.real) & np.isfinite(sigma).all(axis=-1)
    if not np.any(known):
        return {"status": "not determined", "real": None, "imag": None, "sigma": None}
    value, spread = coefficient[known], np.hypot(sigma[known][:, 0], sigma[known][:, 1])
    return {
        "status": "given" if np.all(spread == 0.0) else "estimated",
        "real": float(np.median(value.real)),
        "imag": float(np.median(value.imag)),
        "sigma": float(np.median(spread)),
    }


def _summary_of_delays(table: DelayTable) -> dict[str, Any]:
    last = table.sigma_s[-1]
    # the first receiver's delay is zero by definition
    learned = last[np.isfinite(last) & (last > 0.0)]
    return {
        "jumps": int(np.count_nonzero(table.jumped)),
        "last_sigma_ps": 1e12 * float(np.median(learned)) if learned.size else None,
    }


CSV_COLUMNS = (
    "frame",
    "time_utc",
    "heliostat",
    "azimuth_deg",
    "elevation_deg",
    "normal_east",
    "normal_north",
    "normal_up",
    "normal_sigma_mrad",
    "status",
    "centre_east_m",
    "centre_north_m",
    "centre_up_m",
    "receivers",
    "protection_level_mrad",
    "integrity",
    "transmitters_left_out",
)


_CSV_FORMATS = ("", "", "", ".6f", ".6f", ".9f", ".9f", ".9f", ".6f", "", ".6f", ".6f", ".6f", "", ".6f", "", "")


def pose_table(result: Result) -> tuple[list[str], list[list[Any]]]:
    """Return header and rows of the mirror normals for people: degrees, milliradians of the normal; by frame.

    The centre is the mean of the receivers' places. ``integrity`` and ``transmitters_left_out`` (names with spaces
    between) are empty where nothing was tested; a protection level is infinite where nothing protects the pose.
    """
    poses, rows = result.poses, []
    azimuth, elevation, mrad = np.degrees(poses.azimuth_rad), np.degrees(poses.elevation_rad), 1e3 * poses.sigma_rad
    tested = _tests(result)
    for i_frame, start in enumerate(result.frame_start_index):
        time = frame_time(int(start), result.sample_rate)
        for i, name in enumerate(result.scenario.heliostat_ids):
            k = (i_frame, i)
            status = PoseStatus(int(poses.status[k])).reason
            pose = [azimuth[k], elevation[k], *poses.normal_enu[k], mrad[k], status]
            rows.append([i_frame, time, name, *pose, *poses.centre_enu_m[k], int(poses.n_receiver[k]), *tested(k)])
    return list(CSV_COLUMNS), rows


def _tests(result: Result) -> Callable[[tuple[int, int]], tuple[float, str, str]]:
    """Return what gives a mirror-frame's protection level [mrad], integrity in words, and transmitters left out."""
    table = result.integrity
    if table is None:
        return lambda _: (np.nan, "", "")
    names = np.array(result.scenario.transmitter_ids)
    left_out = left_out_of(table)

    def of(k: tuple[int, int]) -> tuple[float, str, str]:
        words = IntegrityStatus(int(table.status[k])).reason
        return 1e3 * float(table.protection_level_rad[k]), words, " ".join(names[left_out[k]])

    return of


def left_out_of(table: IntegrityTable) -> npt.NDArray[np.bool_]:
    """Return (frame, heliostat, transmitter) which the tests left out, where that explains the residuals."""
    explained = np.isin(table.status, EXPLAINED)[..., None]
    return np.asarray(explained & (table.transmitter_status > TransmitterStatus.NOT_RECEIVED))


def fix_table(result: Result) -> tuple[list[str], list[list[Any]]]:
    """Return header and rows of the receivers' places, each located on its own [m]; by frame."""
    fixes, scenario, rows = result.fixes, result.scenario, []
    sigma_m = np.sqrt(np.trace(fixes.cov_enu_m2, axis1=-2, axis2=-1))
    for i_frame, start in enumerate(result.frame_start_index):
        time = frame_time(int(start), result.sample_rate)
        for i, receiver in enumerate(scenario.receivers):
            k = (i_frame, i)
            owner = "" if receiver.heliostat is None else scenario.heliostat_ids[receiver.heliostat]
            status = FixStatus(int(fixes.status[k])).reason
            place = fixes.position_enu_m[k]
            rows.append([i_frame, time, receiver.id, owner, *place, sigma_m[k], fixes.dop[k], status])
    header = ["frame", "time_utc", "receiver", "heliostat", "east_m", "north_m", "up_m", "sigma_m", "dop", "status"]
    return header, rows


def write_poses_csv(result: Result, path: str | Path) -> None:
    """Write the mirror normals for people as CSV, as `pose_table` has them; numbers that are not known stay empty.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """

    def cell(value: Any, form: str) -> Any:
        return value if not form else "" if np.isnan(value) else f"{value:{form}}"

    header, rows = pose_table(result)
    write_csv(path, header, [[cell(v, form) for v, form in zip(row, _CSV_FORMATS, strict=True)] for row in rows])
