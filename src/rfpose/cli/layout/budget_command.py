"""``rfpose layout budget``: where the error of the normals comes from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
    outputs,
    progress,
    say,
    table,
    wants_json,
)
from rfpose.cli.layout._options import StudiedHeliostats, field_options

__all__ = ["command"]

_SIGMAS = 2.5
"""By how many standard deviations drawn and first order may differ."""
_WORTH_A_REMEDY = 0.01
"""Share of the variance from which a source's remedy is printed."""


def _say_where_not_linear(line: dict[str, Any], n_draw: int) -> None:
    drawn = line["monte_carlo_mrad"]
    # the rms of one number drawn n times scatters by 1/√(2n); with nothing drawn or solved there is NaN, and no more
    if abs(line["normal_mrad"] - drawn) > _SIGMAS * (2.0 * max(n_draw, 1)) ** -0.5 * drawn:
        say(f"{line['source']}: drawn and first order differ by more than chance explains; trust what is drawn")


@click.command(
    name="budget",
    epilog=examples(
        "rfpose layout budget site.toml",
        "rfpose layout budget site.toml --sun 120 30 --sun 180 60 -o budget.csv --picture budget.png",
        "rfpose layout budget site.toml --ground estimated --draws 50",
        "rfpose layout budget site.toml --pose site --draws 50",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option("--pose", type=click.Choice(("rigid", "independent", "site")), default="rigid", show_default=True)
@click.option("--ground", type=click.Choice(("ignored", "known", "estimated")), help="Instead of [budget] `ground`.")
@click.option("--draws", type=click.IntRange(min=0), default=200, show_default=True,
              help="Frames of the Monte Carlo for each line; 0 for none.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="CSV: one row a source and heliostat.")
@click.option("--picture", type=click.Path(path_type=Path), help="PNG or SVG.")
@field_options
@engine_options
@force_option
@common_options
def command(
    scenario: Path,
    pose: str,
    ground: str | None,
    draws: int,
    seed: int,
    output: Path | None,
    picture: Path | None,
    studied: StudiedHeliostats,
    force: bool,
) -> None:
    """Say where the error of the normals comes from, worst first, and what would reduce it.

    Each source is taken to first order and checked by Monte Carlo through the solver; the root of the sum of squares is
    compared with all sources at once. The [budget] table of the scenario says how large the sources are; with pose
    `site` also [multipath], [antenna] and [site.structures].
    """
    check_ending(picture, ".png", ".svg")
    claimed = outputs(output, picture, inputs=[scenario, studied.field], force=force)
    with claimed, progress("Drawing") as on_progress:
        check_scenario(scenario)
        from rfpose.drawing import save_figure

        found = rfpose.budget(
            scenario,
            postures=studied.postures(),
            field=studied.field,
            pose=pose,
            ground=ground,
            n_draw=draws,
            seed=seed,
            on_progress=on_progress,
        )
        if output is not None:
            found.save(output)
        if picture is not None:
            save_figure(found.plot(), picture)
    summary = found.as_dict()
    if wants_json():
        emit_json({**summary, "output": output, "picture": picture})
        return
    rows = [
        [line["source"], *(f"{line[key]:.3g}" for key in ("normal_mrad", "monte_carlo_mrad", "target_m")),
         f"{100.0 * line['share']:.2f} %"]
        for line in summary["lines"]
    ]  # fmt: skip
    whole = summary["sum"]
    drawn = summary["monte_carlo"]
    rows.append(["together", f"{whole['normal_mrad']:.3g}", f"{drawn['normal_mrad']:.3g}", f"{whole['target_m']:.3g}",
                 ""])  # fmt: skip
    title = f"{summary['scenario']}: normal [mrad], rms over {summary['heliostats']} heliostats, pose {summary['pose']}"
    table(title, ["source", "mrad", "drawn", "target [m]", "share"], rows)
    for line in summary["lines"]:
        if line["share"] >= _WORTH_A_REMEDY:
            say(f"{line['source']} ({line['assumed']}): {line['remedy']}")
            if summary["pose"] != "site":  # a source drawn alone lacks the stray field that pose site reckons with
                _say_where_not_linear(line, summary["draws"])
    if summary["solutions_failed"]:
        say(f"{summary['solutions_failed']} drawn solutions failed: that error is beyond first order")
