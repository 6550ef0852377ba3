"""Work shared with other processes: the same bytes whoever does it, and what becomes of it when they fail."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from rfpose import engine
from rfpose.engine import Engine, team_here, team_of
from rfpose.errors import ClusterError, InvalidInputError, RecordingError, install_remedy
from rfpose.pipeline import measure
from rfpose.pipeline.formats.journal import Journal
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.recording import frame_starts
from rfpose.scenario import load_scenario

distributed = pytest.importorskip("distributed", reason="needs the extra `distributed`")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module", autouse=True)
def threads_of_blas() -> Iterator[None]:
    """Here two, as on a user's machine, whatever the tests run with; the workers keep to one."""
    with threadpool_limits(2, user_api="blas"):
        yield


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    shipped, still = (
        load_scenario(ROOT / "data" / "table2_100m.toml"),
        {"frame_count": 6, "frame_interval_s": 1.0, "sun_azimuth_deg": 170.0},
    )
    site = folder / "site.toml"
    site.write_text(
        shipped.changed(heliostat=shipped.heliostat[:2], radio={"frame_samples": 8000}, simulation=still).to_toml()
    )
    simulate(site, seed=1).save(folder / "rec.h5")
    return folder / "rec.h5"


@pytest.fixture(scope="module")
def alone(recording: Path) -> bytes:
    """What this process makes of it by itself."""
    result = recording.with_name("alone.h5")
    process(recording, result)
    return result.read_bytes()


