"""Normal equations of one rigid mirror, and Gauss-Newton over many.

Unknowns of one mirror with R receivers: [pivot 3, rotation 3, clock R, carrier clock R]. Observation group g (a
tone, or the carrier), receiver r, transmitter i:

    z = |pivot + rot m_r − T_i| + clock_{class(g), r} + b_gi + noise,   b_gi ~ N(0, 1/bias_info_gi)

The transmitter's own error b is eliminated: a weighted mean over receivers comes off, all of it without calibration
(bias_info = 0), none of it with a perfect one (infinite).
"""

from __future__ import annotations

import math

import numpy as np

from rfpose.jit import kernel, kernel_rows
from rfpose.multilat.status import PoseStatus

SOLVED, OPEN, STUCK = int(PoseStatus.OK), int(PoseStatus.UNDETERMINED), int(PoseStatus.NOT_CONVERGED)


@kernel
def rotate(theta, rot, out):
    """Left-multiply by the rotation vector ``theta``: out = exp([theta]×) rot (Rodrigues)."""
    angle2 = theta[0] * theta[0] + theta[1] * theta[1] + theta[2] * theta[2]
    angle = math.sqrt(angle2)
    if angle > 1e-8:
        a = math.sin(angle) / angle
        b = (1.0 - math.cos(angle)) / angle2
    else:
        a = 1.0 - angle2 / 6.0
        b = 0.5 - angle2 / 24.0
    for c in range(3):
        x, y, z = rot[0, c], rot[1, c], rot[2, c]
        cx = theta[1] * z - theta[2] * y
        cy = theta[2] * x - theta[0] * z
        cz = theta[0] * y - theta[1] * x
        out[0, c] = x + a * cx + b * (theta[1] * cz - theta[2] * cy)
        out[1, c] = y + a * cy + b * (theta[2] * cx - theta[0] * cz)
        out[2, c] = z + a * cz + b * (theta[0] * cy - theta[1] * cx)


@kernel
def ranges_and_slopes(transmitter, receiver_mirror, pivot, rot, distance, slope):
    """Distances (receiver, transmitter) and their derivative by [pivot, rotation] (receiver, transmitter, 6)."""
    for r in range(receiver_mirror.shape[0]):
        ax = rot[0, 0] * receiver_mirror[r, 0] + rot[0, 1] * receiver_mirror[r, 1] + rot[0, 2] * receiver_mirror[r, 2]
        ay = rot[1, 0] * receiver_mirror[r, 0] + rot[1, 1] * receiver_mirror[r, 1] + rot[1, 2] * receiver_mirror[r, 2]
        az = rot[2, 0] * receiver_mirror[r, 0] + rot[2, 1] * receiver_mirror[r, 1] + rot[2, 2] * receiver_mirror[r, 2]
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
def normal_equations(z, weight, bias_info, clock_class, distance, slope, clock, info, gradient):
    """Add all observations to ``info`` and ``gradient``; return their part of chi².

    ``z``, ``weight`` (group, receiver, transmitter); ``bias_info`` (group, transmitter); ``clock`` (class, receiver).
    Weight zero means not observed.
    """
    n_group, n_receiver, n_transmitter = z.shape
    n = info.shape[0]
    row_sum = np.empty(n)
    chi2 = 0.0
    for g in range(n_group):
        first_clock = 6 + clock_class[g] * n_receiver
        for i in range(n_transmitter):
            row_sum[:] = 0.0
            total = 0.0
            left_sum = 0.0
            for r in range(n_receiver):
                w = weight[g, r, i]
                if w > 0.0:
                    total += w
                    left_sum += w * (z[g, r, i] - distance[r, i] - clock[clock_class[g], r])
            if total == 0.0:
                continue
            # the transmitter's own error comes off first: what is left is small, and rounding stays small with it
            scale = 1.0 / (total + bias_info[g, i])
            bias = scale * left_sum
            if bias != 0.0:
                chi2 += bias * bias * bias_info[g, i]
            for r in range(n_receiver):
                w = weight[g, r, i]
                if w == 0.0:
                    continue
                left = z[g, r, i] - distance[r, i] - clock[clock_class[g], r] - bias
                c = first_clock + r
                for a in range(6):
                    wa = w * slope[r, i, a]
                    for b in range(a + 1):
                        info[a, b] += wa * slope[r, i, b]
                    info[c, a] += wa
                    gradient[a] += wa * left
                    row_sum[a] += wa
                info[c, c] += w
                gradient[c] += w * left
                row_sum[c] += w
                chi2 += w * left * left
            for a in range(n):
                if row_sum[a] != 0.0:
                    sa = scale * row_sum[a]
                    for b in range(a + 1):
                        info[a, b] -= sa * row_sum[b]
    return chi2


