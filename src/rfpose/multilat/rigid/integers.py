"""From wrapped phases to poses: coarse tone first, each finer wavelength once its integers are safe.

The pose found so far predicts the next finer range with a known uncertainty. Its integers are rounded one by one where
that makes a wrong one rarer than the stated risk. Where it does not, all of a mirror's integers are found together by
least squares, with what the rigid mirror makes common to them; where the turn is too uncertain for a straight-line
model, the pose itself decides between the likeliest. Otherwise the mirror keeps the coarser solution and says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.multilat.rigid.parts import part_of
from rfpose.multilat.rigid.pose import solve_rigid
from rfpose.multilat.rigid.problem import MirrorProblem
from rfpose.multilat.rigid.records import RigidPoses
from rfpose.multilat.rigid.search import (
    DELAY_REACH_M,
    Candidates,
    PredictedRanges,
    can_search,
    predict,
    search_integers,
)
from rfpose.multilat.status import PoseStatus

__all__ = ["IntegerMethod", "RigidSolution", "common_offset", "solve_ladder"]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

_SAFE_ROUNDING = 1e-6
"""Where rounding errs less often than this there is nothing to search."""

_DECIDING_TURN_RAD = 0.3
"""A turn less certain than this leaves each candidate's pose several minima: residuals do not decide between them."""

_SAME_TURN = 1e-6
"""Offsets that differ by whole wavelengths to this part of one are the same [cycles]."""

_UNLIKELY = 1e-6
"""Residuals rarer than this are worth another start."""

_SEARCH_ROWS = 4096
"""Mirrors searched at a time: their covariances are kept."""

_COMPLETE = 40.0
"""Candidates are all that matter when the next one fits worse than the best by this much of squared norm."""


