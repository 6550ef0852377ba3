"""How methods steer, in the kernels' numbers, and the margins that the radio loop keeps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.feedback.servo import DriveNumbers, Stepper
from rfpose.feedback.servo.margins import LEAST_GAIN_MARGIN, Margins, margins
from rfpose.feedback.servo.rules import EARTH_RADPS
from rfpose.feedback.structure import StructureMode
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.capture import N_CAPTURE, TOP_RAD
from rfpose.feedback.tracking.methods import Method
from rfpose.feedback.tracking.sampled_loop import SampledLoop
from rfpose.feedback.tracking.timeline import site_of
from rfpose.feedback.tracking.wind import Gusts, structure_of
from rfpose.scenario import Scenario

__all__ = ["check_gains", "drive_numbers", "loop_margins", "loop_margins_of", "loop_of", "steering_of"]

_FORGET_OFFSET_S = 300.0


def loop_of(scenario: Scenario, feedback: int) -> SampledLoop | None:
    """Return the loop of a kind of feedback, by the kernels' number; None: nothing is measured."""
    plan, servo = scenario.tracking, scenario.tracking.servo_interval_s
    if feedback == _kernels.RADIO:
        return SampledLoop(
            gain_per_s=plan.radio.gain_per_s, integral_gain_per_s2=plan.radio.integral_gain_per_s2,
            interval_s=plan.control_interval_s, latency_s=plan.radio.latency_s, servo_s=servo,
            lost=plan.radio.lost_frames,
        )  # fmt: skip
    # what is seen in a step acts in the next
    if feedback == _kernels.ENCODER:
        return SampledLoop(gain_per_s=plan.encoder.gain_per_s, interval_s=servo, latency_s=servo, servo_s=servo)
    if feedback == _kernels.SUN_SENSOR:
        return SampledLoop(
            gain_per_s=plan.sun_sensor.gain_per_s, integral_gain_per_s2=plan.sun_sensor.integral_gain_per_s2,
            interval_s=servo, latency_s=servo, servo_s=servo,
        )  # fmt: skip
    return None


def loop_margins(loop: SampledLoop, structure: StructureMode | None = None) -> Margins:
    """Return the margins of a loop on a motor that goes at once where it is told.

    At the next tick a measurement has acted in full if the latency is less than the interval: what counts is the
    number of whole intervals beyond. ``structure`` lies between motor and mirror; None: stiff.
    """
    return margins(loop.law, structure, interval_s=loop.interval_s, latency_s=loop.delay_s)


def loop_margins_of(scenario: Scenario) -> Margins:
    """Return the margins of the scenario's radio loop."""
    loop = loop_of(scenario, _kernels.RADIO)
    assert loop is not None
    return loop_margins(loop, structure_of(scenario))


def check_gains(scenario: Scenario) -> Margins:
    """Return the margins of the scenario's radio loop.

    Raises
    ------
    InvalidInputError
        They are less than quantisation asks for, and ``force_gains`` is not set.
    """
    plan, found = scenario.tracking, loop_margins_of(scenario)
    if not plan.radio.force_gains and not (found.stable and found.gain >= LEAST_GAIN_MARGIN):
        raise InvalidInputError(
            f"[tracking.radio] the gains leave a gain margin of {found.gain:.2f} and a phase margin of "
            f"{np.rad2deg(found.phase_rad):.0f} degrees at {plan.control_interval_s:g} s interval and "
            f"{plan.radio.latency_s:g} s latency; {LEAST_GAIN_MARGIN:g} is the least: lower `gain_per_s` and "
            "`integral_gain_per_s2`, or set `force_gains`"
        )
    return found


