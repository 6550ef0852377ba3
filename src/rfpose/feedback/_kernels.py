"""Kernels of the mount and of its calibration.

One heliostat is two rows of numbers: ``p``, what a calibration may change, and ``k``, what it may not. A measurement is
a row ``m``. `rfpose.feedback.columns` names their columns: P, K and M.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.feedback.columns import MEASUREMENT, PARAMETERS, K, M, P
from rfpose.jit import kernel, kernel_lean, kernel_rows
from rfpose.multilat.equations._kernels import factor, solve_factored

Array = npt.NDArray[Any]

N_ROW = sum(MEASUREMENT.values())
# what is prepared of a mount: rotation by rows, pivot, opening angles at count zero, sine and cosine of the
# non-orthogonality, normals in the mirror's frame: its own, the receivers' plane's
PIVOT, OPENING, OBLIQUE, MIRROR, PLANE = 9, 12, 14, 16, 19
N_PREPARED = 22
# Median of a Rayleigh variable in units of its sigma: the residual has two components.
_RAYLEIGH_MEDIAN = 1.1774100225154747
_STEP = 1e-6
_SETTLING = 0.01  # a step that lowers the loss by less than this part of it was one near the least
# the axis, from 0, that a parameter turns by itself; −1: it is about something else
_AXIS_OF = np.array([int(name.split("_")[1]) - 1 if name.split("_")[1].isdigit() else -1 for name in PARAMETERS])
_STEEP = 1.2  # an elevation that is safely on this side of the zenith [rad]
_LAST = 1e-9  # so far off [rad], a step of Newton's method with slopes from nearby is the last: it leaves some 1e-13
_NEAR = 2e-5  # so far off [rad], one step of second order with slopes from right there leaves as little
_LITTLE = 1e-3  # an angle whose series ends beneath rounding after the terms taken [rad]


@kernel_lean
def _opening(length, radius, offset):
    """Angle between the two sides of a linear actuator's triangle; NaN where it does not close."""
    cosine = (offset * offset + radius * radius - length * length) / (2.0 * offset * radius)
    if cosine < -1.0 or cosine > 1.0:
        return np.nan
    return math.acos(cosine)


@kernel_lean
def prepare(p, k, out):
    """Prepare what does not depend on the posture."""
    cn, sn = math.cos(p[P.pedestal_tilt_north_rad]), math.sin(p[P.pedestal_tilt_north_rad])
    ce, se = math.cos(p[P.pedestal_tilt_east_rad]), math.sin(p[P.pedestal_tilt_east_rad])
    ct, st = math.cos(p[P.pedestal_twist_rad]), math.sin(p[P.pedestal_twist_rad])
    for j in range(3):
        x, y, z = k[K.rot_enu_from_mount + j], k[K.rot_enu_from_mount + 3 + j], k[K.rot_enu_from_mount + 6 + j]
        x, y = ct * x + st * y, ct * y - st * x  # twist, clockwise from above
        y, z = cn * y + sn * z, cn * z - sn * y  # tilt towards north
        x, z = ce * x + se * z, ce * z - se * x  # tilt towards east
        out[j], out[3 + j], out[6 + j] = x, y, z
    length = p[P.pylon_length_m]
    out[PIVOT] = k[K.pivot_enu_m] + p[P.location_east_m] + length * se * cn
    out[PIVOT + 1] = k[K.pivot_enu_m + 1] + p[P.location_north_m] + length * sn
    out[PIVOT + 2] = k[K.pivot_enu_m + 2] + p[P.location_up_m] + length * (ce * cn - 1.0)
    for a in range(2):
        out[OPENING + a] = 0.0
        if k[K.is_linear + a] > 0.5:
            stroke = p[P.actuator_1_stroke_m + a]
            out[OPENING + a] = _opening(stroke, p[P.actuator_1_radius_m + a], p[P.actuator_1_offset_m + a])
    out[OBLIQUE] = math.sin(p[P.nonorthogonality_rad])
    out[OBLIQUE + 1] = math.cos(p[P.nonorthogonality_rad])
    for receiver in range(2):
        # canting in the mirror frame: towards right, towards up
        across = p[P.canting_right_rad] + receiver * p[P.receiver_plane_right_rad]
        along = p[P.canting_up_rad] + receiver * p[P.receiver_plane_up_rad]
        inverse = 1.0 / math.sqrt(1.0 + across * across + along * along)
        at = PLANE if receiver else MIRROR
        out[at], out[at + 1], out[at + 2] = across * inverse, along * inverse, inverse


