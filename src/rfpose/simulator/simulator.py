"""Turn a scenario into samples."""

from __future__ import annotations

import functools
import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.jit import load_numba
from rfpose.scenario import Receiver, Scenario
from rfpose.simulator import _draws, _kernels, _motion, _rays, _tables
from rfpose.simulator._paths import Paths, paths_from_geometry
from rfpose.truth import Truth

__all__ = ["CHUNK_SAMPLES", "Chunk", "Simulator"]

CHUNK_SAMPLES = 2**17
_MAX_DB = 1000.0
_MAX_CLOCK_PPM = 1e5
_NOISE_PEAK_SIGMA = 4.0

Samples = npt.NDArray[np.int16] | npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Chunk:
    """Successive samples of one receiver.

    Attributes
    ----------
    receiver_id
    start_index
        Number of the first sample, counted from the Unix epoch at the nominal rate.
    samples : (sample, 2)
        Real and imaginary part: int16 [counts], or float32 in units of a transmitter of amplitude one.
    """

    receiver_id: str
    start_index: int
    samples: Samples


@dataclass(frozen=True, slots=True)
class _Job:
    """One chunk to make."""

    i_frame: int
    i_receiver: int
    i_chunk: int
    rays: _rays.RayTerms
    kept: tuple[tuple[int, int], ...]
    """First and past-the-last sample in the frame of each stretch that is not lost."""


