"""A control loop that measures now and then, as the tracking simulation runs it: what it leaves of errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback.servo import PiLaw

__all__ = ["SampledLoop"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledLoop:
    """A PI law on a measurement of the mirror, as the tracking simulation runs it: the mirror follows at once.

    Attributes
    ----------
    gain_per_s, integral_gain_per_s2
        K0, K1.
    interval_s, latency_s
        Between measurements, and from one to the step in which it acts; in whole servo steps, at least one.
    servo_s
        Between servo steps, at which errors count.
    lost
        Part of the measurements that do not arrive.
    """

    gain_per_s: float
    integral_gain_per_s2: float = 0.0
    interval_s: float = 1.0
    latency_s: float = 1.0
    servo_s: float = 1.0
    lost: float = 0.0

    def __post_init__(self) -> None:
        as_positive("interval_s", self.interval_s)
        as_positive("servo_s", self.servo_s)
        if not 0.0 <= self.lost <= 1.0:
            raise InvalidInputError(f"`lost` must be a part, 0 to 1, got {self.lost}")

    @property
    def interval(self) -> int:
        """Servo steps between measurements."""
        return max(round(self.interval_s / self.servo_s), 1)

    @property
    def latency(self) -> int:
        """Servo steps from a measurement to where it acts."""
        return max(int(np.ceil(self.latency_s / self.servo_s - 1e-9)), 1)

    @property
    def law(self) -> PiLaw:
        """Its law, of exact measurements."""
        return PiLaw(gain_per_s=self.gain_per_s, integral_gain_per_s2=self.integral_gain_per_s2, levels=0)

    @property
    def delay_s(self) -> float:
        """What its margins know of the latency [s]: whole intervals, beyond the one within which a step has acted."""
        return max(int(np.ceil(self.latency_s / self.interval_s - 1e-9)) - 1, 0) * self.interval_s

    def _shift(self, frequency_hz: FloatArray) -> npt.NDArray[np.complex128]:
        """Return what the loop shifts the mirror by, for a swinging error of one, from one measurement to the next."""
        n, late = self.interval, self.latency
        interval, here = self.interval_s, 1.0 - self.lost
        # the loop takes away all that stands still
        z = np.exp(2j * np.pi * np.maximum(np.abs(frequency_hz), 1e-9) * interval)
        forward = (
            here * interval * (self.gain_per_s + self.integral_gain_per_s2 * interval * z / (z - 1.0)) * z / (z - 1.0)
        )
        return np.asarray(forward / (1.0 + forward * z ** -float(-(-late // n))), np.complex128)

    def left(self, frequency_hz: npt.ArrayLike) -> FloatArray:
        """Return what part of a swinging error is left, rms over the servo steps between measurements.

        Parameters
        ----------
        frequency_hz : (...)
            May lie above half the sampling rate: what is sampled too rarely is followed falsely, and counts.
        """
        frequency = np.asarray(frequency_hz, np.float64)
        n, late = self.interval, self.latency
        shift = self._shift(frequency)
        square = np.zeros(frequency.shape)
        for step in range(n):
            turn = np.exp(2j * np.pi * frequency * self.servo_s * step)
            behind = np.exp(2j * np.pi * frequency * self.interval_s * ((step - late) // n))
            square += np.abs(turn - shift * behind) ** 2
        return np.asarray(np.sqrt(square / n))

    @property
    def passed(self) -> float:
        """Rms of the mirror for white measurement noise of rms one."""
        frequency = (np.arange(8192) + 0.5) * 0.5 / 8192 / self.interval_s
        # noise comes at the full gain, but with what arrives only
        return float(np.sqrt(np.mean(np.abs(self._shift(frequency)) ** 2) / max(1.0 - self.lost, 1e-9)))

    def start_rms(self, settle_s: float, span_s: float) -> float:
        """Return the rms that an initial error of one leaves over a span that begins some time after the start."""
        n, late = self.interval, self.latency
        here = 1.0 - self.lost
        length = int(np.ceil((settle_s + span_s) / self.servo_s))
        length = min(length, int(settle_s / self.servo_s) + 4000 * n)
        error, pending = np.empty(length), np.zeros(length + late + 1)
        shift = ramp = 0.0
        for g in range(length):
            shift += pending[g]
            error[g] = 1.0 - shift
            if g % n == 0:
                ramp += here * self.integral_gain_per_s2 * self.interval_s * error[g]
                pending[g + late] += self.interval_s * (here * self.gain_per_s * error[g] + ramp)
        after = error[int(settle_s / self.servo_s) :]
        return float(np.sqrt(np.sum(after**2) * self.servo_s / span_s))
