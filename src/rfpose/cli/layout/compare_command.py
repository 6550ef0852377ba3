"""``rfpose layout compare``: layouts side by side."""

from __future__ import annotations

from pathlib import Path

import click

from rfpose.cli._support import (
    check_ending,
    check_scenario,
    check_table,
    common_options,
    emit_json,
    examples,
    force_option,
    outputs,
    progress,
    table,
    wants_json,
)
from rfpose.cli.layout._options import ESTIMATORS, StudiedHeliostats, field_options

__all__ = ["command"]


@click.command(
    name="compare",
    epilog=examples(
        "rfpose layout compare now.toml better.toml",
        "rfpose layout compare a.toml b.toml c.toml --estimator scenario --day 2026-06-21 --picture compared.pdf",
    ),
)
@click.argument("scenarios", type=click.Path(path_type=Path), nargs=-1, required=True, metavar="SCENARIO SCENARIO...")
@click.option("--estimator", "estimators", type=click.Choice(ESTIMATORS), multiple=True,
              help="Default: all that every layout allows but `site`.")  # fmt: skip
@click.option("--cost", type=(float, float, float), default=(1.0, 0.0, 0.0), metavar="TOWER HEIGHT CABLE",
              help="Cost of a tower, of a metre of height, of a metre of cable.")  # fmt: skip
@click.option("--picture", type=click.Path(path_type=Path), help="Maps in the same colours: PNG, SVG or PDF.")
@click.option("--csv", "csv_path", type=click.Path(path_type=Path), help="One row a layout; Parquet if it ends so.")
@field_options
@force_option
@common_options
def command(
    scenarios: tuple[Path, ...],
    estimators: tuple[str, ...],
    cost: tuple[float, float, float],
    picture: Path | None,
    csv_path: Path | None,
    studied: StudiedHeliostats,
    force: bool,
) -> None:
    """Compare layouts: what their normals can be known to, in the same postures, and what they cost."""
    if len(scenarios) < 2:
        raise click.UsageError("give two scenarios or more to compare")
    check_ending(picture, ".png", ".svg", ".pdf")
    check_table(csv_path, ".csv", ".parquet")
    claimed = outputs(picture, csv_path, inputs=[*scenarios, studied.field], force=force)
    with claimed, progress("Mapping") as on_progress:
        for scenario in scenarios:
            check_scenario(scenario)
        from rfpose.drawing import look, save_figure
        from rfpose.layout.optimise import Costs
        from rfpose.pipeline.layout import compare

        found = compare(
            scenarios,
            estimators=estimators or None,
            postures=studied.postures(),
            field=studied.field,
            costs=Costs(per_tower=cost[0], per_height_m=cost[1], per_cable_m=cost[2]),
            on_progress=on_progress,
        )
        if picture is not None:
            with look():
                save_figure(found.plot(), picture)
        if csv_path is not None:
            found.save(csv_path)
    summary = found.as_dict()
    if wants_json():
        emit_json({**summary, "picture": picture, "csv": csv_path})
        return
    layouts = summary["layouts"]
    rows = [
        ["transmitters", *(str(each["transmitters"]) for each in layouts)],
        ["cost", *(f"{each['cost']:g}" for each in layouts)],
        ["PDOP rms", *(f"{each['pdop']['rms']:.4g}" for each in layouts)],
    ]
    for key in layouts[0]["normal_mrad"]:
        rows.append([f"normal, {key} [mrad], rms", *(f"{each['normal_mrad'][key]['rms']:.4g}" for each in layouts)])
        rows.append(["  worst mirror", *(f"{each['normal_mrad'][key]['worst']:.4g}" for each in layouts)])
        if key in layouts[0]["without_worst_mrad"]:
            lost = (each["without_worst_mrad"][key] for each in layouts)
            rows.append(["  rms, most needed transmitter lost", *(f"{value:.4g}" for value in lost)])
    table("Layouts compared", ["", *(each["name"] for each in layouts)], rows)
