"""What the start of `rfpose process` is made of: processor seconds of each part, in a new process each time.

    python benchmarks/startup.py [--runs 5]

Parts are loaded one after the other as the command loads them, so each counts what those before it have not loaded yet.
The last two are `rf.process` of a small recording for the first and the second time: their difference is compiled code
that is read, linked and called for the first time, and modules that are loaded late.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import rfpose as rf

PARTS = {
    "numpy": "import numpy",
    "h5py": "import h5py",
    "pydantic": "import pydantic",
    "the scenario's records": "import rfpose.scenario",
    "scipy.special": "import scipy.special",
    "numba": "from rfpose.jit import load_numba; load_numba()",
    "the rest of rfpose": "import rfpose as rf, rfpose.pipeline.process",
    "a small job, first time": "rf.process(recording)",
    "the same, second time": "rf.process(recording)",
}


def main() -> None:
    """Print a table of medians."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--runs", type=int, default=5)
    n_run = arguments.parse_args().runs
    lines = ["import json, sys, time", "recording, took, last = sys.argv[1], [], time.process_time()"]
    for text in PARTS.values():
        lines += [text, "now = time.process_time(); took.append(now - last); last = now"]
    program = "\n".join([*lines, "print(json.dumps(took))"])
    environment = dict(os.environ)
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python's own cache is part of an installation
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording.h5"
        site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
        small = {"radio": {"frame_samples": 40_000}, "simulation": {"frame_count": 2}}
        rf.simulate(site.changed(heliostat=site.heliostat[:2], **small), seed=1).save(recording)
        command = [sys.executable, "-c", program, str(recording)]
        runs = [
            json.loads(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)
            for _ in range(n_run + 1)
        ][1:]  # the first one fills caches
    for name, took in zip(PARTS, zip(*runs, strict=True), strict=True):
        print(f"{statistics.median(took):6.2f} s  {name}")
    print(f"{statistics.median(map(sum, runs)):6.2f} s  all")


if __name__ == "__main__":
    main()
