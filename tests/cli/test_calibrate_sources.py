"""Calibration from radio poses, pictures and flights, and commands from the model: as it is called."""

from __future__ import annotations

import csv
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from click.testing import CliRunner, Result

from rfpose import geometry
from rfpose.cli._app import app
from rfpose.feedback.calibration import fit
from rfpose.feedback.camera.render import Beam, CameraView, Target, render
from rfpose.feedback.drone import RtkDrone, fly
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Actuator, Mount, command, posture
from rfpose.feedback.optics import reflect, target_offset_m
from rfpose.feedback.paint import read_heliostat
from rfpose.pipeline.demo import shipped_scenario
from rfpose.pipeline.formats.mount_file import read_models
from rfpose.pipeline.formats.result_file import open_result
from rfpose.scenario import load_scenario
from rfpose.sun import Location, sun_position, unix_seconds

PAINT = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "paint"
SITE = Location(latitude_rad=np.deg2rad(37.1), longitude_rad=np.deg2rad(-2.36), altitude_m=500.0)
BOARD_ENU_M, BOARD_NORMAL = np.array([0.0, 0.0, 12.0]), np.array([0.0, 1.0, 0.0])
PLANNED = Mount(pivot_enu_m=np.array([6.0, 36.0, 1.5]), actuators=(Actuator(counts_per_unit=5000.0),) * 2)
TRUE = PLANNED.replace(
    axis_1_zero_rad=6e-3, axis_2_zero_rad=-4e-3, pedestal_tilt_north_rad=2e-3, pedestal_tilt_east_rad=1e-3
)
FREE = ("pedestal_tilt_north_rad", "pedestal_tilt_east_rad", "axis_1_zero_rad", "axis_2_zero_rad")


def _run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def _json(*arguments: object) -> dict[str, Any]:
    shown = _run(*arguments, "--json")
    assert shown.exit_code == 0, shown.stderr
    return json.loads(shown.stdout)


def _table(path: Path, header: str, rows: list[list[Any]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header.split(","), *rows])


def _iso(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s, UTC).isoformat()


def _take_pictures(folder: Path) -> None:
    """Eleven pictures over a day, steered as planned and re-aimed a little: good ones, one empty, one of two beams."""
    from skimage import io

    folder.mkdir()
    rng = np.random.default_rng(1)
    start = unix_seconds(["2026-03-20T07:30:00Z"])[0]
    rows = []
    for i in range(11):
        unix_s = start + 3600.0 * i
        sun = sun_position([unix_s], SITE).direction_enu[0]
        # the heliostat is told to aim beside the board's centre by what it is known to be off
        count = np.rint(command(TRUE, sun_enu=sun, target_enu_m=BOARD_ENU_M).count)
        got = posture(TRUE, count)
        off = target_offset_m(
            got.centre_enu_m,
            reflect(got.normal_enu, sun),
            target_enu_m=BOARD_ENU_M,
            target_normal_enu=BOARD_NORMAL,
        )
        beams: tuple[Beam, ...] = (Beam(centre_m=(float(off[0]), float(off[1]))),)
        if i == 3:
            beams = ()
        if i == 7:
            beams = (Beam(centre_m=(-0.45, 0.3)), Beam(centre_m=(0.5, -0.3)))
        io.imsave(folder / f"{i}.png", render(Target(), CameraView(), beams, rng=rng), check_contrast=False)
        rows.append([f"{i}.png", _iso(unix_s), "A1", *count])
    _table(folder / "pictures.csv", "file,time_utc,heliostat,axis_1,axis_2", rows)
    (folder / "board.toml").write_text(
        tomli_w.dumps({"centre_enu_m": BOARD_ENU_M.tolist(), "normal_enu": BOARD_NORMAL.tolist()})
    )


def _fly(path: Path) -> None:
    (made,) = fly(
        [TRUE], target_enu_m=[0.0, 0.0, 12.0], n_point=60, rng=np.random.default_rng(2), drone=RtkDrone(), layout="dome"
    )
    names = ",".join(f"{what}_{axis}_m" for what in ("drone", "target") for axis in ("east", "north", "up"))
    rows = [["A1", *c, *r[:3], *r[4:7]] for c, r in zip(made.count.tolist(), made.row.tolist(), strict=True)]
    _table(path, f"heliostat,axis_1,axis_2,{names}", rows)


