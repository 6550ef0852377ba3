"""Position and orientation of a mirror from all phases of its receivers at once.

Maximum likelihood for a rigid mirror. What is known enters as it is: the receivers' places on the mirror, their common
oscillator, the surveyed pivot, the two-axis mount, and the transmitters' own errors, which are the same for all
receivers of a frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.reflection import direct_rays
from rfpose.multilat.rigid import _kernels
from rfpose.multilat.rigid.fits import FLOOR, FitRule, begin, fit
from rfpose.multilat.rigid.problem import MirrorProblem
from rfpose.multilat.status import PoseStatus

__all__ = ["RigidPoses", "full_covariance", "rigid_bound", "solve_rigid", "tilt_sigma_rad"]

_RULE = FitRule(max_iteration=40, floor=FLOOR, longest_turn=0.5, settled=1e-6)  # a thousandth of a sigma


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


def solve_rigid(problem: MirrorProblem) -> RigidPoses:
    """Solve rigid poses of many mirrors by Gauss-Newton; whole wavelengths count as resolved."""
    mirrors = problem.equations
    status = np.zeros(len(problem.range_m), np.int64)
    status[np.sum(mirrors.weight > 0, axis=(1, 2, 3)) < 4] = PoseStatus.UNKNOWNS
    status[~problem.has_start] = PoseStatus.TOO_FEW
    fits = begin(mirrors, problem.start_pivot_enu_m, problem.start_rot_enu_from_mirror, status, n_cov=6)
    fit(direct_rays(problem.transmitter_enu_m, mirrors.z.shape[1]), mirrors, _RULE, fits)
    bad = fits.status != PoseStatus.OK
    for array in (fits.pivot, fits.rot, fits.clock, fits.cov, fits.chi2):
        array[bad] = np.nan
    return RigidPoses(
        pivot_enu_m=fits.pivot,
        rot_enu_from_mirror=fits.rot,
        clock_m=fits.clock,
        cov=fits.cov,
        chi2=fits.chi2,
        dof=problem.dof,
        n_iteration=fits.n_iteration,
        status=fits.status,
    )


def rigid_bound(problem: MirrorProblem) -> FloatArray:
    """Cramér–Rao bound of rigid poses: covariance of pivot [m] and rotation [rad].

    Parameters
    ----------
    problem
        Its starts are the true poses; see `MirrorProblem.expected`.

    Returns
    -------
    (mirror, 6, 6)
        NaN where the pose is not determined. `tilt_sigma_rad` makes the normal's rms angle of it.
    """
    return full_covariance(problem)[:, :6, :6]


def full_covariance(problem: MirrorProblem) -> FloatArray:
    """Return the covariance of pivot [m], rotation [rad] and every clock [m], at the poses to begin with.

    Returns
    -------
    (mirror, unknown, unknown)
        Order: pivot, rotation, then clocks by class and receiver. NaN where the pose is not determined.
    """
    mirrors = problem.weighed()
    n_mirror, _, n_receiver, _ = mirrors.z.shape
    n_unknown = 6 + problem.n_class * n_receiver
    cov = np.full((n_mirror, n_unknown, n_unknown), np.nan)
    _kernels.covariance_many(
        n_mirror,
        direct_rays(problem.transmitter_enu_m, mirrors.z.shape[1]),
        mirrors,
        FLOOR,
        problem.start_pivot_enu_m,
        problem.start_rot_enu_from_mirror,
        mirrors.prior.clock,
        cov,
    )
    return cov
