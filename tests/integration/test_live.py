"""Recordings that are being written become the poses of the finished ones, and others read along."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

import rfpose as rf
from rfpose.cli._app import app
from rfpose.dsp import LineStatus
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.pipeline import follow
from rfpose.pipeline.follow import Follow
from rfpose.pipeline.formats.journal import partial_of
from rfpose.pipeline.formats.live_result import LiveResult, ResultFollower, open_live
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import columns_of, result_of
from rfpose.pipeline.publish import messages, messages_as_they_come
from rfpose.recording.segments import open_growing
from rfpose.scenario import Scenario

N_FRAME = 6
N_RECEIVER = 7

# Runs the command line; something happens in this process when it measures a given row, or before it keeps a frame.
DRIVER = """
import itertools, os, resource, signal, sys
import rfpose.pipeline.formats.journal as journal
import rfpose.pipeline.measure as measure
from rfpose.cli import main
def killed():
    os.kill(os.getpid(), signal.SIGKILL)
def disk_full():
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
at_row, at_frame, what = int(sys.argv[1]), int(sys.argv[2]), globals()[sys.argv[3]]
del sys.argv[1:4]
def counted(plain, at, calls):
    def call(*given, **settings):
        if next(calls) == at:
            what()
        return plain(*given, **settings)
    return call
measure.ToneExtractor.measure = counted(measure.ToneExtractor.measure, at_row, itertools.count())
journal.Journal.append = counted(journal.Journal.append, at_frame, itertools.count())
main()
"""


def _follow(night: Path, output: Path, what: str, *, at_row: int = -1, at_frame: int = -1) -> Any:
    words = ["process", str(night), "-o", str(output), "--follow", "--idle-timeout", "0.2"]
    command = [sys.executable, "-c", DRIVER, str(at_row), str(at_frame), what, *words]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.fixture(scope="module")
def site() -> Scenario:
    """Two mirrors that turn; the filter on, a transmitter that the calibration receiver does not hear in one frame."""
    shipped = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    return shipped.changed(
        heliostat=shipped.heliostat[:2],
        radio={"frame_samples": 20_000},
        motion={"filtered": True},
        simulation={
            "frame_count": N_FRAME,
            "frame_interval_s": 2.0,
            "dropped": [{"receiver": "cal0", "frame": 3, "first_sample": 100, "sample_count": 500}],
        },
    )


@pytest.fixture(scope="module")
def night(site: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory of closed files, one a frame."""
    path = tmp_path_factory.mktemp("live") / "night"
    rf.simulate(site, seed=3).record(path, pace=None)
    return path


@pytest.fixture(scope="module")
def plain(night: Path) -> bytes:
    """The result of the plain call on all of it."""
    output = night.parent / "plain.h5"
    rf.process(night, output)
    return output.read_bytes()


class _Recorder:
    """Puts the files of a finished recording into a directory one by one, as a recorder does."""

    def __init__(self, night: Path, to: Path) -> None:
        self.files, self.to = sorted(night.glob("*.h5")), to
        to.mkdir()
        self.n_put = 0

    def put(self, n: int = 1) -> None:
        for file in self.files[self.n_put : self.n_put + n]:
            shutil.copyfile(file, self.to / f".{file.name}.part")
            (self.to / f".{file.name}.part").rename(self.to / file.name)
        self.n_put += n


def test_a_followed_recording_gives_the_same_bytes_and_is_read_meanwhile(
    night: Path, plain: bytes, tmp_path: Path
) -> None:
    recorder, output = _Recorder(night, tmp_path / "night"), tmp_path / "result.h5"
    follower, seen, told = ResultFollower(output), [], []

    def on_frame(result: Result) -> None:
        found = follower.news()
        assert found is not None
        assert not output.exists()
        seen.append(found)
        told.extend(messages(result, number_from=len(seen) - 1))
        recorder.put()

    recorder.put(2)
    rf.process(Follow(recorder.to, idle_timeout_s=0.3, on_frame=on_frame), output)
    assert output.read_bytes() == plain
    assert not partial_of(output).exists()
    whole = rf.open_result(output)
    # each frame was there as soon as it was solved, and as the whole has it but for what only later frames tell
    starts = np.concatenate([each.frame_start_index for each in seen])
    np.testing.assert_array_equal(starts, whole.frame_start_index)
    live = np.concatenate([each.poses.normal_enu for each in seen])
    filtered = np.concatenate([each.filtered.normal_enu for each in seen if each.filtered is not None])
    same = np.arange(N_FRAME) != 3
    np.testing.assert_array_equal(live[same], whole.poses.normal_enu[same])
    assert whole.filtered is not None
    np.testing.assert_array_equal(filtered[:3], whole.filtered.normal_enu[:3])
    assert 0.0 < np.abs(live[3] - whole.poses.normal_enu[3]).max() < 0.1
    assert follower.news() is None
    assert follower.complete
    # who publishes frame by frame hands on each of them, with its number
    assert [(m["frame"], m["heliostat"]) for m in told] == [(f, h) for f in range(N_FRAME) for h in ("H01", "H02")]


