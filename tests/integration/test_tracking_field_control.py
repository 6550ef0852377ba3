"""Fields tracked under field control: stow to stow, by messages, through events, calibrations, interruptions."""

import dataclasses
import datetime
import io
from pathlib import Path

import numpy as np
import pytest

from rfpose.cli.track import _event
from rfpose.feedback.columns import constant
from rfpose.feedback.fieldcontrol.control import ControlledField
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import TrackingSimulation, operation, score
from rfpose.scenario import load_scenario
from sites import PERFECT

DATA = Path(__file__).resolve().parents[2] / "data" / "tracking_100m.toml"

FINE = PERFECT | {"drive": PERFECT["drive"] | {"steps_per_turn": 480_000.0}}
"""Nothing wrong but motor steps, and those of 0.013 mrad."""

FULL_HOUR = {"first_hour": 11.5, "last_hour": 12.5, "store_interval_s": 4.0}
HALF_HOUR = {"first_hour": 11.5, "last_hour": 12.0, "store_interval_s": 4.0}


def scenario(*changes, events=(), bus=None, without=False, **tracking):
    """The shipped scenario with keys of [tracking] replaced; `bus` and events as on the command line."""
    site = load_scenario(DATA)
    for change in (*changes, tracking, {"field_control": {"bus": {"lost": 0.0, **(bus or {})}}}):
        site = site.changed(tracking=change)
    site = site.changed(tracking={"event": [_event(text) for text in events]})
    return site.changed(tracking={"field_control": None}) if without else site


def run(site, methods=("open-loop",), *, count=3, seed=1):
    simulation = TrackingSimulation(site, methods=methods, count=count, seed=seed)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    return simulation


def rms_mrad(simulation, method="open-loop"):
    return 1e3 * score(simulation.sums(method)).normal_rms_rad


def seconds(simulation, hour):
    """Time of an hour from the run's beginning."""
    return 3600.0 * (hour - simulation.days[0].hour[0])


def after(simulation, hour):
    """Which of the courses' instants lie at an hour or later."""
    return simulation.stored_unix_s - simulation.stored_unix_s[0] >= seconds(simulation, hour) - 1e-3


def changes(curves, i):
    """A mirror's modes in turn."""
    mode = curves.mode[:, i]
    return [Mode(m).name for m in mode[np.flatnonzero(np.diff(mode, prepend=-1))]]


def happened(simulation, method="open-loop", day=0):
    return simulation.happened(method)[day]


# ---- from stow to stow --------------------------------------------------------------------------------------------

SHORT_DAY = {"min_sun_elevation_deg": 52.0, "store_interval_s": 4.0}
"""The sun is above for some two and a half hours about noon."""


@pytest.fixture(scope="module")
def whole_day():
    return run(scenario(SHORT_DAY, bus={"lost": 0.01}), ("open-loop", "radio"))


@pytest.mark.parametrize("method", ["open-loop", "radio"])
def test_a_day_goes_from_stow_to_stow_the_safe_way(whole_day, method):
    curves, day = whole_day.curves(method), whole_day.days[0]
    works = day.works[::4]
    on = Mode.POINT if method == "open-loop" else Mode.TRACK
    per_rad = constant(whole_day.field.constant, "counts_per_unit")
    home = constant(whole_day.field.constant, "angle_at_zero_rad").copy()
    for i in range(3):
        want = ["STOW", "APPROACH", "POINT", "TRACK", "STOWING", "STOW"]
        want.remove("TRACK" if method == "open-loop" else "POINT")
        # where normals are measured POINT lasts for a second, which a course may show or not
        assert [m for m in changes(curves, i) if m in want or on == Mode.POINT] == want
        mode, axis = curves.mode[:, i], home[i] + curves.motor_count[:, i] / per_rad[i]
        # park position: north, level, to half a step
        for at in (mode == Mode.STOW).nonzero()[0][[0, -1]]:
            turned = np.mod(axis[at, 0] + np.pi, 2.0 * np.pi) - np.pi
            assert np.hypot(turned, axis[at, 1]) < 2.0 * np.pi / 48_000
        out, back = (np.flatnonzero(mode == m) for m in (Mode.APPROACH, Mode.STOWING))
        # azimuth has arrived before elevation has risen by 2 mrad, and on the way back the other way round
        rising = out[axis[out, 1] > 2e-3]
        assert np.all(np.abs(axis[rising, 0] - axis[out[-1] + 1, 0]) < 10e-3)
        high = back[axis[back, 1] > 4e-3]
        assert np.all(np.abs(axis[high, 0] - axis[back[0] - 1, 0]) < 10e-3)
        assert rising.size > 5
        assert high.size > 5
    # on aim when the field is to work, and until it is over: to one control interval
    assert np.all(curves.mode[works][1:-1] == on)
    assert np.all(curves.mode[0] == Mode.STOW)
    assert np.all(curves.mode[-1] == Mode.STOW)


@pytest.mark.parametrize("method", ["open-loop", "radio"])
def test_errors_are_told_where_mirrors_are_on_the_receiver(whole_day, method):
    curves = whole_day.curves(method)
    on_receiver = np.isin(curves.mode, (Mode.POINT, Mode.TRACK))
    np.testing.assert_array_equal(np.isfinite(curves.error_rad), on_receiver)
    np.testing.assert_array_equal(np.isfinite(curves.rms_rad), on_receiver.any(axis=1))
    np.testing.assert_array_equal(curves.mode_count.sum(axis=1), 3)
    np.testing.assert_array_equal(curves.mode_count[:, Mode.STOW], np.sum(curves.mode == Mode.STOW, axis=1))
    # nothing falls on the receiver from stow
    assert np.all(curves.flux[(curves.mode == Mode.STOW).all(axis=1)] == 0.0)


