"""The tutorials run as they stand, and the site is built from docstrings and pages without a warning."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.py"))


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_tutorial_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.figure import Figure

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    left = runpy.run_path(str(path))
    assert any(isinstance(value, Figure) for value in left.values())


def test_all_four_are_there() -> None:
    assert len(TUTORIALS) == 4


def test_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """Pages and reference; the tutorials, which run above, are not run again."""
    for needed in ("numpydoc", "myst_parser", "sphinx_gallery"):
        pytest.importorskip(needed, reason="the site needs the extra `docs`")
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "-b", "dummy", "-d", str(tmp_path)]
    command += ["-D", "sphinx_gallery_conf.plot_gallery=0", str(DOCS), str(tmp_path / "site")]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
