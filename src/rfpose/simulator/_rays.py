"""One receiver's rays in one frame: amplitudes, and phases as 64-bit fractions of a turn.

Sample numbers since the epoch reach 10^17, too many for float64. The phase at a frame's first sample is
therefore reduced to a fraction of a turn with exact rational arithmetic, and samples count from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.scenario import Scenario

__all__ = ["RayTerms", "make_rays"]

Uint64 = npt.NDArray[np.uint64]
ComplexArray = npt.NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class RayTerms:
    """What `_kernels.sum_of_rays` needs; see there for shapes and units."""

    amplitude: FloatArray
    carrier_turn: Uint64
    carrier_step: Uint64
    tone_turn: Uint64
    tone_step: Uint64


def make_rays(
    scenario: Scenario,
    *,
    length_m: FloatArray,
    gain: ComplexArray,
    pass_factor: FloatArray,
    carrier_phase_rad: FloatArray,
    tone_phase_rad: FloatArray,
    delay_s: float,
    clock_ppm: float,
    oscillator_phase_rad: float,
    sampling_phase: float,
    run_start_index: int,
    sample_in_run: int,
) -> RayTerms:
    """Return the rays of one receiver in one frame.

    The receiver's clock counts from ``run_start_index``, where a stretch of samples without a pause began; the
    frame's first sample is number ``sample_in_run`` of that stretch.

    Parameters
    ----------
    scenario
    length_m, gain : (transmitter, ray)
        As in `Paths`.
    pass_factor : (transmitter,)
        What is left of the amplitude behind an obstacle.
    carrier_phase_rad : (transmitter,)
        θ.
    tone_phase_rad : (transmitter, tone)
        Φ.
    delay_s, clock_ppm, oscillator_phase_rad, sampling_phase
        Of the receiver, see `RecordingDraws`.
    run_start_index
        Samples since the epoch at the nominal rate.
    sample_in_run
    """
    radio = scenario.radio
    clock = Fraction(clock_ppm * 1e-6)
    rate = radio.sample_rate * (1 + clock)
    # ideal time of the frame's first sample, since the epoch [s]
    time = run_start_index / radio.sample_rate + (sample_in_run + Fraction(sampling_phase)) / rate
    beat = [Fraction(f) - Fraction(radio.centre_frequency_hz) * clock for f in scenario.carrier_hz.tolist()]
    tone = [Fraction(f) for f in scenario.tone_hz.tolist()]

    tau = length_m / radio.propagation_speed_mps + delay_s
    carrier_rf_hz = radio.centre_frequency_hz + scenario.carrier_hz
    carrier_rad = (carrier_phase_rad + oscillator_phase_rad)[:, None] + np.angle(gain)
    carrier_turns = carrier_rad / (2.0 * np.pi) - carrier_rf_hz[:, None] * tau
    tone_turns = tone_phase_rad[:, None, :] / (2.0 * np.pi) - tau[:, :, None] * scenario.tone_hz
    return RayTerms(
        amplitude=np.abs(gain) * pass_factor[:, None],
        carrier_turn=_turns_from_fractions([f * time for f in beat])[:, None] + _turns_from_floats(carrier_turns),
        carrier_step=_turns_from_fractions([f / rate for f in beat]),
        tone_turn=_turns_from_fractions([f * time for f in tone]) + _turns_from_floats(tone_turns),
        tone_step=_turns_from_fractions([f / rate for f in tone]),
    )


def _turns_from_fractions(turns: Sequence[Fraction]) -> Uint64:
    """Return the part of each number behind the point, in units of 2^-64, to half a unit."""
    units = [(2 * (x.numerator << 64) + x.denominator) // (2 * x.denominator) for x in turns]
    return np.array([unit & (2**64 - 1) for unit in units], np.uint64)


def _turns_from_floats(turns: FloatArray) -> Uint64:
    """Return the part of each number behind the point, in units of 2^-64, to float64's precision."""
    return ((turns - np.floor(turns)) * 2.0**53).astype(np.uint64) << np.uint64(11)
