"""Rigid poses that notice what is wrong: test, find, leave out, solve again, and say what could still be hidden."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat.integrity.hypotheses import (
    PRIORS,
    Problem,
    Verdict,
    judge,
    largest_eigenvalue,
    limit,
    log_probability,
    noncentrality,
    quiet_median,
    tilt_quantile,
    widened,
)
from rfpose.multilat.rigid import Knowledge, MirrorProblem, RigidPoses, solve_rigid
from rfpose.multilat.status import PoseStatus

__all__ = ["GuardedPoses", "IntegrityStatus", "TransmitterStatus", "solve_with_integrity"]

BoolArray = npt.NDArray[np.bool_]
StatusArray = npt.NDArray[np.int8]
IntArray = npt.NDArray[np.int64]

# A simpler pattern of an error is believed unless what it leaves unexplained is less likely than this.
PATTERN_PROBABILITY = 1e-3
# Drop of chi² above which the residuals are those of a ruined pose, and tests on them mean little.
GROSS = 1e4
# Reported noise this many times the usual is called interference.
NOISY = 3.0


class IntegrityStatus(IntEnum):
    """What the tests say of one mirror; ``reason`` says it in words."""

    OK = 0
    EXCLUDED = 1
    PRIOR_REJECTED = 2
    AMBIGUOUS = 3
    NO_REDUNDANCY = 4
    UNEXPLAINED = 5
    NOT_SOLVED = 6

    @property
    def reason(self) -> str:
        """The status in words."""
        return _REASON[self]


_REASON = {
    IntegrityStatus.OK: "consistent",
    IntegrityStatus.EXCLUDED: "consistent after transmitters were left out",
    IntegrityStatus.PRIOR_REJECTED: "consistent after something known beforehand was left out: it contradicts the data",
    IntegrityStatus.AMBIGUOUS: "an error was found, but which of several causes it has cannot be told; the protection "
    "level covers them all",
    IntegrityStatus.NO_REDUNDANCY: "an error of some transmitter could tilt the normal without trace; more "
    "transmitters, a calibration or a surveyed pivot would help",
    IntegrityStatus.UNEXPLAINED: "residuals that leaving out a few transmitters or priors does not explain",
    IntegrityStatus.NOT_SOLVED: "no pose",
}


class TransmitterStatus(IntEnum):
    """What the tests say of one transmitter at one mirror; all from 2 on were left out."""

    OK = 0
    NOT_RECEIVED = 1
    COMMON_ERROR = 2
    ONE_RECEIVER = 3
    MULTIPATH = 4
    INTERFERENCE = 5

    @property
    def reason(self) -> str:
        """The status in words."""
        return (
            "used",
            "not received",
            "the same error at all receivers of the mirror: transmitter or its calibration off, or path blocked",
            "an error at one receiver only: blocked or reflected on the way there",
            "errors that differ between receivers: reflections",
            "noise far above the others' and an error beyond it: interference",
        )[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardedPoses:
    """Rigid poses with what the tests say of them; arrays are read-only.

    Attributes
    ----------
    poses
        After all exclusions; where there were any, the covariance is as wide as the protection level (`widened`). A
        pose whose ``status`` here is UNEXPLAINED keeps its numbers; they are not to be trusted.
    status : (mirror,)
        `IntegrityStatus` as int8.
    transmitter_status : (mirror, transmitter)
        `TransmitterStatus` as int8.
    used : (mirror, receiver, transmitter)
        Which were used in the end.
    prior_rejected : (mirror, prior)
        Which of `hypotheses.PRIORS` (pivot, mount, clocks) contradicts the data and was left out.
    prior_testable : (mirror, prior)
        Whether the data could contradict it at all.
    chi2_probability : (mirror,)
        Probability of larger residuals than those left, if nothing is wrong.
    protection_level_rad : (mirror,)
        With any one transmitter wrong by whatever amount, the normal is off by more than this, unnoticed, no more
        often than the missed-detection probability [rad, of the normal]; infinite where nothing protects it.
    worst_transmitter : (mirror,)
        The one that sets it; −1: another explanation of an error found, or no pose.
    """

    poses: RigidPoses
    status: StatusArray
    transmitter_status: StatusArray
    used: BoolArray
    prior_rejected: BoolArray
    prior_testable: BoolArray
    chi2_probability: FloatArray
    protection_level_rad: FloatArray
    worst_transmitter: IntArray

    @property
    def ok(self) -> BoolArray:
        """(mirror,) True where all that is left is consistent and the protection level finite."""
        return np.asarray(np.isfinite(self.protection_level_rad))

    def reasons(self) -> tuple[str, ...]:
        """Each mirror's status in words, with transmitters and priors by name."""
        return tuple(self._reason(m) for m in range(len(self.status)))

    def _reason(self, m: int) -> str:
        parts = [IntegrityStatus(self.status[m]).reason]
        for i in np.flatnonzero(self.transmitter_status[m] > TransmitterStatus.NOT_RECEIVED):
            parts.append(f"transmitter {i}: {TransmitterStatus(self.transmitter_status[m, i]).reason}")
        parts += [f"prior rejected: {name}" for name, no in zip(PRIORS, self.prior_rejected[m], strict=True) if no]
        return "; ".join(parts)


