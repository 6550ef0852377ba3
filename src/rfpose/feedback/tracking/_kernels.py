"""Kernels of the tracking loop: one mirror after the other, each through all steps of a stretch of time.

The mount's parameters ``p`` (31) and constants ``k`` (26) are those of `rfpose.feedback._kernels`. Step g of a day is
its g-th servo interval. Everything random is drawn outside and handed in.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from rfpose.feedback._kernels import _axis, _bisector, _command_one, _posture, _prepare
from rfpose.feedback.servo._kernels import law_step, stepper_step
from rfpose.jit import kernel, kernel_parallel

NO_FEEDBACK, RADIO, ENCODER, SUN_SENSOR = 0, 1, 2, 3

# state of a mirror under one method
MOTOR, AXIS, COMMAND, NEXT, SLIP, MOVED, INNOVATION, SHIFT, RAMP = 0, 2, 4, 6, 8, 10, 12, 14, 17
GOAL, LEARNED, SILENT, STARTED, UNREACHABLE, CLOUDED, FRESH = 20, 22, 23, 24, 25, 26, 27
N_STATE = 28

# a measurement on its way
N_RING, N_ENTRY = 16, 6

# what is added up over a day
(
    STEPS, SQUARE, WORST, BEAM_SQUARE, BEAM_WORST, ENERGY, CAUGHT, MOTOR_1, MOTOR_2, STARTS, OUT_OF_REACH,
    OUTAGE_STEPS, OUTAGE_SQUARE, OUTAGE_ENERGY, OUTAGE_CAUGHT, FRAMES, FRAMES_LOST, COLD,
    SUNSHINE, BURSTS, BURST_ERROR, TURNING, FRESH_ENERGY, FRESH_CAUGHT,
) = range(24)  # fmt: skip
N_SUM = 24

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
    disc: float
    """Radius of the sun's image on a unit distance, half [rad] (Malan 3.3)."""


