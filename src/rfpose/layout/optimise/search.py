"""Local searches from many starts under a site's constraints, and the price of accuracy."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.engine import gathered, is_elsewhere
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.jit import one_thread
from rfpose.layout.maps import PosedMirrors
from rfpose.layout.optimise.descent import minimised
from rfpose.layout.optimise.problem import (
    CRITERIA,
    Criterion,
    TowerProblem,
    draw_places,
    problem_of,
    values_of,
)
from rfpose.layout.optimise.rules import Constraints, Costs

__all__ = ["Placement", "Progress", "efficient", "evaluate_placement", "optimise", "pegged"]

Progress = Callable[[int, int], None]

FEASIBLE = 1e-6
_TOLERANCE = 1e-7
"""Of the logarithm of what is minimised, and of places as a share of the site's width."""
_ROUNDING_M = 1e-9
"""By less a height in round numbers is not beyond its limit."""
_FEW_POINTS = 5000
"""Field points of all searches side by side below which threads would only wait for each other."""
_POINTS_AT_ONCE = 20_000
"""Field points of all searches side by side, as far as one search does not have more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Where transmitters should stand.

    Attributes
    ----------
    transmitter_enu_m : (transmitter, xyz)
        Existing ones first [m].
    n_existing
        How many of them stood already.
    criterion, statistic
        What was minimised.
    value
        Its value over the field: PDOP, or radians of the normal.
    lost_one
        The same with the transmitter missing whose loss is worst; NaN where some point is then undetermined.
    cost
        Of the new towers.
    start_value : (start,)
        What each start came to; NaN where its search failed.
    """

    transmitter_enu_m: FloatArray
    n_existing: int
    criterion: str
    statistic: str
    value: float
    lost_one: float
    cost: float
    start_value: FloatArray


def evaluate_placement(
    transmitter_enu_m: npt.ArrayLike,
    field: PosedMirrors,
    *,
    criterion: Criterion = "pdop",
    statistic: str = "rms",
    sigma_m: float = 1.0,
) -> float:
    """Return rms, worst or percentile over the field of PDOP (times sigma) or of the normal's RMS angle [rad].

    NaN where a point of the field is undetermined. See `optimise` for the arguments.
    """
    _check(criterion, statistic)
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    return float(values_of(transmitter[None], field, criterion, statistic, sigma_m)[0])


def optimise(
    n_transmitter: int,
    field: PosedMirrors,
    constraints: Constraints,
    *,
    criterion: Criterion = "pdop",
    statistic: str = "rms",
    existing_enu_m: npt.ArrayLike | None = None,
    costs: Costs | None = None,
    sigma_m: float = 1.0,
    starts: int = 30,
    seed: int = 0,
    also_from: Sequence[npt.ArrayLike] = (),
    progress: Progress | None = None,
) -> Placement:
    """Place transmitters so that a field's accuracy is best: searches from many starts, gradients by the kernel.

    Parameters
    ----------
    n_transmitter
        All of them, existing ones included.
    field
        Field points: mirrors in postures; several postures of one mirror are several rows. For ``pdop`` only the
        pivots count.
    constraints, costs
        See there.
    criterion
        ``pdop``: dilution of position. Else RMS angle of the normal: ``independent`` fits, ``rigid`` with one clock a
        receiver, or with a ``shared-clock``; calibration perfect, noise ``sigma_m`` alike, everything in sight.
    statistic
        ``rms``, ``worst``, or a percentile such as ``p95``, over the field points.
    existing_enu_m : (transmitter, xyz)
        Towers that stand already and stay [m].
    starts, seed
        Random starts; the same seed gives the same result.
    also_from
        Further starts: positions (new transmitter, xyz) [m].
    progress
        Called with (starts done, starts).

    Raises
    ------
    GeometryError
        Fewer than five transmitters; constraints that no random try, or no search, could meet.
    """
    _check(criterion, statistic)
    existing = np.empty((0, 3))
    if existing_enu_m is not None:
        existing = as_float_array("existing_enu_m", existing_enu_m, ("transmitter", 3))
    n_new = n_transmitter - len(existing)
    if n_transmitter < 5:
        raise GeometryError(
            f"{n_transmitter} transmitters cannot fix positions in 3 dimensions: at least 5 are needed (N >= D + 2)"
        )
    if n_new < 1:
        raise GeometryError(f"{len(existing)} transmitters exist already; `n_transmitter` must be larger")
    if starts < 1:
        raise InvalidInputError(f"`starts` must be at least one, got {starts}")
    problem = problem_of(field, criterion, statistic, as_positive("sigma_m", sigma_m), existing, constraints)
    rng = np.random.default_rng(seed)
    begin = [as_float_array("also_from", x, (n_new, 3)) for x in also_from]
    begin += [draw_places(problem, n_new, rng) for _ in range(starts)]
    sites, value = _searched_all(problem, np.stack(begin), progress)
    if np.isnan(value).all():
        raise GeometryError(
            "no search met the constraints with every field point determined; relax separation, zones or heights"
        )
    best = int(np.nanargmin(value))
    return Placement(
        transmitter_enu_m=read_only(sites[best]),
        n_existing=len(existing),
        criterion=criterion,
        statistic=statistic,
        value=float(value[best]),
        lost_one=_without_worst(problem, sites[best]),
        cost=(costs or Costs()).of(sites[best], len(existing)),
        start_value=read_only(value),
    )