@kernel_lean
def axis_angle(a, count, p, k, prepared):
    """Angle of axis ``a`` at a motor position."""
    travel = count / k[K.counts_per_unit + a] * (1.0 + p[P.axis_1_gain + a])
    if k[K.is_linear + a] > 0.5:
        travel = (
            _opening(p[P.actuator_1_stroke_m + a] + travel, p[P.actuator_1_radius_m + a], p[P.actuator_1_offset_m + a])
            - prepared[OPENING + a]
        )
    angle = k[K.angle_at_zero_rad + a] + k[K.sign + a] * travel + p[P.axis_1_zero_rad + a]
    turn = k[K.worm_ratio + a] * angle
    s, c = p[P.worm_1_sin_rad + 2 * a], p[P.worm_1_cos_rad + 2 * a]
    if s != 0.0 or c != 0.0:
        angle += s * math.sin(turn) + c * math.cos(turn)
    return angle


@kernel_lean
def posture(azimuth, elevation, p, prepared, receiver, out):
    """Mirror normal (3) and centre (3) in ENU at two axis angles."""
    sa, ca = math.sin(azimuth), math.cos(azimuth)
    _pose(sa, ca, math.sin(elevation), math.cos(elevation), p, prepared, receiver, out)


@kernel_lean
def _pose(sa, ca, se, ce, p, prepared, receiver, out):
    """The same at sines and cosines of the axis angles."""
    sd, cd = prepared[OBLIQUE], prepared[OBLIQUE + 1]
    at = PLANE if receiver > 0.5 else MIRROR
    for which in range(2):
        if which == 0:
            r, up, n, ahead = prepared[at], prepared[at + 1], prepared[at + 2], 0.0
        else:
            r, up, n, ahead = p[P.arm_right_m], p[P.arm_up_m], p[P.arm_normal_m], p[P.axis_offset_m]
        # frame of axis 1: right, forward, up; then axis 2's non-orthogonality, about forward
        f = ce * n - se * up
        u = se * n + ce * up
        r, u = cd * r + sd * u, cd * u - sd * r
        f += ahead
        x = sa * f - ca * r
        y = ca * f + sa * r
        for i in range(3):
            value = prepared[3 * i] * x + prepared[3 * i + 1] * y + prepared[3 * i + 2] * u
            out[3 * which + i] = value + (prepared[PIVOT + i] if which == 1 else 0.0)
    sag = p[P.gravity_sag_rad]
    if sag != 0.0:
        z = out[2]
        x, y, z = out[0] * (1.0 + sag * z), out[1] * (1.0 + sag * z), z * (1.0 + sag * z) - sag
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        out[0], out[1], out[2] = x * inverse, y * inverse, z * inverse


@kernel_lean
def stand(count_1, count_2, p, k, prepared, receiver, out):
    """Mirror normal and centre at two motor positions."""
    posture(axis_angle(0, count_1, p, k, prepared), axis_angle(1, count_2, p, k, prepared), p, prepared, receiver, out)


@kernel_lean
def bisector(m, centre, out):
    """Normal that sends the row's source to its target from a mirror centre."""
    from_point, to_point = m[M.source_is_point], m[M.target_is_point]
    s0 = m[M.source_enu] - from_point * centre[0]
    s1 = m[M.source_enu + 1] - from_point * centre[1]
    s2 = m[M.source_enu + 2] - from_point * centre[2]
    t0 = m[M.target_enu] - to_point * centre[0]
    t1 = m[M.target_enu + 1] - to_point * centre[1]
    t2 = m[M.target_enu + 2] - to_point * centre[2]
    length_s = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
    length_t = math.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
    x = s0 / length_s + t0 / length_t
    y = s1 / length_s + t1 / length_t
    z = s2 / length_s + t2 / length_t
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    out[0], out[1], out[2] = x * inverse, y * inverse, z * inverse


