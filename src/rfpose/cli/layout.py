"""``rfpose layout``: what a site can reach before it is built, and where its transmitters should stand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from rfpose.cli._support import (
    common_options,
    emit_json,
    examples,
    force_option,
    progress,
    say,
    table,
    wants_json,
)

__all__ = ["command"]

F = TypeVar("F", bound=Callable[..., Any])

# names only, since the modules that define them load numpy
_ESTIMATORS = ("independent", "rigid", "shared-clock", "carrier", "pivot")
_CRITERIA = ("pdop", "independent", "rigid", "shared-clock")


@click.group(name="layout")
def command() -> None:
    """Study a site before it is built: accuracy of every mirror, places of the transmitters.

    Milliradians are of the mirror normal; the beam turns by twice as much.
    """


def _field_options(function: F) -> F:
    function = click.option(
        "--sun",
        "suns",
        type=(float, float),
        multiple=True,
        metavar="AZ EL",
        help="Mirrors reflect this sun onto the aim point [deg]; repeat for several.",
    )(function)
    return click.option(
        "--field",
        type=click.Path(path_type=Path),
        help="CSV of heliostats (east_m, north_m) instead of the scenario's.",
    )(function)


@command.command(
    name="map",
    epilog=examples(
        "rfpose layout map site.toml",
        "rfpose layout map site.toml --sun 120 30 --sun 180 60 --estimator rigid --picture map.png --csv map.csv",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option("--estimator", "estimators", type=click.Choice(_ESTIMATORS), multiple=True, help="Default: all.")
@click.option("--snr", "tone_snr_db", type=float, help="Tone SNR [dB] instead of the scenario's.")
@click.option("--picture", type=click.Path(path_type=Path), help="PNG or SVG, of the first estimator.")
@click.option("--csv", "csv_path", type=click.Path(path_type=Path), help="One row a heliostat.")
@_field_options
@force_option
@common_options
def map_command(
    scenario: Path,
    estimators: tuple[str, ...],
    tone_snr_db: float | None,
    picture: Path | None,
    csv_path: Path | None,
    suns: tuple[tuple[float, float], ...],
    field: Path | None,
    force: bool,
) -> None:
    """Say what each mirror's normal can be known to, and what the loss of each transmitter costs."""
    from rfpose.pipeline.files import refuse_existing
    from rfpose.pipeline.layout import draw_layout_map, map_layout, write_layout_csv

    for path in (picture, csv_path):
        if path is not None:
            refuse_existing(path, force=force)
    found = map_layout(
        scenario,
        estimators=estimators or _ESTIMATORS,
        suns_deg=suns,
        field_csv=field,
        tone_snr_db=tone_snr_db,
    )
    if picture is not None:
        draw_layout_map(found, picture)
    if csv_path is not None:
        write_layout_csv(found, csv_path)
    summary = found.as_dict()
    if wants_json():
        emit_json({**summary, "picture": picture, "csv": csv_path})
        return
    rows = [[f"normal, {name} [mrad]", *_cells(values)] for name, values in summary["normal_mrad"].items()]
    rows = [["PDOP", *_cells(summary["pdop"])], ["VDOP", *_cells(summary["vdop"])], *rows]
    title = f"{summary['scenario']}: {summary['heliostats']} heliostats, {summary['postures']} posture(s)"
    table(title, ["bound", "rms", "median", "95 %", "worst"], rows)
    for name, lost in summary["normal_without_transmitter_mrad"].items():
        worst = max(lost, key=lambda key: lost[key])
        say(f"{name}: losing {worst} is worst, {lost[worst]:.4g} mrad rms")


@command.command(
    name="optimise",
    epilog=examples(
        "rfpose layout optimise site.toml -o better.toml",
        "rfpose layout optimise site.toml -o better.toml -n 8 --minimise rigid --statistic p95 --height 15 40",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the scenario with the new places.")
@click.option("-n", "--transmitters", type=click.IntRange(min=1), help="How many; default: as many as there are.")
@click.option("--minimise", type=click.Choice(_CRITERIA), default="pdop", show_default=True)
@click.option("--statistic", default="rms", show_default=True, help="rms, worst, or a percentile such as p95.")
@click.option("--radius", type=float, help="Farthest from the origin [m]; default: the farthest transmitter now.")
@click.option("--height", type=(float, float), metavar="LOW HIGH", help="Antenna heights [m]; default: those now.")
@click.option("--separation", type=float, default=0.0, show_default=True, help="Least distance of two towers [m].")
@click.option("--clearance", type=float, default=0.0, show_default=True, help="Least distance to heliostats [m].")
@click.option("--exclude", type=(float, float, float), multiple=True, metavar="X Y R", help="Circle kept free [m].")
@click.option("--keep", type=click.IntRange(min=0), default=0, show_default=True, help="The first so many stay.")
@click.option("--cost", type=(float, float, float), default=(1.0, 0.0, 0.0), metavar="TOWER HEIGHT CABLE",
              help="Cost of a tower, of a metre of height, of a metre of cable.")  # fmt: skip
@click.option("--starts", type=click.IntRange(min=1), default=30, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@_field_options
@force_option
@common_options
def optimise_command(
    scenario: Path,
    output: Path | None,
    transmitters: int | None,
    minimise: str,
    statistic: str,
    radius: float | None,
    height: tuple[float, float] | None,
    separation: float,
    clearance: float,
    exclude: tuple[tuple[float, float, float], ...],
    keep: int,
    cost: tuple[float, float, float],
    starts: int,
    seed: int,
    suns: tuple[tuple[float, float], ...],
    field: Path | None,
    force: bool,
) -> None:
    """Place the transmitters anew, for the best accuracy that the limits allow."""
    from rfpose.layout.optimise import Costs
    from rfpose.pipeline.files import refuse_existing, write_atomically
    from rfpose.pipeline.layout import optimise_layout

    if output is not None:
        refuse_existing(output, force=force)
    with progress("Searching") as on_progress:
        found = optimise_layout(
            scenario,
            n_transmitter=transmitters,
            criterion=minimise,  # type: ignore[arg-type]
            statistic=statistic,
            radius_m=radius,
            height_m=height,
            separation_m=separation,
            clearance_m=clearance,
            excluded_m=exclude,
            keep=keep,
            costs=Costs(per_tower=cost[0], per_height_m=cost[1], per_cable_m=cost[2]),
            suns_deg=suns,
            field_csv=field,
            starts=starts,
            seed=seed,
            on_progress=on_progress,
        )
    if output is not None:
        write_atomically(output, found.scenario.to_toml().encode())
    summary = found.as_dict()
    if wants_json():
        emit_json({**summary, "output": output})
        return
    unit = f" {summary['unit']}".rstrip()
    say(f"{minimise} {statistic}: {summary['value']:.4g}{unit}, was {summary['before']:.4g}{unit}")
    say(f"without its most needed transmitter: {summary['without_worst']:.4g}{unit}; cost {summary['cost']:g}")
    say(f"PDOP rms: {summary['pdop_rms']:.4g}, was {summary['pdop_rms_before']:.4g}")
    places = [[name, *(f"{x:.3f}" for x in place)] for name, place in summary["transmitters"].items()]
    table("Transmitters [m]", ["", "east", "north", "up"], places)


def _cells(values: dict[str, float]) -> list[str]:
    return [f"{values[key]:.4g}" for key in ("rms", "median", "p95", "worst")]
