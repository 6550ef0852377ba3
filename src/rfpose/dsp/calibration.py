"""Electronic phases of the transmitters, from receivers at surveyed places (Swart et al. §3.6)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.dsp.tones import TonePhases
from rfpose.errors import InvalidInputError

if TYPE_CHECKING:
    from rfpose.scenario import Scenario

__all__ = ["Calibration", "CalibrationStatus", "calibrate", "electronic_phase", "wrap"]


class CalibrationStatus(IntEnum):
    """Where a transmitter's electronic phase in a frame comes from."""

    OK = 0
    INTERPOLATED = 1
    EXTRAPOLATED = 2
    MISSING = 3

    @property
    def reason(self) -> str:
        """The status in words."""
        return (
            "measured in this frame",
            "interpolated between frames",
            "held from the nearest frame",
            "seen by no calibration receiver",
        )[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Electronic phase Φ of every transmitter, up to one constant a frame and tone.

    Attributes
    ----------
    phase_rad : (frame, transmitter, tone)
        In (−π, π] [rad]; NaN where status is MISSING.
    sigma_rad : (frame, transmitter, tone)
        Its standard deviation [rad]. One error for all receivers of the frame.
    drift_rad_per_sqrt_s : (tone,)
        Random-walk rate of Φ seen between frames; NaN with fewer than two frames.
    status : (frame, transmitter)
        `CalibrationStatus`.
    """

    phase_rad: FloatArray
    sigma_rad: FloatArray
    drift_rad_per_sqrt_s: FloatArray
    status: npt.NDArray[np.uint8]


def wrap(phase_rad: FloatArray) -> FloatArray:
    """Wrap to (−π, π]."""
    return np.asarray(np.pi - np.mod(np.pi - phase_rad, 2.0 * np.pi))


def electronic_phase(
    phase_rad: npt.ArrayLike,
    sigma_rad: npt.ArrayLike,
    *,
    calibration_enu_m: npt.ArrayLike,
    transmitter_enu_m: npt.ArrayLike,
    wavelength_m: npt.ArrayLike,
    survey_sigma_m: npt.ArrayLike = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Electronic phase Φ_i = φ_i + 2π d_i / λ from the tone phases of calibration receivers (§3.6).

    Several receivers are put on the first one's clock and averaged with their weights.

    Parameters
    ----------
    phase_rad, sigma_rad : (frame, calibration receiver, transmitter, tone)
        Tone phases and their standard deviations [rad]; NaN = not received.
    calibration_enu_m : (calibration receiver, xyz)
        Surveyed positions [m].
    transmitter_enu_m : (transmitter, xyz)
        [m].
    wavelength_m : (tone,)
        [m].
    survey_sigma_m : (calibration receiver,) or scalar
        Uncertainty of each receiver's survey [m].

    Returns
    -------
    phase_rad, sigma_rad : (frame, transmitter, tone)
        Wrapped to (−π, π]; NaN where no receiver saw the transmitter.

    Raises
    ------
    InvalidInputError
        Shapes that do not fit together.
    """
    phase = as_float_array("phase_rad", phase_rad, ("frame", "calibration", "transmitter", "tone"), finite=False)
    n_cal, n_transmitter, n_tone = phase.shape[1:]
    sigma = as_float_array("sigma_rad", sigma_rad, phase.shape, finite=False, positive=False)
    place = as_float_array("calibration_enu_m", calibration_enu_m, (n_cal, 3))
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, (n_transmitter, 3))
    wavelength = as_float_array("wavelength_m", wavelength_m, (n_tone,), positive=True)
    if n_cal == 0:
        raise InvalidInputError("`phase_rad` must hold at least one calibration receiver")
    survey = np.broadcast_to(np.asarray(survey_sigma_m, np.float64), (n_cal,))
    wavenumber = 2.0 * np.pi / wavelength
    range_m = np.linalg.norm(place[:, None] - transmitter[None], axis=-1)
    phi = phase + range_m[None, :, :, None] * wavenumber
    variance = sigma**2 + (survey[:, None, None] * wavenumber) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(np.isfinite(phi), 1.0 / variance, 0.0)
    phasor = np.where(np.isfinite(phi), np.exp(1j * np.nan_to_num(phi)), 0.0)
    # one common phase a frame, tone and receiver is that receiver's clock: bring all onto the first that saw anything
    total = np.zeros(phasor[:, 0].shape, np.complex128)
    total_weight = np.zeros(total.shape)
    for i in range(n_cal):
        seen_before = np.sum(np.abs(total), axis=1, keepdims=True) > 0
        turn = np.sum(weight[:, i] * phasor[:, i].conj() * total, axis=1, keepdims=True)
        size = np.abs(turn)
        turn = np.where(seen_before & (size > 0), turn / np.where(size > 0, size, 1.0), 1.0)
        joins = ~seen_before | (size > 0)
        total = total + np.where(joins, weight[:, i] * phasor[:, i] * turn, 0.0)
        total_weight = total_weight + np.where(joins, weight[:, i], 0.0)
    seen = total_weight > 0
    with np.errstate(divide="ignore"):
        sigma_out = np.where(seen, 1.0 / np.sqrt(total_weight), np.nan)
    return np.where(seen, wrap(np.angle(total)), np.nan), sigma_out


