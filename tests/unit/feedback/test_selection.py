"""Parameters that the records carry, fits without redundancy, drift, and PAINT records as others write them."""

from __future__ import annotations

import codecs
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.feedback.calibrated import LEAST_REDUNDANCY, PARAMETER_SETS
from rfpose.feedback.calibration import FitSettings, fit
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import PARAMETERS, Mount
from rfpose.feedback.paint import PaintHeliostat, read_heliostat
from rfpose.feedback.selection import PLANNED_SIGMA, candidates, fit_chosen
from rfpose.pipeline.calibrate import calibrate
from rfpose.pipeline.formats.mount_file import read_models
from rfpose.pipeline.samples.paint import ERRORS, TARGET, tower, wgs84, write_json, write_paint

EAST, WEST = (20.0, 80.0, 1.5), (-30.0, 60.0, 1.5)
CREEP_RAD_PER_DAY = 0.05e-3 / 30.4


def made_of(data: PaintHeliostat, index: Any = slice(None)) -> Measurements:
    return Measurements.from_spots(
        data.count, sun_enu=data.sun_enu, spot_enu_m=data.spot_enu_m, unix_s=data.order_s
    ).take(index)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_paint(tmp_path_factory.mktemp("paint"), {"AA11": EAST, "AB12": WEST}, n_record=16)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_paint(tmp_path, {"AA11": EAST, "AB12": WEST}, n_record=6)


def edit(path: Path, change: Any) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_every_parameter_has_a_prior() -> None:
    assert set(PLANNED_SIGMA) == set(PARAMETERS)


def test_the_choice_stands_in_table_json_and_model(sound: Path, tmp_path: Path) -> None:
    model = tmp_path / "m.json"
    told = run("calibrate", sound, "--heliostat", "AB12", "-o", model)
    assert told.exit_code == 0, told.stderr
    stored = read_models(model).heliostats["AB12"].choice
    assert stored is not None
    assert f"chosen: {stored.chosen}: {stored.reason}" in told.stdout
    assert "on the time-blocks held out" in stored.reason
    (item,) = json.loads(run("calibrate", sound, "--heliostat", "AB12", "--json").stdout)["heliostats"]
    assert item["choice"]["chosen"] == stored.chosen
    assert item["choice"]["reason"] == stored.reason
    assert set(item["choice"]["held_out_mrad"]) == set(candidates(read_heliostat(sound, "AB12").mount))
    assert all("prior_sigma" in entry for entry in item["parameters"].values())
    free = run("calibrate", sound, "--heliostat", "AB12", "--parameters", "level-4", "--json")
    assert json.loads(free.stdout)["heliostats"][0]["choice"] is None


def test_what_was_chosen_predicts_what_the_mount_does(sound: Path) -> None:
    for name in ("AA11", "AB12"):
        data = read_heliostat(sound, name)
        true = data.mount.replace(**ERRORS)
        fitted = fit_chosen(data.mount, made_of(data)).mount
        # five parameters of 16 records with 0.3 mrad a component leave 0.3 * sqrt(5 / 16) = 0.17 mrad; three times that
        assert float(np.median(_apart(fitted, true, data))) < 0.55e-3
        assert float(np.median(_apart(data.mount, true, data))) > 3e-3


def _apart(one: Mount, other: Mount, data: PaintHeliostat) -> Any:
    from rfpose.feedback.mount import posture

    return np.linalg.norm(posture(one, data.count).normal_enu - posture(other, data.count).normal_enu, axis=1)


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_never_more_parameters_than_the_records_carry(sound: Path, n: int) -> None:
    data = read_heliostat(sound, "AA11")
    made = made_of(data, slice(0, n))
    found = fit_chosen(data.mount, made)
    assert found.field.carried[0] <= 2 * n
    assert found.field.redundancy[0] >= 0.0
    # what the fit did not see comes out no worse than as planned
    rest = made_of(data, slice(n, None))
    assert np.median(fit_errors(found.mount, rest)) < np.median(fit_errors(data.mount, rest))


def fit_errors(mount: Mount, made: Measurements) -> Any:
    from rfpose.feedback.calibration import normal_errors_rad

    return normal_errors_rad(mount, made)


