"""What commands write, against signals, kills, a second process and names that are not theirs to take."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.cli._app import app
from rfpose.errors import RecordingError
from rfpose.files import claim, write_atomically
from rfpose.interruption import held_back
from rfpose.recording.output import Hdf5Output
from rfpose.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[2]

# Runs the command line; a signal reaches it after the nth call of a function of `os` by Python code.
DRIVER = """
import os, signal, sys
from rfpose.cli import main
name, function, n = sys.argv[1], sys.argv[2], int(sys.argv[3])
del sys.argv[1:4]
plain, calls = getattr(os, function), [0]
def counted(*arguments, **settings):
    done = plain(*arguments, **settings)
    calls[0] += 1
    if calls[0] == n:
        os.kill(os.getpid(), getattr(signal, name))
    return done
setattr(os, function, counted)
try:
    main()
finally:
    print("calls", calls[0], file=sys.stderr)
"""


def _run(*arguments: object, at: tuple[str, str, int] | None = None) -> subprocess.CompletedProcess[str]:
    name, function, n = at or ("SIGINT", "pwrite", 0)
    command = [sys.executable, "-c", DRIVER, name, function, str(n), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def _calls(done: subprocess.CompletedProcess[str]) -> int:
    return int(done.stderr.split()[-1])


def _names(directory: Path) -> set[str]:
    return {path.name for path in directory.iterdir()}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with a small site, its recording, a SigMF copy and a result."""
    where = tmp_path_factory.mktemp("made")
    site = load_scenario(ROOT / "data" / "table2_100m.toml")
    short = {"radio": {"frame_samples": 8000}, "simulation": {"frame_count": 1, "sun_azimuth_deg": 170.0}}
    site.changed(heliostat=site.heliostat[:1], **short).save(where / "site.toml")
    for words in (
        ["simulate", where / "site.toml", "-o", where / "rec.h5"],
        ["convert", where / "rec.h5", "-o", where / "sig", "--to", "sigmf"],
        ["process", where / "rec.h5", "-o", where / "result.h5", "--csv", where / "poses.csv"],
    ):
        shown = CliRunner().invoke(app, [str(word) for word in words])
        assert shown.exit_code == 0, shown.stderr
    return where


# -- signals -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("command", ["simulate", "convert"])
def test_a_signal_in_a_write_leaves_nothing(made: Path, tmp_path: Path, command: str, name: str) -> None:
    source = made / ("site.toml" if command == "simulate" else "rec.h5")
    total = _calls(_run(command, source, "-o", tmp_path / "whole.h5"))
    whole = (tmp_path / "whole.h5").read_bytes()
    (tmp_path / "whole.h5").unlink()
    assert total > 4
    for n in {"SIGINT": (1, total // 2, total), "SIGTERM": (2,), "SIGHUP": (total - 1,)}[name]:
        stopped = _run(command, source, "-o", tmp_path / "x.h5", at=(name, "pwrite", n))
        assert stopped.returncode == 130, stopped.stderr
        assert "interrupted" in stopped.stderr
        assert _names(tmp_path) == set()
    _run(command, source, "-o", tmp_path / "x.h5")
    assert (tmp_path / "x.h5").read_bytes() == whole


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError, SystemExit, OSError])
@pytest.mark.parametrize("function", ["pwrite", "preadv", "fsync"])
def test_no_error_of_a_callback_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException], function: str
) -> None:
    """Whatever comes up while HDF5 calls back, at whichever call, the file is not published."""
    plain, calls, at = getattr(os, function), [0], [0]

    def counted(*arguments: object) -> object:
        calls[0] += 1
        if calls[0] == at[0]:
            raise error
        return plain(*arguments)

    def write() -> None:
        output = Hdf5Output(tmp_path / "x.h5", overwrite=False, rdcc_nbytes=0)
        try:
            with output.writing() as file:
                data = file.create_dataset("x", (60_000,), "f8", chunks=(1000,))
                data[:] = np.arange(60_000.0)
                data[:500] += 1.0
            output.commit()
        finally:
            output.discard()

    monkeypatch.setattr(os, function, counted)
    write()
    (tmp_path / "x.h5").unlink()
    n_call = calls[0]
    assert n_call > 0
    for n in range(1, n_call + 1):
        calls[0], at[0] = 0, n
        with pytest.raises(RecordingError if error is OSError else error):
            write()
        assert _names(tmp_path) == set()


