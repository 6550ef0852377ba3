"""Poses from the carriers of a mirror's receivers, with foreseen rays in the model; see ``fit.py`` for the model."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rfpose.jit import kernel, kernel_rows
from rfpose.multilat.equations._kernels import factor

_MAX_STEP_RAD = 0.05
_SETTLED_SIGMAS = 2e-2
_SETTLED_WEIGHT = 5e-2
_ENDED_SIGMAS = 0.2
"""A pose that reweighting still moves by less than this is taken as it is: weights settle slowly, and the phase of a
transmitter that hardly counts may not settle at all."""
_MIN_STEPS = 5
_PATIENT_STEPS = 30
_FREE = 1e-3
"""Information on what nothing is known of, so that equations stay regular: 30 m, 30 rad."""


class SiteArrays(NamedTuple):
    """`SiteObservations`, the strength of each transmitter's direct field (mirror, transmitter), and its crowd.

    The crowd (transmitter,) is how many carriers of one antenna hear the same of what nothing foresees.
    """

    carrier: Any
    sigma: Any
    wavenumber: Any
    unit_field: Any
    crowd: Any


class VoltageArrays(NamedTuple):
    """`Voltages`, ray by ray; ``order`` puts rays of one mirror and ``group`` (factor error) beside each other."""

    first: Any
    link_of: Any
    source: Any
    place: Any
    extra: Any
    voltage: Any
    slope: Any
    soil_slope: Any
    vague: Any
    kind: Any
    order: Any
    group: Any
    amplitude_error: Any
    phase_error: Any
    soil_error: Any
    reference_rot: Any


class SitePrior(NamedTuple):
    """`SiteKnowledge` as information (1/σ²)."""

    pivot: Any
    pivot_info: float
    commanded_rot: Any
    posture_info: Any
    roll_info: float
    clock_info: float


class StrayLaw(NamedTuple):
    """How what nothing foresees is distributed, and when a fit ends."""

    floor: float
    tail: float
    own_scale: float
    max_steps: int


class SiteFits(NamedTuple):
    """What a fit gives, mirror by mirror; ``pivot`` and ``rot`` hold where it begins.

    ``factor`` (mirror, kind, 2) and ``soil`` (mirror, 2, 2): what measurements say of factor errors; of no rows where
    nobody asks.
    """

    pivot: Any
    rot: Any
    cov: Any
    weight: Any
    residual: Any
    sigma: Any
    scale: Any
    total: Any
    dof: Any
    cost: Any
    steps: Any
    factor: Any
    soil: Any


@kernel
def turn(w, out):
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    a = 1.0 - angle**2 / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    b = 0.5 - angle**2 / 24.0 if angle < 1e-4 else (1.0 - np.cos(angle)) / angle**2
    x, y, z = w
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[0, 1] = -a * z + b * x * y
    out[0, 2] = a * y + b * x * z
    out[1, 0] = a * z + b * x * y
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[1, 2] = -a * x + b * y * z
    out[2, 0] = -a * y + b * x * z
    out[2, 1] = a * x + b * y * z
    out[2, 2] = 1.0 - b * (x * x + y * y)


@kernel
def turn_between(rot_to, rot_from, out):
    """Rotation vector that takes one orientation to another: small angles, as they are here."""
    r = rot_to @ rot_from.T
    out[0] = 0.5 * (r[2, 1] - r[1, 2])
    out[1] = 0.5 * (r[0, 2] - r[2, 0])
    out[2] = 0.5 * (r[1, 0] - r[0, 1])
    sine = np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    if sine > 1e-9:
        cosine = 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0)
        out *= np.arctan2(sine, cosine) / sine


@kernel
def forward(lower, n, rhs, n_column):
    """Solve lower · x = rhs in place, column by column together."""
    for i in range(n):
        for k in range(i):
            f = lower[i, k]
            for c in range(n_column):
                rhs[i, c] -= f * rhs[k, c]
        f = 1.0 / lower[i, i]
        for c in range(n_column):
            rhs[i, c] *= f


@kernel
def voltages(begin, end, heard, k_tx, pivot, rot, moved, part, h, slope_h):
    """What each link receives and its slope with the pose (rotation vector, then pivot).

    ``part[k - begin]`` becomes the voltage of ray k. Links are numbered within the mirror.
    """
    source, place, slope, n_tx = heard.source, heard.place, heard.slope, len(k_tx)
    h[:] = 0.0
    slope_h[:] = 0.0
    for k in range(begin, end):
        link = heard.link_of[k]
        wave = k_tx[link % n_tx]
        y0 = rot[0, 0] * place[k, 0] + rot[0, 1] * place[k, 1] + rot[0, 2] * place[k, 2]
        y1 = rot[1, 0] * place[k, 0] + rot[1, 1] * place[k, 1] + rot[1, 2] * place[k, 2]
        y2 = rot[2, 0] * place[k, 0] + rot[2, 1] * place[k, 1] + rot[2, 2] * place[k, 2]
        u0 = source[k, 0] - pivot[0] - y0
        u1 = source[k, 1] - pivot[1] - y1
        u2 = source[k, 2] - pivot[2] - y2
        length = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
        u0, u1, u2 = u0 / length, u1 / length, u2 / length
        phase = wave * (length + heard.extra[k])
        turned = complex(np.cos(phase), -np.sin(phase))
        now = heard.voltage[k] + slope[k, 0] * moved[0] + slope[k, 1] * moved[1] + slope[k, 2] * moved[2]
        v = now * turned
        part[k - begin] = v
        h[link] += v
        g = 1j * wave * v
        slope_h[link, 0] += g * (y1 * u2 - y2 * u1) + slope[k, 0] * turned
        slope_h[link, 1] += g * (y2 * u0 - y0 * u2) + slope[k, 1] * turned
        slope_h[link, 2] += g * (y0 * u1 - y1 * u0) + slope[k, 2] * turned
        slope_h[link, 3] += g * u0
        slope_h[link, 4] += g * u1
        slope_h[link, 5] += g * u2


@kernel
def add_factor_errors(begin, end, heard, part, h, row_of, share, touched, s):
    """Add to the covariance s what rays' uncertain factors do to phases; rays in order, those of a group together."""
    order, group, link_of = heard.order, heard.group, heard.link_of
    k = begin
    while k < end:
        now = group[order[k]]
        n_touched = 0
        first = order[k]
        while k < end and group[order[k]] == now:
            ray = order[k]
            k += 1
            row = row_of[link_of[ray]]
            if now < 0 or row < 0:
                continue
            if share[row] == 0.0:
                touched[n_touched] = row
                n_touched += 1
            share[row] += part[ray - begin] / h[link_of[ray]]
        amp, pha = heard.amplitude_error[first] ** 2, heard.phase_error[first] ** 2
        for i in range(n_touched):
            a = share[touched[i]]
            for j in range(n_touched):
                b = share[touched[j]]
                s[touched[i], touched[j]] += amp * a.imag * b.imag + pha * a.real * b.real
        for i in range(n_touched):
            share[touched[i]] = 0.0


