"""The simulated sun: from site and time, or by hand where a sun may stand."""

import logging
from pathlib import Path

import numpy as np
import pytest

from rfpose import geometry
from rfpose.errors import ScenarioError
from rfpose.pipeline.inspect import inspect_file
from rfpose.pipeline.simulate import simulate
from rfpose.scenario import load_scenario, parse_scenario
from rfpose.simulator import Simulator
from rfpose.sun import why_never

TABLE2 = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
NO_SUN = {"sun_azimuth_deg": None, "sun_elevation_deg": None, "frame_count": 3, "frame_interval_s": 3600.0}


@pytest.fixture
def site():
    s = load_scenario(TABLE2)
    return s.changed(heliostat=s.heliostat[:2], site={"latitude_deg": 37.0, "longitude_deg": 0.0}, simulation=NO_SUN)


def test_mirrors_send_the_sun_of_site_and_time_to_the_aim_point(site):
    """At the solstice's solar noon the sun stands 90° − φ + ε high in the south; an hour is 15° of hour angle."""
    noon = site.changed(simulation={"start": "2026-06-21T12:02Z"})  # the equation of time is −2 min
    normal = Simulator(noon, seed=0).truth.normal_enu
    to_aim = geometry.unit(np.array([0.0, 0.0, 50.0]) - noon.pivot_enu_m)
    seen = 2.0 * np.sum(normal * to_aim, axis=-1, keepdims=True) * normal - to_aim
    latitude, declination = np.radians([37.0, 23.44])
    for frame, hour_angle in enumerate(np.radians([0.0, 15.0, 30.0])):
        sine = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour_angle)
        np.testing.assert_allclose(np.arcsin(seen[frame, :, 2]), np.arcsin(sine), atol=2e-3)
    assert np.all(np.abs(seen[0, :, 0]) < 2e-3)
    assert np.all(seen[1:, :, 0] < -0.1)
    np.testing.assert_array_equal(noon.posture_enu, normal[0])


def test_dishes_face_the_sun_without_an_aim_point(site):
    dishes = site.changed(site={"aim_enu_m": None}, tracking={"collector": "dish"})
    normal = Simulator(dishes, seed=0).truth.normal_enu
    np.testing.assert_allclose(normal, np.repeat(dishes.simulated_suns_enu[:, None], 2, axis=1))


def test_at_night_nothing_can_be_followed(site):
    night = site.changed(simulation={"start": "2026-06-21T19:00Z"})
    with pytest.raises(ScenarioError, match=r"frame 1 the sun is below the horizon.*`simulation.start`"):
        Simulator(night, seed=0)
    assert np.isfinite(night.posture_enu).all()


@pytest.mark.parametrize(
    "line",
    ["start = 2026-06-21T12:00Z", "start = 2026-06-21T14:00:00+02:00  # noon", 'start = "2026-06-21T12:00Z"'],
)
def test_a_start_is_a_time_with_or_without_seconds(line):
    text = TABLE2.read_text().replace("[simulation]", "[simulation]\n" + line)
    assert parse_scenario(text).simulation.start_unix_s == 1_782_043_200


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("start = 2026-06-21T12:00", "time zone"),
        ("start = 2026-06-21T12:00:00.5Z", "whole second"),
        ("start = 12", "ISO 8601"),
        ("start = 2026-06-21T12:00Z\nstart_unix_s = 1", "keep the one that counts"),
    ],
)
def test_a_bad_start_is_refused(line, says):
    with pytest.raises(ScenarioError, match=says):
        parse_scenario(TABLE2.read_text().replace("[simulation]", "[simulation]\n" + line))


def test_where_no_sun_stands():
    assert "none reaches it" in why_never(0.0, 60.0, 37.0)  # high in the north from Sicily
    assert why_never(0.0, 60.0, -33.9) == ""
    assert why_never(180.0, 76.0, 37.0) == ""
    assert "none reaches it" in why_never(180.0, 79.0, 37.0)
    assert why_never(0.0, 60.0, None) == ""
    assert "below" in why_never(0.0, -1.0, None)


def test_a_sun_by_hand_that_never_was_is_named(site, tmp_path, caplog):
    wrong = site.changed(simulation={"sun_azimuth_deg": (180.0, 350.0), "sun_elevation_deg": 60.0})
    with caplog.at_level(logging.WARNING):
        simulate(wrong)
    assert "azimuth 350°, elevation 60°: at latitude 37° none reaches it" in caplog.text
    wrong.save(tmp_path / "site.toml")
    found = inspect_file(tmp_path / "site.toml")
    assert not found["sound"]
    assert "azimuth 350°" in found["problems"][0]
