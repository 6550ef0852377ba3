"""The commands on a small field: what they print, what they leave, what they refuse."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from click.testing import CliRunner, Result

from rfpose.cli._app import app
from rfpose.cli.convert import COMPRESSION_NAMES, FORMAT_NAMES
from rfpose.cli.demo import write_report
from rfpose.drawing import save_figure
from rfpose.pipeline.demo import run_demo, shipped_scenario
from rfpose.pipeline.evaluate import evaluate
from rfpose.pipeline.formats.result_file import open_result
from rfpose.recording import open_recording
from rfpose.recording.base import WrittenFormat
from rfpose.recording.writer import COMPRESSIONS
from rfpose.scenario import load_scenario
from told import undocumented, unseen

PNG = b"\x89PNG\r\n\x1a\n"


def _run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def _json(*arguments: object) -> dict[str, Any]:
    shown = _run(*arguments, "--json")
    assert shown.exit_code == 0, shown.stderr
    assert "NaN" not in shown.stdout
    return json.loads(shown.stdout)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with a site, its recording and the result, made by the commands."""
    where = tmp_path_factory.mktemp("field")
    shipped = load_scenario(shipped_scenario("table2_100m.toml"))
    blocked = [{"transmitter": f"T{i}", "receivers": ["H02"], "first_frame": 1} for i in range(1, 7)]
    shipped.changed(
        heliostat=shipped.heliostat[:2],
        radio={"frame_samples": 8000},
        simulation={"frame_count": 2, "sun_azimuth_deg": 170.0, "blocked": blocked},
    ).save(where / "site.toml")
    summary = _json("simulate", where / "site.toml", "-o", where / "rec.h5", "--seed", 4)
    assert summary["frames"] == 2
    assert summary["bytes"] == (where / "rec.h5").stat().st_size
    processed = _json("process", where / "rec.h5", "-o", where / "result.h5", "--csv", where / "poses.csv")
    assert processed["poses"]["solved"] == 3
    return where


def test_process_writes_csv(directory: Path) -> None:
    rows = list(csv.DictReader((directory / "poses.csv").read_text().splitlines()))
    assert [row["status"] == "solved" for row in rows] == [True, True, True, False]


def test_process_prints_counts_and_reasons(directory: Path, tmp_path: Path) -> None:
    shown = _run("process", directory / "rec.h5", "-o", tmp_path / "r.h5", "--estimator", "correlator")
    assert shown.exit_code == 0
    assert "mirror poses" in shown.stdout
    assert "1 poses: fewer than three receivers of the mirror were located" in shown.stdout
    assert "18 transmitters: carrier not found above the noise" in shown.stdout
    # that kernels are compiled, and how far it is, where that takes its time
    assert [
        line for line in shown.stderr.splitlines() if not re.match("rfpose: (note: compiling|Measuring)", line)
    ] == []


def test_evaluate(directory: Path) -> None:
    found = _json("evaluate", directory / "result.h5")
    assert (found["solved"], found["failed"]) == (3, 1)
    assert found["normal_error_mrad"]["rms"] > 0
    # three angles of two components: six degrees of freedom
    assert 0.2 < found["ratio_to_bound"] < 2.2
    shown = _run("evaluate", directory / "result.h5")
    for text in ("mirror normal [mrad]", "receiver position [mm]", "rms over bound", "3 solved, 1 failed", "H02"):
        assert text in shown.stdout


@pytest.mark.parametrize(
    ("name", "kind"), [("site.toml", "scenario"), ("rec.h5", "recording"), ("result.h5", "result")]
)
def test_info(directory: Path, name: str, kind: str) -> None:
    found = _json("info", directory / name)
    assert found["kind"] == kind
    assert isinstance(found["sound"], bool)
    shown = _run("info", directory / name)
    assert shown.exit_code == 0
    assert shown.stdout.startswith(f"kind: {kind}\n")


def test_info_on_a_site_that_cannot_be_solved(directory: Path, tmp_path: Path) -> None:
    load_scenario(directory / "site.toml").changed(tone={"frequency_hz": 1.5e6}).save(tmp_path / "site.toml")
    found = _json("info", tmp_path / "site.toml")
    assert not found["sound"]
    assert "ambiguous" in found["problems"][0]


def test_convert_there_and_back(directory: Path, tmp_path: Path) -> None:
    pytest.importorskip("digital_rf", reason="the digital_rf library is not installed")
    _json("convert", directory / "rec.h5", "-o", tmp_path / "drf", "--to", "digital-rf")
    _json("process", tmp_path / "drf", "-o", tmp_path / "r.h5")
    there, here = open_result(tmp_path / "r.h5"), open_result(directory / "result.h5")
    np.testing.assert_array_equal(there.poses.normal_enu, here.poses.normal_enu)
    assert there.truth is None
    shown = _run("evaluate", tmp_path / "r.h5")
    assert shown.exit_code == 3
    assert shown.stderr.startswith(f"rfpose: {tmp_path / 'r.h5'}: carries no truth; give --truth")
    assert _json("evaluate", tmp_path / "r.h5", "--truth", directory / "rec.h5")["solved"] == 3


