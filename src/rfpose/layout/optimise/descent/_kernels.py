"""Kernels of sequential quadratic programming: the step that a quadratic model asks for, and how much of it is gone.

Every search has its row in each array of `Searches`. Numbers have no unit; the caller scales. Sums over variables or
constraints run along the last axis of what is added, so that they vectorise without being reordered.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rfpose.jit import kernel, kernel_rows

MAX_STEPS = 300
# Ever shorter ways that are tried along a step before it is taken as it is.
MAX_TRIES = 10
# Models that are thrown away because their step leads up, before a search ends.
MAX_RESETS = 20
# Least share that is gained of what the slope promised, and least share of a way that is tried next.
GAINED, SHORTER = 0.1, 0.1
# Least curvature along a step that is learned, as a share of what the model had.
DAMPED = 0.2
# Share of a constraint's slope that those in force may leave before it counts as following from them.
DEPENDENT = 1e-12
# A linear constraint that is missed by less is met.
MISSED = 1e-13
# Curvature of the share of what constraints miss that a step leaves, where it cannot make up for all.
LEAVING = 100.0

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.int64]


class Searches(NamedTuple):
    """Searches over n variables under m constraints ``margin ≥ 0``.

    ``place`` (search, n) where the value is wanted, ``base`` (search, n) where the model stands, ``inverse`` (search,
    n, n) the inverse of its curvature, ``step`` (search, n) the way between them, ``lagrange`` (search, n) the
    Lagrangian's slope at the base, ``multiplier`` and ``penalty`` (search, m). ``level`` (search, 5) is the base's
    value and merit, the merit's promised change, the share of the model's step, and what that makes up for of missed
    constraints; ``tally`` (search, 3) steps, tries
    along the last, models thrown away; ``has_ended`` (search,).
    """

    place: Array
    base: Array
    inverse: Array
    step: Array
    lagrange: Array
    multiplier: Array
    penalty: Array
    level: Array
    tally: Whole
    has_ended: npt.NDArray[np.bool_]


class Force(NamedTuple):
    """Constraints in force.

    ``which`` (n,) they are, whether each of all ``holds`` (m,), their multipliers ``push`` (n,), the inverse curvature
    times their slopes ``turned`` (n, n), the products ``gram`` of both (n, n), its Cholesky ``root`` (n, n).
    """

    which: Whole
    holds: npt.NDArray[np.bool_]
    push: Array
    turned: Array
    gram: Array
    root: Array


@kernel_rows
def advance_rows(begin, end, which, value, slope, margin, by, tolerance, searches):
    """Take what was found at the places of the searches ``which``; set where each looks next, or that it has ended.

    ``value`` (row,), ``slope`` (row, n), ``margin`` (row, m) and its slope ``by`` (row, n, m): row k is search
    which[k].
    """
    for k in range(begin, end):
        i = which[k]
        if searches.tally[i, 0] > 0:
            rise = value[k] + missing(margin[k], searches.penalty[i]) - searches.level[i, 1]
            is_gain = rise <= GAINED * searches.level[i, 2]
            if not is_gain and searches.tally[i, 1] <= MAX_TRIES:
                shorten(i, rise, searches)
                continue
            if has_settled(i, value[k], margin[k], tolerance, searches):
                searches.has_ended[i] = True
                continue
            if is_gain:
                learn(i, slope[k], by[k], searches)
            elif not forget(i, searches):
                continue
        set_out(i, value[k], slope[k], margin[k], by[k], tolerance, searches)


@kernel
def missing(margin, weight):
    """Return the weighed sum of what constraints miss."""
    total = 0.0
    for j in range(margin.shape[0]):
        total += weight[j] * max(-margin[j], 0.0)
    return total


@kernel
def shorten(i, rise, searches):
    """Try less of the step: where a parabola through what is known has its least."""
    promised = searches.level[i, 2]
    share = max(promised / (2.0 * (promised - rise)), SHORTER)
    searches.level[i, 2] *= share
    searches.level[i, 3] *= share
    searches.tally[i, 1] += 1
    for a in range(searches.step.shape[1]):
        searches.step[i, a] *= share
        searches.place[i, a] = searches.base[i, a] + searches.step[i, a]


@kernel
def has_settled(i, value, margin, tolerance, searches):
    """Return whether the constraints are met and value or place no longer change."""
    missed = length2 = 0.0
    for j in range(margin.shape[0]):
        missed += max(-margin[j], 0.0)
    for a in range(searches.step.shape[1]):
        length2 += searches.step[i, a] * searches.step[i, a]
    is_whole = searches.level[i, 4] == 1.0
    is_still = abs(value - searches.level[i, 0]) < tolerance or length2 < tolerance * tolerance
    return is_whole and is_still and missed < tolerance


@kernel
def learn(i, slope, by, searches):
    """Update the inverse curvature by what the step changed of the Lagrangian's slope (BFGS, damped after Powell)."""
    n = slope.shape[0]
    step, inverse, before, multiplier = (
        searches.step[i], searches.inverse[i], searches.lagrange[i], searches.multiplier[i],
    )  # fmt: skip
    change, turned = np.empty(n), np.zeros(n)
    for a in range(n):
        change[a] = slope[a] - before[a]
    for j in range(multiplier.shape[0]):
        if multiplier[j] != 0.0:
            for a in range(n):
                change[a] -= multiplier[j] * by[a, j]
    # the model's own change is its curvature times the step
    found = own = 0.0
    for a in range(n):
        found += step[a] * change[a]
        own -= step[a] * searches.level[i, 3] * before[a]
    if not own > 0.0:
        return
    if found < DAMPED * own:
        share = (1.0 - DAMPED) * own / (own - found)
        for a in range(n):
            change[a] = share * change[a] - (1.0 - share) * searches.level[i, 3] * before[a]
        found = DAMPED * own
    for b in range(n):
        for a in range(n):
            turned[a] += change[b] * inverse[b, a]
    across = 0.0
    for a in range(n):
        across += change[a] * turned[a]
    f = (1.0 + across / found) / found
    for b in range(n):
        x, y = f * step[b] - turned[b] / found, step[b] / found
        for a in range(n):
            inverse[b, a] += x * step[a] - y * turned[a]


