"""Kills simulate, process, convert and track by SIGKILL at random moments, and looks at what is left under the names.

    python benchmarks/kill_jobs.py [--kills 100] [--seed 0] [--only process track …]

Every job is the command line in a process of its own, forked from one that has imported rfpose, so that its life is
work and not imports. Half of the moments lie anywhere in the life of an undisturbed job, half between the first file
that it begins to write and a little after its end. What is wrong: something under an output's name that is not the
whole output, a same command given again that does not end with the bytes of the undisturbed job, and leftovers then.
"""

from __future__ import annotations

import argparse
import collections
import functools
import hashlib
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import rfpose as rf
import rfpose.cli
import rfpose.cli._app
import rfpose.cli.convert
import rfpose.cli.process
import rfpose.cli.simulate
import rfpose.cli.track
import rfpose.feedback.tracking
import rfpose.pipeline.formats.track_file
import rfpose.pipeline.measure as measure
import rfpose.pipeline.simulate
import rfpose.pipeline.track as tracking
from rfpose.pipeline.formats.checkpoint import Checkpoint

fork = multiprocessing.get_context("fork")


@dataclass(frozen=True, kw_only=True)
class Job:
    """A command but for ``-o``, and the name that it gives there."""

    words: tuple[str, ...]
    output: str = "out.h5"


@dataclass(frozen=True, kw_only=True)
class Undisturbed:
    """What a job leaves, how long it lasts, and how long before its end it begins to write [s]."""

    left: dict[str, str]
    lasts_s: float
    writes_s: float


