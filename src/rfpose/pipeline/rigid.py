"""Rigid poses of a recording's mirrors by the chosen estimator: direct or two-ray, guarded, delays learned."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from rfpose.checks import FloatArray, read_only
from rfpose.dsp import Calibration, TonePhases
from rfpose.geometry import azimuth_elevation_from_enu
from rfpose.multilat import Motion, PoseStatus, RangeDifferences, TrackStatus, track_poses
from rfpose.multilat.ground import GroundSolution, GroundStatus, guard_with_ground, solve_with_ground
from rfpose.multilat.integrity import GuardedPoses, IntegrityStatus, TransmitterStatus, solve_with_integrity
from rfpose.multilat.rigid import Knowledge, RigidPoses, RigidStatus, full_covariance, solve_rigid
from rfpose.multilat.rigid.delays import learn_delays
from rfpose.multilat.rigid.integers import IntegerMethod, Observation, align_points, solve_ladder
from rfpose.multilat.rigid.start import rotations_from_differences
from rfpose.pipeline.choice import PoseChoice, reflectors_of
from rfpose.pipeline.mirrors import (
    MirrorGroup,
    calibration_share,
    carrier_rf_hz,
    mirror_groups,
    observations,
)
from rfpose.pipeline.result_file import (
    DelayTable,
    FilteredTable,
    FixTable,
    IntegrityTable,
    PoseTable,
    ReflectionTable,
)
from rfpose.scenario import Scenario

__all__ = ["RigidOutcome", "solve_rigid_poses"]

_RESIDUAL_PROBABILITY = 1e-9
"""A pose whose residuals are rarer than this under the reported noise is marked."""

_STATUS = {
    RigidStatus.OK: PoseStatus.OK,
    RigidStatus.SINGULAR: PoseStatus.UNDETERMINED,
    RigidStatus.NOT_CONVERGED: PoseStatus.NOT_CONVERGED,
    RigidStatus.NO_START: PoseStatus.TOO_FEW,
    RigidStatus.TOO_FEW: PoseStatus.UNKNOWNS,
}
_GROUND_STATUS = {
    GroundStatus.OK: PoseStatus.OK,
    GroundStatus.SINGULAR: PoseStatus.UNDETERMINED,
    GroundStatus.NOT_CONVERGED: PoseStatus.NOT_CONVERGED,
    GroundStatus.NO_START: PoseStatus.TOO_FEW,
    GroundStatus.TOO_FEW: PoseStatus.UNKNOWNS,
    GroundStatus.BEHIND_REFLECTOR: PoseStatus.BEHIND_REFLECTOR,
    GroundStatus.RESIDUAL: PoseStatus.UNEXPLAINED,
}
_VAGUE_RATIO = 100.0
"""A calibration off by so many times what the pivot is off by tells nothing of the pose."""

_START_SIGMA_M = 3.0
"""Uncertainty of ranges from a pose that ignores reflections."""

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidOutcome:
    """Poses, and what else their estimator found; None where it does not look for it."""

    poses: PoseTable
    integrity: IntegrityTable | None
    reflection: ReflectionTable | None
    delays: DelayTable | None
    filtered: FilteredTable | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Stages:
    """What the stages before found, and how to go on."""

    tones: TonePhases
    calibration: Calibration
    ranges: RangeDifferences
    fixes: FixTable
    scenario: Scenario
    choice: PoseChoice


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """Poses of one group; first axis frame × heliostat. ``status`` is `PoseStatus`."""

    poses: RigidPoses
    status: IntArray
    fixed: BoolArray
    wrong_risk: FloatArray
    method: IntArray
    ranges: list[Observation]
    """As used: integers resolved, NaN where left out."""
    known: Knowledge
    full_cov: FloatArray | None = None
    guard: GuardedPoses | None = None
    probability_all: FloatArray | None = None
    coefficient: npt.NDArray[np.complex128] | None = None
    coefficient_sigma: FloatArray | None = None
    probability_direct: FloatArray | None = None


def solve_rigid_poses(
    tones: TonePhases,
    calibration: Calibration,
    ranges: RangeDifferences,
    fixes: FixTable,
    independent: PoseTable,
    scenario: Scenario,
    choice: PoseChoice,
    *,
    sample_rate: Fraction,
) -> RigidOutcome:
    """Solve every mirror of every frame as a rigid body.

    The coarsest tone comes first, finer tones and the carrier follow where their whole wavelengths are safe. The
    carrier is used between receivers on one oscillator.

    Parameters
    ----------
    tones, calibration, ranges, fixes
        The stages before.
    independent
        Normals of separately located receivers: where a mirror cannot be solved as a whole, its status.
    scenario
        The site.
    choice
        The estimator; its ``pose`` is ``rigid``.
    sample_rate
        Of the recording, for the time between frames [1/s].
    """
    stages = _Stages(tones=tones, calibration=calibration, ranges=ranges, fixes=fixes, scenario=scenario, choice=choice)
    tables = _Tables(stages, independent)
    start = tones.frame_start_index
    time_s = np.array([float((int(s) - int(start[0])) / sample_rate) for s in start])
    for group in mirror_groups(scenario):
        found = _two_ray(stages, group) if choice.reflection != "none" else _direct(stages, group)
        if group.learns_delays:
            found = tables.put_delays(group, found, time_s)
        tables.put(group, found)
        if choice.filtered:
            tables.put_filtered(group, found, time_s, exposure_s=float(scenario.radio.frame_samples / sample_rate))
    return tables.outcome()


# -- the direct ray alone ------------------------------------------------------------------------------------


def _direct(stages: _Stages, group: MirrorGroup) -> _Found:
    """Solve by the direct ray: leave out what is wrong in the coarsest tone, climb, test all wavelengths together."""
    scenario = stages.scenario
    places, start, rot, phases = _inputs(stages, group)
    known = group.knowledge(scenario, len(stages.tones.frame_start_index))
    first: GuardedPoses | None = None
    if stages.choice.integrity:
        first = _guard(scenario, places, phases[:1], start, rot, known)
        phases = _keep(phases, first.used)
    ladder = solve_ladder(
        scenario.transmitter_enu_m,
        places,
        phases,
        start_pivot_enu_m=start,
        start_rot_enu_from_mirror=rot,
        knowledge=known,
    )
    found = _Found(
        poses=ladder.poses,
        status=_pose_status(ladder.poses.status),
        fixed=ladder.fixed,
        wrong_risk=ladder.wrong_risk,
        method=ladder.method,
        ranges=[replace(o, range_m=z) for o, z in zip(phases, ladder.range_m, strict=True)],
        known=known,
    )
    probability = _probability(ladder.poses)
    if first is None:
        found.status[(found.status == PoseStatus.OK) & (probability < _RESIDUAL_PROBABILITY)] = PoseStatus.RESIDUAL
        return found
    at, at_rot = _or(ladder.poses.pivot_enu_m, start), _or(ladder.poses.rot_enu_from_mirror, rot)
    guard = _joined(first, _guard(scenario, places, found.ranges, at, at_rot, known))
    status = _pose_status(guard.poses.status)
    status[(status == PoseStatus.OK) & _doubted(guard)] = PoseStatus.UNEXPLAINED
    return replace(
        found,
        poses=guard.poses,
        status=status,
        ranges=_keep(found.ranges, guard.used),
        guard=guard,
        probability_all=_probability_of_all(stages, group, first, probability),
    )


def _inputs(stages: _Stages, group: MirrorGroup) -> tuple[FloatArray, FloatArray, FloatArray, list[Observation]]:
    """Places of receivers, poses to begin with (pivot, rotation), and phases as ranges."""
    n_frame = len(stages.tones.frame_start_index)
    places = np.tile(group.places_m, (n_frame, 1, 1))
    located = stages.fixes.position_enu_m[:, group.rows].reshape(len(places), -1, 3)
    start, rot = align_points(places, located)
    phases = observations(stages.tones, stages.calibration, stages.ranges, stages.scenario, group)
    known = group.knowledge(stages.scenario, n_frame)
    if stages.choice.reflection == "none":
        phases = [_without_vague_calibration(o, known) for o in phases]
    weak = np.flatnonzero(_are_vague(stages, group, places))
    if known.pivot_enu_m is not None and weak.size:
        start[weak] = known.pivot_enu_m[weak]
        rot[weak] = rotations_from_differences(
            stages.scenario.transmitter_enu_m,
            places[weak],
            start[weak],
            phases[0].range_m[weak],
            sigma_m=phases[0].sigma_m[weak],
            clock_sigma_m=known.clock_sigma_m,
        )
    return places, start, rot, phases


def _without_vague_calibration(phases: Observation, known: Knowledge) -> Observation:
    """Leave an old calibration out where the pivot is known far better than it could tell: differences remain.

    What it adds is next to nothing, and so little that the clocks' equations would be singular to working precision.
    """
    common = phases.transmitter_sigma_m
    vague = common > _VAGUE_RATIO * known.pivot_sigma_m
    return replace(phases, transmitter_sigma_m=np.where(vague, np.inf, common))


def _are_vague(stages: _Stages, group: MirrorGroup, places: FloatArray) -> BoolArray:
    """(mirror,) whether a receiver's fix, if there is one, is less certain than the mirror is wide.

    So it is without calibration receivers, or with a calibration that is old.
    """
    variance = np.trace(stages.fixes.cov_enu_m2[:, group.rows], axis1=-2, axis2=-1).reshape(places.shape[:2])
    width = np.linalg.norm(places - places.mean(axis=1, keepdims=True), axis=-1).max(axis=1)
    return np.asarray(~(np.sqrt(variance) < width[:, None]).all(axis=1))


def _guard(
    scenario: Scenario,
    places: FloatArray,
    phases: list[Observation],
    pivot: FloatArray,
    rot: FloatArray,
    known: Knowledge,
) -> GuardedPoses:
    """Solve, test and leave out, with integers resolved."""
    table = scenario.integrity
    return solve_with_integrity(
        scenario.transmitter_enu_m,
        places,
        np.stack([o.range_m for o in phases], axis=1),
        sigma_m=np.stack([o.sigma_m for o in phases], axis=1),
        transmitter_sigma_m=np.stack([o.transmitter_sigma_m for o in phases], axis=1),
        clock_class=[o.clock_class for o in phases],
        start_pivot_enu_m=pivot,
        start_rot_enu_from_mirror=rot,
        knowledge=known,
        false_alarm=table.false_alarm,
        missed_detection=table.missed_detection,
        max_excluded=table.max_excluded,
    )


def _joined(first: GuardedPoses, second: GuardedPoses) -> GuardedPoses:
    """Join the tests before and after a change of what is used: what the first left out, the second does not see."""
    cause = np.where(
        second.transmitter_status > TransmitterStatus.NOT_RECEIVED, second.transmitter_status, first.transmitter_status
    )
    status = second.status.copy()
    level = second.protection_level_rad.copy()
    quiet = np.isin(second.status, (IntegrityStatus.OK, IntegrityStatus.EXCLUDED))
    excluded = (cause > TransmitterStatus.NOT_RECEIVED).any(axis=1)
    status[quiet & excluded] = IntegrityStatus.EXCLUDED
    # which of several causes an error had is not known better afterwards
    ambiguous = quiet & (first.status == IntegrityStatus.AMBIGUOUS)
    status[ambiguous] = IntegrityStatus.AMBIGUOUS
    level[ambiguous] = np.fmax(level, first.protection_level_rad)[ambiguous]
    lost = quiet & (first.status == IntegrityStatus.UNEXPLAINED)
    status[lost] = IntegrityStatus.UNEXPLAINED
    level[lost] = np.inf
    return replace(
        second,
        status=read_only(status),
        transmitter_status=read_only(cause),
        protection_level_rad=read_only(level),
        prior_testable=read_only(first.prior_testable | second.prior_testable),
        chi2_probability=second.chi2_probability,
    )


def _probability_of_all(
    stages: _Stages, group: MirrorGroup, first: GuardedPoses, probability: FloatArray
) -> FloatArray:
    """Probability of the residuals with nothing left out: where something was, of the coarsest tone's."""
    out = probability.copy()
    rows = np.flatnonzero((first.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1))
    if not rows.size:
        return out
    places, start, rot, phases = _inputs(stages, group)
    known = group.knowledge(stages.scenario, len(stages.tones.frame_start_index))
    if known.pivot_enu_m is not None:
        known = replace(known, pivot_enu_m=known.pivot_enu_m[rows])
    coarse = phases[0]
    poses = solve_rigid(
        stages.scenario.transmitter_enu_m,
        places[rows],
        coarse.range_m[rows][:, None],
        sigma_m=coarse.sigma_m[rows][:, None],
        transmitter_sigma_m=coarse.transmitter_sigma_m[rows][:, None],
        clock_class=[0],
        start_pivot_enu_m=start[rows],
        start_rot_enu_from_mirror=rot[rows],
        knowledge=known,
    )
    out[rows] = _probability(poses)
    return out


