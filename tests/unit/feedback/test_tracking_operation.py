"""Parts of a day under field control: who and when, the watch over alarms, the wind station, the park position."""

import json
from pathlib import Path

import numpy as np
import pytest

from rfpose.cli.track import _event
from rfpose.errors import ScenarioError
from rfpose.feedback.columns import constant
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import TrackingSimulation, _kernels
from rfpose.feedback.tracking.operation import Operation, _agenda, _Wind, settings_of, who_of
from rfpose.feedback.tracking.timeline import days, ways_s
from rfpose.feedback.tracking.watch import AlarmWatch
from rfpose.feedback.tracking.wind import Gusts
from rfpose.scenario import load_scenario
from rfpose.scenario.tracking import Event

DATA = Path(__file__).resolve().parents[3] / "data" / "tracking_100m.toml"


def changed(*, events=(), **tracking):
    """The shipped scenario with keys of [tracking] replaced."""
    return load_scenario(DATA).changed(tracking={**tracking, "event": [_event(text) for text in events]})


# ---- who and when -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def field():
    return TrackingSimulation(changed(first_hour=11.5, last_hour=11.6), methods=("open-loop",), count=5).field


def test_events_concern_whom_they_name(field):
    assert who_of(Event(hour=9.0, what="stow"), field, 2).tolist() == [True] * 5
    assert who_of(Event(hour=9.0, what="stow", heliostats=("H04", "H01")), field, 2).tolist() == [
        True, False, False, True, False,
    ]  # fmt: skip
    assert who_of(Event(hour=9.0, what="stow", cluster=1), field, 2).tolist() == [False, False, True, True, False]
    assert who_of(Event(hour=9.0, what="cluster-fails", cluster=2), field, 2).tolist() == [False] * 4 + [True]
    with pytest.raises(ScenarioError, match=r"`stow` at 9\.5 h names cluster 3; 5 heliostats make clusters 0 to 2"):
        who_of(Event(hour=9.5, what="stow", cluster=3), field, 2)
    with pytest.raises(ScenarioError, match=r"`hold` at 9 h names heliostat 'H06', which is not tracked.*H01 to H05"):
        who_of(Event(hour=9.0, what="hold", heliostats=("H01", "H06")), field, 2)


def test_names_that_nobody_has_are_refused_before_the_first_second():
    for text, words in (("11.55 stow H99", "'H99', which is not tracked"), ("2:11.55 stow #7", "cluster 7")):
        with pytest.raises(ScenarioError, match=words):
            TrackingSimulation(changed(events=(text,), days=2, first_hour=11.5, last_hour=11.6), methods=("open-loop",))


def test_the_agenda_has_each_event_at_the_first_step_of_its_hour(field):
    (day,) = days(changed(first_hour=11.5, last_hour=11.9))
    events = tuple(
        Event(**_event(text))
        for text in ("11.8 release", "11.7 emergency", "2:11.6 stow", "1:11.75 hold H01", "3 track")
    )
    agenda = _agenda(events, day, 1, field, 32)
    assert [event.what for _, event, _ in agenda] == ["track", "emergency", "hold", "release"]
    for step, event, _ in agenda:
        assert day.hour[step] >= event.hour
        assert step == 0 or day.hour[step - 1] < event.hour
    second = [event.what for _, event, _ in _agenda(events, day, 2, field, 32)]
    assert second == ["track", "stow", "emergency", "release"]


@pytest.mark.parametrize(
    ("one", "other", "clash"),
    [
        ("9 stow", "9 defocus H01", True),
        ("9 stow H01", "9 defocus H01,H02", True),
        ("9 stow #0", "9 point #0", True),
        ("9 stow H01", "9 defocus H02", False),
        ("9 stow #0", "9 defocus #1", False),
        ("9 stow H01", "9.01 defocus H01", False),
        ("9 stow H01", "9 stow H01", False),
        ("1:9 stow H01", "2:9 defocus H01", False),
        ("1:9 stow H01", "9 defocus H01", True),
        ("9 emergency", "9 approach", True),
        ("9 cluster-fails #0", "9 emergency", False),
        ("9 power-returns H01", "9 stow H01", False),
    ],
)
def test_contradictions_of_the_same_time(one, other, clash):
    a, b = Event(**_event(one)), Event(**_event(other))
    assert a.contradicts(b) is clash
    assert b.contradicts(a) is clash


