"""Cramér–Rao bound of rigid poses where planes reflect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.multilat.ground import _coefficients
from rfpose.multilat.ground._problem import CalibrationSight, State, build
from rfpose.multilat.ground.model import SPEED_OF_LIGHT_MPS, Reflector, build_scene
from rfpose.multilat.ground.solve import joint_covariance
from rfpose.multilat.rigid.arrays import spread_places
from rfpose.multilat.rigid.integers import Observation
from rfpose.multilat.rigid.knowledge import Knowledge

__all__ = ["ground_bound"]


def ground_bound(
    transmitter_enu_m: npt.ArrayLike,
    receiver_mirror_m: npt.ArrayLike,
    pivot_enu_m: npt.ArrayLike,
    rot_enu_from_mirror: npt.ArrayLike,
    *,
    sigma_m: npt.ArrayLike,
    transmitter_sigma_m: npt.ArrayLike,
    clock_class: npt.ArrayLike,
    carrier_rf_hz: npt.ArrayLike,
    tone_hz: npt.ArrayLike,
    reflectors: Sequence[Reflector],
    coefficient: Sequence[complex],
    calibration_enu_m: CalibrationSight | npt.ArrayLike | None = None,
    knowledge: Knowledge | None = None,
    free_space: bool = True,
    propagation_speed_mps: float = SPEED_OF_LIGHT_MPS,
) -> FloatArray:
    """Bound of pose and clocks, the coefficients of all mirrors estimated with them where that is asked for.

    Parameters
    ----------
    transmitter_enu_m, receiver_mirror_m, pivot_enu_m, rot_enu_from_mirror, sigma_m, transmitter_sigma_m, clock_class
        As in `rfpose.multilat.rigid.full_covariance`.
    carrier_rf_hz, reflectors, calibration_enu_m, knowledge, free_space, propagation_speed_mps
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
    known = knowledge or Knowledge()
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    sigma = as_float_array("sigma_m", sigma_m, ("mirror", "group", "receiver", "transmitter"), finite=False)
    n_mirror, n_group, n_receiver, n_transmitter = sigma.shape
    places = spread_places(receiver_mirror_m, n_mirror, n_receiver)
    pivot = np.array(np.broadcast_to(np.asarray(pivot_enu_m, np.float64), (n_mirror, 3)))
    rot = np.array(np.broadcast_to(np.asarray(rot_enu_from_mirror, np.float64), (n_mirror, 3, 3)))
    common = np.broadcast_to(np.asarray(transmitter_sigma_m, np.float64), (n_mirror, n_group, n_transmitter))
    scene = build_scene(
        transmitter,
        reflectors,
        carrier_rf_hz=as_float_array("carrier_rf_hz", carrier_rf_hz, (n_transmitter,), positive=True),
        tone_hz=as_float_array("tone_hz", tone_hz, (n_group,)),
        free_space=free_space,
        propagation_speed_mps=propagation_speed_mps,
    )
    seen = np.where(np.isfinite(sigma), 0.0, np.nan)
    classes = np.asarray(clock_class, np.int64)
    observations = [
        Observation(
            range_m=seen[:, g],
            sigma_m=np.where(np.isfinite(sigma[:, g]), sigma[:, g], 1.0),
            transmitter_sigma_m=common[:, g],
            wavelength_m=np.ones(n_transmitter),
            clock_class=int(classes[g]),
        )
        for g in range(n_group)
    ]
    if known.pivot_enu_m is not None:
        known = replace(known, pivot_enu_m=pivot)
    problem, clock = build(
        scene,
        places,
        observations,
        [o.range_m for o in observations],
        pivot,
        rot,
        calibration=calibration_enu_m,
        known=known,
    )
    # measurements exactly as predicted: the solver stops where it starts and hands on its information
    clock[:] = 0.0
    truth = np.array([c for c, r in zip(coefficient, reflectors, strict=True) if r.estimated], np.complex128)
    parameter = np.stack([truth.real, truth.imag], axis=1).ravel()
    state = State.begin(pivot, rot, clock, np.zeros(n_mirror, np.int64), problem.n_parameter)
    predicted, _ = problem.predict(state, parameter)
    problem = replace(problem, mirrors=problem.mirrors._replace(z=predicted, clock_prior=clock.copy()))
    state.status[~np.isfinite(rot).all(axis=(1, 2))] = 3
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
