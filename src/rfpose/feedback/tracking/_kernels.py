"""Kernels of the tracking loop: one mirror after the other, each through all steps of a stretch of time.

The mount's parameters ``p`` (31) and constants ``k`` (26) are those of `rfpose.feedback._kernels`. Step g of a day is
its g-th servo interval. Everything random is drawn outside and handed in.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rfpose.feedback._kernels import _axis, _bisector, _command_one, _posture, _prepare
from rfpose.feedback.servo._kernels import law_step, stepper_step
from rfpose.jit import kernel, kernel_parallel, prange

NO_FEEDBACK, RADIO, ENCODER, SUN_SENSOR = 0, 1, 2, 3

# what a mirror is to do: turn its motors to a goal, follow its aim by the model, or with feedback too
GO, FOLLOW, TRACK = 0, 1, 2

# state of a mirror under one method
MOTOR, AXIS, COMMAND, NEXT, SLIP, MOVED, INNOVATION, SHIFT, RAMP = 0, 2, 4, 6, 8, 10, 12, 14, 17
GOAL, LEARNED, SILENT, STARTED, UNREACHABLE, CLOUDED, FRESH = 20, 22, 23, 24, 25, 26, 27
SWING, RATE, SINCE = 28, 32, 34
N_STATE = 35

# a measurement on its way: what became of it, the error to steer by, the innovation to learn from
N_RING, N_ENTRY = 16, 6
LOST, USED, HEARD = 0.0, 1.0, 2.0
"""Heard: received while the mirror was about something else; neither steered by nor learnt from."""

N_SCRATCH = 112
N_BLOCK = 64
"""Mirrors are shared out in so many parts, each with room of its own to work in."""
FEW = 48
"""Up to so many mirrors one core is quicker than sharing them out, since field control has a word each second."""

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
    root_y: float
    root_vy: float
    root_v: float
    """Its noise, lower triangle."""
    swing_right: float
    swing_up: float
    """Its standard deviation [rad]."""


@kernel
def _caught(error, table, per_rad):
    """What of its light a mirror with this error of its normal brings into the aperture."""
    place = error * per_rad
    if not place < len(table) - 1:
        return 0.0
    i = int(place)
    return table[i] + (place - i) * (table[i + 1] - table[i])


@kernel
def _carried(heard, angle, loop, out):
    """Turn a direction about the celestial pole by an angle, as the sky turns."""
    s, c = math.sin(angle), math.cos(angle)
    along = (heard[1] * loop.pole_n + heard[2] * loop.pole_u) * (1.0 - c)
    # sky turns clockwise about the north pole: heard × pole
    out[0] = c * heard[0] + s * (heard[1] * loop.pole_u - heard[2] * loop.pole_n)
    out[1] = c * heard[1] - s * heard[0] * loop.pole_u + along * loop.pole_n
    out[2] = c * heard[2] + s * heard[0] * loop.pole_n + along * loop.pole_u


@kernel
def _flatten(n, v):
    """Take from a vector what lies along a normal."""
    along = n[0] * v[0] + n[1] * v[1] + n[2] * v[2]
    for i in range(3):
        v[i] -= along * n[i]


@kernel
def _off(row, posture, wanted):
    """Angle between a normal and the one that the row wants from this mirror centre."""
    _bisector(row, posture[3:], wanted)
    total = 0.0
    for i in range(3):
        total += (wanted[i] - posture[i]) ** 2
    return math.sqrt(total)


@kernel
def _across(n, e, out):
    """Write what of ``e`` lies along the mirror's right and up, for a normal ``n``; return cos of the elevation."""
    h = max(math.hypot(n[0], n[1]), 1e-9)
    out[0] = (-n[1] * e[0] + n[0] * e[1]) / h
    out[1] = -(n[0] * e[0] + n[1] * e[1]) * n[2] / h + h * e[2]
    return max(h, _NEAR_ZENITH)


@kernel
def _along(n, right, up, out):
    """Write the vector with these parts along the mirror's right and up."""
    h = max(math.hypot(n[0], n[1]), 1e-9)
    out[0] = (-n[1] * right - n[0] * n[2] * up) / h
    out[1] = (n[0] * right - n[1] * n[2] * up) / h
    out[2] = h * up


