"""Processing that is killed, interrupted, or runs out of disk: nothing half written, nothing lost."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rfpose.errors import RecordingError
from rfpose.pipeline import measure
from rfpose.pipeline.formats.result_file import open_result
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.scenario import Scenario, load_scenario

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml"
N_ROW = 4 * 7  # frames × receivers

# Runs the command line with a small journal; a signal reaches it while it measures a given row.
DRIVER = """
import itertools, os, signal, sys
import rfpose.pipeline.measure as measure
from rfpose.cli import main
row_of_signal, name = int(sys.argv[1]), sys.argv[2]
del sys.argv[1:3]
measure.JOURNAL_SAMPLES = 3 * 8000
plain, calls = measure.ToneExtractor.measure, itertools.count(1)
def counted(self, samples, **settings):
    if next(calls) == row_of_signal:
        os.kill(os.getpid(), getattr(signal, name))
    return plain(self, samples, **settings)
measure.ToneExtractor.measure = counted
try:
    main()
finally:
    print(next(calls) - 1, file=sys.stderr)
"""


def _scenario(**simulation: object) -> Scenario:
    shipped, still = load_scenario(SHIPPED), {"frame_count": 4, "frame_interval_s": 1.0, "sun_azimuth_deg": 170.0}
    return shipped.changed(
        heliostat=shipped.heliostat[:2], radio={"frame_samples": 8000}, simulation=still | simulation
    )


def _simulate(directory: Path, *, seed: int = 1, name: str = "rec.h5") -> Path:
    site = directory / "site.toml"
    site.write_text(_scenario().to_toml())
    simulate(site, seed=seed).save(directory / name, force=True)
    return directory / name


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _simulate(tmp_path_factory.mktemp("recording"))


@pytest.fixture(scope="module")
def undisturbed(recording: Path) -> bytes:
    result = recording.with_name("undisturbed.h5")
    process(recording, result)
    return result.read_bytes()


def _run(recording: Path, result: Path, *, signal_at_row: int = 0, name: str = "SIGKILL", limit: int | None = None):
    def limited() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    command = [sys.executable, "-c", DRIVER, str(signal_at_row), name, "process", str(recording), "-o", str(result)]
    return subprocess.run(command, capture_output=True, text=True, preexec_fn=limited)


class _StopError(Exception):
    pass


def _stop_after(recording: Path, result: Path, row: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Break processing off in this process, as a program that uses the library might."""

    def on_progress(done: int, _total: int) -> None:
        if done >= row:
            raise _StopError

    monkeypatch.setattr(measure, "JOURNAL_SAMPLES", 3 * 8000)
    with pytest.raises(_StopError):
        process(recording, result, on_progress=on_progress)


def test_killed_and_resumed_gives_the_same_bytes(recording: Path, undisturbed: bytes, tmp_path: Path) -> None:
    result = tmp_path / "result.h5"
    for row in (5, 8):  # the second run begins at row 4
        killed = _run(recording, result, signal_at_row=row)
        assert killed.returncode == -signal.SIGKILL
        assert not result.exists()
    resumed = _run(recording, result)
    assert resumed.returncode == 0, resumed.stderr
    # rows 1-3 of the first run and 4-9 of the second were kept
    assert int(resumed.stderr.split()[-1]) == N_ROW - 9
    assert result.read_bytes() == undisturbed
    assert [path.name for path in tmp_path.iterdir()] == ["result.h5"]


def test_interrupted_says_how_to_go_on(recording: Path, undisturbed: bytes, tmp_path: Path) -> None:
    result = tmp_path / "result.h5"
    stopped = _run(recording, result, signal_at_row=11, name="SIGINT")
    assert stopped.returncode == 130
    assert stopped.stdout == ""
    message, _ = stopped.stderr.strip().splitlines()
    assert message == "rfpose: interrupted; the same command resumes where it stopped"
    resumed = _run(recording, result)
    assert int(resumed.stderr.split()[-1]) == N_ROW - 9
    assert result.read_bytes() == undisturbed