@pytest.fixture(scope="module")
def cluster() -> Iterator[distributed.LocalCluster]:
    """Two workers in processes of their own."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
    ) as started:
        yield started


@pytest.fixture
def small_entries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "JOURNAL_SAMPLES", 3 * 8000)


def _done(by: Engine, job: Callable[[], Any]) -> Any:
    with by.used():
        return job()


def _worker_pids(address: str) -> list[int]:
    with distributed.Client(address, set_as_default=False) as client:
        return list(client.run(os.getpid).values())


@pytest.mark.usefixtures("small_entries")
def test_two_workers_give_the_bytes_of_one_process(
    recording: Path, alone: bytes, cluster: distributed.LocalCluster, tmp_path: Path
) -> None:
    told: list[tuple[int, int]] = []
    by = Engine(scheduler=cluster.scheduler_address)
    with by.used():
        process(recording, tmp_path / "r.h5", on_progress=lambda *now: told.append(now))
    assert (tmp_path / "r.h5").read_bytes() == alone
    assert told == sorted(told)
    assert told[-1] == (42, 42)
    assert len(told) > 4
    assert [path.name for path in tmp_path.iterdir()] == ["r.h5"]


@pytest.mark.usefixtures("small_entries")
def test_a_killed_worker_costs_its_tasks_and_not_the_job(
    recording: Path, alone: bytes, cluster: distributed.LocalCluster, tmp_path: Path
) -> None:
    pids = _worker_pids(cluster.scheduler_address)

    def on_progress(done: int, _total: int) -> None:
        if done > 10 and len(pids) == 2:
            os.kill(pids.pop(), signal.SIGKILL)

    by = Engine(scheduler=cluster.scheduler_address)
    with by.used():
        process(recording, tmp_path / "r.h5", on_progress=on_progress)
    assert len(pids) == 1
    assert (tmp_path / "r.h5").read_bytes() == alone


def test_what_one_process_began_others_finish(
    recording: Path,
    alone: bytes,
    cluster: distributed.LocalCluster,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class StopError(Exception):
        pass

    def stop(done: int, _total: int) -> None:
        if done > 10:
            raise StopError

    monkeypatch.setattr(measure, "JOURNAL_SAMPLES", 3 * 8000)
    with pytest.raises(StopError):
        process(recording, tmp_path / "r.h5", on_progress=stop)
    begun: list[int] = []
    by = Engine(scheduler=cluster.scheduler_address)
    with by.used():
        process(recording, tmp_path / "r.h5", on_progress=lambda done, _total: begun.append(done))
    assert begun[0] > 9
    assert (tmp_path / "r.h5").read_bytes() == alone


def test_a_worker_that_cannot_see_the_recording_is_named(
    recording: Path, cluster: distributed.LocalCluster, tmp_path: Path
) -> None:
    """Whoever starts the job sees it; where the worker looks there is nothing, or something else."""
    seen = measure.open_recording(recording)
    site = seen.scenario
    assert site is not None
    other = simulate(site, seed=2)
    other.save(tmp_path / "other.h5")
    starts = np.array([seen.blocks(seen.receiver_ids[0])[0, 0]])
    by = Engine(scheduler=cluster.scheduler_address)
    for path, why in ((tmp_path / "absent.h5", "no such file"), (tmp_path / "other.h5", "is another recording here")):
        there = measure.OtherProcesses(paths=(path,))
        with by.used(), pytest.raises(RecordingError, match=rf"worker tcp://[\d.:]+: {path}: {why}"):
            measure.measure_tones(seen, site, starts, estimator="hilbert", elsewhere=there)
    seen.close()


def test_a_worker_of_another_version_is_refused(
    recording: Path, cluster: distributed.LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = engine.__version__
    monkeypatch.setattr(engine, "__version__", "9.8.7")
    both = rf"worker tcp://[\d.:]+: its rfpose is {theirs}, and the one that gives the tasks is 9\.8\.7"
    with pytest.raises(ClusterError, match=both), Engine(scheduler=cluster.scheduler_address).used():
        process(recording, tmp_path / "r.h5")
    assert not (tmp_path / "r.h5").exists()
    # one that joins when the others were looked at is refused with its first task
    monkeypatch.setattr(engine, "_check_versions", lambda _client: None)
    with Engine(scheduler=cluster.scheduler_address).used(), team_of() as team, pytest.raises(ClusterError, match=both):
        list(team.map(max, [1, 2], 3))


def test_tasks_that_kill_their_workers_are_given_up(cluster: distributed.LocalCluster) -> None:
    with (
        Engine(scheduler=cluster.scheduler_address).used(),
        team_of() as team,
        pytest.raises(ClusterError, match="4 workers died on the same task, the last at tcp://"),
    ):
        list(team.map(lambda _shared, _item: os._exit(1), [0], 0))


def test_a_full_disk_of_a_worker_harms_nothing(
    recording: Path, alone: bytes, cluster: distributed.LocalCluster, tmp_path: Path
) -> None:
    """What workers find is written where the job was started."""

    def let_files_grow_to(limit: int) -> None:
        import resource

        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))

    with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
        client.run(let_files_grow_to, 0)
        try:
            _done(Engine(scheduler=cluster.scheduler_address), lambda: process(recording, tmp_path / "r.h5"))
        finally:
            client.run(let_files_grow_to, -1)
    assert (tmp_path / "r.h5").read_bytes() == alone


def test_what_tasks_raise_reaches_the_caller(cluster: distributed.LocalCluster) -> None:
    for by in (Engine(), Engine(scheduler=cluster.scheduler_address)):
        with by.used(), team_of() as team, pytest.raises(ZeroDivisionError):
            list(team.map(divmod, [0], 1))


def test_results_are_told_by_their_item(cluster: distributed.LocalCluster) -> None:
    by = Engine(scheduler=cluster.scheduler_address)
    for used, team_for in ((Engine(), team_of), (by, team_of), (by, team_here)):
        with used.used(), team_for() as team:
            assert dict(team.map(divmod, [2, 3, 5], 7)) == {0: (3, 1), 1: (2, 1), 2: (1, 2)}


def test_items_that_are_appended_meanwhile_are_done_and_what_was_found_leaves_workers(
    cluster: distributed.LocalCluster,
) -> None:
    by = Engine(scheduler=cluster.scheduler_address)
    for used, team_for in ((Engine(), team_of), (by, team_of), (by, team_here)):
        items, found = [3, 40], {}
        with used.used(), team_for() as team:
            for i, (_, rest) in team.map(divmod, items, 1000):
                found[items[i]] = rest
                if items[i] < 9:
                    items.append(items[i] + 1)
                if len(found) == 8 and team_for is team_of and used is by:
                    assert _soon(lambda: _n_held(cluster) <= 1)
        assert found == {item: 1000 % item for item in (40, *range(3, 10))}


def _n_held(cluster: distributed.LocalCluster) -> int:
    """Return how many results workers hold."""
    with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
        return len(client.who_has())


def _soon(holds: Callable[[], bool]) -> bool:
    """Tell whether something holds, or soon does."""
    for _ in range(50):
        if holds():
            return True
        time.sleep(0.1)
    return False


def test_entries_keep_the_clocks_of_their_ends(
    recording: Path, cluster: distributed.LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some receivers are measured an entry ahead of others."""
    monkeypatch.setattr(measure, "JOURNAL_SAMPLES", 8000)
    opened = measure.open_recording(recording)
    site = opened.scenario
    assert site is not None
    starts = frame_starts(opened, site.radio.frame_samples)
    journal = Journal(tmp_path / "kept", {}, restart=False)
    with Engine(scheduler=cluster.scheduler_address).used():
        tones = measure.measure_tones(
            opened,
            site,
            starts,
            estimator="hilbert",
            journal=journal,
            elsewhere=measure.OtherProcesses(paths=(recording,)),
        )
    opened.close()
    entries = journal.read()
    assert [(first, end) for first, end, _ in entries] == [(row, min(row + 8, 42)) for row in range(0, 42, 8)]
    n, clocks = len(site.receiver_ids), tones.clock_ppm.ravel()
    for _, end, entry in entries:
        last = [max((row for row in range(i, end, n)), default=None) for i in range(n)]
        wanted = [np.nan if row is None else clocks[row] for row in last]
        np.testing.assert_array_equal(entry["clock_state_ppm"], wanted)


