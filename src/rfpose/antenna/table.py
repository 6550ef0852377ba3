"""A pattern at one frequency as the fit of a pose looks it up: splines over the sphere, with their slope."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.antenna import _kernels
from rfpose.antenna.sphere import ComplexArray, grid_directions
from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError

__all__ = ["PatternTable", "table_of"]

_FINER = 3
"""Steps of the spline in one of the pattern's: what the pattern's step can just carry, the spline follows to 0.1 %."""
_RINGING = 0.27
"""So much of a cubic spline's swing behind a jump is left at the next point (2 − √3)."""
_SWINGS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class PatternTable:
    """Effective lengths of the receivers over direction, at one frequency.

    Kernels of other packages call `rfpose.antenna._kernels.look_up` and ``sigma_at`` on the two arrays.

    Attributes
    ----------
    coefficient : (receiver, polar + 2, azimuth + 3, xyz)
        Coefficients of cubic B-splines, mirror frame.
    sigma : (receiver, polar, azimuth)
        Error (1 σ) of the real and of the imaginary part of a component, on the pattern's own grid.
    """

    coefficient: ComplexArray
    sigma: FloatArray

    @property
    def n_receiver(self) -> int:
        """Receivers of a mirror."""
        return len(self.coefficient)

    def vector(self, direction_mirror: npt.ArrayLike, receiver: npt.ArrayLike) -> ComplexArray:
        """Return effective lengths (n, xyz): the voltage is field · vector, both in the mirror frame.

        Parameters and errors as of `vector_and_slope`.
        """
        return self.vector_and_slope(direction_mirror, receiver)[0]

    def vector_and_slope(
        self, direction_mirror: npt.ArrayLike, receiver: npt.ArrayLike
    ) -> tuple[ComplexArray, ComplexArray, FloatArray]:
        """Return effective lengths, their slopes and their errors.

        Parameters
        ----------
        direction_mirror : (n, xyz)
            From the receiver to where the wave comes from, of any length, in the mirror frame. NaN or zero: what comes
            back is NaN.
        receiver : (n,) or ()
            Which receiver.

        Returns
        -------
        vector : (n, xyz)
            Effective length: the voltage is field · vector, both in the mirror frame.
        slope : (n, xyz, xyz)
            Derivative of vector's component (first) over the direction's (second); none along the direction.
        sigma : (n,)
            Error (1 σ) of the real and of the imaginary part of a component.

        Raises
        ------
        InvalidInputError
            Wrong shapes, or a receiver that the pattern has not.
        """
        direction = as_float_array("direction_mirror", direction_mirror, ("n", 3), finite=False)
        n = len(direction)
        given = np.asarray(receiver)
        if given.dtype.kind not in "iu" or given.shape not in ((), (n,)):
            raise InvalidInputError(f"`receiver` must be an index or {n} of them, got {given.dtype} {given.shape}")
        if given.size and not 0 <= given.min() <= given.max() < self.n_receiver:
            raise InvalidInputError(f"`receiver` must be from 0 to {self.n_receiver - 1}, the pattern's receivers")
        index = np.ascontiguousarray(np.broadcast_to(given, (n,)), np.int64)
        vector, slope = np.empty((n, 3), np.complex128), np.empty((n, 3, 3), np.complex128)
        error = np.empty(n)
        _kernels.look_up_rows(n, self.coefficient, self.sigma, index, direction, vector, slope, error)
        return vector, slope, error


def table_of(vector: ComplexArray, sigma: FloatArray, axis_mirror: FloatArray) -> PatternTable:
    """Return the table of effective lengths on a grid.

    Parameters
    ----------
    vector : (receiver, polar, azimuth, xyz)
        NaN = unknown: there the receiver is taken for a dipole in free space.
    sigma : (receiver, polar, azimuth)
        Their errors.
    axis_mirror : (receiver, xyz)
        Of that dipole.
    """
    unknown = np.asarray(np.isnan(vector).any(axis=-1))
    gaps = bool(unknown.any())
    if gaps:
        vector = np.where(unknown[..., None], _dipoles(axis_mirror, *vector.shape[1:3]), vector)
        sigma = _with_ringing(sigma, unknown)
    # what jumps at the edges of its gaps would ring all over the sphere if it were refined by its Fourier series
    return PatternTable(
        coefficient=read_only(_spline(vector, 1 if gaps else _FINER)), sigma=read_only(np.ascontiguousarray(sigma))
    )


def _dipoles(axis: FloatArray, n_polar: int, n_azimuth: int) -> FloatArray:
    """Return effective lengths of dipoles (receiver, polar, azimuth, xyz): the axis without its part along the way."""
    towards = grid_directions(n_polar, n_azimuth)
    along = np.einsum("paj,rj->rpa", towards, axis)
    return np.asarray(axis[:, None, None] - along[..., None] * towards)


def _with_ringing(sigma: FloatArray, unknown: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the errors with what a gap's edge adds beyond it, where a spline through the jump still swings."""
    swing = np.where(unknown, sigma, 0.0)
    for _ in range(_SWINGS):
        around = _on_torus(swing)
        for axis in (1, 2):
            beside = np.maximum(np.roll(around, 1, axis), np.roll(around, -1, axis))
            around = np.maximum(around, _RINGING * beside)
        swing = around[:, : sigma.shape[1]]
    return np.asarray(np.hypot(sigma, np.where(unknown, 0.0, swing)))


def _on_torus(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return values (receiver, polar, azimuth, …) of the sphere as of a torus, (receiver, 2 polar − 2, azimuth, …).

    Beyond a pole the sphere goes on at the opposite azimuth, so that both angles are periodic.
    """
    back = np.roll(values[:, -2:0:-1], values.shape[2] // 2, axis=2)
    return np.concatenate([values, back], axis=1)


def _spline(vector: ComplexArray, finer: int) -> ComplexArray:
    """Return B-spline coefficients through values (receiver, polar, azimuth, xyz), on a grid so many times finer."""
    spectrum = np.fft.fft2(_on_torus(vector), axes=(1, 2))
    for axis in (1, 2):
        spectrum = _finer_spectrum(spectrum, axis, finer)
    rows = np.fft.ifft2(spectrum, axes=(1, 2))
    n_polar, n_azimuth = finer * (vector.shape[1] - 1) + 1, finer * vector.shape[2]
    rows = np.take(rows, np.arange(-1, n_polar + 1), axis=1, mode="wrap")
    return np.take(rows, np.arange(-1, n_azimuth + 2), axis=2, mode="wrap")


def _finer_spectrum(spectrum: ComplexArray, axis: int, finer: int) -> ComplexArray:
    """Return the spectrum along an axis of even length for a grid so many times finer, and of spline coefficients."""
    n = spectrum.shape[axis]
    order = np.rint(np.fft.fftfreq(n * finer) * (n * finer)).astype(np.int64)
    kept = np.where(2 * np.abs(order) == n, 0.5, 1.0) * (2 * np.abs(order) <= n) if finer > 1 else np.ones(n)
    symbol = (2.0 + np.cos(2.0 * np.pi * order / (n * finer))) / 3.0
    shape = [-1 if i == axis else 1 for i in range(spectrum.ndim)]
    return np.asarray(np.take(spectrum, order, axis=axis, mode="wrap") * (finer * kept / symbol).reshape(shape))