@kernel_lean
def _sines(a, p, k, prepared, count, use, out):
    """Sine and cosine of axis ``a`` (measurement, 2) at motor positions."""
    for i in range(len(count)):
        if use[i]:
            angle = axis_angle(a, count[i, a], p, k, prepared)
            out[i, 0], out[i, 1] = math.sin(angle), math.cos(angle)


@kernel
def _residuals_at(p, prepared, sines_1, sines_2, row, use, out):
    """Modelled minus measured normal over sigma, (measurement, xyz), at sines of the axes; zero where not used."""
    state = np.empty(6)
    wanted = np.empty(3)
    seen = np.empty(N_ROW)
    for i in range(len(row)):
        if not use[i]:
            out[i, 0] = out[i, 1] = out[i, 2] = 0.0
            continue
        sa, ca, se, ce = sines_1[i, 0], sines_1[i, 1], sines_2[i, 0], sines_2[i, 1]
        _pose(sa, ca, se, ce, p, prepared, row[i, M.of_receiver_plane], state)
        for j in range(N_ROW):
            seen[j] = row[i, j]
        for j in range(3):  # a drone's camera sits beside its antenna
            seen[M.source_enu + j] += seen[M.source_is_point] * p[P.drone_camera_east_m + j]
        bisector(seen, state[3:], wanted)
        for j in range(3):
            out[i, j] = (state[j] - wanted[j]) / row[i, M.sigma_rad]


@kernel
def _residuals(p, k, count, row, use, sines, out):
    """The same at motor positions; the axes' sines (axis, measurement, 2) are written."""
    prepared = np.empty(N_PREPARED)
    prepare(p, k, prepared)
    for a in range(2):
        _sines(a, p, k, prepared, count, use, sines[a])
    _residuals_at(p, prepared, sines[0], sines[1], row, use, out)


@kernel
def _residuals_beside(p, k, count, row, use, column, sines, out):
    """The same where one parameter is another than where the axes' sines are from."""
    prepared = np.empty(N_PREPARED)
    prepare(p, k, prepared)
    axis = _AXIS_OF[column]
    if axis < 0:
        _residuals_at(p, prepared, sines[0], sines[1], row, use, out)
        return
    moved = np.empty((len(count), 2))
    _sines(axis, p, k, prepared, count, use, moved)
    if axis == 0:
        _residuals_at(p, prepared, moved, sines[1], row, use, out)
    else:
        _residuals_at(p, prepared, sines[0], moved, row, use, out)


def residuals_batch(p: Array, k: Array, count: Array, row: Array, use: Array) -> Array:
    """Residuals of many heliostats (heliostat, measurement, xyz), in sigma."""
    out = np.empty((len(p), row.shape[1], 3))
    _residuals_rows(len(p), p, k, count, row, use, out)
    return out


@kernel_rows
def _residuals_rows(begin, end, p, k, count, row, use, out):
    sines = np.empty((2, row.shape[1], 2))
    for h in range(begin, end):
        _residuals(p[h], k[h], count[h], row[h], use[h], sines, out[h])


def jacobian_batch(p: Array, k: Array, count: Array, row: Array, use: Array, free: Array, scale: Array) -> Array:
    """Central differences of the residuals by free parameters, (heliostat, measurement, xyz, parameter)."""
    out = np.empty((len(p), row.shape[1], 3, len(free)))
    _jacobian_rows(len(p), p, k, count, row, use, free, scale, out)
    return out


@kernel_rows
def _jacobian_rows(begin, end, p, k, count, row, use, free, scale, out):
    for h in range(begin, end):
        trial = p[h].copy()
        high = np.empty((row.shape[1], 3))
        low = np.empty((row.shape[1], 3))
        sines = np.empty((2, row.shape[1], 2))
        _residuals(trial, k[h], count[h], row[h], use[h], sines, low)
        for f in range(len(free)):
            step = 10.0 * _STEP * scale[f]
            trial[free[f]] = p[h, free[f]] + step
            _residuals_beside(trial, k[h], count[h], row[h], use[h], free[f], sines, high)
            trial[free[f]] = p[h, free[f]] - step
            _residuals_beside(trial, k[h], count[h], row[h], use[h], free[f], sines, low)
            trial[free[f]] = p[h, free[f]]
            for i in range(row.shape[1]):
                for j in range(3):
                    out[h, i, j, f] = (high[i, j] - low[i, j]) / (2.0 * step)


