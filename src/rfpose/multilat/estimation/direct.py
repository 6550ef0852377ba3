"""Poses by the direct ray alone, wavelength by wavelength, guarded."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.estimation.found import (
    RESIDUAL_PROBABILITY,
    PoseEstimates,
    are_doubted,
    joined,
    put_rows,
    residual_probability,
)
from rfpose.multilat.fix import APART_SIGMA, DECISIVE_CHI2
from rfpose.multilat.integrity import Alarms, GuardedPoses, TransmitterStatus, solve_with_integrity
from rfpose.multilat.rigid import MirrorProblem, solve_rigid
from rfpose.multilat.rigid.integers import solve_ladder
from rfpose.multilat.status import PoseStatus

__all__ = ["solve_direct"]

_LEFT_OUT_CHI2 = 2.0 * DECISIVE_CHI2
"""What each transmitter or prior that was left out counts, where two poses of a mirror are compared."""


def solve_direct(
    problem: MirrorProblem,
    alarms: Alarms | None,
    again: Iterable[tuple[npt.NDArray[np.int64], MirrorProblem]] = (),
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
    return found


def _decided(found: PoseEstimates, rows: npt.NDArray[np.int64], other: PoseEstimates) -> PoseEstimates:
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
        first = solve_with_integrity(problem.groups(slice(1)), alarms)
        used = problem.only(first.used)
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
    climbed = resolved.started(ladder.poses.pivot_enu_m, ladder.poses.rot_enu_from_mirror)
    guard = joined(first, solve_with_integrity(climbed, alarms))
    status = guard.poses.status.copy()
    status[(status == PoseStatus.OK) & are_doubted(guard)] = PoseStatus.UNEXPLAINED
    return replace(
        found,
        poses=guard.poses,
        status=status,
        problem=resolved.only(guard.used),
        guard=guard,
        probability_all=_probability_of_all(problem, first, probability),
    )


def _probability_of_all(problem: MirrorProblem, first: GuardedPoses, probability: FloatArray) -> FloatArray:
    """Probability of the residuals with nothing left out: where something was, of the coarsest tone's."""
    out = probability.copy()
    rows = np.flatnonzero((first.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1))
    if rows.size:
        out[rows] = residual_probability(solve_rigid(problem.groups(slice(1)).take(rows)))
    return out
