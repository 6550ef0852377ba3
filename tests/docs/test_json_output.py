"""docs/json-output.md lists the keys that commands print: each of them, and none that is printed no more.

`demo`, `warm-up` and `antenna learn` take long and are held to it where they are tested.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import rfpose as rf
from rfpose.cli._app import COMMANDS, app
from rfpose.cli._reference import commands
from told import undocumented, unseen

LINES = """
init new.toml
simulate site.toml -o rec.h5 --seed 1
process rec.h5 -o result.h5 --filter --profile --csv poses.csv
process rec.h5 -o reflected.h5 --reflection estimate
process rec.h5 -o learned.h5 --scenario learning.toml
process rec.h5 -o told.h5 --pose site
evaluate result.h5
info rec.h5
info recording.h5 night.h5
info result.h5
info site.toml --picture site.png
convert rec.h5 -o converted.h5 --to rfpose-iq
survey recording.h5 night.h5 -o survey.h5
layout map site.toml --line-of-sight 3.2 2.6 --sensitivity
layout map site.toml --sun 120 30
layout map walled.toml --estimator site
layout optimise site.toml -o better.toml --starts 1
layout optimise site.toml --pareto 9..9 --starts 1
layout compare site.toml better.toml
layout budget site.toml --draws 10
layout tones site.toml --accuracy-mrad 1
calibrate paint -o models.json
calibrate --mount planned.toml --camera pictures --drone flight.csv
info models.json
info survey.h5
info data/antenna_front_433MHz.h5
aim models.json --target 0 0 50 --start 2026-06-21T10:00Z
aim models.json --target 0 0 50 --start 2026-06-21T10:00Z --next 1
track data/tracking_100m.toml -o track.h5 --methods radio --event '11.95 emergency' --event '23 release' --check-iq H01
info track.h5
plot result.h5 -o figure.png
view result.h5 --save shown.png
sample paint made
data
bench --seconds 0.01
"""
APART = ("antenna learn", "demo", "publish", "warm-up")


def command_of(line: str) -> str:
    words = line.split()
    return " ".join(words[: 2 if words[0] in ("layout", "antenna") else 1])


@pytest.fixture(scope="module")
def printed(workshop: Path, calibrations: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """What each command prints, by command."""
    folder = tmp_path_factory.mktemp("printed") / "work"
    shutil.copytree(workshop, folder)
    for name in ("paint", "pictures", "planned.toml", "flight.csv"):
        source = calibrations / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / name)
    shutil.copy(rf.shipped_scenario("antenna_front_433MHz.h5"), folder / "data")
    site = rf.load_scenario(folder / "site.toml")
    east, north, _ = site.heliostat[0].pivot_enu_m
    walls = [
        {"id": f"W{k}", "base_enu_m": (east + x, north + y, -1.0), "size_m": (9 - abs(2 * x), 9 - abs(2 * y), 90)}
        for k, (x, y) in enumerate([(4, 0), (-4, 0), (0, 4), (0, -4)])
    ]
    walled = site.changed(multipath={"foresee": ["ground"], "visibility": True}, site={"structures": {"box": walls}})
    walled.save(folder / "walled.toml")
    learning = {"receiver_delay_drift_s_per_sqrt_min": 1e-12, "receiver_delay_sigma_s": None}
    site.changed(heliostat=[h.model_copy(update=learning) for h in site.heliostat]).save(folder / "learning.toml")
    found: dict[str, list[Any]] = {}
    before = Path.cwd()
    os.chdir(folder)
    try:
        for line in LINES.strip().splitlines():
            done = CliRunner().invoke(app, [*shlex.split(line), "--json"])
            assert done.exit_code == 0, f"{line}: {done.stderr}"
            found.setdefault(command_of(line), []).append(json.loads(done.stdout))
    finally:
        os.chdir(before)
    return found


def test_every_command_is_held_to_the_page() -> None:
    assert {command_of(line) for line in LINES.strip().splitlines()} | set(APART) == {name for name, _ in commands()}
    assert {name.split()[0] for name, _ in commands()} == set(COMMANDS)


@pytest.mark.parametrize("command", [name for name, _ in commands() if name not in APART])
def test_keys_are_those_of_the_page(command: str, printed: dict[str, list[Any]]) -> None:
    assert not undocumented(command, printed[command])
    assert not unseen(command, printed[command])
