"""Fields of heliostats: radial staggered and cornfield layouts."""

from __future__ import annotations

import numpy as np

from rfpose.checks import FloatArray, as_positive
from rfpose.errors import GeometryError, InvalidInputError

__all__ = ["cornfield", "radial_staggered"]


def radial_staggered(
    n_heliostat: int,
    *,
    first_radius_m: float,
    diagonal_m: float,
    row_spacing_m: float | None = None,
    height_m: float = 0.0,
) -> FloatArray:
    """Return heliostats on circles about the tower at the origin, each in the gap of the two in front of it.

    A zone begins with the azimuth spacing ``diagonal_m`` and keeps its number a row; where the spacing has doubled a
    new zone begins. Rows are filled from the tower outwards.

    Parameters
    ----------
    n_heliostat
        How many.
    first_radius_m
        Of the first row [m].
    diagonal_m
        A mirror's diagonal with its clearance: no two heliostats are closer [m].
    row_spacing_m
        Between rows; ``diagonal_m``·√3/2 (a triangle in the densest rows) by default, and no less [m].

    Returns
    -------
    (heliostat, xyz) [m]
    """
    if n_heliostat < 1:
        raise InvalidInputError(f"`n_heliostat` must be at least one, got {n_heliostat}")
    radius = as_positive("first_radius_m", first_radius_m)
    width = as_positive("diagonal_m", diagonal_m)
    closest = width * np.sqrt(3.0) / 2.0
    step = closest if row_spacing_m is None else as_positive("row_spacing_m", row_spacing_m)
    if step < closest * (1.0 - 1e-9):
        raise GeometryError(f"`row_spacing_m` must be at least {closest:.6g} m for mirrors {width:g} m apart")
    if radius < width:
        raise GeometryError(f"`first_radius_m` must be at least `diagonal_m`, {width:g} m")
    rows: list[FloatArray] = []
    count = 0
    in_zone = int(np.pi / np.arcsin(width / (2.0 * radius)))
    zone_start = radius
    k = 0
    while count < n_heliostat:
        if radius >= 2.0 * zone_start:
            # a new zone: its first row keeps a whole diagonal from the last row of the old
            radius += width - step
            zone_start, k = radius, 0
            in_zone = int(np.pi / np.arcsin(width / (2.0 * radius)))
        angle = 2.0 * np.pi * (np.arange(in_zone) + 0.5 * (k % 2)) / in_zone
        rows.append(np.stack([radius * np.sin(angle), radius * np.cos(angle), np.full(in_zone, height_m)], axis=1))
        count += in_zone
        radius += step
        k += 1
    return np.concatenate(rows)[:n_heliostat]


def cornfield(
    n_heliostat: int,
    *,
    column_m: float,
    row_m: float,
    inner_radius_m: float = 0.0,
    staggered: bool = True,
    height_m: float = 0.0,
) -> FloatArray:
    """Return heliostats in straight rows, every other one shifted by half a column: those nearest the tower.

    Parameters
    ----------
    n_heliostat
        How many.
    column_m, row_m
        East-west and north-south spacing [m].
    inner_radius_m
        Kept free about the tower at the origin [m].

    Returns
    -------
    (heliostat, xyz) [m]
    """
    if n_heliostat < 1:
        raise InvalidInputError(f"`n_heliostat` must be at least one, got {n_heliostat}")
    column, row = as_positive("column_m", column_m), as_positive("row_m", row_m)
    if inner_radius_m < 0.0:
        raise InvalidInputError("`inner_radius_m` must not be negative")
    reach = np.sqrt(inner_radius_m**2 + n_heliostat * column * row / np.pi) + 2.0 * np.hypot(column, row)
    i = np.arange(-int(reach / row) - 1, int(reach / row) + 2)
    j = np.arange(-int(reach / column) - 1, int(reach / column) + 2)
    east = column * (j[None, :] + (0.5 * (i[:, None] % 2) if staggered else 0.0 * i[:, None]))
    north = np.broadcast_to(row * i[:, None].astype(np.float64), east.shape)
    place = np.stack([east.ravel(), north.ravel(), np.full(east.size, float(height_m))], axis=1)
    distance = np.hypot(place[:, 0], place[:, 1])
    order = np.lexsort((place[:, 1], place[:, 0], np.round(distance, 9)))
    order = order[distance[order] >= inner_radius_m]
    return np.asarray(place[order[:n_heliostat]])
