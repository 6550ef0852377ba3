"""A recording that is followed: how soon after a frame's last sample its poses are there, and what a day does to it.

    python benchmarks/bench_live.py [--receivers 300] [--samples 100000] [--frames 30] [--estimator correlator]
    python benchmarks/bench_live.py --day [--every 60]

A recorder in a process of its own writes a closed rfpose-iq file a frame. A frame's last sample is there when its
file takes its name; its poses are there when who reads ``RESULT.partial`` finds them. The file is written before, in
a folder nobody looks at, and a moment passes: neither the recorder nor the disk works while the frame is solved. With
``--day``, 24 hours pass with a small frame every so many seconds, as fast as they are solved: memory and latency of
each tenth, and frames lost.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import os
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

import rfpose as rf
from rfpose.pipeline import follow
from rfpose.pipeline.follow import Follow
from rfpose.pipeline.formats.live_result import LiveResult
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.measure import FrameByFrame
from rfpose.recording import Recording, RecordingWriter
from rfpose.recording.segments import SegmentsRecording
from rfpose.scenario import Scenario

DAY_S = 86_400
KEPT = 50
"""Files that the recorder leaves; it removes older ones."""
QUIET_S = 0.2
"""From when a frame's file was written until it takes its name."""


def site_of(n_receiver: int, n_sample: int) -> Scenario:
    """Table 2's transmitters, so many receivers on mirrors of three, and its calibration receiver."""
    shipped = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    n_mirror = max(1, n_receiver // 3)
    k = np.arange(n_mirror) + 0.5
    radius, angle = 15.0 + 75.0 * np.sqrt(k / n_mirror), 2.399963 * k
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n_mirror, 2.0)], axis=1)
    return shipped.with_field(places).changed(radio={"frame_samples": n_sample}, simulation={"frame_count": 1})


def record(
    folder: Path,
    recording: Recording,
    samples: dict[str, np.ndarray],
    steps: list[int],
    told: Connection,
    quiet_s: float,
) -> None:
    """Write a file a frame, each when it is asked for; tell when it was there, and what the one before took meanwhile.

    That is processor time between when the one before was there and when this one was asked for [s].
    """
    start = int(recording.blocks(recording.receiver_ids[0])[0, 0])
    beside = folder.with_name("written")
    beside.mkdir()
    spent_s = 0.0
    for k, step in enumerate(steps):
        told.recv()
        meanwhile_s = time.process_time() - spent_s if k else 0.0
        name = f"frame-{k:06d}.h5"
        begun = time.time()
        with RecordingWriter.like(beside / name, recording) as writer:
            for receiver_id, iq in samples.items():
                writer.write(receiver_id, start + step, iq)
        took_s = time.time() - begun
        if k >= KEPT:
            (folder / f"frame-{k - KEPT:06d}.h5").unlink()
        time.sleep(quiet_s)
        spent_s, at = time.process_time(), time.time()
        (beside / name).rename(folder / name)
        told.send((at, took_s, meanwhile_s))


class Stages:
    """What the last call of each stage took: wall and processor time of both cores [s]."""

    def __init__(self) -> None:
        self.last: dict[str, tuple[float, float]] = {}
        self.frames: list[dict[str, tuple[float, float]]] = []
        self._watch(SegmentsRecording, "refresh", "a file is found and opened")
        self._watch(FrameByFrame, "measure", "samples are read and measured")
        self._watch(follow, "solve_calibrated", "poses")
        self._watch(LiveResult, "append", "poses are kept")

    def _watch(self, owner: Any, name: str, stage: str) -> None:
        plain = getattr(owner, name)

        def watched(*given: Any, **settings: Any) -> Any:
            began = time.perf_counter(), time.process_time()
            try:
                return plain(*given, **settings)
            finally:
                self.last[stage] = time.perf_counter() - began[0], time.process_time() - began[1]

        setattr(owner, name, watched)

    def show(self) -> None:
        """Print the median of each over frames but the first."""
        for stage in self.last:
            wall_s, cpu_s = np.median([frame[stage] for frame in self.frames[1:]], axis=0)
            print(f"  {stage}: {1e3 * wall_s:.1f} ms, processor time {1e3 * cpu_s:.1f} ms")


