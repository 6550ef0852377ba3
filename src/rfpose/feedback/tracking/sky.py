"""What clouds leave of the days' sun."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rfpose.checks import FloatArray, read_only
from rfpose.errors import ScenarioError
from rfpose.feedback.energy import draw_bursts
from rfpose.feedback.series import Quantity, read_series_csv
from rfpose.feedback.tracking.hidden import generator
from rfpose.feedback.tracking.timeline import Day, day_of
from rfpose.scenario import Scenario

__all__ = ["under_sky"]

_PLACE = 30  # of the generator
_BEAM = Quantity(
    name="dni",
    units={"w_per_m2": 1.0, "kw_per_m2": 1e3},
    unit="W/m²",
    most=1500.0,
    beyond="the sun",
)
_LONGEST_GAP_S = 3600.0


def under_sky(scenario: Scenario, days: Sequence[Day], *, seed: int) -> tuple[Day, ...]:
    """Return the days with the beam on and off as ``[tracking] sky`` says.

    Bursts are those of `rfpose.feedback.energy.draw_bursts` (Edwards, App. B), laid on the time during which the sun is
    above ``min_sun_elevation_deg``: hours within which the field tracks cut from them and change none. A date has the
    same sky in all runs of a seed. A record's gaps longer than an hour are dark.

    Raises
    ------
    ScenarioError
        A record that does not reach over the days.
    InvalidInputError
        A record that cannot be read, by file and line.
    """
    if scenario.tracking.sky == "clear":
        return tuple(days)
    if scenario.tracking.sky == "record":
        return _as_recorded(scenario, days)
    return tuple(_in_bursts(scenario, day, seed) for day in days)


def _in_bursts(scenario: Scenario, day: Day, seed: int) -> Day:
    span = day_of(scenario, day.date, day.since_first, whole=True).unix_s
    rng = generator(seed, _PLACE, day.date.toordinal())
    bursts = draw_bursts(rng, n_day=1, day_s=float(span[-1] - span[0]))[0]
    lit = _within(day.unix_s - span[0], bursts)
    return replace(day, power_w_per_m2=read_only(day.power_w_per_m2 * lit))


def _as_recorded(scenario: Scenario, days: Sequence[Day]) -> tuple[Day, ...]:
    path = scenario.tracking.beam_record
    assert path is not None
    start, beam = read_series_csv(
        path, _BEAM, interval_s=scenario.tracking.servo_interval_s, longest_gap_s=_LONGEST_GAP_S
    )
    times = start + scenario.tracking.servo_interval_s * np.arange(len(beam))
    found = []
    for day in days:
        if not (times[0] <= day.unix_s[0] and day.unix_s[-1] <= times[-1]):
            raise ScenarioError(
                f"[tracking] `beam_record` does not reach over {day.date}: give a longer one, another `date`, or "
                "`first_hour` and `last_hour` within it"
            )
        power = np.nan_to_num(np.interp(day.unix_s, times, beam))
        found.append(replace(day, power_w_per_m2=read_only(power)))
    return tuple(found)


def _within(time_s: FloatArray, bursts: FloatArray) -> FloatArray:
    """(time,) one within a burst, else zero."""
    if not len(bursts):
        return np.zeros(len(time_s))
    last = np.searchsorted(bursts[:, 0], time_s, side="right") - 1
    return np.asarray((last >= 0) & (time_s <= bursts[np.maximum(last, 0), 1]), np.float64)
