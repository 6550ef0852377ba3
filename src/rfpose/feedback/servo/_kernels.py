"""Kernels of the servo: law, stepper, and both over a field or along a record.

All angles in radians, times in seconds. The two pieces a simulation can inline are `law_step` and `stepper_step`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rfpose.jit import kernel_inline, kernel_parallel, prange

# state of one axis
INTEGRAL, WANTED, MOTOR, AXIS, GOAL, LAST = 0, 1, 2, 3, 4, 5
N_STATE = 6

# what is counted of one axis
STEPS, STARTS, REVERSALS, BUSY = 0, 1, 2, 3
N_COUNT = 4


class LawNumbers(NamedTuple):
    """A PI law in numbers; zero switches a term off."""

    gain: float
    integral_gain: float
    level: float
    half_levels: float
    speed: float
    speed_step: float
    dead_band: float


class DriveNumbers(NamedTuple):
    """A stepper with its gear in numbers; zero switches a term off."""

    step: float
    speed: float
    half_backlash: float
    stiction: float
    dead_band: float
    lead: float


@kernel_inline
def law_step(error, integral, law, dt):
    """Speed and new integral for an error; NaN: no measurement, the integral's speed goes on."""
    saturated = False
    seen = error
    if not math.isfinite(error):
        seen = 0.0
    elif law.level > 0.0:
        slot = math.floor(error / law.level)
        if slot < -law.half_levels:
            slot = -law.half_levels
        elif slot > law.half_levels - 1.0:
            slot = law.half_levels - 1.0
        saturated = slot == -law.half_levels or slot == law.half_levels - 1.0
        seen = (slot + 0.5) * law.level
    if abs(seen) < law.dead_band:
        seen = 0.0
    if saturated:
        speed = math.copysign(law.speed, seen)
    else:
        ahead = integral + law.integral_gain * dt * seen
        speed = law.gain * seen + ahead
        # no winding up: beyond the motor's speed the integral may only shrink
        if abs(speed) <= law.speed or speed * seen < 0.0:
            integral = ahead
        else:
            speed = law.gain * seen + integral
    if speed > law.speed:
        speed = law.speed
    elif speed < -law.speed:
        speed = -law.speed
    if law.speed_step > 0.0:
        speed = math.floor(speed / law.speed_step + 0.5) * law.speed_step
    return speed, integral


@kernel_inline
def stepper_step(wanted, motor, axis, goal, drive, dt):
    """New motor angle, axis angle and goal; the motor rests until it is further off than the dead band.

    Once it has started, it goes on over the wanted place by the lead, however many intervals that takes.
    """
    off = wanted - motor
    if goal == motor and abs(off) > drive.dead_band:
        goal = wanted + math.copysign(drive.lead, off)
    elif goal != motor:
        goal = wanted + math.copysign(drive.lead, goal - motor)
    if drive.step > 0.0:
        goal = math.floor(goal / drive.step + 0.5) * drive.step
    move = goal - motor
    limit = drive.speed * dt
    if drive.step > 0.0:
        limit = math.floor(limit / drive.step + 1e-9) * drive.step
    if move > limit:
        move = limit
    elif move < -limit:
        move = -limit
    if move == goal - motor:
        motor = goal
    else:
        motor += move
    gap = motor - axis
    if abs(gap) > drive.half_backlash + drive.stiction:
        axis = motor - math.copysign(drive.half_backlash, gap)
    return motor, axis, goal


@kernel_inline
def count_move(move, last, drive, count):
    """Add a move to the counts; returns the direction last moved in."""
    if move != 0.0:
        count[STEPS] += abs(move) / drive.step if drive.step > 0.0 else abs(move)
        count[BUSY] += 1.0
        direction = math.copysign(1.0, move)
        if abs(last) < 2.0:  # it stood
            count[STARTS] += 1.0
        if last * direction < 0.0:
            count[REVERSALS] += 1.0
        last = 2.0 * direction
    elif abs(last) > 1.0:
        last = math.copysign(1.0, last)
    return last


@kernel_parallel
def servo_field(command, measured, feed, state, count, law, drive, dt):
    """One step of all axes (axis,), in place of ``state`` (axis, 6) and ``count`` (axis, 4).

    ``command`` and ``measured`` [rad], NaN where unknown; ``feed`` the speed known beforehand [rad/s].
    """
    for i in prange(len(command)):
        s = state[i]
        speed, s[INTEGRAL] = law_step(command[i] - measured[i], s[INTEGRAL], law, dt)
        s[WANTED] += (speed + feed[i]) * dt
        before = s[MOTOR]
        s[MOTOR], s[AXIS], s[GOAL] = stepper_step(s[WANTED], before, s[AXIS], s[GOAL], drive, dt)
        s[LAST] = count_move(s[MOTOR] - before, s[LAST], drive, count[i])


@kernel_parallel
def loop_run(command, disturbance, keep, now, before, row, delay, law, drive, has_drive, dt, out, state, count):
    """Closed loops (loop, time) of law, drive and structure; true angle and speed into ``out`` (loop, time, 2).

    The structure's exact motion over an interval is x ← keep x + before v₋ + now v, with speeds held; ``delay`` whole
    intervals pass from measurement to speed, and the rest of the latency sits between ``before`` and ``now``.
    """
    n_order = len(row)
    for i in prange(command.shape[0]):
        x = np.zeros(n_order)
        moved = np.zeros(n_order)
        line = np.zeros(delay + 1)
        held = 0.0
        s = state[i]
        for t in range(command.shape[1]):
            angle = disturbance[i, t]
            for a in range(n_order):
                angle += row[a] * x[a]
            out[i, t, 0] = angle
            line[t % (delay + 1)] = command[i, t] - angle
            error = line[(t + 1) % (delay + 1)] if t >= delay else np.nan
            speed, s[INTEGRAL] = law_step(error, s[INTEGRAL], law, dt)
            out[i, t, 1] = speed
            if has_drive:
                s[WANTED] += speed * dt
                motor, axis = s[MOTOR], s[AXIS]
                s[MOTOR], s[AXIS], s[GOAL] = stepper_step(s[WANTED], motor, axis, s[GOAL], drive, dt)
                s[LAST] = count_move(s[MOTOR] - motor, s[LAST], drive, count[i])
                speed = (s[AXIS] - axis) / dt
            for a in range(n_order):
                total = before[a] * held + now[a] * speed
                for b in range(n_order):
                    total += keep[a, b] * x[b]
                moved[a] = total
            for a in range(n_order):
                x[a] = moved[a]
            held = speed
