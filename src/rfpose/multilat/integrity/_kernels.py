"""Outlier statistics of one mirror after another.

All observations of a transmitter are whitened together: with weights w_r = 1/σ_r² and the transmitter's own error b of
information β, the information of one group is D½ (I − s q qᵀ …) D½; its symmetric square root leaves everything across
q = √(w/Σw) and shrinks what lies along it by √(β / (Σw + β)): to nothing without a calibration. In whitened
coordinates a transmitter's residual e has covariance R = I − Ã P Ãᵀ, a fault v shifts it by R v, and the most likely
fault lowers chi² by eᵀ R⁻¹ e.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rfpose.jit import kernel, kernel_rows
from rfpose.multilat.equations._kernels import add_prior, covariance, factor, normal_equations
from rfpose.multilat.reflection._kernels import work_for
from rfpose.multilat.rigid._kernels import predict


class SolvedMirrors(NamedTuple):
    """What the data alone say of each mirror's unknowns at its pose, and the covariance with all that is known."""

    ok: Any
    data_info: Any
    data_gradient: Any
    cov: Any


class HypothesisTests(NamedTuple):
    """Statistics of hypotheses; as in `rfpose.multilat.integrity.records.Verdict`."""

    stat: Any
    dof: Any
    hidden: Any
    shift: Any
    spread: Any
    common: Any
    common_dof: Any
    link: Any
    link_dof: Any


@kernel
def whiten(z, weight, bias_info, clock_class, distance, slope, clock, i, rows, left, along, shrink):
    """Whitened design ``rows`` (group × receiver, unknown) and residual ``left`` of transmitter ``i``.

    ``along`` (group, receiver) gets q, ``shrink`` (group) the factor along it; returns the degrees of freedom.
    """
    n_group, n_receiver, _ = z.shape
    rows[:] = 0.0
    left[:] = 0.0
    along[:] = 0.0
    shrink[:] = 0.0
    dof = 0
    for g in range(n_group):
        total = 0.0
        for r in range(n_receiver):
            total += weight[g, r, i]
        if total == 0.0:
            continue
        beta = bias_info[g, i]
        if beta > 0.0:
            shrink[g] = 1.0 if math.isinf(beta) else math.sqrt(beta / (total + beta))
        else:
            dof -= 1
        first = g * n_receiver
        for r in range(n_receiver):
            w = weight[g, r, i]
            if w == 0.0:
                continue
            dof += 1
            root = math.sqrt(w)
            along[g, r] = math.sqrt(w / total)
            left[first + r] = root * (z[g, r, i] - distance[r, i] - clock[clock_class[g], r])
            for a in range(6):
                rows[first + r, a] = root * slope[r, i, a]
            rows[first + r, 6 + clock_class[g] * n_receiver + r] = root
        off = 1.0 - shrink[g]
        if off == 0.0:
            continue
        for a in range(rows.shape[1]):
            mean = 0.0
            for r in range(n_receiver):
                mean += along[g, r] * rows[first + r, a]
            for r in range(n_receiver):
                rows[first + r, a] -= off * along[g, r] * mean
        mean = 0.0
        for r in range(n_receiver):
            mean += along[g, r] * left[first + r]
        for r in range(n_receiver):
            left[first + r] -= off * along[g, r] * mean
    return dof


@kernel
def explain(matrix, right, tilt, floor, blind, shift, spread):
    """Most likely fault with information ``matrix`` and gradient ``right``, and what it did to the normal.

    ``tilt`` (2, k) is the normal's shift by a unit fault. Directions without information are skipped. Fills
    ``shift`` (2) and ``spread`` (2, 2), the covariance that leaving the fault free adds to the normal; returns
    (drop of chi², rank, whether a skipped direction tilts the normal by more than ``blind``).
    """
    k = matrix.shape[0]
    x = np.zeros((k, 3))
    shift[:] = 0.0
    spread[:] = 0.0
    stat = 0.0
    rank = 0
    hidden = False
    for j in range(k):
        diagonal = matrix[j, j]
        d = diagonal
        for p in range(j):
            s = matrix[j, p]
            for m in range(p):
                s -= matrix[j, m] * matrix[p, m]
            matrix[j, p] = s / matrix[p, p] if matrix[p, p] > 0.0 else 0.0
            d -= matrix[j, p] * matrix[j, p]
        b, t0, t1 = right[j], tilt[0, j], tilt[1, j]
        for p in range(j):
            b -= matrix[j, p] * x[p, 0]
            t0 -= matrix[j, p] * x[p, 1]
            t1 -= matrix[j, p] * x[p, 2]
        if not d > floor:
            matrix[j, j] = 0.0
            if t0 * t0 + t1 * t1 > blind * blind:
                hidden = True
            continue
        root = math.sqrt(d)
        matrix[j, j] = root
        x[j, 0], x[j, 1], x[j, 2] = b / root, t0 / root, t1 / root
        rank += 1
        stat += x[j, 0] * x[j, 0]
        for a in range(2):
            shift[a] += x[j, 1 + a] * x[j, 0]
            for c in range(2):
                spread[a, c] += x[j, 1 + a] * x[j, 1 + c]
    return stat, rank, hidden


