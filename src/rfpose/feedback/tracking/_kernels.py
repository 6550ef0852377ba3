"""Kernels of the tracking loop: one mirror after the other, each through all steps of a stretch of time.

The mount's parameters ``p`` and constants ``k`` are those of `rfpose.feedback._kernels`. Its kernels are compiled into
these: once it has changed, a cache of this module is stale. Step g of a day is its g-th servo interval, step s of a
stretch is step ``step0 + s`` of the day. Everything random is drawn outside and handed in.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.feedback._kernels import N_PREPARED, N_ROW, axis_angle, command_one, posture, prepare, stand
from rfpose.feedback.columns import K, M, P
from rfpose.feedback.servo._kernels import DriveNumbers, LawNumbers, law_step, stepper_step
from rfpose.jit import kernel, kernel_lean

NO_FEEDBACK, RADIO, ENCODER, SUN_SENSOR = 0, 1, 2, 3

# what a mirror is to do: turn its motors to a goal, follow its aim by the model, or with feedback too
GO, FOLLOW, TRACK = 0, 1, 2

# state of a mirror under one method
MOTOR, AXIS, COMMAND, NEXT, SLIP, MOVED, INNOVATION, SHIFT, RAMP = 0, 2, 4, 6, 8, 10, 12, 14, 17
GOAL, LEARNED, SILENT, STARTED, UNREACHABLE, CLOUDED, FRESH = 20, 22, 23, 24, 25, 26, 27
SWING, RATE, SINCE = 28, 32, 34
# axis angles by the model: expected for the next sun, of the last one, and what the shift turned them by
EXPECTED, AIMED, TURNED = 35, 37, 39
N_STATE = 41

# a measurement on its way: what became of it, the error to steer by, the innovation to learn from
N_RING, N_ENTRY = 16, 6
LOST, USED, HEARD = 0.0, 1.0, 2.0
"""Heard: received while the mirror was about something else; neither steered by nor learnt from."""

# what is added up over a day
(
    STEPS, SQUARE, WORST, BEAM_SQUARE, BEAM_WORST, ENERGY, CAUGHT, MOTOR_1, MOTOR_2, STARTS, OUT_OF_REACH,
    FRAMES, FRAMES_LOST, COLD, SUNSHINE, BURSTS, BURST_ERROR, TURNING, FRESH_ENERGY, FRESH_CAUGHT,
) = range(20)  # fmt: skip
N_SUM = 20

# while radio is out, by outage
OUT_STEPS, OUT_SQUARE, OUT_ENERGY, OUT_CAUGHT = range(4)

# by mode of the field control, or all under one where there is none
MODE_S, MODE_OFFERED, MODE_CAUGHT = range(3)

RESPONSE_S = 30.0
"""How long after the sun comes out light is counted apart, for what the response costs."""

BINS_PER_DECADE, N_BIN = 32, 160
LOWEST_RAD = 1e-6
_EDGES = LOWEST_RAD * 10.0 ** (np.arange(N_BIN + 1) / BINS_PER_DECADE)
# an octave in so many equal parts, none of which holds two edges; the bin in which each part begins, and one beyond
_PARTS = 32
_OCTAVES = math.ceil(math.log2(_EDGES[-1] / LOWEST_RAD))
_BEGINS = np.array(
    [
        np.searchsorted(_EDGES, LOWEST_RAD * 2.0**octave * (1.0 + part / _PARTS), side="right") - 1
        for octave in range(_OCTAVES)
        for part in range(_PARTS)
    ]
)

_NEAR_ZENITH = 0.05
_LIMIT_RAD = 0.1
"""Feedback shifts a normal no further than this, in each direction."""


class Loop(NamedTuple):
    """How one method steers; times in servo steps, motor positions in counts."""

    feedback: int
    interval: int
    latency: int
    leak: float
    """Part of the shift kept from one silent frame to the next, once silence lasts."""
    learn: int
    """Frames between two steps of the rolling fit; 0: none."""
    wind_variance: float
    settle: int
    servo_s: float
    level: float
    """Width of a level of encoder or sun sensor [rad]."""
    reach: float
    """Where the sun sensor saturates [rad]."""
    per_rad: float
    """Entries of the table of captures to a radian."""
    pole_n: float
    pole_u: float
    """The celestial pole, north and up."""
    control: int
    """Servo steps from one word of field control to the next."""
    turn: float
    """How far a mirror carries on a sun that it heard of, in a servo step [rad]; 0: it does not."""
    swings: bool
    y_y: float
    y_v: float
    v_y: float
    v_v: float
    """Transition of the structure's swing over a servo step."""
    kick_y: float
    kick_v: float
    """What a random number adds to it."""
    swing_right: float
    swing_up: float
    """Its standard deviation [rad]."""


