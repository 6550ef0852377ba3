"""Poses by the direct ray alone, wavelength by wavelength, guarded; and what estimators do with what they find."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.multilat.fix import APART_SIGMA, DECISIVE_CHI2
from rfpose.multilat.integrity.guard import solve_with_integrity, widened
from rfpose.multilat.integrity.records import Alarms, GuardedPoses, IntegrityStatus, TransmitterStatus
from rfpose.multilat.normal import MAX_SIGMA_RAD
from rfpose.multilat.rigid.integers import solve_ladder
from rfpose.multilat.rigid.parts import part_of
from rfpose.multilat.rigid.pose import solve_rigid
from rfpose.multilat.rigid.problem import MirrorProblem
from rfpose.multilat.rigid.records import RigidPoses
from rfpose.multilat.status import PoseStatus

__all__ = ["PoseEstimates", "are_doubted", "finished", "joined", "protected", "solve_direct"]

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

RESIDUAL_PROBABILITY = 1e-9
"""A pose whose residuals are rarer than this under the reported noise is marked."""
_LEFT_OUT_CHI2 = 2.0 * DECISIVE_CHI2
"""What each transmitter or prior that was left out counts, where two poses of a mirror are compared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseEstimates:
    """Poses of mirrors, and how they came about; None where an estimator does not look for it.

    Attributes
    ----------
    poses
    status : (mirror,)
        `PoseStatus`.
    fixed, wrong_risk, method : (mirror, group)
        As in `rfpose.multilat.rigid.integers.RigidSolution`.
    problem
        As solved in the end: integers resolved, NaN where left out.
    full_cov : (mirror, unknown, unknown)
        Of pose and clocks, where it is more than that of ``problem`` alone.
    guard
        The tests.
    probability_all : (mirror,)
        Probability of the residuals with nothing left out.
    coefficient, coefficient_sigma : (mirror, reflector), (mirror, reflector, 2)
        Of what reflects.
    probability_direct : (mirror,)
        Of the residuals with the direct ray alone.
    """

    poses: RigidPoses
    status: IntArray
    fixed: BoolArray
    wrong_risk: FloatArray
    method: IntArray
    problem: MirrorProblem
    full_cov: FloatArray | None = None
    guard: GuardedPoses | None = None
    probability_all: FloatArray | None = None
    coefficient: npt.NDArray[np.complex128] | None = None
    coefficient_sigma: FloatArray | None = None
    probability_direct: FloatArray | None = None


def solve_direct(
    problem: MirrorProblem,
    alarms: Alarms | None,
    again: Iterable[tuple[IntArray, MirrorProblem]] = (),
) -> PoseEstimates:
    """Solve by the direct ray: leave out what is wrong in the coarsest tone, climb, test all wavelengths together.

    Parameters
    ----------
    problem
        The coarsest wavelength's integers resolved, the others' not.
    alarms
        When to leave something out; None: never.
    again
        Some of the mirrors (their rows) beginning elsewhere: the better pose stays; where neither is, that is said.
    """
    found = _solve_from(problem, alarms)
    for rows, other in again:
        found = _decided(found, rows, _solve_from(other, alarms))
    return finished(found, alarms)


def _decided(found: PoseEstimates, rows: IntArray, other: PoseEstimates) -> PoseEstimates:
    """Keep the better of two poses of some mirrors; where neither is clearly better, say so."""
    doubted = (PoseStatus.OK, PoseStatus.AMBIGUOUS)
    here, there = np.isin(found.status[rows], doubted), other.status == PoseStatus.OK
    gain = _cost(found)[rows] - _cost(other)
    apart = np.linalg.norm(found.poses.normal_enu[rows] - other.poses.normal_enu, axis=1)
    with np.errstate(invalid="ignore"):
        one = apart <= APART_SIGMA * np.maximum(found.poses.tilt_sigma_rad[rows], other.poses.tilt_sigma_rad)
        better = np.flatnonzero(there & (~here | (gain > 0.0)))
        alike = here & there & ~one & (np.abs(gain) <= DECISIVE_CHI2)
        settled = here & there & (gain > DECISIVE_CHI2)
    status = found.status.copy()
    kept = status[rows]
    kept[settled] = PoseStatus.OK
    kept[there & ~here] = PoseStatus.OK
    kept[alike] = PoseStatus.AMBIGUOUS
    status[rows] = kept
    return replace(put_rows(found, rows[better], other, better), status=status)


def _cost(found: PoseEstimates) -> FloatArray:
    """(mirror,) how badly a pose fits: what was left out for it counts, lest it fits by leaving out."""
    poses = found.poses
    cost = poses.chi2 - poses.dof
    if found.guard is not None:
        out = (found.guard.transmitter_status > TransmitterStatus.NOT_RECEIVED).sum(axis=1)
        cost = cost + _LEFT_OUT_CHI2 * (out + found.guard.prior_rejected.sum(axis=1))
    return np.asarray(cost)


