"""``rfpose layout optimise``: where transmitters should stand, and what more of them would buy."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import rfpose
from rfpose.cli._engine import engine_options
from rfpose.cli._support import (
    check_ending,
    check_scenario,
    common_options,
    emit_json,
    examples,
    force_option,
    gathered,
    outputs,
    progress,
    say,
    table,
    wants_json,
)
from rfpose.cli.layout._options import CRITERIA, StudiedHeliostats, field_options

if TYPE_CHECKING:
    from rfpose.pipeline.layout import SitePlacement, SitePlacements

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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Files:
    """What is written."""

    output: Path | None
    csv: Path | None
    picture: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Search:
    """What is searched for, and how long."""

    minimise: str
    statistic: str
    cost: tuple[float, float, float]
    starts: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class _Where:
    """Where towers may stand: `rfpose.pipeline.layout.Rules`, named before they are loaded."""

    radius_m: float | None
    outline_csv: Path | None
    allowed_m: tuple[tuple[float, float, float], ...]
    excluded_m: tuple[tuple[float, float, float], ...]
    height_m: tuple[float, float] | None
    separation_m: float | None
    clearance_m: float
    sight_m: float | None
    keep: int


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
@click.option("--csv", type=click.Path(path_type=Path), help="With --pareto: one row a number.")
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
@click.option("--allow", "allowed_m", **_CIRCLE, help="Further ground that may be used: a circle [m].")
@click.option("--exclude", "excluded_m", **_CIRCLE, help="Circle kept free [m].")
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
@gathered("files", _Files)
@gathered("search", _Search)
@gathered("where", _Where)
@field_options
@engine_options
@force_option
@common_options
def command(
    scenario: Path,
    transmitters: int | None,
    pareto: range | None,
    files: _Files,
    search: _Search,
    where: _Where,
    studied: StudiedHeliostats,
    force: bool,
) -> None:
    """Place the transmitters anew, for the best accuracy that the limits allow."""
    if pareto is not None and (files.output is not None or transmitters is not None):
        raise click.UsageError("--pareto compares numbers of transmitters; give -o and -n without it")
    if pareto is None and files.csv is not None:
        raise click.UsageError("--csv goes with --pareto")
    check_ending(files.picture, ".png", ".svg", ".pdf")
    inputs = [scenario, studied.field, where.outline_csv]
    with outputs(files.output, files.csv, files.picture, inputs=inputs, force=force):
        check_scenario(scenario)
        from rfpose.layout.optimise import Costs
        from rfpose.pipeline.layout import Rules

        settings: dict[str, Any] = {
            "criterion": search.minimise,
            "statistic": search.statistic,
            "rules": Rules(**asdict(where)),
            "costs": Costs(per_tower=search.cost[0], per_height_m=search.cost[1], per_cable_m=search.cost[2]),
            "postures": studied.postures(),
            "field": studied.field,
            "starts": search.starts,
            "seed": search.seed,
        }
        if pareto is not None:
            curve = _compare(scenario, pareto, settings, files)
        else:
            found = _place(scenario, transmitters, settings, files)
    if pareto is not None:
        _show_curve(curve.as_dict(), files)
    else:
        _show_places(found.as_dict(), files)


def _place(scenario: Path, transmitters: int | None, settings: dict[str, Any], files: _Files) -> SitePlacement:
    from rfpose.drawing import look, save_figure

    with progress("Searching") as on_progress:
        found = rfpose.optimise(scenario, n_transmitter=transmitters, on_progress=on_progress, **settings)
    if files.output is not None:
        found.save(files.output)
    if files.picture is not None:
        with look():
            save_figure(found.plot(), files.picture)
    return found


def _show_places(summary: dict[str, Any], files: _Files) -> None:
    """Print where the transmitters should stand."""
    if wants_json():
        emit_json({**summary, "output": files.output, "picture": files.picture})
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


def _compare(scenario: Path, counts: range, settings: dict[str, Any], files: _Files) -> SitePlacements:
    from rfpose.drawing import save_figure
    from rfpose.pipeline.layout import pareto

    with progress("Searching, number by number") as on_progress:
        curve = pareto(scenario, counts, on_progress=on_progress, **settings)
    if files.csv is not None:
        curve.save(files.csv)
    if files.picture is not None:
        save_figure(curve.plot(), files.picture)
    return curve


def _show_curve(summary: dict[str, Any], files: _Files) -> None:
    """Print what each number of transmitters would buy."""
    if wants_json():
        emit_json({**summary, "csv": files.csv, "picture": files.picture})
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