@kernel
def _learn(p, k, count, free, scale, variance, innovation, cov, walk, prepared, state):
    """One step of the rolling fit (Kalman): innovation of right and up, averaged, into parameters and covariance."""
    nf = len(free)
    jacobian = np.empty((2, nf))
    base = np.empty(2)
    moved = np.empty(2)
    n = np.empty(3)
    d = np.empty(3)
    _prepare(p, k, prepared)
    _posture(_axis(0, count[0], p, k, prepared), _axis(1, count[1], p, k, prepared), p, prepared, 1.0, state)
    n[:] = state[:3]
    for f in range(nf):
        step = 1e-2 * scale[f]
        kept = p[free[f]]
        p[free[f]] = kept + step
        _prepare(p, k, prepared)
        _posture(_axis(0, count[0], p, k, prepared), _axis(1, count[1], p, k, prepared), p, prepared, 1.0, state)
        p[free[f]] = kept
        for i in range(3):
            d[i] = state[i] - n[i]
        _across(n, d, moved)
        jacobian[0, f] = moved[0] / step
        jacobian[1, f] = moved[1] / step
        cov[f, f] += walk[f]
    gain = np.empty((nf, 2))
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
        base[0] = (s11 * innovation[0] - s01 * innovation[1]) / determinant
        base[1] = (s00 * innovation[1] - s01 * innovation[0]) / determinant
        for f in range(nf):
            p[free[f]] += gain[f, 0] * base[0] + gain[f, 1] * base[1]
        for f in range(nf):
            w0 = (s11 * gain[f, 0] - s01 * gain[f, 1]) / determinant
            w1 = (s00 * gain[f, 1] - s01 * gain[f, 0]) / determinant
            for g in range(f + 1):
                value = cov[f, g] - (w0 * gain[g, 0] + w1 * gain[g, 1])
                cov[f, g] = value
                cov[g, f] = value
    _prepare(p, k, prepared)


@kernel
def _command(p, k, prepared, row, sun, out, work):
    """Counts that send this sun to the row's target; True where the mirror can reach them."""
    row[0], row[1], row[2] = sun[0], sun[1], sun[2]
    if row[9] > 0.5:  # a dish looks where its light comes from
        row[4], row[5], row[6] = sun[0], sun[1], sun[2]
    out[0] = np.nan
    out[1] = np.nan
    return _command_one(p, k, prepared, row, out, work[0], work[1], work[2][:3]) == 0


@kernel
def _nearest_turn(near, k, counts):
    """Take axis 1 the whole turns on that bring it nearest to where it is, if its limits allow."""
    turn = 2.0 * math.pi * k[13]
    moved = counts[0] + turn * math.floor((near - counts[0]) / turn + 0.5)
    if k[22] <= moved <= k[23]:
        counts[0] = moved


@kernel
def _shifted(p, k, prepared, shift, counts, guess, row, work):
    """Move counts so that the model's normal is turned by a small vector; True where the mirror can reach that."""
    _posture(_axis(0, counts[0], p, k, prepared), _axis(1, counts[1], p, k, prepared), p, prepared, 0.0, guess)
    for i in range(3):
        row[i] = row[4 + i] = guess[i] + shift[i]
    return _command_one(p, k, prepared, row, counts, work[0], work[1], work[2][:3]) == 0


@kernel
def _swing(loop, noise, rate_right, rate_up, state):
    """Let the structure swing through a step after its motors took on new speeds [rad a servo step]."""
    for a in range(2):
        rate = rate_right if a == 0 else rate_up
        y = state[SWING + 2 * a]
        # the mirror stays behind what holds it
        v = state[SWING + 2 * a + 1] - (rate - state[RATE + a]) / loop.servo_s
        scale = loop.swing_right if a == 0 else loop.swing_up
        w0, w1 = noise[2 * a], noise[2 * a + 1]
        state[SWING + 2 * a] = loop.y_y * y + loop.y_v * v + scale * loop.root_y * w0
        state[SWING + 2 * a + 1] = loop.v_y * y + loop.v_v * v + scale * (loop.root_vy * w0 + loop.root_v * w1)
        state[RATE + a] = rate


@kernel
def _bend(n, right, up):
    """Turn a normal by small angles."""
    h = max(math.hypot(n[0], n[1]), 1e-9)
    x, y, z = n[0], n[1], n[2]
    n[0] = x - right * y / h - up * x * z / h
    n[1] = y + right * x / h - up * y * z / h
    n[2] = z + up * h
    inverse = 1.0 / math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
    for i in range(3):
        n[i] *= inverse


