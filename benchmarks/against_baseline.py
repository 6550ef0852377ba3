"""How fast this tree is against an older one: both run in turn on this machine, medians and ratios.

    python benchmarks/against_baseline.py [--baseline COMMIT] [--runs 5] [--only process info …] [--cold] [--bench]
        [--output results.json]

The older tree is checked out as a worktree in build/baseline and set up by its own scripts/setup (once). Every job is
one command of rfpose, run by each tree on files that the older one wrote, in a folder of its own. The table has the
processor's and the clock's seconds, medians over the runs, and new / old. ``--cold`` adds each job with an empty cache
of compiled kernels, once; ``--bench`` adds the numbers of `rfpose bench`.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[1]
BASELINE = "3d4d5e2"
TREES = ("old", "new")
SITE, DAY = "data/table2_100m.toml", "data/tracking_100m.toml"
PAINT = ROOT.parent / "shared/data/paint"  # real records, which are no part of the repository
JOBS: Mapping[str, tuple[str, ...]] = {
    "process": ("process", "{recording}", "-o", "{out}.h5", "--force"),
    "evaluate": ("evaluate", "{result}"),
    "info of a recording": ("info", "{recording}"),
    "layout map": ("layout", "map", "{site}"),
    "layout optimise": ("layout", "optimise", "{site}", "-o", "{out}.toml", "--force"),
    "calibrate": ("calibrate", "{paint}", "--heliostat", "BF57"),
    "track --help": ("track", "--help"),
    "track": ("track", "{day}", "-o", "{out}.h5", "--methods", "radio", "--force"),
    "track 1000 mirrors": (
        "track", "{day}", "-o", "{out}.h5", "--methods", "radio", "--heliostats", "1000", "--force",
    ),
    "view --save of a recording": ("view", "{recording}", "--save", "{out}.png", "--force"),
    "view --save of a result": ("view", "{result}", "--save", "{out}.png", "--force"),
    "view --save of a layout": ("view", "{site}", "--save", "{out}.png", "--force"),
    "a refusal": ("evaluate", "{site}"),
}  # fmt: skip


@dataclass(frozen=True)
class Seconds:
    """What a command took."""

    cpu: float
    wall: float


def set_up(commit: str) -> Path:
    """Return a checkout of a commit with an environment of its own."""
    place = ROOT / "build" / "baseline"
    if not place.exists():
        subprocess.run(["git", "worktree", "add", "--detach", place, commit], cwd=ROOT, check=True)
    subprocess.run(["git", "checkout", "--quiet", "--detach", commit], cwd=place, check=True)
    subprocess.run(["scripts/setup"], cwd=place, check=True)
    return place


def run(tree: Path, words: tuple[str, ...], *, folder: Path, cache: Path | None = None) -> tuple[Seconds, str]:
    """Run a command of a tree; return its seconds and what it printed."""
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python's own cache is part of an installation
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    before, began = os.times(), time.perf_counter()
    done = subprocess.run(
        [tree / ".venv/bin/rfpose", *words], cwd=folder, env=environment, capture_output=True, text=True
    )
    after, wall = os.times(), time.perf_counter() - began
    if done.returncode not in (0, 3):  # 3: refused, which one job wants
        raise SystemExit(f"{tree}: rfpose {' '.join(words)} ended with {done.returncode}: {done.stderr[-500:]}")
    cpu = after.children_user - before.children_user + after.children_system - before.children_system
    return Seconds(cpu, wall), done.stdout


def files(old: Path, folder: Path) -> dict[str, str]:
    """Have the older tree write what the jobs read."""
    names = {name: str(folder / f"{name}.h5") for name in ("recording", "result")}
    names |= {"site": str(old / SITE), "day": str(old / DAY), "paint": str(PAINT)}
    run(old, ("simulate", names["site"], "-o", names["recording"]), folder=folder)
    run(old, ("process", names["recording"], "-o", names["result"]), folder=folder)
    return names


def medians(runs: list[Seconds]) -> Seconds:
    """Return the median of each."""
    return Seconds(statistics.median(r.cpu for r in runs), statistics.median(r.wall for r in runs))


def main() -> None:
    """Run, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--baseline", default=BASELINE, help="commit to compare with")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--only", nargs="*", choices=tuple(JOBS), default=tuple(JOBS))
    parser.add_argument("--cold", action="store_true", help="also with an empty cache of kernels")
    parser.add_argument("--bench", action="store_true", help="also `rfpose bench`")
    parser.add_argument("--output", type=Path, help="write all numbers as JSON")
    args = parser.parse_args()
    trees = {"old": set_up(args.baseline), "new": ROOT}
    found: dict[str, Any] = {"baseline": args.baseline, "runs": args.runs, "jobs": {}, "cold": {}, "bench": {}}
    with tempfile.TemporaryDirectory(prefix="rfpose-against-") as name:
        folder = Path(name)
        names = files(trees["old"], folder)
        console = Console(stderr=True)
        for job in args.only:
            if job == "calibrate" and not PAINT.is_dir():
                console.print(f"{job}: left out, since {PAINT} is not there")
                continue
            words = tuple(word.format(**names, out=folder / "out") for word in JOBS[job])
            console.print(f"{job} …")
            for tree in TREES:  # the caches are filled
                run(trees[tree], words, folder=folder)
            taken: dict[str, list[Seconds]] = {tree: [] for tree in TREES}
            for _ in range(args.runs):
                for tree in TREES:
                    taken[tree].append(run(trees[tree], words, folder=folder)[0])
            found["jobs"][job] = {tree: vars(medians(taken[tree])) for tree in TREES}
            if args.cold:
                found["cold"][job] = {}
                for tree in TREES:
                    with tempfile.TemporaryDirectory(dir=folder) as cache:
                        found["cold"][job][tree] = vars(run(trees[tree], words, folder=folder, cache=Path(cache))[0])
        if args.bench:
            console.print("bench …")
            benches = {tree: [] for tree in TREES}
            for _ in range(args.runs):
                for tree in TREES:
                    benches[tree].append(json.loads(run(trees[tree], ("bench", "--json"), folder=folder)[1]))
            found["bench"] = {tree: _median_numbers(benches[tree]) for tree in TREES}
    show(found)
    if args.output is not None:
        args.output.write_text(json.dumps(found, indent=1) + "\n")