@kernel
def _in_subspace(redundancy, left, basis, floor):
    """Drop of chi² by the most likely fault within ``basis`` (k, column), and its rank."""
    k, n = basis.shape
    matrix = np.zeros((n, n))
    right = np.zeros(n)
    for a in range(n):
        for p in range(k):
            right[a] += basis[p, a] * left[p]
        for c in range(a + 1):
            for p in range(k):
                s = 0.0
                for q in range(k):
                    s += redundancy[p, q] * basis[q, c]
                matrix[a, c] += basis[p, a] * s
    shift = np.empty(2)
    spread = np.empty((2, 2))
    stat, rank, _ = explain(matrix, right, np.zeros((2, n)), floor, np.inf, shift, spread)
    return stat, rank


@kernel
def _judge_one(scene, mirrors, m, floor, pivot, rot, clock, data_info, data_gradient, cov, to):
    """Statistics of all transmitters of mirror ``m``; False where the pose is not determined."""
    z, weight, bias_info, clock_class = mirrors.z[m], mirrors.weight[m], mirrors.bias_info[m], mirrors.clock_class
    stat, dof, hidden, shift, spread = to.stat[m], to.dof[m], to.hidden[m], to.shift[m], to.spread[m]
    common, common_dof, link, link_dof = to.common[m], to.common_dof[m], to.link[m], to.link_dof[m]
    n_group, n_receiver, n_transmitter = z.shape
    n = data_gradient.shape[0]
    k = n_group * n_receiver
    predicted = np.empty((1, n_receiver, n_transmitter))
    slope = np.empty((1, n_receiver, n_transmitter, 6))
    predict(scene, scene.common[0], work_for(0), mirrors.receiver_mirror[m], pivot, rot, np.empty(0), predicted, slope)
    normal_equations(z, weight, bias_info, clock_class, predicted, slope, clock, data_info, data_gradient)
    for a in range(n):
        for b in range(a):
            data_info[b, a] = data_info[a, b]
    lower = data_info.copy()
    add_prior(mirrors.prior, m, rot, lower, 0, 6)
    if not factor(lower, lower.shape[0], 1e-13):
        return False
    covariance(lower, cov)
    rows = np.empty((n_transmitter, k, n))
    left = np.empty((n_transmitter, k))
    along = np.empty((n_transmitter, n_group, n_receiver))
    shrink = np.empty((n_transmitter, n_group))
    for i in range(n_transmitter):
        dof[i] = whiten(
            z, weight, bias_info, clock_class, predicted[0], slope[0], clock, i, rows[i], left[i], along[i], shrink[i]
        )
    # the normal's two tilts: rotation about the mirror's x and y axes
    tilt_variance = 0.0
    turned = np.zeros((2, n))
    for c in range(2):
        for b in range(n):
            for a in range(3):
                turned[c, b] += rot[a, c] * cov[3 + a, b]
        for a in range(3):
            tilt_variance += turned[c, 3 + a] * rot[a, c]
    blind = 1e-5 * math.sqrt(tilt_variance)
    half = np.empty((k, n))
    redundancy = np.empty((k, k))
    scratch = np.empty((k, k))
    tilt = np.empty((2, k))
    basis = np.empty((k, n_group))
    for i in range(n_transmitter):
        for p in range(k):
            for a in range(n):
                s = rows[i, p, a]
                for b in range(a):
                    s -= lower[a, b] * half[p, b]
                half[p, a] = s / lower[a, a]
            for c in range(2):
                s = 0.0
                for a in range(n):
                    s += turned[c, a] * rows[i, p, a]
                tilt[c, p] = s
        for p in range(k):
            for q in range(k):
                s = 1.0 if p == q else 0.0
                for a in range(n):
                    s -= half[p, a] * half[q, a]
                redundancy[p, q] = scratch[p, q] = s
        stat[i], rank, hidden[i] = explain(scratch, left[i], tilt, floor, blind, shift[i], spread[i])
        # rows not observed, and those a free transmitter error takes, count in the rank but hold nothing
        dof[i] -= k - rank
        basis[:] = 0.0
        for g in range(n_group):
            if shrink[i, g] > 0.0:
                for r in range(n_receiver):
                    basis[g * n_receiver + r, g] = along[i, g, r]
        common[i], common_dof[i] = _in_subspace(redundancy, left[i], basis, floor)
        for r in range(n_receiver):
            basis[:] = 0.0
            for g in range(n_group):
                q = along[i, g, r]
                if q > 0.0:
                    for other in range(n_receiver):
                        basis[g * n_receiver + other, g] = -(1.0 - shrink[i, g]) * q * along[i, g, other]
                    basis[g * n_receiver + r, g] += 1.0
            link[r, i], link_dof[r, i] = _in_subspace(redundancy, left[i], basis, floor)
    return True


@kernel_rows
def judge_many(begin, end, scene, mirrors, floor, pivot, rot, clock, solved, tests):
    """`_judge_one` for every mirror."""
    for m in range(begin, end):
        solved.ok[m] = _judge_one(
            scene, mirrors, m, floor, pivot[m], rot[m], clock[m], solved.data_info[m], solved.data_gradient[m],
            solved.cov[m], tests,
        )  # fmt: skip
