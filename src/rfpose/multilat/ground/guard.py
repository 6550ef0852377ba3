"""Tests of poses where planes reflect: leave out each transmitter in turn, name the culprit, bound what is hidden.

The slopes of two-ray ranges change within a wavelength of the carrier, so that the hypotheses are not linearised: each
mirror is solved again without each transmitter, coefficients held where all mirrors together have put them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.ground._problem import GroundProblem
from rfpose.multilat.ground.solve import GroundSolution, turns
from rfpose.multilat.integrity.guard import Guard
from rfpose.multilat.integrity.records import Alarms, GuardedPoses, TransmitterStatus, Verdict
from rfpose.multilat.rigid.pose import RigidFits
from rfpose.multilat.rigid.problem import PRIORS
from rfpose.multilat.status import PoseStatus, has_start

__all__ = ["guard_with_ground"]

IntArray = npt.NDArray[np.int64]

_ALIKE = 0.1
"""Residuals that differ by less, relative to the largest, are called common."""


def guard_with_ground(solution: GroundSolution, alarms: Alarms | None = None) -> GuardedPoses:
    """Test two-ray poses, leave out what contradicts the rest, and bound what could be wrong unnoticed.

    Parameters
    ----------
    solution
        From `rfpose.multilat.ground.solve_with_ground`.
    alarms
        When to speak up.

    Returns
    -------
    GuardedPoses
        Hypotheses are whole transmitters and the surveyed pivot; mount and clocks count as not testable. Covariances
        count that coefficients were estimated.
    """
    guard = _Guard(solution, alarms or Alarms())
    guard.run()
    return guard.result()


class _Guard(Guard):
    """Hypotheses are solved, one after the other."""

    def __init__(self, solution: GroundSolution, alarms: Alarms) -> None:
        n_transmitter = solution.problem.mirrors.z.shape[3]
        super().__init__(solution.poses, solution.problem.mirrors, alarms, n_transmitter + 1)
        self.solution = solution
        self.state = solution.state.copy()
        # the covariance of the solution counts the coefficients, that of the state does not
        self.extra_cov = solution.full_cov - solution.state.cov
        self.tested: IntArray = np.zeros(0, np.int64)
        self.tried: list[tuple[RigidFits, IntArray]] = []

    def _without(self, rows: IntArray, h: int) -> tuple[GroundProblem, IntArray]:
        """Problem of some mirrors without a transmitter or the pivot; how many degrees of freedom that frees."""
        weight, dropped = self.without(rows, h)
        problem = self.solution.problem.take(rows)
        prior = problem.mirrors.prior
        info = np.where(dropped[:, 0, None, None], 0.0, prior.pivot_info)
        arrays = problem.mirrors._replace(weight=weight, prior=prior._replace(pivot_info=info))
        if h >= self.n_transmitter:
            count = 3 * (np.any(prior.pivot_info > 0.0, axis=(1, 2)) & ~self.dropped[rows, 0])
        else:
            seen = self.weight[rows][..., h] > 0.0
            free = np.equal(problem.mirrors.bias_info[..., h], 0.0)
            count = seen.sum(axis=(1, 2)) - (seen.any(axis=2) & free).sum(axis=1)
        return replace(problem, mirrors=arrays), np.asarray(count)

    def judge(self, rows: IntArray) -> Verdict:
        n, n_transmitter, n_receiver = len(rows), self.n_transmitter, self.weight.shape[2]
        n_hypothesis = n_transmitter + len(PRIORS)
        stat, dof = np.zeros((n, n_hypothesis)), np.zeros((n, n_hypothesis), np.int64)
        spread = np.zeros((n, n_hypothesis, 2, 2))
        hidden = np.zeros((n, n_hypothesis), np.bool_)
        # poses without each, for those that will be left out
        self.tested, self.tried = rows, []
        own = self.state.take(rows)
        before = _tilt_covariance(own)
        for h in range(n_transmitter + 1):
            problem, count = self._without(rows, h)
            state = own.copy()
            problem.fit(state, self.solution.parameter)
            # a pose that a gross error has ruined is no place to begin: fits that do not help begin again around it
            self._retry(problem, state, rows)
            self.tried.append((state, count))
            added = _tilt_covariance(state) - before
            solved = (state.status == PoseStatus.OK) & np.isfinite(added).all(axis=(1, 2)) & (count > 0)
            drop = np.maximum(own.chi2 - state.chi2, 0.0)
            stat[solved, h], dof[solved, h], spread[solved, h] = drop[solved], count[solved], added[solved]
            hidden[:, h] = ~solved & (count != 0)
        own.cov[:] += self.extra_cov[rows]
        common, link = np.zeros((n, n_transmitter)), np.zeros((n, n_receiver, n_transmitter))
        return Verdict(
            ok=np.ones(n, np.bool_), stat=stat, dof=dof, hidden=hidden, shift_rad=np.zeros((n, n_hypothesis, 2)),
            spread_rad2=spread, cov_rad2=_tilt_covariance(own), common=common, common_dof=common.astype(np.int64),
            link=link, link_dof=link.astype(np.int64),
        )  # fmt: skip

    def _retry(self, problem: GroundProblem, state: RigidFits, rows: IntArray) -> None:
        dof = np.maximum(self.poses["dof"][rows], 1.0)
        ruined = np.flatnonzero(
            ~has_start(state.status) | (state.chi2 > 30.0 * dof) & (self.state.chi2[rows] > 30.0 * dof)
        )
        if not ruined.size:
            return
        again = self.state.take(rows[ruined])
        problem.take(ruined).fit(
            again, self.solution.parameter, turn=turns()[:24], enough=3.0 * dof[ruined], max_iteration=15
        )
        better = np.flatnonzero((again.status == PoseStatus.OK) & ~(state.chi2[ruined] <= again.chi2))
        state.put(ruined[better], again.take(better))

    def leave_out(self, rows: IntArray, verdict: Verdict, single: FloatArray) -> IntArray:
        choice = np.argmin(single, axis=1)
        helps = single[np.arange(len(rows)), choice] < np.log(self.single_alarm)
        for h in np.unique(choice[helps]):
            at = np.isin(self.tested, rows[helps & (choice == h)])
            fits, count = self.tried[h]
            self._leave_out(self.tested[at], int(h), fits.take(np.flatnonzero(at)), count[at])
        return np.asarray(rows[helps])

    def _leave_out(self, rows: IntArray, h: int, fits: RigidFits, count: IntArray) -> None:
        """Accept poses without one transmitter or the pivot."""
        who = np.full(len(rows), h)
        noisy = self.noisy(rows, who) if h < self.n_transmitter else None
        self.state.put(rows, fits)
        poses = {
            "pivot_enu_m": fits.pivot,
            "rot_enu_from_mirror": fits.rot,
            "clock_m": fits.clock,
            "cov": (fits.cov + self.extra_cov[rows])[:, :6, :6],
            "chi2": fits.chi2,
            "dof": self.poses["dof"][rows] - count,
        }
        self.accept(rows, *self.without(rows, h), poses)
        if noisy is not None:
            predicted, _ = self.solution.problem.take(rows).predict(fits, self.solution.parameter)
            cause, _ = self.pattern(rows, who, predicted[..., h], alike=_ALIKE)
            self.transmitter_status[rows, h] = np.where(noisy, TransmitterStatus.INTERFERENCE, cause)
        self.mark(rows)


def _tilt_covariance(fits: RigidFits) -> FloatArray:
    """Covariance of the rotation about the mirror's own x and y axes (mirror, 2, 2)."""
    axes = fits.rot[:, :, :2]
    return np.asarray(np.einsum("mac,mab,mbd->mcd", axes, fits.cov[:, 3:6, 3:6], axes))