@kernel
def add_priors(
    pivot, rot, clock, pivot_prior, pivot_info, roll_info, clock_own, clock_tie, clock_prior, info, gradient
):
    """Add what is known beforehand: pivot (3×3), horizontal x axis of the mount, clocks and their differences."""
    chi2 = 0.0
    for a in range(3):
        left_a = pivot_prior[a] - pivot[a]
        for b in range(3):
            if b <= a:
                info[a, b] += pivot_info[a, b]
            left_b = pivot_prior[b] - pivot[b]
            gradient[a] += pivot_info[a, b] * left_b
            chi2 += left_a * pivot_info[a, b] * left_b
    if roll_info > 0.0:
        # the mirror's x axis stays horizontal: its z component turns with (theta × x)_z = theta_0 x_1 − theta_1 x_0
        j0, j1, left = rot[1, 0], -rot[0, 0], -rot[2, 0]
        info[3, 3] += roll_info * j0 * j0
        info[4, 3] += roll_info * j0 * j1
        info[4, 4] += roll_info * j1 * j1
        gradient[3] += roll_info * j0 * left
        gradient[4] += roll_info * j1 * left
        chi2 += roll_info * left * left
    n_class, n_receiver = clock.shape
    for k in range(n_class):
        first = 6 + k * n_receiver
        for a in range(n_receiver):
            left_a = clock_prior[k, a] - clock[k, a]
            info[first + a, first + a] += clock_own[k, a]
            gradient[first + a] += clock_own[k, a] * left_a
            chi2 += clock_own[k, a] * left_a * left_a
            for b in range(a):
                # between two clocks: as a difference, so that a stiff tie does not drown in rounding
                w = clock_tie[k, a, b]
                apart = left_a - (clock_prior[k, b] - clock[k, b])
                info[first + a, first + a] += w
                info[first + b, first + b] += w
                info[first + a, first + b] -= w
                gradient[first + a] += w * apart
                gradient[first + b] -= w * apart
                chi2 += w * apart * apart
    return chi2


@kernel
def factor(matrix, floor):
    """Cholesky of the lower triangle in place, unknowns scaled to unit diagonal first; False where it is singular.

    ``floor`` is the smallest pivot, relative to the diagonal, that still counts as observed.
    """
    n = matrix.shape[0]
    for j in range(n):
        diagonal = matrix[j, j]
        d = diagonal
        for k in range(j):
            d -= matrix[j, k] * matrix[j, k]
        if not d > floor * diagonal or not diagonal > 0.0:
            return False
        root = math.sqrt(d)
        matrix[j, j] = root
        for i in range(j + 1, n):
            s = matrix[i, j]
            for k in range(j):
                s -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = s / root
    return True


