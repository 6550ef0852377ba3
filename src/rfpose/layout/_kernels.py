"""Kernels of sensitivity maps: dilution, bounds of normals.

Arrays of transmitters are (xyz, transmitter), so that sums over transmitters vectorise. ``visible`` is (mirror,
receiver, transmitter), or has no rows when everything is seen. A mirror whose pose is not determined gives NaN.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rfpose.jit import kernel, kernel_rows
from rfpose.multilat.equations._kernels import add_prior

# Smallest share of an unknown's information that the others may leave before it counts as unobserved.
FLOOR = 1e-13
# det M below this part of (tr M)³ means a plane or a line, as in `rfpose.multilat`.
SINGULAR_DET = 1e-12
# Points taken side by side.
BLOCK = 16

Array = npt.NDArray[np.float64]


class FieldArrays(NamedTuple):
    """Transmitters and mirrors, as the kernels take them.

    ``transmitter`` (xyz, transmitter), ``place`` (1 or mirror, receiver, xyz) in the mirror frame, ``pivot`` (mirror,
    xyz), ``rot`` (mirror, 3, 3), ``range2`` the square of the reference range of free-space noise or zero, ``visible``.
    """

    transmitter: Array
    place: Array
    pivot: Array
    rot: Array
    range2: float
    visible: npt.NDArray[np.uint8]


@kernel
def look(field, i, r, arm, u, inverse):
    """Set arm, unit vectors from the transmitters and inverse distances of receiver r of mirror i."""
    arm_of(field.rot[i], field.place[i % field.place.shape[0], r], arm)
    directions(
        field.transmitter, field.pivot[i, 0] + arm[0], field.pivot[i, 1] + arm[1], field.pivot[i, 2] + arm[2], u,
        inverse,
    )  # fmt: skip


@kernel
def normal_variance(cov, rot):
    """Variance of the normal: the rotation's less that about the normal."""
    total = cov[0, 0] + cov[1, 1] + cov[2, 2]
    for a in range(3):
        for b in range(3):
            total -= rot[a, 2] * cov[a, b] * rot[b, 2]
    return total


@kernel
def torque(arm, x, y, z):
    """Return arm × (x, y, z)."""
    return arm[1] * z - arm[2] * y, arm[2] * x - arm[0] * z, arm[0] * y - arm[1] * x


@kernel
def invert(m, q):
    """Set q = m⁻¹ for a symmetric 3×3; False where m is singular."""
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    c01 = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c02 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    det = m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    if not det > SINGULAR_DET * trace * trace * trace:
        return False
    s = 1.0 / det
    q[0, 0] = s * c00
    q[0, 1] = q[1, 0] = s * c01
    q[0, 2] = q[2, 0] = s * c02
    q[1, 1] = s * (m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2])
    q[1, 2] = q[2, 1] = s * (m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2])
    q[2, 2] = s * (m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1])
    return True


@kernel
def arm_of(rot, place, out):
    """Set out = rot @ place."""
    for a in range(3):
        out[a] = rot[a, 0] * place[0] + rot[a, 1] * place[1] + rot[a, 2] * place[2]


@kernel
def turn_slopes(rot, slope, jac):
    """Turn slopes of the normal by receivers' places (receiver, 3, 3) to places in ENU: jac = slope rotᵀ."""
    for k in range(slope.shape[0]):
        for i in range(3):
            for c in range(3):
                jac[k, i, c] = slope[k, i, 0] * rot[c, 0] + slope[k, i, 1] * rot[c, 1] + slope[k, i, 2] * rot[c, 2]


@kernel
def directions(transmitter, x, y, z, u, inverse):
    """Unit vectors u (3, transmitter) from the transmitters to a point, and inverse distances."""
    for t in range(transmitter.shape[1]):
        dx = x - transmitter[0, t]
        dy = y - transmitter[1, t]
        dz = z - transmitter[2, t]
        a = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        u[0, t] = dx * a
        u[1, t] = dy * a
        u[2, t] = dz * a
        inverse[t] = a