@kernel
def set_out(i, value, slope, margin, by, tolerance, searches):
    """Make the place the base and set out along the model's step; or end where that leads nowhere."""
    n, n_constraint = by.shape
    multiplier, penalty, step = searches.multiplier[i], searches.penalty[i], searches.step[i]
    while True:
        searches.tally[i, 0] += 1
        ease = eased_step(searches.inverse[i], slope, margin, by, multiplier, step)
        along = 0.0
        for a in range(n):
            searches.lagrange[i, a] = slope[a]
            along += slope[a] * step[a]
        left, missed = abs(along), 0.0
        for j in range(n_constraint):
            penalty[j] = max(multiplier[j], 0.5 * (penalty[j] + multiplier[j]))
            left += multiplier[j] * abs(margin[j])
            missed += max(-margin[j], 0.0)
            if multiplier[j] != 0.0:
                for a in range(n):
                    searches.lagrange[i, a] -= multiplier[j] * by[a, j]
        lacking = missing(margin, penalty)
        promised = along - ease * lacking
        if searches.tally[i, 0] > MAX_STEPS or (ease == 1.0 and max(left, missed) < tolerance):
            searches.has_ended[i] = True
            return
        if promised < 0.0:
            break
        if not forget(i, searches):
            return
    searches.level[i, 0], searches.level[i, 1] = value, value + lacking
    searches.level[i, 2], searches.level[i, 3], searches.level[i, 4] = promised, 1.0, ease
    searches.tally[i, 1] = 1
    for a in range(n):
        searches.base[i, a] = searches.place[i, a]
        searches.place[i, a] += step[a]


@kernel
def forget(i, searches):
    """Begin the model anew; False where the search ends, since that was done often enough."""
    searches.tally[i, 2] += 1
    searches.has_ended[i] = searches.tally[i, 2] > MAX_RESETS
    n = searches.step.shape[1]
    for a in range(n):
        for b in range(n):
            searches.inverse[i, a, b] = 1.0 if a == b else 0.0
    return not searches.has_ended[i]


