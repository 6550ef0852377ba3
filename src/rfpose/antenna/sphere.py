"""The grid of directions that patterns stand on, and fields on it: by components along θ and φ, or by x, y, z."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray

__all__ = ["ComplexArray", "cartesian", "components", "grid_directions", "theta_phi_vectors"]

ComplexArray = npt.NDArray[np.complex128]


def _angles(n_polar: int, n_azimuth: int) -> tuple[FloatArray, FloatArray]:
    """Return polar angles and azimuths of the grid (polar, azimuth) [rad]: both poles, and no azimuth twice."""
    polar, azimuth = np.linspace(0.0, np.pi, n_polar), np.arange(n_azimuth) * (2.0 * np.pi / n_azimuth)
    full = np.meshgrid(polar, azimuth, indexing="ij")
    return full[0], full[1]


def grid_directions(n_polar: int, n_azimuth: int) -> FloatArray:
    """Return the unit vectors of the grid (polar, azimuth, xyz), mirror frame."""
    polar, azimuth = _angles(n_polar, n_azimuth)
    flat = np.sin(polar)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(polar)], axis=-1)


def theta_phi_vectors(n_polar: int, n_azimuth: int) -> FloatArray:
    """Return θ̂ and φ̂ of the grid (component, polar, azimuth, xyz)."""
    polar, azimuth = _angles(n_polar, n_azimuth)
    theta = [np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), -np.sin(polar)]
    phi = [-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)]
    return np.stack([np.stack(theta, axis=-1), np.stack(phi, axis=-1)])


def cartesian(response: ComplexArray) -> ComplexArray:
    """Return responses (…, polar, azimuth, component) as effective lengths (…, polar, azimuth, xyz)."""
    unit = theta_phi_vectors(*response.shape[-3:-1])
    return np.asarray(response[..., 0, None] * unit[0] + response[..., 1, None] * unit[1])


def components(vector: ComplexArray) -> ComplexArray:
    """Return effective lengths (…, polar, azimuth, xyz) as responses (…, polar, azimuth, component)."""
    return np.asarray(np.einsum("...paj,kpaj->...pak", vector, theta_phi_vectors(*vector.shape[-3:-1])))
