"""What is found of rigid mirrors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray

__all__ = ["RigidPoses", "tilt_sigma_rad"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidPoses:
    """Poses of many mirrors.

    Attributes
    ----------
    pivot_enu_m : (mirror, xyz)
        [m]; NaN where not solved, like all that follows.
    rot_enu_from_mirror : (mirror, 3, 3)
    clock_m : (mirror, class, receiver)
        Clocks as ranges [m].
    cov : (mirror, 6, 6)
        Of pivot [m] and rotation vector in ENU [rad].
    chi2 : (mirror,)
        Weighted sum of squares left.
    dof : (mirror,)
        Measurements and priors less unknowns: what ``chi2`` should be.
    n_iteration, status : (mirror,)
        ``status`` is `rfpose.multilat.PoseStatus`.
    """

    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    clock_m: FloatArray
    cov: FloatArray
    chi2: FloatArray
    dof: FloatArray
    n_iteration: npt.NDArray[np.int64]
    status: npt.NDArray[np.int64]

    @property
    def normal_enu(self) -> FloatArray:
        """(mirror, xyz) unit normals."""
        return self.rot_enu_from_mirror[:, :, 2]

    @property
    def tilt_sigma_rad(self) -> FloatArray:
        """(mirror,) rms angle between estimated and true normal [rad]."""
        return tilt_sigma_rad(self.cov, self.normal_enu)


def tilt_sigma_rad(cov: FloatArray, normal_enu: FloatArray) -> FloatArray:
    """Rms angle of the normal from the covariance (…, 6, 6): the rotation's variance less that about the normal."""
    turn = cov[..., 3:, 3:]
    about = np.einsum("...a,...ab,...b->...", normal_enu, turn, normal_enu)
    return np.asarray(np.sqrt(np.trace(turn, axis1=-2, axis2=-1) - about))
