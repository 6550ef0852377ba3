"""What a mount predicts of postures, how that differs from what was measured, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfpose.checks import FloatArray
from rfpose.feedback import _kernels
from rfpose.feedback.calibrated import KnownMount
from rfpose.feedback.columns import M, columns_of, scales_of
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount, stack_mounts

__all__ = ["PredictedNormals", "normal_differences", "normal_errors_rad", "posture_jacobian", "predict"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedNormals:
    """Modelled normals and how far to trust them.

    Attributes
    ----------
    normal_enu : (posture, xyz)
        Modelled normals.
    error_rad : (posture,)
        Angle between the modelled normal and the one that the posture's source and target ask for [rad].
    cov_enu_rad2 : (posture, xyz, xyz)
        Of that difference, from the uncertainty of the parameters [rad²].
    sigma_rad : (posture,)
        Root of its trace: RMS angle by which the model is uncertain [rad].
    """

    normal_enu: FloatArray
    error_rad: FloatArray
    cov_enu_rad2: FloatArray
    sigma_rad: FloatArray


def normal_errors_rad(mount: Mount, measurements: Measurements) -> FloatArray:
    """Return the angle between modelled and measured normals [rad]; NaN where either is unknown.

    Parameters
    ----------
    mount
        The heliostat.
    measurements
        Its measurements.
    """
    difference = normal_differences(mount, measurements)
    half = 0.5 * np.linalg.norm(difference, axis=-1)
    return np.asarray(2.0 * np.arcsin(np.minimum(half, 1.0)))


def normal_differences(mount: Mount, measurements: Measurements) -> FloatArray:
    """Return modelled minus measured normals (measurement, xyz)."""
    residual: FloatArray = _kernels.residuals_batch(
        mount.parameter_vector()[None],
        mount.constant_vector()[None],
        measurements.count.copy()[None],  # kernels are compiled for arrays that can be written
        measurements.row.copy()[None],
        np.ones((1, len(measurements)), np.bool_),
    )[0]
    return residual * measurements.sigma_rad[:, None]


def predict(calibration: KnownMount, postures: Measurements) -> PredictedNormals:
    """Return modelled normals of postures with the uncertainty that the parameters leave.

    Parameters
    ----------
    calibration
        A fitted heliostat.
    postures
        Motor positions with source and target. With a target at a finite distance the mirror's own place counts:
        a place and a zero that were fitted together make up for each other, and what matters is their sum.
    """
    jacobian = posture_jacobian(calibration.mount, postures, calibration.free)
    covariance = jacobian @ calibration.covariance @ np.swapaxes(jacobian, -1, -2)
    p, k = stack_mounts([calibration.mount])
    normal = _kernels.posture_batch(p, k, postures.count.copy()[None], 0.0)[0, :, 2:5]
    return PredictedNormals(
        normal_enu=normal,
        error_rad=normal_errors_rad(calibration.mount, postures),
        cov_enu_rad2=covariance,
        sigma_rad=np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)),
    )


def posture_jacobian(mount: Mount, postures: Measurements, free: tuple[str, ...]) -> FloatArray:
    """Return the derivative of modelled minus wanted normals by parameters (posture, xyz, free)."""
    row = postures.row.copy()
    row[:, M.sigma_rad] = 1.0
    p, k = stack_mounts([mount])
    index = columns_of(free)
    scale = scales_of(free)
    use = np.ones((1, len(postures)), np.bool_)
    count = postures.count.copy()
    jacobian: FloatArray = _kernels.jacobian_batch(p, k, count[None], row[None], use, index, scale)[0]
    return jacobian