def posture_batch(p: Array, k: Array, count: Array, receiver: float) -> Array:
    """Axis angles, normal and centre (heliostat, posture, 8)."""
    out = np.empty((len(p), count.shape[1], 8))
    _posture_rows(len(p), p, k, count, receiver, out)
    return out


@kernel_rows
def _posture_rows(begin, end, p, k, count, receiver, out):
    for h in range(begin, end):
        prepared = np.empty(N_PREPARED)
        prepare(p[h], k[h], prepared)
        for i in range(count.shape[1]):
            out[h, i, 0] = axis_angle(0, count[h, i, 0], p[h], k[h], prepared)
            out[h, i, 1] = axis_angle(1, count[h, i, 1], p[h], k[h], prepared)
            posture(out[h, i, 0], out[h, i, 1], p[h], prepared, receiver, out[h, i, 2:])


@kernel_lean
def _count_guess(a, angle, p, k, prepared):
    """Motor position for an axis angle, worm gear left out; NaN where the actuator cannot reach it."""
    travel = (angle - k[K.angle_at_zero_rad + a] - p[P.axis_1_zero_rad + a]) * k[K.sign + a]
    if k[K.is_linear + a] > 0.5:
        opening = travel + prepared[OPENING + a]
        if opening < 0.0 or opening > math.pi:
            return np.nan
        radius, offset = p[P.actuator_1_radius_m + a], p[P.actuator_1_offset_m + a]
        square = offset * offset + radius * radius - 2.0 * offset * radius * math.cos(opening)
        travel = math.sqrt(max(square, 0.0)) - p[P.actuator_1_stroke_m + a]
    return travel / (1.0 + p[P.axis_1_gain + a]) * k[K.counts_per_unit + a]


@kernel_lean
def _worm(p, k, a, angle):
    """How far a worm gear has to turn its axis for the axis to be at an angle.

    By substitution, which stays bounded: a rolling fit may believe in a gear for which Newton's method runs away.
    """
    sine, cosine, ratio = p[P.worm_1_sin_rad + 2 * a], p[P.worm_1_cos_rad + 2 * a], k[K.worm_ratio + a]
    worm = 0.0
    if sine == 0.0 and cosine == 0.0:
        return worm
    for _ in range(8):
        worm = sine * math.sin(ratio * (angle - worm)) + cosine * math.cos(ratio * (angle - worm))
    return worm


@kernel_lean
def _swept(m, centre, wanted, c0, c1, c2):
    """How the normal that a row wants changes when the mirror's centre moves a little."""
    d0 = d1 = d2 = 0.0
    for end in range(2):
        at, is_point = (M.source_enu, M.source_is_point) if end == 0 else (M.target_enu, M.target_is_point)
        if m[is_point] == 0.0:
            continue
        x, y, z = m[at] - centre[0], m[at + 1] - centre[1], m[at + 2] - centre[2]
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        x, y, z = x * inverse, y * inverse, z * inverse
        along = x * c0 + y * c1 + z * c2
        # before it is scaled, the bisector is twice the cosine of half the angle long
        half = x * wanted[0] + y * wanted[1] + z * wanted[2]
        by = inverse / (2.0 * half) if half > 0.05 else 0.0
        d0, d1, d2 = d0 - by * (c0 - along * x), d1 - by * (c1 - along * y), d2 - by * (c2 - along * z)
    along = d0 * wanted[0] + d1 * wanted[1] + d2 * wanted[2]
    return d0 - along * wanted[0], d1 - along * wanted[1], d2 - along * wanted[2]


