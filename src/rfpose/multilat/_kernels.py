"""Kernels of multilateration: many receivers at once, one receiver a lane.

Receivers are taken in groups of `LANES`. A group's state lies in one flat workspace, quantity after quantity,
each `LANES` long, so that every loop over lanes runs over adjacent numbers at constant offsets and becomes
vector instructions. (An offset that is not constant would not: numba then tests each index for being negative,
which is why what belongs to one transmitter is a row of a two-dimensional array.) Lengths inside are in units of
the transmitters' extent about their centroid: `scale` and `centre` lead back to metres.

Symbols as in Swart et al. §3.4: unknowns (x, y, z, d_r), residual ε = |R − T| − d_r − Δ, Jacobian row
(u, −1) with u = (R − T)/|R − T|. The clock d_r is eliminated first (its pivot is the sum of the weights), which
leaves a symmetric 3×3 matrix M: the inverse of M is the covariance of the position.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.jit import kernel, kernel_rows

IntArray = npt.NDArray[np.signedinteger[Any]]

LANES = 16

# fates of a row; `rfpose.multilat.fix.FixStatus` gives them names
OK = 0
TOO_FEW = 1
NOT_FINITE = 2
SINGULAR = 3
NOT_CONVERGED = 4

# offsets of the quantities in the workspace
X, Y, Z, C = 0 * LANES, 1 * LANES, 2 * LANES, 3 * LANES
# sums over transmitters: weights, JᵀWJ without the clock, its clock column, JᵀWε
W = 4 * LANES
AXX, AXY, AXZ = 5 * LANES, 6 * LANES, 7 * LANES
AYY, AYZ, AZZ = 8 * LANES, 9 * LANES, 10 * LANES
BX, BY, BZ = 11 * LANES, 12 * LANES, 13 * LANES
GX, GY, GZ, GC = 14 * LANES, 15 * LANES, 16 * LANES, 17 * LANES
FIRST_SUM, LAST_SUM = W, GC
# more sums, for the linear equations only
BD, BS, DD = 18 * LANES, 19 * LANES, 20 * LANES
PX, PY, PZ = 21 * LANES, 22 * LANES, 23 * LANES
LAST_MOMENT = PZ
# inverse of M
QXX, QXY, QXZ = 24 * LANES, 25 * LANES, 26 * LANES
QYY, QYZ, QZZ = 27 * LANES, 28 * LANES, 29 * LANES
# bookkeeping
ACTIVE, BAD, SEEN = 30 * LANES, 31 * LANES, 32 * LANES
ITERATIONS, LAST_STEP2 = 33 * LANES, 34 * LANES
CHI2, DOP2 = 35 * LANES, 36 * LANES
WORKSPACE = 37 * LANES

TINY = 1e-30
# det(M) against the cube of its mean eigenvalue, below which M counts as singular
SINGULAR_DET = 1e-15


@kernel
def load_group(
    range_difference: FloatArray,
    weight: FloatArray,
    first: int,
    n_lane: int,
    inverse_scale: float,
    delta: FloatArray,
    w: FloatArray,
    ws: FloatArray,
) -> None:
    """Copy a group's rows into lanes; a missing transmitter gets weight zero. Unused lanes repeat the last row."""
    n_transmitter = range_difference.shape[1]
    shared = weight.shape[0] == 1
    for lane in range(LANES):
        row = first + min(lane, n_lane - 1)
        row_w = 0 if shared else row
        seen = 0.0
        for t in range(n_transmitter):
            value = range_difference[row, t]
            q = weight[row_w, t]
            received = abs(value) < np.inf and q > 0.0
            delta[t, lane] = value * inverse_scale if received else 0.0
            w[t, lane] = q if received else 0.0
            seen += 1.0 if received else 0.0
        ws[SEEN + lane] = seen


