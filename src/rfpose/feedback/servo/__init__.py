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
)
from rfpose.feedback.servo.response import MotorCounts, Response, run_loop

__all__ = [
    "DriveNumbers",
    "Margins",
    "MotorCounts",
    "PiLaw",
    "Response",
    "ServoState",
    "Stepper",
    "check_law",
    "design_law",
    "is_stable",
    "limit_cycle_rad",
    "margins",
    "run_loop",
    "sensitivity",
    "servo_step",
]
