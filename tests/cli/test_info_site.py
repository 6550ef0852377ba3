"""``rfpose info`` of a scenario draws its site."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner
from matplotlib.figure import Figure

from rfpose.cli._app import app
from rfpose.pipeline.pictures.site import plan_in_letters, site_plan
from rfpose.scenario import load_scenario

TABLE2 = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"


def test_letters_stand_where_things_do() -> None:
    site = load_scenario(TABLE2)
    lines = plan_in_letters(site, width=41)  # 5 m a letter from -100 to 100 m east, 10 m a line from 90 m north down
    assert "a letter is 5 m wide" in lines[-1]
    at = {(5 * column - 100, 90 - 10 * row): x for row, line in enumerate(lines[:-1]) for column, x in enumerate(line)}
    assert at[100, 0] == "T"
    assert at[10, 90] == "o"
    assert at[-30, 0] == "o"
    assert at[15, -20] == "C"
    assert at[0, 0] == "T"  # T10, and below it the aim point
    assert sum(x == "T" for x in at.values()) == 10
    assert plan_in_letters(site.changed(heliostat=site.heliostat[:1]), width=41)


def test_figure_shows_all_that_stands_there() -> None:
    box = {"id": "tower", "base_enu_m": (0.0, 200.0, 0.0), "size_m": (4.0, 2.0, 30.0)}
    plate = {"id": "N1", "pivot_enu_m": (24.0, 60.0, 2.0), "width_m": 2.0, "height_m": 2.0}
    site = load_scenario(TABLE2).changed(site={"structures": {"box": (box,), "plate": (plate,)}})
    figure = site_plan(site)
    assert isinstance(figure, Figure)
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert labels == {"box", "without receivers", "heliostat", "transmitter", "calibration receiver", "aim point"}
    names = {text.get_text() for text in figure.axes[0].texts}
    assert names == {*site.heliostat_ids, *site.transmitter_ids, "cal0"}


def test_command_draws(tmp_path: Path) -> None:
    shown = CliRunner().invoke(app, ["info", str(TABLE2)])
    assert "o heliostat" in shown.stdout
    drawn = CliRunner().invoke(app, ["info", str(TABLE2), "--picture", str(tmp_path / "site.svg")])
    assert drawn.exit_code == 0
    assert (tmp_path / "site.svg").read_text().startswith("<?xml")
    again = CliRunner().invoke(app, ["info", str(TABLE2), "--picture", str(tmp_path / "site.svg")])
    assert "exists already" in again.stderr


@pytest.mark.parametrize("name", ["antenna_front_433MHz.h5"])
def test_what_is_no_site_is_refused(tmp_path: Path, name: str) -> None:
    shown = CliRunner().invoke(app, ["info", str(TABLE2.parent / name), "--picture", str(tmp_path / "site.png")])
    assert shown.exit_code == 3
    assert "`--picture` draws a scenario's site" in shown.stderr