@kernel
def moments(u, w, s, m):
    """Weighted sums of a receiver's directions: s (4) = Σ w (u, 1), m (3, 3) = Σ w u uᵀ."""
    sw = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for t in range(w.shape[0]):
        x, y, z, b = u[0, t], u[1, t], u[2, t], w[t]
        sw += b
        sx += b * x
        sy += b * y
        sz += b * z
        xx += b * x * x
        xy += b * x * y
        xz += b * x * z
        yy += b * y * y
        yz += b * y * z
        zz += b * z * z
    s[0] = sx
    s[1] = sy
    s[2] = sz
    s[3] = sw
    m[0, 0] = xx
    m[0, 1] = m[1, 0] = xy
    m[0, 2] = m[2, 0] = xz
    m[1, 1] = yy
    m[1, 2] = m[2, 1] = yz
    m[2, 2] = zz


@kernel
def centre(s, m):
    """Take the clock out of a receiver's moments: m − s sᵀ/Σw."""
    x, y, z = s[0], s[1], s[2]
    f = 1.0 / s[3]
    m[0, 0] -= f * x * x
    m[0, 1] -= f * x * y
    m[0, 2] -= f * x * z
    m[1, 0] = m[0, 1]
    m[1, 1] -= f * y * y
    m[1, 2] -= f * y * z
    m[2, 0] = m[0, 2]
    m[2, 1] = m[1, 2]
    m[2, 2] -= f * z * z


@kernel
def row_weights(weight, inverse, range2, visible, seen_all, w):
    """Set w = weight, less what is not seen; with free-space loss where range2 (reference range²) is positive."""
    for t in range(w.shape[0]):
        b = weight[t]
        if range2 > 0.0:
            b *= range2 * inverse[t] * inverse[t]
        w[t] = b
    if not seen_all:
        for t in range(w.shape[0]):
            w[t] *= visible[t]


@kernel
def dop_sums(transmitter, weight, visible, point, first, n, sums):
    """Sums over transmitters of w (1, u, u uᵀ) for BLOCK points from ``first`` on, the last one repeated; (sum, point).

    Points side by side, so that their sums do not wait for each other.
    """
    seen_all = visible.shape[0] == 0
    sums[:] = 0.0
    px, py, pz, w = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    for k in range(BLOCK):
        i = first + min(k, n - 1)
        px[k], py[k], pz[k] = point[i, 0], point[i, 1], point[i, 2]
    for t in range(transmitter.shape[1]):
        tx, ty, tz = transmitter[0, t], transmitter[1, t], transmitter[2, t]
        for k in range(BLOCK):
            w[k] = weight[t]
        if not seen_all:
            for k in range(BLOCK):
                w[k] *= visible[first + min(k, n - 1), t]
        for k in range(BLOCK):
            x, y, z = px[k] - tx, py[k] - ty, pz[k] - tz
            a = 1.0 / math.sqrt(x * x + y * y + z * z)
            x *= a
            y *= a
            z *= a
            sums[0, k] += w[k]
            sums[1, k] += w[k] * x
            sums[2, k] += w[k] * y
            sums[3, k] += w[k] * z
            sums[4, k] += w[k] * x * x
            sums[5, k] += w[k] * x * y
            sums[6, k] += w[k] * x * z
            sums[7, k] += w[k] * y * y
            sums[8, k] += w[k] * y * z
            sums[9, k] += w[k] * z * z


@kernel_rows
def dop_rows(begin, end, transmitter, weight, visible, point, out):
    """Dilution of position, plane and height of each point, (3, point), per unit of one transmitter's range sigma."""
    m, q, s = np.empty((3, 3)), np.empty((3, 3)), np.empty(4)
    sums = np.empty((10, BLOCK))
    for first in range(begin, end, BLOCK):
        n = min(BLOCK, end - first)
        dop_sums(transmitter, weight, visible, point, first, n, sums)
        for k in range(n):
            s[3], s[0], s[1], s[2] = sums[0, k], sums[1, k], sums[2, k], sums[3, k]
            m[0, 0], m[0, 1], m[0, 2] = sums[4, k], sums[5, k], sums[6, k]
            m[1, 1], m[1, 2], m[2, 2] = sums[7, k], sums[8, k], sums[9, k]
            centre(s, m)
            if invert(m, q):
                out[0, first + k] = math.sqrt(q[0, 0] + q[1, 1] + q[2, 2])
                out[1, first + k] = math.sqrt(q[0, 0] + q[1, 1])
                out[2, first + k] = math.sqrt(q[2, 2])


