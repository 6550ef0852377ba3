"""Where a long simulation stands, in one file that each new state replaces."""

from __future__ import annotations

import io
import json
import logging
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.errors import RecordingError
from rfpose.files import replace_content

__all__ = ["Checkpoint"]

_KEY = "key.json"

_log = logging.getLogger(__name__)


class Checkpoint:
    """A state under a key; what was left under another key is not mixed in.

    Parameters
    ----------
    path
        Of the file.
    key
        What the state depends on.
    restart
        Discard what is there.
    interval_s
        Least time between two states written [s].
    """

    def __init__(self, path: Path, key: Mapping[str, str], *, restart: bool, interval_s: float = 20.0) -> None:
        self._path, self._key, self._interval_s = path, dict(key), interval_s
        self._last, self._took_s = time.monotonic(), 0.0
        if restart:
            self.remove()

    def read(self) -> dict[str, npt.NDArray[Any]] | None:
        """Return the state, or None.

        Raises
        ------
        RecordingError
            It is that of another job.
        """
        if not self._path.exists():
            return None
        try:
            with np.load(self._path, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            found = json.loads(str(arrays.pop(_KEY)))
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            _log.warning("%s is damaged (%s); the run begins anew", self._path, error)
            return None
        if found != self._key:
            differing = ", ".join(sorted(k for k in {*found, *self._key} if found.get(k) != self._key.get(k)))
            raise RecordingError(
                f"{self._path}: holds the unfinished work of another job (different: {differing}); repeat that job's "
                "command to finish it, or start over with `force=True`"
            )
        return arrays

    def write(self, state: Mapping[str, npt.NDArray[Any]], *, share: float = 0.0) -> None:
        """Keep a state if the last was kept long enough ago, or if that took less than a share of the time since."""
        began = time.monotonic()
        since = began - self._last
        if since < self._interval_s and self._took_s >= share * since:
            return
        buffer = io.BytesIO()
        np.savez(buffer, **{**state, _KEY: np.array(json.dumps(self._key, sort_keys=True))})  # type: ignore[arg-type]
        replace_content(self._path, buffer.getvalue())
        self._last = time.monotonic()
        self._took_s = self._last - began

    def remove(self) -> None:
        """Forget the state."""
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot remove: {error.strerror or error}") from error
