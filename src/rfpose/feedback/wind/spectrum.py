"""Gust spectrum, what a structure makes of it, and how much of that a servo takes away.

References
----------
Edwards, Arrays of paraboloidal collectors, §5.4.3, (5.14)-(5.25).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback.structure import StructureMode

__all__ = [
    "MEAN_WIND_MPS",
    "ROUGHNESS",
    "STOW_MPS",
    "Deflection",
    "admittance",
    "gust_spectrum",
    "perfect_servo",
    "rigidity_gain",
    "sunshine_deflection",
    "wind_deflection",
]

ROUGHNESS = 0.04
"""k', Edwards' urban value; the spectrum then has a turbulence intensity of √(6 k') = 49 %."""
MEAN_WIND_MPS = 3.0
"""V̄_k of sunny hours (Inyokern)."""
STOW_MPS = 10.0
_LENGTH_M = 1200.0
_LOWEST_HZ, _HIGHEST_HZ = 1e-3, 10.0

Residual = Callable[[FloatArray], FloatArray]
"""Part of a deflection's amplitude that a servo leaves, by frequency [Hz]."""


@dataclass(frozen=True, slots=True)
class Deflection:
    """Standard deviations of a wind deflection [rad]: background, resonant, both."""

    background_rad: float
    resonant_rad: float

    @property
    def total_rad(self) -> float:
        """Root of the sum of squares."""
        return float(np.hypot(self.background_rad, self.resonant_rad))


def gust_spectrum(frequency_hz: npt.ArrayLike, speed_mps: npt.ArrayLike, *, roughness: float = ROUGHNESS) -> FloatArray:
    """Return S_v(f) of the gusts about a mean wind [(m/s)²/Hz] (Edwards 5.24).

    f S / (k' V²) = 4 b²/(1 + b²)^(4/3), b = 1200 f/V; its integral over all frequencies is 6 k' V².
    """
    frequency = as_float_array("frequency_hz", frequency_hz, ("...",), positive=True)
    speed = as_float_array("speed_mps", speed_mps, ("...",), positive=True)
    b = _LENGTH_M * frequency / speed
    return np.asarray(roughness * speed**2 / frequency * 4.0 * b**2 / (1.0 + b**2) ** (4.0 / 3.0))


def admittance(frequency_hz: npt.ArrayLike, speed_mps: npt.ArrayLike, *, size_m: float) -> FloatArray:
    """Return χ²: what part of a gust's power a plate of this side feels, as gusts smaller than it average out.

    [1 + (2 f √A/V)^(4/3)]⁻², a usual fit to the curves that Edwards took from Vickery (1970) and does not print.
    """
    frequency = as_float_array("frequency_hz", frequency_hz, ("...",))
    speed = as_float_array("speed_mps", speed_mps, ("...",), positive=True)
    return np.asarray((1.0 + (2.0 * frequency * size_m / speed) ** (4.0 / 3.0)) ** -2.0)


def perfect_servo(bandwidth_hz: float) -> Residual:
    """Return a servo that takes away all below its bandwidth and nothing above it, as Edwards counts."""
    edge = as_positive("bandwidth_hz", bandwidth_hz)
    return lambda frequency: (np.asarray(frequency) >= edge).astype(np.float64)


def wind_deflection(
    deflection_1mps_rad: float,
    speed_mps: npt.ArrayLike,
    structure: StructureMode,
    *,
    size_m: float,
    residual: Residual | None = None,
    roughness: float = ROUGHNESS,
) -> tuple[FloatArray, FloatArray]:
    """Return variances of a deflection in a mean wind: background (5.20) and resonant (5.19).

    Parameters
    ----------
    deflection_1mps_rad
        x̄₁, what a steady wind of 1 m/s bends; grows with the square of the wind [rad].
    speed_mps : (...)
        Mean winds [m/s].
    structure
        The mode that answers. Background: all up to 10 Hz as if it were stiff. Resonant: what the mode adds, which no
        servo takes away.
    size_m
        Side of the plate [m].
    residual
        What a servo leaves of the background; None: all.

    Returns
    -------
    background, resonant : (...)
        [rad²].
    """
    bend = as_positive("deflection_1mps_rad", deflection_1mps_rad)
    speed = as_float_array("speed_mps", speed_mps, ("...",), positive=True)
    edges = np.geomspace(_LOWEST_HZ, _HIGHEST_HZ, 1201)
    frequency = np.sqrt(edges[1:] * edges[:-1])
    left = np.ones_like(frequency) if residual is None else residual(frequency) ** 2
    felt = admittance(frequency, speed[..., None], size_m=size_m) * gust_spectrum(
        frequency, speed[..., None], roughness=roughness
    )
    background = 4.0 * (bend * speed) ** 2 * np.sum(felt * left * np.diff(edges), axis=-1)
    at = structure.natural_hz
    there = admittance(at, speed, size_m=size_m) * gust_spectrum(at, speed, roughness=roughness)
    resonant = there * np.pi * at / structure.damping * (bend * speed) ** 2
    return background, np.asarray(resonant)


def sunshine_deflection(
    deflection_1mps_rad: float,
    structure: StructureMode,
    *,
    size_m: float,
    residual: Residual | None = None,
    mean_mps: float = MEAN_WIND_MPS,
    stow_mps: float = STOW_MPS,
    roughness: float = ROUGHNESS,
) -> Deflection:
    """Return the deflection over all sunny hours with less wind than mirrors are stowed at (Edwards 5.22, 5.23).

    Winds of sunny hours are exponential about ``mean_mps`` (5.21). As with Edwards, hours in stow count as none.
    """
    node, weight = np.polynomial.legendre.leggauss(60)
    top = as_positive("stow_mps", stow_mps)
    speed = 0.5 * top * (node + 1.0)
    chance = 0.5 * top * weight * np.exp(-speed / as_positive("mean_mps", mean_mps)) / mean_mps
    background, resonant = wind_deflection(
        deflection_1mps_rad, speed, structure, size_m=size_m, residual=residual, roughness=roughness
    )
    return Deflection(
        background_rad=float(np.sqrt(np.sum(chance * background))),
        resonant_rad=float(np.sqrt(np.sum(chance * resonant))),
    )


def rigidity_gain(
    structure: StructureMode,
    residual: Residual,
    *,
    size_m: float,
    against: Residual | None = None,
    mean_mps: float = MEAN_WIND_MPS,
    stow_mps: float = STOW_MPS,
) -> float:
    """Return how much softer the structure may be with one servo than with another, for the same rms deflection.

    Parameters
    ----------
    residual, against
        What the servos leave; ``against`` None: no servo.
    """
    with_servo, without = (
        sunshine_deflection(
            1e-3, structure, size_m=size_m, residual=each, mean_mps=mean_mps, stow_mps=stow_mps
        ).total_rad
        for each in (residual, against)
    )
    if with_servo == 0.0:
        raise InvalidInputError("`residual` leaves nothing; a servo has a finite bandwidth")
    return without / with_servo
