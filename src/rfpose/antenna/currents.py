"""Currents that stand for an antenna and its plate: what they radiate is linear in them, and smooth by itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfpose.antenna.pattern import AntennaPattern
from rfpose.antenna.sphere import ComplexArray, components, grid_directions
from rfpose.antenna.table import PatternTable
from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.geometry import unit

__all__ = ["Currents", "MirrorType"]

_SPACING = 0.36
"""Of the plate's currents, in wavelengths: finer ones radiate nothing else (half a wavelength is the limit)."""
_MOST_A_RECEIVER = 1200
_EXTRA_DEGREE = 8
_OPEN = 1e-6
"""Of the mean square of a response (about 1): so far a pattern need not be met by currents."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorType:
    """What mirrors of one type have in common.

    Attributes
    ----------
    receiver_mirror_m : (receiver, xyz)
        Places in the mirror frame [m].
    axis_mirror : (receiver, xyz)
        Axes of the dipoles; of any length when given, unit vectors afterwards.
    plate_m : (width, height)
        Of the plate, which lies about the origin in z = 0 [m].

    Raises
    ------
    InvalidInputError
        Wrong shapes or values.
    """

    receiver_mirror_m: FloatArray
    axis_mirror: FloatArray
    plate_m: tuple[float, float]

    def __post_init__(self) -> None:
        put = object.__setattr__
        place = as_float_array("receiver_mirror_m", self.receiver_mirror_m, ("receiver", 3))
        axis = as_float_array("axis_mirror", self.axis_mirror, ("...", 3))
        if axis.ndim > 2 or (axis.ndim == 2 and len(axis) != len(place)):
            raise InvalidInputError(f"`axis_mirror` must have shape (3,) or ({len(place)}, 3), got {axis.shape}")
        axis = unit(np.broadcast_to(axis, place.shape))
        if not np.isfinite(axis).all():
            raise InvalidInputError("`axis_mirror` must have a length")
        width, height = self.plate_m
        put(self, "receiver_mirror_m", read_only(place))
        put(self, "axis_mirror", read_only(axis))
        put(self, "plate_m", (as_positive("plate_m", width), as_positive("plate_m", height)))

    @property
    def n_receiver(self) -> int:
        """Receivers of a mirror."""
        return len(self.receiver_mirror_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Currents:
    """Elements of current: three at each receiver, along x, y, z, and two at each point of a grid on the plate.

    An element at x with the direction u gives a receiver at m the effective length (u − s (s·u)) exp(jk s·(x − m))
    towards s, in the unit of a dipole. What a receiver of a plate does lies in these: the plate carries tangential
    currents only, and as many of them as its size in wavelengths can tell apart.

    Attributes
    ----------
    mirror
        What they stand for.
    wave_number_radpm
        2π/λ [rad/m].
    place_mirror_m : (point, xyz)
        Points of the grid on the plate [m].
    """

    mirror: MirrorType
    wave_number_radpm: float
    place_mirror_m: FloatArray

    @classmethod
    def of(cls, mirror: MirrorType, frequency_hz: float, *, speed_mps: float) -> Currents:
        """Return the currents of a type of mirror at a frequency.

        Raises
        ------
        InvalidInputError
            The plate is so large in wavelengths that its pattern cannot be learned.
        """
        wavelength_m = speed_mps / as_positive("frequency_hz", frequency_hz)
        counts = [max(2, int(np.ceil(side / (_SPACING * wavelength_m))) + 1) for side in mirror.plate_m]
        if 2 * counts[0] * counts[1] > _MOST_A_RECEIVER:
            raise InvalidInputError(
                f"a plate of {mirror.plate_m[0] / wavelength_m:.3g} x {mirror.plate_m[1] / wavelength_m:.3g} "
                f"wavelengths has {2 * counts[0] * counts[1]} currents, more than the {_MOST_A_RECEIVER} that can be "
                "learned; make its pattern with `scripts/antenna_pattern.py`, or take it for smaller"
            )
        sides = [
            (np.arange(count) + 0.5) / count * side - 0.5 * side
            for count, side in zip(counts, mirror.plate_m, strict=True)
        ]
        x, y = np.meshgrid(*sides, indexing="ij")
        return cls(
            mirror=mirror,
            wave_number_radpm=2.0 * np.pi / wavelength_m,
            place_mirror_m=read_only(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)),
        )

    @property
    def n_coefficient(self) -> int:
        """Elements of one receiver."""
        return 3 + 2 * len(self.place_mirror_m)

    def responses(self, direction_mirror: FloatArray, field_mirror: ComplexArray, receiver: int) -> ComplexArray:
        """Return what each element makes of waves (wave, element): its effective length · field.

        Parameters
        ----------
        direction_mirror : (wave, xyz)
            From the receiver to where a wave comes from; unit vectors, mirror frame.
        field_mirror : (wave, xyz)
            Fields at the receiver, mirror frame.
        receiver
            Which.
        """
        along = np.sum(direction_mirror * field_mirror, axis=1, keepdims=True)
        across = field_mirror - direction_mirror * along
        detour = direction_mirror @ (self.place_mirror_m - self.mirror.receiver_mirror_m[receiver]).T
        turned = np.exp(1j * self.wave_number_radpm * detour)
        return np.concatenate([across, across[:, :1] * turned, across[:, 1:2] * turned], axis=1)

    def grid(self) -> tuple[int, int]:
        """Return how many polar angles and azimuths carry the patterns of these currents."""
        reach = np.linalg.norm(self.place_mirror_m[None] - self.mirror.receiver_mirror_m[:, None], axis=-1).max()
        degree = self.wave_number_radpm * reach + _EXTRA_DEGREE
        step = next((s for s in (10.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.5, 1.0) if 180.0 / s > degree), 0.5)
        n_polar = round(180.0 / step) + 1
        return n_polar, 2 * (n_polar - 1)

    def effective_lengths(self, receiver: int) -> ComplexArray:
        """Return the elements' effective lengths on the grid (polar, azimuth, xyz, element)."""
        direction = grid_directions(*self.grid())
        flat = direction.reshape(-1, 3)
        found = [
            self.responses(flat, np.broadcast_to(axis.astype(np.complex128), flat.shape), receiver)
            for axis in np.eye(3)
        ]
        return np.stack(found, axis=1).reshape(*direction.shape, self.n_coefficient)

    def dipoles(self) -> ComplexArray:
        """Return the coefficients (receiver, element) of dipoles in free space."""
        found = np.zeros((self.mirror.n_receiver, self.n_coefficient), np.complex128)
        found[:, :3] = self.mirror.axis_mirror
        return found

    def nearest_to(self, table: PatternTable, plate_sigma: FloatArray) -> ComplexArray:
        """Return the coefficients (receiver, element) whose pattern is nearest to a table.

        Parameters
        ----------
        table
            Of these receivers, at this frequency.
        plate_sigma : (receiver, point)
            How large the currents of the plate may be, where the pattern leaves it open.
        """
        grid = grid_directions(*self.grid())[1:-1]  # the poles would be there for each azimuth
        direction = grid.reshape(-1, 3)
        weight = np.sqrt(np.repeat(np.hypot(grid[..., 0], grid[..., 1]).ravel(), 3))
        found = self.dipoles()
        for r in range(self.mirror.n_receiver):
            lengths = self.effective_lengths(r)[1:-1].reshape(-1, self.n_coefficient)
            wanted = table.vector(direction, r).ravel() - lengths @ found[r]
            sigma = np.concatenate([np.ones(3), plate_sigma[r], plate_sigma[r]])
            rows = weight[:, None] * lengths * sigma
            square = rows.conj().T @ rows + _OPEN * len(direction) * np.eye(self.n_coefficient)
            found[r] += sigma * np.linalg.solve(square, rows.conj().T @ (weight * wanted))
        return found

    def pattern(
        self, coefficient: ComplexArray, frequency_hz: float, sigma: FloatArray | None = None
    ) -> AntennaPattern:
        """Return the pattern of currents (receiver, element), with errors (receiver, polar, azimuth)."""
        vector = np.array([self.effective_lengths(r) @ coefficient[r] for r in range(self.mirror.n_receiver)])
        return self.pattern_of_lengths(vector, frequency_hz, sigma)

    def pattern_of_lengths(
        self, vector: ComplexArray, frequency_hz: float, sigma: FloatArray | None = None
    ) -> AntennaPattern:
        """Return the pattern of effective lengths (receiver, polar, azimuth, xyz) on the grid."""
        return AntennaPattern(
            frequency_hz=np.array([frequency_hz]),
            receiver_mirror_m=self.mirror.receiver_mirror_m,
            axis_mirror=self.mirror.axis_mirror,
            response=components(vector)[None],
            sigma=(np.zeros(vector.shape[:-1]) if sigma is None else sigma)[None],
        )