def test_ways_cost_nothing_of_the_score(whole_day):
    plain = run(scenario(SHORT_DAY, without=True), ("open-loop", "radio"))
    for method in ("open-loop", "radio"):
        mine, other = (score(s.sums(method)) for s in (whole_day, plain))
        # the same wind at other steps of the day: the wind's part of radio's error scatters by some per cent
        assert mine.normal_rms_rad == pytest.approx(other.normal_rms_rad, rel=0.05)
        assert mine.intercept == pytest.approx(other.intercept, abs=2e-3)
        assert plain.happened(method) == []
    modes = plain.curves("radio").mode_count
    assert np.all(modes[:, Mode.TRACK] == 3)


# ---- the sun between messages -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def between():
    """Runs by how mirrors take the sun, control interval and losses."""
    found = {}
    for how, interval, lost in (
        ("held", 4.0, 0.0), ("held", 20.0, 0.0), ("held", 20.0, 0.2), ("carried-on", 20.0, 0.0),
        ("carried-on", 20.0, 0.2),
    ):  # fmt: skip
        site = scenario(
            FINE, HALF_HOUR, {"field_control": {"between_messages": how}}, control_interval_s=interval,
            store_interval_s=interval, bus={"lost": lost},
        )  # fmt: skip
        found[how, interval, lost] = run(site)
    return found


def normal_rate_radps(simulation):
    """How fast the wanted normals turn, rms over mirrors and steps."""
    day = simulation.days[0]
    here, later = (simulation.plant.wanted_normal_enu(day, i) for i in (900, 901))
    return np.sqrt(np.mean(np.sum((later - here) ** 2, axis=1)))


@pytest.mark.parametrize("interval", [4.0, 20.0])
def test_a_held_sun_costs_what_the_sky_turns_in_an_interval(between, interval):
    found = between["held", interval, 0.0]
    way_mrad = 1e3 * interval * normal_rate_radps(found)
    # a mirror that stands until it hears of the sun again is off by nothing at first and by the whole way at last: rms
    # way/√3; one that turns evenly and half an interval late: way/2. The sun is heard within a second
    assert 0.45 * way_mrad < rms_mrad(found) < 0.75 * (1.0 + 1.0 / interval) * way_mrad
    # M7: half of the sun's 0.0727 mrad/s, more where the sun turns across the plane of its rays
    assert way_mrad / interval == pytest.approx(0.5 * 0.0727, rel=0.2)


def test_a_held_sun_costs_in_proportion_and_more_where_messages_are_lost(between):
    short, long, lossy = (rms_mrad(between["held", *key]) for key in ((4.0, 0.0), (20.0, 0.0), (20.0, 0.2)))
    # scored each second, by nought to n - 1 seconds of the sky: root of (n - 1)(2n - 1)/6, 1.87 and 11.1 s
    assert long == pytest.approx(np.sqrt(19.0 * 39.0 / (3.0 * 7.0)) * short, rel=0.05)
    # mean square of k + u intervals, k missed in a row with 0.2^k, u even between nought and one: 0.958 against 1/3
    assert 1.1 * long < lossy < 1.8 * long


def test_a_sun_that_is_carried_on_does_without_messages(between):
    sound, lossy = (between["carried-on", 20.0, lost] for lost in (0.0, 0.2))
    # half a motor step in each axis, and the thousandth of a degree that a packet carries (0.005 mrad)
    assert rms_mrad(sound) < 0.012
    assert rms_mrad(lossy) < rms_mrad(sound) + 0.003
    assert happened(lossy)["messages"]["watchdog_emergencies"] == 0  # 0.2^6 of 264 intervals: 0.02 expected
    lost = happened(lossy)["messages"]
    n = lost["sun_ok"] + lost["sun_lost"]
    assert lost["sun_lost"] == pytest.approx(0.2 * n, abs=4.0 * np.sqrt(0.16 * n))


def test_the_watchdog_takes_mirrors_off_and_the_programme_brings_them_back():
    site = scenario(
        FINE, HALF_HOUR, {"field_control": {"watchdog_intervals": 2.0}, "settle_s": 0.0}, bus={"lost": 0.35}
    )
    found = run(site)
    curves, trips = found.curves("open-loop"), happened(found)["messages"]["watchdog_emergencies"]
    # two suns and two questions lost running: 0.35⁴ in each of 1332 intervals, less those spent on the way (a third)
    assert 3 <= trips <= 25
    assert any(m in changes(curves, i) for i in range(3) for m in ("EMERGENCY",))
    began = int(np.sum((np.diff(curves.mode, axis=0) != 0) & (curves.mode[1:] == Mode.EMERGENCY)))
    assert began == trips
    back = [changes(curves, i) for i in range(3)]
    assert sum(c[k : k + 5] == ["EMERGENCY", "STOWING", "STOW", "APPROACH", "POINT"] for c in back
               for k in range(len(c))) >= 0.5 * trips  # fmt: skip


