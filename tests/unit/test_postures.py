"""Where mirrors were told to point: which source is believed, and what a table of postures must hold."""

import logging
from pathlib import Path

import numpy as np
import pytest

from rfpose import geometry
from rfpose.errors import ScenarioError
from rfpose.pipeline.postures import commanded_normals, read_postures
from rfpose.scenario import load_scenario
from rfpose.simulator import Simulator
from rfpose.sun import site_from_degrees, sun_position

TABLE2 = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
NOON_UNIX_S = 1_782_039_600.0 + 60.0 * np.arange(3)  # 2026-06-21 11:00 UTC


@pytest.fixture
def site():
    plate = {"id": "N1", "pivot_enu_m": (24.0, 3.0, 2.0), "width_m": 2.0, "height_m": 2.0}
    s = load_scenario(TABLE2).changed(site={"structures": {"plate": (plate,)}, "latitude_deg": None})
    return s.changed(heliostat=s.heliostat[:2])


def angle_rad(a, b):
    return float(np.max(geometry.angle_between_rad(a, np.broadcast_to(b, np.shape(a)))))


def test_the_simulated_sun_is_what_the_simulator_has(site):
    turning = site.changed(simulation={"sun_azimuth_deg": (120.0, 150.0), "frame_count": 3})
    normal = commanded_normals(turning, NOON_UNIX_S)
    assert normal.shape == (3, 3, 3)
    simulated = Simulator(turning, seed=1).truth.normal_enu
    np.testing.assert_allclose(normal[:, :2], simulated, atol=1e-12)
    assert np.isfinite(normal).all()


def test_the_sun_of_the_time_is_believed_but_for_simulated_frames(site):
    placed = site.changed(site={"latitude_deg": 37.0, "longitude_deg": 14.0})
    sun = sun_position(NOON_UNIX_S, site_from_degrees(37.0, 14.0)).direction_enu
    wanted = geometry.bisector_enu(sun, np.array(site.site.aim_enu_m) - site.pivot_enu_m[1])
    assert angle_rad(commanded_normals(placed, NOON_UNIX_S)[:, 1], wanted) < 1e-9
    by_simulation = commanded_normals(site, NOON_UNIX_S)
    assert angle_rad(by_simulation[:, 1], wanted) > 0.01
    np.testing.assert_array_equal(commanded_normals(placed, NOON_UNIX_S, simulated=True), by_simulation)


def test_what_is_not_known_is_nan_and_said_once(site, caplog):
    nowhere = site.changed(simulation={"sun_azimuth_deg": None})
    with caplog.at_level(logging.WARNING):
        normal = commanded_normals(nowhere, [np.nan, np.nan])
    assert np.isnan(normal).all()
    (said,) = caplog.messages
    assert "3 of 3 mirrors have frames without a known posture, such as `H01`" in said
    night = site.changed(site={"latitude_deg": 37.0, "longitude_deg": 14.0}, simulation={"sun_azimuth_deg": None})
    assert np.isnan(commanded_normals(night, NOON_UNIX_S[:1] + 43_200.0)).all()


def test_a_table_goes_before_the_scenario_and_that_before_the_sun(site, tmp_path):
    table = tmp_path / "postures.csv"
    table.write_text("# from the control room\nid,frame,normal_e,normal_n,normal_u\nH01,1,0,-3,4\nX9,0,0,0,1\n")
    given = site.changed(posture={"csv": str(table)}, heliostat={"normal_enu": (0.0, 0.0, 2.0)})
    normal = commanded_normals(given, NOON_UNIX_S)
    np.testing.assert_allclose(normal[1, 0], [0.0, -0.6, 0.8])
    np.testing.assert_allclose(normal[[0, 2], 0], [[0, 0, 1], [0, 0, 1]])
    np.testing.assert_allclose(normal[:, 1], np.tile([0, 0, 1], (3, 1)))
    assert np.isfinite(normal[:, 2]).all()  # the plate follows the sun


def test_between_its_times_a_mirror_turns_evenly(tmp_path):
    table = tmp_path / "postures.csv"
    table.write_text(
        "id,time,azimuth_deg,elevation_deg\n"
        "H01,2026-06-21T11:02:00Z,180,60\nH01,2026-06-21T11:00:30Z,180,30\nH02,2026-06-21T11:01:00Z,90,0\n"
    )
    normal = read_postures(table, ["H01", "H02"], [*NOON_UNIX_S, np.nan])
    azimuth, elevation = geometry.azimuth_elevation_from_enu(normal[1:3, 0])
    np.testing.assert_allclose(np.degrees(azimuth), 180.0)
    assert np.degrees(elevation[1]) == pytest.approx(60.0)
    assert np.degrees(elevation[0]) == pytest.approx(40.0, abs=0.5)
    assert np.isnan(normal[[0, 3], 0]).all()
    np.testing.assert_allclose(normal[1, 1], [1.0, 0.0, 0.0], atol=1e-12)
    assert np.isnan(normal[[0, 2], 1]).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("id;frame;azimuth_deg;elevation_deg\n", "separated by `;`"),
        ("id,frame,azimuth_deg\nH01,0,1\n", "line 1 must name the columns"),
        ("frame,azimuth_deg,elevation_deg\n0,1,1\n", "line 1 must name the columns"),
        ("id,frame,time,azimuth_deg,elevation_deg\n", "keep the one that counts"),
        ("id,frame,azimuth_deg,elevation_deg\nH01,0,1\n", "line 2 has 3 cells, the header 4"),
        ("id,frame,azimuth_deg,elevation_deg\nH01,0,south,3\n", "line 2: `azimuth_deg` must be a number"),
        ("id,frame,azimuth_deg,elevation_deg\nH01,0,nan,3\n", "line 2: `azimuth_deg` must be finite"),
        ("id,frame,azimuth_deg,elevation_deg\nH01,0.5,1,3\n", "line 2: `frame` must be a whole number"),
        ("id,time,azimuth_deg,elevation_deg\nH01,2026-06-21T11:00:00,1,3\n", "line 2: `time`: .*time zone"),
        ("id,normal_e,normal_n,normal_u\nH01,0,0,0\n", "line 2: the normal must not be zero"),
        ("id,frame,azimuth_deg,elevation_deg\nH01,0,1,3\nH01,0,1,4\n", "`H01` has two postures in frame 0"),
        ("id,azimuth_deg,elevation_deg\nH01,1,3\nH01,1,4\n", "`H01` has two postures; remove one"),
        (
            "id,time,azimuth_deg,elevation_deg\nH01,2026-06-21T11:00:00Z,1,3\nH01,2026-06-21T11:00:00Z,1,4\n",
            "two postures at one time",
        ),
        ('id,azimuth_deg,elevation_deg\nH01,1,"3\n', "no CSV"),
    ],
)
def test_tables_that_cannot_be_read_say_where(tmp_path, text, words):
    table = tmp_path / "postures.csv"
    table.write_text(text)
    with pytest.raises(ScenarioError, match=words) as caught:
        read_postures(table, ["H01"], NOON_UNIX_S)
    assert "postures.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_table_is_named(site):
    with pytest.raises(ScenarioError, match=r"nowhere\.csv"):
        commanded_normals(site.changed(posture={"csv": "nowhere.csv"}), NOON_UNIX_S)