def _radio(where: Path) -> dict[str, Any]:
    """A result of two frames of one heliostat, and the log of its motors; returns its planned mount."""
    site = load_scenario(shipped_scenario("table2_100m.toml"))
    short = {"radio": {"frame_samples": 8000}, "simulation": {"frame_count": 2, "sun_azimuth_deg": 170.0}}
    site.changed(heliostat=site.heliostat[:1], **short).save(where / "site.toml")
    _json("simulate", where / "site.toml", "-o", where / "rec.h5", "--seed", 4)
    _json("process", where / "rec.h5", "-o", where / "result.h5")
    result = open_result(where / "result.h5")
    rows = []
    for i in range(2):
        azimuth, elevation = geometry.azimuth_elevation_from_enu(result.truth.normal_enu[i, 0])
        when = float(int(result.frame_start_index[i]) / result.sample_rate)
        # its log reads 0.05 rad more than the first axis has turned
        rows.append([_iso(when), result.scenario.heliostat_ids[0], float(azimuth) + 0.05, float(elevation)])
    _table(where / "motors.csv", "time_utc,heliostat,axis_1,axis_2", rows)
    return {result.scenario.heliostat_ids[0]: {"pivot_enu_m": result.poses.centre_enu_m[0, 0].tolist()}}


@pytest.fixture(scope="module")
def where(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("skimage", reason="pictures need scikit-image")
    folder = tmp_path_factory.mktemp("sources")
    heliostats = _radio(folder)
    drives = [{"counts_per_unit": 5000.0}, {"counts_per_unit": 5000.0}]
    heliostats["A1"] = {"pivot_enu_m": PLANNED.pivot_enu_m.tolist(), "actuators": drives}
    site = {"latitude_deg": 37.1, "longitude_deg": -2.36, "altitude_m": 500.0}
    content = {"format": "rfpose-mount", "version": 1, "site": site, "heliostat": heliostats}
    (folder / "planned.toml").write_text(tomli_w.dumps(content))
    _take_pictures(folder / "pictures")
    _fly(folder / "flight.csv")
    return folder


def test_pictures_and_a_flight_in_one_fit(where: Path) -> None:
    model = where / "models.json"
    found = _json(
        "calibrate", "--mount", where / "planned.toml", "--camera", where / "pictures", "--drone", where / "flight.csv",
        "-o", model,
    )["heliostats"][0]  # fmt: skip
    assert found["sources"] == {"camera": 9, "drone": 60}
    assert set(found["skipped"]) == {"3.png", "7.png"}
    assert "no spot" in found["skipped"]["3.png"]
    assert "two spots" in found["skipped"]["7.png"]
    assert found["notes"] == []
    for name in FREE:
        entry = found["parameters"][name]
        assert abs(entry["estimate"] - TRUE.parameters[name]) < 5.0 * entry["sigma"] + 5e-5, name
        assert entry["sigma"] < 2e-4
    stored = read_models(model)
    known = stored.heliostats["A1"]
    assert stored.site == SITE
    assert known.mount.parameters["axis_1_zero_rad"] == found["parameters"]["axis_1_zero_rad"]["estimate"]
    assert known.noise_rad == pytest.approx(1e-3 * found["noise_mrad"])
    np.testing.assert_allclose(
        np.sqrt(np.diag(known.covariance)), [found["parameters"][name]["sigma"] for name in FREE], rtol=1e-9
    )


def test_pictures_alone(where: Path) -> None:
    found = _json(
        "calibrate", "--mount", where / "planned.toml", "--camera", where / "pictures", "--parameters", "offsets"
    )["heliostats"][0]
    assert found["used"] == 9
    assert found["median_mrad"] < 1.0


def test_radio_alone_says_what_it_cannot_know(where: Path) -> None:
    found = _json(
        "calibrate", "--mount", where / "planned.toml", "--radio", where / "result.h5", "--motors",
        where / "motors.csv", "--parameters", "offsets",
    )["heliostats"][0]  # fmt: skip
    assert found["sources"] == {"radio": 2}
    assert found["parameters"]["axis_1_zero_rad"]["estimate"] == pytest.approx(-0.05, abs=0.01)
    assert "receivers' plane" in found["notes"][0]


def test_radio_with_a_flight_gets_the_receivers_plane(where: Path, tmp_path: Path) -> None:
    # the flight's heliostat under the radio one's name and place
    name = next(iter(read_models(where / "planned.toml").heliostats))
    mount = read_models(where / "planned.toml").heliostats[name].mount
    (made,) = fly([mount], target_enu_m=[0.0, 0.0, 20.0], n_point=30, rng=np.random.default_rng(3))
    names = ",".join(f"{what}_{axis}_m" for what in ("drone", "target") for axis in ("east", "north", "up"))
    rows = [[name, *c, *r[:3], *r[4:7]] for c, r in zip(made.count.tolist(), made.row.tolist(), strict=True)]
    _table(tmp_path / "flight.csv", f"heliostat,axis_1,axis_2,{names}", rows)
    found = _json(
        "calibrate", "--mount", where / "planned.toml", "--radio", where / "result.h5", "--motors",
        where / "motors.csv", "--drone", tmp_path / "flight.csv", "--parameters", "offsets",
    )["heliostats"][0]  # fmt: skip
    assert set(found["parameters"]) == {
        "axis_1_zero_rad", "axis_2_zero_rad", "receiver_plane_up_rad", "receiver_plane_right_rad"
    }  # fmt: skip
    assert found["undetermined"] == []
    assert abs(found["parameters"]["axis_1_zero_rad"]["estimate"]) < 1e-3
    # the log's 0.05 rad of azimuth: to the right, shortened by the cosine of the elevation
    log = list(csv.DictReader((where / "motors.csv").read_text().splitlines()))
    cosine = np.cos(float(log[0]["axis_2"]))
    plane = found["parameters"]["receiver_plane_right_rad"]["estimate"]
    assert abs(plane) == pytest.approx(0.05 * cosine, rel=0.15)


@pytest.mark.skipif(not PAINT.is_dir(), reason=f"the PAINT records are not at {PAINT}")
def test_real_records_and_a_flight_in_one_fit(tmp_path: Path) -> None:
    data = read_heliostat(PAINT, "BF57")
    fitted = fit(data.mount, Measurements.from_spots(data.count, sun_enu=data.sun_enu, spot_enu_m=data.spot_enu_m),
                 free="level-7").mount  # fmt: skip
    (made,) = fly([fitted], target_enu_m=[0.0, 0.0, 40.0], n_point=40, rng=np.random.default_rng(5))
    names = ",".join(f"{what}_{axis}_m" for what in ("drone", "target") for axis in ("east", "north", "up"))
    rows = [["BF57", *c, *r[:3], *r[4:7]] for c, r in zip(made.count.tolist(), made.row.tolist(), strict=True)]
    _table(tmp_path / "flight.csv", f"heliostat,axis_1,axis_2,{names}", rows)
    (found,) = _json(
        "calibrate", PAINT, "--heliostat", "BF57", "--drone", tmp_path / "flight.csv", "--parameters", "level-7"
    )["heliostats"]
    assert found["sources"] == {"PAINT": 145, "drone": 40}
    assert found["median_mrad"] < 0.7


def test_commands_of_the_model_hit(where: Path, tmp_path: Path) -> None:
    model, table = where / "models.json", tmp_path / "day.csv"
    if not model.exists():
        test_pictures_and_a_flight_in_one_fit(where)
    target = (3.0, 1.0, 14.0)
    told = _json(
        "aim", model, "--target", *target, "--start", "2026-06-21T04:00Z", "--hours", 8, "--step", 1800,
        "--next", 3, "-o", table,
    )["heliostats"][0]  # fmt: skip
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == 17
    assert rows[0]["status"] == "sun down"
    assert rows[0]["axis_1"] == ""
    good = [row for row in rows if row["status"] == "ok"]
    assert len(good) >= 12
    sun = sun_position(unix_seconds([row["time_utc"] for row in good]), SITE).direction_enu
    got = posture(TRUE, [[float(row["axis_1"]), float(row["axis_2"])] for row in good])
    miss = geometry.angle_between_rad(reflect(got.normal_enu, sun), np.array(target) - got.centre_enu_m)
    sigma = 2e-3 * np.array([float(row["normal_sigma_mrad"]) for row in good])
    assert np.all(miss < 4.0 * sigma + 1e-5)
    assert all(float(row["normal_with_noise_mrad"]) > float(row["normal_sigma_mrad"]) for row in good)
    assert len(told["month_sigma_mrad"]) == 12
    after = [item["sigma_after_mrad"] for item in told["next"]]
    assert told["year_sigma_mrad"] > after[0] > after[1] > after[2]


def test_a_person_reads_it_too(where: Path) -> None:
    planned = _run("aim", where / "planned.toml", "--heliostat", "A1", "--dish", "--start", "2026-06-21T08:00Z")
    assert planned.exit_code == 0, planned.stderr
    assert "not calibrated" in planned.stdout
    known = _run("info", where / "planned.toml")
    assert "kind: model" in known.stdout
    assert "calibrated no" in known.stdout
    fitted = _run("calibrate", "--mount", where / "planned.toml", "--camera", where / "pictures")
    assert "3.png left out: no spot" in fitted.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["calibrate"], 2, "give a PAINT DIRECTORY"),
        (["calibrate", "--mount", "{w}/planned.toml"], 2, "needs measurements"),
        (["calibrate", "--mount", "{w}/planned.toml", "--radio", "{w}/result.h5"], 2, "belong together"),
        (["calibrate", "{w}/nowhere", "--drone", "{w}/flight.csv"], 3, "nowhere: no such file or directory"),
        (["calibrate", "--mount", "{w}/motors.csv", "--drone", "{w}/flight.csv"], 3, "motors.csv: not valid JSON"),
        (["calibrate", "--mount", "{w}/site.toml", "--drone", "{w}/flight.csv"], 3, "no rfpose-mount file"),
        (["calibrate", "--mount", "{w}/planned.toml", "--drone", "{w}/motors.csv"], 3, "has no column drone_east_m"),
        (["calibrate", "--mount", "{w}/planned.toml", "--camera", "{w}"], 3, "board.toml: is missing"),
        (["aim", "{w}/planned.toml", "--start", "2026-06-21T08:00Z"], 2, "--dish"),
        (["aim", "{w}/planned.toml", "--dish", "--start", "noon"], 3, "ISO 8601"),
        (["aim", "{w}/planned.toml", "--dish", "--start", "2026-06-21T08:00"], 3, "time zone"),
        (["aim", "{w}/planned.toml", "--dish", "--start", "2026-06-21T08:00Z", "--heliostat", "Z"], 3, "no heliostat"),
    ],
)
def test_mistakes_are_named(where: Path, arguments: list[str], code: int, message: str) -> None:
    shown = _run(*(word.format(w=where) for word in arguments))
    assert shown.exit_code == code, shown.output
    assert message in " ".join(shown.stderr.split())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 9}, "update rfpose"),
        ({"heliostat": {}}, "names no heliostat"),
        ({"heliostat": {"A": {}}}, "heliostat A: 'pivot_enu_m' is missing"),
        ({"heliostat": {"A": {"pivot_enu_m": [0, 0, 0], "tilt": 1}}}, "no key is called 'tilt'"),
        ({"heliostat": {"A": {"pivot_enu_m": [0, 0, 0], "parameters": {"tilt": 1}}}}, "no mount parameter"),
        ({"heliostat": {"A": {"pivot_enu_m": [0, 0, 0], "actuators": [{}]}}}, "must be two"),
        ({"site": {"latitude_deg": "north"}}, "latitude_deg"),
    ],
)
def test_broken_models_are_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    content = {"format": "rfpose-mount", "version": 1, "heliostat": {"A": {"pivot_enu_m": [0, 0, 0]}}} | change
    (tmp_path / "m.json").write_text(json.dumps(content))
    shown = _run("info", tmp_path / "m.json")
    assert shown.exit_code == 3
    assert message in " ".join(shown.stderr.split())


def test_a_log_line_that_is_no_number_is_named(where: Path, tmp_path: Path) -> None:
    text = (where / "flight.csv").read_text().splitlines()
    text[2] = text[2].replace(text[2].split(",")[3], "far")
    (tmp_path / "f.csv").write_text("\n".join(text))
    shown = _run("calibrate", "--mount", where / "planned.toml", "--drone", tmp_path / "f.csv")
    assert shown.exit_code == 3
    assert "f.csv line 3: drone_east_m must be a number, got 'far'" in shown.stderr
