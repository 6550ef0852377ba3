"""What a search for places looks at: the field's accuracy and the site's rules, of many sites at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import GeometryError
from rfpose.layout.maps import PosedMirrors, plane_slope
from rfpose.layout.optimise import _kernels
from rfpose.layout.optimise.rules import Constraints

if TYPE_CHECKING:
    from scipy.spatial import KDTree

__all__ = [
    "CRITERIA",
    "Criterion",
    "TowerProblem",
    "draw_places",
    "problem_of",
    "statistic_of",
    "values_of",
    "variances_of",
]

Criterion = Literal["pdop", "independent", "rigid", "shared-clock"]
CRITERIA: dict[str, int] = {
    "pdop": _kernels.DOP,
    "independent": _kernels.INDEPENDENT,
    "rigid": _kernels.RIGID,
    "shared-clock": _kernels.SHARED,
}

_DRAWS = 2000
"""Random places tried for a tower before another attempt begins."""
_FIRST_DRAWS = 50
_ATTEMPTS = 20
"""Attempts to place all towers before the constraints count as impossible."""
_WORST_POWER = 12.0
_BAND = 0.02
"""Width of the ranks that stand for a percentile while searching, so that it has a slope."""
_NO_PLANES = np.empty((0, 0, 3, 3))
_UNDETERMINED = 50.0
"""Logarithm of a statistic where some point's pose is not determined: beyond any other."""


@dataclass(frozen=True, slots=True)
class TowerProblem:
    """Objective and constraints over the flat, scaled coordinates of the new towers.

    Attributes
    ----------
    field, criterion, statistic, sigma_m, constraints
        As of `optimise`.
    existing : (transmitter, xyz)
        Towers that stand already [m].
    scale
        What coordinates are measured in [m].
    heliostats
        From above, where towers keep clear of them.
    """

    field: PosedMirrors
    criterion: Criterion
    statistic: str
    sigma_m: float
    existing: FloatArray
    constraints: Constraints
    scale: float
    heliostats: KDTree | None

    def sites(self, x: FloatArray) -> FloatArray:
        """Return all transmitters (search, transmitter, xyz) of each search."""
        new = self.scale * x.reshape(len(x), -1, 3)
        return np.concatenate([np.broadcast_to(self.existing, (len(x), *self.existing.shape)), new], axis=1)

    def objective(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Logarithm of the statistic of each search (search,), and its slope (search, variable)."""
        variance, slope = variances_of(self.sites(x), self.field, self.criterion, self.sigma_m)
        good = np.isfinite(variance).all(axis=1) & (variance.min(axis=1) > 0.0)
        variance[~good] = 1.0
        value, weight = statistic_of(variance, self.statistic, smooth=True)
        gradient = (weight[..., None, None] * slope).sum(axis=1)[:, len(self.existing) :]
        gradient = self.scale * gradient.reshape(x.shape) / value[:, None]
        return np.where(good, np.log(value), _UNDETERMINED), np.where(good[:, None], gradient, 0.0)

    def values(self, sites: FloatArray) -> FloatArray:
        """Return the statistic itself (site,) with transmitters (site, transmitter, xyz); NaN: undetermined."""
        return values_of(sites, self.field, self.criterion, self.statistic, self.sigma_m)

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
            free[found] = rules.sight.margin(place[found]) >= 0.0
        for other in others if rules.separation_m > 0.0 else ():
            free &= np.hypot(*(ground - other).T) >= rules.separation_m
        return free

    def margins(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what must not be negative (search, constraint), scaled, and its slope (search, variable, constraint).

        Of a zone or a line of sight the slope is that of the nearest edge.
        """
        rules = self.constraints
        n_search, n = len(x), x.shape[1] // 3
        place = self.scale * x.reshape(-1, 3)
        alone = _alone(rules, place, self.heliostats)
        apart = np.empty((n_search, 0)), np.empty((n_search, 0, 2)), np.empty((2, 0), np.int64)
        if rules.separation_m > 0.0:
            apart = _apart(place[:, :2].reshape(n_search, n, 2), self.existing[:, :2], rules.separation_m)
        distance, by, (first, second) = apart
        value = [depth.reshape(n_search, n) for depth, _ in alone]
        slope = np.zeros((n_search, n, 3, len(alone) * n + distance.shape[1]))
        each = np.arange(n)
        for k, (_, steep) in enumerate(alone):
            across = steep.shape[1]
            slope[:, each, :across, k * n + each] = np.swapaxes(steep.reshape(n_search, n, across), 0, 1)
        pair = len(alone) * n + np.arange(len(first))
        slope[:, first, :2, pair] = np.swapaxes(by, 0, 1)
        moves = second < n
        slope[:, second[moves], :2, pair[moves]] = -np.swapaxes(by[:, moves], 0, 1)
        return np.concatenate([*value, distance], axis=1) / self.scale, slope.reshape(n_search, 3 * n, -1)


def _alone(rules: Constraints, place: FloatArray, heliostats: KDTree | None) -> list[tuple[FloatArray, FloatArray]]:
    """Return by how much each tower (tower, xyz) keeps each rule about itself [m], and the slope (tower, xy or xyz)."""
    ground = place[:, :2]
    inside = [zone.depth(ground) for zone in rules.allowed]
    best = np.argmax([depth for depth, _ in inside], axis=0)
    each = np.arange(len(place))
    kept = [(np.array([depth for depth, _ in inside])[best, each], np.array([by for _, by in inside])[best, each])]
    for zone in rules.excluded:
        depth, by = zone.inside(place)
        kept.append((-depth, -by))
    if rules.clearance_m > 0.0 and heliostats is not None:
        distance, nearest = (np.asarray(a) for a in heliostats.query(ground))
        offset = ground - heliostats.data[nearest]
        kept.append((distance - rules.clearance_m, offset / np.maximum(distance, 1e-12)[:, None]))
    if rules.sight is not None:
        clear, by = rules.sight.margins(place)
        kept += [(clear[:, k], by[:, k]) for k in range(clear.shape[1])]
    up = np.broadcast_to([0.0, 0.0, 1.0], place.shape)
    low, high = rules.height_m
    return [*kept, (place[:, 2] - low, up), (high - place[:, 2], -up)]


def _apart(
    ground: FloatArray, existing: FloatArray, separation_m: float
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64]]:
    """Return by how much towers (search, tower, xy) stand apart from each other and from existing ones (tower, xy) [m].

    (search, pair), its slope (search, pair, xy) by the first of each pair, and the pairs (2, pair).
    """
    n = ground.shape[1]
    others = np.concatenate([ground, np.broadcast_to(existing, (len(ground), *existing.shape))], axis=1)
    first, second = np.triu_indices(others.shape[1], 1)
    first, second = first[first < n], second[first < n]
    offset = others[:, first] - others[:, second]
    distance = np.linalg.norm(offset, axis=2)
    return distance - separation_m, offset / np.maximum(distance, 1e-12)[..., None], np.stack([first, second])


