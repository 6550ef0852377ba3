"""Which transmitters each receiver sees: past its own plate, neighbouring mirrors and the tower."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError
from rfpose.layout.maps import Mirrors
from rfpose.layout.sight import _kernels

__all__ = ["Plates", "Tower", "discs_lit", "visible"]

_HAIR = 1e-6
"""Share of a plate's diagonal by which a flush receiver stands out of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plates:
    """Rectangular mirrors, all alike, centred ``arm_m`` from the pivot along the normal.

    Attributes
    ----------
    width_m, height_m
        Along the mirror's x and y [m].
    arm_m
        [m].
    flush
        The side out of which a receiver looks that lies in the plate's own plane, within its outline.
    """

    width_m: float
    height_m: float
    arm_m: float = 0.0
    flush: Literal["front", "back"] = "front"

    def __post_init__(self) -> None:
        as_positive("width_m", self.width_m)
        as_positive("height_m", self.height_m)
        if self.flush not in ("front", "back"):
            raise InvalidInputError(f"`flush` must be 'front' or 'back', got {self.flush!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Tower:
    """An upright cylinder.

    Attributes
    ----------
    centre_enu_m, radius_m
        From above [m].
    bottom_m, top_m
        Heights in the site frame [m].
    """

    radius_m: float
    top_m: float
    centre_enu_m: tuple[float, float] = (0.0, 0.0)
    bottom_m: float = 0.0

    def __post_init__(self) -> None:
        as_positive("radius_m", self.radius_m)
        if not self.top_m > self.bottom_m:
            raise InvalidInputError(f"`top_m` must be above `bottom_m`, got {self.top_m} and {self.bottom_m}")


def visible(
    transmitter_enu_m: npt.ArrayLike, mirrors: Mirrors, plates: Plates, *, tower: Tower | None = None
) -> npt.NDArray[np.bool_]:
    """Return which transmitters each receiver sees (mirror, receiver, transmitter), by straight rays.

    A receiver is where ``mirrors`` puts it: in front of its plate, behind it, or, outside the rectangle, beside it,
    where it looks both ways. One that lies in the plate (an antenna flush with it) looks out of the side that
    ``plates`` says. Edges are sharp: no diffraction.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    mirrors
        One posture; call again for other instants.
    plates, tower
        See there.
    """
    transmitter = np.array(as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3)))
    receiver = _lifted(mirrors, plates)
    centre = mirrors.pivot_enu_m + plates.arm_m * mirrors.normal_enu
    half_x, half_y = 0.5 * plates.width_m, 0.5 * plates.height_m
    reach = float(np.hypot(half_x, half_y))
    # a plate lies within one cell's side of the cell of its centre, so a ray's own cell and the eight about it suffice
    cell = max(2.0 * reach, float(np.ptp(centre[:, :2], axis=0).max()) / 1000.0, 1e-9)
    origin = centre[:, :2].min(axis=0)
    start, member = _cells(centre, origin, cell)
    out = np.empty((*receiver.shape[:2], len(transmitter)), np.uint8)
    cylinder = np.zeros(5)
    if tower is not None:
        cylinder[:] = (*tower.centre_enu_m, tower.radius_m, tower.bottom_m, tower.top_m)
    _kernels.visible_rows(
        transmitter, receiver, centre, mirrors.rot_enu_from_mirror, half_x, half_y, reach,
        float(centre[:, 2].max() + reach), cylinder, float(origin[0]), float(origin[1]), cell, start, member, out,
    )  # fmt: skip
    return out.astype(np.bool_)


def _lifted(mirrors: Mirrors, plates: Plates) -> FloatArray:
    """(mirror, receiver, xyz) places of the receivers, those within a plate a hair's breadth out of it [m]."""
    hair = _HAIR * float(np.hypot(plates.width_m, plates.height_m))
    place = mirrors.receiver_mirror_m
    inside = (np.abs(place[..., 0]) < 0.5 * plates.width_m) & (np.abs(place[..., 1]) < 0.5 * plates.height_m)
    flush = inside & (np.abs(place[..., 2] - plates.arm_m) < hair)
    offset = np.where(flush, hair if plates.flush == "front" else -hair, 0.0)
    return np.asarray(mirrors.receiver_enu_m + offset[..., None] * mirrors.normal_enu[:, None])


def _cells(centre: FloatArray, origin: FloatArray, cell: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the plates by cell: ``member[start[i, j]:start[i, j + 1]]`` stand in cell (i, j)."""
    index = np.floor((centre[:, :2] - origin) / cell).astype(np.int64)
    n_column, n_row = index.max(axis=0) + 1
    flat = index[:, 0] * n_row + index[:, 1]
    member = np.argsort(flat, kind="stable")
    count = np.bincount(flat, minlength=n_column * n_row).reshape(n_column, n_row)
    before = np.concatenate([[0], np.cumsum(count.sum(axis=1))[:-1]])
    start = np.concatenate([np.zeros((n_column, 1), np.int64), np.cumsum(count, axis=1)], axis=1) + before[:, None]
    return np.ascontiguousarray(start), member


def discs_lit(offset_m: npt.ArrayLike, *, diameter_m: float, n_line: int = 400) -> float:
    """Return the part of a disc that discs of its size, all facing the light, leave lit (Edwards 1979, App. A).

    Parameters
    ----------
    offset_m : (disc, 2)
        Centres of the shading discs from that of the shaded one, in the plane across the light [m].
    diameter_m
        Of all discs [m].
    n_line
        Lines into which the disc is cut.
    """
    offset = as_float_array("offset_m", offset_m, ("disc", 2))
    radius = 0.5 * as_positive("diameter_m", diameter_m)
    offset = offset[np.linalg.norm(offset, axis=1) < 2.0 * radius]
    if not len(offset):
        return 1.0
    x = radius * (2.0 * (np.arange(n_line) + 0.5) / n_line - 1.0)
    half = np.sqrt(radius**2 - x**2)
    width = np.sqrt(np.maximum(radius**2 - (x - offset[:, :1]) ** 2, 0.0))
    low = np.clip(offset[:, 1:] - width, -half, half)
    high = np.clip(offset[:, 1:] + width, -half, half)
    order = np.argsort(low, axis=0)
    low, high = np.take_along_axis(low, order, axis=0), np.take_along_axis(high, order, axis=0)
    covered = np.zeros(n_line)
    top = -half
    for k in range(len(offset)):
        covered += np.maximum(high[k] - np.maximum(low[k], top), 0.0)
        top = np.maximum(top, high[k])
    return float(1.0 - covered.sum() / (2.0 * half.sum()))