def memory_mb() -> float:
    """Return the resident memory of this process [MB]."""
    text = Path("/proc/self/statm").read_text()
    return int(text.split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    """Print latencies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--receivers", type=int, default=300)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--estimator", default="correlator")
    parser.add_argument("--day", action="store_true")
    parser.add_argument("--every", type=int, default=60, help="seconds between two frames of the day")
    asked = parser.parse_args()
    logging.getLogger("rfpose").setLevel(logging.ERROR)
    if asked.day:
        asked.receivers, asked.samples, asked.frames = 3, 20_000, DAY_S // asked.every
    site = site_of(asked.receivers, asked.samples)
    recording = rf.simulate(site, seed=1)
    start = int(recording.blocks(recording.receiver_ids[0])[0, 0])
    samples = {name: recording.read(name, start, asked.samples) for name in recording.receiver_ids}
    every = int(asked.every * recording.sample_rate) if asked.day else 10 * asked.samples
    quiet_s = 0.0 if asked.day else QUIET_S
    here, there = multiprocessing.Pipe()
    latency_s: list[float] = []
    memory: list[float] = []
    writing_s: list[float] = []
    recorder_s: list[float] = []
    spent_s: list[float] = []
    stages = Stages()

    def on_frame(_result: Result) -> None:
        seen = time.time()
        at, took, meanwhile = here.recv()
        latency_s.append(seen - at)
        writing_s.append(took)
        recorder_s.append(meanwhile)
        stages.frames.append(dict(stages.last))
        memory.append(memory_mb())
        spent_s.append(time.process_time())
        if len(latency_s) < asked.frames:
            here.send(None)

    with tempfile.TemporaryDirectory() as folder:
        night = Path(folder) / "night"
        night.mkdir()
        steps = [k * every for k in range(asked.frames)]
        until_s = (start + steps[-1] + every) / recording.sample_rate
        recorder = multiprocessing.Process(target=record, args=(night, recording, samples, steps, there, quiet_s))
        recorder.start()
        here.send(None)
        began = time.time()
        result = rf.process(
            Follow(night, idle_timeout_s=5.0, until_s=until_s, on_frame=on_frame),
            Path(folder) / "result.h5",
            estimator=asked.estimator,
        )
        lasted_s = time.time() - began
        recorder.join(30.0)
        recorder.kill()
    n_receiver = len(site.receiver_ids)
    print(
        f"{n_receiver} receivers, {len(site.heliostat)} mirrors, {asked.samples} samples a frame, {asked.estimator}, "
        f"{len(os.sched_getaffinity(0))} cores, load {os.getloadavg()[0]:.1f}"
    )
    print(f"frames written {asked.frames}, solved {len(result.frame_start_index)}, in {lasted_s:.0f} s")
    print(f"poses solved {np.count_nonzero(result.poses.status == 0)} of {result.poses.status.size}")
    later = np.array(latency_s[1:])
    print(f"writing a frame's file: median {1e3 * np.median(writing_s):.0f} ms")
    print(
        f"latency after the first frame: median {1e3 * np.median(later):.0f} ms, "
        f"95 % {1e3 * np.quantile(later, 0.95):.0f} ms, worst {1e3 * later.max():.0f} ms"
    )
    print(f"the recorder's processor time while a frame is solved: at most {1e3 * max(recorder_s):.0f} ms")
    print(f"processor time a frame, both cores together: median {1e3 * np.median(np.diff(spent_s)):.0f} ms")
    stages.show()
    if asked.day:
        tenths = [np.array_split(each, 10) for each in (later, memory[1:], np.diff(spent_s))]
        for k, (times, sizes, spent) in enumerate(zip(*tenths, strict=True)):
            print(
                f"  tenth {k + 1:2d}: latency median {1e3 * np.median(times):5.1f} ms, processor time a frame "
                f"{1e3 * np.median(spent):4.1f} ms, memory {sizes[-1]:.0f} MB"
            )


if __name__ == "__main__":
    main()
