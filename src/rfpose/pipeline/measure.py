"""From IQ to tone phases for a whole recording: receivers side by side, resumable."""

from __future__ import annotations

import contextlib
import hashlib
import json
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import __version__
from rfpose.dsp import FrameTones, LinePlan, LineStatus, ToneExtractor, TonePhases
from rfpose.pipeline._workers import worker_pool
from rfpose.pipeline.formats.journal import Entry, Journal
from rfpose.pipeline.stages import Stopwatch
from rfpose.recording import GapError, Recording
from rfpose.scenario import Scenario

__all__ = ["JOURNAL_SAMPLES", "journal_key", "measure_tones"]

JOURNAL_SAMPLES = 40_000_000
"""Samples measured between two entries of the journal: about a second's work."""

_MAX_ENTRY_ROWS = 4096
_PROBE_SAMPLES = 1024
_CLOCK_STATE = "clock_state_ppm"

Samples = npt.NDArray[Any]


def journal_key(recording: Recording, scenario: Scenario, estimator: str) -> dict[str, str]:
    """Return what measured phases depend on; it does not change when the files move."""
    return {
        "scenario": hashlib.sha256(scenario.to_toml().encode()).hexdigest(),
        "recording": _fingerprint(recording),
        "estimator": estimator,
        "rfpose version": __version__,
    }


def _fingerprint(recording: Recording) -> str:
    """Hash a recording's shape and some of its samples, so that another recording of the same shape differs."""
    facts = [recording.receiver_ids, str(recording.sample_rate), recording.sample_format, str(recording.full_scale)]
    found = hashlib.sha256(json.dumps(facts).encode())
    for receiver_id in recording.receiver_ids:
        blocks = recording.blocks(receiver_id)
        found.update(np.ascontiguousarray(blocks, "<i8").tobytes())
        for start, count in blocks[[0, -1]] if len(blocks) else ():
            n = min(int(count), _PROBE_SAMPLES)
            for at in (int(start), int(start + count) - n):
                with contextlib.suppress(GapError):  # a damaged part
                    found.update(recording.read(receiver_id, at, n).tobytes())
    return found.hexdigest()


def measure_tones(
    recording: Recording,
    scenario: Scenario,
    frame_start_index: npt.NDArray[np.int64],
    *,
    estimator: str,
    journal: Journal | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    stages: Stopwatch | None = None,
) -> TonePhases:
    """Measure every tone in every frame of every receiver.

    Parameters
    ----------
    recording
        Open recording; a receiver that it lacks, and a frame with a gap, become NaN with a status. A receiver that
        started some samples beside the others is measured in its own frame; see `Recording.frame_at`.
    scenario
        The site; its receiver axis is the result's.
    frame_start_index : (frame,)
        First sample of each frame since the Unix epoch.
    estimator
        One of `rfpose.dsp.ESTIMATORS`.
    journal
        What was measured before is taken from here, what is measured is added.
    on_progress
        Called with (rows done, rows in all); a row is one receiver in one frame.
    stages
        Takes the time of reading and of measuring.

    Raises
    ------
    RecordingError
        The recording is damaged, or the journal cannot be written.
    """
    stages = Stopwatch() if stages is None else stages
    n_receiver = len(scenario.receiver_ids)
    n_row = len(frame_start_index) * n_receiver
    tones = TonePhases.empty(
        receiver_ids=scenario.receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        tone_hz=scenario.tone_hz,
        frame_start_index=frame_start_index,
    )
    rows = _rows(tones)
    # where each receiver's clock was last seen; it is searched anew after a frame in which nothing was found
    clock_ppm = np.full(n_receiver, np.nan)
    done = 0
    for first, end, entry in journal.read() if journal is not None else ():
        for name, values in rows.items():
            values[first:end] = entry[name]
        clock_ppm[:] = entry[_CLOCK_STATE]
        done = end
    extractor = ToneExtractor(LinePlan.from_scenario(scenario), estimator, full_scale=recording.full_scale)
    reader = _Reader(recording, scenario, frame_start_index)
    per_entry = max(1, min(_MAX_ENTRY_ROWS, JOURNAL_SAMPLES // scenario.radio.frame_samples))
    with worker_pool() as pool:
        while done < n_row:
            first, end = done, min(done + per_entry, n_row)

            def measure_receiver(i_receiver: int, first: int = first, end: int = end) -> int:
                """Measure one receiver's rows of this entry, in order, since its clock is followed."""
                mine = range(first + (i_receiver - first) % n_receiver, end, n_receiver)
                for row in mine:
                    with stages.during("read"):
                        samples = reader.read(row)
                    with stages.during("tones", 0 if isinstance(samples, LineStatus) else len(samples)):
                        found = _measure(extractor, samples, float(clock_ppm[i_receiver]))
                    tones.put(row // n_receiver, i_receiver, found)
                    clock_ppm[i_receiver] = found.clock_ppm if np.any(found.status == LineStatus.OK) else np.nan
                return len(mine)

            for n_measured in pool.map(measure_receiver, range(n_receiver)):
                done += n_measured
                if on_progress is not None and n_measured:
                    on_progress(done, n_row)
            if journal is not None:
                entry = {name: values[first:end] for name, values in rows.items()}
                journal.append(first, end, {**entry, _CLOCK_STATE: clock_ppm})
    return tones


def _rows(tones: TonePhases) -> Entry:
    """Return views of the arrays with frame and receiver in one axis."""
    arrays = {name: getattr(tones, name) for name in FrameTones.__dataclass_fields__}
    return {name: array.reshape(-1, *array.shape[2:], copy=False) for name, array in arrays.items()}


def _measure(extractor: ToneExtractor, samples: Samples | LineStatus, clock_ppm: float) -> FrameTones:
    if isinstance(samples, LineStatus):
        return FrameTones.failed(extractor.plan.n_transmitter, extractor.plan.n_tone, samples)
    return extractor.measure(samples, clock_ppm=clock_ppm)


class _Reader:
    """Reads rows for several threads; each has one buffer, which its next row overwrites."""

    def __init__(self, recording: Recording, scenario: Scenario, frame_start_index: npt.NDArray[np.int64]) -> None:
        self._recording = recording
        self._receiver_ids = scenario.receiver_ids
        self._n_sample = scenario.radio.frame_samples
        self._start_index = frame_start_index
        self._lock = threading.Lock()  # not every format's library can be called from several threads at once
        self._own = threading.local()

    def read(self, row: int) -> Samples | LineStatus:
        """Return one receiver's samples in one frame, or why there are none."""
        i_frame, i_receiver = divmod(row, len(self._receiver_ids))
        receiver_id, start = self._receiver_ids[i_receiver], int(self._start_index[i_frame])
        if receiver_id not in self._recording.receiver_ids:
            return LineStatus.NOT_RECORDED
        with self._lock:
            begin = self._recording.frame_at(receiver_id, start, self._n_sample)
            if begin is None:
                return LineStatus.GAP
            try:
                return self._recording.read(receiver_id, begin, self._n_sample, out=self._buffer())
            except GapError:  # of a part that is damaged, which is said; the rest goes on
                return LineStatus.GAP

    def _buffer(self) -> Samples:
        if not hasattr(self._own, "buffer"):
            self._own.buffer = np.empty((self._n_sample, 2), self._recording.component_dtype)
        buffer: Samples = self._own.buffer
        return buffer
