"""A whole field played through: what it does after an alarm and what flux is left on the receiver.

Mounts are perfect azimuth-elevation mounts with a limited rate, since an emergency is a matter of degrees and not of
milliradians. A mirror's spot on the receiver is Gaussian: the sun's disc, the slope error (twice, as every error of the
normal) and the mirror's own width.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback import _kernels, optics
from rfpose.feedback.columns import constant
from rfpose.feedback.fieldcontrol.control import ControlledField
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.fieldcontrol.motion import PROTOTYPE_RATE_RAD_S, move_axes
from rfpose.feedback.mount import Mount, aim_rows, stack_mounts

__all__ = ["EmergencyField", "EmergencyRun", "TowerReceiver", "play", "ring_field", "share_on_receiver"]

_AIM_EVERY_S = 4.0
_EVERYTHING_STANDS = (Mode.STOW, Mode.FAULT)


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerReceiver:
    """An upright cylinder, which each mirror sees as a rectangle that faces it.

    Attributes
    ----------
    centre_enu_m : (xyz)
        Its middle [m].
    width_m, height_m
        Diameter and height [m].
    """

    centre_enu_m: FloatArray
    width_m: float
    height_m: float

    def __post_init__(self) -> None:
        centre = as_float_array("centre_enu_m", self.centre_enu_m, (3,))
        object.__setattr__(self, "centre_enu_m", read_only(centre))
        as_positive("width_m", self.width_m)
        as_positive("height_m", self.height_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class EmergencyField:
    """Mirrors, their drives, and the receiver that they serve.

    Attributes
    ----------
    pivot_enu_m : (heliostat, xyz)
        Where the mirrors stand [m].
    receiver
        What they aim at.
    rate_rad_s
        Fastest rate of an axis [rad/s].
    mirror_m
        Side of a flat square mirror [m].
    sun_sigma_rad, slope_error_rad
        The sun's disc as a Gaussian, a quarter of its diameter, and the mirrors' slope error, a component [rad].
    """

    pivot_enu_m: FloatArray
    receiver: TowerReceiver
    rate_rad_s: float = PROTOTYPE_RATE_RAD_S
    mirror_m: float = 3.2
    sun_sigma_rad: float = 9.3e-3 / 4.0
    slope_error_rad: float = 1.5e-3

    def __post_init__(self) -> None:
        pivot = as_float_array("pivot_enu_m", self.pivot_enu_m, ("heliostat", 3))
        object.__setattr__(self, "pivot_enu_m", read_only(pivot))
        for name in ("rate_rad_s", "mirror_m", "sun_sigma_rad", "slope_error_rad"):
            as_positive(name, getattr(self, name))


@dataclass(frozen=True, slots=True, kw_only=True)
class EmergencyRun:
    """What a field did.

    Attributes
    ----------
    time_s : (time,)
        Times [s].
    flux : (time,)
        Flux on the receiver over that of all mirrors on their aim at the start.
    n_mode : (time, mode)
        Heliostats in each `Mode`.
    off_receiver_s, stowed_s : (heliostat,)
        Time from which a mirror stays below a tenth of its own flux at the start, and time of its arrival in stow [s];
        NaN: not in this time.
    axis_rad : (heliostat, axis)
        Where the axes ended [rad].
    """

    time_s: FloatArray
    flux: FloatArray
    n_mode: npt.NDArray[np.int64]
    off_receiver_s: FloatArray
    stowed_s: FloatArray
    axis_rad: FloatArray

    def time_below_s(self, part: float) -> float:
        """Return the time from which the flux stays below a part of the full one [s]; NaN: never."""
        above = np.flatnonzero(self.flux >= part)
        first = 0 if above.size == 0 else int(above[-1]) + 1
        return float(self.time_s[first]) if first < len(self.time_s) else float("nan")


def ring_field(n: int, *, nearest_m: float = 30.0, spacing_m: float = 6.0) -> FloatArray:
    """Return places of heliostats in rings about a tower at the origin (heliostat, xyz) [m].

    Numbered from the inner ring outwards and along each ring, so that neighbours share a bus. Pivots stand 2 m high.
    """
    if n < 1:
        raise InvalidInputError(f"`n` must be at least 1, got {n}")
    rows: list[FloatArray] = []
    radius, left = as_positive("nearest_m", nearest_m), n
    while left > 0:
        on_ring = min(left, int(2.0 * np.pi * radius / as_positive("spacing_m", spacing_m)))
        angle = 2.0 * np.pi * (np.arange(on_ring) + 0.5 * (len(rows) % 2)) / on_ring
        rows.append(np.stack([radius * np.sin(angle), radius * np.cos(angle), np.full(on_ring, 2.0)], axis=1))
        left -= on_ring
        radius += spacing_m
    return np.concatenate(rows)


def share_on_receiver(
    field: EmergencyField, normal_enu: FloatArray, centre_enu_m: FloatArray, sun_enu: FloatArray
) -> FloatArray:
    """Return what part of the light that its area could collect each mirror brings to the receiver (heliostat,).

    Cosine of incidence times the part of its Gaussian spot within the receiver's outline.
    """
    receiver = field.receiver
    beam = optics.reflect(normal_enu, sun_enu)
    way = centre_enu_m - receiver.centre_enu_m
    facing = way * np.array([1.0, 1.0, 0.0])
    offset = optics.target_offset_m(centre_enu_m, beam, target_enu_m=receiver.centre_enu_m, target_normal_enu=facing)
    distance = np.linalg.norm(way, axis=1)
    sigma = np.hypot(
        distance * np.hypot(field.sun_sigma_rad, 2.0 * field.slope_error_rad), field.mirror_m / np.sqrt(12)
    )
    # the outline stands upright: a beam that climbs draws its spot out
    upright = np.hypot(way[:, 0], way[:, 1]) / distance
    half = np.array([receiver.width_m, receiver.height_m]) / 2.0
    caught = _within(offset, half, np.stack([sigma, sigma / upright], axis=1)).prod(axis=1)
    cosine = np.clip((normal_enu * sun_enu).sum(axis=1), 0.0, None)
    return np.asarray(np.nan_to_num(caught) * cosine)


def _within(offset_m: FloatArray, half_m: FloatArray, sigma_m: FloatArray) -> FloatArray:
    from scipy.special import ndtr  # only a played field needs it

    return np.asarray(ndtr((half_m - offset_m) / sigma_m) - ndtr((-half_m - offset_m) / sigma_m))


class _Mirrors:
    """Perfect mounts of a field as the kernels read them."""

    def __init__(self, pivot_enu_m: FloatArray) -> None:
        parameters, constants = stack_mounts([Mount(pivot_enu_m=pivot_enu_m[0])])
        n = len(pivot_enu_m)
        self._parameters = np.repeat(parameters, n, axis=0)
        self._constants = np.repeat(constants, n, axis=0)
        constant(self._constants, "pivot_enu_m")[:] = pivot_enu_m

    def axes_for(self, sun_enu: FloatArray, aim_enu_m: FloatArray) -> FloatArray:
        """Return axis angles that send the sun to aim points [rad]; NaN where there are none."""
        rows = aim_rows(sun_enu, aim_enu_m, source_is_point=False, target_is_point=True)
        axis, status = _kernels.command_batch(self._parameters, self._constants, np.ascontiguousarray(rows[:, None]))
        axis[status != 0] = np.nan
        return np.asarray(axis[:, 0])

    def posture(self, axis_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return normals and centres at axis angles."""
        out = _kernels.posture_batch(self._parameters, self._constants, np.array(axis_rad)[:, None], 0.0)[:, 0]
        return out[:, 2:5], out[:, 5:8]


