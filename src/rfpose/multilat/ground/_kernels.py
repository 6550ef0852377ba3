"""Rigid mirrors seen over direct and reflected rays: corrections of ranges, normal equations, Gauss-Newton.

A line of wavenumber k arrives with amplitude e^{-jkd} w(k),

    w(k) = 1 + Σ_p G_p A_p e^{-jkΔ_p},   A_p = (d/d'_p) Γ_p(grazing angle),   Δ_p = d'_p − d,

d' the distance of the image in plane p. With k of the carrier and κ of the tone the demodulated tone is
h ∝ e^{-jκd} [w(k+κ) w(k)* + w(k−κ)* w(k)], so that ranges read off the phases are d + shift with

    tone: shift = −arg[w(k+κ) w(k)* + w(k−κ)* w(k)] / κ,      carrier: shift = −arg w(k) / k.

Unknowns of one mirror: [pivot 3, rotation 3, clocks]; those shared by all mirrors, [Re G, Im G] of each estimated
coefficient, come last and are left over as a Schur complement.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rfpose.jit import kernel, kernel_rows
from rfpose.multilat.rigid._kernels import OPEN, SOLVED, STUCK, add_priors, factor, rotate, solve_factored

Float64 = npt.NDArray[np.float64]
Complex128 = npt.NDArray[np.complex128]
Int64 = npt.NDArray[np.int64]


class Scene(NamedTuple):
    """What all mirrors have in common.

    ``image`` (plane, transmitter, 3) and ``normal`` (plane, 3); ``tone_k`` (group,) is zero for the carrier;
    ``kind`` (plane,) 0 = coefficient only, 1 = vertical, 2 = horizontal polarisation; ``permittivity`` (plane,
    transmitter); ``column`` (plane,) gives a coefficient's first parameter, −1 = known; ``common`` (frame, transmitter,
    group, 1 + parameter) is what calibration receivers' phases carry of it, as range and its derivatives.
    """

    transmitter: Float64
    image: Float64
    normal: Float64
    carrier_k: Float64
    tone_k: Float64
    kind: Int64
    permittivity: Complex128
    spreads: bool
    coefficient: Complex128
    column: Int64
    common: Float64


class Mirrors(NamedTuple):
    """Measurements and knowledge of many mirrors, as in the rigid body's kernels; mirror is the first axis.

    ``frame`` (mirror,) is each one's row of the scene's ``common``.
    """

    receiver_mirror: Float64
    z: Float64
    weight: Float64
    bias_info: Float64
    clock_class: Int64
    pivot_prior: Float64
    pivot_info: Float64
    roll_info: float
    clock_own: Float64
    clock_tie: Float64
    clock_prior: Float64
    frame: Int64


class Work(NamedTuple):
    """Room for `shift_at`."""

    strength: Complex128
    strength_slope: Complex128
    detour: Float64
    detour_slope: Float64
    line: Complex128
    w_slope: Complex128
    direction: Float64


@kernel
def _work(n_plane):
    return Work(
        np.empty(n_plane, np.complex128),
        np.empty((n_plane, 3), np.complex128),
        np.empty(n_plane),
        np.empty((n_plane, 3)),
        np.empty((6, n_plane), np.complex128),
        np.empty((3, 3), np.complex128),
        np.empty((2, 3)),
    )


@kernel
def _line(k, phasor, strength, strength_slope, detour_slope, coefficient, w_slope, per_coefficient):
    """w(k); its derivative by the receiver's place (3,) and by each coefficient (plane,)."""
    w = 1.0 + 0.0j
    w_slope[:] = 0.0
    for p in range(phasor.shape[0]):
        e = strength[p] * phasor[p]
        per_coefficient[p] = e
        w += coefficient[p] * e
        gk = coefficient[p] * phasor[p]
        gek = coefficient[p] * e * (1j * k)
        for a in range(3):
            w_slope[a] += gk * strength_slope[p, a] - gek * detour_slope[p, a]
    return w