def test_messages_are_counted_by_what_became_of_them():
    site = scenario(HALF_HOUR, bus={"lost": 0.1, "bit_error_rate": 1e-3, "late": 0.1, "late_s": 0.5})
    found = happened(run(site))["messages"]
    n = 3 * 444  # mirrors and control intervals
    total = {
        what: sum(found[f"{what}_{fate}"] for fate in ("ok", "lost", "corrupted", "undetected", "late", "silent"))
        for what in ("sun", "question", "answer")
    }
    assert total["sun"] == total["question"] == total["answer"]
    assert total["sun"] == pytest.approx(n, abs=9)
    for what in ("sun", "question"):
        assert found[f"{what}_lost"] == pytest.approx(0.1 * n, abs=4.0 * np.sqrt(0.09 * n))
        # 96 bits at 1e-3: 9.2 % of those that arrive
        assert found[f"{what}_corrupted"] == pytest.approx(0.9 * 0.0916 * n, abs=4.0 * np.sqrt(0.08 * n))
        assert found[f"{what}_late"] == 0
    # an answer is late if its question or itself is, by more than the 2 ms of silence
    asked = n - found["answer_silent"]
    assert found["answer_late"] == pytest.approx(0.9 * 0.19 * asked, abs=0.05 * asked)
    assert found["answer_corrupted"] > found["question_corrupted"]  # those that a late one ran into


# ---- emergencies --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def emergency():
    return run(
        scenario(FULL_HOUR, events=("11.7 emergency", "11.9 release"), bus={"lost": 0.05}), ("open-loop", "radio"),
        count=6,
    )  # fmt: skip


@pytest.mark.parametrize("method", ["open-loop", "radio"])
def test_an_emergency_darkens_and_stows_the_field(emergency, method):
    curves, told = emergency.curves(method), happened(emergency, method)
    (alarm,) = told["alarms"]
    assert alarm["alarm"] == "emergency"
    assert alarm["at_s"] == pytest.approx(seconds(emergency, 11.7), abs=1.0)
    assert alarm["below_tenth_s"] <= alarm["off_s"] <= 30.0
    assert alarm["off_s"] < alarm["stowed_median_s"] <= alarm["stowed_s"] <= 300.0
    # the courses, every 4 s, tell the same times
    since = emergency.stored_unix_s - emergency.stored_unix_s[0] - alarm["at_s"]
    before = curves.flux[since < 0.0][-1]
    dark = since[(since >= 0.0) & (curves.flux < 0.1 * before)][0]
    assert alarm["below_tenth_s"] == pytest.approx(dark - 2.0, abs=3.0)
    all_in = since[(since >= 0.0) & (curves.mode_count[:, Mode.STOW] == 6)][0]
    assert alarm["stowed_s"] == pytest.approx(all_in - 2.0, abs=3.0)
    half_in = since[(since >= 0.0) & (curves.mode_count[:, Mode.STOW] >= 3)][0]
    assert alarm["stowed_median_s"] == pytest.approx(half_in, abs=8.0)
    # stays dark until released, then everybody comes back
    waits = (since > all_in) & ~after(emergency, 11.9)
    assert np.all(curves.mode_count[waits, Mode.STOW] == 6)
    assert np.all(np.isin(curves.mode[after(emergency, 12.1)], (Mode.POINT, Mode.TRACK)))
    assert np.all(np.diff(curves.motor_count[waits], axis=0) == 0.0)


@pytest.mark.parametrize("method", ["open-loop", "radio"])
def test_light_by_mode_adds_up_to_what_the_emergency_cost(emergency, method):
    sums, curves, day = emergency.sums(method), emergency.curves(method), emergency.days[0]
    found = score(sums)
    by_mode = found.by_mode
    assert found.energy_j_per_m2 == pytest.approx(by_mode[:, 2].sum())
    assert by_mode[:, 0].sum() == pytest.approx(day.works.sum())
    np.testing.assert_allclose(
        by_mode[:, 0] / by_mode[:, 0].sum(), curves.mode_count.mean(axis=0) / 6.0, atol=1.5 * 5.0 / len(curves.flux)
    )
    assert found.availability == pytest.approx(by_mode[:, 2].sum() / by_mode[:, 1].sum())
    assert found.availability < found.intercept
    assert by_mode[Mode.STOW, 2] == 0.0
    # offered: beam times the cosine at the wanted normal, by another path
    cosine = np.array([
        np.mean(emergency.plant.wanted_normal_enu(day, s) @ day.sun_enu[s]) for s in range(0, len(day.unix_s), 4)
    ])  # fmt: skip
    offered = day.power_w_per_m2[::4] * cosine * 4.0
    # on the receiver it is counted as mirrors stand: some mrad of error are some 1e-4 of the cosine
    assert by_mode[:, 1].sum() == pytest.approx(offered.sum(), rel=1e-3)
    # what is missing is what the flux says is missing
    assert by_mode[:, 1].sum() - by_mode[:, 2].sum() == pytest.approx((offered * (1.0 - curves.flux)).sum(), rel=0.01)
    away = [Mode.EMERGENCY, Mode.STOWING, Mode.STOW, Mode.APPROACH]
    lost = (by_mode[away, 1] - by_mode[away, 2]).sum()
    share = curves.mode_count[:, away].sum(axis=1) / 6.0
    # some seconds' light is caught while mirrors leave; mirrors differ in their cosine by a tenth
    assert lost == pytest.approx((offered * share).sum(), rel=0.03)
    # settled seconds on the receiver are the score's
    assert np.nansum(by_mode[[Mode.POINT, Mode.TRACK], 2]) >= sums.total[0, :, 6].mean()