def pegged(
    place_enu_m: FloatArray, existing_enu_m: FloatArray, field: PosedMirrors, constraints: Constraints, *, step_m: float
) -> FloatArray:
    """Return towers' places in round numbers, each the nearest that keeps the rules.

    Parameters
    ----------
    place_enu_m : (tower, xyz)
        As found; they keep the rules.
    existing_enu_m : (tower, xyz)
        Towers that stay.
    field, constraints
        As for `optimise`.
    step_m
        What places are to be multiples of. Where no neighbour among these keeps the rules, the nearest is taken.
    """
    problem = problem_of(field, "pdop", "rms", 1.0, existing_enu_m, constraints)
    low, high = constraints.height_m
    around = step_m * np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    out = place_enu_m.copy()
    for i, place in enumerate(place_enu_m):
        near = step_m * np.round((place + around) / step_m)
        near = near[np.argsort(np.linalg.norm(near - place, axis=1), kind="stable")]
        others = np.vstack([existing_enu_m, np.delete(out, i, axis=0)])[:, :2]
        keeps = problem.is_free(near, others) & (near[:, 2] >= low - _ROUNDING_M) & (near[:, 2] <= high + _ROUNDING_M)
        out[i] = near[np.argmax(keeps)]
    return out


def _check(criterion: str, statistic: str) -> None:
    if criterion not in CRITERIA:
        raise InvalidInputError(f"`criterion` must be one of {', '.join(CRITERIA)}, got {criterion!r}")
    if statistic in ("rms", "worst"):
        return
    try:
        part = float(statistic[1:])
    except ValueError:
        part = np.nan
    if not statistic.startswith("p") or not 0.0 < part < 100.0:
        raise InvalidInputError(f"`statistic` must be rms, worst or a percentile such as p95, got {statistic!r}")


def _searched_all(problem: TowerProblem, start: FloatArray, progress: Progress | None) -> tuple[FloatArray, FloatArray]:
    """Return the sites (start, transmitter, xyz) where searches end and their values (start,); NaN: nowhere.

    Other processes take one start at a time; here those go side by side whose points fit into the processor's cache.
    """
    if is_elsewhere():
        found = gathered(_searched_one, list(start), problem, progress)
    else:
        n, found = max(1, _POINTS_AT_ONCE // len(problem.field.pivot_enu_m)), []
        for begin in range(0, len(start), n):
            found.append(_searched(problem, start[begin : begin + n], _told(progress, begin, len(start))))
    sites, value = zip(*found, strict=True)
    return np.concatenate(sites), np.concatenate(value)


def _told(progress: Progress | None, before: int, total: int) -> Callable[[int], None] | None:
    return None if progress is None else lambda done: progress(before + done, total)


def _searched_one(problem: TowerProblem, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    return _searched(problem, start[None])


def _searched(
    problem: TowerProblem, start: FloatArray, on_end: Callable[[int], None] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Search from places (start, tower, xyz) side by side; see `_searched_all`."""
    n_start, n_tower, _ = start.shape
    low, high = problem.constraints.height_m
    begin = start.copy()
    begin[..., 2] = np.clip(begin[..., 2], low, high)
    begin = begin.reshape(n_start, -1) / problem.scale
    few = n_start * len(problem.field.pivot_enu_m) < _FEW_POINTS
    with one_thread() if few else contextlib.nullcontext():
        x = minimised(problem.objective, problem.margins, begin, tolerance=_TOLERANCE, on_end=on_end)
        missed = problem.margins(x)[0].min(axis=1) < -FEASIBLE
        if missed.any():  # where the least lies on an edge that turns
            x[missed] = minimised(_nothing, problem.margins, x[missed], tolerance=_TOLERANCE)
            missed = problem.margins(x)[0].min(axis=1) < -FEASIBLE
        sites = problem.sites(x)
        new = sites[:, -n_tower:]
        new[..., 2] = np.clip(new[..., 2], low, high)
        return sites, np.where(missed, np.nan, problem.values(sites))


def _nothing(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return nothing to be minimised: constraints alone count."""
    return np.zeros(len(x)), np.zeros(x.shape)


def _without_worst(problem: TowerProblem, site: FloatArray) -> float:
    """Return the value without the transmitter whose loss is worst; NaN with five, of which none may go."""
    if len(site) <= 5:
        return float("nan")
    return float(problem.values(np.stack([np.delete(site, k, axis=0) for k in range(len(site))])).max())


def efficient(found: Sequence[Placement]) -> list[tuple[Placement, bool]]:
    """Mark the placements that none beats in cost, value and loss of one."""
    merit = np.array([(p.cost, p.value, np.nan_to_num(p.lost_one, nan=np.inf)) for p in found])
    beaten = [
        any(np.all(other <= own) and np.any(other < own) for k, other in enumerate(merit) if k != i)
        for i, own in enumerate(merit)
    ]
    return [(p, not b) for p, b in zip(found, beaten, strict=True)]
