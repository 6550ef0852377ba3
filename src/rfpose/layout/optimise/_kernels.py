"""Kernels of placement: what is minimised, with its derivative by every transmitter's position."""

from __future__ import annotations

import numpy as np

from rfpose.jit import kernel, kernel_rows
from rfpose.layout._kernels import FLOOR, arm_of, directions, invert, torque, turn_slopes

DOP, INDEPENDENT, RIGID, SHARED = 0, 1, 2, 3


@kernel_rows
def objective_rows(begin, end, method, transmitter, place, pivot, rot, weight, plane_slope, value, gradient):
    """Variance at each field point and its derivative by every transmitter's position.

    ``transmitter`` (site, xyz, transmitter), ``place``, ``pivot`` and ``rot`` as in `FieldArrays`, ``value`` (site,
    point), ``gradient`` (site, point, transmitter, xyz); the row of a site's point is site · points + point.
    ``method`` is DOP (position, ``place`` unused), INDEPENDENT, RIGID or SHARED; calibration is perfect, all is seen.
    Writing the variance as tr(G N⁻¹) with N = Σ w ĵ ĵᵀ over centred rows, its change is −2 Σ w ĵᵀ (N⁻¹GN⁻¹) dj.
    """
    n_point, n_transmitter = pivot.shape[0], transmitter.shape[2]
    n_receiver = 1 if method == DOP else place.shape[1]
    size = 3 if method <= INDEPENDENT else 6
    u = np.empty((n_receiver, 3, n_transmitter))
    inverse = np.empty((n_receiver, n_transmitter))
    row = np.empty((n_receiver, n_transmitter, 6))
    arm = np.zeros((n_receiver, 3))
    jac = np.empty((n_receiver, 3, 3))
    mean = np.empty((n_receiver, 6))
    info = np.empty((6, 6))
    weighed = np.empty((6, 6))
    cov = np.empty((6, 6))
    q3 = np.empty((3, 3))
    for k in range(begin, end):
        site, i = k // n_point, k % n_point
        if method == INDEPENDENT:
            turn_slopes(rot[i], plane_slope[i % plane_slope.shape[0]], jac)
        for r in range(n_receiver):
            if method != DOP:
                arm_of(rot[i], place[i % place.shape[0], r], arm[r])
            x, y, z = pivot[i, 0] + arm[r, 0], pivot[i, 1] + arm[r, 1], pivot[i, 2] + arm[r, 2]
            directions(transmitter[site], x, y, z, u[r], inverse[r])
        fill_rows(u, arm, weight, size, method == SHARED, row, mean)
        total = 0.0
        info[:] = 0.0
        for r in range(n_receiver):
            if size == 3:
                info[:] = 0.0
            for t in range(n_transmitter):
                for a in range(size):
                    f = weight[t] * row[r, t, a]
                    for b in range(a + 1):
                        info[a, b] += f * row[r, t, b]
            if size == 3:
                mirror_up(info, 3)
                if not invert(info, q3):
                    total = np.nan
                    break
                total += weigh_position(method, q3, jac[r], weighed)
                add_gradient(r, 3, weight, row, u, inverse, arm, weighed, gradient[site, i])
        if size == 6:
            mirror_up(info, 6)
            if invert_spd(info, 6, cov):
                total = weigh_rotation(cov, rot[i], weighed)
                for r in range(n_receiver):
                    add_gradient(r, 6, weight, row, u, inverse, arm, weighed, gradient[site, i])
            else:
                total = np.nan
        value[site, i] = total


@kernel
def fill_rows(u, arm, weight, size, shared, row, mean):
    """Rows of the Jacobian less their mean: over the receiver's transmitters, or over all where a clock is shared."""
    n_receiver, n_transmitter = row.shape[0], row.shape[1]
    total = 0.0
    for t in range(n_transmitter):
        total += weight[t]
    for r in range(n_receiver):
        mean[r] = 0.0
        for t in range(n_transmitter):
            x, y, z = u[r, 0, t], u[r, 1, t], u[r, 2, t]
            row[r, t, 0] = x
            row[r, t, 1] = y
            row[r, t, 2] = z
            row[r, t, 3], row[r, t, 4], row[r, t, 5] = torque(arm[r], x, y, z)
            for a in range(size):
                mean[r, a] += weight[t] / total * row[r, t, a]
    for a in range(size):
        if shared:
            s = 0.0
            for r in range(n_receiver):
                s += mean[r, a] / n_receiver
            for r in range(n_receiver):
                mean[r, a] = s
        for r in range(n_receiver):
            for t in range(n_transmitter):
                row[r, t, a] -= mean[r, a]