def play(
    control: ControlledField,
    field: EmergencyField,
    *,
    time_s: npt.ArrayLike,
    sun_enu: npt.ArrayLike,
    wind_mps: npt.ArrayLike = 0.0,
    happenings: Mapping[float, Callable[[ControlledField], object]] | None = None,
) -> EmergencyRun:
    """Return what a field does: steps its control, moves its axes, adds up its flux.

    Parameters
    ----------
    control
        The field's control; its heliostats start on their aim points, or in stow if that is their mode.
    field
        Mirrors and receiver; as many as ``control`` has.
    time_s : (time,)
        Ascending times [s].
    sun_enu : (time, xyz) or (xyz)
        Direction towards the sun.
    wind_mps : (time,) or one
        Wind [m/s]; NaN: unknown.
    happenings
        What is done to the control at the first of the times that is not before a given one, after that step.

    Raises
    ------
    InvalidInputError
        Another number of heliostats, or a sun from which a mirror cannot reach its aim at the start.
    """
    times = as_float_array("time_s", time_s, ("time",))
    sun = geometry.unit(np.broadcast_to(as_float_array("sun_enu", sun_enu, ("...", 3)), (len(times), 3)))
    wind = np.broadcast_to(as_float_array("wind_mps", wind_mps, ("...",), finite=False), times.shape)
    n = control.n_heliostat
    if len(field.pivot_enu_m) != n:
        raise InvalidInputError(f"`field` must have the {n} heliostats of `control`, got {len(field.pivot_enu_m)}")
    mirrors = _Mirrors(field.pivot_enu_m)
    receiver_enu_m = np.broadcast_to(field.receiver.centre_enu_m, (n, 3))
    aim_axis = mirrors.axes_for(sun[0], receiver_enu_m)
    if not np.isfinite(aim_axis).all():
        raise InvalidInputError("`sun_enu` must let every mirror reach its aim at the start")
    full = share_on_receiver(field, *mirrors.posture(aim_axis), sun[0])
    parked = np.isin(control.mode, (Mode.STOW, Mode.STOWING))
    axis = np.where(parked[:, None], control.settings.stow_axis_rad, aim_axis)
    left = sorted((happenings or {}).items())
    tally = _Tally(len(times), n, full)
    aimed_s = times[0]
    for i, now in enumerate(times):
        orders = control.step(now, axis_rad=axis, aim_axis_rad=aim_axis, sun_enu=sun[i], wind_mps=float(wind[i]))
        steering = np.isin(orders.mode, _EVERYTHING_STANDS, invert=True).any()
        if orders.changed.any() or (steering and now - aimed_s >= _AIM_EVERY_S):
            aim = np.where(np.isnan(orders.aim_enu_m), receiver_enu_m, orders.aim_enu_m)
            aim_axis = mirrors.axes_for(sun[i], aim)
            aimed_s = now
        share = share_on_receiver(field, *mirrors.posture(axis), sun[i])
        tally.add(i, now, orders.mode, share)
        while left and left[0][0] <= now:
            left.pop(0)[1](control)
        if i + 1 < len(times):
            target = np.where(np.isnan(orders.target_axis_rad), aim_axis, orders.target_axis_rad)
            axis = move_axes(axis, target, times[i + 1] - now, rate_rad_s=field.rate_rad_s)
    return tally.play(times, axis)


