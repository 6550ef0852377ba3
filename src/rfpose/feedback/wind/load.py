"""From wind to torque to deflection of the mirror."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback.structure import AIR_KG_M3, StructureMode, deflect

__all__ = ["WindLoad", "wind_bend"]


@dataclass(frozen=True, slots=True, kw_only=True)
class WindLoad:
    """What the wind does to one axis of a mirror.

    Attributes
    ----------
    area_m2
        Of the mirror.
    coefficient
        Of drag, or of the torque: torque = ½ ρ C A lever V².
    lever_m
        With a drag coefficient the distance of the wind's pressure from the axis, with a torque coefficient the height
        or side that it is told for [m].
    stiffness_nm_per_rad
        Of drive and structure about the axis.
    air_kg_m3
        Density of the air.
    """

    area_m2: float
    lever_m: float
    stiffness_nm_per_rad: float
    coefficient: float = 1.0
    air_kg_m3: float = AIR_KG_M3

    def __post_init__(self) -> None:
        for name in ("area_m2", "lever_m", "stiffness_nm_per_rad", "air_kg_m3"):
            as_positive(name, getattr(self, name))
        if not np.isfinite(self.coefficient):
            raise InvalidInputError(f"`coefficient` must be finite, got {self.coefficient}")

    @property
    def torque_1mps_nm(self) -> float:
        """Torque of a steady wind of 1 m/s [N m]."""
        return 0.5 * self.air_kg_m3 * self.coefficient * self.area_m2 * self.lever_m

    @property
    def deflection_1mps_rad(self) -> float:
        """x̄₁: what a steady wind of 1 m/s bends [rad]."""
        return self.torque_1mps_nm / self.stiffness_nm_per_rad


def wind_bend(
    deflection_1mps_rad: float,
    speed_mps: npt.ArrayLike,
    *,
    structure: StructureMode | None = None,
    interval_s: float = 1.0,
) -> FloatArray:
    """Return what a wind record bends a mirror by.

    Parameters
    ----------
    deflection_1mps_rad
        x̄₁ [rad].
    speed_mps : (..., time)
        Mean wind and gusts together [m/s].
    structure
        The mode that answers; None: at once and without overshoot.
    interval_s
        Between samples [s].
    """
    speed = as_float_array("speed_mps", speed_mps, ("...", "time"))
    static = as_positive("deflection_1mps_rad", deflection_1mps_rad) * speed * np.abs(speed)
    return static if structure is None else deflect(static, structure, interval_s=interval_s)
