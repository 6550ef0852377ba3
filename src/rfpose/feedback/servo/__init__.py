"""The servo that follows the sun: law, stepper, margins, sensor, counts of motor moves."""

from rfpose.feedback.servo.law import PiLaw, ServoState, Stepper, servo_step

__all__ = ["PiLaw", "ServoState", "Stepper", "servo_step"]