@kernel
def _moments(transmitter: FloatArray, t: int, delta: FloatArray, w: FloatArray, ws: FloatArray) -> None:
    """Add transmitters ``t`` and ``t + 1`` to the moments of the linear equations (see `start_group`)."""
    ax, ay, az = transmitter[t, 0], transmitter[t, 1], transmitter[t, 2]
    bx, by, bz = transmitter[t + 1, 0], transmitter[t + 1, 1], transmitter[t + 1, 2]
    a2 = ax * ax + ay * ay + az * az
    b2 = bx * bx + by * by + bz * bz
    for lane in range(LANES):
        da = delta[t, lane]
        db = delta[t + 1, lane]
        qa = w[t, lane]
        qb = w[t + 1, lane]
        sa = 0.5 * (a2 - da * da)
        sb = 0.5 * (b2 - db * db)
        qax = qa * ax
        qay = qa * ay
        qaz = qa * az
        qad = qa * da
        qbx = qb * bx
        qby = qb * by
        qbz = qb * bz
        qbd = qb * db
        ws[W + lane] += qa + qb
        ws[BX + lane] += qax + qbx
        ws[BY + lane] += qay + qby
        ws[BZ + lane] += qaz + qbz
        ws[BD + lane] += qad + qbd
        ws[BS + lane] += qa * sa + qb * sb
        ws[AXX + lane] += qax * ax + qbx * bx
        ws[AXY + lane] += qax * ay + qbx * by
        ws[AXZ + lane] += qax * az + qbx * bz
        ws[AYY + lane] += qay * ay + qby * by
        ws[AYZ + lane] += qay * az + qby * bz
        ws[AZZ + lane] += qaz * az + qbz * bz
        ws[PX + lane] += qax * da + qbx * db
        ws[PY + lane] += qay * da + qby * db
        ws[PZ + lane] += qaz * da + qbz * db
        ws[DD + lane] += qad * da + qbd * db
        ws[GX + lane] += qax * sa + qbx * sb
        ws[GY + lane] += qay * sa + qby * sb
        ws[GZ + lane] += qaz * sa + qbz * sb
        ws[GC + lane] += qad * sa + qbd * sb


@kernel
def _solve_linear(planar: float, ws: FloatArray) -> None:
    """Solve each lane's linear equations for position and clock."""
    for lane in range(LANES):
        iw = 1.0 / (ws[W + lane] + TINY)
        mx = ws[BX + lane] * iw
        my = ws[BY + lane] * iw
        mz = ws[BZ + lane] * iw
        md = ws[BD + lane] * iw
        sb = ws[BS + lane]
        axx = ws[AXX + lane] - mx * ws[BX + lane]
        axy = ws[AXY + lane] - mx * ws[BY + lane]
        axz = ws[AXZ + lane] - mx * ws[BZ + lane]
        ayy = ws[AYY + lane] - my * ws[BY + lane]
        ayz = ws[AYZ + lane] - my * ws[BZ + lane]
        azz = ws[AZZ + lane] - mz * ws[BZ + lane] + planar * ws[W + lane]
        px = ws[PX + lane] - md * ws[BX + lane]
        py = ws[PY + lane] - md * ws[BY + lane]
        pz = ws[PZ + lane] - md * ws[BZ + lane]
        dd = ws[DD + lane] - md * ws[BD + lane]
        gx = ws[GX + lane] - mx * sb
        gy = ws[GY + lane] - my * sb
        gz = ws[GZ + lane] - mz * sb
        gd = ws[GC + lane] - md * sb
        # the adjugate of the 3x3 block, then the clock from its Schur complement
        qxx = ayy * azz - ayz * ayz
        qxy = axz * ayz - axy * azz
        qxz = axy * ayz - axz * ayy
        qyy = axx * azz - axz * axz
        qyz = axy * axz - axx * ayz
        qzz = axx * ayy - axy * axy
        idet = 1.0 / (axx * qxx + axy * qxy + axz * qxz + TINY)
        rx = (qxx * gx + qxy * gy + qxz * gz) * idet
        ry = (qxy * gx + qyy * gy + qyz * gz) * idet
        rz = (qxz * gx + qyz * gy + qzz * gz) * idet
        sx = (qxx * px + qxy * py + qxz * pz) * idet
        sy = (qxy * px + qyy * py + qyz * pz) * idet
        sz = (qxz * px + qyz * py + qzz * pz) * idet
        clock = (gd - px * rx - py * ry - pz * rz) / (dd - px * sx - py * sy - pz * sz + TINY)
        ws[X + lane] = rx - clock * sx
        ws[Y + lane] = ry - clock * sy
        ws[Z + lane] = rz - clock * sz
        ws[C + lane] = clock


