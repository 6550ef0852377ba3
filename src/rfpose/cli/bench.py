"""``rfpose bench``: how fast this machine does it, against what a user would write with scipy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import click

from rfpose.cli._support import common_options, emit_json, examples, progress, table, wants_json

__all__ = ["command"]


@click.command(name="bench", epilog=examples("rfpose bench", "rfpose bench --json --seconds 10"))
@click.option(
    "--seconds",
    type=click.FloatRange(min=0.0, min_open=True),
    default=3.0,
    show_default=True,
    help="Time spent on each measurement.",
)
@common_options
def command(seconds: float) -> None:
    """Measure the speed of signal processing and multilateration on this machine."""
    with progress("Measuring"):
        from rfpose.pipeline.bench import run

        measured = run(seconds=seconds)
    if wants_json():
        emit_json(measured)
        return
    table("Speed on this machine", ["", "value"], [[name, f"{value:,.4g}"] for name, value in _flat(measured)])


def _flat(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield ``dotted.name, number`` for every number in nested mappings."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{prefix}{key}", value