@kernel
def add_soil_errors(begin, end, heard, part, h, row_of, share, n, s):
    """Add to the covariance s what the ground's uncertain permittivity, one for all links, does to phases."""
    soil_error = heard.soil_error
    for k in range(begin, end):
        row = row_of[heard.link_of[k]]
        if row >= 0:
            share[row] += part[k - begin] * heard.soil_slope[k] / h[heard.link_of[k]]
    for i in range(n):
        a = share[i]
        for j in range(n):
            b = share[j]
            s[i, j] += soil_error[0] ** 2 * a.imag * b.imag + soil_error[1] ** 2 * a.real * b.real
    share[:n] = 0.0


@kernel
def whitened_rows(
    begin,
    end,
    heard,
    part,
    h,
    slope_h,
    k_tx,
    row_of,
    link_at,
    residual,
    variance,
    weight,
    heavy,
    share,
    touched,
    n,
    n_clock,
    s,
    lower,
    a,
):
    """Phases by pose, transmitters and clocks, residuals last, whitened; false where their covariance is singular.

    ``heavy`` is how much more variance links have than their weights say.
    """
    n_tx = len(k_tx)
    n_par = 6 + n_tx + n_clock
    s[:n, :n] = 0.0
    for i in range(n):
        link = link_at[i]
        t = link % n_tx
        a[i, :] = 0.0
        for q in range(6):
            a[i, q] = (slope_h[link, q] / h[link]).imag
        a[i, 6 + t] = 1.0
        if n_clock:
            a[i, 6 + n_tx + link // n_tx] = -k_tx[t]
        a[i, n_par] = residual[i]
        s[i, i] = heavy * variance[i] / weight[i]
    add_factor_errors(begin, end, heard, part, h, row_of, share, touched, s)
    add_soil_errors(begin, end, heard, part, h, row_of, share, n, s)
    lower[:n, :n] = s[:n, :n]
    if not factor(lower, n, 0.0):
        return False
    forward(lower, n, a, n_par + 1)
    return True


@kernel
def add_priors(prior, m, pivot, rot, n_tx, n_clock, off, normal, gradient):
    """Add what is known of a mirror before: posture, mount, pivot, clocks."""
    turn_between(prior.commanded_rot[m], rot, off)
    for q in range(3):
        for p in range(3):
            normal[q, p] += prior.posture_info[m, q, p]
            gradient[q, 0] += prior.posture_info[m, q, p] * off[p]
        normal[3 + q, 3 + q] += prior.pivot_info
        gradient[3 + q, 0] += prior.pivot_info * (prior.pivot[m, q] - pivot[q])
    tilt = (rot[1, 0], -rot[0, 0])  # of the x axis out of the horizontal, by a turn about east and north
    for p in range(2):
        gradient[p, 0] -= prior.roll_info * tilt[p] * rot[2, 0]
        for q in range(2):
            normal[p, q] += prior.roll_info * tilt[p] * tilt[q]
    for t in range(n_tx):
        normal[6 + t, 6 + t] += _FREE
    for r in range(n_clock):
        normal[6 + n_tx + r, 6 + n_tx + r] += max(prior.clock_info, _FREE)


@kernel
def invert(lower, n, out):
    """Invert a lower triangle; above its diagonal ``out`` keeps what it had."""
    for i in range(n):
        f = 1.0 / lower[i, i]
        for c in range(i):
            out[i, c] = 0.0
        for k in range(i):
            g = -f * lower[i, k]
            for c in range(k + 1):
                out[i, c] += g * out[k, c]
        out[i, i] = f


@kernel
def square(a, n, n_par, normal, gradient):
    """Normal equations of whitened rows, the right-hand side in the last column."""
    normal[:] = 0.0
    gradient[:] = 0.0
    for i in range(n):
        for p in range(n_par):
            f = a[i, p]
            if f != 0.0:
                for q in range(p + 1):
                    normal[p, q] += f * a[i, q]
                gradient[p, 0] += f * a[i, n_par]
    for p in range(n_par):
        for q in range(p):
            normal[q, p] = normal[p, q]


@kernel
def tell(z_part, n, own, lower, a, n_par, normal_lower, whitened, seen):
    """What measurements say of one standardised factor error: its estimate, and how much of it they tell (0 to 1)."""
    u = 0.0
    for i in range(n):
        u += z_part[i] * own[i]
        x = z_part[i]
        for k in range(i):
            x -= lower[i, k] * whitened[k]
        whitened[i] = x / lower[i, i]
    told = 0.0
    for i in range(n):
        told += whitened[i] ** 2
    for p in range(n_par):
        x = 0.0
        for i in range(n):
            x += a[i, p] * whitened[i]
        for q in range(p):
            x -= normal_lower[p, q] * seen[q]
        seen[p] = x / normal_lower[p, p]
        told -= seen[p] ** 2
    return u, told


@kernel
def tell_factors(
    begin,
    end,
    heard,
    part,
    h,
    row_of,
    share,
    n,
    own,
    lower,
    a,
    n_par,
    normal_lower,
    whitened,
    seen,
    z_part,
    factor,
    soil,
):
    """Sum, by kind of ray, what measurements say of factor errors; and of the ground's permittivity."""
    order, group, kind, link_of = heard.order, heard.group, heard.kind, heard.link_of
    k = begin
    while k < end:
        now = group[order[k]]
        first = order[k]
        share[:n] = 0.0
        while k < end and group[order[k]] == now:
            ray = order[k]
            k += 1
            row = row_of[link_of[ray]]
            if now >= 0 and row >= 0:
                share[row] += part[ray - begin] / h[link_of[ray]]
        if now < 0:
            continue
        for i in range(n):
            z_part[i] = heard.amplitude_error[first] * share[i].imag
        u, told = tell(z_part, n, own, lower, a, n_par, normal_lower, whitened, seen)
        factor[kind[first], 0] += u * u
        factor[kind[first], 1] += told
        for i in range(n):
            z_part[i] = heard.phase_error[first] * share[i].real
        u, told = tell(z_part, n, own, lower, a, n_par, normal_lower, whitened, seen)
        factor[kind[first], 0] += u * u
        factor[kind[first], 1] += told
    share[:n] = 0.0
    for k in range(begin, end):
        row = row_of[link_of[k]]
        if row >= 0:
            share[row] += part[k - begin] * heard.soil_slope[k] / h[link_of[k]]
    for q in range(2):
        for i in range(n):
            z_part[i] = heard.soil_error[q] * (share[i].imag if q == 0 else share[i].real)
        u, told = tell(z_part, n, own, lower, a, n_par, normal_lower, whitened, seen)
        soil[q, 0] = u
        soil[q, 1] = told
    share[:n] = 0.0


@kernel
def wrapped(x):
    """In (−π, π]."""
    return np.pi - np.mod(np.pi - x, 2.0 * np.pi)


@kernel_rows
def fit_mirrors(begin_row, end_row, rows, seen_links, heard, prior, law, out, n_factor):
    """Fit the pose of each mirror; see `fit` for the model."""
    carrier, sigma, k_tx = seen_links.carrier, seen_links.sigma, seen_links.wavenumber
    first, nu = heard.first, law.tail
    n_rx, n_tx = carrier.shape[1], carrier.shape[2]
    n_link = n_rx * n_tx
    n_clock = n_rx if np.isfinite(prior.clock_info) else 0
    n_par = 6 + n_tx + n_clock
    h = np.empty(n_link, np.complex128)
    slope_h = np.empty((n_link, 6), np.complex128)
    row_of = np.empty(n_link, np.int64)
    link_at = np.empty(n_link, np.int64)
    share = np.zeros(n_link, np.complex128)
    touched = np.empty(n_link, np.int64)
    s = np.empty((n_link, n_link))
    lower = np.empty((n_link, n_link))
    a = np.empty((n_link, n_par + 1))
    inverse = np.empty((n_link, n_link))
    size = np.empty(n_link)
    variance = np.empty(n_link)
    weight = np.empty(n_link)
    residual = np.empty(n_link)
    normal = np.empty((n_par, n_par))
    normal_lower = np.empty((n_par, n_par))
    gradient = np.empty((n_par, 1))
    cov, last = np.empty((6, 6)), np.empty((6, 1))
    own = np.empty(n_link)
    part_dof = np.empty(n_link)
    seen = np.empty(n_par)
    step_rot = np.empty((3, 3))
    moved = np.empty(3)
    off = np.empty(3)
    whitened, z_part = np.empty(n_link), np.empty(n_link)
    beta = np.empty(n_tx, np.complex128)
    gain_a, gain_b = np.empty(n_tx), np.empty(n_tx)
    for i_row in range(begin_row, end_row):
        m = rows[i_row]
        begin, end = first[m * n_link], first[(m + 1) * n_link]
        part = np.empty(max(end - begin, 1), np.complex128)
        pivot, rot = out.pivot[m].copy(), out.rot[m].copy()
        out.steps[m] = -1
        # which links are received and foreseen
        turn_between(rot, heard.reference_rot[m], moved)
        voltages(begin, end, heard, k_tx, pivot, rot, moved, part, h, slope_h)
        n = 0
        for link in range(n_link):
            c = carrier[m, link // n_tx, link % n_tx]
            row_of[link] = -1
            if np.isfinite(c.real) and np.isfinite(c.imag) and abs(c) > 0.0 and abs(h[link]) > 0.0:
                row_of[link] = n
                link_at[n] = link
                size[n] = abs(c)
                n += 1
        if n < 6:
            continue
        weight[:n] = 1.0
        scale = 1.0
        failed = False
        n_step = 0
        length = np.inf
        for n_step in range(law.max_steps):
            turn_between(rot, heard.reference_rot[m], moved)
            voltages(begin, end, heard, k_tx, pivot, rot, moved, part, h, slope_h)
            # amplitude of each transmitter, so that the floor is relative to its direct field
            gain_a[:], gain_b[:] = 0.0, 0.0
            for i in range(n):
                t = link_at[i] % n_tx
                gain_a[t] += weight[i] * size[i] * abs(h[link_at[i]])
                gain_b[t] += weight[i] * abs(h[link_at[i]]) ** 2
            if n_step == 0:
                beta[:] = 0.0
            for i in range(n):
                link = link_at[i]
                t = link % n_tx
                r = link // n_tx
                stray = law.floor * gain_a[t] / gain_b[t] * seen_links.unit_field[m, t]
                variance[i] = (sigma[m, r, t] ** 2 + scale * stray**2) / size[i] ** 2
                variance[i] += heard.vague[m * n_link + link] / abs(h[link]) ** 2
                residual[i] = np.angle(carrier[m, r, t]) - np.angle(h[link])
                if n_step == 0:
                    beta[t] += complex(np.cos(residual[i]), np.sin(residual[i])) / variance[i]
            for i in range(n):
                residual[i] = wrapped(residual[i] - np.angle(beta[link_at[i] % n_tx]))
            if not whitened_rows(
                begin, end, heard, part, h, slope_h, k_tx, row_of, link_at, residual, variance, weight, 1.0, share,
                touched, n, n_clock, s, lower, a,
            ):  # fmt: skip
                failed = True
                break
            square(a, n, n_par, normal, gradient)
            add_priors(prior, m, pivot, rot, n_tx, n_clock, off, normal, gradient)
            normal_lower[:] = normal
            if not factor(normal_lower, n_par, 0.0):
                failed = True
                break
            forward(normal_lower, n_par, gradient, 1)
            for p in range(n_par - 1, -1, -1):
                x = gradient[p, 0]
                for q in range(p + 1, n_par):
                    x -= normal_lower[q, p] * gradient[q, 0]
                gradient[p, 0] = x / normal_lower[p, p]
            angle = np.sqrt(gradient[0, 0] ** 2 + gradient[1, 0] ** 2 + gradient[2, 0] ** 2)
            length = 0.0  # of the step, in standard deviations; clocks are solved for anew each time
            for p in range(6 + n_tx):
                for q in range(6 + n_tx):
                    length += gradient[p, 0] * normal[p, q] * gradient[q, 0]
            # a fit that goes to and fro between two poses is brought to rest between them
            shrink = min(1.0 if n_step < _PATIENT_STEPS else 0.5, _MAX_STEP_RAD / max(angle, 1e-300))
            turn(shrink * gradient[:3, 0], step_rot)
            rot = step_rot @ rot
            for q in range(3):
                pivot[q] += shrink * gradient[3 + q, 0]
            for t in range(n_tx):
                beta[t] *= complex(np.cos(gradient[6 + t, 0]), np.sin(gradient[6 + t, 0]))
            # what is left, less what the rays' factors explain: D S⁻¹ (b − A d)
            for i in range(n):
                own[i] = a[i, n_par]
                for p in range(n_par):
                    own[i] -= a[i, p] * gradient[p, 0]
            for i in range(n - 1, -1, -1):
                for k in range(i + 1, n):
                    own[i] -= lower[k, i] * own[k]
                own[i] /= lower[i, i]
            change = 0.0
            total = 0.0
            for i in range(n):
                e = own[i] * variance[i] / weight[i]
                residual[i] = e
                total += weight[i] * e * e / variance[i]
            # degrees of freedom of what is left: trace of D (S⁻¹ − S⁻¹ A N⁻¹ Aᵀ S⁻¹)
            invert(lower, n, inverse)
            dof = 0.0
            for i in range(n):
                d = 0.0
                for k in range(i, n):
                    d += inverse[k, i] ** 2
                part_dof[i] = d * variance[i] / weight[i]
            for i in range(n):
                seen[:] = 0.0
                for k in range(i, n):
                    f = inverse[k, i]
                    for p in range(n_par):
                        seen[p] += f * a[k, p]
                for p in range(n_par):
                    x = seen[p]
                    for q in range(p):
                        x -= normal_lower[p, q] * seen[q]
                    seen[p] = x / normal_lower[p, p]
                    part_dof[i] -= seen[p] ** 2 * variance[i] / weight[i]
                dof += part_dof[i]
            for i in range(n):
                # of e²'s expectation: what is left may be anywhere within what the others leave open
                open_part = max(1.0 - part_dof[i], 0.0) / weight[i]
                new = (nu + 1.0) / (nu + residual[i] ** 2 / variance[i] + open_part)
                change = max(change, abs(new - weight[i]))
                if n_step + 1 < law.max_steps:  # one step alone is a forecast: links count what they do on average
                    weight[i] = 0.5 * (weight[i] + new)
            if law.own_scale > 0.0 and n_step >= 2:
                new_scale = (law.own_scale + scale * total) / (law.own_scale + max(dof, 0.0))
                change = max(change, abs(np.log(new_scale / scale)))
                scale = np.sqrt(scale * new_scale)
            if n_step >= _MIN_STEPS and length < _SETTLED_SIGMAS**2 and change < _SETTLED_WEIGHT:
                break
        if failed:
            continue
        if n_factor:
            out.factor[m] = 0.0
            tell_factors(
                begin, end, heard, part, h, row_of, share, n, own, lower, a, n_par, normal_lower, whitened, seen,
                z_part, out.factor[m], out.soil[m],
            )  # fmt: skip
        cost = 0.0
        for i in range(n):
            cost += (nu + 1.0) * np.log1p(residual[i] ** 2 / (nu * variance[i])) + np.log(variance[i])
        # of the rays' factors: vᵀ (S − D) v with v = S⁻¹ r
        quadratic = 0.0
        for i in range(n):
            left = a[i, n_par]
            for p in range(n_par):
                left -= a[i, p] * gradient[p, 0]
            quadratic += left * left
            quadratic -= residual[i] * own[i]
        cost += quadratic
        turn_between(prior.commanded_rot[m], rot, off)
        for q in range(3):
            for p in range(3):
                cost += off[q] * prior.posture_info[m, q, p] * off[p]
            cost += prior.pivot_info * (prior.pivot[m, q] - pivot[q]) ** 2
        out.cost[m] = cost
        out.pivot[m], out.rot[m] = pivot, rot
        out.scale[m] = scale
        out.total[m] = scale * total
        out.dof[m] = dof
        for q in range(6):
            last[q, 0] = gradient[q, 0]
        # expected information of Student's t (Lange et al., section 4), of what has that distribution; and what nothing
        # foresees is one witness where several carriers hear the same of it
        for i in range(n):
            link = link_at[i]
            r, t = link // n_tx, link % n_tx
            stray = (
                variance[i] - sigma[m, r, t] ** 2 / size[i] ** 2 - heard.vague[m * n_link + link] / abs(h[link]) ** 2
            )
            out.sigma[m, r, t] = np.sqrt(variance[i])
            variance[i] += (seen_links.crowd[t] - 1.0) * max(stray, 0.0)
        whitened_rows(
            begin, end, heard, part, h, slope_h, k_tx, row_of, link_at, residual, variance, weight,
            (nu + 3.0) / (nu + 1.0), share, touched, n, n_clock, s, lower, a,
        )  # fmt: skip
        square(a, n, n_par, normal, gradient)
        add_priors(prior, m, pivot, rot, n_tx, n_clock, off, normal, gradient)
        normal_lower[:] = normal
        factor(normal_lower, n_par, 0.0)
        for p in range(6):
            gradient[:, 0] = 0.0
            gradient[p, 0] = 1.0
            forward(normal_lower, n_par, gradient, 1)
            for q in range(n_par - 1, -1, -1):
                x = gradient[q, 0]
                for k in range(q + 1, n_par):
                    x -= normal_lower[k, q] * gradient[k, 0]
                gradient[q, 0] = x / normal_lower[q, q]
            for q in range(6):
                out.cov[m, q, p] = gradient[q, 0]
        cov[:] = out.cov[m]
        factor(cov, 6, 0.0)
        forward(cov, 6, last, 1)
        length = 0.0
        for q in range(6):
            length += last[q, 0] ** 2
        out.steps[m] = n_step if length < _ENDED_SIGMAS**2 else law.max_steps
        for i in range(n):
            r, t = link_at[i] // n_tx, link_at[i] % n_tx
            out.weight[m, r, t] = weight[i]
            out.residual[m, r, t] = residual[i]
