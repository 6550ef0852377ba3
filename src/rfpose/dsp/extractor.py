"""From the samples of one frame to tone phases, by the estimator of one's choice."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import _kernels, hilbert
from rfpose.dsp.bank import ClockRange, Inspection, LineBank, LineStreams, inspect
from rfpose.dsp.clock import SEARCH_SAMPLES, ClockSearch, coarse_clock_ppm, search_bank
from rfpose.dsp.correlator import JointFit
from rfpose.dsp.plan import LinePlan
from rfpose.dsp.tones import FrameTones, LineStatus
from rfpose.errors import InvalidInputError

__all__ = ["ESTIMATORS", "ToneExtractor"]

ComplexArray = npt.NDArray[np.complex128]
Samples = npt.NDArray[np.int16] | npt.NDArray[np.float32]

ESTIMATORS = ("hilbert", "correlator", "dot", "dot-compensated")

_MAX_CLIPPED_FRACTION = 1e-4
_CLOCK_DRIFT_PPM = 0.5
"""How far a clock may wander from where it was acquired before it is acquired anew."""
_CLOCK_CLASS_PPM = 2.5
"""Receivers whose clocks are off by as much, in such steps, share a line bank."""
_LINEAR_STEP_SIGMA = 3.0
"""A step of the clock within so many sigma bends the lines less than the noise does: it needs no second fit."""
_CARRIER_POWER_SNR = 25.0
"""A carrier counts as present above this power ratio to the noise: false alarm exp(−25) a line."""
_OK, _ABSENT, _WEAK = int(LineStatus.OK), int(LineStatus.ABSENT), int(LineStatus.WEAK)
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
        self._bank = lru_cache(maxsize=16)(self._make_bank)
        self._search_bank = lru_cache(maxsize=4)(self._make_search_bank)
        self._wide_bank = lru_cache(maxsize=4)(lambda n_sample: search_bank(plan, n_sample))
        self._fit = lru_cache(maxsize=16)(JointFit)
        self._drift_ppm = min(_CLOCK_DRIFT_PPM, plan.clock_search_ppm)
        self._refine = lru_cache(maxsize=16)(lambda bank: ClockSearch(bank, self._drift_ppm))

    def _bank_at(self, n_sample: int, clock_ppm: float) -> LineBank:
        """Return the bank for frames of a receiver whose clock is followed."""
        return self._bank(n_sample, _CLOCK_CLASS_PPM * math.ceil((abs(clock_ppm) + self._drift_ppm) / _CLOCK_CLASS_PPM))

    def _make_bank(self, n_sample: int, largest_ppm: float) -> LineBank:
        return LineBank(
            self.plan,
            n_sample,
            windowed=self.estimator != "correlator",
            clock=ClockRange(largest_ppm, self._drift_ppm),
            full_scale=self.full_scale,
        )

    def _make_search_bank(self, n_sample: int) -> LineBank:
        return LineBank(self.plan, n_sample, windowed=self.estimator != "correlator")

    def acquire_clock(self, samples: npt.ArrayLike) -> float:
        """Return the receiver's clock offset [ppm], searched over the plan's whole range; NaN for bad samples.

        Parameters
        ----------
        samples : (sample, 2)
            One frame.
        """
        x = _as_samples(samples)
        if _fault(inspect(x, self.full_scale), len(x)) is not LineStatus.OK:
            return np.nan
        coarse = coarse_clock_ppm(x, self.plan, self._wide_bank(len(x)))
        bin_ppm = 1.0 / (min(len(x), SEARCH_SAMPLES) * float(np.max(np.abs(self.plan.cycles_per_ppm()))))
        bank = self._search_bank(len(x))
        return ClockSearch(bank, min(bin_ppm, self.plan.clock_search_ppm))(bank.streams(x, coarse))[0]

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
        start_ppm = self.acquire_clock(x) if clock_ppm is None or not np.isfinite(clock_ppm) else float(clock_ppm)
        # a frame whose samples are bad has no clock; its samples are looked at all the same
        assumed_ppm = start_ppm if np.isfinite(start_ppm) else 0.0
        bank = self._bank_at(len(x), assumed_ppm)
        streams = bank.streams(x, self._fit(bank).node_ppm(assumed_ppm))
        fault, clipped = _fault(streams.inspection, len(x)), streams.inspection.clipped / len(x)
        if fault is not LineStatus.OK:
            return FrameTones.failed(self.plan.n_transmitter, self.plan.n_tone, fault, clipped_fraction=clipped)
        ppm, curvature, coherence = self._refine(bank)(streams)
        if clock_ppm is not None and coherence < 0.5:
            # the lines do not add up: either all is noise, or the clock has jumped
            again = self.acquire_clock(x)
            if abs(again - ppm) > self._drift_ppm:
                bank = self._bank_at(len(x), again)
                streams = bank.streams(x, self._fit(bank).node_ppm(again))
                ppm, curvature, _ = self._refine(bank)(streams)
        if self.estimator != "correlator":
            return self._from_filters(streams, ppm, curvature, clipped)
        fit = self._fit(bank)(streams, ppm)
        # the power's maximum is shifted a little by leakage between lines; their joint fit is not
        ppm += fit.clock_step_ppm
        if abs(fit.clock_step_ppm) > _LINEAR_STEP_SIGMA * fit.clock_step_sigma_ppm:
            fit = self._fit(bank)(streams, ppm)
            ppm += fit.clock_step_ppm
        tone = hilbert.analytic_tones(fit.amplitude[:, None], self.plan.n_transmitter, self.plan.n_tone)[..., 0]
        lines = _Lines(
            amplitude=fit.amplitude,
            variance=fit.variance,
            tone=tone,
            phase=np.angle(tone),
            added_variance=np.zeros(tone.shape),
            n_effective=float(len(x)),
        )
        return self._tones(lines, (ppm, fit.clock_step_sigma_ppm), clipped)

    def _from_filters(self, streams: LineStreams, ppm: float, curvature: float, clipped: float) -> FrameTones:
        """Measure by averaging the filtered, analytic tones."""
        n_transmitter, n_tone = self.plan.n_transmitter, self.plan.n_tone
        filtered = hilbert.average_lines(streams, self.plan.line_cycles(ppm))
        tone = hilbert.analytic_tones(filtered.amplitude[:, None], n_transmitter, n_tone)[..., 0]
        phase, added = self._averaged_phase(
            filtered, hilbert.analytic_tones(filtered.line, n_transmitter, n_tone), tone
        )
        lines = _Lines(
            amplitude=filtered.amplitude,
            variance=filtered.variance,
            tone=tone,
            phase=phase,
            added_variance=added,
            n_effective=filtered.statistics.equivalent_samples,
        )
        return self._tones(lines, (ppm, _clock_sigma(filtered, curvature)), clipped)

    def _tones(self, lines: _Lines, clock: tuple[float, float], clipped: float) -> FrameTones:
        """Put the record together, and mark what is too weak."""
        n_transmitter, shape = self.plan.n_transmitter, lines.tone.shape
        by_transmitter = lines.amplitude.reshape(n_transmitter, -1)
        sigma, line_sigma = np.empty(shape), np.empty(by_transmitter.shape)
        status = np.full(n_transmitter, _OK, np.uint8)
        typical = _kernels.tone_quality(
            by_transmitter,
            lines.variance.reshape(n_transmitter, -1),
            lines.tone,
            lines.added_variance,
            _CARRIER_POWER_SNR,
            _TONE_POWER_SNR,
            _ABSENT,
            _WEAK,
            lines.phase,
            sigma,
            line_sigma,
            status,
        )
        return FrameTones(
            phase_rad=lines.phase,
            sigma_rad=sigma,
            carrier=by_transmitter[:, 0],
            carrier_sigma=line_sigma[:, 0],
            sideband=by_transmitter[:, 1:].reshape(*shape, 2),
            sideband_sigma=line_sigma[:, 1:].reshape(*shape, 2),
            clock_ppm=clock[0],
            clock_sigma_ppm=clock[1],
            noise_variance=typical * lines.n_effective,
            clipped_fraction=clipped,
            status=status,
        )

    def _averaged_phase(
        self, filtered: hilbert.FilteredLines, tones: ComplexArray, mean_tone: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Phase by the chosen average of the analytic tones, and the variance it adds to the noise's own."""
        signed = hilbert.unit_phasor_phase(tones)
        variance, statistics = filtered.variance.reshape(self.plan.n_transmitter, -1), filtered.statistics
        per_output = (variance[:, 1::2] + variance[:, 2::2]) * (statistics.equivalent_samples * statistics.gain)
        if self.estimator == "hilbert":
            power = mean_tone.real**2 + mean_tone.imag**2
            return signed, hilbert.unit_phasor_variance(per_output / power, statistics, tones.shape[2])
        reference = int(np.argmax(np.abs(mean_tone[:, 0])))
        ref_tone = tones[reference][None]
        if self.estimator == "dot":
            unsigned = hilbert.dot_phase(tones, ref_tone)
        else:
            unsigned = hilbert.compensated_dot_phase(tones, ref_tone, per_output, per_output[reference][None])
        difference = np.mod(signed - signed[reference] + np.pi, 2.0 * np.pi) - np.pi
        phase = np.where(np.arange(len(unsigned))[:, None] == reference, 0.0, np.copysign(unsigned, difference))
        return phase, np.zeros_like(phase)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lines:
    """What an estimator found in a frame: lines, their analytic tones, and samples that average noise as well."""

    amplitude: ComplexArray
    variance: FloatArray
    tone: ComplexArray
    phase: FloatArray
    added_variance: FloatArray
    n_effective: float


