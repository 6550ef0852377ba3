"""Poses of rigid mirrors and the coefficients of what reflects, from the same phases.

The coefficients are shared by all mirrors and frames. Each mirror is solved at given coefficients; what it says about
them, its own unknowns eliminated, is a Schur complement of its normal equations, and their sum gives the coefficients'
Gauss-Newton step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError
from rfpose.multilat.ground import _coefficients
from rfpose.multilat.ground._coefficients import MAX_CONDITION
from rfpose.multilat.ground._problem import NO_TURN, CalibrationSight, GroundProblem, build
from rfpose.multilat.ground.integers import resolve
from rfpose.multilat.ground.model import (
    LEVEL_GROUND,
    SPEED_OF_LIGHT_MPS,
    ComplexArray,
    Reflector,
    build_scene,
    heights_m,
)
from rfpose.multilat.rigid.parts import part_of
from rfpose.multilat.rigid.pose import RigidFits, can_begin
from rfpose.multilat.rigid.problem import MirrorProblem, Observation
from rfpose.multilat.rigid.records import RigidPoses
from rfpose.multilat.status import PoseStatus, has_start

__all__ = ["GroundSolution", "joint_covariance", "solve_with_ground", "turns"]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

_TURN_RAD, _N_TURN = 0.4, 200
"""How far a mirror that does not fit is turned at most to start again; points in a cube, half of them in the ball."""
_FAR_TURN_RAD, _N_FAR_TURN = 0.8, 400
"""The same where coefficients are known: no other mirror need fit, and the direct ray's pose may be a radian off."""
_MAX_ITERATION_DIRECT = 12


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
        `rfpose.multilat.PoseStatus`.
    problem, state, parameter
        What was solved, where it ended and the estimated coefficients, for tests that solve it again with less.
    """

    poses: RigidPoses
    full_cov: FloatArray
    coefficient: ComplexArray
    coefficient_cov: FloatArray
    fixed: BoolArray
    wrong_risk: FloatArray
    range_m: FloatArray
    probability_direct: FloatArray
    probability: FloatArray
    status: IntArray
    problem: GroundProblem
    state: RigidFits
    parameter: FloatArray


def solve_with_ground(
    mirrors: MirrorProblem,
    *,
    carrier_rf_hz: npt.ArrayLike,
    reflectors: Sequence[Reflector] = (LEVEL_GROUND,),
    calibration_enu_m: CalibrationSight | npt.ArrayLike | None = None,
    free_space: bool = True,
    start_sigma_m: float = 1.0,
    wrong_risk: float = 1e-6,
    min_probability: float = 1e-6,
    propagation_speed_mps: float = SPEED_OF_LIGHT_MPS,
) -> GroundSolution:
    """Solve rigid poses where planes reflect, coefficients shared by all mirrors and frames estimated with them.

    Parameters
    ----------
    mirrors
        Whole wavelengths not resolved yet. Frames are rows of the mirror axis like mirrors.
    carrier_rf_hz : (transmitter,)
        Carrier frequencies at RF, f_c + f_i [Hz].
    reflectors
        Planes; those without a coefficient are estimated. None at all: the direct ray alone.
    calibration_enu_m : `CalibrationSight`, or (calibration receiver, xyz), optional
        Where Φ was measured, and how it became of several receivers; places alone mean their plain mean. The
        reflections there are in the ranges, and are modelled.
    free_space
        Whether a longer ray is weaker by d/d'.
    start_sigma_m
        Uncertainty of the start's ranges, reflections included, for the integers of the tones [m].
    wrong_risk
        Largest probability that any integer of an observation is wrong, for it to be used.
    min_probability
        Residuals less likely than this give status UNEXPLAINED.
    propagation_speed_mps
        [m/s].

    Raises
    ------
    InvalidInputError
        Shapes that do not fit, a tone whose wavelength differs between transmitters.
    GeometryError
        A transmitter behind a reflector.
    """
    n_tone = int(np.count_nonzero(~mirrors.is_carrier))
    observations = [mirrors.observation(k) for k in range(len(mirrors.clock_class))]
    transmitter, places, n_mirror = mirrors.transmitter_enu_m, mirrors.receiver_mirror_m, len(mirrors.range_m)
    pivot, rot = mirrors.start_pivot_enu_m, mirrors.start_rot_enu_from_mirror
    status = np.zeros(n_mirror, np.int64)
    status[_behind(places, pivot, rot, reflectors)] = PoseStatus.BEHIND_REFLECTOR
    status[~can_begin(mirrors)] = PoseStatus.TOO_FEW
    speed = as_positive("propagation_speed_mps", propagation_speed_mps)
    scene = build_scene(
        transmitter,
        reflectors,
        carrier_rf_hz=as_float_array("carrier_rf_hz", carrier_rf_hz, (len(transmitter),), positive=True),
        tone_hz=np.array([0.0 if o.carrier else _tone_hz(o, speed) for o in observations]),
        free_space=free_space,
        propagation_speed_mps=speed,
    )

    def lay_out(ranges: list[FloatArray], pivot: FloatArray, rot: FloatArray) -> GroundProblem:
        count = len(ranges)
        used = scene._replace(tone_k=scene.tone_k[:count], common=scene.common[:, :, :count].copy())
        begun = replace(
            part_of(mirrors, groups=slice(count)),
            range_m=np.stack(ranges, axis=1),
            start_pivot_enu_m=pivot,
            start_rot_enu_from_mirror=rot,
        )
        return build(used, begun, calibration=calibration_enu_m)

    risk = np.ones((n_mirror, len(observations)))
    distance = np.linalg.norm(_receivers(places, pivot, rot)[:, :, None] - transmitter, axis=-1)
    ranges = []
    offset = None
    for k in range(n_tone):
        resolved, risk[:, k], offset = resolve(mirrors, k, distance, float(start_sigma_m), offset)
        ranges.append(np.where((risk[:, k] <= wrong_risk)[:, None, None], resolved, np.nan))
    problem = lay_out(ranges, pivot, rot)
    status[(status == PoseStatus.OK) & (problem.dof < 0)] = PoseStatus.UNKNOWNS
    start = problem.begin(pivot, rot, status)
    probability_direct = _direct_probability(problem, start)
    turn = turns()
    parameter = _coefficients.find(problem, start, turn)
    state = start.copy()
    problem.fit(state, parameter)
    _coefficients.retry(problem, start, state, parameter, turn)
    if problem.n_parameter == 0:
        _coefficients.retry(problem, start, state, parameter, turns(_FAR_TURN_RAD, _N_FAR_TURN))
    parameter = _coefficients.refine(problem, state, parameter)
    if n_tone < len(observations):
        finest = lay_out([o.range_m for o in observations], state.pivot, state.rot)
        predicted, slope = finest.predict(state, parameter)
        cov = joint_covariance(state, _coefficient_cov(problem, state))
        pose_and_coefficients = [*range(6), *range(state.cov.shape[1], cov.shape[1])]
        cov = cov[:, pose_and_coefficients][:, :, pose_and_coefficients]
        # a pose that does not explain its tones predicts no carrier
        sound = ~(_probability(state.chi2, problem.dof, state.status == PoseStatus.OK) < min_probability)
        for k in range(n_tone, len(observations)):
            resolved, risk[:, k], _ = resolve(mirrors, k, predicted[:, k], (slope[:, k], cov))
            risk[~sound, k] = 1.0
            ranges.append(np.where((risk[:, k] <= wrong_risk)[:, None, None], resolved, np.nan))
        problem = lay_out(ranges, state.pivot, state.rot)
        state = problem.begin(state.pivot, state.rot, state.status)
        problem.fit(state, parameter)
        parameter = _coefficients.refine(problem, state, parameter)
    return _solution(
        problem, state, parameter, places, reflectors, risk, ranges, wrong_risk, probability_direct, min_probability
    )


def _tone_hz(observation: Observation, speed_mps: float) -> float:
    wavelength = np.asarray(observation.wavelength_m, np.float64)
    if np.ptp(wavelength) > 1e-9 * float(wavelength.max()):
        raise InvalidInputError("`wavelength_m` of a tone must be the same for all transmitters")
    return speed_mps / float(wavelength.flat[0])


def _receivers(places: FloatArray, pivot: FloatArray, rot: FloatArray) -> FloatArray:
    return np.asarray(pivot[:, None] + np.einsum("mab,mrb->mra", rot, places))


def _behind(places: FloatArray, pivot: FloatArray, rot: FloatArray, reflectors: Sequence[Reflector]) -> BoolArray:
    """(mirror,) whether a receiver lies behind a plane."""
    receiver = _receivers(places, pivot, rot)
    behind = [np.any(heights_m(receiver, reflector) <= 0.0, axis=1) for reflector in reflectors]
    return np.asarray(np.any(behind, axis=0)) if behind else np.zeros(len(places), np.bool_)


def turns(largest_rad: float = _TURN_RAD, count: int = _N_TURN) -> FloatArray:
    """Rotation vectors spread over a ball, small ones first; none at all is first of all.

    Parameters
    ----------
    largest_rad
        Radius of the ball [rad].
    count
        Points in a cube about it.
    """
    cube = 2.0 * _halton(count) - 1.0
    length = np.linalg.norm(cube, axis=1)
    inside = length <= 1.0
    return np.concatenate([NO_TURN, largest_rad * cube[inside][np.argsort(length[inside])]])


def _halton(n: int) -> FloatArray:
    """Return Halton's first points in the unit cube (point, 3): scipy has them in a module that takes long to load."""
    out = np.zeros((n, 3))
    for axis, base in enumerate((2, 3, 5)):
        rest, worth = np.arange(n), 1.0 / base
        while rest.any():  # digits of the point's number, mirrored at the point
            out[:, axis] += rest % base * worth
            rest, worth = rest // base, worth / base
    return out


