"""A result that grows: frames as a journal, which others read while it is written.

The directory ``RESULT.partial`` holds closed files, each with all columns of some frames. A file is there in whole or
not at all, so that a reader needs no lock, and neither a killed writer nor a full disk can damage what was written.
"""

from __future__ import annotations

import functools
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.dsp import FrameTones, TonePhases
from rfpose.errors import RecordingError, RfposeError
from rfpose.interruption import held_back
from rfpose.kinds import LIVE_SCENARIO, is_live, read_key
from rfpose.pipeline.formats.journal import Entry, Journal, entries_in, partial_of, read_entry
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import KEYS, columns_of, open_result, result_of
from rfpose.scenario import Scenario, parse_scenario

__all__ = ["LiveResult", "ResultFollower", "n_frame_in", "open_live", "probe_in"]

_PROBE = "first frame"
_SETTING = "setting "
_DAMAGES = (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, RfposeError)
_TRIES = 3
_MERGED = 64
"""Files of one frame that become one."""
_MERGED_BYTES = 2**23
"""Or fewer, where they are as large together."""


def probe_in(directory: str | Path) -> str | None:
    """Return by what the recording was told from others whose frames are in a directory; None: there are none."""
    return (read_key(Path(directory)) or {}).get(_PROBE)


class LiveResult:
    """Writes a result frame by frame.

    Parameters
    ----------
    directory
        ``RESULT.partial``; made if absent. Frames of the same job that are there already are kept.
    scenario
        The site as it is processed.
    settings
        As of `Result`.
    probe
        Tells the recording from others, see `probe_in`.
    restart
        Discard frames of another job instead of refusing.

    Raises
    ------
    RecordingError
        The directory holds the work of another job, or cannot be read or written.
    """

    def __init__(
        self, directory: Path, scenario: Scenario, settings: Mapping[str, str], *, probe: str, restart: bool
    ) -> None:
        key = {
            LIVE_SCENARIO: scenario.to_toml(),
            _PROBE: probe,
            **{f"{_SETTING}{name}": text for name, text in settings.items()},
        }
        self.directory = directory
        self._scenario = scenario
        self._journal = Journal(directory, key, restart=restart)
        found = entries_in(directory)
        self.n_frame = found[-1][1] if found else 0
        self._single = [entry for entry in found if entry[1] - entry[0] == 1][-_MERGED:]
        self._drop_overtaken(found)

    def _drop_overtaken(self, found: list[tuple[int, int, Path]]) -> None:
        """Remove what a killed job left of files that had become one, and what follows a gap."""
        used = {path for _, _, path in found}
        for path in self.directory.glob("rows-*.npz"):
            if path not in used:
                path.unlink()

    def append(self, result: Result) -> None:
        """Add the frames of a result.

        Raises
        ------
        RecordingError
            They cannot be written; those before stay.
        """
        end = self.n_frame + len(result.frame_start_index)
        arrays = {path: values for path, (_, values) in columns_of(result).items() if not path.startswith("truth/")}
        with held_back():
            self._journal.append(self.n_frame, end, arrays)
            self._single.append((self.n_frame, end, self.directory / f"rows-{self.n_frame:012d}-{end:012d}.npz"))
            self.n_frame = end

    def tidy(self) -> None:
        """Make one file of many small ones, if there are; for a moment in which nothing waits."""
        size = sum(path.stat().st_size for _, _, path in self._single)
        if len(self._single) < _MERGED and (size < _MERGED_BYTES or len(self._single) < 2):
            return
        arrays = _joined([read_entry(path) for _, _, path in self._single])
        with held_back():
            self._journal.merge(self._single, arrays)
            self._single.clear()

    def tones(self, first_frame: int = 0) -> TonePhases:
        """Return the phases of frames from one on."""
        names = [*(f"tones/{name}" for name in FrameTones.__dataclass_fields__), "frames/start_index"]
        parts = [
            {name: arrays[name] for name in names} for arrays in _frames_from(self.directory, first_frame, self.n_frame)
        ]
        arrays = _joined(parts)
        site = self._scenario
        starts = arrays.pop("frames/start_index")
        return TonePhases(
            receiver_ids=site.receiver_ids,
            transmitter_ids=site.transmitter_ids,
            tone_hz=site.tone_hz,
            frame_start_index=starts,
            **{name.partition("/")[2]: values for name, values in arrays.items()},
        )

    def remove(self) -> None:
        """Delete it: the result is complete elsewhere."""
        self._journal.remove()


def open_live(directory: str | Path, first_frame: int = 0) -> Result:
    """Read the frames so far of a result that is being made.

    Parameters
    ----------
    directory
        ``RESULT.partial`` of `rfpose process --follow`.
    first_frame
        Leave out the frames before.

    Raises
    ------
    RecordingError
        It is no such directory, damaged, or holds no such frame yet.
    """
    directory = Path(directory)
    key = read_key(directory)
    if key is None or LIVE_SCENARIO not in key:
        raise RecordingError(
            f"{directory}: no result that is being made frame by frame; give such a directory, or a result"
        )
    scenario = _scenario_of(key[LIVE_SCENARIO], f"{directory}:scenario")
    settings = {name.removeprefix(_SETTING): text for name, text in key.items() if name.startswith(_SETTING)}
    try:
        parts = list(_frames_from(directory, first_frame))
        if not parts:
            raise RecordingError(f"{directory}: holds no frame yet; wait for the first one")
        return result_of(scenario, settings, _joined(parts))
    except RecordingError:
        raise
    except _DAMAGES as error:
        raise RecordingError(f"{directory}: damaged ({error}); process the recording again") from error


