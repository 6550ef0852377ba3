"""Heliostats from a table: which columns are known, and where heights come from."""

import logging
from pathlib import Path

import numpy as np
import pytest

from rfpose.errors import ScenarioError
from rfpose.pipeline.samples.paint import ORIGIN, write_paint
from rfpose.scenario import load_scenario, parse_scenario, read_positions

TABLE2 = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"


def site_with(folder: Path, table: str, *, scenario: str = "", ours: str = ""):
    """Table 2's site without its heliostats, with the ones of a table."""
    (folder / "positions.csv").write_text(table)
    text = TABLE2.read_text()
    begin, end = text.index("[[heliostat]]"), text.index("[simulation]")
    path = folder / "site.toml"
    heading = f'[heliostats]\ncsv = "positions.csv"\n{scenario}\n{ours}\n'
    path.write_text(text[:begin] + heading + text[end:])
    return load_scenario(path)


@pytest.mark.parametrize(
    ("table", "scenario", "up_m"),
    [
        ("id,east_m,north_m,up_m\nA,30.48,0,2.5\nB,0,60.96,3\n", "", [2.5, 3.0]),
        ("ID,Pos-x,Pos-y,Pos-z\nA,30.48,0,0\nB,0,60.96,0\n", "pivot_height_m = 2", [2.0, 2.0]),
        ("ID,Pos-x,Pos-y,Pos-z\n,m,m,m\nA,30.48,0,1\nB,0,60.96,0\n", "pivot_height_m = 2", [3.0, 2.0]),
        ("Name,Pos-x [ft],Pos-y [ft]\nA,100,0\nB,0,200\n", "pivot_height_m = 2", [2.0, 2.0]),
        (
            "No,X,Y,Z\nA,100,0,10\nB,0,200,10\n",
            'unit = "ft"\ncolumns = {id = "No", east = "X", north = "Y", up = "Z"}',
            [3.048, 3.048],
        ),
        ("id,east_m,north_m\nA,30.48,0\nB,0,60.96\n", "pivot_height_m = 0", [0.0, 0.0]),
    ],
    ids=["ours", "SolarPILOT", "line of units", "feet", "by name", "zero where it is said"],
)
def test_columns_units_and_heights(tmp_path, table, scenario, up_m):
    site = site_with(tmp_path, table, scenario=scenario)
    assert site.heliostat_ids == ("A", "B")
    np.testing.assert_allclose(site.pivot_enu_m, [[30.48, 0.0, up_m[0]], [0.0, 60.96, up_m[1]]])
    assert site.receiver_ids[:2] == ("A_r0", "A_r1")
    assert parse_scenario(site.to_toml()) == site  # what goes into a recording needs no table


@pytest.mark.parametrize(
    ("table", "scenario", "says"),
    [
        ("id,east_m,north_m\nA,1,2\n", "", "no column of heights; add `up_m`, or give `pivot_height_m`"),
        ("id,Pos-x,Pos-y,Pos-z\nA,1,2,0\n", "", "all heights in `Pos-z` are zero; give `pivot_height_m`"),
        ("id,x,y\nA,1,2\n", "pivot_height_m = 2", r"`east_m` is missing; the header has id, x, y.*heliostats.columns"),
        ("id,x,y\nA,1,2\n", 'columns = {east = "X"}', "no column `X`, which `columns.east` names"),
        ("No 1,east_m,north_m,up_m\n", 'columns = {id = "No 1"}', "no heliostats below it"),
        ("id,east_m,north_m,up_m\nrow 1,1,2,3\n", "", "line 2: heliostat 'row 1' cannot be called so"),
        ("id,east,north,up_m\nA,1,2,3\n", "", "`east` says no unit"),
        ("id,east_m,north_m,up_m\nA,1,2,3\n", 'paint = "."', "exactly one of `csv`"),
        ("id,east_m,north_m,up_m\nA,1,2,3\n", 'hight = "."', "unknown key `heliostats.hight`"),
    ],
)
def test_what_is_not_told_is_never_guessed(tmp_path, table, scenario, says):
    with pytest.raises(ScenarioError, match=says):
        site_with(tmp_path, table, scenario=scenario)


def test_what_the_scenario_says_of_one_goes_before_the_table(tmp_path):
    ours = '[[heliostat]]\nid = "B"\nnormal_enu = [0, 0, 1]\n[[heliostat]]\nid = "C"\npivot_enu_m = [5, 5, 5]\n'
    site = site_with(tmp_path, "id,east_m,north_m,up_m\nA,1,2,3\nB,9,9,3\n", ours=ours)
    assert site.heliostat_ids == ("A", "B", "C")
    assert [h.normal_enu for h in site.heliostat] == [None, (0.0, 0.0, 1.0), None]
    assert site.heliostat[1].pivot_enu_m == (9.0, 9.0, 3.0)


def test_a_plant_of_paint_is_known(tmp_path):
    places = {"AB12": (10.0, 120.0, 1.5), "AC34": (-30.0, 140.0, 1.7)}
    write_paint(tmp_path / "plant", places, n_record=1)
    text = TABLE2.read_text()
    begin, end = text.index("[[heliostat]]"), text.index("[simulation]")
    (tmp_path / "site.toml").write_text(text[:begin] + '[heliostats]\npaint = "plant"\n' + text[end:])
    site = load_scenario(tmp_path / "site.toml")
    assert site.heliostat_ids == tuple(places)
    np.testing.assert_allclose(site.pivot_enu_m, list(places.values()), atol=1e-3)
    assert ORIGIN[0] == 50.9
    (tmp_path / "plant" / "AB12" / "AB12_properties.json").write_text("{}")
    with pytest.raises(ScenarioError, match=r"AB12_properties\.json: has no 'heliostat_position'"):
        load_scenario(tmp_path / "site.toml")


def test_a_field_without_heights_is_said_to_lie_at_zero(tmp_path, caplog):
    (tmp_path / "field.csv").write_text("id,east_m,north_m\nA,1,2\n")
    with caplog.at_level(logging.WARNING):
        assert read_positions(tmp_path / "field.csv")[1][0, 2] == 0.0
    assert "height zero" in caplog.text
