"""The options by which a command's work is given to other processes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import click

__all__ = ["engine_options"]

F = TypeVar("F", bound=Callable[..., Any])


def engine_options(function: F) -> F:
    """Add ``--scheduler`` and ``--workers``, by which the command's jobs are shared."""

    @functools.wraps(function)
    def with_engine(*args: Any, scheduler: str | None, workers: int | None, **settings: Any) -> Any:
        from rfpose.engine import Engine

        with Engine(scheduler=scheduler, workers=workers).used():
            return function(*args, **settings)

    for option in (
        click.option(
            "--workers",
            type=click.IntRange(min=1),
            help="Share the work among so many processes of this machine, which are started for it.",
        ),
        click.option(
            "--scheduler",
            metavar="ADDRESS",
            help="Share the work among the workers of a Dask scheduler, such as tcp://host:8786; paths must lead to "
            "the same files for them.",
        ),
    ):
        with_engine = option(with_engine)
    return with_engine  # type: ignore[return-value]