class Steering(NamedTuple):
    """How a method steers: its law turns errors into speeds, drives are in counts and servo steps."""

    loop: Loop
    law: LawNumbers
    drive_1: DriveNumbers
    drive_2: DriveNumbers
    table: FloatArray
    """What is caught, by the error of the normal; see `rfpose.feedback.tracking.capture`."""


class Tasks(NamedTuple):
    """What each mirror is to do from now on."""

    duty: npt.NDArray[np.int64]
    """GO, FOLLOW or TRACK."""
    renew: npt.NDArray[np.uint8]
    """Whether duty or aim is another than before."""
    scored: npt.NDArray[np.uint8]
    """Whether on the receiver."""
    mode: npt.NDArray[np.int64]
    """Row of `Tally.by_mode`."""
    aim: FloatArray
    """(mirror, xyz) [m]"""
    goal: FloatArray
    """(mirror, axis) counts, for GO."""
    heard: FloatArray
    """(mirror, interval, xyz) sun by the last message,"""
    age: FloatArray
    """(mirror, interval) so many steps before the first one; NaN: the sun is known."""


class Mounts(NamedTuple):
    """Mirrors as they stand."""

    true: FloatArray
    """(mirror, parameter)"""
    constant: FloatArray
    """(mirror, constant)"""
    lean: FloatArray
    """(mirror, 2) of the pedestal by day, times the heat [rad]."""
    target: FloatArray
    """(mirror, 4) receiver [m], and 1 for a dish."""


class Models(NamedTuple):
    """What the controller believes of the mounts; changed in place."""

    parameters: FloatArray
    """(mirror, parameter)"""
    cov: FloatArray
    """(mirror, free, free) of the rolling fit."""
    free: npt.NDArray[np.int64]
    """Columns that it corrects,"""
    scale: FloatArray
    """their usual changes,"""
    walk: FloatArray
    """and how their variances grow from fit to fit."""


class Weather(NamedTuple):
    """Sun, warmth and wind of a stretch of steps."""

    sun: FloatArray
    """(step + interval + 1, xyz)"""
    power: FloatArray
    """(step,) [W/m²], negative outside the field's hours."""
    heat: FloatArray
    """(step,)"""
    hour_of: npt.NDArray[np.int64]
    """(step,) hour of the day."""
    mean_speed: float
    """Of the wind [m/s]."""
    bend: FloatArray
    """(2) right, up [rad/(m/s)²]."""
    gust: npt.NDArray[np.float32]
    """(mirror, step) [m/s]."""
    swing: npt.NDArray[np.float32]
    """(mirror, step, 2) right, up, of variance one."""


class Readings(NamedTuple):
    """What comes between mirrors and what is measured of them."""

    noise: npt.NDArray[np.float32]
    """(mirror, frame, 2) of variance one."""
    spread: FloatArray
    """(mirror, 3) its lower triangle, right and up [rad]."""
    bias: FloatArray
    """(mirror, 2) right, up [rad]."""
    lost: npt.NDArray[np.uint8]
    """(mirror, frame)"""
    outage: npt.NDArray[np.uint8]
    """(pattern, step) 0, or which one is on, from 1,"""
    pattern: npt.NDArray[np.int64]
    """(mirror,) and whose of these patterns is whose."""
    drift: FloatArray
    """(mirror,) of the receivers' plane or the sensor by day, times the heat [rad]."""
    null: FloatArray
    """(mirror, 2) of the sun sensor [rad]."""


class Memory(NamedTuple):
    """What mirrors take from step to step; changed in place."""

    state: FloatArray
    """(mirror, N_STATE)"""
    ring: FloatArray
    """(mirror, N_RING, N_ENTRY) measurements on their way."""
    light: FloatArray
    """(mirror, 2) caught and offered at the last step, as parts of the beam."""


class Tally(NamedTuple):
    """What mirrors add up to, in place."""

    total: FloatArray
    """(mirror, N_SUM)"""
    by_mode: FloatArray
    """(mirror, mode, 3)"""
    by_outage: FloatArray
    """(mirror, outage, 4)"""
    hours: FloatArray
    """(mirror, 24, 2) steps and squared errors."""
    histogram: npt.NDArray[np.int32]
    """(mirror, N_BIN) of errors."""


class Courses(NamedTuple):
    """What is kept each ``stride`` steps, written in place."""

    stride: int
    error: FloatArray
    """(mirror, kept) [rad]"""
    light: FloatArray
    """(mirror, kept, 2)"""
    stored: npt.NDArray[np.int64]
    """(mirror,) row of ``trace``, or −1."""
    trace: FloatArray
    """(stored, kept, 8) true normal, motor counts, shift."""


class Stretch(NamedTuple):
    """All that mirrors go through a stretch of steps with, but what they are told."""

    step0: int
    """Of the day."""
    steering: Steering
    mounts: Mounts
    models: Models
    surroundings: Weather
    readings: Readings
    memory: Memory
    tally: Tally
    courses: Courses


