"""What a mirror does with the sun: where the beam goes, where it meets a target, how much of it is caught."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array, as_positive

__all__ = ["intercept_ratio", "reflect", "target_offset_m"]


def reflect(normal_enu: npt.ArrayLike, sun_enu: npt.ArrayLike) -> FloatArray:
    """Return the direction into which a mirror sends the sun.

    Parameters
    ----------
    normal_enu, sun_enu : (..., xyz)
        Mirror normal and direction towards the sun.

    Returns
    -------
    (..., xyz)
        Unit vectors; NaN where the sun is behind the mirror.
    """
    normal, sun = geometry.unit(normal_enu), geometry.unit(sun_enu)
    cosine = np.sum(normal * sun, axis=-1, keepdims=True)
    return np.asarray(np.where(cosine > 0.0, 2.0 * cosine * normal - sun, np.nan))


def target_offset_m(
    centre_enu_m: npt.ArrayLike,
    beam_enu: npt.ArrayLike,
    *,
    target_enu_m: npt.ArrayLike,
    target_normal_enu: npt.ArrayLike,
) -> FloatArray:
    """Return where beams meet a plane target, from its centre [m].

    Parameters
    ----------
    centre_enu_m, beam_enu : (..., xyz)
        Mirror centres [m] and directions of the beams.
    target_enu_m : (xyz)
        Centre of the target.
    target_normal_enu : (xyz)
        Outward normal of the target's plane, tilted or not; Malan's (4.22) is the direction towards the heliostat.

    Returns
    -------
    (..., 2)
        Right and up, as seen looking at the target from in front [m]; NaN where the beam misses the plane's front.
    """
    centre = as_float_array("centre_enu_m", centre_enu_m, ("...", 3), finite=False)
    beam = geometry.unit(beam_enu)
    target = as_float_array("target_enu_m", target_enu_m, (3,))
    right, up, normal = np.moveaxis(geometry.rot_enu_from_mirror(target_normal_enu), -1, 0)
    against = -np.sum(beam * normal, axis=-1)
    height = np.sum((centre - target) * normal, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where((against > 1e-9) & (height > 0.0), height / against, np.nan)
    hit = centre + distance[..., None] * beam - target
    return np.stack([np.sum(hit * right, axis=-1), np.sum(hit * up, axis=-1)], axis=-1)


def intercept_ratio(
    normal_error_rad: npt.ArrayLike,
    *,
    sun_rad: float = 9.3e-3,
    slope_error_rad: float = 1.5e-3,
    aperture_ratio: float = 1.0,
) -> FloatArray:
    """Return the part of a heliostat's round image that a round aperture catches [1]_.

    Parameters
    ----------
    normal_error_rad : (...)
        Error of the mirror normal [rad].
    sun_rad
        Angle subtended by the sun [rad].
    slope_error_rad
        Mean slope error of the mirror [rad].
    aperture_ratio
        Radius of the aperture over that of the image; Malan's is one.

    References
    ----------
    .. [1] Malan, A heliostat field control system, (3.3): overlap of two equal discs, here of any two.
    """
    error = np.abs(as_float_array("normal_error_rad", normal_error_rad, ("...",)))
    big = as_positive("aperture_ratio", aperture_ratio)
    radius = 0.5 * as_positive("sun_rad", sun_rad) + slope_error_rad
    d = error / radius  # between the middles, in radii of the image
    inside = d <= abs(big - 1.0)
    apart = d >= big + 1.0
    safe = np.where(inside | apart, max(big, 1.0), d)
    image = np.arccos(np.clip((safe**2 + 1.0 - big**2) / (2.0 * safe), -1.0, 1.0))
    aperture = np.arccos(np.clip((safe**2 + big**2 - 1.0) / (2.0 * safe * big), -1.0, 1.0))
    kite = (1.0 + big - safe) * (safe + 1.0 - big) * (safe - 1.0 + big) * (safe + 1.0 + big)
    lens = (image + big**2 * aperture - 0.5 * np.sqrt(np.maximum(kite, 0.0))) / np.pi
    return np.asarray(np.where(apart, 0.0, np.where(inside, min(1.0, big**2), lens)))
