"""Local searches from many starts under a site's constraints, and the price of accuracy."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.engine import gathered, one_thread_of_blas
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.jit import one_thread
from rfpose.layout.maps import PosedMirrors, kernel_field, plane_slope
from rfpose.layout.optimise import _kernels
from rfpose.layout.optimise.rules import Constraints, Costs

if TYPE_CHECKING:
    from scipy.spatial import KDTree

__all__ = ["CRITERIA", "Criterion", "Placement", "Progress", "efficient", "evaluate_placement", "optimise", "pegged"]

Criterion = Literal["pdop", "independent", "rigid", "shared-clock"]
CRITERIA: dict[str, int] = {
    "pdop": _kernels.DOP,
    "independent": _kernels.INDEPENDENT,
    "rigid": _kernels.RIGID,
    "shared-clock": _kernels.SHARED,
}
Progress = Callable[[int, int], None]

_DRAWS = 2000
"""Random places tried for a tower before another attempt begins."""
_FIRST_DRAWS = 50
_ATTEMPTS = 20
"""Attempts to place all towers before the constraints count as impossible."""
_WORST_POWER = 12.0
_BAND = 0.02
"""Width of the ranks that stand for a percentile while searching, so that it has a slope."""
FEASIBLE = 1e-6
_ROUNDING_M = 1e-9
"""By less a height in round numbers is not beyond its limit."""
_UNUSED = np.empty((0, 0, 3, 3))
"""Slopes of planes where no plane is laid through receivers."""
_FEW_POINTS = 5000
"""Field points below which a search keeps to one core."""


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


@dataclass(frozen=True, slots=True)
class TowerProblem:
    """Objective and constraints over the flat, scaled coordinates of the new towers."""

    field: PosedMirrors
    criterion: Criterion
    statistic: str
    sigma_m: float
    existing: FloatArray
    constraints: Constraints
    scale: float
    heliostats: KDTree | None

    def site(self, x: FloatArray) -> FloatArray:
        return np.vstack([self.existing, self.scale * x.reshape(-1, 3)])

    def objective(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Logarithm of the statistic and its slope."""
        variance, slope = _rows(self.site(x), self.field, self.criterion, self.sigma_m)
        if not np.isfinite(variance).all() or variance.min() <= 0.0:
            return 50.0, np.zeros(x.size)
        value, weight = statistic_of(variance, self.statistic, smooth=True)
        gradient = np.einsum("p,pta->ta", weight, slope)[len(self.existing) :]
        return float(np.log(value)), self.scale * gradient.ravel() / value

    def is_free(self, place: FloatArray, others: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which places (place, xyz) a tower may take beside others (tower, xy)."""
        rules, ground = self.constraints, place[:, :2]
        free: npt.NDArray[np.bool_] = np.any([zone.depth(ground)[0] >= 0.0 for zone in rules.allowed], axis=0)
        for zone in rules.excluded:
            free &= zone.inside(place)[0] <= 0.0
        if self.heliostats is not None:
            free &= np.asarray(self.heliostats.query(ground)[0]) >= rules.clearance_m
        if rules.sight is not None:
            found = np.flatnonzero(free)
            free[found] = rules.sight.margin(place[found])[0] >= 0.0
        for other in others if rules.separation_m > 0.0 else ():
            free &= np.hypot(*(ground - other).T) >= rules.separation_m
        return free

    def margins(self, x: FloatArray) -> FloatArray:
        return self._margins(x)[0]

    def margins_once(self) -> tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]:
        """Return margins and slopes as two functions, which work both out once where they are asked in turn."""
        seen, known = np.empty(0), (np.empty(0), np.empty(0))

        def at(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            nonlocal seen, known
            if not np.array_equal(x, seen):
                seen, known = x.copy(), self._margins(x)
            return known

        return lambda x: at(x)[0].copy(), lambda x: at(x)[1].copy()

    def _margins(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what must not be negative (constraint,), scaled, and its slope (constraint, variable)."""
        rules = self.constraints
        new = x.reshape(-1, 3)
        ground = self.scale * new[:, :2]
        n = len(new)
        value: list[FloatArray] = []
        slope: list[FloatArray] = []

        def each(depth: FloatArray, by: FloatArray) -> None:
            rows = np.zeros((n, n, 3))
            rows[np.arange(n), np.arange(n), : by.shape[1]] = by
            value.append(depth / self.scale)
            slope.append(rows.reshape(n, -1))

        inside = [zone.depth(ground) for zone in rules.allowed]
        best = np.argmax([depth for depth, _ in inside], axis=0)
        each(
            np.array([inside[k][0][i] for i, k in enumerate(best)]),
            np.array([inside[k][1][i] for i, k in enumerate(best)]),
        )
        for zone in rules.excluded:
            depth, by = zone.inside(self.scale * new)
            each(-depth, -by)
        if rules.clearance_m > 0.0 and self.heliostats is not None:
            distance, nearest = (np.asarray(a) for a in self.heliostats.query(ground))
            offset = ground - self.heliostats.data[nearest]
            each(distance - rules.clearance_m, offset / np.maximum(distance, 1e-12)[:, None])
        if rules.sight is not None:
            each(*rules.sight.margin(self.scale * new))
        if rules.separation_m > 0.0:
            others = np.vstack([ground, self.existing[:, :2]])
            i, j = np.triu_indices(len(others), 1)
            i, j = i[i < n], j[i < n]
            offset = others[i] - others[j]
            distance = np.linalg.norm(offset, axis=1)
            by = offset / np.maximum(distance, 1e-12)[:, None]
            rows = np.zeros((len(i), n, 3))
            rows[np.arange(len(i)), i, :2] = by
            moving = j < n
            rows[np.flatnonzero(moving), j[moving], :2] = -by[moving]
            value.append((distance - rules.separation_m) / self.scale)
            slope.append(rows.reshape(len(i), 3 * n))
        return np.concatenate(value), np.vstack(slope)


def _rows(
    transmitter: FloatArray, field: PosedMirrors, criterion: Criterion, sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """Variance at each field point (point,) and its slope (point, transmitter, xyz)."""
    n = len(field.pivot_enu_m)
    value = np.empty(n)
    slope = np.zeros((n, len(transmitter), 3))
    _kernels.objective_rows(
        n, CRITERIA[criterion], kernel_field(transmitter, field), np.full(len(transmitter), sigma_m**-2.0),
        plane_slope(field.receiver_mirror_m) if criterion == "independent" else _UNUSED, value, slope,
    )  # fmt: skip
    return value, slope


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Search on one core: a few hundred points and tiny matrices, where threads only wait for each other."""
    with one_thread(), one_thread_of_blas(scipy=True):
        yield


def statistic_of(variance: FloatArray, statistic: str, *, smooth: bool) -> tuple[float, FloatArray]:
    """Rms, worst or percentile of √variance, and its slope by each variance; smooth stand-ins for the search."""
    n = len(variance)
    if statistic == "rms":
        value = float(np.sqrt(variance.mean()))
        return value, np.full(n, 0.5 / (n * value))
    if statistic == "worst":
        top = float(variance.max())
        if not smooth:
            return float(np.sqrt(top)), np.zeros(n)
        share = (variance / top) ** _WORST_POWER
        value = float(np.sqrt(top * share.mean() ** (1.0 / _WORST_POWER)))
        return value, 0.5 * value * share / share.sum() / variance
    part = float(statistic[1:]) / 100.0
    root = np.sqrt(variance)
    if not smooth:
        return float(np.quantile(root, part)), np.zeros(n)
    rank = np.empty(n)
    rank[np.argsort(root)] = (np.arange(n) + 0.5) / n
    weight = np.exp(-0.5 * ((rank - part) / _BAND) ** 2)
    weight /= weight.sum()
    return float(weight @ root), 0.5 * weight / root


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
    variance, _ = _rows(transmitter, field, criterion, sigma_m)
    return statistic_of(variance, statistic, smooth=False)[0] if np.isfinite(variance).all() else float("nan")


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
    """Place transmitters so that a field's accuracy is best: SLSQP from many starts, gradients by the kernel.

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
    ends = gathered(_searched, begin, problem, progress)
    value = np.array([worth for worth, _ in ends])
    found = [(worth, end) for worth, end in ends if end is not None and np.isfinite(worth)]
    if not found:
        raise GeometryError(
            "no search met the constraints with every field point determined; relax separation, zones or heights"
        )
    best = min(found, key=lambda item: item[0])[1]
    site = problem.site(best)
    return Placement(
        transmitter_enu_m=read_only(site),
        n_existing=len(existing),
        criterion=criterion,
        statistic=statistic,
        value=_value(problem, best),
        lost_one=_without_worst(problem, site),
        cost=(costs or Costs()).of(site, len(existing)),
        start_value=read_only(value),
    )


def problem_of(
    field: PosedMirrors,
    criterion: Criterion,
    statistic: str,
    sigma_m: float,
    existing: FloatArray,
    constraints: Constraints,
) -> TowerProblem:
    from scipy.spatial import KDTree

    corners = np.vstack([corner for zone in constraints.allowed for corner in zone.box])
    return TowerProblem(
        field, criterion, statistic, sigma_m, existing, constraints,
        scale=max(float(np.ptp(corners, axis=0).max()), 1e-9),
        heliostats=KDTree(field.pivot_enu_m[:, :2]) if constraints.clearance_m > 0.0 else None,
    )  # fmt: skip


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


def draw_places(problem: TowerProblem, n_new: int, rng: np.random.Generator) -> FloatArray:
    """Random places (new transmitter, xyz) that meet the constraints, one tower after the other."""
    rules = problem.constraints
    boxes = np.array([zone.box for zone in rules.allowed])
    area = np.prod(boxes[:, 1] - boxes[:, 0], axis=1)
    most = 0
    for _ in range(_ATTEMPTS):
        placed = np.empty((0, 3))
        while len(placed) < n_new:
            which = rng.choice(len(boxes), size=_DRAWS, p=area / area.sum())
            ground = rng.uniform(boxes[which, 0], boxes[which, 1])
            place = np.column_stack([ground, rng.uniform(*rules.height_m, size=_DRAWS)])
            others = np.vstack([problem.existing, placed])[:, :2]
            few, rest = place[:_FIRST_DRAWS], place[_FIRST_DRAWS:]  # mostly one of a few will do
            free = few[problem.is_free(few, others)]
            if not len(free):
                free = rest[problem.is_free(rest, others)]
            if not len(free):
                break
            placed = np.vstack([placed, free[0]])
        if len(placed) == n_new:
            return placed
        most = max(most, len(placed))
    raise GeometryError(
        f"the constraints leave no room for {n_new} new transmitters ({most} found places); relax the "
        f"separation of {rules.separation_m:g} m, the clearance, {'the lines of sight, ' if rules.sight else ''}or the "
        "zones"
    )


def _searched(problem: TowerProblem, start: FloatArray) -> tuple[float, FloatArray | None]:
    """Return what the search from one start comes to, and where it ends; NaN and None where that is nowhere."""
    with _one_thread() if len(problem.field.pivot_enu_m) < _FEW_POINTS else contextlib.nullcontext():
        end = _search(problem, start)
        return (np.nan, None) if end is None else (_value(problem, end), end)


def _search(problem: TowerProblem, start: FloatArray) -> FloatArray | None:
    """SLSQP from one start; None where it ends outside the constraints."""
    n = len(start)
    low, high = (h / problem.scale for h in problem.constraints.height_m)
    margins, slopes = problem.margins_once()
    constraint: dict[str, Any] = {"type": "ineq", "fun": margins, "jac": slopes}
    from scipy.optimize import minimize

    result = minimize(  # type: ignore[call-overload]
        problem.objective,
        start.ravel() / problem.scale,
        jac=True,
        method="SLSQP",
        bounds=[(-np.inf, np.inf), (-np.inf, np.inf), (low, high)] * n,
        constraints=[constraint],
        options={"maxiter": 300, "ftol": 1e-7},
    )
    x = np.asarray(result.x, np.float64)
    if not np.isfinite(x).all() or problem.margins(x).min() < -FEASIBLE:
        return None
    x.reshape(-1, 3)[:, 2] = np.clip(x.reshape(-1, 3)[:, 2], low, high)
    return x


def _value(problem: TowerProblem, x: FloatArray) -> float:
    return evaluate_placement(
        problem.site(x),
        problem.field,
        criterion=problem.criterion,
        statistic=problem.statistic,
        sigma_m=problem.sigma_m,
    )


def _without_worst(problem: TowerProblem, site: FloatArray) -> float:
    if len(site) <= 5:
        return float("nan")
    return float(
        np.max(
            [
                evaluate_placement(
                    np.delete(site, k, axis=0),
                    problem.field,
                    criterion=problem.criterion,
                    statistic=problem.statistic,
                    sigma_m=problem.sigma_m,
                )
                for k in range(len(site))
            ]
        )
    )


def efficient(found: Sequence[Placement]) -> list[tuple[Placement, bool]]:
    """Mark the placements that none beats in cost, value and loss of one."""
    merit = np.array([(p.cost, p.value, np.nan_to_num(p.lost_one, nan=np.inf)) for p in found])
    beaten = [
        any(np.all(other <= own) and np.any(other < own) for k, other in enumerate(merit) if k != i)
        for i, own in enumerate(merit)
    ]
    return [(p, not b) for p, b in zip(found, beaten, strict=True)]