@kernel_rows
def tilt_independent(begin, end, field, plane_slope, own, common, n_min, out):
    """Variance of the normal [rad²] from fits of each receiver by itself; (mirror,).

    ``own``, ``common`` (group, transmitter): variances of a receiver's own noise and of the calibration's.
    """
    n_group, n_transmitter = own.shape
    n_receiver = field.place.shape[1]
    range2, visible = field.range2, field.visible
    seen_all = visible.shape[0] == 0
    calibrated = np.any(common > 0.0)
    arm = np.empty(3)
    jac = np.empty((n_receiver, 3, 3))
    u = np.empty((n_receiver, 3, n_transmitter))
    inverse = np.empty(n_transmitter)
    w = np.empty((n_receiver, n_group, n_transmitter))
    variance = np.empty((n_receiver, n_group, n_transmitter))
    mean = np.empty((n_receiver, n_group, 3))
    none = np.empty(n_transmitter, np.uint8)
    s = np.empty(4)
    part = np.empty((3, 3))
    m = np.empty((3, 3))
    q = np.empty((3, 3))
    gain = np.empty((n_receiver, 3, 3))
    for i in range(begin, end):
        turn_slopes(field.rot[i], plane_slope[i % plane_slope.shape[0]], jac)
        total = 0.0
        good = True
        for r in range(n_receiver):
            look(field, i, r, arm, u[r], inverse)
            mask = none if seen_all else visible[i, r]
            m[:] = 0.0
            seen = 0
            for g in range(n_group):
                for t in range(n_transmitter):
                    loss = 1.0
                    if range2 > 0.0:
                        loss = range2 * inverse[t] * inverse[t]
                    variance[r, g, t] = own[g, t] / loss
                    b = 1.0 / (variance[r, g, t] + common[g, t])
                    if not seen_all:
                        b *= mask[t]
                    w[r, g, t] = b
                moments(u[r], w[r, g], s, part)
                for a in range(3):
                    mean[r, g, a] = s[a] / s[3]
                    for b in range(3):
                        m[a, b] += part[a, b] - s[a] * s[b] / s[3]
            if not seen_all:
                for t in range(n_transmitter):
                    seen += mask[t]
                if seen < n_min:
                    good = False
            if not good or not invert(m, q):
                good = False
                break
            for a in range(3):
                for b in range(3):
                    gain[r, a, b] = jac[r, a, 0] * q[0, b] + jac[r, a, 1] * q[1, b] + jac[r, a, 2] * q[2, b]
            if not calibrated:
                for a in range(3):
                    for b in range(3):
                        total += gain[r, a, b] * jac[r, a, b]
        if not good:
            continue
        if calibrated:
            for g in range(n_group):
                for t in range(n_transmitter):
                    tx = ty = tz = 0.0
                    for r in range(n_receiver):
                        b = w[r, g, t]
                        x = b * (u[r, 0, t] - mean[r, g, 0])
                        y = b * (u[r, 1, t] - mean[r, g, 1])
                        z = b * (u[r, 2, t] - mean[r, g, 2])
                        vx = gain[r, 0, 0] * x + gain[r, 0, 1] * y + gain[r, 0, 2] * z
                        vy = gain[r, 1, 0] * x + gain[r, 1, 1] * y + gain[r, 1, 2] * z
                        vz = gain[r, 2, 0] * x + gain[r, 2, 1] * y + gain[r, 2, 2] * z
                        total += variance[r, g, t] * (vx * vx + vy * vy + vz * vz)
                        tx += vx
                        ty += vy
                        tz += vz
                    total += common[g, t] * (tx * tx + ty * ty + tz * tz)
        out[i] = total