def test_an_interrupted_one_goes_on_and_another_recording_is_refused(night: Path, plain: bytes, tmp_path: Path) -> None:
    recorder, output = _Recorder(night, tmp_path / "night"), tmp_path / "result.h5"
    frames: list[Result] = []

    def stop(result: Result) -> None:
        frames.append(result)
        if len(frames) == 3:
            raise KeyboardInterrupt

    recorder.put(4)
    with pytest.raises(KeyboardInterrupt):
        rf.process(Follow(recorder.to, on_frame=stop), output)
    assert not output.exists()
    assert len(rf.open_result(partial_of(output)).frame_start_index) == 3
    picture = tmp_path / "map.png"
    for words in ("info", f"plot -o {picture}"):  # as a finished one
        command, *options = words.split()
        done = CliRunner().invoke(app, [command, str(partial_of(output)), *options])
        assert done.exit_code == 0, done.output
    assert picture.stat().st_size > 10_000
    # the recorder has removed what it wrote first; what was measured of it stays
    whole = tmp_path / "whole"
    shutil.copytree(recorder.to, whole)
    other = tmp_path / "other"
    shutil.copytree(night, other)
    with h5py.File(other / "frame-000000.h5", "r+") as file:
        file["receivers/cal0/iq"][0] = (5, 5)
    (other.rename(tmp_path / "night2"), recorder.to.rename(tmp_path / "aside"))
    (tmp_path / "night2").rename(tmp_path / "night")
    with pytest.raises(RecordingError, match="another job"):
        rf.process(Follow(tmp_path / "night", idle_timeout_s=0.3), output)
    shutil.rmtree(tmp_path / "night")
    (tmp_path / "aside").rename(tmp_path / "night")
    recorder.put(2)
    (tmp_path / "night" / "frame-000001.h5").unlink()
    more: list[Result] = []
    rf.process(Follow(tmp_path / "night", idle_timeout_s=0.3, on_frame=more.append), output)
    assert len(more) == N_FRAME - 3
    found, wanted = rf.open_result(output), rf.open_result(night.parent / "plain.h5")
    np.testing.assert_array_equal(found.tones.phase_rad, wanted.tones.phase_rad)
    np.testing.assert_array_equal(found.poses.normal_enu, wanted.poses.normal_enu)


def test_killed_in_a_frame_and_while_it_keeps_one_it_goes_on_to_the_same_bytes(
    night: Path, plain: bytes, tmp_path: Path
) -> None:
    output = tmp_path / "result.h5"
    assert _follow(night, output, "killed", at_row=N_RECEIVER + 3).returncode == -signal.SIGKILL
    assert len(rf.open_result(partial_of(output)).frame_start_index) == 1
    # of the second run the third frame to be kept is the recording's fourth
    assert _follow(night, output, "killed", at_frame=2).returncode == -signal.SIGKILL
    assert len(rf.open_result(partial_of(output)).frame_start_index) == 3
    more: list[Result] = []
    rf.process(Follow(night, idle_timeout_s=0.2, on_frame=more.append), output)
    assert len(more) == N_FRAME - 3
    assert output.read_bytes() == plain
    assert [path.name for path in tmp_path.iterdir()] == ["result.h5"]