class Workspace(NamedTuple):
    """Where one mirror after the other is worked on."""

    p: FloatArray
    prepared: FloatArray
    known: FloatArray
    guess: FloatArray
    true: FloatArray
    still: FloatArray
    wanted: FloatArray
    hoped: FloatArray
    error: FloatArray
    change: FloatArray
    seen: FloatArray
    across: FloatArray
    counts: FloatArray
    row: FloatArray
    aside: FloatArray
    work: FloatArray
    to_aim: FloatArray
    to_receiver: FloatArray
    believed: FloatArray
    jacobian: FloatArray
    gain: FloatArray


@kernel
def _workspace():
    """Make room to work in."""
    return Workspace(
        np.empty(len(P)), np.empty(N_PREPARED), np.empty(N_PREPARED), np.empty(6), np.empty(6), np.empty(6),
        np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(2), np.empty(2), np.empty(N_ROW),
        np.empty(N_ROW), np.empty(6), np.empty(3), np.empty(3), np.empty(2), np.empty((2, len(P))),
        np.empty((len(P), 2)),
    )  # fmt: skip


@kernel_lean
def _copy(values, out):
    """Fill an array with as many values as it has room for; a slice that is set makes a copy in between."""
    for i in range(len(out)):
        out[i] = values[i]


@kernel_lean
def _caught(error, table, per_rad):
    """What of its light a mirror with this error of its normal brings into the aperture."""
    place = error * per_rad
    if not place < len(table) - 1:
        return 0.0
    i = int(place)
    return table[i] + (place - i) * (table[i + 1] - table[i])


@kernel_lean
def bin_of(angle):
    """Bin of an error: the logarithm's, without the time that a logarithm takes."""
    if not angle < _EDGES[N_BIN - 1]:
        return N_BIN - 1
    if angle < _EDGES[1]:
        return 0
    fraction, octave = math.frexp(angle / LOWEST_RAD)
    found = _BEGINS[(octave - 1) * _PARTS + int(_PARTS * (2.0 * fraction - 1.0))]
    return found + 1 if angle >= _EDGES[found + 1] else found


@kernel_lean
def _carried(heard, angle, loop, out):
    """Turn a direction about the celestial pole by an angle, as the sky turns."""
    s, c = math.sin(angle), math.cos(angle)
    along = (heard[1] * loop.pole_n + heard[2] * loop.pole_u) * (1.0 - c)
    # sky turns clockwise about the north pole: heard × pole
    out[0] = c * heard[0] + s * (heard[1] * loop.pole_u - heard[2] * loop.pole_n)
    out[1] = c * heard[1] - s * heard[0] * loop.pole_u + along * loop.pole_n
    out[2] = c * heard[2] + s * heard[0] * loop.pole_n + along * loop.pole_u


@kernel_lean
def _flatten(n, v):
    """Take from a vector what lies along a normal."""
    along = n[0] * v[0] + n[1] * v[1] + n[2] * v[2]
    for i in range(3):
        v[i] -= along * n[i]


@kernel_lean
def _towards(point, centre, out):
    """Write the direction from a mirror's centre to a point."""
    x, y, z = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    length = math.sqrt(x * x + y * y + z * z)
    out[0], out[1], out[2] = x / length, y / length, z / length


@kernel_lean
def _off(n, sun, towards, wanted):
    """Angle between a normal and the one, written, that sends the sun's light towards a direction."""
    x, y, z = sun[0] + towards[0], sun[1] + towards[1], sun[2] + towards[2]
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    wanted[0], wanted[1], wanted[2] = x * inverse, y * inverse, z * inverse
    return math.sqrt((wanted[0] - n[0]) ** 2 + (wanted[1] - n[1]) ** 2 + (wanted[2] - n[2]) ** 2)


@kernel_lean
def _believe(motor, p, k, prepared, last, out):
    """Write normal and centre by the model at motor positions, unless they are the ``last``, for which it has them."""
    if motor[0] != last[0] or motor[1] != last[1]:
        stand(motor[0], motor[1], p, k, prepared, 0.0, out)
        last[0], last[1] = motor[0], motor[1]


@kernel_lean
def _across(n, e, out):
    """Write what of ``e`` lies along the mirror's right and up, for a normal ``n``; return cos of the elevation."""
    h = max(math.sqrt(n[0] * n[0] + n[1] * n[1]), 1e-9)
    out[0] = (-n[1] * e[0] + n[0] * e[1]) / h
    out[1] = -(n[0] * e[0] + n[1] * e[1]) * n[2] / h + h * e[2]
    return max(h, _NEAR_ZENITH)