@kernel
def eliminate(info, n, keep):
    """Cholesky-eliminate the first n − keep unknowns in place (lower triangle); False where one is unobserved."""
    for j in range(n - keep):
        d = info[j, j]
        if not d > 0.0:
            return False
        for a in range(j + 1, n):
            f = info[a, j] / d
            if f != 0.0:
                for b in range(j + 1, a + 1):
                    info[a, b] -= f * info[b, j]
    return True


@kernel
def add_receiver(info, arm, s, m, clock, first):
    """Add one receiver's observations: clock's place ``clock``, pivot's ``first``, rotation's ``first + 3``."""
    ax, ay, az = arm[0], arm[1], arm[2]
    for a in range(3):
        for b in range(a + 1):
            info[first + a, first + b] += m[a, b]
    info[clock, clock] += s[3]
    for b in range(3):
        # column b of M; (arm × column) is what the rotation sees
        cx, cy, cz = m[0, b], m[1, b], m[2, b]
        tx, ty, tz = torque(arm, cx, cy, cz)
        info[first + 3, first + b] += tx
        info[first + 4, first + b] += ty
        info[first + 5, first + b] += tz
    for a in range(3):
        if a == 0:
            k0, k1, k2 = 0.0, -az, ay
        elif a == 1:
            k0, k1, k2 = az, 0.0, -ax
        else:
            k0, k1, k2 = -ay, ax, 0.0
        # row a of [arm]× M
        x = k0 * m[0, 0] + k1 * m[1, 0] + k2 * m[2, 0]
        y = k0 * m[0, 1] + k1 * m[1, 1] + k2 * m[2, 1]
        z = k0 * m[0, 2] + k1 * m[1, 2] + k2 * m[2, 2]
        info[first + 3 + a, first + 3] += ay * z - az * y
        if a >= 1:
            info[first + 3 + a, first + 4] += az * x - ax * z
        if a == 2:
            info[first + 5, first + 5] += ax * y - ay * x
        info[first + a, clock] += s[a]
    tx, ty, tz = torque(arm, s[0], s[1], s[2])
    info[first + 3, clock] += tx
    info[first + 4, clock] += ty
    info[first + 5, clock] += tz


@kernel
def add_arm(ax, ay, az, m, pp, tp, tt):
    """Add a receiver's centred moments: pp += M, tp += [arm]× M, tt += [arm]× M [arm]×ᵀ (lower triangle)."""
    pp[0, 0] += m[0, 0]
    pp[0, 1] += m[0, 1]
    pp[0, 2] += m[0, 2]
    pp[1, 1] += m[1, 1]
    pp[1, 2] += m[1, 2]
    pp[2, 2] += m[2, 2]
    x0, y0, z0 = ay * m[2, 0] - az * m[1, 0], ay * m[2, 1] - az * m[1, 1], ay * m[2, 2] - az * m[1, 2]
    x1, y1, z1 = az * m[0, 0] - ax * m[2, 0], az * m[0, 1] - ax * m[2, 1], az * m[0, 2] - ax * m[2, 2]
    x2, y2, z2 = ax * m[1, 0] - ay * m[0, 0], ax * m[1, 1] - ay * m[0, 1], ax * m[1, 2] - ay * m[0, 2]
    tp[0, 0] += x0
    tp[0, 1] += y0
    tp[0, 2] += z0
    tp[1, 0] += x1
    tp[1, 1] += y1
    tp[1, 2] += z1
    tp[2, 0] += x2
    tp[2, 1] += y2
    tp[2, 2] += z2
    tt[0, 0] += ay * z0 - az * y0
    tt[1, 0] += ay * z1 - az * y1
    tt[1, 1] += az * x1 - ax * z1
    tt[2, 0] += ay * z2 - az * y2
    tt[2, 1] += az * x2 - ax * z2
    tt[2, 2] += ax * y2 - ay * x2


