"""Margins of a sampled loop: what a feedback gain, an interval and a delay leave until it oscillates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfpose.errors import InvalidInputError
from rfpose.scenario import Scenario

__all__ = ["LEAST_GAIN_MARGIN", "Margins", "check_gains", "loop_margins"]

LEAST_GAIN_MARGIN = 1.5
"""Edwards (6.2): quantisation lets the gain of a level vary by this much."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Margins:
    """How far a loop is from oscillating.

    Attributes
    ----------
    gain
        By what the gain may be multiplied; one or less: unstable.
    phase_rad
        Further lag at unity gain that it bears [rad].
    bandwidth_hz
        Where the open loop's gain is one [Hz].
    delay_s
        Further delay that it bears [s].
    """

    gain: float
    phase_rad: float
    bandwidth_hz: float
    delay_s: float


def loop_margins(gain_per_s: float, integral_per_s2: float, *, interval_s: float, latency_s: float) -> Margins:
    """Return the margins of ``velocity = gain e + integral ∫e`` on a motor that goes where it is told.

    A measurement taken at a tick acts after the latency; at the next tick it has acted in full if the latency is less
    than the interval. In z: L = T (K0 + K1 T z/(z−1)) / (z−1) · z^−d, d whole intervals of delay.

    Raises
    ------
    InvalidInputError
        A gain that is negative or zero throughout, an interval that is not positive.
    """
    if not (gain_per_s > 0.0 and integral_per_s2 >= 0.0 and interval_s > 0.0 and latency_s >= 0.0):
        raise InvalidInputError(
            f"`gain_per_s` and `interval_s` must be positive, `integral_gain_per_s2` and `latency_s` not negative, got "
            f"{gain_per_s}, {interval_s}, {integral_per_s2}, {latency_s}"
        )
    delay = int(np.ceil(latency_s / interval_s - 1e-9)) - 1 if latency_s > 0.0 else 0
    delay = max(delay, 0)
    omega = np.geomspace(1e-5, np.pi * (1.0 - 1e-9), 40_000)  # radians an interval
    z = np.exp(1j * omega)
    response = interval_s * (gain_per_s + integral_per_s2 * interval_s * z / (z - 1.0)) / (z - 1.0) * z**-delay
    phase = np.unwrap(np.angle(response))
    phase -= 2.0 * np.pi * np.rint((phase[0] + 0.5 * np.pi) / (2.0 * np.pi))
    size = np.abs(response)
    crossing = np.flatnonzero((size[:-1] >= 1.0) & (size[1:] < 1.0))
    at = int(crossing[-1]) if crossing.size else len(omega) - 1
    lagging = np.flatnonzero((phase[:-1] > -np.pi) & (phase[1:] <= -np.pi))
    margin = 1.0 / float(size[lagging[-1]]) if lagging.size else 1.0 / float(size[-1])
    left = float(phase[at] + np.pi)
    return Margins(
        gain=margin,
        phase_rad=left,
        bandwidth_hz=float(omega[at] / (2.0 * np.pi * interval_s)),
        delay_s=max(left, 0.0) / float(omega[at]) * interval_s,
    )


def check_gains(scenario: Scenario) -> Margins:
    """Return the margins of the scenario's radio loop.

    Raises
    ------
    InvalidInputError
        They are less than quantisation asks for, and ``force_gains`` is not set.
    """
    plan = scenario.tracking
    margins = loop_margins(
        plan.radio.gain_per_s,
        plan.radio.integral_gain_per_s2,
        interval_s=plan.control_interval_s,
        latency_s=plan.radio.latency_s,
    )
    if not plan.radio.force_gains and not (margins.gain >= LEAST_GAIN_MARGIN and margins.phase_rad > 0.0):
        raise InvalidInputError(
            f"[tracking.radio] the gains leave a gain margin of {margins.gain:.2f} and a phase margin of "
            f"{np.rad2deg(margins.phase_rad):.0f} degrees at {plan.control_interval_s:g} s interval and "
            f"{plan.radio.latency_s:g} s latency; {LEAST_GAIN_MARGIN:g} is the least: lower `gain_per_s` and "
            "`integral_gain_per_s2`, or set `force_gains`"
        )
    return margins
