"""What clouds leave of the days' sun."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rfpose.checks import FloatArray, read_only
from rfpose.feedback.energy import draw_bursts
from rfpose.feedback.tracking.hidden import generator
from rfpose.feedback.tracking.timeline import Day, day_of
from rfpose.scenario import Scenario

__all__ = ["under_sky"]

_PLACE = 30  # of the generator


def under_sky(scenario: Scenario, days: Sequence[Day], *, seed: int) -> tuple[Day, ...]:
    """Return the days with the beam on and off as ``[tracking] sky`` says.

    Bursts are those of `rfpose.feedback.energy.draw_bursts` (Edwards, App. B), laid on the time during which the sun is
    above ``min_sun_elevation_deg``: hours within which the field tracks cut from them and change none. A date has the
    same sky in all runs of a seed.
    """
    if scenario.tracking.sky == "clear":
        return tuple(days)
    return tuple(_in_bursts(scenario, day, seed) for day in days)


def _in_bursts(scenario: Scenario, day: Day, seed: int) -> Day:
    span = day_of(scenario, day.date, day.since_first, whole=True).unix_s
    rng = generator(seed, _PLACE, day.date.toordinal())
    bursts = draw_bursts(rng, n_day=1, day_s=float(span[-1] - span[0]))[0]
    lit = _within(day.unix_s - span[0], bursts)
    return replace(day, power_w_per_m2=read_only(day.power_w_per_m2 * lit))


def _within(time_s: FloatArray, bursts: FloatArray) -> FloatArray:
    """(time,) one within a burst, else zero."""
    if not len(bursts):
        return np.zeros(len(time_s))
    last = np.searchsorted(bursts[:, 0], time_s, side="right") - 1
    return np.asarray((last >= 0) & (time_s <= bursts[np.maximum(last, 0), 1]), np.float64)