@kernel
def start_group(transmitter: FloatArray, delta: FloatArray, w: FloatArray, planar: float, ws: FloatArray) -> None:
    """Start from the linear equations: T·R + Δ d_r − ½(|R|² − d_r²) = ½(|T|² − Δ²), five unknowns."""
    for k in range(FIRST_SUM, LAST_MOMENT + LANES):
        ws[k] = 0.0
    for t in range(0, transmitter.shape[0], 2):
        _moments(transmitter, t, delta, w, ws)
    _solve_linear(planar, ws)


@kernel
def start_given(
    start: FloatArray,
    first: int,
    n_lane: int,
    n_transmitter: int,
    delta: FloatArray,
    w: FloatArray,
    transmitter: FloatArray,
    ws: FloatArray,
) -> None:
    """Start from given positions, with the clock that fits them best."""
    for lane in range(LANES):
        row = min(first + min(lane, n_lane - 1), start.shape[0] - 1)
        ws[X + lane] = start[row, 0]
        ws[Y + lane] = start[row, 1]
        ws[Z + lane] = start[row, 2]
        total = 0.0
        q_total = TINY
        for t in range(n_transmitter):
            dx = start[row, 0] - transmitter[t, 0]
            dy = start[row, 1] - transmitter[t, 1]
            dz = start[row, 2] - transmitter[t, 2]
            q = w[t, lane]
            total += q * (math.sqrt(dx * dx + dy * dy + dz * dz) - delta[t, lane])
            q_total += q
        ws[C + lane] = total / q_total


@kernel
def _normal_equations(transmitter: FloatArray, t: int, delta: FloatArray, w: FloatArray, ws: FloatArray) -> None:
    """Add transmitters ``t`` and ``t + 1`` to JᵀWJ and JᵀWε. Two at a time halve the traffic of the sums."""
    ax, ay, az = transmitter[t, 0], transmitter[t, 1], transmitter[t, 2]
    bx, by, bz = transmitter[t + 1, 0], transmitter[t + 1, 1], transmitter[t + 1, 2]
    for lane in range(LANES):
        x = ws[X + lane]
        y = ws[Y + lane]
        z = ws[Z + lane]
        clock = ws[C + lane]
        ux = x - ax
        uy = y - ay
        uz = z - az
        vx = x - bx
        vy = y - by
        vz = z - bz
        u2 = ux * ux + uy * uy + uz * uz + TINY
        v2 = vx * vx + vy * vy + vz * vz + TINY
        iu = 1.0 / math.sqrt(u2)
        iv = 1.0 / math.sqrt(v2)
        qu = w[t, lane]
        qv = w[t + 1, lane]
        eu = u2 * iu - clock - delta[t, lane]
        ev = v2 * iv - clock - delta[t + 1, lane]
        ux *= iu
        uy *= iu
        uz *= iu
        vx *= iv
        vy *= iv
        vz *= iv
        qux = qu * ux
        quy = qu * uy
        quz = qu * uz
        qvx = qv * vx
        qvy = qv * vy
        qvz = qv * vz
        ws[AXX + lane] += qux * ux + qvx * vx
        ws[AXY + lane] += qux * uy + qvx * vy
        ws[AXZ + lane] += qux * uz + qvx * vz
        ws[AYY + lane] += quy * uy + qvy * vy
        ws[AYZ + lane] += quy * uz + qvy * vz
        ws[AZZ + lane] += quz * uz + qvz * vz
        ws[BX + lane] += qux + qvx
        ws[BY + lane] += quy + qvy
        ws[BZ + lane] += quz + qvz
        ws[GX + lane] += qux * eu + qvx * ev
        ws[GY + lane] += quy * eu + qvy * ev
        ws[GZ + lane] += quz * eu + qvz * ev
        ws[GC + lane] += qu * eu + qv * ev
        ws[W + lane] += qu + qv


