"""A day under field control: what each mirror of one method is told, from stow to stow, and what happens on the way.

`rfpose.feedback.fieldcontrol` has the modes, the buses and the local controllers. Here stand the plant's programme (out
of stow in the morning, back in the evening and again once an alarm is over), the events of the scenario, calibrations
on the target, and the link to the kernel that moves the mirrors.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.feedback.columns import constant
from rfpose.feedback.fieldcontrol.bus import BusSettings
from rfpose.feedback.fieldcontrol.control import ControlledField, FieldSettings, Orders
from rfpose.feedback.fieldcontrol.modes import Mode, ModeEvent
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.campaign import Campaign
from rfpose.feedback.tracking.hidden import HiddenField, generator
from rfpose.feedback.tracking.plant import Plant
from rfpose.feedback.tracking.postures import aim_count
from rfpose.feedback.tracking.timeline import Day
from rfpose.feedback.tracking.watch import AlarmWatch
from rfpose.feedback.tracking.wind import Gusts
from rfpose.scenario import Scenario
from rfpose.scenario.tracking import Event as Happening

__all__ = ["Operation", "who_of"]

_SILENT_FRAMES = 5.0
_WORDS_AHEAD = 4
"""Control intervals that are told at once while nothing happens; so much later may a mode show that radio is lost."""
_COMMANDS = {
    "stow": ModeEvent.STOW,
    "approach": ModeEvent.APPROACH,
    "point": ModeEvent.POINT,
    "track": ModeEvent.TRACK,
    "defocus": ModeEvent.DEFOCUS,
    "refocus": ModeEvent.REFOCUS,
    "hold": ModeEvent.HOLD,
    "zero-counts": ModeEvent.ZERO_COUNTS,
}
_FOLLOWS = np.isin(np.arange(len(Mode)), [Mode.POINT, Mode.TRACK, Mode.CALIBRATE, Mode.SEARCH, Mode.DEFOCUS])
_ON_RECEIVER = np.isin(np.arange(len(Mode)), [Mode.POINT, Mode.TRACK])
_BACK = (Mode.STOW, Mode.STOWING, Mode.POWER_LOSS, Mode.FAULT)


class Operation:
    """One day of one method under field control.

    Parameters
    ----------
    plant
        The field; all methods begin the day with the same buses.
    i_day
        Which of its days.
    feedback
        What the method measures, by the kernels' number.
    """

    def __init__(self, plant: Plant, i_day: int, *, feedback: int) -> None:
        scenario, field, day = plant.scenario, plant.field, plant.days[i_day]
        plan = scenario.tracking
        assert plan.field_control is not None
        self._plan, self._field, self._day, self._feedback, self._seed = plan, field, day, feedback, plant.seed
        self._servo_s = plan.servo_interval_s
        self._interval = round(plan.control_interval_s / self._servo_s)
        self._held = plan.field_control.between_messages == "held"
        n = len(field)
        step_rad = 2.0 * np.pi / plan.drive.steps_per_turn * (plan.drive.microsteps + plan.drive.dead_band_steps)
        self.control = ControlledField(
            aim_enu_m=field.target[:, :3],
            pivot_enu_m=field.pivot_enu_m,
            calibration_enu_m=plan.calibration_target_enu_m,
            settings=settings_of(scenario, arrived_rad=max(2e-3, 2.0 * step_rad)),
            bus=bus_of(scenario),
            mode=Mode.STOW if day.from_stow else Mode.TRACK,
            rng=generator(plant.seed, 40, i_day),
        )
        self._wind_mps = _Wind(plant.gusts, round(plan.field_control.wind_average_s / self._servo_s), day)
        self._events = _agenda(plan.event, day, i_day + 1, field, plan.field_control.bus.cluster_size)
        self._works_until = int(np.flatnonzero(day.works)[-1])
        self._home = constant(field.constant, "angle_at_zero_rad").copy()
        self._per_rad = constant(field.constant, "counts_per_unit")
        # the turn on which the park position lies within half a turn of the middle of the travel
        parked = self.control.settings.stow_axis_rad[0]
        self._home[:, 0] -= 2.0 * np.pi * np.rint((self._home[:, 0] - parked) / (2.0 * np.pi))
        self.campaign = Campaign(scenario, field, feedback=feedback, seed=plant.seed)
        self.watch = AlarmWatch(n)
        self._out = np.ones(n, np.bool_)
        self._next_event = 0
        self._last_duty = np.full(n, -1, np.int64)
        self._last_aim = np.full((n, 3), np.nan)
        self._last_mode = self.control.mode
        self._ahead: Orders | None = None
        self.log: list[dict[str, Any]] = []
        self.homing_rad = np.zeros((n, 2))

    # -- beginning -----------------------------------------------------------------------------------------

    def park(self, state: FloatArray) -> None:
        """Put motors where they stand in stow, if the day begins there."""
        if not self._day.from_stow:
            return
        stow = (np.array(self.control.settings.stow_axis_rad) - self._home) * self._per_rad
        step = float(self._plan.drive.microsteps)
        for at in (_kernels.MOTOR, _kernels.AXIS, _kernels.GOAL):
            state[:, at : at + 2] = np.rint(stow / step) * step
        state[:, _kernels.STARTED] = 1.0

    # -- going on ------------------------------------------------------------------------------------------

    def tell(self, s: int, stretch: _kernels.Stretch) -> tuple[int, _kernels.Tasks]:
        """Let messages pass until step ``s`` of the day; return what mirrors are to do from there on, and until when.

        For a second; for the rest of the control interval if all is quiet; for some intervals if it stays so; never
        beyond the stretch. Light is that of the step before; a calibration changes the models, a homing the counts.
        """
        state, light, model = stretch.memory.state, stretch.memory.light, stretch.models.parameters
        gust = stretch.surroundings.gust
        end = stretch.step0 + len(stretch.surroundings.power)

        def step(at: int) -> Orders:
            return self.control.step(
                at * self._servo_s,
                axis_rad=axis,
                aim_axis_rad=aim_axis,
                # held, a sun counts from the interval after it was sent: the centre says where it will be then
                sun_enu=self._day.sun_enu[at + (self._interval if self._held else 0)],
                wind_mps=self._wind_mps.at(at, stretch.step0, gust),
                feedback_valid=self._valid(state),
                found=self.campaign.found,
            )

        axis = self._home + state[:, _kernels.MOTOR : _kernels.MOTOR + 2] / self._per_rad
        aim_axis = np.full(axis.shape, np.nan)
        orders, self._ahead = self._ahead, None
        if orders is None:
            self._let_happen(s, light, axis)
            self._programme(s)
            self.campaign.proceed(self.control, s, self._day, self._last_aim, state, model, stretch.mounts.true)
            aim_axis = self._aim_axis_rad(s, state, model)
            orders = step(s)
        self._home_counts(orders.mode, state, s)
        self.watch.observe(s * self._servo_s, orders.mode, light, orders.alarms)
        words = [orders]
        until, quiet = self._holds_until(s)
        while quiet and len(words) < _WORDS_AHEAD and until < end and self._calm(until):
            later = step(until)
            if later.changed.any() or later.alarms != orders.alarms:
                self._ahead = later
                break
            words.append(later)
            until, quiet = self._holds_until(until)
        return min(until, end), self._tasks(words, s, state)

    def _calm(self, s: int) -> bool:
        """Whether nothing but messages goes on at the control interval that begins at step ``s``."""
        waits = self.campaign.active or self.watch.open or self._due(s) or s > self._works_until
        return s % self._interval == 0 and not waits

    def _due(self, s: int) -> bool:
        return self._next_event < len(self._events) and self._events[self._next_event][0] <= s

    def _holds_until(self, s: int) -> tuple[int, bool]:
        """Return the step up to which a word holds: a second, or the rest of a control interval; and if it is quiet."""
        tick = (s // self._interval + 1) * self._interval
        if self._next_event < len(self._events):
            tick = min(tick, max(self._events[self._next_event][0], s + 1))
        quiet = self.control.quiet_until(tick * self._servo_s) >= tick * self._servo_s and not self.watch.open
        return (tick if quiet else s + 1), quiet

    def end(self) -> None:
        """Close what is under way at the end of the day."""
        self.watch.close()
        for _, event, who in self._events[self._next_event :]:
            late = {"the field's day was over": int(who.sum())}
            self.log.append({"what": event.what, "hour": event.hour, "heliostats": int(who.sum()), "refused": late})
        self._next_event = len(self._events)

    def report(self) -> dict[str, Any]:
        """Return the day in plain values: events, alarms, calibrations, messages."""
        return {
            "events": self.log,
            "alarms": [each | {"hour": self._hour(each["at_s"])} for each in self.watch.found],
            "calibrations": [each | {"hour": self._hour(each["at_s"])} for each in self.campaign.results],
            "messages": self.control.messages.as_dict(),
        }

    def _hour(self, at_s: float) -> float:
        """Return local mean solar time so long after the day's first step [h]."""
        return float(self._day.hour[round(at_s / self._servo_s)])

    def _tasks(self, words: list[Orders], s: int, state: FloatArray) -> _kernels.Tasks:
        orders = words[0]
        mode = orders.mode.astype(np.int64)
        follows = _FOLLOWS[mode] & np.isfinite(orders.sun_enu).all(axis=1)
        duty = np.where(follows, np.where(mode == int(Mode.POINT), _kernels.FOLLOW, _kernels.TRACK), _kernels.GO)
        aim = np.where(follows[:, None], orders.aim_enu_m, self._field.target[:, :3])
        goal = (orders.target_axis_rad - self._home) * self._per_rad
        # who has not heard of the sun yet stands
        goal = np.where(np.isfinite(goal), goal, state[:, _kernels.MOTOR : _kernels.MOTOR + 2])
        renew = follows & ((self._last_duty == _kernels.GO) | (aim != self._last_aim).any(axis=1))
        self._last_duty, self._last_aim = duty, aim
        age, heard = np.empty((len(mode), len(words))), np.empty((len(mode), len(words), 3))
        for i, word in enumerate(words):
            age[:, i] = word.sun_age_s / self._servo_s - (word.time_s / self._servo_s - s)
            heard[:, i] = word.sun_enu
        if not follows.all():
            age[~follows], heard[~follows] = 0.0, 0.0
        return _kernels.Tasks(
            duty=duty,
            renew=renew.astype(np.uint8),
            scored=(_ON_RECEIVER[mode] & follows).astype(np.uint8),
            mode=mode,
            aim=aim,
            goal=goal,
            heard=heard,
            age=age,
        )

    def _valid(self, state: FloatArray) -> npt.NDArray[np.bool_]:
        """Whether normals are measured: single lost frames do not count."""
        if self._feedback == _kernels.NO_FEEDBACK:
            return np.zeros(len(state), np.bool_)
        most = _SILENT_FRAMES if self._feedback == _kernels.RADIO else 0.0
        return np.asarray(state[:, _kernels.SILENT] <= most)

    def _aim_axis_rad(self, s: int, state: FloatArray, model: FloatArray) -> FloatArray:
        """Where mirrors on approach have to go, by their method's model; NaN for the others."""
        axis = np.full((len(state), 2), np.nan)
        index = np.flatnonzero(self.control.mode == int(Mode.APPROACH))
        if index.size:
            count, _ = aim_count(
                model[index], self._field.constant[index], self._day.sun_enu[s], self._field.target[index]
            )
            turn = 2.0 * np.pi * self._per_rad[index, 0]
            count[:, 0] += turn * np.rint((state[index, _kernels.NEXT] - count[:, 0]) / turn)
            axis[index] = self._home[index] + count / self._per_rad[index]
        return axis

    # -- what the plant orders -----------------------------------------------------------------------------

    def _programme(self, s: int) -> None:
        """Send mirrors out by day and into stow when the day is over."""
        if self.control.centre_dead:
            return
        reported, free = self.control.reported_mode, ~self.control.waiting
        if s > self._works_until:
            self._order(ModeEvent.STOW, free & ~np.isin(reported, _BACK))
        elif not self.control.alarms:
            self._order(ModeEvent.APPROACH, free & self._out & (reported == int(Mode.STOW)))
            self._order(ModeEvent.STOW, free & self._out & (reported == int(Mode.IDLE)))

    def _order(self, command: ModeEvent, to: npt.NDArray[np.bool_]) -> None:
        if to.any():
            self.control.command(command, to)

    def _let_happen(self, s: int, light: FloatArray, axis_rad: FloatArray) -> None:
        while self._due(s):
            _, event, who = self._events[self._next_event]
            self._next_event += 1
            entry: dict[str, Any] = {"what": event.what, "hour": event.hour, "heliostats": int(who.sum())}
            reasons = self._do(event, who, axis_rad)
            if reasons:
                entry["refused"] = reasons
            elif event.what == "emergency":
                self.watch.begin(s * self._servo_s, "emergency", light)
            self.log.append(entry)

    def _do(self, event: Happening, who: npt.NDArray[np.bool_], axis_rad: FloatArray) -> dict[str, int]:
        """Let an event happen; return how many mirrors refuse an order, by reason."""
        control = self.control
        if event.what in _COMMANDS:
            if event.what in ("stow", "hold", "approach"):
                self._out[who] = event.what == "approach"
            return _counted(control.command(_COMMANDS[event.what], who).reasons)
        if event.what == "calibrate":
            self.campaign.queue(np.flatnonzero(who))
        elif event.what in ("emergency", "release", "centre-fails", "centre-returns"):
            if control.centre_dead and event.what == "emergency":
                return {"the centre is dead": len(who)}
            {"emergency": control.emergency, "release": control.release, "centre-fails": control.fail_centre,
             "centre-returns": control.repair_centre}[event.what]()  # fmt: skip
        elif event.what == "power-fails":
            control.power_off(who, axis_rad=axis_rad)
        elif event.what == "power-returns":
            control.power_on(who & (control.mode == Mode.POWER_LOSS))
        elif event.what == "counts-lost":
            control.power_off(who, axis_rad=axis_rad)
            control.power_on(who, counts_kept=False)
        else:
            assert event.cluster is not None
            (control.fail_cluster if event.what == "cluster-fails" else control.repair_cluster)(event.cluster)
        return {}

    def _home_counts(self, mode: npt.NDArray[np.int8], state: FloatArray, s: int) -> None:
        """Mirrors whose counts were zeroed count from where the switch is, which is a little beside."""
        index = np.flatnonzero((self._last_mode == int(Mode.FAULT)) & (mode == int(Mode.IDLE)))
        self._last_mode = mode
        if not index.size:
            return
        assert self._plan.field_control is not None
        draw = generator(self._seed, 42, s).standard_normal((len(state), 2))[index]
        off = 1e-3 * self._plan.field_control.homing_sigma_mrad * draw
        self.homing_rad[index] += off
        for at in (_kernels.MOTOR, _kernels.AXIS, _kernels.GOAL):
            state[index, at : at + 2] -= off * self._per_rad[index]

    # -- interruption --------------------------------------------------------------------------------------

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return all that going on depends on."""
        text = {"log": self.log, "next": self._next_event}
        text |= {"campaign": self.campaign.text(), "watch": self.watch.text(), "wind": self._wind_mps.past}
        own = {
            "out": self._out, "duty": self._last_duty, "aim": self._last_aim, "mode": self._last_mode,
            "homing": self.homing_rad, "text": np.frombuffer(json.dumps(text).encode(), np.uint8).copy(),
        }  # fmt: skip
        parts = (("own", own), ("watch", self.watch.arrays()), ("control", self.control.state()))
        return {f"{part}.{name}": values for part, arrays in parts for name, values in arrays.items()}

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go back to what `state` gave, of the same day and method."""

        def part(name: str) -> dict[str, npt.NDArray[Any]]:
            return {key[len(name) + 1 :]: v for key, v in state.items() if key.startswith(f"{name}.")}

        own = part("own")
        self._out, self._last_duty, self._last_aim = own["out"].copy(), own["duty"].copy(), own["aim"].copy()
        self._last_mode, self.homing_rad = own["mode"].copy(), own["homing"].copy()
        text = json.loads(bytes(own["text"]).decode())
        self.log, self._next_event = text["log"], text["next"]
        self.campaign.restore(text["campaign"])
        self._wind_mps.past = text["wind"]
        self.watch.restore(part("watch"), text["watch"])
        self.control.restore(part("control"))