class Simulator:
    """A synthetic recording: iterate over it for the samples, frame by frame, receiver by receiver.

    Each sample is the sum over transmitters and rays of the whole modulated carrier, delayed, RF phase included;
    plus noise; through the converter. See ``docs/simulation.md``. Iterating again gives the same samples, and
    memory does not grow with length.

    Parameters
    ----------
    scenario
        What to simulate; its ``simulation`` table says how.
    seed
        Everything random follows from it.
    folder
        Where the scenario's file is: relative names of ray tables are looked for there first.

    Attributes
    ----------
    truth : Truth
        What is really there.
    receiver_ids
        In the order in which a frame's samples come.
    files
        Ray tables that were read.
    frame_start_index : (frame,) int64
        First sample of each frame, counted from the Unix epoch at the nominal rate.
    sample_format
        "int16" or "complex64" (as pairs of float32).
    full_scale
        Largest value of a component: 2^(bits−1)−1 counts, at which the converter saturates; for complex64, which
        is not converted, infinity.
    counts_per_unit
        Sample value that a transmitter of amplitude one gives at the reference range.
    noise_sigma
        Standard deviation of one component of the noise, in units of a transmitter of amplitude one.
    total_samples
        Over all receivers and frames, lost ones not counted.
    draws : Draws
        What chance decided, that which ``truth`` does not hold included.

    Raises
    ------
    ScenarioError
        The scenario cannot be simulated: a heliostat without posture, overlapping frames, a receiver on top of a
        transmitter, an impairment of a frame that does not exist, a ray table of another site or posture. Names the
        key to change.
    RecordingError
        A ray table is missing or damaged.
    InvalidInputError
        ``seed`` is not a non-negative integer.
    """

    truth: Truth
    receiver_ids: tuple[str, ...]
    files: tuple[Path, ...]
    frame_start_index: npt.NDArray[np.int64]
    sample_format: Literal["int16", "complex64"]
    full_scale: float
    counts_per_unit: float
    noise_sigma: float
    total_samples: int
    draws: _draws.RecordingDraws

    def __init__(self, scenario: Scenario, *, seed: int, folder: Path | None = None) -> None:
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise InvalidInputError(f"`seed` must be a non-negative integer, got {seed!r}")
        _check(scenario)
        self._scenario = scenario
        self._seed = int(seed)
        self._scratch = threading.local()
        simulation = scenario.simulation

        self.receiver_ids = scenario.receiver_ids
        self.sample_format = simulation.sample_format
        self.frame_start_index = read_only(_motion.frame_start_index(scenario))
        self._run_start_index = _run_starts(self.frame_start_index, scenario.radio.frame_samples)
        self._lost = _lost_stretches(scenario)
        self.total_samples = self._count_samples()

        since_start = self.frame_start_index - self.frame_start_index[0]
        self.draws = _draws.draw(
            scenario, seed=self._seed, frame_time_s=since_start / float(scenario.radio.sample_rate)
        )
        normal_enu = _motion.mirror_normal_enu(scenario)
        self._receiver_enu_m = _motion.receiver_enu_m(scenario, normal_enu)
        self._tables = _tables.SiteTables.of(scenario, normal_enu, self._receiver_enu_m, folder)
        if self._tables is not None:
            self._receiver_enu_m = self._tables.receiver_enu_m
        self.files = () if self._tables is None else self._tables.files
        self._pass_factor = _pass_factor(scenario)

        self.noise_sigma = scenario.tone[0].modulation_index * 10.0 ** (-simulation.tone_snr_db / 20.0) / np.sqrt(2.0)
        amplitude, peak = self._signal_and_peak()
        if simulation.sample_format == "int16":
            self.full_scale = 2.0 ** (simulation.adc_bits - 1) - 1.0
            peak += _NOISE_PEAK_SIGMA * self.noise_sigma
            self.counts_per_unit = self.full_scale / (peak * 10.0 ** (simulation.headroom_db / 20.0))
            rounding_variance = 1.0 / (12.0 * self.counts_per_unit**2)
        else:
            self.full_scale = math.inf
            self.counts_per_unit = 1.0
            rounding_variance = 0.0
        noise_variance = 2.0 * (self.noise_sigma**2 + rounding_variance)
        index = np.array([t.modulation_index for t in scenario.tone])
        self.truth = Truth(
            heliostat_ids=scenario.heliostat_ids,
            receiver_ids=scenario.receiver_ids,
            transmitter_ids=scenario.transmitter_ids,
            normal_enu=read_only(normal_enu),
            receiver_enu_m=read_only(self._receiver_enu_m),
            frame_start_index=self.frame_start_index,
            transmitter_phase_rad=read_only(self.draws.tone_phase_rad),
            clock_ppm=read_only(self.draws.clock_ppm),
            receiver_delay_s=read_only(self.draws.delay_s),
            tone_snr=read_only((amplitude[..., None] * index) ** 2 / noise_variance),
        )

    def __iter__(self) -> Iterator[Chunk]:
        """Yield the samples in order; a few chunks ahead are made on other cores meanwhile."""
        n_worker = int(load_numba().config.NUMBA_NUM_THREADS)
        ahead: deque[Future[list[Chunk]]] = deque()
        with ThreadPoolExecutor(n_worker, thread_name_prefix="rfpose-simulate") as pool:
            for job in self._jobs():
                ahead.append(pool.submit(self._make, job))
                if len(ahead) > n_worker:
                    yield from ahead.popleft().result()
            while ahead:
                yield from ahead.popleft().result()

    def stretches(self, receiver_id: str) -> npt.NDArray[np.int64]:
        """Return (stretch, 2) rows [start index, count] of what a receiver records, each within one frame."""
        i_receiver, n_sample = self.receiver_ids.index(receiver_id), self._scenario.radio.frame_samples
        rows = [
            (int(start) + first, stop - first)
            for i_frame, start in enumerate(self.frame_start_index)
            for first, stop in _kept_stretches(0, n_sample, self._lost.get((i_frame, i_receiver), []))
        ]
        return np.array(rows, np.int64).reshape(-1, 2)

    def pieces(self, receiver_id: str, start_index: int, count: int) -> Iterator[Callable[[], tuple[int, Samples]]]:
        """Yield what makes the samples of a part of one stretch, piece by piece, on whichever thread.

        Each, when it is called, returns where its samples begin in the part, and the samples.
        """
        i_receiver = self.receiver_ids.index(receiver_id)
        i_frame = int(np.searchsorted(self.frame_start_index, start_index, side="right")) - 1
        begin = start_index - int(self.frame_start_index[i_frame])
        rays = self._rays_of(i_frame, i_receiver, self._paths(i_frame))

        def piece(i_chunk: int) -> tuple[int, Samples]:
            first = max(begin, i_chunk * CHUNK_SAMPLES)
            stop = min(begin + count, (i_chunk + 1) * CHUNK_SAMPLES)
            return first - begin, self._make(_Job(i_frame, i_receiver, i_chunk, rays, ((first, stop),)))[0].samples

        for i_chunk in range(begin // CHUNK_SAMPLES, -(-(begin + count) // CHUNK_SAMPLES)):
            yield functools.partial(piece, i_chunk)

    # -- one chunk ---------------------------------------------------------------------------------------

    def _jobs(self) -> Iterator[_Job]:
        n_sample = self._scenario.radio.frame_samples
        for i_frame in range(len(self.frame_start_index)):
            paths = self._paths(i_frame)
            for i_receiver in range(len(self.receiver_ids)):
                rays = self._rays_of(i_frame, i_receiver, paths)
                lost = self._lost.get((i_frame, i_receiver), [])
                for i_chunk, first in enumerate(range(0, n_sample, CHUNK_SAMPLES)):
                    kept = _kept_stretches(first, min(first + CHUNK_SAMPLES, n_sample), lost)
                    if kept:
                        yield _Job(i_frame, i_receiver, i_chunk, rays, kept)

    def _paths(self, i_frame: int) -> Paths:
        """Return a frame's rays: those of its table, else from geometry."""
        if self._tables is not None:
            return self._tables.paths(i_frame)
        return paths_from_geometry(self._scenario, self._receiver_enu_m[i_frame])

    def _rays_of(self, i_frame: int, i_receiver: int, paths: Paths) -> _rays.RayTerms:
        draws = self.draws
        run_start_index = int(self._run_start_index[i_frame])
        return _rays.make_rays(
            self._scenario,
            length_m=paths.length_m[i_receiver],
            gain=paths.gain[i_receiver],
            pass_factor=self._pass_factor[i_frame, i_receiver],
            carrier_phase_rad=draws.carrier_phase_rad,
            tone_phase_rad=draws.tone_phase_rad[i_frame],
            delay_s=float(draws.delay_s[i_frame, i_receiver]),
            clock_ppm=float(draws.clock_ppm[i_receiver]),
            oscillator_phase_rad=float(draws.oscillator_phase_rad[i_receiver]),
            sampling_phase=float(draws.sampling_phase[i_receiver]),
            run_start_index=run_start_index,
            sample_in_run=int(self.frame_start_index[i_frame]) - run_start_index,
        )

    def _make(self, job: _Job) -> list[Chunk]:
        first = job.i_chunk * CHUNK_SAMPLES
        n_sample = min(CHUNK_SAMPLES, self._scenario.radio.frame_samples - first)
        signal, noise = self._buffers()
        signal, noise = signal[:, :n_sample], noise[:n_sample]
        generator = _draws.noise_generator(
            self._seed, i_frame=job.i_frame, i_receiver=job.i_receiver, i_chunk=job.i_chunk
        )
        generator.standard_normal(dtype=np.float32, out=noise)
        index = np.array([t.modulation_index for t in self._scenario.tone])
        rays = job.rays
        _kernels.sum_of_rays(
            first, rays.amplitude, rays.carrier_turn, rays.carrier_step, index, rays.tone_turn, rays.tone_step, signal
        )
        samples: npt.NDArray[Any]
        if self.sample_format == "int16":
            samples = np.empty((n_sample, 2), np.int16)
            _kernels.to_int16(signal, noise, self.noise_sigma, self.counts_per_unit, self.full_scale, samples)
        else:
            samples = np.empty((n_sample, 2), np.float32)
            _kernels.to_float32(signal, noise, self.noise_sigma, samples)
        receiver_id, frame_start = self.receiver_ids[job.i_receiver], int(self.frame_start_index[job.i_frame])
        return [Chunk(receiver_id, frame_start + a, samples[a - first : b - first]) for a, b in job.kept]

    def _buffers(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]]:
        """Return this thread's space for signal (2, sample) and noise (sample, 2); fresh pages cost a tenth more."""
        if not hasattr(self._scratch, "buffers"):
            n_sample = min(CHUNK_SAMPLES, self._scenario.radio.frame_samples)
            self._scratch.buffers = (np.empty((2, n_sample)), np.empty((n_sample, 2), np.float32))
        buffers: tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]] = self._scratch.buffers
        return buffers

    # -- the whole recording -----------------------------------------------------------------------------

    def _count_samples(self) -> int:
        n_sample = self._scenario.radio.frame_samples
        whole = n_sample * len(self.receiver_ids) * len(self.frame_start_index)
        return whole - sum(
            n_sample - sum(b - a for a, b in _kept_stretches(0, n_sample, lost)) for lost in self._lost.values()
        )

    def _signal_and_peak(self) -> tuple[FloatArray, float]:
        """Return signals' amplitudes (frame, receiver, transmitter) and the largest that a sample can become."""
        crest = 1.0 + sum(t.modulation_index for t in self._scenario.tone)
        signal = np.empty(self._pass_factor.shape)
        peak = 0.0
        for i_frame in range(len(signal)):
            paths = self._paths(i_frame)
            signal[i_frame] = paths.signal * self._pass_factor[i_frame]
            peak = max(peak, crest * float(np.abs(paths.gain).sum(axis=(-2, -1)).max()))
        return signal, peak