def test_a_cluster_that_fails_takes_its_mirrors_and_no_others():
    site = scenario(
        HALF_HOUR, events=("11.65 cluster-fails #1", "11.8 cluster-returns #1"), bus={"lost": 0.0, "cluster_size": 2}
    )
    found = run(site, count=4)
    curves, told = found.curves("open-loop"), happened(found)
    assert [e["heliostats"] for e in told["events"]] == [2, 2]
    assert changes(curves, 0) == changes(curves, 1) == ["POINT"]
    for i in (2, 3):
        assert changes(curves, i) == ["POINT", "EMERGENCY", "STOWING", "STOW", "APPROACH", "POINT"]
        # by themselves, three intervals of silence later: 12 s after the last word, which is up to 4 s old
        gone = found.stored_unix_s[curves.mode[:, i] == Mode.EMERGENCY][0] - found.stored_unix_s[0]
        assert 8.0 <= gone - seconds(found, 11.65) <= 20.0
        out = found.stored_unix_s[curves.mode[:, i] == Mode.APPROACH][0] - found.stored_unix_s[0]
        assert 0.0 <= out - seconds(found, 11.8) <= 24.0
    assert told["messages"]["watchdog_emergencies"] == 2
    assert told["messages"]["sun_silent"] == pytest.approx(2 * 135, abs=4)
    assert told["alarms"] == []


def test_clusters_help_themselves_when_the_centre_is_dead():
    found = run(scenario(HALF_HOUR, events=("11.65 centre-fails", "11.75 centre-returns")))
    curves, (alarm,) = found.curves("open-loop"), happened(found)["alarms"]
    assert alarm["alarm"] == "centre silent"
    # 30 s of silence
    assert alarm["at_s"] - seconds(found, 11.65) == pytest.approx(30.0, abs=4.0)
    assert alarm["off_s"] < 30.0
    assert alarm["stowed_s"] < 300.0
    quiet = after(found, 11.65) & ~after(found, 11.65 + 28.0 / 3600.0)
    assert np.all(curves.mode[quiet] == Mode.POINT)
    assert np.all(curves.mode[after(found, 11.85)] == Mode.POINT)


def test_an_emergency_that_nobody_can_order_is_no_alarm():
    # the centre is dead when it is called: refused; what stows the field is their clusters, 30 s later
    found = run(scenario(HALF_HOUR, events=("11.65 centre-fails", "11.653 emergency", "11.75 centre-returns")))
    told = happened(found)
    assert told["events"][1]["refused"] == {"the centre is dead": 3}
    assert [a["alarm"] for a in told["alarms"]] == ["centre silent"]
    assert told["alarms"][0]["at_s"] - seconds(found, 11.65) == pytest.approx(30.0, abs=4.0)


@pytest.fixture(scope="module")
def powerless():
    site = scenario(FINE, HALF_HOUR, events=("11.65 power-fails", "11.85 power-returns"))
    return run(site, ("open-loop",))


def test_without_power_the_sun_moves_on_and_the_field_comes_back_by_way_of_stow(powerless):
    curves = powerless.curves("open-loop")
    dead = after(powerless, 11.65) & ~after(powerless, 11.85)
    flux = curves.flux[dead]
    assert np.all(curves.mode[dead][1:] == Mode.POWER_LOSS)
    # the image of 12.3 mrad of normal leaves at 0.0364 mrad/s or more: half of it gone after 2.5 minutes about
    assert flux[0] > 0.9
    assert np.all(np.diff(flux) <= 1e-9)
    assert 60.0 < 4.0 * np.sum(flux > 0.5) < 240.0
    assert flux[-1] < 0.01
    for i in range(3):
        assert changes(curves, i) == ["POINT", "POWER_LOSS", "IDLE", "STOWING", "STOW", "APPROACH", "POINT"]
    assert happened(powerless)["alarms"] == []
    assert happened(powerless)["messages"]["sun_silent"] == pytest.approx(3 * 180, abs=6)


def test_motors_without_power_do_not_turn(powerless):
    curves = powerless.curves("open-loop")
    at = np.flatnonzero(curves.mode[:, 0] == Mode.POWER_LOSS)
    before, stands = curves.motor_count[at[0] - 1], curves.motor_count[at]
    np.testing.assert_array_equal(stands, np.broadcast_to(stands[0], stands.shape))
    # nor do they go back to where they were when field control last looked: they go on for up to 4 s, then stand
    way = curves.motor_count[at[0] - 1] - curves.motor_count[at[0] - 2]
    beyond = (stands[0] - before) * np.sign(way)
    assert np.all(beyond >= -1.0)
    assert np.all(beyond <= np.abs(way) + 2.0)


# ---- wind ---------------------------------------------------------------------------------------------------------