def variances_of(
    sites: FloatArray, field: PosedMirrors, criterion: Criterion, sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """Variance at points (site, point) with transmitters (site, transmitter, xyz), and its slope by their places."""
    n_site, n_transmitter, _ = sites.shape
    n_point = len(field.pivot_enu_m)
    value = np.empty((n_site, n_point))
    slope = np.zeros((n_site, n_point, n_transmitter, 3))
    plane = plane_slope(field.receiver_mirror_m) if criterion == "independent" else _NO_PLANES
    _kernels.objective_rows(
        value.size, CRITERIA[criterion], np.ascontiguousarray(np.swapaxes(sites, 1, 2)), field.receiver_mirror_m,
        field.pivot_enu_m, field.rot_enu_from_mirror, np.full(n_transmitter, sigma_m**-2.0), plane, value, slope,
    )  # fmt: skip
    return value, slope


def values_of(
    sites: FloatArray, field: PosedMirrors, criterion: Criterion, statistic: str, sigma_m: float
) -> FloatArray:
    """Return the statistic (site,) with transmitters (site, transmitter, xyz); NaN where a point is undetermined."""
    variance, _ = variances_of(sites, field, criterion, sigma_m)
    good = np.isfinite(variance).all(axis=1)
    variance[~good] = 1.0
    return np.where(good, statistic_of(variance, statistic, smooth=False)[0], np.nan)


def statistic_of(variance: FloatArray, statistic: str, *, smooth: bool) -> tuple[FloatArray, FloatArray]:
    """Rms, worst or percentile (…,) of √variance (…, point), and its slope by each variance; smooth for the search."""
    n = variance.shape[-1]
    if statistic == "rms":
        value = np.sqrt(variance.mean(axis=-1))
        return value, np.broadcast_to(0.5 / (n * value[..., None]), variance.shape)
    if statistic == "worst":
        top = variance.max(axis=-1, keepdims=True)
        if not smooth:
            return np.sqrt(top[..., 0]), np.zeros(variance.shape)
        share = (variance / top) ** _WORST_POWER
        value = np.sqrt(top * share.mean(axis=-1, keepdims=True) ** (1.0 / _WORST_POWER))
        return value[..., 0], 0.5 * value * share / share.sum(axis=-1, keepdims=True) / variance
    part = float(statistic[1:]) / 100.0
    root = np.sqrt(variance)
    if not smooth:
        return np.quantile(root, part, axis=-1), np.zeros(variance.shape)
    rank = (np.argsort(np.argsort(root, axis=-1), axis=-1) + 0.5) / n
    weight = np.exp(-0.5 * ((rank - part) / _BAND) ** 2)
    weight /= weight.sum(axis=-1, keepdims=True)
    return (weight * root).sum(axis=-1), 0.5 * weight / root


def problem_of(
    field: PosedMirrors,
    criterion: Criterion,
    statistic: str,
    sigma_m: float,
    existing: FloatArray,
    constraints: Constraints,
) -> TowerProblem:
    """Return the problem of placing towers beside existing ones (transmitter, xyz)."""
    heliostats = None
    if constraints.clearance_m > 0.0:
        from scipy.spatial import KDTree

        heliostats = KDTree(field.pivot_enu_m[:, :2])
    corners = np.vstack([corner for zone in constraints.allowed for corner in zone.box])
    return TowerProblem(
        field, criterion, statistic, sigma_m, existing, constraints,
        scale=max(float(np.ptp(corners, axis=0).max()), 1e-9),
        heliostats=heliostats,
    )  # fmt: skip


def draw_places(problem: TowerProblem, n_new: int, rng: np.random.Generator) -> FloatArray:
    """Random places (new transmitter, xyz) that meet the constraints, one tower after the other."""
    rules = problem.constraints
    low, high = np.moveaxis(np.array([zone.box for zone in rules.allowed]), 1, 0)
    bottom, top = rules.height_m
    share = np.cumsum(np.prod(high - low, axis=1))
    share /= share[-1]
    most = 0
    for _ in range(_ATTEMPTS):
        placed = np.empty((0, 3))
        while len(placed) < n_new:
            which = np.searchsorted(share, rng.random(_DRAWS), side="right")
            ground = low[which] + (high - low)[which] * rng.random((_DRAWS, 2))
            height = bottom + (top - bottom) * rng.random(_DRAWS)
            place = np.column_stack([ground, height])
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
