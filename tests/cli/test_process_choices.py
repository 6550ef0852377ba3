"""Choices of the estimator of poses at the command line: what is kept, shown and refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, get_args

import pytest
from click.testing import CliRunner, Result

from rfpose.cli._app import app
from rfpose.cli.process import POSE_NAMES, REFLECTION_NAMES
from rfpose.pipeline.choice import POSES, REFLECTIONS
from rfpose.pipeline.demo import shipped_scenario
from rfpose.scenario import Reflection, load_scenario


def _run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def _json(*arguments: object) -> dict[str, Any]:
    shown = _run(*arguments, "--json")
    assert shown.exit_code == 0, shown.stderr
    assert "NaN" not in shown.stdout
    assert "Infinity" not in shown.stdout
    return json.loads(shown.stdout)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("choices")
    shipped = load_scenario(shipped_scenario("table2_100m.toml"))
    two = shipped.changed(heliostat=shipped.heliostat[:2], radio={"frame_samples": 8000})
    two.changed(
        heliostat={"pivot_sigma_m": 0.005, "receiver_delay_sigma_s": 0.0},
        simulation={"frame_count": 2, "sun_azimuth_deg": 170.0},
    ).save(where / "site.toml")
    _json("simulate", where / "site.toml", "-o", where / "rec.h5")
    return where / "rec.h5"


def test_names_at_the_command_line_are_those_inside() -> None:
    assert set(POSE_NAMES) == set(POSES)
    assert set(REFLECTION_NAMES) == set(REFLECTIONS)
    assert "estimate" in get_args(Reflection.model_fields["model"].annotation)


def test_the_scenario_gives_the_default(recording: Path, tmp_path: Path) -> None:
    shown = _json("process", recording, "-o", tmp_path / "r.h5")
    assert shown["choice"] == {
        "reflection": "none",
        "integrity": "on",
        "delays": "as the scenario says",
        "filter": "off",
    }
    assert shown["integrity"]["reasons"] == {}
    assert shown["integrity"]["protected"] == 4
    assert shown["integrity"]["protection_level_mrad"] > 0.0
    assert "reflection" not in shown
    evaluated = _json("evaluate", tmp_path / "r.h5")
    assert evaluated["protection"]["covered"] == 4
    assert evaluated["protection"]["exceeded_fraction"] == 0.0
    settings = _json("info", tmp_path / "r.h5")["settings"]
    assert (settings["reflection"], settings["integrity"]) == ("none", "on")
    assert "--reflection" not in settings["command"]


def test_options_win_and_are_kept(recording: Path, tmp_path: Path) -> None:
    shown = _json("process", recording, "-o", tmp_path / "r.h5", "--reflection", "estimate", "--no-integrity")
    assert shown["choice"]["reflection"] == "estimate"
    assert shown["choice"]["integrity"] == "off"
    assert "integrity" not in shown
    assert shown["reflection"]["coefficients"]["ground"]["status"] == "estimated"
    # nothing reflects here: the coefficient is zero within its sigma, and nothing asks for it
    ground = shown["reflection"]["coefficients"]["ground"]
    assert abs(complex(ground["real"], ground["imag"])) < 5.0 * ground["sigma"]
    assert shown["reflection"]["needed"] == 0
    info = _json("info", tmp_path / "r.h5")
    assert info["settings"]["command"].endswith("--reflection estimate --no-integrity")
    assert info["reflection"]["needed"] == 0
    assert _json("evaluate", tmp_path / "r.h5")["protection"] is None
    text = _run("process", recording, "-o", tmp_path / "t.h5", "--reflection", "estimate")
    assert "reflection of ground estimated: " in text.stdout
    assert "protection level, median: " in text.stdout


def test_poses_are_filtered_where_asked(recording: Path, tmp_path: Path) -> None:
    shown = _json("process", recording, "-o", tmp_path / "r.h5", "--filter")
    assert shown["choice"]["filter"] == "on"
    assert sum(shown["filtered"]["reasons"].values()) == 4
    info = _json("info", tmp_path / "r.h5")
    assert info["settings"]["command"].endswith("--filter")
    assert info["filtered"] == shown["filtered"]
    evaluated = _json("evaluate", tmp_path / "r.h5")["filtered"]
    assert (evaluated["given"], evaluated["predicted"]) == (4, 0)
    assert evaluated["nees"] > 0.0
    assert "filtered over frames: " in _run("evaluate", tmp_path / "r.h5").stdout
    assert _json("process", recording, "-o", tmp_path / "n.h5", "--no-filter")["choice"]["filter"] == "off"
    assert _json("evaluate", tmp_path / "n.h5")["filtered"] is None


def test_how_integers_were_found_is_in_the_result(recording: Path, tmp_path: Path) -> None:
    shown = _json("process", recording, "-o", tmp_path / "r.h5")["integers"]
    assert all(sum(counts.values()) == 4 for counts in shown.values())
    assert next(iter(shown.values())) == {"resolved beforehand": 4}


def test_independent_receivers_have_no_such_choice(recording: Path, tmp_path: Path) -> None:
    refused = _run("process", recording, "-o", tmp_path / "r.h5", "--pose", "independent", "--reflection", "estimate")
    assert refused.exit_code in (2, 3)
    assert "`--reflection` is of pose `rigid`" in refused.stderr
    plain = _json("process", recording, "-o", tmp_path / "p.h5", "--pose", "independent")
    assert plain["choice"] == {
        "reflection": "none",
        "integrity": "off",
        "delays": "as the scenario says",
        "filter": "off",
    }