@kernel
def _fresnel(kind, permittivity, sine):
    """Reflection coefficient and its derivative by the sine of the grazing angle; 1 = vertical, 2 = horizontal."""
    q = np.sqrt(permittivity - 1.0 + sine * sine)
    q_slope = sine / q
    if kind == 1:
        down = permittivity * sine + q
        return (permittivity * sine - q) / down, 2.0 * permittivity * (q - sine * q_slope) / (down * down)
    down = sine + q
    return (sine - q) / down, 2.0 * (q - sine * q_slope) / (down * down)


@kernel
def shift_at(scene, work, x, y, z, i, out):
    """Fill ``out`` (group, 1 + 3 + parameter): shift, its derivative by the place, by the estimated coefficients."""
    transmitter, image, normal, tone_k, coefficient = (
        scene.transmitter,
        scene.image,
        scene.normal,
        scene.tone_k,
        scene.coefficient,
    )
    n_plane = image.shape[0]
    strength, strength_slope, detour, detour_slope = (
        work.strength,
        work.strength_slope,
        work.detour,
        work.detour_slope,
    )
    carrier_phasor, phasor, phasor_lower = work.line[0], work.line[1], work.line[2]
    ec, eu, el = work.line[3], work.line[4], work.line[5]
    wc_slope, wu_slope, wl_slope = work.w_slope[0], work.w_slope[1], work.w_slope[2]
    u, v = work.direction[0], work.direction[1]
    u[0], u[1], u[2] = x - transmitter[i, 0], y - transmitter[i, 1], z - transmitter[i, 2]
    d = math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    for a in range(3):
        u[a] /= d
    k = scene.carrier_k[i]
    for p in range(n_plane):
        v[0], v[1], v[2] = x - image[p, i, 0], y - image[p, i, 1], z - image[p, i, 2]
        d_image = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        sine = 0.0
        for a in range(3):
            v[a] /= d_image
            sine += v[a] * normal[p, a]
        ratio = d / d_image if scene.spreads else 1.0
        gamma, gamma_slope = 1.0 + 0.0j, 0.0j
        if scene.kind[p] != 0:
            gamma, gamma_slope = _fresnel(scene.kind[p], scene.permittivity[p, i], sine)
        strength[p] = ratio * gamma
        detour[p] = d_image - d
        for a in range(3):
            ratio_slope = ratio * (u[a] / d - v[a] / d_image) if scene.spreads else 0.0
            sine_slope = (normal[p, a] - sine * v[a]) / d_image
            strength_slope[p, a] = ratio_slope * gamma + ratio * gamma_slope * sine_slope
            detour_slope[p, a] = v[a] - u[a]
        turn = k * detour[p]
        carrier_phasor[p] = complex(math.cos(turn), -math.sin(turn))
    wc = _line(k, carrier_phasor, strength, strength_slope, detour_slope, coefficient, wc_slope, ec)
    for g in range(tone_k.shape[0]):
        kappa = tone_k[g]
        if kappa == 0.0:
            h = wc
        else:
            for p in range(n_plane):
                turn = kappa * detour[p]
                half = complex(math.cos(turn), -math.sin(turn))
                phasor[p] = carrier_phasor[p] * half
                phasor_lower[p] = carrier_phasor[p] * np.conj(half)
            wu = _line(k + kappa, phasor, strength, strength_slope, detour_slope, coefficient, wu_slope, eu)
            wl = _line(k - kappa, phasor_lower, strength, strength_slope, detour_slope, coefficient, wl_slope, el)
            h = wu * np.conj(wc) + np.conj(wl) * wc
        wave = k if kappa == 0.0 else kappa
        out[g, 0] = -math.atan2(h.imag, h.real) / wave
        # d arg h = Im(dh / h)
        scale = np.conj(h) / (-wave * (h.real * h.real + h.imag * h.imag))
        for a in range(3):
            if kappa == 0.0:
                dh = wc_slope[a]
            else:
                dh = wu_slope[a] * np.conj(wc) + wu * np.conj(wc_slope[a])
                dh += np.conj(wl_slope[a]) * wc + np.conj(wl) * wc_slope[a]
            out[g, 1 + a] = (dh * scale).imag
        for p in range(n_plane):
            c = scene.column[p]
            if c < 0:
                continue
            if kappa == 0.0:
                even, odd = ec[p], 0.0j
            else:
                even = eu[p] * np.conj(wc) + np.conj(wl) * ec[p]
                odd = wu * np.conj(ec[p]) + np.conj(el[p]) * wc
            out[g, 4 + c] = ((even + odd) * scale).imag
            out[g, 5 + c] = (1j * (even - odd) * scale).imag