class _Wind:
    """Wind by the station, which stands at the first mirror, averaged as wind stow wants it.

    Only samples once a control interval or second come in, as field control is stepped; the average is over those.
    """

    def __init__(self, gusts: Gusts, n_average: int, day: Day) -> None:
        self._gusts, self._n_average = gusts, max(n_average, 1)
        self._known = gusts.known(day.unix_s)
        self.past: list[tuple[int, float, float]] = []
        """Step and speed of each sample, and the way of the wind from the day's first one up to it [m/s · steps]."""

    def at(self, s: int, first_of: int, gust: npt.NDArray[np.float32]) -> float:
        """Return the average up to a step [m/s]; NaN: unknown now."""
        speed, past = float(self._gusts.speed_mps(np.asarray(gust[0, s - first_of], np.float64))), self.past
        # each sample stands for the time until the next one
        way = past[-1][2] + past[-1][1] * (s - past[-1][0]) if past else 0.0
        past.append((s, speed, way))
        while past[0][0] <= s - self._n_average:
            del past[0]
        if not self._known[s]:
            return float("nan")
        total, length = way + speed - past[0][2], s + 1 - past[0][0]
        if not self._gusts.recorded and length < self._n_average:
            # before the day's first step the wind was what it is on the average
            total, length = total + (self._n_average - length) * self._gusts.mean_mps, self._n_average
        return total / length


