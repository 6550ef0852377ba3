"""What the geometry allows: Cramér–Rao bounds of positions and normals, before anything is measured."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError
from rfpose.multilat.normal import Normals, joint_covariance, mirror_normal

__all__ = ["dop", "normal_bound", "position_bound", "tilt_rms_from_position"]


def position_bound(
    transmitter_enu_m: npt.ArrayLike, receiver_enu_m: npt.ArrayLike, sigma_m: npt.ArrayLike | float
) -> FloatArray:
    """Return the Cramér–Rao bound of positions from range differences.

    With J the rows (u_i, −1), u_i the unit vector from transmitter i to the receiver: the position's block of
    (JᵀWJ)⁻¹. The clock is estimated with the position, so no reference is special.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz) or (transmitter, xy)
        [m].
    receiver_enu_m : (..., xyz) or (..., xy)
        True positions [m]. NaN gives NaN.
    sigma_m : scalar or broadcastable to (..., transmitter)
        Standard deviation of ONE transmitter's range [m]; not of a difference. NaN = not received.

    Returns
    -------
    (..., xyz, xyz)
        Covariance [m²]; NaN where the transmitters received fix no position.

    Raises
    ------
    InvalidInputError
        Wrong shape, ``sigma_m <= 0``.
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", "xyz"))
    n_axis = transmitter.shape[1]
    receiver = as_float_array("receiver_enu_m", receiver_enu_m, ("...", n_axis), finite=False)
    sigma = as_float_array("sigma_m", sigma_m, ("...",), finite=False, positive=True)
    try:
        weight = np.broadcast_to(sigma, (*receiver.shape[:-1], len(transmitter))) ** -2.0
    except ValueError as error:
        raise InvalidInputError(f"`sigma_m` must broadcast to (..., transmitter), got shape {sigma.shape}") from error
    weight = np.where(np.isnan(weight), 0.0, weight)
    offset = receiver[..., None, :] - transmitter
    with np.errstate(invalid="ignore", divide="ignore"):
        u = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
        mean = np.einsum("...t,...tx->...x", weight, u) / weight.sum(axis=-1)[..., None]
    u = u - mean[..., None, :]
    information = np.einsum("...t,...tx,...ty->...xy", weight, u, u)
    bad = ~np.isfinite(information).all(axis=(-2, -1))
    information[bad] = np.eye(n_axis)
    bad |= np.linalg.cond(information) > 1e14
    information[bad] = np.eye(n_axis)
    cov = np.linalg.inv(information)
    cov[bad] = np.nan
    return np.asarray(cov)


def dop(transmitter_enu_m: npt.ArrayLike, receiver_enu_m: npt.ArrayLike) -> FloatArray:
    """Return the position dilution of precision (...): position RMS per unit of one transmitter's range sigma.

    Per unit of the noise of a *difference*, as Swart et al. §4.3 count, it is smaller by √2.
    """
    cov = position_bound(transmitter_enu_m, receiver_enu_m, 1.0)
    return np.asarray(np.sqrt(np.trace(cov, axis1=-2, axis2=-1)))


def normal_bound(
    transmitter_enu_m: npt.ArrayLike,
    receiver_enu_m: npt.ArrayLike,
    sigma_m: npt.ArrayLike | float,
    calibration_sigma_m: npt.ArrayLike | float = 0.0,
    *,
    receiver_mirror_m: npt.ArrayLike | None = None,
) -> Normals:
    """Return true normals with the covariance that fits of each receiver by itself can reach.

    The bound of this method, not of the mirror: it uses neither the mirror's rigidity nor a common clock.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    receiver_enu_m : (..., receiver, xyz)
        True positions of a mirror's receivers [m].
    sigma_m, calibration_sigma_m : scalar or broadcastable to (..., receiver, transmitter)
        Noise of one transmitter's range: a receiver's own, and the calibration's, common to all receivers [m].
    receiver_mirror_m : (receiver, xyz), optional
        See `mirror_normal`.

    Returns
    -------
    Normals
        ``sigma_rad`` is the bound of the RMS angle, of the normal.
    """
    cov = joint_covariance(transmitter_enu_m, receiver_enu_m, sigma_m, calibration_sigma_m)
    return mirror_normal(receiver_enu_m, cov, receiver_mirror_m=receiver_mirror_m)


def tilt_rms_from_position(position_rms_m: float, spacing_m: float) -> float:
    """Return the RMS angle [rad] of the normal of three receivers, √(4/3)·ε_R/d_R (Swart et al. §4.4).

    Parameters
    ----------
    position_rms_m
        RMS position error of each receiver, ε_R, independent between receivers and alike in all directions [m].
    spacing_m
        Side of the receivers' equilateral triangle, d_R [m].
    """
    return (
        float(np.sqrt(4.0 / 3.0)) * as_positive("position_rms_m", position_rms_m) / as_positive("spacing_m", spacing_m)
    )
