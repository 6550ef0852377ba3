"""What the command line promises whatever the data: help, versions, exit codes, one JSON object."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

import rfpose
from rfpose.cli import _app
from rfpose.cli._support import emit_json
from rfpose.cli.process import ESTIMATOR_NAMES
from rfpose.recording import RecordingWriter

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


COMPILED = ("numba", "scipy", "pvlib", "matplotlib", "PySide6")
NO_KERNEL = ("numba", "scipy.stats", "scipy.ndimage", "matplotlib", "PySide6", "pydantic")


REFUSED = {
    HEAVY: [
        ("simulate there -o there", "the same"),
        ("process there.h5 -o there", "exists already"),
        ("convert there.h5 -o there", "exists already"),
        ("track there.toml -o there", "exists already"),
        ("layout map there.toml --csv there", "exists already"),
        ("view absent.h5 --save x.png", "no such file"),
        ("evaluate absent.h5", "no such file"),
        ("info absent.h5", "no such file"),
        ("calibrate absent", "no such file"),
        ("aim absent.json --dish --start 2026-06-21T06:00Z", "no such file"),
        ("demo -o .", "exists already"),
        ("evaluate there.h5", "no result"),
        ("calibrate bad.toml", "is no directory"),
    ],
    COMPILED: [
        ("simulate bad.toml -o x.h5", "not valid TOML"),
        ("track bad.toml -o x.h5", "not valid TOML"),
        ("layout map bad.toml", "not valid TOML"),
        ("layout budget bad.toml", "not valid TOML"),
        ("layout optimise bad.toml", "not valid TOML"),
        ("layout tones bad.toml --accuracy-mrad 1", "not valid TOML"),
        ("process bare.h5 -o x.h5", "holds no scenario"),
        ("process bare.h5 --scenario bad.toml -o x.h5", "not valid TOML"),
        ("convert absent.h5 -o x.h5", "no such file"),
        ("info there.h5", "the file is empty"),
        ("info bad.toml", "not valid TOML"),
        ("view there.h5 --save x.png", "the file is empty"),
        ("view bad.toml --save x.png", "not valid TOML"),
        ("view there.h5 --scenario bad.toml --save x.png", "the file is empty"),
    ],
    NO_KERNEL: [
        ("aim bad.toml --dish --start 2026-06-21T06:00Z", "not valid TOML"),
        ("calibrate .", "no heliostat folder"),
        ("calibrate --mount bad.toml --drone there", "not valid TOML"),
    ],
}
"""What is refused and with which words, by what must not have been loaded for it."""
SEVERAL = """
import json, sys
from rfpose.cli import main
for words in json.loads(sys.argv[1]):
    sys.argv[1:] = words.split()
    done = 0
    try: main()
    except SystemExit as ended: done = ended.code
    loaded = [name for name in json.loads(sys.stdin.readline()) if name in sys.modules]
    print(json.dumps([words, done or 0, loaded]))
    print(file=sys.stderr)
"""


def _loaded(folder: Path, given: list[tuple[str, tuple[str, ...]]]) -> tuple[list[Any], list[str]]:
    """Run commands one after the other in one new process.

    Returns what each came to (words, exit code, those of its modules that had been loaded by then) and its messages.
    """
    code = [sys.executable, "-c", SEVERAL, json.dumps([words for words, _ in given])]
    asked = "".join(json.dumps(modules) + "\n" for _, modules in given)
    done = subprocess.run(code, input=asked, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    told = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('["')]
    return told, done.stderr.split("\n\n")


@pytest.mark.parametrize("unloaded", REFUSED)
def test_a_refusal_waits_for_nothing_heavy(tmp_path: Path, unloaded: tuple[str, ...]) -> None:
    """What is loaded, not how long it takes: that depends on the machine."""
    for name in ("there", "there.h5", "there.toml", "spectrum.png"):
        (tmp_path / name).write_text("")
    (tmp_path / "bad.toml").write_text("= 3")
    settings = {"scenario": None, "receiver_ids": ["a"], "sample_rate": Fraction(1), "centre_frequency_hz": None}
    with RecordingWriter(
        tmp_path / "bare.h5", **settings, sample_format="int16", full_scale=1.0, provenance={}
    ) as writer:
        writer.write("a", 0, np.zeros((9, 2), np.int16))
    found, messages = _loaded(tmp_path, [(words, unloaded) for words, _ in REFUSED[unloaded]])
    assert found == [[words, 3, []] for words, _ in REFUSED[unloaded]]
    for (words, says), message in zip(REFUSED[unloaded], messages, strict=False):
        assert says in message, words


SLOW = """
import sys, time
import rfpose.cli._support as support, rfpose.pipeline.inspect as inspect
support._EVERY_S = 0.05
def slow(path, **_settings):
    with support.progress("Looking") as shown:
        time.sleep(0.2)
        shown(1, 4)
        time.sleep(0.2)
    return {"kind": "nothing"}
