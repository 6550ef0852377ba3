"""``rfpose init``: a scenario to begin with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rfpose.cli._support import common_options, emit_json, examples, force_option, outputs, say, wants_json
from rfpose.errors import InvalidInputError

__all__ = ["KIND_NAMES", "UNITS", "command"]

# Written out so that --help need not load what knows them; a test holds them to what they name.
KIND_NAMES = ("paper", "tower", "dishes")
UNITS = ("m", "km", "cm", "mm", "ft")


@click.command(
    name="init",
    epilog=examples(
        "rfpose init site.toml",
        "rfpose init site.toml --kind tower --place 50.91 6.39",
        "rfpose init site.toml --from positions.csv --pivot-height-m 2.5",
        "rfpose init site.toml --from survey.csv --columns id=No,east=X,north=Y,up=Z --unit ft",
        "rfpose init site.toml --schema rfpose.schema.json",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option(
    "--kind",
    type=click.Choice(KIND_NAMES),
    help="What to begin with: the paper's field, a field north of a tower, dishes. [default: paper]",
)
@click.option(
    "--from",
    "field",
    type=click.Path(path_type=Path),
    help="Take the heliostats from this table (CSV; ours or SolarPILOT's), or PAINT directory.",
)
@click.option("--pivot-height-m", type=float, help="Pivots are so far above the table's heights, or above zero.")
@click.option("--unit", type=click.Choice(UNITS), help="Of the table's columns whose headers name none.")
@click.option("--columns", metavar="NAME=HEADER,…", help="Headers of the table's id, east, north, up.")
@click.option("--place", type=float, nargs=2, metavar="LAT LON", help="Where the site is [degrees, north and east].")
@click.option("--aim", type=float, nargs=3, metavar="E N U", help="Where the heliostats send the sun [m].")
@click.option("--schema", type=click.Path(path_type=Path), help="Also write the JSON Schema of scenarios, for editors.")
@force_option
@common_options
def command(
    scenario: Path,
    kind: str | None,
    field: Path | None,
    pivot_height_m: float | None,
    unit: str | None,
    columns: str | None,
    place: tuple[float, float] | None,
    aim: tuple[float, float, float] | None,
    schema: Path | None,
    force: bool,
) -> None:
    """Write a commented scenario to begin with.

    SCENARIO is the TOML file to write. Lines marked `<- yours` are to be changed.
    """
    form: dict[str, Any] = {"pivot_height_m": pivot_height_m, "unit": unit, "columns": _columns(columns)}
    given = {key: value for key, value in form.items() if value is not None}
    if field is None and given:
        raise click.UsageError("--pivot-height-m, --unit and --columns are about the table of --from")
    if field is not None and kind is not None:
        raise click.UsageError("--kind and --from both say where the heliostats are; give one")
    with outputs(scenario, schema, inputs=[field], force=force):
        from rfpose.pipeline.starter import starter_of_field, starter_of_kind, write_starter
        from rfpose.scenario import check_form

        if field is None:
            starter = starter_of_kind(kind or KIND_NAMES[0], place_deg=place, aim_enu_m=aim)
        else:
            starter = starter_of_field(field, check_form(given), folder=scenario.parent, place_deg=place, aim_enu_m=aim)
        summary = write_starter(scenario, starter, schema=schema, force=True)
    if wants_json():
        emit_json({"scenario": scenario, "schema": schema, **summary})
        return
    say(f"{scenario}: {summary['heliostats']} mirrors, {summary['transmitters']} transmitters")
    say(f"look at it with `rfpose info {scenario}`, change what is marked `<- yours`, and go on with")
    say(f"  rfpose simulate {scenario} -o recording.h5    # {summary['bytes'] / 1e6:.0f} MB")


def _columns(text: str | None) -> dict[str, str] | None:
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",")]
    if not all(name.strip() and equals and header.strip() for name, equals, header in pairs):
        raise InvalidInputError(f"`columns` must be such as id=No,east=X,north=Y,up=Z, got {text!r}")
    return {name.strip(): header.strip() for name, _, header in pairs}
