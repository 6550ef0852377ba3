"""Where to send a beam that is not seen: outward spiral about the target, zones about the camera's view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError

__all__ = ["SearchOutcome", "neighbour_zones_m", "search", "spiral_offsets_m"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchOutcome:
    """How a search ended.

    Attributes
    ----------
    offset_m : (right, up)
        By how much the aim was moved when the beam came into view [m]; NaN if it did not.
    n_look
        Pictures looked at.
    """

    offset_m: FloatArray
    n_look: int

    @property
    def seen(self) -> bool:
        """Whether the beam came into view."""
        return bool(np.isfinite(self.offset_m).all())


def spiral_offsets_m(side_m: float, *, n_ring: int) -> FloatArray:
    """Return aims on an outward square spiral, the first in the middle (aim, 2) [m].

    Parameters
    ----------
    side_m
        Side of the target: the spiral's step is half of it, so that no beam slips through (Malan, App. E.2) [m].
    n_ring
        Turns of the spiral; after each all aims within a larger square have been tried.
    """
    step = 0.5 * as_positive("side_m", side_m)
    if n_ring < 0:
        raise InvalidInputError(f"`n_ring` must be zero or greater, got {n_ring}")
    points, place = [(0, 0)], np.zeros(2, np.int64)
    for leg in range(4 * n_ring + 1):
        way = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)][leg % 4])
        length = leg // 2 + 1 if leg < 4 * n_ring else 2 * n_ring
        for _ in range(length):
            place = place + way
            points.append((int(place[0]), int(place[1])))
    return step * np.array(points if n_ring else points[:1], np.float64)


def neighbour_zones_m(width_m: float, height_m: float, *, last_seen_m: tuple[float, float] | None = None) -> FloatArray:
    """Return the eight zones about the view, each as large as it, in the order in which to try them (zone, 2) [m].

    Parameters
    ----------
    width_m, height_m
        Of the view on the target's plane [m].
    last_seen_m : (right, up)
        Where the beam was seen while the mirror was on its way: the search begins on that side. Left out: the beam was
        never seen, and it begins anywhere (Berenguel §4.6).
    """
    size = np.array([as_positive("width_m", width_m), as_positive("height_m", height_m)])
    ring = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)], np.float64)
    if last_seen_m is not None:
        seen = as_float_array("last_seen_m", last_seen_m, (2,)) / size
        norm = float(np.linalg.norm(seen))
        toward = ring @ (seen / norm if norm > 0.0 else seen) / np.linalg.norm(ring, axis=1)
        ring = ring[np.argsort(-toward, kind="stable")]
    return np.asarray(ring * size)


def search(look: Callable[[FloatArray], bool], offsets_m: FloatArray) -> SearchOutcome:
    """Move the aim along given offsets until the beam is in view.

    Parameters
    ----------
    look
        Given an offset (right, up) of the aim [m]: moves the heliostat, takes a picture, tells whether it holds a beam.
    offsets_m : (aim, 2)
        Of `spiral_offsets_m` or `neighbour_zones_m`.
    """
    for i, offset in enumerate(offsets_m):
        if look(offset):
            return SearchOutcome(offset_m=offset, n_look=i + 1)
    return SearchOutcome(offset_m=np.full(2, np.nan), n_look=len(offsets_m))
