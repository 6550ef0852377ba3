"""Rigid poses that notice what is wrong: test, find, leave out, solve again, and say what could still be hidden."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.integrity.guard import Alarms, Guard, GuardedPoses, IntegrityStatus, TransmitterStatus
from rfpose.multilat.integrity.hypotheses import (
    Verdict,
    judge,
    largest_eigenvalue,
    limit,
    log_probability,
    tilt_quantile,
)
from rfpose.multilat.rigid import MirrorProblem, RigidPoses, solve_rigid
from rfpose.multilat.rigid.problem import PRIORS
from rfpose.multilat.status import PoseStatus

__all__ = ["solve_with_integrity"]

BoolArray = npt.NDArray[np.bool_]
StatusArray = npt.NDArray[np.int8]
IntArray = npt.NDArray[np.int64]
Arrays = dict[str, npt.NDArray[Any]]

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
    guard = _Guard(problem, alarms or Alarms())
    guard.run()
    guard.take_back()
    return guard.result()


class _Guard(Guard):
    """Hypotheses are linearised: the drop of chi² that each would bring, from one solution."""

    def __init__(self, given: MirrorProblem, alarms: Alarms) -> None:
        n_mirror, _, n_receiver, n_transmitter = given.range_m.shape
        poses = solve_rigid(given)
        super().__init__(poses, given.equations, alarms, n_transmitter * (1 + n_receiver) + len(PRIORS))
        self.given = given
        # mirrors that only something left out may let converge
        self.lost = np.flatnonzero((poses.status == PoseStatus.NOT_CONVERGED) & given.has_start)
        # what was left out, in order: mirrors, hypothesis
        self.history: list[tuple[IntArray, IntArray]] = []
        # other explanations of what was found: normal and its uncertainty if that had been left out instead
        n_hypothesis = n_transmitter + len(PRIORS)
        self.other_normal = np.full((n_mirror, n_hypothesis, 3), np.nan)
        self.other_sigma = np.full((n_mirror, n_hypothesis), np.nan)

    # -- solving

    def _problem(self, rows: IntArray, weight: FloatArray, dropped: BoolArray) -> MirrorProblem:
        some = self.given.take(rows)
        return replace(some, range_m=np.where(weight > 0.0, some.range_m, np.nan), dropped=dropped)

    def _solve(self, rows: IntArray, weight: FloatArray, dropped: BoolArray, *, from_start: bool = False) -> Arrays:
        """Solve some mirrors with other weights and priors, from where they are or from their first start."""
        some = self._problem(rows, weight, dropped)
        if not from_start:
            some = some.started(self.poses["pivot_enu_m"][rows], self.poses["rot_enu_from_mirror"][rows])
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
        has_prior = self._problem(rows, before, dropped_before).has_prior
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


def _like(rows: BoolArray, array: npt.NDArray[Any]) -> BoolArray:
    """Let (mirror,) broadcast against ``array``."""
    return rows.reshape((-1,) + (1,) * (array.ndim - 1))
