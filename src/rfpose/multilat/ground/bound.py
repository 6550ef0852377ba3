"""Cramér–Rao bound of rigid poses where planes reflect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.multilat.ground import _coefficients
from rfpose.multilat.ground._problem import CalibrationSight, build
from rfpose.multilat.ground.model import SPEED_OF_LIGHT_MPS, Reflector, build_scene
from rfpose.multilat.ground.solve import joint_covariance
from rfpose.multilat.rigid.pose import can_begin
from rfpose.multilat.rigid.problem import MirrorProblem
from rfpose.multilat.status import PoseStatus

__all__ = ["ground_bound"]


def ground_bound(
    mirrors: MirrorProblem,
    *,
    carrier_rf_hz: npt.ArrayLike,
    tone_hz: npt.ArrayLike,
    reflectors: Sequence[Reflector],
    coefficient: Sequence[complex],
    calibration_enu_m: CalibrationSight | npt.ArrayLike | None = None,
    free_space: bool = True,
    propagation_speed_mps: float = SPEED_OF_LIGHT_MPS,
) -> FloatArray:
    """Bound of pose and clocks, the coefficients of all mirrors estimated with them where that is asked for.

    Parameters
    ----------
    mirrors
        In their true poses, by `MirrorProblem.expected`.
    carrier_rf_hz, reflectors, calibration_enu_m, free_space, propagation_speed_mps
        As in `rfpose.multilat.ground.solve_with_ground`; a reflector without a coefficient counts as estimated.
    tone_hz : (group,)
        [Hz]; zero = the carrier's own phase.
    coefficient : (reflector,)
        What the coefficients truly are; where a reflector has one of its own, that is used.

    Returns
    -------
    (mirror, unknown, unknown)
        In the order of `rfpose.multilat.rigid.full_covariance`; NaN where the pose is not determined.
    """
    n_mirror, n_group, _, n_transmitter = mirrors.range_m.shape
    pivot, rot = mirrors.start_pivot_enu_m, mirrors.start_rot_enu_from_mirror
    scene = build_scene(
        mirrors.transmitter_enu_m,
        reflectors,
        carrier_rf_hz=as_float_array("carrier_rf_hz", carrier_rf_hz, (n_transmitter,), positive=True),
        tone_hz=as_float_array("tone_hz", tone_hz, (n_group,)),
        free_space=free_space,
        propagation_speed_mps=propagation_speed_mps,
    )
    known = mirrors.knowledge
    if known.pivot_enu_m is not None:
        mirrors = replace(mirrors, knowledge=replace(known, pivot_enu_m=pivot))
    problem = build(scene, mirrors, calibration=calibration_enu_m)
    # measurements exactly as predicted: the solver stops where it starts and hands on its information
    arrays = problem.mirrors
    still = arrays._replace(prior=arrays.prior._replace(clock=np.zeros_like(arrays.prior.clock)))
    problem = replace(problem, mirrors=still)
    truth = np.array([c for c, r in zip(coefficient, reflectors, strict=True) if r.estimated], np.complex128)
    parameter = np.stack([truth.real, truth.imag], axis=1).ravel()
    state = problem.begin(pivot, rot, np.zeros(n_mirror, np.int64))
    predicted, _ = problem.predict(state, parameter)
    problem = replace(problem, mirrors=still._replace(z=predicted))
    state.status[~can_begin(mirrors)] = PoseStatus.TOO_FEW
    problem.fit(state, parameter)
    solved = state.status == 0
    information = _coefficients.information(state, solved)
    determined = not information.size or np.linalg.cond(information) < _coefficients.MAX_CONDITION
    coefficient_cov = np.full(information.shape, np.nan)
    if determined:
        coefficient_cov[:] = np.linalg.inv(information)
    n_own = state.cov.shape[1]
    out = joint_covariance(state, coefficient_cov)[:, :n_own, :n_own]
    out[~solved] = np.nan
    return out