def test_a_full_disk_is_one_line_and_leaves_the_frames_before(night: Path, plain: bytes, tmp_path: Path) -> None:
    output = tmp_path / "result.h5"
    done = _follow(night, output, "disk_full", at_row=2 * N_RECEIVER + 1)
    assert done.returncode == 3
    told = [line for line in done.stderr.splitlines() if "poses solved" not in line]  # of the frames before
    assert len(told) == 1
    assert "cannot write: File too large" in told[0]
    assert len(rf.open_result(partial_of(output)).frame_start_index) == 2
    rf.process(Follow(night, idle_timeout_s=0.2), output)
    assert output.read_bytes() == plain


def test_a_recording_is_written_live_by_the_command(site: Scenario, night: Path, plain: bytes, tmp_path: Path) -> None:
    site.save(tmp_path / "site.toml")
    written = tmp_path / "night"
    words = ["simulate", str(tmp_path / "site.toml"), "-o", str(written), "--seed", "3", "--live", "--pace", "100"]
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert (told["recording"], told["frames"]) == (str(written), N_FRAME)
    assert told["bytes"] == sum(file.stat().st_size for file in written.iterdir())
    assert {file.name: file.read_bytes() for file in written.iterdir()} == {
        file.name: file.read_bytes() for file in night.iterdir()
    }
    rf.process(Follow(written, idle_timeout_s=0.2), tmp_path / "r.h5")
    assert (tmp_path / "r.h5").read_bytes() == plain
    again = CliRunner().invoke(app, words)
    assert (again.exit_code, "frame-000000.h5" in again.stderr) == (3, True)


