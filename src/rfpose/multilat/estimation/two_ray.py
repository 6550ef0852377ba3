"""Poses with reflected rays in the model, coefficients given or estimated with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.estimation.direct import PoseEstimates, are_doubted, finished, joined
from rfpose.multilat.ground import CalibrationSight, GroundSolution, Reflector, guard_with_ground, solve_with_ground
from rfpose.multilat.integrity import Alarms, GuardedPoses, IntegrityStatus, TransmitterStatus
from rfpose.multilat.rigid import MirrorProblem, RigidPoses, part_of, solve_rigid
from rfpose.multilat.rigid.integers import IntegerMethod
from rfpose.multilat.status import PoseStatus

__all__ = ["ReflectionModel", "solve_two_ray"]

IntArray = npt.NDArray[np.int64]
_T = TypeVar("_T")

_START_SIGMA_M = 3.0
"""Uncertainty of ranges from a pose that ignores reflections."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectionModel:
    """What reflects, and how it gets into ranges; see `rfpose.multilat.ground.solve_with_ground`.

    Attributes
    ----------
    reflectors
        Planes; those without a coefficient are estimated.
    carrier_rf_hz : (transmitter,)
        [Hz].
    calibration
        Frames of the mirrors that are solved, and what their calibration carries.
    free_space
        Whether a longer ray is weaker.
    propagation_speed_mps
        [m/s].
    """

    reflectors: tuple[Reflector, ...]
    carrier_rf_hz: FloatArray
    calibration: CalibrationSight
    free_space: bool
    propagation_speed_mps: float

    def take(self, rows: IntArray) -> ReflectionModel:
        """Select mirrors."""
        frame = self.calibration.frame
        if frame is None:
            return self
        return replace(self, calibration=replace(self.calibration, frame=frame[rows]))


def solve_two_ray(
    problem: MirrorProblem,
    reflections: ReflectionModel,
    alarms: Alarms | None,
    *,
    surveyed_enu_m: FloatArray,
    heliostat: IntArray,
    shared: Sequence[IntArray],
) -> PoseEstimates:
    """Solve with planes that reflect, their coefficients shared.

    Parameters
    ----------
    problem
        The coarsest wavelength's integers resolved, the others' not.
    reflections
    alarms
        When to leave something out; None: never.
    surveyed_enu_m : (mirror, xyz)
        Where pivots are, whatever their sigma [m].
    heliostat : (mirror,)
        Which of the rows are the same mirror, in other frames.
    shared
        Rows that have their coefficients in common.
    """
    problem = _better_start(problem, surveyed_enu_m)
    parts = [
        _two_ray_of(part_of(problem, mirrors=rows), reflections.take(rows), alarms, heliostat[rows]) for rows in shared
    ]
    return finished(_in_order(parts, np.argsort(np.concatenate(shared)), problem), alarms)


def _better_start(problem: MirrorProblem, surveyed_enu_m: FloatArray) -> MirrorProblem:
    """Start from surveyed pivots, whatever their sigma, and from orientations by the direct ray.

    Receivers located each on its own are metres off where the ground reflects.
    """
    poses = solve_rigid(part_of(problem, groups=slice(1)))
    rot = poses.rot_enu_from_mirror
    rot = np.where(np.isfinite(rot), rot, problem.start_rot_enu_from_mirror)
    pivot = np.where(np.isfinite(rot).all(axis=2), surveyed_enu_m, np.nan)
    return replace(problem, start_pivot_enu_m=pivot, start_rot_enu_from_mirror=rot)


