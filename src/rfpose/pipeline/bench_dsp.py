"""How many samples a second become tone phases, against scipy and against the memory they are read from."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import signal

from rfpose.checks import as_positive
from rfpose.dsp import ESTIMATORS, LinePlan, ToneExtractor
from rfpose.engine import n_core, worker_pool
from rfpose.recording import Recording, RecordingWriter, open_recording

__all__ = ["measure", "measure_memory"]

RATE_HZ, CENTRE_HZ, TONE_HZ = 40e6, 100e6, 750e3
CARRIER_HZ = np.arange(-18e6, 19e6, 4e6)
CLOCK_PPM = 12.0
N_SAMPLE = 1_000_000
N_RECEIVER = 24  # 96 MB of int16 IQ: more than the caches hold
N_SCIPY = 200_000

Samples = npt.NDArray[np.int16]


def measure(seconds: float) -> dict[str, dict[str, float]]:
    """Measure each estimator on ten-carrier int16 IQ, all cores, samples to phases.

    Frames of a million samples from memory and from a file in the page cache. The comparison is what one would
    write with scipy: per carrier mix, FIR, decimate, envelope, band-pass, Hilbert transform, mean phasor.

    Parameters
    ----------
    seconds
        Time to spend on each estimator [s].

    Returns
    -------
    dict
        Per estimator ``samples_per_s``, ``file_samples_per_s``, ``speedup_vs_scipy``,
        ``fraction_of_read_bandwidth`` (bytes taken in over bytes that the memory can deliver).
    """
    seconds = as_positive("seconds", seconds)
    frames = _frames()
    scipy_rate = _best_rate(lambda: _scipy_chain(frames[0][:N_SCIPY]), N_SCIPY, seconds / 4)
    bandwidth = 1e9 * measure_memory(seconds / 4)
    plan = LinePlan.create(CARRIER_HZ, [TONE_HZ], sample_rate_hz=RATE_HZ, centre_frequency_hz=CENTRE_HZ)  # type: ignore[arg-type]
    out = {}
    with tempfile.TemporaryDirectory() as folder:
        path = _write(Path(folder) / "bench.h5", frames)
        with worker_pool() as pool, open_recording(path) as recording:
            for estimator in ESTIMATORS:
                extractor = ToneExtractor(plan, estimator)
                out[estimator] = _estimator(extractor, frames, recording, pool, seconds, scipy_rate, bandwidth)
    return out


def measure_memory(seconds: float) -> float:
    """Return the rate at which all cores together read memory [GB/s]."""
    block = np.ones(64 * 2**20 // 8, np.int64)
    parts = np.array_split(block, n_core())
    with worker_pool() as pool:
        return 1e-9 * _best_rate(lambda: list(pool.map(np.max, parts)), block.nbytes, seconds)


def _estimator(
    extractor: ToneExtractor,
    frames: Sequence[Samples],
    recording: Recording,
    pool: Executor,
    seconds: float,
    scipy_rate: float,
    bandwidth: float,
) -> dict[str, float]:
    clock_ppm = extractor.acquire_clock(frames[0])
    own = threading.local()

    def from_memory(i: int) -> Any:
        return extractor.measure(frames[i], clock_ppm=clock_ppm)

    def from_file(i: int) -> Any:
        if not hasattr(own, "buffer"):
            own.buffer = np.empty_like(frames[0])
        samples = recording.read(recording.receiver_ids[i], 0, N_SAMPLE, out=own.buffer)
        return extractor.measure(samples, clock_ppm=clock_ppm)

    count = len(frames) * N_SAMPLE
    rate = _best_rate(lambda: list(pool.map(from_memory, range(len(frames)))), count, seconds / 2)
    file_rate = _best_rate(lambda: list(pool.map(from_file, range(len(frames)))), count, seconds / 2)
    return {
        "samples_per_s": rate,
        "file_samples_per_s": file_rate,
        "speedup_vs_scipy": rate / scipy_rate,
        "fraction_of_read_bandwidth": rate * frames[0].itemsize * 2 / bandwidth,
    }


def _frames() -> list[Samples]:
    rng = np.random.default_rng(1)
    t = np.arange(N_SAMPLE) / RATE_HZ
    x = np.zeros(N_SAMPLE, np.complex128)
    for f in CARRIER_HZ:
        shifted = f - CLOCK_PPM * 1e-6 * (CENTRE_HZ + f)
        x += (1.0 + 0.8 * np.cos(2 * np.pi * TONE_HZ * t)) * np.exp(2j * np.pi * (shifted * t + rng.random()))
    x += 0.01 * (rng.standard_normal(N_SAMPLE) + 1j * rng.standard_normal(N_SAMPLE))
    pair = np.stack([x.real, x.imag], axis=-1)
    first = np.rint(pair * (30000.0 / np.abs(pair).max())).astype(np.int16)
    return [first.copy() for _ in range(N_RECEIVER)]


def _write(path: Path, frames: Sequence[Samples]) -> Path:
    with RecordingWriter(
        path,
        scenario=None,
        receiver_ids=tuple(f"r{i}" for i in range(len(frames))),
        sample_rate=Fraction(int(RATE_HZ)),
        centre_frequency_hz=CENTRE_HZ,
        sample_format="int16",
        full_scale=32767.0,
        provenance={},
    ) as writer:
        for i, frame in enumerate(frames):
            writer.write(f"r{i}", 0, frame)
    return path


def _scipy_chain(samples: Samples) -> npt.NDArray[np.float64]:
    """Phase of each carrier's tone against the first's, as one would write it with scipy."""
    x = samples[:, 0] + 1j * samples[:, 1].astype(np.float64)
    t = np.arange(len(x)) / RATE_HZ
    low_pass = signal.firwin(129, 1.5e6, fs=RATE_HZ)
    band_pass = signal.butter(4, [0.6e6, 0.9e6], "bandpass", fs=RATE_HZ / 10, output="sos")
    tones = []
    for f in CARRIER_HZ:
        mixed = x * np.exp(-2j * np.pi * f * t)
        envelope = np.abs(signal.upfirdn(low_pass, mixed, down=10))
        tones.append(signal.hilbert(signal.sosfiltfilt(band_pass, envelope - envelope.mean())))
    unit = np.array(tones) / np.abs(tones)
    return np.asarray(np.angle(np.mean(unit * unit[:1].conj(), axis=1)))


def _best_rate(work: Callable[[], object], count: int, seconds: float) -> float:
    """Return the rate of the best of several rounds, so that what else runs on the machine counts least."""
    work()
    best, end, rounds = np.inf, time.perf_counter() + seconds, 0
    while rounds < 3 or time.perf_counter() < end:
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
        rounds += 1
    return count / best