def steering_of(scenario: Scenario, method: Method, gusts: Gusts, table: FloatArray) -> _kernels.Steering:
    """Return how a method steers, as the kernels read it; ``table`` of `capture_table`.

    Raises
    ------
    InvalidInputError
        Radio that is later than the kernels keep measurements for.
    """
    plan, servo = scenario.tracking, scenario.tracking.servo_interval_s
    control = round(plan.control_interval_s / servo)
    sampled = loop_of(scenario, method.feedback) or SampledLoop(
        gain_per_s=1.0, interval_s=plan.control_interval_s, latency_s=servo, servo_s=servo
    )
    interval = sampled.interval
    if method.feedback == _kernels.RADIO and sampled.latency > (_kernels.N_RING - 1) * interval:
        raise InvalidInputError(
            f"[tracking.radio] `latency_s` {plan.radio.latency_s:g} is more than {_kernels.N_RING - 1} control "
            "intervals; shorten it or lengthen `control_interval_s`"
        )
    levels = {_kernels.ENCODER: plan.encoder.level_rad, _kernels.SUN_SENSOR: plan.sun_sensor.level_rad}
    seconds = interval * servo
    learn = max(1, round(plan.radio_model.learn_interval_s / plan.control_interval_s)) if method.learns else 0
    law = replace(sampled.law, speed_radps=1e-3 * plan.drive.speed_mradps).numbers()
    loop = _kernels.Loop(
        feedback=method.feedback,
        interval=interval,
        latency=sampled.latency,
        leak=float(np.exp(-seconds / _FORGET_OFFSET_S)) if method.learns else 1.0,
        learn=learn,
        wind_variance=gusts.variance_rad2,
        settle=round(plan.settle_s / servo),
        servo_s=servo,
        level=levels.get(method.feedback, 1.0),
        reach=1e-3 * plan.sun_sensor.range_mrad,
        per_rad=(N_CAPTURE - 1) / TOP_RAD,
        control=control,
        **_sky(scenario),
        **_swing(gusts),
    )
    drives = [drive_numbers(scenario, axis) for axis in (0, 1)]
    return _kernels.Steering(loop, law, drives[0], drives[1], table)


def _sky(scenario: Scenario) -> dict[str, Any]:
    """Return what a mirror needs to carry a sun that it heard of on."""
    plan, site = scenario.tracking, site_of(scenario)
    carries = plan.field_control is not None and plan.field_control.between_messages == "carried-on"
    return {
        "pole_n": float(np.cos(site.latitude_rad)),
        "pole_u": float(np.sin(site.latitude_rad)),
        "turn": EARTH_RADPS * plan.servo_interval_s if carries else 0.0,
    }


def _swing(gusts: Gusts) -> dict[str, Any]:
    """Return how the structure swings."""
    (y_y, y_v), (v_y, v_v) = gusts.transition.tolist()
    kick_y, kick_v = gusts.kick.tolist()
    right, up = gusts.swing_sigma_rad.tolist()
    return {
        "swings": gusts.swings, "y_y": y_y, "y_v": y_v, "v_y": v_y, "v_v": v_v, "kick_y": kick_y, "kick_v": kick_v,
        "swing_right": right, "swing_up": up,
    }  # fmt: skip


def drive_numbers(scenario: Scenario, axis: int) -> DriveNumbers:
    """Return one axis's motor and gear in counts and servo steps."""
    drive, servo = scenario.tracking.drive, scenario.tracking.servo_interval_s
    count = 2.0 * np.pi / drive.steps_per_turn
    wait = drive.dead_band_steps * count if drive.dead_band_steps > 0.0 else None
    numbers = Stepper(
        steps_per_turn=drive.steps_per_turn,
        microsteps=drive.microsteps,
        speed_radps=1e-3 * drive.speed_mradps,
        backlash_rad=1e-3 * drive.backlash_mrad[axis],
        stiction_rad=1e-3 * drive.stiction_mrad[axis],
        dead_band_rad=wait,
    ).numbers(servo)
    return DriveNumbers(
        step=numbers.step / count,
        speed=numbers.speed * servo / count,
        half_backlash=numbers.half_backlash / count,
        stiction=numbers.stiction / count,
        dead_band=numbers.dead_band / count,
        lead=numbers.lead / count,
    )
