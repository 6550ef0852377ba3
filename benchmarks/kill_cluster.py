"""Kills a worker, the scheduler or the client of a distributed job at random moments, and counts what comes of it.

    python benchmarks/kill_cluster.py [--kills 10] [--seed 0]

Each round starts `scripts/cluster` anew, begins `rfpose process --scheduler`, and sends SIGKILL to one of the three
after a random part of the time that an undisturbed job takes. What is wrong: a job that neither ends right nor names
what is missing, a file under the result's name that is not the whole result, and another result than the undisturbed
one when the same command is given again, without the cluster.
"""

from __future__ import annotations

import argparse
import collections
import random
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import distributed
import psutil

import rfpose as rf

ROOT = Path(__file__).resolve().parents[1]
VICTIMS = ("worker", "scheduler", "client")

# Short entries, so that what was measured before the kill counts.
CLIENT = """
import sys, rfpose.pipeline.measure as measure
from rfpose.cli import main
measure.JOURNAL_SAMPLES = 200_000
main()
"""


def main() -> None:
    """Do the rounds and print the counts; exit status 1 if anything was wrong."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    rng = random.Random(asked.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
        site = site.changed(
            heliostat=site.heliostat[:3], radio={"frame_samples": 20_000}, simulation={"frame_count": 40}
        )
        rf.simulate(site, seed=1).save(folder / "rec.h5")
        rf.process(folder / "rec.h5", folder / "alone.h5")
        wanted = (folder / "alone.h5").read_bytes()
        lasts = min(_round(folder, wanted, None, 0.0)[1] for _ in range(2))  # the first compiles
        print(f"an undisturbed job with its start: {lasts:.1f} s", flush=True)
        counts: collections.Counter[str] = collections.Counter()
        for k in range(asked.kills):
            victim = VICTIMS[k % len(VICTIMS)]
            moment = rng.uniform(0.1, 1.0) * lasts
            outcome, _ = _round(folder, wanted, victim, moment)
            counts[f"{victim}: {outcome}"] += 1
            print(f"{k + 1}: {victim} after {moment:.1f} s: {outcome}", flush=True)
    for outcome, count in sorted(counts.items()):
        print(f"{count:4d}  {outcome}")
    sys.exit(any("WRONG" in outcome for outcome in counts))


def _round(folder: Path, wanted: bytes, victim: str | None, moment_s: float) -> tuple[str, float]:
    """Run one job, kill somebody, finish what is left; return what came of it and how long the job ran [s]."""
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
            workers = list(client.run(lambda: __import__("os").getpid()).values())
        scheduler = next(p for p in psutil.Process(script.pid).children() if "scheduler" in p.cmdline())
        command = [sys.executable, "-c", CLIENT, "process", folder / "rec.h5", "-o", folder / "out.h5"]
        began = time.monotonic()
        job = subprocess.Popen([*command, "--scheduler", address], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        if victim is not None:
            time.sleep(moment_s)
            if job.poll() is None:
                psutil.Process({"worker": workers[0], "scheduler": scheduler.pid, "client": job.pid}[victim]).kill()
            else:
                victim = None
        told = job.communicate(timeout=300)[1].decode()
        lasts = time.monotonic() - began
    finally:
        script.terminate()
        script.wait()
    outcome = _judge(folder, wanted, job.returncode, told, victim)
    return outcome if victim is not None else f"over before the kill, {outcome}", lasts


def _judge(folder: Path, wanted: bytes, code: int, told: str, victim: str | None) -> str:
    result = folder / "out.h5"
    whole = result.exists() and result.read_bytes() == wanted
    if result.exists() and not whole:
        return "WRONG: the file is not the undisturbed one"
    if code == 0 and not whole:
        return "WRONG: says that all is done, and no file is there"
    if code == 3 and victim == "worker":
        return f"WRONG: gave up: {told.strip().splitlines()[-1]}"
    if code not in (0, 3, -9):
        return f"WRONG: exit code {code}"
    outcome = "ended right" if code == 0 else "resumed to the same bytes"
    if not whole:
        kept = len(list(Path(f"{result}.partial").glob("rows-*")))
        rf.process(folder / "rec.h5", result)
        if result.read_bytes() != wanted:
            return "WRONG: what was resumed is not the undisturbed one"
        outcome += f" ({'with' if kept else 'without'} work of before)"
    result.unlink()
    left = [path.name for path in folder.iterdir() if path.name not in ("rec.h5", "alone.h5", ".out.h5.lock")]
    return f"WRONG: left {left}" if left else outcome


if __name__ == "__main__":
    main()