def test_format_names_are_those_of_recording() -> None:
    assert set(FORMAT_NAMES) == set(get_args(WrittenFormat))
    assert COMPRESSION_NAMES == COMPRESSIONS


@pytest.mark.parametrize(
    ("command", "output"),
    [
        (("simulate", "site.toml", "-o"), "rec.h5"),
        (("process", "rec.h5", "-o"), "result.h5"),
        (("process", "rec.h5", "-o", "new.h5", "--csv"), "poses.csv"),
        (("convert", "rec.h5", "-o"), "result.h5"),
    ],
)
def test_existing_output_is_refused(directory: Path, command: tuple[str, ...], output: str) -> None:
    before = (directory / output).read_bytes()
    words = [str(directory / word) if "." in word else word for word in command]
    shown = _run(*words, directory / output)
    assert shown.exit_code == 3
    assert f"{output}: exists already" in shown.stderr
    assert "--force" in shown.stderr
    assert (directory / output).read_bytes() == before
    assert not (directory / "new.h5").exists()


def test_differing_scenario_is_said_on_standard_error(directory: Path, tmp_path: Path) -> None:
    load_scenario(directory / "site.toml").changed(name="another").save(tmp_path / "site.toml")
    arguments = ("process", directory / "rec.h5", "-o", tmp_path / "r.h5", "--scenario", tmp_path / "site.toml")
    shown = _run(*arguments, "--json")
    assert json.loads(shown.stdout)["poses"]["solved"] == 3
    assert shown.stderr.startswith("rfpose: note: ")
    assert "the given one is used" in shown.stderr


@pytest.mark.parametrize("spoil", [lambda b: b[: len(b) // 2], lambda _b: b"a letter"])
def test_broken_result_is_exit_3(directory: Path, tmp_path: Path, spoil: Any) -> None:
    (tmp_path / "r.h5").write_bytes(spoil((directory / "result.h5").read_bytes()))
    for command in ("evaluate", "info"):
        shown = _run(command, tmp_path / "r.h5")
        assert shown.exit_code == 3
        assert shown.stderr.count("\n") == 1
        assert str(tmp_path / "r.h5") in shown.stderr


def test_a_fault_of_our_own_is_exit_1_in_one_line(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fault(_path: Path, **_settings: object) -> None:
        raise ZeroDivisionError("no such\nluck")

    monkeypatch.setattr("rfpose.pipeline.inspect.inspect_file", fault)
    shown = _run("info", directory / "rec.h5")
    assert shown.exit_code == 1
    assert shown.stderr.startswith("rfpose: unexpected ZeroDivisionError: no such luck;")
    assert shown.stderr.count("\n") == 1


# -- pictures and demo ---------------------------------------------------------------------------------------


def test_pictures(directory: Path, tmp_path: Path) -> None:
    result = open_result(directory / "result.h5")
    save_figure(result.plot(evaluation=evaluate(result)), tmp_path / "map.png")
    save_figure(result.plot(), tmp_path / "map.svg")
    with open_recording(directory / "rec.h5") as recording:
        spectrum = recording.plot(receiver_id="cal0")
    save_figure(spectrum, tmp_path / "spectrum.png")
    with pytest.raises(ValueError, match=r"must end in \.png, \.svg"):
        save_figure(spectrum, tmp_path / "spectrum.gif")
    for name in ("map.png", "spectrum.png"):
        assert (tmp_path / name).read_bytes().startswith(PNG)
    assert "<svg" in (tmp_path / "map.svg").read_text()


def test_demo_on_a_small_field(directory: Path, tmp_path: Path) -> None:
    stages: list[str] = []
    outcome = run_demo(tmp_path / "demo", scenario_path=directory / "site.toml", on_stage=stages.append)
    assert stages == ["Simulating", "Measuring", "Drawing"]
    assert outcome.evaluation.solved == 3
    names = {"recording.h5", "result.h5", "poses.csv", "field_map.png", "spectrum.png"}
    assert {path.name for path in (tmp_path / "demo").iterdir()} == names


def test_demo_writes_a_report(directory: Path, tmp_path: Path) -> None:
    write_report(directory / "result.h5", tmp_path / "report.html")
    report = (tmp_path / "report.html").read_text()
    assert "H01" in report
    assert "<svg" in report


def test_demo_makes_its_directory_and_all_it_promises(tmp_path: Path) -> None:
    told = _json("demo", "-o", tmp_path / "new" / "demo")
    names = {"recording.h5", "result.h5", "poses.csv", "field_map.png", "spectrum.png", "report.html"}
    assert {Path(path).name for path in told["files"].values()} == names
    assert all(Path(path).is_file() for path in told["files"].values())
    assert told["solved"] == 60
    assert not undocumented("demo", [told])
    assert not unseen("demo", [told])
    (tmp_path / "new" / "demo" / "recording.h5").unlink()  # 300 MB


@pytest.mark.parametrize("name", ["spectrum.png", "report.html"])
def test_demo_refuses_what_is_there_before_any_work(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("dear")
    shown = _run("demo", "-o", tmp_path)
    assert shown.exit_code == 3
    assert f"{name}: exists already" in shown.stderr
    assert [path.name for path in tmp_path.iterdir()] == [name]
