"""Tone measurement by two workers, by one, and by this process, one core each, in turn: ratios of one run.

    python benchmarks/bench_cluster.py [--frames 20] [--rounds 5]

The recording is measured once before the clock starts, so that it comes from memory and kernels are compiled. Workers
stay between rounds. Ratios are of medians. Those of the clock say little on a machine with other work, and so there are
those of the processor, too: what the client used plus what the busiest worker used is the time that the job cannot be
faster than with a core for each.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from pathlib import Path

import dask
import distributed
import numpy as np
import psutil

import rfpose as rf
from rfpose.engine import Engine
from rfpose.pipeline.measure import OtherProcesses, measure_tones
from rfpose.recording import frame_starts


def main() -> None:
    """Print seconds and ratios."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=5)
    asked = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml")).changed(
        radio={"frame_samples": 400_000}, simulation={"frame_count": asked.frames}
    )
    # as those of `--workers` and scripts/cluster, workers do not look at their own stacks
    dask.config.set({"distributed.worker.profile.enabled": False})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rec.h5"
        rf.simulate(site, seed=1).save(path)
        with (
            rf.open_recording(path) as recording,
            distributed.LocalCluster(
                n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
            ) as one,
            distributed.LocalCluster(
                n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
            ) as two,
        ):
            starts = frame_starts(recording, site.radio.frame_samples)

            def alone() -> None:
                os.sched_setaffinity(0, cores[:1])
                try:
                    measure_tones(recording, site, starts, estimator="hilbert")
                finally:
                    os.sched_setaffinity(0, cores)

            def by(cluster: distributed.LocalCluster) -> None:
                with Engine(scheduler=cluster.scheduler_address).used():
                    measure_tones(recording, site, starts, estimator="hilbert", elsewhere=OtherProcesses(paths=(path,)))

            jobs = {"this process": alone, "one worker": lambda: by(one), "two workers": lambda: by(two)}
            workers = {"this process": [], "one worker": _workers(one), "two workers": _workers(two)}
            clock: dict[str, list[float]] = {name: [] for name in jobs}
            processor: dict[str, list[float]] = {name: [] for name in jobs}
            for k in range(asked.rounds + 1):
                for name, job in jobs.items():
                    began, used = time.perf_counter(), _used_s(workers[name])
                    job()
                    if k:
                        clock[name].append(time.perf_counter() - began)
                        here, *there = np.subtract(_used_s(workers[name]), used)
                        processor[name].append(here + max(there, default=0.0))
    n_sample = asked.frames * len(site.receiver_ids) * site.radio.frame_samples
    print(f"{n_sample / 1e6:.0f} million samples, {len(cores)} cores, load {os.getloadavg()[0]:.1f}")
    for what, seconds in (("clock", clock), ("processor", processor)):
        middle = {name: statistics.median(found) for name, found in seconds.items()}
        print(f"by the {what}")
        for name, value in middle.items():
            print(f"  {name:14s} {value:6.2f} s  ({np.ptp(seconds[name]):.2f} s between the rounds)")
        print(f"  one worker / this process, speed: {middle['this process'] / middle['one worker']:.2f}")
        print(f"  two workers / one worker, speed:  {middle['one worker'] / middle['two workers']:.2f}")


def _workers(cluster: distributed.LocalCluster) -> list[psutil.Process]:
    with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
        return [psutil.Process(pid) for pid in client.run(os.getpid).values()]


def _used_s(workers: list[psutil.Process]) -> list[float]:
    """Return the processor's seconds that this process and workers have used."""
    times = [each.cpu_times() for each in (psutil.Process(), *workers)]
    return [each.user + each.system for each in times]


if __name__ == "__main__":
    main()
