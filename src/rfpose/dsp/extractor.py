"""From the samples of one frame to tone phases, by the estimator of one's choice."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import _kernels, hilbert
from rfpose.dsp.bank import LineBank, LineStreams
from rfpose.dsp.clock import coarse_clock_ppm, refine_clock
from rfpose.dsp.correlator import fit_lines
from rfpose.dsp.plan import LinePlan
from rfpose.dsp.tones import FrameTones, LineStatus
from rfpose.errors import InvalidInputError

__all__ = ["ESTIMATORS", "ToneExtractor"]

ComplexArray = npt.NDArray[np.complex128]
Samples = npt.NDArray[np.int16] | npt.NDArray[np.float32]

ESTIMATORS = ("hilbert", "correlator", "dot", "dot-compensated")

_MAX_CLIPPED_FRACTION = 1e-4
_ZERO_SEGMENT = 256
_CLOCK_DRIFT_PPM = 0.5
"""How far a clock may wander from where it was acquired before it is acquired anew."""
_CARRIER_POWER_SNR = 25.0
"""A carrier counts as present above this power ratio to the noise: false alarm exp(−25) a line."""
_TONE_POWER_SNR = 8.0
"""A tone has a usable phase above this power ratio; its sigma is then below 0.25 rad."""


class ToneExtractor:
    """Measures tone phases frame by frame.

    Parameters
    ----------
    plan
        The recording's lines.
    estimator
        ``"hilbert"``: narrow filters, analytic tones, unit-phasor averaging (§3.1.3). ``"correlator"``: joint least
        squares of all carriers and sidebands, maximum likelihood in white noise. ``"dot"``, ``"dot-compensated"``:
        the paper's dot products (§3.1.1, §3.1.2), which know no sign; it is taken from the Hilbert phase.
    full_scale
        Component magnitude at which a sample counts as clipped [counts].

    Raises
    ------
    InvalidInputError
        Unknown estimator.
    """

    def __init__(self, plan: LinePlan, estimator: str = "hilbert", *, full_scale: float = 32767.0) -> None:
        if estimator not in ESTIMATORS:
            raise InvalidInputError(f"`estimator` must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
        self.plan = plan
        self.estimator = estimator
        self.full_scale = float(full_scale)
        self._bank = lru_cache(maxsize=4)(self._make_bank)

    def _make_bank(self, n_sample: int) -> LineBank:
        return LineBank(self.plan, n_sample, windowed=self.estimator != "correlator")

    def acquire_clock(self, samples: npt.ArrayLike) -> float:
        """Return the receiver's clock offset [ppm], searched over the plan's whole range; NaN for bad samples.

        Parameters
        ----------
        samples : (sample, 2)
            One frame.
        """
        x = _as_samples(samples)
        if self._fault(x)[0] is not LineStatus.OK:
            return np.nan
        coarse = coarse_clock_ppm(x, self.plan)
        bin_ppm = 1.0 / (min(len(x), 2**17) * float(np.max(np.abs(self.plan.cycles_per_ppm()))))
        streams = self._bank(len(x)).streams(x, coarse)
        return refine_clock(streams, self.plan, coarse, min(bin_ppm, self.plan.clock_search_ppm))[0]

    def measure(self, samples: npt.ArrayLike, *, clock_ppm: float | None = None) -> FrameTones:
        """Measure one frame of one receiver.

        Parameters
        ----------
        samples : (sample, 2)
            I and Q as recorded, int16 or float32.
        clock_ppm
            Where `acquire_clock` found the receiver's clock; None searches here. Either way the offset is refined
            on this frame.

        Returns
        -------
        FrameTones
            Bad samples give NaN with the reason as status.

        Raises
        ------
        InvalidInputError
            Samples of another shape or type, or fewer than 64.
        """
        x = _as_samples(samples)
        fault, clipped = self._fault(x)
        if fault is not LineStatus.OK:
            return FrameTones.failed(self.plan.n_transmitter, self.plan.n_tone, fault, clipped_fraction=clipped)
        bank = self._bank(len(x))
        start_ppm = self.acquire_clock(x) if clock_ppm is None or not np.isfinite(clock_ppm) else float(clock_ppm)
        streams = bank.streams(x, start_ppm)
        drift = min(_CLOCK_DRIFT_PPM, self.plan.clock_search_ppm)
        ppm, curvature, power = refine_clock(streams, self.plan, start_ppm, drift)
        if clock_ppm is not None and power[0] < 0.5 * power[1]:
            # the lines do not add up: either all is noise, or the clock has jumped
            again = self.acquire_clock(x)
            if abs(again - ppm) > drift:
                start_ppm = again
                streams = bank.streams(x, start_ppm)
                ppm, curvature, power = refine_clock(streams, self.plan, start_ppm, drift)
        streams = streams.at_clock(self.plan, start_ppm, ppm)
        if self.estimator != "correlator":
            return self._from_filters(streams, ppm, curvature, clipped)
        slope = self.plan.cycles_per_ppm()
        fit = fit_lines(streams, slope)
        if abs(fit.clock_step_ppm) > 0.3 * fit.clock_step_sigma_ppm:
            # the power's maximum is shifted a little by leakage between lines; their joint fit is not
            ppm += fit.clock_step_ppm
            fit = fit_lines(streams.at_clock(self.plan, ppm - fit.clock_step_ppm, ppm), slope)
        tone = hilbert.analytic_tones(fit.amplitude[:, None], self.plan.n_transmitter, self.plan.n_tone)[..., 0]
        return self._tones(
            fit.amplitude,
            fit.variance,
            tone,
            np.angle(tone),
            0.0,
            float(len(x)),
            (ppm, fit.clock_step_sigma_ppm),
            clipped,
        )

    def _from_filters(self, streams: LineStreams, ppm: float, curvature: float, clipped: float) -> FrameTones:
        """Measure by averaging the filtered, analytic tones."""
        n_transmitter, n_tone = self.plan.n_transmitter, self.plan.n_tone
        line = hilbert.centred_streams(streams)
        amplitude, variance = hilbert.average_lines(streams, line)
        tone = hilbert.analytic_tones(amplitude[:, None], n_transmitter, n_tone)[..., 0]
        phase, added = self._averaged_phase(
            streams, hilbert.analytic_tones(line, n_transmitter, n_tone), tone, variance
        )
        n_effective = hilbert.window_statistics(streams).equivalent_samples
        clock = ppm, _clock_sigma(streams, curvature, float(np.median(variance)) * n_effective)
        return self._tones(amplitude, variance, tone, phase, added, n_effective, clock, clipped)

    def _fault(self, x: Samples) -> tuple[LineStatus, float]:
        """Return what is wrong with the samples, and the fraction at full scale."""
        flat = x.reshape(-1)
        if x.dtype == np.int16:
            limit = min(self.full_scale, 32767.0)
            n_clip, n_fill, n_zero = _kernels.inspect_i16(flat, np.int16(limit), _ZERO_SEGMENT)
            n_bad = 0
        else:
            n_clip, n_bad, n_zero = _kernels.inspect_f32(flat, self.full_scale, _ZERO_SEGMENT)
            n_fill = 0
        clipped = n_clip / len(x)
        if n_bad:
            return LineStatus.NOT_FINITE, clipped
        if n_zero == len(x):
            return LineStatus.NO_SIGNAL, clipped
        if n_zero or n_fill:
            return LineStatus.MISSING_SAMPLES, clipped
        if clipped > _MAX_CLIPPED_FRACTION:
            return LineStatus.CLIPPED, clipped
        return LineStatus.OK, clipped

    def _tones(
        self,
        amplitude: ComplexArray,
        variance: FloatArray,
        tone: ComplexArray,
        phase: FloatArray,
        added_variance: FloatArray | float,
        n_effective: float,
        clock: tuple[float, float],
        clipped: float,
    ) -> FrameTones:
        """Put the record together, and mark what is too weak."""
        n_transmitter = self.plan.n_transmitter
        by_transmitter, lines = amplitude.reshape(n_transmitter, -1), variance.reshape(n_transmitter, -1)
        tone_variance = lines[:, 1::2] + lines[:, 2::2]
        tone_power = np.abs(tone) ** 2
        sigma = np.sqrt(0.5 * tone_variance / tone_power + added_variance)
        status = np.full(n_transmitter, LineStatus.OK, np.uint8)
        status[np.any(tone_power < _TONE_POWER_SNR * tone_variance, axis=1)] = LineStatus.WEAK
        status[np.abs(by_transmitter[:, 0]) ** 2 < _CARRIER_POWER_SNR * lines[:, 0]] = LineStatus.ABSENT
        bad = status != LineStatus.OK
        phase[bad] = np.nan
        sigma[bad] = np.nan
        return FrameTones(
            phase_rad=phase,
            sigma_rad=sigma,
            carrier=by_transmitter[:, 0],
            carrier_sigma=np.sqrt(0.5 * lines[:, 0]),
            sideband=np.stack([by_transmitter[:, k::2] for k in (1, 2)], axis=-1),
            sideband_sigma=np.sqrt(0.5 * np.stack([lines[:, k::2] for k in (1, 2)], axis=-1)),
            clock_ppm=clock[0],
            clock_sigma_ppm=clock[1],
            noise_variance=float(np.median(variance)) * n_effective,
            clipped_fraction=clipped,
            status=status,
        )

    def _averaged_phase(
        self, streams: LineStreams, tones: ComplexArray, mean_tone: ComplexArray, variance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Phase by the chosen average of the analytic tones, and the variance it adds to the noise's own."""
        signed = hilbert.unit_phasor_phase(tones)
        lines = variance.reshape(self.plan.n_transmitter, -1)
        statistics = hilbert.window_statistics(streams)
        per_output = (lines[:, 1::2] + lines[:, 2::2]) * (statistics.equivalent_samples * statistics.gain)
        if self.estimator == "hilbert":
            return signed, hilbert.unit_phasor_variance(per_output / np.abs(mean_tone) ** 2, streams)
        reference = int(np.argmax(np.abs(mean_tone[:, 0])))
        ref_tone = tones[reference][None]
        if self.estimator == "dot":
            unsigned = hilbert.dot_phase(tones, ref_tone)
        else:
            unsigned = hilbert.compensated_dot_phase(tones, ref_tone, per_output, per_output[reference][None])
        difference = np.mod(signed - signed[reference] + np.pi, 2.0 * np.pi) - np.pi
        phase = np.where(np.arange(len(unsigned))[:, None] == reference, 0.0, np.copysign(unsigned, difference))
        return phase, np.zeros_like(phase)


def _clock_sigma(streams: LineStreams, curvature: float, noise_variance: float) -> float:
    """Return the standard deviation of the clock offset [ppm] from the curvature of the coherent power."""
    if not curvature > 0.0:
        return np.nan
    response = streams.response()
    gain = float(np.mean(np.abs(response)))
    covered = gain * streams.n_block
    n = hilbert.window_statistics(streams).equivalent_samples
    return float(np.sqrt(noise_variance * covered**2 / (2.0 * curvature * n)))


def _as_samples(samples: npt.ArrayLike) -> Samples:
    x = np.ascontiguousarray(samples)
    if x.ndim != 2 or x.shape[1] != 2 or x.dtype not in (np.int16, np.float32):
        raise InvalidInputError(
            f"`samples` must be int16 or float32 of shape (sample, 2), got {x.dtype} of shape {x.shape}"
        )
    if len(x) < 64:
        raise InvalidInputError(f"`samples` must hold at least 64 samples, got {len(x)}")
    return x
