"""Fits of many mirrors at given coefficients of what reflects: the step that all solvers of rigid mirrors take."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.equations import MirrorArrays
from rfpose.multilat.reflection import SharedGeometry
from rfpose.multilat.rigid import _kernels
from rfpose.multilat.rigid._kernels import FitRule, RigidFits

__all__ = ["FLOOR", "NO_TURN", "FitRule", "RigidFits", "begin", "fit", "predict"]

FLOOR = 1e-13
"""Smallest share of an unknown's information that the other unknowns may leave before it counts as unobserved."""

NO_TURN: FloatArray = np.zeros((0, 3))


def begin(
    mirrors: MirrorArrays,
    pivot: FloatArray,
    rot: FloatArray,
    status: npt.NDArray[np.int64],
    *,
    n_cov: int,
    n_parameter: int = 0,
) -> RigidFits:
    """Nothing solved yet; covariances are kept of the first ``n_cov`` unknowns."""
    clock = mirrors.prior.clock
    n_mirror, n_class, n_receiver = clock.shape
    return RigidFits(
        pivot=pivot.copy(),
        rot=rot.copy(),
        clock=clock.copy(),
        cov=np.full((n_mirror, n_cov, n_cov), np.nan),
        follow=np.zeros((n_mirror, 6 + n_class * n_receiver, n_parameter)),
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
    """Ranges (mirror, group, receiver, transmitter) and their derivatives (…, 6 + parameter)."""
    n_group = mirrors.z.shape[1] if len(scene.image) else 1
    predicted = np.empty((len(mirrors.z), n_group, *mirrors.z.shape[2:]))
    slope = np.empty((*predicted.shape, 6 + fits.schur.shape[1]))
    _kernels.predict_many(len(predicted), scene, mirrors, fits.pivot, fits.rot, predicted, slope)
    shape = mirrors.z.shape
    return np.array(np.broadcast_to(predicted, shape)), np.array(np.broadcast_to(slope, (*shape, slope.shape[-1])))
