"""A site, and what was measured of it, as arrays to draw: one row a heliostat, one layer a frame."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import CalibrationStatus, LineStatus
from rfpose.errors import RfposeError
from rfpose.geometry import rot_enu_from_mirror, unit
from rfpose.multilat import FixStatus, PoseStatus, RangeStatus
from rfpose.multilat.integrity import TransmitterStatus
from rfpose.multilat.rigid.problem import PRIORS
from rfpose.pipeline.evaluate import evaluate
from rfpose.pipeline.formats.result import Result, frame_time
from rfpose.scenario import Scenario

__all__ = [
    "Exclusion",
    "FieldPicture",
    "History",
    "field_of_result",
    "field_of_scenario",
    "history",
    "project",
    "seen_transmitters",
]

_ELLIPSE_POINTS = 64
_CHI_95 = 2.4477468306808161
"""Radius of the ellipse that holds 95 % of a normal distribution of two dimensions, in sigmas: √(−2 ln 0.05)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldPicture:
    """What there is to draw; a site without a result has no frames.

    Attributes
    ----------
    name
        The scenario's.
    transmitter_ids, transmitter_enu_m : (transmitter, xyz)
    calibration_ids, calibration_enu_m : (calibration receiver, xyz)
    heliostat_ids, pivot_enu_m : (heliostat, xyz)
        [m].
    time : (frame,)
        UTC of each frame, ISO 8601.
    time_s : (frame,)
        From the first frame [s].
    normal_enu : (frame, heliostat, xyz)
        Measured; NaN where not solved.
    error_mrad : (frame, heliostat) or None
        Angle to the true normal [mrad of the normal]; None without a truth.
    sigma_mrad : (frame, heliostat)
        RMS angle that the result claims [mrad of the normal].
    status : (frame, heliostat)
        `rfpose.multilat.PoseStatus`.
    n_transmitter : (frame, heliostat)
        Transmitters seen by the mirror's worst receiver.
    error_enu : (frame, heliostat, xyz) or None
        Measured less true normal.
    """

    name: str
    transmitter_ids: tuple[str, ...]
    transmitter_enu_m: FloatArray
    calibration_ids: tuple[str, ...]
    calibration_enu_m: FloatArray
    heliostat_ids: tuple[str, ...]
    pivot_enu_m: FloatArray
    time: tuple[str, ...]
    time_s: FloatArray
    normal_enu: FloatArray
    error_mrad: FloatArray | None
    sigma_mrad: FloatArray
    status: npt.NDArray[np.int8]
    n_transmitter: npt.NDArray[np.int64]
    error_enu: FloatArray | None = None

    @property
    def n_frame(self) -> int:
        """Number of frames."""
        return len(self.time)

    @property
    def extent_m(self) -> float:
        """Largest horizontal distance between any two sides of the site, never zero [m]."""
        ground = np.concatenate([self.transmitter_enu_m[:, :2], self.pivot_enu_m[:, :2]])
        ground = ground[np.isfinite(ground).all(axis=1)]
        return max(float(np.ptp(ground, axis=0).max()), 1.0) if len(ground) else 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Exclusion:
    """A transmitter (or what else a pose rests on) that had no full part in it: why, and how often."""

    transmitter_id: str
    reason: str
    count: int
    total: int
    unit: str = "receiver-frames"


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """One heliostat over the frames; offsets are in the plane across its normal, x horizontal, y up the mirror.

    Attributes
    ----------
    time_s : (frame,)
    offset_mrad : (frame, xy)
        Measured normal less the true one, or less the mean where no truth is known [mrad of the normal].
    ellipse_mrad : (frame, point, xy)
        95 % of the claimed covariance about each offset; NaN where unknown.
    sigma_mrad : (frame,)
    azimuth_deg, elevation_deg : (frame,)
        Of the normal; azimuth from north, clockwise.
    has_truth
        What ``offset_mrad`` is relative to.
    residual_mm, residual_sigma_mm : (frame, transmitter)
        Computed less measured range, mean over the receivers, and the sigma of one range.
    status : (frame,)
        In words.
    fix_reasons
        What kept receivers from being located, with counts.
    exclusions
    protection_level_mrad : (frame,)
        The normal is off by more, unnoticed, as rarely as the scenario asks; NaN where nobody tested.
    """

    time_s: FloatArray
    offset_mrad: FloatArray
    ellipse_mrad: FloatArray
    sigma_mrad: FloatArray
    azimuth_deg: FloatArray
    elevation_deg: FloatArray
    has_truth: bool
    residual_mm: FloatArray
    residual_sigma_mm: FloatArray
    status: tuple[str, ...]
    fix_reasons: dict[str, int]
    exclusions: tuple[Exclusion, ...]
    protection_level_mrad: FloatArray