@kernel
def mirror_up(a, n):
    """Fill the upper triangle from the lower."""
    for i in range(n):
        for j in range(i):
            a[j, i] = a[i, j]


@kernel
def invert_spd(a, n, out):
    """Set out = a⁻¹ of a positive definite matrix by Gauss-Jordan on a copy; False where it is singular."""
    work = a[:n, :n].copy()
    out[:n, :n] = 0.0
    for i in range(n):
        out[i, i] = 1.0
    for j in range(n):
        p = work[j, j]
        if not p > FLOOR * a[j, j]:
            return False
        for k in range(n):
            work[j, k] /= p
            out[j, k] /= p
        for i in range(n):
            if i != j:
                f = work[i, j]
                for k in range(n):
                    work[i, k] -= f * work[j, k]
                    out[i, k] -= f * out[j, k]
    return True


@kernel
def weigh_position(method, q, jac, weighed):
    """Return tr(B q), and weighed = q B q, with B the identity (dilution) or jacᵀ jac (normal)."""
    total = 0.0
    for a in range(3):
        for b in range(3):
            weighed[a, b] = 0.0
    for k in range(3):
        # row k of jac q, or of q
        x = y = z = 0.0
        if method == DOP:
            x, y, z = q[k, 0], q[k, 1], q[k, 2]
            total += q[k, k]
        else:
            for c in range(3):
                x += jac[k, c] * q[c, 0]
                y += jac[k, c] * q[c, 1]
                z += jac[k, c] * q[c, 2]
            total += x * jac[k, 0] + y * jac[k, 1] + z * jac[k, 2]
        v = (x, y, z)
        for a in range(3):
            for b in range(3):
                weighed[a, b] += v[a] * v[b]
    return total


@kernel
def weigh_rotation(cov, rot, weighed):
    """Return the normal's variance, and weighed = C G C with G the rotation's part across the normal."""
    total = 0.0
    for a in range(6):
        for b in range(6):
            weighed[a, b] = 0.0
    for axis in range(2):
        # tilts about the mirror's x and y axes
        for a in range(6):
            x = 0.0
            for c in range(3):
                x += cov[a, 3 + c] * rot[c, axis]
            weighed[a, a] += x * x
            if a >= 3:
                total += x * rot[a - 3, axis]
            for b in range(a):
                y = 0.0
                for c in range(3):
                    y += cov[b, 3 + c] * rot[c, axis]
                weighed[a, b] += x * y
                weighed[b, a] += x * y
    return total


@kernel
def add_gradient(r, size, weight, row, u, inverse, arm, weighed, gradient):
    """Add one receiver's part of the derivative of the variance by the transmitters' positions."""
    v = np.empty(6)
    for t in range(weight.shape[0]):
        for a in range(size):
            s = 0.0
            for b in range(size):
                s += weighed[a, b] * row[r, t, b]
            v[a] = s
        x, y, z = v[0], v[1], v[2]
        if size == 6:
            # (arm × du) · v = du · (v × arm)
            x += v[4] * arm[r, 2] - v[5] * arm[r, 1]
            y += v[5] * arm[r, 0] - v[3] * arm[r, 2]
            z += v[3] * arm[r, 1] - v[4] * arm[r, 0]
        along = x * u[r, 0, t] + y * u[r, 1, t] + z * u[r, 2, t]
        # du = −(I − u uᵀ)/d dT, so the minus of −2 Σ … turns
        f = 2.0 * weight[t] * inverse[r, t]
        gradient[t, 0] += f * (x - along * u[r, 0, t])
        gradient[t, 1] += f * (y - along * u[r, 1, t])
        gradient[t, 2] += f * (z - along * u[r, 2, t])
