"""``rfpose layout``: what a site can reach before it is built, and where its transmitters should stand."""

from __future__ import annotations

import importlib

import click

__all__ = ["command"]

_COMMANDS = {
    "map": "map_command",
    "optimise": "optimise_command",
    "compare": "compare_command",
    "budget": "budget_command",
    "tones": "tones_command",
}


class _Studies(click.Group):
    """Loads a study's module when it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        found: click.Command = importlib.import_module(f"rfpose.cli.layout.{_COMMANDS[cmd_name]}").command
        return found


@click.group(name="layout", cls=_Studies)
def command() -> None:
    """Study a site before it is built: accuracy of every mirror, places of the transmitters, sources of error.

    Milliradians are of the mirror normal; the beam turns by twice as much.
    """
