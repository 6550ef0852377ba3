"""Calibration by a drone that sees a target in the mirror, its place known by RTK-GPS.

The camera's place, the mirror's and the target's fix the normal wherever the drone flies, by day or night and also
where the sun never stands. What it costs is the GPS's noise and the unknown way from its antenna to the camera, which
is fitted along: ``drone_camera_..._m``, camera less antenna, the drone's heading held.

References
----------
Gouws, Calibration of heliostats using a drone, Table 3.1, §5.1, §5.5, §6.4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback import _kernels
from rfpose.feedback.columns import constant
from rfpose.feedback.drive import AxisDrive
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount, aim_rows, stack_mounts

__all__ = [
    "CAMERA",
    "GPS_SIGMA_ENU_M",
    "RtkDrone",
    "dome_directions",
    "drone_sigma_rad",
    "fly",
    "gouws_bounds",
    "random_directions",
    "uniform_priors",
]

GPS_SIGMA_ENU_M = (5.602e-3, 5.781e-3, 8.866e-3)
"""Standard deviations of an RTK fix, east, north, up [m] (Gouws, Table 3.1)."""

CAMERA = ("drone_camera_east_m", "drone_camera_north_m", "drone_camera_up_m")
"""Names of the camera's offset; free, they need a target at a known place and more than ten points."""

_LEAST_COSINE = 0.1  # the mirror seen at more than 84° from its normal shows nothing
_ROUNDS = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class RtkDrone:
    """A drone with an RTK receiver and a camera.

    Attributes
    ----------
    gps_sigma_enu_m : (xyz)
        Standard deviation of a fix, drawn anew for each point [m].
    camera_enu_m : (xyz)
        Camera less antenna, the same for all points [m].

    Raises
    ------
    InvalidInputError
        A negative sigma, or a wrong shape.
    """

    gps_sigma_enu_m: tuple[float, float, float] = GPS_SIGMA_ENU_M
    camera_enu_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        sigma = as_float_array("gps_sigma_enu_m", self.gps_sigma_enu_m, (3,))
        if np.any(sigma < 0.0):
            raise InvalidInputError(f"`gps_sigma_enu_m` must be zero or greater, got {self.gps_sigma_enu_m}")
        as_float_array("camera_enu_m", self.camera_enu_m, (3,))


def dome_directions(n: int, *, lowest_rad: float = 0.05, highest_rad: float = 1.4) -> FloatArray:
    """Return directions evenly spread over the upper half of a sphere (n, xyz), on a golden spiral.

    Parameters
    ----------
    n
        How many.
    lowest_rad, highest_rad
        Elevations between which they lie [rad].
    """
    low, high = np.sin(lowest_rad), np.sin(highest_rad)
    step = (np.arange(n) + 0.5) / n
    azimuth = np.mod(np.arange(n) * np.pi * (3.0 - np.sqrt(5.0)), 2.0 * np.pi)
    return geometry.enu_from_azimuth_elevation(azimuth, np.arcsin(low + (high - low) * step))


def random_directions(
    n: int, rng: np.random.Generator, *, lowest_rad: float = 0.05, highest_rad: float = 1.4
) -> FloatArray:
    """Return directions drawn evenly over the upper half of a sphere (n, xyz).

    Parameters
    ----------
    n
        How many.
    rng
        Source of randomness.
    lowest_rad, highest_rad
        Elevations between which they lie [rad].
    """
    height = rng.uniform(np.sin(lowest_rad), np.sin(highest_rad), n)
    return geometry.enu_from_azimuth_elevation(rng.uniform(0.0, 2.0 * np.pi, n), np.arcsin(height))


