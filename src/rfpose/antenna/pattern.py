"""Antenna patterns of a type of mirror: what each receiver makes of a wave, over the direction it comes from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.antenna.sphere import ComplexArray, cartesian, components
from rfpose.antenna.table import PatternTable, table_of
from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.geometry import unit
from rfpose.scenario import SPEED_OF_LIGHT_MPS

__all__ = ["MISSING_SIGMA", "AntennaPattern", "dipole_pattern"]

MISSING_SIGMA = 1.0
"""Error of the response where the table has none: as large as that of a dipole broadside in free space."""

_PLACE_WAVELENGTHS = 0.05
_FEWEST = (4, 6)
BEYOND = 0.02  # of a frequency: so far outside the table its end still holds
_LARGEST = 1e3
_DIPOLE_STEP_DEG = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AntennaPattern:
    """Responses of the receivers of a type of mirror: the mirror's plate, and all that moves with it, included.

    The voltage of a receiver is response θ · Eθ + response φ · Eφ for a plane wave that has the phase 0 at the
    receiver's own place; time goes as exp(+jωt), so that a way of length d turns by exp(−jkd). Polar angle and azimuth
    name the direction FROM the receiver TO the source, in the mirror frame: polar from the mirror's normal z, azimuth
    from x to y. θ̂ = (cosθ cosφ, cosθ sinφ, −sinθ), φ̂ = (−sinφ, cosφ, 0). The unit is the response of a short dipole
    broadside in free space, so that a lone dipole has the response θ̂ · axis, φ̂ · axis. A factor common to all
    receivers and directions means nothing.

    Attributes
    ----------
    frequency_hz : (frequency,)
        Rising [Hz].
    receiver_mirror_m : (receiver, xyz)
        Places in the mirror frame, to which the phases refer [m].
    axis_mirror : (receiver, xyz)
        Axes of the dipoles, unit vectors: what is taken where the table has nothing.
    response : (frequency, receiver, polar, azimuth, component)
        Components θ, φ; polar angles evenly from 0 to π with both ends, azimuths evenly from 0 to 2π without its end,
        an even number of them. NaN = unknown.
    sigma : (frequency, receiver, polar, azimuth)
        Error (1 σ) of the response: of the real and of the imaginary part of either component. Where the response is
        unknown it is `MISSING_SIGMA`.

    Raises
    ------
    InvalidInputError
        A shape, frequency, place or value that cannot be.
    """

    frequency_hz: FloatArray
    receiver_mirror_m: FloatArray
    axis_mirror: FloatArray
    response: ComplexArray
    sigma: FloatArray

    def __post_init__(self) -> None:
        put = object.__setattr__
        frequency = as_float_array("frequency_hz", self.frequency_hz, ("frequency",), positive=True)
        if not len(frequency) or np.any(np.diff(frequency) <= 0.0):
            raise InvalidInputError("`frequency_hz` must hold at least one frequency, rising")
        place = as_float_array("receiver_mirror_m", self.receiver_mirror_m, ("receiver", 3))
        if not len(place) or np.abs(place).max() > _LARGEST:
            raise InvalidInputError(f"`receiver_mirror_m` must hold at least one receiver, within {_LARGEST:g} m")
        axis = as_float_array("axis_mirror", self.axis_mirror, (len(place), 3))
        if np.any(np.abs(np.linalg.norm(axis, axis=1) - 1.0) > 1e-6):
            raise InvalidInputError("`axis_mirror` must be unit vectors")
        response = np.array(self.response, np.complex128)
        if response.ndim != 5 or response.shape[:2] != (len(frequency), len(place)) or response.shape[4] != 2:
            raise InvalidInputError(
                f"`response` must have shape ({len(frequency)}, {len(place)}, polar, azimuth, 2), got {response.shape}"
            )
        n_polar, n_azimuth = response.shape[2:4]
        if n_polar < _FEWEST[0] or n_azimuth < _FEWEST[1] or n_azimuth % 2:
            raise InvalidInputError(
                f"`response` must have at least {_FEWEST[0]} polar angles and an even number of azimuths, at least "
                f"{_FEWEST[1]}, got {n_polar} and {n_azimuth}"
            )
        if np.any(np.abs(response[np.isfinite(response)]) > _LARGEST):
            raise InvalidInputError(f"`response` must be below {_LARGEST:g} (1 = a dipole broadside in free space)")
        unknown = ~np.isfinite(response).all(axis=-1)
        response[unknown] = np.nan
        sigma = np.array(as_float_array("sigma", self.sigma, response.shape[:4], finite=False))
        sigma[unknown] = MISSING_SIGMA
        if not np.isfinite(sigma).all() or sigma.min() < 0.0:
            raise InvalidInputError("`sigma` must be zero or greater where the response is known")
        for name, value in (
            ("frequency_hz", frequency),
            ("receiver_mirror_m", place),
            ("axis_mirror", axis),
            ("response", response),
            ("sigma", sigma),
        ):
            put(self, name, read_only(value))

    @property
    def n_receiver(self) -> int:
        """Receivers of a mirror."""
        return len(self.receiver_mirror_m)

    def check_receivers(self, receiver_mirror_m: npt.ArrayLike) -> None:
        """Refuse a pattern that is of other receivers than a mirror's, or has them in another order.

        Parameters
        ----------
        receiver_mirror_m : (receiver, xyz)
            The mirror's, from the plate's centre [m].

        Raises
        ------
        InvalidInputError
            Another number of receivers, or one that is farther from its place than a twentieth of the wavelength.
        """
        place = as_float_array("receiver_mirror_m", receiver_mirror_m, ("receiver", 3))
        if len(place) != self.n_receiver:
            raise InvalidInputError(
                f"the antenna pattern is of {self.n_receiver} receivers, and the mirror has {len(place)}; give the "
                "pattern of this type of mirror"
            )
        off_m = np.linalg.norm(place - self.receiver_mirror_m, axis=1)
        limit_m = _PLACE_WAVELENGTHS * SPEED_OF_LIGHT_MPS / self.frequency_hz[-1]
        if off_m.max() > limit_m:
            r = int(np.argmax(off_m))
            raise InvalidInputError(
                f"receiver {r} of the antenna pattern stands at {self.receiver_mirror_m[r].tolist()}, the mirror's at "
                f"{place[r].tolist()}; give the pattern of this type of mirror, its receivers in the same order"
            )

    def table(self, frequency_hz: float) -> PatternTable:
        """Return the table of one frequency, from which directions are looked up.

        Between the frequencies of the pattern the response is that of the parabola through the nearest three.

        Parameters
        ----------
        frequency_hz
            Of the wave [Hz].

        Raises
        ------
        InvalidInputError
            The pattern reaches from two per cent below its lowest to two above its highest frequency.
        """
        wanted = as_positive("frequency_hz", frequency_hz)
        known = self.frequency_hz
        if not known[0] * (1.0 - BEYOND) <= wanted <= known[-1] * (1.0 + BEYOND):
            raise InvalidInputError(
                f"the antenna pattern holds from {known[0] / 1e6:.6g} to {known[-1] / 1e6:.6g} MHz, and "
                f"{wanted / 1e6:.6g} MHz is asked for; give a pattern of that frequency"
            )
        # three, where there are so many: a short dipole's response grows with frequency, and bends
        near = np.sort(np.argsort(np.abs(known - wanted), kind="stable")[:3])
        response = np.tensordot(_lagrange(known[near], wanted), self.response[near], 1)
        sigma = self.sigma[near].max(axis=0)
        return table_of(cartesian(response), sigma, self.axis_mirror)


def _lagrange(known: FloatArray, wanted: float) -> FloatArray:
    """Return the weights of values at known places in the polynomial through them."""
    other = ~np.eye(len(known), dtype=bool)
    ratio = np.divide(wanted - known, known[:, None] - known, out=np.ones(other.shape), where=other)
    return np.asarray(ratio.prod(axis=1))


def dipole_pattern(receiver_mirror_m: npt.ArrayLike, axis_mirror: npt.ArrayLike, frequency_hz: float) -> AntennaPattern:
    """Return the pattern of short dipoles alone in free space: the axis, seen from the direction.

    An antenna that answers alike to all directions is not among the patterns: no tangential field on a sphere has the
    same length everywhere. An isotropic vertical antenna, as ray tables have it, is for the caller.

    Parameters
    ----------
    receiver_mirror_m : (receiver, xyz)
        Places in the mirror frame [m].
    axis_mirror : (xyz,) or (receiver, xyz)
        Axes in the mirror frame, of any length.
    frequency_hz
        Where it is to hold, within two per cent [Hz].

    Raises
    ------
    InvalidInputError
        Wrong shapes; an axis of no length.
    """
    place = as_float_array("receiver_mirror_m", receiver_mirror_m, ("receiver", 3))
    axis = unit(np.broadcast_to(as_float_array("axis_mirror", axis_mirror, ("...", 3)), place.shape))
    if not np.isfinite(axis).all():
        raise InvalidInputError("`axis_mirror` must have a length")
    n_polar, n_azimuth = round(180.0 / _DIPOLE_STEP_DEG) + 1, round(360.0 / _DIPOLE_STEP_DEG)
    shape = (1, len(place), n_polar, n_azimuth)
    return AntennaPattern(
        frequency_hz=np.array([frequency_hz], np.float64),
        receiver_mirror_m=place,
        axis_mirror=axis,
        response=components(np.broadcast_to(axis[None, :, None, None].astype(np.complex128), (*shape, 3))),
        sigma=np.zeros(shape),
    )
