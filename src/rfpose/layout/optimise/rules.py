"""What a site allows: zones, heights, distances, and what towers cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError

__all__ = ["Constraints", "Costs", "Sightlines", "Zone"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """A piece of ground, from above: a polygon, or a circle.

    Attributes
    ----------
    corner_enu_m : (corner, xy) or None
        Polygon, any direction, not closed [m].
    centre_enu_m, radius_m
        Circle [m].
    top_m
        Where it is excluded, only what is not above this [m].
    """

    corner_enu_m: FloatArray | None = None
    centre_enu_m: tuple[float, float] = (0.0, 0.0)
    radius_m: float = np.nan
    top_m: float = np.inf

    def __post_init__(self) -> None:
        if self.corner_enu_m is None:
            as_positive("radius_m", self.radius_m)
        elif len(as_float_array("corner_enu_m", self.corner_enu_m, ("corner", 2))) < 3:
            raise InvalidInputError("`corner_enu_m` must hold three or more corners")

    def depth(self, point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how deep each point (point, xy) lies inside [m] (negative: outside), and its slope (point, xy)."""
        if self.corner_enu_m is None:
            offset = point - np.asarray(self.centre_enu_m)
            distance = np.linalg.norm(offset, axis=1)
            return self.radius_m - distance, -offset / np.maximum(distance, 1e-12)[:, None]
        start = np.asarray(self.corner_enu_m, np.float64)
        edge = np.roll(start, -1, axis=0) - start
        offset = point[:, None] - start
        along = np.einsum("pcx,cx->pc", offset, edge) / np.maximum((edge**2).sum(axis=1), 1e-300)
        gap = offset - np.clip(along, 0.0, 1.0)[..., None] * edge
        nearest = np.argmin((gap**2).sum(axis=2), axis=1)
        gap = gap[np.arange(len(point)), nearest]
        distance = np.linalg.norm(gap, axis=1)
        end = np.roll(start, -1, axis=0)
        crosses = (start[:, 1] > point[:, 1:]) != (end[:, 1] > point[:, 1:])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = start[:, 0] + (point[:, 1:] - start[:, 1]) / edge[:, 1] * edge[:, 0]
        inside = np.where((crosses & (point[:, :1] < x)).sum(axis=1) % 2 == 1, 1.0, -1.0)
        return inside * distance, inside[:, None] * gap / np.maximum(distance, 1e-12)[:, None]

    def inside(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how deep each place (place, xyz) lies inside or below [m] (negative: not), and its slope."""
        depth, by = self.depth(place[:, :2])
        below = self.top_m - place[:, 2]
        over = below < depth
        slope = np.concatenate([np.where(over[:, None], 0.0, by), np.where(over, -1.0, 0.0)[:, None]], axis=1)
        return np.where(over, below, depth), slope

    @property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Smallest and largest (xy) coordinates [m]."""
        if self.corner_enu_m is None:
            centre = np.asarray(self.centre_enu_m)
            return centre - self.radius_m, centre + self.radius_m
        corner = np.asarray(self.corner_enu_m, np.float64)
        return corner.min(axis=0), corner.max(axis=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sightlines:
    """Lines from mirrors to where their light goes, which towers stay out of: beside them, or below.

    A tower is an upright line from the ground to its antenna. The last ``clearance_m`` of a line before its end, where
    the receiver's own tower stands, does not count.

    Attributes
    ----------
    start_enu_m, end_enu_m : (line, xyz)
        [m].
    clearance_m
        Least distance: sideways, or of the antenna below the line [m].
    """

    start_enu_m: FloatArray
    end_enu_m: FloatArray
    clearance_m: float

    def _clear(self, tower_enu_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return distances sideways and below (tower, line), the way along (tower, line), the gap (tower, line, xy)."""
        along = self.end_enu_m - self.start_enu_m
        length = np.maximum(np.linalg.norm(along[:, :2], axis=1), 1e-9)
        offset = tower_enu_m[:, None, :2] - self.start_enu_m[:, :2]
        reach = np.maximum(1.0 - self.clearance_m / length, 0.0)
        part = np.clip(np.einsum("tlx,lx->tl", offset, along[:, :2]) / length**2, 0.0, reach)
        gap = offset - part[..., None] * along[:, :2]
        above = self.start_enu_m[:, 2] + part * along[:, 2] - tower_enu_m[:, None, 2]
        return np.linalg.norm(gap, axis=2), above, np.where((part > 0.0) & (part < reach), part, np.nan), gap

    def margin(self, tower_enu_m: FloatArray) -> FloatArray:
        """Return by how much each tower (tower, xyz) is clear of the worst line [m]; negative: it stands in the way."""
        aside, above, _, _ = self._clear(tower_enu_m)
        return np.asarray(np.maximum(aside, above).min(axis=1) - self.clearance_m)

    def margins(self, tower_enu_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return by how much each tower is clear of its worst lines (tower, line) [m], and the slopes (…, xyz).

        Of several that are as near, since a tower among them leaves one only to come into the next; else of one, again.
        """
        aside, above, part, gap = self._clear(tower_enu_m)
        clear = np.maximum(aside, above) - self.clearance_m
        rows = np.arange(len(tower_enu_m))[:, None]
        worst = np.argsort(clear, axis=1)[:, :_WORST_LINES]
        is_alike = clear[rows, worst] < clear[rows, worst[:, :1]] + _ALIKE * self.clearance_m
        worst = np.where(is_alike, worst, worst[:, :1])
        along = (self.end_enu_m - self.start_enu_m)[worst]
        beside = (aside >= above)[rows, worst][..., None]
        flat = gap[rows, worst] / np.maximum(aside[rows, worst], 1e-12)[..., None]
        # where the tower is nearest to an end of the line, its height does not change with the place
        steep = along[..., 2] / np.maximum((along[..., :2] ** 2).sum(axis=-1), 1e-18)
        rise = np.where(np.isfinite(part[rows, worst]), steep, 0.0)[..., None] * along[..., :2]
        slope = np.concatenate([np.where(beside, flat, rise), np.where(beside, 0.0, -1.0)], axis=-1)
        return clear[rows, worst], slope

    def crossed(self, tower_enu_m: FloatArray) -> int:
        """Return how many of the lines have a tower in their way."""
        aside, above, _, _ = self._clear(tower_enu_m)
        return int((np.maximum(aside, above) < self.clearance_m - _TOUCH_M).any(axis=0).sum())


_WORST_LINES = 3
_ALIKE = 0.005
"""Of so many lines of sight a search keeps each tower clear at once, where they are as near but for this share."""
_TOUCH_M = 1e-3
"""A tower that stands in a line by less only touches it; places are written in round numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Constraints:
    """Where transmitters may stand.

    Attributes
    ----------
    allowed
        Each tower stands in one of these zones.
    height_m
        Lowest and highest antenna, z in the site frame [m].
    excluded
        No tower stands in any of these.
    separation_m
        Least horizontal distance between two towers [m].
    clearance_m
        Least horizontal distance to a heliostat [m].
    sight
        Lines that new towers stay out of; None: none.
    """

    allowed: tuple[Zone, ...]
    height_m: tuple[float, float]
    excluded: tuple[Zone, ...] = ()
    separation_m: float = 0.0
    clearance_m: float = 0.0
    sight: Sightlines | None = None

    def __post_init__(self) -> None:
        low, high = self.height_m
        if not (np.isfinite(low) and np.isfinite(high) and low <= high):
            raise InvalidInputError(f"`height_m` must be (lowest, highest), got {self.height_m}")
        if not self.allowed:
            raise InvalidInputError("`allowed` must hold a zone")
        if self.separation_m < 0.0 or self.clearance_m < 0.0:
            raise InvalidInputError("`separation_m` and `clearance_m` must not be negative")


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """What new towers cost, in any currency: each, by height above ``ground_m``, by cable.

    Cables run as the shortest tree over all towers and ``cable_start_enu_m``.
    """

    per_tower: float = 1.0
    per_height_m: float = 0.0
    per_cable_m: float = 0.0
    cable_start_enu_m: tuple[float, float] = (0.0, 0.0)
    ground_m: float = 0.0

    def of(self, transmitter_enu_m: FloatArray, n_existing: int = 0) -> float:
        """Return the cost of a site, whose first ``n_existing`` towers stand already (their cables, too)."""
        new = transmitter_enu_m[n_existing:]
        height = np.maximum(new[:, 2] - self.ground_m, 0.0).sum()
        cable = 0.0
        if self.per_cable_m > 0.0:
            node = np.vstack([self.cable_start_enu_m, transmitter_enu_m[:, :2]])
            # the tree takes what is below 1e-8 as not joined
            length = np.maximum(np.linalg.norm(node[:, None] - node, axis=2), 1e-6)
            standing = n_existing + 1
            length[:standing, :standing] = 1e-6
            from scipy.sparse.csgraph import minimum_spanning_tree

            cable = float(minimum_spanning_tree(length).sum())
        return float(self.per_tower * len(new) + self.per_height_m * height + self.per_cable_m * cable)