@pytest.mark.parametrize(("n", "free"), [(2, "level-4"), (4, "level-7"), (6, "level-full")])
def test_without_redundancy_the_noise_is_the_stated_one_and_aim_says_so(
    sound: Path, tmp_path: Path, n: int, free: str
) -> None:
    few = tmp_path / "few"
    write_paint(few, {"AA11": EAST}, n_record=n)
    model = tmp_path / "m.json"
    told = run("calibrate", few, "--parameters", free, "-o", model)
    assert told.exit_code == 0, told.stderr
    assert ", assumed" in told.stdout
    assert "measure more" in told.stdout
    known = read_models(model).heliostats["AA11"]
    assert known.noise_assumed
    assert known.noise_rad > 0.5e-3  # of the stated 1 mrad
    aimed = run("aim", model, "--target", 0, 0, 36, "--start", "2026-06-21T10:00Z", "--hours", 0)
    assert "noise is assumed" in aimed.stdout
    (plan,) = json.loads(
        run("aim", model, "--target", 0, 0, 36, "--start", "2026-06-21T10:00Z", "--hours", 0, "--json").stdout
    )["heliostats"]
    assert plan["noise_assumed"] is True
    assert plan["commands"][0]["normal_with_noise_mrad"] > 0.5


def test_with_redundancy_the_noise_is_the_measured_one(sound: Path) -> None:
    data = read_heliostat(sound, "AA11")
    found = fit(data.mount, made_of(data), free="level-5")
    assert found.field.redundancy[0] > LEAST_REDUNDANCY
    assert not found.noise_assumed
    assert 0.15e-3 < found.noise_rad < 0.5e-3  # 0.3 mrad over 27 components: 14 % a sigma; stated is 1 mrad


def test_too_many_parameters_for_the_records_are_told(sound: Path, tmp_path: Path) -> None:
    write_paint(tmp_path, {"AA11": EAST}, n_record=8, sigma_rad=1e-3)
    (item,) = calibrate(tmp_path, parameters="level-location")
    assert any("do not carry" in note and "`parameters=auto`" in note for note in item.notes), item.notes
    assert len(PARAMETER_SETS["level-location"]) == 12


def test_least_noise_is_a_sensible_number() -> None:
    with pytest.raises(InvalidInputError, match="least_noise"):
        FitSettings(least_noise=-1.0)


def test_creep_is_flagged_and_steadiness_is_not(tmp_path: Path) -> None:
    # 0.05 mrad a month over 21 months, 60 records of 0.3 mrad a component: 1.05 mrad, six sigma of a slope
    places = {f"A{i}": (20.0 - 15.0 * i, 80.0, 1.5) for i in range(3)}
    flagged = {}
    for creep in (0.0, CREEP_RAD_PER_DAY):
        where = write_paint(tmp_path / f"{creep}", places, n_record=60, creep_rad_per_day=creep)
        made = {name: read_heliostat(where, name) for name in places}
        found = {name: fit_chosen(data.mount, made_of(data)) for name, data in made.items()}
        flagged[creep] = [a for name in places for a in _drifts(found[name])]
    assert flagged[0.0] == []
    assert len(flagged[CREEP_RAD_PER_DAY]) >= 2
    assert {alarm.axis for alarm in flagged[CREEP_RAD_PER_DAY]} == {1}


def _drifts(found: Any) -> list[Any]:
    from rfpose.feedback.alarms import alarms

    return [alarm for alarm in alarms(found) if alarm.kind == "drift"]


def _of_actuator(**change: Any) -> Any:
    return lambda p: p["kinematics_properties"]["actuators"][0].update(change)


PROPERTIES = "AA11/AA11_properties.json"
_ACTUATOR = "kinematics_properties.actuators[0]"
BAD: dict[str, tuple[Any, str]] = {
    "null": (_of_actuator(increment=None), f"{_ACTUATOR}.increment"),
    "text": (_of_actuator(offset="far"), f"{_ACTUATOR}.offset"),
    "zero": (_of_actuator(pivot_radius=0), f"{_ACTUATOR}.pivot_radius"),
    "missing": (lambda p: p["kinematics_properties"]["actuators"][0].pop("initial_angle"), "'initial_angle'"),
    "no kinematics": (lambda p: p.pop("kinematics_properties"), "'kinematics_properties'"),
    "ideal": (_of_actuator(type_axis="ideal"), f"{_ACTUATOR}.type_axis"),
    "shift": (_of_actuator(offset_shift=0.01), f"{_ACTUATOR}.offset_shift"),
    "facing": (lambda p: p.update(initial_orientation=[0.0, 0.0, 1.0]), "initial_orientation"),
    "joint": (
        lambda p: p["kinematics_properties"].update(joint_translation_u_2=0.3),
        "kinematics_properties.joint_translation_u_2",
    ),
}


