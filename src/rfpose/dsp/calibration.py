"""Electronic phases of the transmitters, from receivers at surveyed places (Swart et al. §3.6)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.dsp.tones import TonePhases
from rfpose.errors import InvalidInputError

if TYPE_CHECKING:
    from rfpose.scenario import Scenario

__all__ = [
    "CalibrationStatus",
    "CalibrationWindow",
    "PhaseAverage",
    "PhaseCalibration",
    "average_phases",
    "calibrate",
    "frame_times",
    "phase_average",
    "wrap",
]


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
class PhaseCalibration:
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


def average_phases(
    phase_rad: npt.ArrayLike,
    sigma_rad: npt.ArrayLike,
    *,
    calibration_enu_m: npt.ArrayLike,
    transmitter_enu_m: npt.ArrayLike,
    wavelength_m: npt.ArrayLike,
    survey_sigma_m: npt.ArrayLike = 0.0,
) -> PhaseAverage:
    """Return electronic phases Φ_i = φ_i + 2π d_i / λ from the tone phases of calibration receivers (§3.6).

    Several receivers are put on one clock and averaged with their weights.

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
        weight = np.where(np.isfinite(phi) & np.isfinite(variance), 1.0 / variance, 0.0)
    return PhaseAverage(
        phi_rad=np.where(weight > 0.0, phi, 0.0),
        weight=np.where(_joined(weight), weight, 0.0),
        survey_rad=survey[:, None] * wavenumber,
        time_s=None,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseAverage:
    """What each calibration receiver alone takes the electronic phases to be, and how they become one.

    Φ and one clock a receiver are found by least squares, frame by frame and tone by tone; a frame's Φ are known up to
    one constant a tone. Averages are of phases, not of phasors: they change in proportion to what they are made of.

    Attributes
    ----------
    phi_rad : (frame, calibration receiver, transmitter, tone)
        Phase and range [rad], on the receiver's own clock.
    weight : (frame, calibration receiver, transmitter, tone)
        1/σ²; 0 = not seen, or by a receiver that shares no transmitter with the rest.
    survey_rad : (calibration receiver, tone)
        Share of σ that its place is uncertain by [rad].
    time_s : (frame,)
        For frames in which a transmitter was not measured [s]; None: frames follow each other evenly.
    """

    phi_rad: FloatArray
    weight: FloatArray
    survey_rad: FloatArray
    time_s: FloatArray | None

    @property
    def sigma_rad(self) -> FloatArray:
        """(frame, transmitter, tone) standard deviation of the phases; NaN where not measured."""
        total = self.weight.sum(axis=1)
        with np.errstate(divide="ignore"):
            return np.where(total > 0.0, 1.0 / np.sqrt(total), np.nan)

    @property
    def noise_rad(self) -> FloatArray:
        """(frame, transmitter, tone) what of `sigma_rad` is left where all receivers are as surveyed."""
        total, square = self.weight.sum(axis=1), self.survey_rad[:, None] ** 2
        # Σ (w/Σw)² (1/w − survey²)
        noise = (self.weight * np.maximum(1.0 - self.weight * square, 0.0)).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(total > 0.0, np.sqrt(noise) / total, np.nan)

    @property
    def phase_rad(self) -> FloatArray:
        """(frame, transmitter, tone) electronic phases; NaN where not measured."""
        return np.where(self.weight.sum(axis=1) > 0.0, wrap(_mean_phase(self.phi_rad, self.weight)), np.nan)

    def change_rad(self, shift_rad: FloatArray, frames: npt.NDArray[np.int64]) -> FloatArray:
        """Change of the electronic phases where each receiver's are changed first.

        Parameters
        ----------
        shift_rad : (calibration receiver, transmitter, tone, 1 + parameter)
            What is added to each receiver's phases, of whatever size, and its derivatives by parameters [rad].
        frames : (row,)
            Frames that are asked for.

        Returns
        -------
        (row, transmitter, tone, 1 + parameter)
            [rad], up to one constant a row and tone; 0 where nothing was ever measured.
        """
        measured = np.all(self.weight.sum(axis=1) > 0.0, axis=2)
        time_s = np.arange(float(len(measured))) if self.time_s is None else self.time_s
        before, after, share = _sources(measured, time_s)
        needed = np.unique(np.concatenate([frames, before[frames].ravel(), after[frames].ravel()]))
        phi, weight = self.phi_rad[needed], self.weight[needed]
        seen = weight.sum(axis=1) > 0.0
        change = np.array(_least_squares(np.broadcast_to(shift_rad, (*phi.shape, shift_rad.shape[-1])), weight)[0])
        step = _mean_phase(phi + shift_rad[..., 0], weight) - _mean_phase(phi, weight)
        # on one branch: relative to what all transmitters have in common
        common = np.angle(np.sum(np.where(seen, np.exp(1j * step), 0.0), axis=1, keepdims=True))
        change[..., 0] = np.where(seen, common + wrap(step - common), 0.0)
        row = np.searchsorted(needed, frames)
        out = change[row]
        for k, i in np.argwhere(~measured[frames]):
            f = frames[k]
            both = [np.searchsorted(needed, g[f, i]) for g in (before, after)]
            parts = [change[g, i] + _datum(change[row[k]] - change[g], measured[[f, needed[g]]]) for g in both]
            out[k, i] = (1.0 - share[f, i]) * parts[0] + share[f, i] * parts[1]
        return out


def _datum(difference: FloatArray, measured: npt.NDArray[np.bool_]) -> FloatArray:
    """(tone, …) mean of a difference between two frames (transmitter, …) over transmitters measured in both."""
    both = measured.all(axis=0)
    return np.asarray(difference[both].mean(axis=0) if both.any() else np.zeros(difference.shape[1:]))


def _joined(weight: FloatArray) -> npt.NDArray[np.bool_]:
    """Which receivers' clocks can be compared, (frame, receiver, 1, tone): of groups that share no transmitter, one."""
    sees = np.moveaxis(weight > 0.0, 3, 1)
    reach = (sees.astype(np.float64) @ np.swapaxes(sees, 2, 3).astype(np.float64)) > 0.0
    for _ in range(max(1, int(np.ceil(np.log2(max(2, weight.shape[1])))))):
        reach = (reach.astype(np.float64) @ reach.astype(np.float64)) > 0.0
    own = np.moveaxis(weight.sum(axis=2), 2, 1)
    group = np.argmax((reach * own[:, :, None]).sum(axis=3), axis=2)
    chosen = np.take_along_axis(reach, group[..., None, None], axis=2)[:, :, 0]
    return np.moveaxis(chosen, 1, 2)[:, :, None]


def _mean_phase(phi: FloatArray, weight: FloatArray) -> FloatArray:
    """(frame, transmitter, tone) least-squares phases, one clock a receiver taken off, not wrapped."""
    phasor = np.where(weight > 0.0, np.exp(1j * phi), 0.0)
    # clocks to begin with: how receivers' phases turn against each other over all transmitters at once
    root = np.moveaxis(np.sqrt(weight) * phasor, 3, 1)
    clock = np.angle(np.linalg.eigh(root @ np.swapaxes(root.conj(), 2, 3))[1][..., -1])
    clock = np.moveaxis(clock, 1, 2)[:, :, None]
    mean = np.angle(np.sum(weight * phasor * np.exp(-1j * clock), axis=1))
    for _ in range(2):
        # a mean of phasors is not the phasor of a mean: what is left of each is averaged as it is
        left = wrap(phi - clock - mean[:, None])
        step, clock_step = _least_squares(left[..., None], weight)
        mean = mean + step[..., 0]
        clock = clock + clock_step[..., 0][:, :, None]
    # the constant that leaves the receivers' clocks zero on average
    of_receiver = weight.sum(axis=2)[:, :, None]
    total = np.maximum(of_receiver.sum(axis=1, keepdims=True), 1e-300)
    return np.asarray(mean + (of_receiver * wrap(clock) / total).sum(axis=1))


def _least_squares(value: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means (frame, transmitter, tone, k) and clocks (frame, receiver, tone, k) of values (…, receiver, …, tone, k).

    Clocks average to zero.
    """
    w = np.moveaxis(weight, 3, 1)
    share = w / np.maximum(w.sum(axis=2, keepdims=True), 1e-300)
    v = np.moveaxis(value, 3, 1)
    mean = np.einsum("fqci,fqcik->fqik", share, v)
    own = w.sum(axis=3)
    matrix = (
        -w @ np.swapaxes(share, 2, 3)
        + own[..., None] * own[..., None, :] / np.maximum(own.sum(axis=2), 1e-300)[..., None, None]
    )
    diagonal = np.arange(w.shape[2])
    matrix[..., diagonal, diagonal] += np.where(own > 0.0, own, 1.0)
    clock = np.linalg.solve(matrix, np.einsum("fqci,fqcik->fqck", w, v - mean[:, :, None]))
    mean = mean - np.einsum("fqci,fqck->fqik", share, clock)
    return np.moveaxis(mean, 1, 2), np.moveaxis(clock, 1, 2)


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
                common += float(np.average(wrap(step - common), weights=weight))
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


def _sources(
    measured: npt.NDArray[np.bool_], time_s: FloatArray
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray]:
    """Frames before and after from which a transmitter's phase comes, and the share of the one after.

    All (frame, transmitter). Both are the frame itself where it was measured or where it never was, and the nearest
    one where it was measured on one side only.
    """
    n_frame = len(measured)
    index = np.arange(n_frame)[:, None]
    before = np.maximum.accumulate(np.where(measured, index, -1), axis=0)
    after = np.minimum.accumulate(np.where(measured, index, n_frame)[::-1], axis=0)[::-1]
    never = (before < 0) & (after >= n_frame)
    one_sided = np.where(before < 0, after, before)
    before = np.where(never, index, one_sided)
    after = np.where(never, index, np.where(after >= n_frame, one_sided, after))
    gap = time_s[after] - time_s[before]
    share = np.where(after > before, (time_s[:, None] - time_s[before]) / np.where(after > before, gap, 1.0), 0.0)
    return before, after, np.asarray(share)


def interpolate_phase(
    phase_rad: npt.ArrayLike, sigma_rad: npt.ArrayLike, time_s: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.uint8]]:
    """Fill frames in which a transmitter's electronic phase was not measured.

    Between measured frames linearly, outside by the nearest; the uncertainty grows as the bridge of a random walk
    whose rate is read off the measured frames.

    Parameters
    ----------
    phase_rad, sigma_rad : (frame, transmitter, tone)
        Of `average_phases`; NaN = not measured.
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
    before, after, shares = _sources(measured, time)
    # a frame with no measured transmitter at all still has no clock to be aligned to; any datum will do
    for f, i in np.argwhere(~measured):
        a, b, share = before[f, i], after[f, i], shares[f, i]
        if a != b:
            out[f, i] = wrap((1 - share) * aligned[a, i] + share * aligned[b, i])
            bridge = rate**2 * (time[f] - time[a]) * (time[b] - time[f]) / (time[b] - time[a])
            out_sigma[f, i] = np.sqrt(((1 - share) * sigma[a, i]) ** 2 + (share * sigma[b, i]) ** 2 + bridge)
            status[f, i] = CalibrationStatus.INTERPOLATED
        elif a != f and np.all(np.isfinite(rate)):
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


def phase_average(
    phase_rad: FloatArray, sigma_rad: FloatArray, scenario: Scenario, time_s: FloatArray | None = None
) -> PhaseAverage:
    """Electronic phases as a scenario's calibration receivers see them.

    Parameters
    ----------
    phase_rad, sigma_rad : (frame, receiver, transmitter, tone)
        Of all receivers along the scenario's receiver axis [rad]; NaN = not received.
    scenario
        Places of the calibration receivers and transmitters.
    time_s : (frame,), optional
        As in `PhaseAverage`.

    Raises
    ------
    InvalidInputError
        The scenario has no calibration receiver.
    """
    rows = [i for i, receiver in enumerate(scenario.receivers) if receiver.calibration is not None]
    if not rows:
        raise InvalidInputError("`scenario` must name at least one calibration receiver")
    average = average_phases(
        phase_rad[:, rows],
        sigma_rad[:, rows],
        calibration_enu_m=scenario.calibration_enu_m,
        transmitter_enu_m=scenario.transmitter_enu_m,
        wavelength_m=scenario.wavelength_m,
        survey_sigma_m=[r.survey_sigma_m for r in scenario.calibration_receiver],
    )
    return replace(average, time_s=time_s)


def frame_times(tones: TonePhases, scenario: Scenario) -> FloatArray:
    """(frame,) time since the first frame [s]."""
    rate_hz = as_positive("sample_rate_hz", scenario.radio.sample_rate_hz)
    index = tones.frame_start_index
    return np.asarray((index - (index[0] if len(index) else 0)) / rate_hz)


def calibrate(tones: TonePhases, scenario: Scenario) -> PhaseCalibration:
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
    average = phase_average(tones.phase_rad, tones.sigma_rad, scenario)
    phase, sigma, drift, status = interpolate_phase(average.phase_rad, average.sigma_rad, frame_times(tones, scenario))
    return PhaseCalibration(phase_rad=phase, sigma_rad=sigma, drift_rad_per_sqrt_s=drift, status=status)


class CalibrationWindow:
    """Electronic phases frame by frame, of a recording whose later frames are not there yet.

    Where all transmitters are measured in every frame they are those of `calibrate`. A transmitter that is missing is
    held from the last of so many frames, where `calibrate` would interpolate; how much it drifts is read off these.

    Parameters
    ----------
    scenario
        Places of the calibration receivers and transmitters; at least one calibration receiver.
    n_frame
        Frames that are remembered.
    """

    def __init__(self, scenario: Scenario, n_frame: int = 32) -> None:
        self._scenario = scenario
        self._kept: deque[tuple[int, FloatArray, FloatArray]] = deque(maxlen=n_frame)

    def add(self, tones: TonePhases) -> PhaseCalibration:
        """Return the electronic phases of one more frame.

        Parameters
        ----------
        tones
            Of this frame alone, along the scenario's receiver axis.
        """
        average = phase_average(tones.phase_rad, tones.sigma_rad, self._scenario)
        self._kept.append((int(tones.frame_start_index[0]), average.phase_rad, average.sigma_rad))
        starts, phases, sigmas = zip(*self._kept, strict=True)
        time_s = np.array([start - starts[0] for start in starts]) / self._scenario.radio.sample_rate_hz
        phase, sigma, drift, status = interpolate_phase(np.concatenate(phases), np.concatenate(sigmas), time_s)
        return PhaseCalibration(
            phase_rad=phase[-1:], sigma_rad=sigma[-1:], drift_rad_per_sqrt_s=drift, status=status[-1:]
        )