inspect.inspect_file = slow
from rfpose.cli import main
main()
"""


def test_long_work_is_told_without_a_terminal(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("")
    command = [sys.executable, "-c", SLOW, "info", str(tmp_path / "x"), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == {"kind": "nothing"}
    lines = done.stderr.splitlines()
    assert re.fullmatch(r"rfpose: Looking, for \d+ s", lines[0])
    assert re.fullmatch(r"rfpose: Looking: 1 of 4, \d+ s left", lines[-1])


KERNEL = """
from rfpose.cli._app import _notes_to_stderr
import numpy as np, rfpose.multilat._kernels as kernels
from rfpose.jit import kernel
@kernel
def one(x):
    return x + 1.0
one.py_func.__module__ = "rfpose.test._kernels"
with _notes_to_stderr():
    assert one(2.0) == 3.0
    assert one(2) == 3
"""


def test_kernels_work_where_no_cache_can_be_written(tmp_path: Path) -> None:
    """A place below a file cannot be made, whoever tries."""
    (tmp_path / "file").write_text("")
    shutil.copytree(Path(rfpose.__file__).parent, tmp_path / "rfpose", ignore=shutil.ignore_patterns("__pycache__"))
    for where in (tmp_path / "rfpose").rglob("_kernels.py"):
        (where.parent / "__pycache__").write_text("")
    (tmp_path / "k.py").write_text(KERNEL)
    (tmp_path / "__pycache__").write_text("")
    home = str(tmp_path / "file" / "home")
    environment = {key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    environment |= {"HOME": home, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run([sys.executable, "k.py"], capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    first, second = done.stderr.splitlines()
    assert first.startswith("rfpose: note: compiling kernels, once")
    assert "NUMBA_CACHE_DIR" in second


def _words() -> list[str]:
    """Every command as typed; a group's sub-commands instead of the group."""
    out = []
    for name in _app.COMMANDS:
        command = importlib.import_module(f"rfpose.cli.{name.replace('-', '_')}").command
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
    command = importlib.import_module(f"rfpose.cli.{name.replace('-', '_')}").command
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


@pytest.fixture(scope="module")
def small_job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small recording, its scenario and its result."""
    folder = tmp_path_factory.mktemp("job")
    site = rfpose.load_scenario(rfpose.shipped_scenario("table2_100m.toml"))
    short = site.changed(heliostat=site.heliostat[:2], radio={"frame_samples": 40_000}, simulation={"frame_count": 2})
    short.save(folder / "site.toml")
    rfpose.simulate(short, seed=1).save(folder / "recording.h5")
    rfpose.process(folder / "recording.h5", folder / "result.h5")
    return folder


NO_SCIPY = ("scipy._lib._array_api", "matplotlib", "pvlib")
# numba's, which a kernel that comes out of the cache does not need
COMPILER = ("numba.typed.typeddict", "numba.np.polynomial", "numba.np.random.generator_core")
SLOW_TO_LOAD = ("scipy.linalg", "scipy.stats", "scipy.optimize", "scipy.spatial", "scipy.signal", "matplotlib", "pvlib")


def test_a_command_loads_what_it_needs(small_job: Path) -> None:
    """What is loaded, not how long it takes: start-up is most of a small job's time."""
    # those that load least come first: what one has loaded is there for the next
    given = [
        ("info recording.h5", (*SLOW_TO_LOAD, "scipy.special", "numba", "rfpose.recording.drf", "rfpose.dsp")),
        ("evaluate result.h5", (*SLOW_TO_LOAD, "scipy.special", "rfpose.recording.drf")),
        (
            "process recording.h5 -o again.h5",
            (*SLOW_TO_LOAD, *COMPILER, "rfpose.pipeline.site", "rfpose.recording.drf"),
        ),
        ("process recording.h5 -o again.h5 --estimator correlator --force", SLOW_TO_LOAD),
    ]
    studies = (*NO_SCIPY, "rfpose.layout.budget", "rfpose.pipeline.site")
    layouts = [
        ("layout map site.toml", studies),
        ("layout optimise site.toml -o better.toml --starts 2", studies),
    ]
    for together in (given, layouts):
        found, _ = _loaded(small_job, together)
        assert found == [[words, 0, []] for words, _ in together]


def test_profile_tells_where_the_time_went(small_job: Path) -> None:
    words = ["process", str(small_job / "recording.h5"), "-o", str(small_job / "profiled.h5"), "--json"]
    plain, profiled = (CliRunner().invoke(_app.app, [*words, *more]) for more in ([], ["--force", "--profile"]))
    assert "profile" not in json.loads(plain.stdout)
    profile = json.loads(profiled.stdout)["profile"]
    seconds = profile["seconds"]
    assert list(seconds) == ["open", "read", "tones", "calibration", "poses", "write"]
    assert min(seconds.values()) > 0.0
    # two mirrors of three receivers and the calibration receiver, two frames
    assert profile["samples"] == 2 * 7 * 40_000
    assert profile["samples_per_s"] == pytest.approx(profile["samples"] / (seconds["read"] + seconds["tones"]))
    assert seconds[profile["bound_by"]] == max(seconds.values())
