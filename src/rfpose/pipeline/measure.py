"""From IQ to tone phases for a whole recording: receivers side by side, here or on other machines; resumable."""

from __future__ import annotations

import contextlib
import hashlib
import json
import pickle
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rfpose import __version__
from rfpose.dsp import FrameTones, LinePlan, LineStatus, ToneExtractor, TonePhases
from rfpose.engine import Team, team_here, team_of
from rfpose.errors import RecordingError
from rfpose.pipeline.formats.journal import Entry, Journal
from rfpose.pipeline.stages import Stopwatch
from rfpose.recording import GapError, Recording, open_recording
from rfpose.scenario import Scenario

__all__ = ["JOURNAL_SAMPLES", "FrameByFrame", "OtherProcesses", "extractors", "journal_key", "measure_tones"]

JOURNAL_SAMPLES = 40_000_000
"""Samples measured here between two entries of the journal: a small part of a second's work for each core."""
_LONGER_ELSEWHERE = 4
"""So many times as long are entries for each thread elsewhere, for tasks that are worth giving out."""

_PER_THREAD = 2
"""Tasks of an entry for each thread elsewhere: one to do and one that lies there when it is done. Giving one out takes
4 ms of the processors, whatever it holds."""

_PER_THREAD_HERE = 16
"""The same for each thread here, to which they go in no time."""
_FOR_THREADS_SAMPLES = 400_000
"""Of a frame; in shorter ones a kernel takes less time than it takes a thread to get the interpreter back."""

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
    facts = [
        recording.receiver_ids,
        str(recording.sample_rate),
        recording.sample_format,
        str(recording.full_scale),
        [recording.centre_frequency_hz, recording.tunings],
    ]
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


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherProcesses:
    """Measuring in other processes, which open the recording by themselves.

    Attributes
    ----------
    paths
        The recording or its parts, as they see them.
    follow_links
        As for `rfpose.recording.open_recording`.
    """

    paths: tuple[Path, ...]
    follow_links: bool = False


