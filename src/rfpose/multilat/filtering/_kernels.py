"""Filter of moving mirrors over frames: one error-state Kalman filter a mirror.

State: pivot p, rotation R (enu from mirror), rate ω (rotation vector a second, ENU). Error state [δp, δθ, δω] with
R = exp(δθ) R̂. Between frames R ← exp(ω dt) R and ω walks with spectral density q; p walks with its own.
"""

from __future__ import annotations

import math

import numpy as np

from rfpose.jit import kernel, kernel_rows
from rfpose.multilat.equations._kernels import rotate

N = 9

# what became of a frame; `rfpose.multilat.filtering.FilterStatus` gives them names
UNKNOWN = 0
UPDATED = 1
STARTED = 2
COASTED = 3
GATED = 4
RESTARTED = 5
LOST = 6

# parts of a rejected measurement that contradict the prediction
POSITION = 1
ROTATION = 2


@kernel
def rotation_vector(rot, out):
    """Logarithm of a rotation: the vector whose `rotate` it is."""
    x = 0.5 * (rot[2, 1] - rot[1, 2])
    y = 0.5 * (rot[0, 2] - rot[2, 0])
    z = 0.5 * (rot[1, 0] - rot[0, 1])
    sine = math.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (rot[0, 0] + rot[1, 1] + rot[2, 2] - 1.0)
    angle = math.atan2(sine, cosine)
    if sine > 1e-9:
        scale = angle / sine
        out[0], out[1], out[2] = scale * x, scale * y, scale * z
    elif cosine > 0.0:
        out[0], out[1], out[2] = x, y, z
    else:
        # half a turn: the axis is the column of R + I that is longest
        k = 0
        for a in range(1, 3):
            if rot[a, a] > rot[k, k]:
                k = a
        norm = math.sqrt(2.0 * (1.0 + rot[k, k]))
        for a in range(3):
            out[a] = math.pi * (rot[a, k] + (1.0 if a == k else 0.0)) / norm


@kernel
def left_jacobian(theta, out):
    """J with exp(θ + δ) ≈ exp(J δ) exp(θ)."""
    angle2 = theta[0] ** 2 + theta[1] ** 2 + theta[2] ** 2
    angle = math.sqrt(angle2)
    if angle > 1e-4:
        a = (1.0 - math.cos(angle)) / angle2
        b = (angle - math.sin(angle)) / (angle2 * angle)
    else:
        a, b = 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    x, y, z = theta
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    square = cross @ cross
    for i in range(3):
        for j in range(3):
            out[i, j] = (1.0 if i == j else 0.0) + a * cross[i, j] + b * square[i, j]


@kernel
def propagate(dt, walk_rate, walk_pivot, rot, rate, cov):
    """Carry rotation and covariance ``dt`` seconds on (back, if negative); pivot and rate stay."""
    theta = dt * rate
    turn, jacobian = np.empty((3, 3)), np.empty((3, 3))
    rotate(theta, np.eye(3), turn)
    left_jacobian(theta, jacobian)
    f = np.eye(N)
    for a in range(3):
        for b in range(3):
            f[3 + a, 3 + b] = turn[a, b]
            f[3 + a, 6 + b] = dt * jacobian[a, b]
    cov[:] = f @ cov @ f.T
    size = abs(dt)
    for a in range(3):
        cov[a, a] += walk_pivot * size
        cov[3 + a, 3 + a] += walk_rate * size**3 / 3.0
        cov[3 + a, 6 + a] += walk_rate * size * dt / 2.0
        cov[6 + a, 3 + a] += walk_rate * size * dt / 2.0
        cov[6 + a, 6 + a] += walk_rate * size
    rot[:] = turn @ rot


@kernel
def innovation(pivot, rot, measured_pivot, measured_rot, out):
    """Measured less predicted pose: shift and rotation vector, ENU."""
    for a in range(3):
        out[a] = measured_pivot[a] - pivot[a]
    rotation_vector(measured_rot @ rot.T, out[3:])


@kernel
def distance2(left, cov):
    """Squared Mahalanobis distance; NaN where the covariance is singular."""
    n = len(left)
    lower = np.zeros((n, n))
    x = np.empty(n)
    total = 0.0
    for i in range(n):
        for j in range(i + 1):
            s = cov[i, j]
            for k in range(j):
                s -= lower[i, k] * lower[j, k]
            if i == j:
                if not s > 0.0:
                    return np.nan
                lower[i, i] = math.sqrt(s)
            else:
                lower[i, j] = s / lower[j, j]
        s = left[i]
        for k in range(i):
            s -= lower[i, k] * x[k]
        x[i] = s / lower[i, i]
        total += x[i] * x[i]
    return total


