"""What every recording offers, whatever file format lies beneath."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, Self

import numpy as np
import numpy.typing as npt

from rfpose.checks import read_only
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.recording import keys
from rfpose.recording.members import members
from rfpose.scenario import Scenario
from rfpose.shown import html_table, listed
from rfpose.truth import Truth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "COMPONENT_DTYPE",
    "FILL_VALUE",
    "STORED_DTYPE",
    "GapError",
    "IqArray",
    "Recording",
    "RecordingFormat",
    "SampleFormat",
    "WrittenFormat",
    "as_stored",
    "count_fill",
    "frame_starts",
    "merge_rows",
    "own_frames",
    "recorded_runs",
]

_log = logging.getLogger(__name__)

WrittenFormat = Literal["rfpose-iq", "digital-rf", "sigmf"]
RecordingFormat = Literal["rfpose-iq", "digital-rf", "sigmf", "wav", "raw", "gnuradio", "parts"]
SampleFormat = Literal["int16", "complex64"]
IqArray = npt.NDArray[Any]
"""(sample, 2) in-phase and quadrature: int16 counts or float32."""
IndexArray = npt.NDArray[np.int64]

COMPONENT_DTYPE: Final[Mapping[str, np.dtype[Any]]] = {
    "int16": np.dtype("<i2"),
    "complex64": np.dtype("<f4"),
}
STORED_DTYPE: Final[Mapping[str, np.dtype[Any]]] = {
    "int16": np.dtype([(keys.REAL, "<i2"), (keys.IMAG, "<i2")]),
    "complex64": np.dtype("<c8"),  # h5py's name for the compound of float32 r and i
}
FILL_VALUE: Final[Mapping[str, float]] = {"int16": -(2**15), "complex64": float("nan")}
"""What stands in I and in Q where a file has room for a sample that was never written; Digital RF's choice too."""

_FRAME_PER_SHIFT: Final = 4
"""A receiver's own frame lies at most this part of a frame beside the common one: much of it is the same stretch of
time, in which the mirrors are taken to stand still."""

_FEW_ROWS: Final = 4


class GapError(RecordingError):
    """Samples were asked for that the receiver did not record."""


def as_stored(iq: IqArray, sample_format: str) -> npt.NDArray[Any]:
    """Return a (sample,) view of ``iq`` (sample, 2) of the type that files hold; no copy is made."""
    return iq.view(STORED_DTYPE[sample_format]).reshape(-1)


def count_fill(iq: IqArray) -> int:
    """Count samples of ``iq`` (sample, 2) whose I and Q both hold the fill value of their type.

    A recorder that fills holes instead of leaving gaps shows them this way. Int16 counts of −32768 in both
    components are taken for fill, so a digitiser should clip at ±32767.
    """
    if iq.dtype.kind == "f":
        return int(np.count_nonzero(np.isnan(iq[:, 0]) & np.isnan(iq[:, 1])))
    lowest = np.iinfo(iq.dtype).min
    return int(np.count_nonzero((iq[:, 0] == lowest) & (iq[:, 1] == lowest)))


