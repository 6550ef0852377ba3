"""Commands in a page, with what they print: run, compared, and written anew.

Anew by ``python tests/docs/transcript.py docs/first-hour.md``.
"""

from __future__ import annotations

import contextlib
import math
import re
import shlex
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from click.testing import CliRunner

from rfpose.cli._app import app

BLOCK = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^`([\w.]+)`:\n\n```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(?<![\w.])[-+−]?\d+(?:[.,]\d+)?(?:e[-+]?\d+)?(?![\w])")


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A command, as typed, and the lines that the page has below it."""

    command: str
    shown: str


def steps(page: Path) -> list[Step]:
    """Return the commands of a page in their order."""
    out = []
    for block in BLOCK.finditer(page.read_text()):
        for part in re.split(r"^\$ ", block[1], flags=re.MULTILINE)[1:]:
            command, _, shown = part.partition("\n")
            out.append(Step(command=command.partition("  #")[0].strip(), shown=shown))
    return out


def write_files(page: Path, folder: Path) -> None:
    """Write the files that a page shows."""
    for name, content in FILE.findall(page.read_text()):
        (folder / name).write_text(content)


def run(command: str, folder: Path) -> str:
    """Run a command as in a shell and return what it prints; notes and progress are left out.

    In this process, which spares loading all anew.
    """
    program, *words = shlex.split(command)
    assert program == "rfpose", command
    environment = {"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"}
    with contextlib.chdir(folder):
        shown = CliRunner().invoke(app, words, env=environment)
    assert shown.exit_code == 0, f"{command}: {shown.stderr}"
    return "".join(f"{line.rstrip()}\n" for line in shown.stdout.splitlines())


def same(shown: str, printed: str, *, rel: float = 0.05) -> bool:
    """Tell whether two prints are alike: the same words, and numbers that agree."""
    if _words(shown) != _words(printed):
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(math.isclose(_value(a), _value(b), rel_tol=rel, abs_tol=1e-9) for a, b in pairs)


def _words(text: str) -> list[str]:
    return re.sub(r"[━─┏┓┡┩└┘┴┬╇┳│┃]+", " ", NUMBER.sub("#", text)).split()


def _value(text: str) -> float:
    return float(text.replace("−", "-").replace(",", "."))


def written_anew(page: Path) -> str:
    """Return the page with what its commands print now."""
    text = page.read_text()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_files(page, folder)

        def renew(block: re.Match[str]) -> str:
            lines = [line for line in block[1].splitlines() if line.startswith("$ ")]
            parts = [f"{line}\n{run(line[2:], folder)}" for line in lines]
            return "```console\n" + "".join(parts) + "```"

        return BLOCK.sub(renew, text)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(written_anew(Path(sys.argv[1])))
