"""Looking at a recording of any size: spectrum, waterfall, analytic tones, phases; never the whole file in memory."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.dsp import FrameTones, LinePlan, LineStatus, PhaseCalibration, ToneExtractor, TonePhases, calibrate
from rfpose.dsp.bank import LineBank
from rfpose.dsp.calibration import wrap
from rfpose.dsp.hilbert import analytic_tones, centred_streams
from rfpose.errors import RecordingError
from rfpose.recording import Recording, frame_starts, recorded_runs
from rfpose.recording.base import IndexArray, IqArray
from rfpose.scenario import Scenario

__all__ = [
    "FrameLook",
    "LineHealth",
    "PhaseTrack",
    "SharedRecording",
    "Spectrum",
    "Waterfall",
    "line_health",
    "look_at_frame",
    "losses",
    "phase_track",
    "phases_of",
    "prepare",
    "spectrum",
    "viewing_frames",
    "waterfall",
]

ComplexArray = npt.NDArray[np.complex128]
Progress = Callable[[int, int], None]

_SPECTRUM_SAMPLES = 2**19
_FRAME_WITHOUT_SCENARIO = 2**18
_BINS = (4096, 2**16)
_BINS_PER_GAP = 16.0
_FLOOR = 1e-20
_ROW_SEGMENTS = 4
"""Spectra averaged in a row of the waterfall."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spectrum:
    """Power spectrum of a piece of one receiver's recording.

    Attributes
    ----------
    frequency_hz, power_db : (bin,)
        From the centre frequency [Hz]; power of a sinusoid in each bin [dB of full scale, or of one count].
    line_hz, line_db : (transmitter, line)
        Where the scenario has its lines (carrier, then upper and lower sideband of each tone), and the level there;
        empty without a scenario.
    full_scale
        Whether levels are relative to full scale.
    """

    frequency_hz: FloatArray
    power_db: FloatArray
    line_hz: FloatArray
    line_db: FloatArray
    full_scale: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Waterfall:
    """Spectra over frames, as coarse as the picture.

    Attributes
    ----------
    span
        First and last frame shown, counted from zero, with fractions.
    band_hz
        Lowest and highest frequency shown, from the centre [Hz].
    power_db : (row, column)
        Frame by frequency; the largest of the bins that fall into a column. NaN where nothing was recorded.
    """

    span: tuple[float, float]
    band_hz: tuple[float, float]
    power_db: npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLook:
    """One frame of one receiver, demodulated.

    Attributes
    ----------
    tones
        Phases, levels, clock, status.
    analytic : (transmitter, tone, block)
        Analytic tone over the frame, over its mean magnitude: a point on the unit circle where there is no noise.
        Empty where nothing could be measured.
    """

    tones: FrameTones
    analytic: ComplexArray


@dataclass(frozen=True, slots=True, kw_only=True)
class LineHealth:
    """How one transmitter arrives in one frame; NaN where not measured. Levels [dB of full scale or of one count]."""

    transmitter_id: str
    carrier_db: float
    carrier_snr_db: float
    tone_sigma_mrad: tuple[float, ...]
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseTrack:
    """Tone phases of one receiver over frames, with what the calibration receivers say of the transmitters.

    Attributes
    ----------
    time_s : (frame,)
        From the recording's first sample [s].
    phase_rad, sigma_rad : (frame, transmitter, tone)
        In the receiver's own time; only differences mean anything.
    electronic_rad, electronic_sigma_rad : (frame, transmitter, tone)
        Phases of the transmitters themselves; NaN where no calibration receiver tells.
    clock_ppm, clock_sigma_ppm, clipped_fraction : (frame,)
    status : (frame, transmitter)
        `rfpose.dsp.LineStatus`.
    """

    time_s: FloatArray
    phase_rad: FloatArray
    sigma_rad: FloatArray
    electronic_rad: FloatArray
    electronic_sigma_rad: FloatArray
    clock_ppm: FloatArray
    clock_sigma_ppm: FloatArray
    clipped_fraction: FloatArray
    status: npt.NDArray[np.uint8]

    def difference(
        self, transmitter: int, reference: int, tone: int, *, corrected: bool
    ) -> tuple[float, FloatArray, FloatArray]:
        """Return one transmitter's phase less another's over frames.

        Parameters
        ----------
        corrected
            Take the difference of the transmitters' own phases off.

        Returns
        -------
        mean_rad
            Mean direction, in (−π, π]; NaN where nothing was measured.
        offset_rad, sigma_rad : (frame,)
            From the mean, in (−π, π], and its standard deviation [rad].
        """
        pair = np.array([transmitter, reference])
        phase, sigma = self.phase_rad[:, pair, tone], self.sigma_rad[:, pair, tone]
        if corrected:
            phase = phase - self.electronic_rad[:, pair, tone]
            sigma = np.hypot(sigma, self.electronic_sigma_rad[:, pair, tone])
        step = phase[:, 0] - phase[:, 1]
        seen = np.isfinite(step)
        mean = float(np.angle(np.mean(np.exp(1j * step[seen])))) if seen.any() else float("nan")
        return mean, wrap(step - mean), np.hypot(sigma[:, 0], sigma[:, 1])