@kernel_lean
def command_one(p, k, prepared, m, near, out, state, wanted):
    """Counts that make the mirror send the row's source to its target; returns 0 if done.

    ``near`` holds axis angles not far from the wanted ones, NaN if unknown, and those that were found afterwards.
    """
    # beyond the zenith there is another way to the same normal: no guess may lead there
    if abs(near[1]) < _STEEP:
        status = _command_from(near[0], near[1], p, k, prepared, m, near, out, state, wanted)
        if abs(near[1]) < _STEEP:
            return status
    for i in range(3):
        state[3 + i] = prepared[PIVOT + i]
    bisector(m, state[3:], wanted)
    # back into the nominal mount frame for a first guess
    x = prepared[0] * wanted[0] + prepared[3] * wanted[1] + prepared[6] * wanted[2]
    y = prepared[1] * wanted[0] + prepared[4] * wanted[1] + prepared[7] * wanted[2]
    z = prepared[2] * wanted[0] + prepared[5] * wanted[1] + prepared[8] * wanted[2]
    azimuth, elevation = math.atan2(x, y), math.atan2(z, math.hypot(x, y))
    return _command_from(azimuth, elevation, p, k, prepared, m, near, out, state, wanted)


@kernel_lean
def _turned(s, c, angle, by):
    """Sine and cosine of an angle from those before it turned by a little."""
    if abs(by) > _LITTLE:
        return math.sin(angle), math.cos(angle)
    square = by * by
    sine, less = by * (1.0 - square / 6.0 * (1.0 - square / 20.0)), square / 2.0 * (1.0 - square / 12.0)
    return s + (c * sine - s * less), c - (s * sine + c * less)


@kernel_lean
def _second(z, r, a, b, by_azimuth, by_elevation):
    """What turns about axes ``z`` and ``r`` change a normal by to second order; to first order by ``a`` and ``b``."""
    xx, yy, xy = 0.5 * by_azimuth * by_azimuth, 0.5 * by_elevation * by_elevation, by_azimuth * by_elevation
    # axis 2 goes round with axis 1
    c0, c1, c2 = xx * a[0] + xy * b[0], xx * a[1] + xy * b[1], xx * a[2] + xy * b[2]
    return (
        c1 * z[2] - c2 * z[1] + yy * (b[1] * r[2] - b[2] * r[1]),
        c2 * z[0] - c0 * z[2] + yy * (b[2] * r[0] - b[0] * r[2]),
        c0 * z[1] - c1 * z[0] + yy * (b[0] * r[1] - b[1] * r[0]),
    )