def field_of_scenario(scenario: Scenario) -> FieldPicture:
    """Return a site to which nothing has been measured; normals are those of `Scenario.posture_enu`."""
    n = len(scenario.heliostat)
    normal = scenario.posture_enu.reshape(1, n, 3)
    shown = bool(np.isfinite(normal).any())
    return FieldPicture(
        **_site(scenario),
        time=("as in the scenario",) if shown else (),
        time_s=np.zeros(int(shown)),
        normal_enu=normal[: int(shown)],
        error_mrad=None,
        sigma_mrad=np.full((int(shown), n), np.nan),
        status=np.zeros((int(shown), n), np.int8),
        n_transmitter=np.full((int(shown), n), len(scenario.transmitter), np.int64),
    )


def _site(scenario: Scenario) -> dict[str, Any]:
    return {
        "name": scenario.name,
        "transmitter_ids": scenario.transmitter_ids,
        "transmitter_enu_m": scenario.transmitter_enu_m,
        "calibration_ids": tuple(r.id for r in scenario.calibration_receiver),
        "calibration_enu_m": scenario.calibration_enu_m,
        "heliostat_ids": scenario.heliostat_ids,
        "pivot_enu_m": scenario.pivot_enu_m,
    }


def field_of_result(result: Result) -> FieldPicture:
    """Return a measured field, with errors where the truth is known."""
    start = result.frame_start_index
    error_mrad = error_enu = None
    if result.truth is not None and len(start):
        try:
            error_mrad = 1e3 * evaluate(result).normal_error_rad
        except RfposeError:  # a truth that cannot be compared is none
            error_mrad = None
        error_enu = _true_normals(result)
        error_enu = None if error_enu is None else result.poses.normal_enu - error_enu
    return FieldPicture(
        **_site(result.scenario),
        time=tuple(frame_time(int(s), result.sample_rate).isoformat(timespec="milliseconds") for s in start),
        time_s=_time_s(result),
        normal_enu=result.poses.normal_enu,
        error_mrad=error_mrad,
        sigma_mrad=1e3 * result.poses.sigma_rad,
        status=result.poses.status,
        n_transmitter=seen_transmitters(result),
        error_enu=error_enu,
    )


def _time_s(result: Result) -> FloatArray:
    start = result.frame_start_index
    first = start[0] if len(start) else 0
    return np.asarray((start - first) / float(result.sample_rate), np.float64)


def _true_normals(result: Result) -> FloatArray | None:
    """(frame, heliostat, xyz) true normals; None without a truth."""
    from rfpose.pipeline.formats.truth_rows import truth_rows

    if result.truth is None:
        return None
    rows = truth_rows(result.truth, result.frame_start_index)
    normal = np.array(result.truth.normal_enu[np.maximum(rows, 0)], np.float64)
    normal[rows < 0] = np.nan
    return normal


def seen_transmitters(result: Result) -> npt.NDArray[np.int64]:
    """Return (frame, heliostat) transmitters that the mirror's worst receiver sees."""
    count = np.isfinite(result.ranges.range_difference_m).sum(axis=2)
    sizes = [len(h.receiver_ids) for h in result.scenario.heliostat]
    if not sizes:
        return np.zeros((len(count), 0), np.int64)
    first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    return np.asarray(np.minimum.reduceat(count[:, : sum(sizes)], first, axis=1), np.int64)


def history(result: Result, i_heliostat: int) -> History:
    """Return one heliostat's poses over the frames, its residuals, and which transmitters had no part and why."""
    poses, rows = result.poses, result.scenario.receiver_rows(i_heliostat)
    normal = poses.normal_enu[:, i_heliostat]
    truth = _true_normals(result)
    reference = None if truth is None else truth[:, i_heliostat]
    has_truth = reference is not None and bool(np.isfinite(reference).any())
    if reference is None or not has_truth:
        solved = normal[np.isfinite(normal).all(axis=1)]
        mean = solved.mean(axis=0) if len(solved) else np.full(3, np.nan)
        reference = np.broadcast_to(mean, normal.shape)
    across = np.swapaxes(rot_enu_from_mirror(reference), -1, -2)[:, :2]
    offset = np.einsum("fax,fx->fa", across, normal - unit(reference))
    cov = np.einsum("fax,fxy,fby->fab", across, poses.cov_enu[:, i_heliostat], across)
    with np.errstate(invalid="ignore", divide="ignore"):
        residual = _mean(result.fixes.residual_m[:, rows])
        sigma = _mean(result.ranges.sigma_m[:, rows])
    return History(
        time_s=_time_s(result),
        offset_mrad=1e3 * offset,
        ellipse_mrad=1e3 * (offset[:, None] + _ellipses(cov)),
        sigma_mrad=1e3 * poses.sigma_rad[:, i_heliostat],
        azimuth_deg=np.degrees(poses.azimuth_rad[:, i_heliostat]),
        elevation_deg=np.degrees(poses.elevation_rad[:, i_heliostat]),
        has_truth=has_truth,
        residual_mm=1e3 * residual,
        residual_sigma_mm=1e3 * sigma,
        status=tuple(PoseStatus(int(s)).reason for s in poses.status[:, i_heliostat]),
        fix_reasons={
            FixStatus(code).reason: n
            for code, n in Counter(int(s) for s in result.fixes.status[:, rows].ravel() if s).most_common()
        },
        exclusions=_exclusions(result, rows) + _rejections(result, i_heliostat),
        protection_level_mrad=_protection_mrad(result, i_heliostat),
    )


