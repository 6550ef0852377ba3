"""A field tracked by all methods: what each reaches, what makes it worse, and that runs can be repeated."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from rfpose.errors import ScenarioError
from rfpose.feedback.tracking import TrackingSimulation, score
from rfpose.scenario import load_scenario
from sites import PERFECT

DATA = Path(__file__).resolve().parents[2] / "data" / "tracking_100m.toml"


def scenario(*changes, **tracking):
    """The shipped scenario between nine and ten o'clock without field control, with keys of [tracking] replaced."""
    site = load_scenario(DATA)
    hour = {"first_hour": 9.0, "last_hour": 9.75, "settle_s": 240.0, "field_control": None}
    for change in (hour, *changes, tracking):
        site = site.changed(tracking=change)
    return site


def run(site, methods, *, count=None, seed=1):
    simulation = TrackingSimulation(site, methods=methods, count=count, seed=seed)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    return simulation


def rms_mrad(simulation, method):
    return 1e3 * score(simulation.sums(method.name if hasattr(method, "name") else method)).normal_rms_rad


@pytest.fixture(scope="module")
def default_hour():
    return run(scenario(), ())


def test_radio_beats_what_plants_do_today(default_hour):
    rms = {m.name: rms_mrad(default_hour, m) for m in default_hour.methods}
    assert rms["radio"] <= 0.3
    assert rms["radio-both"] <= 0.3
    assert rms["radio-both"] < rms["camera-model"] < rms["open-loop"]
    assert rms["drone-model"] < rms["open-loop"]
    assert max(rms["bias"], rms["berenguel"]) < 0.95 * rms["open-loop"]
    assert rms["encoder"] == pytest.approx(rms["open-loop"], rel=0.1)  # neither knows how the pedestal stands
    lost = score(default_hour.sums("radio")).lost_frames
    n_frame = 12 * 0.68 * 900
    assert lost == pytest.approx(0.1, abs=4.0 * np.sqrt(0.09 / n_frame))


def test_scores_agree_with_the_courses(default_hour):
    # sampled once a minute, of the stored mirrors: the same errors by another path
    curves, sums = default_hour.curves("open-loop"), score(default_hour.sums("open-loop"))
    scored = default_hour.stored_unix_s >= default_hour.days[0].unix_s[0] + 240.0
    sampled = np.sqrt(np.mean(curves.error_rad[scored] ** 2, axis=0))
    np.testing.assert_allclose(sampled, sums.heliostat_rms_rad[default_hour.stored], rtol=0.02, atol=3e-5)
    assert np.sqrt(np.mean(curves.rms_rad[scored] ** 2)) == pytest.approx(sums.normal_rms_rad, rel=0.02)
    assert np.all(sums.heliostat_p95_rad <= sums.heliostat_worst_rad * 1.08)  # a bin's width
    assert sums.beam_rms_rad == pytest.approx(2.0 * sums.normal_rms_rad, rel=0.25)
    np.testing.assert_allclose(np.linalg.norm(curves.normal_enu, axis=-1), 1.0)


def test_motor_steps_are_all_that_a_perfect_field_lacks():
    # two axes off by up to half a step each, azimuth seen from the mirror shortened by the cosine of its elevation
    step = 2.0 * np.pi / 48_000
    fine = run(scenario(PERFECT), ("open-loop",))
    coarse = run(scenario(PERFECT, drive={"microsteps": 8}), ("open-loop",))
    curves = fine.curves("open-loop")
    cosine2 = np.mean(1.0 - curves.normal_enu[..., 2] ** 2)
    expected = 1e3 * step / np.sqrt(12.0) * np.sqrt(1.0 + cosine2)
    assert rms_mrad(fine, "open-loop") == pytest.approx(expected, rel=0.1)
    assert rms_mrad(coarse, "open-loop") == pytest.approx(8.0 * expected, rel=0.2)


def test_slack_shows_in_full_where_the_drive_keeps_its_direction():
    slack = run(scenario(PERFECT, drive={"backlash_mrad": (0.0, 1.0)}), ("open-loop",))
    # elevation lies half the play behind
    assert rms_mrad(slack, "open-loop") == pytest.approx(0.5, rel=0.1)


def test_feedback_settles_on_what_it_measures():
    # a tilted plate that nobody knows of is followed in full
    off = run(scenario(PERFECT, radio={"plate_sigma_mrad": 2.0, "plate_calibration": "none"}), ("radio",))
    plate = off.field.true[:, 29:31]
    got = score(off.sums("radio")).heliostat_rms_rad
    np.testing.assert_allclose(got, np.hypot(plate[:, 0], plate[:, 1]), atol=1.2e-4)
    known = run(scenario(PERFECT, radio={"plate_sigma_mrad": 2.0, "plate_calibration": "camera"}), ("radio",))
    assert rms_mrad(known, "radio") < 0.15 * rms_mrad(off, "radio")


def test_a_dead_band_spares_starts_and_costs_accuracy():
    every, seldom = (run(scenario(drive={"dead_band_steps": band}), ("radio",), count=6) for band in (0.0, 4.0))
    a, b = score(every.sums("radio")), score(seldom.sums("radio"))
    assert b.motor_starts < 0.5 * a.motor_starts
    assert b.motor_steps == pytest.approx(a.motor_steps, rel=0.1)
    assert b.normal_rms_rad > 1.2 * a.normal_rms_rad


