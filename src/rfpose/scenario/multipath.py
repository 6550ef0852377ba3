"""What pose ``site`` knows of waves and antennas: ``[multipath]`` and ``[antenna]``."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rfpose.scenario.records import NonNegative, Point, Record

__all__ = ["Antenna", "Multipath"]

Pair = tuple[NonNegative, NonNegative]


class Antenna(Record):
    """What the antennas make of a wave."""

    transmitter: Literal["isotropic", "half_wave"] = "isotropic"
    """Upright: of gain one in all directions, or a half-wave dipole."""
    receiver: Literal["vertical", "dipole"] = "vertical"
    """On mirrors: answers alike to vertical waves from everywhere, or a short dipole fixed to the mirror."""
    axis_mirror: Point = (0.0, 1.0, 0.0)
    """Of the dipole, in the mirror frame."""
    pattern: str | None = None
    """File of the receivers' pattern, the plate behind them included; its path from where the command is run."""

    @model_validator(mode="after")
    def _one_antenna(self) -> Self:
        if sum(x * x for x in self.axis_mirror) < 1e-18:
            raise ValueError("`antenna.axis_mirror` must not be zero")
        if self.pattern is not None and self.receiver != "vertical":
            raise ValueError("`antenna.pattern` says all of the receivers' antennas: leave `receiver` out")
        return self


class Multipath(Record):
    """Of pose ``site``: which rays are foreseen, how well, and what is left to chance."""

    foresee: tuple[Literal["ground", "specular", "diffracted", "own_plate"], ...] = (
        "ground",
        "specular",
        "diffracted",
        "own_plate",
    )
    """Besides the direct one."""
    visibility: bool = True
    """Whether plates and boxes hide."""
    reach_m: NonNegative = 30.0
    """Plates farther from a mirror than this hide, but turn nothing to it."""
    edges: Literal["all", "boxes"] = "all"
    """Whose edges bend rays: of boxes and plates, or of boxes alone."""
    wedge: Literal["uniform", "sionna"] = "uniform"
    """Coefficients of diffraction: exact for metal half-planes; or those of Sionna RT, to compare with its tables."""
    detour_m: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Mean detour of what nothing foresees: carriers of one antenna closer than c / 2π detour hear the same of it."""
    floor: Annotated[float, Field(gt=0, le=10)] | None = None
    """Strength of what nothing foresees, relative to the direct ray; without it found from residuals."""
    tail: Annotated[float, Field(ge=1)] | None = None
    """Degrees of freedom of Student's t for it; without it found from residuals."""
    ground_sigma: Pair = (0.05, 0.05)
    """Of the ground's rays, besides its constants: relative amplitude, phase [rad]."""
    specular_sigma: Pair = (0.1, 0.3)
    """Of rays off plates and boxes: relative amplitude, phase [rad]."""
    diffracted_sigma: Pair = (0.1, 0.3)
    """Of rays bent around edges: relative amplitude, phase [rad]."""
    own_plate_sigma: Pair = (0.1, 0.3)
    """Of rays off the mirror's own plate, where no pattern holds them: relative amplitude, phase [rad]."""
    permittivity_sigma: Pair = (0.3, 0.1)
    """Relative, of the ground's complex permittivity: real and imaginary part of its relative change."""
    rounds: Annotated[int, Field(ge=1, le=20)] = 3
    """How often rays are foreseen anew from the poses found."""
