"""Position and orientation of a mirror from all phases of its receivers at once.

Maximum likelihood for a rigid mirror. What is known enters as it is: the receivers' places on the mirror, their common
oscillator, the surveyed pivot, the two-axis mount, and the transmitters' own errors, which are the same for all
receivers of a frame.

`solve_rigid` solves a `MirrorProblem`; `begin`, `fit` and `predict` are the step that all rigid solvers take.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.equations import MirrorArrays
from rfpose.multilat.reflection import SharedGeometry, direct_rays
from rfpose.multilat.rigid import _kernels
from rfpose.multilat.rigid._kernels import FitRule, RigidFits
from rfpose.multilat.rigid.problem import MirrorProblem
from rfpose.multilat.rigid.records import RigidPoses
from rfpose.multilat.rigid.weights import MirrorEquations, equations_of, weighed
from rfpose.multilat.status import PoseStatus

__all__ = [
    "FLOOR",
    "NO_TURN",
    "FitRule",
    "RigidFits",
    "begin",
    "can_begin",
    "fit",
    "full_covariance",
    "predict",
    "rigid_bound",
    "solve_rigid",
]

BoolArray = npt.NDArray[np.bool_]

FLOOR = 1e-13
"""Smallest share of an unknown's information that the other unknowns may leave before it counts as unobserved."""

NO_TURN: FloatArray = np.zeros((0, 3))

_RULE = FitRule(max_iteration=40, floor=FLOOR, longest_turn=0.5, settled=1e-6)  # a thousandth of a sigma


def solve_rigid(problem: MirrorProblem, equations: MirrorEquations | None = None) -> RigidPoses:
    """Solve rigid poses of many mirrors by Gauss-Newton; whole wavelengths count as resolved.

    Parameters
    ----------
    problem
    equations
        Of the problem, if they are there already.
    """
    mirrors, dof = equations_of(problem) if equations is None else equations
    status = np.zeros(len(problem.range_m), np.int64)
    status[np.sum(mirrors.weight > 0, axis=(1, 2, 3)) < 4] = PoseStatus.UNKNOWNS
    status[~can_begin(problem)] = PoseStatus.TOO_FEW
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
        dof=dof,
        n_iteration=fits.n_iteration,
        status=fits.status,
    )


def can_begin(problem: MirrorProblem) -> BoolArray:
    """(mirror,) whether there is a pose to begin with."""
    pivot, rot = problem.start_pivot_enu_m, problem.start_rot_enu_from_mirror
    return np.asarray(np.isfinite(pivot).all(axis=1) & np.isfinite(rot).all(axis=(1, 2)))


def begin(
    mirrors: MirrorArrays,
    pivot: FloatArray,
    rot: FloatArray,
    status: npt.NDArray[np.int64],
    *,
    n_cov: int,
    n_survey: int = 0,
    n_parameter: int = 0,
) -> RigidFits:
    """Nothing solved yet; covariances are kept of the first ``n_cov`` unknowns."""
    clock = mirrors.prior.clock
    n_mirror, n_class, n_receiver = clock.shape
    return RigidFits(
        pivot=pivot.copy(),
        rot=rot.copy(),
        clock=clock.copy(),
        survey=np.zeros((n_mirror, n_survey)),
        cov=np.full((n_mirror, n_cov, n_cov), np.nan),
        follow=np.zeros((n_mirror, 6 + n_class * n_receiver + n_survey, n_parameter)),
        schur=np.zeros((n_mirror, n_parameter, n_parameter)),
        rest=np.zeros((n_mirror, n_parameter)),
        chi2=np.full(n_mirror, np.inf),
        n_iteration=np.zeros(n_mirror, np.int64),
        status=status.copy(),
    )


def fit(
    scene: SharedGeometry,
    mirrors: MirrorArrays,
    rule: FitRule,
    fits: RigidFits,
    *,
    turn: FloatArray = NO_TURN,
    enough: FloatArray | float = np.inf,
) -> None:
    """Solve every mirror from where ``fits`` stands, or from there turned by each of ``turn`` until it fits.

    One that does not converge keeps pose and chi² of its last step.
    """
    n_mirror = len(fits.chi2)
    enough = np.array(np.broadcast_to(enough, (n_mirror,)), np.float64)
    _kernels.fit_many(n_mirror, scene, mirrors, rule, turn, enough, fits)


def predict(scene: SharedGeometry, mirrors: MirrorArrays, fits: RigidFits) -> tuple[FloatArray, FloatArray]:
    """Ranges (mirror, group, receiver, transmitter) and their derivatives (…, 6 + survey + parameter)."""
    n_group = mirrors.z.shape[1] if len(scene.image) else 1
    predicted = np.empty((len(mirrors.z), n_group, *mirrors.z.shape[2:]))
    slope = np.empty((*predicted.shape, 6 + fits.survey.shape[1] + fits.schur.shape[1]))
    _kernels.predict_many(len(predicted), scene, mirrors, fits.pivot, fits.rot, fits.survey, predicted, slope)
    shape = mirrors.z.shape
    return np.array(np.broadcast_to(predicted, shape)), np.array(np.broadcast_to(slope, (*shape, slope.shape[-1])))


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
    mirrors = weighed(problem)
    n_mirror, n_class, n_receiver = mirrors.prior.clock.shape
    n_unknown = 6 + n_class * n_receiver
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
