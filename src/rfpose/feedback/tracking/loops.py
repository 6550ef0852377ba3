"""Margins of the radio loop: what a feedback gain, an interval and a delay leave until it oscillates."""

from __future__ import annotations

import numpy as np

from rfpose.errors import InvalidInputError
from rfpose.feedback.servo import PiLaw
from rfpose.feedback.servo.margins import LEAST_GAIN_MARGIN, Margins, margins
from rfpose.scenario import Scenario

__all__ = ["check_gains", "loop_margins"]


def loop_margins(gain_per_s: float, integral_per_s2: float, *, interval_s: float, latency_s: float) -> Margins:
    """Return the margins of ``velocity = gain e + integral ∫e`` on a motor that goes at once where it is told.

    At the next tick a measurement has acted in full if the latency is less than the interval: what counts is the
    number of whole intervals beyond.

    Raises
    ------
    InvalidInputError
        Gains that are no law, an interval that is not positive, a latency that is negative.
    """
    beyond = max(int(np.ceil(latency_s / interval_s - 1e-9)) - 1, 0)
    law = PiLaw(gain_per_s=gain_per_s, integral_gain_per_s2=integral_per_s2, levels=0)
    return margins(law, None, interval_s=interval_s, latency_s=beyond * interval_s)


def check_gains(scenario: Scenario) -> Margins:
    """Return the margins of the scenario's radio loop.

    Raises
    ------
    InvalidInputError
        They are less than quantisation asks for, and ``force_gains`` is not set.
    """
    plan = scenario.tracking
    found = loop_margins(
        plan.radio.gain_per_s,
        plan.radio.integral_gain_per_s2,
        interval_s=plan.control_interval_s,
        latency_s=plan.radio.latency_s,
    )
    if not plan.radio.force_gains and not (found.stable and found.gain >= LEAST_GAIN_MARGIN):
        raise InvalidInputError(
            f"[tracking.radio] the gains leave a gain margin of {found.gain:.2f} and a phase margin of "
            f"{np.rad2deg(found.phase_rad):.0f} degrees at {plan.control_interval_s:g} s interval and "
            f"{plan.radio.latency_s:g} s latency; {LEAST_GAIN_MARGIN:g} is the least: lower `gain_per_s` and "
            "`integral_gain_per_s2`, or set `force_gains`"
        )
    return found
