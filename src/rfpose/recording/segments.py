"""A directory in which a recorder puts one closed rfpose-iq file after the other, read while it grows."""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rfpose.errors import RecordingError, ScenarioError
from rfpose.recording.alike import AlikeRecording, Layout
from rfpose.recording.base import GapError, IndexArray, IqArray, Recording
from rfpose.recording.manifest import MANIFEST_FILE
from rfpose.recording.native import NativeRecording
from rfpose.recording.opening import open_recording
from rfpose.scenario import Scenario

__all__ = ["open_growing"]

_log = logging.getLogger(__name__)

_SETTLED_S: Final = 2.0
"""A file that cannot be read and did not change for so long is damaged; before that it may be on its way."""
_LAYOUTS: Final = 4
"""Of so many files it is remembered how they are laid out: of a whole frame, and of some with losses."""


def open_growing(path: str | Path, *, scenario: Scenario | None = None, follow_links: bool = False) -> Recording | None:
    """Open a recording that may still grow; what came since, `Recording.refresh` takes in.

    Parameters
    ----------
    path
        A Digital RF directory, or a directory of rfpose-iq files that are complete when they appear and whose names
        sort in order of time. Any other recording is opened as it is, and does not grow.
    scenario, follow_links
        As for `rfpose.recording.open_recording`.

    Returns
    -------
    Recording or None
        None: there is nothing yet.

    Raises
    ------
    RecordingError
        What is there is damaged, or no recording.
    """
    path = Path(path)
    if not path.exists():
        return None
    if not path.is_dir():
        return open_recording(path, scenario=scenario, follow_links=follow_links)
    if any(path.glob("*/drf_properties.h5")):
        recording = open_recording(path, scenario=scenario, follow_links=follow_links)
        if all(len(recording.blocks(name)) == 0 for name in recording.receiver_ids):
            recording.close()
            return None
        return recording
    if (path / MANIFEST_FILE).is_file() or any(path.glob("*.sigmf-meta")):
        return open_recording(path, scenario=scenario, follow_links=follow_links)
    return SegmentsRecording.begun(path, scenario=scenario, follow_links=follow_links)


@dataclass(frozen=True, slots=True)
class _Segment:
    """One closed file."""

    recording: Recording
    end: int
    """Of its last receiver."""
    blocks: dict[str, IndexArray]
    """Of each receiver."""