@kernel
def update(left, noise, pivot, rot, rate, cov):
    """Take in a measured pose: innovation ``left``, its own covariance ``noise`` (6, 6)."""
    total = cov[:6, :6] + noise
    gain = np.ascontiguousarray(np.linalg.solve(total, np.ascontiguousarray(cov[:6, :])).T)
    step = gain @ left
    keep = np.eye(N)
    keep[:, :6] -= gain
    # Joseph's form: symmetric and positive whatever the gain
    cov[:] = keep @ cov @ keep.T + gain @ noise @ gain.T
    for a in range(3):
        pivot[a] += step[a]
        rate[a] += step[6 + a]
    before = rot.copy()
    rotate(step[3:6], before, rot)


@kernel
def begin(measured_pivot, measured_rot, noise, rate_variance, pivot, rot, rate, cov):
    """State from one measured pose; the rate is unknown but for its prior."""
    pivot[:] = measured_pivot
    rot[:] = measured_rot
    rate[:] = 0.0
    cov[:] = 0.0
    cov[:6, :6] = noise
    for a in range(3):
        cov[6 + a, 6 + a] = rate_variance


@kernel
def _is_sound(pivot, rot, cov):
    for a in range(3):
        if not math.isfinite(pivot[a]):
            return False
        for b in range(3):
            if not math.isfinite(rot[a, b]):
                return False
    for a in range(6):
        if not (math.isfinite(cov[a, a]) and cov[a, a] > 0.0):
            return False
        for b in range(6):
            if not math.isfinite(cov[a, b]):
                return False
    return True


@kernel
def step_frame(
    measured_pivot, measured_rot, noise, usable, exposure, walk_rate, walk_pivot, rate_variance, limits, max_coast,
    restart_after, time, times, counts, pivot, rot, rate, cov,
):  # fmt: skip
    """One frame of one mirror, at ``time``; returns (status, squared distance, contradicting parts).

    ``times`` holds the state's instant and that of the last measurement taken in, ``counts`` whether there is a state
    and how many frames in a row were rejected; ``limits`` are the squared distances allowed: all, position, rotation.
    """
    sound = usable and _is_sound(measured_pivot, measured_rot, noise)
    if counts[0] == 1:
        propagate(time - times[0], walk_rate, walk_pivot, rot, rate, cov)
        times[0] = time
        if time - times[1] > max_coast:
            counts[0] = 0
    if counts[0] == 0:
        if not sound:
            return (LOST if times[1] > -np.inf else UNKNOWN), np.nan, 0
        status = RESTARTED if times[1] > -np.inf else STARTED
        begin(measured_pivot, measured_rot, noise, rate_variance, pivot, rot, rate, cov)
        times[0] = times[1] = time
        counts[0], counts[1] = 1, 0
        return status, np.nan, 0
    if not sound:
        return COASTED, np.nan, 0
    left = np.empty(6)
    innovation(pivot, rot, measured_pivot, measured_rot, left)
    # a frame tells the mean posture; a walking rate makes that differ from the middle's by q T³/320
    inside = noise.copy()
    for a in range(3):
        inside[3 + a, 3 + a] += walk_rate * exposure**3 / 320.0
    total = cov[:6, :6] + inside
    distance = distance2(left, total)
    if not distance <= limits[0]:
        parts = 0
        if not distance2(left[:3], total[:3, :3]) <= limits[1]:
            parts |= POSITION
        if not distance2(left[3:], total[3:, 3:]) <= limits[2]:
            parts |= ROTATION
        counts[1] += 1
        if counts[1] < restart_after:
            return GATED, distance, parts
        begin(measured_pivot, measured_rot, noise, rate_variance, pivot, rot, rate, cov)
        times[1] = time
        counts[1] = 0
        return RESTARTED, distance, parts
    update(left, inside, pivot, rot, rate, cov)
    times[1] = time
    counts[1] = 0
    return UPDATED, distance, 0


@kernel_rows
def filter_many(
    begin, end,
    measured_pivot, measured_rot, noise, usable, exposure, walk_rate, walk_pivot, rate_variance, limits, max_coast,
    restart_after, delay, time, times, counts, pivot, rot, rate, cov, out_pivot, out_rot, out_rate, out_cov, status,
    distance, parts,
):  # fmt: skip
    """`step_frame` for every frame of every mirror; results ``delay`` after each frame's ``time``."""
    for m in range(begin, end):
        for f in range(len(time)):
            status[f, m], distance[f, m], parts[f, m] = step_frame(
                measured_pivot[f, m], measured_rot[f, m], noise[f, m], usable[f, m], exposure, walk_rate, walk_pivot,
                rate_variance, limits, max_coast, restart_after, time[f], times[m], counts[m], pivot[m], rot[m],
                rate[m], cov[m],
            )  # fmt: skip
            if counts[m, 0] == 0:
                continue
            later_rot, later_cov = rot[m].copy(), cov[m].copy()
            if delay != 0.0:
                propagate(delay, walk_rate, walk_pivot, later_rot, rate[m], later_cov)
            out_pivot[f, m] = pivot[m]
            out_rot[f, m] = later_rot
            out_rate[f, m] = rate[m]
            out_cov[f, m] = later_cov