@kernel_rows
def shifts_at_points(begin, end, scene, point, out):
    """`shift_at` for points (point, 3): ``out`` (point, transmitter, group, 4 + parameter)."""
    for m in range(begin, end):
        work = _work(scene.image.shape[0])
        for i in range(out.shape[1]):
            shift_at(scene, work, point[m, 0], point[m, 1], point[m, 2], i, out[m, i])


@kernel
def predict(scene, common, work, receiver_mirror, pivot, rot, predicted, slope):
    """Ranges (group, receiver, transmitter) and derivatives (…, 6 + parameter), less what the calibration carries."""
    transmitter = scene.transmitter
    n_group = scene.tone_k.shape[0]
    n_parameter = slope.shape[3] - 6
    shift = np.zeros((n_group, 4 + n_parameter))
    for r in range(receiver_mirror.shape[0]):
        ax = rot[0, 0] * receiver_mirror[r, 0] + rot[0, 1] * receiver_mirror[r, 1] + rot[0, 2] * receiver_mirror[r, 2]
        ay = rot[1, 0] * receiver_mirror[r, 0] + rot[1, 1] * receiver_mirror[r, 1] + rot[1, 2] * receiver_mirror[r, 2]
        az = rot[2, 0] * receiver_mirror[r, 0] + rot[2, 1] * receiver_mirror[r, 1] + rot[2, 2] * receiver_mirror[r, 2]
        x, y, z = pivot[0] + ax, pivot[1] + ay, pivot[2] + az
        for i in range(transmitter.shape[0]):
            if scene.image.shape[0] > 0:
                shift_at(scene, work, x, y, z, i, shift)
            dx, dy, dz = x - transmitter[i, 0], y - transmitter[i, 1], z - transmitter[i, 2]
            d = math.sqrt(dx * dx + dy * dy + dz * dz)
            for g in range(n_group):
                predicted[g, r, i] = d + shift[g, 0] - common[i, g, 0]
                sx, sy, sz = dx / d + shift[g, 1], dy / d + shift[g, 2], dz / d + shift[g, 3]
                slope[g, r, i, 0] = sx
                slope[g, r, i, 1] = sy
                slope[g, r, i, 2] = sz
                slope[g, r, i, 3] = ay * sz - az * sy
                slope[g, r, i, 4] = az * sx - ax * sz
                slope[g, r, i, 5] = ax * sy - ay * sx
                for c in range(n_parameter):
                    slope[g, r, i, 6 + c] = shift[g, 4 + c] - common[i, g, 1 + c]