class Recording(ABC):
    """IQ of several receivers on one sample grid, read by absolute sample index.

    A sample's index counts from the Unix epoch at the nominal sample rate, so that sample ``k`` was taken at
    ``k / sample_rate`` seconds of the receivers' common time. Open one with `open_recording`; use it as a
    context manager. Nothing is held in memory but the table of blocks.

    Attributes
    ----------
    path
        What was opened.
    format
        ``"rfpose-iq"``, ``"digital-rf"``, ``"sigmf"``, ``"wav"``, ``"raw"``, ``"gnuradio"``; or ``"parts"``, see
        `open_recording`.
    receiver_ids
        Receivers in file order.
    sample_rate
        Exact rate [1/s].
    centre_frequency_hz
        Radio frequency at baseband zero [Hz]; None when the file does not say.
    tunings
        Radio frequency at baseband zero of receivers that are tuned otherwise, by their names [Hz]; see `tuning_of`.
    sample_format
        ``"int16"`` (`read` gives int16 counts) or ``"complex64"`` (`read` gives float32).
    full_scale
        Largest magnitude that an I or Q component can take; infinite when there is no such limit.
    scenario
        The site: as given by the caller, else as found in the recording, else None.
    truth
        What was simulated; None for a real recording.
    provenance
        How the recording came about, free text by name.
    doubts
        What the file says that cannot be right, or does not say and should, by receiver; one line each. `describe`
        calls these problems.
    notes
        What is wrong with the recording as a whole, such as parts that could not be read; one line each.
    names
        What was given to open it: more than one name where it is made of parts.
    time_known
        Whether indices count from the Unix epoch; else the file has no time, and they count from its start.
    """

    grows: ClassVar[bool] = False
    """Whether `refresh` may find more than there was when it was opened."""
    reads_side_by_side: ClassVar[bool] = False
    """Whether several threads may `read` at once; not every format's library can be called so."""

    def __init__(
        self,
        path: Path,
        *,
        format: RecordingFormat,
        receiver_ids: tuple[str, ...],
        sample_rate: Fraction,
        centre_frequency_hz: float | None,
        sample_format: SampleFormat,
        full_scale: float,
        scenario: Scenario | None = None,
        truth: Truth | None = None,
        provenance: Mapping[str, str] | None = None,
    ) -> None:
        self.path = path
        self.format: RecordingFormat = format
        self.receiver_ids = receiver_ids
        self.sample_rate = sample_rate
        self.centre_frequency_hz = centre_frequency_hz
        self.tunings: dict[str, float] = {}
        self.sample_format: SampleFormat = sample_format
        self.full_scale = full_scale
        self.scenario = scenario
        self.truth = truth
        self.provenance: dict[str, str] = dict(provenance or {})
        self.doubts: dict[str, list[str]] = {}
        self.notes: list[str] = []
        self.names: tuple[str, ...] = (path.name,)
        self.time_known = True
        self._segments: dict[str, IndexArray] = {}
        self._blocks: dict[str, IndexArray] = {}

    # -- to be supplied by each format -------------------------------------------------------------------

    @abstractmethod
    def _load_segments(self, receiver_id: str) -> IndexArray:
        """Return (segment, 2) rows [start index, count], sorted, not overlapping, as the file stores them."""

    @abstractmethod
    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        """Fill ``out`` (sample, 2) with one segment's samples from its ``skip``-th on."""

    def close(self) -> None:  # noqa: B027  (a format that holds nothing open has nothing to do)
        """Release the files. The recording cannot be read afterwards."""

    def refresh(self) -> None:  # noqa: B027  (most do not grow)
        """Look for what was recorded since it was opened; only some formats can be read while they grow."""

    def forget(self, before_index: int) -> None:  # noqa: B027
        """Let go of what ends before a sample and will not be read any more, so that what grows stays small here."""

    # -- what callers use --------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {str(self.path)!r}, {len(self.receiver_ids)} receivers>"

    def _repr_html_(self) -> str:
        lasts = sum(int(count) for name in self.receiver_ids for count in self.blocks(name)[:, 1])
        tuned = "unknown" if self.centre_frequency_hz is None else f"{1e-6 * self.centre_frequency_hz:g} MHz"
        rows = [
            ["receivers", listed(self.receiver_ids)],
            ["sample rate", f"{1e-6 * float(self.sample_rate):g} MHz, {self.sample_format}"],
            ["radio frequency", tuned],
            ["samples of all receivers", f"{lasts:,}"],
            ["scenario", "none" if self.scenario is None else self.scenario.name],
            ["truth", "none" if self.truth is None else "of a simulation"],
        ]
        return html_table(repr(self)[1:-1], ["", ""], rows)

    def files(self) -> list[Path]:
        """Return what it is read from: nothing else may be written there."""
        return [self.path, *members(self.path)]

    def save(
        self,
        path: str | Path,
        *,
        format: str = "rfpose-iq",
        force: bool = False,
        compress: str | None = None,
        on_progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Write the recording in one of the known formats.

        Parameters
        ----------
        path
            File (rfpose-iq) or directory (the others) to make.
        format, compress, on_progress
            As for `rfpose.recording.convert`.
        force
            Overwrite what exists.

        Raises
        ------
        InvalidInputError
            Unknown ``format``.
        RecordingError
            It exists, or cannot be written.
        """
        from rfpose.recording.conversion import convert

        convert(self, path, format=format, overwrite=force, compress=compress, on_progress=on_progress)

    def plot(self, *, receiver_id: str | None = None) -> Figure:
        """Draw the spectrum of one receiver's first whole frame, by default the first's, with every line marked.

        Raises
        ------
        InvalidInputError
            No scenario that says where the lines are, no such receiver, or no whole frame.
        RecordingError
            The recording is damaged.
        """
        from rfpose.recording.picture import draw_spectrum

        return draw_spectrum(self, receiver_id=receiver_id)

    def plot_coverage(self) -> Figure:
        """Draw who recorded when: a line a receiver, each part of the recording in its colour.

        Raises
        ------
        RecordingError
            The recording is damaged, or holds no samples.
        """
        from rfpose.recording.picture import draw_coverage

        return draw_coverage(self)

    @property
    def fill_value(self) -> float:
        """What I and Q both hold where the file has room for a sample that was never written; see `count_fill`."""
        return FILL_VALUE[self.sample_format]

    @property
    def component_dtype(self) -> np.dtype[Any]:
        """Type of one I or Q component as `read` returns it."""
        return COMPONENT_DTYPE[self.sample_format]

    def blocks(self, receiver_id: str) -> IndexArray:
        """Return the stretches that a receiver recorded without a gap.

        Returns
        -------
        (block, 2)
            Rows [start index since the Unix epoch, count], ascending, with at least one lost sample between.

        Raises
        ------
        InvalidInputError
            The recording has no such receiver.
        RecordingError
            The file is damaged.
        """
        if receiver_id not in self._blocks:
            self._blocks[receiver_id] = read_only(merge_rows(self._segments_of(receiver_id)))
        return self._blocks[receiver_id]

    def tuning_of(self, receiver_id: str) -> float | None:
        """Return the radio frequency at baseband zero of a receiver [Hz]; None when the file does not say."""
        return self.tunings.get(receiver_id, self.centre_frequency_hz)

    def reached(self) -> dict[str, int]:
        """Return by receiver, of those that recorded anything, the sample up to which it is recorded.

        Raises
        ------
        RecordingError
            The file is damaged.
        """
        rows = {name: self.blocks(name) for name in self.receiver_ids}
        return {name: int(blocks[-1, 0]) + int(blocks[-1, 1]) for name, blocks in rows.items() if len(blocks)}

    def covers(self, receiver_id: str, start_index: int, count: int) -> bool:
        """Tell whether a receiver recorded all of ``count`` samples from ``start_index`` on."""
        return self._recorded_from(receiver_id, start_index) >= count

    def frame_at(self, receiver_id: str, start_index: int, frame_samples: int) -> int | None:
        """Return where a receiver's own frame begins that stands for the common one, or None if it has none.

        Receivers that are triggered start a few samples apart, and a burst of just one frame then never covers the
        common grid. Its phases at its own frame's centre do as well: only differences between transmitters are
        used, and a whole number of samples moves all of one receiver's phases alike.

        Parameters
        ----------
        receiver_id
            One of `receiver_ids`.
        start_index
            First sample of the common frame; see `frame_starts`.
        frame_samples
            Samples in a frame.

        Returns
        -------
        int or None
            ``start_index`` where the receiver recorded all of the frame; else the first sample of the nearest
            frame within one of its blocks, at most a quarter of a frame away.
        """
        if self.covers(receiver_id, start_index, frame_samples):
            return start_index
        begin = int(own_frames(self.blocks(receiver_id), np.array([start_index]), frame_samples)[0])
        return None if begin < 0 else begin

    def read(self, receiver_id: str, start_index: int, count: int, out: IqArray | None = None) -> IqArray:
        """Read samples by absolute index.

        Parameters
        ----------
        receiver_id
            One of `receiver_ids`.
        start_index
            First sample, counted from the Unix epoch.
        count
            Number of samples.
        out : (sample, 2)
            Buffer to fill: C-contiguous, at least ``count`` rows, of `component_dtype`.

        Returns
        -------
        (sample, 2)
            I and Q; the first ``count`` rows of ``out`` when it was given.

        Raises
        ------
        GapError
            A sample in the range was not recorded.
        InvalidInputError
            No such receiver, ``count`` below one, or an unsuitable ``out``.
        RecordingError
            The file is damaged.
        """
        if count < 1:
            raise InvalidInputError(f"`count` must be one or more, got {count}")
        target = self._buffer(count, out)
        recorded = self._recorded_from(receiver_id, start_index)
        if recorded < count:
            raise GapError(
                f"{self.path}: receiver `{receiver_id}` did not record sample {start_index + recorded} of the "
                f"{count} from {start_index} on; ask `covers` first and leave such a frame out"
            )
        segments = self._segments_of(receiver_id)
        i = int(np.searchsorted(segments[:, 0], start_index, side="right")) - 1
        done = 0
        while done < count:
            skip = start_index + done - int(segments[i, 0])
            take = min(count - done, int(segments[i, 1]) - skip)
            self._read_segment(receiver_id, i, skip, target[done : done + take])
            done += take
            i += 1
        return target

    # -- helpers -----------------------------------------------------------------------------------------

    def _segments_of(self, receiver_id: str) -> IndexArray:
        if receiver_id not in self._segments:
            if receiver_id not in self.receiver_ids:
                names = ", ".join(self.receiver_ids[:8]) + (", …" if len(self.receiver_ids) > 8 else "")
                raise InvalidInputError(f"`receiver_id` must be one of {names}; got {receiver_id!r} for {self.path}")
            self._segments[receiver_id] = self._load_segments(receiver_id)
        return self._segments[receiver_id]

    def _recorded_from(self, receiver_id: str, start_index: int) -> int:
        """Count the samples recorded without a gap from ``start_index`` on; zero if that one is missing."""
        blocks = self.blocks(receiver_id)
        i = int(np.searchsorted(blocks[:, 0], start_index, side="right")) - 1
        if i < 0:
            return 0
        return max(0, int(blocks[i, 0]) + int(blocks[i, 1]) - start_index)

    def _buffer(self, count: int, out: IqArray | None) -> IqArray:
        dtype = self.component_dtype
        if out is None:
            return np.empty((count, 2), dtype)
        if out.dtype != dtype or out.ndim != 2 or out.shape[1] != 2 or out.shape[0] < count:
            raise InvalidInputError(
                f"`out` must be {dtype.name} of shape ({count} or more, 2), got {out.dtype} of shape {out.shape}"
            )
        if not (out.flags.c_contiguous and out.flags.writeable):
            raise InvalidInputError("`out` must be C-contiguous and writeable")
        return out[:count]


def recorded_runs(recording: Recording, receiver_ids: Sequence[str] | None = None) -> IndexArray:
    """Return the stretches in which at least one receiver (of those named) recorded: (run, 2) [start index, count]."""
    names = recording.receiver_ids if receiver_ids is None else receiver_ids
    rows = np.concatenate([np.empty((0, 2), np.int64), *(recording.blocks(name) for name in names)])
    return merge_rows(rows[np.argsort(rows[:, 0], kind="stable")])


def frame_starts(recording: Recording, frame_samples: int) -> IndexArray:
    """Lay one grid of frames over a recording, the same for all receivers.

    Frames lie back to back in each stretch in which at least one receiver recorded. They begin where the receivers
    together have most frames without a loss, at the earliest such place: at the start of the stretch if all started
    with it, else where most of them have started. What is left at the ends of a stretch is not used. A receiver that
    misses part of a frame is found with `Recording.frame_at`.

    Parameters
    ----------
    recording
        An open recording.
    frame_samples
        Samples in a frame, one or more.

    Returns
    -------
    (frame,)
        Index of each frame's first sample, ascending.

    Raises
    ------
    InvalidInputError
        ``frame_samples`` is below one.
    """
    if frame_samples < 1:
        raise InvalidInputError(f"`frame_samples` must be one or more, got {frame_samples}")
    runs = recorded_runs(recording)
    offset = _best_offsets(recording, runs, frame_samples)
    n_frame, left_over = np.divmod(runs[:, 1] - offset, frame_samples)
    left_over = left_over + offset
    if left_over.any():
        _log.info(
            "%s: %d samples at the ends of %d of %d stretches are shorter than a frame of %d and are not used",
            recording.path, left_over.sum(), np.count_nonzero(left_over), len(runs), frame_samples,
        )  # fmt: skip
    first_frame = np.repeat(np.cumsum(n_frame) - n_frame, n_frame)
    within_run = np.arange(n_frame.sum(), dtype=np.int64) - first_frame
    starts: IndexArray = np.repeat(runs[:, 0] + offset, n_frame) + within_run * frame_samples
    return starts


def own_frames(blocks: IndexArray, starts: IndexArray, frame_samples: int) -> IndexArray:
    """Return (frame,) where a receiver's own frames begin, −1: it has none; see `Recording.frame_at`.

    Parameters
    ----------
    blocks : (block, 2)
        As `Recording.blocks` gives them.
    starts : (frame,)
        First sample of each common frame.
    frame_samples
        Samples in a frame.
    """
    blocks = blocks[blocks[:, 1] >= frame_samples]
    if not len(blocks):
        return np.full(len(starts), -1, np.int64)
    before = np.searchsorted(blocks[:, 0], starts, side="right") - 1
    # none lies nearer than in the block that began last or in the next to begin
    near = np.clip(np.stack([before, before + 1]), 0, len(blocks) - 1)
    begin = np.clip(starts, blocks[near, 0], blocks[near].sum(axis=2) - frame_samples)
    shift = np.abs(begin - starts)
    nearest = np.argmin(shift, axis=0)[None]
    begin, shift = (np.take_along_axis(rows, nearest, 0)[0] for rows in (begin, shift))
    found: IndexArray = np.where(shift <= frame_samples // _FRAME_PER_SHIFT, begin, -1)
    return found


def _best_offsets(recording: Recording, runs: IndexArray, frame_samples: int) -> IndexArray:
    """Return (run,) how many samples after the start of each run its frames begin, less than a frame.

    As the grid moves on from the run's start, a block gains a frame when its own start is reached, and loses one
    when its end no longer holds the last: two steps a block, so one sorted walk finds the best place.
    """
    blocks = np.concatenate([recording.blocks(name) for name in recording.receiver_ids])
    blocks = blocks[blocks[:, 1] >= frame_samples]
    i_run = np.searchsorted(runs[:, 0], blocks[:, 0], side="right") - 1
    gained = (blocks[:, 0] - runs[i_run, 0]) % frame_samples
    lost = (blocks[:, 0] + blocks[:, 1] - runs[i_run, 0]) % frame_samples + 1
    run = np.concatenate([np.arange(len(runs)), i_run[gained > 0], i_run[lost < frame_samples]])
    place = np.concatenate([np.zeros(len(runs), np.int64), gained[gained > 0], lost[lost < frame_samples]])
    n_step = len(runs), int(np.count_nonzero(gained)), int(np.count_nonzero(lost < frame_samples))
    step = np.repeat(np.array([0, 1, -1]), n_step)
    order = np.lexsort((place, run))
    run, place, total = run[order], place[order], np.cumsum(step[order])
    # steps at one place count together: what holds there is the total after the last of them
    is_last = np.concatenate([(run[1:] != run[:-1]) | (place[1:] != place[:-1]), [True]])[: len(run)]
    run, place, total = run[is_last], place[is_last], total[is_last]
    best_first = np.lexsort((place, -total, run))
    _, first = np.unique(run[best_first], return_index=True)
    offset: IndexArray = place[best_first][first]
    return offset


def merge_rows(rows: IndexArray) -> IndexArray:
    """Join rows [start, count], sorted by start, that touch or overlap."""
    if len(rows) == 0:
        return np.empty((0, 2), np.int64)
    if len(rows) <= _FEW_ROWS:
        return _merge_few(rows)
    start = rows[:, 0]
    reached = np.maximum.accumulate(start + rows[:, 1])
    opens = np.concatenate([[True], start[1:] > reached[:-1]])
    closes = np.concatenate([opens[1:], [True]])
    return np.stack([start[opens], reached[closes] - start[opens]], axis=1)


def _merge_few(rows: IndexArray) -> IndexArray:
    """Do what `merge_rows` does for so few rows that numpy takes longer: of hundreds of receivers each has one."""
    merged: list[list[int]] = []
    for start, count in rows.tolist():
        if merged and start <= sum(merged[-1]):
            merged[-1][1] = max(merged[-1][1], start + count - merged[-1][0])
        else:
            merged.append([start, count])
    return np.array(merged, np.int64)