def _check(scenario: Scenario) -> None:
    simulation = scenario.simulation
    if not scenario.receivers:
        raise ScenarioError("the scenario has no receivers to simulate; add a `[[heliostat]]`")
    for key in ("tone_snr_db", "headroom_db"):
        value = getattr(simulation, key)
        if abs(value) > _MAX_DB:
            raise ScenarioError(f"`simulation.{key}` must lie within ±{_MAX_DB:g} dB, got {value:g}")
    if simulation.clock_offset_ppm > _MAX_CLOCK_PPM:
        raise ScenarioError(
            f"`simulation.clock_offset_ppm` must not exceed {_MAX_CLOCK_PPM:g}, got {simulation.clock_offset_ppm:g}"
        )
    for k, blockage in enumerate(simulation.blocked):
        if not blockage.first_frame <= min(blockage.last_frame, simulation.frame_count - 1):
            raise ScenarioError(
                f"`simulation.blocked[{k}]` holds for no frame: `first_frame` is {blockage.first_frame}, "
                f"`last_frame` {blockage.last_frame}, and there are {simulation.frame_count} frames, from 0"
            )
    for k, dropout in enumerate(simulation.dropped):
        end = dropout.first_sample + dropout.sample_count
        if dropout.frame >= simulation.frame_count or end > scenario.radio.frame_samples:
            raise ScenarioError(
                f"`simulation.dropped[{k}]` ends at sample {end} of frame {dropout.frame}, but there are "
                f"{simulation.frame_count} frames, from 0, of {scenario.radio.frame_samples} samples"
            )