def _fault(inspection: Inspection, n_sample: int) -> LineStatus:
    """Return what is wrong with a frame's samples."""
    if inspection.not_finite:
        return LineStatus.NOT_FINITE
    if inspection.zero == n_sample:
        return LineStatus.NO_SIGNAL
    if inspection.zero or inspection.fill:
        return LineStatus.MISSING_SAMPLES
    if inspection.clipped > _MAX_CLIPPED_FRACTION * n_sample:
        return LineStatus.CLIPPED
    return LineStatus.OK


def _clock_sigma(filtered: hilbert.FilteredLines, curvature: float) -> float:
    """Return the standard deviation of the clock offset [ppm] from the curvature of the coherent power."""
    if not curvature > 0.0:
        return np.nan
    gain = float(np.abs(filtered.response).mean())
    covered = gain * filtered.line.shape[1]
    return math.sqrt(float(np.median(filtered.variance)) * covered**2 / (2.0 * curvature))


def _as_samples(samples: npt.ArrayLike) -> Samples:
    x = np.ascontiguousarray(samples)
    if x.ndim != 2 or x.shape[1] != 2 or x.dtype not in (np.int16, np.float32):
        raise InvalidInputError(
            f"`samples` must be int16 or float32 of shape (sample, 2), got {x.dtype} of shape {x.shape}"
        )
    if len(x) < 64:
        raise InvalidInputError(f"`samples` must hold at least 64 samples, got {len(x)}")
    return x
