"""Print the way from a recording to its normals: each file in the order in which it is first entered, and how often.

    python benchmarks/walk.py

Entered means: called from another file. Left out: kernels, and what every part leans on (checks, errors, scenario,
recording). The work on receivers, which threads share, is not followed.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType

import rfpose as rf

ROOT = Path(rf.__file__).parent
LEANED_ON = (
    "checks.py",
    "errors.py",
    "files.py",
    "foreign.py",
    "interruption.py",
    "jit.py",
    "recording",
    "scenario",
    "shown.py",
)


def main() -> None:
    """Process a small recording twice, the second time watched."""
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    small = {"radio": {"frame_samples": 40_000}, "simulation": {"frame_count": 2}}
    recording = rf.simulate(site.changed(heliostat=site.heliostat[:2], **small), seed=1)
    rf.process(recording)
    entered: dict[str, int] = {}
    last = ""

    def watch(frame: FrameType, event: str, _: object) -> None:
        nonlocal last
        path = Path(frame.f_code.co_filename)
        if event != "call" or not path.is_relative_to(ROOT):
            return
        name = path.relative_to(ROOT)
        if name.name == "_kernels.py" or name.parts[0] in LEANED_ON or str(name) == last:
            return
        last = str(name)
        entered[last] = entered.get(last, 0) + 1

    sys.setprofile(watch)
    rf.process(recording)
    sys.setprofile(None)
    for name, count in entered.items():
        print(f"{count:5d} {name}")
    print(f"{sum(entered.values()):5d} entries of {len(entered)} files")


if __name__ == "__main__":
    main()
