"""``rfpose layout optimise``: where transmitters should stand, and what more of them would buy."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import rfpose
from rfpose.cli._support import (
    check_ending,
    check_scenario,
    common_options,
    emit_json,
    examples,
    force_option,
    outputs,
    progress,
    say,
    table,
    wants_json,
)
from rfpose.cli.layout._options import CRITERIA, field_options, postures

if TYPE_CHECKING:
    from rfpose.pipeline.layout import Rules, SitePlacement, SitePlacements

__all__ = ["command"]


class _Counts(click.ParamType[range]):
    """Numbers of transmitters as ``6..12``."""

    name = "counts"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> range:
        """Return the numbers, both ends included."""
        if isinstance(value, range):
            return value
        first, dots, last = str(value).partition("..")
        try:
            counts = range(int(first), int(last if dots else first) + 1)
        except ValueError:
            counts = range(0)
        if not counts:
            self.fail(f"{value!r} is no range such as 6..12", param, ctx)
        return counts


_CIRCLE: dict[str, Any] = {"type": (float, float, float), "multiple": True, "metavar": "X Y R"}


@click.command(
    name="optimise",
    epilog=examples(
        "rfpose layout optimise site.toml -o better.toml",
        "rfpose layout optimise site.toml -o better.toml -n 8 --minimise rigid --statistic p95 --height 15 40",
        "rfpose layout optimise site.toml -o better.toml --minimise site --day 2026-06-21 --starts 10",
        "rfpose layout optimise site.toml --pareto 6..12 --cost 10000 200 30 --csv curve.csv --picture curve.png",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the scenario with the new places.")
@click.option("-n", "--transmitters", type=click.IntRange(min=1), help="How many; default: as many as there are.")
@click.option("--pareto", type=_Counts(), metavar="N1..N2", help="Instead, the best of each number: cost and accuracy.")
@click.option("--csv", "csv_path", type=click.Path(path_type=Path), help="With --pareto: one row a number.")
@click.option("--picture", type=click.Path(path_type=Path), help="Before and after, or the curve: PNG, SVG or PDF.")
@click.option("--minimise", type=click.Choice(CRITERIA), default="pdop", show_default=True,
              help="PDOP, or the normal's bound; `site`: what pose `site` states among reflections.")  # fmt: skip
@click.option("--statistic", default="rms", show_default=True, help="rms, worst, or a percentile such as p95.")
@click.option("--radius", "radius_m", type=float, help="Farthest from the origin [m]; default: as now.")
@click.option(
    "--outline",
    "outline_csv",
    type=click.Path(path_type=Path),
    help="CSV of corners of the allowed ground.",
)
@click.option("--allow", **_CIRCLE, help="Further ground that may be used: a circle [m].")
@click.option("--exclude", **_CIRCLE, help="Circle kept free [m].")
@click.option("--height", "height_m", type=(float, float), metavar="LOW HIGH", help="Antennas [m]; default: as now.")
@click.option(
    "--separation",
    "separation_m",
    type=float,
    help="Between towers [m]; default: radius/20.",
)
@click.option("--clearance", "clearance_m", type=float, default=0.0, show_default=True, help="To heliostats [m].")
@click.option(
    "--sight",
    "sight_m",
    type=float,
    help="From lines of sight to the aim point [m]; 0: may stand in them; default: half a mirror and half a metre.",
)
@click.option("--keep", type=click.IntRange(min=0), default=0, show_default=True, help="The first so many stay.")
@click.option("--cost", type=(float, float, float), default=(1.0, 0.0, 0.0), metavar="TOWER HEIGHT CABLE",
              help="Cost of a tower, of a metre of height, of a metre of cable.")  # fmt: skip
@click.option("--starts", type=click.IntRange(min=1), default=30, show_default=True,
              help="Random starts; with `--minimise site`, places tried for each tower in each round.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@field_options
@force_option
@common_options
def command(
    scenario: Path,
    output: Path | None,
    transmitters: int | None,
    pareto: range | None,
    csv_path: Path | None,
    picture: Path | None,
    minimise: str,
    statistic: str,
    cost: tuple[float, float, float],
    starts: int,
    seed: int,
    field: Path | None,
    suns_deg: tuple[tuple[float, float], ...],
    day: datetime | None,
    year: int | None,
    stow: bool,
    force: bool,
    **where: Any,
) -> None:
    """Place the transmitters anew, for the best accuracy that the limits allow."""
    if pareto is not None and (output is not None or transmitters is not None):
        raise click.UsageError("--pareto compares numbers of transmitters; give -o and -n without it")
    if pareto is None and csv_path is not None:
        raise click.UsageError("--csv goes with --pareto")
    check_ending(picture, ".png", ".svg", ".pdf")
    claimed = outputs(output, csv_path, picture, inputs=[scenario, field, where["outline_csv"]], force=force)
    with claimed:
        check_scenario(scenario)
        from rfpose.layout.optimise import Costs

        settings: dict[str, Any] = {
            "criterion": minimise,
            "statistic": statistic,
            "rules": _rules(**where),
            "costs": Costs(per_tower=cost[0], per_height_m=cost[1], per_cable_m=cost[2]),
            "postures": postures(suns_deg, day, year, stow),
            "field": field,
            "starts": starts,
            "seed": seed,
        }
        if pareto is not None:
            curve = _compare(scenario, pareto, settings, csv_path, picture)
        else:
            found = _place(scenario, transmitters, settings, output, picture)
    if pareto is not None:
        _show_curve(curve.as_dict(), csv_path, picture)
    else:
        _show_places(found.as_dict(), output, picture)


def _rules(
    radius_m: float | None,
    outline_csv: Path | None,
    allow: tuple[tuple[float, float, float], ...],
    exclude: tuple[tuple[float, float, float], ...],
    height_m: tuple[float, float] | None,
    separation_m: float | None,
    clearance_m: float,
    sight_m: float | None,
    keep: int,
) -> Rules:
    from rfpose.pipeline.layout import Rules

    return Rules(
        radius_m=radius_m,
        outline_csv=outline_csv,
        allowed_m=allow,
        excluded_m=exclude,
        height_m=height_m,
        separation_m=separation_m,
        clearance_m=clearance_m,
        sight_m=sight_m,
        keep=keep,
    )


def _place(
    scenario: Path, transmitters: int | None, settings: dict[str, Any], output: Path | None, picture: Path | None
) -> SitePlacement:
    from rfpose.drawing import look, save_figure

    with progress("Searching") as on_progress:
        found = rfpose.optimise(scenario, n_transmitter=transmitters, on_progress=on_progress, **settings)
    if output is not None:
        found.save(output)
    if picture is not None:
        with look():
            save_figure(found.plot(), picture)
    return found


def _show_places(summary: dict[str, Any], output: Path | None, picture: Path | None) -> None:
    """Print where the transmitters should stand."""
    if wants_json():
        emit_json({**summary, "output": output, "picture": picture})
        return
    unit = f" {summary['unit']}".rstrip()
    name = f"{summary['criterion']} {summary['statistic']}"
    say(f"{name}: {summary['value']:.4g}{unit}, was {summary['before']:.4g}{unit}")
    say(f"without its most needed transmitter: {summary['without_worst']:.4g}{unit}; cost {summary['cost']:g}")
    say(f"PDOP rms: {summary['pdop_rms']:.4g}, was {summary['pdop_rms_before']:.4g}")
    _say_light(summary, unit)
    places = [[name, *(f"{x:.3f}" for x in place)] for name, place in summary["transmitters"].items()]
    table("Transmitters [m]", ["", "east", "north", "up"], places)


def _say_light(summary: dict[str, Any], unit: str) -> None:
    """Say what towers do to mirrors' light, and what keeping them out of it costs."""
    if summary["sight_lines_crossed"] is not None:
        say(
            f"lines of sight to the aim point with a tower in their way: {summary['sight_lines_crossed']}, were "
            f"{summary['sight_lines_crossed_before']}"
        )
    if summary["without_sight_lines"] is not None:
        say(f"were towers allowed there: {summary['without_sight_lines']:.4g}{unit}")
    if summary["mirror_suns"]:
        say(
            f"mirrors behind a tower, over all suns studied: {summary['mirror_suns_shaded']} of "
            f"{summary['mirror_suns']}, were {summary['mirror_suns_shaded_before']}"
        )


def _compare(
    scenario: Path, counts: range, settings: dict[str, Any], csv_path: Path | None, picture: Path | None
) -> SitePlacements:
    from rfpose.drawing import save_figure
    from rfpose.pipeline.layout import pareto

    with progress("Searching, number by number") as on_progress:
        curve = pareto(scenario, counts, on_progress=on_progress, **settings)
    if csv_path is not None:
        curve.save(csv_path)
    if picture is not None:
        save_figure(curve.plot(), picture)
    return curve


def _show_curve(summary: dict[str, Any], csv_path: Path | None, picture: Path | None) -> None:
    """Print what each number of transmitters would buy."""
    if wants_json():
        emit_json({**summary, "csv": csv_path, "picture": picture})
        return
    unit = f" [{summary['unit']}]" if summary["unit"] else ""
    table(
        f"{summary['criterion']}, {summary['statistic']} over the field{unit}",
        ["transmitters", "cost", "all", "worst one lost", "efficient"],
        [
            [str(row["transmitters"]), *(f"{row[key]:.4g}" for key in ("cost", "value", "without_worst")),
             "yes" if row["efficient"] else "no"]
            for row in summary["placements"]
        ],
    )  # fmt: skip
