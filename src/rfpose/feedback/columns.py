"""Names of the columns in which kernels read mounts and measurements; nothing else knows a column's number.

``P.axis_1_zero_rad`` is the column of a parameter, ``K.sign`` the first column of a constant, ``M.sigma_rad`` that of a
measurement; compiled, they are plain numbers. What belongs to both axes stands evenly spaced, so that kernels add the
axis: ``P.axis_1_zero_rad + 1`` is that of axis 2, and ``P.worm_1_sin_rad + 2``.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterable
from itertools import accumulate
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray

__all__ = ["CONSTANTS", "MEASUREMENT", "PARAMETERS", "K", "M", "P", "columns_of", "constant", "scales_of"]

PARAMETERS: dict[str, float] = {
    "pedestal_tilt_north_rad": 1e-3,
    "pedestal_tilt_east_rad": 1e-3,
    "pedestal_twist_rad": 1e-3,
    "axis_1_zero_rad": 1e-3,
    "axis_2_zero_rad": 1e-3,
    "nonorthogonality_rad": 1e-3,
    "canting_up_rad": 1e-3,
    "canting_right_rad": 1e-3,
    "location_east_m": 1e-2,
    "location_north_m": 1e-2,
    "location_up_m": 1e-2,
    "pylon_length_m": 1e-1,
    "arm_normal_m": 1e-2,
    "arm_up_m": 1e-2,
    "arm_right_m": 1e-2,
    "axis_offset_m": 1e-2,
    "axis_1_gain": 1e-3,
    "axis_2_gain": 1e-3,
    "actuator_1_stroke_m": 1e-3,
    "actuator_2_stroke_m": 1e-3,
    "actuator_1_radius_m": 1e-3,
    "actuator_2_radius_m": 1e-3,
    "actuator_1_offset_m": 1e-3,
    "actuator_2_offset_m": 1e-3,
    "worm_1_sin_rad": 1e-3,
    "worm_1_cos_rad": 1e-3,
    "worm_2_sin_rad": 1e-3,
    "worm_2_cos_rad": 1e-3,
    "gravity_sag_rad": 1e-3,
    "receiver_plane_up_rad": 1e-3,
    "receiver_plane_right_rad": 1e-3,
    "drone_camera_east_m": 1e-3,
    "drone_camera_north_m": 1e-3,
    "drone_camera_up_m": 1e-3,
}
"""Every parameter of a mount, in the kernels' order, with the size of a usual change (it scales the fit).

The last three belong to the drone that looked at it: its camera less its antenna."""

CONSTANTS: dict[str, int] = {
    "rot_enu_from_mount": 9,
    "is_linear": 2,
    "sign": 2,
    "counts_per_unit": 2,
    "angle_at_zero_rad": 2,
    "worm_ratio": 2,
    "pivot_enu_m": 3,
    "lowest_count": 2,
    "highest_count": 2,
}
"""What a calibration does not change, and how many columns each has: the rotation by rows, else one an axis or xyz."""

MEASUREMENT: dict[str, int] = {
    "source_enu": 3,
    "source_is_point": 1,
    "target_enu": 3,
    "target_is_point": 1,
    "sigma_rad": 1,
    "of_receiver_plane": 1,
}
"""A measurement: where light comes from and goes to, directions or points; sigma of the normal; 1 if the normal is that
of the receivers' plane and not the mirror's."""


# numba reads named tuples as constants; they are made from the tables so that no name is written twice
ParameterColumns = namedtuple("ParameterColumns", list(PARAMETERS))  # type: ignore[misc]
ConstantColumns = namedtuple("ConstantColumns", list(CONSTANTS))  # type: ignore[misc]
MeasurementColumns = namedtuple("MeasurementColumns", list(MEASUREMENT))  # type: ignore[misc]

P: Any = ParameterColumns(*range(len(PARAMETERS)))
K: Any = ConstantColumns(*list(accumulate(CONSTANTS.values(), initial=0))[:-1])
M: Any = MeasurementColumns(*list(accumulate(MEASUREMENT.values(), initial=0))[:-1])


def constant(constants: FloatArray, name: str) -> FloatArray:
    """Return one of `CONSTANTS` of mounts (..., columns), as a view into their rows."""
    first = getattr(K, name)
    return constants[..., first : first + CONSTANTS[name]]


def columns_of(names: Iterable[str]) -> npt.NDArray[np.int64]:
    """Return the columns of parameters."""
    return np.array([getattr(P, name) for name in names], np.int64)


def scales_of(names: Iterable[str]) -> FloatArray:
    """Return the sizes of usual changes of parameters."""
    return np.array([PARAMETERS[name] for name in names])