# -- with reflections ----------------------------------------------------------------------------------------


def _two_ray(stages: _Stages, group: MirrorGroup) -> _Found:
    """Solve with the planes of the scenario, their coefficients shared as it says."""
    scenario = stages.scenario
    n_frame, n_helio = len(stages.tones.frame_start_index), len(group.column)
    places, start, rot, phases = _inputs(stages, group)
    known = group.knowledge(scenario, n_frame)
    surveyed = np.tile(group.pivot_enu_m, (n_frame, 1))
    start, rot = _better_start(scenario, places, phases, start, rot, surveyed, known)
    row = np.arange(n_frame * n_helio).reshape(n_frame, n_helio)
    shared = {"recording": [row.ravel()], "frame": list(row), "mirror": list(row.T)}[scenario.reflection.shared]
    parts = []
    for rows in shared:
        mine = known if known.pivot_enu_m is None else replace(known, pivot_enu_m=known.pivot_enu_m[rows])
        these = [_taken(o, rows) for o in phases]
        parts.append(_two_ray_of(stages, places[rows], these, start[rows], rot[rows], mine, rows % n_helio))
    return _in_order(parts, np.argsort(np.concatenate(shared)), known)


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
    rot = _or(poses.rot_enu_from_mirror, rot)
    return np.where(np.isfinite(rot).all(axis=2), surveyed, np.nan), rot


