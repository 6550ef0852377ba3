"""The reference of the command line, from the commands themselves: ``python -m rfpose.cli._reference``.

What it prints is ``docs/command-reference.md``.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator

import click

from rfpose.cli._app import app

__all__ = ["commands", "reference"]

_HEAD = """\
# Commands and options

Made from the commands by `python -m rfpose.cli._reference > docs/command-reference.md`. What all commands have in
common stands in [command-line.md](command-line.md), what they print with `--json` in [json-output.md](json-output.md).
Every command has `--help`, `--json` and `--debug` besides.
"""
_BAR = " \\| "
_COMMON = ("json", "debug", "help")


def commands() -> Iterator[tuple[str, click.Command]]:
    """Yield each command as typed after ``rfpose``, a group's sub-commands instead of the group."""
    context = click.Context(app)
    for name in app.list_commands(context):
        command = app.get_command(context, name)
        if isinstance(command, click.Group):
            inner = click.Context(command, parent=context)
            for sub in command.list_commands(inner):
                found = command.get_command(inner, sub)
                assert found is not None
                yield f"{name} {sub}", found
        elif command is not None:
            yield name, command


def reference() -> str:
    """Return the reference as Markdown."""
    return "\n".join([_HEAD, *(_section(name, command) for name, command in commands())])


def _section(name: str, command: click.Command) -> str:
    arguments = [p for p in command.params if isinstance(p, click.Argument)]
    options = [p for p in command.params if isinstance(p, click.Option) and p.name not in _COMMON]
    usage = " ".join(["rfpose", name, "[OPTIONS]" if options else "", *map(_argument, arguments)])
    rows = [f"| {_names(option)} | {_meaning(option)} |" for option in options]
    parts = [
        f"## `rfpose {name}`",
        f"`{' '.join(usage.split())}`",
        inspect.cleandoc(command.help or "").replace("\b\n", ""),
    ]
    if rows:
        parts.append("\n".join(["| option | |", "|---|---|", *rows]))
    examples = [line.strip() for line in (command.epilog or "").splitlines() if line.startswith("  ")]
    if examples:
        parts.append("\n".join(["```", *examples, "```"]))
    return "\n\n".join(parts) + "\n"


def _argument(argument: click.Argument) -> str:
    name = argument.human_readable_name
    if isinstance(argument.type, click.Choice):
        name = "|".join(argument.type.choices)
    name += "..." if argument.nargs == -1 else ""
    return name if argument.required else f"[{name}]"


def _names(option: click.Option) -> str:
    flags = ", ".join(f"`{flag}`" for flag in sorted([*option.opts, *option.secondary_opts], key=len))
    if option.is_flag:
        return flags
    if isinstance(option.type, click.Choice):
        return f"{flags} {_BAR.join(f'`{choice}`' for choice in option.type.choices)}"
    metavar = option.metavar or option.type.name.upper().replace(" RANGE", "")
    return f"{flags} {_in_table(metavar)}"


def _in_table(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _meaning(option: click.Option) -> str:
    text = _in_table(option.help or "")
    marks = ["required"] if option.required else []
    default = option.default
    if option.show_default and default is not None and not callable(default):
        shown = " ".join(map(str, default)) if isinstance(default, tuple) else str(default)
        marks.append(f"default: {shown}")
    if isinstance(option.type, click.IntRange | click.FloatRange):
        ends = zip(("from", "to"), (option.type.min, option.type.max), strict=True)
        marks.append(" ".join(f"{word} {end:g}" for word, end in ends if end is not None))
    return f"{text} [{'; '.join(filter(None, marks))}]" if any(marks) else text


if __name__ == "__main__":
    click.echo(reference(), nl=False)