@kernel
def normal_equations(z, weight, bias_info, clock_class, predicted, slope, clock, info, gradient):
    """Fill ``info`` and ``gradient`` with all observations; return their part of chi².

    As in the rigid body's, with derivatives of their own for each group and the shared parameters last. What is dense
    (pose and parameters) and the clocks are summed apart and put together at the end.
    """
    n_group, n_receiver, n_transmitter = z.shape
    n_dense = slope.shape[3]
    n_clock = clock.size
    dense = np.zeros((n_dense, n_dense))
    cross = np.zeros((n_clock, n_dense))
    among = np.zeros((n_clock, n_clock))
    dense_gradient = np.zeros(n_dense)
    clock_gradient = np.zeros(n_clock)
    dense_sum = np.empty(n_dense)
    chi2 = 0.0
    for g in range(n_group):
        k = clock_class[g]
        first = k * n_receiver
        for i in range(n_transmitter):
            total = 0.0
            left_sum = 0.0
            for r in range(n_receiver):
                w = weight[g, r, i]
                if w > 0.0:
                    total += w
                    left_sum += w * (z[g, r, i] - predicted[g, r, i] - clock[k, r])
            if total == 0.0:
                continue
            scale = 1.0 / (total + bias_info[g, i])
            bias = scale * left_sum
            if bias != 0.0:
                chi2 += bias * bias * bias_info[g, i]
            for a in range(n_dense):
                dense_sum[a] = 0.0
            for r in range(n_receiver):
                w = weight[g, r, i]
                if w == 0.0:
                    continue
                left = z[g, r, i] - predicted[g, r, i] - clock[k, r] - bias
                for a in range(n_dense):
                    wa = w * slope[g, r, i, a]
                    for b in range(a + 1):
                        dense[a, b] += wa * slope[g, r, i, b]
                    cross[first + r, a] += wa
                    dense_gradient[a] += wa * left
                    dense_sum[a] += wa
                among[first + r, first + r] += w
                clock_gradient[first + r] += w * left
                chi2 += w * left * left
            for a in range(n_dense):
                sa = scale * dense_sum[a]
                for b in range(a + 1):
                    dense[a, b] -= sa * dense_sum[b]
            for r in range(n_receiver):
                w = scale * weight[g, r, i]
                for a in range(n_dense):
                    cross[first + r, a] -= w * dense_sum[a]
                for b in range(r + 1):
                    among[first + r, first + b] -= w * weight[g, b, i]
    info[:] = 0.0
    for a in range(n_dense):
        # lower triangle: clocks stand below the pose and above the shared parameters
        pa = a if a < 6 else a + n_clock
        gradient[pa] = dense_gradient[a]
        for b in range(a + 1):
            info[pa, b if b < 6 else b + n_clock] = dense[a, b]
        for c in range(n_clock):
            if a < 6:
                info[6 + c, pa] = cross[c, a]
            else:
                info[pa, 6 + c] = cross[c, a]
    for c in range(n_clock):
        gradient[6 + c] = clock_gradient[c]
        for b in range(c + 1):
            info[6 + c, 6 + b] = among[c, b]
    return chi2


@kernel
def _leave(lower, info, gradient, n_own, cov, follow, schur, rest):
    """What a converged mirror hands on: covariance, how it follows the parameters, what it says about them."""
    n_parameter = schur.shape[0]
    x = np.empty(n_own)
    for a in range(n_own):
        x[:] = 0.0
        x[a] = 1.0
        solve_factored(lower, x)
        for b in range(n_own):
            cov[a, b] = x[b]
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
def _move(step, share, old_pivot, old_rot, old_clock, pivot, rot, clock):
    """Pose and clocks a share of a step away from the old ones."""
    n_class, n_receiver = clock.shape
    for a in range(3):
        pivot[a] = old_pivot[a] + share * step[a]
    rotate(share * step[3:6], old_rot, rot)
    for k in range(n_class):
        for r in range(n_receiver):
            clock[k, r] = old_clock[k, r] + share * step[6 + k * n_receiver + r]


@kernel
def _fit(scene, mirrors, m, max_iteration, floor, pivot, rot, clock, cov, follow, schur, rest):
    """Gauss-Newton with step halving of mirror ``m`` at given coefficients; (chi², iterations, status)."""
    z = mirrors.z[m]
    common = scene.common[mirrors.frame[m]]
    n_class, n_receiver = clock.shape
    n_parameter = schur.shape[0]
    n_own = 6 + n_class * n_receiver
    n = n_own + n_parameter
    work = _work(scene.image.shape[0])
    predicted = np.empty(z.shape)
    slope = np.empty((*z.shape, 6 + n_parameter))
    info = np.empty((n, n))
    lower = np.empty((n_own, n_own))
    gradient = np.empty(n)
    step = np.empty(n_own)
    old_pivot, old_rot, old_clock = pivot.copy(), rot.copy(), clock.copy()
    chi2_before = np.inf
    share = 1.0
    chi2 = np.nan
    used = 0
    for iteration in range(max_iteration):
        used = iteration + 1
        predict(scene, common, work, mirrors.receiver_mirror[m], pivot, rot, predicted, slope)
        chi2 = normal_equations(
            z, mirrors.weight[m], mirrors.bias_info[m], mirrors.clock_class, predicted, slope, clock, info, gradient
        )
        chi2 += add_priors(
            pivot,
            rot,
            clock,
            mirrors.pivot_prior[m],
            mirrors.pivot_info[m],
            mirrors.roll_info,
            mirrors.clock_own[m],
            mirrors.clock_tie[m],
            mirrors.clock_prior[m],
            info,
            gradient,
        )
        if not math.isfinite(chi2):
            return np.inf, used, STUCK
        if chi2 > chi2_before * (1.0 + 1e-9) + 1e-6 and share > 1e-3:
            share *= 0.5
            _move(step, share, old_pivot, old_rot, old_clock, pivot, rot, clock)
            continue
        for a in range(n_own):
            for b in range(a + 1):
                lower[a, b] = info[a, b]
        if not factor(lower, floor):
            return chi2, used, OPEN
        for a in range(n_own):
            step[a] = gradient[a]
        solve_factored(lower, step)
        decrement = 0.0
        for a in range(n_own):
            decrement += step[a] * gradient[a]
        turn = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
        share = 1.0 if turn <= 0.2 else 0.2 / turn
        chi2_before = chi2
        _copy(pivot, old_pivot)
        _copy(rot, old_rot)
        _copy(clock, old_clock)
        _move(step, share, old_pivot, old_rot, old_clock, pivot, rot, clock)
        if decrement < 1e-4 and share == 1.0:
            _leave(lower, info, gradient, n_own, cov, follow, schur, rest)
            return chi2 - decrement, used, SOLVED
    return min(chi2, chi2_before), used, STUCK


