"""`rfpose layout`: the commands, their JSON, and what they refuse."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.cli._support import Session
from rfpose.cli.layout import command
from rfpose.errors import GeometryError, ScenarioError
from rfpose.layout.maps import ESTIMATORS
from rfpose.pipeline.layout import map_layout, optimise_layout
from rfpose.scenario import load_scenario

SITE = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"


def run(*arguments):
    result = CliRunner().invoke(command, [str(a) for a in arguments], obj=Session())
    assert result.exit_code == 0, result.output
    return result.stdout


def test_map_writes_json_csv_and_picture(tmp_path):
    table, picture = tmp_path / "map.csv", tmp_path / "map.png"
    found = json.loads(
        run("map", SITE, "--json", "--csv", table, "--picture", picture, "--sun", 120, 30, "--sun", 180, 60)
    )
    assert found["heliostats"] == 12
    assert found["postures"] == 2
    assert set(found["normal_mrad"]) == set(ESTIMATORS)
    assert found["normal_mrad"]["shared-clock"]["rms"] < found["normal_mrad"]["rigid"]["rms"]
    lost = found["normal_without_transmitter_mrad"]["rigid"]
    assert min(lost.values()) > found["normal_mrad"]["rigid"]["rms"]
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["id"] for row in rows] == list(load_scenario(SITE).heliostat_ids)
    rms = np.sqrt(np.mean([float(row["normal_rigid_rms_mrad"]) ** 2 for row in rows]))
    assert rms == pytest.approx(found["normal_mrad"]["rigid"]["rms"], rel=1e-4)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_map_of_a_field_from_csv(tmp_path):
    field = tmp_path / "field.csv"
    field.write_text("east_m,north_m,up_m\n20,0,2\n0,25,2\n")
    found = json.loads(run("map", SITE, "--field", field, "--json", "--estimator", "rigid"))
    assert found["heliostats"] == 2
    own = map_layout(SITE, estimators=["rigid"])
    expected = np.sqrt(np.mean(own.rms_mrad["rigid"][:2] ** 2))
    assert found["normal_mrad"]["rigid"]["rms"] == pytest.approx(expected)


def test_optimise_writes_a_scenario(tmp_path):
    better = tmp_path / "better.toml"
    found = json.loads(
        run("optimise", SITE, "-o", better, "--json", "--starts", 2, "--minimise", "rigid", "--keep", 1, "-n", 11)
    )
    assert found["value"] < found["before"]
    scenario = load_scenario(better)
    assert len(scenario.transmitter) == 11
    assert scenario.transmitter[0].position_enu_m == load_scenario(SITE).transmitter[0].position_enu_m
    measured = map_layout(better, estimators=["rigid"]).as_dict()["pdop"]["rms"]
    assert measured == pytest.approx(found["pdop_rms"], rel=1e-9)


def test_a_person_gets_tables():
    assert "PDOP" in run("map", SITE, "--estimator", "rigid")


def broken(tmp_path, old, new):
    text = SITE.read_text()
    assert old in text
    path = tmp_path / "site.toml"
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frequency_hz = 750e3", "frequency_hz = 1.9e6", "wider than the longest tone"),
        ("pivot_enu_m = [0.0, 25.0, 2.0]", "pivot_enu_m = [20.0, 0.0, 2.0]", "`H01` and `H02` stand at the same place"),
        ("pivot_enu_m = [0.0, 25.0, 2.0]", "pivot_enu_m = [0.0, 0.0, 50.0]", "`H02` and transmitter `T10`"),
    ],
)
def test_bad_sites_are_refused(tmp_path, old, new, message):
    path = broken(tmp_path, old, new)
    with pytest.raises(ScenarioError, match=message) as caught:
        map_layout(path)
    assert str(path) in str(caught.value)


def test_level_transmitters_are_refused(tmp_path):
    text = SITE.read_text()
    for height in ("20.0", "30.0", "40.0", "50.0"):
        text = text.replace(f", {height}]\ncarrier", ", 25.0]\ncarrier")
    path = tmp_path / "level.toml"
    path.write_text(text)
    with pytest.raises(ScenarioError, match=r"one plane.*0\.000, 0\.000, 1\.000.*different heights"):
        map_layout(path)


def test_constraints_that_cannot_be_met_are_refused():
    with pytest.raises((ScenarioError, GeometryError), match="no room"):
        optimise_layout(SITE, separation_m=150.0, starts=1)
