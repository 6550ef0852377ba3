"""Every command in README and docs runs as it stands, or says beside it why it does not.

They run where the files lie that they name, on a field of two heliostats; ``$(rfpose data NAME)`` and ``data/NAME`` are
shorter files of that name. ``<!-- not run: REASON -->`` before a block leaves it out. ``rfpose view`` without
``--save`` opens a window, which tests/viewer does.
"""

from __future__ import annotations

import glob
import re
import shlex
import shutil
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from rfpose.cli._app import app

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
APART = {"first-hour.md": "test_first_hour.py", "command-reference.md": "test_command_reference.py"}
"""Pages that have a test of their own."""
COMMAND = re.compile(r"^(?:\$ )?(?:rfpose|python|pip|apt-get|eval|scripts/\w+) ")
NOT_RUN = re.compile(r"<!-- not run: (.+?) -->")


def _blocks(page: Path) -> list[tuple[int, list[str]]]:
    """Return the commands of each block that is to run, with the block's line."""
    out: list[tuple[int, list[str]]] = []
    lines = page.read_text().splitlines()
    k, before = 0, ""
    while k < len(lines):
        begin, fenced = k, re.match(r"```(\w*)$", lines[k])
        if fenced:
            k = lines.index("```", k + 1)
            body = lines[begin + 1 : k] if fenced[1] in ("", "console", "sh") else []
        else:
            while k < len(lines) and lines[k].startswith("    "):
                k += 1
            body = [line.strip() for line in lines[begin:k]]
            k = max(k - 1, begin)
        commands = [line.removeprefix("$ ") for line in body if COMMAND.match(line)]
        if commands and not NOT_RUN.search(before):
            out.append((begin + 1, commands))
        if lines[begin].strip():
            before = lines[begin]
        k += 1
    return out


FOUND = [(page, line, commands) for page in PAGES if page.name not in APART for line, commands in _blocks(page)]
BY_PAGE = {page.name: [block for block in FOUND if block[0] == page] for page in PAGES}


def words_of(command: str, folder: Path) -> list[str]:
    """Return a command's words as a shell would have them; files of rfpose are the shorter ones of this test."""
    typed = command.partition("  #")[0].strip()
    typed = re.sub(r'"\$\(rfpose data ([\w.]+)\)"', r"data/\1", typed)
    program, *words = shlex.split(typed)
    assert program == "rfpose", f"{command}: only rfpose is run here; say why it is not (<!-- not run: … -->)"
    return [one for word in words for one in (sorted(glob.glob(word, root_dir=folder)) or [word])]


def opens_a_window(words: list[str]) -> bool:
    return words[0] == "view" and "--save" not in words


@pytest.mark.parametrize(("page", "line", "commands"), FOUND, ids=[f"{p.name}:{line}" for p, line, _ in FOUND])
def test_commands_are_taken(page: Path, line: int, commands: list[str]) -> None:
    for command in commands:
        words = words_of(command, ROOT)
        found: click.Command = app
        context = click.Context(app)
        while isinstance(found, click.Group):
            found, words = found.get_command(context, words[0]), words[1:]
        assert found is not None, command
        found.make_context(command, words)


@pytest.mark.parametrize("name", [name for name, blocks in BY_PAGE.items() if blocks])
def test_commands_do_what_they_say(
    name: str, workshop: Path, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = request.getfixturevalue("calibrations") if name == "heliostat-calibration.md" else workshop
    shutil.copytree(source, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    for page, line, commands in BY_PAGE[name]:
        for command in commands:
            words = words_of(command, tmp_path)
            if opens_a_window(words):
                continue
            if words[0] == "view":
                pytest.importorskip("PySide6", reason="pictures of the viewer need the extra `gui`")
            outputs = [words[k + 1] for k, word in enumerate(words) if word in ("-o", "--csv", "--picture", "--save")]
            for output in outputs:
                Path(output).unlink(missing_ok=True)
            done = CliRunner().invoke(app, words)
            assert done.exit_code == 0, f"{page.name}:{line} {command}: {done.stderr}"
            assert all(Path(output).exists() for output in outputs), command
