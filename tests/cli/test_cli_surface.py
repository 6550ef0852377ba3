"""What the command line promises whatever the data: help, versions, exit codes, one JSON object."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

import rfpose
from rfpose.cli import _app
from rfpose.cli._support import emit_json
from rfpose.cli.process import ESTIMATOR_NAMES

HEAVY = ("numpy", "scipy", "numba", "h5py", "pydantic", "matplotlib", "rich")


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['rfpose', '--help']\n"
        "from rfpose.cli import main\n"
        "try: main()\n"
        "except SystemExit as done: assert done.code == 0\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    for name in _app.COMMANDS:
        assert name in done.stdout


def _words() -> list[str]:
    """Every command as typed; a group's sub-commands instead of the group."""
    out = []
    for name in _app.COMMANDS:
        command = importlib.import_module(f"rfpose.cli.{name}").command
        out += [f"{name} {sub}" for sub in command.commands] if isinstance(command, click.Group) else [name]
    return out


@pytest.mark.parametrize("name", _words())
def test_each_command_has_help_with_examples(name: str) -> None:
    shown = CliRunner().invoke(_app.app, [*name.split(), "--help"])
    assert shown.exit_code == 0
    assert f"  rfpose {name}" in shown.output
    assert "--json" in shown.output
    assert "--debug" in shown.output


@pytest.mark.parametrize("name", _app.COMMANDS)
def test_command_is_called_as_its_module(name: str) -> None:
    command = importlib.import_module(f"rfpose.cli.{name}").command
    assert isinstance(command, click.Command)
    assert command.name == name


def test_version() -> None:
    shown = CliRunner().invoke(_app.app, ["--version"])
    assert shown.output.strip() == f"rfpose {rfpose.__version__}"


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["process"],
        ["process", "a.h5", "-o", "b.h5", "--estimator", "guess"],
        ["simulate", "--seed", "-1"],
    ],
)
def test_wrong_usage_is_exit_2(arguments: list[str]) -> None:
    assert CliRunner().invoke(_app.app, arguments).exit_code == 2


def test_estimator_names_are_those_of_dsp() -> None:
    from rfpose.dsp import ESTIMATORS

    assert set(ESTIMATOR_NAMES) == set(ESTIMATORS)


@pytest.mark.parametrize("command", [["info"], ["evaluate"], ["process", "-o", "{out}"], ["simulate", "-o", "{out}"]])
def test_missing_input_is_exit_3_and_one_line(tmp_path: Path, command: list[str]) -> None:
    absent = tmp_path / "absent.h5"
    out = tmp_path / "out.h5"
    arguments = [command[0], str(absent), *(part.format(out=out) for part in command[1:])]
    shown = CliRunner().invoke(_app.app, arguments)
    assert shown.exit_code == 3
    assert shown.stdout == ""
    assert shown.stderr.startswith("rfpose: ")
    assert shown.stderr.count("\n") == 1
    assert "absent.h5" in shown.stderr
    assert not out.exists()


def test_failure_with_json_is_still_one_object(tmp_path: Path) -> None:
    shown = CliRunner().invoke(_app.app, ["info", str(tmp_path / "absent.h5"), "--json"])
    assert shown.exit_code == 3
    assert set(json.loads(shown.stdout)) == {"error", "exit_code"}


def test_traceback_only_with_debug(tmp_path: Path) -> None:
    arguments = ["info", str(tmp_path / "absent.h5")]
    assert "Traceback" not in CliRunner().invoke(_app.app, arguments).stderr
    assert "Traceback" in CliRunner().invoke(_app.app, [*arguments, "--debug"]).stderr


def test_json_has_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    emit_json({"a": float("nan"), "b": np.array([1.0, np.inf]), "c": {"d": (np.float32(0.5), Path("x"), None, True)}})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [1.0, None], "c": {"d": [0.5, "x", None, True]}}
