"""Prints what `rfpose process` costs a receiver and frame, stage by stage, in seconds of the processor on one core.

    python benchmarks/stage_cost.py [--mirrors 12] [--frames 20] [--samples 400000]

The recording is processed once before, so that it comes from memory and kernels are compiled. Seconds of the processor
depend less on a machine's other work than those of the clock.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import rfpose as rf
from rfpose.pipeline import stages


def main() -> None:
    """Simulate, process, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--mirrors", type=int, default=12)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--samples", type=int, default=400_000)
    asked = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
    stages.time.perf_counter = time.process_time  # type: ignore[attr-defined]
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    changes = {"frame_count": asked.frames, "frame_interval_s": 4.0, "sun_azimuth_deg": 170.0}
    site = site.changed(
        heliostat=site.heliostat[: asked.mirrors], radio={"frame_samples": asked.samples}, simulation=changes
    )
    with tempfile.TemporaryDirectory() as name:
        recording, result = Path(name) / "rec.h5", Path(name) / "result.h5"
        rf.simulate(site, seed=1).save(recording)
        for _ in range(2):
            profile = rf.process(recording, result, force=True).profile
        n_byte = result.stat().st_size
    assert profile is not None
    n_row = asked.frames * len(site.receiver_ids)
    print(f"{len(site.receiver_ids)} receivers, {asked.frames} frames of {asked.samples} samples")
    for stage, seconds in profile["seconds"].items():
        print(f"  {stage:12s} {1e6 * seconds / n_row:9.1f} µs a receiver and frame")
    print(f"  result       {n_byte / n_row:9.0f} bytes a receiver and frame, truth and scenario with it")


if __name__ == "__main__":
    main()
