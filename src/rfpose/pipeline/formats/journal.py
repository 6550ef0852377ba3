"""What a long job has done so far, on disk, so that a killed one goes on where it stopped."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.errors import RecordingError
from rfpose.files import make_directory, replace_content
from rfpose.kinds import JOURNAL_KEY, read_key

__all__ = ["Entry", "Journal", "entries_in", "partial_of", "read_entry"]

Entry = dict[str, npt.NDArray[Any]]

_ENTRY_NAME = re.compile(r"rows-(\d{12})-(\d{12})\.npz")

_log = logging.getLogger(__name__)


def partial_of(path: str | Path) -> Path:
    """Return where a result is kept while it is made."""
    path = Path(path)
    return path.with_name(f"{path.name}.partial")


def entries_in(directory: Path) -> list[tuple[int, int, Path]]:
    """Return ``(first row, end row, file)`` of a journal's entries from row zero on, as far as there is no gap.

    Of entries that begin with the same row the longest: it was made of the others, which a killed job left.
    """
    found = [(int(m[1]), int(m[2]), m[0]) for name in os.listdir(directory) if (m := _ENTRY_NAME.fullmatch(name))]
    longest = {first: (end, name) for first, end, name in sorted(found)}
    entries, row = [], 0
    while row in longest and longest[row][0] > row:
        end, name = longest[row]
        entries.append((row, end, directory / name))
        row = end
    return entries


def read_entry(path: Path) -> Entry:
    """Return the arrays of one entry; OSError, ValueError, EOFError or BadZipFile: it is damaged or gone."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


class Journal:
    """A directory of numbered entries; rows are numbered from zero without gaps.

    Parameters
    ----------
    directory
        Made if absent.
    key
        What the entries depend on, as text. Entries written under another key are never mixed in.
    restart
        Discard entries of another key instead of refusing.

    Raises
    ------
    RecordingError
        The directory holds the work of another key, holds something else, or cannot be read or written.
    """

    def __init__(self, directory: Path, key: Mapping[str, str], *, restart: bool) -> None:
        self._directory = directory
        found = read_key(directory)
        if found is None:
            self._refuse_strangers()
        elif found != dict(key):
            if not restart and entries_in(directory):  # without any nothing is lost
                differing = ", ".join(sorted(k for k in {*found, *key} if found.get(k) != key.get(k)))
                raise RecordingError(
                    f"{directory}: holds the unfinished work of another job (different: {differing}); repeat that "
                    "job's command to finish it, or start over with `force=True`"
                )
            self.remove()
        make_directory(directory)
        replace_content(directory / JOURNAL_KEY, json.dumps(dict(key), indent=1, sort_keys=True).encode())

    def _refuse_strangers(self) -> None:
        """Without a key, only what a job leaves that was killed while it wrote the key may be there."""
        if self._directory.is_dir() and all(self._is_own(path) for path in self._directory.iterdir()):
            return
        if self._directory.exists():
            raise RecordingError(f"{self._directory}: is in the way and no unfinished work of rfpose; move it aside")

    @staticmethod
    def _is_own(path: Path) -> bool:
        return path.name == JOURNAL_KEY or path.suffix == ".part" or _ENTRY_NAME.fullmatch(path.name) is not None

    def read(self) -> list[tuple[int, int, Entry]]:
        """Return ``(first row, end row, arrays)`` of the entries from row zero on; what follows a damaged one is lost.

        A damaged entry is one that a power cut left incomplete; its rows are measured again.
        """
        entries: list[tuple[int, int, Entry]] = []
        for first, end, path in entries_in(self._directory):
            try:
                entries.append((first, end, read_entry(path)))
            except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
                _log.warning("%s is damaged (%s); that part is measured again", path, error)
                break
        return entries

    def append(self, first_row: int, end_row: int, arrays: Entry) -> None:
        """Write one entry; it is there in whole or not at all."""
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)  # type: ignore[arg-type]
        replace_content(self._directory / f"rows-{first_row:012d}-{end_row:012d}.npz", buffer.getvalue())

    def merge(self, entries: Sequence[tuple[int, int, Path]], arrays: Entry) -> None:
        """Put one entry in place of several that follow each other; they go when it is there."""
        self.append(entries[0][0], entries[-1][1], arrays)
        for _, _, path in entries:
            path.unlink(missing_ok=True)

    def remove(self) -> None:
        """Delete the entries and, unless something else is in it, the directory."""
        try:
            # the first rows go first: who reads along sees all entries or none, and never fewer; and what depends on a
            # key never outlives it
            own = sorted((path for path in self._directory.iterdir() if self._is_own(path)), key=_removal_order)
            for path in own:
                path.unlink()
            if not any(self._directory.iterdir()):
                self._directory.rmdir()
        except OSError as error:
            raise RecordingError(f"{self._directory}: cannot remove: {error.strerror or error}") from error


def _removal_order(path: Path) -> tuple[bool, str]:
    return path.name == JOURNAL_KEY, path.name
