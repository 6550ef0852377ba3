"""Kernels of antenna patterns: a cubic spline over polar angle and azimuth, looked up with its slope.

A table is an array (receiver, polar + 2, azimuth + 3, xyz) of B-spline coefficients of the effective length's Cartesian
components in the mirror frame, which are smooth across the poles, where components along θ and φ are not. Row and
column 1 belong to angle 0; what lies beyond either end is what the sphere continues with, so that no index wraps.
"""

from __future__ import annotations

import math

import numpy as np

from rfpose.jit import kernel, kernel_inline, kernel_rows

_POLE = 1e-8  # rad


@kernel_inline
def _weights(t, w, dw):
    """Cubic B-spline and its derivative at the four knots about t, which lies 0 to 1 behind the second."""
    s = 1.0 - t
    w[0] = s * s * s / 6.0
    w[1] = 2.0 / 3.0 - t * t * (1.0 - 0.5 * t)
    w[2] = 2.0 / 3.0 - s * s * (1.0 - 0.5 * s)
    w[3] = t * t * t / 6.0
    dw[0] = -0.5 * s * s
    dw[1] = t * (1.5 * t - 2.0)
    dw[2] = -s * (1.5 * s - 2.0)
    dw[3] = 0.5 * t * t


@kernel
def look_up(table, receiver, x, y, z, work, vector, slope):
    """Effective length towards (x, y, z), of any length, in the mirror frame, and its slope over (x, y, z).

    Parameters
    ----------
    table : (receiver, polar + 2, azimuth + 3, xyz)
        As `PatternTable.coefficient`.
    receiver
        Row of the table.
    x, y, z
        From the antenna to where the wave comes from, mirror frame; not zero.
    work : (4, 4)
        Scratch.
    vector : (xyz,)
        Out: voltage = field · vector.
    slope : (xyz, xyz)
        Out: derivative of vector's component (first index) over the direction's (second), tangential.
    """
    n_polar, n_azimuth = table.shape[1] - 2, table.shape[2] - 3
    flat = math.hypot(x, y)
    length = math.hypot(flat, z)
    if flat < _POLE * length:  # where azimuth means nothing: a step beside the pole everything is defined
        x, y, flat = _POLE * length, 0.0, _POLE * length
    p = math.atan2(flat, z) * ((n_polar - 1) / math.pi)
    a = math.atan2(y, x) * (n_azimuth / (2.0 * math.pi))
    if a < 0.0:
        a += n_azimuth
    i = min(int(p), n_polar - 2)
    j = min(int(a), n_azimuth - 1)
    _weights(p - i, work[0], work[1])
    _weights(a - j, work[2], work[3])
    # unit vectors of growing polar angle and azimuth, times knots per length along them
    by_polar = (n_polar - 1) / math.pi / length
    by_azimuth = n_azimuth / (2.0 * math.pi) / flat
    cos_a, sin_a = x / flat, y / flat
    px, py, pz = by_polar * z / length * cos_a, by_polar * z / length * sin_a, -by_polar * flat / length
    ax, ay = -by_azimuth * sin_a, by_azimuth * cos_a
    near = table[receiver, i : i + 4, j : j + 4]
    for c in range(
        3
    ):  # real and imaginary part each on its own: numba would multiply by a weight as by a complex number
        value, over_p, over_a = 0.0, 0.0, 0.0
        value_j, over_p_j, over_a_j = 0.0, 0.0, 0.0
        for m in range(4):
            b0, b1, b2, b3 = near[m, 0, c], near[m, 1, c], near[m, 2, c], near[m, 3, c]
            along = work[2, 0] * b0.real + work[2, 1] * b1.real + work[2, 2] * b2.real + work[2, 3] * b3.real
            across = work[3, 0] * b0.real + work[3, 1] * b1.real + work[3, 2] * b2.real + work[3, 3] * b3.real
            value += work[0, m] * along
            over_p += work[1, m] * along
            over_a += work[0, m] * across
            along = work[2, 0] * b0.imag + work[2, 1] * b1.imag + work[2, 2] * b2.imag + work[2, 3] * b3.imag
            across = work[3, 0] * b0.imag + work[3, 1] * b1.imag + work[3, 2] * b2.imag + work[3, 3] * b3.imag
            value_j += work[0, m] * along
            over_p_j += work[1, m] * along
            over_a_j += work[0, m] * across
        vector[c] = complex(value, value_j)
        slope[c, 0] = complex(over_p * px + over_a * ax, over_p_j * px + over_a_j * ax)
        slope[c, 1] = complex(over_p * py + over_a * ay, over_p_j * py + over_a_j * ay)
        slope[c, 2] = complex(over_p * pz, over_p_j * pz)


@kernel
def sigma_at(sigma, receiver, x, y, z):
    """Error of the effective length towards (x, y, z): linear between the table's own points.

    ``sigma`` is (receiver, polar, azimuth), from 0 to π and from 0 to 2π without its end.
    """
    n_polar, n_azimuth = sigma.shape[1], sigma.shape[2]
    p = math.atan2(math.hypot(x, y), z) * ((n_polar - 1) / math.pi)
    a = math.atan2(y, x) * (n_azimuth / (2.0 * math.pi))
    if a < 0.0:
        a += n_azimuth
    i = min(int(p), n_polar - 2)
    j = min(int(a), n_azimuth - 1)
    s, t = p - i, a - j
    k = j + 1 if j + 1 < n_azimuth else 0
    return (1.0 - s) * ((1.0 - t) * sigma[receiver, i, j] + t * sigma[receiver, i, k]) + s * (
        (1.0 - t) * sigma[receiver, i + 1, j] + t * sigma[receiver, i + 1, k]
    )


@kernel_rows
def look_up_rows(begin, end, table, sigma, receiver, direction, vector, slope, error):
    """`look_up` and `sigma_at` for many directions; NaN where a direction is not finite or zero."""
    work = np.empty((4, 4))
    for n in range(begin, end):
        x, y, z = direction[n, 0], direction[n, 1], direction[n, 2]
        length = math.hypot(math.hypot(x, y), z)
        if not (length > 0.0 and length < math.inf):
            vector[n] = np.nan
            slope[n] = np.nan
            error[n] = np.nan
            continue
        look_up(table, receiver[n], x, y, z, work, vector[n], slope[n])
        error[n] = sigma_at(sigma, receiver[n], x, y, z)