def drone_sigma_rad(
    drone_enu_m: npt.ArrayLike,
    centre_enu_m: npt.ArrayLike,
    *,
    target_enu_m: npt.ArrayLike,
    gps_sigma_enu_m: npt.ArrayLike = GPS_SIGMA_ENU_M,
) -> FloatArray:
    """Return the standard deviation of the normal, RMS of its two components, that the GPS leaves [rad].

    Parameters
    ----------
    drone_enu_m, centre_enu_m, target_enu_m : (..., xyz)
        Drone, mirror, target [m].
    gps_sigma_enu_m : (xyz)
        Of a fix [m].

    Notes
    -----
    Within the plane of the two rays the normal turns by half the turn of the drone's ray, across it by more: half
    over the cosine of incidence.
    """
    line = as_float_array("drone_enu_m", drone_enu_m, ("...", 3), finite=False) - np.asarray(centre_enu_m)
    distance = np.linalg.norm(line, axis=-1)
    ray = line / distance[..., None]
    variance = np.asarray(gps_sigma_enu_m, np.float64) ** 2
    cosine = np.sum(geometry.bisector_enu(ray, np.asarray(target_enu_m) - np.asarray(centre_enu_m)) * ray, axis=-1)
    across = 0.5 * (variance.sum() - np.sum(ray**2 * variance, axis=-1))
    return np.asarray(0.5 * np.sqrt(0.5 * across * (1.0 + 1.0 / cosine**2)) / distance)


def fly(
    mounts: Sequence[Mount],
    *,
    target_enu_m: npt.ArrayLike,
    n_point: int,
    rng: np.random.Generator,
    distance_m: float = 32.0,
    layout: Literal["random", "dome"] = "random",
    drone: RtkDrone | None = None,
    drives: tuple[AxisDrive, AxisDrive] | None = None,
) -> tuple[Measurements, ...]:
    """Simulate what a drone measures of many heliostats, each from points of its own.

    Parameters
    ----------
    mounts : (heliostat,)
        The true heliostats.
    target_enu_m : (xyz) or (heliostat, xyz)
        Centre of the target that is seen in the mirrors [m].
    n_point
        Points a heliostat.
    rng
        Source of randomness.
    distance_m
        From the pivot to the camera [m].
    layout
        ``"random"``: drawn evenly over the sky. ``"dome"``: evenly spread, turned at random.
    drone
        Its GPS and camera; left out: Gouws' and no offset.
    drives
        Pulses and backlash of both axes; left out: exact.

    Raises
    ------
    InvalidInputError
        A heliostat that can show the target to next to none of the points.

    Notes
    -----
    Points from which the mirror cannot show the target (behind it, beyond its motors) are left out and others drawn,
    as a pilot would (§5.1).
    """
    device = drone or RtkDrone()
    as_positive("distance_m", distance_m)
    if n_point < 1:
        raise InvalidInputError(f"`n_point` must be one or more, got {n_point}")
    target = np.broadcast_to(as_float_array("target_enu_m", target_enu_m, ("...", 3)), (len(mounts), 3))
    p, k = stack_mounts(mounts)
    pivot = constant(k, "pivot_enu_m")
    count = np.empty((len(mounts), 0, 2))
    good = np.empty((len(mounts), 0), np.bool_)
    for _ in range(_ROUNDS):
        offered = _directions(len(mounts), 2 * n_point, layout, rng)
        camera = pivot[:, None] + distance_m * offered
        more, usable = _show(p, k, camera, target)
        count, good = np.concatenate([count, more], axis=1), np.concatenate([good, usable], axis=1)
        if np.all(good.sum(axis=1) >= n_point):
            break
    else:
        worst = int(np.argmin(good.sum(axis=1)))
        raise InvalidInputError(
            f"heliostat {worst} can show the target to {good[worst].sum()} of {good.shape[1]} points at "
            f"{distance_m:g} m; check its place, the target's and the motors' limits"
        )
    order = np.argsort(~good, axis=1, kind="stable")[:, :n_point]
    chosen = np.take_along_axis(count, order[..., None], axis=1)
    return _measure(p, k, chosen, target, distance_m, device, drives, rng)


