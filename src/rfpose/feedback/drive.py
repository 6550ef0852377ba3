"""What a drive makes of a wanted angle: whole pulses, and play between the motor and the mirror."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError

__all__ = ["GOUWS_AZIMUTH", "GOUWS_ELEVATION", "AxisDrive", "follow"]


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisDrive:
    """Resolution and play of one axis.

    Attributes
    ----------
    pulse_rad
        Turn of the axis for one pulse [rad].
    backlash_rad
        Whole width within which the axis lies loose [rad].

    Raises
    ------
    InvalidInputError
        A pulse that is not positive, or negative play.
    """

    pulse_rad: float
    backlash_rad: float = 0.0

    def __post_init__(self) -> None:
        as_positive("pulse_rad", self.pulse_rad)
        if not self.backlash_rad >= 0.0:
            raise InvalidInputError(f"`backlash_rad` must be zero or greater, got {self.backlash_rad}")

    @property
    def variance_rad2(self) -> float:
        """Of the axis angle about the wanted one, pulse and play evenly spread [rad²]."""
        return (self.pulse_rad**2 + self.backlash_rad**2) / 12.0


GOUWS_AZIMUTH = AxisDrive(pulse_rad=0.440e-3, backlash_rad=1.5e-3)
"""His rotary actuator (§4.2)."""
GOUWS_ELEVATION = AxisDrive(pulse_rad=0.111e-3)
"""His linear actuator (§4.2)."""


def follow(drive: AxisDrive, wanted_rad: npt.ArrayLike, *, start_rad: float | None = None) -> FloatArray:
    """Return where an axis comes to stand that is sent to one angle after the other.

    Parameters
    ----------
    drive
        Of the axis.
    wanted_rad : (time,)
        Wanted angles [rad].
    start_rad
        Where the axis stands before [rad]; left out: in the middle of the play about the first.

    Notes
    -----
    The motor stops at the nearest whole pulse; the axis follows only once its play is used up, so that the same
    command leaves it elsewhere when approached from the other side.
    """
    wanted = as_float_array("wanted_rad", wanted_rad, ("time",))
    motor = np.rint(wanted / drive.pulse_rad) * drive.pulse_rad
    half = 0.5 * drive.backlash_rad
    axis = np.empty_like(motor)
    stands = motor[0] if start_rad is None and len(motor) else start_rad or 0.0
    for i, goes in enumerate(motor):
        stands = min(max(stands, goes - half), goes + half)
        axis[i] = stands
    return axis
