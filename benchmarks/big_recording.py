"""Processes a recording that is larger than memory and disk, and prints how much memory each process took at most.

    python benchmarks/big_recording.py [--gigabytes 100] [--workers 2]

Eight frames are simulated, and the file's table of blocks lists them again and again, a second apart: so a small file
is a recording of that size, of which every byte is read, out of the page cache. It is processed by `rfpose process`,
and the high-water mark of memory is read from Linux for the command and each process that it started.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import psutil

import rfpose as rf

N_STORED = 8
FRAME_SAMPLES = 400_000


def main() -> None:
    """Make the recording, process it, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--gigabytes", type=float, default=100.0)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        recording = Path(name) / "rec.h5"
        n_frame = _make(recording, asked.gigabytes * 1e9)
        on_disk = recording.stat().st_size
        print(f"{n_frame} frames of {FRAME_SAMPLES} samples; {on_disk / 1e6:.0f} MB on disk", flush=True)
        command = [Path(sys.executable).with_name("rfpose"), "process", recording, "-o", Path(name) / "result.h5"]
        began = time.monotonic()
        process = subprocess.Popen(
            [*command, "--workers", str(asked.workers)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        peaks = _watch(process)
        lasts = time.monotonic() - began
        if process.returncode:
            raise SystemExit(f"rfpose process ends with {process.returncode}")
    print(f"{asked.gigabytes:g} GB in {lasts:.0f} s; peak of memory of each process, the largest first, in MB:")
    print(*(f"{value / 1e6:.0f}" for value in sorted(peaks.values(), reverse=True)))


def _make(path: Path, n_byte: float) -> int:
    """Write the recording; return its number of frames."""
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    still = {"frame_count": N_STORED, "frame_interval_s": 1.0, "sun_azimuth_deg": 170.0}
    site = site.changed(heliostat=site.heliostat[:1], radio={"frame_samples": FRAME_SAMPLES}, simulation=still)
    rf.simulate(site, seed=1).save(path)
    with h5py.File(path, "r+") as file:
        receivers = file["receivers"]
        n_frame = int(n_byte / (4 * FRAME_SAMPLES * len(receivers)))
        i_frame = np.arange(n_frame)
        for receiver in receivers.values():
            first, count, _ = receiver["blocks"][0]
            offset = receiver["blocks"][:, 2]
            start = first + round(site.radio.sample_rate_hz) * i_frame
            rows = np.stack([start, np.full(n_frame, count), offset[i_frame % N_STORED]], axis=1)
            del receiver["blocks"]
            receiver["blocks"] = rows.astype("<i8")
        del file["truth"]
    return n_frame


def _watch(process: subprocess.Popen[bytes]) -> dict[int, int]:
    """Return the high-water mark of a process and those below it, by number [byte], when it has ended."""
    peaks: dict[int, int] = {}
    while process.poll() is None:
        try:
            family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
        except psutil.NoSuchProcess:
            break
        for each in family:
            try:
                status = Path(f"/proc/{each.pid}/status").read_text()
            except OSError:
                continue
            marks = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")]
            if marks:  # none of one that has just ended
                peaks[each.pid] = 1024 * int(marks[0])
        time.sleep(0.5)
    process.wait()
    return peaks


if __name__ == "__main__":
    main()
