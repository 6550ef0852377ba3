"""Integer least squares: decorrelation, success probability, search (LAMBDA).

With Q = Lᵀ D L (L unit lower triangular) the last unknown stands alone and each earlier one is conditioned on those
after it: D holds the conditional variances. Integer Gauss transformations and swaps make them small and alike
(Teunissen 1995; de Jonge and Tiberius 1996), a depth-first search with shrinking radius finds the nearest integer
vectors (Chang, Yang and Zhou 2005).
"""

from __future__ import annotations

import math

import numpy as np

from rfpose.jit import kernel, kernel_rows

# fates of a row; `rfpose.multilat.ambiguity.IntegerStatus` gives them names
OK = 0
NOT_FINITE = 1
NOT_POSITIVE = 2
SEARCH_LIMIT = 3
NONE = 4

# a swap must lower the later variance by more than rounding could
SWAP_GAIN = 1.0 - 1e-6


@kernel
def factor_ltdl(cov, n, lower, variance):
    """Factor cov = Lᵀ D L, from the last unknown to the first; False where it is not positive definite."""
    for i in range(n):
        for j in range(i + 1):
            lower[i, j] = cov[i, j]
    for i in range(n - 1, -1, -1):
        d = lower[i, i]
        if not d > 1e-15 * cov[i, i] or not cov[i, i] > 0.0:
            return False
        variance[i] = d
        for j in range(i + 1):
            lower[i, j] /= d
        for j in range(i):
            scaled = lower[i, j] * d
            for k in range(j + 1):
                lower[j, k] -= scaled * lower[i, k]
    return True


@kernel
def _subtract(i, j, n, lower, value, back):
    """Integer Gauss transformation: unknown j less the nearest multiple of unknown i > j that correlation suggests."""
    mu = np.rint(lower[i, j])
    if mu == 0.0:
        return
    for k in range(i, n):
        lower[k, j] -= mu * lower[k, i]
    value[j] -= mu * value[i]
    for k in range(n):
        back[k, i] += mu * back[k, j]


@kernel
def _swap(j, n, after, lower, variance, value, back):
    """Exchange unknowns j and j + 1; ``after`` is the variance that then stands at j + 1."""
    eta = variance[j] / after
    lam = variance[j + 1] * lower[j + 1, j] / after
    below = lower[j + 1, j]
    variance[j] = eta * variance[j + 1]
    variance[j + 1] = after
    for k in range(j):
        first, second = lower[j, k], lower[j + 1, k]
        lower[j, k] = second - below * first
        lower[j + 1, k] = eta * first + lam * second
    lower[j + 1, j] = lam
    for k in range(j + 2, n):
        lower[k, j], lower[k, j + 1] = lower[k, j + 1], lower[k, j]
    value[j], value[j + 1] = value[j + 1], value[j]
    for k in range(n):
        back[k, j], back[k, j + 1] = back[k, j + 1], back[k, j]


@kernel
def decorrelate(n, lower, variance, value, back):
    """Z-transformation in place; ``back`` becomes the integer matrix that leads from the new unknowns to the old."""
    for i in range(n):
        for j in range(n):
            back[i, j] = 1.0 if i == j else 0.0
    j = n - 2
    while j >= 0:
        _subtract(j + 1, j, n, lower, value, back)
        after = variance[j] + lower[j + 1, j] ** 2 * variance[j + 1]
        if after < SWAP_GAIN * variance[j + 1]:
            _swap(j, n, after, lower, variance, value, back)
            j = min(j + 1, n - 2)
        else:
            for i in range(j + 2, n):
                _subtract(i, j, n, lower, value, back)
            j -= 1


@kernel
def bootstrap_risk(n, variance):
    """Probability that sequential rounding errs anywhere: 1 − Π erf(1/(√8 σ)) (Teunissen 1998).

    An upper bound of the same for integer least squares (Teunissen 1999).
    """
    log_right = 0.0
    for i in range(n):
        wrong = math.erfc(1.0 / math.sqrt(8.0 * variance[i]))
        if wrong >= 1.0:
            return 1.0
        log_right += math.log1p(-wrong)
    return -math.expm1(log_right)


