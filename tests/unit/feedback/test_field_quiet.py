"""Stepping a field's control only where something happens, and counting what its buses carry."""

import dataclasses
import json

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.feedback.fieldcontrol.bus import BusSettings, MessageStatus
from rfpose.feedback.fieldcontrol.control import ControlledField, FieldSettings, Orders
from rfpose.feedback.fieldcontrol.modes import Mode, ModeEvent
from rfpose.feedback.fieldcontrol.motion import move_axes

EARTH_RAD_S = 2.0 * np.pi / 86400.0
SECONDS = 150
# a report holds the axes of the step that took it up
DIFFERS = "wire.reported_axis_rad"


class World:
    """What happens to a field, second by second, drawn from a seed; twins of the field live in the same world."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.seed = seed
        self.n = n = int(rng.integers(1, 40))
        self.bus = BusSettings(
            cluster_size=int(rng.choice([4, 32])),
            control_interval_s=float(rng.choice([4.0, 4.0, 3.3])),
            lost=float(rng.choice([0.0, 0.02, 0.3])),
            bit_error_rate=float(rng.choice([0.0, 1e-3, 2e-2])),
            late=float(rng.choice([0.0, 0.05, 0.3])),
            late_s=float(rng.choice([0.3, 3.0])),
        )
        self.settings = FieldSettings(
            watchdog_intervals=float(rng.choice([1.2, 2.0, 3.0])),
            emergency_hold_s=5.0,
            centre_silence_s=13.0,
            search_dwell_s=1.0,
            search_cells=9,
            wind_release_s=17.0,
            wind_gap_s=9.0,
        )
        self.mode = rng.choice([Mode.STOW, Mode.POINT, Mode.TRACK, Mode.TRACK, Mode.DEFOCUS, Mode.IDLE, Mode.SEARCH], n)
        self.aim_axis = np.stack([rng.uniform(-1.0, 1.0, n), rng.uniform(0.3, 1.2, n)], axis=1)
        elevation = rng.choice([0.5, 0.5, 8e-3]) + rng.choice([-1.0, 1.0]) * EARTH_RAD_S * np.arange(SECONDS)
        self.sun = np.stack([np.cos(elevation), np.zeros(SECONDS), np.sin(elevation)], axis=1)
        self.found = rng.random((SECONDS, n)) < 0.1
        # wind and feedback change now and then; commands and failures come after a step
        rough = rng.choice([0.0, 0.3])
        self.wind = np.where(rng.random(SECONDS) < rough, rng.choice([9.0, 11.0, np.nan], SECONDS), 3.0)
        self.wind = np.repeat(self.wind[: SECONDS // 15], 15)
        self.feedback = np.repeat(rng.random((SECONDS // 15, n)) < rng.choice([0.0, 0.8, 1.0]), 15, axis=0)
        often = rng.choice([0.02, 0.06])
        self.happenings = {int(t): int(rng.integers(1 << 30)) for t in np.flatnonzero(rng.random(SECONDS) < often)}
        every = np.arange(SECONDS)
        # wind that changes must be stepped to before, feedback not
        self.changes = np.unique([*self.happenings, *every[::15], *every[14::15], SECONDS - 1])

    def twin(self):
        return Twin(self)

    def next_change(self, second):
        """Return how far a step from here may go before something is done to the field or its wind changes."""
        return int(self.changes[np.searchsorted(self.changes, second, side="right")])


class Twin:
    """A field whose axes are moved each second, and whose control is stepped when it is told to."""

    def __init__(self, world):
        n = world.n
        self.world = world
        self.control = ControlledField(
            aim_enu_m=[0.0, 0.0, 60.0],
            pivot_enu_m=np.stack([np.linspace(-90.0, 90.0, n), np.full(n, -80.0), np.full(n, 2.0)], axis=1),
            calibration_enu_m=[0.0, 0.0, 45.0],
            settings=world.settings,
            bus=world.bus,
            mode=world.mode,
            rng=np.random.default_rng(world.seed + 1000),
        )
        self.axis = np.where(world.mode[:, None] == Mode.STOW, 0.0, world.aim_axis)
        self.orders = None

    def move(self, second):
        target = self.orders.target_axis_rad
        aim = self.world.aim_axis + 1e-4 * second
        self.axis = move_axes(self.axis, np.where(np.isnan(target), aim, target), 1.0, rate_rad_s=0.1)

    def step(self, second):
        world = self.world
        self.orders = self.control.step(
            float(second),
            axis_rad=self.axis,
            aim_axis_rad=world.aim_axis,
            sun_enu=world.sun[second],
            wind_mps=float(world.wind[second]),
            feedback_valid=world.feedback[second],
            found=world.found[second],
        )
        if second in world.happenings:
            self.disturb(np.random.default_rng(world.happenings[second]))

    def disturb(self, rng):
        control = self.control
        some = np.flatnonzero(rng.random(self.world.n) < 0.4)
        dark = control.mode == Mode.POWER_LOSS
        what = rng.choice(["command", "command", "command", "cluster", "centre", "power", "alarm", "well", "well"])
        if what == "command":
            control.command(ModeEvent(rng.integers(0, ModeEvent.ZERO_COUNTS + 1)), some)
        elif what == "cluster":
            (control.fail_cluster if rng.random() < 0.4 else control.repair_cluster)(0)
        elif what == "centre":
            (control.fail_centre if rng.random() < 0.4 else control.repair_centre)()
        elif what == "power":
            if dark.any():
                control.power_on(dark, counts_kept=bool(rng.random() < 0.7))
            else:
                control.power_off(some)
        elif what == "alarm":
            control.repair_centre()
            control.emergency()
        else:
            control.repair_centre()
            control.release()
            for cluster in np.unique(control.cluster):
                control.repair_cluster(int(cluster))
            control.power_on(dark)
            control.command(ModeEvent.APPROACH)
            control.command(ModeEvent.REFOCUS)


def differing(one, other):
    """Return what is not the same to the last bit in the states of two twins and in what they ordered last."""
    first, second = one.control.state(), other.control.state()
    for state, twin in ((first, one), (second, other)):
        state.update((f.name, np.asarray(getattr(twin.orders, f.name))) for f in dataclasses.fields(Orders))
    assert first.keys() == second.keys()
    return {name for name in first if first[name].tobytes() != second[name].tobytes()} - {DIFFERS}


@pytest.mark.parametrize("seed", range(60))
def test_one_step_over_a_quiet_time_equals_a_step_each_second(seed):
    world = World(seed)
    fine, rare = world.twin(), world.twin()
    for twin in (fine, rare):
        twin.step(0)
    now = 0
    while now < SECONDS - 1:
        goal = min((now // 4 + 1) * 4, world.next_change(now))
        then = max(int(rare.control.quiet_until(goal)), now + 1)
        assert then <= goal
        for second in range(now + 1, then + 1):
            fine.move(second)
            fine.step(second)
            rare.move(second)
        rare.step(then)
        now = then
        assert differing(fine, rare) == set()


def _calm(n=40, *, mode=Mode.TRACK, settings=None, **bus):
    control = ControlledField(
        aim_enu_m=[0.0, 0.0, 60.0],
        pivot_enu_m=np.stack([np.arange(n), np.full(n, -80.0), np.zeros(n)], axis=1),
        mode=mode,
        bus=BusSettings(**bus),
        settings=settings,
        rng=np.random.default_rng(3),
    )
    return control, {"axis_rad": np.full((n, 2), 0.5), "aim_axis_rad": np.full((n, 2), 0.5), "sun_enu": [0.0, 0.6, 0.8]}


@pytest.mark.parametrize("mode", [Mode.TRACK, Mode.POINT, Mode.DEFOCUS, Mode.STOW, Mode.IDLE])
def test_a_calm_field_is_quiet_from_round_to_round(mode):
    control, inputs = _calm(mode=mode)
    assert control.quiet_until(4.0) == 0.0  # nothing was seen yet
    control.step(0.0, **inputs, feedback_valid=mode == Mode.TRACK)
    control.step(1.0, **inputs, feedback_valid=mode == Mode.TRACK)
    assert control.quiet_until(1.5) == 1.5
    for until in (4.0, 8.0, 12.0, 16.0):
        assert control.quiet_until(100.0) == until
        control.step(until, **inputs, feedback_valid=mode == Mode.TRACK)
    with pytest.raises(InvalidInputError, match="`time_s` must not go back, got 15"):
        control.quiet_until(15.0)


def test_wind_may_vary_below_the_limit():
    fine, inputs = _calm(lost=0.1)
    rare, _ = _calm(lost=0.1)
    wind = np.random.default_rng(2).uniform(0.0, 9.99, 121)
    wind[100] = 10.0
    n_jump, now = 0, 0
    for control in (fine, rare):
        control.step(0.0, **inputs, wind_mps=wind[0])
    while now < 120:
        then = max(int(rare.quiet_until(now // 4 * 4 + 4)), now + 1)
        n_jump += then > now + 1
        for second in range(now + 1, then + 1):
            fine.step(second, **inputs, wind_mps=wind[second])
        rare.step(then, **inputs, wind_mps=wind[then])
        now = then
        one, other = fine.state(), rare.state()
        for name in one.keys() - {"centre"}:
            np.testing.assert_array_equal(one[name], other[name], name)
        one, other = (json.loads(bytes(state["centre"])) for state in (one, other))
        assert one["rng"] == other["rng"]
        assert one["alarms"] == other["alarms"]
        assert one["times_s"][:2] == other["times_s"][:2]
    assert n_jump > 20
    assert fine.alarms == ("strong wind",)


def test_sun_near_its_limit_is_not_quiet():
    control, inputs = _calm(settings=FieldSettings(sun_lowest_rad=0.1))
    for second, elevation in ((0.0, 0.2), (4.0, 0.1005), (8.0, 0.0995), (12.0, 0.0)):
        sun = [np.cos(elevation), 0.0, np.sin(elevation)]
        control.step(second, **(inputs | {"sun_enu": sun}))
        if second > 0.0 and abs(elevation - 0.1) < 1e-3:
            assert control.quiet_until(second + 4.0) == second
    assert control.alarms == ("sun below the horizon",)


def test_forged_messages_are_not_quiet_until_they_are_heard():
    control, inputs = _calm(n=3200, bit_error_rate=2e-3, settings=FieldSettings(watchdog_intervals=50.0))
    control.step(0.0, **inputs)
    control.step(1.0, **inputs)
    before = control.messages
    control.step(4.0, **inputs)
    assert control.messages.question_undetected > before.question_undetected
    assert not np.any(control.mode != Mode.TRACK)
    assert control.quiet_until(8.0) == 4.0
    control.step(5.0, **inputs)
    assert control.quiet_until(8.0) == 8.0


def test_ends_of_the_centres_clocks_are_stepped_to():
    settings = FieldSettings(wind_release_s=30.0, wind_gap_s=20.0, centre_silence_s=10.0)
    control, inputs = _calm(mode=Mode.STOW, settings=settings)

    def until(now, **changes):
        control.step(now, **inputs, **changes)
        return control.quiet_until(now + 4.0)

    for now in (0.0, 1.0):
        until(now, wind_mps=10.0)
    assert control.alarms == ("strong wind",)
    until(4.0, wind_mps=10.0)  # stow is ordered
    until(8.0, wind_mps=10.0)
    assert [until(now, wind_mps=7.0) - now for now in (28.0, 32.0, 36.0)] == [4.0, 4.0, 0.0]
    assert until(38.0, wind_mps=7.0) == 40.0  # the next round
    assert control.alarms == ()
    assert [until(now, wind_mps=np.nan) - now for now in (52.0, 56.0)] == [4.0, 0.0]
    control.step(56.0, **inputs)
    control.fail_centre()
    assert [until(now, wind_mps=20.0) - now for now in (60.0, 64.0)] == [4.0, 0.0]
    control.repair_centre()
    assert control.quiet_until(65.0) == 64.0  # the first look at the wind is to come
    until(64.0, wind_mps=20.0)
    assert control.alarms == ("strong wind",)


def test_an_order_that_cannot_arrive_does_not_keep_the_field_awake():
    control, inputs = _calm(n=64, mode=Mode.STOW)
    control.fail_cluster(0)
    control.power_off([40])
    control.step(0.0, **inputs)
    control.step(1.0, **inputs)
    reply = control.command(ModeEvent.APPROACH, [3, 40, 50])  # the centre does not know what was heard last
    assert reply.accepted.sum() == 3
    assert control.quiet_until(4.0) == 4.0  # the third waits for the next round
    control.step(4.0, **inputs)
    assert control.quiet_until(8.0) == 4.0
    for second in (5.0, 6.0, 7.0):  # it is on its aim already: at once on its way, there, and tracking
        control.step(second, **inputs)
    assert np.flatnonzero(control.mode == Mode.TRACK).tolist() == [50]
    assert np.flatnonzero(control.waiting).tolist() == [3, 40]
    control.command(ModeEvent.STOW, [50])
    for second in np.arange(8.0, 28.0):  # longer than the watchdog waits: to stowed heliostats silence does nothing
        control.step(second, **(inputs | {"axis_rad": np.zeros((64, 2))}))
    for now, until in ((27.5, 28.0), (28.0, 32.0)):
        control.step(now, **inputs)
        assert control.quiet_until(until) == until


def test_messages_are_counted_by_what_became_of_them():
    control, inputs = _calm(n=640, lost=0.1, bit_error_rate=1e-3, late=0.05)
    control.fail_cluster(3)
    n_round = 30
    for i in range(n_round):
        control.step(4.0 * i, **inputs)
        assert sum(control.messages.as_dict()[f"sun_{s.name.lower()}"] for s in MessageStatus) == 640 * (i + 1)
    got = control.messages
    total, dead = 640 * n_round, 32 * n_round
    live = total - dead
    assert got.sun_silent == got.question_silent == dead
    assert got.sun_late == got.question_late == 0
    # five sigma of a binomial
    assert abs(got.sun_lost - 0.1 * live) < 5.0 * np.sqrt(0.09 * live)
    assert abs(got.question_lost - 0.1 * live) < 5.0 * np.sqrt(0.09 * live)
    assert got.answer_silent == dead + got.question_lost + got.question_corrupted
    heard = total - got.answer_silent
    assert abs(got.answer_lost - 0.1 * heard) < 5.0 * np.sqrt(0.09 * heard)
    assert got.answer_late > 0
    assert got.watchdog_emergencies >= 32
    for what in ("sun", "question", "answer"):
        assert sum(getattr(got, f"{what}_{status.name.lower()}") for status in MessageStatus) == total
    other, _ = _calm(n=640)
    other.restore(control.state())
    assert other.messages == got
    assert all(type(count) is int for count in other.messages.as_dict().values())


def test_orders_are_counted_once_and_refusals_by_heliostats_too():
    control, inputs = _calm(n=12)
    control.step(0.0, **inputs)
    control.command(ModeEvent.POINT, [0, 1, 2])
    control.command(ModeEvent.POINT, [2, 3])  # on its way to one of them already
    assert control.messages.orders_sent == 4
    control.power_off([0])
    control.power_on([0])  # IDLE, which the centre does not know
    assert control.command(ModeEvent.HOLD, [0]).reasons
    for second in range(1, 12):
        control.step(float(second), **inputs)
    got = control.messages
    assert got.orders_sent == 4
    assert got.orders_refused == 1
    assert got.watchdog_emergencies == 0
    control.emergency()
    assert control.messages.orders_sent == 16


def test_emergencies_by_the_watchdog_are_counted_and_those_by_order_are_not():
    control, inputs = _calm(n=64)
    for second in range(8):
        control.step(float(second), **inputs)
    control.fail_cluster(1)
    for second in range(8, 30):
        control.step(float(second), **inputs)
    assert control.messages.watchdog_emergencies == 32
    control.emergency()
    for second in range(30, 40):
        control.step(float(second), **inputs)
    assert control.messages.watchdog_emergencies == 32