@kernel
def eased_step(inverse, slope, margin, by, multiplier, step):
    """Set step and multipliers; return the share that it makes up for of what constraints miss.

    What is left of it is one more variable: none, or where no step makes up for all, between none and one.
    """
    n, n_constraint = by.shape
    wide_inverse, wide_slope, wide_step = np.zeros((n + 1, n + 1)), np.zeros(n + 1), np.zeros(n + 1)
    wide_margin, wide_multiplier = np.zeros(n_constraint + 2), np.zeros(n_constraint + 2)
    wide_by = np.zeros((n + 1, n_constraint + 2))
    wide_inverse[n, n], wide_by[n, n_constraint], wide_by[n, n_constraint + 1] = 1.0 / LEAVING, 1.0, -1.0
    for a in range(n):
        wide_slope[a] = slope[a]
        for b in range(n):
            wide_inverse[a, b] = inverse[a, b]
        for j in range(n_constraint):
            wide_by[a, j] = by[a, j]
    for j in range(n_constraint):
        wide_margin[j], wide_multiplier[j] = margin[j], multiplier[j]
    for leaves in range(2):
        wide_margin[n_constraint + 1] = leaves
        for j in range(n_constraint):
            wide_by[n, j] = leaves * max(-margin[j], 0.0)
        if model_step(wide_inverse, wide_slope, wide_margin, wide_by, wide_multiplier, wide_step):
            for a in range(n):
                step[a] = wide_step[a]
            for j in range(n_constraint):
                multiplier[j] = wide_multiplier[j]
            return 1.0 - wide_step[n]
    for a in range(n):
        step[a] = 0.0
    for j in range(n_constraint):
        multiplier[j] = 0.0
    return 0.0


@kernel
def model_step(inverse, slope, margin, by, multiplier, step):
    """Least ½ stepᵀ inverse⁻¹ step + slope·step where margin + byᵀ step ≥ 0; False where there is no such step.

    By the dual method of Goldfarb and Idnani (Mathematical Programming 27 (1983) 1): from the least without
    constraints, or with those that had a multiplier before, one missed constraint after the other is put in force.
    """
    n, n_constraint = by.shape
    force = Force(
        np.empty(n, np.int64), np.zeros(n_constraint, np.bool_), np.empty(n), np.empty((n, n)), np.empty((n, n)),
        np.empty((n, n)),
    )  # fmt: skip
    n_force = begin_with(inverse, slope, margin, by, multiplier, step, force)
    rest = np.empty(n_constraint)
    multiplier[:] = 0.0
    for _ in range(3 * (n + n_constraint)):
        worst = most_missed(step, margin, by, rest, force)
        if worst < 0:
            break
        n_force = enforce(worst, rest[worst], inverse, by, step, n_force, force)
        if n_force < 0:
            return False
    for k in range(n_force):
        multiplier[force.which[k]] = force.push[k]
    return True


@kernel
def most_missed(step, margin, by, rest, force):
    """Set rest to what is left of margins after a step; return which not in force misses most, -1 where none does."""
    for j in range(rest.shape[0]):
        rest[j] = margin[j]
    for a in range(step.shape[0]):
        for j in range(rest.shape[0]):
            rest[j] += step[a] * by[a, j]
    worst, least = -1, -MISSED
    for j in range(rest.shape[0]):
        if not force.holds[j] and rest[j] < least:
            worst, least = j, rest[j]
    return worst


@kernel
def begin_with(inverse, slope, margin, by, multiplier, step, force):
    """Set step to the least with those in force that had a multiplier, less those that would pull; return how many."""
    n, n_constraint = by.shape
    free, turned = np.zeros(n), np.empty(n)
    for b in range(n):
        for a in range(n):
            free[a] += slope[b] * inverse[b, a]
    n_force = np.int64(0)
    for j in range(n_constraint):
        if multiplier[j] > 0.0 and n_force < n:
            turn(j, inverse, by, turned)
            n_force += put(j, by, turned, n_force, force)
    while n_force > 0:
        for k in range(n_force):
            j = force.which[k]
            force.push[k] = -margin[j]
            for a in range(n):
                force.push[k] += by[a, j] * free[a]
        solve(n_force, force.root, force.push)
        least = np.int64(0)
        for k in range(1, n_force):
            if force.push[k] < force.push[least]:
                least = k
        if force.push[least] >= 0.0:
            break
        n_force = drop(least, n_force, force)
    for a in range(n):
        step[a] = -free[a]
    for k in range(n_force):
        for a in range(n):
            step[a] += force.push[k] * force.turned[k, a]
    return n_force