def test_strong_and_unknown_wind_stow_the_field(tmp_path):
    base = scenario(HALF_HOUR, first_hour=11.25, last_hour=12.25)
    first = TrackingSimulation(base, methods=("open-loop",), count=3).days[0]
    time = np.arange(np.floor(first.unix_s[0]) - 60.0, first.unix_s[-1] + 60.0)
    hour = 11.25 + (time - first.unix_s[0]) / 3600.0
    speed = np.where((hour >= 11.4) & (hour < 11.5), 12.0, 4.0)
    gap, short = (hour >= 11.9) & (hour < 11.95), (hour >= 11.8) & (hour < 11.81)
    rows = (f"{t:.0f},{'' if g else f'{v:g}'}\n" for t, v, g in zip(time, speed, gap | short, strict=True))
    path = tmp_path / "wind.csv"
    path.write_text("unix_s,speed_mps\n" + "".join(rows))
    table = {"record": str(path)}
    found = run(
        scenario(
            HALF_HOUR, {"field_control": {"wind_average_s": 60.0, "wind_release_s": 60.0}}, first_hour=11.25,
            last_hour=12.25, wind=table,
        )
    )  # fmt: skip
    curves, alarms = found.curves("open-loop"), happened(found)["alarms"]
    assert [a["alarm"] for a in alarms] == ["strong wind", "wind unknown"]
    # the mean of a minute passes ten when three quarters of it are of the stronger wind
    assert alarms[0]["at_s"] - seconds(found, 11.4) == pytest.approx(45.0, abs=8.0)
    # a gap of 180 s, from its first minute on; one of 36 s is none. Stowing is no emergency: elevation goes first
    assert alarms[1]["at_s"] - seconds(found, 11.9) == pytest.approx(60.0, abs=8.0)
    for alarm in alarms:
        assert alarm["stowed_s"] < 300.0
    # both ways: out again when the mean was below eight for a minute (30 s for the mean, 60 s), and once it is known
    on = np.flatnonzero(np.diff((curves.mode == Mode.POINT).all(axis=1).astype(int)))
    assert changes(curves, 0) == ["POINT", "STOWING", "STOW", "APPROACH", "POINT", "STOWING", "STOW", "APPROACH",
                                  "POINT"]  # fmt: skip
    assert on.size == 4
    calm = (np.flatnonzero(curves.mode[:, 0] == Mode.APPROACH)[0]) * 4.0
    assert calm - seconds(found, 11.5) == pytest.approx(30.0 + 60.0, abs=16.0)


# ---- counts lost, calibration -------------------------------------------------------------------------------------

LOST = ("11.55 counts-lost H03", "11.58 zero-counts H03", "11.7 calibrate H03")


@pytest.fixture(scope="module")
def homed():
    return run(scenario(FULL_HOUR, events=LOST), ("open-loop", "radio"))


def course_mrad(simulation, method, i, begin, end):
    keep = after(simulation, begin) & ~after(simulation, end)
    return 1e3 * np.sqrt(np.nanmean(simulation.curves(method).error_rad[keep, i] ** 2))


def test_counts_that_were_lost_are_found_by_a_search(homed):
    (told,) = happened(homed)["calibrations"]
    assert told["heliostat"] == "H03"
    assert told["searched"]
    assert told["outcome"] in ("corrected", "on target")
    modes = changes(homed.curves("open-loop"), 2)
    assert modes == ["POINT", "FAULT", "IDLE", "STOWING", "STOW", "APPROACH", "POINT", "CALIBRATE", "SEARCH",
                     "CALIBRATE", "POINT"]  # fmt: skip
    before = course_mrad(homed, "open-loop", 2, 11.52, 11.55)
    astray = course_mrad(homed, "open-loop", 2, 11.66, 11.7)
    later = course_mrad(homed, "open-loop", 2, 12.2, 12.5)
    # 20 mrad of each zero; then that of before: within 1 mrad of beam (Berenguel's 74 mm at 50 m), in another posture
    assert astray > 5.0
    assert later < before + 1.0
    for i in (0, 1):
        assert changes(homed.curves("open-loop"), i) == ["POINT"]


def test_radio_finds_back_by_itself(homed):
    before = course_mrad(homed, "radio", 2, 11.52, 11.55)
    later = course_mrad(homed, "radio", 2, 12.2, 12.5)
    assert later < before + 0.1
    (told,) = happened(homed, "radio")["calibrations"]
    assert not told["searched"]
    assert told["outcome"] == "on target"


def test_a_search_that_finds_nothing_ends_and_the_field_goes_on():
    site = scenario(
        HALF_HOUR, {"field_control": {"homing_sigma_mrad": 150.0, "search_cells": 9}},
        events=("11.52 counts-lost H01", "11.55 zero-counts H01", "11.65 calibrate H01,H03"),
    )  # fmt: skip
    found = run(site)
    first, second = happened(found)["calibrations"]
    assert (first["heliostat"], first["outcome"], first["searched"]) == ("H01", "not found", True)
    # 9 cells of 5 s after a dwell of a minute
    assert first["took_s"] == pytest.approx(9 * 5.0 + 60.0 + 10.0, abs=15.0)
    assert (second["heliostat"], second["searched"]) == ("H03", False)
    assert second["outcome"] in ("corrected", "on target")
    assert changes(found.curves("open-loop"), 0)[-4:] == ["CALIBRATE", "SEARCH", "DEFOCUS", "POINT"]
    assert np.all(found.curves("open-loop").mode[-1] == Mode.POINT)
    assert np.all(found.curves("open-loop").mode_count[:, [Mode.CALIBRATE, Mode.SEARCH]].sum(axis=1) <= 1)


def test_an_emergency_ends_a_calibration():
    found = run(scenario(HALF_HOUR, events=("11.6 calibrate H03", "11.62 emergency", "11.7 release")))
    (told,) = happened(found)["calibrations"]
    assert told["outcome"] == "given up"
    assert changes(found.curves("open-loop"), 2) == [
        "POINT", "CALIBRATE", "EMERGENCY", "STOWING", "STOW", "APPROACH", "POINT",
    ]  # fmt: skip