def _two_ray_of(
    stages: _Stages,
    places: FloatArray,
    phases: list[Observation],
    start: FloatArray,
    rot: FloatArray,
    known: Knowledge,
    helio: IntArray,
) -> _Found:
    """Solve mirrors that share their coefficients; where a test finds something to leave out, once more without."""
    table = stages.scenario.integrity

    def guarded(solution: GroundSolution) -> GuardedPoses:
        return guard_with_ground(
            solution,
            false_alarm=table.false_alarm,
            missed_detection=table.missed_detection,
            max_excluded=table.max_excluded,
        )

    before = rot
    solution = _solve_ground(stages, places, phases, start, rot, known)
    start, rot = _again(stages, solution, helio, places, phases, start, rot, known)
    if not np.array_equal(rot, before):
        solution = _solve_ground(stages, places, phases, start, rot, known)
    probability_all, probability_direct = solution.probability, solution.probability_direct
    guard: GuardedPoses | None = None
    if stages.choice.integrity:
        guard = guarded(solution)
        if np.any(guard.transmitter_status > TransmitterStatus.NOT_RECEIVED):
            first = guard
            at, at_rot = _or(first.poses.pivot_enu_m, start), _or(first.poses.rot_enu_from_mirror, rot)
            solution = _solve_ground(stages, places, _keep(phases, first.used), at, at_rot, known)
            guard = _joined(first, guarded(solution))
    poses = solution.poses if guard is None else guard.poses
    status = np.array([_GROUND_STATUS[GroundStatus(s)] for s in solution.status], np.int64)
    if guard is not None:
        explained = np.isfinite(guard.protection_level_rad) | (guard.status == IntegrityStatus.NO_REDUNDANCY)
        status[(status == PoseStatus.UNEXPLAINED) & explained] = PoseStatus.OK
        status[(status == PoseStatus.OK) & _doubted(guard)] = PoseStatus.UNEXPLAINED
    n, n_plane = len(places), len(solution.coefficient)
    sigma = np.zeros((n_plane, 2))
    estimated = [p for p, r in enumerate(reflectors_of(stages.scenario, stages.choice.reflection)) if r.estimated]
    sigma[estimated] = np.sqrt(np.diag(solution.coefficient_cov)).reshape(-1, 2)
    return _Found(
        poses=poses,
        status=status,
        fixed=solution.fixed,
        wrong_risk=solution.wrong_risk,
        method=np.where(solution.fixed, IntegerMethod.ROUNDED, IntegerMethod.FLOAT),
        ranges=[replace(o, range_m=z) for o, z in zip(phases, solution.range_m, strict=True)],
        known=known,
        full_cov=solution.full_cov,
        guard=guard,
        probability_all=probability_all,
        coefficient=np.array(np.broadcast_to(solution.coefficient, (n, n_plane))),
        coefficient_sigma=np.array(np.broadcast_to(sigma, (n, n_plane, 2))),
        probability_direct=probability_direct,
    )