def test_signals_wait_while_held_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    seen = []

    def work() -> None:
        with held_back():
            with held_back():
                os.kill(os.getpid(), signal.SIGINT)
                seen.append("inner")
            seen.append("outer")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert seen == ["inner", "outer"]
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("n", [1, 2])
def test_an_interruption_between_two_names_waits_for_both(made: Path, tmp_path: Path, n: int) -> None:
    words = ("process", made / "rec.h5", "-o", tmp_path / "r.h5", "--csv", tmp_path / "p.csv")
    # the names are taken by the last two renames, after those of the journal
    renames = _calls(_run(*words, at=("SIGINT", "replace", 0)))
    shutil.rmtree(tmp_path)
    tmp_path.mkdir()
    stopped = _run(*words, at=("SIGTERM", "replace", renames - 2 + n))
    assert stopped.returncode in (0, 130), stopped.stderr
    assert _names(tmp_path) in ({"r.h5", "p.csv"}, {"r.h5.partial"})


# -- killed --------------------------------------------------------------------------------------------------


def test_killed_between_result_and_table_the_same_command_goes_on(made: Path, tmp_path: Path) -> None:
    """The outputs already published are that job's own; another job's names stay safe."""
    words = ("process", made / "rec.h5", "-o", tmp_path / "r.h5", "--csv", tmp_path / "p.csv")
    kill = (
        "import rfpose.files as f, os, signal, sys; plain = f._take_name\n"
        "def killed(output): plain(output); os.kill(os.getpid(), signal.SIGKILL)\n"
        "f._take_name = killed\nfrom rfpose.cli import main; main()"
    )
    killed = subprocess.run([sys.executable, "-c", kill, *map(str, words)], capture_output=True, timeout=300)
    assert killed.returncode == -signal.SIGKILL
    assert (tmp_path / "r.h5").exists()
    assert not (tmp_path / "p.csv").exists()
    other = _run("process", made / "sig", "-o", tmp_path / "r.h5", "--csv", tmp_path / "p.csv")
    assert other.returncode == 3
    assert "exists already" in other.stderr
    again = _run(*words)
    assert again.returncode == 0, again.stderr
    assert _names(tmp_path) == {"r.h5", "p.csv"}
    assert (tmp_path / "r.h5").read_bytes() == (made / "result.h5").read_bytes()
    assert _run(*words).returncode == 3  # now it is done, and nothing of it is taken for unfinished


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux exchanges names; see the next test")
def test_a_directory_is_replaced_in_one_step(made: Path, tmp_path: Path) -> None:
    """Killed right after the exchange, or after any plain renaming, there is a whole recording under the name."""
    shutil.copytree(made / "sig", tmp_path / "sig")
    before = _names(tmp_path / "sig")
    kill = (
        "import rfpose.files as f, os, signal\n"
        "plain = f._exchange\n"
        "def killed(one, other):\n"
        "    if plain(one, other): os.kill(os.getpid(), signal.SIGKILL)\n"
        "f._exchange = killed\nfrom rfpose.cli import main; main()"
    )
    words = ["convert", str(made / "rec.h5"), "-o", str(tmp_path / "sig"), "--to", "sigmf", "--force"]
    killed = subprocess.run([sys.executable, "-c", kill, *words], capture_output=True, timeout=300)
    assert killed.returncode == -signal.SIGKILL
    assert _names(tmp_path / "sig") == before
    _run(*words, at=("SIGKILL", "rename", 1))
    assert _names(tmp_path / "sig") == before
    assert _run(*words).returncode == 0
    assert _names(tmp_path) == {"sig"}


