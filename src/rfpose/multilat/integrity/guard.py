"""Poses that notice what is wrong: test, find, leave out, solve again, and say what could still be hidden.

`Guard` is the loop that all estimators' tests share; `solve_with_integrity` is that of the direct ray.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.multilat.equations import MirrorArrays
from rfpose.multilat.integrity.hypotheses import judge
from rfpose.multilat.integrity.records import Alarms, GuardedPoses, IntegrityStatus, TransmitterStatus, Verdict
from rfpose.multilat.rigid.parts import part_of
from rfpose.multilat.rigid.pose import can_begin, solve_rigid
from rfpose.multilat.rigid.problem import PRIORS, MirrorProblem
from rfpose.multilat.rigid.records import RigidPoses
from rfpose.multilat.rigid.weights import equations_of, used_priors
from rfpose.multilat.status import PoseStatus

__all__ = ["Guard", "limit", "log_probability", "noncentrality", "solve_with_integrity", "widened"]

BoolArray = npt.NDArray[np.bool_]
StatusArray = npt.NDArray[np.int8]
IntArray = npt.NDArray[np.int64]
Arrays = dict[str, npt.NDArray[Any]]

# Reported noise this many times the usual is called interference.
NOISY = 3.0
# Sigmas from which a receiver's residual of what was left out counts for the pattern of the error.
CLEAR = 10.0
# A simpler pattern of an error is believed unless what it leaves unexplained is less likely than this.
PATTERN_PROBABILITY = 1e-3
# Drop of chi² above which the residuals are those of a ruined pose, and tests on them mean little.
GROSS = 1e4
# Residuals that differ by less, relative to the largest, are called common.
ALIKE = 0.05


def solve_with_integrity(problem: MirrorProblem, alarms: Alarms | None = None) -> GuardedPoses:
    """Solve rigid poses, leave out what contradicts the rest, and bound what could be wrong unnoticed.

    Parameters
    ----------
    problem
        As for `rfpose.multilat.rigid.solve_rigid`.
    alarms
        When to speak up.
    """
    guard = _DirectGuard(problem, alarms or Alarms())
    guard.run()
    guard.take_back()
    return guard.result()


class Guard(ABC):
    """The loop over all mirrors; an estimator says how it tests (`judge`) and how it leaves out (`leave_out`).

    Hypotheses are numbered: whole transmitters first, then `PRIORS`.

    Parameters
    ----------
    poses
        Solved with all there is.
    mirrors
        What they were solved with.
    alarms
    n_test
        How many single tests share the false alarms.
    """

    def __init__(self, poses: RigidPoses, mirrors: MirrorArrays, alarms: Alarms, n_test: int) -> None:
        n_mirror, _, _, self.n_transmitter = mirrors.z.shape
        self.mirrors = mirrors
        self.poses: dict[str, npt.NDArray[Any]] = {f.name: np.array(getattr(poses, f.name)) for f in fields(poses)}
        self.weight = mirrors.weight.copy()
        self.dropped = np.zeros((n_mirror, len(PRIORS)), np.bool_)
        self.max_excluded, self.missed = alarms.max_excluded, alarms.missed_detection
        self.global_alarm = alarms.false_alarm / 2.0
        self.single_alarm = alarms.false_alarm / 2.0 / n_test
        self.status = np.full(n_mirror, IntegrityStatus.NOT_SOLVED, np.int8)
        self.status[poses.status == PoseStatus.OK] = IntegrityStatus.OK
        self.transmitter_status = np.zeros((n_mirror, self.n_transmitter), np.int8)
        self.transmitter_status[~np.any(self.weight > 0.0, axis=(1, 2))] = TransmitterStatus.NOT_RECEIVED
        self.testable = np.zeros((n_mirror, len(PRIORS)), np.bool_)
        self.probability = np.full(n_mirror, np.nan)
        self.own_level = np.full(n_mirror, np.inf)
        self.worst = np.full(n_mirror, -1, np.int64)

    # -- what estimators differ in

    @abstractmethod
    def judge(self, rows: IntArray) -> Verdict:
        """Test every hypothesis about some mirrors."""

    @abstractmethod
    def leave_out(self, rows: IntArray, verdict: Verdict, single: FloatArray) -> IntArray:
        """Leave out each failing mirror's likeliest culprit; return the mirrors to be tested again."""

    def other_level(self) -> FloatArray:
        """(mirror,) protection level against an error found having another cause; NaN where none is likely."""
        return np.full(len(self.status), np.nan)

    # -- the loop

    def run(self) -> None:
        """Test; leave out; solve again; until all is consistent or nothing helps."""
        rows = np.flatnonzero(self.status != IntegrityStatus.NOT_SOLVED)
        for step in range(self.max_excluded + 1):
            bad, verdict, single = self._test(rows)
            if step < self.max_excluded:
                rows = self.leave_out(rows[bad], verdict, single)

    def alarm(
        self, verdict: Verdict, chi2: npt.NDArray[Any], dof: npt.NDArray[Any]
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Whether anything is wrong; log-probabilities of all hypotheses; of chi²."""
        overall = log_probability(chi2, np.rint(dof).astype(np.int64))
        single = log_probability(verdict.stat, verdict.dof)
        links = log_probability(verdict.link, verdict.link_dof)
        alarm = overall < np.log(self.global_alarm)
        alarm |= (single < np.log(self.single_alarm)).any(axis=1)
        alarm |= (links < np.log(self.single_alarm)).any(axis=(1, 2))
        return np.asarray(alarm), single, overall

    def _test(self, rows: IntArray) -> tuple[IntArray, Verdict, FloatArray]:
        """Test mirrors and note what comes out; return which fail, and their statistics."""
        verdict = self.judge(rows)
        alarm, single, overall = self.alarm(verdict, self.poses["chi2"][rows], self.poses["dof"][rows])
        self.probability[rows] = np.exp(overall)
        self.testable[rows] |= verdict.dof[:, self.n_transmitter :] > 0
        self.protect(rows, verdict)
        bad = np.flatnonzero(alarm)
        self.status[rows[bad]] = IntegrityStatus.UNEXPLAINED
        return bad, verdict.take(bad), single[bad]

    def without(self, rows: IntArray, hypothesis: int) -> tuple[FloatArray, BoolArray]:
        """Weights and dropped priors of some mirrors if a hypothesis were left out."""
        weight, dropped = self.weight[rows], self.dropped[rows]
        if hypothesis < self.n_transmitter:
            weight[..., hypothesis] = 0.0
        else:
            dropped[:, hypothesis - self.n_transmitter] = True
        return weight, dropped

    def accept(
        self, rows: IntArray, weight: FloatArray, dropped: BoolArray, poses: dict[str, npt.NDArray[Any]]
    ) -> None:
        """Take poses for those of some mirrors, with what they were solved with."""
        self.weight[rows], self.dropped[rows] = weight, dropped
        for name, array in poses.items():
            self.poses[name][rows] = array

    def mark(self, rows: IntArray) -> None:
        """Status of mirrors from which something was left out."""
        left = self.dropped[rows].any(axis=1)
        self.status[rows] = np.where(left, IntegrityStatus.PRIOR_REJECTED, IntegrityStatus.EXCLUDED)

    # -- what was wrong

    def pattern(
        self, rows: IntArray, who: IntArray, predicted: FloatArray, *, alike: float
    ) -> tuple[IntArray, IntArray]:
        """Name each mirror's pattern of errors, seen from a pose without them; the receiver if it is only one, else −1.

        Parameters
        ----------
        rows, who : (mirror,)
            Mirrors, and the transmitter of each that was left out.
        predicted : (mirror, group, receiver)
            Its ranges by the pose [m].
        alike
            Residuals that differ by less, relative to the largest, are called common.
        """
        mirrors = self.mirrors
        left = mirrors.z[rows, :, :, who] - predicted - self.poses["clock_m"][rows][:, mirrors.clock_class]
        own = mirrors.weight[rows, :, :, who]
        with np.errstate(divide="ignore"):
            sigma = mirrors.bias_info[rows, :, who][..., None] ** -0.5
        free = np.isinf(sigma)
        middle = quiet_median(np.where(own > 0.0, left, np.nan))[..., None]
        # without calibration nothing that all receivers have in common is an error
        left = np.where(free, left - middle, left)
        size = np.where(own > 0.0, np.abs(left), 0.0)
        with np.errstate(divide="ignore"):
            small = CLEAR * np.where(free, own**-0.5, np.hypot(own**-0.5, sigma))
        clear = np.any(size > small, axis=1)
        apart = np.max(np.where(own > 0.0, np.abs(left - middle), 0.0), axis=(1, 2))
        common = np.all(clear, axis=1) & (apart < alike * size.max(axis=(1, 2)))
        one = clear.sum(axis=1) == 1
        cause = np.where(common, TransmitterStatus.COMMON_ERROR, TransmitterStatus.MULTIPATH)
        return np.where(one, TransmitterStatus.ONE_RECEIVER, cause), np.where(one, np.argmax(clear, axis=1), -1)

    def noisy(self, rows: IntArray, who: IntArray) -> BoolArray:
        """Whether a transmitter's reported noise is far above that of the mirror's others."""
        with np.errstate(divide="ignore"):
            sigma = np.where(self.weight[rows] > 0.0, self.weight[rows] ** -0.5, np.nan)
        usual = quiet_median(sigma.reshape(*sigma.shape[:2], -1))
        own = sigma[np.arange(len(rows)), :, :, who]
        return np.asarray((own > NOISY * usual[:, :, None]).any(axis=(1, 2)))

    # -- protection

    def protect(self, rows: IntArray, verdict: Verdict) -> None:
        """Protection level against one more faulty transmitter."""
        dof = verdict.dof[:, : self.n_transmitter]
        spread = np.sqrt(np.maximum(largest_eigenvalue(verdict.spread_rad2[:, : self.n_transmitter]), 0.0))
        hidden_bias = np.sqrt(noncentrality(limit(self.single_alarm, dof), dof, self.missed))
        with np.errstate(invalid="ignore"):
            bias = np.where(dof > 0, hidden_bias * spread, 0.0)
        bias[verdict.hidden[:, : self.n_transmitter]] = np.inf
        noise = tilt_quantile(self.missed) * np.sqrt(largest_eigenvalue(verdict.cov_rad2))
        self.own_level[rows] = np.where(verdict.ok, bias.max(axis=1) + noise, np.inf)
        self.worst[rows] = np.argmax(bias, axis=1)

    def n_left_out(self, rows: IntArray) -> IntArray:
        """How many transmitters and priors were left out of some mirrors."""
        left_out = self.transmitter_status[rows] > TransmitterStatus.NOT_RECEIVED
        return np.asarray(left_out.sum(axis=1) + self.dropped[rows].sum(axis=1))

    def result(self) -> GuardedPoses:
        """Put everything together."""
        others = self.other_level()
        level = np.fmax(self.own_level, others)
        ambiguous = others > self.own_level
        explained = np.isin(self.status, (IntegrityStatus.EXCLUDED, IntegrityStatus.PRIOR_REJECTED))
        self.status[ambiguous & explained] = IntegrityStatus.AMBIGUOUS
        unprotected = np.isin(self.status, (IntegrityStatus.UNEXPLAINED, IntegrityStatus.NOT_SOLVED))
        level[unprotected | ~np.isfinite(level)] = np.inf
        self.status[np.isinf(level) & ~unprotected] = IntegrityStatus.NO_REDUNDANCY
        poses = RigidPoses(**{name: read_only(array) for name, array in self.poses.items()})
        left_out: BoolArray = np.asarray(self.n_left_out(np.arange(len(level))) > 0)
        return GuardedPoses(
            poses=widened(poses, left_out, level, self.missed),
            status=read_only(self.status),
            transmitter_status=read_only(self.transmitter_status),
            used=read_only(np.asarray((self.weight > 0.0).any(axis=1))),
            prior_rejected=read_only(self.dropped),
            prior_testable=read_only(self.testable),
            chi2_probability=read_only(self.probability),
            protection_level_rad=read_only(level),
            worst_transmitter=read_only(np.where(ambiguous | unprotected, -1, self.worst)),
        )


class _DirectGuard(Guard):
    """Hypotheses are linearised: the drop of chi² that each would bring, from one solution."""

    def __init__(self, given: MirrorProblem, alarms: Alarms) -> None:
        n_mirror, _, n_receiver, n_transmitter = given.range_m.shape
        equations = equations_of(given)
        poses = solve_rigid(given, equations)
        super().__init__(poses, equations.mirrors, alarms, n_transmitter * (1 + n_receiver) + len(PRIORS))
        self.given = given
        # mirrors that only something left out may let converge
        self.lost = np.flatnonzero((poses.status == PoseStatus.NOT_CONVERGED) & can_begin(given))
        # what was left out, in order: mirrors, hypothesis
        self.history: list[tuple[IntArray, IntArray]] = []
        # other explanations of what was found: normal and its uncertainty if that had been left out instead
        n_hypothesis = n_transmitter + len(PRIORS)
        self.other_normal = np.full((n_mirror, n_hypothesis, 3), np.nan)
        self.other_sigma = np.full((n_mirror, n_hypothesis), np.nan)

    # -- solving

    def _problem(self, rows: IntArray, weight: FloatArray, dropped: BoolArray) -> MirrorProblem:
        some = part_of(self.given, mirrors=rows)
        return replace(some, range_m=np.where(weight > 0.0, some.range_m, np.nan), dropped=dropped)

    def _solve(self, rows: IntArray, weight: FloatArray, dropped: BoolArray, *, from_start: bool = False) -> Arrays:
        """Solve some mirrors with other weights and priors, from where they are or from their first start."""
        some = self._problem(rows, weight, dropped)
        if not from_start:
            some = part_of(some, begin=(self.poses["pivot_enu_m"][rows], self.poses["rot_enu_from_mirror"][rows]))
        poses = solve_rigid(some)
        return {name: getattr(poses, name) for name in self.poses}

    def _accept_some(
        self, which: IntArray, rows: IntArray, weight: FloatArray, dropped: BoolArray, poses: Arrays
    ) -> None:
        self.accept(rows[which], weight[which], dropped[which], {name: v[which] for name, v in poses.items()})

    # -- testing

    def judge(self, rows: IntArray) -> Verdict:
        problem = self._problem(rows, self.weight[rows], self.dropped[rows])
        return judge(problem, RigidPoses(**{name: v[rows] for name, v in self.poses.items()}))

    def leave_out(self, rows: IntArray, verdict: Verdict, single: FloatArray) -> IntArray:
        gross = verdict.stat.max(axis=1, initial=0.0) > GROSS
        found = self._try_each(np.concatenate([rows[gross], self.lost]))
        self.lost = self.lost[:0]
        rest = np.flatnonzero(~gross)
        return np.concatenate([found, self._leave_out(rows[rest], verdict.take(rest), single[rest])])

    def _try_each(self, rows: IntArray) -> IntArray:
        """Leave out each transmitter and prior in turn, from the first start, and keep what fits best.

        For errors so large that the pose they lead to says nothing of them. Returns the mirrors that were solved.
        """
        if not rows.size:
            return rows
        before, dropped_before = self.weight[rows].copy(), self.dropped[rows].copy()
        has_prior = used_priors(self._problem(rows, before, dropped_before))
        used = np.concatenate([(before > 0.0).any(axis=(1, 2)), has_prior], axis=1)
        best, choice = np.full(len(rows), np.inf), np.full(len(rows), -1)
        for h in range(used.shape[1]):
            at = np.flatnonzero(used[:, h])
            weight, dropped = before[at], dropped_before[at]
            if h < self.n_transmitter:
                weight[..., h] = 0.0
            else:
                dropped[:, h - self.n_transmitter] = True
            poses = self._solve(rows[at], weight, dropped, from_start=True)
            chi2 = np.where(poses["status"] == PoseStatus.OK, np.asarray(poses["chi2"], np.float64), np.inf)
            better = np.flatnonzero(chi2 < best[at])
            best[at[better]], choice[at[better]] = chi2[better], h
            self._accept_some(better, rows[at], weight, dropped, poses)
        found = np.flatnonzero(choice >= 0)
        rows, choice = rows[found], choice[found]
        of_transmitter = np.flatnonzero(choice < self.n_transmitter)
        if of_transmitter.size:
            self._name_gross(rows[of_transmitter], choice[of_transmitter])
        self.history.append((rows, choice))
        self.mark(rows)
        return rows

    def _name_gross(self, rows: IntArray, who: IntArray) -> None:
        """Name the pattern of errors seen from a pose without them; use the other receivers if only one is wrong."""
        pivot, rot = self.poses["pivot_enu_m"][rows], self.poses["rot_enu_from_mirror"][rows]
        places = pivot[:, None] + np.einsum("mab,mrb->mra", rot, self.given.receiver_mirror_m[rows])
        distance = np.linalg.norm(places - self.given.transmitter_enu_m[who][:, None], axis=-1)
        cause, receiver = self.pattern(rows, who, distance[:, None], alike=ALIKE)
        self.transmitter_status[rows, who] = cause
        at = np.flatnonzero(receiver >= 0)
        if at.size:
            weight = self.weight[rows[at]]
            for k, m in enumerate(at):
                weight[k, :, :, who[m]] = self.mirrors.weight[rows[m], :, :, who[m]]
                weight[k, :, receiver[m], who[m]] = 0.0
            dropped = self.dropped[rows[at]]
            poses = self._solve(rows[at], weight, dropped)
            good = np.flatnonzero(
                (poses["status"] == PoseStatus.OK) & (poses["chi2"] < self.poses["chi2"][rows[at]] + 0.1 * GROSS)
            )
            self._accept_some(good, rows[at], weight, dropped, poses)

    def _leave_out(self, rows: IntArray, verdict: Verdict, single: FloatArray) -> IntArray:
        """Leave out each mirror's likeliest culprit; return the mirrors that could be solved without."""
        if not rows.size:
            return rows
        n_transmitter = self.n_transmitter
        choice = np.argmin(single, axis=1)
        at = np.arange(len(rows))
        weight, dropped = self.weight[rows], self.dropped[rows]
        is_prior = choice >= n_transmitter
        dropped[at[is_prior], choice[is_prior] - n_transmitter] = True
        who = np.minimum(choice, n_transmitter - 1)
        cause, receiver = self._cause(rows, verdict, who)
        for r in range(weight.shape[2]):
            one = ~is_prior & (receiver == r)
            weight[at[one], :, r, who[one]] = 0.0
        whole = ~is_prior & (receiver < 0)
        weight[at[whole], :, :, who[whole]] = 0.0
        poses = self._solve(rows, weight, dropped)
        solved = np.flatnonzero((poses["status"] == PoseStatus.OK) & (verdict.dof[at, choice] > 0))
        self._remember_others(rows[solved], verdict.take(solved), choice[solved])
        self._accept_some(solved, rows, weight, dropped, poses)
        self.history.append((rows[solved], choice[solved]))
        marked = solved[~is_prior[solved]]
        self.transmitter_status[rows[marked], who[marked]] = cause[marked]
        self.mark(rows[solved])
        return np.asarray(rows[solved])

    def _cause(self, rows: IntArray, verdict: Verdict, who: IntArray) -> tuple[StatusArray, IntArray]:
        """Name the pattern of each mirror's worst transmitter; the receiver if it is only one, else −1."""
        at = np.arange(len(rows))
        stat, dof = verdict.stat[at, who], verdict.dof[at, who]
        link, link_dof = verdict.link[at, :, who], verdict.link_dof[at, :, who]
        receiver = np.argmax(link, axis=1)
        enough = np.log(PATTERN_PROBABILITY)
        common_fits = (verdict.common_dof[at, who] > 0) & (
            log_probability(stat - verdict.common[at, who], dof - verdict.common_dof[at, who]) >= enough
        )
        link_fits = (link_dof[at, receiver] > 0) & (
            log_probability(stat - link[at, receiver], dof - link_dof[at, receiver]) >= enough
        )
        link_fits &= ~common_fits | (link[at, receiver] > verdict.common[at, who])
        cause = np.where(
            link_fits,
            TransmitterStatus.ONE_RECEIVER,
            np.where(common_fits, TransmitterStatus.COMMON_ERROR, TransmitterStatus.MULTIPATH),
        )
        noisy = self.noisy(rows, who)
        cause = np.where(noisy, TransmitterStatus.INTERFERENCE, cause).astype(np.int8)
        return cause, np.where(link_fits & ~noisy, receiver, -1)

    def _remember_others(self, rows: IntArray, verdict: Verdict, choice: IntArray) -> None:
        """Keep the poses that other explanations, nearly as likely as the one taken, would have given."""
        at = np.arange(len(rows))
        best, best_dof = verdict.stat[at, choice], verdict.dof[at, choice]
        n_hypothesis = verdict.stat.shape[1]
        margin = limit(self.missed / n_hypothesis, best_dof)
        near = (verdict.dof > 0) & (verdict.stat > (best - margin)[:, None])
        near[at, choice] = False
        rot = self.poses["rot_enu_from_mirror"][rows]
        turn = -np.einsum("mac,mhc->mha", rot[:, :, :2], verdict.shift_rad)
        normal = rot[:, None, :, 2] + np.cross(turn, rot[:, None, :, 2])
        sigma = np.sqrt(largest_eigenvalue(verdict.cov_rad2[:, None] + verdict.spread_rad2))
        self.other_normal[rows] = np.where(near[..., None], normal, np.nan)
        self.other_sigma[rows] = np.where(near, sigma, np.nan)

    def take_back(self) -> None:
        """Where several things were left out, use again each that fits what the last one left."""
        for rows, choice in self.history[:-1]:
            count = self.n_left_out(rows)
            again = np.flatnonzero(
                (count > 1) & np.isin(self.status[rows], (IntegrityStatus.EXCLUDED, IntegrityStatus.PRIOR_REJECTED))
            )
            if again.size:
                self._try_back(rows[again], choice[again])

    def _try_back(self, rows: IntArray, choice: IntArray) -> None:
        weight, dropped = self.weight[rows], self.dropped[rows]
        at = np.arange(len(rows))
        is_prior = choice >= self.n_transmitter
        dropped[at[is_prior], choice[is_prior] - self.n_transmitter] = False
        for k in at[~is_prior]:
            weight[k, :, :, choice[k]] = self.mirrors.weight[rows[k], :, :, choice[k]]
        poses = self._solve(rows, weight, dropped)
        solved = poses["status"] == PoseStatus.OK
        safe = {name: np.where(_like(solved, v), v, self.poses[name][rows]) for name, v in poses.items()}
        verdict = judge(self._problem(rows, weight, dropped), RigidPoses(**safe))
        alarm, _, overall = self.alarm(verdict, safe["chi2"], safe["dof"])
        good = np.flatnonzero(solved & verdict.ok & ~alarm)
        self._accept_some(good, rows, weight, dropped, safe)
        self.probability[rows[good]] = np.exp(overall[good])
        self.protect(rows[good], verdict.take(good))
        back = good[~is_prior[good]]
        self.transmitter_status[rows[back], choice[back]] = TransmitterStatus.OK
        self.mark(rows[good])

    def other_level(self) -> FloatArray:
        moot = np.concatenate([self.transmitter_status > TransmitterStatus.NOT_RECEIVED, self.dropped], axis=1)
        normal = self.poses["rot_enu_from_mirror"][:, None, :, 2]
        apart = np.linalg.norm(self.other_normal - normal, axis=-1)
        level = np.where(moot, np.nan, apart + tilt_quantile(self.missed) * self.other_sigma)
        return np.asarray(np.fmax.reduce(level, axis=1))


def log_probability(stat: FloatArray, dof: IntArray) -> FloatArray:
    """Logarithm of the probability that chi² of ``dof`` exceeds ``stat``; 0 without degrees of freedom."""
    from scipy.special import gammaincc, gammaln

    half, x = np.maximum(dof, 1) / 2.0, np.maximum(stat, 0.0) / 2.0
    far = x > 300.0 + half
    with np.errstate(divide="ignore"):
        near = np.log(gammaincc(half, np.where(far, 0.0, x)))
        # first terms of the asymptotic series of Γ(a, x)
        tail = (half - 1.0) * np.log(x) - x - gammaln(half) + np.log1p(np.where(far, (half - 1.0) / x, 0.0))
    return np.asarray(np.where(dof > 0, np.where(far, tail, near), 0.0))


def limit(probability: float | FloatArray, dof: IntArray) -> FloatArray:
    """Value that chi² of ``dof`` exceeds with ``probability``."""
    from scipy.special import chdtri

    return np.asarray(np.where(dof > 0, chdtri(np.maximum(dof, 1), probability), np.inf))


def noncentrality(threshold: FloatArray, dof: IntArray, missed: float) -> FloatArray:
    """Noncentrality at which a chi² of ``dof`` stays below ``threshold`` with probability ``missed``."""
    from scipy.special import chndtrinc

    out = np.full(dof.shape, np.inf)
    for d in np.unique(dof[dof > 0]):
        at = dof == d
        out[at] = chndtrinc(threshold[at][0], float(d), missed)
    return out


def largest_eigenvalue(matrix: FloatArray) -> FloatArray:
    """Larger eigenvalue of symmetric 2×2 matrices."""
    a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    return np.asarray(0.5 * (a + d) + np.sqrt(0.25 * (a - d) ** 2 + b * b))


def tilt_quantile(probability: float) -> float:
    """How many of its larger sigmas a two-dimensional normal error exceeds with at most ``probability``."""
    return float(np.sqrt(-2.0 * np.log(probability)))


def widened(poses: RigidPoses, left_out: BoolArray, level_rad: FloatArray, missed: float) -> RigidPoses:
    """Return poses whose covariance allows for what their protection levels do, where something was left out.

    Where one transmitter proved wrong, the others are no longer known to be right: the normal's standard deviation,
    whichever way, is at least that of an error which exceeds the level with probability ``missed``.

    Parameters
    ----------
    poses
    left_out : (mirror,)
        Where any transmitter or prior was.
    level_rad : (mirror,)
        Protection level; where it is infinite nothing is changed.
    missed
        Missed-detection probability of the level.
    """
    rows = np.flatnonzero(left_out & np.isfinite(level_rad) & np.isfinite(poses.cov).all(axis=(1, 2)))
    cov = np.array(poses.cov)
    axes = poses.rot_enu_from_mirror[rows][:, :, :2]
    size, way = np.linalg.eigh(np.swapaxes(axes, 1, 2) @ cov[rows, 3:, 3:] @ axes)
    lacking = np.maximum((level_rad[rows, None] / tilt_quantile(missed)) ** 2 - size, 0.0)
    turn = axes @ way
    cov[rows, 3:, 3:] += (turn * lacking[:, None]) @ np.swapaxes(turn, 1, 2)
    return replace(poses, cov=read_only(cov))


def quiet_median(x: FloatArray) -> FloatArray:
    """Median over the last axis without NaN; NaN where nothing is left."""
    ordered = np.sort(x, axis=-1)  # NaN last
    count = np.isfinite(x).sum(axis=-1)
    low, high = (np.maximum(k, 0)[..., None] for k in ((count - 1) // 2, np.minimum(count // 2, x.shape[-1] - 1)))
    middle = 0.5 * (np.take_along_axis(ordered, low, -1) + np.take_along_axis(ordered, high, -1))[..., 0]
    return np.asarray(np.where(count > 0, middle, np.nan))


def _like(rows: BoolArray, array: npt.NDArray[Any]) -> BoolArray:
    """Let (mirror,) broadcast against ``array``."""
    return rows.reshape((-1,) + (1,) * (array.ndim - 1))
