"""What the commands share: the two common options, JSON, progress, small texts."""

from __future__ import annotations

import contextlib
import functools
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import click

from rfpose.errors import InvalidInputError, RecordingError

if TYPE_CHECKING:
    from rfpose.recording.declared import Declared

__all__ = [
    "CommonOptions",
    "Progress",
    "check_directory",
    "check_ending",
    "check_readable",
    "check_scenario",
    "check_table",
    "check_there",
    "common_options",
    "declared_options",
    "emit_json",
    "examples",
    "follow_links_option",
    "force_option",
    "gathered",
    "in_options",
    "outputs",
    "progress",
    "say",
    "table",
    "wants_json",
    "when_written",
]

F = TypeVar("F", bound=Callable[..., Any])


@dataclass
class CommonOptions:
    """What the common options said; it reaches the error handler even when a command fails."""

    debug: bool = False
    json: bool = False
    options: Mapping[str, click.Parameter] = field(default_factory=dict)
    """Of the running command, by the names that the library has for them."""
    when_interrupted: str = "interrupted; nothing was written"


def common_options(function: F) -> F:
    """Add ``--json`` and ``--debug`` to a command."""

    def remember(ctx: click.Context, parameter: click.Parameter, value: bool) -> None:
        session = ctx.ensure_object(CommonOptions)
        session.options = {str(each.name): each for each in ctx.command.params}
        setattr(session, str(parameter.name), value)

    settings: dict[str, Any] = {"is_flag": True, "expose_value": False, "callback": remember}
    function = click.option("--debug", help="On failure show the traceback.", **settings)(function)
    return click.option("--json", help="Print one JSON object on standard output.", **settings)(function)


def in_options(text: str, options: Mapping[str, click.Parameter]) -> str:
    """Say what the library says of its arguments, such as `force=True`, in a command's options.

    An argument that a message begins with is meant as well; other words in backticks are keys of files.
    """

    def option(found: re.Match[str]) -> str:
        parameter, value = options.get(found[1]), (found[2] or "").strip("='")
        if not isinstance(parameter, click.Option):
            return found[0]
        if value == "False" and parameter.secondary_opts:
            return parameter.secondary_opts[0]
        flag = max(parameter.opts, key=len)
        return f"`{flag}`" if found[2] is None else flag if value in ("", "True") else f"{flag} {value}"

    return re.sub(r"`(\w+)(=[^`]*)`", option, re.sub(r"^`(\w+)(=)?`", option, text))


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


def gathered(parameter: str, record: type) -> Callable[[F], F]:
    """Hand a command those options that are fields of ``record`` as one, in its parameter ``parameter``.

    It stands under the options, which keep their order in the help.
    """
    names = [each.name for each in fields(record)]

    def decorate(function: F) -> F:
        @functools.wraps(function)
        def called(*args: Any, **options: Any) -> Any:
            options[parameter] = record(**{name: options.pop(name) for name in names})
            return function(*args, **options)

        return cast(F, called)

    return decorate


def declared_options(function: F) -> F:
    """Add what files of samples do not say of themselves; the command gets it as one argument, ``declared``."""

    @functools.wraps(function)
    def command(*args: Any, **given: Any) -> Any:
        names = ("file_format", "sample_type", "sample_rate", "start", "centre_frequency_hz", "receiver_ids")
        return function(*args, declared=_declared(**{name: given.pop(name) for name in names}), **given)

    added: Any = command
    for option in (
        click.option(
            "--receiver",
            "receiver_ids",
            multiple=True,
            help="With --format: the receiver's name; once for each, in order.",
        ),
        click.option("--centre", "centre_frequency_hz", help="With --format: radio frequency at baseband zero, Hz."),
        click.option("--start", help="With --format: when the first sample was taken, as 2026-09-21T14:00:00.123Z."),
        click.option("--rate", "sample_rate", help="With --format: samples a second, also as a fraction: 10000000/3."),
        click.option("--sample-type", help="With --format: ci8, cu8, ci16_le, ci16_be, ci32_le, cf32_le and so on."),
        click.option(
            "--format",
            "file_format",
            type=click.Choice(("raw", "wav")),
            help="The files are raw interleaved IQ, or WAV; the next options say what they do not say of themselves.",
        ),
    ):
        added = option(added)
    return cast(F, added)


def _declared(
    file_format: Any,
    sample_type: str | None,
    sample_rate: str | None,
    start: str | None,
    centre_frequency_hz: str | None,
    receiver_ids: Any,
) -> Declared | None:
    """Return what the options say of files of samples, by the library's names; None where nothing is said."""
    told = {
        "--sample-type": sample_type,
        "--rate": sample_rate,
        "--start": start,
        "--centre": centre_frequency_hz,
        "--receiver": receiver_ids,
    }
    if file_format is None:
        if lone := [name for name, value in told.items() if value]:
            raise InvalidInputError(f"{lone[0]} goes with --format raw or --format wav")
        return None
    from rfpose.foreign import exact_number, exact_rate
    from rfpose.recording.declared import Declared, seconds_of

    exact = None if sample_rate is None else exact_number("sample_rate", sample_rate)
    centre = centre_frequency_hz
    return Declared(
        format=file_format,
        sample_type=sample_type,
        sample_rate=None if exact is None else exact_rate("sample_rate", exact),
        start_s=None if start is None else seconds_of(start, "`start`"),
        centre_frequency_hz=None if centre is None else float(exact_number("centre_frequency_hz", centre)),
        receiver_ids=tuple(receiver_ids),
    )