def bus_of(scenario: Scenario) -> BusSettings:
    """Return the buses of a scenario with field control."""
    plan = scenario.tracking
    assert plan.field_control is not None
    return BusSettings(control_interval_s=plan.control_interval_s, **plan.field_control.bus.model_dump())


def settings_of(scenario: Scenario, *, arrived_rad: float) -> FieldSettings:
    """Return the behaviour of field control that a scenario asks for: what both know by the same name, as it stands."""
    plan = scenario.tracking.field_control
    assert plan is not None
    names = {f.name for f in dataclasses.fields(FieldSettings)}
    return FieldSettings(
        stow_axis_rad=(float(np.deg2rad(plan.stow_deg[0])), float(np.deg2rad(plan.stow_deg[1]))),
        arrived_rad=arrived_rad,
        search_step_m=0.5 * plan.calibration_target_m,
        **plan.model_dump(include=names),
    )


def who_of(event: Happening, field: HiddenField, cluster_size: int) -> npt.NDArray[np.bool_]:
    """Return which mirrors an event concerns (mirror,).

    Raises
    ------
    ScenarioError
        A name or a cluster that the field does not have.
    """
    n = len(field)
    if event.cluster is not None:
        n_cluster = -(-n // cluster_size)
        if event.cluster >= n_cluster:
            raise ScenarioError(
                f"event `{event.what}` at {event.hour:g} h names cluster {event.cluster}; {n} heliostats make clusters "
                f"0 to {n_cluster - 1}"
            )
        return np.asarray(np.arange(n) // cluster_size == event.cluster)
    if not event.heliostats:
        return np.ones(n, np.bool_)
    row = {name: i for i, name in enumerate(field.ids)}
    missing = [name for name in event.heliostats if name not in row]
    if missing:
        raise ScenarioError(
            f"event `{event.what}` at {event.hour:g} h names heliostat {missing[0]!r}, which is not tracked; tracked "
            f"are {field.ids[0]} to {field.ids[-1]}"
        )
    who = np.zeros(n, np.bool_)
    who[[row[name] for name in event.heliostats]] = True
    return who


def _agenda(
    events: tuple[Happening, ...], day: Day, number: int, field: HiddenField, cluster_size: int
) -> list[tuple[int, Happening, npt.NDArray[np.bool_]]]:
    """Return a day's events in order: step, event, whom it concerns."""
    found = []
    for event in events:
        who = who_of(event, field, cluster_size)
        if event.day in (None, number):
            found.append((int(np.searchsorted(day.hour, event.hour)), event, who))
    return sorted(found, key=lambda each: each[0])


def _counted(reasons: Mapping[int, str]) -> dict[str, int]:
    found: dict[str, int] = {}
    for why in reasons.values():
        found[why] = found.get(why, 0) + 1
    return found