class SegmentsRecording(Recording):
    """Closed files of one directory that follow each other in time. Open it through `open_growing`.

    A file that is damaged, unlike the first, or goes back in time is left out and told.
    """

    grows = True
    reads_side_by_side = True

    def __init__(self, path: Path, first: NativeRecording, *, scenario: Scenario | None, follow_links: bool) -> None:
        super().__init__(
            path,
            format="parts",
            receiver_ids=first.receiver_ids,
            sample_rate=first.sample_rate,
            centre_frequency_hz=first.centre_frequency_hz,
            sample_format=first.sample_format,
            full_scale=first.full_scale,
            scenario=scenario if scenario is not None else first.scenario,
            truth=first.truth,
        )
        self._follow_links = follow_links
        self._last_name = ""
        self._kept: deque[_Segment] = deque()
        self._reached: dict[str, int] = {}
        self._rows: dict[str, list[tuple[_Segment, int]]] = {}
        self._layouts: dict[int, Layout] = {}
        """Of files that were opened, by their size."""
        self._unlike_any: NativeRecording | None = None
        """What was opened last in full, of which the layout is not known yet."""
        self._take_in(first)

    @classmethod
    def begun(cls, path: Path, *, scenario: Scenario | None, follow_links: bool) -> SegmentsRecording | None:
        """Open a directory from its first file that can be read; None: there is none yet."""
        for name in _names_after(path, ""):
            first = _opened(path / name, scenario, follow_links=follow_links)
            if first is None:
                return None
            if isinstance(first, NativeRecording):
                found = cls(path, first, scenario=scenario, follow_links=follow_links)
                found.refresh()
                return found
        return None

    def close(self) -> None:
        """Close the files that are open."""
        while self._kept:
            self._kept.pop().recording.close()

    def refresh(self) -> None:
        """Take in files that appeared since."""
        names = _names_after(self.path, self._last_name)
        if not names:
            self._learn()
        for name in names:
            self._learn()
            found = self._open_next(self.path / name)
            if found is None:  # still on its way, and those after it wait
                return
            self._last_name = name
            if isinstance(found, Recording):
                self._take_in(found)

    def _learn(self) -> None:
        """Find out how the file is laid out that was opened last; for a moment in which nothing waits."""
        if self._unlike_any is None:
            return
        layout, self._unlike_any = self._unlike_any.layout(), None
        if layout is not None:
            self._layouts.pop(layout.n_byte, None)
            self._layouts[layout.n_byte] = layout
            if len(self._layouts) > _LAYOUTS:
                del self._layouts[next(iter(self._layouts))]

    def _open_next(self, path: Path) -> Recording | bool | None:
        """Open a file, as `_opened`; one that is like another in no time."""
        with contextlib.suppress(OSError):
            layout = self._layouts.get(path.stat().st_size)
            found = None if layout is None else AlikeRecording.opened(path, layout)
            if found is not None:
                return found
        return _opened(path, self.scenario, follow_links=self._follow_links)

    def forget(self, before_index: int) -> None:
        """Close files that end before a sample."""
        while len(self._kept) > 1 and self._kept[0].end <= before_index:
            old = self._kept.popleft().recording
            if old is self._unlike_any:
                self._learn()
            old.close()
            self._lay_out()

    def reached(self) -> dict[str, int]:
        """Return by receiver the sample up to which it was recorded, in files that were let go of, too."""
        return dict(self._reached)

    def _take_in(self, found: Recording) -> None:
        self._last_name = found.path.name
        blocks = {name: found.blocks(name) for name in found.receiver_ids}
        wrong = self._unlike(found) or next(
            (
                f"goes back in time: receiver `{name}` is recorded up to sample {self._reached[name]}, and it begins "
                f"with {int(rows[0, 0])}"
                for name, rows in blocks.items()
                if len(rows) and rows[0, 0] < self._reached.get(name, 0)
            ),
            None,
        )
        if wrong is not None:
            self.notes = [*self.notes[-99:], f"{found.path.name} is left out: {wrong}"]
            _log.warning("%s: %s; it is left out", found.path, wrong)
            found.close()
            return
        reached = {name: _end(rows) for name, rows in blocks.items() if len(rows)}
        self._reached.update(reached)
        if self.receiver_ids != found.receiver_ids:
            self.receiver_ids = tuple(dict.fromkeys((*self.receiver_ids, *found.receiver_ids)))
        self._kept.append(_Segment(found, max(reached.values(), default=0), blocks))
        if isinstance(found, NativeRecording):
            self._unlike_any = found
        self._lay_out()

    def _unlike(self, found: Recording) -> str | None:
        for what in ("sample_rate", "centre_frequency_hz", "sample_format", "full_scale"):
            mine, theirs = getattr(self, what), getattr(found, what)
            if mine != theirs:
                return f"its {what.replace('_', ' ')} is {theirs}, that of the files before {mine}"
        return None

    def _lay_out(self) -> None:
        self._segments.clear()
        self._blocks.clear()
        self._rows.clear()

    def _load_segments(self, receiver_id: str) -> IndexArray:
        rows = [np.empty((0, 2), np.int64)]
        where: list[tuple[_Segment, int]] = []
        for segment in self._kept:
            found = segment.blocks.get(receiver_id)
            if found is not None:
                rows.append(found)
                where += [(segment, start) for start in found[:, 0].tolist()]
        self._rows[receiver_id] = where
        return rows[-1] if len(rows) == 2 else np.concatenate(rows)

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        segment, start = self._rows[receiver_id][i_segment]
        try:
            segment.recording.read(receiver_id, start + skip, len(out), out=out)
        except RecordingError as error:
            self.notes = [*self.notes[-99:], str(error)]
            _log.warning("%s; what cannot be read is left out", error)
            raise GapError(str(error)) from error


def _end(rows: IndexArray) -> int:
    """Return where the last of some blocks ends."""
    return int(rows[-1, 0]) + int(rows[-1, 1])


def _names_after(path: Path, name: str) -> list[str]:
    """Return files of a directory whose names come after one, in order; a recorder's hidden ones are not complete."""
    try:
        return sorted(each for each in os.listdir(path) if each > name and each.endswith(".h5") and each[0] != ".")
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: is gone; the recording was removed while it was followed") from error


def _opened(path: Path, scenario: Scenario | None, *, follow_links: bool) -> NativeRecording | bool | None:
    """Open a file; None: it may still be on its way, False: it is damaged, which is told."""
    try:
        return NativeRecording(path, scenario=scenario, follow_links=follow_links)
    except (RecordingError, ScenarioError) as error:
        try:
            age_s = time.time() - path.stat().st_mtime
        except OSError:  # gone already
            return False
        if age_s < _SETTLED_S:
            return None
        _log.warning("%s; it is left out", error)
        return False
