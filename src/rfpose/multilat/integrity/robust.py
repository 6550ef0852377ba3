"""Positions where gross errors would ruin least squares: robust loss, outliers named, height as an observation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat.fix import FixStatus, locate

__all__ = ["RobustFixes", "locate_robust"]

BoolArray = npt.NDArray[np.bool_]
StatusArray = npt.NDArray[np.int8]

# The loss is quadratic far within this many sigma and constant far beyond.
LOSS_SIGMA = 2.0
# Each stage of the loss is this much narrower than the one before.
NARROWING = 1.5
# A start is not trusted where its residuals are less likely than this.
RESTART_PROBABILITY = 1e-3
MAX_ITERATION = 40
# Smallest share of an unknown's information that the others may leave.
FLOOR = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class RobustFixes:
    """Positions and what was left out for them; arrays are read-only. A row that is not solved is NaN.

    Attributes
    ----------
    position_enu_m : (receiver, xyz)
        [m].
    clock_m : (receiver,)
        What the row's ranges lack to be true ranges [m].
    cov_enu_m2 : (receiver, xyz, xyz)
        Covariance from the observations used [m²]; the choice of these is taken as certain.
    residual_m : (receiver, transmitter)
        Range measured less range at the solution [m], of outliers too; NaN = not received.
    height_residual_m : (receiver,)
        Height observed less height found [m]; NaN = not observed.
    outlier : (receiver, transmitter)
        Ranges left out.
    height_outlier : (receiver,)
        Whether the height was.
    chi2, dof : (receiver,)
        Of the observations used. Without degrees of freedom nothing confirms the choice of outliers.
    status : (receiver,)
        `FixStatus` as int8; RESIDUAL: what is left is still unlikely; AMBIGUOUS: it fits alike on the other side of the
        transmitters' plane.
    """

    position_enu_m: FloatArray
    clock_m: FloatArray
    cov_enu_m2: FloatArray
    residual_m: FloatArray
    height_residual_m: FloatArray
    outlier: BoolArray
    height_outlier: BoolArray
    chi2: FloatArray
    dof: npt.NDArray[np.int64]
    status: StatusArray

    @property
    def ok(self) -> BoolArray:
        """(receiver,) True where the status is OK."""
        return np.asarray(self.status == FixStatus.OK)


def locate_robust(
    transmitter_enu_m: npt.ArrayLike,
    range_difference_m: npt.ArrayLike,
    *,
    sigma_m: npt.ArrayLike | float,
    height_enu_m: npt.ArrayLike | None = None,
    height_sigma_m: float = np.inf,
    side: Literal["below", "above"] | None = "below",
    outlier_sigma: float = 4.0,
    min_probability: float = 1e-6,
) -> RobustFixes:
    """Locate receivers from range differences some of which may be grossly wrong.

    Least squares from a cold start; then the Geman-McClure loss ρ(r) = r²/(1 + r²/s²), s narrowed step by step from
    where it is convex to 2 σ [1]_. Rows with unlikely residuals are also solved without each observation in turn, and
    the solution with the smallest sum of squares, each cut off at ``outlier_sigma``, is taken. Last comes least squares
    without what lies beyond ``outlier_sigma``.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        Surveyed positions, site ENU frame [m]; five or more.
    range_difference_m : (receiver, transmitter)
        Range to each transmitter minus range to the reference, up to one constant a row [m]. NaN = not received.
    sigma_m : scalar, (transmitter,) or (receiver, transmitter)
        Standard deviation of ONE transmitter's range, were it no outlier [m].
    height_enu_m : (receiver,), optional
        Observed z (an altimeter, a survey) [m]; NaN = none.
    height_sigma_m
        Its standard deviation, were it no outlier [m].
    side
        As in `rfpose.multilat.locate`.
    outlier_sigma
        Residual, in sigmas, beyond which an observation is left out.
    min_probability
        A row whose remaining residuals are less likely is marked RESIDUAL.

    Raises
    ------
    InvalidInputError, GeometryError
        As `rfpose.multilat.locate`; a height without its sigma.

    Notes
    -----
    Five ranges and no height leave one degree of freedom: an error can be seen but not assigned, and the loss then
    picks one of several equally good explanations. With a height there are two.

    References
    ----------
    .. [1] Yang, Antonante, Tzoumas, Carlone, Graduated non-convexity for robust spatial perception, IEEE RA-L 5
       (2020), equations for the Geman-McClure cost.
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    ranges = as_float_array("range_difference_m", range_difference_m, ("receiver", len(transmitter)), finite=False)
    outlier_sigma = as_positive("outlier_sigma", outlier_sigma)
    if not 0.0 <= min_probability < 1.0:
        raise InvalidInputError(f"`min_probability` must lie in [0, 1), got {min_probability}")
    plain = locate(
        transmitter, ranges, sigma_m=sigma_m, side=side, max_dop=np.inf, min_probability=0.0
    )  # checks all the rest
    sigma = np.broadcast_to(np.asarray(sigma_m, np.float64), ranges.shape)
    height, height_sigma = _height(height_enu_m, height_sigma_m, len(ranges))
    problem = _Rows(
        transmitter, np.concatenate([ranges, height[:, None]], axis=1), np.column_stack([sigma, height_sigma])
    )
    state = _start(problem, plain.position_enu_m)
    state = _without_one(problem, _narrow(problem, state), state, outlier_sigma)
    left = problem.left(state)
    outlier = problem.seen & (np.abs(left) > outlier_sigma * problem.sigma)
    state, cov, singular = _least_squares(problem, state, problem.weight * ~outlier)
    # what is left may fit as well on the other side of the transmitters' plane; a height tells the sides apart
    kept = np.where(outlier[:, :-1], np.nan, ranges)
    last = locate(transmitter, kept, sigma_m=sigma_m, side=side, max_dop=np.inf, min_probability=0.0)
    ambiguous = (last.status == FixStatus.AMBIGUOUS) & ~(problem.seen & ~outlier)[:, -1]
    return _result(problem, state, cov, singular, outlier, min_probability, ambiguous)


