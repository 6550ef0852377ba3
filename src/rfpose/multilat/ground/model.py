"""What a reflection does to ranges read off phases: planes, their coefficients, and the exact correction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.multilat.reflection import SharedGeometry, shifts_at_points

__all__ = ["LEVEL_GROUND", "Reflector", "Surface", "build_scene", "fresnel_coefficient", "heights_m", "range_shift_m"]

SPEED_OF_LIGHT_MPS = 299_792_458.0
_VACUUM_PERMITTIVITY = 8.8541878128e-12
_KIND = {None: 0, "vertical": 1, "horizontal": 2}

ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """Electrical properties from which Fresnel's formulas give the coefficient.

    Attributes
    ----------
    permittivity
        Relative, real part.
    conductivity_s_per_m
        [S/m].
    polarisation
        Electric field in the plane of incidence ("vertical") or across it ("horizontal").
    """

    permittivity: float
    conductivity_s_per_m: float = 0.0
    polarisation: Literal["vertical", "horizontal"] = "vertical"

    def __post_init__(self) -> None:
        """Refuse what is no dielectric."""
        if not self.permittivity > 1.0:
            raise InvalidInputError(f"`permittivity` must be greater than one, got {self.permittivity}")
        if not self.conductivity_s_per_m >= 0.0:
            raise InvalidInputError(f"`conductivity_s_per_m` must not be negative, got {self.conductivity_s_per_m}")
        if self.polarisation not in ("vertical", "horizontal"):
            raise InvalidInputError(f"`polarisation` must be 'vertical' or 'horizontal', got {self.polarisation!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflector:
    """A plane that reflects: the ground, a wall.

    Attributes
    ----------
    name
        For messages.
    point_enu_m, normal_enu
        A point in the plane [m], and its normal, towards transmitters and receivers (need not be of unit length).
    coefficient
        Complex reflection coefficient at RF. With a ``surface`` it multiplies what Fresnel's formulas give. None =
        estimated with the poses without a surface, one with it.
    surface
        None = the coefficient does not depend on the grazing angle.
    scaled
        Estimate the factor on what the ``surface`` gives.
    """

    name: str = "ground"
    point_enu_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normal_enu: tuple[float, float, float] = (0.0, 0.0, 1.0)
    coefficient: complex | None = None
    surface: Surface | None = None
    scaled: bool = False

    def __post_init__(self) -> None:
        """Refuse a plane without a direction."""
        as_float_array("point_enu_m", self.point_enu_m, (3,))
        if np.linalg.norm(as_float_array("normal_enu", self.normal_enu, (3,))) < 1e-9:
            raise InvalidInputError(f"`normal_enu` of reflector {self.name!r} must not be zero")
        if self.coefficient is not None and not abs(self.coefficient) <= 1.0:
            raise InvalidInputError(
                f"`coefficient` of reflector {self.name!r} must not exceed one in magnitude, got {self.coefficient}"
            )

    @property
    def estimated(self) -> bool:
        """Whether its coefficient, or the factor on it, is found with the poses."""
        return self.coefficient is None and (self.surface is None or self.scaled)


LEVEL_GROUND = Reflector()
"""Level at height zero, coefficient to be estimated."""


def heights_m(point_enu_m: npt.ArrayLike, reflector: Reflector) -> FloatArray:
    """Distance of points (…, xyz) from a reflector's plane [m], negative behind it."""
    point = np.asarray(point_enu_m, np.float64)
    return np.asarray((point - np.asarray(reflector.point_enu_m)) @ geometry.unit(reflector.normal_enu))


def fresnel_coefficient(surface: Surface, grazing_rad: npt.ArrayLike, frequency_hz: npt.ArrayLike) -> ComplexArray:
    """Reflection coefficient of a plane half-space, time as e^{+jωt} [1]_.

    Parameters
    ----------
    surface
    grazing_rad : (...)
        Angle between ray and plane [rad].
    frequency_hz : (...)
        [Hz].

    References
    ----------
    .. [1] J. D. Jackson, Classical Electrodynamics, 3rd ed., §7.3; vertical: the sign that is −1 at grazing incidence.
    """
    sine = np.sin(np.asarray(grazing_rad, np.float64))
    epsilon = _permittivity(surface, np.asarray(frequency_hz, np.float64))
    root = np.sqrt(epsilon - 1.0 + sine**2)
    scale = epsilon if surface.polarisation == "vertical" else 1.0
    return np.asarray((scale * sine - root) / (scale * sine + root))


