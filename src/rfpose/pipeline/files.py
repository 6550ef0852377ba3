"""Writing files so that a name holds either the whole content or what it held before."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from rfpose.errors import RecordingError

__all__ = ["TEMPORARY_SUFFIX", "make_directory", "refuse_existing", "write_atomically"]

TEMPORARY_SUFFIX = ".tmp"


def refuse_existing(path: str | Path, *, force: bool) -> None:
    """Make sure that ``path`` may be written, before any work is done.

    Raises
    ------
    RecordingError
        It exists and ``force`` is not set, is a directory, or its directory does not exist.
    """
    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path}: is a directory; give a file name")
    if path.exists() and not force:
        raise RecordingError(f"{path}: exists already; choose another name, or --force to overwrite it")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: its directory does not exist; make {path.parent} first")


def make_directory(path: str | Path) -> Path:
    """Make a directory and those above it; an existing one is fine.

    Raises
    ------
    RecordingError
        It cannot be made, or is a file.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{path}: cannot make this directory: {error.strerror or error}") from error
    return path


def write_atomically(path: str | Path, content: bytes) -> None:
    """Write a file under a temporary name beside ``path``, then give it its name.

    Raises
    ------
    RecordingError
        Writing failed (disk full, no permission); ``path`` is as it was and nothing is left beside it.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}")
    try:
        try:
            with open(temporary, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink()
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot write: {error.strerror or error}; free some space or write elsewhere"
        ) from error