@kernel
def _invert(planar: float, ws: FloatArray) -> None:
    """Eliminate the clock and invert what is left; a singular lane is marked."""
    for lane in range(LANES):
        iw = 1.0 / (ws[W + lane] + TINY)
        bx = ws[BX + lane]
        by = ws[BY + lane]
        bz = ws[BZ + lane]
        mxx = ws[AXX + lane] - bx * bx * iw
        mxy = ws[AXY + lane] - bx * by * iw
        mxz = ws[AXZ + lane] - bx * bz * iw
        myy = ws[AYY + lane] - by * by * iw
        myz = ws[AYZ + lane] - by * bz * iw
        mzz = ws[AZZ + lane] - bz * bz * iw + planar * ws[W + lane]
        qxx = myy * mzz - myz * myz
        qxy = mxz * myz - mxy * mzz
        qxz = mxy * myz - mxz * myy
        det = mxx * qxx + mxy * qxy + mxz * qxz
        trace = mxx + myy + mzz
        bad = 0.0 if det > SINGULAR_DET * trace * trace * trace else 1.0
        idet = (1.0 - bad) / (det + TINY)
        ws[BAD + lane] = bad
        ws[QXX + lane] = qxx * idet
        ws[QXY + lane] = qxy * idet
        ws[QXZ + lane] = qxz * idet
        ws[QYY + lane] = (mxx * mzz - mxz * mxz) * idet
        ws[QYZ + lane] = (mxy * mxz - mxx * myz) * idet
        ws[QZZ + lane] = (mxx * myy - mxy * mxy) * idet


@kernel
def _step(tolerance2: float, relax: float, ws: FloatArray) -> float:
    """Take each active lane's Gauss-Newton step and return how many lanes are still on their way.

    ``relax`` below one takes part of each step: where residuals are large, full steps can swing to and fro.
    A step longer than the transmitters' extent is shortened to it. A lane has arrived when its next step, foretold
    from the last two as of a sequence that converges linearly (near the solution it does better), is below the
    tolerance in standard deviations, or when this one was below what float64 resolves.
    """
    for lane in range(LANES):
        iw = 1.0 / (ws[W + lane] + TINY)
        bx = ws[BX + lane]
        by = ws[BY + lane]
        bz = ws[BZ + lane]
        gc = ws[GC + lane]
        hx = ws[GX + lane] - bx * gc * iw
        hy = ws[GY + lane] - by * gc * iw
        hz = ws[GZ + lane] - bz * gc * iw
        sx = -(ws[QXX + lane] * hx + ws[QXY + lane] * hy + ws[QXZ + lane] * hz)
        sy = -(ws[QXY + lane] * hx + ws[QYY + lane] * hy + ws[QYZ + lane] * hz)
        sz = -(ws[QXZ + lane] * hx + ws[QYZ + lane] * hy + ws[QZZ + lane] * hz)
        in_sigma2 = -(sx * hx + sy * hy + sz * hz)
        length2 = sx * sx + sy * sy + sz * sz
        shorten = relax * ws[ACTIVE + lane] / math.sqrt(max(length2, 1.0))
        ws[X + lane] += shorten * sx
        ws[Y + lane] += shorten * sy
        ws[Z + lane] += shorten * sz
        # the clock that fits best after the step: linear in the step, not shortened with it
        ws[C + lane] += ws[ACTIVE + lane] * ((gc + shorten * (bx * sx + by * sy + bz * sz)) * iw)
        ws[ITERATIONS + lane] += ws[ACTIVE + lane]
        arrived = in_sigma2 * in_sigma2 < tolerance2 * ws[LAST_STEP2 + lane] or length2 < 1e-28
        ws[LAST_STEP2 + lane] = in_sigma2
        ws[ACTIVE + lane] = 0.0 if arrived or ws[BAD + lane] > 0.0 else ws[ACTIVE + lane]
    active = 0.0
    for lane in range(LANES):
        active += ws[ACTIVE + lane]
    return active


@kernel
def _linearise(transmitter: FloatArray, delta: FloatArray, w: FloatArray, ws: FloatArray) -> None:
    """Form the normal equations of all lanes at their present position."""
    for k in range(FIRST_SUM, LAST_SUM + LANES):
        ws[k] = 0.0
    for t in range(0, transmitter.shape[0], 2):
        _normal_equations(transmitter, t, delta, w, ws)