def measure_tones(
    recording: Recording,
    scenario: Scenario,
    frame_start_index: npt.NDArray[np.int64],
    *,
    estimator: str,
    journal: Journal | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    stages: Stopwatch | None = None,
    elsewhere: OtherProcesses | None = None,
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
    elsewhere
        Who measures in place of this process; the phases are the same.

    Raises
    ------
    RecordingError
        The recording is damaged, or the journal cannot be written; a worker sees no, or another, recording.
    ClusterError
        As `rfpose.engine.team_of`.
    """
    stages = Stopwatch() if stages is None else stages
    n_receiver = len(scenario.receiver_ids)
    n_row = len(frame_start_index) * n_receiver
    tones = _empty(scenario, scenario.receiver_ids, frame_start_index)
    rows = _rows(tones)
    # where each receiver's clock was last seen; it is searched anew after a frame in which nothing was found
    clock_ppm = np.full(n_receiver, np.nan)
    done = 0 if journal is None else _resume(journal, rows, clock_ppm)
    if done == n_row:
        return tones
    recipe = _Recipe(scenario=scenario, frame_start_index=frame_start_index, estimator=estimator)
    bench = _Bench(recording, recipe)
    with _team_here(scenario) if elsewhere is None else team_of() as team:
        share = _share_here(bench, n_receiver, team) if elsewhere is None else _share_elsewhere(bench, elsewhere, team)
        stages.cores = team.n_at_once
        end = min(done + share.rows, n_row)
        wanted = [_Wanted(done, end, group, clock_ppm[group]) for group in share.groups]
        # some receivers are an entry ahead of others: nobody waits for the last of an entry
        under_way: dict[int, list[tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]]] = {}
        for i, measured in team.map(share.measure, wanted, share.shared):
            first, end, group = wanted[i].first, wanted[i].end, wanted[i].i_receiver
            if end < n_row:
                wanted.append(_Wanted(end, min(end + share.rows, n_row), group, measured.clock_ppm))
            _put(rows, measured)
            for name, seconds in measured.seconds.items():
                stages.seconds[name] += seconds
            stages.samples += measured.samples
            done += len(measured.row)
            if on_progress is not None and len(measured.row):
                on_progress(done, n_row)
            parts = under_way.setdefault(first, [])
            parts.append((group, measured.clock_ppm))
            if len(parts) < len(share.groups):
                continue
            for group, clocks in under_way.pop(first):
                clock_ppm[group] = clocks
            if journal is not None:
                entry = {name: values[first:end] for name, values in rows.items()}
                journal.append(first, end, {**entry, _CLOCK_STATE: clock_ppm})
    return tones


def extractors(recording: Recording, scenario: Scenario, estimator: str = "hilbert") -> Callable[[str], ToneExtractor]:
    """Return what measures a receiver's tones, by its name: receivers tuned apart have their lines elsewhere."""

    def made(tuned_hz: float | None) -> ToneExtractor:
        plan = LinePlan.from_scenario(scenario, tuned_hz=tuned_hz)
        return ToneExtractor(plan, estimator, full_scale=recording.full_scale)

    as_told = made(None)
    apart = {recording.centre_frequency_hz, *recording.tunings.values()} if recording.tunings else set()
    others = {tuned: made(tuned) for tuned in apart if tuned is not None}

    def of(receiver_id: str) -> ToneExtractor:
        tuned = recording.tuning_of(receiver_id)
        return as_told if tuned is None else others.get(tuned, as_told)

    return of


class FrameByFrame:
    """Measures frames as they come, each as `measure_tones` would among all; a context manager.

    Parameters
    ----------
    recording, scenario, estimator
        As for `measure_tones`.
    before
        Phases of the frames before, of which the last says where the receivers' clocks were; None: there are none.
    """

    def __init__(
        self, recording: Recording, scenario: Scenario, *, estimator: str, before: TonePhases | None = None
    ) -> None:
        self._recipe = _Recipe(scenario=scenario, frame_start_index=np.empty(0, np.int64), estimator=estimator)
        self._bench = _Bench(recording, self._recipe)
        self._clock_ppm = np.full(len(scenario.receiver_ids), np.nan)
        if before is not None and len(before.frame_start_index):
            seen = np.any(before.status[-1] == LineStatus.OK, axis=1)
            self._clock_ppm = np.where(seen, before.clock_ppm[-1], np.nan)
        self._open = contextlib.ExitStack()

    def __enter__(self) -> Self:
        self._team = self._open.enter_context(_team_here(self._recipe.scenario))
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def measure(self, start_index: int) -> TonePhases:
        """Return the phases of the frame that begins with a sample.

        Raises
        ------
        RecordingError
            The recording is damaged.
        """
        scenario, n_receiver = self._recipe.scenario, self._bench.n_receiver
        starts = np.array([start_index], np.int64)
        self._bench.recipe = replace(self._recipe, frame_start_index=starts)
        tones = _empty(scenario, scenario.receiver_ids, starts)
        arrays = _rows(tones)
        groups = _groups(n_receiver, _PER_THREAD_HERE * self._team.n_at_once)
        wanted = [_Wanted(0, n_receiver, group, self._clock_ppm[group]) for group in groups]
        for i, measured in self._team.map(_measure_here, wanted, self._bench):
            self._clock_ppm[groups[i]] = measured.clock_ppm
            _put(arrays, measured)
        return tones


def _empty(scenario: Scenario, receiver_ids: tuple[str, ...], starts: npt.NDArray[np.int64]) -> TonePhases:
    return TonePhases.empty(
        receiver_ids=receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        tone_hz=scenario.tone_hz,
        frame_start_index=starts,
    )


def _rows(tones: TonePhases) -> Entry:
    """Return views of the arrays with frame and receiver in one axis."""
    arrays = {name: getattr(tones, name) for name in FrameTones.__dataclass_fields__}
    return {name: array.reshape(-1, *array.shape[2:], copy=False) for name, array in arrays.items()}


def _resume(journal: Journal, rows: Entry, clock_ppm: npt.NDArray[np.float64]) -> int:
    """Take over what a journal has, and clocks (receiver,) at its end; return how many rows there are."""
    done = 0
    for first, end, entry in journal.read():
        for name, values in rows.items():
            values[first:end] = entry[name]
        clock_ppm[:] = entry[_CLOCK_STATE]
        done = end
    return done


def _put(rows: Entry, measured: _Measured) -> None:
    """Store what was measured."""
    for name, values in rows.items():
        values[measured.row] = measured.found[name]


# -- how the work is shared ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Wanted:
    """Some receivers' rows of one entry of the journal."""

    first: int
    end: int
    i_receiver: npt.NDArray[np.int64]
    clock_ppm: npt.NDArray[np.float64]
    """Where each of their clocks was last seen."""


@dataclass(frozen=True, slots=True)
class _Measured:
    """What came of it; stages as in `Stopwatch`."""

    row: npt.NDArray[np.int64]
    found: Entry
    """Columns of these rows."""
    clock_ppm: npt.NDArray[np.float64]
    seconds: Mapping[str, float]
    samples: int


@dataclass(frozen=True, slots=True)
class _Share:
    """How an entry's rows become tasks."""

    rows: int
    """In an entry."""
    groups: list[npt.NDArray[np.int64]]
    """Receivers of each task: one's rows stay together and in order, since its clock is followed."""
    measure: Callable[[Any, _Wanted], _Measured]
    shared: Any


@dataclass(frozen=True, slots=True, kw_only=True)
class _Recipe:
    """What is measured in a recording, whoever opens it."""

    scenario: Scenario
    frame_start_index: npt.NDArray[np.int64]
    estimator: str


def _team_here(scenario: Scenario) -> contextlib.AbstractContextManager[Team]:
    return team_here(alone=scenario.radio.frame_samples < _FOR_THREADS_SAMPLES)


def _groups(n_receiver: int, n_task: int) -> list[npt.NDArray[np.int64]]:
    """Return the receivers of at most so many tasks."""
    return np.array_split(np.arange(n_receiver), min(n_receiver, n_task))


def _share_here(bench: _Bench, n_receiver: int, team: Team) -> _Share:
    groups = _groups(n_receiver, _PER_THREAD_HERE * team.n_at_once)
    return _Share(bench.rows_of(JOURNAL_SAMPLES), groups, _measure_here, bench)


def _share_elsewhere(bench: _Bench, elsewhere: OtherProcesses, team: Team) -> _Share:
    groups = _groups(bench.n_receiver, _PER_THREAD * team.n_at_once)
    place = _Place(
        paths=tuple(path.absolute() for path in elsewhere.paths),
        follow_links=elsewhere.follow_links,
        fingerprint=_fingerprint(bench.recording),
        recipe=bench.recipe,
    )
    packed = _Packed(key=place.key, place=pickle.dumps(place))
    return _Share(bench.rows_of(_LONGER_ELSEWHERE * JOURNAL_SAMPLES * team.n_at_once), groups, _measure_there, packed)


# -- where it is done ----------------------------------------------------------------------------------------


class _Bench:
    """Measures rows of an open recording, for several threads; each has one buffer, which its next row overwrites."""

    def __init__(self, recording: Recording, recipe: _Recipe) -> None:
        self.recording = recording
        self.recipe = recipe
        self._receiver_ids = recipe.scenario.receiver_ids
        self._n_sample = recipe.scenario.radio.frame_samples
        self._extractor_of = extractors(recording, recipe.scenario, recipe.estimator)
        lock = contextlib.nullcontext() if recording.reads_side_by_side else threading.Lock()
        self._reading: contextlib.AbstractContextManager[Any] = lock
        self._own = threading.local()

    @property
    def n_receiver(self) -> int:
        return len(self._receiver_ids)

    def rows_of(self, samples: int) -> int:
        """Return how many rows hold about so many samples."""
        return max(1, min(_MAX_ENTRY_ROWS, samples // self._n_sample))

    def measure(self, wanted: _Wanted) -> _Measured:
        """Measure rows, each receiver's in order, since its clock is followed."""
        stages, clock_ppm, n = Stopwatch(), wanted.clock_ppm.copy(), self.n_receiver
        firsts = (wanted.first + (int(i_receiver) - wanted.first) % n for i_receiver in wanted.i_receiver)
        rows_of = [np.arange(first, wanted.end, n) for first in firsts]
        row = np.concatenate(rows_of)
        found = _rows(_empty(self.recipe.scenario, ("any",), row))
        at = 0
        for k, i_receiver in enumerate(wanted.i_receiver):
            for each in rows_of[k]:
                with stages.during("read"):
                    samples = self._read(int(each))
                with stages.during("tones", 0 if isinstance(samples, LineStatus) else len(samples)):
                    frame = self._found(int(i_receiver), samples, float(clock_ppm[k]))
                for name, values in found.items():
                    values[at] = getattr(frame, name)
                clock_ppm[k] = frame.clock_ppm if np.any(frame.status == LineStatus.OK) else np.nan
                at += 1
        return _Measured(row, found, clock_ppm, stages.seconds, stages.samples)

    def _found(self, i_receiver: int, samples: Samples | LineStatus, clock_ppm: float) -> FrameTones:
        extractor = self._extractor_of(self._receiver_ids[i_receiver])
        if isinstance(samples, LineStatus):
            return FrameTones.failed(extractor.plan.n_transmitter, extractor.plan.n_tone, samples)
        return extractor.measure(samples, clock_ppm=clock_ppm)

    def _read(self, row: int) -> Samples | LineStatus:
        """Return one receiver's samples in one frame, or why there are none."""
        i_frame, i_receiver = divmod(row, self.n_receiver)
        receiver_id, start = self._receiver_ids[i_receiver], int(self.recipe.frame_start_index[i_frame])
        if receiver_id not in self.recording.receiver_ids:
            return LineStatus.NOT_RECORDED
        with self._reading:
            begin = self.recording.frame_at(receiver_id, start, self._n_sample)
            if begin is None:
                return LineStatus.GAP
            try:
                return self.recording.read(receiver_id, begin, self._n_sample, out=self._buffer())
            except GapError:  # of a part that is damaged, which is said; the rest goes on
                return LineStatus.GAP

    def _buffer(self) -> Samples:
        if not hasattr(self._own, "buffer"):
            self._own.buffer = np.empty((self._n_sample, 2), self.recording.component_dtype)
        buffer: Samples = self._own.buffer
        return buffer


def _measure_here(bench: _Bench, wanted: _Wanted) -> _Measured:
    return bench.measure(wanted)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Place:
    """What a worker needs to know to open the recording by itself."""

    paths: tuple[Path, ...]
    follow_links: bool
    fingerprint: str
    recipe: _Recipe

    @property
    def key(self) -> str:
        """Equal for equal work."""
        scenario, starts = self.recipe.scenario.to_toml(), self.recipe.frame_start_index.tobytes()
        facts: list[Any] = [
            [str(path) for path in self.paths],
            str(self.follow_links),
            self.fingerprint,
            self.recipe.estimator,
            scenario,
            starts.hex(),
        ]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Packed:
    """A place that travels with each task, and is unpacked by a worker once: a scenario takes as long as its rows."""

    key: str
    place: bytes


_benches: dict[str, _Bench] = {}
"""Of this worker, the newest alone: a recording stays open between its tasks."""
_opening = threading.Lock()


def _measure_there(packed: _Packed, wanted: _Wanted) -> _Measured:
    """Measure on a worker."""
    with _opening:
        bench = _benches.get(packed.key)
        if bench is None:
            _benches.clear()
            bench = _benches[packed.key] = _opened(pickle.loads(packed.place))
    return bench.measure(wanted)


def _opened(place: _Place) -> _Bench:
    paths = place.paths
    recording = open_recording(paths[0] if len(paths) == 1 else paths, follow_links=place.follow_links)
    if _fingerprint(recording) != place.fingerprint:
        raise RecordingError(
            f"{', '.join(map(str, paths))}: is another recording here than where the job was started; give a path that "
            "leads to the same one everywhere"
        )
    return _Bench(recording, place.recipe)