@dataclass(frozen=True, slots=True)
class _Rows:
    """Observations of all receivers: a range to each transmitter, then the height."""

    transmitter: FloatArray
    value: FloatArray
    sigma: FloatArray

    @property
    def seen(self) -> BoolArray:
        return np.asarray(np.isfinite(self.value) & np.isfinite(self.sigma))

    @property
    def weight(self) -> FloatArray:
        return np.where(self.seen, self.sigma, np.inf) ** -2.0

    def rows(self, index: npt.NDArray[np.int64]) -> _Rows:
        return _Rows(self.transmitter, self.value[index], self.sigma[index])

    def left(self, state: FloatArray) -> FloatArray:
        """Observed less computed; 0 where not observed. ``state`` is (receiver, xyz and clock)."""
        distance = np.linalg.norm(state[:, None, :3] - self.transmitter, axis=-1)
        model = np.concatenate([distance + state[:, 3:], state[:, 2:3]], axis=1)
        return np.where(self.seen, np.nan_to_num(self.value) - model, 0.0)

    def slope(self, state: FloatArray) -> FloatArray:
        """(receiver, observation, unknown)."""
        to_receiver = state[:, None, :3] - self.transmitter
        distance = np.linalg.norm(to_receiver, axis=-1, keepdims=True)
        out = np.zeros((len(state), len(self.transmitter) + 1, 4))
        out[:, :-1, :3] = to_receiver / np.maximum(distance, 1e-300)
        out[:, :-1, 3] = 1.0
        out[:, -1, 2] = 1.0
        return out


def _height(
    height_enu_m: npt.ArrayLike | None, height_sigma_m: float, n_receiver: int
) -> tuple[FloatArray, FloatArray]:
    if height_enu_m is None:
        return np.full(n_receiver, np.nan), np.full(n_receiver, np.nan)
    height = as_float_array("height_enu_m", height_enu_m, (n_receiver,), finite=False)
    return height, np.full(n_receiver, as_positive("height_sigma_m", height_sigma_m))