def _run_starts(frame_start_index: npt.NDArray[np.int64], frame_samples: int) -> npt.NDArray[np.int64]:
    """Return, for each frame, the first sample of the stretch without a pause that the frame belongs to."""
    begins = np.diff(frame_start_index, prepend=frame_start_index[0] - frame_samples - 1) != frame_samples
    run = np.cumsum(begins) - 1
    return np.asarray(frame_start_index[begins][run], np.int64)


def _lost_stretches(scenario: Scenario) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """Return, by frame and receiver, the stretches of samples that were lost, sorted."""
    lost: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for dropout in sorted(scenario.simulation.dropped, key=lambda d: d.first_sample):
        key = (dropout.frame, scenario.receiver_ids.index(dropout.receiver))
        stretch = (dropout.first_sample, dropout.first_sample + dropout.sample_count)
        lost.setdefault(key, []).append(stretch)
    return lost


def _kept_stretches(first: int, stop: int, lost: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Return what is left of samples first to stop (exclusive) without the sorted stretches ``lost``."""
    kept = []
    for a, b in [*lost, (stop, stop)]:
        if first < min(a, stop):
            kept.append((first, min(a, stop)))
        first = max(first, b)
    return tuple(kept)


def _pass_factor(scenario: Scenario) -> FloatArray:
    """Return what obstacles leave of each amplitude (frame, receiver, transmitter)."""
    simulation = scenario.simulation
    factor = np.ones((simulation.frame_count, len(scenario.receivers), len(scenario.transmitter)))
    for blockage in simulation.blocked:
        i_transmitter = scenario.transmitter_ids.index(blockage.transmitter)
        hidden = [not blockage.receivers or _is_named(scenario, r, blockage.receivers) for r in scenario.receivers]
        frames = slice(blockage.first_frame, blockage.last_frame + 1)
        factor[frames, hidden, i_transmitter] *= 10.0 ** (-blockage.attenuation_db / 20.0)
    return factor


def _is_named(scenario: Scenario, receiver: Receiver, names: tuple[str, ...]) -> bool:
    heliostat = None if receiver.heliostat is None else scenario.heliostat_ids[receiver.heliostat]
    return receiver.id in names or heliostat in names