@kernel
def _caught(error, disc):
    """Intercept ratio of two discs (Malan 3.3)."""
    half = error / (2.0 * disc)
    if half >= 1.0:
        return 0.0
    return 2.0 / math.pi * (math.acos(half) - half * math.sqrt(1.0 - half * half))


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
def _track(
    loop, law, drive_1, drive_2,
    step0, p, k, lean, heat, model, cov, free, scale, walk, sun, target, gust, mean_speed, bend, noise, spread,
    bias, lost, outage, power, drift, sensor, state, ring, total, hours, hour_of, histogram,
    stride, trace_error, trace, keeps,
):  # fmt: skip
    """One mirror through a stretch of steps; see `advance`."""
    prepared = np.empty(16)
    known = np.empty(16)
    work = np.empty((3, 6))
    true = np.empty(6)
    guess = np.ones(6)
    wanted = np.empty(3)
    hoped = np.empty(3)
    error = np.empty(3)
    across = np.empty(2)
    counts = np.empty(2)
    change = np.empty(3)
    row = np.zeros(10)
    is_dish = target[3] > 0.5
    row[4:7] = target[:3]
    row[7] = 0.0 if is_dish else 1.0
    row[8] = 1.0
    row[9] = target[3]
    aside = np.zeros(10)  # a row whose light comes from and goes to one direction
    aside[8] = 1.0
    lean_north, lean_east = p[0], p[1]
    plate_up, plate_right = p[29], p[30]
    _prepare(model, k, known)
    n_step = len(power)
    for s in range(n_step):
        g = step0 + s
        tick = g % loop.interval == 0
        if s % 16 == 0:
            p[0] = lean_north + lean[0] * heat[s]
            p[1] = lean_east + lean[1] * heat[s]
            _prepare(p, k, prepared)
        # where the model says the motors belong, now and one interval ahead
        if tick:
            first = state[STARTED] == 0.0
            reached = True
            if first:
                reached = _command(model, k, known, row, sun[s], counts, work)
                _nearest_turn(state[NEXT], k, counts)
                state[NEXT], state[NEXT + 1] = counts[0], counts[1]
            state[COMMAND], state[COMMAND + 1] = state[NEXT], state[NEXT + 1]
            reached = _command(model, k, known, row, sun[s + loop.interval], counts, work) and reached
            shift = state[SHIFT : SHIFT + 3]
            if reached and (shift[0] != 0.0 or shift[1] != 0.0 or shift[2] != 0.0):
                reached = _shifted(model, k, known, shift, counts, guess, aside, work)
            _nearest_turn(state[COMMAND], k, counts)
            if reached:
                state[NEXT], state[NEXT + 1] = counts[0], counts[1]
                state[UNREACHABLE] = 0.0
            else:
                state[UNREACHABLE] = 1.0
                for a in range(2):
                    if not math.isfinite(state[NEXT + a]):
                        state[NEXT + a] = 0.0
                    state[COMMAND + a] = state[NEXT + a]
            if first:
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
            if entry[0] > 0.5:
                state[SILENT] = 0.0
                busy = False
                for a in range(2):
                    busy = busy or abs(state[COMMAND + a] - state[MOTOR + a]) > drive_1.speed
                if loop.feedback == ENCODER:
                    for a in range(2 if not busy else 0):
                        state[SLIP + a] += seconds * law.gain * entry[1 + a]
                elif not busy:  # a motor that runs flat out is on its way: nothing winds up meanwhile
                    for i in range(3):
                        speed, state[RAMP + i] = law_step(entry[1 + i], state[RAMP + i], law, seconds)
                        change[i] = state[SHIFT + i]
                        moved = change[i] + seconds * speed
                        state[SHIFT + i] = min(max(moved, -_LIMIT_RAD), _LIMIT_RAD)
                        change[i] = state[SHIFT + i] - change[i]
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
            else:
                state[SILENT] += 1.0
                for i in range(3):
                    if state[SILENT] <= 5.0:
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
            want = state[COMMAND + a] + (state[NEXT + a] - state[COMMAND + a]) * part + state[SLIP + a] * k[13 + a]
            want = min(max(want, k[22 + 2 * a]), k[23 + 2 * a])
            before = state[MOTOR + a]
            state[MOTOR + a], state[AXIS + a], state[GOAL + a] = stepper_step(
                want, before, state[AXIS + a], state[GOAL + a], drive_1 if a == 0 else drive_2, 1.0
            )
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
        h = max(math.hypot(true[0], true[1]), 1e-9)
        right, up = bend[0] * push, bend[1] * push
        x, y, z = true[0], true[1], true[2]
        true[0] = x - right * y / h - up * x * z / h
        true[1] = y + right * x / h - up * y * z / h
        true[2] = z + up * h
        inverse = 1.0 / math.sqrt(true[0] ** 2 + true[1] ** 2 + true[2] ** 2)
        for i in range(3):
            true[i] *= inverse
            row[i] = sun[s, i]
            if is_dish:
                row[4 + i] = sun[s, i]
        _bisector(row, true[3:], wanted)
        angle = 0.0
        for i in range(3):
            error[i] = wanted[i] - true[i]
            angle += error[i] * error[i]
        angle = math.sqrt(angle)
        dark = outage[s] > 0
        emerged = state[CLOUDED] > 0.0 and power[s] > 0.0
        state[CLOUDED] = 0.0 if power[s] > 0.0 else 1.0
        state[FRESH] = RESPONSE_S / loop.servo_s if emerged else max(state[FRESH] - 1.0, 0.0)
        if g >= loop.settle:
            if state[UNREACHABLE] > 0.0:
                total[OUT_OF_REACH] += 1.0
                if tick:
                    total[COLD] += power[s] * loop.interval
            else:
                facing = true[0] * sun[s, 0] + true[1] * sun[s, 1] + true[2] * sun[s, 2]
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
                    total[OUTAGE_STEPS] += 1.0
                    total[OUTAGE_SQUARE] += angle * angle
                if tick:
                    # an error of the normal moves a heliostat's image by twice itself, a dish's by once
                    energy = power[s] * loop.interval * max(facing, 0.0)
                    caught = energy * _caught(0.5 * angle if is_dish else angle, loop.disc)
                    total[ENERGY] += energy
                    total[CAUGHT] += caught
                    if state[FRESH] > 0.0:
                        total[FRESH_ENERGY] += energy
                        total[FRESH_CAUGHT] += caught
                    if dark:
                        total[OUTAGE_ENERGY] += energy
                        total[OUTAGE_CAUGHT] += caught
        if s % stride == 0:
            i_trace = s // stride
            trace_error[i_trace] = angle if state[UNREACHABLE] == 0.0 else np.nan
            if keeps:
                trace[i_trace, 0], trace[i_trace, 1], trace[i_trace, 2] = true[0], true[1], true[2]
                trace[i_trace, 3], trace[i_trace, 4] = state[MOTOR], state[MOTOR + 1]
                for i in range(3):
                    trace[i_trace, 5 + i] = state[SHIFT + i]
        # what is measured now
        if not tick or loop.feedback == NO_FEEDBACK:
            continue
        entry = ring[(g // loop.interval) % N_RING]
        entry[0] = 1.0
        _posture(
            _axis(0, state[MOTOR], model, k, known), _axis(1, state[MOTOR + 1], model, k, known), model, known, 0.0,
            guess,
        )  # fmt: skip
        if loop.feedback == RADIO:
            if g >= loop.settle:
                total[FRAMES] += 1.0
            frame = s // loop.interval
            if dark or lost[frame] > 0:
                entry[0] = 0.0
                if g >= loop.settle:
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
                seen = across[a] + sensor[a] + drift * heat[s]
                seen = min(max(seen, -loop.reach), loop.reach * (1.0 - 1e-9))
                across[a] = (math.floor(seen / loop.level) + 0.5) * loop.level
            _along(true, across[0], across[1], entry[1:4])
            if not power[s] > 0.0:
                entry[0] = 0.0
    p[0], p[1] = lean_north, lean_east


@kernel_parallel
def advance(
    loop, law, drive_1, drive_2,
    step0, p, k, lean, heat, model, cov, free, scale, walk, sun, target, gust, mean_speed, bend, noise, spread,
    bias, lost, outage, power, drift, sensor, state, ring, total, hours, hour_of, histogram,
    stride, trace_error, stored, trace,
):  # fmt: skip
    """Take all mirrors through a stretch of steps, in place of ``model, cov, state, ring`` and the sums.

    ``law`` turns errors into speeds; ``drive_1, drive_2`` are in counts, a servo step being one unit of time. First
    axis is the mirror. ``p, k`` true mount; ``lean`` (2) of the pedestal by day, times ``heat`` (step); ``model``
    what the controller believes; ``cov, free, scale, walk`` of its rolling fit; ``sun`` (step + interval + 1, xyz);
    ``target`` (xyz, 1 for a dish); ``gust`` (step) [m/s]; ``bend`` (2) [rad/(m/s)²]; ``noise`` (frame, 2) of variance
    one, ``spread`` (3) its lower triangle [rad], ``bias`` (2) [rad]: right, up; ``lost`` (frame), ``outage`` (step);
    ``power`` (step) [W/m²]; ``drift`` of plate or sensor [rad]; ``trace_error`` (trace); ``stored`` row of ``trace``
    or −1; ``trace`` (stored, trace, 8).
    """
    for h in nb.prange(p.shape[0]):
        keeps = stored[h] >= 0
        _track(
            loop, law, drive_1, drive_2,
            step0, p[h], k[h], lean[h], heat, model[h], cov[h], free, scale, walk, sun, target[h], gust[h],
            mean_speed, bend, noise[h], spread[h], bias[h], lost[h], outage[h], power, drift[h],
            sensor[h], state[h], ring[h], total[h], hours[h], hour_of, histogram[h], stride, trace_error[h],
            trace[max(stored[h], 0)], keeps,
        )  # fmt: skip