def _chi2(problem: _Rows, state: FloatArray) -> FloatArray:
    return np.asarray(np.sum(problem.weight * problem.left(state) ** 2, axis=1))


def _with_clock(problem: _Rows, position: FloatArray) -> FloatArray:
    """Add the clock that fits most ranges: the median."""
    state = np.column_stack([position, np.zeros(len(position))])
    left = np.where(problem.seen, problem.left(state), np.nan)[:, :-1]
    known = np.isfinite(left).any(axis=1)
    state[known, 3] = np.nanmedian(left[known], axis=1)
    return state


def _start(problem: _Rows, position: FloatArray) -> FloatArray:
    """Least squares from the plain fixes, and where these are unlikely or missing from places all around."""
    from scipy.special import chdtrc

    centre = problem.transmitter.mean(axis=0)
    size = np.sqrt(np.mean(np.sum((problem.transmitter - centre) ** 2, axis=1)))
    height = np.where(problem.seen[:, -1], problem.value[:, -1], centre[2])
    middle = np.column_stack([np.broadcast_to(centre[:2], (len(height), 2)), height])
    first = np.where(np.isfinite(position), position, middle)
    best, _, _ = _least_squares(problem, _with_clock(problem, first), problem.weight)
    chi2 = _chi2(problem, best)
    dof = problem.seen.sum(axis=1) - 4
    unlikely = chdtrc(np.maximum(dof, 1), chi2) < RESTART_PROBABILITY
    rows = np.flatnonzero((unlikely & (dof > 0)) | ~np.isfinite(position).all(axis=1))
    if not rows.size:
        return best
    part = problem.rows(rows)
    for offset in 0.7 * size * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]):
        state, _, _ = _least_squares(part, _with_clock(part, middle[rows] + offset), part.weight)
        better = _chi2(part, state) < chi2[rows]
        best[rows[better]] = state[better]
        chi2[rows[better]] = _chi2(part, state)[better]
    return best


