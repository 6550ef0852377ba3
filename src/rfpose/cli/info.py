"""``rfpose info``: what a file holds and whether it is sound."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rfpose.cli._support import (
    check_ending,
    check_there,
    common_options,
    declared_options,
    emit_json,
    examples,
    follow_links_option,
    force_option,
    outputs,
    say,
    table,
    wants_json,
)
from rfpose.errors import InvalidInputError
from rfpose.kinds import kind_of

if TYPE_CHECKING:
    from rfpose.recording.declared import Declared

__all__ = ["command"]

_MANY = ("receivers",)
"""Tables of what is usually alike."""
_MANY_RECEIVERS = 5
"""So many are counted, not named."""
_EACH = 20
"""Of other tables so many rows are printed each for itself."""


@click.command(
    name="info",
    epilog=examples(
        "rfpose info recording.h5",
        "rfpose info result.h5 --json",
        "rfpose info site.toml",
        "rfpose info site.toml --picture site.png",
        "rfpose info models.json",
        "rfpose info day.h5",
        "rfpose info night/*.h5 cal0/ --picture coverage.svg",
    ),
)
@click.argument("file", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--picture", type=click.Path(path_type=Path), help="Draw a scenario's site, or who recorded when: .png, .svg, .pdf."
)
@declared_options
@follow_links_option
@force_option
@common_options
def command(
    file: tuple[Path, ...], picture: Path | None, declared: Declared | None, follow_links: bool, force: bool
) -> None:
    """Say what a recording, a result, a tracking run, a scenario or a file of mounts holds and whether it is sound.

    Several files are the parts of one recording. Of a scenario also draw the site, in letters or with --picture; of a
    recording --picture draws who recorded when.
    """
    check_ending(picture, ".png", ".svg", ".pdf")
    given: Path | tuple[Path, ...] = file[0] if len(file) == 1 else file
    if isinstance(given, Path):
        check_there(given)
    from rfpose.pipeline.inspect import inspect_file

    found = inspect_file(given, declared=declared, follow_links=follow_links)
    is_site = found["kind"] == "scenario"
    if picture is not None:
        if found["kind"] not in ("scenario", "recording"):
            raise InvalidInputError(
                f"`picture` draws a scenario's site or who recorded when, and {file[0]} is no such file; `rfpose view` "
                "draws it"
            )
        with outputs(picture, inputs=file, force=force):
            _draw(given, picture, declared=declared, follow_links=follow_links)
    if wants_json():
        emit_json(found if picture is None else {**found, "picture": picture})
        return
    _print({key: value for key, value in found.items() if key != "parts"}, indent=0)
    if "parts" in found:
        _print_parts(found["parts"])
    if is_site and picture is None:
        from rfpose.pipeline.pictures.site import plan_in_letters
        from rfpose.scenario import load_scenario

        for line in ("", *plan_in_letters(load_scenario(file[0]))):
            say(line)
    if picture is not None:
        say(f"wrote {picture}")


def _draw(given: Path | tuple[Path, ...], picture: Path, *, declared: Declared | None, follow_links: bool) -> None:
    from rfpose.drawing import save_figure

    if declared is None and isinstance(given, Path) and given.suffix == ".toml" and kind_of(given) != "recording":
        from rfpose.pipeline.pictures.site import site_plan
        from rfpose.scenario import load_scenario

        save_figure(site_plan(load_scenario(given)), picture)
        return
    from rfpose.recording import open_recording

    with open_recording(given, declared=declared, follow_links=follow_links) as recording:
        save_figure(recording.plot_coverage(), picture)


def _print_parts(parts: Mapping[str, Mapping[str, Any]]) -> None:
    """Print who covers what, one part a line."""
    rows = [
        [
            name,
            part["format"],
            _text(part["receivers"] if len(part["receivers"]) < _MANY_RECEIVERS else len(part["receivers"])),
            _moment(part["start_utc"]),
            _moment(part["end_utc"]),
            f"{part['samples']:,}",
            str(part["gaps"]),
        ]
        for name, part in parts.items()
    ]
    table("parts", ["part", "format", "receivers", "from", "until", "samples", "gaps"], rows)


def _moment(utc: str | None) -> str:
    """Say a time to milliseconds."""
    return _text(utc) if utc is None else utc[:23].replace("T", " ")


def _print(data: Mapping[str, Any], *, indent: int) -> None:
    """Print nested facts, one a line; a table of tables has one row a line."""
    for key, value in data.items():
        name = " " * indent + key.replace("_", " ")
        if isinstance(value, Mapping) and value and all(isinstance(item, Mapping) for item in value.values()):
            say(f"{name}: {len(value)}")
            for row, facts in (value if len(value) <= _EACH and key not in _MANY else _alike(value)).items():
                say(
                    f"{' ' * indent}  {row}: "
                    + ", ".join(f"{k.replace('_', ' ')} {_text(v)}" for k, v in facts.items())
                )
        elif isinstance(value, Mapping) and value:
            say(f"{name}:")
            _print(value, indent=indent + 2)
        else:
            say(f"{name}: {_text(value)}")


def _alike(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Sum up rows whose facts are the same but for measured numbers, of which the range is told."""
    groups: dict[str, list[str]] = {}
    for name, facts in rows.items():
        same = {key: value for key, value in facts.items() if not isinstance(value, float)}
        groups.setdefault(repr(same) + repr(list(facts)), []).append(name)
    summed = {}
    for names in groups.values():
        title = names[0] if len(names) == 1 else f"{names[0]} … {names[-1]} ({len(names)} alike)"
        summed[title] = {key: _range([rows[name][key] for name in names]) for key in rows[names[0]]}
    return summed


def _range(values: list[Any]) -> Any:
    """Return the one value of all, or the range of numbers."""
    if not isinstance(values[0], float) or min(values) == max(values):
        return values[0]
    return f"{_text(min(values))} to {_text(max(values))}"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, list | tuple | Mapping):
        return ", ".join(_text(item) for item in value) or "none"
    return "unknown" if value is None else str(value)