def test_an_order_that_takes_a_mirror_from_the_target_leaves_it_to_the_next():
    found = run(scenario(HALF_HOUR, events=("11.55 calibrate H01,H03", "11.562 point H01")))
    told = happened(found)["calibrations"]
    assert [t["heliostat"] for t in told] == ["H01", "H03"]
    assert told[0]["outcome"] == "given up"
    assert changes(found.curves("open-loop"), 0) == ["POINT", "CALIBRATE", "POINT"]


def test_a_mirror_without_power_teaches_its_model_nothing():
    events = ("11.55 calibrate H03", "11.562 power-fails H03", "11.7 power-returns H03")
    found = run(scenario(HALF_HOUR, events=events))
    before = course_mrad(found, "open-loop", 2, 11.51, 11.55)
    later = course_mrad(found, "open-loop", 2, 11.85, 12.0)
    # the beam has left the target by as much as the sun moved: that is no error of the zeros
    assert later < before + 0.5
    assert [t["outcome"] for t in happened(found)["calibrations"]] == ["given up"]


def test_what_is_learned_of_homed_counts_holds_the_next_morning():
    # whether the counts are put right overnight or not: the model goes with them
    site = scenario(
        HALF_HOUR, {"days": 2, "last_hour": 11.9}, events=("1:11.55 counts-lost H03", "1:11.58 zero-counts H03")
    )
    found = run(site, ("radio-both",))
    error = 1e3 * found.curves("radio-both").error_rad[:, 2]
    evening, morning = error[found.stored_day == 0][-20:], error[found.stored_day == 1][2:22]
    assert np.max(morning) < np.max(evening) + 0.5


# ---- orders -------------------------------------------------------------------------------------------------------


def test_orders_that_do_not_fit_are_refused_with_their_reason():
    site = scenario(
        HALF_HOUR,
        events=("11.55 approach H01,H02", "11.56 zero-counts", "11.6 stow H02", "11.7 track H02", "11.75 emergency",
                "11.8 approach", "11.9 release"),
    )  # fmt: skip
    events = happened(run(site))["events"]
    assert " ".join(e["what"] for e in events) == "approach zero-counts stow track emergency approach release"
    assert events[0]["heliostats"] == 2
    assert events[0]["refused"] == {"APPROACH refused: it points at its aim already": 2}
    assert events[1]["refused"] == {"ZERO_COUNTS refused: its step counts are valid and in use": 3}
    assert "refused" not in events[2]
    assert events[3]["refused"] == {"TRACK refused: it is stowed: order an approach first": 1}
    (why,) = events[5]["refused"]
    assert "emergency since" in why
    assert "only stow is possible" in why
    assert events[5]["refused"][why] == 3


def test_a_mirror_that_is_to_hold_stands_still_until_ordered_away():
    found = run(scenario(HALF_HOUR, events=("11.6 hold H02", "11.8 stow H02")))
    curves = found.curves("open-loop")
    assert changes(curves, 1) == ["POINT", "IDLE", "STOWING", "STOW"]
    # one round to hear of it
    stands = after(found, 11.6 + 8.0 / 3600.0) & ~after(found, 11.8)
    assert np.all(curves.mode[stands, 1] == Mode.IDLE)
    assert np.all(np.diff(curves.motor_count[stands, 1], axis=0) == 0.0)


def test_defocused_mirrors_spare_the_receiver_until_refocused():
    found = run(scenario(HALF_HOUR, events=("11.6 defocus H02", "11.7 refocus H02", "11.75 point", "11.85 stow H03")))
    curves = found.curves("open-loop")
    assert changes(curves, 1) == ["POINT", "DEFOCUS", "POINT"]
    assert changes(curves, 2) == ["POINT", "STOWING", "STOW"]
    aside = curves.mode[:, 1] == Mode.DEFOCUS
    # the beam 15 m beside at 50 m: 140 mrad of the normal, of which the image has 12
    assert np.mean(curves.flux[aside][1:]) < 0.75
    by_mode = found.sums("open-loop").by_mode[0, 1, Mode.DEFOCUS]
    assert by_mode[0] == pytest.approx(360.0, abs=8.0)
    # it leaves and returns within a second or two
    assert by_mode[2] < 0.02 * by_mode[1]


def test_events_of_a_day_stay_on_it():
    site = scenario(
        HALF_HOUR, {"days": 2, "last_hour": 11.75}, events=("2:11.6 defocus H01", "11.65 stow H03", "1:11.7 hold H01")
    )
    found = run(site)
    assert [d["day"] for d in found.happened("open-loop")] == ["2026-03-20", "2026-03-21"]
    days = [[e["what"] for e in d["events"]] for d in found.happened("open-loop")]
    assert days == [["stow", "hold"], ["defocus", "stow"]]
    assert found.days[1].date == datetime.date(2026, 3, 21)


# ---- interruption, seeds, company ---------------------------------------------------------------------------------


def through_a_file(state):
    """A state as a checkpoint keeps it."""
    file = io.BytesIO()
    np.savez(file, **state)
    file.seek(0)
    with np.load(file, allow_pickle=False) as loaded:
        return {name: loaded[name] for name in loaded.files}


def same_bytes(one, other):
    assert one.keys() == other.keys()
    for name, values in one.items():
        assert np.asarray(values).tobytes() == np.asarray(other[name]).tobytes(), name


