"""``rfpose info``: what a file holds and whether it is sound."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from rfpose.cli._support import common_options, emit_json, examples, say, wants_json

__all__ = ["command"]


@click.command(
    name="info",
    epilog=examples("rfpose info recording.h5", "rfpose info result.h5 --json", "rfpose info site.toml"),
)
@click.argument("file", type=click.Path(path_type=Path))
@common_options
def command(file: Path) -> None:
    """Say what a recording, a result or a scenario holds and whether it is sound."""
    from rfpose.pipeline.inspect import inspect_file

    found = inspect_file(file)
    if wants_json():
        emit_json(found)
        return
    _print(found, indent=0)


def _print(data: Mapping[str, Any], *, indent: int) -> None:
    """Print nested facts, one a line."""
    for key, value in data.items():
        name = " " * indent + key.replace("_", " ")
        if isinstance(value, Mapping):
            say(f"{name}:")
            _print(value, indent=indent + 2)
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            say(f"{name}:")
            for item in value:
                say(" " * (indent + 2) + ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in item.items()))
        elif isinstance(value, list | tuple):
            say(f"{name}: {', '.join(str(item) for item in value) or 'none'}")
        else:
            say(f"{name}: {'unknown' if value is None else value}")
