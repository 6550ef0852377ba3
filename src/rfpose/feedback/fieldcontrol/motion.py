"""Axes with a limited rate, as stepper motors move them."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive

__all__ = ["PROTOTYPE_RATE_RAD_S", "move_axes"]

PROTOTYPE_RATE_RAD_S = math.radians(270.0) / 120.0
"""Slowest axis that stows within Malan's two minutes: half a turn of azimuth after a quarter of elevation [rad/s]."""


def move_axes(
    axis_rad: npt.ArrayLike,
    target_axis_rad: npt.ArrayLike,
    duration_s: float,
    *,
    rate_rad_s: float = PROTOTYPE_RATE_RAD_S,
) -> FloatArray:
    """Return where axes are after moving towards their targets for a while.

    Parameters
    ----------
    axis_rad : (..., axis)
        Where they are [rad].
    target_axis_rad : (..., axis)
        Where they shall go [rad]; NaN: stand still.
    duration_s
        For so long [s].
    rate_rad_s
        Fastest rate of an axis [rad/s].
    """
    axis = as_float_array("axis_rad", axis_rad, ("...", 2), finite=False)
    target = as_float_array("target_axis_rad", target_axis_rad, ("...", 2), finite=False)
    reach = as_positive("rate_rad_s", rate_rad_s) * as_positive("duration_s", duration_s)
    return np.asarray(axis + np.nan_to_num(np.clip(target - axis, -reach, reach)))