def test_disk_full_leaves_nothing_under_the_name(recording: Path, undisturbed: bytes, tmp_path: Path) -> None:
    result = tmp_path / "result.h5"
    # journal entries fit below the limit, the result does not
    stopped = _run(recording, result, limit=40_000)
    assert stopped.returncode == 3
    assert f"\nrfpose: {result}: cannot write: " in f"\n{stopped.stderr}"
    assert [path.name for path in tmp_path.iterdir()] == ["result.h5.partial"]
    resumed = _run(recording, result)
    assert int(resumed.stderr.split()[-1]) == 0
    assert result.read_bytes() == undisturbed


def test_disk_full_in_the_journal_names_it(recording: Path, tmp_path: Path) -> None:
    result = tmp_path / "result.h5"
    stopped = _run(recording, result, limit=2_000)
    assert stopped.returncode == 3
    assert "result.h5.partial/rows-000000000000-000000000003.npz: cannot write" in stopped.stderr
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["key.json", "result.h5.partial"]


def test_existing_result_is_refused_before_any_work(recording: Path, tmp_path: Path) -> None:
    result = tmp_path / "result.h5"
    result.write_text("dear")
    with pytest.raises(RecordingError, match=r"result\.h5: exists already.*`force=True`"):
        process(tmp_path / "absent.h5", result)
    assert result.read_text() == "dear"
    process(recording, result, force=True)
    open_result(result)


def test_unfinished_work_of_another_recording_is_not_mixed_in(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = _simulate(tmp_path, seed=2, name="other.h5")
    result = tmp_path / "result.h5"
    _stop_after(recording, result, 11, monkeypatch)
    with pytest.raises(RecordingError, match=r"result\.h5\.partial.*different: recording.*`force=True`"):
        process(other, result)
    with pytest.raises(RecordingError, match="different: estimator"):
        process(recording, result, estimator="correlator")
    process(other, result, force=True)
    clean = tmp_path / "clean.h5"
    process(other, clean)
    assert result.read_bytes() == clean.read_bytes()


def test_work_that_never_began_is_in_nobodys_way(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = tmp_path / "result.h5"
    _stop_after(recording, result, 0, monkeypatch)
    assert [path.name for path in (tmp_path / "result.h5.partial").iterdir()] == ["key.json"]
    process(recording, result, estimator="correlator")
    assert result.exists()
    assert not (tmp_path / "result.h5.partial").exists()


def test_interrupted_while_it_waits_for_a_recording(tmp_path: Path) -> None:
    command = [
        Path(sys.executable).with_name("rfpose"),
        "process",
        tmp_path / "night",
        "-o",
        tmp_path / "result.h5",
        "--follow",
    ]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as waiting:
        assert waiting.stderr is not None
        assert "not there yet; waiting for it" in waiting.stderr.readline()
        waiting.send_signal(signal.SIGINT)
        assert waiting.stderr.read().strip() == "rfpose: interrupted; no frame was complete yet"
    assert list(tmp_path.iterdir()) == []


def test_damaged_journal_entry_is_measured_again(
    recording: Path,
    undisturbed: bytes,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = tmp_path / "result.h5"
    _stop_after(recording, result, 11, monkeypatch)
    second = sorted((tmp_path / "result.h5.partial").glob("rows-*.npz"))[1]
    second.write_bytes(second.read_bytes()[:700])
    process(recording, result)
    assert f"{second} is damaged" in caplog.text
    assert result.read_bytes() == undisturbed


def test_foreign_directory_in_the_journals_place_is_left_alone(recording: Path, tmp_path: Path) -> None:
    diary = tmp_path / "result.h5.partial" / "diary.txt"
    diary.parent.mkdir()
    diary.write_text("dear")
    for force in (False, True):
        with pytest.raises(RecordingError, match="in the way"):
            process(recording, tmp_path / "result.h5", force=force)
    assert diary.read_text() == "dear"


def test_result_in_a_missing_directory_is_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="directory does not exist"):
        process(tmp_path / "absent.h5", tmp_path / "nowhere" / "result.h5")
