"""Integers of one observation by least squares, where rounding each by itself is not safe.

What the pose so far predicts wrongly, it predicts wrongly for all receivers and transmitters together: the mirror is
rigid and its receivers' places on it are known. The differences whose integers are sought therefore share six unknowns,
and their covariance knows it. Integer least squares uses all of it; a range rounded alone uses its own variance only.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.ambiguity import integer_least_squares
from rfpose.multilat.rigid import _kernels
from rfpose.multilat.rigid.problem import MirrorKnowledge, MirrorProblem
from rfpose.multilat.rigid.records import RigidPoses

__all__ = ["Candidates", "PredictedRanges", "can_search", "predict", "search_integers"]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

DELAY_REACH_M = 3.0
"""Unknown delays between a mirror's receivers are searched up to this, 10 ns."""

_NOISE_FLOOR_CYCLES = 1e-5
"""Noise is taken as no less than this, so that covariances stay far from rounding errors; it decides no integer."""

N_CANDIDATE = 12
"""Integer vectors that are tried with the pose itself where the straight-line model is not good enough."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedRanges:
    """What a pose says of ranges.

    Attributes
    ----------
    distance_m : (mirror, receiver, transmitter)
        [m].
    slope : (mirror, receiver, transmitter, 6)
        Derivative by pivot [m/m] and rotation [m/rad].
    cov : (mirror, 6, 6)
        Of the pose.
    bend_m : (mirror, receiver)
        What the straight-line model leaves out: standard deviation of the second-order term [m].
    """

    distance_m: FloatArray
    slope: FloatArray
    cov: FloatArray
    bend_m: FloatArray

    def take(self, rows: IntArray) -> PredictedRanges:
        """Select mirrors."""
        return PredictedRanges(**{f.name: getattr(self, f.name)[rows] for f in fields(PredictedRanges)})


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """Resolved ranges of some mirrors, the likeliest first.

    Attributes
    ----------
    range_m : (mirror, candidate, receiver, transmitter)
        [m]; NaN where not observed or beyond the references' reach.
    squared_norm : (mirror, candidate)
        Infinity where there is none.
    wrong_risk : (mirror,)
        Probability, beforehand, that the first is wrong, the straight-line model's own error counted.
    straight_risk : (mirror,)
        The same where the pose itself decides between the candidates.
    odds_against : (mirror,)
        What the data leave to the other candidates.
    adop_cycles : (mirror,)
    """

    range_m: FloatArray
    squared_norm: FloatArray
    wrong_risk: FloatArray
    straight_risk: FloatArray
    odds_against: FloatArray
    adop_cycles: FloatArray


def predict(problem: MirrorProblem, poses: RigidPoses) -> PredictedRanges:
    """Return distances at the given poses, with their derivative."""
    arm = np.einsum("mab,mrb->mra", poses.rot_enu_from_mirror, problem.receiver_mirror_m)
    to_receiver = (poses.pivot_enu_m[:, None] + arm)[:, :, None] - problem.transmitter_enu_m
    distance = np.linalg.norm(to_receiver, axis=-1)
    direction = to_receiver / distance[..., None]
    # d = |p + exp(θ)a − T| to second order: ½ [(θ·a)(θ·u) − |θ|²(a·u)], at most |a| |θ|²; an arm's end moves by no
    # more than twice its length
    turn2 = np.minimum(np.trace(poses.cov[:, 3:, 3:], axis1=1, axis2=2), 2.0)
    bend = np.linalg.norm(arm, axis=-1) * turn2[:, None]
    return PredictedRanges(
        distance_m=distance,
        slope=np.concatenate([direction, np.cross(arm[:, :, None], direction)], axis=-1),
        cov=poses.cov,
        bend_m=bend,
    )


def can_search(problem: MirrorProblem, k: int) -> bool:
    """Tell whether wavelength k's integers are defined: a common clock and unequal wavelengths leave none."""
    calibrated = bool(np.isfinite(problem.transmitter_sigma_m[:, k]).all())
    return not calibrated or bool(np.ptp(problem.wavelength_m[k]) == 0.0)


