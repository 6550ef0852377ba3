"""Frames, rotations and directions.

Site frame ENU: x east, y north, z up, metres. Azimuth from north, clockwise; elevation from the horizontal.
Mirror frame: z along the mirror normal, x horizontal, y up the mirror; seen from the front, x points right and
y up, so that points numbered counter-clockwise in (x, y) are counter-clockwise as viewed from the front.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import GeometryError

__all__ = [
    "angle_between_rad",
    "azimuth_elevation_from_enu",
    "bisector_enu",
    "cross_matrix",
    "enu_from_azimuth_elevation",
    "enu_from_wgs84",
    "is_collinear",
    "rot_enu_from_mirror",
    "unit",
]

_WGS84_A, _WGS84_E2 = 6378137.0, 6.69437999014e-3


def unit(vector: npt.ArrayLike) -> FloatArray:
    """Scale vectors to length one.

    Parameters
    ----------
    vector : (..., xyz)
        Any frame, any unit. A zero or NaN vector gives NaN.

    Returns
    -------
    (..., xyz)
    """
    v = as_float_array("vector", vector, ("...", 3), finite=False)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def enu_from_azimuth_elevation(azimuth_rad: npt.ArrayLike, elevation_rad: npt.ArrayLike) -> FloatArray:
    """Return the unit vector (east, north, up) of a direction.

    Parameters
    ----------
    azimuth_rad : (...)
        From north, clockwise [rad].
    elevation_rad : (...)
        From the horizontal [rad].

    Returns
    -------
    (..., xyz)
    """
    azimuth, elevation = np.broadcast_arrays(np.asarray(azimuth_rad, np.float64), np.asarray(elevation_rad, np.float64))
    return np.stack(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
    )


def azimuth_elevation_from_enu(direction_enu: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return azimuth in [0, 2π) and elevation in [−π/2, π/2] of a direction [rad].

    Parameters
    ----------
    direction_enu : (..., xyz)
        Need not be of unit length. NaN gives NaN.
    """
    v = as_float_array("direction_enu", direction_enu, ("...", 3), finite=False)
    azimuth = np.mod(np.arctan2(v[..., 0], v[..., 1]), 2.0 * np.pi)
    elevation = np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1]))
    return azimuth, elevation


def rot_enu_from_mirror(normal_enu: npt.ArrayLike) -> FloatArray:
    """Return the rotation of a mirror on an azimuth-elevation mount: ``v_enu = rot @ v_mirror``.

    Columns are the mirror's x (horizontal, to the right seen from the front), y (up the mirror) and z (the
    normal). For a normal straight up or down azimuth is undefined and taken as north.

    Parameters
    ----------
    normal_enu : (..., xyz)
        Mirror normal, need not be of unit length. NaN gives NaN.

    Returns
    -------
    (..., 3, 3)
    """
    z = unit(normal_enu)
    horizontal = np.hypot(z[..., 0], z[..., 1])
    flat = horizontal < 1e-12
    safe = np.where(flat, 1.0, horizontal)
    x = np.stack(
        [
            np.where(flat, -1.0, -z[..., 1] / safe),
            np.where(flat, 0.0, z[..., 0] / safe),
            np.zeros_like(safe),
        ],
        axis=-1,
    )
    x = np.where(np.isnan(z[..., :1]), np.nan, x)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def bisector_enu(first_enu: npt.ArrayLike, second_enu: npt.ArrayLike) -> FloatArray:
    """Return the unit vector halfway between two directions: the normal that reflects one into the other.

    Parameters
    ----------
    first_enu, second_enu : (..., xyz)
        Directions, need not be of unit length.

    Returns
    -------
    (..., xyz)
        NaN where the directions are opposite.
    """
    total = unit(first_enu) + unit(second_enu)
    opposite = np.linalg.norm(total, axis=-1, keepdims=True) < 1e-9
    return unit(np.where(opposite, np.nan, total))


def angle_between_rad(first: npt.ArrayLike, second: npt.ArrayLike) -> FloatArray:
    """Return the angle between two vectors [rad], accurate for small angles too.

    Parameters
    ----------
    first, second : (..., xyz)
        Same frame; need not be of unit length.
    """
    a, b = unit(first), unit(second)
    return np.asarray(2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def is_collinear(points_m: npt.ArrayLike, *, tolerance: float = 1e-3) -> bool:
    """Tell whether points lie on one line, to ``tolerance`` of their largest extent.

    Parameters
    ----------
    points_m : (point, xyz)
        Three or more points, any frame [m].

    Raises
    ------
    GeometryError
        Fewer than three points.
    """
    p = as_float_array("points_m", points_m, ("point", 3))
    if len(p) < 3:
        raise GeometryError(f"`points_m` must hold three or more points, got {len(p)}")
    extent = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    return bool(extent[1] <= tolerance * max(extent[0], np.finfo(float).tiny))


def cross_matrix(vector: FloatArray) -> FloatArray:
    """Return the matrices (..., 3, 3) with ``matrix @ x = vector × x``."""
    out = np.zeros((*vector.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -vector[..., 2], vector[..., 1]
    out[..., 1, 0], out[..., 1, 2] = vector[..., 2], -vector[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -vector[..., 1], vector[..., 0]
    return out


def enu_from_wgs84(latitude_longitude_height: npt.ArrayLike, origin: npt.ArrayLike) -> FloatArray:
    """Return positions in the ENU frame about an origin, by way of ECEF.

    Parameters
    ----------
    latitude_longitude_height : (..., 3)
        WGS84 [deg, deg, m].
    origin : (3,)
        The same, of the site frame's origin.

    Returns
    -------
    (..., xyz)
        Site ENU [m].
    """
    start = np.asarray(origin, np.float64)
    difference = _ecef(np.asarray(latitude_longitude_height, np.float64)) - _ecef(start)
    latitude, longitude = np.radians(start[:2])
    s, c, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    enu_from_ecef = np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    return np.asarray(difference @ enu_from_ecef.T)


def _ecef(position: FloatArray) -> FloatArray:
    latitude, longitude, height = np.radians(position[..., 0]), np.radians(position[..., 1]), position[..., 2]
    prime = _WGS84_A / np.sqrt(1.0 - _WGS84_E2 * np.sin(latitude) ** 2)
    across = (prime + height) * np.cos(latitude)
    return np.stack(
        [
            across * np.cos(longitude),
            across * np.sin(longitude),
            (prime * (1.0 - _WGS84_E2) + height) * np.sin(latitude),
        ],
        axis=-1,
    )
