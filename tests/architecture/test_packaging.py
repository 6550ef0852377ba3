"""What an index shows of rfpose, and what a citation names, is what stands in the code."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

import rfpose

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_metadata_is_fit_for_an_index() -> None:
    assert PROJECT["authors"] == [{"name": "rfpose developers"}]
    assert "urls" not in PROJECT  # until a release has a place to name
    lowest = PROJECT["requires-python"].removeprefix(">=")
    named = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)]
    assert named[0] == lowest
    assert named == [f"3.{minor}" for minor in range(11, 11 + len(named))]
    assert not any(c.startswith("License") for c in PROJECT["classifiers"])  # the licence is an expression


def test_every_dependency_has_a_lowest_version_that_the_matrix_can_install() -> None:
    for line in PROJECT["dependencies"]:
        assert re.fullmatch(r"[\w.-]+>=[\d.]+", line), line


def test_citation_names_this_version_and_what_the_code_cites() -> None:
    yaml = pytest.importorskip("yaml")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == rfpose.__version__
    assert citation["license"] == PROJECT["license"]
    assert citation["authors"] == PROJECT["authors"]
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "src").rglob("*.py")]
    text = " ".join(" ".join(page.read_text().split()) for page in pages).lower()
    for reference in citation["references"]:
        assert reference["title"].lower() in text, reference["title"]
        assert all(author.get("family-names", "").lower() in text for author in reference["authors"])
        assert reference.get("doi", "") in text
