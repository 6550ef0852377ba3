"""Print the way from a recording to its normals, as somebody walks it who reads the code.

    python benchmarks/walk.py [--frame-samples 8000]

Each function is read once, where it is first called, depth first. A step goes from a function into one of another file;
a return is a step into a file that was left already. Left out: kernels, how records check themselves, and what every
part leans on (checks, errors, geometry, scenario, recording). What threads do for receivers is not followed; short
frames are measured without threads, and what is done for a receiver shows.
"""

from __future__ import annotations

import argparse
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
    "geometry.py",
    "interruption.py",
    "jit.py",
    "recording",
    "scenario",
    "shown.py",
)


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


def returns(steps: list[Step]) -> dict[str, list[str]]:
    """Return by file the functions for which it is entered again."""
    seen: set[str] = set()
    again: dict[str, list[str]] = {}
    for step in steps:
        if step.file in seen:
            again.setdefault(step.file, []).append(step.function)
        seen.add(step.file)
    return again


def from_phases(steps: list[Step]) -> list[Step]:
    """Return the part from tone phases to normals."""
    return steps[
        next(k for k, step in enumerate(steps) if step.file == "pipeline/solve.py" and step.function == "solve") :
    ]


def small_recording(frame_samples: int = 400_000) -> rf.Recording:
    """Return two mirrors in two frames; by default so long that threads measure them."""
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    small = {"radio": {"frame_samples": frame_samples}, "simulation": {"frame_count": 2}}
    return rf.simulate(site.changed(heliostat=site.heliostat[:2], **small), seed=1)


def summary(steps: list[Step]) -> str:
    """Return how many steps, files and returns there are."""
    again = sum(map(len, returns(steps).values()))
    return f"{len(steps)} steps, {len({step.file for step in steps})} files, {again} returns"


def main() -> None:
    """Process a small recording twice, the second time watched."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frame-samples", type=int, default=400_000)
    recording = small_recording(parser.parse_args().frame_samples)
    rf.process(recording)
    steps = walked(recording)
    seen: set[str] = set()
    for step in steps:
        print(f"{'<-' if step.file in seen else '  '} {'  ' * step.depth}{step.file}: {step.function}")
        seen.add(step.file)
    part = from_phases(steps)
    print(
        f"\nfrom recording to normals: {summary(steps)}\nfrom tone phases to normals: {summary(part)}; entered again:"
    )
    for file, functions in returns(part).items():
        print(f"  {file}: {', '.join(functions)}")


if __name__ == "__main__":
    main()