def _median_numbers(runs: list[Any]) -> Any:
    """Return the median of every number in JSON of one shape."""
    first = runs[0]
    if isinstance(first, dict):
        return {key: _median_numbers([one[key] for one in runs if key in one]) for key in first}
    return statistics.median(runs) if isinstance(first, int | float) else first


def show(found: Mapping[str, Any]) -> None:
    """Print the tables."""
    console = Console(width=max(100, Console().width), file=sys.stdout)
    for part, title in (("jobs", "warm, medians"), ("cold", "no compiled kernels in the cache, once")):
        if not found[part]:
            continue
        table = Table(
            "", *(f"{tree} {what} [s]" for what in ("cpu", "wall") for tree in TREES), "cpu", "wall", title=title
        )
        for job, row in found[part].items():
            ratios = [f"{row['new'][what] / row['old'][what]:.2f}" for what in ("cpu", "wall")]
            table.add_row(job, *(f"{row[tree][what]:.2f}" for what in ("cpu", "wall") for tree in TREES), *ratios)
        console.print(table)
    if found["bench"]:
        table = Table("rfpose bench", *TREES, "new / old", title=f"medians of {found['runs']}")
        old, new = (dict(_flat(found["bench"][tree])) for tree in TREES)
        for name in (name for name in old if name in new and old[name]):
            table.add_row(name, f"{old[name]:,.4g}", f"{new[name]:,.4g}", f"{new[name] / old[name]:.2f}")
        console.print(table)


def _flat(data: Any, prefix: str = "") -> list[tuple[str, float]]:
    """Give every number of nested mappings its dotted name."""
    if isinstance(data, dict):
        return [item for key, value in data.items() for item in _flat(value, f"{prefix}{key}.")]
    return [(prefix[:-1], data)] if isinstance(data, int | float) and not isinstance(data, bool) else []


if __name__ == "__main__":
    main()
