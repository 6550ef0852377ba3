"""The servo that follows the sun: law, stepper, margins, response in time, counts of motor moves, rules of thumb."""

from rfpose.feedback.servo._kernels import DriveNumbers
from rfpose.feedback.servo.law import PiLaw, ServoState, Stepper, servo_step
from rfpose.feedback.servo.margins import (
    Margins,
    check_law,
    design_law,
    is_stable,
    limit_cycle_rad,
    margins,
    sensitivity,
    velocity_error_rad,
)
from rfpose.feedback.servo.response import MotorCounts, Response, count_motor, run_loop

__all__ = [
    "DriveNumbers",
    "Margins",
    "MotorCounts",
    "PiLaw",
    "Response",
    "ServoState",
    "Stepper",
    "check_law",
    "count_motor",
    "design_law",
    "is_stable",
    "limit_cycle_rad",
    "margins",
    "run_loop",
    "sensitivity",
    "servo_step",
    "velocity_error_rad",
]