class SharedRecording(Recording):
    """A recording that several threads may read: not every format's library can be called by two at once.

    Closing it, with the recording inside, waits for a read under way; reading it afterwards raises RecordingError.
    """

    def __init__(self, inner: Recording) -> None:
        super().__init__(
            inner.path,
            format=inner.format,
            receiver_ids=inner.receiver_ids,
            sample_rate=inner.sample_rate,
            centre_frequency_hz=inner.centre_frequency_hz,
            sample_format=inner.sample_format,
            full_scale=inner.full_scale,
            scenario=inner.scenario,
            truth=inner.truth,
            provenance=inner.provenance,
        )
        self.tunings = inner.tunings
        self.doubts = inner.doubts
        self.time_known = inner.time_known
        self._inner = inner
        self._lock = threading.RLock()
        self._closed = False

    def close(self) -> None:
        """Close the recording inside."""
        with self._lock:
            self._closed = True
            self._inner.close()

    def _load_segments(self, receiver_id: str) -> IndexArray:
        with self._lock:
            self._refuse_closed()
            return self._inner._segments_of(receiver_id)  # which also remembers them, for its own reading

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        with self._lock:
            self._refuse_closed()
            self._inner._read_segment(receiver_id, i_segment, skip, out)

    def _refuse_closed(self) -> None:
        if self._closed:
            raise RecordingError(f"{self.path}: was closed; open it again")


def prepare() -> None:
    """Load what the first spectrum needs, so that it does not wait for it."""
    import scipy.signal  # noqa: F401


def viewing_frames(recording: Recording, scenario: Scenario | None) -> tuple[npt.NDArray[np.int64], int]:
    """Return the frames' first samples (frame,) and their length; a recording too short for one is one frame.

    Raises
    ------
    RecordingError
        Nothing was recorded.
    """
    n_sample = scenario.radio.frame_samples if scenario is not None else _FRAME_WITHOUT_SCENARIO
    starts = frame_starts(recording, n_sample)
    if len(starts):
        return starts, n_sample
    runs = recorded_runs(recording)
    if not len(runs):
        raise RecordingError(f"{recording.path}: no samples were recorded; record again")
    return runs[:1, 0].copy(), int(runs[0, 1])


def losses(recording: Recording, receiver_id: str) -> tuple[int, int]:
    """Return how many stretches, and samples, a receiver missed while any other recorded."""
    runs, blocks = recorded_runs(recording), recording.blocks(receiver_id)
    missed = 0
    for start, count in runs:
        first, last = np.searchsorted(blocks[:, 0], [start, start + count])
        inside = blocks[first:last]
        end = np.concatenate([[start], inside.sum(axis=1)])
        begin = np.concatenate([inside[:, 0], [start + count]])
        missed += int(np.count_nonzero(begin > end))
    return missed, int(runs[:, 1].sum() - blocks[:, 1].sum())


def _first_index(recording: Recording) -> int:
    runs = recorded_runs(recording)
    return int(runs[0, 0]) if len(runs) else 0


def spectrum(
    recording: Recording,
    receiver_id: str,
    start_index: int,
    n_sample: int,
    *,
    scenario: Scenario | None = None,
) -> Spectrum | None:
    """Return the spectrum of samples from ``start_index`` on, at most half a million; None where they are missing.

    Raises
    ------
    RecordingError
        The file is damaged.
    """
    count = min(n_sample, _SPECTRUM_SAMPLES)
    begin = recording.frame_at(receiver_id, start_index, count)
    if begin is None:
        return None
    rate_hz = float(recording.sample_rate)
    n_bin = _n_bin(scenario, rate_hz, count)
    frequency_hz, power = _welch(_complex(recording.read(receiver_id, begin, count)), rate_hz, n_bin)
    power_db = _decibels(power, recording)
    line_hz = np.empty((0, 0)) if scenario is None else scenario.line_hz
    near = np.maximum.reduce([np.roll(power_db, k) for k in (-2, -1, 0, 1, 2)])
    return Spectrum(
        frequency_hz=frequency_hz,
        power_db=power_db,
        line_hz=line_hz,
        line_db=np.interp(line_hz, frequency_hz, near),
        full_scale=bool(np.isfinite(recording.full_scale)),
    )