@kernel_lean
def _command_from(azimuth, elevation, p, k, prepared, m, found, out, state, wanted):
    """Newton's method from axis angles; those that it ends with go to ``found``, NaN if it does not."""
    found[0] = found[1] = np.nan
    done = first = True
    # light from and to far away wants the same normal wherever the mirror's centre is
    moves = m[M.source_is_point] != 0.0 or m[M.target_is_point] != 0.0
    sa, ca, se, ce = math.sin(azimuth), math.cos(azimuth), math.sin(elevation), math.cos(elevation)
    a0 = a1 = a2 = b0 = b1 = b2 = 0.0
    near = False
    for _ in range(30):
        _pose(sa, ca, se, ce, p, prepared, 0.0, state)
        if moves or first:
            bisector(m, state[3:], wanted)
        n0, n1, n2 = state[0], state[1], state[2]
        e0, e1, e2 = wanted[0] - n0, wanted[1] - n1, wanted[2] - n2
        square = e0 * e0 + e1 * e1 + e2 * e2
        if not (square < 10.0):
            return 1
        done = square < _LAST * _LAST
        if square < 1e-26:
            break
        if first or not done:
            # what the normal moves by when axis 1 turns, and axis 2: n × axis; sag changes that little
            z0, z1, z2 = prepared[2], prepared[5], prepared[8]
            x, y, u = -ca * prepared[OBLIQUE + 1], sa * prepared[OBLIQUE + 1], -prepared[OBLIQUE]
            r0 = prepared[0] * x + prepared[1] * y + prepared[2] * u
            r1 = prepared[3] * x + prepared[4] * y + prepared[5] * u
            r2 = prepared[6] * x + prepared[7] * y + prepared[8] * u
            a0, a1, a2 = n1 * z2 - n2 * z1, n2 * z0 - n0 * z2, n0 * z1 - n1 * z0
            b0, b1, b2 = n1 * r2 - n2 * r1, n2 * r0 - n0 * r2, n0 * r1 - n1 * r0
            turn_1, turn_2 = (a0, a1, a2), (b0, b1, b2)
            v0 = v1 = v2 = w0 = w1 = w2 = 0.0
            if moves:
                # the centre goes with it, and with the centre the normal that is wanted
                c0, c1, c2 = state[3] - prepared[PIVOT], state[4] - prepared[PIVOT + 1], state[5] - prepared[PIVOT + 2]
                v0, v1, v2 = _swept(m, state[3:], wanted, c1 * z2 - c2 * z1, c2 * z0 - c0 * z2, c0 * z1 - c1 * z0)
                a0, a1, a2 = a0 - v0, a1 - v1, a2 - v2
                x, y = sa * p[P.axis_offset_m], ca * p[P.axis_offset_m]
                c0 -= prepared[0] * x + prepared[1] * y
                c1 -= prepared[3] * x + prepared[4] * y
                c2 -= prepared[6] * x + prepared[7] * y
                w0, w1, w2 = _swept(m, state[3:], wanted, c1 * r2 - c2 * r1, c2 * r0 - c0 * r2, c0 * r1 - c1 * r0)
                b0, b1, b2 = b0 - w0, b1 - w1, b2 - w2
            # slopes are exact but for sag, and where light grazes the mirror, so that it is not known what it sweeps
            swept = abs(v0) + abs(v1) + abs(v2) + abs(w0) + abs(w1) + abs(w2) > 0.0
            near = first and square < _NEAR * _NEAR and p[P.gravity_sag_rad] == 0.0 and (swept or not moves)
        aa, bb, ab = a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2, a0 * b0 + a1 * b1 + a2 * b2
        ae, be = a0 * e0 + a1 * e1 + a2 * e2, b0 * e0 + b1 * e1 + b2 * e2
        determinant = aa * bb - ab * ab
        if determinant < 1e-14:
            return 1
        by_azimuth, by_elevation = (bb * ae - ab * be) / determinant, (aa * be - ab * ae) / determinant
        if near and not done:
            done = True
            e0, e1, e2 = _second((z0, z1, z2), (r0, r1, r2), turn_1, turn_2, by_azimuth, by_elevation)
            ae, be = a0 * e0 + a1 * e1 + a2 * e2, b0 * e0 + b1 * e1 + b2 * e2
            by_azimuth -= (bb * ae - ab * be) / determinant
            by_elevation -= (aa * be - ab * ae) / determinant
            wanted[0] += v0 * by_azimuth + w0 * by_elevation
            wanted[1] += v1 * by_azimuth + w1 * by_elevation
            wanted[2] += v2 * by_azimuth + w2 * by_elevation
        azimuth += by_azimuth
        elevation += by_elevation
        if done:
            break
        sa, ca = _turned(sa, ca, azimuth, by_azimuth)
        se, ce = _turned(se, ce, elevation, by_elevation)
        first = False
    if not done:
        return 1
    if abs(azimuth) > math.pi:  # where a guess was a turn away
        azimuth -= 2.0 * math.pi * math.floor(azimuth / (2.0 * math.pi) + 0.5)
    found[0], found[1] = azimuth, elevation
    # an azimuth axis may have to be taken a whole turn further to lie within its counts
    for a in range(2):
        angle = azimuth if a == 0 else elevation
        best = np.nan
        for turn in (0, -1, 1):
            goal = angle + 2.0 * math.pi * turn
            count = _count_guess(a, goal - _worm(p, k, a, goal), p, k, prepared)
            if k[K.lowest_count + a] <= count <= k[K.highest_count + a]:
                best = count
                break
            if turn == 0:
                best = count
        out[a] = best
    for a in range(2):
        if not (k[K.lowest_count + a] <= out[a] <= k[K.highest_count + a]):
            return 2
    return 0


