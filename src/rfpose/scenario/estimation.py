"""How poses are estimated where the site reflects and transmitters fail: ``[reflection]`` and ``[integrity]``."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rfpose.scenario.records import Identifier, NonNegative, Point, Positive, Record

__all__ = ["Integrity", "Motion", "Plane", "Reflection"]

Coefficient = tuple[float, float]
Probability = Annotated[float, Field(gt=0, lt=1)]


class Plane(Record):
    """A wall or another plane at a known place that reflects besides the ground."""

    name: Identifier
    point_enu_m: Point
    normal_enu: Point
    """Towards transmitters and receivers; need not be of unit length."""
    coefficient: Coefficient | None = None
    """Real and imaginary part at RF; without it estimated with the poses."""

    @model_validator(mode="after")
    def _possible(self) -> Self:
        _check_normal(self.normal_enu)
        _check_coefficient(self.coefficient)
        return self


class Reflection(Record):
    """The reflected rays in the model of pose ``rigid``, and where their coefficients come from."""

    model: Literal["none", "estimate", "known", "fresnel"] = "none"
    """Of the ground's coefficient: no reflection at all, estimated with the poses, given, or by Fresnel's formulas."""
    coefficient: Coefficient | None = None
    """Of model ``known``: real and imaginary part at RF."""
    permittivity: Annotated[float, Field(gt=1)] | None = None
    """Of model ``fresnel``: relative, real part."""
    conductivity_s_per_m: NonNegative = 0.0
    polarisation: Literal["vertical", "horizontal"] = "vertical"
    scaled: bool = False
    """Model ``fresnel`` with a complex factor on it that is estimated."""
    height_m: float = 0.0
    """Of the ground where the site's origin is."""
    normal_enu: Point = (0.0, 0.0, 1.0)
    """Of the ground, upwards: level unless given."""
    spreading: Literal["free_space", "none"] = "free_space"
    """Whether the longer ray is the weaker one."""
    shared: Literal["recording", "frame", "mirror"] = "recording"
    """One coefficient for all mirrors and frames, one a frame, or one a mirror over all frames."""
    plane: tuple[Plane, ...] = ()

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.model == "known") != (self.coefficient is not None):
            raise ValueError('`reflection.coefficient` goes with `model = "known"`: give both or neither')
        if (self.model == "fresnel") != (self.permittivity is not None):
            raise ValueError('`reflection.permittivity` goes with `model = "fresnel"`: give both or neither')
        if self.model == "none" and self.plane:
            raise ValueError("`reflection.plane` needs a `model`; without one nothing reflects")
        if self.scaled and self.model != "fresnel":
            raise ValueError('`reflection.scaled` is a factor on Fresnel\'s formulas; it needs `model = "fresnel"`')
        _check_normal(self.normal_enu)
        _check_coefficient(self.coefficient)
        names = ["ground", *(p.name for p in self.plane)]
        if len(set(names)) < len(names):
            raise ValueError("`reflection.plane` needs a `name` of its own for each plane, and none is `ground`")
        return self


class Integrity(Record):
    """Tests of each mirror's residuals: what is left out, and what is guaranteed."""

    enabled: bool = True
    false_alarm: Probability = 1e-3
    """That a mirror without any error is not found consistent."""
    missed_detection: Probability = 1e-3
    """That the normal is farther off than the protection level without a warning, one transmitter being wrong."""
    max_excluded: Annotated[int, Field(ge=0)] = 4
    """Transmitters and priors to leave out of one mirror at most; 0 only tests."""


class Motion(Record):
    """How mirrors move, for the filter of poses over frames."""

    filtered: bool = False
    """Whether poses are filtered, unless the command line says otherwise."""
    rate_walk_radps_per_sqrt_s: NonNegative = 1e-6
    """Random walk of the turning rate, each axis; 0: the rate is constant."""
    rate_sigma_radps: Positive = 1e-2
    """What the rate may be when nothing was measured yet, each axis."""
    gate_probability: Probability = 1e-6
    """A pose rarer than this under the prediction is left out."""
    restart_after: Annotated[int, Field(ge=1)] = 3
    """So many rejected frames in a row are believed after all."""
    max_coast_s: Positive | None = None
    """A prediction older than this is given up; without it never."""


def _check_normal(normal: Point) -> None:
    if math.hypot(*normal) < 1e-9:
        raise ValueError("`normal_enu` of a reflecting plane must not be zero")


def _check_coefficient(coefficient: Coefficient | None) -> None:
    if coefficient is not None and math.hypot(*coefficient) > 1.0:
        raise ValueError(f"`coefficient` of a reflection must not exceed one in magnitude, got {list(coefficient)}")
