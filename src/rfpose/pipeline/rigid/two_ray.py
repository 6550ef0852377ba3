"""Poses with reflected rays in the model, coefficients given or estimated with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp.calibration import frame_times, phase_average
from rfpose.measurement import reflectors_of
from rfpose.multilat import PoseStatus
from rfpose.multilat.ground import CalibrationSight, GroundSolution, GroundStatus, guard_with_ground, solve_with_ground
from rfpose.multilat.integrity import GuardedPoses, IntegrityStatus, TransmitterStatus
from rfpose.multilat.rigid import Knowledge, RigidPoses, solve_rigid
from rfpose.multilat.rigid.integers import IntegerMethod, Observation
from rfpose.pipeline.mirrors import (
    MirrorGroup,
    calibration_sight,
)
from rfpose.pipeline.rigid.found import (
    Found,
    IntArray,
    Stages,
    are_doubted,
    joined,
    keep_where,
    rows_of,
    where_known,
)
from rfpose.pipeline.rigid.inputs import inputs_of
from rfpose.scenario import Scenario

_START_SIGMA_M = 3.0
"""Uncertainty of ranges from a pose that ignores reflections."""

_GROUND_STATUS = {
    GroundStatus.OK: PoseStatus.OK,
    GroundStatus.SINGULAR: PoseStatus.UNDETERMINED,
    GroundStatus.NOT_CONVERGED: PoseStatus.NOT_CONVERGED,
    GroundStatus.NO_START: PoseStatus.TOO_FEW,
    GroundStatus.TOO_FEW: PoseStatus.UNKNOWNS,
    GroundStatus.BEHIND_REFLECTOR: PoseStatus.BEHIND_REFLECTOR,
    GroundStatus.RESIDUAL: PoseStatus.UNEXPLAINED,
}
_T = TypeVar("_T")


def solve_two_ray(stages: Stages, group: MirrorGroup) -> Found:
    """Solve with the planes of the scenario, their coefficients shared as it says."""
    scenario = stages.scenario
    n_frame, n_helio = len(stages.tones.frame_start_index), len(group.column)
    places, start, rot, phases = inputs_of(stages, group)
    known = group.knowledge(n_frame)
    surveyed = np.tile(group.pivot_enu_m, (n_frame, 1))
    start, rot = _better_start(scenario, places, phases, start, rot, surveyed, known)
    row = np.arange(n_frame * n_helio).reshape(n_frame, n_helio)
    tones = stages.tones
    average = phase_average(tones.phase_rad, tones.sigma_rad, scenario, frame_times(tones, scenario))
    everyone = _Mirrors(
        places=places,
        phases=phases,
        pivot=start,
        rot=rot,
        known=known,
        helio=row.ravel() % n_helio,
        calibration=calibration_sight(average, scenario, row.ravel() // n_helio),
    )
    shared = {"recording": [row.ravel()], "frame": list(row), "mirror": list(row.T)}[scenario.reflection.shared]
    parts = [_two_ray_of(stages, everyone.take(rows)) for rows in shared]
    return _in_order(parts, np.argsort(np.concatenate(shared)), known)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Mirrors:
    """Mirrors to be solved together, and where each begins; first axis mirror."""

    places: FloatArray
    phases: list[Observation]
    pivot: FloatArray
    rot: FloatArray
    known: Knowledge
    helio: IntArray
    calibration: CalibrationSight

    def take(self, rows: IntArray) -> _Mirrors:
        """Select some."""
        known, calibration = self.known, self.calibration
        if known.pivot_enu_m is not None:
            known = replace(known, pivot_enu_m=known.pivot_enu_m[rows])
        if calibration.frame is not None:
            calibration = replace(calibration, frame=calibration.frame[rows])
        return _Mirrors(
            places=self.places[rows],
            phases=[rows_of(o, rows) for o in self.phases],
            pivot=self.pivot[rows],
            rot=self.rot[rows],
            known=known,
            helio=self.helio[rows],
            calibration=calibration,
        )


def _better_start(
    scenario: Scenario,
    places: FloatArray,
    phases: list[Observation],
    start: FloatArray,
    rot: FloatArray,
    surveyed: FloatArray,
    known: Knowledge,
) -> tuple[FloatArray, FloatArray]:
    """Start from surveyed pivots, whatever their sigma, and from orientations by the direct ray.

    Receivers located each on its own are metres off where the ground reflects.
    """
    coarse = phases[0]
    poses = solve_rigid(
        scenario.transmitter_enu_m,
        places,
        coarse.range_m[:, None],
        sigma_m=coarse.sigma_m[:, None],
        transmitter_sigma_m=coarse.transmitter_sigma_m[:, None],
        clock_class=[0],
        start_pivot_enu_m=start,
        start_rot_enu_from_mirror=rot,
        knowledge=known,
    )
    rot = where_known(poses.rot_enu_from_mirror, rot)
    return np.where(np.isfinite(rot).all(axis=2), surveyed, np.nan), rot


def _two_ray_of(stages: Stages, mirrors: _Mirrors) -> Found:
    """Solve mirrors that share their coefficients; where a test finds something to leave out, once more without."""
    table = stages.scenario.integrity

    def guarded(solution: GroundSolution) -> GuardedPoses:
        return guard_with_ground(
            solution,
            false_alarm=table.false_alarm,
            missed_detection=table.missed_detection,
            max_excluded=table.max_excluded,
        )

    solution = _solve_ground(stages, mirrors)
    better = _again(stages, solution, mirrors)
    if not np.array_equal(mirrors.rot, better.rot):
        solution = _solve_ground(stages, better)
    probability_all, probability_direct = solution.probability, solution.probability_direct
    guard: GuardedPoses | None = None
    if stages.choice.integrity:
        guard = guarded(solution)
        if np.any(guard.transmitter_status > TransmitterStatus.NOT_RECEIVED):
            first = guard
            kept = replace(
                better,
                phases=keep_where(mirrors.phases, first.used),
                pivot=where_known(first.poses.pivot_enu_m, better.pivot),
                rot=where_known(first.poses.rot_enu_from_mirror, better.rot),
            )
            solution = _solve_ground(stages, kept)
            guard = joined(first, guarded(solution))
    poses = solution.poses if guard is None else guard.poses
    status = np.array([_GROUND_STATUS[GroundStatus(s)] for s in solution.status], np.int64)
    if guard is not None:
        explained = np.isfinite(guard.protection_level_rad) | (guard.status == IntegrityStatus.NO_REDUNDANCY)
        status[(status == PoseStatus.UNEXPLAINED) & explained] = PoseStatus.OK
        status[(status == PoseStatus.OK) & are_doubted(guard)] = PoseStatus.UNEXPLAINED
    n, n_plane = len(mirrors.places), len(solution.coefficient)
    sigma = np.zeros((n_plane, 2))
    estimated = [p for p, r in enumerate(reflectors_of(stages.scenario, stages.choice.reflection)) if r.estimated]
    sigma[estimated] = np.sqrt(np.diag(solution.coefficient_cov)).reshape(-1, 2)
    return Found(
        poses=poses,
        status=status,
        fixed=solution.fixed,
        wrong_risk=solution.wrong_risk,
        method=np.where(solution.fixed, IntegerMethod.ROUNDED, IntegerMethod.FLOAT),
        ranges=[replace(o, range_m=z) for o, z in zip(mirrors.phases, solution.range_m, strict=True)],
        known=mirrors.known,
        full_cov=solution.full_cov,
        guard=guard,
        probability_all=probability_all,
        coefficient=np.array(np.broadcast_to(solution.coefficient, (n, n_plane))),
        coefficient_sigma=np.array(np.broadcast_to(sigma, (n, n_plane, 2))),
        probability_direct=probability_direct,
    )


def _again(stages: Stages, solution: GroundSolution, mirrors: _Mirrors) -> _Mirrors:
    """Return better poses to begin with for mirrors that ended in a false minimum, where any mirror did not.

    With the coefficients of those that fit, each other one is tried from the same mirror's pose in another frame, or
    around where it began.
    """
    good = solution.status == GroundStatus.OK
    lost = np.flatnonzero(np.isin(solution.status, (GroundStatus.RESIDUAL, GroundStatus.NOT_CONVERGED)))
    if not lost.size or not good.any():
        return mirrors
    pivot, turned = mirrors.pivot.copy(), mirrors.rot.copy()
    pivot[good], turned[good] = solution.poses.pivot_enu_m[good], solution.poses.rot_enu_from_mirror[good]
    for m in lost:
        frames = np.flatnonzero(good & (mirrors.helio == mirrors.helio[m]))
        if frames.size:
            nearest = frames[np.argmin(np.abs(frames - m))]
            pivot[m], turned[m] = pivot[nearest], turned[nearest]
    better = replace(mirrors, pivot=pivot, rot=turned)
    found = _solve_ground(stages, better.take(lost), coefficient=solution.coefficient)
    fits = found.status == GroundStatus.OK
    pivot[lost[fits]], turned[lost[fits]] = found.poses.pivot_enu_m[fits], found.poses.rot_enu_from_mirror[fits]
    return better


def _solve_ground(
    stages: Stages, mirrors: _Mirrors, *, coefficient: npt.NDArray[np.complex128] | None = None
) -> GroundSolution:
    scenario = stages.scenario
    reflectors = reflectors_of(scenario, stages.choice.reflection)
    if coefficient is not None:
        reflectors = tuple(replace(r, coefficient=complex(c)) for r, c in zip(reflectors, coefficient, strict=True))
    return solve_with_ground(
        scenario.transmitter_enu_m,
        mirrors.places,
        mirrors.phases,
        carrier_rf_hz=scenario.carrier_rf_hz,
        start_pivot_enu_m=mirrors.pivot,
        start_rot_enu_from_mirror=mirrors.rot,
        reflectors=reflectors,
        calibration_enu_m=mirrors.calibration,
        tone_count=len(scenario.tone),
        knowledge=mirrors.known,
        free_space=scenario.reflection.spreading == "free_space",
        start_sigma_m=_START_SIGMA_M,
        propagation_speed_mps=scenario.radio.propagation_speed_mps,
    )


def _in_order(parts: list[Found], order: IntArray, known: Knowledge) -> Found:
    """Put mirrors solved in parts back into their order."""
    if len(parts) == 1:
        return parts[0]

    def joined(*arrays: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.asarray(np.concatenate(arrays)[order])

    guards = [p.guard for p in parts if p.guard is not None]
    return Found(
        poses=_record_of(RigidPoses, [p.poses for p in parts], joined),
        guard=_record_of(GuardedPoses, guards, joined) if guards else None,
        known=known,
        ranges=[_record_of(Observation, [p.ranges[k] for p in parts], joined) for k in range(len(parts[0].ranges))],
        **{
            name: joined(*(getattr(p, name) for p in parts))
            for name in (
                "status",
                "fixed",
                "wrong_risk",
                "method",
                "full_cov",
                "probability_all",
                "coefficient",
                "coefficient_sigma",
                "probability_direct",
            )
        },
    )


def _record_of(kind: type[_T], records: list[_T], joined: Callable[..., npt.NDArray[Any]]) -> _T:
    """Join records field by field; what is not by mirror is as in the first."""
    values = {}
    for field in fields(kind):  # type: ignore[arg-type]
        parts = [getattr(record, field.name) for record in records]
        if isinstance(parts[0], RigidPoses):
            values[field.name] = _record_of(RigidPoses, parts, joined)
        elif field.name in ("wavelength_m", "clock_class"):
            values[field.name] = parts[0]
        else:
            values[field.name] = joined(*parts)
    return kind(**values)
