"""Where the time of a job goes, stage by stage."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

__all__ = ["STAGES", "Stopwatch"]

STAGES = ("open", "read", "tones", "calibration", "poses", "write")


@dataclass(slots=True, kw_only=True)
class Stopwatch:
    """Seconds by stage; threads that are in one side by side all count.

    Attributes
    ----------
    seconds
        By name, see `STAGES` [s].
    samples
        Complex samples that became tone phases.
    cores
        That share reading and measuring; one before anything is measured.
    """

    seconds: dict[str, float] = field(default_factory=dict.fromkeys(STAGES, 0.0).copy)
    samples: int = 0
    cores: int = 1
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

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