def command_batch(p: Array, k: Array, row: Array) -> tuple[Array, Array]:
    """Counts (heliostat, posture, 2) for rows of source and target, and a status: 0 done, 1 no solution, 2 limits."""
    out = np.full((len(p), row.shape[1], 2), np.nan)
    status = np.empty((len(p), row.shape[1]), np.int8)
    _command_rows(len(p), p, k, row, out, status)
    return out, status


@kernel_rows
def _command_rows(begin, end, p, k, row, out, status):
    for h in range(begin, end):
        prepared = np.empty(N_PREPARED)
        state = np.empty(6)
        wanted = np.empty(3)
        near = np.empty(2)
        prepare(p[h], k[h], prepared)
        for i in range(row.shape[1]):
            near[:] = np.nan
            status[h, i] = command_one(p[h], k[h], prepared, row[h, i], near, out[h, i], state, wanted)


@kernel
def _median_norm(r, use, norm):
    """Norm of each residual into ``norm``; returns the median over those in use."""
    n = 0
    kept = np.empty(len(r))
    for i in range(len(r)):
        norm[i] = math.sqrt(r[i, 0] ** 2 + r[i, 1] ** 2 + r[i, 2] ** 2)
        if use[i]:
            kept[n] = norm[i]
            n += 1
    return np.median(kept[:n]) if n else np.nan


@kernel
def _loss(norm, use, cut):
    """Huber's loss of the residual norms, in their own unit."""
    total = 0.0
    for i in range(len(norm)):
        if use[i]:
            e = norm[i]
            total += 0.5 * e * e if e <= cut else cut * (e - 0.5 * cut)
    return total


@kernel
def _prior_loss(p, free, prior_mean, prior_weight):
    total = 0.0
    for f in range(len(free)):
        total += 0.5 * prior_weight[f] * (p[free[f]] - prior_mean[f]) ** 2
    return total


@kernel
def _normal_equations(p, k, count, row, use, free, scale, sines, r, norm, cut, near, normal, gradient):
    """Weighted normal matrix and gradient in scaled parameters, Jacobian by forward differences.

    ``near`` the least loss the matrix is the loss' own second derivative, but for the curvature of residuals; else that
    of a parabola which lies above the loss everywhere, since from afar the loss' own leads too far.
    """
    n_free = len(free)
    m = len(row)
    moved = np.empty((m, 3))
    along = np.empty(n_free)
    jacobian = np.empty((m, 3, n_free))
    trial = p.copy()
    for f in range(n_free):
        trial[free[f]] = p[free[f]] + _STEP * scale[f]
        _residuals_beside(trial, k, count, row, use, free[f], sines, moved)
        trial[free[f]] = p[free[f]]
        for i in range(m):
            for j in range(3):
                jacobian[i, j, f] = (moved[i, j] - r[i, j]) / _STEP
    normal[:] = 0.0
    gradient[:] = 0.0
    for i in range(m):
        if not use[i]:
            continue
        weight = 1.0 if norm[i] <= cut else cut / norm[i]
        for j in range(3):
            for f in range(n_free):
                scaled = weight * jacobian[i, j, f]
                gradient[f] += scaled * r[i, j]
                for g in range(f + 1):
                    normal[f, g] += scaled * jacobian[i, j, g]
        if near and norm[i] > cut:
            # along the residual the loss is straight
            for f in range(n_free):
                along[f] = 0.0
                for j in range(3):
                    along[f] += jacobian[i, j, f] * r[i, j] / norm[i]
            for f in range(n_free):
                for g in range(f + 1):
                    normal[f, g] -= weight * along[f] * along[g]
    for f in range(n_free):
        for g in range(f):
            normal[g, f] = normal[f, g]


