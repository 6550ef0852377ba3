"""Kills a worker, the scheduler or the client of a distributed job at random moments, and counts what comes of it.

    python benchmarks/kill_cluster.py [--kills 50] [--seed 0]

In each round a scheduler and two workers begin a job of `rfpose process` or `rfpose track`, and SIGKILL goes to one of
the three sides at a moment of the time that an undisturbed job takes. All are processes of their own, forked from one
that has imported what they need. What is wrong: a job that neither ends right nor names what is missing, a worker's
death that ends the job, a file under the result's name that is not the whole result, and another result than the
undisturbed one when the same command is given again, without the cluster.
"""

from __future__ import annotations

import argparse
import asyncio
import collections
import contextlib
import dataclasses
import multiprocessing
import os
import random
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import distributed
from kill_jobs import Job, begin, clear, fork, jobs_in, left, often_kept, undisturbed

Process = multiprocessing.process.BaseProcess

SIDES = ("worker", "scheduler", "client")


def main() -> None:
    """Do the rounds and print the counts; exit status 1 if anything was wrong."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    often_kept()
    rng, counts = random.Random(asked.seed), collections.Counter[str]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "here"
        folder.mkdir()
        os.chdir(folder)
        jobs = jobs_in(Path(name))
        # of a method that learns each day is a task, which goes on from the one before
        days = dataclasses.replace(jobs["track"][0], words=(*jobs["track"][0].words, "--days", "4"))
        chosen = {"process": jobs["process"][0], "track": days}
        known, lasts = {}, {}
        for title, job in chosen.items():
            known[title] = undisturbed(folder, job).left
            for _ in range(2):  # the first loads kernels
                code, _, lasts[title] = _round(folder, job, None, 0.0)
                if code != 0 or left(folder) != known[title]:
                    raise SystemExit(f"{title}: the cluster ends with {code}, or makes another result")
                clear(folder)
            print(f"{title}: an undisturbed job takes {lasts[title]:.1f} s", flush=True)
        for k in range(asked.kills):
            title, side = ("process", "track")[k % 2], SIDES[k // 2 % 3]
            moment = rng.uniform(0.0, 1.0) * lasts[title]
            code, killed, _ = _round(folder, chosen[title], side, moment)
            outcome = _judge(folder, chosen[title], known[title], code, side if killed else "nobody")
            counts[f"{title}, {side if killed else 'over before the kill'}: {outcome}"] += 1
            print(f"{k + 1}: {title}, {side} after {moment:.1f} s: {outcome}", flush=True)
            clear(folder)
    for outcome, count in sorted(counts.items()):
        print(f"{count:4d}  {outcome}")
    sys.exit(any("WRONG" in outcome for outcome in counts))


def _round(folder: Path, job: Job, side: str | None, moment_s: float) -> tuple[int | None, bool, float]:
    """Run one job and kill one side of it; return its exit code, whether the kill met it, and how long it ran [s]."""
    with _cluster(2) as (address, sides):
        began = time.monotonic()
        client = begin(job, "--scheduler", address)
        killed = False
        if side is not None:
            client.join(moment_s)
            killed = client.is_alive()
            (client if side == "client" else sides[side]).kill()
        client.join(300)
        lasts = time.monotonic() - began
        if client.is_alive():
            client.kill()
            client.join()
            return None, killed, lasts
        return client.exitcode, killed, lasts


@contextlib.contextmanager
def _cluster(n_worker: int) -> Iterator[tuple[str, dict[str, Process]]]:
    """Yield the address of a scheduler with workers, and its process and one worker's."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    started = [fork.Process(target=_serve, args=(_scheduler, port))]
    started += [fork.Process(target=_serve, args=(_worker, address)) for _ in range(n_worker)]
    try:
        for process in started:
            process.start()
        yield address, {"scheduler": started[0], "worker": started[1]}
    finally:
        for process in started:
            process.kill()
            process.join()


def _serve(server: Callable[[Any], Coroutine[Any, Any, None]], at: Any) -> None:
    with open(os.devnull, "w") as silence:
        os.dup2(silence.fileno(), 2)
        asyncio.run(server(at))


async def _scheduler(port: int) -> None:
    async with distributed.Scheduler(host="127.0.0.1", port=port, dashboard=False) as scheduler:
        await scheduler.finished()


async def _worker(address: str) -> None:
    place = tempfile.gettempdir()
    async with distributed.Worker(address, host="127.0.0.1", nthreads=1, local_directory=place) as worker:
        await worker.finished()


def _judge(folder: Path, job: Job, known: dict[str, str], code: int | None, killed: str) -> str:
    there = (folder / job.output).exists()
    if there and any(left(folder).get(name) != held for name, held in known.items()):
        return "WRONG: the file is not the undisturbed one"
    if code == 0 and not there:
        return "WRONG: says that all is done, and no file is there"
    if code is None:
        return "WRONG: hangs"
    if code == 3 and killed == "worker":
        return "WRONG: gave up"
    if code not in (0, 3, -9):
        return f"WRONG: exit code {code}"
    if code == 0:
        return "ended right"
    kept = left(folder).keys() - known.keys()
    again = begin(job)
    again.join()
    if again.exitcode not in ((0, 3) if there else (0,)) or left(folder) != known:
        return f"WRONG: resumed, it ends with {again.exitcode}, or other bytes"
    return f"resumed to the same bytes ({'with' if kept else 'without'} work of before)"


if __name__ == "__main__":
    main()