@kernel
def search(n, lower, variance, value, limit, best, norm):
    """Nearest integer vectors to ``value``, nearest first, into ``best`` (candidate, n) and ``norm`` (candidate,).

    Depth first from the last unknown, each level from the nearest integer outwards; a full list shrinks the radius to
    its worst member. Returns how many were found, and whether ``limit`` nodes were enough.
    """
    n_wanted = len(norm)
    found = 0
    radius = np.inf
    centre = np.empty(n)
    z = np.empty(n)
    off = np.empty(n)
    step = np.empty(n)
    above = np.zeros(n)  # squared distance of the levels above
    k = n - 1
    centre[k] = value[k]
    z[k] = np.rint(centre[k])
    off[k] = z[k] - centre[k]
    step[k] = -1.0 if off[k] > 0.0 else 1.0
    for _ in range(limit):
        distance = above[k] + off[k] * off[k] / variance[k]
        if distance < radius:
            if k > 0:
                k -= 1
                above[k] = distance
                c = value[k]
                for j in range(k + 1, n):
                    c += lower[j, k] * off[j]
                centre[k] = c
                z[k] = np.rint(c)
                off[k] = z[k] - c
                step[k] = -1.0 if off[k] > 0.0 else 1.0
                continue
            at = min(found, n_wanted - 1)
            while at > 0 and norm[at - 1] > distance:
                norm[at] = norm[at - 1]
                for j in range(n):
                    best[at, j] = best[at - 1, j]
                at -= 1
            norm[at] = distance
            for j in range(n):
                best[at, j] = z[j]
            found = min(found + 1, n_wanted)
            if found == n_wanted:
                radius = norm[n_wanted - 1]
        else:
            if k == n - 1:
                return found, True
            k += 1
        # the next integer of this level: to and fro about its centre
        z[k] += step[k]
        off[k] = z[k] - centre[k]
        step[k] = -step[k] - (1.0 if step[k] > 0.0 else -1.0)
    return found, False


@kernel
def fix_one(n, value, cov, limit, integers, norm):
    """Integer least squares of one row: (risk, ADOP, candidates, status)."""
    for i in range(n):
        if not math.isfinite(value[i]):
            return 1.0, np.nan, 0, NOT_FINITE
    lower, variance = np.zeros((n, n)), np.empty(n)
    back, z = np.empty((n, n)), value[:n].copy()
    if not factor_ltdl(cov, n, lower, variance):
        return 1.0, np.nan, 0, NOT_POSITIVE
    # large values lose the fraction in sums: only the fraction takes part
    whole = np.rint(z)
    z -= whole
    decorrelate(n, lower, variance, z, back)
    log_sum = 0.0
    for i in range(n):
        log_sum += math.log(variance[i])
    adop = math.exp(0.5 * log_sum / n)
    risk = bootstrap_risk(n, variance)
    best = np.empty((len(norm), n))
    found, complete = search(n, lower, variance, z, limit, best, norm)
    for c in range(found):
        for i in range(n):
            total = whole[i]
            for j in range(n):
                total += back[i, j] * best[c, j]
            integers[c, i] = np.int64(total)
    if not complete:
        return 1.0, adop, found, SEARCH_LIMIT
    return risk, adop, found, OK


@kernel_rows
def fix_many(begin, end, count, value, cov, limit, integers, norm, risk, adop, n_found, status):
    """`fix_one` for every row; row m has ``count[m]`` unknowns, its first ones."""
    for m in range(begin, end):
        if count[m] == 0:
            status[m] = NONE
            continue
        risk[m], adop[m], n_found[m], status[m] = fix_one(count[m], value[m], cov[m], limit, integers[m], norm[m])
