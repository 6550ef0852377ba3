"""What the commands share: the two common options, JSON, progress, small texts."""

from __future__ import annotations

import contextlib
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import click

__all__ = [
    "Progress",
    "Session",
    "common_options",
    "emit_json",
    "examples",
    "follow_links_option",
    "force_option",
    "progress",
    "say",
    "table",
    "wants_json",
]

F = TypeVar("F", bound=Callable[..., Any])


@dataclass
class Session:
    """What the common options said; it reaches the error handler even when a command fails."""

    debug: bool = False
    json: bool = False
    when_interrupted: str = "interrupted; nothing was written"


def common_options(function: F) -> F:
    """Add ``--json`` and ``--debug`` to a command."""

    def remember(ctx: click.Context, parameter: click.Parameter, value: bool) -> None:
        setattr(ctx.ensure_object(Session), str(parameter.name), value)

    settings: dict[str, Any] = {"is_flag": True, "expose_value": False, "callback": remember}
    function = click.option("--debug", help="On failure show the traceback.", **settings)(function)
    return click.option("--json", help="Print one JSON object on standard output.", **settings)(function)


def force_option(function: F) -> F:
    """Add ``--force`` to a command that writes files."""
    return click.option("--force", is_flag=True, help="Overwrite what exists.")(function)


def follow_links_option(function: F) -> F:
    """Add ``--follow-links`` to a command that opens recordings."""
    return click.option(
        "--follow-links",
        is_flag=True,
        help="Read what a recording names outside its own folder. [default: refuse; it may come from elsewhere]",
    )(function)


def examples(*lines: str) -> str:
    """Return an epilog that click leaves unwrapped."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def wants_json() -> bool:
    """Tell whether the running command was asked for JSON."""
    return click.get_current_context().ensure_object(Session).json


def emit_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output; what is not finite becomes null."""
    click.echo(json.dumps(_plain(data), indent=2, ensure_ascii=False, allow_nan=False))


def _plain(value: Any) -> Any:
    """Turn arrays, paths, tuples and numpy scalars into what JSON knows."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def say(text: str) -> None:
    """Print a line for a person; with ``--json`` it goes to standard error."""
    click.echo(text, err=wants_json())


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a small table for a person; with ``--json`` it goes to standard error."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    # as Text, since square brackets hold units here and are no markup
    grid = Table(title=Text(title), title_justify="left", header_style="bold")
    for i, name in enumerate(header):
        grid.add_column(Text(name), justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        grid.add_row(*(Text(cell) for cell in row))
    Console(file=sys.stderr if wants_json() else sys.stdout).print(grid)


@contextlib.contextmanager
def progress(text: str) -> Iterator[Progress]:
    """Give a callback that draws a bar on standard error if that is a terminal."""
    if not sys.stderr.isatty():
        yield Progress(None)
        return
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.progress import TextColumn, TimeElapsedColumn, TimeRemainingColumn

    default = Bar.get_default_columns()[:-1]
    columns = (*default, TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        shown = Progress(bar)
        shown.stage(text)
        yield shown


class Progress:
    """Called with (done, total) of a stage; draws nothing without a bar."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar
        self._task: Any = None

    def stage(self, text: str) -> None:
        """Begin another stage, with a bar of its own."""
        if self._bar is not None:
            self._task = self._bar.add_task(text, total=None)

    def __call__(self, done: int, total: int) -> None:
        """Move the bar."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total)
