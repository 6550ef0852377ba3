"""How a field responds to alarms: when its flux is gone, the last mirror off the receiver, all in stow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.feedback.fieldcontrol.modes import Mode

__all__ = ["AlarmWatch"]

_PART = 0.1
_LONGEST_S = 1800.0
_TO_STOW = ("strong wind", "wind unknown", "centre silent")
"""Alarms that field control raises by itself; an emergency by hand is told to `begin`."""


class AlarmWatch:
    """Follows the field from an alarm until all mirrors are in stow, one alarm at a time.

    Attributes
    ----------
    found
        What came of past alarms: ``alarm``, ``at_s`` (after the day's first step), ``below_tenth_s``, ``off_s`` (last
        mirror below a tenth of its own light), ``stowed_median_s``, ``stowed_s`` (last mirror), all after the alarm;
        None: not within half an hour or the day. Mirrors without power, or without valid counts, are not waited for.
    """

    def __init__(self, n: int) -> None:
        self.found: list[dict[str, Any]] = []
        self._name: str | None = None
        self._begin_s = 0.0
        self._below_s: float | None = None
        self._known: tuple[str, ...] = ()
        self._full = np.zeros(n)
        self._off_s = np.full(n, np.nan)
        self._stowed_s = np.full(n, np.nan)
        self._able = np.ones(n, np.bool_)

    @property
    def open(self) -> bool:
        """Whether an alarm is being followed."""
        return self._name is not None

    def begin(self, now_s: float, name: str, light: FloatArray) -> None:
        """Begin to follow an alarm, from the light (mirror, caught-offered) that there is; one at a time."""
        if self.open or not light[:, 0].sum() > 0.0:
            return
        self._name, self._begin_s, self._below_s = name, now_s, None
        self._full[:] = light[:, 0]
        self._off_s[:] = self._stowed_s[:] = np.nan

    def observe(self, now_s: float, mode: npt.NDArray[np.int8], light: FloatArray, alarms: Sequence[str]) -> None:
        """Take note of a moment; begin with an alarm that is new and means stow."""
        for name in alarms:
            if name in _TO_STOW and name not in self._known:
                self.begin(now_s, name, light)
        self._known = tuple(alarms)
        if not self.open:
            return
        after = now_s - self._begin_s
        if light[:, 0].sum() >= _PART * self._full.sum():
            self._below_s = None
        elif self._below_s is None:
            self._below_s = after
        off = light[:, 0] < _PART * np.maximum(self._full, 1e-12)
        self._off_s = np.where(off, np.where(np.isnan(self._off_s), after, self._off_s), np.nan)
        stowed = mode == Mode.STOW
        self._stowed_s = np.where(stowed, np.where(np.isnan(self._stowed_s), after, self._stowed_s), np.nan)
        self._able = ~np.isin(mode, (Mode.POWER_LOSS, Mode.FAULT))
        if stowed[self._able].all() or after >= _LONGEST_S:
            self.close()

    def close(self) -> None:
        """End what is being followed and keep what came of it."""
        if not self.open:
            return
        able = self._able
        self.found.append(
            {
                "alarm": self._name,
                "at_s": self._begin_s,
                "below_tenth_s": self._below_s,
                "off_s": _last(self._off_s[able]),
                "stowed_median_s": _last(np.median(self._stowed_s[able], keepdims=True)) if able.any() else None,
                "stowed_s": _last(self._stowed_s[able]),
            }
        )
        self._name = None

    def text(self) -> dict[str, Any]:
        """Return what is no array, for `restore`."""
        return {
            "found": self.found, "name": self._name, "begin_s": self._begin_s, "below_s": self._below_s,
            "known": self._known,
        }  # fmt: skip

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays, for `restore`."""
        return {"full": self._full, "off_s": self._off_s, "stowed_s": self._stowed_s, "able": self._able}

    def restore(self, arrays: Mapping[str, npt.NDArray[Any]], text: Mapping[str, Any]) -> None:
        """Go back to what `arrays` and `text` gave."""
        self.found, self._name = list(text["found"]), text["name"]
        self._begin_s, self._below_s = text["begin_s"], text["below_s"]
        self._known = tuple(text["known"])
        self._full, self._able = arrays["full"].copy(), arrays["able"].copy()
        self._off_s, self._stowed_s = arrays["off_s"].copy(), arrays["stowed_s"].copy()


def _last(times_s: FloatArray) -> float | None:
    """Return the latest time; None if one has not come, or nobody is there."""
    return float(times_s.max()) if times_s.size and np.isfinite(times_s).all() else None
