"""The group of commands, and what becomes of errors."""

from __future__ import annotations

import contextlib
import importlib
import logging
import traceback
from collections.abc import Iterator
from typing import Any, NoReturn

import click

from rfpose import __version__, interruption
from rfpose.cli._support import CommonOptions, emit_json, in_options
from rfpose.errors import RfposeError

__all__ = ["app"]

COMMANDS = (
    "demo",
    "init",
    "simulate",
    "info",
    "process",
    "evaluate",
    "survey",
    "antenna",
    "layout",
    "calibrate",
    "aim",
    "track",
    "convert",
    "publish",
    "view",
    "plot",
    "sample",
    "data",
    "warm-up",
    "bench",
)

EXIT_UNEXPECTED = 1
EXIT_BAD_DATA = 3
EXIT_INTERRUPTED = 130


class _LazyGroup(click.Group):
    """Loads a sub-command's module when it is asked for, and turns errors into one line and an exit code."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = importlib.import_module(f"rfpose.cli.{cmd_name.replace('-', '_')}").command
        return command

    def make_context(self, *args: Any, **settings: Any) -> click.Context:
        try:
            return super().make_context(*args, **settings)
        except KeyboardInterrupt:  # while the command's module was loaded
            raise click.exceptions.Exit(EXIT_INTERRUPTED) from None

    def invoke(self, ctx: click.Context) -> Any:
        session = ctx.ensure_object(CommonOptions)
        try:
            with interruption.heard(), _notes_to_stderr():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            _leave(ctx, session.when_interrupted)
        except RfposeError as error:
            _fail(ctx, session, in_options(str(error), session.options), EXIT_BAD_DATA)
        except (BrokenPipeError, click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except MemoryError as error:
            _fail(ctx, session, f"out of memory: {error or 'use shorter frames or fewer receivers'}", EXIT_BAD_DATA)
        except OSError as error:
            place = f"{error.filename}: " if error.filename else ""
            _fail(ctx, session, f"{place}{error.strerror or error}", EXIT_BAD_DATA)
        except Exception as error:  # noqa: BLE001 -- the last resort: one line for the user, traceback on request
            text = f"unexpected {type(error).__name__}: {error}; run again with --debug and report the traceback"
            _fail(ctx, session, text, EXIT_UNEXPECTED)


class _StderrHandler(logging.Handler):
    """Shows what the library logs as one line each on standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        click.echo(f"rfpose: note: {record.getMessage()}", err=True)


@contextlib.contextmanager
def _notes_to_stderr() -> Iterator[None]:
    """While it lasts, warnings of the library appear on standard error, and that it compiles."""
    handler = _StderrHandler()
    logger, compiler = logging.getLogger("rfpose"), logging.getLogger("rfpose.jit")
    level = compiler.level
    logger.addHandler(handler)
    compiler.setLevel(logging.INFO)
    try:
        yield
    finally:
        compiler.setLevel(level)
        logger.removeHandler(handler)


def _leave(ctx: click.Context, message: str) -> NoReturn:
    """End after an interruption; another one, or a terminal that is gone, changes nothing any more."""
    with interruption.ignored():
        from rfpose.files import release_all

        release_all()
        with contextlib.suppress(OSError):
            click.echo(f"\nrfpose: {message}", err=True)
        ctx.exit(EXIT_INTERRUPTED)


def _fail(ctx: click.Context, session: CommonOptions, message: str, code: int) -> NoReturn:
    """Print one line (and the traceback if asked for), give the JSON reader its object, and leave.

    What takes no more text, such as a full disk, may be why the command failed: the other streams still get theirs.
    """
    line = " ".join(message.split())
    with contextlib.suppress(OSError):
        if session.debug:
            click.echo(traceback.format_exc(), err=True)
        click.echo(f"rfpose: {line}", err=True)
    with contextlib.suppress(OSError):
        if session.json:
            emit_json({"error": line, "exit_code": code})
    ctx.exit(code)


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="rfpose", message="%(prog)s %(version)s")
def app() -> None:
    """Measure where heliostat mirrors point, by radio.

    Transmitters around the field send ranging tones; receivers on the mirrors record them. From such a recording
    come the receivers' positions and the mirrors' normals, with how far to trust them.

    Start with `rfpose demo`.
    """
