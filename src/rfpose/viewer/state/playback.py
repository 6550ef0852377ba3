"""Playing through frames: position, speed, play and pause; a clock outside calls `tick`."""

from __future__ import annotations

import math

from rfpose.viewer.state.observed import Signal

__all__ = ["Playback"]

SPEEDS = (0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0)


class Playback:
    """A position among ``n_frame`` frames.

    Attributes
    ----------
    changed
        Position, length, speed or playing changed.
    """

    def __init__(self, n_frame: int = 0) -> None:
        self.changed = Signal()
        self._n_frame = max(0, n_frame)
        self._position = 0.0
        self._playing = False
        self.frames_per_s = 10.0

    @property
    def n_frame(self) -> int:
        """Number of frames."""
        return self._n_frame

    @property
    def frame(self) -> int:
        """The frame shown, from zero; zero if there is none."""
        return int(self._position)

    @property
    def playing(self) -> bool:
        """Whether `tick` moves."""
        return self._playing

    def load(self, n_frame: int) -> None:
        """Begin anew with another number of frames."""
        self._n_frame, self._position, self._playing = max(0, n_frame), 0.0, False
        self.changed.emit()

    def extend(self, n_frame: int) -> None:
        """Take on more frames (a run that is still going on)."""
        self._n_frame = max(self._n_frame, n_frame)
        self.changed.emit()

    def scrub(self, frame: int) -> None:
        """Go to a frame; one that does not exist becomes the nearest that does."""
        position = float(min(max(frame, 0), max(self._n_frame - 1, 0)))
        if position != self._position:
            self._position = position
            self.changed.emit()

    def step(self, by: int) -> None:
        """Go some frames on or back."""
        self.scrub(self.frame + by)

    def play(self) -> None:
        """Start; from the beginning if at the end."""
        if self._n_frame < 2:
            return
        if self.frame >= self._n_frame - 1:
            self._position = 0.0
        self._playing = True
        self.changed.emit()

    def pause(self) -> None:
        """Stop where it is."""
        if self._playing:
            self._playing = False
            self.changed.emit()

    def toggle(self) -> None:
        """Play, or pause."""
        if self._playing:
            self.pause()
        else:
            self.play()

    def tick(self, elapsed_s: float) -> None:
        """Move on by what plays in ``elapsed_s`` seconds; at the end it pauses."""
        if not self._playing or not math.isfinite(elapsed_s) or elapsed_s <= 0.0:
            return
        before = self.frame
        self._position += elapsed_s * self.frames_per_s
        if self._position >= self._n_frame - 1:
            self._position, self._playing = float(self._n_frame - 1), False
        if self.frame != before or not self._playing:
            self.changed.emit()