@kernel
def _track(
    loop, law, drive_1, drive_2, table,
    step0, first, end, duty, renew, scored, mode, aim, goal, heard, age,
    p, k, lean, heat, model, cov, free, scale, walk, sun, target, gust, mean_speed, bend, swing, noise, spread,
    bias, lost, outage, power, drift, sensor, state, ring, total, by_mode, by_outage, hours, hour_of, histogram,
    stride, trace_error, trace_light, trace, keeps, light, scratch,
):  # fmt: skip
    """One mirror through a stretch of steps; see `advance`."""
    prepared, known, guess, true = scratch[0:16], scratch[16:32], scratch[32:38], scratch[38:44]
    wanted, hoped, error, change = scratch[44:47], scratch[47:50], scratch[50:53], scratch[53:56]
    seen, across, counts = scratch[56:59], scratch[59:61], scratch[61:63]
    row, receiver, aside = scratch[64:74], scratch[74:84], scratch[84:94]
    work = scratch[94:112].reshape(3, 6)
    row[:] = 0.0
    aside[:] = 0.0
    is_dish = target[3] > 0.5
    row[4:7] = aim
    row[7] = 0.0 if is_dish else 1.0
    row[8] = 1.0
    row[9] = target[3]
    receiver[:] = row
    receiver[4:7] = target[:3]
    aside[8] = 1.0  # a row whose light comes from and goes to one direction
    lean_north, lean_east = p[0], p[1]
    plate_up, plate_right = p[29], p[30]
    _prepare(model, k, known)
    for s in range(first, end):
        g = step0 + s
        tick = g % loop.interval == 0
        if s % 16 == 0 or s == first:
            # wherever a stretch is cut, the same lean
            p[0] = lean_north + lean[0] * heat[s - s % 16]
            p[1] = lean_east + lean[1] * heat[s - s % 16]
            _prepare(p, k, prepared)
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
            ahead = loop.interval - g % loop.interval
            word = min(g // loop.control - (step0 + first) // loop.control, len(age) - 1)
            if fresh or (renew and s == first):
                seen[:] = sun[s]
                if math.isfinite(age[word]):
                    _carried(heard[word], loop.turn * (age[word] + s - first), loop, seen)
                reached = _command(model, k, known, row, seen, counts, work)
                if reached:
                    _nearest_turn(state[NEXT] if fresh else state[MOTOR], k, counts)
                    state[NEXT], state[NEXT + 1] = counts[0], counts[1]
            state[COMMAND], state[COMMAND + 1] = state[NEXT], state[NEXT + 1]
            seen[:] = sun[s + ahead]
            if math.isfinite(age[word]):
                _carried(heard[word], loop.turn * (age[word] + s - first + ahead), loop, seen)
            reached = _command(model, k, known, row, seen, counts, work) and reached
            shift = state[SHIFT : SHIFT + 3]
            if reached and (shift[0] != 0.0 or shift[1] != 0.0 or shift[2] != 0.0):
                reached = _shifted(model, k, known, shift, counts, guess, aside, work)
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
        if loop.feedback != NO_FEEDBACK and due >= 0 and due % loop.interval == 0:
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
                    _posture(
                        _axis(0, state[MOTOR], model, k, known), _axis(1, state[MOTOR + 1], model, k, known), model,
                        known, 0.0, guess,
                    )  # fmt: skip
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
                        state[COMMAND + a] += turn * k[13 + a]
                        state[NEXT + a] += turn * k[13 + a]
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
                _posture(
                    _axis(0, state[MOTOR], model, k, known), _axis(1, state[MOTOR + 1], model, k, known), model, known,
                    0.0, guess,
                )  # fmt: skip
                for i in range(3):
                    state[SHIFT + i] -= guess[i]
                _learn(
                    model, k, state[MOTOR : MOTOR + 2], free, scale, own / m + loop.wind_variance, across, cov, walk,
                    known, guess,
                )  # fmt: skip
                # what the model has learned comes off the shift, so that the mirror does not jump
                _posture(
                    _axis(0, state[MOTOR], model, k, known), _axis(1, state[MOTOR + 1], model, k, known), model, known,
                    0.0, guess,
                )  # fmt: skip
                for i in range(3):
                    state[SHIFT + i] += guess[i]
                state[LEARNED] = state[INNOVATION] = state[INNOVATION + 1] = 0.0
        # motors, gears
        part = (g % loop.interval) / loop.interval
        for a in range(2):
            want = state[COMMAND + a]
            if duty != GO:
                want += (state[NEXT + a] - state[COMMAND + a]) * part + state[SLIP + a] * k[13 + a]
                want = min(max(want, k[22 + 2 * a]), k[23 + 2 * a])
            before = state[MOTOR + a]
            change[a] = state[AXIS + a]
            state[MOTOR + a], state[AXIS + a], state[GOAL + a] = stepper_step(
                want, before, state[AXIS + a], state[GOAL + a], drive_1 if a == 0 else drive_2, 1.0
            )
            change[a] = (state[AXIS + a] - change[a]) / k[13 + a]
            move = state[MOTOR + a] - before
            total[MOTOR_1 + a] += abs(move)
            if move != 0.0 and state[MOVED + a] == 0.0:
                total[STARTS] += 1.0
            state[MOVED + a] = move
        # where the mirror really points
        axis_1 = _axis(0, state[AXIS], p, k, prepared)
        axis_2 = _axis(1, state[AXIS + 1], p, k, prepared)
        _posture(axis_1, axis_2, p, prepared, 0.0, true)
        push = mean_speed * mean_speed + 2.0 * mean_speed * gust[s]
        right, up = bend[0] * push, bend[1] * push
        if loop.swings:
            _swing(loop, swing[s], -math.hypot(true[0], true[1]) * change[0], change[1], state)
            right += state[SWING]
            up += state[SWING + 2]
        _bend(true, right, up)
        for i in range(3):
            row[i] = receiver[i] = sun[s, i]
            if is_dish:
                row[4 + i] = receiver[4 + i] = sun[s, i]
        angle = _off(row, true, wanted)
        facing = max(true[0] * sun[s, 0] + true[1] * sun[s, 1] + true[2] * sun[s, 2], 0.0)
        if tick or s % stride == 0 or s == end - 1:
            # what the receiver gets, whatever the mirror is told to aim at
            off = angle if scored else _off(receiver, true, hoped)
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
                    length = 0.0
                    for i in range(3):
                        work[0, i] = target[i] - true[3 + i]
                        length += work[0, i] ** 2
                    length = math.sqrt(length)
                    for i in range(3):
                        beam += (2.0 * facing * true[i] - sun[s, i] - work[0, i] / length) ** 2
                    beam = math.sqrt(beam)
                total[STEPS] += 1.0
                total[SQUARE] += angle * angle
                total[WORST] = max(total[WORST], angle)
                total[BEAM_SQUARE] += beam * beam
                total[BEAM_WORST] = max(total[BEAM_WORST], beam)
                hours[hour_of[s], 0] += 1.0
                hours[hour_of[s], 1] += angle * angle
                slot = int(BINS_PER_DECADE * math.log10(max(angle, LOWEST_RAD) / LOWEST_RAD))
                histogram[min(slot, N_BIN - 1)] += 1
                if power[s] > 0.0:
                    total[SUNSHINE] += loop.servo_s
                if emerged:
                    total[BURSTS] += 1.0
                    total[BURST_ERROR] += angle
                    total[TURNING] += angle * k[13] / drive_1.speed * loop.servo_s
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
        if s % stride == 0:
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
        _posture(
            _axis(0, state[MOTOR], model, k, known), _axis(1, state[MOTOR + 1], model, k, known), model, known, 0.0,
            guess,
        )  # fmt: skip
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
            right = plate_right + drift * heat[s] + bias[0] + spread[0] * noise[frame, 0] - model[30]
            up = plate_up + bias[1] + spread[1] * noise[frame, 0] + spread[2] * noise[frame, 1] - model[29]
            for i in range(3):
                error[i] = true[i] - guess[i]
            _across(true, error, across)
            entry[4] = across[0] + right
            entry[5] = across[1] + up
            _bisector(row, guess[3:], hoped)
            for i in range(3):
                error[i] = hoped[i] - true[i]
            _across(true, error, across)
            _along(true, across[0] - right, across[1] - up, entry[1:4])
        elif loop.feedback == ENCODER:
            for a in range(2):
                here = (axis_1 if a == 0 else axis_2) - p[3 + a]
                read = math.floor(here / loop.level + 0.5) * loop.level
                entry[1 + a] = _axis(a, state[COMMAND + a], model, k, known) - read
        else:
            for i in range(3):
                error[i] = sun[s, i] - true[i]
            _across(true, error, across)
            for a in range(2):
                read = across[a] + sensor[a] + drift * heat[s]
                read = min(max(read, -loop.reach), loop.reach * (1.0 - 1e-9))
                across[a] = (math.floor(read / loop.level) + 0.5) * loop.level
            _along(true, across[0], across[1], entry[1:4])
            if not power[s] > 0.0:
                entry[0] = LOST
    p[0], p[1] = lean_north, lean_east


@kernel
def advance_some(
    row, end_row,
    loop, law, drive_1, drive_2, table,
    step0, first, end, duty, renew, scored, mode, aim, goal, heard, age,
    p, k, lean, heat, model, cov, free, scale, walk, sun, target, gust, mean_speed, bend, swing, noise, spread,
    bias, lost, outage, power, drift, sensor, state, ring, total, by_mode, by_outage, hours, hour_of, histogram,
    stride, trace_error, trace_light, stored, trace, light,
):  # fmt: skip
    """Take mirrors ``row`` to before ``end_row`` through a stretch, one after the other; see `advance`."""
    scratch = np.empty(N_SCRATCH)
    for h in range(row, end_row):
        keeps = stored[h] >= 0
        _track(
            loop, law, drive_1, drive_2, table,
            step0, first, end, duty[h], renew[h] > 0, scored[h] > 0, mode[h], aim[h], goal[h], heard[h], age[h],
            p[h], k[h], lean[h], heat, model[h], cov[h], free, scale, walk, sun, target[h], gust[h],
            mean_speed, bend, swing[h], noise[h], spread[h], bias[h], lost[h], outage[h], power, drift[h],
            sensor[h], state[h], ring[h], total[h], by_mode[h], by_outage[h], hours[h], hour_of, histogram[h],
            stride, trace_error[h], trace_light[h], trace[max(stored[h], 0)], keeps, light[h], scratch,
        )  # fmt: skip


@kernel_parallel
def advance(
    loop, law, drive_1, drive_2, table,
    step0, first, end, duty, renew, scored, mode, aim, goal, heard, age,
    p, k, lean, heat, model, cov, free, scale, walk, sun, target, gust, mean_speed, bend, swing, noise, spread,
    bias, lost, outage, power, drift, sensor, state, ring, total, by_mode, by_outage, hours, hour_of, histogram,
    stride, trace_error, trace_light, stored, trace, light,
):  # fmt: skip
    """Take all mirrors through steps ``first`` to ``end`` of a stretch, in place of ``model, cov, state, ring``, sums.

    ``law`` turns errors into speeds; ``drive_1, drive_2`` are in counts, a servo step being one unit of time. First
    axis is the mirror; step ``s`` of the stretch is step ``step0 + s`` of the day. ``table`` of captures.

    What mirrors are told: ``duty``; ``renew``: at the first step it or the aim is another than before; ``scored``: on
    the receiver; ``mode`` row of ``by_mode``; ``aim`` (xyz); ``goal`` (2) counts; ``heard`` (interval, xyz) sun, so
    many steps ``age`` (interval) before the first step; NaN: the sun is known.

    ``p, k`` true mount; ``lean`` (2) of the pedestal by day, times ``heat`` (step); ``model`` what the controller
    believes; ``cov, free, scale, walk`` of its rolling fit; ``sun`` (step + interval + 1, xyz); ``target`` (xyz, 1 for
    a dish); ``gust`` (step) [m/s]; ``bend`` (2) [rad/(m/s)²]; ``swing`` (step, 4) and ``noise`` (frame, 2) of variance
    one, ``spread`` (3) its lower triangle [rad], ``bias`` (2) [rad]: right, up; ``lost`` (frame), ``outage`` (step):
    0, or which one is on, from 1; ``power`` (step) [W/m²], negative outside the field's hours;
    ``drift`` of plate or sensor [rad]; ``trace_error``,
    ``trace_light`` (trace, 2); ``stored`` row of ``trace`` or −1; ``trace`` (stored, trace, 8); ``light`` (2) caught
    and offered, as parts of the beam, at the last step.
    """
    n = p.shape[0]
    share = max(n // N_BLOCK, 1)
    for block in prange((n + share - 1) // share):
        advance_some(
            block * share, min((block + 1) * share, n),
            loop, law, drive_1, drive_2, table,
            step0, first, end, duty, renew, scored, mode, aim, goal, heard, age,
            p, k, lean, heat, model, cov, free, scale, walk, sun, target, gust, mean_speed, bend, swing, noise, spread,
            bias, lost, outage, power, drift, sensor, state, ring, total, by_mode, by_outage, hours, hour_of, histogram,
            stride, trace_error, trace_light, stored, trace, light,
        )  # fmt: skip
