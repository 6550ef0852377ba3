"""Rules of thumb with their sources: speeds a mount needs, quantisation, speed commands, sensors, control interval."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError

__all__ = [
    "EARTH_RADPS",
    "SLEW_RADPS",
    "azimuth_speed_radps",
    "sensor_null_shift_rad",
    "speed_command_rms_rad",
]

EARTH_RADPS = 2.0 * np.pi / 86_400.0
"""Turn of the mean sun [rad/s]; Edwards rounds it to 7.3e-5."""
SLEW_RADPS = np.pi / 3600.0
"""Greatest speed of Edwards' actuators."""


def azimuth_speed_radps(latitude_rad: npt.ArrayLike, declination_rad: npt.ArrayLike) -> FloatArray:
    """Return the greatest speed of axis 1 over a day, dish on the sun: k cos δ / sin|B − δ| (Edwards 5.3).

    Parameters
    ----------
    latitude_rad : (...)
        B, of a plumb line along axis 1: leaning the axis poleward adds to it [rad].
    declination_rad : (...)
        Of the sun [rad].

    Returns
    -------
    (...)
        Infinite where the sun passes through the axis [rad/s].
    """
    latitude = as_float_array("latitude_rad", latitude_rad, ("...",))
    declination = as_float_array("declination_rad", declination_rad, ("...",))
    with np.errstate(divide="ignore"):
        return np.asarray(EARTH_RADPS * np.cos(declination) / np.abs(np.sin(latitude - declination)))


def speed_command_rms_rad(interval_s: float, bits: int, *, speed_radps: float = SLEW_RADPS) -> float:
    """Return the rms error of a path commanded as speeds of a sign and so many bits [rad] (Edwards 5.40-5.42).

    The end points are off by up to half the least change of speed times the interval, independent of each other; the
    mean square along the line between them is two thirds of theirs.
    """
    if bits < 1:
        raise InvalidInputError(f"`bits` must be one or more, got {bits}")
    end = as_positive("speed_radps", speed_radps) / 2**bits * as_positive("interval_s", interval_s) / 2.0
    return float(np.sqrt(2.0 / 3.0) / np.sqrt(3.0) * end)


def sensor_null_shift_rad(gain_ratio: npt.ArrayLike, *, zone_rad: float = 9.3e-3) -> FloatArray:
    """Return how far the null of a shadow-bar sensor moves if its two elements differ [rad] (Edwards 20.1).

    Parameters
    ----------
    gain_ratio : (...)
        γ = tan(ψ/2 + β)/tan(ψ/2 − β), of one element's gain over the other's.
    zone_rad
        ψ, width of the penumbra, the sun's diameter [rad].
    """
    gamma = as_float_array("gain_ratio", gain_ratio, ("...",), positive=True)
    # tan(a + β)/tan(a − β) = (sin 2a + sin 2β)/(sin 2a − sin 2β)
    return np.asarray(0.5 * np.arcsin(np.sin(zone_rad) * (gamma - 1.0) / (gamma + 1.0)))
