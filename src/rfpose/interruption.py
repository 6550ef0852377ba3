"""Ctrl-C and its like: heard as one exception, held back where an exception would be lost or leave things half done."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

__all__ = ["check", "heard", "held_back", "ignore_for_good", "ignored"]

_STOPPING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name)
)
_HELD = (*_STOPPING, *(getattr(signal, name) for name in ("SIGALRM", "SIGUSR1", "SIGUSR2") if hasattr(signal, name)))

Handler = Callable[[int, FrameType | None], Any]

_asked = False
"""An interruption was heard. It stays true where the exception got lost, as in a destructor or a C callback."""


@contextlib.contextmanager
def heard() -> Iterator[None]:
    """While it lasts, SIGINT, SIGTERM and SIGHUP raise ``KeyboardInterrupt``, unless they were ignored before.

    Only the main thread can set handlers; elsewhere this does nothing.
    """
    global _asked
    _asked = False

    def interrupt(signum: int, _frame: FrameType | None) -> None:
        global _asked
        _asked = True
        raise KeyboardInterrupt(signal.Signals(signum).name)

    # a handler of None was not set from Python, and cannot be put back
    with _handled(_STOPPING, interrupt, lambda now: now not in (signal.SIG_IGN, None)):
        yield


def check() -> None:
    """Raise ``KeyboardInterrupt`` if `heard` heard an interruption, even if that exception got lost on its way."""
    if _asked:
        raise KeyboardInterrupt


@contextlib.contextmanager
def ignored() -> Iterator[None]:
    """Let nothing interrupt the block: what is done there ends the work anyway."""
    with _handled(_STOPPING, lambda _signum, _frame: None, lambda now: now is not None):
        yield


def ignore_for_good() -> None:
    """Let nothing interrupt the end of the process; for the main thread."""
    for signum in _STOPPING:
        signal.signal(signum, signal.SIG_IGN)


@contextlib.contextmanager
def held_back() -> Iterator[None]:
    """Let signals wait until the block is over; then their handlers run, and raise what they raise.

    For what must be done as a whole, and for C code that calls back into Python, such as HDF5 with a Python file
    object: an exception that comes up in there is swallowed, and the work goes on without its result.
    """
    arrived: list[tuple[Handler, int, FrameType | None]] = []
    waiting: dict[int, Handler] = {}

    def wait(signum: int, frame: FrameType | None) -> None:
        arrived.append((waiting[signum], signum, frame))

    try:
        with _handled(_HELD, wait, callable, waiting):
            yield
    finally:
        for handler, signum, frame in arrived:
            handler(signum, frame)


@contextlib.contextmanager
def _handled(
    signals: tuple[int, ...], handler: Handler, wanted: Callable[[Any], bool], before: dict[int, Any] | None = None
) -> Iterator[None]:
    """Handle the signals whose present handler is ``wanted`` in another way; ``before`` collects the present ones."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {} if before is None else before
    try:
        for signum in signals:
            now = signal.getsignal(signum)
            if wanted(now):
                before[signum] = now
                signal.signal(signum, handler)
        yield
    finally:
        interruption: BaseException | None = None
        for signum, was in before.items():
            while signal.getsignal(signum) is handler:
                try:
                    signal.signal(signum, was)
                except BaseException as error:  # noqa: BLE001 -- of a handler that was due before this; raised below
                    interruption = error
        if interruption is not None:
            raise interruption