# ---- the beginning of a day ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("stow", [(0.0, 0.0), (180.0, 10.0), (-90.0, 90.0)])
def test_mirrors_are_parked_where_they_are_to_be_within_the_time_for_ways(stow):
    site = changed(field_control={"stow_deg": stow}, min_sun_elevation_deg=54.0)
    simulation = TrackingSimulation(site, methods=("open-loop",), count=8)
    field, day = simulation.field, simulation.days[0]
    assert day.from_stow
    operation = Operation(simulation.plant, 0, feedback=_kernels.NO_FEEDBACK)
    state = np.zeros((8, _kernels.N_STATE))
    operation.park(state)
    per_rad, home = (constant(field.constant, name) for name in ("counts_per_unit", "angle_at_zero_rad"))
    axis = home + state[:, _kernels.MOTOR : _kernels.MOTOR + 2] / per_rad
    off = np.mod(axis - np.deg2rad(stow) + np.pi, 2.0 * np.pi) - np.pi
    assert np.max(np.abs(off)) <= np.pi / 48_000.0 * (1.0 + 1e-9)
    assert np.all(state[:, _kernels.AXIS] == state[:, _kernels.MOTOR])
    # the turn nearest to the middle of the travel: the time for ways reckons with half a turn at most
    assert np.max(np.abs(axis[:, 0] - home[:, 0])) <= np.pi + np.pi / 48_000.0
    assert ways_s(site.tracking) > 1.5 * np.pi / 40e-3


def test_days_have_room_for_the_ways():
    way = ways_s(changed().tracking)
    assert way % 4.0 == 0.0
    whole, (plain,) = days(changed(min_sun_elevation_deg=50.0))[0], days(changed_without(min_sun_elevation_deg=50.0))
    assert whole.from_stow
    assert not whole.works[0]
    assert not whole.works[-1]
    at = np.flatnonzero(whole.works)
    assert plain.unix_s[0] - whole.unix_s[0] == way
    assert whole.unix_s[at[0]] == plain.unix_s[0]
    assert whole.unix_s[-1] - whole.unix_s[at[-1]] == pytest.approx(way, abs=4.0)
    assert plain.works.all()
    # hours that cut a day in the middle: mirrors are on their way already
    cut = days(changed(first_hour=11.0, last_hour=12.0))[0]
    assert not cut.from_stow
    assert cut.works.all()
    evening = days(changed(min_sun_elevation_deg=50.0, first_hour=12.0))[0]
    assert not evening.from_stow
    assert evening.works[0]
    assert not evening.works[-1]


def changed_without(**tracking):
    return load_scenario(DATA).changed(tracking={"field_control": None, **tracking})


def test_settings_go_through_to_field_control():
    site = changed(
        field_control={
            "stow_deg": (90.0, 10.0), "emergency_hold_s": 7.0, "watchdog_intervals": 5.0, "defocus_offset_m": 9.0,
            "calibration_target_m": 3.0, "search_dwell_s": 4.0, "search_cells": 25, "wind_stow_mps": 12.0,
            "wind_release_mps": 6.0, "wind_release_s": 99.0,
        }
    )  # fmt: skip
    found = settings_of(site, arrived_rad=3e-3)
    assert found.stow_axis_rad == pytest.approx((np.pi / 2.0, np.deg2rad(10.0)))
    assert (found.arrived_rad, found.emergency_hold_s, found.watchdog_intervals) == (3e-3, 7.0, 5.0)
    assert (found.defocus_offset_m, found.search_step_m, found.search_dwell_s, found.search_cells) == (
        9.0,
        1.5,
        4.0,
        25,
    )
    assert (found.wind_stow_mps, found.wind_release_mps, found.wind_release_s) == (12.0, 6.0, 99.0)


# ---- wind ---------------------------------------------------------------------------------------------------------


def record(tmp_path, day, speed):
    path = tmp_path / "wind.csv"
    rows = "".join(f"{day.unix_s[0] + i:.3f},{'' if np.isnan(v) else f'{v:.5f}'}\n" for i, v in enumerate(speed))
    path.write_text("unix_s,speed_mps\n" + rows)
    return path


