"""The reference of the command line is what the commands say of themselves; examples are lines that they take."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from rfpose.cli._app import COMMANDS, app
from rfpose.cli._reference import commands, reference

DOCS = Path(__file__).resolve().parents[2] / "docs"
TEXT = (DOCS / "command-line.md").read_text()
EXAMPLES = [
    line.strip() for _, c in commands() for line in (c.epilog or "").splitlines() if line.strip().startswith("rfpose ")
]


def test_reference_is_up_to_date() -> None:
    """Write it anew with `python -m rfpose.cli._reference > docs/command-reference.md`."""
    assert (DOCS / "command-reference.md").read_text() == reference()


@pytest.mark.parametrize("name", COMMANDS)
def test_command_line_page_tells_of_each_command_and_its_json(name: str) -> None:
    found = re.search(rf"^## `rfpose {name}\b.*?(?=^## |\Z)", TEXT, re.MULTILINE | re.DOTALL)
    assert found, f"docs/command-line.md has no section on `rfpose {name}`"
    assert "JSON" in found[0]


@pytest.mark.parametrize("line", EXAMPLES)
def test_examples_of_help_are_taken(line: str) -> None:
    """Options exist and have such values; what the lines do is tested with the commands."""
    _, *words = shlex.split(line.replace("$(", "").replace(")", ""))
    command: click.Command = app
    context = click.Context(app)
    while isinstance(command, click.Group):
        name, words = words[0], words[1:]
        command = command.get_command(context, name)
    command.make_context(name, words)


@pytest.mark.parametrize(
    ("typed", "offered"), [("pro", "process"), ("layout op", "optimise"), ("process --est", "--estimator")]
)
def test_shells_can_complete(typed: str, offered: str) -> None:
    words = f"rfpose {typed}"
    environment = os.environ | {
        "_RFPOSE_COMPLETE": "bash_complete",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    command = [sys.executable, "-c", "from rfpose.cli import main; main()"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert offered in [line.partition(",")[2] for line in done.stdout.splitlines()]
