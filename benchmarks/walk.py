"""Print the way from a recording to its normals, as somebody walks it who reads the code.

    python benchmarks/walk.py

Each function is read once, where it is first called, depth first. A step goes from a function into one of another file;
return is a step into a file that was left already. Left out: kernels, how records check themselves, and what every part
leans on (checks, errors, scenario, recording). The work on receivers, which threads share, is not followed.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import CodeType, FrameType
from typing import NamedTuple

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
FIRST_OF_POSE = "solve"
"""The function that takes tone phases."""


class Step(NamedTuple):
    """One step from a function into another file's."""

    depth: int
    caller: str
    file: str
    function: str


def followed(code: CodeType) -> str:
    """Return the file of a function that is read, from the package's root; empty for others."""
    path = Path(code.co_filename)
    if not path.is_relative_to(ROOT) or code.co_name.startswith("__post_init"):
        return ""
    name = path.relative_to(ROOT)
    return "" if name.name == "_kernels.py" or name.parts[0] in LEANED_ON else str(name)


def walked(recording: rf.Recording) -> list[Step]:
    """Return the steps of `rfpose.process`; its own file comes first."""
    seen: set[CodeType] = set()
    steps: list[Step] = []

    def watch(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or code in seen:
            return
        seen.add(code)
        file = followed(code)
        if not file:
            return
        above, depth = frame.f_back, 0
        caller = ""
        while above is not None:
            if there := followed(above.f_code):
                caller = caller or f"{there}:{above.f_code.co_name}"
                depth += 1
            above = above.f_back
        if caller.partition(":")[0] != file:
            steps.append(Step(depth, caller, file, code.co_qualname))

    sys.setprofile(watch)
    rf.process(recording)
    sys.setprofile(None)
    return steps


def show(steps: list[Step]) -> None:
    """Print each step, and how many of them are returns."""
    files: list[str] = []
    for step in steps:
        mark = "<-" if step.file in files else "  "
        print(f"{mark} {'  ' * step.depth}{step.file}: {step.function}")
        if step.file not in files:
            files.append(step.file)
    print(f"{len(steps)} steps, {len(files)} files, {len(steps) - len(files)} returns")


def main() -> None:
    """Process a small recording twice, the second time watched."""
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    small = {"radio": {"frame_samples": 40_000}, "simulation": {"frame_count": 2}}
    recording = rf.simulate(site.changed(heliostat=site.heliostat[:2], **small), seed=1)
    rf.process(recording)
    steps = walked(recording)
    show(steps)


if __name__ == "__main__":
    main()