def test_without_exchange_a_directory_gets_its_name_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rfpose.files._exchange", lambda _one, _other: False)
    (tmp_path / ".d.old").mkdir()
    (tmp_path / ".d.old" / "x").write_text("mine")
    with claim(tmp_path / "d", force=True, directories=True) as job:
        assert (tmp_path / "d" / "x").read_text() == "mine"
        job.part(tmp_path / "d").mkdir()
        (job.part(tmp_path / "d") / "y").write_text("new")
        job.complete(tmp_path / "d")
    assert _names(tmp_path) == {"d"}
    assert _names(tmp_path / "d") == {"y"}


# -- two at once ---------------------------------------------------------------------------------------------


def test_a_second_process_is_refused_and_told_by_whom(tmp_path: Path) -> None:
    code = (
        "import sys, pathlib; from rfpose.files import claim\n"
        "with claim(sys.argv[1]): print('held', flush=True); sys.stdin.read()"
    )
    target = tmp_path / "x.csv"
    holder = subprocess.Popen(
        [sys.executable, "-c", code, str(target)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout is not None
        holder.stdout.readline()
        (tmp_path / "link").symlink_to(tmp_path)
        for name in (target, tmp_path / "link" / "x.csv"):
            with pytest.raises(RecordingError, match=f"being written by process {holder.pid} on "):
                write_atomically(name, b"mine")
    finally:
        holder.kill()
        holder.communicate()
    write_atomically(target, b"mine")
    assert _names(tmp_path) == {"x.csv", "link"}


# -- names ---------------------------------------------------------------------------------------------------

MOUNTS = '{"format": "rfpose-mounts", "version": 1, "heliostat": {}}'
# command with {i}: what it reads, {o}: what it writes
WRITERS = {
    "simulate": "simulate {i} -o {o}",
    "process": "process {i} -o {o}",
    "process-scenario": "process rec.h5 --scenario {i} -o {o}",
    "process-csv": "process {i} -o new.h5 --csv {o}",
    "convert": "convert {i} -o {o}",
    "convert-scenario": "convert rec.h5 --scenario {i} -o {o}",
    "track": "track {i} -o {o}",
    "track-csv": "track {i} -o new.h5 --csv {o}",
    "track-picture": "track {i} -o new.h5 --picture {o}",
    "map": "layout map {i} --csv {o}",
    "map-field": "layout map site.toml --field {i} --csv {o}",
    "map-picture": "layout map {i} --picture {o}",
    "budget": "layout budget {i} -o {o}",
    "budget-picture": "layout budget {i} --picture {o}",
    "optimise": "layout optimise {i} -o {o}",
    "optimise-outline": "layout optimise site.toml --outline {i} -o {o}",
    "pareto": "layout optimise {i} --pareto 4..5 --csv {o}",
    "pareto-picture": "layout optimise {i} --pareto 4..5 --picture {o}",
    "calibrate": "calibrate --mount {i} --drone log.csv -o {o}",
    "calibrate-drone": "calibrate --mount m.toml --drone {i} -o {o}",
    "calibrate-picture": "calibrate --mount {i} --drone log.csv --picture {o}",
    "aim": "aim {i} --dish --start 2026-06-21T06:00Z -o {o}",
    "optimise-picture": "layout optimise {i} --picture {o}",
    "compare-picture": "layout compare {i} site.toml --picture {o}",
    "compare-csv": "layout compare {i} site.toml --csv {o}",
    "track-series.csv": "track {i} -o new.h5 --series {o}",
    "process-parquet": "process {i} -o new.h5 --parquet {o}",
    "plot-picture": "plot {i} -o {o}",
    "view": "view {i} --save {o}",
}
ENDINGS = {"picture": ".png", "csv": ".csv", "parquet": ".parquet", "view": ".png"}
ENDINGS |= {"calibrate": ".toml", "calibrate-drone": ".toml"}


def _name(writer: str) -> str:
    ending = ENDINGS.get(writer) or next((e for key, e in ENDINGS.items() if writer.endswith(key)), ".x")
    return f"thing{ending}"


def _refused(words: str, where: Path, text: str) -> None:
    before = {path: path.read_bytes() for path in where.rglob("*") if path.is_file()}
    shown = CliRunner().invoke(app, words.split())
    assert shown.exit_code == 3, (words, shown.output)
    assert text in shown.stderr
    assert {path: path.read_bytes() for path in where.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("writer", WRITERS)
def test_no_output_takes_an_input(writer: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the same name, by a link of either kind, by a way round; force or not."""
    monkeypatch.chdir(tmp_path)
    name = _name(writer)
    Path(name).write_text("dear")
    ending = os.path.splitext(name)[1]
    Path(f"soft{ending}").symlink_to(name)
    os.link(name, f"hard{ending}")
    Path("sub").mkdir()
    for other in (name, f"./sub/../{name}", str(tmp_path / name), f"soft{ending}", f"hard{ending}"):
        _refused(f"{WRITERS[writer].format(i=name, o=other)} --force", tmp_path, "source and target are the same")


@pytest.mark.parametrize("writer", [name for name in WRITERS if name not in ("process-scenario", "convert-scenario")])
def test_an_output_that_cannot_be_written_is_refused_before_any_work(
    writer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The input is missing too: that would be the message if anything had been read."""
    monkeypatch.chdir(tmp_path)
    name = _name(writer)
    Path("file").write_text("")
    Path(f"d{os.path.splitext(name)[1]}").mkdir()
    Path(name).write_text("dear")
    for output, text in (
        (f"no/{name}", "directory does not exist"),
        (f"file/{name}", "directory does not exist"),
        (f"d{os.path.splitext(name)[1]}", "is a directory"),
        (name, "exists already"),
    ):
        _refused(WRITERS[writer].format(i="absent", o=output), tmp_path, text)


@pytest.mark.parametrize(
    "words",
    [
        "process rec.h5 -o x.h5 --csv ./x.h5",
        "track site.toml -o x.h5 --csv x.h5",
        "track site.toml -o x.png --picture x.png",
        "layout map site.toml --csv x.png --picture x.png",
        "layout budget site.toml -o x.png --picture x.png",
        "layout optimise site.toml --pareto 4..5 --csv x.png --picture x.png",
    ],
)
def test_two_outputs_of_one_name(words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _refused(f"{words} --force", tmp_path, "two outputs of this name")


def test_convert_deletes_nothing_but_a_recording(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(made / "sig", tmp_path / "night")
    one = next((tmp_path / "night").glob("*.sigmf-meta")).relative_to(tmp_path)
    _refused(f"convert {one} -o night --to sigmf --force", tmp_path, "which lies in there")
    _refused(f"convert {one} -o {one.with_suffix('.sigmf-data')} --force", tmp_path, "are the same")
    _refused(f"process night -o {one} --force", tmp_path, "nothing there is replaced")
    (tmp_path / "night" / "notes.txt").write_text("years of work")
    _refused(f"convert {made / 'rec.h5'} -o night --to sigmf --force", tmp_path, "holds `notes.txt`")


def test_something_that_is_no_file_is_never_replaced(made: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    shown = CliRunner().invoke(app, ["convert", str(made / "rec.h5"), "-o", str(tmp_path / "pipe"), "--force"])
    assert shown.exit_code == 3
    assert "no regular file" in shown.stderr


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "x.csv").symlink_to(tmp_path / "disk" / "x.csv")
    write_atomically(tmp_path / "x.csv", b"new")
    assert (tmp_path / "x.csv").is_symlink()
    assert (tmp_path / "disk" / "x.csv").read_bytes() == b"new"