def test_a_model_holds_through_an_outage_and_an_offset_does_not():
    out = scenario(
        {"radio": {"outages": ({"first_hour": 10.0, "last_hour": 11.5},)}, "last_hour": 12.0, "first_hour": 8.5},
    )
    simulation = run(out, ("radio", "radio-both", "radio-model"))
    dark = {m.name: 1e3 * score(simulation.sums(m.name)).outage_rms_rad for m in simulation.methods}
    assert dark["radio-both"] < 0.35
    assert dark["radio"] > 2.0 * dark["radio-both"]
    found = score(simulation.sums("radio"))
    assert found.outage_loss_j_per_m2 > 0.0
    assert found.lost_frames > 0.4


def test_an_unreachable_aim_point_is_told():
    low = scenario(drive={"elevation_limits_deg": (-5.0, 50.0)})
    part = score(run(low, ("open-loop",)).sums("open-loop")).out_of_reach
    assert 0.1 < part < 1.0
    with pytest.raises(ScenarioError, match=r"no mirror reaches its aim point.*beyond its limits"):
        TrackingSimulation(scenario(drive={"elevation_limits_deg": (-5.0, 0.0)}), methods=("open-loop",))


def test_dishes_follow_the_sun():
    simulation = run(scenario(collector="dish"), ("open-loop", "sun-sensor", "radio", "radio-both"))
    rms = {m.name: rms_mrad(simulation, m) for m in simulation.methods}
    assert rms["radio-both"] < rms["sun-sensor"] < rms["open-loop"]
    # null of the sensor, drift over the day and a level's width
    assert rms["sun-sensor"] < 0.8
    curves = simulation.curves("radio")
    cosine = np.sum(curves.normal_enu * simulation.stored_sun_enu[:, None], axis=-1)
    assert np.all(np.arccos(np.minimum(cosine[5:], 1.0)) < 2e-3)


def test_what_a_method_meets_does_not_depend_on_its_company(default_hour):
    alone = run(scenario(), ("radio-both",))
    np.testing.assert_array_equal(alone.curves("radio-both").normal_enu, default_hour.curves("radio-both").normal_enu)
    other = run(scenario(), ("radio-both",), seed=2)
    assert not np.array_equal(other.curves("radio-both").normal_enu, alone.curves("radio-both").normal_enu)


def test_a_restored_run_goes_on_as_if_nothing_had_happened(default_hour):
    first = TrackingSimulation(scenario(), seed=1)
    first.advance()
    kept = {name: values.copy() for name, values in first.state().items()}
    second = TrackingSimulation(scenario(), seed=1)
    second.restore(kept)
    while second.done < second.n_segment:
        second.advance()
    for method in second.methods:
        mine, whole = second.state(), default_hour.state()
        for name in mine:
            np.testing.assert_array_equal(mine[name], whole[name], err_msg=f"{method.name} {name}")


def test_days_and_methods_simulated_apart_are_those_of_one_run():
    # hidden transmitters: their draws are radio's alone, and a portion without radio lacks them
    site = scenario(days=3, last_hour=9.3, radio={"hidden_transmitters": 0.1})
    methods = ("open-loop", "encoder", "radio-both")
    whole = run(site, methods, count=2)
    state = whole.state()
    for learned in ("model", "cov"):
        np.testing.assert_array_equal(state[f"radio-both/evening/{learned}"], state[f"radio-both/{learned}"])
    parts = TrackingSimulation(site, methods=methods, count=2, seed=1)
    for _ in range(3):  # a day and half of the next, which begins again
        parts.advance()
    assert parts.n_over == 3 * 2
    portions = parts.portions(4)
    assert [(p.methods, p.i_day) for p in portions] == [
        (("radio-both",), 1), (("open-loop",), 1), (("encoder",), 1), (("open-loop",), 2), (("encoder",), 2),
    ]  # fmt: skip

    def apart(portion):
        return TrackingSimulation(site, methods=portion.methods, count=2, seed=1).go_through(
            portion, parts.learned(portion)
        )

    found = {p: apart(p) for p in portions[::-1]}
    assert [later for p in portions[1:] for later in parts.following(p)] == []
    for portion in portions:
        parts.take(portion, found[portion])
    rest = TrackingSimulation(site, methods=methods, count=2, seed=1)
    rest.restore({name: values.copy() for name, values in parts.state().items()})
    (last,) = parts.following(portions[0])
    assert parts.portions(4) == [last]
    parts.take(last, apart(last))
    assert parts.portions(4) == parts.following(last) == []
    assert parts.n_over == 3 * 6
    while rest.done < rest.n_segment:
        rest.advance()
    for name in methods:
        for results in (TrackingSimulation.sums, TrackingSimulation.curves):
            for field in dataclasses.fields(results(whole, name)):
                wanted = getattr(results(whole, name), field.name)
                for other in (parts, rest):
                    got = getattr(results(other, name), field.name)
                    assert got.tobytes() == wanted.tobytes(), f"{name} {field.name}"


def test_foundations_that_creep_need_new_models():
    creeping = scenario(
        {"mount_errors": {"creep_sigma_mrad_per_month": 1.0}, "days": 3, "day_interval": 40,
         "camera": {"interval_days": 60.0}, "last_hour": 9.5},
    )  # fmt: skip
    simulation = run(creeping, ("camera-model", "radio-model", "radio-both"))
    by_day = {m.name: 1e3 * score(simulation.sums(m.name)).day_rms_rad for m in simulation.methods}
    # the camera's last day was 30, 10 and 50 days ago
    camera = by_day["camera-model"]
    assert 1.3 * camera[1] < camera[0] < camera[2] / 1.3
    assert np.all(by_day["radio-model"] < 0.4)
    assert np.all(by_day["radio-both"] < 0.4)
