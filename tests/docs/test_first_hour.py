"""docs/first-hour.md: every command runs and prints what the page shows."""

from __future__ import annotations

import re
from pathlib import Path

from docs.transcript import run, same, steps, write_files

PAGE = Path(__file__).resolve().parents[2] / "docs" / "first-hour.md"


def test_ten_commands_lead_from_a_table_to_a_report(tmp_path: Path) -> None:
    """Write the page anew with `python tests/docs/transcript.py docs/first-hour.md`."""
    write_files(PAGE, tmp_path)
    found = steps(PAGE)
    assert len(found) == 10
    for step in found:
        printed = run(step.command, tmp_path)
        assert same(step.shown, printed), f"{step.command} printed:\n{printed}"
    made = {"site.png", "map.png", "budget.png", "poses.csv", "field.png", "report.html"}
    assert made < {path.name for path in tmp_path.iterdir()}
    # names of vocabularies are no addresses that anything is loaded from
    assert not re.search(r"(src|href)\s*=\s*.http|url\(.?http", (tmp_path / "report.html").read_text())


def test_a_changed_number_or_word_is_seen() -> None:
    assert same("rms 0.550 mrad\n", "rms 0.551 mrad\n")
    assert not same("rms 0.550 mrad\n", "rms 0.650 mrad\n")
    assert not same("rms 0.550 mrad\n", "RMS 0.550 mrad\n")
    assert not same("a 1\n", "a 1 2\n")
