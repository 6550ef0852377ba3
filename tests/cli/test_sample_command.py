"""``rfpose sample`` and ``rfpose data``: files for every command, made up and marked as such."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.cli.sample import KIND_NAMES
from rfpose.feedback.camera.spot import read_picture
from rfpose.pipeline.calibrate import calibrate
from rfpose.pipeline.samples import ERRORS, KINDS

DATA = Path(__file__).resolve().parents[2] / "data"


def run(*words: object):
    return CliRunner().invoke(app, [*map(str, words)])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("samples")
    for kind in KIND_NAMES:
        done = run("sample", kind, folder / kind, "--json")
        assert done.exit_code == 0, done.stderr
        told = json.loads(done.stdout)
        assert told["synthetic"]
        assert sorted(told["files"]) == sorted(
            str(p.relative_to(folder / kind)) for p in (folder / kind).rglob("*") if p.is_file()
        )
    return folder


def test_names_are_those_of_the_library() -> None:
    assert KIND_NAMES == KINDS


def test_every_directory_says_that_nothing_was_measured(made: Path) -> None:
    for kind in KIND_NAMES:
        assert "Nothing here was measured" in (made / kind / "SYNTHETIC.txt").read_text()
    tower = json.loads((made / "paint" / "tower" / "tower_measurements.json").read_text())
    assert tower["power_plant_properties"]["ID"] == "synthetic"


@pytest.mark.parametrize(
    "sources",
    [
        {"drone": "drone/flight.csv"},
        {"camera": "camera/pictures"},
        {"radio": ["motors/night.h5"], "motors": "motors/motors.csv", "drone": "drone/flight.csv"},
    ],
    ids=["drone", "camera", "radio with a drone"],
)
def test_a_calibration_finds_what_was_made_wrong(made: Path, sources: dict) -> None:
    if "camera" in sources:
        pytest.importorskip("skimage", reason="pictures need scikit-image")
    paths = {k: [made / x for x in v] if isinstance(v, list) else made / v for k, v in sources.items()}
    (report,) = calibrate(mounts=made / "drone" / "planned.toml", parameters="edwards-4", **paths)
    found = report.as_dict()["parameters"]
    for name, value in ERRORS.items():
        assert abs(found[name]["estimate"] - value) < 5.0 * found[name]["sigma"] + 5e-5, name


def test_records_in_paints_layout_are_all_used(made: Path) -> None:
    reports = calibrate(made / "paint", parameters="level-7")
    assert [report.id for report in reports] == ["AA31", "AB42"]
    assert not any(report.as_dict()["skipped"] for report in reports)


def test_pictures_are_grey_eight_bits(made: Path) -> None:
    pytest.importorskip("skimage", reason="pictures need scikit-image")
    assert read_picture(made / "camera" / "pictures" / "0.png").ndim == 2


def test_only_what_was_made_up_is_replaced(made: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "night.h5").write_text("three months of measurements")
    done = run("sample", "drone", tmp_path / "mine", "--force")
    assert done.exit_code == 3
    assert "files of others" in done.stderr
    assert (tmp_path / "mine" / "night.h5").exists()
    before = (made / "drone" / "flight.csv").read_bytes()
    assert run("sample", "drone", made / "drone").exit_code == 3
    assert run("sample", "drone", made / "drone", "--force").exit_code == 0
    assert (made / "drone" / "flight.csv").read_bytes() == before


def test_data_prints_where_files_lie() -> None:
    told = json.loads(run("data", "--json").stdout)["files"]
    assert set(told) == {p.name for p in DATA.iterdir()}
    assert run("data", "table2.toml").stdout == f"{DATA / 'table2.toml'}\n"
    unknown = run("data", "table3.toml")
    assert unknown.exit_code == 3
    assert "known are antenna_front_433MHz.h5" in unknown.stderr
