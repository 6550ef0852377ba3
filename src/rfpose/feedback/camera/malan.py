"""Malan's image chain: perspective taken out by corner markers, thresholds, brightness-weighted centroid.

References
----------
Malan, A heliostat field control system, §5.6.3, (5.2)-(5.4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.camera.spot import LEAST_PX, Spot, SpotStatus, as_grey, no_spot, skimage

__all__ = ["Board", "beam_threshold", "find_spot", "marker_threshold", "weighted_centroid"]

Mask = npt.NDArray[np.bool_]

_MOST_PIXELS = 10_000  # a side; more is no camera's, but a typing error that takes all memory
_ALIKE = 4.0
_LEAST_CONTRAST = 20.0
_SATURATED_PART = 0.3
_SECOND_PART = 0.25
_EDGE_PART = 0.10


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A target with a black marker in each corner, as the chain needs to know it.

    Attributes
    ----------
    width_m, height_m
        Size [m].
    marker_centres_m : (4, 2)
        Right and up of the markers: upper left, upper right, lower right, lower left [m].
    mm_per_px
        Of the rectified picture; Malan's is 6.67: a target of 2 m on 300 pixels.
    corners_px : (4, 2)
        Columns and rows where the markers are about, in the same order; left out: the dark marks that lie furthest
        out. Malan picked them by hand on the first picture of a day.
    shape_px
        Rows and columns that pictures must have; left out: any.

    Raises
    ------
    InvalidInputError
        Wrong shapes, or a size or scale that is not positive.
    """

    width_m: float = 2.0
    height_m: float = 2.0
    marker_centres_m: tuple[tuple[float, float], ...] = ((-0.85, 0.85), (0.85, 0.85), (0.85, -0.85), (-0.85, -0.85))
    mm_per_px: float = 2000.0 / 300.0
    corners_px: tuple[tuple[float, float], ...] | None = None
    shape_px: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        for name in ("width_m", "height_m", "mm_per_px"):
            as_positive(name, getattr(self, name))
        pixels = 1e3 * max(self.width_m, self.height_m) / self.mm_per_px
        if not 10.0 <= pixels <= _MOST_PIXELS:
            raise InvalidInputError(
                f"`mm_per_px` must make 10 to {_MOST_PIXELS} pixels of the target, got {self.mm_per_px!r}"
            )
        for name in ("marker_centres_m", "corners_px"):
            value = getattr(self, name)
            if value is not None:
                as_float_array(name, value, (4, 2))


def marker_threshold(darkest: float, lightest: float) -> float:
    """Return the brightness below which a pixel is a marker's (5.2)."""
    return darkest + 0.2 * lightest


def beam_threshold(average: float, lightest: float) -> float:
    """Return the brightness above which a pixel is the beam's (5.3)."""
    return 0.5 * (average + lightest)


def weighted_centroid(image: FloatArray, mask: Mask) -> FloatArray:
    """Return column and row of the brightness-weighted centroid of the masked pixels (5.4).

    Parameters
    ----------
    image : (row, column)
        Brightness.
    mask : (row, column)
        Pixels that count.
    """
    row, column = np.nonzero(mask)
    weight = image[mask]
    return np.asarray(np.array([np.sum(column * weight), np.sum(row * weight)]) / np.sum(weight))


def find_spot(image: npt.ArrayLike, board: Board | None = None) -> Spot:
    """Find a heliostat's image on a target.

    Parameters
    ----------
    image : (row, column) or (row, column, channel)
        The picture, 8 or 16 bits.
    board
        The target; left out: Malan's, 2 m square.

    Notes
    -----
    A picture that tells nothing is a `Spot` with its reason, not an error: a day's pictures go on.
    """
    plan = board or Board()
    grey = as_grey(image)
    if min(grey.shape) < LEAST_PX or (plan.shape_px is not None and grey.shape != plan.shape_px):
        wanted = f"{plan.shape_px[0]} x {plan.shape_px[1]}" if plan.shape_px else f"{LEAST_PX} or more each way"
        return no_spot(SpotStatus.WRONG_SIZE, f"{grey.shape[0]} x {grey.shape[1]} pixels, wanted {wanted}")
    corners = _marker_px(grey, plan)
    if corners is None:
        return no_spot(SpotStatus.NO_MARKERS, "no four dark markers of like size; light or black level?")
    shape = (round(1e3 * plan.height_m / plan.mm_per_px), round(1e3 * plan.width_m / plan.mm_per_px))
    given_from_flat = _homography(_flat_px(np.array(plan.marker_centres_m), plan, shape), corners)
    if given_from_flat is None:
        return no_spot(SpotStatus.NO_MARKERS, "the markers lie on one line")
    flat = skimage("transform").warp(grey, given_from_flat, output_shape=shape, order=1, preserve_range=True)
    return _spot(flat, plan, given_from_flat)