def test_nobody_there_is_told_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "_CONNECT_S", 0.3)
    why, nobody = r"tcp://127\.0\.0\.1:9: no Dask scheduler answers.*`dask scheduler`", "tcp://127.0.0.1:9"
    with pytest.raises(ClusterError, match=why), Engine(scheduler=nobody).used(), team_of():
        pass
    with pytest.raises(ClusterError, match="no Dask scheduler answers"), Engine(scheduler="nonsense").used(), team_of():
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ClusterError, match=r"dask\.distributed; ") as raised, Engine(workers=2).used(), team_of():
        pass
    assert install_remedy("distributed") in str(raised.value)


def test_placements_and_budgets_are_those_of_one_process(cluster: distributed.LocalCluster) -> None:
    import rfpose

    site = load_scenario(ROOT / "data" / "table2_100m.toml")
    few = site.changed(heliostat=site.heliostat[:3])
    by = Engine(scheduler=cluster.scheduler_address)
    placed = [_done(who, lambda: rfpose.optimise(few, starts=3)) for who in (Engine(), by)]
    assert placed[0].scenario == placed[1].scenario
    known = few.changed(heliostat={"pivot_sigma_m": 0.005, "receiver_delay_sigma_s": 0.0})
    for pose in ("rigid", "site"):
        job = partial(rfpose.budget, known, n_draw=3, pose=pose, seed=2)
        budgets = [_done(who, job) for who in (Engine(), by)]
        assert budgets[0].as_dict() == budgets[1].as_dict()