@kernel
def solve_factored(lower, x):
    """Solve L Lᵀ x = b in place."""
    n = lower.shape[0]
    for i in range(n):
        s = x[i]
        for k in range(i):
            s -= lower[i, k] * x[k]
        x[i] = s / lower[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= lower[k, i] * x[k]
        x[i] = s / lower[i, i]


@kernel
def pose_covariance(lower, out):
    """Covariance (6, 6) of pivot and rotation, all other unknowns estimated."""
    n = lower.shape[0]
    x = np.empty(n)
    for a in range(6):
        x[:] = 0.0
        x[a] = 1.0
        solve_factored(lower, x)
        for b in range(6):
            out[a, b] = x[b]


@kernel
def _solve_one(
    transmitter,
    receiver_mirror,
    z,
    weight,
    bias_info,
    clock_class,
    pivot_prior,
    pivot_info,
    roll_info,
    clock_own,
    clock_tie,
    clock_prior,
    max_iteration,
    floor,
    pivot,
    rot,
    clock,
    cov,
):
    """Gauss-Newton with step halving from ``pivot, rot, clock``, which it changes; (chi², iterations, status)."""
    n_class, n_receiver = clock.shape
    n_transmitter = transmitter.shape[0]
    n = 6 + n_class * n_receiver
    distance = np.empty((n_receiver, n_transmitter))
    slope = np.empty((n_receiver, n_transmitter, 6))
    info = np.empty((n, n))
    step = np.empty(n)
    old_pivot, old_rot, old_clock = pivot.copy(), rot.copy(), clock.copy()
    chi2_before = np.inf
    shrink = 1.0
    status = STUCK
    chi2 = np.nan
    used = 0
    for iteration in range(max_iteration):
        used = iteration + 1
        ranges_and_slopes(transmitter, receiver_mirror, pivot, rot, distance, slope)
        info[:] = 0.0
        gradient = np.zeros(n)
        chi2 = normal_equations(z, weight, bias_info, clock_class, distance, slope, clock, info, gradient)
        chi2 += add_priors(
            pivot, rot, clock, pivot_prior, pivot_info, roll_info, clock_own, clock_tie, clock_prior, info, gradient
        )
        if not math.isfinite(chi2):
            return chi2, used, STUCK
        if chi2 > chi2_before * (1.0 + 1e-9) + 1e-6 and shrink > 1e-3:
            # too long a step: halve it from where it began
            shrink *= 0.5
            for a in range(3):
                pivot[a] = old_pivot[a] + shrink * step[a]
            rotate(shrink * step[3:6], old_rot, rot)
            for k in range(n_class):
                for r in range(n_receiver):
                    clock[k, r] = old_clock[k, r] + shrink * step[6 + k * n_receiver + r]
            continue
        if not factor(info, floor):
            return chi2, used, OPEN
        for a in range(n):
            step[a] = gradient[a]
        solve_factored(info, step)
        decrement = 0.0
        for a in range(n):
            decrement += step[a] * gradient[a]
        shrink = 1.0
        turn = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
        if turn > 0.5:
            shrink = 0.5 / turn
        chi2_before = chi2
        old_pivot[:] = pivot
        old_rot[:] = rot
        old_clock[:] = clock
        for a in range(3):
            pivot[a] += shrink * step[a]
        rotate(shrink * step[3:6], old_rot, rot)
        for k in range(n_class):
            for r in range(n_receiver):
                clock[k, r] += shrink * step[6 + k * n_receiver + r]
        # the step promises less than a thousandth of a sigma
        if decrement < 1e-6 and shrink == 1.0:
            status = SOLVED
            chi2 -= decrement
            pose_covariance(info, cov)
            break
    return chi2, used, status


@kernel_rows
def solve_many(
    begin,
    end,
    transmitter,
    receiver_mirror,
    z,
    weight,
    bias_info,
    clock_class,
    pivot_prior,
    pivot_info,
    roll_info,
    clock_own,
    clock_tie,
    clock_prior,
    max_iteration,
    floor,
    pivot,
    rot,
    clock,
    cov,
    chi2,
    n_iteration,
    status,
):
    """`_solve_one` for every mirror: first axis of all arrays but transmitter and clock_class."""
    for m in range(begin, end):
        if status[m] != SOLVED:
            continue
        chi2[m], n_iteration[m], status[m] = _solve_one(
            transmitter,
            receiver_mirror[m],
            z[m],
            weight[m],
            bias_info[m],
            clock_class,
            pivot_prior[m],
            pivot_info[m],
            roll_info,
            clock_own[m],
            clock_tie[m],
            clock_prior[m],
            max_iteration,
            floor,
            pivot[m],
            rot[m],
            clock[m],
            cov[m],
        )


@kernel_rows
def covariance_many(
    begin,
    end,
    transmitter,
    receiver_mirror,
    weight,
    bias_info,
    clock_class,
    pivot_info,
    roll_info,
    clock_own,
    clock_tie,
    floor,
    pivot,
    rot,
    cov,
):
    """Covariance (unknown, unknown) of all unknowns at the given poses; rows that are not determined stay as given."""
    n_receiver = receiver_mirror.shape[1]
    n_class = clock_own.shape[1]
    n = 6 + n_class * n_receiver
    for m in range(begin, end):
        distance = np.empty((n_receiver, transmitter.shape[0]))
        slope = np.empty((n_receiver, transmitter.shape[0], 6))
        info = np.zeros((n, n))
        unused = np.zeros(n)
        clock = np.zeros((n_class, n_receiver))
        ranges_and_slopes(transmitter, receiver_mirror[m], pivot[m], rot[m], distance, slope)
        normal_equations(weight[m], weight[m], bias_info[m], clock_class, distance, slope, clock, info, unused)
        add_priors(
            pivot[m],
            rot[m],
            clock,
            pivot[m],
            pivot_info[m],
            roll_info,
            clock_own[m],
            clock_tie[m],
            clock,
            info,
            unused,
        )
        if factor(info, floor):
            for a in range(n):
                column = np.zeros(n)
                column[a] = 1.0
                solve_factored(info, column)
                cov[m, a] = column
