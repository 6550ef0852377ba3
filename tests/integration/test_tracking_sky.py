"""Tracking with the sun in and out of clouds: what is scored, and what the time to respond costs."""

from pathlib import Path

import numpy as np
import pytest

from rfpose.feedback.energy import draw_bursts
from rfpose.feedback.tracking import TrackingSimulation, score
from rfpose.feedback.tracking.sky import under_sky
from rfpose.feedback.tracking.timeline import days
from rfpose.scenario import load_scenario

DATA = Path(__file__).resolve().parents[2] / "data" / "tracking_100m.toml"
CLOUDY = 11
"""A seed with clouds that come and go within these hours."""


def scenario(**tracking):
    hours = {"first_hour": 9.0, "last_hour": 10.25, "field_control": None}
    return load_scenario(DATA).changed(tracking={"sky": "bursts", **hours, **tracking})


def run(site, methods, *, seed=CLOUDY):
    simulation = TrackingSimulation(site, methods=methods, count=3, seed=seed)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    return simulation


@pytest.fixture(scope="module")
def dishes():
    # mounts so far off that the sun sensor does not see the sun from where the model alone puts them
    crooked = {"tilt_sigma_mrad": 8.0, "zero_sigma_mrad": 8.0}
    return run(scenario(collector="dish", mount_errors=crooked), ("sun-sensor", "open-loop", "radio"))


def test_the_beam_is_on_or_off_and_a_date_keeps_its_sky():
    site, clear = scenario(), scenario(sky="clear")
    bare = days(site)
    assert under_sky(clear, bare, seed=CLOUDY) == bare
    short = under_sky(site, bare, seed=CLOUDY)[0]
    lit = short.power_w_per_m2 > 0.0
    assert 0.1 < lit.mean() < 0.9
    np.testing.assert_array_equal(short.power_w_per_m2[lit], bare[0].power_w_per_m2[lit])
    # hours within which the field tracks cut from the same clouds
    later = scenario(first_hour=9.5)
    cut = under_sky(later, days(later), seed=CLOUDY)[0]
    both, here, there = np.intersect1d(short.unix_s, cut.unix_s, return_indices=True)
    assert len(both) > 2000
    np.testing.assert_array_equal(lit[here], cut.power_w_per_m2[there] > 0.0)


def test_days_have_the_sunshine_of_the_bursts_that_they_are_drawn_from():
    site = scenario(days=60, first_hour=0.0, last_hour=24.0)
    found = [np.mean(day.power_w_per_m2 > 0.0) for day in under_sky(site, days(site), seed=1)]
    drawn = [np.diff(day, axis=1).sum() / 36_000.0 for day in draw_bursts(np.random.default_rng(1), n_day=2000)]
    assert np.mean(found) == pytest.approx(np.mean(drawn), abs=3.0 * np.std(drawn) / np.sqrt(60))
    assert np.mean(np.array(found) > 0.999) == pytest.approx(0.5, abs=0.2)


def test_sunshine_and_bursts_are_counted_as_the_sky_has_them(dishes):
    lit = dishes.days[0].power_w_per_m2 > 0.0
    scored = np.arange(len(lit)) >= 120
    came_out = np.concatenate([[False], lit[1:] & ~lit[:-1]])
    for method in dishes.methods:
        found = score(dishes.sums(method.name))
        assert found.sunshine_s == np.sum(lit & scored)
        assert found.bursts == np.sum(came_out & scored) > 0
        # Edwards' loss: the error over the drives' speed of 40 mrad/s, at every burst
        expected = found.burst_error_rad / 40e-3 * found.bursts / found.sunshine_s
        assert found.turning_loss == pytest.approx(expected, rel=1e-9)


def test_clouds_take_light_and_do_not_mislead_a_loop_that_needs_no_sun():
    clear, clouded = (run(scenario(sky=sky), ("open-loop", "radio")) for sky in ("clear", "bursts"))
    lit = clouded.days[0].power_w_per_m2[120:].sum() / clear.days[0].power_w_per_m2[120:].sum()
    for name in ("open-loop", "radio"):
        bright, dim = score(clear.sums(name)), score(clouded.sums(name))
        assert dim.normal_rms_rad == bright.normal_rms_rad
        assert dim.energy_j_per_m2 == pytest.approx(lit * bright.energy_j_per_m2, rel=0.1)
        assert bright.bursts == 0.0
        assert np.isnan(bright.response_loss)
    assert abs(score(clouded.sums("radio")).response_loss) < 2e-3


def test_a_servo_that_needs_the_sun_pays_for_every_burst(dishes):
    sensor, radio = score(dishes.sums("sun-sensor")), score(dishes.sums("radio"))
    assert sensor.burst_error_rad > 1.5 * radio.burst_error_rad
    assert sensor.response_loss > 2.0 * abs(radio.response_loss)
    assert sensor.response_loss_j_per_m2 > 0.0


def test_taken_up_again_amid_clouds_nothing_changes():
    site = scenario(collector="dish")
    whole = run(site, ("sun-sensor",))
    first = TrackingSimulation(site, methods=("sun-sensor",), count=3, seed=CLOUDY)
    for _ in range(2):
        first.advance()
    second = TrackingSimulation(site, methods=("sun-sensor",), count=3, seed=CLOUDY)
    second.restore({name: values.copy() for name, values in first.state().items()})
    while second.done < second.n_segment:
        second.advance()
    for name, values in whole.state().items():
        np.testing.assert_array_equal(second.state()[name], values, err_msg=name)