def _direct_probability(problem: GroundProblem, start: RigidFits) -> FloatArray:
    """(mirror,) probability of the residuals with the direct ray alone."""
    direct = problem.direct()
    state = direct.begin(start.pivot, start.rot, start.status)
    direct.fit(state, np.zeros(0), max_iteration=_MAX_ITERATION_DIRECT)
    return _probability(state.chi2, problem.dof, has_start(state.status))


def _probability(chi2: FloatArray, dof: FloatArray, solved: BoolArray) -> FloatArray:
    from scipy.special import chdtrc

    known = solved & np.isfinite(chi2) & (dof > 0.0)
    return np.asarray(np.where(known, chdtrc(np.maximum(dof, 1e-9), np.where(known, chi2, 0.0)), np.nan))


def _coefficient_cov(problem: GroundProblem, state: RigidFits) -> FloatArray:
    """Covariance of the coefficients; NaN where the mirrors do not determine them."""
    information = _coefficients.information(state, _coefficients.trusted(problem, state))
    if information.size and not (np.any(information) and np.linalg.cond(information) < MAX_CONDITION):
        return np.full(information.shape, np.nan)
    return np.asarray(np.linalg.inv(information))


def joint_covariance(state: RigidFits, coefficient_cov: FloatArray) -> FloatArray:
    """(mirror, unknown + parameter, unknown + parameter) of pose, clocks and coefficients."""
    n_mirror, _, n_parameter = state.follow.shape
    n_own = state.cov.shape[1]
    follow = state.follow[:, :n_own]
    out = np.empty((n_mirror, n_own + n_parameter, n_own + n_parameter))
    out[:, :n_own, :n_own] = state.cov + follow @ coefficient_cov @ np.swapaxes(follow, 1, 2)
    out[:, :n_own, n_own:] = follow @ coefficient_cov
    out[:, n_own:, :n_own] = np.swapaxes(out[:, :n_own, n_own:], 1, 2)
    out[:, n_own:, n_own:] = coefficient_cov
    return out


