"""``rfpose calibrate`` as it is called."""

import json
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

from rfpose.cli.calibrate import command
from rfpose.errors import InvalidInputError, RecordingError

PAINT = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "paint"
needs_paint = pytest.mark.skipif(not PAINT.is_dir(), reason=f"the PAINT records are not at {PAINT}")


@needs_paint
def test_json_holds_what_the_table_shows():
    run = CliRunner().invoke(command, [str(PAINT), "--heliostat", "BF57", "--parameters", "level-8", "--json"])
    assert run.exit_code == 0, run.output
    (item,) = json.loads(run.stdout)["heliostats"]
    assert item["heliostat"] == "BF57"
    assert item["used"] == 145
    assert item["rank"] == 7
    assert item["undetermined"] == [["pedestal_tilt_north_rad", "axis_1_zero_rad"]]
    assert item["parameters"]["axis_1_zero_rad"] == {"estimate": None, "sigma": None}
    assert item["held_out_median_mrad"] < 0.65


@needs_paint
def test_table_names_alarms_and_files(tmp_path):
    model = tmp_path / "models.toml"
    run = CliRunner().invoke(command, [str(PAINT), "--heliostat", "BE61", "-o", str(model)])
    assert run.exit_code == 0, run.output
    assert "axis 1 shifts by" in run.stdout
    assert "off by more than 5 mrad" in run.stdout
    written = tomllib.loads(model.read_text())
    assert written["format"] == "rfpose-mount"
    assert written["heliostat"]["BE61"]["actuators"][0]["kind"] == "linear"
    again = CliRunner().invoke(command, [str(PAINT), "--heliostat", "BE61", "-o", str(model)])
    assert isinstance(again.exception, RecordingError)
    assert "`force=True`" in str(again.exception)


@needs_paint
def test_names_of_parameters_instead_of_a_set():
    names = "axis_1_zero_rad,axis_2_zero_rad"
    run = CliRunner().invoke(command, [str(PAINT), "--heliostat", "BH36", "--parameters", names, "--json"])
    assert list(json.loads(run.stdout)["heliostats"][0]["parameters"]) == names.split(",")
    run = CliRunner().invoke(command, [str(PAINT), "--heliostat", "BH36", "--parameters", "everything"])
    assert isinstance(run.exception, InvalidInputError)


def test_a_missing_directory_is_named(tmp_path):
    run = CliRunner().invoke(command, [str(tmp_path / "nowhere")])
    assert isinstance(run.exception, RecordingError)
    assert "nowhere" in str(run.exception)
