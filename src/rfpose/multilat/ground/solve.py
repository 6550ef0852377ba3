"""Poses of rigid mirrors and the coefficients of what reflects, from the same phases.

The coefficients are shared by all mirrors and frames. Each mirror is solved at given coefficients; what it says about
them, its own unknowns eliminated, is a Schur complement of its normal equations, and their sum gives the coefficients'
Gauss-Newton step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError
from rfpose.multilat.ground import _coefficients
from rfpose.multilat.ground._coefficients import MAX_CONDITION
from rfpose.multilat.ground._problem import NO_TURN, CalibrationSight, Problem, State, build
from rfpose.multilat.ground.integers import resolve
from rfpose.multilat.ground.model import (
    LEVEL_GROUND,
    SPEED_OF_LIGHT_MPS,
    ComplexArray,
    Reflector,
    build_scene,
    heights_m,
)
from rfpose.multilat.rigid.arrays import spread_places
from rfpose.multilat.rigid.integers import Observation
from rfpose.multilat.rigid.pose import Knowledge, RigidPoses, RigidStatus

__all__ = ["GroundSolution", "GroundStatus", "joint_covariance", "solve_with_ground", "turns"]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

_TURN_RAD = 0.4
"""How far a mirror that does not fit is turned at most to start again."""
_N_TURN = 200
"""Points in a cube, of which half lie in the ball."""
_MAX_ITERATION_DIRECT = 12
_RIGID_STATUS = np.array([0, 1, 2, 3, 4, RigidStatus.NO_START, RigidStatus.OK], np.int64)
"""`RigidStatus` of each `GroundStatus`."""


class GroundStatus(IntEnum):
    """Outcome of one mirror; the first five as in `RigidStatus`."""

    OK = 0
    SINGULAR = 1
    NOT_CONVERGED = 2
    NO_START = 3
    TOO_FEW = 4
    BEHIND_REFLECTOR = 5
    RESIDUAL = 6

    @property
    def reason(self) -> str:
        """The status in words."""
        return (
            "solved",
            "the measurements leave part of the pose undetermined; give a pivot, a mount, or more transmitters",
            "no convergence",
            "no starting pose",
            "fewer measurements than unknowns",
            "a receiver lies behind a reflector (below the ground); check the plane's height and the pivot",
            "residuals larger than the noise explains, the reflections included: the covariance is not to be trusted",
        )[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundSolution:
    """Poses, coefficients and the tests of both.

    Attributes
    ----------
    poses
        Their covariance counts that the coefficients were estimated.
    full_cov : (mirror, unknown, unknown)
        The same with the clocks, in the order of `rfpose.multilat.rigid.full_covariance`.
    coefficient : (reflector,)
        Estimated or given.
    coefficient_cov : (2 × estimated, 2 × estimated)
        Of real and imaginary parts in turn.
    fixed : (mirror, observation)
        Whether an observation's integers were resolved and used.
    wrong_risk : (mirror, observation)
        Probability, beforehand, that any of its integers is wrong.
    range_m : one (mirror, receiver, transmitter) an observation
        Resolved ranges, NaN where left out [m].
    probability_direct, probability : (mirror,)
        Of residuals as large or larger, by chance, with the direct ray alone (tones only), and with the reflections.
        A small first one says that reflections are needed.
    status : (mirror,)
        `GroundStatus`.
    problem, state, parameter
        What was solved, where it ended and the estimated coefficients, for tests that solve it again with less.
    """

    poses: RigidPoses
    full_cov: FloatArray
    coefficient: ComplexArray
    coefficient_cov: FloatArray
    fixed: BoolArray
    wrong_risk: FloatArray
    range_m: tuple[FloatArray, ...]
    probability_direct: FloatArray
    probability: FloatArray
    status: IntArray
    problem: Problem
    state: State
    parameter: FloatArray


def solve_with_ground(
    transmitter_enu_m: npt.ArrayLike,
    receiver_mirror_m: npt.ArrayLike,
    observations: Sequence[Observation],
    *,
    carrier_rf_hz: npt.ArrayLike,
    start_pivot_enu_m: npt.ArrayLike,
    start_rot_enu_from_mirror: npt.ArrayLike,
    reflectors: Sequence[Reflector] = (LEVEL_GROUND,),
    calibration_enu_m: CalibrationSight | npt.ArrayLike | None = None,
    tone_count: int | None = None,
    knowledge: Knowledge | None = None,
    free_space: bool = True,
    start_sigma_m: float = 1.0,
    wrong_risk: float = 1e-6,
    min_probability: float = 1e-6,
    propagation_speed_mps: float = SPEED_OF_LIGHT_MPS,
) -> GroundSolution:
    """Solve rigid poses where planes reflect, coefficients shared by all mirrors and frames estimated with them.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    receiver_mirror_m : (mirror, receiver, xyz) or (receiver, xyz)
        From the pivot, in the mirror frame [m]. Frames are rows of the mirror axis like mirrors.
    observations
        Tones, coarsest first, then the carrier (``clock_class`` 1) if any.
    carrier_rf_hz : (transmitter,)
        Carrier frequencies at RF, f_c + f_i [Hz].
    start_pivot_enu_m, start_rot_enu_from_mirror : (mirror, xyz), (mirror, 3, 3)
        Where to begin; NaN gives status NO_START.
    reflectors
        Planes; those without a coefficient are estimated. None at all: the direct ray alone.
    calibration_enu_m : `CalibrationSight`, or (calibration receiver, xyz), optional
        Where Φ was measured, and how it became of several receivers; places alone mean their plain mean. The
        reflections there are in the ranges, and are modelled.
    tone_count
        How many observations are tones; the rest are carriers. Default: those with ``clock_class`` 0.
    knowledge
        Clocks, pivot, mount.
    free_space
        Whether a longer ray is weaker by d/d'.
    start_sigma_m
        Uncertainty of the start's ranges, reflections included, for the integers of the tones [m].
    wrong_risk
        Largest probability that any integer of an observation is wrong, for it to be used.
    min_probability
        Residuals less likely than this give status RESIDUAL.
    propagation_speed_mps
        [m/s].

    Raises
    ------
    InvalidInputError
        No tone, shapes that do not fit, a tone whose wavelength differs between transmitters.
    GeometryError
        Receivers on a line, a transmitter behind a reflector.
    """
    known = knowledge or Knowledge()
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    n_tone = sum(o.clock_class == 0 for o in observations) if tone_count is None else tone_count
    n_mirror, n_receiver = _shape(observations, n_tone, len(transmitter))
    places = spread_places(receiver_mirror_m, n_mirror, n_receiver)
    pivot, rot, status = _starts(places, reflectors, start_pivot_enu_m, start_rot_enu_from_mirror)
    speed = as_positive("propagation_speed_mps", propagation_speed_mps)
    scene = build_scene(
        transmitter,
        reflectors,
        carrier_rf_hz=as_float_array("carrier_rf_hz", carrier_rf_hz, (len(transmitter),), positive=True),
        tone_hz=np.array([_tone_hz(o, speed) if k < n_tone else 0.0 for k, o in enumerate(observations)]),
        free_space=free_space,
        propagation_speed_mps=speed,
    )

    def lay_out(count: int, ranges: list[FloatArray], pivot: FloatArray, rot: FloatArray) -> tuple[Problem, FloatArray]:
        used = scene._replace(tone_k=scene.tone_k[:count], common=scene.common[:, :, :count].copy())
        return build(
            used,
            places,
            observations[:count],
            ranges[:count],
            pivot,
            rot,
            calibration=calibration_enu_m,
            known=known,
        )

    risk = np.ones((n_mirror, len(observations)))
    distance = np.linalg.norm(_receivers(places, pivot, rot)[:, :, None] - transmitter, axis=-1)
    ranges = []
    offset = None
    for k in range(n_tone):
        resolved, risk[:, k], offset = resolve(observations[k], distance, float(start_sigma_m), known, offset)
        ranges.append(np.where((risk[:, k] <= wrong_risk)[:, None, None], resolved, np.nan))
    problem, clock = lay_out(n_tone, ranges, pivot, rot)
    status[(status == GroundStatus.OK) & (problem.dof < 0)] = GroundStatus.TOO_FEW
    start = State.begin(pivot, rot, clock, status, problem.n_parameter)
    probability_direct = _direct_probability(problem, start)
    turn = turns()
    parameter = _coefficients.find(problem, start, turn)
    state = start.copy()
    problem.fit(state, parameter)
    _coefficients.retry(problem, start, state, parameter, turn)
    parameter = _coefficients.refine(problem, state, parameter)
    if n_tone < len(observations):
        finest, _ = lay_out(len(observations), [o.range_m for o in observations], state.pivot, state.rot)
        predicted, slope = finest.predict(state, parameter)
        cov = joint_covariance(state, _coefficient_cov(problem, state))
        pose_and_coefficients = [*range(6), *range(state.cov.shape[1], cov.shape[1])]
        cov = cov[:, pose_and_coefficients][:, :, pose_and_coefficients]
        # a pose that does not explain its tones predicts no carrier
        sound = ~(_probability(state.chi2, problem.dof, state.status == GroundStatus.OK) < min_probability)
        for k in range(n_tone, len(observations)):
            resolved, risk[:, k], _ = resolve(observations[k], predicted[:, k], (slope[:, k], cov), known)
            risk[~sound, k] = 1.0
            ranges.append(np.where((risk[:, k] <= wrong_risk)[:, None, None], resolved, np.nan))
        problem, clock = lay_out(len(observations), ranges, state.pivot, state.rot)
        state = State.begin(state.pivot, state.rot, clock, state.status, problem.n_parameter)
        problem.fit(state, parameter)
        parameter = _coefficients.refine(problem, state, parameter)
    return _solution(
        problem, state, parameter, places, reflectors, risk, ranges, wrong_risk, probability_direct, min_probability
    )


def _shape(observations: Sequence[Observation], n_tone: int, n_transmitter: int) -> tuple[int, int]:
    """Mirrors and receivers, after checks of what `Observation` does not check."""
    classes = [o.clock_class for o in observations]
    if not 0 < n_tone <= len(observations) or classes != sorted(classes):
        raise InvalidInputError("`observations` must hold at least one tone, and tones before the carrier")
    shape = np.shape(observations[0].range_m)
    for k, observation in enumerate(observations):
        if np.ndim(observation.range_m) != 3 or np.shape(observation.range_m) != shape or shape[2] != n_transmitter:
            raise InvalidInputError(
                f"`range_m` of observation {k} must have shape (mirror, receiver, {n_transmitter}) like the first, "
                f"got {np.shape(observation.range_m)}"
            )
    return shape[0], shape[1]


def _tone_hz(observation: Observation, speed_mps: float) -> float:
    wavelength = np.asarray(observation.wavelength_m, np.float64)
    if np.ptp(wavelength) > 1e-9 * float(wavelength.max()):
        raise InvalidInputError("`wavelength_m` of a tone must be the same for all transmitters")
    return speed_mps / float(wavelength.flat[0])


def _receivers(places: FloatArray, pivot: FloatArray, rot: FloatArray) -> FloatArray:
    return np.asarray(pivot[:, None] + np.einsum("mab,mrb->mra", rot, places))


def _starts(
    places: FloatArray,
    reflectors: Sequence[Reflector],
    start_pivot_enu_m: npt.ArrayLike,
    start_rot_enu_from_mirror: npt.ArrayLike,
) -> tuple[FloatArray, FloatArray, IntArray]:
    n_mirror = len(places)
    pivot = np.array(np.broadcast_to(np.asarray(start_pivot_enu_m, np.float64), (n_mirror, 3)))
    rot = np.array(np.broadcast_to(np.asarray(start_rot_enu_from_mirror, np.float64), (n_mirror, 3, 3)))
    status = np.zeros(n_mirror, np.int64)
    missing = ~(np.isfinite(pivot).all(axis=1) & np.isfinite(rot).all(axis=(1, 2)))
    status[_behind(places, pivot, rot, reflectors)] = GroundStatus.BEHIND_REFLECTOR
    status[missing] = GroundStatus.NO_START
    return pivot, rot, status


def _behind(places: FloatArray, pivot: FloatArray, rot: FloatArray, reflectors: Sequence[Reflector]) -> BoolArray:
    """(mirror,) whether a receiver lies behind a plane."""
    receiver = _receivers(places, pivot, rot)
    behind = [np.any(heights_m(receiver, reflector) <= 0.0, axis=1) for reflector in reflectors]
    return np.asarray(np.any(behind, axis=0)) if behind else np.zeros(len(places), np.bool_)


def turns() -> FloatArray:
    """Rotation vectors spread over a ball, small ones first; none at all is first of all."""
    from scipy.stats import qmc  # takes a second to load, and only this needs it

    cube = 2.0 * qmc.Halton(3, scramble=False).random(_N_TURN) - 1.0
    length = np.linalg.norm(cube, axis=1)
    inside = length <= 1.0
    return np.concatenate([NO_TURN, _TURN_RAD * cube[inside][np.argsort(length[inside])]])


def _direct_probability(problem: Problem, start: State) -> FloatArray:
    """(mirror,) probability of the residuals with the direct ray alone."""
    direct = problem.direct()
    state = State.begin(start.pivot, start.rot, start.clock, start.status, 0)
    direct.fit(state, np.zeros(0), max_iteration=_MAX_ITERATION_DIRECT)
    return _probability(state.chi2, problem.dof, state.status <= 2)


def _probability(chi2: FloatArray, dof: FloatArray, solved: BoolArray) -> FloatArray:
    known = solved & np.isfinite(chi2) & (dof > 0.0)
    return np.asarray(np.where(known, chdtrc(np.maximum(dof, 1e-9), np.where(known, chi2, 0.0)), np.nan))


def _coefficient_cov(problem: Problem, state: State) -> FloatArray:
    """Covariance of the coefficients; NaN where the mirrors do not determine them."""
    information = _coefficients.information(state, _coefficients.trusted(problem, state))
    if information.size and not (np.any(information) and np.linalg.cond(information) < MAX_CONDITION):
        return np.full(information.shape, np.nan)
    return np.asarray(np.linalg.inv(information))


def joint_covariance(state: State, coefficient_cov: FloatArray) -> FloatArray:
    """(mirror, unknown + parameter, unknown + parameter) of pose, clocks and coefficients."""
    n_mirror, n_own, n_parameter = state.follow.shape
    follow = state.follow
    out = np.empty((n_mirror, n_own + n_parameter, n_own + n_parameter))
    out[:, :n_own, :n_own] = state.cov + follow @ coefficient_cov @ np.swapaxes(follow, 1, 2)
    out[:, :n_own, n_own:] = follow @ coefficient_cov
    out[:, n_own:, :n_own] = np.swapaxes(out[:, :n_own, n_own:], 1, 2)
    out[:, n_own:, n_own:] = coefficient_cov
    return out


def _solution(
    problem: Problem,
    state: State,
    parameter: FloatArray,
    places: FloatArray,
    reflectors: Sequence[Reflector],
    risk: FloatArray,
    ranges: list[FloatArray],
    wrong_risk: float,
    probability_direct: FloatArray,
    min_probability: float,
) -> GroundSolution:
    coefficient_cov = _coefficient_cov(problem, state)
    kept = state.copy()
    status = state.status.copy()
    status[(status == GroundStatus.OK) & _behind(places, state.pivot, state.rot, reflectors)] = (
        GroundStatus.BEHIND_REFLECTOR
    )
    if np.any(np.isnan(coefficient_cov)):
        status[status == GroundStatus.OK] = GroundStatus.SINGULAR
    solved = status == GroundStatus.OK
    kept.status[~solved] = np.maximum(status[~solved], GroundStatus.NO_START)
    # each mirror pays its share of the coefficients
    dof = problem.dof - np.einsum("mab,ba->m", state.schur, coefficient_cov)
    probability = _probability(state.chi2, dof, solved)
    status[solved & (probability < min_probability)] = GroundStatus.RESIDUAL
    n_own = state.cov.shape[1]
    full = joint_covariance(state, coefficient_cov)[:, :n_own, :n_own]
    cov = full[:, :6, :6].copy()
    chi2 = state.chi2.copy()
    for array in (state.pivot, state.rot, state.clock, cov, full, chi2):
        array[~solved] = np.nan
    return GroundSolution(
        poses=RigidPoses(
            pivot_enu_m=state.pivot,
            rot_enu_from_mirror=state.rot,
            clock_m=state.clock,
            cov=cov,
            chi2=chi2,
            dof=dof,
            n_iteration=state.n_iteration,
            status=_RIGID_STATUS[status],
        ),
        full_cov=full,
        coefficient=problem.scene_at(parameter).coefficient,
        coefficient_cov=coefficient_cov,
        fixed=risk <= wrong_risk,
        wrong_risk=risk,
        range_m=tuple(ranges),
        probability_direct=probability_direct,
        probability=probability,
        status=status,
        problem=problem,
        state=kept,
        parameter=parameter,
    )