def _solution(
    problem: GroundProblem,
    state: RigidFits,
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
    status[(status == PoseStatus.OK) & _behind(places, state.pivot, state.rot, reflectors)] = (
        PoseStatus.BEHIND_REFLECTOR
    )
    if np.any(np.isnan(coefficient_cov)):
        status[status == PoseStatus.OK] = PoseStatus.UNDETERMINED
    solved = status == PoseStatus.OK
    kept.status[~solved] = np.where(has_start(status[~solved]), PoseStatus.TOO_FEW, status[~solved])
    # each mirror pays its share of the coefficients
    dof = problem.dof - np.einsum("mab,ba->m", state.schur, coefficient_cov)
    probability = _probability(state.chi2, dof, solved)
    status[solved & (probability < min_probability)] = PoseStatus.UNEXPLAINED
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
            status=np.where(status == PoseStatus.UNEXPLAINED, PoseStatus.OK, status),
        ),
        full_cov=full,
        coefficient=problem.scene_at(parameter).coefficient,
        coefficient_cov=coefficient_cov,
        fixed=risk <= wrong_risk,
        wrong_risk=risk,
        range_m=np.stack(ranges, axis=1),
        probability_direct=probability_direct,
        probability=probability,
        status=status,
        problem=problem,
        state=kept,
        parameter=parameter,
    )
