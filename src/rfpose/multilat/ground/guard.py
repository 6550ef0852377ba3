"""Tests of poses where planes reflect: leave out each transmitter in turn, name the culprit, bound what is hidden.

The slopes of two-ray ranges change within a wavelength of the carrier, so that the hypotheses are not linearised: each
mirror is solved again without each transmitter, coefficients held where all mirrors together have put them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat.ground._problem import Problem, State
from rfpose.multilat.ground.solve import GroundSolution, turns
from rfpose.multilat.integrity.exclusion import NOISY, GuardedPoses, IntegrityStatus, TransmitterStatus
from rfpose.multilat.integrity.hypotheses import (
    PRIORS,
    largest_eigenvalue,
    limit,
    log_probability,
    noncentrality,
    quiet_median,
    tilt_quantile,
    widened,
)
from rfpose.multilat.rigid import RigidPoses
from rfpose.multilat.status import PoseStatus, has_start

__all__ = ["guard_with_ground"]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

_PIVOT = PRIORS.index("pivot")
_CLEAR = 10.0
"""Sigmas from which a receiver's residual of an excluded transmitter counts for the pattern of the error."""
_ALIKE = 0.1
"""Residuals that differ by less, relative to the largest, are called common."""


def guard_with_ground(
    solution: GroundSolution,
    *,
    false_alarm: float = 1e-2,
    missed_detection: float = 1e-3,
    max_excluded: int = 4,
) -> GuardedPoses:
    """Test two-ray poses, leave out what contradicts the rest, and bound what could be wrong unnoticed.

    Parameters
    ----------
    solution
        From `rfpose.multilat.ground.solve_with_ground`.
    false_alarm, missed_detection, max_excluded
        As in `rfpose.multilat.integrity.solve_with_integrity`.

    Returns
    -------
    GuardedPoses
        Hypotheses are whole transmitters and the surveyed pivot; mount and clocks count as not testable. Covariances
        count that coefficients were estimated.

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
    guard = _Guard(solution, false_alarm, missed_detection)
    rows = np.flatnonzero(guard.state.status == 0)
    for step in range(max_excluded + 1):
        rows = guard.test(rows, leave_out=step < max_excluded)
        if not rows.size:
            break
    return guard.result()


class _Guard:
    """State of the loop over all mirrors."""

    def __init__(self, solution: GroundSolution, false_alarm: float, missed: float) -> None:
        self.solution = solution
        mirrors = solution.problem.mirrors
        self.problem = replace(
            solution.problem,
            mirrors=mirrors._replace(weight=mirrors.weight.copy(), pivot_info=mirrors.pivot_info.copy()),
        )
        self.state = solution.state.copy()
        # the covariance of the solution counts the coefficients, that of the state does not
        self.extra_cov = solution.full_cov - solution.state.cov
        n_mirror, _, _, n_transmitter = self.problem.mirrors.z.shape
        self.global_alarm = false_alarm / 2.0
        self.single_alarm = false_alarm / 2.0 / (n_transmitter + 1)
        self.missed = missed
        self.dof = solution.poses.dof.copy()
        self.status = np.full(n_mirror, IntegrityStatus.NOT_SOLVED, np.int8)
        self.status[self.state.status == 0] = IntegrityStatus.OK
        self.transmitter_status = np.zeros((n_mirror, n_transmitter), np.int8)
        received = np.any(self.problem.mirrors.weight > 0.0, axis=(1, 2))
        self.transmitter_status[~received] = TransmitterStatus.NOT_RECEIVED
        self.dropped = np.zeros((n_mirror, len(PRIORS)), np.bool_)
        self.testable = np.zeros((n_mirror, len(PRIORS)), np.bool_)
        self.probability = np.full(n_mirror, np.nan)
        self.level = np.full(n_mirror, np.inf)
        self.worst = np.full(n_mirror, -1, np.int64)

    def test(self, rows: IntArray, *, leave_out: bool) -> IntArray:
        """Test mirrors; return those from which something was left out, to be tested again."""
        n_transmitter = self.transmitter_status.shape[1]
        stat, dof, spread, states = self._hypotheses(rows)
        overall = log_probability(self.state.chi2[rows], np.rint(self.dof[rows]).astype(np.int64))
        single = log_probability(stat, dof)
        self.probability[rows] = np.exp(overall)
        self.testable[rows, _PIVOT] |= dof[:, n_transmitter] > 0
        self._protect(rows, dof[:, :n_transmitter], spread[:, :n_transmitter])
        bad = np.flatnonzero((overall < np.log(self.global_alarm)) | (single < np.log(self.single_alarm)).any(axis=1))
        self.status[rows[bad]] = IntegrityStatus.UNEXPLAINED
        if not leave_out or not bad.size:
            return rows[:0]
        choice = np.argmin(single[bad], axis=1)
        helps = single[bad, choice] < np.log(self.single_alarm)
        bad, choice = bad[helps], choice[helps]
        for h in np.unique(choice):
            at = bad[choice == h]
            self._leave_out(rows[at], int(h), states[h].take(at))
        return np.asarray(rows[bad])

    def _hypotheses(self, rows: IntArray) -> tuple[FloatArray, IntArray, FloatArray, list[State]]:
        """Drop of chi², degrees of freedom and added tilt covariance without each transmitter and the pivot."""
        n_transmitter = self.transmitter_status.shape[1]
        n_hypothesis = n_transmitter + 1
        stat, dof = np.zeros((len(rows), n_hypothesis)), np.zeros((len(rows), n_hypothesis), np.int64)
        spread = np.full((len(rows), n_hypothesis, 2, 2), np.inf)
        states = []
        before = _tilt_covariance(self.state.take(rows))
        for h in range(n_hypothesis):
            problem, count = self._without(rows, h)
            state = self.state.take(rows)
            problem.fit(state, self.solution.parameter)
            # a pose that a gross error has ruined is no place to begin: fits that do not help begin again around it
            self._retry(problem, state, rows)
            states.append(state)
            solved = (state.status == 0) & (count > 0)
            stat[:, h] = np.where(solved, np.maximum(self.state.chi2[rows] - state.chi2, 0.0), 0.0)
            dof[:, h] = np.where(solved, count, 0)
            spread[:, h] = np.where(solved[:, None, None], _tilt_covariance(state) - before, np.inf)
            spread[count == 0, h] = 0.0
        return stat, dof, spread, states

    def _retry(self, problem: Problem, state: State, rows: IntArray) -> None:
        dof = np.maximum(self.dof[rows], 1.0)
        ruined = np.flatnonzero(
            ~has_start(state.status) | (state.chi2 > 30.0 * dof) & (self.state.chi2[rows] > 30.0 * dof)
        )
        if not ruined.size:
            return
        again = self.state.take(rows[ruined])
        problem.take(ruined).fit(
            again, self.solution.parameter, turn=turns()[:24], enough=3.0 * dof[ruined], max_iteration=15
        )
        better = np.flatnonzero((again.status == 0) & ~(state.chi2[ruined] <= again.chi2))
        state.put(ruined[better], again.take(better))

    def _without(self, rows: IntArray, h: int) -> tuple[Problem, IntArray]:
        """Problem of some mirrors without one transmitter or the pivot; how many degrees of freedom that frees."""
        problem = self.problem.take(rows)
        mirrors = problem.mirrors
        if h == self.transmitter_status.shape[1]:
            given = np.any(mirrors.pivot_info > 0.0, axis=(1, 2))
            return replace(problem, mirrors=mirrors._replace(pivot_info=np.zeros_like(mirrors.pivot_info))), 3 * given
        weight = mirrors.weight.copy()
        seen = weight[..., h] > 0.0
        free = np.asarray(mirrors.bias_info[..., h] == 0.0)
        count = seen.sum(axis=(1, 2)) - (seen.any(axis=2) & free).sum(axis=1)
        weight[..., h] = 0.0
        return replace(problem, mirrors=mirrors._replace(weight=weight)), np.asarray(count)

    def _leave_out(self, rows: IntArray, h: int, state: State) -> None:
        """Accept the pose without one transmitter or the pivot."""
        problem, count = self._without(rows, h)
        self.state.put(rows, state)
        self.dof[rows] -= count
        if h < self.transmitter_status.shape[1]:
            self.transmitter_status[rows, h] = self._cause(rows, h, state)
            self.problem.mirrors.weight[rows] = problem.mirrors.weight
        else:
            self.dropped[rows, _PIVOT] = True
            self.problem.mirrors.pivot_info[rows] = 0.0
        left = self.dropped[rows].any(axis=1)
        self.status[rows] = np.where(left, IntegrityStatus.PRIOR_REJECTED, IntegrityStatus.EXCLUDED)

    def _cause(self, rows: IntArray, i: int, state: State) -> IntArray:
        """Name the pattern of a transmitter's errors, seen from a pose without it."""
        mirrors = self.problem.mirrors
        predicted, _ = self.problem.take(rows).predict(state, self.solution.parameter)
        weight = mirrors.weight[rows][..., i]
        clock = state.clock[:, mirrors.clock_class]
        left = np.where(weight > 0.0, mirrors.z[rows][..., i] - predicted[..., i] - clock, np.nan)
        with np.errstate(divide="ignore"):
            sigma = np.where(weight > 0.0, weight**-0.5, np.nan)
            every = np.where(mirrors.weight[rows] > 0.0, mirrors.weight[rows] ** -0.5, np.nan)
        free = np.equal(mirrors.bias_info[rows][..., i : i + 1], 0.0)
        middle = quiet_median(left)[..., None]
        # without calibration nothing that all receivers have in common is an error
        error = np.where(free, left - middle, left)
        relative = np.abs(error) / sigma
        clear = np.any(np.nan_to_num(relative) > _CLEAR, axis=1)
        size = np.abs(np.nan_to_num(error)).max(axis=(1, 2))
        apart = np.abs(np.nan_to_num(left - middle)).max(axis=(1, 2))
        cause = np.where(
            clear.sum(axis=1) == 1,
            TransmitterStatus.ONE_RECEIVER,
            np.where(apart < _ALIKE * size, TransmitterStatus.COMMON_ERROR, TransmitterStatus.MULTIPATH),
        )
        usual = quiet_median(every.reshape(*every.shape[:2], -1))
        noisy = np.any(np.nan_to_num(sigma) > NOISY * usual[:, :, None], axis=(1, 2))
        return np.asarray(np.where(noisy, TransmitterStatus.INTERFERENCE, cause), np.int64)

    def _protect(self, rows: IntArray, dof: IntArray, spread: FloatArray) -> None:
        """Protection level against one more faulty transmitter."""
        hidden: BoolArray = np.asarray(~np.isfinite(spread).all(axis=(2, 3)))
        tilt = np.sqrt(np.maximum(largest_eigenvalue(np.where(hidden[..., None, None], 0.0, spread)), 0.0))
        bias = np.sqrt(noncentrality(limit(self.single_alarm, dof), dof, self.missed))
        with np.errstate(invalid="ignore"):
            bias = np.where(dof > 0, bias * tilt, 0.0)
        bias[hidden] = np.inf
        own = self.state.take(rows)
        own.cov += self.extra_cov[rows]
        noise = tilt_quantile(self.missed) * np.sqrt(largest_eigenvalue(_tilt_covariance(own)))
        self.level[rows] = bias.max(axis=1) + noise
        self.worst[rows] = np.argmax(bias, axis=1)

    def result(self) -> GuardedPoses:
        """Put everything together."""
        level, status = self.level, self.status
        unprotected = np.isin(status, (IntegrityStatus.UNEXPLAINED, IntegrityStatus.NOT_SOLVED))
        level[unprotected | ~np.isfinite(level)] = np.inf
        status[np.isinf(level) & ~unprotected] = IntegrityStatus.NO_REDUNDANCY
        solved = self.solution.poses
        changed = (self.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1) | self.dropped.any(axis=1)
        state = self.state
        cov = (state.cov + self.extra_cov)[:, :6, :6]
        poses = {name: np.array(getattr(solved, name)) for name in RigidPoses.__dataclass_fields__}
        for name, values in (
            ("pivot_enu_m", state.pivot),
            ("rot_enu_from_mirror", state.rot),
            ("clock_m", state.clock),
            ("cov", cov),
            ("chi2", state.chi2),
            ("dof", self.dof),
        ):
            poses[name][changed] = values[changed]
        poses["status"][changed] = PoseStatus.OK
        guarded = RigidPoses(**{name: read_only(array) for name, array in poses.items()})
        return GuardedPoses(
            poses=widened(guarded, np.asarray(changed), level, self.missed),
            status=read_only(status),
            transmitter_status=read_only(self.transmitter_status),
            used=read_only(np.asarray((self.problem.mirrors.weight > 0.0).any(axis=1))),
            prior_rejected=read_only(self.dropped),
            prior_testable=read_only(self.testable),
            chi2_probability=read_only(self.probability),
            protection_level_rad=read_only(level),
            worst_transmitter=read_only(np.where(unprotected, -1, self.worst)),
        )


def _tilt_covariance(state: State) -> FloatArray:
    """Covariance of the rotation about the mirror's own x and y axes (mirror, 2, 2)."""
    axes = state.rot[:, :, :2]
    return np.asarray(np.einsum("mac,mab,mbd->mcd", axes, state.cov[:, 3:6, 3:6], axes))