def solve_with_integrity(
    problem: MirrorProblem,
    *,
    false_alarm: float = 1e-2,
    missed_detection: float = 1e-3,
    max_excluded: int = 4,
) -> GuardedPoses:
    """Solve rigid poses, leave out what contradicts the rest, and bound what could be wrong unnoticed.

    Parameters
    ----------
    problem
        As for `rfpose.multilat.rigid.solve_rigid`.
    false_alarm
        Probability that a mirror without any error is not found OK. Half of it goes to chi² of all residuals, half
        is shared by the single tests.
    missed_detection
        Probability of the protection level.
    max_excluded
        Transmitters and priors to leave out of one mirror, at most; 0 only tests.

    Raises
    ------
    InvalidInputError
        A probability outside (0, 1), a negative ``max_excluded``.
    """
    for name, value in (("false_alarm", false_alarm), ("missed_detection", missed_detection)):
        if not 0.0 < value < 1.0:
            raise InvalidInputError(f"`{name}` must lie between 0 and 1, got {value}")
    if max_excluded < 0:
        raise InvalidInputError(f"`max_excluded` must not be negative, got {max_excluded}")
    guard = _Guard(problem, solve_rigid(problem), false_alarm, missed_detection)
    guard.run(max_excluded)
    guard.take_back()
    return guard.result()