def test_bad_heliostats_are_named_by_file_and_key_and_the_others_are_fitted(tmp_path: Path) -> None:
    names = {kind: f"B{i:02d}" for i, kind in enumerate(BAD)}
    write_paint(tmp_path, {"AB12": WEST} | dict.fromkeys(names.values(), EAST), n_record=4)
    for kind, name in names.items():
        edit(tmp_path / name / f"{name}_properties.json", BAD[kind][0])
    told = run("calibrate", tmp_path, "--json")
    assert told.exit_code == 0, told.stderr
    content = json.loads(told.stdout)
    assert [item["heliostat"] for item in content["heliostats"]] == ["AB12"]
    for kind, name in names.items():
        assert f"{name}_properties.json" in content["skipped"][name], kind
        assert BAD[kind][1] in content["skipped"][name], kind
        assert f"heliostat {name} left out" in told.stderr
        with pytest.raises(RecordingError):
            read_heliostat(tmp_path, name)
    alone = run("calibrate", tmp_path, "--heliostat", "B00")
    assert alone.exit_code == 3
    assert BAD["null"][1] in alone.stderr


def test_a_single_record_turns_the_zeros(tmp_path: Path) -> None:
    write_paint(tmp_path, {"AA11": EAST}, n_record=1)
    (report,) = calibrate(tmp_path)
    assert report.calibration.choice is not None
    assert report.calibration.choice.chosen == "offsets"
    assert "too few measurements" in report.calibration.choice.reason
    assert report.calibration.noise_assumed


def test_a_mount_far_from_its_plan_is_fitted_with_a_warning(folder: Path) -> None:
    edit(folder / PROPERTIES, lambda p: p["kinematics_properties"]["actuators"][1].update(initial_angle=1.3))
    reports = {report.id: report for report in calibrate(folder)}
    assert set(reports) == {"AA11", "AB12"}
    assert any("check its nominal values" in note for note in reports["AA11"].notes)
    assert reports["AB12"].notes == () or all("nominal" not in note for note in reports["AB12"].notes)


def test_stac_items_give_the_times(folder: Path) -> None:
    table = json.loads((folder / "timestamps.json").read_text())
    stated = read_heliostat(folder, "AA11").unix_s
    (folder / "timestamps.json").unlink()
    for name, time in table.items():
        heliostat, number = name.split("_")
        item = folder / heliostat / "calibration" / f"{number}-calibration-item-stac.json"
        write_json(item, {"properties": {"datetime": time}})
    np.testing.assert_array_equal(read_heliostat(folder, "AA11").unix_s, stated)
    item = sorted((folder / "AA11" / "calibration").glob("*stac*"))[2]
    write_json(item, {"properties": {"datetime": "2023-01-01 noon"}})
    data = read_heliostat(folder, "AA11")
    assert np.isnan(data.unix_s).tolist() == [False, False, True, False, False, False]
    assert item.name in data.notes[0]
    assert np.all(np.diff(data.order_s) > 0.0)


def test_a_record_with_one_algorithm_is_used_where_that_is_asked_for(folder: Path) -> None:
    path = sorted((folder / "AA11" / "calibration").iterdir())[0]
    edit(path, lambda record: record["focal_spot"].pop("UTIS"))
    used = {
        how: len(read_heliostat(folder, "AA11", algorithm=how).record_ids) for how in ("both", "any", "HeliOS", "UTIS")
    }
    assert used == {"both": 5, "any": 6, "HeliOS": 6, "UTIS": 5}
    with pytest.raises(InvalidInputError, match="no algorithm"):
        read_heliostat(folder, "AA11", algorithm="hough")
    told = run("calibrate", folder, "--heliostat", "AA11", "--algorithm", "any", "--json")
    assert json.loads(told.stdout)["heliostats"][0]["records"] == 6


def test_targets_lie_in_the_plane_of_their_corners(folder: Path) -> None:
    content = tower()
    turned = 5.5e-3  # as PAINT's normal_vector is off
    for name, place in (("upper_left", (4.0, 3.5)), ("lower_left", (4.0, -3.5)), ("upper_right", (-4.0, 3.5)),
                        ("lower_right", (-4.0, -3.5))):  # fmt: skip
        east, up = place
        content[TARGET]["coordinates"][name] = wgs84([east, turned * east, 36.0 + up])
    write_json(folder / "tower" / "tower_measurements.json", content)
    normal = read_heliostat(folder, "AA11").targets[TARGET].normal_enu
    np.testing.assert_allclose(normal, [-turned, 1.0, 0.0], atol=1e-4)


