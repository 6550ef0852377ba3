"""What planes that reflect add to ranges read off phases.

A line of wavenumber k arrives with amplitude e^{-jkd} w(k),

    w(k) = 1 + Σ_p G_p A_p e^{-jkΔ_p},   A_p = (d/d'_p) Γ_p(grazing angle),   Δ_p = d'_p − d,

d' the distance of the image in plane p. With k of the carrier and κ of the tone the demodulated tone is
h ∝ e^{-jκd} [w(k+κ) w(k)* + w(k−κ)* w(k)], so that ranges read off the phases are d + shift with

    tone: shift = −arg[w(k+κ) w(k)* + w(k−κ)* w(k)] / κ,      carrier: shift = −arg w(k) / k.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rfpose.jit import kernel, kernel_rows

Float64 = npt.NDArray[np.float64]
Complex128 = npt.NDArray[np.complex128]
Int64 = npt.NDArray[np.int64]


class SharedGeometry(NamedTuple):
    """What all mirrors have in common.

    ``image`` (plane, transmitter, 3) and ``normal`` (plane, 3); ``tone_k`` (group,) is zero for the carrier;
    ``kind`` (plane,) 0 = coefficient only, 1 = vertical, 2 = horizontal polarisation; ``permittivity`` (plane,
    transmitter); ``column`` (plane,) gives a coefficient's first parameter, −1 = known; ``common`` (frame, transmitter,
    group, 1 + survey + parameter) is what calibration receivers' phases carry of it, as range and its derivatives: by
    how far each of these receivers is from where it is surveyed, in standard deviations, and by the coefficients.
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


class ShiftRoom(NamedTuple):
    """Room for `shift_at`."""

    strength: Complex128
    strength_slope: Complex128
    detour: Float64
    detour_slope: Float64
    line: Complex128
    w_slope: Complex128
    direction: Float64


@kernel
def work_for(n_plane):
    return ShiftRoom(
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
        work = work_for(scene.image.shape[0])
        for i in range(out.shape[1]):
            shift_at(scene, work, point[m, 0], point[m, 1], point[m, 2], i, out[m, i])
