"""Print how fast fields are tracked, how time and memory grow with the field, and what a plain loop would need.

    python benchmarks/bench_tracking.py [--heliostats 10000] [--whole]

One method (radio closed loop), 1 s servo steps, 4 s control interval, data/tracking_100m.toml. Without ``--whole`` the
day is extrapolated from an hour of it; the first quarter of an hour, in which numba loads or compiles, is not counted.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numba

from rfpose.feedback.tracking import TrackingSimulation
from rfpose.scenario import load_scenario

SCENARIO = Path(__file__).resolve().parents[1] / "data" / "tracking_100m.toml"
PLAIN = """
import sys, time
from rfpose.feedback.tracking import TrackingSimulation
from rfpose.scenario import load_scenario
base = load_scenario(sys.argv[1])
tracking = base.tracking.model_copy(update={"first_hour": 9.0, "last_hour": 9.1})
simulation = TrackingSimulation(base.model_copy(update={"tracking": tracking}), methods=("radio",), count=4, seed=1)
start = time.process_time()
simulation.advance()
print((time.process_time() - start) / (4 * len(simulation.days[0].unix_s)))
"""


def track(n: int, n_segment: int | None) -> tuple[float, float, TrackingSimulation]:
    """Seconds and seconds of processor a mirror and step, and the simulation."""
    simulation = TrackingSimulation(load_scenario(SCENARIO), methods=("radio",), count=n, seed=1)
    simulation.advance()
    last = simulation.n_segment if n_segment is None else min(1 + n_segment, simulation.n_segment)
    steps = simulation.segments[last - 1].end - simulation.segments[0].end
    start, start_cpu = time.perf_counter(), time.process_time()
    while simulation.done < last:
        simulation.advance()
    work = n * steps
    return (time.perf_counter() - start) / work, (time.process_time() - start_cpu) / work, simulation


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--heliostats", type=int, default=10_000)
    parser.add_argument("--whole", action="store_true", help="track the whole day, not an hour")
    arguments = parser.parse_args()
    print(f"{numba.get_num_threads()} threads, load {os.getloadavg()[0]:.1f}")
    print("mirrors   ns a mirror and second: elapsed, processor   day: elapsed, processor over two   memory so far")
    least = float("inf")
    for n in (100, 1000, arguments.heliostats):
        whole = arguments.whole and n == arguments.heliostats
        each, cpu, simulation = track(n, None if whole else 4)
        least = min(least, cpu)
        day = n * len(simulation.days[0].unix_s)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(
            f"{n:7d} {1e9 * each:22.0f} {1e9 * cpu:22.0f} {each * day:17.0f} s {0.5 * cpu * day:17.0f} s"
            f"{' ' if whole else '*'} {memory:15.2f} GB",
            flush=True,
        )
    print("* extrapolated")
    done = subprocess.run(
        [sys.executable, "-c", PLAIN, str(SCENARIO)],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    plain = float(done.stdout)
    print(f"the same code as plain Python: {1e6 * plain:.0f} µs of processor, {plain / least:.0f} times as much")


if __name__ == "__main__":
    main()