def test_elevations_are_taken_as_they_stand(folder: Path) -> None:
    path = sorted((folder / "AA11" / "calibration").iterdir())[0]
    edit(path, lambda record: record.update(sun_elevation=10.0, sun_azimuth=-20.0))
    data = read_heliostat(folder, "AA11")
    assert np.degrees(data.sun_elevation_rad[0]) == pytest.approx(10.0, abs=1e-12)  # refraction is in it already
    assert np.degrees(data.sun_azimuth_rad[0]) == pytest.approx(200.0, abs=1e-12)


def test_an_azimuth_that_runs_otherwise_is_told_in_papers_terms(folder: Path) -> None:
    for path in (folder / "AA11" / "calibration").iterdir():
        edit(path, lambda record: record.update(sun_azimuth=180.0 - record["sun_azimuth"]))
    with pytest.raises(RecordingError, match="from north, clockwise; PAINT's is 180° minus that"):
        calibrate(folder, heliostats=("AA11",))
    assert [report.id for report in calibrate(folder)] == ["AB12"]


MOUNT = {"format": "rfpose-mount", "version": 1, "heliostat": {"A": {"pivot_enu_m": [0.0, 80.0, 3.0]}}}
HEADER = [
    "heliostat",
    "axis_1",
    "axis_2",
    *(f"{what}_{a}_m" for what in ("drone", "target") for a in ("east", "north", "up")),
]


def flight(separator: str = ",", decimal: str = ".") -> str:
    rows = [["A", f"{0.1 * i}", f"{0.3 + 0.05 * i}", f"{5.0 * i}", "20.5", "60.0", "0.0", "0.0", "20.0"]
            for i in range(6)]  # fmt: skip
    return "\n".join(separator.join(cell.replace(".", decimal) for cell in row) for row in [HEADER, *rows]) + "\n"


def test_a_byte_order_mark_is_no_part_of_a_column(tmp_path: Path) -> None:
    write_json(tmp_path / "m.json", MOUNT)
    (tmp_path / "f.csv").write_bytes(codecs.BOM_UTF8 + flight().encode())
    told = run("calibrate", "--mount", tmp_path / "m.json", "--drone", tmp_path / "f.csv", "--json")
    assert told.exit_code == 0, told.stderr
    assert json.loads(told.stdout)["heliostats"][0]["sources"] == {"drone": 6}


def test_other_separators_and_decimals_are_told(tmp_path: Path) -> None:
    write_json(tmp_path / "m.json", MOUNT)
    (tmp_path / "f.csv").write_text(flight(";", ","))
    told = run("calibrate", "--mount", tmp_path / "m.json", "--drone", tmp_path / "f.csv")
    assert told.exit_code == 3
    assert "f.csv: its columns have semicolons between" in told.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--target", 0, 0, 1e9], "within 100 km"),
        (["--target", 0, 0, "nan"], "target"),
        (["--dish", "--hours", -1], "--hours"),
        (["--dish", "--hours", 1e9], "--hours"),
        (["--dish", "--step", 0], "--step"),
        (["--dish", "--step", 1e-9], "longer --step"),
        (["--dish", "--next", 10**6], "postures"),
        (["--dish", "--site", 95, 0, 0], "latitude"),
        (["--dish", "--site", -23, -69, -500000], "altitude"),
    ],
)
def test_what_aim_cannot_do_is_refused(tmp_path: Path, options: list[object], message: str) -> None:
    write_json(tmp_path / "m.json", MOUNT)
    site = [] if "--site" in options else ["--site", -23, -69, 0]
    told = run("aim", tmp_path / "m.json", "--start", "2026-06-21T08:00Z", *site, *options)
    assert told.exit_code == 3, told.output
    assert message in " ".join(told.stderr.split())
    assert "rad" not in told.stderr.replace("degrees", "")


def test_the_end_of_the_calendar_is_no_bug(tmp_path: Path) -> None:
    write_json(tmp_path / "m.json", MOUNT)
    told = run(
        "aim", tmp_path / "m.json", "--dish", "--start", "9999-12-31T23:00Z", "--hours", 3, "--site", -23, -69, 0
    )
    assert told.exit_code == 3
    assert told.stderr.startswith("rfpose: ")