def _n_bin(scenario: Scenario | None, rate_hz: float, count: int) -> int:
    """Bins enough to tell neighbouring lines apart."""
    wanted = float(_BINS[0])
    if scenario is not None:
        wanted = _BINS_PER_GAP * rate_hz / float(np.diff(np.sort(scenario.line_hz.ravel())).min())
    n_bin = 1 << int(np.ceil(np.log2(np.clip(wanted, *_BINS))))
    return min(n_bin, 1 << int(np.log2(count)))


def _complex(iq: npt.NDArray[np.generic]) -> npt.NDArray[np.complex64]:
    values = iq.astype(np.float32)
    return np.asarray(values[:, 0] + 1j * values[:, 1], np.complex64)


def _welch(signal: npt.NDArray[np.complex64], rate_hz: float, n_bin: int) -> tuple[FloatArray, FloatArray]:
    from scipy.signal import welch

    frequency_hz, power = welch(
        signal, rate_hz, "blackmanharris", n_bin, return_onesided=False, detrend=False, scaling="spectrum"
    )
    return np.fft.fftshift(frequency_hz), np.fft.fftshift(power)


def _decibels(power: npt.NDArray[np.floating], recording: Recording) -> FloatArray:
    reference = recording.full_scale**2 if np.isfinite(recording.full_scale) else 1.0
    return np.asarray(10.0 * np.log10(np.maximum(power / reference, _FLOOR)), np.float64)


def waterfall(
    recording: Recording,
    receiver_id: str,
    frame_start_index: npt.NDArray[np.int64],
    frame_samples: int,
    *,
    span: tuple[float, float] | None = None,
    band_hz: tuple[float, float] | None = None,
    n_row: int = 200,
    n_column: int = 800,
    on_progress: Progress | None = None,
) -> Waterfall:
    """Return spectra over frames, each row from a short look at the begin of what it stands for.

    Parameters
    ----------
    frame_start_index : (frame,)
        From `viewing_frames`, with ``frame_samples``.
    span
        Frames, counted from zero, with fractions; all of them by default.
    band_hz
        From the centre frequency [Hz]; all of it by default.
    n_row, n_column
        Size of the picture; what is read is proportional to it and to the resolution, not to the file.
    on_progress
        Called with (rows done, rows).
    """
    rate_hz = float(recording.sample_rate)
    n_frame = len(frame_start_index)
    span = (max(span[0], 0.0), min(span[1], float(n_frame))) if span is not None else (0.0, float(n_frame))
    band = band_hz or (-0.5 * rate_hz, 0.5 * rate_hz)
    wanted = n_column * rate_hz / max(band[1] - band[0], 1e-9)
    n_bin = 1 << int(np.ceil(np.log2(np.clip(wanted, 512, _BINS[1]))))
    n_bin = min(n_bin, 1 << int(np.log2(frame_samples)))
    frequency_hz = np.fft.fftshift(np.fft.fftfreq(n_bin, 1.0 / rate_hz))
    inside = np.flatnonzero((frequency_hz >= band[0]) & (frequency_hz <= band[1]))
    n_out = max(1, min(n_column, len(inside)))
    pick = np.linspace(0, len(inside), n_out, endpoint=False).astype(np.int64)
    rows = np.full((n_row, n_out), np.nan, np.float32)
    for k, place in enumerate(np.linspace(*span, n_row, endpoint=False)):
        frame = min(int(place), n_frame - 1)
        skip = min(int((place - frame) * frame_samples), frame_samples - n_bin)
        start, count = int(frame_start_index[frame]) + skip, min(_ROW_SEGMENTS * n_bin, frame_samples - skip)
        begin = recording.frame_at(receiver_id, start, count)
        if len(inside) and begin is not None:
            power = _welch(_complex(recording.read(receiver_id, begin, count)), rate_hz, n_bin)[1]
            rows[k] = np.maximum.reduceat(_decibels(power[inside], recording), pick)
        if on_progress is not None:
            on_progress(k + 1, n_row)
    return Waterfall(span=span, band_hz=band, power_db=rows)


def look_at_frame(recording: Recording, scenario: Scenario, receiver_id: str, start_index: int) -> FrameLook:
    """Demodulate one frame of one receiver; a bad one has its reason as status and no analytic tones.

    Raises
    ------
    RecordingError
        The file is damaged.
    """
    plan = LinePlan.from_scenario(scenario)
    n_sample = scenario.radio.frame_samples
    begin = recording.frame_at(receiver_id, start_index, n_sample)
    if begin is None:
        return _failed(plan, LineStatus.GAP)
    samples = recording.read(receiver_id, begin, n_sample)
    tones = ToneExtractor(plan, full_scale=recording.full_scale).measure(samples)
    if not np.isfinite(tones.clock_ppm):
        return FrameLook(tones=tones, analytic=np.empty((plan.n_transmitter, plan.n_tone, 0), np.complex128))
    streams = LineBank(plan, n_sample, windowed=True).streams(samples, tones.clock_ppm)
    analytic = analytic_tones(centred_streams(streams), plan.n_transmitter, plan.n_tone)
    with np.errstate(invalid="ignore", divide="ignore"):
        analytic = analytic / np.mean(np.abs(analytic), axis=-1, keepdims=True)
    return FrameLook(tones=tones, analytic=analytic)