def _align(phase: FloatArray, sigma: FloatArray) -> FloatArray:
    """Turn every frame by one common phase a tone onto the last frame before it, and unwrap along time."""
    aligned = phase.copy()
    n_frame, n_transmitter, n_tone = phase.shape
    for q in range(n_tone):
        last = np.full(n_transmitter, np.nan)
        for f in range(n_frame):
            row = aligned[f, :, q]
            both = np.isfinite(row) & np.isfinite(last)
            if both.any():
                weight = 1.0 / sigma[f, both, q] ** 2
                step = wrap(row[both] - last[both])
                common = float(np.angle(np.sum(weight * np.exp(1j * step))))
                row -= common
                row[both] = last[both] + wrap(row[both] - last[both])
            last = np.where(np.isfinite(row), row, last)
    return aligned


def _drift_rate(aligned: FloatArray, sigma: FloatArray, time_s: FloatArray) -> FloatArray:
    """(tone,) random-walk rate of the electronic phases beyond their measurement noise [rad/√s]."""
    step = np.diff(aligned, axis=0)
    noise = sigma[1:] ** 2 + sigma[:-1] ** 2
    rate = np.full(aligned.shape[2], np.nan)
    for q in range(len(rate)):
        used = np.isfinite(step[:, :, q])
        if used.sum() >= 3:
            dt = np.broadcast_to(np.diff(time_s)[:, None], used.shape)[used]
            excess = np.mean(step[:, :, q][used] ** 2 - noise[:, :, q][used])
            rate[q] = np.sqrt(max(0.0, float(excess)) / float(np.mean(dt)))
    return rate


def interpolate_phase(
    phase_rad: npt.ArrayLike, sigma_rad: npt.ArrayLike, time_s: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.uint8]]:
    """Fill frames in which a transmitter's electronic phase was not measured.

    Between measured frames linearly, outside by the nearest; the uncertainty grows as the bridge of a random walk
    whose rate is read off the measured frames.

    Parameters
    ----------
    phase_rad, sigma_rad : (frame, transmitter, tone)
        From `electronic_phase`; NaN = not measured.
    time_s : (frame,)
        Increasing [s].

    Returns
    -------
    phase_rad, sigma_rad : (frame, transmitter, tone)
    drift_rad_per_sqrt_s : (tone,)
    status : (frame, transmitter)
    """
    phase = as_float_array("phase_rad", phase_rad, ("frame", "transmitter", "tone"), finite=False)
    sigma = as_float_array("sigma_rad", sigma_rad, phase.shape, finite=False)
    time = as_float_array("time_s", time_s, (len(phase),))
    measured = np.all(np.isfinite(phase), axis=2)
    status = np.where(measured, CalibrationStatus.OK, CalibrationStatus.MISSING).astype(np.uint8)
    aligned = _align(phase, sigma)
    rate = _drift_rate(aligned, sigma, time)
    out, out_sigma = phase.copy(), sigma.copy()
    for f, i in np.argwhere(~measured):
        known = np.flatnonzero(measured[:, i])
        # a frame with no measured transmitter at all still has no clock to be aligned to; any datum will do
        before, after = known[known < f], known[known > f]
        if before.size and after.size:
            a, b = before[-1], after[0]
            share = (time[f] - time[a]) / (time[b] - time[a])
            out[f, i] = wrap((1 - share) * aligned[a, i] + share * aligned[b, i])
            bridge = rate**2 * (time[f] - time[a]) * (time[b] - time[f]) / (time[b] - time[a])
            out_sigma[f, i] = np.sqrt(((1 - share) * sigma[a, i]) ** 2 + (share * sigma[b, i]) ** 2 + bridge)
            status[f, i] = CalibrationStatus.INTERPOLATED
        elif known.size and np.all(np.isfinite(rate)):
            a = int(before[-1]) if before.size else int(after[0])
            out[f, i] = wrap(aligned[a, i])
            out_sigma[f, i] = np.sqrt(sigma[a, i] ** 2 + rate**2 * abs(time[f] - time[a]))
            status[f, i] = CalibrationStatus.EXTRAPOLATED
        else:
            out[f, i] = out_sigma[f, i] = np.nan
    # a measured transmitter in the same frame must share the filled ones' datum
    for f in range(len(out)):
        if np.any((status[f] == CalibrationStatus.INTERPOLATED) | (status[f] == CalibrationStatus.EXTRAPOLATED)):
            out[f, measured[f]] = wrap(aligned[f, measured[f]])
    return out, out_sigma, rate, status


def calibrate(tones: TonePhases, scenario: Scenario) -> Calibration:
    """Electronic phases in every frame of a recording from its calibration receivers.

    Parameters
    ----------
    tones
        Tone phases of all receivers along the scenario's receiver axis.
    scenario
        Places of the calibration receivers and transmitters.

    Raises
    ------
    InvalidInputError
        The scenario has no calibration receiver.
    """
    rows = [i for i, receiver in enumerate(scenario.receivers) if receiver.calibration is not None]
    if not rows:
        raise InvalidInputError("`scenario` must name at least one calibration receiver")
    phase, sigma = electronic_phase(
        tones.phase_rad[:, rows],
        tones.sigma_rad[:, rows],
        calibration_enu_m=scenario.calibration_enu_m,
        transmitter_enu_m=scenario.transmitter_enu_m,
        wavelength_m=scenario.wavelength_m,
        survey_sigma_m=[r.survey_sigma_m for r in scenario.calibration_receiver],
    )
    rate_hz = as_positive("sample_rate_hz", scenario.radio.sample_rate_hz)
    index = tones.frame_start_index
    time_s = (index - (index[0] if len(index) else 0)) / rate_hz
    phase, sigma, drift, status = interpolate_phase(phase, sigma, time_s)
    return Calibration(phase_rad=phase, sigma_rad=sigma, drift_rad_per_sqrt_s=drift, status=status)
