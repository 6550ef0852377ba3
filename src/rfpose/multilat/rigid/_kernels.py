"""Gauss-Newton over many rigid mirrors, by direct rays or by these and reflected ones.

Each mirror is solved at given coefficients of what reflects; what it says about them, its own unknowns eliminated, is
left over as a Schur complement. Without planes that is the direct ray alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rfpose.jit import kernel, kernel_rows
from rfpose.multilat.equations._kernels import (
    Float64,
    Int64,
    add_prior,
    covariance,
    factor,
    normal_equations,
    pull_to_prior,
    rotate,
    solve_factored,
)
from rfpose.multilat.reflection._kernels import shift_at, work_for
from rfpose.multilat.status import PoseStatus

SOLVED, OPEN, STUCK = int(PoseStatus.OK), int(PoseStatus.UNDETERMINED), int(PoseStatus.NOT_CONVERGED)


class FitRule(NamedTuple):
    """When a fit ends: steps, smallest pivot that counts as observed, longest turn of a step [rad], what is no step."""

    max_iteration: int
    floor: float
    longest_turn: float
    settled: float


class RigidFits(NamedTuple):
    """Where each mirror stands, changed in place by fits; mirror is the first axis.

    ``survey`` (mirror, 3 × calibration receiver): how far these are from where they are surveyed, in standard
    deviations, as this mirror has it. ``cov`` of the first unknowns (pose, then clocks, then survey) is at given
    coefficients; ``follow`` (mirror, unknown, parameter) is how the unknowns move with these, ``schur`` and ``rest``
    the information and gradient left for them.
    """

    pivot: Float64
    rot: Float64
    clock: Float64
    survey: Float64
    cov: Float64
    follow: Float64
    schur: Float64
    rest: Float64
    chi2: Float64
    n_iteration: Int64
    status: Int64

    def take(self, rows: Int64) -> RigidFits:
        """Copy some mirrors."""
        return RigidFits(**{name: array[rows] for name, array in self._asdict().items()})

    def copy(self) -> RigidFits:
        """Copy all."""
        return RigidFits(**{name: array.copy() for name, array in self._asdict().items()})

    def put(self, rows: Int64, other: RigidFits) -> None:
        """Write mirrors back."""
        for array, new in zip(self, other, strict=True):
            array[rows] = new


class Ambiguous(NamedTuple):
    """Ranges whose integers are sought, one wavelength of many mirrors; mirror is the first axis.

    ``left`` (mirror, receiver, transmitter) ranges less prediction; ``slope`` (…, 6) their derivative by the pose of
    covariance ``pose_cov``; ``own_m2`` each range's own variance, ``common_m2`` (mirror, transmitter) that common to
    receivers, ``clock_m2`` that of a receiver's clock. From range (r, i) comes off that of receiver ``minus[m, i]``
    (−1: none) and the difference of transmitter ``reference[m, r, 1]`` at receiver ``reference[m, r, 0]`` (−1: none).
    """

    left: Float64
    slope: Float64
    pose_cov: Float64
    own_m2: Float64
    common_m2: Float64
    clock_m2: float
    wavelength: Float64
    minus: Int64
    reference: Int64


class Differences(NamedTuple):
    """Differences of `Ambiguous` ranges [cycles]: how many, value, covariance, receiver and transmitter of each."""

    n_sought: Int64
    value: Float64
    cov: Float64
    row: Int64
    column: Int64


@kernel
def _arm(rot, place):
    return (
        rot[0, 0] * place[0] + rot[0, 1] * place[1] + rot[0, 2] * place[2],
        rot[1, 0] * place[0] + rot[1, 1] * place[1] + rot[1, 2] * place[2],
        rot[2, 0] * place[0] + rot[2, 1] * place[1] + rot[2, 2] * place[2],
    )


@kernel
def _direct(transmitter, receiver_mirror, pivot, rot, distance, slope):
    """Distances (receiver, transmitter) and their derivative by pivot and rotation (receiver, transmitter, ≥ 6)."""
    for r in range(receiver_mirror.shape[0]):
        ax, ay, az = _arm(rot, receiver_mirror[r])
        for i in range(transmitter.shape[0]):
            dx = pivot[0] + ax - transmitter[i, 0]
            dy = pivot[1] + ay - transmitter[i, 1]
            dz = pivot[2] + az - transmitter[i, 2]
            d = math.sqrt(dx * dx + dy * dy + dz * dz)
            distance[r, i] = d
            ux, uy, uz = dx / d, dy / d, dz / d
            slope[r, i, 0] = ux
            slope[r, i, 1] = uy
            slope[r, i, 2] = uz
            # the arm turns by theta × a, so the range changes by (a × u) · theta
            slope[r, i, 3] = ay * uz - az * uy
            slope[r, i, 4] = az * ux - ax * uz
            slope[r, i, 5] = ax * uy - ay * ux


@kernel
def predict(scene, common, work, receiver_mirror, pivot, rot, survey, predicted, slope):
    """Ranges (group, receiver, transmitter) and derivatives (…, 6 + survey + parameter), less what calibration carries.

    Without planes there is one group for all, and nothing besides the pose.
    """
    _direct(scene.transmitter, receiver_mirror, pivot, rot, predicted[0], slope[0])
    if scene.image.shape[0] == 0:
        return
    n_survey = survey.shape[0]
    n_parameter = slope.shape[3] - 6 - n_survey
    shift = np.zeros((predicted.shape[0], 4 + n_parameter))
    for r in range(receiver_mirror.shape[0]):
        ax, ay, az = _arm(rot, receiver_mirror[r])
        for i in range(predicted.shape[2]):
            shift_at(scene, work, pivot[0] + ax, pivot[1] + ay, pivot[2] + az, i, shift)
            for g in range(predicted.shape[0] - 1, -1, -1):  # the direct ray stands in the first group
                predicted[g, r, i] = predicted[0, r, i] + shift[g, 0] - common[i, g, 0]
                sx, sy, sz = shift[g, 1], shift[g, 2], shift[g, 3]
                slope[g, r, i, 0] = slope[0, r, i, 0] + sx
                slope[g, r, i, 1] = slope[0, r, i, 1] + sy
                slope[g, r, i, 2] = slope[0, r, i, 2] + sz
                slope[g, r, i, 3] = slope[0, r, i, 3] + ay * sz - az * sy
                slope[g, r, i, 4] = slope[0, r, i, 4] + az * sx - ax * sz
                slope[g, r, i, 5] = slope[0, r, i, 5] + ax * sy - ay * sx
                for c in range(n_survey):
                    slope[g, r, i, 6 + c] = -common[i, g, 1 + c]
                    predicted[g, r, i] -= common[i, g, 1 + c] * survey[c]
                for c in range(n_survey, n_survey + n_parameter):
                    slope[g, r, i, 6 + c] = shift[g, 4 + c - n_survey] - common[i, g, 1 + c]


@kernel
def _leave(lower, info, gradient, cov, follow, schur, rest):
    """What a converged mirror hands on: covariance, how it follows the parameters, what it says about them."""
    n_own, n_parameter = lower.shape[0], schur.shape[0]
    covariance(lower, cov)
    x = np.empty(n_own)
    for c in range(n_parameter):
        for a in range(n_own):
            x[a] = info[n_own + c, a]
        solve_factored(lower, x)
        rest[c] = gradient[n_own + c]
        for a in range(n_own):
            follow[a, c] = -x[a]
            rest[c] -= x[a] * gradient[a]
        for b in range(n_parameter):
            s = info[n_own + max(b, c), n_own + min(b, c)]
            for a in range(n_own):
                s -= x[a] * info[n_own + b, a]
            schur[b, c] = s


@kernel
def _copy(source, target):
    """Element by element: an assignment of slices compiles to much more."""
    from_flat, to_flat = source.ravel(), target.ravel()
    for a in range(from_flat.shape[0]):
        to_flat[a] = from_flat[a]


@kernel
def _move(step, share, old_pivot, old_rot, old_clock, old_survey, pivot, rot, clock, survey):
    """Pose, clocks and survey a share of a step away from the old ones."""
    n_class, n_receiver = clock.shape
    for a in range(3):
        pivot[a] = old_pivot[a] + share * step[a]
    rotate(share * step[3:6], old_rot, rot)
    for k in range(n_class):
        for r in range(n_receiver):
            clock[k, r] = old_clock[k, r] + share * step[6 + k * n_receiver + r]
    for a in range(survey.shape[0]):
        survey[a] = old_survey[a] + share * step[6 + clock.size + a]


@kernel
def _pull_to_survey(survey, first, info, gradient):
    """Add that the calibration receivers are where they were surveyed, give or take one; return that part of chi²."""
    chi2 = 0.0
    for a in range(survey.shape[0]):
        info[first + a, first + a] += 1.0
        gradient[first + a] -= survey[a]
        chi2 += survey[a] * survey[a]
    return chi2


@kernel
def _fit(scene, mirrors, m, rule, pivot, rot, clock, survey, cov, follow, schur, rest):
    """Gauss-Newton with step halving of mirror ``m`` at given coefficients; (chi², iterations, status)."""
    z, weight = mirrors.z[m], mirrors.weight[m]
    common = scene.common[mirrors.frame[m]]
    n_parameter = schur.shape[0]
    n_survey = survey.shape[0]
    n_own = 6 + clock.size + n_survey
    n = n_own + n_parameter
    n_bent = z.shape[0] if scene.image.shape[0] > 0 else 1
    work = work_for(scene.image.shape[0])
    predicted = np.empty((n_bent, z.shape[1], z.shape[2]))
    slope = np.empty((n_bent, z.shape[1], z.shape[2], 6 + n_survey + n_parameter))
    info = np.empty((n, n))
    lower = np.empty((n_own, n_own))
    gradient = np.empty(n)
    step = np.empty(n_own)
    old_pivot, old_rot, old_clock, old_survey = pivot.copy(), rot.copy(), clock.copy(), survey.copy()
    chi2_before = np.inf
    share = 1.0
    chi2 = np.nan
    used = 0
    for iteration in range(rule.max_iteration):
        used = iteration + 1
        predict(scene, common, work, mirrors.receiver_mirror[m], pivot, rot, survey, predicted, slope)
        chi2 = normal_equations(
            z, weight, mirrors.bias_info[m], mirrors.clock_class, predicted, slope, clock, info, gradient
        )
        add_prior(mirrors.prior, m, rot, info, 0, 6)
        chi2 += pull_to_prior(mirrors.prior, m, pivot, rot, clock, gradient)
        chi2 += _pull_to_survey(survey, n_own - n_survey, info, gradient)
        if not math.isfinite(chi2):
            return np.inf, used, STUCK
        if chi2 > chi2_before * (1.0 + 1e-9) + 1e-6 and share > 1e-3:
            # too long a step: halve it from where it began
            share *= 0.5
            _move(step, share, old_pivot, old_rot, old_clock, old_survey, pivot, rot, clock, survey)
            continue
        for a in range(n_own):
            for b in range(a + 1):
                lower[a, b] = info[a, b]
        if not factor(lower, n_own, rule.floor):
            return chi2, used, OPEN
        for a in range(n_own):
            step[a] = gradient[a]
        solve_factored(lower, step)
        decrement = 0.0
        for a in range(n_own):
            decrement += step[a] * gradient[a]
        turn = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
        share = 1.0 if turn <= rule.longest_turn else rule.longest_turn / turn
        chi2_before = chi2
        _copy(pivot, old_pivot)
        _copy(rot, old_rot)
        _copy(clock, old_clock)
        _copy(survey, old_survey)
        _move(step, share, old_pivot, old_rot, old_clock, old_survey, pivot, rot, clock, survey)
        if decrement < rule.settled and share == 1.0:
            _leave(lower, info, gradient, cov, follow, schur, rest)
            return chi2 - decrement, used, SOLVED
    return min(chi2, chi2_before), used, STUCK


@kernel
def _fit_from_turns(scene, mirrors, m, rule, turn, enough, pivot, rot, clock, survey, cov, follow, schur, rest):
    """`_fit` from the pose turned by each of ``turn`` (start, 3) until chi² is below ``enough``; else the smallest.

    Without any that converged: where the best of the others stopped.
    """
    from_pivot, from_rot, from_clock, from_survey = pivot.copy(), rot.copy(), clock.copy(), survey.copy()
    pivot_try, rot_try, clock_try, survey_try = pivot.copy(), rot.copy(), clock.copy(), survey.copy()
    cov_try, follow_try, schur_try, rest_try = cov.copy(), follow.copy(), schur.copy(), rest.copy()
    about = np.empty(3)
    best = np.inf
    status = STUCK
    total = 0
    for s in range(turn.shape[0]):
        _copy(from_pivot, pivot_try)
        _copy(from_clock, clock_try)
        _copy(from_survey, survey_try)
        for a in range(3):
            about[a] = from_rot[a, 0] * turn[s, 0] + from_rot[a, 1] * turn[s, 1] + from_rot[a, 2] * turn[s, 2]
        rotate(about, from_rot, rot_try)
        chi2, used, outcome = _fit(
            scene, mirrors, m, rule, pivot_try, rot_try, clock_try, survey_try, cov_try, follow_try, schur_try, rest_try
        )
        total += used
        if outcome == OPEN and status != SOLVED and best == np.inf:
            status = OPEN
        # a solution beats every attempt that did not come to an end
        first = outcome == SOLVED and status != SOLVED
        if first or (chi2 < best and (outcome == SOLVED or (outcome == STUCK and status != SOLVED))):
            best = chi2
            status = outcome
            _copy(pivot_try, pivot)
            _copy(rot_try, rot)
            _copy(clock_try, clock)
            _copy(survey_try, survey)
            _copy(cov_try, cov)
            _copy(follow_try, follow)
            _copy(schur_try, schur)
            _copy(rest_try, rest)
        if status == SOLVED and best < enough:
            break
    return best, total, status


@kernel_rows
def fit_many(begin, end, scene, mirrors, rule, turn, enough, to):
    """Fit every mirror that has a start: from there, or from there turned; see `_fit_from_turns`."""
    for m in range(begin, end):
        if to.status[m] != SOLVED and to.status[m] != OPEN and to.status[m] != STUCK:
            continue
        pivot, rot, clock, survey, cov = to.pivot[m], to.rot[m], to.clock[m], to.survey[m], to.cov[m]
        follow, schur, rest = to.follow[m], to.schur[m], to.rest[m]
        if turn.shape[0] == 0:
            to.chi2[m], to.n_iteration[m], to.status[m] = _fit(
                scene, mirrors, m, rule, pivot, rot, clock, survey, cov, follow, schur, rest
            )
        else:
            to.chi2[m], to.n_iteration[m], to.status[m] = _fit_from_turns(
                scene, mirrors, m, rule, turn, enough[m], pivot, rot, clock, survey, cov, follow, schur, rest
            )


@kernel_rows
def clocks_many(begin, end, scene, mirrors, pivot, rot, clock):
    """Set clocks (mirror, class, receiver) that fit poses, one a mirror and class: the mean of range less distance."""
    n_group, n_receiver, n_transmitter = mirrors.z.shape[1:]
    distance = np.empty((n_receiver, n_transmitter))
    unused = np.empty((n_receiver, n_transmitter, 6))
    for m in range(begin, end):
        _direct(scene.transmitter, mirrors.receiver_mirror[m], pivot[m], rot[m], distance, unused)
        for k in range(clock.shape[1]):
            total = 0.0
            count = 0
            for g in range(n_group):
                if mirrors.clock_class[g] != k:
                    continue
                for r in range(n_receiver):
                    for i in range(n_transmitter):
                        if mirrors.weight[m, g, r, i] > 0.0:
                            total += mirrors.z[m, g, r, i] - distance[r, i]
                            count += 1
            clock[m, k] = total / count if count > 0 and math.isfinite(total) else 0.0


@kernel_rows
def predict_many(begin, end, scene, mirrors, pivot, rot, survey, predicted, slope):
    """`predict` for every mirror."""
    for m in range(begin, end):
        work = work_for(scene.image.shape[0])
        common = scene.common[mirrors.frame[m]]
        predict(scene, common, work, mirrors.receiver_mirror[m], pivot[m], rot[m], survey[m], predicted[m], slope[m])


@kernel_rows
def equations_many(begin, end, mirrors, predicted, slope, pivot, rot, clock, info, gradient, chi2):
    """Normal equations with priors of every mirror where ``predicted`` and ``slope`` stand."""
    for m in range(begin, end):
        chi2[m] = normal_equations(
            mirrors.z[m], mirrors.weight[m], mirrors.bias_info[m], mirrors.clock_class, predicted[m], slope[m],
            clock[m], info[m], gradient[m],
        )  # fmt: skip
        add_prior(mirrors.prior, m, rot[m], info[m], 0, 6)
        chi2[m] += pull_to_prior(mirrors.prior, m, pivot[m], rot[m], clock[m], gradient[m])


@kernel_rows
def covariance_many(begin, end, scene, mirrors, floor, pivot, rot, clock, cov):
    """Covariance (unknown, unknown) of all unknowns at the given poses; rows that are not determined stay as given."""
    n_receiver, n_transmitter = mirrors.z.shape[2:]
    n = cov.shape[1]
    work, surveyed = work_for(0), np.empty(0)
    for m in range(begin, end):
        predicted = np.empty((1, n_receiver, n_transmitter))
        slope = np.empty((1, n_receiver, n_transmitter, 6))
        info, unused = np.empty((n, n)), np.empty(n)
        predict(scene, scene.common[0], work, mirrors.receiver_mirror[m], pivot[m], rot[m], surveyed, predicted, slope)
        normal_equations(
            mirrors.z[m], mirrors.weight[m], mirrors.bias_info[m], mirrors.clock_class, predicted, slope, clock[m],
            info, unused,
        )  # fmt: skip
        add_prior(mirrors.prior, m, rot[m], info, 0, 6)
        if factor(info, info.shape[0], floor):
            covariance(info, cov[m])


@kernel
def _terms(r, i, q, r0, i0, receiver, transmitter, sign):
    """Signed raw ranges of one difference: (r, i), less receiver q, less the reference (r0, i0); −1 = not taken off."""
    n = 1
    receiver[0], transmitter[0], sign[0] = r, i, 1.0
    if q >= 0:
        receiver[n], transmitter[n], sign[n] = q, i, -1.0
        n += 1
    if i0 >= 0:
        receiver[n], transmitter[n], sign[n] = r0, i0, -1.0
        n += 1
        if q >= 0:
            receiver[n], transmitter[n], sign[n] = q, i0, 1.0
            n += 1
    return n


@kernel_rows
def difference_many(begin, end, seen, out):
    """Differences of ranges whose integers are sought, in cycles, and their covariance; see `Ambiguous`."""
    left, slope, pose_cov, minus, reference = seen.left, seen.slope, seen.pose_cov, seen.minus, seen.reference
    value, cov, row, column, wavelength = out.value, out.cov, out.row, out.column, seen.wavelength
    n_receiver, n_transmitter = left.shape[1:]
    for m in range(begin, end):
        size = n_receiver * n_transmitter
        receivers, transmitters = np.empty((size, 4), np.int64), np.empty((size, 4), np.int64)
        signs, n_term = np.empty((size, 4)), np.empty(size, np.int64)
        slopes, spread = np.empty((size, 6)), np.empty(6)
        n = 0
        for r in range(n_receiver):
            for i in range(n_transmitter):
                q, r0, i0 = minus[m, i], reference[m, r, 0], reference[m, r, 1]
                if r == q or (r == r0 and i == i0) or not math.isfinite(left[m, r, i]):
                    continue
                if i0 >= 0 and q >= 0 and (i == i0 or not math.isfinite(left[m, q, i])):
                    continue
                n_term[n] = _terms(r, i, q, r0, i0, receivers[n], transmitters[n], signs[n])
                total = 0.0
                slopes[n] = 0.0
                for t in range(n_term[n]):
                    total += signs[n, t] * left[m, receivers[n, t], transmitters[n, t]]
                    for a in range(6):
                        slopes[n, a] += signs[n, t] * slope[m, receivers[n, t], transmitters[n, t], a]
                value[m, n] = total / wavelength[i]
                row[m, n], column[m, n] = r, i
                n += 1
        out.n_sought[m] = n
        for j in range(n):
            for a in range(6):
                spread[a] = 0.0
                for b in range(6):
                    spread[a] += pose_cov[m, a, b] * slopes[j, b]
            for k in range(j + 1):
                total = 0.0
                for a in range(6):
                    total += slopes[k, a] * spread[a]
                for s in range(n_term[j]):
                    for t in range(n_term[k]):
                        both = signs[j, s] * signs[k, t]
                        same = receivers[j, s] == receivers[k, t]
                        if same:
                            total += both * seen.clock_m2
                        if transmitters[j, s] == transmitters[k, t]:
                            total += both * seen.common_m2[m, transmitters[j, s]]
                            if same:
                                total += both * seen.own_m2[m, receivers[j, s], transmitters[j, s]]
                cov[m, j, k] = total / (wavelength[column[m, j]] * wavelength[column[m, k]])
                cov[m, k, j] = cov[m, j, k]