def _failed(plan: LinePlan, status: LineStatus) -> FrameLook:
    return FrameLook(
        tones=FrameTones.failed(plan.n_transmitter, plan.n_tone, status),
        analytic=np.empty((plan.n_transmitter, plan.n_tone, 0), np.complex128),
    )


def line_health(tones: FrameTones, transmitter_ids: Sequence[str], full_scale: float) -> tuple[LineHealth, ...]:
    """Return a row a transmitter: level, signal-to-noise ratio of its carrier, sigma of its tones, what is wrong."""
    reference = full_scale if np.isfinite(full_scale) else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        level_db = 20.0 * np.log10(np.abs(tones.carrier) / reference)
        snr_db = 20.0 * np.log10(np.abs(tones.carrier)) - 10.0 * np.log10(tones.noise_variance)
    return tuple(
        LineHealth(
            transmitter_id=name,
            carrier_db=float(level_db[i]),
            carrier_snr_db=float(snr_db[i]),
            tone_sigma_mrad=tuple(1e3 * float(s) for s in tones.sigma_rad[i]),
            reason=LineStatus(int(tones.status[i])).reason,
        )
        for i, name in enumerate(transmitter_ids)
    )


def phase_track(
    recording: Recording,
    scenario: Scenario,
    receiver_id: str,
    *,
    n_frame: int = 100,
    on_progress: Progress | None = None,
) -> PhaseTrack:
    """Measure one receiver and the calibration receivers in frames spread over the recording.

    Parameters
    ----------
    n_frame
        At most so many frames are measured.
    on_progress
        Called with (frames done, frames).
    """
    starts, n_sample = viewing_frames(recording, scenario)
    if len(starts) > n_frame:
        starts = starts[np.linspace(0, len(starts) - 1, n_frame).astype(np.int64)]
    tones = TonePhases.empty(
        receiver_ids=scenario.receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        tone_hz=scenario.tone_hz,
        frame_start_index=starts,
    )
    extractor = ToneExtractor(LinePlan.from_scenario(scenario), full_scale=recording.full_scale)
    names = (receiver_id, *(r.id for r in scenario.calibration_receiver if r.id != receiver_id))
    rows = [(scenario.receiver_ids.index(name), name) for name in names if name in scenario.receiver_ids]
    clock: dict[int, float] = {}
    for f, start in enumerate(starts):
        for row, name in rows:
            if name not in recording.receiver_ids:
                continue
            found = _measured(extractor, recording, name, int(start), n_sample, clock.get(row))
            for field in FrameTones.__dataclass_fields__:
                getattr(tones, field)[f, row] = getattr(found, field)
            clock[row] = found.clock_ppm
        if on_progress is not None:
            on_progress(f + 1, len(starts))
    calibration = calibrate(tones, scenario) if scenario.calibration_receiver else None
    return phases_of(tones, calibration, receiver_id, scenario, first_index=_first_index(recording))


def _measured(
    extractor: ToneExtractor, recording: Recording, name: str, start: int, n_sample: int, clock_ppm: float | None
) -> FrameTones:
    begin = recording.frame_at(name, start, n_sample)
    if begin is None:
        return FrameTones.failed(extractor.plan.n_transmitter, extractor.plan.n_tone, LineStatus.GAP)
    return extractor.measure(recording.read(name, begin, n_sample), clock_ppm=clock_ppm)


def phases_of(
    tones: TonePhases, calibration: PhaseCalibration | None, receiver_id: str, scenario: Scenario, *, first_index: int
) -> PhaseTrack:
    """Return one receiver's phases over frames from what was measured before."""
    row = scenario.receiver_ids.index(receiver_id)
    phase = tones.phase_rad[:, row]
    unknown = np.full_like(phase, np.nan)
    time_s = (tones.frame_start_index - first_index) / scenario.radio.sample_rate_hz
    return PhaseTrack(
        time_s=read_only(np.asarray(time_s, np.float64)),
        phase_rad=phase,
        sigma_rad=tones.sigma_rad[:, row],
        electronic_rad=unknown if calibration is None else calibration.phase_rad,
        electronic_sigma_rad=unknown if calibration is None else calibration.sigma_rad,
        clock_ppm=tones.clock_ppm[:, row],
        clock_sigma_ppm=tones.clock_sigma_ppm[:, row],
        clipped_fraction=tones.clipped_fraction[:, row],
        status=tones.status[:, row],
    )
