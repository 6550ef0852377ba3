"""Phase noise of a result: what the truth's signal-to-noise ratios make of it, else what the result reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.measurement import phase_sigma_rad
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.mirrors import carrier_sigma_rad
from rfpose.truth import Truth

__all__ = ["PhaseNoise", "phase_noise"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseNoise:
    """Standard deviations [rad]; NaN = not received.

    Attributes
    ----------
    tone_rad : (frame, receiver, transmitter, tone)
    carrier_rad : (frame, receiver, transmitter)
    calibration_rad : (frame, transmitter, tone)
        Of the electronic phases, common to a frame's receivers.
    own_m, calibration_m : (frame, receiver, transmitter)
        One transmitter's range, all tones together: receiver's noise, and calibration's [m].
    source
        ``"truth"`` or ``"result"``.
    """

    tone_rad: FloatArray
    carrier_rad: FloatArray
    calibration_rad: FloatArray
    own_m: FloatArray
    calibration_m: FloatArray
    source: str


def phase_noise(result: Result, truth: Truth, rows: npt.NDArray[np.int64], *, reported: bool = False) -> PhaseNoise:
    """Return the noise of every phase of a result.

    Parameters
    ----------
    result
    truth
        Its ``tone_snr`` counts, where it has one.
    rows : (frame,)
        The truth's row of each frame, −1 none.
    reported
        What the result reports, whatever the truth knows.
    """
    tones = result.tones
    if truth.tone_snr is None or reported:
        return PhaseNoise(
            tone_rad=tones.sigma_rad,
            carrier_rad=carrier_sigma_rad(tones),
            calibration_rad=result.calibration.sigma_rad,
            own_m=result.ranges.sigma_m,
            calibration_m=result.ranges.calibration_sigma_m,
            source="result",
        )
    scenario = result.scenario
    snr = np.array(truth.tone_snr[np.maximum(rows, 0)])
    snr[rows < 0] = np.nan
    tone, carrier = phase_sigma_rad(scenario, snr)
    to_m = scenario.wavelength_m / (2.0 * np.pi)
    is_calibration = np.array([r.calibration is not None for r in scenario.receivers], bool)
    own_m = _combine(tone * to_m)
    calibration_m = _combine(np.moveaxis(own_m[:, is_calibration], 1, -1))
    seen = np.isfinite(tones.phase_rad)
    return PhaseNoise(
        tone_rad=np.where(seen, tone, np.nan),
        carrier_rad=np.where(seen[..., 0], carrier, np.nan),
        calibration_rad=_combine(np.moveaxis(np.where(seen, tone, np.nan)[:, is_calibration], 1, -1)),
        own_m=own_m,
        calibration_m=np.broadcast_to(calibration_m[:, None], own_m.shape),
        source="truth",
    )


def _combine(sigma: FloatArray) -> FloatArray:
    """Return the standard deviation of the weighted mean over the last axis; NaN entries do not take part."""
    information = np.nansum(sigma**-2.0, axis=-1)
    with np.errstate(divide="ignore"):
        return np.where(information > 0.0, information**-0.5, np.nan)
