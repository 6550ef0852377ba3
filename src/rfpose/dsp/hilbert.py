"""The paper's chain: each tone demodulated, filtered, made analytic, and its unit phasors averaged.

A carrier and the two sidebands of a tone pass one narrow filter each. Referred to the carrier's phase they add up to
the analytic signal of the band-passed envelope, which is what envelope detector, band-pass filter and Hilbert
transform make of the same samples, without their edges and at the rate of the filter:
``h = U C*/|C| + (L C*/|C|)*`` (design, signal model; Swart et al. §3.1.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import _kernels
from rfpose.dsp.bank import LineStreams
from rfpose.dsp.correlator import smooth_variance

__all__ = [
    "analytic_tones",
    "average_lines",
    "centred_streams",
    "compensated_dot_phase",
    "dot_phase",
    "unit_phasor_phase",
    "unit_phasor_variance",
    "window_statistics",
]

ComplexArray = npt.NDArray[np.complex128]


def centred_streams(streams: LineStreams) -> ComplexArray:
    """(line, block) amplitude of each line over time, its phase referred to the frame's centre."""
    return np.asarray(streams.stream * _to_centre(streams, streams.cycles, streams.response())[:, None])


def _to_centre(streams: LineStreams, cycles: FloatArray, response: ComplexArray) -> ComplexArray:
    """(line,) factor that makes a filter's output the line's amplitude with its phase at the frame's centre."""
    return np.asarray(np.exp(2j * np.pi * streams.centre * cycles) / response)


@dataclass(frozen=True, slots=True)
class WindowStatistics:
    """How overlapping windows average white noise.

    Attributes
    ----------
    equivalent_samples
        Samples with flat weight that average noise as well as all windows of the frame added up.
    gain
        Noise power in one output over noise power in a sample, at unit response.
    second_order
        Sum over lags of the squared correlation between outputs: how products of noise average.
    """

    equivalent_samples: float
    gain: float
    second_order: float


def window_statistics(streams: LineStreams) -> WindowStatistics:
    """Return the statistics of a windowed bank's outputs."""
    return _window_statistics(streams.window, streams.n_tap, streams.hop, streams.n_block)


@lru_cache(maxsize=16)
def _window_statistics(window: tuple[float, ...], n_tap: int, hop: int, n_block: int) -> WindowStatistics:
    n = np.arange(n_tap)
    weight = np.sum([a * np.cos(2.0 * np.pi * h * (n + 0.5) / n_tap) for h, a in enumerate(window)], axis=0)
    energy = float(np.sum(weight**2))
    # windows add up to a constant inside the frame; at either end the sum tapers off over one window
    rising = np.zeros(n_tap)
    for first in range(0, min(n_tap, n_block * hop), hop):
        rising[first:] += weight[: n_tap - first]
    taper, inner = rising[: n_tap - hop], float(rising[-1])
    n_inner = n_block * hop - (n_tap - hop)
    total = 2.0 * taper.sum() + inner * n_inner
    total_energy = 2.0 * np.sum(taper**2) + inner**2 * n_inner
    lags = [float(np.sum(weight[lag:] * weight[: n_tap - lag])) / energy for lag in range(hop, n_tap, hop)]
    return WindowStatistics(
        equivalent_samples=float(total**2 / total_energy),
        gain=energy / float(np.sum(weight)) ** 2,
        second_order=1.0 + 2.0 * float(np.sum(np.square(lags))),
    )


def analytic_tones(line: ComplexArray, n_transmitter: int, n_tone: int) -> ComplexArray:
    """(transmitter, tone, block) analytic tones from (line, block) amplitudes."""
    out = np.empty((n_transmitter, n_tone, line.shape[1]), np.complex128)
    _kernels.analytic_tones(line, n_tone, out)
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class FilteredLines:
    """Each line as its filter gives it.

    Attributes
    ----------
    line : (line, block)
        As `centred_streams`.
    amplitude, variance : (line,)
        Mean over the frame, and that mean's variance from the scatter about it.
    response : (line,)
        Of one block to unit amplitude.
    statistics
        How the windows average noise.
    """

    line: ComplexArray
    amplitude: ComplexArray
    variance: FloatArray
    response: ComplexArray
    statistics: WindowStatistics


def average_lines(streams: LineStreams, cycles: FloatArray) -> FilteredLines:
    """Bring the lines to another clock offset and average them.

    Parameters
    ----------
    streams
        Of a windowed bank.
    cycles : (line,)
        Frequency of each line where the clock is now assumed [cycles/sample].
    """
    statistics, response = window_statistics(streams), streams.response(cycles)
    line = np.empty_like(streams.stream)
    amplitude, scatter = np.empty(len(line), np.complex128), np.empty(len(line))
    back = (streams.cycles - cycles) * streams.hop
    _kernels.filtered_lines(streams.stream, back, _to_centre(streams, cycles, response), line, amplitude, scatter)
    n_equivalent = statistics.equivalent_samples
    dof = max(2.0 * n_equivalent * statistics.gain, 2.0)
    per_sample = scatter / (statistics.gain - 1.0 / n_equivalent)
    return FilteredLines(
        line=line,
        amplitude=amplitude,
        variance=smooth_variance(per_sample, dof) / n_equivalent,
        response=response,
        statistics=statistics,
    )


def unit_phasor_variance(relative_noise: FloatArray, statistics: WindowStatistics, n_block: int) -> FloatArray:
    """Variance that discarding the phasors' lengths adds to the mean phase [rad²].

    With noise of variance s² in each part of a unit phasor, ``mean(h/|h|)`` has phase variance s² + s⁴ an output;
    the second term averages with the squared correlation between outputs.

    Parameters
    ----------
    relative_noise : (...)
        Variance of the complex noise over the power of the tone, in one output.
    statistics, n_block
        Of the outputs.
    """
    s2 = 0.5 * relative_noise
    return np.asarray(s2 * s2 * (statistics.second_order / n_block))


def unit_phasor_phase(tone: ComplexArray) -> FloatArray:
    """Phase of the mean unit phasor over the last axis (§3.1.3) [rad]."""
    mean = np.empty(tone.shape[:2], np.complex128)
    _kernels.mean_unit_phasor(tone, mean)
    return np.asarray(np.angle(mean))


def dot_phase(tone: ComplexArray, reference: ComplexArray) -> FloatArray:
    """Unsigned phase against a reference tone by the dot product (§3.1.1), in [0, π] [rad].

    The product of two real tones averages to ``½ Re⟨h₁ h₂*⟩`` once the double frequency has averaged out.
    """
    product = np.mean((tone * np.conj(reference)).real, axis=-1)
    power = np.mean(np.abs(tone) ** 2, axis=-1) * np.mean(np.abs(reference) ** 2, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.arccos(np.clip(product / np.sqrt(power), -1.0, 1.0)))


def compensated_dot_phase(
    tone: ComplexArray, reference: ComplexArray, noise: FloatArray, reference_noise: FloatArray
) -> FloatArray:
    """Unsigned phase by the dot product with the noise's power taken off each tone's (§3.1.2), in [0, π] [rad].

    ``noise`` is the variance of the complex noise in each analytic tone.
    """
    product = np.mean((tone * np.conj(reference)).real, axis=-1)
    power = np.mean(np.abs(tone) ** 2, axis=-1) - noise
    power_reference = np.mean(np.abs(reference) ** 2, axis=-1) - reference_noise
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = product / np.sqrt(np.maximum(power, 0.0) * np.maximum(power_reference, 0.0))
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))
