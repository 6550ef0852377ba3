"""A live field as the view shows it: whether it runs, how fast, and its course so far."""

from __future__ import annotations

import math

from rfpose.viewer.models.live_track import LivePicture, LiveTrack
from rfpose.viewer.state.observed import Signal

__all__ = ["FACTORS", "LiveRun"]

FACTORS = (10.0, 30.0, 60.0, 120.0, 300.0)
"""How much faster than the clock a live field may run."""
_KEEP = 5000
_MOST_STEPS = 60
"""Steps taken at once, so that a slow computer stays answerable."""


class LiveRun:
    """A running or halted live field; a clock outside calls `due`, a worker takes the steps, `take` notes them.

    Attributes
    ----------
    changed
        There is something else to draw.
    marks
        Disturbances so far: second of the run, what.
    """

    def __init__(self, track: LiveTrack) -> None:
        self.changed = Signal()
        self.track = track
        self.factor = 60.0
        self.picture: LivePicture | None = None
        self.seconds: list[float] = []
        self.rms_mrad: list[float] = []
        self.marks: list[tuple[float, str]] = []
        self._running = False
        self._owed_s = 0.0

    @property
    def running(self) -> bool:
        """Whether time goes on."""
        return self._running

    @property
    def over(self) -> bool:
        """Whether the day is over."""
        return self.picture is not None and self.picture.over

    @property
    def now_s(self) -> float:
        """Simulated time since the start [s]."""
        return self.seconds[-1] if self.seconds else 0.0

    def toggle(self) -> None:
        """Run, or halt."""
        self._running = not self._running and not self.over
        self._owed_s = 0.0
        self.changed.emit()

    def due(self, elapsed_s: float) -> int:
        """Return how many steps are to be taken now, after ``elapsed_s`` seconds on the clock."""
        if not self._running or not math.isfinite(elapsed_s) or elapsed_s <= 0.0:
            return 0
        self._owed_s += elapsed_s * self.factor
        n = int(self._owed_s / self.track.step_s)
        self._owed_s -= n * self.track.step_s
        return min(n, _MOST_STEPS)

    def take(self, picture: LivePicture | None) -> None:
        """Note what a stretch of steps came to."""
        if picture is not None:
            self.picture = picture
            self.seconds = [*self.seconds, *picture.seconds.tolist()][-_KEEP:]
            self.rms_mrad = [*self.rms_mrad, *picture.rms_mrad.tolist()][-_KEEP:]
        if picture is None or picture.over:
            self._running = False
        self.changed.emit()

    def disturb(self, what: str, name: str = "") -> None:
        """Disturb the field before its next step, and note when.

        Raises
        ------
        InvalidInputError
            No transmitter or mirror of this name.
        """
        self.track.disturb(what, name)
        words = {"gust": "gust", "emergency": "emergency", "normal": "normal", "stop_motor": "stop"}
        self.marks.append((self.now_s, f"{words.get(what, 'kill')} {name}".strip()))
        self.changed.emit()
