"""Normal equations of rigid mirrors with what is known beforehand, and the dense algebra that solves them: here alone.

Unknowns of one mirror with R receivers: [pivot 3, rotation 3, a clock a receiver and class, parameters shared by all
mirrors]. Observation group g (a tone, or the carrier), receiver r, transmitter i:

    z = range(pivot, rotation, parameters) + clock_{class(g), r} + b_gi + noise,   b_gi ~ N(0, 1/bias_info_gi)

The transmitter's own error b is eliminated: a weighted mean over receivers comes off, all of it without calibration
(bias_info = 0), none of it with a perfect one (infinite). Symmetric matrices are filled in their lower triangle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rfpose.jit import kernel

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


class MirrorPrior(NamedTuple):
    """What is known of mirrors beforehand, as information (1/σ²); mirror is the first axis.

    ``pivot``, ``pivot_info`` (mirror, 3, 3): surveys; ``roll_info`` (mirror,): a mount keeps the x axis horizontal;
    ``clock_own``, ``clock_tie`` (mirror, class, receiver[, receiver]): on clocks and on their differences, about
    ``clock``.
    """

    pivot: Float64
    pivot_info: Float64
    roll_info: Float64
    clock_own: Float64
    clock_tie: Float64
    clock: Float64


class MirrorArrays(NamedTuple):
    """Measurements of many mirrors and what is known of them, as kernels take them; mirror is the first axis.

    ``receiver_mirror`` (mirror, receiver, 3) in the mirror frame; ``z``, ``weight`` (mirror, group, receiver,
    transmitter): ranges and 1/σ², zero where not observed; ``bias_info`` (mirror, group, transmitter): 1/σ² of what
    transmitters are off by; ``clock_class`` (group,); ``frame`` (mirror,): which calibration each shares with others.
    """

    receiver_mirror: Float64
    z: Float64
    weight: Float64
    bias_info: Float64
    clock_class: Int64
    prior: MirrorPrior
    frame: Int64

    def take(self, rows: Int64) -> MirrorArrays:
        """Select mirrors."""
        own = {name: getattr(self, name)[rows] for name in self._fields if name not in ("clock_class", "prior")}
        return self._replace(**own, prior=MirrorPrior(*(array[rows] for array in self.prior)))


@kernel
def normal_equations(z, weight, bias_info, clock_class, predicted, slope, clock, info, gradient):
    """Fill ``info`` and ``gradient`` with all observations of one mirror; return their part of chi².

    ``z``, ``weight`` (group, receiver, transmitter); ``bias_info`` (group, transmitter); ``clock`` (class, receiver).
    ``predicted`` and ``slope`` (…, 6 + parameter) are as ``z``, or have one group for all. Weight zero means not
    observed.
    """
    n_group, n_receiver, n_transmitter = z.shape
    n_more = slope.shape[3] - 6
    more = info.shape[0] - n_more
    info[:] = 0.0
    gradient[:] = 0.0
    row_sum = np.empty(6 + n_more)
    chi2 = 0.0
    for g in range(n_group):
        p = g if slope.shape[0] > 1 else 0
        k = clock_class[g]
        first = 6 + k * n_receiver
        for i in range(n_transmitter):
            total = 0.0
            left_sum = 0.0
            for r in range(n_receiver):
                w = weight[g, r, i]
                if w > 0.0:
                    total += w
                    left_sum += w * (z[g, r, i] - predicted[p, r, i] - clock[k, r])
            if total == 0.0:
                continue
            # the transmitter's own error comes off first: what is left is small, and rounding stays small with it
            scale = 1.0 / (total + bias_info[g, i])
            bias = scale * left_sum
            if bias != 0.0:
                chi2 += bias * bias * bias_info[g, i]
            for a in range(6 + n_more):
                row_sum[a] = 0.0
            for r in range(n_receiver):
                w = weight[g, r, i]
                if w == 0.0:
                    continue
                left = z[g, r, i] - predicted[p, r, i] - clock[k, r] - bias
                c = first + r
                for a in range(6):
                    wa = w * slope[p, r, i, a]
                    for b in range(a + 1):
                        info[a, b] += wa * slope[p, r, i, b]
                    info[c, a] += wa
                    gradient[a] += wa * left
                    row_sum[a] += wa
                info[c, c] += w
                gradient[c] += w * left
                chi2 += w * left * left
                for a in range(n_more):
                    wa = w * slope[p, r, i, 6 + a]
                    for b in range(6):
                        info[more + a, b] += wa * slope[p, r, i, b]
                    info[more + a, c] += wa
                    for b in range(a + 1):
                        info[more + a, more + b] += wa * slope[p, r, i, 6 + b]
                    gradient[more + a] += wa * left
                    row_sum[6 + a] += wa
            if scale == 0.0:
                continue
            for a in range(6):
                sa = scale * row_sum[a]
                for b in range(a + 1):
                    info[a, b] -= sa * row_sum[b]
            for r in range(n_receiver):
                sa = scale * weight[g, r, i]
                for b in range(6):
                    info[first + r, b] -= sa * row_sum[b]
                for b in range(r + 1):
                    info[first + r, first + b] -= sa * weight[g, b, i]
            for a in range(n_more):
                sa = scale * row_sum[6 + a]
                for b in range(6):
                    info[more + a, b] -= sa * row_sum[b]
                for r in range(n_receiver):
                    info[more + a, first + r] -= sa * weight[g, r, i]
                for b in range(a + 1):
                    info[more + a, more + b] -= sa * row_sum[6 + b]
    return chi2


@kernel
def add_prior(prior, m, rot, info, pose, clocks):
    """Add what is known of mirror ``m`` beforehand; its pose stands from ``pose`` on, its clocks from ``clocks``."""
    for a in range(3):
        for b in range(a + 1):
            info[pose + a, pose + b] += prior.pivot_info[m, a, b]
    roll = prior.roll_info[m]
    if roll > 0.0:
        # the mirror's x axis stays horizontal: its z component turns with (theta × x)_z = theta_0 x_1 − theta_1 x_0
        j0, j1 = rot[1, 0], -rot[0, 0]
        info[pose + 3, pose + 3] += roll * j0 * j0
        info[pose + 4, pose + 3] += roll * j0 * j1
        info[pose + 4, pose + 4] += roll * j1 * j1
    own, tie = prior.clock_own[m], prior.clock_tie[m]
    for k in range(own.shape[0]):
        first = clocks + k * own.shape[1]
        for a in range(own.shape[1]):
            info[first + a, first + a] += own[k, a]
            for b in range(a):
                w = tie[k, a, b]
                info[first + a, first + a] += w
                info[first + b, first + b] += w
                info[first + a, first + b] -= w


@kernel
def pull_to_prior(prior, m, pivot, rot, clock, gradient):
    """Add to ``gradient`` how far mirror ``m`` is from what is known of it; return that part of chi²."""
    chi2 = 0.0
    for a in range(3):
        left_a = prior.pivot[m, a] - pivot[a]
        for b in range(3):
            left_b = prior.pivot[m, b] - pivot[b]
            gradient[a] += prior.pivot_info[m, a, b] * left_b
            chi2 += left_a * prior.pivot_info[m, a, b] * left_b
    roll = prior.roll_info[m]
    if roll > 0.0:
        left = -rot[2, 0]
        gradient[3] += roll * rot[1, 0] * left
        gradient[4] -= roll * rot[0, 0] * left
        chi2 += roll * left * left
    own, tie = prior.clock_own[m], prior.clock_tie[m]
    for k in range(own.shape[0]):
        first = 6 + k * own.shape[1]
        for a in range(own.shape[1]):
            left_a = prior.clock[m, k, a] - clock[k, a]
            gradient[first + a] += own[k, a] * left_a
            chi2 += own[k, a] * left_a * left_a
            for b in range(a):
                # between two clocks: as a difference, so that a stiff tie does not drown in rounding
                apart = left_a - (prior.clock[m, k, b] - clock[k, b])
                gradient[first + a] += tie[k, a, b] * apart
                gradient[first + b] -= tie[k, a, b] * apart
                chi2 += tie[k, a, b] * apart * apart
    return chi2


@kernel
def factor(matrix, n, floor):
    """Cholesky of the lower triangle of the first ``n`` rows in place; False where it is singular.

    ``floor`` is the smallest pivot, relative to the diagonal, that still counts as observed.
    """
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
def covariance(lower, out):
    """Covariance of the first unknowns, as many as ``out`` has, all others estimated."""
    n = lower.shape[0]
    x = np.empty(n)
    for a in range(out.shape[0]):
        x[:] = 0.0
        x[a] = 1.0
        solve_factored(lower, x)
        for b in range(out.shape[0]):
            out[a, b] = x[b]


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