def _mean(values: FloatArray) -> FloatArray:
    """Mean over the receivers (frame, transmitter); NaN where none counts."""
    known = np.isfinite(values)
    return np.asarray(np.where(known, values, 0.0).sum(axis=1) / np.where(known.any(axis=1), known.sum(axis=1), np.nan))


def _ellipses(cov: FloatArray) -> FloatArray:
    """(frame, point, xy) outlines that hold 95 %; NaN for covariances that are none."""
    known = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    size, axes = np.linalg.eigh(np.where(known[:, None, None], cov, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS)
    circle = _CHI_95 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outline = np.einsum("fab,fb,pb->fpa", axes, np.sqrt(np.maximum(size, 0.0)), circle)
    outline[~known] = np.nan
    return np.asarray(outline)


def _exclusions(result: Result, rows: slice) -> tuple[Exclusion, ...]:
    """Which transmitters were not used in full, by the first stage that refused them."""
    tones, ranges = result.tones.status[:, rows], result.ranges.status[:, rows]
    calibration = np.broadcast_to(result.calibration.status[:, None], tones.shape)
    total = tones.shape[0] * tones.shape[1]
    found = []
    for t, name in enumerate(result.scenario.transmitter_ids):
        counted: Counter[str] = Counter()
        for tone, own, given in zip(
            tones[..., t].ravel(), ranges[..., t].ravel(), calibration[..., t].ravel(), strict=True
        ):
            if tone:
                counted[LineStatus(int(tone)).reason] += 1
            elif given == CalibrationStatus.MISSING:
                counted[CalibrationStatus.MISSING.reason] += 1
            elif own:
                counted[RangeStatus(int(own)).reason] += 1
        found += [Exclusion(transmitter_id=name, reason=r, count=n, total=total) for r, n in counted.most_common()]
    return tuple(found)


def _rejections(result: Result, i_heliostat: int) -> tuple[Exclusion, ...]:
    """Which transmitters and priors the tests of the residuals threw out, and in how many frames."""
    tests = result.integrity
    if tests is None:
        return ()
    found, total = [], len(result.frame_start_index)
    for t, name in enumerate(result.scenario.transmitter_ids):
        counted = Counter(int(s) for s in tests.transmitter_status[:, i_heliostat, t])
        for code, count in counted.most_common():
            if code not in (TransmitterStatus.OK, TransmitterStatus.NOT_RECEIVED):
                reason = TransmitterStatus(code).reason
                found.append(Exclusion(transmitter_id=name, reason=reason, count=count, total=total, unit="frames"))
    for prior, name in enumerate(PRIORS):
        count = int(np.count_nonzero(tests.prior_rejected[:, i_heliostat, prior]))
        if count:
            reason = "contradicts the phases"
            found.append(Exclusion(transmitter_id=name, reason=reason, count=count, total=total, unit="frames"))
    return tuple(found)


def _protection_mrad(result: Result, i_heliostat: int) -> FloatArray:
    if result.integrity is None:
        return np.full(len(result.frame_start_index), np.nan)
    return np.asarray(1e3 * result.integrity.protection_level_rad[:, i_heliostat])


def project(point_enu_m: FloatArray, azimuth_rad: float, elevation_rad: float) -> FloatArray:
    """Return points as seen from afar (..., xyz): x to the right, y up, z towards the eye [same unit].

    The eye stands at ``azimuth_rad`` from north, clockwise, and ``elevation_rad`` above the ground.
    """
    sin_a, cos_a = np.sin(azimuth_rad), np.cos(azimuth_rad)
    sin_e, cos_e = np.sin(elevation_rad), np.cos(elevation_rad)
    towards = np.array([sin_a * cos_e, cos_a * cos_e, sin_e])
    right = np.array([-cos_a, sin_a, 0.0])
    up = np.cross(towards, right)
    return np.asarray(np.asarray(point_enu_m) @ np.stack([right, up, towards], axis=1))
