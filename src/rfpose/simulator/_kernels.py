"""The samples of a stretch of one frame: sum of rays, then noise and analogue-digital converter.

Phase is counted in turns as an unsigned 64-bit fraction (2^64 = one turn), which wraps by itself: the phase of
sample n, start + n·step, is off by no more than n·2^-65 turns, 5e-13 turns at the longest frame. Sines are taken
once a block of 256 samples and once for each place within a block; between them phasors are multiplied.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.jit import kernel, kernel_fast, kernel_inline

__all__ = ["BLOCK", "sum_of_rays", "to_float32", "to_int16"]

BLOCK = 256
_TWO_PI = 2.0 * np.pi
_TURN_OF_ONE = 2.0**-53  # of the 53 highest bits
_LOW_BITS = np.uint64(11)

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int16 = npt.NDArray[np.int16]
Uint64 = npt.NDArray[np.uint64]


@kernel
def _radians(turn: np.uint64) -> float:
    """Return a 64-bit fraction of a turn as an angle in [0, 2π)."""
    return _TWO_PI * (np.float64(turn >> _LOW_BITS) * _TURN_OF_ONE)


@kernel
def _rotations(step: Uint64) -> Float64:
    """Return (line, 2, BLOCK): cosine and sine of k steps of each line."""
    rotation = np.empty((step.shape[0], 2, BLOCK))
    for i_line in range(step.shape[0]):
        turn = np.uint64(0)
        for k in range(BLOCK):
            angle = _radians(turn)
            rotation[i_line, 0, k] = np.cos(angle)
            rotation[i_line, 1, k] = np.sin(angle)
            turn += step[i_line]
    return rotation


@kernel_inline
def _add_cosine(re: float, im: float, cos: Float64, sin: Float64, envelope: Float64) -> None:
    """Envelope += Re((re + j im)·(cos + j sin))."""
    for k in range(envelope.shape[0]):
        envelope[k] += re * cos[k] - im * sin[k]


@kernel_inline
def _add_carrier(
    re: float, im: float, cos: Float64, sin: Float64, envelope: Float64, sum_re: Float64, sum_im: Float64
) -> None:
    """Sum += (re + j im)·(cos + j sin)·envelope."""
    for k in range(envelope.shape[0]):
        sum_re[k] += (re * cos[k] - im * sin[k]) * envelope[k]
        sum_im[k] += (re * sin[k] + im * cos[k]) * envelope[k]


@kernel_fast
def sum_of_rays(
    first: int,
    amplitude: Float64,
    carrier_turn: Uint64,
    carrier_step: Uint64,
    modulation_index: Float64,
    tone_turn: Uint64,
    tone_step: Uint64,
    out: Float64,
) -> None:
    """Fill ``out`` with the noise-free samples first, first + 1, … of a frame.

    Each ray is a carrier phasor × (1 + Σ_q m_q cos(…)).

    Parameters
    ----------
    amplitude, carrier_turn : (transmitter, ray)
        Amplitude, and carrier phase at the frame's sample zero [2^-64 turn].
    carrier_step : (transmitter,)
        Phase from sample to sample [2^-64 turn].
    modulation_index, tone_step : (tone,)
    tone_turn : (transmitter, ray, tone)
    out : (2, sample)
        Real and imaginary part.
    """
    carrier_rotation = _rotations(carrier_step)
    tone_rotation = _rotations(tone_step)
    envelope_block = np.empty(BLOCK)
    out[:] = 0.0
    for start in range(0, out.shape[1], BLOCK):
        stop = min(start + BLOCK, out.shape[1])
        envelope = envelope_block[: stop - start]
        n = np.uint64(first + start)
        for i in range(amplitude.shape[0]):
            for p in range(amplitude.shape[1]):
                if amplitude[i, p] == 0.0:  # links have unequal numbers of rays
                    continue
                envelope[:] = 1.0
                for q in range(tone_step.shape[0]):
                    angle = _radians(tone_turn[i, p, q] + n * tone_step[q])
                    re = modulation_index[q] * np.cos(angle)
                    im = modulation_index[q] * np.sin(angle)
                    _add_cosine(re, im, tone_rotation[q, 0], tone_rotation[q, 1], envelope)
                angle = _radians(carrier_turn[i, p] + n * carrier_step[i])
                re = amplitude[i, p] * np.cos(angle)
                im = amplitude[i, p] * np.sin(angle)
                rotation = carrier_rotation[i]
                _add_carrier(re, im, rotation[0], rotation[1], envelope, out[0, start:stop], out[1, start:stop])


@kernel_fast
def to_int16(signal: Float64, noise: Float32, sigma: float, counts_per_unit: float, top: float, out: Int16) -> None:
    """Add noise, convert to counts, round to nearest, saturate at ±top.

    Parameters
    ----------
    signal : (2, sample)
        As `sum_of_rays` gives it.
    noise, out : (sample, 2)
        Standard normal; counts.
    sigma
        Standard deviation of the noise of one component, in the signal's unit.
    """
    for k in range(out.shape[0]):
        re = np.rint((signal[0, k] + sigma * noise[k, 0]) * counts_per_unit)
        im = np.rint((signal[1, k] + sigma * noise[k, 1]) * counts_per_unit)
        out[k, 0] = np.int16(min(max(re, -top), top))
        out[k, 1] = np.int16(min(max(im, -top), top))


@kernel_fast
def to_float32(signal: Float64, noise: Float32, sigma: float, out: Float32) -> None:
    """Add noise; arguments as in `to_int16`."""
    for k in range(out.shape[0]):
        out[k, 0] = np.float32(signal[0, k] + sigma * noise[k, 0])
        out[k, 1] = np.float32(signal[1, k] + sigma * noise[k, 1])