def _solve_from(problem: MirrorProblem, alarms: Alarms | None) -> PoseEstimates:
    """Solve from where mirrors begin."""
    first: GuardedPoses | None = None
    used = problem
    if alarms is not None:
        first = solve_with_integrity(part_of(problem, groups=slice(1)), alarms)
        used = part_of(problem, used=first.used)
    ladder = solve_ladder(used)
    resolved = replace(used, range_m=ladder.range_m)
    found = PoseEstimates(
        poses=ladder.poses,
        status=ladder.poses.status.copy(),
        fixed=ladder.fixed,
        wrong_risk=ladder.wrong_risk,
        method=ladder.method,
        problem=resolved,
    )
    probability = residual_probability(ladder.poses)
    if alarms is None or first is None:
        found.status[(found.status == PoseStatus.OK) & (probability < RESIDUAL_PROBABILITY)] = PoseStatus.RESIDUAL
        return found
    climbed = part_of(resolved, begin=(ladder.poses.pivot_enu_m, ladder.poses.rot_enu_from_mirror))
    guard = joined(first, solve_with_integrity(climbed, alarms))
    status = guard.poses.status.copy()
    status[(status == PoseStatus.OK) & are_doubted(guard)] = PoseStatus.UNEXPLAINED
    return replace(
        found,
        poses=guard.poses,
        status=status,
        problem=part_of(resolved, used=guard.used),
        guard=guard,
        probability_all=_probability_of_all(problem, first, probability),
    )


def _probability_of_all(problem: MirrorProblem, first: GuardedPoses, probability: FloatArray) -> FloatArray:
    """Probability of the residuals with nothing left out: where something was, of the coarsest tone's."""
    out = probability.copy()
    rows = np.flatnonzero((first.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1))
    if rows.size:
        out[rows] = residual_probability(solve_rigid(part_of(problem, groups=slice(1), mirrors=rows)))
    return out


def residual_probability(poses: RigidPoses) -> FloatArray:
    """Return the probability of residuals as large as these or larger."""
    from scipy.special import chdtrc

    with np.errstate(invalid="ignore"):
        return np.asarray(chdtrc(np.maximum(poses.dof, 1.0), poses.chi2))


def are_doubted(guard: GuardedPoses) -> BoolArray:
    """(mirror,) not explained, or explained by leaving out so much that nothing confirms it."""
    unconfirmed = _left_out(guard) & (guard.status == IntegrityStatus.NO_REDUNDANCY)
    return np.asarray((guard.status == IntegrityStatus.UNEXPLAINED) | unconfirmed)


def put_rows(first: PoseEstimates, rows: IntArray, second: PoseEstimates, those: IntArray) -> PoseEstimates:
    """Return poses with some mirrors' replaced by those of another solution."""
    return cast("PoseEstimates", _put(first, rows, second, those))


def _put(first: Any, rows: IntArray, second: Any, those: IntArray) -> Any:
    if first is None:
        return None
    if isinstance(first, MirrorProblem):
        return replace(first, range_m=_put(first.range_m, rows, second.range_m, those))
    if is_dataclass(first) and not isinstance(first, type):
        values = {f.name: _put(getattr(first, f.name), rows, getattr(second, f.name), those) for f in fields(first)}
        return replace(first, **values)
    out = np.array(first)
    out[rows] = second[those]
    return out


def joined(first: GuardedPoses, second: GuardedPoses) -> GuardedPoses:
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


def _left_out(guard: GuardedPoses) -> BoolArray:
    """(mirror,) whether any transmitter or prior was."""
    excluded = (guard.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1)
    return np.asarray(excluded | guard.prior_rejected.any(axis=1))


def finished(found: PoseEstimates, alarms: Alarms | None) -> PoseEstimates:
    """Let covariances say what protection levels do, and mark poses that tell too little of the normal."""
    if alarms is not None:
        found = protected(found, alarms.missed_detection)
    vague = ~(found.poses.tilt_sigma_rad <= MAX_SIGMA_RAD)
    return replace(found, status=np.where((found.status == PoseStatus.OK) & vague, PoseStatus.UNCERTAIN, found.status))


def protected(found: PoseEstimates, missed: float) -> PoseEstimates:
    """Let covariances say what protection levels do, where something was left out; ``missed`` is theirs."""
    guard = found.guard
    if guard is None:
        return found
    return replace(found, poses=widened(found.poses, _left_out(guard), guard.protection_level_rad, missed))
