"""The run: all methods through the same days, on the same sun, wind, hidden errors and lost frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.feedback.servo.margins import Margins
from rfpose.feedback.tracking.calibrations import Calibrator
from rfpose.feedback.tracking.engine import Arrays, StretchDraws
from rfpose.feedback.tracking.hidden import generator
from rfpose.feedback.tracking.loops import check_gains
from rfpose.feedback.tracking.methods import choose
from rfpose.feedback.tracking.operation import who_of
from rfpose.feedback.tracking.plant import Plant
from rfpose.feedback.tracking.radio import RadioByPosture
from rfpose.feedback.tracking.run import Curves, KeptCourses, MethodRun, MethodSums, Segment
from rfpose.scenario import Scenario

__all__ = ["Curves", "MethodSums", "Portion", "TrackingSimulation"]

SEGMENT_S = 900.0
"""Simulated time between two points at which a run can be taken up again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Portion:
    """A day of some methods; those of one that learns go on from what `TrackingSimulation.learned` tells."""

    methods: tuple[str, ...]
    i_day: int
    learns: bool = False


class TrackingSimulation:
    """A field tracked by several methods; go through it with `advance`.

    Parameters
    ----------
    scenario
        Site, mirrors, radio, and ``[tracking]``.
    methods
        Names of `METHODS`; none: all that can steer the collector.
    count
        Number of mirrors; None: those of the scenario.
    seed
        Everything random follows from it; what one method meets does not depend on which others run.

    Raises
    ------
    ScenarioError, GeometryError, InvalidInputError
        The scenario cannot be tracked: no mirrors, no site, no sun, an aim point that no mirror reaches, transmitters
        that fix nothing, gains without margin.
    """

    def __init__(
        self, scenario: Scenario, *, methods: Sequence[str] = (), count: int | None = None, seed: int = 0
    ) -> None:
        if isinstance(seed, bool) or seed < 0:
            raise InvalidInputError(f"`seed` must be a non-negative integer, got {seed!r}")
        plan = scenario.tracking
        self.scenario = scenario
        self.methods = choose(methods, collector=plan.collector)
        self.plant = Plant(scenario, count=count, seed=int(seed))
        self.field, self.days = self.plant.field, self.plant.days
        needs_radio = any(m.radio for m in self.methods)
        self.margins: Margins | None = check_gains(scenario) if needs_radio else None
        self.radio: RadioByPosture | None = None
        if needs_radio:
            usual = self.plant.usual_normal_enu()
            self.radio = RadioByPosture(scenario, self.field.pivot_enu_m, usual_normal_enu=usual)
        n = len(self.field)
        self.stored = np.unique(np.linspace(0, n - 1, min(plan.stored, n)).astype(np.int64))
        self._stride = round(plan.store_interval_s / plan.servo_interval_s)
        self.segments = self._segments()
        if plan.field_control is not None:
            for event in plan.event:  # refuse names that nobody has before days go by
                who_of(event, self.field, plan.field_control.bus.cluster_size)
        calibrator = Calibrator(self.plant, self.radio)
        kept = KeptCourses(stored=self.stored, stride=self._stride)
        self._runs = {m.name: MethodRun(m, self.plant, calibrator, kept) for m in self.methods}
        self._over = {name: np.zeros(len(self.days), np.bool_) for name in self._runs}
        self._gust_state = self.plant.gusts.process.start(generator(self.plant.seed, 1, 0), n)
        self._beside = ThreadPoolExecutor(1, "rfpose-wind")
        self.done = 0
        self.plant.check_reach()

    # -- plan ----------------------------------------------------------------------------------------------

    @property
    def n_segment(self) -> int:
        """Number of stretches to advance through."""
        return len(self.segments)

    @property
    def stored_unix_s(self) -> FloatArray:
        """(time,) instants of the curves, all days in turn [s since 1970 UTC]."""
        return np.concatenate([day.unix_s[:: self._stride] for day in self.days])

    @property
    def stored_sun_enu(self) -> FloatArray:
        """(time, xyz) sun at the curves' instants."""
        return np.concatenate([day.sun_enu[: len(day.unix_s) : self._stride] for day in self.days])

    @property
    def stored_day(self) -> npt.NDArray[np.int64]:
        """(time,) which day each instant belongs to."""
        return np.concatenate([np.full(len(d.unix_s[:: self._stride]), i) for i, d in enumerate(self.days)])

    def _segments(self) -> tuple[Segment, ...]:
        length = max(1, round(SEGMENT_S / self.scenario.tracking.store_interval_s)) * self._stride
        found, stored = [], 0
        for i, day in enumerate(self.days):
            n_step = len(day.unix_s)
            for first in range(0, n_step, length):
                found.append(
                    Segment(
                        i_day=i,
                        first=first,
                        end=min(first + length, n_step),
                        first_stored=stored + first // self._stride,
                    )
                )
            stored += -(-n_step // self._stride)
        return tuple(found)

    # -- go on ---------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Simulate the next stretch of time."""
        segment = self.segments[self.done]
        left = [name for name, over in self._over.items() if not over[segment.i_day]]
        if left:
            self._advance(segment, left)
        self.done += 1

    def _advance(self, segment: Segment, names: Sequence[str]) -> None:
        """Take methods through a stretch."""
        runs = [self._runs[name] for name in names]
        if segment.first == 0:
            start = generator(self.plant.seed, 1, segment.i_day)
            self._gust_state[:] = self.plant.gusts.process.start(start, len(self.field))
            for run in runs:
                run.begin_day(segment.i_day)
        draws = self._draw(segment)
        for run in runs:
            run.go_through(segment, draws)
        if segment.end == len(self.days[segment.i_day].unix_s):
            for name in names:
                self._over[name][segment.i_day] = True

    def _draw(self, segment: Segment) -> StretchDraws:
        """Draw what a stretch brings to all methods."""
        plant, plan, day, n = self.plant, self.scenario.tracking, self.days[segment.i_day], len(self.field)
        steps = slice(segment.first, segment.end)
        n_step = segment.end - segment.first
        n_frame = -(-n_step // round(plan.control_interval_s / plan.servo_interval_s))
        place = (segment.i_day, segment.first)
        # wind has random numbers of its own, and can be drawn beside the others
        wind = generator(plant.seed, 2, *place)
        gust = self._beside.submit(plant.gusts.run, self._gust_state, wind, day.unix_s[steps])
        rng = generator(plant.seed, 3, *place)
        noise = rng.standard_normal((n, n_frame, 2), dtype=np.float32)
        lost = (rng.random((n, n_frame), dtype=np.float32) < plan.radio.lost_frames).astype(np.uint8)
        # before radio's, which are drawn only where there is a method that needs it
        swing = plant.gusts.draw_swing(rng, (n, n_step))
        spread, bias = np.zeros((n, 3)), np.zeros((n, 2))
        if self.radio is not None:
            errors = self.radio.errors(plant.wanted_normal_enu(day, (segment.first + segment.end) // 2), rng)
            spread, bias = errors.spread_rad.copy(), errors.bias_rad.copy()
            lost[~errors.solved] = 1
        outage, pattern = self._outage(day.hour[steps])
        return StretchDraws(
            mean_mps=plant.gusts.mean_mps,
            gust=gust.result(),
            swing=swing,
            noise=noise,
            lost=lost,
            outage=outage,
            pattern=pattern,
            spread=spread,
            bias=bias,
        )

    def _outage(self, hour: FloatArray) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64]]:
        """Return which outage has taken the radio (pattern, step), from 1, 0 none; and each mirror's pattern."""
        n, outages = len(self.field), self.scenario.tracking.radio.outages
        hit = np.zeros((n, len(outages)), np.bool_)
        for i, outage in enumerate(outages):
            hit[:, i] = generator(self.plant.seed, 8, i).random(n) < outage.share
        who, pattern = np.unique(hit, axis=0, return_inverse=True)
        out = np.zeros((len(who), len(hour)), np.uint8)
        for i, outage in enumerate(outages):
            dark = (hour >= outage.first_hour) & (hour < outage.last_hour)
            out[who[:, i, None] & dark] = i + 1
        return out, pattern.reshape(n)

    # -- by several ----------------------------------------------------------------------------------------

    def portions(self, n_at_once: int) -> list[Portion]:
        """Return what can be begun, in portions for so many workers, who learn first; a day under way begins anew.

        A method that learns takes its model from day to day: of it there is the next day alone, see `following`. Days
        of the others depend on nothing but the seed; where there are fewer days than workers, their methods are shared
        out, too.
        """
        self.done, n_day, learning, days = 0, len(self.days), [], []
        for method in self.methods:
            self._runs[method.name].drop_today()
            if method.learns and not self._over[method.name].all():
                learning.append(
                    Portion(methods=(method.name,), i_day=int(self._over[method.name].argmin()), learns=True)
                )
        for i_day in range(n_day):
            left = [m.name for m in self.methods if not m.learns and not self._over[m.name][i_day]]
            n_group = min(len(left), max(1, -(-n_at_once // n_day)))
            groups = (tuple(left[i::n_group]) for i in range(n_group))
            days += [Portion(methods=group, i_day=i_day) for group in groups]
        return learning + days

    def following(self, portion: Portion) -> list[Portion]:
        """Return what can be begun when a portion was taken: the next day of a method that learns."""
        goes_on = portion.learns and portion.i_day + 1 < len(self.days)
        return [replace(portion, i_day=portion.i_day + 1)] if goes_on else []

    def learned(self, portion: Portion) -> dict[str, Arrays]:
        """Return what a portion's methods know from the day before, for `go_through`; it does not change any more."""
        evenings = {name: self._runs[name].evening() for name in portion.methods}
        return {name: {k: v.copy() for k, v in arrays.items()} for name, arrays in evenings.items()}

    @property
    def n_over(self) -> int:
        """Number of stretches of days that are over, counted once a method."""
        return sum(int(over[segment.i_day]) for over in self._over.values() for segment in self.segments)

    def go_through(self, portion: Portion, learned: Mapping[str, Mapping[str, npt.NDArray[Any]]]) -> dict[str, Arrays]:
        """Simulate a portion, of a simulation of its methods alone, and return what `take` wants."""
        for name in portion.methods:
            self._runs[name].resume_from(learned[name])
        self.done = next(i for i, segment in enumerate(self.segments) if segment.i_day == portion.i_day)
        while self.done < self.n_segment and self.segments[self.done].i_day == portion.i_day:
            self.advance()
        return {name: self._runs[name].part(*self._place_of(portion)) for name in portion.methods}

    def take(self, portion: Portion, found: Mapping[str, Mapping[str, npt.NDArray[Any]]]) -> None:
        """Take over a portion that another simulation with the same arguments went through."""
        days, times = self._place_of(portion)
        for name in portion.methods:
            self._runs[name].put(days, times, found[name])
            self._over[name][days] = True

    def _place_of(self, portion: Portion) -> tuple[slice, slice]:
        """Return a portion's day, and its times among all instants kept."""
        ends = np.cumsum([0, *(-(-len(day.unix_s) // self._stride) for day in self.days)])
        i = portion.i_day
        return slice(i, i + 1), slice(int(ends[i]), int(ends[i + 1]))

    # -- results -------------------------------------------------------------------------------------------

    def sums(self, name: str) -> MethodSums:
        """Return what a method's mirrors have added up to so far."""
        return self._runs[name].sums()

    def curves(self, name: str) -> Curves:
        """Return a method's courses so far."""
        return self._runs[name].curves()

    def happened(self, name: str) -> list[dict[str, Any]]:
        """Return what a method's field control has to tell of each day that is over; empty without field control."""
        return [each for each in self._runs[name].happened if each is not None]

    # -- interruption --------------------------------------------------------------------------------------

    def state(self) -> Arrays:
        """Return all that going on depends on."""
        found: Arrays = {"done": np.array(self.done), "gust": self._gust_state}
        for name, run in self._runs.items():
            found |= {f"{name}/{part}": values for part, values in run.arrays().items()}
            found[f"{name}/over"] = self._over[name]
        return found

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go back to what `state` gave, of a run with the same arguments."""
        self.done = int(state["done"])
        self._gust_state[:] = state["gust"]
        i_day = self.segments[max(self.done - 1, 0)].i_day
        for name, run in self._runs.items():
            place = f"{name}/"
            run.restore({k[len(place) :]: v for k, v in state.items() if k.startswith(place)}, i_day)
            self._over[name][:] = state[f"{place}over"]
