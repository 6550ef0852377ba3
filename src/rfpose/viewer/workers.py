"""Long work beside the window: each job in a thread of its own, its end told in the window's thread.

Python collects cyclic garbage in whatever thread happens to allocate. Windows and pictures are full of cycles, and Qt
objects must not end outside the window's thread; so while there are workers, garbage is collected there and only there.
"""

from __future__ import annotations

import contextlib
import gc
import threading
import time
from collections.abc import Callable
from typing import Any

from PySide6.QtCore import QObject, Qt, QTimer, Signal, Slot

from rfpose.errors import RfposeError

__all__ = ["CancelledError", "Job", "Workers"]

Progress = Callable[[int, int], None]
Work = Callable[[Progress], Any]

_COLLECT_EVERY_MS = 200
_RUNNING: set[Job] = set()
"""Jobs whose end has not been told: no window owns them, so that none takes one away from its thread."""
_OPEN: set[int] = set()
"""Workers that have not been stopped."""


class CancelledError(Exception):
    """Raised inside work that nobody wants any more."""


class Job(QObject):
    """One piece of work in a thread of its own; where it reports progress, there it can be ended."""

    progressed = Signal(int, int)
    ended = Signal()
    _told = Signal(int, int)
    _left = Signal()

    def __init__(self, name: str, work: Work, done: Callable[[Any], None], failed: Callable[[str], None]) -> None:
        super().__init__()
        self.name = name
        self._work, self._done, self._failed = work, done, failed
        self.begun_s = time.monotonic()
        self.told: tuple[int, int] = (0, 0)
        """Done and in all, as it last said; nothing in all: not said."""
        self._cancelled = threading.Event()
        self._value: Any = None
        self._problem: str | None = None
        self._thread = threading.Thread(target=self._run, name=f"rfpose {name}", daemon=True)
        self._told.connect(self._on_told, Qt.ConnectionType.QueuedConnection)
        self._left.connect(self._on_left, Qt.ConnectionType.QueuedConnection)

    def start(self) -> None:
        """Begin."""
        _RUNNING.add(self)
        self._thread.start()

    def cancel(self) -> None:
        """End it; nothing more is heard of it, even if it takes a while to notice."""
        self._cancelled.set()

    @property
    def is_cancelled(self) -> bool:
        """Whether it was cancelled."""
        return self._cancelled.is_set()

    def wait(self, timeout_s: float) -> bool:
        """Wait for its thread to end; tells whether it has."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._value = self._work(self._progress)
        except CancelledError:
            self._cancelled.set()
        except RfposeError as error:
            self._problem = str(error)
        except MemoryError:
            self._problem = f"{self.name}: out of memory; close other programs, or look at less at a time"
        except OSError as error:
            place = f"{error.filename}: " if error.filename else ""
            self._problem = f"{place}{error.strerror or error}; check the file and its disk"
        except Exception as error:  # noqa: BLE001 -- a job's end must reach the window, whatever it is
            self._problem = f"{self.name}: unexpected {type(error).__name__}: {error}; please report this"
        with contextlib.suppress(RuntimeError):  # the program ends
            self._left.emit()

    def _progress(self, done: int, total: int) -> None:
        if self._cancelled.is_set():
            raise CancelledError
        with contextlib.suppress(RuntimeError):
            self._told.emit(done, total)

    @Slot(int, int)
    def _on_told(self, done: int, total: int) -> None:
        if not self._cancelled.is_set():
            self.told = (done, total)
            self.progressed.emit(done, total)

    @Slot()
    def _on_left(self) -> None:
        self._thread.join()  # it may still be on its way out of the signal
        _RUNNING.discard(self)
        self.ended.emit()
        if self._cancelled.is_set():
            return
        if self._problem is not None:
            self._failed(self._problem)
        else:
            self._done(self._value)


class Workers(QObject):
    """The jobs under way. A job with the key of an earlier one takes its place.

    ``changed`` tells that the set of jobs changed, ``progressed`` that one of them got on.
    """

    changed = Signal()
    progressed = Signal()

    def __init__(self, failed: Callable[[str], None], parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._failed = failed
        self._jobs: list[Job] = []
        self._by_key: dict[str, Job] = {}
        self._closed = False
        self._garbage = QTimer(self)
        self._garbage.timeout.connect(_collect)
        self._garbage.start(_COLLECT_EVERY_MS)
        _OPEN.add(id(self))
        gc.disable()

    @property
    def jobs(self) -> tuple[Job, ...]:
        """Those under way and wanted."""
        return tuple(job for job in self._jobs if not job.is_cancelled)

    def run(
        self,
        name: str,
        work: Work,
        done: Callable[[Any], None],
        *,
        key: str | None = None,
        failed: Callable[[str], None] | None = None,
    ) -> Job:
        """Start ``work(on_progress)``; its value reaches ``done`` in the window's thread, an error ``failed``."""
        key = key or name
        if key in self._by_key:
            self._by_key[key].cancel()
        job = Job(name, work, done, failed or self._failed)
        job.ended.connect(lambda: self._forget(job, key))
        job.progressed.connect(lambda *_: self.progressed.emit())
        self._jobs.append(job)
        self._by_key[key] = job
        if self._closed:
            job.cancel()
        else:
            job.start()
        self.changed.emit()
        return job

    def cancel(self, key: str | None = None) -> None:
        """End the job of a key, or all."""
        for name, job in tuple(self._by_key.items()):
            if key is None or name == key:
                job.cancel()
        self.changed.emit()

    def stop(self, timeout_s: float = 2.0) -> bool:
        """End all and wait a little for their threads, which die with the program; tells whether all have ended."""
        self._closed = True
        self.cancel()
        waited = [job.wait(timeout_s) for job in tuple(self._jobs)]
        _OPEN.discard(id(self))
        if not _OPEN and all(waited):
            gc.enable()
        return all(waited)

    def _forget(self, job: Job, key: str) -> None:
        if job in self._jobs:
            self._jobs.remove(job)
        if self._by_key.get(key) is job:
            del self._by_key[key]
        job.deleteLater()
        with contextlib.suppress(RuntimeError):  # the window has gone
            self.changed.emit()


def _collect() -> None:
    """Collect the oldest generation whose time has come, as Python does by itself."""
    for generation, (count, threshold) in reversed(
        list(enumerate(zip(gc.get_count(), gc.get_threshold(), strict=True)))
    ):
        if count > threshold:
            gc.collect(generation)
            return
