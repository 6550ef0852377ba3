"""Files that one writer lays out alike: what was found out of the first need not be found out of the next."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from rfpose.errors import RecordingError
from rfpose.recording.base import IndexArray, IqArray, Recording, as_stored
from rfpose.recording.stored import StoredSamples, read_at
from rfpose.scenario import MAX_SAMPLE_INDEX

__all__ = ["AlikeRecording", "Layout"]


class Layout:
    """How a file is laid out that was opened, checked and read in whole but for its samples.

    A file of the same size in which all other bytes are the same, but for when the samples were taken, holds what the
    first one holds at the same places.

    Parameters
    ----------
    recording
        What the file holds.
    samples
        Where each receiver's samples lie.
    tables
        Where each receiver's table of blocks lies [byte], and that table, (block, 3) rows [start, count, offset].
    free
        Places and lengths of what may differ and is not asked for [byte].
    file_number
        Descriptor of the open file.

    Raises
    ------
    OSError
        The file cannot be read.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        samples: Mapping[str, StoredSamples],
        tables: Mapping[str, tuple[int, IndexArray]],
        free: list[tuple[int, int]],
        file_number: int,
    ) -> None:
        self.recording = recording
        self.samples = dict(samples)
        self.n_byte = os.fstat(file_number).st_size
        self._kept = _complement(samples.values(), self.n_byte)
        self._free = [slice(self._place(begin), self._place(begin) + count) for begin, count in free]
        self._table = np.concatenate([self._place(begin) + np.arange(rows.nbytes) for begin, rows in tables.values()])
        self._rows = np.concatenate([rows for _, rows in tables.values()])
        ends = np.cumsum([len(rows) for _, rows in tables.values()]).tolist()
        self.row_of = {name: slice(end - len(tables[name][1]), end) for name, end in zip(tables, ends, strict=True)}
        owner = np.repeat(np.arange(len(tables)), [len(rows) for _, rows in tables.values()])
        self._follows = owner[1:] == owner[:-1]
        self._fixed = self._split(file_number)[1]

    @property
    def offset(self) -> IndexArray:
        """(row,) first sample of each block among the stored ones, in the order of `row_of`."""
        offset: IndexArray = self._rows[:, 2]
        return offset

    def rows_of(self, file_number: int) -> IndexArray | None:
        """Return (row, 2) the blocks [start, count] of an open file, of all receivers; None: it is laid out otherwise.

        Raises
        ------
        OSError
            The file cannot be read.
        """
        status = os.fstat(file_number)
        if not stat.S_ISREG(status.st_mode) or status.st_size != self.n_byte:
            return None
        rows, fixed = self._split(file_number)
        if fixed != self._fixed or not np.array_equal(rows[:, 1:], self._rows[:, 1:]):
            return None
        start, end = rows[:, 0], rows[:, 0] + rows[:, 1]
        blocks: IndexArray = rows[:, :2]
        is_valid = ((start >= 0) & (start <= MAX_SAMPLE_INDEX)).all()
        return blocks if is_valid and (start[1:] >= end[:-1])[self._follows].all() else None

    def _place(self, offset: int) -> int:
        """Return where a byte of the file stands among those that are not samples."""
        i = int(np.searchsorted(self._kept[:, 0], offset, side="right")) - 1
        return int(self._kept[:i, 1].sum()) + offset - int(self._kept[i, 0])

    def _split(self, file_number: int) -> tuple[IndexArray, bytes]:
        """Return the tables of an open file, and all bytes that are neither these nor samples nor free."""
        kept = np.empty(int(self._kept[:, 1].sum()), np.uint8)
        view, done = memoryview(kept.data), 0
        for begin, count in self._kept.tolist():
            read_at(file_number, begin, view[done : done + count])
            done += count
        rows: IndexArray = kept[self._table].view("<i8").reshape(-1, 3)
        kept[self._table] = 0
        for place in self._free:
            kept[place] = 0
        return rows, kept.tobytes()


def _complement(samples: Iterable[StoredSamples], n_byte: int) -> npt.NDArray[np.int64]:
    """(place, 2) where a file holds something else than samples, and how much [byte]."""
    pieces = [np.stack([each.offset, np.full_like(each.offset, each.piece_bytes)], axis=1) for each in samples]
    taken = np.concatenate(pieces)
    taken = taken[np.argsort(taken[:, 0])]
    begin = np.append(0, taken.sum(axis=1))
    count = np.append(taken[:, 0], n_byte) - begin
    if (count < 0).any():
        raise OSError("samples of two receivers lie at the same place")
    kept: npt.NDArray[np.int64] = np.stack([begin, count], axis=1)[count > 0]
    return kept


class AlikeRecording(Recording):
    """A file that is laid out as another; see `Layout`."""

    reads_side_by_side = True

    def __init__(self, path: Path, layout: Layout, file_number: int, rows: IndexArray) -> None:
        like = layout.recording
        super().__init__(
            path,
            format="rfpose-iq",
            receiver_ids=like.receiver_ids,
            sample_rate=like.sample_rate,
            centre_frequency_hz=like.centre_frequency_hz,
            sample_format=like.sample_format,
            full_scale=like.full_scale,
            provenance=like.provenance,
        )
        self._layout, self._file_number, self._rows = layout, file_number, rows

    @classmethod
    def opened(cls, path: Path, layout: Layout) -> Self | None:
        """Open a file; None: it is laid out otherwise, or cannot be read, which who opens it in full will tell."""
        try:
            file_number = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError:
            return None
        try:
            rows = layout.rows_of(file_number)
        except OSError:
            rows = None
        if rows is None:
            os.close(file_number)
            return None
        return cls(path, layout, file_number, rows)

    def close(self) -> None:
        """Close the file."""
        number, self._file_number = self._file_number, -1
        if number >= 0:
            os.close(number)

    def _load_segments(self, receiver_id: str) -> IndexArray:
        return self._rows[self._layout.row_of[receiver_id]]

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        stored = self._layout.samples[receiver_id]
        target = as_stored(out, self.sample_format)
        first = int(self._layout.offset[self._layout.row_of[receiver_id]][i_segment]) + skip
        try:
            stored.read(self._file_number, first * target.itemsize, out)
        except OSError as error:
            raise RecordingError(
                f"{self.path}: cannot read samples of `{receiver_id}` at {first}: {error}; copy the file again or "
                "check the disk"
            ) from error
