"""From how long a frame on it pays to share receivers among threads: one thread and one a core, in turn.

    python benchmarks/short_frames.py [--mirrors 12] [--rounds 15] [--estimator correlator]

Prints for frames of several lengths what measuring one frame of all receivers takes from a file in memory, the best of
the rounds [ms]; `rfpose.pipeline.measure` shares frames from its limit on.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import rfpose as rf
from rfpose.pipeline import measure
from rfpose.recording import Recording
from rfpose.scenario import Scenario


def milliseconds(recording: Recording, site: Scenario, start: int, asked: argparse.Namespace) -> dict[str, float]:
    """Return the best of the rounds by who measures."""
    limits = {"one thread": 10**9, "a thread a core": 0}
    best = dict.fromkeys(limits, float("inf"))
    for who, limit in limits.items():
        measure._FOR_THREADS_SAMPLES = limit
        with measure.FrameByFrame(recording, site, estimator=asked.estimator) as bench:
            bench.measure(start)  # clocks are searched for
            for _ in range(asked.rounds):
                began = time.perf_counter()
                bench.measure(start)
                best[who] = min(best[who], 1e3 * (time.perf_counter() - began))
    return best


def main() -> None:
    """Print a line a length."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mirrors", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--estimator", default="correlator")
    asked = parser.parse_args()
    limit = measure._FOR_THREADS_SAMPLES
    shipped = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    print(f"{len(os.sched_getaffinity(0))} cores, load {os.getloadavg()[0]:.1f}; shared from {limit} samples on")
    with tempfile.TemporaryDirectory() as folder:
        for n_sample in (25_000, 50_000, 100_000, 200_000, 400_000, 800_000):
            site = shipped.changed(
                heliostat=shipped.heliostat[: asked.mirrors],
                radio={"frame_samples": n_sample},
                simulation={"frame_count": 1},
            )
            path = Path(folder) / f"{n_sample}.h5"
            rf.simulate(site, seed=1).save(path)
            with rf.open_recording(path) as recording:
                start = int(recording.blocks(recording.receiver_ids[0])[0, 0])
                found = milliseconds(recording, site, start, asked)
            told = ", ".join(f"{who} {value:.2f} ms" for who, value in found.items())
            print(f"{len(site.receiver_ids)} receivers, {n_sample:7d} samples: {told}")


if __name__ == "__main__":
    main()