def main() -> None:
    """Kill, judge, print the counts; exit status 1 if anything was wrong."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=100, help="of each command; of convert a third to each format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+")
    asked = parser.parse_args()
    often_kept()
    rng, wrong = random.Random(asked.seed), False
    with tempfile.TemporaryDirectory() as name:
        for title, jobs in jobs_in(Path(name)).items():
            if asked.only is None or title in asked.only:
                for i, job in enumerate(jobs):
                    kills = asked.kills * (i + 1) // len(jobs) - asked.kills * i // len(jobs)
                    wrong |= _kill_often(Path(name) / f"{title}-{i}", job, kills, rng)
    sys.exit(wrong)


def often_kept() -> None:
    """Let jobs that are forked from here keep unfinished work often, so that kills meet it."""
    measure.JOURNAL_SAMPLES = 100_000
    tracking.Checkpoint = functools.partial(_often, Checkpoint)  # type: ignore[misc]


def _often(kind: Callable[..., Checkpoint], *arguments: object, **settings: object) -> Checkpoint:
    return kind(*arguments, **settings | {"interval_s": 0.0})


def jobs_in(folder: Path) -> dict[str, list[Job]]:
    """Return jobs by command; what they read is made in a folder."""
    site, toml = rf.load_scenario(rf.shipped_scenario("table2_100m.toml")), str(folder / "site.toml")
    changes = {"frame_count": 40, "frame_interval_s": 0.1, "sun_azimuth_deg": 170.0}
    site = site.changed(heliostat=site.heliostat[:1], radio={"frame_samples": 20_000}, simulation=changes)
    Path(toml).write_text(site.to_toml())
    day, hours = rf.load_scenario(rf.shipped_scenario("tracking_100m.toml")), {"first_hour": 9.0, "last_hour": 10.0}
    (folder / "day.toml").write_text(day.changed(tracking=hours).to_toml())
    recording = str(folder / "rec.h5")
    # by a process of its own: what has started threads cannot be forked
    begin(Job(words=("simulate", toml), output=recording)).join()
    convert = ("convert", recording)
    return {
        "simulate": [Job(words=("simulate", toml, "--seed", "3"))],
        "process": [Job(words=("process", recording))],
        "convert": [
            Job(words=(*convert, "--compress", "bitshuffle-zstd")),
            Job(words=(*convert, "--to", "sigmf"), output="out"),
            Job(words=(*convert, "--to", "digital-rf"), output="out"),
        ],
        "track": [Job(words=("track", str(folder / "day.toml"), "--methods", "radio-both", "--heliostats", "3"))],
    }


def _kill_often(folder: Path, job: Job, kills: int, rng: random.Random) -> bool:
    folder.mkdir()
    os.chdir(folder)
    undisturbed(folder, job)  # compiles
    known = undisturbed(folder, job)
    shown = " ".join(Path(word).name for word in (*job.words, "-o", job.output))
    print(f"{shown}: {known.lasts_s:.1f} s, and writes in the last {known.writes_s:.1f} s of them", flush=True)
    counts: collections.Counter[str] = collections.Counter()
    for k in range(kills):
        process = begin(job)
        if k % 2:
            while process.is_alive() and not _began_to_write(folder):
                time.sleep(1e-3)
            time.sleep(rng.uniform(0.0, 1.05) * known.writes_s)
        else:
            time.sleep(rng.uniform(0.0, 1.05) * known.lasts_s)
        process.kill()
        process.join()
        outcome = _judge(folder, job, known, process.exitcode)
        counts[outcome] += 1
        if "WRONG" in outcome:
            print(f"  {k}: {outcome}", flush=True)
    for outcome, count in sorted(counts.items()):
        print(f"{count:6d}  {outcome}", flush=True)
    os.chdir("/")
    shutil.rmtree(folder)
    return any("WRONG" in outcome for outcome in counts)


def begin(job: Job, *more: str) -> multiprocessing.process.BaseProcess:
    """Start the command, with more options."""
    process = fork.Process(target=_run, args=((*job.words, "-o", job.output, *more),))
    process.start()
    return process


def _run(words: tuple[str, ...]) -> None:
    silence = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (1, 2):
        os.dup2(silence, descriptor)
    sys.argv = ["rfpose", *words]
    rfpose.cli.main()


def _began_to_write(folder: Path) -> bool:
    return any(not name.endswith(".lock") for name in os.listdir(folder))


def undisturbed(folder: Path, job: Job) -> Undisturbed:
    """Run a job to its end in an empty folder, and empty that."""
    began, process, writes = time.monotonic(), begin(job), None
    while process.is_alive():
        if writes is None and _began_to_write(folder):
            writes = time.monotonic()
        time.sleep(1e-3)
    ended = time.monotonic()
    if process.exitcode:
        raise SystemExit(f"rfpose {' '.join(job.words)} ends with {process.exitcode}")
    found = left(folder)
    clear(folder)
    return Undisturbed(left=found, lasts_s=ended - began, writes_s=ended - (writes or ended))


def left(folder: Path) -> dict[str, str]:
    """Return a digest of each file but locks; of Digital RF, in which times of writing stand, of the samples."""
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    found = {name: _digest(path.read_bytes()) for name, path in files.items() if not name.endswith(".lock")}
    if not any(name.endswith("drf_properties.h5") for name in found if name.startswith("out/")):
        return found
    found = {name: "" if name.endswith(".h5") else held for name, held in found.items()}
    with rf.open_recording(folder / "out") as recording:
        for receiver in recording.receiver_ids:
            for start, length in recording.blocks(receiver):
                found[f"{receiver} {start}"] = _digest(recording.read(receiver, start, length).tobytes())
    return found


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def clear(folder: Path) -> None:
    """Remove what is in a folder."""
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def _judge(folder: Path, job: Job, known: Undisturbed, code: int | None) -> str:
    """Return what was left, and what the same command makes of that."""
    try:
        there = (folder / job.output).exists()
        found = left(folder)
        if there and any(found.get(name) != held for name, held in known.left.items()):
            return "WRONG: what has the name is not what the undisturbed job makes"
        if code == 0 and not there:
            return "WRONG: it ended well, and nothing has the name"
        beside = found.keys() - known.left.keys()
        again = begin(job)
        again.join()
        # what is whole is no more to be made, which the same command may say
        if again.exitcode not in ((0, 3) if there else (0,)):
            return f"WRONG: the same command ends with {again.exitcode}"
        if left(folder) != known.left:
            return f"WRONG: the same command leaves something else: {sorted(left(folder))[:9]}"
        state = "over before the kill" if code == 0 else "killed, whole" if there else "killed, nothing"
        kept = any(not name.split("/")[0].endswith(".part") for name in beside)
        return f"{state} under the name{', unfinished work beside it' if kept else ''}; again: the same"
    finally:
        clear(folder)


if __name__ == "__main__":
    main()