# a stretch ends 15 minutes after the beginning: half a minute into an emergency, amid a search
@pytest.mark.parametrize(
    ("events", "amid"),
    [
        (("11.745 emergency", "11.9 release"), Mode.EMERGENCY),
        (("11.52 counts-lost H01", "11.53 zero-counts H01", "11.71 calibrate H01"), Mode.SEARCH),
    ],
    ids=["emergency", "search"],
)
def test_killed_and_taken_up_again_nothing_changes(events, amid):
    site = scenario(
        HALF_HOUR, {"store_interval_s": 60.0, "field_control": {"homing_sigma_mrad": 150.0}}, events=events,
        bus={"lost": 0.1},
    )  # fmt: skip
    whole = TrackingSimulation(site, methods=("open-loop", "radio-both"), count=3, seed=1)
    whole.advance()
    kept = through_a_file(whole.state())
    (mode,) = (values for name, values in kept.items() if name.endswith("open-loop/operation/control.heliostats.mode"))
    assert amid in mode
    while whole.done < whole.n_segment:
        whole.advance()
    second = TrackingSimulation(site, methods=("open-loop", "radio-both"), count=3, seed=1)
    second.restore(kept)
    same_bytes(second.state(), kept)
    while second.done < second.n_segment:
        second.advance()
    same_bytes(second.state(), whole.state())
    assert second.happened("open-loop") == whole.happened("open-loop")
    assert whole.n_segment == 2


def test_days_of_a_method_that_learns_go_from_hand_to_hand():
    """Each day by another simulation, told what was learned, and what a homing has made worthless overnight."""
    site = scenario(
        {"first_hour": 11.5, "last_hour": 11.8, "days": 3, "store_interval_s": 60.0},
        {"field_control": {"homing_sigma_mrad": 5.0}},
        events=("11.52 counts-lost H01", "11.53 zero-counts H01"),
    )  # fmt: skip
    whole = run(site, ("radio-both",))
    relay = TrackingSimulation(site, methods=("radio-both",), count=3, seed=1)
    (portion,) = relay.portions(2)
    for i_day in range(3):
        assert portion.i_day == i_day
        other = TrackingSimulation(site, methods=("radio-both",), count=3, seed=1)
        relay.take(portion, other.go_through(portion, relay.learned(portion)))
        kept = through_a_file(relay.state())
        relay = TrackingSimulation(site, methods=("radio-both",), count=3, seed=1)
        relay.restore(kept)
        (portion,) = relay.portions(2) or [None]
    homed = next(values for name, values in kept.items() if name.endswith("/homed"))
    assert homed.tolist() == [True, False, False]
    assert relay.happened("radio-both") == whole.happened("radio-both")
    for results in (TrackingSimulation.sums, TrackingSimulation.curves):
        mine, wanted = (dataclasses.asdict(results(each, "radio-both")) for each in (relay, whole))
        same_bytes(mine, wanted)


def test_same_seed_same_bytes_and_company_makes_no_difference(emergency):
    site = scenario(FULL_HOUR, events=("11.7 emergency", "11.9 release"), bus={"lost": 0.05})
    alone = run(site, ("radio",), count=6)
    mine, whole = alone.state(), emergency.state()
    same_bytes({n: v for n, v in mine.items() if n.startswith("radio/")},
               {n: v for n, v in whole.items() if n.startswith("radio/")})  # fmt: skip
    other = run(site, ("radio",), count=6, seed=2)
    assert happened(other, "radio")["messages"] != happened(alone, "radio")["messages"]


# ---- telling ahead ------------------------------------------------------------------------------------------------

AHEAD = {
    "losses": ({}, {"lost": 0.2}),
    "emergency": ({"events": ("11.6 emergency", "11.7 release")}, {"lost": 0.1}),
    "calibration": ({"events": ("11.6 calibrate H01,H03",)}, {"lost": 0.1}),
    "defocus and stow": ({"events": ("11.6 defocus H01", "11.65 refocus H01", "11.7 stow H02", "11.8 approach H02")},
                         {"lost": 0.1}),
}  # fmt: skip


NO_LEAN = {"mount_errors": {"thermal_sigma_mrad": 0.0}}
"""The pedestals' lean is brought up to date every 16 steps and at each word: see the test below."""


def equal_courses(one, other, method):
    a, b = one.curves(method), other.curves(method)
    np.testing.assert_array_equal(a.mode, b.mode)
    np.testing.assert_array_equal(a.normal_enu, b.normal_enu)
    assert happened(one, method) == happened(other, method)
    assert rms_mrad(one, method) == rms_mrad(other, method)


@pytest.mark.parametrize("case", AHEAD)
def test_telling_mirrors_ahead_changes_nothing(case, monkeypatch):
    more, bus = AHEAD[case]
    site = scenario(HALF_HOUR, NO_LEAN, bus=bus, **more)
    ahead = run(site, ("open-loop", "radio"))
    monkeypatch.setattr(operation, "_WORDS_AHEAD", 1)
    each = run(site, ("open-loop", "radio"))
    for method in ("open-loop", "radio"):
        equal_courses(ahead, each, method)


def test_the_lean_is_as_new_as_sixteen_steps(monkeypatch):
    ahead = run(scenario(HALF_HOUR)).curves("open-loop")
    monkeypatch.setattr(operation, "_WORDS_AHEAD", 1)
    each = run(scenario(HALF_HOUR)).curves("open-loop")
    # four sigma of 0.1 mrad about each of two axes, at 2π a day
    most = 4.0 * np.sqrt(2.0) * 0.1e-3 * 2.0 * np.pi / 86_400.0 * 16.0
    np.testing.assert_allclose(ahead.normal_enu, each.normal_enu, atol=most, rtol=0.0)