class IntegerMethod(IntEnum):
    """How an observation's integers were found."""

    FLOAT = 0
    GIVEN = 1
    ROUNDED = 2
    LEAST_SQUARES = 3
    CONSTRAINED = 4

    @property
    def reason(self) -> str:
        """The method in words."""
        return (
            "not found safely: the observation is left out",
            "resolved beforehand",
            "rounded one by one",
            "least squares over all of the mirror's integers",
            "least squares, then the pose itself decided between the likeliest",
        )[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidSolution:
    """Poses, and which wavelengths they rest on.

    Attributes
    ----------
    poses
        The finest solution of each mirror.
    fixed : (mirror, observation)
        Whether an observation's integers were resolved and used.
    wrong_risk : (mirror, observation)
        Probability, beforehand, that any of its integers is wrong, by the best method; 1 where it could not be judged.
    method : (mirror, observation)
        `IntegerMethod`; FLOAT where not fixed.
    odds_against : (mirror, observation)
        Where integers were searched: what the data leave to the runners-up, afterwards; else NaN.
    adop_cycles : (mirror, observation)
        Where integers were searched: their ambiguity dilution of precision; else NaN.
    range_m : (mirror, group, receiver, transmitter)
        Resolved ranges, NaN where left out [m]. Whole wavelengths that a clock or a transmitter's own error takes up
        are as they happen to be.
    """

    poses: RigidPoses
    fixed: BoolArray
    wrong_risk: FloatArray
    method: IntArray
    odds_against: FloatArray
    adop_cycles: FloatArray
    range_m: FloatArray


def solve_ladder(problem: MirrorProblem, *, wrong_risk: float = 1e-6, search: bool = True) -> RigidSolution:
    """Solve poses from the coarsest wavelength down.

    Parameters
    ----------
    problem
        The first wavelength's integers must be resolved already.
    wrong_risk
        Largest probability that any integer of a wavelength is wrong, for it to be used.
    search
        Where rounding is not safe, find a mirror's integers together, by least squares [1]_ [2]_.

    Raises
    ------
    InvalidInputError
        ``wrong_risk`` is no probability.

    Notes
    -----
    The stated risk is that of the method used: the sum over all integers (rounding), or that of sequential rounding
    after decorrelation, an upper bound of least squares. It is a statement about the noise, made before the data.

    References
    ----------
    .. [1] Teunissen, The least-squares ambiguity decorrelation adjustment, J. Geodesy 70 (1995) 65–82.
    .. [2] Teunissen, Integer least-squares theory for the GNSS compass, J. Geodesy 84 (2010) 433–447: the receivers'
       known places constrain the search.
    """
    if not 0.0 < wrong_risk < 1.0:
        raise InvalidInputError(f"`wrong_risk` must lie between 0 and 1, got {wrong_risk}")
    ladder = _Ladder(problem, wrong_risk)
    poses = ladder.solve(np.arange(len(problem.range_m)), [problem.range_m[:, :1]], problem)
    for k in range(1, len(problem.clock_class)):
        poses = ladder.climb(k, poses, search=search)
    return RigidSolution(
        poses=poses,
        fixed=ladder.method != IntegerMethod.FLOAT,
        wrong_risk=ladder.risk,
        method=ladder.method,
        odds_against=ladder.odds,
        adop_cycles=ladder.adop,
        range_m=np.stack(ladder.resolved, axis=1),
    )


class _Ladder:
    """The state of a climb: which integers are resolved so far, how, and at what risk."""

    def __init__(self, problem: MirrorProblem, wrong_risk: float) -> None:
        shape = problem.range_m.shape[:2]
        self.problem, self.limit = problem, wrong_risk
        self.resolved = [np.full(problem.range_m[:, k].shape, np.nan) for k in range(shape[1])]
        self.resolved[0] = np.array(problem.range_m[:, 0])
        self.method = np.full(shape, IntegerMethod.FLOAT, np.int64)
        self.method[:, 0] = IntegerMethod.GIVEN
        self.risk = np.ones(shape)
        self.risk[:, 0] = 0.0
        self.odds, self.adop = np.full(shape, np.nan), np.full(shape, np.nan)

    def solve(self, mirrors: IntArray, ranges: list[FloatArray], start: MirrorProblem | RigidPoses) -> RigidPoses:
        """Solve some mirrors with the first wavelengths; each of ``ranges`` is (mirror, candidate, …).

        They begin at poses, where there are any, else where the problem does. The result's rows are mirror × candidate.
        """
        repeat = max(r.shape[1] for r in ranges)
        rows = np.repeat(mirrors, repeat)
        shape = (len(mirrors), repeat, *ranges[0].shape[2:])
        z = np.stack([np.broadcast_to(r, shape).reshape(-1, *shape[2:]) for r in ranges], axis=1)
        begin = None
        if isinstance(start, RigidPoses):
            begin = start.pivot_enu_m[rows], start.rot_enu_from_mirror[rows]
        some = part_of(self.problem, groups=slice(len(ranges)), mirrors=rows, begin=begin)
        return solve_rigid(replace(some, range_m=z))

    def climb(self, k: int, poses: RigidPoses, *, search: bool) -> RigidPoses:
        """Resolve observation k where that is safe, and solve with it."""
        prediction = predict(self.problem, poses)
        ranges, self.risk[:, k] = _round(self.problem, k, prediction)
        rounding_risk = self.risk[:, k].copy()
        limit = min(self.limit, _SAFE_ROUNDING) if search else self.limit
        self._take_rounded(k, ranges, np.less_equal(rounding_risk, limit))
        unsafe = np.flatnonzero((self.method[:, k] == IntegerMethod.FLOAT) & (poses.status == PoseStatus.OK))
        if search and len(unsafe) and can_search(self.problem, k):
            self._search(k, unsafe, poses, prediction)
        left: BoolArray = np.equal(self.method[:, k], IntegerMethod.FLOAT) & (rounding_risk <= self.limit)
        self._take_rounded(k, ranges, left)
        everyone = np.arange(len(self.problem.range_m))
        solution = self.solve(everyone, [r[:, None] for r in self.resolved[: k + 1]], poses)
        # a coarse wavelength may have led into another minimum, which the finer one cannot leave but shows
        lost = np.flatnonzero(_is_unlikely(solution))
        if len(lost):
            again = self.solve(lost, [r[lost][:, None] for r in self.resolved[: k + 1]], self.problem)
            with np.errstate(invalid="ignore"):
                keep = ~(again.chi2 < np.where(np.isfinite(solution.chi2[lost]), solution.chi2[lost], np.inf))
            solution = _placed(solution, lost[~keep], _taken(again, np.flatnonzero(~keep)))
        # what made a solved mirror unsolvable is not used for it
        worse = (poses.status == PoseStatus.OK) & (solution.status != PoseStatus.OK)
        self.method[worse, k] = IntegerMethod.FLOAT
        self.resolved[k][worse] = np.nan
        return _merge(solution, poses, worse)

    def _take_rounded(self, k: int, ranges: FloatArray, which: BoolArray) -> None:
        self.method[which, k] = IntegerMethod.ROUNDED
        self.resolved[k][which] = ranges[which]

    def _search(self, k: int, mirrors: IntArray, poses: RigidPoses, prediction: PredictedRanges) -> None:
        """Resolve by least squares what could not be rounded."""
        for part in np.array_split(mirrors, -(-len(mirrors) // _SEARCH_ROWS)):
            found = search_integers(part_of(self.problem, mirrors=part), k, prediction.take(part))
            risk, odds = found.wrong_risk.copy(), found.odds_against.copy()
            chosen = np.zeros(len(part), np.int64)
            method = np.full(len(part), IntegerMethod.LEAST_SQUARES, np.int64)
            # where the straight-line model makes the risk, the pose itself is asked
            bent = (risk > min(self.limit, _SAFE_ROUNDING)) & (found.straight_risk <= np.minimum(self.limit, risk / 2))
            bent &= np.trace(prediction.cov[part][:, 3:, 3:], axis1=1, axis2=2) < _DECIDING_TURN_RAD**2
            if bent.any():
                chosen[bent], odds[bent], complete = self._decide(k, part[bent], found, bent, poses)
                method[bent] = IntegerMethod.CONSTRAINED
                risk[bent] = np.where(complete, found.straight_risk[bent], 1.0)
            better = risk < self.risk[part, k]
            self.risk[part, k] = np.where(better, risk, self.risk[part, k])
            self.odds[part, k], self.adop[part, k] = odds, found.adop_cycles
            safe = risk <= self.limit
            self.method[part[safe], k] = method[safe]
            self.resolved[k][part[safe]] = found.range_m[safe, chosen[safe]]

    def _decide(
        self, k: int, mirrors: IntArray, found: Candidates, chosen: BoolArray, poses: RigidPoses
    ) -> tuple[IntArray, FloatArray, BoolArray]:
        """Solve the pose with each candidate: the likeliest, the odds of the others, whether the list was complete."""
        norm = found.squared_norm[chosen]
        trial = self.solve(mirrors, [r[mirrors][:, None] for r in self.resolved[:k]] + [found.range_m[chosen]], poses)
        solved = (trial.status == PoseStatus.OK).reshape(norm.shape) | ~np.isfinite(norm)
        chi2 = np.where(np.isfinite(norm) & solved, trial.chi2.reshape(norm.shape), np.inf)
        best = np.argmin(chi2, axis=1)
        lowest = chi2.min(axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):
            odds = np.nan_to_num(np.exp(-0.5 * (chi2 - lowest))).sum(axis=1) - 1.0
            complete = np.isfinite(lowest[:, 0]) & (norm[:, -1] - norm[:, 0] > _COMPLETE) & solved.all(axis=1)
        return best, odds, complete


def _merge(new: RigidPoses, old: RigidPoses, keep_old: BoolArray) -> RigidPoses:
    """Take each mirror's row from the old poses where told; clock classes that the old ones lack are NaN."""
    arrays = {}
    for name in RigidPoses.__dataclass_fields__:
        array, before = np.array(getattr(new, name)), getattr(old, name)
        if name == "clock_m":
            array[keep_old, : before.shape[1]] = before[keep_old]
        else:
            array[keep_old] = before[keep_old]
        arrays[name] = array
    return RigidPoses(**arrays)


def _taken(poses: RigidPoses, rows: IntArray) -> RigidPoses:
    """Return some rows of poses."""
    return RigidPoses(**{name: getattr(poses, name)[rows] for name in RigidPoses.__dataclass_fields__})


def _placed(poses: RigidPoses, rows: IntArray, other: RigidPoses) -> RigidPoses:
    """Return poses with some rows replaced."""
    arrays = {name: np.array(getattr(poses, name)) for name in RigidPoses.__dataclass_fields__}
    for name, array in arrays.items():
        array[rows] = getattr(other, name)
    return RigidPoses(**arrays)


def _is_unlikely(poses: RigidPoses) -> BoolArray:
    """Not solved, or with residuals that noise hardly makes."""
    from scipy.special import chdtrc

    with np.errstate(invalid="ignore"):
        rare = chdtrc(np.maximum(poses.dof, 1.0), poses.chi2) < _UNLIKELY
    return np.asarray(rare | (poses.status == PoseStatus.NOT_CONVERGED))


def _round(problem: MirrorProblem, k: int, prediction: PredictedRanges) -> tuple[FloatArray, FloatArray]:
    """Round the integers of wavelength k; return resolved ranges and the risk that any is wrong (mirror,)."""
    from scipy.special import erfc

    range_m, own, common = problem.range_m[:, k], problem.sigma_m[:, k], problem.transmitter_sigma_m[:, k]
    known, wavelength, slope = problem.knowledge, problem.wavelength_m[k], prediction.slope
    left = range_m - prediction.distance_m
    calibrated = np.isfinite(common).all()
    # what clocks add is found from the ranges themselves: the mean over transmitters says nothing about integers
    centred = slope - slope.mean(axis=2, keepdims=True)
    offset_free = True
    if calibrated:
        slope = centred
        noise = own**2 + common[:, None] ** 2
    else:
        # only differences between receivers mean anything
        left = left - left[:, :1]
        noise = own**2 + own[:, :1] ** 2
        offset_free = not np.isfinite(known.clock_sigma_m)
        slope = centred - centred[:, :1] if offset_free else slope - slope[:, :1]
        noise = noise if offset_free else noise + 2.0 * known.clock_sigma_m**2
    predicted = np.einsum("mria,mab,mrib->mri", slope, prediction.cov, slope)
    # the straight-line model's own error counts, of both receivers where two are compared
    bend = prediction.bend_m**2 if calibrated else prediction.bend_m**2 + prediction.bend_m[:, :1] ** 2
    sigma = np.sqrt(predicted + noise + bend[:, :, None])
    offset_risk = np.zeros(left.shape[:2])
    if offset_free:
        offset, offset_risk = common_offset(left, wavelength, sigma)
        left = left - offset
    turns = np.rint(left / wavelength)
    with np.errstate(invalid="ignore"):
        wrong = erfc(0.5 * wavelength / (np.sqrt(2.0) * sigma))
    wrong = np.where(np.isfinite(wrong), wrong, 1.0)  # a mirror without a pose so far predicts nothing
    risk = np.where(np.isfinite(left), wrong, 0.0).sum(axis=(1, 2)) + offset_risk[:, 0 if calibrated else 1 :].sum(
        axis=1
    )
    risk = np.where(np.isfinite(left).any(axis=(1, 2)), np.minimum(risk, 1.0), 1.0)
    return range_m - turns * wavelength, risk


def common_offset(left: FloatArray, wavelength: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the common offset of ranges known up to whole wavelengths, per receiver, and the risk of a wrong one.

    With one wavelength the offset is near zero; any multiple of it does as well. With unequal wavelengths (carriers)
    it is the one within ±`DELAY_REACH_M` that fits best, and the runner-up tells how safely. Offsets that are a whole
    number of every wavelength apart (carriers on a common raster) are one answer; the one nearest zero is given.

    Parameters
    ----------
    left, sigma : (mirror, receiver, transmitter)
        Ranges less their prediction, NaN = not received; what they may scatter [m].
    wavelength : (transmitter,)
        [m].

    Returns
    -------
    offset_m : (mirror, receiver, 1)
    risk : (mirror, receiver)
    """
    seen = np.isfinite(left)
    count = np.maximum(seen.sum(axis=2, keepdims=True), 1)
    if np.ptp(wavelength) == 0.0:
        phasor = np.where(seen, np.exp(2j * np.pi * np.nan_to_num(left) / wavelength), 0.0)
        mean = np.angle(phasor.sum(axis=2, keepdims=True)) / (2 * np.pi) * wavelength[0]
        return np.asarray(mean), np.zeros(left.shape[:2])
    steps = int(np.ceil(4.0 * DELAY_REACH_M / float(np.min(wavelength)))) + 1
    offsets, scores = [], []
    for begin in np.linspace(-DELAY_REACH_M, DELAY_REACH_M, steps):
        offset = np.full(count.shape, begin)
        for _ in range(4):
            wrapped = np.where(seen, left - offset, 0.0)
            wrapped = wrapped - np.rint(wrapped / wavelength) * wavelength
            offset = offset + wrapped.sum(axis=2, keepdims=True) / count
        offsets.append(offset)
        with np.errstate(invalid="ignore"):
            scores.append(np.where(seen, (wrapped / sigma) ** 2, 0.0).sum(axis=2))
    all_offsets, score = np.stack(offsets), np.nan_to_num(np.stack(scores), nan=np.inf)
    best = np.argmin(score, axis=0)[None]
    chosen = np.take_along_axis(all_offsets, best[..., None], axis=0)[0]
    lowest = np.take_along_axis(score, best, axis=0)
    # Several beginnings end at the same offset, or a whole number of every wavelength from it, which the receiver's
    # unknown clock takes up: both are the same answer. The runner-up is the best of the others.
    turns = (all_offsets - chosen) / wavelength
    same = np.where(seen, np.abs(turns - np.rint(turns)), 0.0).max(axis=3) < _SAME_TURN
    nearest = np.argmin(np.where(same, np.abs(all_offsets[..., 0]), np.inf), axis=0)[None]
    chosen = np.take_along_axis(all_offsets, nearest[..., None], axis=0)[0]
    apart = ~same & (np.abs(all_offsets - chosen)[..., 0] > 0.25 * float(np.min(wavelength)))
    with np.errstate(invalid="ignore"):
        odds = np.where(apart, np.exp(-0.5 * np.minimum(score - lowest, 1400.0)), 0.0).sum(axis=0)
    return chosen, np.nan_to_num(np.minimum(odds, 1.0), nan=1.0)
