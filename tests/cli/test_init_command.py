"""``rfpose init``: what it writes is a site that can be measured, from what it was told."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.cli.init import KIND_NAMES, UNITS
from rfpose.pipeline.choice import POSES
from rfpose.pipeline.samples.paint import ORIGIN, write_paint
from rfpose.pipeline.solvable import check_solvable
from rfpose.pipeline.starter import KINDS
from rfpose.scenario import PositionForm, load_scenario
from rfpose.scenario.schema import scenario_schema
from rfpose.simulator import Simulator
from sites import TABLE_2

DATA = Path(__file__).resolve().parents[2] / "data"


def run(*words: object):
    return CliRunner().invoke(app, ["init", *map(str, words)])


def test_names_are_those_of_the_library() -> None:
    assert KIND_NAMES == KINDS
    choices, _ = get_args(PositionForm.model_fields["unit"].annotation)
    assert get_args(choices) == UNITS


@pytest.mark.parametrize("kind", KIND_NAMES)
def test_each_kind_can_be_simulated_and_solved(tmp_path: Path, kind: str) -> None:
    done = run(tmp_path / "site.toml", "--kind", kind)
    assert done.exit_code == 0, done.output
    site = load_scenario(tmp_path / "site.toml")
    check_solvable(site, pose=POSES[0])
    normal = Simulator(site, seed=0).truth.normal_enu
    if kind == "dishes":
        np.testing.assert_allclose(normal, np.repeat(site.simulated_suns_enu[:, None], 4, axis=1))
    else:
        assert np.all(normal[..., 2] > 0.0)
    if kind == "paper":
        shipped = load_scenario(DATA / "table2_100m.toml")
        np.testing.assert_allclose(site.pivot_enu_m, shipped.pivot_enu_m)
        np.testing.assert_allclose(site.transmitter_enu_m[:, :2], 100.0 * TABLE_2[:, :2], atol=0.1)


def test_a_table_becomes_a_site_about_it(tmp_path: Path) -> None:
    (tmp_path / "positions.csv").write_text("No,X,Y\nA,3000,1000\nB,3300,1000\nC,3150,1400\n")
    words = ["--from", tmp_path / "positions.csv", "--columns", "id=No,east=X,north=Y", "--unit", "ft"]
    refused = run(tmp_path / "site.toml", *words)
    assert refused.exit_code == 3
    assert "give `pivot_height_m`" in refused.stderr
    assert not (tmp_path / "site.toml").exists()
    words += ["--pivot-height-m", 2.5, "--place", 50.9, 6.4, "--aim", 900, 200, 60]
    done = run(tmp_path / "site.toml", *words, "--json")
    assert json.loads(done.stdout)["heliostats"] == 3
    text = (tmp_path / "site.toml").read_text()
    assert 'csv = "positions.csv"' in text
    assert "<- yours" not in text
    site = load_scenario(tmp_path / "site.toml")
    np.testing.assert_allclose(site.pivot_enu_m[0], [914.4, 304.8, 2.5])
    assert site.site.aim_enu_m == (900.0, 200.0, 60.0)
    spread = np.linalg.norm(site.transmitter_enu_m[:, :2] - site.pivot_enu_m[:, :2].mean(axis=0), axis=1)
    assert spread.max() < 150.0


def test_a_plant_of_paint_brings_its_place(tmp_path: Path) -> None:
    write_paint(tmp_path / "plant", {"AB12": (10.0, 120.0, 1.5), "AC34": (-30.0, 140.0, 1.7)}, n_record=1)
    assert run(tmp_path / "site.toml", "--from", tmp_path / "plant").exit_code == 0
    site = load_scenario(tmp_path / "site.toml")
    assert (site.site.latitude_deg, site.site.longitude_deg, site.site.height_m) == pytest.approx(ORIGIN, abs=1e-3)


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["--kind", "tower", "--from", "x.csv"], 2, "give one"),
        (["--unit", "ft"], 2, "table of --from"),
        (["--from", "absent.csv"], 3, "cannot be read"),
        (["--from", "absent.csv", "--columns", "id:No"], 3, "must be such as id=No"),
        (["--from", "absent.csv", "--columns", "hight=Z"], 3, "unknown key `columns.hight`"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, words: list[str], code: int, says: str) -> None:
    done = run(tmp_path / "site.toml", *words)
    assert done.exit_code == code
    assert says in done.stderr
    assert not (tmp_path / "site.toml").exists()


def test_the_schema_takes_what_the_reader_takes(tmp_path: Path) -> None:
    validator = pytest.importorskip("jsonschema").Draft202012Validator(scenario_schema())
    assert run(tmp_path / "site.toml", "--schema", tmp_path / "s.json").exit_code == 0
    assert (tmp_path / "site.toml").read_text().startswith("#:schema s.json\n")
    for path in (tmp_path / "site.toml", *DATA.glob("*.toml")):
        told = json.loads(json.dumps(tomllib.loads(path.read_text()), default=str))
        assert [error.message for error in validator.iter_errors(told)] == [], path
    told["radio"]["frame_sample"] = 3
    assert any("frame_sample" in error.message for error in validator.iter_errors(told))