@kernel
def enforce(new, rest, inverse, by, step, n_force, force):
    """Move the step until the constraint ``new``, which misses ``rest``, is met; return how many are then in force.

    On the way those go whose multiplier would turn negative. -1: it cannot be met with the others.
    """
    n = step.shape[0]
    turned, pull, cross = np.empty(n), np.empty(n), np.empty(n)
    turn(new, inverse, by, turned)
    own = pushed = 0.0
    for a in range(n):
        own += by[a, new] * turned[a]
    while True:
        reach = own
        for k in range(n_force):
            cross[k] = 0.0
            for a in range(n):
                cross[k] += by[a, new] * force.turned[k, a]
            pull[k] = cross[k]
        solve(n_force, force.root, pull)
        least, length = np.int64(-1), np.inf
        for k in range(n_force):
            reach -= cross[k] * pull[k]
            if pull[k] > 0.0 and force.push[k] < length * pull[k]:
                least, length = k, force.push[k] / pull[k]
        is_apart = n_force < n and reach > DEPENDENT * own
        if not is_apart and least < 0:
            return -1
        is_met = is_apart and rest + length * reach >= 0.0
        if is_met:
            length = -rest / reach
        if is_apart:
            rest += length * reach
            for a in range(n):
                step[a] += length * turned[a]
            for k in range(n_force):
                for a in range(n):
                    step[a] -= length * pull[k] * force.turned[k, a]
        for k in range(n_force):
            force.push[k] -= length * pull[k]
        pushed += length
        if is_met:
            force.push[n_force] = pushed
            return n_force + put(new, by, turned, n_force, force)
        n_force = drop(least, n_force, force)


@kernel
def turn(j, inverse, by, turned):
    """Set turned = inverse @ by[:, j]."""
    turned[:] = 0.0
    for b in range(by.shape[0]):
        f = by[b, j]
        if f != 0.0:
            for a in range(turned.shape[0]):
                turned[a] += f * inverse[b, a]


@kernel
def put(j, by, turned, n_force, force):
    """Put constraint j in force; return 1, or 0 where it follows from the others."""
    force.which[n_force] = j
    for a in range(turned.shape[0]):
        force.turned[n_force, a] = turned[a]
    for k in range(n_force + 1):
        s = 0.0
        for a in range(turned.shape[0]):
            s += by[a, force.which[k]] * turned[a]
        force.gram[n_force, k] = s
    if not root_row(n_force, force):
        return 0
    force.holds[j] = True
    return 1


@kernel
def drop(k, n_force, force):
    """Take the k-th constraint out of force; return how many are left."""
    force.holds[force.which[k]] = False
    for i in range(k + 1, n_force):
        force.which[i - 1], force.push[i - 1] = force.which[i], force.push[i]
        for a in range(force.turned.shape[1]):
            force.turned[i - 1, a] = force.turned[i, a]
        for c in range(k):
            force.gram[i - 1, c] = force.gram[i, c]
        for c in range(k + 1, i + 1):
            force.gram[i - 1, c - 1] = force.gram[i, c]
        root_row(i - 1, force)
    return n_force - 1


@kernel
def root_row(k, force):
    """Make row k of the Cholesky root from those above; False where it depends on them."""
    gram, root = force.gram, force.root
    for c in range(k + 1):
        s = gram[k, c]
        for a in range(c):
            s -= root[k, a] * root[c, a]
        if c < k:
            root[k, c] = s / root[c, c]
        elif s > DEPENDENT * gram[k, k]:
            root[k, k] = math.sqrt(s)
        else:
            return False
    return True


@kernel
def solve(n, root, x):
    """Solve root rootᵀ x = x in place, first n."""
    for k in range(n):
        for a in range(k):
            x[k] -= root[k, a] * x[a]
        x[k] /= root[k, k]
    for k in range(n - 1, -1, -1):
        for a in range(k + 1, n):
            x[k] -= root[a, k] * x[a]
        x[k] /= root[k, k]