def _two_ray_of(
    problem: MirrorProblem, reflections: ReflectionModel, alarms: Alarms | None, heliostat: IntArray
) -> PoseEstimates:
    """Solve mirrors that share their coefficients; where a test finds something to leave out, once more without."""
    solution = _solve_ground(problem, reflections)
    better = _again(problem, reflections, solution, heliostat)
    if not np.array_equal(problem.start_rot_enu_from_mirror, better.start_rot_enu_from_mirror):
        solution = _solve_ground(better, reflections)
    probability_all, probability_direct = solution.probability, solution.probability_direct
    guard: GuardedPoses | None = None
    if alarms is not None:
        guard = guard_with_ground(solution, alarms)
        if np.any(guard.transmitter_status > TransmitterStatus.NOT_RECEIVED):
            first = guard
            begin = (first.poses.pivot_enu_m, first.poses.rot_enu_from_mirror)
            kept = part_of(better, used=first.used, begin=begin)
            solution = _solve_ground(kept, reflections)
            guard = joined(first, guard_with_ground(solution, alarms))
    poses = solution.poses if guard is None else guard.poses
    status = solution.status.copy()
    if guard is not None:
        explained = np.isfinite(guard.protection_level_rad) | (guard.status == IntegrityStatus.NO_REDUNDANCY)
        status[(status == PoseStatus.UNEXPLAINED) & explained] = PoseStatus.OK
        status[(status == PoseStatus.OK) & are_doubted(guard)] = PoseStatus.UNEXPLAINED
    n, n_plane = len(status), len(solution.coefficient)
    sigma = np.zeros((n_plane, 2))
    estimated = [p for p, r in enumerate(reflections.reflectors) if r.estimated]
    sigma[estimated] = np.sqrt(np.diag(solution.coefficient_cov)).reshape(-1, 2)
    return PoseEstimates(
        poses=poses,
        status=status,
        fixed=solution.fixed,
        wrong_risk=solution.wrong_risk,
        method=np.where(solution.fixed, IntegerMethod.ROUNDED, IntegerMethod.FLOAT),
        problem=replace(problem, range_m=solution.range_m),
        full_cov=solution.full_cov,
        guard=guard,
        probability_all=probability_all,
        coefficient=np.array(np.broadcast_to(solution.coefficient, (n, n_plane))),
        coefficient_sigma=np.array(np.broadcast_to(sigma, (n, n_plane, 2))),
        probability_direct=probability_direct,
    )


def _again(
    problem: MirrorProblem, reflections: ReflectionModel, solution: GroundSolution, heliostat: IntArray
) -> MirrorProblem:
    """Return better poses to begin with for mirrors that ended in a false minimum, where any mirror did not.

    With the coefficients of those that fit, each other one is tried from the same mirror's pose in another frame, or
    around where it began.
    """
    good = solution.status == PoseStatus.OK
    lost = np.flatnonzero(np.isin(solution.status, (PoseStatus.UNEXPLAINED, PoseStatus.NOT_CONVERGED)))
    if not lost.size or not good.any():
        return problem
    pivot, turned = problem.start_pivot_enu_m.copy(), problem.start_rot_enu_from_mirror.copy()
    pivot[good], turned[good] = solution.poses.pivot_enu_m[good], solution.poses.rot_enu_from_mirror[good]
    for m in lost:
        frames = np.flatnonzero(good & (heliostat == heliostat[m]))
        if frames.size:
            nearest = frames[np.argmin(np.abs(frames - m))]
            pivot[m], turned[m] = pivot[nearest], turned[nearest]
    better = replace(problem, start_pivot_enu_m=pivot, start_rot_enu_from_mirror=turned)
    reflectors = tuple(
        replace(r, coefficient=complex(c)) for r, c in zip(reflections.reflectors, solution.coefficient, strict=True)
    )
    found = _solve_ground(part_of(better, mirrors=lost), replace(reflections.take(lost), reflectors=reflectors))
    fits = found.status == PoseStatus.OK
    pivot[lost[fits]], turned[lost[fits]] = found.poses.pivot_enu_m[fits], found.poses.rot_enu_from_mirror[fits]
    return replace(problem, start_pivot_enu_m=pivot, start_rot_enu_from_mirror=turned)


def _solve_ground(problem: MirrorProblem, reflections: ReflectionModel) -> GroundSolution:
    return solve_with_ground(
        problem,
        carrier_rf_hz=reflections.carrier_rf_hz,
        reflectors=reflections.reflectors,
        calibration_enu_m=reflections.calibration,
        free_space=reflections.free_space,
        start_sigma_m=_START_SIGMA_M,
        propagation_speed_mps=reflections.propagation_speed_mps,
    )


def _in_order(parts: list[PoseEstimates], order: IntArray, problem: MirrorProblem) -> PoseEstimates:
    """Put mirrors solved in parts back into their order."""
    if len(parts) == 1:
        return parts[0]

    def joined(*arrays: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.asarray(np.concatenate(arrays)[order])

    resolved = replace(problem, range_m=joined(*(p.problem.range_m for p in parts)))
    return replace(_record_of(PoseEstimates, parts, joined), problem=resolved)


def _record_of(kind: type[_T], records: list[_T], joined: Callable[..., npt.NDArray[Any]]) -> _T:
    """Join records field by field; what is no array by mirror is as in the first."""
    values: dict[str, Any] = {}
    for field in fields(kind):  # type: ignore[arg-type]
        parts = [getattr(record, field.name) for record in records]
        if isinstance(parts[0], np.ndarray):
            values[field.name] = joined(*parts)
        elif isinstance(parts[0], RigidPoses | GuardedPoses):
            values[field.name] = _record_of(type(parts[0]), parts, joined)
        else:
            values[field.name] = parts[0]
    return kind(**values)
