"""Every block of Python in README and docs runs as it stands, or says beside it why it does not."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rfpose as rf
from rfpose.feedback.mount import Mount, command, posture
from rfpose.sun import Location

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"(?:<!-- not run: (?P<reason>.+?) -->\n+)?```python\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)
TOLD = re.compile(r"^(\S.*?)  # ('.*')$", re.MULTILINE)
"""An expression, and what a comment says that it is."""
FOUND = [
    pytest.param(page.name, block["code"], id=f"{page.name}:{page.read_text()[: block.start()].count(chr(10)) + 1}")
    for page in PAGES
    for block in BLOCK.finditer(page.read_text())
    if not block["reason"]
]


def a_plants_own_measurements() -> dict[str, Any]:
    """What the block on fits takes for given."""
    rng = np.random.default_rng(1)
    true = Mount(pivot_enu_m=[20.0, 80.0, 3.0], parameters={"axis_1_zero_rad": 2e-3})
    azimuth, elevation = np.radians(rng.uniform([100.0, 20.0], [260.0, 65.0], (20, 2))).T
    suns = np.column_stack(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    aim = np.array([0.0, 0.0, 50.0])
    found = command(true, sun_enu=suns, target_enu_m=aim)
    return {
        "counts": found.count[:10],
        "normals": posture(true, found.count[:10]).normal_enu,
        "counts_by_day": found.count[10:],
        "suns": suns[10:],
        "spots": np.tile(aim, (10, 1)),
        "sun": suns[0],
        "aim": aim,
        "site": Location(latitude_rad=0.65, longitude_rad=-0.04),
        "times": 1782043200.0 + 3600.0 * np.arange(4),
    }


@pytest.mark.parametrize(("name", "code"), FOUND)
def test_block_runs(name: str, code: str, workshop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if "xarray" in code or "pandas" in code:
        pytest.importorskip("h5netcdf", reason="labelled arrays need the extra `labelled`")
    folder = tmp_path / "work"
    shutil.copytree(workshop, folder)
    shutil.copy(ROOT / "data" / "antenna_front_433MHz.h5", folder / "data")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    if "result.h5" in code and "save(" not in code:
        rf.process("recording.h5", "result.h5")
    given = a_plants_own_measurements() if name == "heliostat-calibration.md" else {}
    exec(compile(code, name, "exec"), given)
    for expression, value in TOLD.findall(code):
        assert repr(eval(expression, given)) == value


def test_what_comments_tell_is_found() -> None:
    """Else nothing of a block would be compared."""
    assert ("reply.reasons[0]", "'APPROACH refused: it tracks its aim already'") in [
        told for each in FOUND for told in TOLD.findall(each.values[1])
    ]