def test_the_station_averages_what_it_sampled_and_knows_gaps(tmp_path):
    (day,) = days(changed(first_hour=11.5, last_hour=11.6))
    n = len(day.unix_s)
    speed = 5.0 + 2.0 * np.sin(np.arange(n + 100) / 20.0)
    speed[200:290] = np.nan
    gusts = Gusts(changed(first_hour=11.5, last_hour=11.6, wind={"record": str(record(tmp_path, day, speed))}))
    gust = gusts.run(np.zeros((2, 1)), np.random.default_rng(0), day.unix_s)
    each, coarse = _Wind(gusts, 60, day), _Wind(gusts, 60, day)
    for s in range(190):
        got = each.at(s, 0, gust)
        # a trailing mean of what there is
        assert got == pytest.approx(np.mean(speed[max(0, s - 59) : s + 1]), abs=2e-3)
    for s in range(0, 192, 4):
        got = coarse.at(s, 0, gust)
    # every fourth sample, the last for one second: the sine's mean to what 4 s of it change
    assert got == pytest.approx(np.mean(speed[s - 59 : s + 1]), abs=0.1)
    assert np.isnan(each.at(230, 0, gust))
    assert np.isfinite(each.at(292, 0, gust))
    # goes on after a stop: what JSON makes of the past is the past
    other = _Wind(gusts, 60, day)
    other.past = json.loads(json.dumps(coarse.past))
    assert other.at(196, 0, gust) == pytest.approx(coarse.at(196, 0, gust), rel=0.0) or np.isnan(other.at(197, 0, gust))


# ---- alarms -------------------------------------------------------------------------------------------------------

FULL = np.ones((3, 2))


def light(*caught):
    return np.array([[c, 1.0] for c in caught])


def modes(*each):
    return np.array([int(m) for m in each], np.int8)


ON, OUT, HOME, DEAD = Mode.TRACK, Mode.STOWING, Mode.STOW, Mode.POWER_LOSS


def test_an_alarm_is_followed_to_its_end():
    watch = AlarmWatch(3)
    watch.observe(0.0, modes(ON, ON, ON), FULL, ())
    watch.begin(100.0, "emergency", FULL)
    assert watch.open
    watch.observe(100.0, modes(ON, ON, ON), FULL, ("emergency",))
    watch.observe(104.0, modes(OUT, OUT, ON), light(0.0, 0.05, 1.0), ("emergency",))
    watch.observe(107.0, modes(OUT, OUT, OUT), light(0.0, 0.05, 0.2), ("emergency",))
    watch.observe(109.0, modes(OUT, OUT, OUT), light(0.0, 0.05, 0.09), ("emergency",))
    watch.observe(150.0, modes(HOME, OUT, OUT), light(0.0, 0.0, 0.0), ("emergency",))
    watch.observe(160.0, modes(HOME, HOME, OUT), light(0.0, 0.0, 0.0), ())
    assert watch.found == []
    watch.observe(190.0, modes(HOME, HOME, HOME), light(0.0, 0.0, 0.0), ())
    assert not watch.open
    assert watch.found == [
        {"alarm": "emergency", "at_s": 100.0, "below_tenth_s": 7.0, "off_s": 9.0, "stowed_median_s": 60.0,
         "stowed_s": 90.0}
    ]  # fmt: skip


def test_light_that_comes_back_counts_again():
    watch = AlarmWatch(3)
    watch.begin(0.0, "emergency", FULL)
    for at, left in ((2.0, 0.0), (4.0, 0.5), (8.0, 0.0)):
        watch.observe(at, modes(OUT, OUT, OUT), light(0.0, 0.0, left), ())
    watch.observe(50.0, modes(HOME, HOME, HOME), light(0.0, 0.0, 0.0), ())
    assert watch.found[0]["below_tenth_s"] == 8.0
    assert watch.found[0]["off_s"] == 8.0


def test_what_takes_too_long_is_told_as_not_reached_and_the_dead_are_not_waited_for():
    watch = AlarmWatch(3)
    watch.observe(0.0, modes(ON, ON, ON), FULL, ("strong wind",))
    assert watch.open
    watch.observe(40.0, modes(HOME, HOME, DEAD), light(0.0, 0.0, 0.9), ("strong wind",))
    (first,) = watch.found
    assert (first["alarm"], first["stowed_s"], first["stowed_median_s"]) == ("strong wind", 40.0, 40.0)
    assert first["below_tenth_s"] is None
    # the alarm goes on: no new one
    watch.observe(60.0, modes(HOME, HOME, HOME), FULL, ("strong wind",))
    assert not watch.open
    watch.observe(70.0, modes(ON, ON, ON), FULL, ())
    watch.observe(80.0, modes(ON, ON, ON), FULL, ("wind unknown",))
    watch.observe(1879.0, modes(HOME, OUT, HOME), light(0.0, 0.0, 0.0), ("wind unknown",))
    assert watch.open
    watch.observe(1880.0, modes(HOME, OUT, HOME), light(0.0, 0.0, 0.0), ("wind unknown",))
    assert watch.found[1]["stowed_s"] is None
    assert watch.found[1]["off_s"] == 1799.0
    # in the dark there is nothing to follow
    watch.begin(3000.0, "emergency", light(0.0, 0.0, 0.0))
    assert not watch.open
    watch.begin(3000.0, "emergency", FULL)
    watch.close()
    assert watch.found[2]["stowed_s"] is None
    assert watch.found[2]["below_tenth_s"] is None