def _again(
    stages: _Stages,
    solution: GroundSolution,
    helio: IntArray,
    places: FloatArray,
    phases: list[Observation],
    start: FloatArray,
    rot: FloatArray,
    known: Knowledge,
) -> tuple[FloatArray, FloatArray]:
    """Return better poses to begin with for mirrors that ended in a false minimum, where any mirror did not.

    With the coefficients of those that fit, each other one is tried from the same mirror's pose in another frame, or
    around where it began.
    """
    good = solution.status == GroundStatus.OK
    lost = np.flatnonzero(np.isin(solution.status, (GroundStatus.RESIDUAL, GroundStatus.NOT_CONVERGED)))
    if not lost.size or not good.any():
        return start, rot
    pivot, turned = start.copy(), rot.copy()
    pivot[good], turned[good] = solution.poses.pivot_enu_m[good], solution.poses.rot_enu_from_mirror[good]
    for m in lost:
        frames = np.flatnonzero(good & (helio == helio[m]))
        if frames.size:
            nearest = frames[np.argmin(np.abs(frames - m))]
            pivot[m], turned[m] = pivot[nearest], turned[nearest]
    mine = known if known.pivot_enu_m is None else replace(known, pivot_enu_m=known.pivot_enu_m[lost])
    found = _solve_ground(
        stages,
        places[lost],
        [_taken(o, lost) for o in phases],
        pivot[lost],
        turned[lost],
        mine,
        coefficient=solution.coefficient,
    )
    fits = found.status == GroundStatus.OK
    pivot[lost[fits]], turned[lost[fits]] = found.poses.pivot_enu_m[fits], found.poses.rot_enu_from_mirror[fits]
    return pivot, turned


