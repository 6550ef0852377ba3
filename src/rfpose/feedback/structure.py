"""The structure between motor and mirror: one mode of vibration, its damping by air, and what stiffness costs.

References
----------
Edwards, Arrays of paraboloidal collectors, §5.4.3, §5.6.1, §6.3 and Appendix G.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError

__all__ = [
    "AIR_KG_M3",
    "EDWARDS_MODE",
    "StructureMode",
    "aerodynamic_damping",
    "deflect",
    "mass_ratio",
    "plate_mode_hz",
    "swing_transition",
]

AIR_KG_M3 = 1.2


@dataclass(frozen=True, slots=True, kw_only=True)
class StructureMode:
    """Lowest mode of a collector's structure, K(s) = ω₀²/(s² + 2ζω₀s + ω₀²) (Edwards 6.1).

    Attributes
    ----------
    natural_hz
        Natural frequency [Hz].
    damping
        Part ζ of critical damping; above zero, below one.

    Raises
    ------
    InvalidInputError
        A frequency that is not positive, or a damping outside 0 … 1.
    """

    natural_hz: float = 0.1
    damping: float = 0.3

    def __post_init__(self) -> None:
        as_positive("natural_hz", self.natural_hz)
        if not 0.0 < self.damping < 1.0:
            raise InvalidInputError(f"`damping` must be above 0 and below 1, got {self.damping}")

    @property
    def natural_radps(self) -> float:
        """Natural frequency [rad/s]."""
        return 2.0 * np.pi * self.natural_hz

    def gain(self, frequency_hz: npt.ArrayLike) -> FloatArray:
        """|H|: how much more a swinging load deflects than a steady one (Edwards 5.15, times k)."""
        ratio = np.asarray(frequency_hz, np.float64) / self.natural_hz
        return np.asarray(1.0 / np.sqrt((1.0 - ratio**2) ** 2 + (2.0 * self.damping * ratio) ** 2))


EDWARDS_MODE = StructureMode(natural_hz=0.1, damping=0.3)
"""The mode for which Edwards designs his servo."""


def plate_mode_hz(
    pressure_1mps_pa: float, *, density_kg_m3: float, thickness_m: float, deflection_1mps_rad: float, diameter_m: float
) -> float:
    """Return the frequency of a dish whose rim flaps (Edwards 5.25) [Hz].

    Parameters
    ----------
    pressure_1mps_pa
        Force on a square metre in a steady wind of 1 m/s [Pa].
    density_kg_m3, thickness_m
        Of the collector, the thickness as if it were solid.
    deflection_1mps_rad
        x̄₁, the deflection that this wind makes [rad].
    diameter_m
        Of the dish.
    """
    values = {
        "density_kg_m3": density_kg_m3,
        "thickness_m": thickness_m,
        "deflection_1mps_rad": deflection_1mps_rad,
        "diameter_m": diameter_m,
    }
    product = np.prod([as_positive(name, value) for name, value in values.items()])
    return float(np.sqrt(as_positive("pressure_1mps_pa", pressure_1mps_pa) / (0.5 * product)) / (2.0 * np.pi))


def aerodynamic_damping(
    natural_hz: npt.ArrayLike,
    *,
    speed_mps: npt.ArrayLike,
    area_m2: float,
    mass_kg: float,
    drag_coefficient: float = 1.0,
    air_kg_m3: float = AIR_KG_M3,
) -> FloatArray:
    """Return the part of critical damping that wind on a plate makes, ζ = ρ C_D A V / (4π f M) (Edwards, App. G).

    Parameters
    ----------
    natural_hz, speed_mps : (...)
        Natural frequency [Hz] and mean wind [m/s].
    area_m2, mass_kg
        Of the plate.
    """
    frequency = as_float_array("natural_hz", natural_hz, ("...",), positive=True)
    speed = as_float_array("speed_mps", speed_mps, ("...",))
    plate = air_kg_m3 * drag_coefficient * as_positive("area_m2", area_m2) / as_positive("mass_kg", mass_kg)
    return np.asarray(plate * speed / (4.0 * np.pi * frequency))


def deflect(static_rad: npt.ArrayLike, structure: StructureMode, *, interval_s: float) -> FloatArray:
    """Return the moving deflection that a changing load makes, the load in line between its samples.

    Parameters
    ----------
    static_rad : (..., time)
        What the load of each moment would bend if it were steady [rad].
    structure
        The mode that answers; it rests under the first sample's load at the start.
    interval_s
        Between samples [s].

    Returns
    -------
    (..., time)
        Deflection [rad].
    """
    from scipy import signal

    static = as_float_array("static_rad", static_rad, ("...", "time"))
    w = structure.natural_radps
    step = signal.cont2discrete(
        (np.array([w**2]), np.array([1.0, 2.0 * structure.damping * w, w**2])),
        as_positive("interval_s", interval_s),
        method="foh",
    )
    top, bottom = np.ravel(step[0]), np.ravel(step[1])
    start = signal.lfilter_zi(top, bottom) * static[..., :1]
    return np.asarray(signal.lfilter(top, bottom, static, axis=-1, zi=start)[0])


def swing_transition(structure: StructureMode, *, interval_s: float) -> tuple[FloatArray, FloatArray]:
    """Return how a mode swings from one sample to the next: exact at the samples, whatever their interval.

    State is deflection y and its speed, ``x' = transition @ x + root @ w`` with white w of variance one. The force
    between samples is white about the mode, as Edwards takes it for (5.19), and scaled so that y has variance one.

    Returns
    -------
    transition, root : (2, 2)
        Units of seconds; ``root`` is a lower triangle.
    """
    from scipy.linalg import expm

    w, damping = structure.natural_radps, structure.damping
    transition = expm(np.array([[0.0, 1.0], [-(w**2), -2.0 * damping * w]]) * as_positive("interval_s", interval_s))
    stationary = np.diag([1.0, w**2])
    root = np.linalg.cholesky(stationary - transition @ stationary @ transition.T)
    return np.asarray(transition), np.asarray(root)


def mass_ratio(deflection_ratio: npt.ArrayLike, *, bore_ratio: float, bore_fixed: bool = False) -> FloatArray:
    """Return new mass over old mass of a tube that is to deflect differently (Edwards 5.44).

    Parameters
    ----------
    deflection_ratio : (...)
        S: deflection of the OLD over the new, for the same load; below one for a softer, lighter structure.
    bore_ratio
        Inner over outer diameter before the change.
    bore_fixed
        Keep the inner diameter and change the outer; else the outer is kept.

    Returns
    -------
    (...)
        NaN where no such tube exists: stiffer than a solid bar of the same outer diameter.
    """
    s = as_float_array("deflection_ratio", deflection_ratio, ("...",), positive=True)
    if not 0.0 <= bore_ratio < 1.0:
        raise InvalidInputError(f"`bore_ratio` must be at least 0 and below 1, got {bore_ratio}")
    # second moment ∝ D⁴ − d⁴, mass ∝ D² − d², in units of the outer diameter
    second = s * (1.0 - bore_ratio**4)
    if bore_fixed:
        area = np.sqrt(second + bore_ratio**4) - bore_ratio**2
    else:
        inside = 1.0 - second
        area = 1.0 - np.sqrt(np.where(inside >= 0.0, inside, np.nan))
    return np.asarray(area / (1.0 - bore_ratio**2))