@kernel
def iterate_group(
    transmitter: FloatArray,
    delta: FloatArray,
    w: FloatArray,
    planar: float,
    max_iteration: int,
    tolerance2: float,
    relax: float,
    n_min: int,
    ws: FloatArray,
) -> None:
    """Iterate until every lane with enough transmitters has arrived, is singular, or has had its turns."""
    for lane in range(LANES):
        ws[ACTIVE + lane] = 1.0 if ws[SEEN + lane] >= n_min else 0.0
        ws[ITERATIONS + lane] = 0.0
        ws[LAST_STEP2 + lane] = 0.0
    for _ in range(max_iteration):
        _linearise(transmitter, delta, w, ws)
        _invert(planar, ws)
        if not _step(tolerance2, relax, ws) > 0.0:
            break


@kernel
def _residuals(
    transmitter: FloatArray, t: int, delta: FloatArray, w: FloatArray, ws: FloatArray, residual: FloatArray
) -> None:
    """One transmitter's residuals, and their share of chi-squared."""
    tx, ty, tz = transmitter[t, 0], transmitter[t, 1], transmitter[t, 2]
    for lane in range(LANES):
        dx = ws[X + lane] - tx
        dy = ws[Y + lane] - ty
        dz = ws[Z + lane] - tz
        error = math.sqrt(dx * dx + dy * dy + dz * dz) - ws[C + lane] - delta[t, lane]
        residual[t, lane] = error
        ws[CHI2 + lane] += w[t, lane] * error * error


@kernel
def _unequal(n_transmitter: int, w: FloatArray, ws: FloatArray) -> float:
    """Count lanes whose received transmitters differ in weight; each lane's largest weight goes to DOP2."""
    for lane in range(LANES):
        ws[DOP2 + lane] = 0.0
        ws[DD + lane] = 1e300
    for t in range(n_transmitter):
        for lane in range(LANES):
            q = w[t, lane]
            largest = ws[DOP2 + lane]
            smallest = ws[DD + lane]
            received = q if q > 0.0 else 1e300
            ws[DOP2 + lane] = q if q > largest else largest
            ws[DD + lane] = received if received < smallest else smallest
    count = 0.0
    for lane in range(LANES):
        count += 1.0 if ws[DOP2 + lane] > ws[DD + lane] else 0.0
    return count


@kernel
def dop_group(
    transmitter: FloatArray, delta: FloatArray, w: FloatArray, planar: float, even: FloatArray, ws: FloatArray
) -> None:
    """Squared position DOP: as if every transmitter that was received had the same weight."""
    height = 1.0 - planar
    if _unequal(transmitter.shape[0], w, ws) == 0.0:
        for lane in range(LANES):
            ws[DOP2 + lane] *= ws[QXX + lane] + ws[QYY + lane] + height * ws[QZZ + lane]
        return
    keep = ws[QXX : BAD + LANES].copy()
    for t in range(w.shape[0]):
        for lane in range(LANES):
            even[t, lane] = 1.0 if w[t, lane] > 0.0 else 0.0
    _linearise(transmitter, delta, even, ws)
    _invert(planar, ws)
    for lane in range(LANES):
        ws[DOP2 + lane] = ws[QXX + lane] + ws[QYY + lane] + height * ws[QZZ + lane]
    for a in range(keep.shape[0]):  # an assignment of slices compiles to much more
        ws[QXX + a] = keep[a]


@kernel
def residual_group(
    n_transmitter: int,
    transmitter: FloatArray,
    delta: FloatArray,
    w: FloatArray,
    ws: FloatArray,
    residual: FloatArray,
) -> None:
    """Residuals and chi-squared at the solution."""
    for lane in range(LANES):
        ws[CHI2 + lane] = 0.0
    for t in range(n_transmitter):
        _residuals(transmitter, t, delta, w, ws, residual)


