"""A camera's measurements without pictures: spots with their noise, for many heliostats at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError
from rfpose.feedback import _kernels
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount, aim_rows, stack_mounts

__all__ = ["camera_measurements", "spot_sigma_rad", "spots_enu_m"]


def spot_sigma_rad(spot_sigma_m: npt.ArrayLike, distance_m: npt.ArrayLike) -> FloatArray:
    """Return the standard deviation of a mirror's normal for that of its spot: half the angle [rad]."""
    return np.asarray(0.5 * np.asarray(spot_sigma_m, np.float64) / np.asarray(distance_m, np.float64))


def spots_enu_m(
    centre_m: npt.ArrayLike, *, target_enu_m: npt.ArrayLike, target_normal_enu: npt.ArrayLike
) -> FloatArray:
    """Return places in the site's frame of points on a target (..., xyz) [m].

    Parameters
    ----------
    centre_m : (..., 2)
        Right and up on the target, seen from in front [m].
    target_enu_m : (xyz)
        The target's centre [m].
    target_normal_enu : (xyz)
        Outward normal of its plane.
    """
    point = as_float_array("centre_m", centre_m, ("...", 2), finite=False)
    rot = geometry.rot_enu_from_mirror(target_normal_enu)
    return np.asarray(as_float_array("target_enu_m", target_enu_m, (3,)) + point @ rot[:, :2].T)


def camera_measurements(
    mounts: Sequence[Mount],
    *,
    sun_enu: npt.ArrayLike,
    target_enu_m: npt.ArrayLike,
    rng: np.random.Generator,
    steering: Sequence[Mount] | None = None,
    spot_sigma_m: float = 0.01,
) -> tuple[Measurements, ...]:
    """Simulate what a camera measures of many heliostats that send the sun to a target.

    Parameters
    ----------
    mounts : (heliostat,)
        The true heliostats.
    sun_enu : (measurement, xyz) or (heliostat, measurement, xyz)
        Directions towards the sun.
    target_enu_m : (xyz), (measurement, xyz) or (heliostat, measurement, xyz)
        Aims [m].
    rng
        Source of randomness.
    steering : (heliostat,)
        What the plant believes of them; left out: the truth. The beam lands off the aim by the difference.
    spot_sigma_m
        Standard deviation of a spot's centre, each way across the beam [m].

    Notes
    -----
    The spot is where the beam passes the aim's distance, whichever way the target's plane lies. A posture out of
    reach, or a sun behind the mirror, is NaN, which a fit leaves out.
    """
    if not spot_sigma_m >= 0.0:
        raise InvalidInputError(f"`spot_sigma_m` must be zero or greater, got {spot_sigma_m}")
    p, k = stack_mounts(mounts)
    believed = p if steering is None else stack_mounts(steering)[0]
    sun = geometry.unit(as_float_array("sun_enu", sun_enu, ("...", 3)))
    sun = np.broadcast_to(sun, (len(mounts), *sun.shape[-2:]))
    aim = np.broadcast_to(as_float_array("target_enu_m", target_enu_m, ("...", 3)), sun.shape)
    rows = aim_rows(sun, aim, source_is_point=False, target_is_point=True)
    count, _ = _kernels.command_batch(believed, k, np.ascontiguousarray(rows))
    out = _kernels.posture_batch(p, k, np.nan_to_num(count), 0.0)
    normal, centre = out[..., 2:5], out[..., 5:]
    cosine = np.sum(normal * sun, axis=-1, keepdims=True)
    beam = np.where(
        (cosine > 0.0) & np.isfinite(count).all(axis=-1, keepdims=True), 2.0 * cosine * normal - sun, np.nan
    )
    distance = np.linalg.norm(aim - centre, axis=-1)
    noise = spot_sigma_m * rng.standard_normal(beam.shape)
    noise -= np.sum(noise * beam, axis=-1, keepdims=True) * beam
    spot = centre + distance[..., None] * beam + noise
    sigma = spot_sigma_rad(max(spot_sigma_m, 1e-3), distance)
    return tuple(
        Measurements.from_spots(count[i], sun_enu=sun[i], spot_enu_m=spot[i], sigma_rad=sigma[i])
        for i in range(len(mounts))
    )
