"""A live field, disturbed: each disturbance changes what it should, and nothing else does."""

from __future__ import annotations

import numpy as np
import pytest

from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.feedback import optics
from rfpose.feedback.tracking.live import FieldMoment, LiveField, live_scenario
from rfpose.pipeline.demo import shipped_scenario
from rfpose.scenario import Scenario, load_scenario


def scenario() -> Scenario:
    site = load_scenario(shipped_scenario("tracking_100m.toml"))
    return live_scenario(site.changed(heliostat=site.heliostat[:5]))


def after(field: LiveField, seconds: float) -> FieldMoment:
    for _ in range(round(seconds / field.step_s)):
        moment = field.step()
    return moment


@pytest.fixture
def field() -> LiveField:
    found = LiveField(scenario(), seed=4)
    after(found, 240.0)
    return found


def miss_rad(field: LiveField, moment: FieldMoment) -> np.ndarray:
    """Angle of each beam from the line to its aim point."""
    beam = optics.reflect(moment.normal_enu, moment.sun_enu)
    way = field.field.target[:, :3] - field.field.pivot_enu_m
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return np.arccos(np.clip(np.sum(beam * way, axis=1), -1.0, 1.0))


def test_field_settles_on_its_target_and_the_same_seed_gives_the_same_course(field: LiveField) -> None:
    moment = after(field, 60.0)
    assert moment.rms_rad < 0.4e-3
    assert miss_rad(field, moment).max() < 0.02  # centres lie off the pivots by up to the arm
    other = LiveField(scenario(), seed=4)
    np.testing.assert_array_equal(after(other, 300.0).normal_enu, moment.normal_enu)
    assert not np.array_equal(after(LiveField(scenario(), seed=5), 300.0).normal_enu, moment.normal_enu)


def test_killed_transmitter_raises_the_radio_sigma_and_enough_of_them_end_the_poses(field: LiveField) -> None:
    before = field.step()
    field.kill_transmitter("T10")
    one = field.step()
    assert np.all(one.radio_sigma_rad > before.radio_sigma_rad)
    np.testing.assert_array_equal(np.flatnonzero(one.dead), [9])
    for name in field.transmitter_ids[:9]:
        field.kill_transmitter(name)
    assert np.isnan(field.step().radio_sigma_rad).all()
    field.normal()
    back = field.step()
    assert not back.dead.any()
    np.testing.assert_allclose(back.radio_sigma_rad, before.radio_sigma_rad, rtol=0.02)


def test_stopped_motors_let_their_mirror_drift_with_the_sun_and_no_other(field: LiveField) -> None:
    field.stop_motor("H03")
    moment = after(field, 600.0)
    # the sun goes 7.3e-5 rad a second; a mirror must turn by about half of that
    assert moment.error_rad[2] > 8e-3
    assert np.delete(moment.error_rad, 2).max() < 2e-3
    np.testing.assert_array_equal(np.flatnonzero(moment.stopped), [2])
    field.normal()
    assert after(field, 300.0).error_rad.max() < 2e-3


def test_gust_bends_all_mirrors_by_the_square_of_its_speed_and_passes() -> None:
    calm, windy = LiveField(scenario(), seed=4), LiveField(scenario(), seed=4)
    after(calm, 240.0)
    after(windy, 240.0)
    windy.gust(16.0, 40.0)
    quiet, pushed = after(calm, 20.0), after(windy, 20.0)
    assert pushed.wind_mps == pytest.approx(4.0 + 16.0, rel=0.03)
    bend = np.linalg.norm(pushed.normal_enu - quiet.normal_enu, axis=1)
    whole = (20.0**2 - 4.0**2) * 1e-3 * np.hypot(0.003, 0.006)  # less what the loop has taken out, and gusts about it
    assert np.all(bend > 0.4 * whole)
    assert np.all(bend < 1.6 * whole)
    assert after(windy, 200.0).rms_rad < 0.4e-3
    assert windy.step().wind_mps == pytest.approx(4.0)


def test_emergency_takes_all_beams_off_the_target_in_half_a_minute_and_normal_brings_them_back(
    field: LiveField,
) -> None:
    field.stop_motor("H01")
    field.emergency()
    moment = after(field, 28.0)
    assert np.all(miss_rad(field, moment)[1:] > 0.1)
    assert miss_rad(field, moment)[0] < 0.03  # it cannot move
    field.normal()
    assert after(field, 400.0).rms_rad < 2e-3


def test_names_that_do_not_exist_and_a_day_that_is_over_are_refused() -> None:
    field = LiveField(scenario(), seed=1, start_hour=23.0)
    with pytest.raises(InvalidInputError, match="no transmitter is called 'T77'"):
        field.kill_transmitter("T77")
    with pytest.raises(InvalidInputError, match="no mirror is called 'H99'"):
        field.stop_motor("H99")
    field.step()
    assert field.over
    with pytest.raises(InvalidInputError, match="is over"):
        field.step()


def test_scenario_without_place_and_aim_gets_them_and_one_without_mirrors_is_refused() -> None:
    site = load_scenario(shipped_scenario("table2_100m.toml"))
    assert live_scenario(site).site.latitude_deg is not None
    assert live_scenario(site).site.aim_enu_m is not None
    with pytest.raises(ScenarioError, match="no heliostats"):
        live_scenario(site.model_copy(update={"heliostat": ()}))