def test_a_watch_goes_on_where_it_was():
    one, other = AlarmWatch(3), AlarmWatch(3)
    one.observe(5.0, modes(ON, ON, ON), FULL, ("centre silent",))
    one.observe(9.0, modes(OUT, OUT, OUT), light(0.0, 0.0, 0.5), ("centre silent",))
    other.restore({k: v.copy() for k, v in one.arrays().items()}, json.loads(json.dumps(one.text())))
    for watch in (one, other):
        watch.observe(12.0, modes(OUT, OUT, OUT), light(0.0, 0.0, 0.0), ("centre silent",))
        watch.observe(60.0, modes(HOME, HOME, HOME), light(0.0, 0.0, 0.0), ("centre silent",))
    # the same alarm, still on, is no new one for a watch that has gone on
    third = AlarmWatch(3)
    third.restore({k: v.copy() for k, v in one.arrays().items()}, json.loads(json.dumps(one.text())))
    third.observe(64.0, modes(ON, ON, ON), FULL, ("centre silent",))
    assert not third.open
    assert one.found == other.found
    assert one.found[0]["off_s"] == 7.0


# ---- tables that cannot be meant ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tracking", "events", "words"),
    [
        ({"field_control": {"wind_release_mps": 11.0}}, (), "`wind_release_mps` 11 must not exceed `wind_stow_mps` 10"),
        ({}, ("9 stow", "9 defocus H01"), "`stow` and `defocus` contradict each other: both at 9 h.*different times"),
        ({}, ("3:9 stow",), "`stow` is on day 3, and only 1 are simulated"),
        ({"collector": "dish"}, ("9 defocus",), "`defocus` is for heliostats"),
        ({"collector": "dish"}, ("9 calibrate",), "`calibrate` is for heliostats"),
        ({}, ("9 cluster-fails",), "`cluster-fails` at 9 h needs the number of a `cluster`"),
        ({}, ("9 cluster-returns H01",), "`cluster-returns` at 9 h needs the number of a `cluster`"),
        ({}, ("9 emergency H01",), "`emergency` at 9 h concerns the whole field"),
        ({}, ("9 release #0",), "`release` at 9 h concerns the whole field"),
        ({"structure": {"natural_hz": 0.3}}, (), r"`natural_hz` must be 0 \(stiff\) or at least 0.5, got 0.3"),
        ({"structure": {"damping": 0.0}}, (), "damping"),
        ({"field_control": {"between_messages": "guessed"}}, (), "between_messages"),
        ({"field_control": {"bus": {"lost": 1.0}}}, (), "lost"),
        ({}, ("25 stow",), "hour"),
        ({}, ("9 sleep",), "what"),
    ],
)
def test_tables_that_contradict_themselves_are_refused(tracking, events, words):
    with pytest.raises(ValueError, match=words):
        changed(events=events, **tracking)


def test_events_need_field_control_and_calibrations_a_target():
    event = [_event("9 calibrate")]
    aimless = {"calibration_target_enu_m": None}
    with pytest.raises(ValueError, match=r"`calibrate` needs a target: set .*`calibration_target_enu_m`"):
        load_scenario(DATA).changed(tracking={"event": event, "field_control": aimless})
    load_scenario(DATA).changed(tracking={"event": event})
    with pytest.raises(ValueError, match=r"needs field control to act on; add a table \[tracking.field_control\]"):
        load_scenario(DATA).changed(tracking={"event": event, "field_control": None})


@pytest.mark.parametrize("natural_hz", [0.0, 0.5, 2.2])
def test_stiff_and_quick_structures_are_taken(natural_hz):
    assert changed(structure={"natural_hz": natural_hz}).tracking.structure.natural_hz == natural_hz
