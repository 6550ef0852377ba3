"""Where the time of a job goes, stage by stage."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

from rfpose.engine import n_core

__all__ = ["STAGES", "Stopwatch"]

STAGES = ("open", "read", "tones", "calibration", "poses", "write")


class Stopwatch:
    """Seconds by stage; threads that are in one side by side all count.

    Attributes
    ----------
    seconds
        By name, see `STAGES` [s].
    samples
        Complex samples that became tone phases.
    cores
        That share reading and measuring.
    """

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self.samples = 0
        self.cores = n_core()
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def during(self, stage: str, samples: int = 0) -> Iterator[None]:
        """Count the time of the block, and samples if it ends well."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                self.seconds[stage] += time.perf_counter() - begun
        with self._lock:
            self.samples += samples

    def add(self, seconds: Mapping[str, float], samples: int) -> None:
        """Count what was done elsewhere."""
        for name, value in seconds.items():
            self.seconds[name] += value
        self.samples += samples

    def summary(self) -> dict[str, Any]:
        """Return seconds by stage, samples a second of reading and tones, and the stage that takes longest.

        ``read`` and ``tones`` are shared by ``cores``: their seconds are divided by that.
        """
        shared = {name: self.seconds[name] / self.cores for name in ("read", "tones")}
        seconds = self.seconds | shared
        busy = sum(shared.values())
        return {
            "seconds": seconds,
            "cores": self.cores,
            "samples": self.samples,
            "samples_per_s": self.samples / busy if busy > 0.0 else None,
            "bound_by": max(seconds, key=seconds.__getitem__),
        }