def _directions(n: int, n_offered: int, layout: str, rng: np.random.Generator) -> FloatArray:
    """Directions to try for each heliostat (heliostat, offered, xyz)."""
    if layout == "random":
        return random_directions(n * n_offered, rng).reshape(n, n_offered, 3)
    even = dome_directions(n_offered)
    turn = rng.uniform(0.0, 2.0 * np.pi, n)[:, None]
    x, y = even[:, 0], even[:, 1]
    turned = np.stack(
        [np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, np.tile(even[:, 2], (n, 1))], axis=-1
    )
    # the first that are taken must not be the lowest ones only
    return np.asarray(turned[:, rng.permutation(n_offered)])


def _show(
    p: FloatArray, k: FloatArray, camera: FloatArray, target: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return counts that show the target to the camera, and whether the mirror can."""
    rows = aim_rows(camera, np.broadcast_to(target[:, None], camera.shape), source_is_point=True, target_is_point=True)
    count, status = _kernels.command_batch(p, k, np.ascontiguousarray(rows))
    out = _kernels.posture_batch(p, k, np.nan_to_num(count), 0.0)
    normal, centre = out[..., 2:5], out[..., 5:]
    cosine = np.sum(normal * geometry.unit(camera - centre), axis=-1)
    return count, (status == 0) & (cosine > _LEAST_COSINE) & (normal[..., 2] > 0.0)


def _measure(
    p: FloatArray,
    k: FloatArray,
    count: FloatArray,
    target: FloatArray,
    distance_m: float,
    drone: RtkDrone,
    drives: tuple[AxisDrive, AxisDrive] | None,
    rng: np.random.Generator,
) -> tuple[Measurements, ...]:
    """Fly to where the mirrors, standing as their drives leave them, show the target; read GPS and counts."""
    told, real = count, count
    if drives is not None:
        scale = constant(k, "counts_per_unit")[:, None]
        pulse = np.array([drive.pulse_rad for drive in drives])
        slack = np.array([drive.backlash_rad for drive in drives])
        told = np.rint(count / scale / pulse) * pulse * scale
        real = told + 0.5 * slack * rng.uniform(-1.0, 1.0, count.shape) * scale
    out = _kernels.posture_batch(p, k, np.ascontiguousarray(real), 0.0)
    normal, centre = out[..., 2:5], out[..., 5:]
    toward = geometry.unit(target[:, None] - centre)
    beam = 2.0 * np.sum(normal * toward, axis=-1, keepdims=True) * normal - toward
    camera = centre + distance_m * beam
    sigma = np.array(drone.gps_sigma_enu_m)
    antenna = camera - np.array(drone.camera_enu_m) + sigma * rng.standard_normal(camera.shape)
    stated = np.where(np.any(sigma > 0.0), sigma, 1e-3)
    spread = drone_sigma_rad(camera, centre, target_enu_m=target[:, None], gps_sigma_enu_m=stated)
    if drives is not None:
        spread = np.hypot(spread, np.sqrt(np.mean([drive.variance_rad2 for drive in drives])))
    return tuple(
        Measurements.from_points(told[i], source_enu_m=antenna[i], target_enu_m=target[i], sigma_rad=spread[i])
        for i in range(len(count))
    )


def gouws_bounds(mount: Mount) -> dict[str, tuple[float, float]]:
    """Return how far each parameter may lie from a mount's own (§5.5).

    Parameters
    ----------
    mount
        As surveyed: its place, arms and zeros are the middles.
    """
    half = {
        **dict.fromkeys(("location_east_m", "location_north_m", "location_up_m"), 0.05),
        **dict.fromkeys(("pedestal_tilt_north_rad", "pedestal_tilt_east_rad"), float(np.deg2rad(2.5))),
        **dict.fromkeys(("axis_1_zero_rad", "axis_2_zero_rad"), float(np.deg2rad(10.0))),
        "arm_normal_m": 0.01,
        "arm_up_m": 0.1,
        **dict.fromkeys(CAMERA, 0.006),
    }
    return {name: (mount.parameters[name] - size, mount.parameters[name] + size) for name, size in half.items()}


def uniform_priors(bounds: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation of values that are equally likely anywhere within bounds."""
    return {name: (0.5 * (low + high), (high - low) / np.sqrt(12.0)) for name, (low, high) in bounds.items()}