@kernel_lean
def _along(n, right, up, out):
    """Write the vector with these parts along the mirror's right and up."""
    h = max(math.sqrt(n[0] * n[0] + n[1] * n[1]), 1e-9)
    out[0] = (-n[1] * right - n[0] * n[2] * up) / h
    out[1] = (n[0] * right - n[1] * n[2] * up) / h
    out[2] = h * up


@kernel_lean
def _learn(p, k, count, free, scale, variance, innovation, cov, walk, prepared, state, room):
    """One step of the rolling fit (Kalman): innovation of right and up, averaged, into parameters and covariance."""
    nf = len(free)
    jacobian, gain = room.jacobian, room.gain
    n, d, moved = room.hoped, room.error, room.counts
    prepare(p, k, prepared)
    stand(count[0], count[1], p, k, prepared, 1.0, state)
    _copy(state, n)
    for f in range(nf):
        step = 1e-2 * scale[f]
        kept = p[free[f]]
        p[free[f]] = kept + step
        prepare(p, k, prepared)
        stand(count[0], count[1], p, k, prepared, 1.0, state)
        p[free[f]] = kept
        for i in range(3):
            d[i] = state[i] - n[i]
        _across(n, d, moved)
        jacobian[0, f] = moved[0] / step
        jacobian[1, f] = moved[1] / step
        cov[f, f] += walk[f]
    for f in range(nf):
        for a in range(2):
            total = 0.0
            for g in range(nf):
                total += cov[f, g] * jacobian[a, g]
            gain[f, a] = total
    s00 = s01 = s11 = 0.0
    for f in range(nf):
        s00 += jacobian[0, f] * gain[f, 0]
        s01 += jacobian[0, f] * gain[f, 1]
        s11 += jacobian[1, f] * gain[f, 1]
    s00 += variance
    s11 += variance
    determinant = s00 * s11 - s01 * s01
    if determinant > 0.0:
        right = (s11 * innovation[0] - s01 * innovation[1]) / determinant
        up = (s00 * innovation[1] - s01 * innovation[0]) / determinant
        for f in range(nf):
            p[free[f]] += gain[f, 0] * right + gain[f, 1] * up
        for f in range(nf):
            w0 = (s11 * gain[f, 0] - s01 * gain[f, 1]) / determinant
            w1 = (s00 * gain[f, 1] - s01 * gain[f, 0]) / determinant
            for g in range(f + 1):
                value = cov[f, g] - (w0 * gain[g, 0] + w1 * gain[g, 1])
                cov[f, g] = value
                cov[g, f] = value
    prepare(p, k, prepared)


@kernel_lean
def _command(p, k, prepared, row, is_dish, sun, near, out, work, wanted):
    """Counts that send this sun to the row's target, or a dish to the sun; True where the mirror can reach them."""
    for i in range(3):
        row[M.source_enu + i] = sun[i]
        if is_dish:
            row[M.target_enu + i] = sun[i]
    out[0] = np.nan
    out[1] = np.nan
    return command_one(p, k, prepared, row, near, out, work, wanted) == 0


@kernel_lean
def _nearest_turn(near, k, counts):
    """Take axis 1 the whole turns on that bring it nearest to where it is, if its limits allow."""
    turn = 2.0 * math.pi * k[K.counts_per_unit]
    moved = counts[0] + turn * math.floor((near - counts[0]) / turn + 0.5)
    if k[K.lowest_count] <= moved <= k[K.highest_count]:
        counts[0] = moved


@kernel_lean
def _shifted(p, k, prepared, shift, counts, near, row, work, wanted):
    """Counts that turn the model's normal ``wanted`` by a small vector; True where the mirror can reach that."""
    for i in range(3):
        row[M.source_enu + i] = row[M.target_enu + i] = wanted[i] + shift[i]
    return command_one(p, k, prepared, row, near, counts, work, wanted) == 0


@kernel_lean
def _swing(loop, noise, rate_right, rate_up, state):
    """Let the structure swing through a step after its motors took on new speeds [rad a servo step]."""
    for a in range(2):
        rate = rate_right if a == 0 else rate_up
        y = state[SWING + 2 * a]
        # the mirror stays behind what holds it
        v = state[SWING + 2 * a + 1] - (rate - state[RATE + a]) / loop.servo_s
        scale = loop.swing_right if a == 0 else loop.swing_up
        push = scale * noise[a]
        state[SWING + 2 * a] = loop.y_y * y + loop.y_v * v + loop.kick_y * push
        state[SWING + 2 * a + 1] = loop.v_y * y + loop.v_v * v + loop.kick_v * push
        state[RATE + a] = rate


@kernel_lean
def _bend(n, level, right, up):
    """Turn a normal, whose level part is so long, by small angles."""
    h = max(level, 1e-9)
    x, y, z = n[0], n[1], n[2]
    turn, lift = right / h, up * z / h
    n[0] = x - turn * y - lift * x
    n[1] = y + turn * x - lift * y
    n[2] = z + up * h
    inverse = 1.0 / math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
    for i in range(3):
        n[i] *= inverse


