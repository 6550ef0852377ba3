"""Better places by any measure, one tower exchanged after the other.

A measure that counts what hides and what reflects has no slope to follow: it jumps where a tower comes out from behind
a mirror. So each tower in turn is tried at other places, anywhere and near its own, and stands where the measure is
best (coordinate exchange, as in the design of experiments: Meyer and Nachtsheim, Technometrics 37 (1995) 60).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.layout.maps import PosedMirrors
from rfpose.layout.optimise.problem import TowerProblem, draw_places, problem_of, statistic_of
from rfpose.layout.optimise.rules import Constraints, Costs
from rfpose.layout.optimise.search import FEASIBLE, Placement, Progress

__all__ = ["Measure", "exchange", "measured"]

Measure = Callable[[FloatArray], FloatArray]
"""From transmitters (transmitter, xyz) to the variance at each field point (point,) [rad²]; finite."""

_ROUNDS = 5
_SETTLED = 0.01
"""A round that gains less than this share is the last."""
_NEAR = 0.15
"""Places near a tower scatter by this share of the zones' extent, half of it in each further round."""


def measured(measure: Measure, transmitter_enu_m: npt.ArrayLike, statistic: str) -> float:
    """Return rms, worst or percentile over the field of what a measure says of transmitters (transmitter, xyz)."""
    place = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    return float(statistic_of(measure(place), statistic, smooth=False)[0])


def exchange(
    begin: Placement,
    measure: Measure,
    field: PosedMirrors,
    constraints: Constraints,
    *,
    criterion: str,
    costs: Costs | None = None,
    tries: int = 30,
    seed: int = 0,
    also_from: Sequence[npt.ArrayLike] = (),
    progress: Progress | None = None,
) -> Placement:
    """Improve a placement by exchanging its new towers one after the other.

    Parameters
    ----------
    begin
        From where; its statistic is kept.
    measure
        What to minimise.
    field, constraints, costs
        As in `optimise`.
    criterion
        The measure's name.
    tries
        Places tried for each tower in each round: half of them anywhere, half near where it stands.
    seed
        The same seed gives the same result.
    also_from
        Further placements (transmitter, xyz) [m], existing ones first; the best one is begun with. Those that do not
        meet the constraints are left out.
    progress
        Called with (towers done, towers at most).

    Raises
    ------
    InvalidInputError
        ``tries`` below two.
    GeometryError
        No place for a tower.
    """
    if tries < 2:
        raise InvalidInputError(f"`tries` must be at least two, got {tries}")
    existing = begin.transmitter_enu_m[: begin.n_existing]
    problem = problem_of(field, "rigid", begin.statistic, 1.0, existing, constraints)
    starts = [begin.transmitter_enu_m]
    for other in also_from:
        place = as_float_array("also_from", other, begin.transmitter_enu_m.shape)
        if _meets(problem, place):
            starts.append(place)
    value = np.array([measured(measure, place, begin.statistic) for place in starts])
    site, best = starts[int(np.argmin(value))].copy(), float(value.min())
    rng = np.random.default_rng([seed, 1])
    new = np.arange(len(existing), len(site))
    for k in range(_ROUNDS):
        before = best
        for done, tower in enumerate(rng.permutation(new)):
            for place in _other_places(problem, site, int(tower), tries, _NEAR * 0.5**k, rng):
                tried = site.copy()
                tried[tower] = place
                now = measured(measure, tried, begin.statistic)
                if now < best:
                    site, best = tried, now
            if progress is not None:
                progress(k * len(new) + done + 1, _ROUNDS * len(new))
        if best > (1.0 - _SETTLED) * before:
            break
    if progress is not None:
        progress(_ROUNDS * len(new), _ROUNDS * len(new))
    return replace(
        begin,
        transmitter_enu_m=read_only(site),
        criterion=criterion,
        value=best,
        lost_one=_without_worst(measure, site, begin.statistic),
        cost=(costs or Costs()).of(site, len(existing)),
        start_value=read_only(value),
    )


def _meets(problem: TowerProblem, site: FloatArray) -> bool:
    """Return whether the new towers of a site meet the constraints."""
    low, high = problem.constraints.height_m
    new = site[len(problem.existing) :]
    inside = bool(np.all((new[:, 2] >= low) & (new[:, 2] <= high)))
    stays = np.allclose(site[: len(problem.existing)], problem.existing)
    return inside and stays and bool(problem.margins(new.reshape(1, -1) / problem.scale)[0].min() >= -FEASIBLE)


def _other_places(
    problem: TowerProblem, site: FloatArray, tower: int, tries: int, near: float, rng: np.random.Generator
) -> FloatArray:
    """(place, xyz) where a tower could stand, the others staying."""
    others = np.delete(site, tower, axis=0)
    alone = replace(problem, existing=others)
    low, high = problem.constraints.height_m
    anywhere = np.concatenate([draw_places(alone, 1, rng) for _ in range(tries // 2)])
    step = near * problem.scale * rng.standard_normal((4 * tries, 3)) * [1.0, 1.0, 0.5]
    close = site[tower] + step
    close[:, 2] = np.clip(close[:, 2], low, high)
    free = problem.is_free(close, others[:, :2])
    return np.concatenate([anywhere, close[free][: tries - tries // 2]])


def _without_worst(measure: Measure, site: FloatArray, statistic: str) -> float:
    """Return what is left when the transmitter is lost whose loss is worst; NaN with five, of which none may go."""
    if len(site) <= 5:
        return float("nan")
    return max(measured(measure, np.delete(site, k, axis=0), statistic) for k in range(len(site)))
