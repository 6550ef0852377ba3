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
    epilog=examples(
        "rfpose info recording.h5",
        "rfpose info result.h5 --json",
        "rfpose info site.toml",
        "rfpose info models.json",
    ),
)
@click.argument("file", type=click.Path(path_type=Path))
@common_options
def command(file: Path) -> None:
    """Say what a recording, a result, a scenario or a file of mounts holds and whether it is sound."""
    from rfpose.pipeline.inspect import inspect_file

    found = inspect_file(file)
    if wants_json():
        emit_json(found)
        return
    _print(found, indent=0)


def _print(data: Mapping[str, Any], *, indent: int) -> None:
    """Print nested facts, one a line; a table of tables has one row a line."""
    for key, value in data.items():
        name = " " * indent + key.replace("_", " ")
        if isinstance(value, Mapping) and value and all(isinstance(item, Mapping) for item in value.values()):
            say(f"{name}:")
            for row, facts in value.items():
                say(
                    f"{' ' * indent}  {row}: "
                    + ", ".join(f"{k.replace('_', ' ')} {_text(v)}" for k, v in facts.items())
                )
        elif isinstance(value, Mapping) and value:
            say(f"{name}:")
            _print(value, indent=indent + 2)
        else:
            say(f"{name}: {_text(value)}")


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, list | tuple | Mapping):
        return ", ".join(_text(item) for item in value) or "none"
    return "unknown" if value is None else str(value)