def _least_squares(problem: _Rows, start: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Levenberg-Marquardt; returns states, their covariance (receiver, 4, 4), and which are not determined."""
    state = start.copy()
    damping = np.full(len(state), 1e-7)
    cost = np.sum(weight * problem.left(state) ** 2, axis=1)
    for _ in range(MAX_ITERATION):
        info, gradient = _normal_equations(problem, state, weight)
        step = _solve(info, gradient, damping)
        trial = state + step
        new = np.sum(weight * problem.left(trial) ** 2, axis=1)
        good = new <= cost
        state[good], cost[good] = trial[good], new[good]
        damping = np.where(good, damping * 0.1, damping * 10.0)
        if np.all((np.einsum("na,na->n", step, gradient) < 1e-4) | (damping > 1e3)):
            break
    info, _ = _normal_equations(problem, state, weight)
    unit = np.sqrt(np.maximum(np.einsum("naa->na", info), 1e-300))
    scaled = info / (unit[:, :, None] * unit[:, None, :])
    singular = np.linalg.eigvalsh(scaled)[:, 0] < FLOOR
    scaled[singular] = np.eye(4)
    cov = np.linalg.inv(scaled) / (unit[:, :, None] * unit[:, None, :])
    return state, cov, np.asarray(singular)


def _solve(info: FloatArray, gradient: FloatArray, damping: FloatArray) -> FloatArray:
    """Damped step; unknowns that nothing observes stay where they are."""
    unit = np.einsum("naa->na", info)
    ridge = damping[:, None] * unit + 1e-14 * unit.sum(axis=1, keepdims=True)
    damped = info + np.eye(4) * np.where(ridge > 0.0, ridge, 1.0)[:, None, :]
    return np.asarray(np.linalg.solve(damped, gradient[..., None])[..., 0])


def _normal_equations(problem: _Rows, state: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    slope = problem.slope(state)
    weighted = slope * weight[..., None]
    return np.swapaxes(slope, 1, 2) @ weighted, np.einsum("noa,no->na", weighted, problem.left(state))


def _narrow(problem: _Rows, start: FloatArray) -> FloatArray:
    """Geman-McClure loss, from nearly quadratic down to `LOSS_SIGMA`."""
    state = start.copy()
    relative = np.abs(problem.left(state)) / np.where(problem.seen, problem.sigma, 1.0)
    width = np.maximum(3.0 * relative.max(axis=1), LOSS_SIGMA)
    last = 0
    while last < 3:
        scale = width[:, None] * np.where(problem.seen, problem.sigma, 1.0)
        for _ in range(2):
            weight = problem.weight / (1.0 + (problem.left(state) / scale) ** 2) ** 2
            info, gradient = _normal_equations(problem, state, weight)
            state = state + _solve(info, gradient, np.full(len(state), 1e-9))
        last += bool(np.all(width == LOSS_SIGMA))
        width = np.maximum(width / NARROWING, LOSS_SIGMA)
    lost = ~np.isfinite(state).all(axis=1)
    state[lost] = start[lost]
    return state


def _cut_cost(problem: _Rows, state: FloatArray, outlier_sigma: float) -> FloatArray:
    return np.asarray(np.sum(np.minimum(problem.weight * problem.left(state) ** 2, outlier_sigma**2), axis=1))


def _without_one(problem: _Rows, state: FloatArray, plain: FloatArray, outlier_sigma: float) -> FloatArray:
    """Solve rows whose plain residuals are unlikely without each observation in turn; keep what fits most."""
    from scipy.special import chdtrc

    dof = problem.seen.sum(axis=1) - 4
    rows = np.flatnonzero((chdtrc(np.maximum(dof, 1), _chi2(problem, plain)) < RESTART_PROBABILITY) & (dof > 1))
    if not rows.size:
        return state
    part = problem.rows(rows)
    out = state.copy()
    cost = _cut_cost(part, state[rows], outlier_sigma)
    for j in range(problem.value.shape[1]):
        weight = part.weight
        weight[:, j] = 0.0
        for start in (state[rows], plain[rows]):
            trial, _, _ = _least_squares(part, start, weight)
            new = _cut_cost(part, trial, outlier_sigma)
            better = new < cost
            out[rows[better]] = trial[better]
            cost[better] = new[better]
    return out


def _result(
    problem: _Rows,
    state: FloatArray,
    cov: FloatArray,
    singular: BoolArray,
    outlier: BoolArray,
    min_probability: float,
    ambiguous: BoolArray,
) -> RobustFixes:
    from scipy.special import chdtrc

    left = problem.left(state)
    used = problem.seen & ~outlier
    chi2 = np.sum(np.where(used, problem.weight * left**2, 0.0), axis=1)
    dof = used.sum(axis=1) - 4
    status = np.full(len(state), FixStatus.OK, np.int8)
    status[ambiguous] = FixStatus.AMBIGUOUS
    if min_probability > 0.0:
        status[(dof > 0) & (chdtrc(np.maximum(dof, 1), chi2) < min_probability)] = FixStatus.RESIDUAL
    status[singular] = FixStatus.SINGULAR
    status[dof < 0] = FixStatus.TOO_FEW
    bad = (dof < 0) | singular
    left = np.where(problem.seen, left, np.nan)
    for array in (state, cov, left, chi2):
        array[bad] = np.nan
    outlier = outlier & ~bad[:, None]
    return RobustFixes(
        position_enu_m=read_only(state[:, :3]),
        clock_m=read_only(state[:, 3]),
        cov_enu_m2=read_only(cov[:, :3, :3]),
        residual_m=read_only(left[:, :-1]),
        height_residual_m=read_only(left[:, -1]),
        outlier=read_only(outlier[:, :-1]),
        height_outlier=read_only(outlier[:, -1]),
        chi2=read_only(chi2),
        dof=read_only(np.asarray(dof)),
        status=read_only(status),
    )
