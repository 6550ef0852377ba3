"""Events that views listen to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

__all__ = ["Signal"]

Listener = Callable[..., Any]


class Signal:
    """Something that happens; listeners are called in the order in which they came."""

    def __init__(self) -> None:
        self._listeners: list[Listener] = []

    def connect(self, listener: Listener) -> Callable[[], None]:
        """Call ``listener`` at each `emit`; the returned function ends that."""
        self._listeners.append(listener)

        def disconnect() -> None:
            if listener in self._listeners:
                self._listeners.remove(listener)

        return disconnect

    def emit(self, *arguments: Any) -> None:
        """Tell everyone who listens now."""
        for listener in tuple(self._listeners):
            if listener in self._listeners:
                listener(*arguments)