@kernel
def _fit_one(
    p, k, count, row, use, free, scale, low, high, prior_mean, prior_weight, huber, sigma_known, max_iteration
):
    """Levenberg-Marquardt with Huber's loss, in place; returns iterations (negative: did not settle) and scale."""
    n_free = len(free)
    m = len(row)
    r = np.empty((m, 3))
    r_new = np.empty((m, 3))
    norm = np.empty(m)
    norm_new = np.empty(m)
    normal = np.empty((n_free, n_free))
    damped = np.empty((n_free, n_free))
    gradient = np.empty(n_free)
    step = np.empty(n_free)
    trial = p.copy()
    weight = np.empty(n_free)
    sines = np.empty((2, m, 2))
    sines_new = np.empty((2, m, 2))
    damping = 1e-3
    _residuals(p, k, count, row, use, sines, r)
    noise = 1.0
    near = False
    for iteration in range(max_iteration):
        middle = _median_norm(r, use, norm)
        if not middle < np.inf:
            return -1, np.nan
        if not sigma_known:
            noise = max(middle / _RAYLEIGH_MEDIAN, 1e-9)
        cut = huber * noise
        for f in range(n_free):
            weight[f] = prior_weight[f] * noise * noise
        cost = _loss(norm, use, cut) + _prior_loss(p, free, prior_mean, weight)
        _normal_equations(p, k, count, row, use, free, scale, sines, r, norm, cut, near, normal, gradient)
        for f in range(n_free):
            gradient[f] += weight[f] * (p[free[f]] - prior_mean[f]) * scale[f]
            normal[f, f] += weight[f] * scale[f] * scale[f]
            pushed = (p[free[f]] <= low[f] and gradient[f] > 0.0) or (p[free[f]] >= high[f] and gradient[f] < 0.0)
            if pushed or normal[f, f] <= 0.0:
                for g in range(n_free):
                    normal[f, g] = normal[g, f] = 0.0
                normal[f, f] = 1.0
                gradient[f] = 0.0
        improved = False
        gain = 0.0
        for _ in range(12):
            for f in range(n_free):
                for g in range(n_free):
                    damped[f, g] = normal[f, g]
                damped[f, f] *= 1.0 + damping
                step[f] = -gradient[f]
            if factor(damped, damped.shape[0], 0.0):
                solve_factored(damped, step)
                for f in range(n_free):
                    value = p[free[f]] + step[f] * scale[f]
                    trial[free[f]] = min(max(value, low[f]), high[f])
                _residuals(trial, k, count, row, use, sines_new, r_new)
                _median_norm(r_new, use, norm_new)
                fresh = _loss(norm_new, use, cut) + _prior_loss(trial, free, prior_mean, weight)
                if fresh <= cost:
                    improved = True
                    gain = cost - fresh
                    break
            damping = min(max(damping, 1e-6) * 8.0, 1e12)
        if not improved:
            return iteration + 1, noise
        damping = max(damping * 0.1, 1e-9)
        near = gain < _SETTLING * cost
        for f in range(n_free):
            p[free[f]] = trial[free[f]]
        r, r_new = r_new, r
        sines, sines_new = sines_new, sines
        if gain <= 1e-9 * cost + 1e-22:
            return iteration + 1, noise
    return -max_iteration, noise


def fit_batch(
    start: Array,
    k: Array,
    count: Array,
    row: Array,
    use: Array,
    free: Array,
    scale: Array,
    low: Array,
    high: Array,
    mean: Array,
    weight: Array,
    huber: float,
    sigma_known: bool,
    max_iteration: int,
) -> tuple[Array, Array, Array]:
    """Fit many heliostats; returns parameters, iterations and noise in units of the stated sigma."""
    p = start.copy()
    iterations = np.empty(len(p), np.int64)
    noise = np.empty(len(p))
    _fit_rows(
        len(p), p, k, count, row, use, free, scale, low, high, mean, weight, huber, sigma_known, max_iteration,
        iterations, noise,
    )  # fmt: skip
    return p, iterations, noise


@kernel_rows
def _fit_rows(
    begin, end, p, k, count, row, use, free, scale, low, high, mean, weight, huber, sigma_known, max_iteration,
    iterations, noise,
):  # fmt: skip
    for h in range(begin, end):
        iterations[h], noise[h] = _fit_one(
            p[h], k[h], count[h], row[h], use[h], free, scale, low[h], high[h], mean[h], weight,
            huber, sigma_known, max_iteration,
        )  # fmt: skip
