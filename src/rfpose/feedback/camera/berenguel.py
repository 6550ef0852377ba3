"""Berenguel's chain: target and beam by grey levels in the camera's own pixels, then corrections by encoder steps.

References
----------
Berenguel et al., An artificial vision-based control system for automatic heliostat positioning offset correction in a
central receiver solar power plant, Solar Energy 76 (2004), §4 and Table 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.camera.spot import Spot, SpotStatus, as_grey, no_spot, skimage

__all__ = [
    "ENCODER_STEP_RAD",
    "Correction",
    "CorrectionStatus",
    "Plate",
    "arrival_s",
    "correct_offset",
    "find_beam",
    "find_target_px",
    "step_mm",
]

ENCODER_STEP_RAD = np.pi / 4096.0
"""Turn of an axis for one encoder step."""

_RUN = 3
_LEAST_CONTRAST = 20.0
_SATURATED_PART = 0.3
_SECOND_PART = 0.25
_LEAST_AREA_PX = 25


@dataclass(frozen=True, slots=True, kw_only=True)
class Plate:
    """A plain target on a tower and how it appears in the picture.

    Attributes
    ----------
    width_m, height_m
        Size [m].
    mm_per_px
        Across; 3700 mm on 200 pixels.
    target_tilt_rad, camera_tilt_rad
        Of the target towards the ground and of the camera's line of sight above the horizon [rad]. The picture is
        shortened upwards by the cosine of their difference.
    shape_px
        Rows and columns of the pictures.
    shift
        Half the width, in levels, of what counts as target about the commonest level.
    """

    width_m: float = 3.70
    height_m: float = 3.66
    mm_per_px: float = 3700.0 / 200.0
    target_tilt_rad: float = 0.61
    camera_tilt_rad: float = 0.35
    shape_px: tuple[int, int] = (576, 768)
    shift: float = 30.0

    def __post_init__(self) -> None:
        for name in ("width_m", "height_m", "mm_per_px", "shift"):
            as_positive(name, getattr(self, name))

    @property
    def mm_per_px_up(self) -> float:
        """Millimetres of the target's plane for one pixel upwards."""
        return float(self.mm_per_px / np.cos(self.target_tilt_rad - self.camera_tilt_rad))


class CorrectionStatus(IntEnum):
    """How a correction ended."""

    CENTRED = 0
    NOT_SETTLED = 1
    NOT_SEEN = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Correction:
    """What was done to centre a beam.

    Attributes
    ----------
    status
        Whether it is centred to within an encoder step.
    steps : (axis,)
        Sum of the corrections, azimuth and elevation [encoder steps].
    offset_mm : (picture, 2)
        Right and up of the beam from the target's centre in each picture [mm].
    """

    status: CorrectionStatus
    steps: npt.NDArray[np.int64]
    offset_mm: FloatArray

    @property
    def n_correction(self) -> int:
        """Corrections that were sent."""
        return max(len(self.offset_mm) - 1, 0)