def _flat_px(point_m: FloatArray, plan: Board, shape: tuple[int, int]) -> FloatArray:
    """Column and row in the rectified picture of right and up on the target."""
    scale = 1e3 / plan.mm_per_px
    return np.stack(
        [0.5 * (shape[1] - 1) + scale * point_m[:, 0], 0.5 * (shape[0] - 1) - scale * point_m[:, 1]], axis=1
    )


def _homography(from_px: FloatArray, to_px: FloatArray) -> Any | None:
    """Projective map that takes four points to four others."""
    kind = skimage("transform").ProjectiveTransform
    if hasattr(kind, "from_estimate"):
        found = kind.from_estimate(from_px, to_px)
        return found if found else None
    found = kind()
    return found if found.estimate(from_px, to_px) else None


def _marker_px(grey: FloatArray, plan: Board) -> FloatArray | None:
    """Columns and rows of the four markers' centres, weighted by darkness; None if there are not four."""
    threshold = marker_threshold(float(grey.min()), float(grey.max()))
    labels = skimage("measure").label(grey < threshold, connectivity=2)
    size = grey.shape[0] * grey.shape[1]
    marks = [
        (region.centroid_weighted[::-1], region.area)
        for region in skimage("measure").regionprops(labels, intensity_image=threshold - grey)
        if 4 <= region.area <= 0.03 * size and region.extent > 0.5
    ]
    if len(marks) < 4:
        return None
    place, area = np.array([mark[0] for mark in marks]), np.array([mark[1] for mark in marks])
    alike = (area > np.median(np.sort(area)[-4:]) / _ALIKE) & (area < np.median(np.sort(area)[-4:]) * _ALIKE)
    place = place[alike]
    if len(place) < 4:
        return None
    index = _outermost(place) if plan.corners_px is None else _nearest(place, np.array(plan.corners_px))
    return place[index] if len(set(index)) == 4 else None


def _outermost(place: FloatArray) -> list[int]:
    """Upper left, upper right, lower right, lower left of marks."""
    x, y = place.T
    return [int(np.argmin(x + y)), int(np.argmax(x - y)), int(np.argmax(x + y)), int(np.argmin(x - y))]


def _nearest(place: FloatArray, wanted: FloatArray) -> list[int]:
    return [int(np.argmin(np.linalg.norm(place - point, axis=1))) for point in wanted]


def _spot(flat: FloatArray, plan: Board, given_from_flat: Any) -> Spot:
    """Find the beam in the rectified picture."""
    average, lightest = float(flat.mean()), float(flat.max())
    threshold = beam_threshold(average, lightest)
    if lightest - float(np.median(flat)) < _LEAST_CONTRAST:
        return no_spot(
            SpotStatus.NO_SPOT, f"nothing brighter than the target: {lightest:.0f}, {average:.0f} on average"
        )
    labels = skimage("measure").label(flat > threshold, connectivity=2)
    regions = skimage("measure").regionprops(labels, intensity_image=flat)
    weight = np.array([region.area * region.intensity_mean for region in regions])
    order = np.argsort(-weight)
    best = regions[order[0]]
    if best.area < 9:
        return no_spot(SpotStatus.NO_SPOT, f"single bright pixels only, {best.area:.0f} at most together")
    mask = np.asarray(labels == best.label)
    # what the warp interpolates next to a clipped pixel is just below full scale
    clipped = float(np.mean(flat[mask] >= 254.5))
    if clipped > _SATURATED_PART:
        return no_spot(SpotStatus.SATURATED, f"{100 * clipped:.0f} % of the beam is at full scale; expose less")
    if len(order) > 1 and weight[order[1]] > _SECOND_PART * weight[order[0]]:
        part = 100.0 * weight[order[1]] / weight[order[0]]
        return no_spot(SpotStatus.TWO_SPOTS, f"a second image of {part:.0f} % of the first; send one away")
    # the outermost pixels are half tower: look at three rows on each side
    edge = np.concatenate([mask[:3].any(0), mask[-3:].any(0), mask[:, :3].any(1), mask[:, -3:].any(1)])
    if edge.sum() > _EDGE_PART * np.sqrt(best.area):
        return no_spot(SpotStatus.OFF_TARGET, "the beam runs over the target's edge; its centroid would be wrong")
    centre = weighted_centroid(flat, mask)
    scale = 1e-3 * plan.mm_per_px
    middle = 0.5 * np.array([flat.shape[1] - 1, flat.shape[0] - 1])
    right_up = (centre - middle) * scale * np.array([1.0, -1.0])
    return Spot(
        status=SpotStatus.OK,
        centre_m=read_only(right_up),
        centre_px=read_only(np.asarray(given_from_flat(centre[None])[0])),
        area_m2=float(best.area) * scale**2,
    )