def test_calibrations_are_those_of_one_process_and_a_folder_unseen_is_named(
    cluster: distributed.LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import rfpose
    from rfpose.pipeline.samples.paint import write_paint

    folder = write_paint(tmp_path / "paint", {"AA11": (0.0, 80.0, 0.0), "AB12": (30.0, 90.0, 0.0)})
    (folder / "AB12" / "AB12_properties.json").write_text("{")
    by = Engine(scheduler=cluster.scheduler_address)
    found = [_done(who, lambda: rfpose.calibrate(folder)) for who in (Engine(), by)]
    assert [report.as_dict() for report in found[0]] == [report.as_dict() for report in found[1]]
    assert list(found[1].skipped) == ["AB12"]
    # one-sided: the workers look under a name that only this process knows how to resolve
    monkeypatch.setattr(Path, "absolute", lambda path: Path("/elsewhere") / path.name)
    with pytest.raises(ClusterError, match=r"worker tcp://[\d.:]+: /elsewhere/paint: is no directory here"):
        _done(by, lambda: rfpose.calibrate(folder))


def test_a_track_is_that_of_one_process_whoever_began_it(
    cluster: distributed.LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rfpose.pipeline.track import track

    class StopError(Exception):
        pass

    windy = {"record": str(tmp_path / "wind.csv")}
    # a minute between the lines: wind that is unknown for longer is steady
    lines = [f"{1_773_980_000 + 60 * k},{5 + k % 3}" for k in range(2200)]
    (tmp_path / "wind.csv").write_text("\n".join(["unix_s,speed_mps", *lines]))
    hours = {"first_hour": 9.0, "last_hour": 9.3, "days": 2, "wind": windy, "field_control": None, "event": None}
    site = load_scenario(ROOT / "data" / "tracking_100m.toml").changed(tracking=hours)
    told: list[tuple[int, int]] = []

    def run(name: str, by: Engine, stop_after: int | None = None) -> bytes | None:
        def on_progress(*now: int) -> None:
            told.append(now)
            if len(told) == stop_after:
                raise StopError

        told.clear()
        methods = ("open-loop", "encoder")
        job = partial(track, site, tmp_path / name, methods=methods, heliostats=2, checkpoint_s=0.0)
        try:
            _done(by, partial(job, on_progress=on_progress))
        except StopError:
            assert not (tmp_path / name).exists()
            return None
        return (tmp_path / name).read_bytes()

    here, there = Engine(), Engine(scheduler=cluster.scheduler_address)
    wanted = run("alone.h5", here)
    # the second day is begun here, and begins again there
    run("begun.h5", here, stop_after=3)
    assert run("begun.h5", there) == wanted
    assert told[-1] == (8, 8)
    assert told[0][0] > 4
    assert {path.name for path in tmp_path.iterdir()} == {"wind.csv", "alone.h5", "begun.h5"}
    monkeypatch.setattr(Path, "absolute", lambda path: Path("/elsewhere") / path.name)
    with pytest.raises(InvalidInputError, match=r"worker tcp://[\d.:]+: /elsewhere/wind.csv: cannot read"):
        run("unseen.h5", there)


def test_a_method_that_learns_is_kept_day_by_day_whoever_dies(
    cluster: distributed.LocalCluster, tmp_path: Path
) -> None:
    from rfpose.pipeline.track import track

    hours = {"first_hour": 9.0, "last_hour": 9.2, "days": 4, "field_control": None, "event": None}
    site = load_scenario(ROOT / "data" / "tracking_100m.toml").changed(tracking=hours)
    (tmp_path / "site.toml").write_text(site.to_toml())
    job = partial(track, tmp_path / "site.toml", methods=("radio-both", "encoder"), heliostats=2)
    there = Engine(scheduler=cluster.scheduler_address)
    _done(Engine(), partial(job, tmp_path / "alone.h5"))
    _done(there, partial(job, tmp_path / "r.h5"))
    wanted = (tmp_path / "alone.h5").read_bytes()
    assert (tmp_path / "r.h5").read_bytes() == wanted
    # the client is killed when the second day of it is there, and a worker in what follows
    code = f"""
import os, signal
from rfpose.engine import Engine
from rfpose.pipeline import track
plain = track.Checkpoint.write
def write(self, state, **how):
    plain(self, state, **how)
    if state["radio-both/over"].sum() == 2:
        os.kill(os.getpid(), signal.SIGKILL)
track.Checkpoint.write = write
with Engine(scheduler={cluster.scheduler_address!r}).used():
    track.track("site.toml", "k.h5", methods=("radio-both", "encoder"), heliostats=2, checkpoint_s=0.0)
"""
    killed = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert not (tmp_path / "k.h5").exists()
    with np.load(tmp_path / ".k.h5.state") as state:
        assert state["radio-both/over"].tolist() == [True, True, False, False]
    told: list[int] = []
    pids = _worker_pids(cluster.scheduler_address)

    def on_progress(done: int, _total: int) -> None:
        told.append(done)
        if pids:
            os.kill(pids.pop(), signal.SIGKILL)
            pids.clear()

    _done(there, partial(job, tmp_path / "k.h5", on_progress=on_progress))
    assert (tmp_path / "k.h5").read_bytes() == wanted
    assert told[0] > 2  # stretches: a day has one, and two of each method were kept at least
    assert told[-1] == 8


def test_wrong_choices_are_refused(recording: Path) -> None:
    with pytest.raises(InvalidInputError, match="give one of the two"):
        Engine(scheduler="tcp://host:8786", workers=2)
    with pytest.raises(InvalidInputError, match="`workers` must be at least one, got 0"):
        Engine(workers=0)
    with (
        measure.open_recording(recording) as opened,
        pytest.raises(InvalidInputError, match="must be paths"),
        Engine(workers=2).used(),
    ):
        process(opened)


# -- whole processes -----------------------------------------------------------------------------------------

# Runs the command line with small entries; when five rows are done a process is sent a signal, and once more later.
DRIVER = """
import os, signal, sys, threading
import psutil
import rfpose.pipeline.measure as measure
from rfpose.cli import main
name, pid = sys.argv[1], int(sys.argv[2])
del sys.argv[1:3]
measure.JOURNAL_SAMPLES = 3 * 8000
plain, left = measure.measure_tones, [1]
def send():
    os.kill(pid or os.getpid(), getattr(signal, name))
def watched(*arguments, on_progress=None, **settings):
    def told(done, total):
        on_progress(done, total)
        if done >= 5 and left:
            left.clear()
            print("started:", *(child.pid for child in psutil.Process().children(True)), file=sys.stderr, flush=True)
            if not pid:
                threading.Timer(0.2, send).start()
            send()
    return plain(*arguments, on_progress=told, **settings)
measure.measure_tones = watched
main()
"""


def _run(recording: Path, result: Path, *words: str, name: str, pid: int = 0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", DRIVER, name, str(pid), "process", str(recording), "-o", str(result), *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def _ends(pid: int) -> bool:
    """Tell whether a process is gone, or is soon."""
    import psutil

    for _ in range(150):
        if not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
            return True
        time.sleep(0.1)
    return False


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGKILL", -signal.SIGKILL)])
def test_interrupted_twice_or_killed_leaves_nothing_running(
    recording: Path, alone: bytes, tmp_path: Path, name: str, code: int
) -> None:
    result = tmp_path / "result.h5"
    stopped = _run(recording, result, "--workers", "2", name=name)
    assert stopped.returncode == code, stopped.stderr
    lines = stopped.stderr.strip().splitlines()
    started = next(line for line in lines if line.startswith("started:")).split()[1:]
    assert len(started) > 1
    assert all(_ends(int(pid)) for pid in started)
    if name == "SIGINT":
        assert lines[-1] == "rfpose: interrupted; the same command resumes where it stopped"
    assert not result.exists()
    process(recording, result)
    assert result.read_bytes() == alone


@pytest.mark.skipif(not (ROOT / ".venv/bin/python").exists(), reason="scripts/cluster runs what scripts/setup made")
def test_a_scheduler_that_dies_is_named_and_nothing_is_lost(recording: Path, alone: bytes, tmp_path: Path) -> None:
    import psutil

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    script = subprocess.Popen(
        [ROOT / "scripts/cluster", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        address = f"tcp://127.0.0.1:{port}"
        with distributed.Client(address, set_as_default=False, timeout=60) as client:
            client.wait_for_workers(2, timeout=60)
        family = psutil.Process(script.pid).children(recursive=True)
        scheduler = next(each for each in family if "scheduler" in each.cmdline())
        result = tmp_path / "result.h5"
        stopped = _run(recording, result, "--scheduler", address, name="SIGKILL", pid=scheduler.pid)
        assert stopped.returncode == 3, stopped.stderr
        assert f"rfpose: {address}: the scheduler does not answer any more" in stopped.stderr
        assert not result.exists()
        assert all(_ends(each.pid) for each in family)
    finally:
        script.terminate()
        script.wait()
    process(recording, result)
    assert result.read_bytes() == alone


@pytest.mark.parametrize("address", ["nonsense", "tcp://host", "carrier-pigeon://host:1"])
def test_what_is_no_address_leaves_no_client_behind(recording, tmp_path, address):
    """One that is begun and given up goes on in a thread of its own, and complains at the end of the process."""
    before = set(threading.enumerate())
    with Engine(scheduler=address).used(), pytest.raises(ClusterError, match=f"{address}: no Dask scheduler answers"):
        process(recording, tmp_path / "r.h5")
    assert {thread.name for thread in set(threading.enumerate()) - before} == set()