def search_integers(problem: MirrorProblem, k: int, prediction: PredictedRanges) -> Candidates:
    """Find the likeliest integers of wavelength k for every mirror, of whose poses so far ``prediction`` is."""
    range_m, sigma_m, wavelength_m = problem.range_m[:, k], problem.sigma_m[:, k], problem.wavelength_m[k]
    transmitter_sigma_m = problem.transmitter_sigma_m[:, k]
    calibrated = bool(np.isfinite(transmitter_sigma_m).all())
    seen = np.isfinite(range_m) & np.isfinite(sigma_m)
    left = np.where(seen, range_m - prediction.distance_m, np.nan)
    floor = _NOISE_FLOOR_CYCLES * wavelength_m
    own = np.where(seen, np.maximum(np.where(seen, sigma_m, 0.0), floor) ** 2, 0.0)
    bend = prediction.bend_m[:, :, None] ** 2
    minus, reference, clock_m2 = _references(seen, calibrated, wavelength_m, problem.knowledge)
    size = range_m.shape[1] * range_m.shape[2]
    ranges = _kernels.Ambiguous(
        left=left,
        slope=prediction.slope,
        pose_cov=prediction.cov,
        own_m2=own,
        common_m2=np.asarray(transmitter_sigma_m**2 if calibrated else np.zeros(range_m.shape[::2])),
        clock_m2=clock_m2,
        wavelength=wavelength_m,
        minus=minus,
        reference=reference,
    )

    def differences(seen: _kernels.Ambiguous) -> _kernels.Differences:
        n = len(left)
        out = _kernels.Differences(
            n_sought=np.zeros(n, np.int64),
            value=np.zeros((n, size)),
            cov=np.zeros((n, size, size)),
            row=np.zeros((n, size), np.int64),
            column=np.zeros((n, size), np.int64),
        )
        _kernels.difference_many(n, seen, out)
        return out

    count, value, cov, row, column = differences(ranges._replace(own_m2=own + bend))
    found = integer_least_squares(value, cov, count=count, n_candidate=N_CANDIDATE)
    resolved = np.full((len(left), N_CANDIDATE, *left.shape[1:]), np.nan)
    # the references keep the integer that they have: clocks and transmitters take it up
    used = seen & (np.arange(left.shape[1])[:, None] == minus[:, None, :])
    mirrors = np.arange(len(left))
    r0, i0 = reference[..., 0], reference[..., 1]
    for r in range(left.shape[1]):
        held = i0[:, r] >= 0
        used[mirrors[held], r0[held, r], i0[held, r]] = True
    resolved[:] = np.where(used, range_m, np.nan)[:, None]
    for j in range(int(count.max(initial=0))):
        m = np.flatnonzero(count > j)
        r, i = row[m, j], column[m, j]
        resolved[m, :, r, i] = range_m[m, r, i][:, None] - found.integers[m, :, j] * wavelength_m[i][:, None]
    # a single observation that took no part in any difference is of no use
    resolved[count == 0] = np.nan
    straight = integer_least_squares(value, differences(ranges).cov, count=count, n_candidate=1)
    return Candidates(
        range_m=resolved,
        squared_norm=found.squared_norm,
        wrong_risk=found.wrong_risk,
        straight_risk=straight.wrong_risk,
        odds_against=found.odds_against,
        adop_cycles=found.adop_cycles,
    )


def _references(
    seen: BoolArray, calibrated: bool, wavelength_m: FloatArray, known: MirrorKnowledge
) -> tuple[IntArray, IntArray, float]:
    """Choose what comes off each range; return it and the clock variance that remains [m²].

    Calibrated ranges: one transmitter a receiver (clocks of their own) or one a mirror (tied clocks). Uncalibrated: the
    receiver that sees most; with clocks of their own and equal wavelengths one transmitter a receiver besides.
    """
    n_mirror, n_receiver, n_transmitter = seen.shape
    free = not np.isfinite(known.clock_sigma_m)
    minus = np.full((n_mirror, n_transmitter), -1)
    reference = np.full((n_mirror, n_receiver, 2), -1)
    clock_m2 = 0.0 if free else known.clock_sigma_m**2
    first = np.argmax(seen, axis=2)
    any_seen: BoolArray = np.asarray(np.any(seen, axis=2))
    if calibrated:
        if free:
            reference[..., 0] = np.where(any_seen, np.arange(n_receiver), -1)
            reference[..., 1] = np.where(any_seen, first, -1)
        else:
            r0 = np.asarray(np.argmax(any_seen, axis=1))
            reference[..., 0] = r0[:, None]
            reference[..., 1] = np.where(np.any(any_seen, axis=1), first[np.arange(n_mirror), r0], -1)[:, None]
        return minus, reference, clock_m2
    base = np.argmax(seen.sum(axis=2), axis=1)
    if not free or np.ptp(wavelength_m) > 0.0:
        seen_by_base = np.take_along_axis(seen, base[:, None, None], axis=1)[:, 0]
        minus = np.where(seen_by_base, base[:, None], np.where(seen.any(axis=1), np.argmax(seen, axis=1), -1))
        return minus, reference, (DELAY_REACH_M / 2.0) ** 2 if free else clock_m2
    minus[:] = base[:, None]
    both = seen & np.take_along_axis(seen, base[:, None, None], axis=1)
    reference[..., 0] = np.where(both.any(axis=2), np.arange(n_receiver), -1)
    reference[..., 1] = np.where(both.any(axis=2), np.argmax(both, axis=2), -1)
    return minus, reference, clock_m2