def find_target_px(image: npt.ArrayLike, plate: Plate | None = None) -> FloatArray | None:
    """Find the target's centre in a picture without beam: column and row [pixel]; None if it is not there.

    Parameters
    ----------
    image : (row, column)
        The target is about in the middle.
    plate
        The target; left out: his.

    Notes
    -----
    The commonest level of a rectangle about the middle, ± ``shift``, is target. From the middle up to the first row
    that is not, half the known height down again; 20 rows below that edge to the right, half the known width back.
    """
    plan = plate or Plate()
    grey = as_grey(image)
    if grey.shape != plan.shape_px:
        raise InvalidInputError(f"`image` must have {plan.shape_px} pixels, got {grey.shape}")
    rows, columns = grey.shape
    middle = grey[rows // 2 - 40 : rows // 2 + 40, columns // 2 - 40 : columns // 2 + 40]
    level = float(np.argmax(np.bincount(np.rint(middle).astype(np.int64).ravel(), minlength=256)))
    inside = np.abs(grey - level) < plan.shift
    top = _edge(inside[: rows // 2 + 1, columns // 2][::-1])
    if top is None:
        return None
    upper = rows // 2 - top
    right = _edge(inside[min(upper + 20, rows - 1), columns // 2 :])
    if right is None:
        return None
    half_height = 0.5e3 * plan.height_m / plan.mm_per_px_up
    half_width = 0.5e3 * plan.width_m / plan.mm_per_px
    return np.array([columns // 2 + right + 0.5 - half_width, upper - 0.5 + half_height])


def _edge(inside: npt.NDArray[np.bool_]) -> int | None:
    """Last index before the first run that is outside; None without an edge or if it begins outside."""
    outside = ~inside
    run = np.convolve(outside, np.ones(_RUN, np.int64), mode="valid") == _RUN
    if not run.any() or int(np.argmax(run)) == 0:
        return None
    return int(np.argmax(run)) - 1


def find_beam(
    image: npt.ArrayLike,
    target_px: npt.ArrayLike,
    plate: Plate | None = None,
    *,
    dark: npt.ArrayLike | None = None,
) -> Spot:
    """Find a heliostat's image as the largest bright figure of a picture; its box's middle is its centre.

    Parameters
    ----------
    image : (row, column)
        With the beam.
    target_px : (column, row)
        Of `find_target_px`.
    plate
        The target; left out: his.
    dark : (row, column)
        The picture without beam, to be taken off: needed where the low sun on the tower is as bright as the beam.

    Notes
    -----
    The threshold lies midway between what is commonly the brightest without beam (a level above 95 % of the pixels)
    and the brightest. Neighbours above it form figures; the largest is the beam, so that reflections on the tower's
    edge do not count.
    """
    plan = plate or Plate()
    grey = as_grey(image)
    if grey.shape != plan.shape_px:
        return no_spot(SpotStatus.WRONG_SIZE, f"{grey.shape} pixels, wanted {plan.shape_px}")
    full = grey >= 255.0
    if dark is not None:
        grey = grey - as_grey(dark)
    usual, brightest = float(np.percentile(grey, 95.0)), float(grey.max())
    if brightest - usual < _LEAST_CONTRAST:
        return no_spot(SpotStatus.NO_SPOT, f"nothing brighter than the target: {brightest:.0f} against {usual:.0f}")
    labels = skimage("measure").label(grey > 0.5 * (usual + brightest), connectivity=1)
    area = np.bincount(labels.ravel())
    area[0] = 0
    best = int(np.argmax(area))
    if area[best] < _LEAST_AREA_PX:
        return no_spot(SpotStatus.NO_SPOT, f"single bright pixels only, {area[best]} at most together")
    mask = labels == best
    clipped = float(np.mean(full[mask]))
    if clipped > _SATURATED_PART:
        return no_spot(SpotStatus.SATURATED, f"{100 * clipped:.0f} % of the beam is at full scale; expose less")
    second = int(np.sort(area)[-2])
    if second > _SECOND_PART * area[best]:
        return no_spot(SpotStatus.TWO_SPOTS, f"a second figure of {100 * second / area[best]:.0f} % of the first")
    row, column = np.nonzero(mask)
    if row.min() == 0 or column.min() == 0 or row.max() == grey.shape[0] - 1 or column.max() == grey.shape[1] - 1:
        return no_spot(SpotStatus.OFF_TARGET, "the beam runs out of the picture")
    centre = 0.5 * np.array([column.min() + column.max(), row.min() + row.max()])
    scale = 1e-3 * np.array([plan.mm_per_px, -plan.mm_per_px_up])
    return Spot(
        status=SpotStatus.OK,
        centre_m=read_only((centre - np.asarray(target_px)) * scale),
        centre_px=read_only(centre),
        area_m2=float(-area[best] * scale[0] * scale[1]),
    )


def step_mm(
    heliostat_m: npt.ArrayLike,
    *,
    target_m: npt.ArrayLike = (0.0, 8.180, 64.200),
    axis_height_m: float = 3.650,
    target_tilt_rad: float = 0.61,
    turn_rad: float = ENCODER_STEP_RAD,
    offset_m: npt.ArrayLike = (0.0, 0.0),
) -> FloatArray:
    """Return how far a beam moves on the target for a turn about each axis, right and up [mm] (Table 1).

    Parameters
    ----------
    heliostat_m : (xyz)
        East, north, up of its foot from the tower's [m].
    target_m : (xyz)
        The target's centre [m].
    axis_height_m
        Of the heliostat's centre above its foot [m].
    target_tilt_rad
        Of the target towards the ground [rad].
    turn_rad
        Turn of the beam. The table takes an encoder step; a mirror's turn moves the beam by twice itself.
    offset_m : (right, up)
        Where the beam is now [m]: the exact column of the table. Left out: the approximate one, at the centre.
    """
    helio = as_float_array("heliostat_m", heliostat_m, (3,))
    target = as_float_array("target_m", target_m, (3,))
    right, up = as_float_array("offset_m", offset_m, (2,))
    level = float(np.hypot(helio[0] - target[0], helio[1] - target[1]))
    height = float(target[2] - helio[2] - axis_height_m)
    rise = height + float(np.cos(target_tilt_rad)) * up
    up_mm = level * (np.tan(np.arctan2(rise, level) + turn_rad) - rise / level) * np.cos(target_tilt_rad)
    away = float(np.hypot(helio[1] - target[1], height))
    side = float(helio[0] - target[0]) + right
    right_mm = away * (np.tan(np.arctan2(side, away) + turn_rad) - side / away)
    return 1e3 * np.array([right_mm, up_mm])


def correct_offset(
    take_picture: Callable[[npt.NDArray[np.int64]], npt.ArrayLike],
    target_px: npt.ArrayLike,
    mm_per_step: npt.ArrayLike,
    *,
    plate: Plate | None = None,
    dark: npt.ArrayLike | None = None,
    max_correction: int = 4,
) -> Correction:
    """Centre a beam on the target by successive corrections.

    Parameters
    ----------
    take_picture
        Given the sum of the steps so far (azimuth, elevation): sends the heliostat there, waits and takes a picture.
    target_px : (column, row)
        Of `find_target_px`.
    mm_per_step : (2,)
        Right for a step of azimuth, up for one of elevation, of the beam [mm].
    plate
        The target; left out: his.
    dark : (row, column)
        As for `find_beam`.
    max_correction
        Give up after so many.
    """
    scale = as_float_array("mm_per_step", mm_per_step, (2,))
    if np.any(scale == 0.0):
        raise InvalidInputError("`mm_per_step` must not be zero")
    steps = np.zeros(2, np.int64)
    seen: list[FloatArray] = []
    status = CorrectionStatus.NOT_SETTLED
    for _ in range(max_correction + 1):
        spot = find_beam(take_picture(steps), target_px, plate, dark=dark)
        if spot.status != SpotStatus.OK:
            status = CorrectionStatus.NOT_SEEN
            break
        seen.append(1e3 * spot.centre_m)
        more = -np.rint(seen[-1] / scale).astype(np.int64)
        if not more.any():
            status = CorrectionStatus.CENTRED
            break
        if len(seen) <= max_correction:
            steps = steps + more
    return Correction(status=status, steps=steps, offset_mm=np.array(seen).reshape(-1, 2))


def arrival_s(
    time_s: npt.ArrayLike,
    centre_px: npt.ArrayLike,
    *,
    tolerance_px: float = 2.0,
    first_s: float = 18.0,
    last_s: float = 60.0,
) -> float:
    """Return when a heliostat counts as arrived: two successive centroids alike, else after the longest wait [s].

    Parameters
    ----------
    time_s : (picture,)
        Since the command; he takes one each 5 s [s].
    centre_px : (picture, 2)
        Centroids; NaN where no beam was seen.
    tolerance_px
        What the wind moves the camera by [pixel].
    first_s, last_s
        Shortest and longest wait [s].
    """
    times = as_float_array("time_s", time_s, ("picture",))
    centres = as_float_array("centre_px", centre_px, (len(times), 2), finite=False)
    late = times >= first_s
    times, centres = times[late], centres[late]
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    still = np.flatnonzero(moved < tolerance_px)
    return float(min(times[still[0] + 1], last_s)) if len(still) else float(last_s)
