"""Coefficients of reflectors from all mirrors: a search on a few, then Gauss-Newton on all."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.ground._problem import GroundProblem, follow
from rfpose.multilat.rigid.pose import RigidFits
from rfpose.multilat.status import has_start

__all__ = ["MAX_CONDITION", "find", "information", "refine", "retry", "trusted"]

BoolArray = npt.NDArray[np.bool_]

_N_SUBSET = 24
_N_REFINED = 3
_MAX_STEP = 0.2
MAX_CONDITION = 1e12
"""Of the coefficients' information; beyond it they are not determined."""
_MAX_ROUND = 25
_MAX_HALVING = 6
_MAX_ITERATION_TRIED = 8
_MAX_ITERATION_RETRY = 15
_MOST_FITS = 1500
_FEWEST_TURNS = 6
_FAR_WORSE = 20.0
"""times the chi² of a mirror that fits well. False minima are worse by thousands."""
_FITS = 2.0
"""chi² over degrees of freedom of the middle mirror that leaves nothing to search for."""


def find(problem: GroundProblem, state: RigidFits, turn: FloatArray) -> FloatArray:
    """Coefficients to start from: the best of a grid, tried on mirrors spread over the field.

    Parameters
    ----------
    problem, state
        ``state`` is left as it is.
    turn : (start, 3)
        Rotation vectors in the mirror frame from which a mirror is tried again [rad].
    """
    usable = np.flatnonzero(has_start(state.status))
    parameter = problem.first_parameter()
    if problem.n_parameter == 0 or not len(usable):
        return parameter
    rows = usable[np.unique(np.linspace(0, len(usable) - 1, _N_SUBSET).astype(np.int64))]
    few, start = problem.take(rows), state.take(rows)
    tried: dict[tuple[float, ...], float] = {tuple(parameter): _score(few, start, parameter)}
    for plane in range(problem.n_parameter // 2):
        base = np.array(min(tried, key=tried.__getitem__))
        for value in _grid():
            candidate = base.copy()
            candidate[2 * plane : 2 * plane + 2] = value.real, value.imag
            tried[tuple(candidate)] = _score(few, start, candidate)
    best, best_cost = parameter, np.inf
    for key in sorted(tried, key=tried.__getitem__)[:_N_REFINED]:
        candidate, trial = np.array(key), start.copy()
        few.fit(trial, candidate)
        refined = candidate
        for _ in range(2):
            # the second time with coefficients that tell right poses from wrong ones
            retry(few, start, trial, refined, turn)
            refined = refine(few, trial, refined)
        cost = _cost(few, trial)
        if cost < best_cost:
            best, best_cost = refined, cost
        if np.median(trial.chi2 / np.maximum(few.dof, 1.0)) < _FITS:
            break
    return best


def refine(problem: GroundProblem, state: RigidFits, parameter: FloatArray) -> FloatArray:
    """Gauss-Newton on the coefficients from solved mirrors; ``state`` ends solved at what is returned."""
    if problem.n_parameter == 0:
        return parameter
    for _ in range(_MAX_ROUND):
        good = trusted(problem, state)
        total, rest = information(state, good), state.rest[good].sum(axis=0)
        if not np.any(good) or np.linalg.cond(total) > MAX_CONDITION:
            break
        step = np.linalg.solve(total, rest)
        share = min(1.0, _MAX_STEP / max(float(np.abs(step).max()), 1e-300))
        if float(step @ rest) < 1e-3 and share == 1.0:
            # a thirtieth of a sigma: the linear step is exact enough
            follow(state, step)
            return parameter + step
        before = state.chi2[good].sum()
        cap = 1e3 * np.maximum(state.chi2, problem.dof)
        for _ in range(_MAX_HALVING):
            candidate = problem.clip(parameter + share * step)
            trial = state.copy()
            follow(trial, candidate - parameter)
            problem.fit(trial, candidate)
            if np.minimum(trial.chi2, cap)[good].sum() <= before * (1.0 + 1e-9) + 1e-3:
                break
            share *= 0.5
        else:
            break
        parameter = candidate
        state.put(np.arange(len(state.chi2)), trial)
    return parameter


def retry(problem: GroundProblem, start: RigidFits, state: RigidFits, parameter: FloatArray, turn: FloatArray) -> None:
    """Solve mirrors that failed, or fit far worse than they should (`_usual`), again from starts turned about."""
    ratio = state.chi2 / np.maximum(problem.dof, 1.0)
    usual = _usual(problem, state)
    rows = np.flatnonzero(has_start(start.status) & ~((state.status == 0) & (ratio <= usual)))
    if not len(rows):
        return
    again = start.take(rows)
    # where the model itself is wrong nothing fits: what is spent on it stays bounded
    affordable = turn[: max(_FEWEST_TURNS, _MOST_FITS // len(rows))]
    enough = (usual * np.maximum(problem.dof, 1.0))[rows]
    problem.take(rows).fit(again, parameter, turn=affordable, enough=enough, max_iteration=_MAX_ITERATION_RETRY)
    better = np.flatnonzero((again.status == 0) & (again.chi2 < state.chi2[rows]))
    state.put(rows[better], again.take(better))


def trusted(problem: GroundProblem, state: RigidFits) -> BoolArray:
    """(mirror,) those that may speak about coefficients: solved, and not fitting far worse than the rest."""
    return np.asarray((state.status == 0) & (state.chi2 / np.maximum(problem.dof, 1.0) <= _usual(problem, state)))


def information(state: RigidFits, good: BoolArray) -> FloatArray:
    """Return what mirrors say about the coefficients together: the inverse of their covariance."""
    return np.asarray(state.schur[good].sum(axis=0))


def _usual(problem: GroundProblem, state: RigidFits) -> FloatArray:
    """(mirror,) largest chi² over degrees of freedom that is not out of the ordinary.

    Coefficients to be found may be what is wrong, and then all mirrors fit badly: only the others tell. Known, they
    let every mirror be judged by itself.
    """
    dof = np.maximum(problem.dof, 1.0)
    chance = 1.0 + 6.0 * np.sqrt(2.0 / dof)
    if problem.n_parameter == 0:
        return np.asarray(chance)
    solved = state.status == 0
    good = float(np.quantile((state.chi2 / dof)[solved], 0.1)) if np.any(solved) else 1.0
    return np.asarray(np.maximum(_FAR_WORSE * good, chance))


def _score(problem: GroundProblem, start: RigidFits, parameter: FloatArray) -> float:
    trial = start.copy()
    problem.fit(trial, parameter, max_iteration=_MAX_ITERATION_TRIED)
    return _cost(problem, trial)


def _cost(problem: GroundProblem, state: RigidFits) -> float:
    """How badly mirrors fit, none able to outweigh the rest."""
    with np.errstate(over="ignore"):
        return float(np.log1p(np.minimum(state.chi2, 1e12) / np.maximum(problem.dof, 1.0)).sum())


def _grid() -> list[complex]:
    return [
        radius * complex(np.exp(2j * np.pi * k / count))
        for radius, count in ((0.15, 6), (0.3, 10), (0.5, 14))
        for k in range(count)
    ]