@kernel
def _fit_from_turns(
    scene,
    mirrors,
    m,
    max_iteration,
    floor,
    turn,
    enough,
    pivot,
    rot,
    clock,
    cov,
    follow,
    schur,
    rest,
):
    """`_fit` from the pose turned by each of ``turn`` (start, 3) until chi² is below ``enough``; else the smallest.

    Without any that converged: where the best of the others stopped.
    """
    from_pivot, from_rot, from_clock = pivot.copy(), rot.copy(), clock.copy()
    pivot_try, rot_try, clock_try = pivot.copy(), rot.copy(), clock.copy()
    cov_try, follow_try, schur_try, rest_try = cov.copy(), follow.copy(), schur.copy(), rest.copy()
    about = np.empty(3)
    best = np.inf
    status = STUCK
    total = 0
    for s in range(turn.shape[0]):
        _copy(from_pivot, pivot_try)
        _copy(from_clock, clock_try)
        for a in range(3):
            about[a] = from_rot[a, 0] * turn[s, 0] + from_rot[a, 1] * turn[s, 1] + from_rot[a, 2] * turn[s, 2]
        rotate(about, from_rot, rot_try)
        chi2, used, outcome = _fit(
            scene,
            mirrors,
            m,
            max_iteration,
            floor,
            pivot_try,
            rot_try,
            clock_try,
            cov_try,
            follow_try,
            schur_try,
            rest_try,
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
            _copy(cov_try, cov)
            _copy(follow_try, follow)
            _copy(schur_try, schur)
            _copy(rest_try, rest)
        if status == SOLVED and best < enough:
            break
    return best, total, status


@kernel_rows
def fit_many(
    begin,
    end,
    scene,
    mirrors,
    max_iteration,
    floor,
    turn,
    enough,
    pivot,
    rot,
    clock,
    cov,
    follow,
    schur,
    rest,
    chi2,
    n_iteration,
    status,
):
    """`_fit_from_turns` for every mirror that has a start."""
    for m in range(begin, end):
        if status[m] == SOLVED or status[m] == OPEN or status[m] == STUCK:
            chi2[m], n_iteration[m], status[m] = _fit_from_turns(
                scene,
                mirrors,
                m,
                max_iteration,
                floor,
                turn,
                enough[m],
                pivot[m],
                rot[m],
                clock[m],
                cov[m],
                follow[m],
                schur[m],
                rest[m],
            )


@kernel_rows
def predict_many(begin, end, scene, frame, receiver_mirror, pivot, rot, predicted, slope):
    """`predict` for every mirror."""
    for m in range(begin, end):
        common = scene.common[frame[m]]
        work = _work(scene.image.shape[0])
        predict(scene, common, work, receiver_mirror[m], pivot[m], rot[m], predicted[m], slope[m])
