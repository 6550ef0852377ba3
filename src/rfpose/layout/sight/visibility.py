"""Which transmitters each receiver sees: past its own plate, neighbouring mirrors and the tower."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError
from rfpose.geometry import unit
from rfpose.layout.maps import PosedMirrors
from rfpose.layout.sight import _kernels

__all__ = ["Plates", "Tower", "discs_lit", "lit_share", "visible"]

_HAIR = 1e-6
"""Share of a plate's diagonal by which a flush receiver stands out of it."""
_FAR = 1e5
"""How many fields away the sun is put."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plates:
    """Mirrors, all alike, centred ``arm_m`` from the pivot along the normal.

    Attributes
    ----------
    width_m, height_m
        Along the mirror's x and y [m]; equal for a disc.
    shape
        ``rectangle`` or ``disc``.
    arm_m
        [m].
    flush
        The side out of which a receiver looks that lies in the plate's own plane, within its outline.
    """

    width_m: float
    height_m: float
    arm_m: float = 0.0
    shape: Literal["rectangle", "disc"] = "rectangle"
    flush: Literal["front", "back"] = "front"

    def __post_init__(self) -> None:
        as_positive("width_m", self.width_m)
        as_positive("height_m", self.height_m)
        if self.shape not in ("rectangle", "disc") or (self.shape == "disc" and self.width_m != self.height_m):
            raise InvalidInputError("`shape` must be 'rectangle', or 'disc' with `width_m` equal to `height_m`")
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
    transmitter_enu_m: npt.ArrayLike, mirrors: PosedMirrors, plates: Plates, *, tower: Tower | None = None
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
    who = np.arange(len(mirrors.pivot_enu_m))
    return _free(transmitter, _lifted(mirrors, plates), who, mirrors, plates, tower)


def lit_share(
    mirrors: PosedMirrors,
    plates: Plates,
    *,
    sun_enu: npt.ArrayLike,
    aim_enu_m: npt.ArrayLike | None = None,
    rows: npt.ArrayLike | None = None,
    tower: Tower | None = None,
    n_side: int = 20,
) -> FloatArray:
    """Return the share of each plate that the sun reaches and, with an aim point, whose light reaches that.

    The same rays as for radio: from points all over the plate, each for the same area, past all other plates and the
    tower. No penumbra: the sun is a point.

    Parameters
    ----------
    mirrors
        One posture.
    plates, tower
        What stands in the way.
    sun_enu : (xyz,)
        Towards the sun, above the horizon.
    aim_enu_m : (xyz,), optional
        Where the light goes [m].
    rows : (row,), optional
        Which mirrors; all by default.
    n_side
        Points along a plate's side; their square are on it.

    Returns
    -------
    (row,)
        Zero where the sun stands behind the plate, or the plate's back is to the aim point.

    Raises
    ------
    InvalidInputError
        A sun that is not above the horizon.
    """
    sun = unit(as_float_array("sun_enu", sun_enu, (3,)))
    if not sun[2] > 0.0:
        raise InvalidInputError(f"`sun_enu` must point above the horizon, got {sun}")
    who = np.arange(len(mirrors.pivot_enu_m)) if rows is None else np.asarray(rows, np.int64)
    points = _points(plates, n_side)
    rot = mirrors.rot_enu_from_mirror[who]
    place = (mirrors.pivot_enu_m[who])[:, None] + np.einsum("mab,kb->mka", rot, points)
    extent = float(np.ptp(place.reshape(-1, 3), axis=0).max() + np.ptp(mirrors.pivot_enu_m, axis=0).max())
    sources = [place.reshape(-1, 3).mean(axis=0) + _FAR * max(extent, 1e-9) * sun]
    if aim_enu_m is not None:
        sources.append(as_float_array("aim_enu_m", aim_enu_m, (3,)))
    free = _free(np.array(sources), place, who, mirrors, plates, tower)
    return np.asarray(free.all(axis=2).mean(axis=1))


def _points(plates: Plates, n_side: int) -> FloatArray:
    """(point, xyz) places on a plate's face, a hair in front of it, each for the same area, in the mirror frame [m]."""
    grid = (np.arange(n_side) + 0.5) / n_side
    u, v = (a.ravel() for a in np.meshgrid(grid, grid))
    height = np.full(u.size, plates.arm_m + _HAIR * float(np.hypot(plates.width_m, plates.height_m)))
    if plates.shape == "disc":
        k = np.arange(n_side**2) + 0.5
        radius, angle = 0.5 * plates.width_m * np.sqrt(k / n_side**2), np.pi * (3.0 - np.sqrt(5.0)) * k
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return np.stack([plates.width_m * (u - 0.5), plates.height_m * (v - 0.5), height], axis=1)


def _free(
    source_enu_m: FloatArray,
    place_enu_m: FloatArray,
    who: npt.NDArray[np.int64],
    mirrors: PosedMirrors,
    plates: Plates,
    tower: Tower | None,
) -> npt.NDArray[np.bool_]:
    """(row, place, source) whether the way is free from places on or about plate ``who[row]``."""
    centre = mirrors.pivot_enu_m + plates.arm_m * mirrors.normal_enu
    half_x, half_y = 0.5 * plates.width_m, 0.5 * plates.height_m
    disc = plates.shape == "disc"
    reach = half_x if disc else float(np.hypot(half_x, half_y))
    # a plate lies within one cell's side of the cell of its centre, so a ray's own cell and the eight about it suffice
    cell = max(2.0 * reach, float(np.ptp(centre[:, :2], axis=0).max()) / 1000.0, 1e-9)
    origin = centre[:, :2].min(axis=0)
    start, member = _cells(centre, origin, cell)
    out = np.empty((*place_enu_m.shape[:2], len(source_enu_m)), np.uint8)
    cylinder = np.zeros(5)
    if tower is not None:
        cylinder[:] = (*tower.centre_enu_m, tower.radius_m, tower.bottom_m, tower.top_m)
    _kernels.visible_rows(
        len(out), source_enu_m, place_enu_m, who, centre, mirrors.rot_enu_from_mirror, half_x, half_y, disc, reach,
        float(centre[:, 2].max() + reach), cylinder, float(origin[0]), float(origin[1]), cell, start, member, out,
    )  # fmt: skip
    return out.astype(np.bool_)


def _lifted(mirrors: PosedMirrors, plates: Plates) -> FloatArray:
    """(mirror, receiver, xyz) places of the receivers, those within a plate a hair's breadth out of it [m]."""
    hair = _HAIR * float(np.hypot(plates.width_m, plates.height_m))
    place = mirrors.receiver_mirror_m
    inside = (np.abs(place[..., 0]) < 0.5 * plates.width_m) & (np.abs(place[..., 1]) < 0.5 * plates.height_m)
    if plates.shape == "disc":
        inside = np.hypot(place[..., 0], place[..., 1]) < 0.5 * plates.width_m
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