def test_what_is_damaged_late_or_goes_back_is_left_out_and_told(
    night: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rfpose.recording.segments._SETTLED_S", 0.1)
    recorder = _Recorder(night, tmp_path / "night")
    recorder.put(N_FRAME)
    names = sorted(path.name for path in recorder.to.glob("*.h5"))
    damaged, late = recorder.to / names[1], recorder.to / names[-1]
    damaged.write_bytes(damaged.read_bytes()[:5000])
    with h5py.File(late, "r+") as file:
        del file["receivers/H02_r1"]
    (recorder.to / names[0]).rename(tmp_path / "first")
    shutil.copyfile(tmp_path / "first", recorder.to / names[0])
    shutil.copyfile(tmp_path / "first", recorder.to / "frame-000003b.h5")
    result = rf.process(Follow(recorder.to, idle_timeout_s=0.5, lateness_s=0.05), tmp_path / "r.h5")
    wanted = rf.open_result(night.parent / "plain.h5").frame_start_index
    np.testing.assert_array_equal(result.frame_start_index, np.delete(wanted, 1))
    row = result.scenario.receiver_ids.index("H02_r1")
    assert (result.tones.status[-1, row] == LineStatus.GAP).all()
    assert np.isnan(result.poses.normal_enu[-1, 1]).all()
    assert np.isfinite(result.poses.normal_enu[-1, 0]).all()
    for text in (names[1], "goes back in time", "H02_r1 lag by more than"):
        assert any(text in record.getMessage() for record in caplog.records), text


def test_a_result_that_is_replaced_is_told_to_who_follows(night: Path, plain: bytes, tmp_path: Path) -> None:
    output = tmp_path / "r.h5"
    output.write_bytes(plain)
    follower = ResultFollower(output)
    assert len(list(messages_as_they_come(follower))) == 2 * N_FRAME
    shorter = rf.process(rf.open_recording(night / "frame-000002.h5"))
    shorter.save(output, force=True)
    with pytest.raises(RecordingError, match="was replaced by another result while it was followed"):
        follower.news()


def test_who_follows_does_not_take_what_is_being_removed_for_a_new_beginning(
    night: Path, plain: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "r.h5"
    whole = rf.open_result(night.parent / "plain.h5")
    live = LiveResult(partial_of(output), whole.scenario, whole.settings, probe="", restart=False)
    for i in range(N_FRAME):
        live.append(_frame(whole, i))
    follower = ResultFollower(output)
    assert follower.news() is not None
    output.write_bytes(plain)
    unlink, seen = Path.unlink, []

    def unlink_and_look(path: Path, missing_ok: bool = False) -> None:
        unlink(path, missing_ok=missing_ok)
        seen.append((path.name, follower.news()))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", unlink_and_look)
        live.remove()
    assert [news for _, news in seen] == [None] * (N_FRAME + 1)
    assert seen[-1][0] == "key.json"  # on which entries depend
    assert follower.news() is None
    assert follower.complete


def _frame(result: Result, i: int) -> Result:
    columns = {
        path: values[i : i + 1] if column.dims[0] == "frame" else values
        for path, (column, values) in columns_of(result).items()
        if not path.startswith("truth/")
    }
    return result_of(result.scenario, result.settings, columns)


def test_digital_rf_is_followed_while_it_is_written(night: Path, site: Scenario, tmp_path: Path) -> None:
    pytest.importorskip("digital_rf", reason="needs the extra `digital-rf`")
    whole, grown = tmp_path / "whole", tmp_path / "grown"
    with rf.open_recording([night / f"frame-{k:06d}.h5" for k in range(3)]) as recording:
        recording.save(whole, format="digital-rf")
    (whole / "scenario.toml").write_text(site.to_toml())
    wanted = rf.process(whole)
    files = sorted(whole.glob("*/*/rf@*.h5"), key=lambda path: path.name)
    later = [file for file in files if file.name != files[0].name]  # all but the first of each channel
    shutil.copytree(whole, grown, ignore=lambda _, names: [n for n in names if n in {f.name for f in later}])
    opened = open_growing(grown)
    assert opened is not None
    before = {name: int(opened.blocks(name)[-1].sum()) for name in opened.receiver_ids}
    opened.forget(min(before.values()) - 1)
    assert max(len(opened.blocks(name)) for name in opened.receiver_ids) <= 2
    opened.close()

    def on_frame(_result: Result) -> None:
        for file in later:
            if not (grown / file.relative_to(whole)).exists():
                (grown / file.relative_to(whole)).parent.mkdir(exist_ok=True)
                shutil.copyfile(file, grown / file.relative_to(whole))

    found = rf.process(Follow(grown, idle_timeout_s=0.5, on_frame=on_frame), tmp_path / "r.h5")
    np.testing.assert_array_equal(found.frame_start_index, wanted.frame_start_index)
    np.testing.assert_array_equal(found.tones.status, wanted.tones.status)
    np.testing.assert_array_equal(found.tones.phase_rad, wanted.tones.phase_rad)


def test_wrong_calls_and_silence_are_one_line(night: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="needs `output`"):
        rf.process(Follow(night))
    with pytest.raises(InvalidInputError, match="`idle_timeout_s` must be greater than zero"):
        Follow(night, idle_timeout_s=0.0)
    two = CliRunner().invoke(app, ["process", str(night), str(night), "-o", "r.h5", "--follow"])
    assert (two.exit_code, "takes one RECORDING" in two.stderr) == (2, True)
    words = ["process", str(tmp_path / "nix"), "-o", str(tmp_path / "r.h5"), "--follow", "--idle-timeout", "0.2"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 3
    assert "nothing was recorded there within 0.2 s" in done.stderr
    assert "--idle-timeout SECONDS" in done.stderr
    assert done.stderr.splitlines()[0] == f"rfpose: note: {tmp_path / 'nix'}: not there yet; waiting for it"
    assert done.stderr.count("\n") == 2
    assert CliRunner().invoke(app, ["process", str(night), "-o", "r.h5", "--until", "0"]).exit_code == 2
    assert list(tmp_path.iterdir()) == []


def test_many_frames_become_few_files_that_read_the_same(
    night: Path, plain: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rfpose.pipeline.formats.live_result._MERGED", 3)
    counts = []
    output = tmp_path / "r.h5"

    def on_frame(_result: Result) -> None:
        counts.append(len(list(partial_of(output).glob("rows-*.npz"))))
        assert len(open_live(partial_of(output)).frame_start_index) == len(counts)

    monkeypatch.setattr(follow._Grid, "frames", _tidied(follow._Grid.frames))
    rf.process(Follow(night, idle_timeout_s=0.3, on_frame=on_frame), output)
    assert counts == [1, 2, 3, 2, 3, 4]
    assert output.read_bytes() == plain


def _tidied(frames: Callable[..., Iterator[int]]) -> Callable[..., Iterator[int]]:
    """As where the recorder leaves time between two frames."""

    def with_time_between(self: Any, between: Callable[[], None] = lambda: None) -> Iterator[int]:
        for start in frames(self, between):
            between()
            yield start

    return with_time_between
