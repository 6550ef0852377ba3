"""``rfpose data``: where the files lie that come with rfpose."""

from __future__ import annotations

import click

from rfpose.cli._support import common_options, emit_json, examples, say, wants_json

__all__ = ["command"]


@click.command(
    name="data",
    epilog=examples("rfpose data", "rfpose data table2_100m.toml", 'rfpose info "$(rfpose data tracking_100m.toml)"'),
)
@click.argument("name", required=False)
@common_options
def command(name: str | None) -> None:
    """Print where the files lie that come with rfpose: scenarios and an antenna pattern.

    With NAME it prints that one's path alone, for use in other commands.
    """
    from rfpose.pipeline.demo import shipped_file, shipped_files

    found = shipped_files() if name is None else {name: shipped_file(name)}
    if wants_json():
        emit_json({"files": found})
        return
    for path in found.values():
        say(str(path))
