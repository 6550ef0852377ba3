"""How methods steer, in the kernels' numbers, and the margins that the radio loop keeps."""

from __future__ import annotations

from typing import Any

import numpy as np

from rfpose.errors import InvalidInputError
from rfpose.feedback.servo import PiLaw, Stepper
from rfpose.feedback.servo._kernels import DriveNumbers, LawNumbers
from rfpose.feedback.servo.margins import LEAST_GAIN_MARGIN, Margins, margins
from rfpose.feedback.servo.rules import EARTH_RADPS
from rfpose.feedback.structure import Structure
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.capture import N_CAPTURE, TOP_RAD
from rfpose.feedback.tracking.methods import Method
from rfpose.feedback.tracking.timeline import site_of
from rfpose.feedback.tracking.wind import Gusts
from rfpose.scenario import Scenario

__all__ = ["check_gains", "drive_numbers", "loop_margins", "loop_margins_of", "loop_numbers"]

_FORGET_OFFSET_S = 300.0


def loop_margins(
    gain_per_s: float,
    integral_per_s2: float,
    *,
    interval_s: float,
    latency_s: float,
    structure: Structure | None = None,
) -> Margins:
    """Return the margins of ``velocity = gain e + integral ∫e`` on a motor that goes at once where it is told.

    At the next tick a measurement has acted in full if the latency is less than the interval: what counts is the
    number of whole intervals beyond. ``structure`` lies between motor and mirror; None: stiff.

    Raises
    ------
    InvalidInputError
        Gains that are no law, an interval that is not positive, a latency that is negative.
    """
    beyond = max(int(np.ceil(latency_s / interval_s - 1e-9)) - 1, 0)
    law = PiLaw(gain_per_s=gain_per_s, integral_gain_per_s2=integral_per_s2, levels=0)
    return margins(law, structure, interval_s=interval_s, latency_s=beyond * interval_s)


def loop_margins_of(scenario: Scenario) -> Margins:
    """Return the margins of the scenario's radio loop."""
    plan = scenario.tracking
    mode = plan.structure
    return loop_margins(
        plan.radio.gain_per_s,
        plan.radio.integral_gain_per_s2,
        interval_s=plan.control_interval_s,
        latency_s=plan.radio.latency_s,
        structure=Structure(natural_hz=mode.natural_hz, damping=mode.damping) if mode.natural_hz > 0.0 else None,
    )


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


def loop_numbers(scenario: Scenario, method: Method, gusts: Gusts) -> tuple[_kernels.Loop, LawNumbers]:
    """Return how a method steers, as the kernels read it.

    Raises
    ------
    InvalidInputError
        Radio that is later than the kernels keep measurements for.
    """
    plan = scenario.tracking
    radio, servo = plan.radio, plan.servo_interval_s
    control = round(plan.control_interval_s / servo)
    interval, latency, gain, integral, level = control, 1, 1.0, 0.0, 1.0  # what is seen in a step acts in the next
    if method.feedback == _kernels.RADIO:
        gain, integral = radio.gain_per_s, radio.integral_gain_per_s2
        latency = max(int(np.ceil(radio.latency_s / servo - 1e-9)), 1)
        if latency > (_kernels.N_RING - 1) * interval:
            raise InvalidInputError(
                f"[tracking.radio] `latency_s` {radio.latency_s:g} is more than {_kernels.N_RING - 1} control "
                "intervals; shorten it or lengthen `control_interval_s`"
            )
    elif method.feedback == _kernels.ENCODER:
        interval, gain, level = 1, plan.encoder.gain_per_s, 2.0 * np.pi / 2**plan.encoder.bits
    elif method.feedback == _kernels.SUN_SENSOR:
        sensor = plan.sun_sensor
        interval, gain, integral = 1, sensor.gain_per_s, sensor.integral_gain_per_s2
        level = 2e-3 * sensor.range_mrad / sensor.levels
    seconds = interval * servo
    learn = max(1, round(plan.radio_model.learn_interval_s / plan.control_interval_s)) if method.learns else 0
    law = PiLaw(
        gain_per_s=gain,
        integral_gain_per_s2=integral,
        speed_radps=1e-3 * plan.drive.speed_mradps,
        levels=0,
    ).numbers()
    loop = _kernels.Loop(
        feedback=method.feedback,
        interval=interval,
        latency=latency,
        leak=float(np.exp(-seconds / _FORGET_OFFSET_S)) if method.learns else 1.0,
        learn=learn,
        wind_variance=gusts.variance_rad2,
        settle=round(plan.settle_s / servo),
        servo_s=servo,
        level=level,
        reach=1e-3 * plan.sun_sensor.range_mrad,
        per_rad=(N_CAPTURE - 1) / TOP_RAD,
        control=control,
        **_sky(scenario),
        **_swing(gusts),
    )
    return loop, law


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
    (root_y, _), (root_vy, root_v) = gusts.root.tolist()
    right, up = gusts.swing_sigma_rad.tolist()
    return {
        "swings": gusts.swings, "y_y": y_y, "y_v": y_v, "v_y": v_y, "v_v": v_v, "root_y": root_y,
        "root_vy": root_vy, "root_v": root_v, "swing_right": right, "swing_up": up,
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