@kernel
def store_group(
    first: int,
    n_lane: int,
    scale: float,
    centre: FloatArray,
    planar: float,
    w: FloatArray,
    error: FloatArray,
    n_min: int,
    ws: FloatArray,
    position: FloatArray,
    clock: FloatArray,
    cov: FloatArray,
    dop: FloatArray,
    residual: FloatArray,
    chi2: FloatArray,
    n_seen: IntArray,
    n_iteration: IntArray,
    fate: IntArray,
) -> None:
    """Write a group's lanes to the result arrays in metres; a row without a solution is NaN."""
    n_transmitter = residual.shape[1]
    n_axis = position.shape[1]
    scale2 = scale * scale
    for lane in range(n_lane):
        i = first + lane
        n_seen[i] = int(ws[SEEN + lane])
        n_iteration[i] = int(ws[ITERATIONS + lane])
        if ws[SEEN + lane] < n_min:
            fate[i] = NOT_FINITE if ws[SEEN + lane] == 0.0 else TOO_FEW
        elif ws[BAD + lane] > 0.0:
            fate[i] = SINGULAR
        elif ws[ACTIVE + lane] > 0.0 or not ws[CHI2 + lane] < np.inf:
            fate[i] = NOT_CONVERGED
        else:
            fate[i] = OK
        if fate[i] != OK:
            for a in range(n_axis):
                position[i, a] = np.nan
                for b in range(n_axis):
                    cov[i, a, b] = np.nan
            for t in range(n_transmitter):
                residual[i, t] = np.nan
            clock[i] = np.nan
            dop[i] = np.nan
            chi2[i] = np.nan
            continue
        position[i, 0] = ws[X + lane] * scale + centre[0]
        position[i, 1] = ws[Y + lane] * scale + centre[1]
        cov[i, 0, 0] = ws[QXX + lane] * scale2
        cov[i, 0, 1] = ws[QXY + lane] * scale2
        cov[i, 1, 0] = ws[QXY + lane] * scale2
        cov[i, 1, 1] = ws[QYY + lane] * scale2
        if n_axis == 3:
            position[i, 2] = ws[Z + lane] * scale + centre[2]
            cov[i, 0, 2] = ws[QXZ + lane] * scale2
            cov[i, 2, 0] = ws[QXZ + lane] * scale2
            cov[i, 1, 2] = ws[QYZ + lane] * scale2
            cov[i, 2, 1] = ws[QYZ + lane] * scale2
            cov[i, 2, 2] = ws[QZZ + lane] * scale2
        clock[i] = ws[C + lane] * scale
        dop[i] = math.sqrt(ws[DOP2 + lane])
        chi2[i] = ws[CHI2 + lane]
        for t in range(n_transmitter):
            residual[i, t] = error[t, lane] * scale if w[t, lane] > 0.0 else np.nan


@kernel_rows
def locate_rows(
    begin: int,
    end: int,
    transmitter: FloatArray,
    range_difference: FloatArray,
    weight: FloatArray,
    start: FloatArray,
    scale: float,
    centre: FloatArray,
    planar: float,
    max_iteration: int,
    tolerance2: float,
    relax: float,
    n_min: int,
    position: FloatArray,
    clock: FloatArray,
    cov: FloatArray,
    dop: FloatArray,
    residual: FloatArray,
    chi2: FloatArray,
    n_seen: IntArray,
    n_iteration: IntArray,
    fate: IntArray,
) -> None:
    """Locate the rows of ``range_difference`` in its groups ``begin`` to ``end`` of `LANES` each.

    ``transmitter`` and ``start`` are centred and scaled; ``transmitter`` has an even number of rows, the last of
    which may be beyond the columns of ``range_difference`` and then has no weight. ``range_difference`` is in
    metres; ``weight`` is (scale/σ)², one row for all or one a row. An empty ``start`` means the linear equations.
    ``planar`` is 1 for two dimensions (all z are zero), else 0.
    """
    n = range_difference.shape[0]
    n_transmitter = transmitter.shape[0]
    ws = np.zeros(WORKSPACE)
    delta = np.zeros((n_transmitter, LANES))
    w = np.zeros((n_transmitter, LANES))
    error = np.empty((n_transmitter, LANES))
    for group in range(begin, end):
        first = group * LANES
        n_lane = min(LANES, n - first)
        load_group(range_difference, weight, first, n_lane, 1.0 / scale, delta, w, ws)
        if start.shape[0] == 0:
            start_group(transmitter, delta, w, planar, ws)
        else:
            start_given(start, first, n_lane, n_transmitter, delta, w, transmitter, ws)
        iterate_group(transmitter, delta, w, planar, max_iteration, tolerance2, relax, n_min, ws)
        dop_group(transmitter, delta, w, planar, error, ws)
        residual_group(range_difference.shape[1], transmitter, delta, w, ws, error)
        store_group(
            first, n_lane, scale, centre, planar, w, error, n_min, ws,
            position, clock, cov, dop, residual, chi2, n_seen, n_iteration, fate,
        )  # fmt: skip