@kernel_rows
def tilt_calibrated(begin, end, field, weight, shared, pivot_info, roll_info, out):
    """Variance of the normal [rad²] of rigid mirrors with perfectly calibrated transmitters; (mirror,).

    ``weight`` (transmitter,) is the sum over tones. Clocks, one a receiver or one a mirror (``shared``), come off as
    means, the pivot as a block: far less arithmetic than `tilt_rigid`, and the same result.
    """
    n_transmitter = field.transmitter.shape[1]
    n_receiver = field.place.shape[1]
    range2, visible, rot = field.range2, field.visible, field.rot
    seen_all = visible.shape[0] == 0
    arm = np.empty(3)
    u = np.empty((3, n_transmitter))
    inverse = np.empty(n_transmitter)
    w = weight.copy()
    none = np.empty(n_transmitter, np.uint8)
    s = np.empty(4)
    m = np.empty((3, 3))
    q = np.empty((3, 3))
    pp = np.empty((3, 3))
    tp = np.empty((3, 3))
    tt = np.empty((3, 3))
    mean = np.empty(7)
    for i in range(begin, end):
        pp[:] = 0.0
        tp[:] = 0.0
        tt[:] = 0.0
        mean[:] = 0.0
        for r in range(n_receiver):
            look(field, i, r, arm, u, inverse)
            if not seen_all or range2 > 0.0:
                row_weights(weight, inverse, range2, none if seen_all else visible[i, r], seen_all, w)
            moments(u, w, s, m)
            if shared:
                mean[0] += s[0]
                mean[1] += s[1]
                mean[2] += s[2]
                x, y, z = torque(arm, s[0], s[1], s[2])
                mean[3] += x
                mean[4] += y
                mean[5] += z
                mean[6] += s[3]
            elif s[3] > 0.0:
                centre(s, m)
            add_arm(arm[0], arm[1], arm[2], m, pp, tp, tt)
        trace = pp[0, 0] + pp[1, 1] + pp[2, 2]
        turn = tt[0, 0] + tt[1, 1] + tt[2, 2]
        if shared:
            f = 1.0 / mean[6]
            for a in range(3):
                fa = f * mean[a]
                fb = f * mean[3 + a]
                for b in range(a, 3):
                    pp[a, b] -= fa * mean[b]
                for b in range(3):
                    tp[a, b] -= fb * mean[b]
                for b in range(a + 1):
                    tt[a, b] -= fb * mean[3 + b]
        for a in range(3):
            pp[a, a] += pivot_info
        if roll_info > 0.0:
            j0, j1 = rot[i, 1, 0], -rot[i, 0, 0]
            tt[0, 0] += roll_info * j0 * j0
            tt[1, 0] += roll_info * j0 * j1
            tt[1, 1] += roll_info * j1 * j1
        if not trace > 0.0 or not invert(pp, q):
            continue
        for a in range(3):
            x = tp[a, 0] * q[0, 0] + tp[a, 1] * q[1, 0] + tp[a, 2] * q[2, 0]
            y = tp[a, 0] * q[0, 1] + tp[a, 1] * q[1, 1] + tp[a, 2] * q[2, 1]
            z = tp[a, 0] * q[0, 2] + tp[a, 1] * q[1, 2] + tp[a, 2] * q[2, 2]
            for b in range(a + 1):
                m[a, b] = tt[a, b] - (x * tp[b, 0] + y * tp[b, 1] + z * tp[b, 2])
                m[b, a] = m[a, b]
        # what is left of the rotation must stand out of the rounding of what came off
        if m[0, 0] + m[1, 1] + m[2, 2] > FLOOR * turn and invert(m, q):
            out[i] = normal_variance(q, rot[i])