def _solve_ground(
    stages: _Stages,
    places: FloatArray,
    phases: list[Observation],
    start: FloatArray,
    rot: FloatArray,
    known: Knowledge,
    *,
    coefficient: npt.NDArray[np.complex128] | None = None,
) -> GroundSolution:
    scenario = stages.scenario
    reflectors = reflectors_of(scenario, stages.choice.reflection)
    if coefficient is not None:
        reflectors = tuple(replace(r, coefficient=complex(c)) for r, c in zip(reflectors, coefficient, strict=True))
    return solve_with_ground(
        scenario.transmitter_enu_m,
        places,
        phases,
        carrier_rf_hz=carrier_rf_hz(scenario),
        start_pivot_enu_m=start,
        start_rot_enu_from_mirror=rot,
        reflectors=reflectors,
        calibration_enu_m=scenario.calibration_enu_m,
        calibration_share=calibration_share(stages.tones.sigma_rad, scenario),
        tone_count=len(scenario.tone),
        knowledge=known,
        free_space=scenario.reflection.spreading == "free_space",
        start_sigma_m=_START_SIGMA_M,
        propagation_speed_mps=scenario.radio.propagation_speed_mps,
    )


def _in_order(parts: list[_Found], order: IntArray, known: Knowledge) -> _Found:
    """Put mirrors solved in parts back into their order."""
    if len(parts) == 1:
        return parts[0]

    def joined(*arrays: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.asarray(np.concatenate(arrays)[order])

    guards = [p.guard for p in parts if p.guard is not None]
    return _Found(
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


# -- small things --------------------------------------------------------------------------------------------


def _pose_status(status: IntArray) -> IntArray:
    return np.array([_STATUS[RigidStatus(s)] for s in status], np.int64)


def _probability(poses: RigidPoses) -> FloatArray:
    with np.errstate(invalid="ignore"):
        return np.asarray(chi2_distribution.sf(poses.chi2, np.maximum(poses.dof, 1.0)))


def _doubted(guard: GuardedPoses) -> BoolArray:
    """(mirror,) not explained, or explained by leaving out so much that nothing confirms it."""
    left_out = (guard.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1) | guard.prior_rejected.any(
        axis=1
    )
    unconfirmed = left_out & (guard.status == IntegrityStatus.NO_REDUNDANCY)
    return np.asarray((guard.status == IntegrityStatus.UNEXPLAINED) | unconfirmed)


def _keep(phases: list[Observation], used: BoolArray) -> list[Observation]:
    return [replace(o, range_m=np.where(used, o.range_m, np.nan)) for o in phases]


def _taken(phases: Observation, rows: IntArray) -> Observation:
    return replace(
        phases,
        range_m=phases.range_m[rows],
        sigma_m=phases.sigma_m[rows],
        transmitter_sigma_m=phases.transmitter_sigma_m[rows],
    )


def _or(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.where(np.isfinite(first), first, second)


def _cross_matrix(v: FloatArray) -> FloatArray:
    """(…, 3, 3) with ``m @ x = v × x``."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


# -- tables --------------------------------------------------------------------------------------------------


class _Tables:
    """The result's tables, filled group by group."""

    def __init__(self, stages: _Stages, independent: PoseTable) -> None:
        self._stages = stages
        scenario, choice = stages.scenario, stages.choice
        n_frame = self._n_frame = len(stages.tones.frame_start_index)
        frame_mirror = (n_frame, len(scenario.heliostat))
        n_receiver, n_transmitter = len(scenario.receivers), len(scenario.transmitter)
        self._poses = {name: np.array(getattr(independent, name)) for name in PoseTable.__dataclass_fields__}
        for values in self._poses.values():
            if values.dtype.kind == "f":
                values[:] = np.nan
        self._integrity: dict[str, npt.NDArray[Any]] = {}
        if choice.integrity:
            self._integrity = {
                "status": np.full(frame_mirror, IntegrityStatus.NOT_SOLVED, np.int8),
                "transmitter_status": np.zeros((*frame_mirror, n_transmitter), np.int8),
                "used": np.zeros((n_frame, n_receiver, n_transmitter), np.bool_),
                "prior_rejected": np.zeros((*frame_mirror, 3), np.bool_),
                "prior_testable": np.zeros((*frame_mirror, 3), np.bool_),
                "probability_all": np.full(frame_mirror, np.nan),
                "probability": np.full(frame_mirror, np.nan),
                "protection_level_rad": np.full(frame_mirror, np.nan),
                "worst_transmitter": np.full(frame_mirror, -1, np.int16),
            }
        self._reflection: dict[str, npt.NDArray[Any]] = {}
        if choice.reflection != "none":
            n_plane = 1 + len(scenario.reflection.plane)
            self._reflection = {
                "coefficient": np.full((*frame_mirror, n_plane), np.nan, np.complex128),
                "coefficient_sigma": np.full((*frame_mirror, n_plane, 2), np.nan),
                "probability_direct": np.full(frame_mirror, np.nan),
            }
        self._filtered: dict[str, npt.NDArray[Any]] = {}
        if choice.filtered:
            self._filtered = {
                name: np.full((*frame_mirror, *shape), np.nan)
                for name, shape in (
                    ("normal_enu", (3,)),
                    ("cov_enu", (3, 3)),
                    ("sigma_rad", ()),
                    ("pivot_enu_m", (3,)),
                    ("rate_enu_radps", (3,)),
                )
            }
            self._filtered["status"] = np.full(frame_mirror, TrackStatus.UNKNOWN, np.int8)
        self._delays: dict[str, npt.NDArray[Any]] = {}
        if any(group.learns_delays for group in mirror_groups(scenario)):
            n_clock = len(scenario.tone) + 1
            self._delays = {
                "delay_s": np.full((n_frame, n_receiver, n_clock), np.nan),
                "sigma_s": np.full((n_frame, n_receiver, n_clock), np.nan),
                "jumped": np.zeros(frame_mirror, np.bool_),
            }

    def put(self, group: MirrorGroup, found: _Found) -> None:
        """Write one group's poses and tests."""
        poses = found.poses
        normal = poses.normal_enu
        azimuth, elevation = azimuth_elevation_from_enu(normal)
        cross = _cross_matrix(normal)
        places = np.tile(group.places_m, (self._n_frame, 1, 1))
        self._put(
            self._poses,
            group,
            {
                "normal_enu": normal,
                "cov_enu": cross @ poses.cov[:, 3:, 3:] @ cross.swapaxes(1, 2),
                "sigma_rad": poses.tilt_sigma_rad,
                "azimuth_rad": azimuth,
                "elevation_rad": elevation,
                "centre_enu_m": poses.pivot_enu_m
                + np.einsum("mab,mb->ma", poses.rot_enu_from_mirror, places.mean(axis=1)),
                "n_receiver": np.where(np.isfinite(normal[:, 0]), group.rows.shape[1], 0),
                "n_wavelength": found.fixed.sum(axis=1),
                "integer_method": self._methods(group, found),
                "integer_risk": np.where(found.fixed, found.wrong_risk, 0.0).max(axis=1),
                "status": found.status,
            },
        )
        guard = found.guard
        if self._integrity and guard is not None:
            level = np.where(np.isfinite(normal[:, 0]), guard.protection_level_rad, np.nan)
            self._put(
                self._integrity,
                group,
                {
                    "status": guard.status,
                    "transmitter_status": guard.transmitter_status,
                    "prior_rejected": guard.prior_rejected,
                    "prior_testable": guard.prior_testable,
                    "probability_all": found.probability_all,
                    "probability": guard.chi2_probability,
                    "protection_level_rad": level,
                    "worst_transmitter": guard.worst_transmitter,
                },
            )
            used = guard.used & np.isfinite(normal[:, :1, None])
            self._integrity["used"][:, group.rows] = used.reshape(self._n_frame, *group.rows.shape, -1)
        if self._reflection:
            names = ("coefficient", "coefficient_sigma", "probability_direct")
            self._put(self._reflection, group, {name: getattr(found, name) for name in names})

    def _methods(self, group: MirrorGroup, found: _Found) -> IntArray:
        """(mirror, clock) how integers were found; what a pose that failed rests on says nothing."""
        out = np.full((len(found.method), len(self._stages.scenario.tone) + 1), IntegerMethod.FLOAT, np.int64)
        out[:, : found.method.shape[1]] = np.where(np.isfinite(found.poses.tilt_sigma_rad)[:, None], found.method, 0)
        return out

    def put_filtered(self, group: MirrorGroup, found: _Found, time_s: FloatArray, *, exposure_s: float) -> None:
        """Filter a group's poses over frames and write them; poses that are doubted are left out."""

        def by_frame(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
            return array.reshape(self._n_frame, len(group.column), *array.shape[1:])

        poses, table = found.poses, self._stages.scenario.motion
        tracked = track_poses(
            by_frame(poses.pivot_enu_m),
            by_frame(poses.rot_enu_from_mirror),
            by_frame(poses.cov),
            time_s=time_s + 0.5 * exposure_s,
            exposure_s=exposure_s,
            usable=by_frame(found.status == PoseStatus.OK),
            motion=Motion(
                rate_walk_radps_per_sqrt_s=table.rate_walk_radps_per_sqrt_s,
                rate_sigma_radps=table.rate_sigma_radps,
                gate_probability=table.gate_probability,
                restart_after=table.restart_after,
                max_coast_s=np.inf if table.max_coast_s is None else table.max_coast_s,
            ),
        )
        cross = _cross_matrix(tracked.normal_enu)
        values = {
            "normal_enu": tracked.normal_enu,
            "cov_enu": cross @ tracked.cov[..., 3:6, 3:6] @ cross.swapaxes(-1, -2),
            "sigma_rad": tracked.tilt_sigma_rad,
            "pivot_enu_m": tracked.pivot_enu_m,
            "rate_enu_radps": tracked.rate_enu_radps,
            "status": tracked.status,
        }
        for name, array in values.items():
            self._filtered[name][:, group.column] = array

    def _put(self, table: dict[str, npt.NDArray[Any]], group: MirrorGroup, values: dict[str, Any]) -> None:
        for name, array in values.items():
            table[name][:, group.column] = array.reshape(self._n_frame, len(group.column), *array.shape[1:])

    def put_delays(self, group: MirrorGroup, found: _Found, time_s: FloatArray) -> _Found:
        """Learn the delays of a group over frames, write them, and return its poses refined by them."""
        scenario = self._stages.scenario
        speed = scenario.radio.propagation_speed_mps
        n_frame, n_helio = self._n_frame, len(group.column)
        poses, whole = found.poses, _with_clocks(scenario, group, found, n_frame)
        # poses that are doubted, or rest on fewer priors than the rest, teach nothing
        whole[found.status != PoseStatus.OK] = np.nan
        if found.guard is not None:
            whole[found.guard.prior_rejected.any(axis=1)] = np.nan
        n_class = poses.clock_m.shape[1]
        observed = _observed_clocks(found.ranges, n_class)

        def by_frame(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
            return array.reshape(n_frame, n_helio, *array.shape[1:])

        learned = learn_delays(
            by_frame(poses.pivot_enu_m),
            by_frame(poses.rot_enu_from_mirror),
            by_frame(np.where(observed, poses.clock_m, 0.0)),
            by_frame(whole),
            time_s=time_s,
            drift_m_per_sqrt_s=group.drift_m_per_sqrt_s(scenario),
            observed=by_frame(observed),
        )
        n_receiver = group.rows.shape[1]
        shape = (n_frame, n_helio, n_class, n_receiver - 1)
        variance = np.einsum("fmdd->fmd", learned.difference_cov_m2).reshape(shape)
        for name, values in (("delay_s", learned.difference_m.reshape(shape)), ("sigma_s", np.sqrt(variance))):
            known = np.isfinite(values) & (variance < learned.unseen_m**2 / 2.0)
            rows = np.where(known, values / speed, np.nan).swapaxes(2, 3)
            self._delays[name][:, group.rows[:, 1:], :n_class] = rows
            self._delays[name][:, group.rows[:, 0], :n_class] = np.where(known.any(axis=3), 0.0, np.nan)
        self._delays["jumped"][:, group.column] = learned.jumped
        refined = np.isfinite(learned.cov).all(axis=(2, 3)).reshape(-1)
        values = {
            "pivot_enu_m": learned.pivot_enu_m,
            "rot_enu_from_mirror": learned.rot_enu_from_mirror,
            "cov": learned.cov,
        }
        arrays = {}
        for name, array in values.items():
            flat = array.reshape(n_frame * n_helio, *array.shape[2:])
            arrays[name] = np.where(refined.reshape(-1, *[1] * (flat.ndim - 1)), flat, getattr(poses, name))
        return replace(found, poses=replace(poses, **arrays))

    def outcome(self) -> RigidOutcome:
        """Return the tables, those that were asked for."""
        return RigidOutcome(
            poses=PoseTable(**self._poses),
            integrity=IntegrityTable(**self._integrity) if self._integrity else None,
            reflection=ReflectionTable(**self._reflection) if self._reflection else None,
            delays=DelayTable(**self._delays) if self._delays else None,
            filtered=FilteredTable(**self._filtered) if self._filtered else None,
        )


def _with_clocks(scenario: Scenario, group: MirrorGroup, found: _Found, n_frame: int) -> FloatArray:
    """Covariance of pose and clocks of every mirror."""
    if found.full_cov is not None:
        return np.array(found.full_cov)
    phases = found.ranges
    return np.array(
        full_covariance(
            scenario.transmitter_enu_m,
            np.tile(group.places_m, (n_frame, 1, 1)),
            np.nan_to_num(found.poses.pivot_enu_m),
            np.nan_to_num(found.poses.rot_enu_from_mirror),
            sigma_m=np.stack([np.where(np.isfinite(o.range_m), o.sigma_m, np.nan) for o in phases], axis=1),
            transmitter_sigma_m=np.stack([o.transmitter_sigma_m for o in phases], axis=1),
            clock_class=[o.clock_class for o in phases],
            knowledge=found.known,
        )
    )


def _observed_clocks(phases: list[Observation], n_class: int) -> BoolArray:
    """(mirror, class, receiver) whether any range tells of a clock."""
    out = np.zeros((len(phases[0].range_m), n_class, phases[0].range_m.shape[1]), np.bool_)
    for phase in phases:
        out[:, phase.clock_class] |= np.isfinite(phase.range_m).any(axis=2)
    return out
