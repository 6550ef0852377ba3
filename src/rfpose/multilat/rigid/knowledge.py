"""What is known about mirrors besides their phases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfpose.checks import FloatArray

__all__ = ["Knowledge"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Knowledge:
    """What is known about mirrors besides the phases.

    Attributes
    ----------
    clock_sigma_m
        Standard deviation of each receiver's delay about the mirror's common clock [m]: 0 means one shared clock
        with known delays, infinity one unknown clock a receiver.
    pivot_enu_m : (mirror, xyz) or None
        Surveyed pivots [m].
    pivot_sigma_m
        Their standard deviation in each axis [m].
    two_axis
        The mirror stands on an azimuth-elevation mount: its x axis stays horizontal.
    roll_sigma_rad
        How well it does.
    """

    clock_sigma_m: float = np.inf
    pivot_enu_m: FloatArray | None = None
    pivot_sigma_m: float = np.inf
    two_axis: bool = False
    roll_sigma_rad: float = 1e-6