@kernel_rows
def tilt_rigid(begin, end, field, weight, bias_info, group_class, n_class, shared, tie, pivot_info, roll_info, out):
    """Variance of the normal [rad²] of rigid mirrors; (mirror,).

    ``weight``, ``bias_info`` (group, transmitter): 1/variance of own noise and of the transmitter's own error
    (infinite = perfectly calibrated, 0 = not at all). ``shared``: one clock a mirror and class; else one a receiver,
    whose differences have information ``tie`` a pair.
    """
    n_group, n_transmitter = weight.shape
    n_receiver = field.place.shape[1]
    range2, visible, rot = field.range2, field.visible, field.rot
    n_clock = 1 if shared else n_receiver
    first = n_class * n_clock
    size = first + 6
    seen_all = visible.shape[0] == 0
    uncalibrated = np.zeros(n_group, np.bool_)
    known = np.zeros(n_class, np.bool_)
    for g in range(n_group):
        for t in range(n_transmitter):
            if bias_info[g, t] < np.inf:
                uncalibrated[g] = True
            if bias_info[g, t] > 0.0:
                known[group_class[g]] = True
    info = np.zeros((size, size))
    arm = np.empty((n_receiver, 3))
    u = np.empty((n_receiver, 3, n_transmitter))
    inverse = np.empty((n_receiver, n_transmitter))
    w = np.empty((n_receiver, n_transmitter))
    none = np.empty(n_transmitter, np.uint8)
    s = np.empty(4)
    m = np.empty((3, 3))
    q = np.empty((3, 3))
    row = np.empty(size)
    before = np.empty(size)
    for i in range(begin, end):
        info[:] = 0.0
        for r in range(n_receiver):
            look(field, i, r, arm[r], u[r], inverse[r])
        for g in range(n_group):
            for r in range(n_receiver):
                mask = none if seen_all else visible[i, r]
                row_weights(weight[g], inverse[r], range2, mask, seen_all, w[r])
                clock = group_class[g] * n_clock + (0 if shared else r)
                moments(u[r], w[r], s, m)
                add_receiver(info, arm[r], s, m, clock, first)
            if uncalibrated[g]:
                for t in range(n_transmitter):
                    row[:] = 0.0
                    total = 0.0
                    for r in range(n_receiver):
                        b = w[r, t]
                        x, y, z = b * u[r, 0, t], b * u[r, 1, t], b * u[r, 2, t]
                        total += b
                        row[group_class[g] * n_clock + (0 if shared else r)] += b
                        row[first] += x
                        row[first + 1] += y
                        row[first + 2] += z
                        x, y, z = torque(arm[r], x, y, z)
                        row[first + 3] += x
                        row[first + 4] += y
                        row[first + 5] += z
                    if total > 0.0:
                        scale = 1.0 / (total + bias_info[g, t])
                        for a in range(size):
                            f = scale * row[a]
                            for b in range(a + 1):
                                info[a, b] -= f * row[b]
        for a in range(3):
            info[first + a, first + a] += pivot_info
        if roll_info > 0.0:
            j0, j1 = rot[i, 1, 0], -rot[i, 0, 0]
            info[first + 3, first + 3] += roll_info * j0 * j0
            info[first + 4, first + 3] += roll_info * j0 * j1
            info[first + 4, first + 4] += roll_info * j1 * j1
        for k in range(n_class):
            if not known[k]:
                # nothing tells a common clock from the transmitters' errors: hold the first, which says nothing
                info[k * n_clock, k * n_clock] += max(info[first, first], 1.0)
            if not shared and tie > 0.0:
                for a in range(n_clock):
                    for b in range(a):
                        ka, kb = k * n_clock + a, k * n_clock + b
                        info[ka, ka] += tie
                        info[kb, kb] += tie
                        info[ka, kb] -= tie
        for a in range(size):
            before[a] = info[a, a]
        if not eliminate(info, size, 3):
            continue
        good = True
        for a in range(size):
            if not info[a, a] > FLOOR * before[a]:
                good = False
        if not good:
            continue
        for a in range(3):
            for b in range(a + 1):
                m[a, b] = m[b, a] = info[first + 3 + a, first + 3 + b]
        if not invert(m, q):
            continue
        out[i] = normal_variance(q, rot[i])


@kernel_rows
def prior_rows(begin, end, prior, rot, out):
    """Information of ``prior`` on [pose, clocks] of each mirror; (mirror, unknown, unknown), lower triangle."""
    for i in range(begin, end):
        add_prior(prior, i, rot[i], out[i], 0, 6)