def examples(*lines: str) -> str:
    """Return an epilog that click leaves unwrapped."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def wants_json() -> bool:
    """Tell whether the running command was asked for JSON."""
    return click.get_current_context().ensure_object(CommonOptions).json


def emit_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output; what is not finite becomes null."""
    import json

    from rfpose.shown import plain

    click.echo(json.dumps(plain(data), indent=2, ensure_ascii=False, allow_nan=False))


def say(text: str) -> None:
    """Print a line for a person; with ``--json`` it goes to standard error."""
    click.echo(text, err=wants_json())


_WIDE = 1000
"""Letters; more than any table has."""


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
    console = Console(file=sys.stderr if wants_json() else sys.stdout)
    if not console.is_terminal:  # a file or a pipe has room for all of it
        console.width = max(console.width, console.measure(grid, options=console.options.update(width=_WIDE)).maximum)
    console.print(grid)


@contextlib.contextmanager
def outputs(
    *paths: Path | None, inputs: Iterable[Path | None] = (), force: bool = False, directories: bool = False
) -> Iterator[None]:
    """Check what a command will write before it loads or does anything; publish it when the block ends well.

    See `rfpose.files.claim`.
    """
    from rfpose.files import claim

    with claim(*paths, inputs=inputs, force=force, directories=directories):
        yield
    written = [path for path in paths if path is not None]
    if written:
        click.get_current_context().ensure_object(CommonOptions).when_interrupted = when_written(*written)


def when_written(*paths: Path) -> str:
    """Return what to say of an interruption that comes too late to prevent anything."""
    return f"interrupted when all was done: {', '.join(map(str, paths))} written"


def check_there(*paths: Path | None) -> None:
    """Refuse an input that is not there before anything is loaded for it."""
    for path in paths:
        if path is not None and not path.exists():
            raise RecordingError(f"{path}: no such file or directory; check the path")


def check_readable(path: Path, *, follow_links: bool = False) -> None:
    """Refuse what is nothing of ours, or cannot be opened, before all is loaded that shows it."""
    from rfpose.kinds import kind_of

    check_there(path)
    kind = kind_of(path)
    if kind == "scenario" or (kind is None and path.suffix == ".toml"):
        check_scenario(path)
    elif kind is None:
        from rfpose.recording import open_recording

        open_recording(path, follow_links=follow_links).close()


def check_directory(path: Path | None) -> None:
    """Refuse what is no directory before anything is loaded to read it."""
    check_there(path)
    if path is not None and not path.is_dir():
        raise RecordingError(f"{path}: is no directory; give the folder that holds the heliostats' folders")


def check_scenario(path: Path) -> None:
    """Refuse a scenario that is missing or malformed before the compiled code is loaded that works on it."""
    from rfpose.scenario import load_scenario

    load_scenario(path)


def check_ending(path: Path | None, *endings: str) -> None:
    """Refuse a name with another ending before any work is done for it."""
    if path is not None and path.suffix not in endings:
        raise InvalidInputError(f"{path}: its name must end in {', '.join(endings)}")


def check_table(path: Path | None, *endings: str) -> None:
    """Refuse a table that could not be written before any work is done for it."""
    check_ending(path, *endings)
    if path is not None and path.suffix == ".parquet":
        from rfpose.tables import labelled_library

        labelled_library("pyarrow")


_EVERY_S = 10.0
"""From one line of progress to the next, where no bar can be drawn [s]."""


@contextlib.contextmanager
def progress(text: str) -> Iterator[Progress]:
    """Give a callback that draws a bar on standard error if that is a terminal, else writes a line now and then."""
    if not sys.stderr.isatty():
        shown = _Lines(text)
        ended = threading.Event()
        # a thread, so that work that reports nothing is heard of too
        teller = threading.Thread(target=shown.tell_until, args=(ended,), name="rfpose-progress", daemon=True)
        teller.start()
        try:
            yield shown
        finally:
            ended.set()
            teller.join()
        return
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.progress import TextColumn, TimeElapsedColumn, TimeRemainingColumn

    default = Bar.get_default_columns()[:-1]
    columns = (*default, TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        drawn = _Drawn(bar)
        drawn.stage(text)
        yield drawn


class Progress(Protocol):
    """Called with (done, total) of a stage."""

    def stage(self, text: str) -> None:
        """Begin another stage."""

    def __call__(self, done: int, total: int) -> None:
        """Take note of how far the stage is."""


class _Drawn:
    """A bar for each stage."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar
        self._task: Any = None

    def stage(self, text: str) -> None:
        self._task = self._bar.add_task(text, total=None)

    def __call__(self, done: int, total: int) -> None:
        self._bar.update(self._task, completed=done, total=total)


class _Lines:
    """A line every `_EVERY_S`; nothing of what is over sooner."""

    def __init__(self, text: str) -> None:
        self.stage(text)

    def stage(self, text: str) -> None:
        now = time.monotonic()
        # one tuple, which the other thread sees as a whole
        self._state = (text, now, 0, 0, now)

    def __call__(self, done: int, total: int) -> None:
        text, began, *_ = self._state
        self._state = (text, began, done, total, time.monotonic())

    def tell_until(self, ended: threading.Event) -> None:
        """Write lines until the work has ended."""
        while not ended.wait(_EVERY_S):
            with contextlib.suppress(OSError):  # nobody reads
                click.echo(f"rfpose: {self.line()}", err=True)

    def line(self) -> str:
        """Return how far the stage is and how long it will still take."""
        text, began, done, total, at = self._state
        if not done:
            return f"{text}, for {_duration(time.monotonic() - began)}"
        if done >= total:  # what is found is being put together
            return f"{text}: all {total} done, finishing for {_duration(time.monotonic() - at)}"
        left = max(0.0, (at - began) * (total / done - 1.0) - (time.monotonic() - at))
        return f"{text}: {done} of {total}, {_duration(left)} left"


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"
