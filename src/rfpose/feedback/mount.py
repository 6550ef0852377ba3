"""The two-axis mount: from motor positions to the mirror's centre and normal, and back.

One model serves every mount whose two axes nearly cross at a right angle: azimuth over elevation, an axis 1 that
lies level (as in Jülich), a polar axis. What differs is the nominal direction of axis 1, ``rot_enu_from_mount``.
Angles of the axes are those of an azimuth-elevation mount in that frame: axis 1 turns clockwise seen along −z
from the frame's y, axis 2 lifts the normal towards its z.

From the mirror outwards: canting, arms, axis 2, non-orthogonality, axis 1, nominal frame, twist and tilt of the
pedestal (towards north first, then towards east), gravity sag, location. Each parameter is zero in a perfect
mount except lengths that exist anyway.

References
----------
Malan, A heliostat field control system, (4.7)-(4.27), (6.1). Gouws, Calibration of heliostats using a drone,
(5.26)-(5.49). Edwards, Arrays of paraboloidal collectors, ch. 5.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback import _kernels
from rfpose.feedback.columns import CONSTANTS, PARAMETERS, M

__all__ = [
    "PARAMETERS",
    "Actuator",
    "CommandStatus",
    "Commands",
    "Mount",
    "MountPosture",
    "command",
    "mount_frame_from_axis",
    "posture",
]

_NAMES = tuple(PARAMETERS)


class CommandStatus(IntEnum):
    """What became of a wanted posture."""

    OK = 0
    NO_SOLUTION = 1
    BEYOND_LIMITS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Actuator:
    """The drive of one axis.

    Attributes
    ----------
    kind
        ``"rotary"``: travel is an angle. ``"linear"``: a spindle that closes a triangle with two fixed sides; the
        axis turns by the change of the angle between them.
    counts_per_unit
        Counts for one radian (rotary) or one metre (linear).
    sign
        +1 if the axis angle grows with the count, −1 if it falls.
    angle_at_zero_rad
        Nominal axis angle at count zero [rad].
    stroke_m, radius_m, offset_m
        Linear: length of the spindle at count zero and the two fixed sides of the triangle [m].
    limits_count
        Lowest and highest count.
    worm_ratio
        Turns of the worm for one turn of the axis (30 for Malan's, a period of 12°).

    Raises
    ------
    InvalidInputError
        A count scale or side that is not positive, a sign other than ±1, limits that are not ascending, or a
        triangle that does not close at count zero.
    """

    kind: Literal["rotary", "linear"] = "rotary"
    counts_per_unit: float = 1.0
    sign: int = 1
    angle_at_zero_rad: float = 0.0
    stroke_m: float = 0.0
    radius_m: float = 0.0
    offset_m: float = 0.0
    limits_count: tuple[float, float] = (-np.inf, np.inf)
    worm_ratio: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in ("rotary", "linear"):
            raise InvalidInputError(f"`kind` must be 'rotary' or 'linear', got {self.kind!r}")
        if self.sign not in (-1, 1):
            raise InvalidInputError(f"`sign` must be 1 or -1, got {self.sign!r}")
        as_positive("counts_per_unit", self.counts_per_unit)
        if not self.limits_count[0] < self.limits_count[1]:
            raise InvalidInputError(f"`limits_count` must be ascending, got {self.limits_count}")
        if self.kind == "linear":
            sides = (
                as_positive("stroke_m", self.stroke_m),
                as_positive("radius_m", self.radius_m),
                as_positive("offset_m", self.offset_m),
            )
            if 2.0 * max(sides) > sum(sides):
                raise InvalidInputError(
                    f"`stroke_m`, `radius_m` and `offset_m` must close a triangle, got {sides} m; "
                    "check that all are metres"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class Mount:
    """One heliostat: where it stands, how its axes lie, how they are driven, and what is not as planned.

    Attributes
    ----------
    pivot_enu_m : (xyz)
        Nominal crossing point of the axes, site ENU [m].
    rot_enu_from_mount : (3, 3)
        Nominal directions of the mount's x, y, z in ENU (columns); z is axis 1. Unit matrix: azimuth-elevation.
    actuators
        Drives of axis 1 and axis 2.
    parameters
        Values by name of `PARAMETERS`; what is left out is zero, or the actuator's nominal side.
    """

    pivot_enu_m: FloatArray
    rot_enu_from_mount: FloatArray = field(default_factory=lambda: np.eye(3))
    actuators: tuple[Actuator, Actuator] = (Actuator(), Actuator())
    parameters: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rot = as_float_array("rot_enu_from_mount", self.rot_enu_from_mount, (3, 3))
        if not np.allclose(rot @ rot.T, np.eye(3), atol=1e-9) or np.linalg.det(rot) < 0.0:
            raise InvalidInputError("`rot_enu_from_mount` must be a right-handed rotation matrix")
        object.__setattr__(self, "rot_enu_from_mount", read_only(rot))
        pivot = as_float_array("pivot_enu_m", self.pivot_enu_m, (3,))
        object.__setattr__(self, "pivot_enu_m", read_only(pivot))
        values = self._nominal() | {name: float(value) for name, value in self.parameters.items()}
        check_names(values)
        bad = [name for name, value in values.items() if not np.isfinite(value)]
        if bad:
            raise InvalidInputError(f"`parameters` must be finite, got {bad[0]} = {values[bad[0]]}")
        object.__setattr__(self, "parameters", {name: values.get(name, 0.0) for name in _NAMES})

    def _nominal(self) -> dict[str, float]:
        """Return the sides of the actuators' triangles as built."""
        sides: dict[str, float] = {}
        for i, actuator in enumerate(self.actuators, start=1):
            if actuator.kind == "linear":
                sides[f"actuator_{i}_stroke_m"] = actuator.stroke_m
                sides[f"actuator_{i}_radius_m"] = actuator.radius_m
                sides[f"actuator_{i}_offset_m"] = actuator.offset_m
        return sides

    def replace(self, **parameters: float) -> Mount:
        """Return the mount with some parameters changed."""
        return dataclasses.replace(self, parameters={**self.parameters, **parameters})

    def parameter_vector(self) -> FloatArray:
        """Return the parameters in the order of `PARAMETERS`."""
        return np.array([self.parameters[name] for name in _NAMES])

    def constant_vector(self) -> FloatArray:
        """Return what a calibration does not change, in the order of `CONSTANTS`."""
        axes = self.actuators
        values: dict[str, npt.ArrayLike] = {
            "rot_enu_from_mount": self.rot_enu_from_mount,
            "is_linear": [a.kind == "linear" for a in axes],
            "sign": [a.sign for a in axes],
            "counts_per_unit": [a.counts_per_unit for a in axes],
            "angle_at_zero_rad": [a.angle_at_zero_rad for a in axes],
            "worm_ratio": [a.worm_ratio for a in axes],
            "pivot_enu_m": self.pivot_enu_m,
            "lowest_count": [a.limits_count[0] for a in axes],
            "highest_count": [a.limits_count[1] for a in axes],
        }
        return np.concatenate([np.ravel(np.asarray(values[name], np.float64)) for name in CONSTANTS])


@dataclass(frozen=True, slots=True, kw_only=True)
class MountPosture:
    """Where mirrors are and face; rows as the motor positions given.

    Attributes
    ----------
    axis_rad : (..., axis)
        Angles of axis 1 and axis 2 [rad].
    normal_enu : (..., xyz)
        Mirror normals; NaN where a linear actuator's triangle does not close.
    centre_enu_m : (..., xyz)
        Mirror centres, site ENU [m].
    """

    axis_rad: FloatArray
    normal_enu: FloatArray
    centre_enu_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Commands:
    """Motor positions for wanted postures.

    Attributes
    ----------
    count : (..., axis)
        Motor positions; NaN where there is no solution. Beyond the limits the wanted value is given.
    status : (...)
        `CommandStatus` of each.
    """

    count: FloatArray
    status: npt.NDArray[np.int8]


def check_names(names: Iterable[str]) -> None:
    """Refuse names that are no parameter of a mount."""
    unknown = [name for name in names if name not in PARAMETERS]
    if unknown:
        raise InvalidInputError(f"no mount parameter is called {unknown[0]!r}; known are {', '.join(_NAMES)}")


def mount_frame_from_axis(axis_enu: npt.ArrayLike, zero_enu: npt.ArrayLike) -> FloatArray:
    """Return ``rot_enu_from_mount`` of a mount whose axis 1 and zero direction are known.

    Parameters
    ----------
    axis_enu : (xyz)
        Direction of axis 1 (the fixed axis); need not be of unit length. For an axis at latitude B and longitude
        offset l (Edwards), the direction in the site frame of a plumb line there.
    zero_enu : (xyz)
        Direction towards which the normal leans at axis 1's zero; its part along the axis is dropped.

    Raises
    ------
    InvalidInputError
        The two directions are parallel.
    """
    z = geometry.unit(as_float_array("axis_enu", axis_enu, (3,)))
    zero = as_float_array("zero_enu", zero_enu, (3,))
    x = np.cross(zero, z)
    if np.linalg.norm(x) < 1e-9 * np.linalg.norm(zero):
        raise InvalidInputError("`axis_enu` and `zero_enu` must not be parallel")
    x = geometry.unit(x)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def posture(mount: Mount, count: npt.ArrayLike, *, receiver_plane: bool = False) -> MountPosture:
    """Return centre and normal of the mirror at motor positions.

    Parameters
    ----------
    mount
        The heliostat.
    count : (..., axis)
        Motor positions; with ``counts_per_unit`` one, axis angles [rad].
    receiver_plane
        Give the normal of the receivers' plane and not the mirror's.
    """
    counts = as_float_array("count", count, ("...", 2), finite=False)
    out = _kernels.posture_batch(
        mount.parameter_vector()[None],
        mount.constant_vector()[None],
        counts.reshape(1, -1, 2).copy(),  # kernels are compiled for arrays that can be written
        1.0 if receiver_plane else 0.0,
    ).reshape(*counts.shape[:-1], 8)
    return MountPosture(axis_rad=out[..., :2], normal_enu=out[..., 2:5], centre_enu_m=out[..., 5:])


def aim_rows(
    source_enu: FloatArray, target_enu: FloatArray, *, source_is_point: bool, target_is_point: bool
) -> FloatArray:
    """Rows of sources and targets as the kernels read them."""
    source, target = np.broadcast_arrays(source_enu, target_enu)
    rows = np.zeros((*source.shape[:-1], _kernels.N_ROW))
    rows[..., M.source_enu : M.source_enu + 3], rows[..., M.source_is_point] = source, source_is_point
    rows[..., M.target_enu : M.target_enu + 3], rows[..., M.target_is_point] = target, target_is_point
    rows[..., M.sigma_rad] = 1.0
    return rows


def command(
    mount: Mount,
    *,
    sun_enu: npt.ArrayLike,
    target_enu_m: npt.ArrayLike | None = None,
    mode: Literal["heliostat", "dish"] = "heliostat",
) -> Commands:
    """Return the motor positions that send the sun to a target, every known error of the mount undone.

    Parameters
    ----------
    mount
        The heliostat as calibrated.
    sun_enu : (..., xyz)
        Directions towards the sun.
    target_enu_m : (..., xyz)
        Aim points, site ENU [m]; heliostats only.
    mode
        ``"heliostat"``: the normal bisects sun and target, seen from the mirror's centre as it then is.
        ``"dish"``: the normal points at the sun.

    Raises
    ------
    InvalidInputError
        No target for a heliostat, one for a dish, or wrong shapes.
    """
    sun = geometry.unit(as_float_array("sun_enu", sun_enu, ("...", 3)))
    if (mode == "heliostat") != (target_enu_m is not None):
        raise InvalidInputError("`target_enu_m` must be given for mode 'heliostat' and only for it")
    target = sun if target_enu_m is None else as_float_array("target_enu_m", target_enu_m, ("...", 3))
    rows = aim_rows(sun, target, source_is_point=False, target_is_point=target_enu_m is not None)
    shape = rows.shape[:-1]
    count, status = _kernels.command_batch(
        mount.parameter_vector()[None],
        mount.constant_vector()[None],
        np.ascontiguousarray(rows.reshape(1, -1, _kernels.N_ROW)),
    )
    return Commands(count=count.reshape(*shape, 2), status=status.reshape(shape))


def stack_mounts(mounts: Sequence[Mount]) -> tuple[FloatArray, FloatArray]:
    """Return parameters and constants of many mounts as the kernels read them."""
    return (
        np.stack([mount.parameter_vector() for mount in mounts]),
        np.stack([mount.constant_vector() for mount in mounts]),
    )