class _Guard:
    """State of the loop over all mirrors."""

    def __init__(self, given: MirrorProblem, poses: RigidPoses, false_alarm: float, missed: float) -> None:
        n_mirror, _, n_receiver, n_transmitter = given.range_m.shape
        self.given = given
        self.problem = problem = Problem.of(given)
        self.poses = {f.name: np.array(getattr(poses, f.name)) for f in fields(RigidPoses)}
        self.global_alarm = false_alarm / 2.0
        self.single_alarm = false_alarm / 2.0 / (n_transmitter * (1 + n_receiver) + len(PRIORS))
        self.missed = missed
        self.status = np.full(n_mirror, IntegrityStatus.NOT_SOLVED, np.int8)
        self.status[poses.status == PoseStatus.OK] = IntegrityStatus.OK
        self.transmitter_status = np.zeros((n_mirror, n_transmitter), np.int8)
        received = np.any(problem.weight > 0.0, axis=(1, 2))
        self.transmitter_status[~received] = TransmitterStatus.NOT_RECEIVED
        self.testable = np.zeros((n_mirror, len(PRIORS)), np.bool_)
        self.probability = np.full(n_mirror, np.nan)
        self.own_level = np.full(n_mirror, np.inf)
        self.worst = np.full(n_mirror, -1, np.int64)
        self.original = given.equations.weight
        # what was left out, in order: mirrors, hypothesis, receiver (−1: all)
        self.history: list[tuple[IntArray, IntArray, IntArray]] = []
        # other explanations of what was found: normal and its uncertainty if that had been left out instead
        n_hypothesis = n_transmitter + len(PRIORS)
        self.other_normal = np.full((n_mirror, n_hypothesis, 3), np.nan)
        self.other_sigma = np.full((n_mirror, n_hypothesis), np.nan)

    # -- solving

    def _known(self, rows: IntArray, dropped: BoolArray) -> Knowledge:
        known = self.problem.known
        if known.pivot_enu_m is not None:
            known = replace(known, pivot_enu_m=None if dropped[0] else known.pivot_enu_m[rows])
        if dropped[1]:
            known = replace(known, two_axis=False)
        if dropped[2]:
            known = replace(known, clock_sigma_m=np.inf)
        return known

    def _solve(
        self, rows: IntArray, weight: FloatArray, dropped: BoolArray, *, from_start: bool = False
    ) -> dict[str, npt.NDArray[Any]]:
        """Solve some mirrors with other weights and priors, from where they are or from their first start."""
        out: dict[str, npt.NDArray[Any]] = {k: v[rows].copy() for k, v in self.poses.items()}
        for pattern in np.unique(dropped, axis=0):
            at = np.flatnonzero((dropped == pattern).all(axis=1))
            pick = rows[at]
            some = self.given.take(pick)
            left = np.where(weight[at] > 0.0, some.range_m, np.nan)
            some = replace(some, range_m=left, knowledge=self._known(pick, pattern))
            if not from_start:
                some = some.started(self.poses["pivot_enu_m"][pick], self.poses["rot_enu_from_mirror"][pick])
            poses = solve_rigid(some)
            for name, array in out.items():
                array[at] = getattr(poses, name)
        return out

    def _accept(
        self, rows: IntArray, weight: FloatArray, dropped: BoolArray, poses: dict[str, npt.NDArray[Any]]
    ) -> None:
        self.problem.weight[rows] = weight
        self.problem.dropped[rows] = dropped
        for name, array in poses.items():
            self.poses[name][rows] = array

    def _as_poses(self, arrays: dict[str, npt.NDArray[Any]]) -> RigidPoses:
        return RigidPoses(**arrays)

    # -- testing

    def _alarm(self, problem: Problem, verdict: Verdict, chi2: FloatArray) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Whether anything is wrong; log-probabilities of all hypotheses; of chi²."""
        dof = problem.dof()
        overall = log_probability(chi2, dof)
        single = log_probability(verdict.stat, verdict.dof)
        links = log_probability(verdict.link, verdict.link_dof)
        alarm = overall < np.log(self.global_alarm)
        alarm |= (single < np.log(self.single_alarm)).any(axis=1)
        alarm |= (links < np.log(self.single_alarm)).any(axis=(1, 2))
        return np.asarray(alarm), single, overall

    def run(self, max_excluded: int) -> None:
        """Test; leave out the likeliest culprit; solve again; until all is consistent or nothing helps."""
        started = self.given.has_start
        lost = np.flatnonzero((self.poses["status"] == PoseStatus.NOT_CONVERGED) & started)
        rows = np.flatnonzero(self.status != IntegrityStatus.NOT_SOLVED)
        for step in range(max_excluded + 1):
            bad, verdict, single = self._test(rows)
            if step == max_excluded:
                return
            gross = verdict.stat.max(axis=1, initial=0.0) > GROSS
            found = self._try_each(np.concatenate([rows[bad[gross]], lost]))
            rest = np.flatnonzero(~gross)
            rows = np.concatenate([found, self._leave_out(rows[bad[rest]], _pick(verdict, rest), single[rest])])
            lost = lost[:0]

    def _test(self, rows: IntArray) -> tuple[IntArray, Verdict, FloatArray]:
        """Test mirrors and note what comes out; return which fail, and their statistics."""
        problem = self.problem.rows(rows)
        poses = {k: v[rows] for k, v in self.poses.items()}
        verdict = judge(problem, self._as_poses(poses))
        alarm, single, overall = self._alarm(problem, verdict, np.asarray(poses["chi2"], np.float64))
        self.probability[rows] = np.exp(overall)
        self.testable[rows] |= verdict.dof[:, -len(PRIORS) :] > 0
        self._protect(rows, verdict)
        bad = np.flatnonzero(alarm)
        self.status[rows[bad]] = IntegrityStatus.UNEXPLAINED
        return bad, _pick(verdict, bad), single[bad]

    def _try_each(self, rows: IntArray) -> IntArray:
        """Leave out each transmitter and prior in turn, from the first start, and keep what fits best.

        For errors so large that the pose they lead to says nothing of them. Returns the mirrors that were solved.
        """
        if not rows.size:
            return rows
        n_transmitter = len(self.problem.transmitter)
        before, dropped_before = self.problem.weight[rows].copy(), self.problem.dropped[rows].copy()
        used = np.concatenate([(before > 0.0).any(axis=(1, 2)), self.problem.rows(rows).has_prior], axis=1)
        best, choice = np.full(len(rows), np.inf), np.full(len(rows), -1)
        for h in range(used.shape[1]):
            at = np.flatnonzero(used[:, h])
            weight, dropped = before[at].copy(), dropped_before[at].copy()
            if h < n_transmitter:
                weight[..., h] = 0.0
            else:
                dropped[:, h - n_transmitter] = True
            poses = self._solve(rows[at], weight, dropped, from_start=True)
            chi2 = np.where(poses["status"] == PoseStatus.OK, np.asarray(poses["chi2"], np.float64), np.inf)
            better = np.flatnonzero(chi2 < best[at])
            best[at[better]], choice[at[better]] = chi2[better], h
            self._accept(rows[at[better]], weight[better], dropped[better], {k: v[better] for k, v in poses.items()})
        found = np.flatnonzero(choice >= 0)
        rows, choice = rows[found], choice[found]
        receiver = np.full(len(rows), -1)
        of_transmitter = np.flatnonzero(choice < n_transmitter)
        if of_transmitter.size:
            receiver[of_transmitter] = self._name_gross(rows[of_transmitter], choice[of_transmitter])
        self.history.append((rows, choice, receiver))
        self._mark(rows)
        return rows

    def _mark(self, rows: IntArray) -> None:
        """Status of mirrors from which something was left out."""
        left = self.problem.dropped[rows].any(axis=1)
        self.status[rows] = np.where(left, IntegrityStatus.PRIOR_REJECTED, IntegrityStatus.EXCLUDED)

    def _name_gross(self, rows: IntArray, who: IntArray) -> IntArray:
        """Name the pattern of errors seen from a pose without them; use the other receivers if only one is wrong."""
        left, sigma = self._left(rows, who)
        free = np.isinf(sigma)
        own = self.original[rows, :, :, who]
        middle = quiet_median(np.where(own > 0.0, left, np.nan))[..., None]
        left = np.where(free, left - middle, left)
        size = np.where(own > 0.0, np.abs(left), 0.0)
        with np.errstate(divide="ignore"):
            small = 10.0 * np.where(free, own**-0.5, np.hypot(own**-0.5, sigma))
        clear = np.any(size > small, axis=1)
        apart = np.max(np.where(own > 0.0, np.abs(left - middle), 0.0), axis=(1, 2))
        common = np.all(clear, axis=1) & (apart < 0.05 * size.max(axis=(1, 2)))
        one = clear.sum(axis=1) == 1
        cause = np.where(
            one,
            TransmitterStatus.ONE_RECEIVER,
            np.where(common, TransmitterStatus.COMMON_ERROR, TransmitterStatus.MULTIPATH),
        )
        self.transmitter_status[rows, who] = cause
        receiver = np.where(one, np.argmax(clear, axis=1), -1)
        at = np.flatnonzero(one)
        if at.size:
            weight = self.problem.weight[rows[at]].copy()
            for k, m in enumerate(at):
                weight[k, :, :, who[m]] = self.original[rows[m], :, :, who[m]]
                weight[k, :, receiver[m], who[m]] = 0.0
            dropped = self.problem.dropped[rows[at]]
            poses = self._solve(rows[at], weight, dropped)
            good = np.flatnonzero(
                (poses["status"] == PoseStatus.OK) & (poses["chi2"] < self.poses["chi2"][rows[at]] + 0.1 * GROSS)
            )
            self._accept(rows[at[good]], weight[good], dropped[good], {k: v[good] for k, v in poses.items()})
        return np.asarray(receiver)

    def _left(self, rows: IntArray, who: IntArray) -> tuple[FloatArray, FloatArray]:
        """(mirror, group, receiver) range less distance and clock of one transmitter a mirror; its own sigma."""
        pivot, rot, clock = (self.poses[k][rows] for k in ("pivot_enu_m", "rot_enu_from_mirror", "clock_m"))
        receiver = pivot[:, None] + np.einsum("mab,mrb->mra", rot, self.problem.places[rows])
        distance = np.linalg.norm(receiver - self.problem.transmitter[who][:, None], axis=-1)
        left = self.problem.z[rows, :, :, who] - distance[:, None] - clock[:, self.problem.classes]
        return left, _sigma(self.problem.bias_info[rows, :, who])[:, :, None]

    def _leave_out(self, rows: IntArray, verdict: Verdict, single: FloatArray) -> IntArray:
        """Leave out each mirror's likeliest culprit; return the mirrors that could be solved without."""
        if not rows.size:
            return rows
        n_transmitter = len(self.problem.transmitter)
        choice = np.argmin(single, axis=1)
        at = np.arange(len(rows))
        weight, dropped = self.problem.weight[rows].copy(), self.problem.dropped[rows].copy()
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
        self._remember_others(rows[solved], _pick(verdict, solved), choice[solved])
        self._accept(
            rows[solved], weight[solved], dropped[solved], {name: array[solved] for name, array in poses.items()}
        )
        self.history.append((rows[solved], choice[solved], receiver[solved]))
        marked = solved[~is_prior[solved]]
        self.transmitter_status[rows[marked], who[marked]] = cause[marked]
        self._mark(rows[solved])
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
        noisy = self._noisy(rows, who)
        cause = np.where(noisy, TransmitterStatus.INTERFERENCE, cause).astype(np.int8)
        return cause, np.where(link_fits & ~noisy, receiver, -1)

    def _noisy(self, rows: IntArray, who: IntArray) -> BoolArray:
        """Whether a transmitter's reported noise is far above that of the mirror's others."""
        weight = self.problem.weight[rows]
        with np.errstate(divide="ignore"):
            sigma = np.where(weight > 0.0, weight**-0.5, np.nan)
        usual = quiet_median(sigma.reshape(*sigma.shape[:2], -1))
        own = sigma[np.arange(len(rows)), :, :, who]
        return np.asarray((own > NOISY * usual[:, :, None]).any(axis=(1, 2)))

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
        for rows, choice, receiver in self.history[:-1]:
            count = self._n_left_out(rows)
            again = np.flatnonzero(
                (count > 1) & np.isin(self.status[rows], (IntegrityStatus.EXCLUDED, IntegrityStatus.PRIOR_REJECTED))
            )
            if again.size:
                self._try_back(rows[again], choice[again], receiver[again])

    def _n_left_out(self, rows: IntArray) -> IntArray:
        left_out = self.transmitter_status[rows] > TransmitterStatus.NOT_RECEIVED
        return np.asarray(left_out.sum(axis=1) + self.problem.dropped[rows].sum(axis=1))

    def _try_back(self, rows: IntArray, choice: IntArray, receiver: IntArray) -> None:
        n_transmitter = len(self.problem.transmitter)
        weight, dropped = self.problem.weight[rows].copy(), self.problem.dropped[rows].copy()
        at = np.arange(len(rows))
        is_prior = choice >= n_transmitter
        dropped[at[is_prior], choice[is_prior] - n_transmitter] = False
        for k in at[~is_prior]:
            weight[k, :, :, choice[k]] = self.original[rows[k], :, :, choice[k]]
        poses = self._solve(rows, weight, dropped)
        problem = replace(self.problem.rows(rows), weight=weight, dropped=dropped)
        solved = poses["status"] == PoseStatus.OK
        safe = {name: np.where(_like(solved, v), v, self.poses[name][rows]) for name, v in poses.items()}
        verdict = judge(problem, self._as_poses(safe))
        alarm, _, overall = self._alarm(problem, verdict, np.asarray(safe["chi2"], np.float64))
        good = np.flatnonzero(solved & verdict.ok & ~alarm)
        self._accept(rows[good], weight[good], dropped[good], {k: v[good] for k, v in safe.items()})
        self.probability[rows[good]] = np.exp(overall[good])
        self._protect(rows[good], _pick(verdict, good))
        back = good[~is_prior[good]]
        self.transmitter_status[rows[back], choice[back]] = TransmitterStatus.OK
        self._mark(rows[good])

    # -- protection

    def _protect(self, rows: IntArray, verdict: Verdict) -> None:
        """Protection level against one more faulty transmitter."""
        n_transmitter = len(self.problem.transmitter)
        dof = verdict.dof[:, :n_transmitter]
        spread = np.sqrt(largest_eigenvalue(verdict.spread_rad2[:, :n_transmitter]))
        hidden_bias = np.sqrt(noncentrality(limit(self.single_alarm, dof), dof, self.missed))
        with np.errstate(invalid="ignore"):
            bias = np.where(dof > 0, hidden_bias * spread, 0.0)
        bias[verdict.hidden[:, :n_transmitter]] = np.inf
        noise = tilt_quantile(self.missed) * np.sqrt(largest_eigenvalue(verdict.cov_rad2))
        self.own_level[rows] = np.where(verdict.ok, bias.max(axis=1) + noise, np.inf)
        self.worst[rows] = np.argmax(bias, axis=1)

    def result(self) -> GuardedPoses:
        """Put everything together."""
        others = self._others()
        level = np.fmax(self.own_level, others)
        ambiguous = others > self.own_level
        explained = np.isin(self.status, (IntegrityStatus.EXCLUDED, IntegrityStatus.PRIOR_REJECTED))
        self.status[ambiguous & explained] = IntegrityStatus.AMBIGUOUS
        unprotected = np.isin(self.status, (IntegrityStatus.UNEXPLAINED, IntegrityStatus.NOT_SOLVED))
        level[unprotected] = np.inf
        self.status[np.isinf(level) & ~unprotected] = IntegrityStatus.NO_REDUNDANCY
        worst = np.where(ambiguous | unprotected, -1, self.worst)
        poses = RigidPoses(**{name: read_only(array) for name, array in self.poses.items()})
        left_out: BoolArray = np.asarray(self._n_left_out(np.arange(len(level))) > 0)
        return GuardedPoses(
            poses=widened(poses, left_out, level, self.missed),
            status=read_only(self.status),
            transmitter_status=read_only(self.transmitter_status),
            used=read_only(np.asarray((self.problem.weight > 0.0).any(axis=1))),
            prior_rejected=read_only(self.problem.dropped),
            prior_testable=read_only(self.testable),
            chi2_probability=read_only(self.probability),
            protection_level_rad=read_only(level),
            worst_transmitter=read_only(worst),
        )

    def _others(self) -> FloatArray:
        """Protection level against the error found having another cause; NaN where none is likely."""
        moot = np.concatenate([self.transmitter_status > TransmitterStatus.NOT_RECEIVED, self.problem.dropped], axis=1)
        normal = self.poses["rot_enu_from_mirror"][:, None, :, 2]
        apart = np.linalg.norm(self.other_normal - normal, axis=-1)
        level = np.where(moot, np.nan, apart + tilt_quantile(self.missed) * self.other_sigma)
        return np.asarray(np.fmax.reduce(level, axis=1))


def _sigma(bias_info: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore"):
        return np.asarray(bias_info**-0.5)


def _like(rows: BoolArray, array: npt.NDArray[Any]) -> BoolArray:
    """Let (mirror,) broadcast against ``array``."""
    return rows.reshape((-1,) + (1,) * (array.ndim - 1))


def _pick(verdict: Verdict, index: IntArray) -> Verdict:
    return Verdict(**{f.name: getattr(verdict, f.name)[index] for f in fields(Verdict)})