@functools.lru_cache(maxsize=2)
def _scenario_of(text: str, source: str) -> Scenario:
    """Return the site, which who follows a result reads with each frame."""
    return parse_scenario(text, source=source)


def n_frame_in(directory: str | Path) -> int:
    """Count the frames so far of a result that is being made; none where there is no such directory."""
    try:
        found = entries_in(Path(directory))
    except OSError:
        return 0
    return found[-1][1] if found else 0


def _frames_from(directory: Path, first_frame: int, end_frame: int | None = None) -> Iterator[Entry]:
    """Yield entries from a frame on; of the first, what comes before is cut off."""
    for first, end, path in _readable(directory):
        if end <= first_frame or (end_frame is not None and first >= end_frame):
            continue
        arrays = read_entry(path)
        if first < first_frame:
            arrays = {
                name: values[first_frame - first :] if _is_by_frame(name) else values for name, values in arrays.items()
            }
        yield arrays


def _readable(directory: Path) -> list[tuple[int, int, Path]]:
    try:
        return entries_in(directory)
    except OSError as error:
        raise RecordingError(f"{directory}: cannot be read: {error.strerror or error}") from error


def _is_by_frame(name: str) -> bool:
    return KEYS[name].dims[0] == "frame"


def _joined(parts: list[Entry]) -> Entry:
    """Join entries frame after frame; what is not by frame is as the last one says."""
    return {
        name: np.concatenate([part[name] for part in parts]) if _is_by_frame(name) else values
        for name, values in parts[-1].items()
    }


class ResultFollower:
    """Sees the frames of a result as they come, while it is made and when it is complete.

    Parameters
    ----------
    path
        The result; while it is made, its frames are in ``PATH.partial``.
    first_frame
        Where to begin; None: with the first frame that comes from now on.

    Attributes
    ----------
    n_seen
        Frames that were seen, or left out at the beginning.
    complete
        The result is complete: no more will come.
    """

    def __init__(self, path: str | Path, *, first_frame: int | None = 0) -> None:
        self.path = Path(path)
        self._partial = self.path if is_live(self.path) else partial_of(self.path)
        self._seen: tuple[int, int] | None = None
        """Number and first sample of the last frame seen."""
        self._site: tuple[str, ...] | None = None
        self.complete = False
        self.n_seen = first_frame or 0
        if first_frame is None:
            found = self._read(0)
            self.n_seen = 0 if found is None else len(found.frame_start_index)

    def news(self) -> Result | None:
        """Return the frames that were not seen yet; None: there are none.

        Raises
        ------
        RecordingError
            What is there is damaged, or is another result than before.
        """
        # with one that was seen before, to know that it is the same result
        first = max(0, self.n_seen - 1) if self._seen is not None else self.n_seen
        found = self._read(first)
        if found is None:
            return None
        starts = found.frame_start_index
        if self._seen is not None:
            if not len(starts) or int(starts[0]) != self._seen[1] or found.scenario.heliostat_ids != self._site:
                raise RecordingError(
                    f"{self.path}: was replaced by another result while it was followed; follow it anew"
                )
            first, starts = first + 1, starts[1:]
        if not len(starts):
            return None
        self._site = found.scenario.heliostat_ids
        self.n_seen = first + len(starts)
        self._seen = self.n_seen - 1, int(starts[-1])
        return frames_of(found, len(found.frame_start_index) - len(starts))

    def _read(self, first: int) -> Result | None:
        """Return frames from one on; None: there are none yet."""
        if self._partial.is_dir():
            found = _readable(self._partial)
            if not found or found[-1][1] <= first:
                if self._seen is not None and found and found[-1][1] <= self._seen[0]:
                    raise RecordingError(f"{self.path}: was begun anew while it was followed; follow it anew")
                return None
            for _ in range(_TRIES):
                try:
                    return open_live(self._partial, first)
                except RecordingError as error:  # perhaps files became one, or the result is complete, meanwhile
                    damage = error
            if self._partial.is_dir():
                raise damage
            return None
        if not self.path.exists():
            return None
        self.complete = True
        found_whole = open_result(self.path)
        n_frame = len(found_whole.frame_start_index)
        if n_frame <= first:
            if self._seen is not None and n_frame <= self._seen[0]:
                raise RecordingError(
                    f"{self.path}: was replaced by another result while it was followed; follow it anew"
                )
            return None
        return frames_of(found_whole, first)


def frames_of(result: Result, first: int) -> Result:
    """Return a result without its first frames, and without truth."""
    columns: dict[str, npt.NDArray[Any]] = {
        path: values[first:] if column.dims[0] == "frame" else values
        for path, (column, values) in columns_of(result).items()
        if not path.startswith("truth/")
    }
    return result_of(result.scenario, result.settings, columns)