@kernel_lean
def _track(h, first, end, tasks, stretch, room):
    """One mirror through steps ``first`` to before ``end`` of a stretch."""
    loop, law, drive_1, drive_2, table = stretch.steering
    duty, renew, scored, mode = tasks.duty[h], tasks.renew[h] > 0, tasks.scored[h] > 0, tasks.mode[h]
    aim, goal, heard, age = tasks.aim[h], tasks.goal[h], tasks.heard[h], tasks.age[h]
    built, k, lean, target = (
        stretch.mounts.true[h], stretch.mounts.constant[h], stretch.mounts.lean[h], stretch.mounts.target[h]
    )  # fmt: skip
    model, cov = stretch.models.parameters[h], stretch.models.cov[h]
    free, scale, walk = stretch.models.free, stretch.models.scale, stretch.models.walk
    sun, power, heat, hour_of, mean_speed, bend = (
        stretch.surroundings.sun, stretch.surroundings.power, stretch.surroundings.heat, stretch.surroundings.hour_of,
        stretch.surroundings.mean_speed, stretch.surroundings.bend,
    )  # fmt: skip
    gust, swing = stretch.surroundings.gust[h], stretch.surroundings.swing[h]
    noise, spread, bias = stretch.readings.noise[h], stretch.readings.spread[h], stretch.readings.bias[h]
    lost, drift = stretch.readings.lost[h], stretch.readings.drift[h]
    outage = stretch.readings.outage[stretch.readings.pattern[h]]
    null = stretch.readings.null[h]
    state, ring, light = stretch.memory.state[h], stretch.memory.ring[h], stretch.memory.light[h]
    total, by_mode, by_outage = stretch.tally.total[h], stretch.tally.by_mode[h], stretch.tally.by_outage[h]
    hours, histogram = stretch.tally.hours[h], stretch.tally.histogram[h]
    stride, trace_error, trace_light = stretch.courses.stride, stretch.courses.error[h], stretch.courses.light[h]
    keeps = stretch.courses.stored[h] >= 0
    trace = stretch.courses.trace[max(stretch.courses.stored[h], 0)]
    step0 = stretch.step0
    p, prepared, known, guess, true, still = room[:6]
    wanted, hoped, error, change, seen, across, counts, row, aside, work, to_aim, to_receiver, believed = room[6:19]
    is_dish = target[3] > 0.5
    _copy(built, p)
    row[:] = 0.0
    _copy(aim, row[M.target_enu : M.target_enu + 3])
    row[M.target_is_point] = 0.0 if is_dish else 1.0
    row[M.sigma_rad] = 1.0
    aside[:] = 0.0
    aside[M.sigma_rad] = 1.0  # a row whose light comes from and goes to one direction
    plate_up, plate_right = p[P.receiver_plane_up_rad], p[P.receiver_plane_right_rad]
    prepare(model, k, known)
    near, aimed, turned_by = state[EXPECTED:AIMED], state[AIMED:TURNED], state[TURNED:N_STATE]
    shift, motor = state[SHIFT:RAMP], state[MOTOR:AXIS]
    believed[:] = np.nan
    level = 0.0
    stood_1 = stood_2 = np.nan
    axis_1 = axis_2 = 0.0
    turned = True
    phase = (step0 + first) % loop.interval - 1
    since_due = (step0 + first - loop.latency) % loop.interval - 1
    since_kept = first % stride - 1
    for s in range(first, end):
        g = step0 + s
        phase += 1
        if phase == loop.interval:
            phase = 0
        tick = phase == 0
        since_due += 1
        if since_due == loop.interval:
            since_due = 0
        since_kept += 1
        if since_kept == stride:
            since_kept = 0
        keep = since_kept == 0
        if s % 16 == 0 or s == first:
            # wherever a stretch is cut, the same lean
            p[P.pedestal_tilt_north_rad] = built[P.pedestal_tilt_north_rad] + lean[0] * heat[s - s % 16]
            p[P.pedestal_tilt_east_rad] = built[P.pedestal_tilt_east_rad] + lean[1] * heat[s - s % 16]
            prepare(p, k, prepared)
            turned = True
        # where the model says the motors belong, now and one interval ahead
        if duty == GO:
            state[UNREACHABLE] = 0.0
            for a in range(2):
                state[COMMAND + a] = goal[a]
            for i in range(3):
                state[RAMP + i] = 0.0
        elif tick or (renew and s == first):
            fresh = state[STARTED] == 0.0
            reached = True
            ahead = loop.interval - phase
            word = min(g // loop.control - (step0 + first) // loop.control, len(age) - 1)
            if fresh or (renew and s == first):
                _copy(sun[s], seen)
                if math.isfinite(age[word]):
                    _carried(heard[word], loop.turn * (age[word] + s - first), loop, seen)
                near[:] = np.nan
                aimed[:] = np.nan
                reached = _command(model, k, known, row, is_dish, seen, near, counts, work, wanted)
                if reached:
                    _nearest_turn(state[NEXT] if fresh else state[MOTOR], k, counts)
                    state[NEXT], state[NEXT + 1] = counts[0], counts[1]
            state[COMMAND], state[COMMAND + 1] = state[NEXT], state[NEXT + 1]
            _copy(sun[s + ahead], seen)
            if math.isfinite(age[word]):
                _carried(heard[word], loop.turn * (age[word] + s - first + ahead), loop, seen)
            reached = _command(model, k, known, row, is_dish, seen, near, counts, work, wanted) and reached
            for a in range(2):
                across[a] = near[a] + turned_by[a]
                # one interval on, the sun will have gone on
                before, aimed[a] = aimed[a], near[a]
                near[a] += near[a] - before if math.isfinite(before) else 0.0
            if reached and (shift[0] != 0.0 or shift[1] != 0.0 or shift[2] != 0.0):
                reached = _shifted(model, k, known, shift, counts, across, aside, work, wanted)
                for a in range(2):
                    turned_by[a] = across[a] - aimed[a] if reached else 0.0
            # from where the motor is: near the zenith commands swing faster than it can follow
            _nearest_turn(state[COMMAND] if fresh else state[MOTOR], k, counts)
            if reached:
                state[NEXT], state[NEXT + 1] = counts[0], counts[1]
                state[UNREACHABLE] = 0.0
                if math.isfinite(age[word]) and loop.turn == 0.0:
                    # a sun that is held: go there at once, and stand
                    state[COMMAND], state[COMMAND + 1] = counts[0], counts[1]
            else:
                state[UNREACHABLE] = 1.0
                for a in range(2):
                    if not math.isfinite(state[NEXT + a]):
                        state[NEXT + a] = 0.0
                    state[COMMAND + a] = state[NEXT + a]
            if fresh:
                for a in range(2):
                    step = drive_1.step
                    at = math.floor(state[COMMAND + a] / step + 0.5) * step
                    state[MOTOR + a] = state[AXIS + a] = state[GOAL + a] = at
                state[STARTED] = 1.0
        # a measurement has arrived
        due = g - loop.latency
        if loop.feedback != NO_FEEDBACK and due >= 0 and since_due == 0:
            entry = ring[(due // loop.interval) % N_RING]
            seconds = loop.interval * loop.servo_s
            used = entry[0] == USED and duty == TRACK
            state[SILENT] = state[SILENT] + 1.0 if entry[0] == LOST else 0.0
            if used:
                busy = state[UNREACHABLE] > 0.0
                for a in range(2):
                    busy = busy or abs(state[COMMAND + a] - state[MOTOR + a]) > drive_1.speed
                if loop.feedback == ENCODER:
                    for a in range(2 if not busy else 0):
                        state[SLIP + a] += seconds * law.gain * entry[1 + a]
                elif not busy:  # out of reach, or with a motor flat out on its way: nothing winds up meanwhile
                    _believe(motor, model, k, known, believed, guess)
                    for i in range(3):
                        speed, state[RAMP + i] = law_step(entry[1 + i], state[RAMP + i], law, seconds)
                        change[i] = state[SHIFT + i]
                        moved = change[i] + seconds * speed
                        state[SHIFT + i] = min(max(moved, -_LIMIT_RAD), _LIMIT_RAD)
                        change[i] = state[SHIFT + i] - change[i]
                    # along the normal a shift turns nothing, and nothing would hold it
                    _flatten(guess, state[SHIFT : SHIFT + 3])
                    _flatten(guess, state[RAMP : RAMP + 3])
                    # at once, to first order; exact from the next command on
                    h = _across(guess, change, across)
                    for a in range(2):
                        turn = -across[0] / h if a == 0 else across[1]
                        state[COMMAND + a] += turn * k[K.counts_per_unit + a]
                        state[NEXT + a] += turn * k[K.counts_per_unit + a]
                if loop.learn > 0:
                    state[INNOVATION] += entry[4]
                    state[INNOVATION + 1] += entry[5]
                    state[LEARNED] += 1.0
            elif duty != GO:
                for i in range(3):
                    if duty == TRACK and state[SILENT] <= 5.0:
                        state[SHIFT + i] += seconds * state[RAMP + i]
                    else:
                        state[RAMP + i] = 0.0
                        state[SHIFT + i] *= loop.leak
            if loop.learn > 0 and state[LEARNED] >= loop.learn:
                m = state[LEARNED]
                across[0], across[1] = state[INNOVATION] / m, state[INNOVATION + 1] / m
                own = 0.5 * (spread[0] * spread[0] + spread[1] * spread[1] + spread[2] * spread[2])
                _believe(motor, model, k, known, believed, guess)
                for i in range(3):
                    state[SHIFT + i] -= guess[i]
                _learn(
                    model, k, motor, free, scale, own / m + loop.wind_variance, across, cov, walk, known, guess, room
                )
                # what the model has learned comes off the shift, so that the mirror does not jump
                believed[:] = np.nan
                _believe(motor, model, k, known, believed, guess)
                for i in range(3):
                    state[SHIFT + i] += guess[i]
                state[LEARNED] = state[INNOVATION] = state[INNOVATION + 1] = 0.0
        # motors, gears
        part = phase / loop.interval
        for a in range(2):
            want = state[COMMAND + a]
            if duty != GO:
                want += (state[NEXT + a] - state[COMMAND + a]) * part + state[SLIP + a] * k[K.counts_per_unit + a]
                want = min(max(want, k[K.lowest_count + a]), k[K.highest_count + a])
            before = state[MOTOR + a]
            if state[GOAL + a] == before and abs(want - before) <= (drive_1.dead_band if a == 0 else drive_2.dead_band):
                change[a] = state[MOVED + a] = 0.0
                continue
            change[a] = state[AXIS + a]
            state[MOTOR + a], state[AXIS + a], state[GOAL + a] = stepper_step(
                want, before, state[AXIS + a], state[GOAL + a], drive_1 if a == 0 else drive_2, 1.0
            )
            change[a] = (state[AXIS + a] - change[a]) / k[K.counts_per_unit + a]
            move = state[MOTOR + a] - before
            total[MOTOR_1 + a] += abs(move)
            if move != 0.0 and state[MOVED + a] == 0.0:
                total[STARTS] += 1.0
            state[MOVED + a] = move
        # where the mirror really points
        if state[AXIS] != stood_1:
            stood_1 = state[AXIS]
            axis_1 = axis_angle(0, stood_1, p, k, prepared)
            turned = True
        if state[AXIS + 1] != stood_2:
            stood_2 = state[AXIS + 1]
            axis_2 = axis_angle(1, stood_2, p, k, prepared)
            turned = True
        if turned:  # in most seconds no motor takes a step
            posture(axis_1, axis_2, p, prepared, 0.0, still)
            level = math.sqrt(still[0] * still[0] + still[1] * still[1])
            if not is_dish:
                _towards(aim, still[3:], to_aim)
                _towards(target, still[3:], to_receiver)
            turned = False
        _copy(still, true)
        push = mean_speed * mean_speed + 2.0 * mean_speed * gust[s]
        right, up = bend[0] * push, bend[1] * push
        if loop.swings:
            _swing(loop, swing[s], -level * change[0], change[1], state)
            right += state[SWING]
            up += state[SWING + 2]
        _bend(true, level, right, up)
        if is_dish:
            _copy(sun[s], to_aim)
            _copy(sun[s], to_receiver)
        angle = _off(true, sun[s], to_aim, wanted)
        facing = max(true[0] * sun[s, 0] + true[1] * sun[s, 1] + true[2] * sun[s, 2], 0.0)
        if tick or keep or s == end - 1:
            # what the receiver gets, whatever the mirror is told to aim at
            off = angle if scored else _off(true, sun[s], to_receiver, hoped)
            offered = facing
            if not scored:
                offered = max(hoped[0] * sun[s, 0] + hoped[1] * sun[s, 1] + hoped[2] * sun[s, 2], 0.0)
            light[0] = facing * _caught(off, table, loop.per_rad)
            light[1] = offered
        dark = outage[s] > 0
        open_ = power[s] >= 0.0  # negative: the field is not to work yet, or no longer
        emerged = open_ and state[CLOUDED] > 0.0 and power[s] > 0.0
        if open_:
            state[CLOUDED] = 0.0 if power[s] > 0.0 else 1.0
        state[FRESH] = RESPONSE_S / loop.servo_s if emerged else max(state[FRESH] - 1.0, 0.0)
        settled = scored and state[SINCE] >= loop.settle and open_
        state[SINCE] = state[SINCE] + 1.0 if scored else 0.0
        if open_:
            by_mode[mode, MODE_S] += loop.servo_s
            if tick:
                by_mode[mode, MODE_OFFERED] += power[s] * loop.interval * light[1]
                by_mode[mode, MODE_CAUGHT] += power[s] * loop.interval * light[0]
        if settled:
            if state[UNREACHABLE] > 0.0:
                total[OUT_OF_REACH] += 1.0
                if tick:
                    total[COLD] += power[s] * loop.interval
            else:
                beam = angle
                if not is_dish:
                    beam = 0.0
                    for i in range(3):
                        beam += (2.0 * facing * true[i] - sun[s, i] - to_receiver[i]) ** 2
                    beam = math.sqrt(beam)
                total[STEPS] += 1.0
                total[SQUARE] += angle * angle
                total[WORST] = max(total[WORST], angle)
                total[BEAM_SQUARE] += beam * beam
                total[BEAM_WORST] = max(total[BEAM_WORST], beam)
                hours[hour_of[s], 0] += 1.0
                hours[hour_of[s], 1] += angle * angle
                histogram[bin_of(angle)] += 1
                if power[s] > 0.0:
                    total[SUNSHINE] += loop.servo_s
                if emerged:
                    total[BURSTS] += 1.0
                    total[BURST_ERROR] += angle
                    total[TURNING] += angle * k[K.counts_per_unit] / drive_1.speed * loop.servo_s
                if dark:
                    by_outage[outage[s] - 1, OUT_STEPS] += 1.0
                    by_outage[outage[s] - 1, OUT_SQUARE] += angle * angle
                if tick:
                    energy = power[s] * loop.interval * facing
                    caught = power[s] * loop.interval * light[0]
                    total[ENERGY] += energy
                    total[CAUGHT] += caught
                    if state[FRESH] > 0.0:
                        total[FRESH_ENERGY] += energy
                        total[FRESH_CAUGHT] += caught
                    if dark:
                        by_outage[outage[s] - 1, OUT_ENERGY] += energy
                        by_outage[outage[s] - 1, OUT_CAUGHT] += caught
        if keep:
            i_trace = s // stride
            trace_error[i_trace] = angle if scored and state[UNREACHABLE] == 0.0 else np.nan
            trace_light[i_trace, 0], trace_light[i_trace, 1] = light[0], light[1]
            if keeps:
                trace[i_trace, 0], trace[i_trace, 1], trace[i_trace, 2] = true[0], true[1], true[2]
                trace[i_trace, 3], trace[i_trace, 4] = state[MOTOR], state[MOTOR + 1]
                for i in range(3):
                    trace[i_trace, 5 + i] = state[SHIFT + i]
        # what is measured now
        if not tick or loop.feedback == NO_FEEDBACK:
            continue
        entry = ring[(g // loop.interval) % N_RING]
        # flat out a mirror is somewhere on its way: that is nothing to steer by or to learn from
        slewing = abs(state[MOVED]) >= 0.999 * drive_1.speed or abs(state[MOVED + 1]) >= 0.999 * drive_2.speed
        entry[0] = HEARD if duty == GO or slewing else USED
        _believe(motor, model, k, known, believed, guess)
        if loop.feedback == RADIO:
            if settled:
                total[FRAMES] += 1.0
            frame = s // loop.interval
            if dark or lost[frame] > 0:
                entry[0] = LOST
                if settled:
                    total[FRAMES_LOST] += 1.0
                continue
            # measured minus known tilt of the plate is the mirror as the loop sees it
            right = (
                plate_right
                + drift * heat[s]
                + bias[0]
                + spread[0] * noise[frame, 0]
                - model[P.receiver_plane_right_rad]
            )
            up = (
                plate_up
                + bias[1]
                + spread[1] * noise[frame, 0]
                + spread[2] * noise[frame, 1]
                - model[P.receiver_plane_up_rad]
            )
            for i in range(3):
                error[i] = true[i] - guess[i]
            _across(true, error, across)
            entry[4] = across[0] + right
            entry[5] = across[1] + up
            if not is_dish:
                _towards(aim, guess[3:], seen)
                _off(guess, sun[s], seen, hoped)
            else:
                _copy(sun[s], hoped)
            for i in range(3):
                error[i] = hoped[i] - true[i]
            _across(true, error, across)
            _along(true, across[0] - right, across[1] - up, entry[1:4])
        elif loop.feedback == ENCODER:
            for a in range(2):
                here = (axis_1 if a == 0 else axis_2) - p[P.axis_1_zero_rad + a]
                read = math.floor(here / loop.level + 0.5) * loop.level
                entry[1 + a] = axis_angle(a, state[COMMAND + a], model, k, known) - read
        else:
            for i in range(3):
                error[i] = sun[s, i] - true[i]
            _across(true, error, across)
            for a in range(2):
                read = across[a] + null[a] + drift * heat[s]
                read = min(max(read, -loop.reach), loop.reach * (1.0 - 1e-9))
                across[a] = (math.floor(read / loop.level) + 0.5) * loop.level
            _along(true, across[0], across[1], entry[1:4])
            if not power[s] > 0.0:
                entry[0] = LOST


@kernel
def advance(row, end_row, first, end, tasks, stretch):
    """Take mirrors ``row`` to before ``end_row`` through steps ``first`` to before ``end`` of a stretch, in place.

    ``tasks`` and ``stretch`` are `Tasks` and `Stretch`; mirrors know nothing of each other.
    """
    room = _workspace()
    for h in range(row, end_row):
        _track(h, first, end, tasks, stretch, room)