def test_telling_ahead_delays_nobody_by_more_than_the_words_told(monkeypatch):
    # who has come back to stow by himself is sent out at the next word: at most three intervals later
    events = ("11.6 cluster-fails #1", "11.7 cluster-returns #1")
    site = scenario(HALF_HOUR, events=events, bus={"lost": 0.0, "cluster_size": 2})
    ahead = run(site, count=4).curves("open-loop")
    monkeypatch.setattr(operation, "_WORDS_AHEAD", 1)
    each = run(site, count=4).curves("open-loop")
    for i in range(4):
        assert changes(ahead, i) == changes(each, i)
        at = [np.flatnonzero(np.diff(c.mode[:, i])) for c in (ahead, each)]
        assert np.all(np.abs(at[0] - at[1]) <= 3 + 1)


@pytest.mark.parametrize("between_messages", ["carried-on", "held"])
def test_stepping_each_second_changes_nothing_while_all_is_quiet(between_messages, monkeypatch):
    site = scenario(HALF_HOUR, NO_LEAN, {"field_control": {"between_messages": between_messages}}, bus={"lost": 0.2})
    ahead = run(site, ("open-loop", "radio"))
    monkeypatch.setattr(ControlledField, "quiet_until", lambda self, time_s: min(time_s, self._time_s))
    each = run(site, ("open-loop", "radio"))
    for method in ("open-loop", "radio"):
        equal_courses(ahead, each, method)


# ---- structure and dish -------------------------------------------------------------------------------------------


def test_wind_swings_mirrors_as_edwards_has_it():
    from rfpose.feedback.structure import StructureMode
    from rfpose.feedback.wind.spectrum import wind_deflection

    bend = (0.05, 0.1)
    stiff, soft = (
        run(scenario(FINE, FULL_HOUR, without=True, structure={"natural_hz": hz},
                     wind={"deflection_mrad_per_mps2": bend, "mean_speed_mps": 6.0}), count=8)
        for hz in (0.0, 2.2)
    )  # fmt: skip
    a, b = (s.curves("open-loop").normal_enu for s in (stiff, soft))
    moved, n = b - a, 0.5 * (a + b)
    h = np.hypot(n[..., 0], n[..., 1])
    right = (-n[..., 1] * moved[..., 0] + n[..., 0] * moved[..., 1]) / h
    up = -(n[..., 0] * moved[..., 0] + n[..., 1] * moved[..., 1]) * n[..., 2] / h + h * moved[..., 2]
    keep = h > 0.1  # right and up have a meaning
    mode = StructureMode(natural_hz=2.2, damping=0.02)
    for got, k in zip((right, up), bend, strict=True):
        want = wind_deflection(1e-3 * k, 6.0, mode, size_m=2.0)[1]
        # some 7000 samples 4 s apart, of which 3.6 s ring down: as 2800 free ones, five sigma of their variance; motor
        # steps of 0.013 mrad shake by less than a hundredth of this
        assert np.mean(got[keep] ** 2) == pytest.approx(want, rel=5.0 * np.sqrt(2.0 / 2800.0))
        assert abs(np.mean(got[keep])) < 0.1 * np.sqrt(want)


def test_a_stopped_motor_leaves_the_mirror_ringing():
    hz, damping = 2.2, 0.02
    site = scenario(
        FINE, {"first_hour": 11.5, "last_hour": 11.58, "control_interval_s": 1.0, "store_interval_s": 1.0},
        structure={"natural_hz": hz, "damping": damping}, wind={"mean_speed_mps": 0.0}, events=("11.51 stow",),
    )  # fmt: skip
    curves = run(site, count=2).curves("open-loop")
    for i in range(2):
        stow = np.flatnonzero(curves.mode[:, i] == Mode.STOW)
        still = stow[np.all(curves.motor_count[stow, i] == curves.motor_count[stow[-1], i], axis=1)][1:40]
        # azimuth stopped last, from 40 mrad/s: the mirror faces north, east is its swing
        swing = curves.normal_enu[still, i, 0] - curves.normal_enu[still[-1], i, 0]
        w = 2.0 * np.pi * hz
        decay, wd = np.exp(-damping * w), w * np.sqrt(1.0 - damping**2)
        # samples a second apart of a mode at 2.2 Hz: alias at 0.2 Hz, three-term recursion of its poles
        left = swing[2:] - 2.0 * decay * np.cos(wd) * swing[1:-1] + decay**2 * swing[:-2]
        assert np.max(np.abs(left[:15])) < 1e-3 * np.max(np.abs(swing))
        # no more than v/ω after the last full second at 40 mrad/s
        assert 1e-6 < np.max(np.abs(swing)) < 40e-3 / w


def test_dishes_capture_what_edwards_has_for_their_error():
    from rfpose.feedback.energy import dish_capture

    site = scenario(
        {"first_hour": 11.5, "last_hour": 11.75}, without=True, collector="dish",
        aperture={"area_ratio": 20_000.0, "h_per_deg": 3.9, "rim_deg": 60.0},
    )  # fmt: skip
    found = run(site, ("open-loop", "radio"), count=60)
    for method, tolerance in (("radio", 5e-4), ("open-loop", 0.03)):
        mine = score(found.sums(method))
        sigma = mine.normal_rms_rad / np.sqrt(2.0)
        want = dish_capture(20_000.0, h_per_deg=3.9, sigma_rad=sigma, rim_rad=np.pi / 3.0)
        # (4.12) holds on the average over errors that scatter alike in two directions: 60 mirrors, whose mean scatters
        assert mine.intercept == pytest.approx(float(want), abs=tolerance), method