@kernel
def gain(
    transmitter: FloatArray, x: float, y: float, z: float, weight: FloatArray, h: FloatArray, u: FloatArray
) -> None:
    """Fill ``h`` (3, transmitter) with the position's part of (JᵀWJ)⁻¹JᵀW; NaN where it does not exist.

    A weight that is not positive, or NaN, means a missing transmitter, whose column is zero.
    """
    n_transmitter = transmitter.shape[0]
    m = np.zeros((3, 3))
    b = np.zeros(3)
    total = 0.0
    seen = 0
    for t in range(n_transmitter):
        dx = x - transmitter[t, 0]
        dy = y - transmitter[t, 1]
        dz = z - transmitter[t, 2]
        inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz + TINY)
        u[0, t] = dx * inverse
        u[1, t] = dy * inverse
        u[2, t] = dz * inverse
        if weight[t] > 0.0:
            seen += 1
            total += weight[t]
            for i in range(3):
                b[i] += weight[t] * u[i, t]
    for i in range(3):
        b[i] /= total + TINY
    for t in range(n_transmitter):
        if weight[t] > 0.0:
            for i in range(3):
                for j in range(3):
                    m[i, j] += weight[t] * (u[i, t] - b[i]) * (u[j, t] - b[j])
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    c01 = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c02 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    c11 = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    c12 = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    c22 = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    det = m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    solvable = seen >= 5 and det > SINGULAR_DET * trace * trace * trace
    for t in range(n_transmitter):
        if not solvable:
            h[0, t] = np.nan
            h[1, t] = np.nan
            h[2, t] = np.nan
            continue
        q = weight[t] / det if weight[t] > 0.0 else 0.0
        ex = q * (u[0, t] - b[0])
        ey = q * (u[1, t] - b[1])
        ez = q * (u[2, t] - b[2])
        h[0, t] = c00 * ex + c01 * ey + c02 * ez
        h[1, t] = c01 * ex + c11 * ey + c12 * ez
        h[2, t] = c02 * ex + c12 * ey + c22 * ez


@kernel
def joint_covariances(
    transmitter: FloatArray, position: FloatArray, own: FloatArray, common: FloatArray, out: FloatArray
) -> None:
    """Joint covariance of each row's receivers: own noise apart, calibration noise together."""
    n, n_receiver, n_transmitter = own.shape
    h = np.empty((n_receiver, 3, n_transmitter))
    u = np.empty((3, n_transmitter))
    weight = np.empty(n_transmitter)
    for i in range(n):
        for r in range(n_receiver):
            for t in range(n_transmitter):
                variance = own[i, r, t] ** 2 + common[i, r, t] ** 2
                weight[t] = 1.0 / variance
            gain(transmitter, position[i, r, 0], position[i, r, 1], position[i, r, 2], weight, h[r], u)
        for r in range(n_receiver):
            for s in range(r + 1):
                for a in range(3):
                    for b in range(3):
                        total = 0.0
                        for t in range(n_transmitter):
                            g = h[r, a, t] * h[s, b, t]
                            if g == 0.0:
                                continue
                            variance = common[i, r, t] * common[i, s, t]
                            if r == s:
                                variance += own[i, r, t] ** 2
                            total += g * variance
                        out[i, 3 * r + a, 3 * s + b] = total
                        out[i, 3 * s + b, 3 * r + a] = total