def range_shift_m(
    transmitter_enu_m: npt.ArrayLike,
    point_enu_m: npt.ArrayLike,
    *,
    reflectors: Sequence[Reflector],
    carrier_rf_hz: npt.ArrayLike,
    tone_hz: npt.ArrayLike,
    free_space: bool = True,
    propagation_speed_mps: float = SPEED_OF_LIGHT_MPS,
) -> FloatArray:
    """Return what reflections add to ranges read off phases, of demodulated tones and of carriers.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    point_enu_m : (point, xyz)
        Receivers, or calibration receivers, whose Φ this corrects: Φ_true = Φ − 2π/λ · shift [m].
    reflectors
        All with a coefficient.
    carrier_rf_hz : (transmitter,)
        Carrier frequencies at RF, f_c + f_i [Hz].
    tone_hz : (group,)
        [Hz]; zero = the carrier's own phase.
    free_space
        Whether a longer ray is weaker by d/d'.
    propagation_speed_mps
        [m/s].

    Returns
    -------
    (point, transmitter, group)
        Range minus distance [m].

    Raises
    ------
    InvalidInputError
        Shapes that do not fit, or a reflector without a coefficient.
    GeometryError
        A transmitter behind a reflector.
    """
    unknown = [r.name for r in reflectors if r.estimated]
    if unknown:
        raise InvalidInputError(f"`reflectors` must have a coefficient each, {unknown[0]!r} has none")
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    point = as_float_array("point_enu_m", point_enu_m, ("point", 3))
    scene = build_scene(
        transmitter,
        reflectors,
        carrier_rf_hz=as_float_array("carrier_rf_hz", carrier_rf_hz, (len(transmitter),), positive=True),
        tone_hz=as_float_array("tone_hz", tone_hz, ("group",)),
        free_space=free_space,
        propagation_speed_mps=as_positive("propagation_speed_mps", propagation_speed_mps),
    )
    out = np.zeros((len(point), len(transmitter), len(scene.tone_k), 4))
    shifts_at_points(len(point), scene, point, out)
    return out[..., 0]


def build_scene(
    transmitter: FloatArray,
    reflectors: Sequence[Reflector],
    *,
    carrier_rf_hz: FloatArray,
    tone_hz: FloatArray,
    free_space: bool,
    propagation_speed_mps: float,
) -> SharedGeometry:
    """Arrays for the kernels; arguments as in `range_shift_m`. Coefficients to be estimated start at zero.

    Raises
    ------
    GeometryError
        A transmitter behind a reflector: it has no mirror image there.
    """
    n_plane, n_transmitter = len(reflectors), len(transmitter)
    image = np.zeros((n_plane, n_transmitter, 3))
    permittivity = np.ones((n_plane, n_transmitter), np.complex128)
    coefficient = np.zeros(n_plane, np.complex128)
    column = np.full(n_plane, -1, np.int64)
    free = 0
    for p, reflector in enumerate(reflectors):
        height = heights_m(transmitter, reflector)
        if np.any(height <= 0.0):
            i = int(np.argmin(height))
            raise GeometryError(
                f"transmitter {i} lies {-height[i]:.3g} m behind reflector {reflector.name!r}: it has no reflection "
                f"there; turn `normal_enu` around, move the plane, or leave the reflector out"
            )
        image[p] = transmitter - 2.0 * height[:, None] * geometry.unit(reflector.normal_enu)
        if reflector.surface is not None:
            permittivity[p] = _permittivity(reflector.surface, carrier_rf_hz)
        if reflector.estimated:
            column[p] = free
            free += 2
        else:
            coefficient[p] = 1.0 if reflector.coefficient is None else reflector.coefficient
    return SharedGeometry(
        transmitter=np.array(transmitter),
        image=image,
        normal=np.array([geometry.unit(r.normal_enu) for r in reflectors]).reshape(-1, 3),
        carrier_k=2.0 * np.pi * carrier_rf_hz / propagation_speed_mps,
        tone_k=2.0 * np.pi * tone_hz / propagation_speed_mps,
        kind=np.array([_KIND[r.surface.polarisation if r.surface else None] for r in reflectors], np.int64),
        permittivity=permittivity,
        spreads=free_space,
        coefficient=coefficient,
        column=column,
        common=np.zeros((1, n_transmitter, len(tone_hz), 1 + free)),
    )


def _permittivity(surface: Surface, frequency_hz: FloatArray) -> ComplexArray:
    loss = surface.conductivity_s_per_m / (2.0 * np.pi * frequency_hz * _VACUUM_PERMITTIVITY)
    return np.asarray(surface.permittivity - 1j * loss)