class _Tally:
    """Adds up what a played field does."""

    def __init__(self, n_time: int, n: int, full: FloatArray) -> None:
        self._full = full
        self._flux = np.empty(n_time)
        self._n_mode = np.zeros((n_time, len(Mode)), np.int64)
        self._off_s = np.full(n, np.nan)
        self._stowed_s = np.full(n, np.nan)

    def add(self, i: int, now_s: float, mode: npt.NDArray[np.int8], share: FloatArray) -> None:
        """Count one time."""
        self._flux[i] = share.sum() / self._full.sum()
        self._n_mode[i] = np.bincount(mode, minlength=len(Mode))
        on = share >= 0.1 * self._full
        self._off_s[on] = np.nan
        self._off_s[~on & np.isnan(self._off_s)] = now_s
        stowed = mode == Mode.STOW
        self._stowed_s[~stowed] = np.nan
        self._stowed_s[stowed & np.isnan(self._stowed_s)] = now_s

    def play(self, time_s: FloatArray, axis_rad: FloatArray) -> EmergencyRun:
        """Return the whole."""
        return EmergencyRun(
            time_s=read_only(time_s),
            flux=read_only(self._flux),
            n_mode=read_only(self._n_mode),
            off_receiver_s=read_only(self._off_s),
            stowed_s=read_only(self._stowed_s),
            axis_rad=read_only(axis_rad),
        )
