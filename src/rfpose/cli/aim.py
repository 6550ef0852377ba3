"""``rfpose aim``: motor positions that send the sun to a point, for calibrated heliostats."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rfpose.cli._support import (
    check_there,
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

if TYPE_CHECKING:
    from rfpose.pipeline.aim import CommandPlan

__all__ = ["command"]

_SHOWN = 24
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Wanted:
    """Arguments of `rfpose.pipeline.aim.plan_commands`; the site in degrees."""

    target_enu_m: tuple[float, float, float] | None
    start: str
    hours: float
    step_s: float
    heliostats: tuple[str, ...]
    site: tuple[float, float, float] | None
    n_next: int


@click.command(
    name="aim",
    epilog=examples(
        "rfpose aim models.json --target 0 0 55 --start 2026-06-21T06:00Z",
        "rfpose aim models.json --heliostat BF57 --target 0 0 55 --start 2026-06-21T06:00Z -o day.csv",
        "rfpose aim models.json --target 0 0 55 --start 2026-01-01T00:00Z --hours 24 --next 5 --json",
    ),
)
@click.argument("model", type=click.Path(path_type=Path))
@click.option(
    "--target", "target_enu_m", nargs=3, type=float, metavar="E N U", help="Aim point in the site's frame [m]."
)
@click.option("--dish", is_flag=True, help="No aim point: the mirror's normal points at the sun.")
@click.option("--start", required=True, metavar="TIME", help="First time, such as 2026-06-21T06:00Z.")
@click.option("--hours", default=12.0, show_default=True, help="How long.")
@click.option("--step", "step_s", default=600.0, show_default=True, metavar="S", help="Between commands [s].")
@click.option("--heliostat", "heliostats", multiple=True, metavar="ID", help="Only this one; may be repeated.")
@click.option("--site", nargs=3, type=float, metavar="LAT LON ALT", help="Of the site's origin [deg, deg, m].")
@click.option("--next", "n_next", type=click.IntRange(min=0), default=0, help="Postures to propose for measuring.")
@click.option("--output", "-o", type=click.Path(path_type=Path), help="Write the commands as CSV.")
@force_option
@common_options
@gathered("wanted", _Wanted)
def command(model: Path, dish: bool, wanted: _Wanted, output: Path | None, force: bool) -> None:
    """Turn aim points and times into motor positions, every known error of the mounts undone.

    MODEL is what `rfpose calibrate -o` wrote. Uncertainties are of the mirror normal: what the calibration left open,
    and with the scatter about the model that it found.
    """
    if dish == (wanted.target_enu_m is not None):
        raise click.UsageError("give either --target E N U, or --dish")
    with outputs(output, inputs=[model], force=force), progress("Aiming"):
        check_there(model)
        plans = _plans(model, wanted)
        if output is not None:
            from rfpose.pipeline.aim import write_commands

            write_commands(output, plans, force=force)
    if wants_json():
        emit_json({"heliostats": [plan.as_dict() for plan in plans]})
        return
    for plan in plans:
        _show(plan)
    if output is not None:
        say(f"wrote {output}")


def _plans(model: Path, wanted: _Wanted) -> tuple[CommandPlan, ...]:
    """Plan what the options name."""
    from rfpose.pipeline.aim import plan_commands
    from rfpose.sun import site_from_degrees

    place = None if wanted.site is None else site_from_degrees(*wanted.site)
    return plan_commands(model, **(asdict(wanted) | {"site": place}))


def _show(plan: CommandPlan) -> None:
    """Print commands, the year, and what to measure next."""
    told = plan.as_dict()
    rows = [
        [
            f"{row['time_utc'][5:10]} {row['time_utc'][11:16]}",
            *(_number(row[name], 8) for name in ("axis_1", "axis_2")),
            *(_number(row[name]) for name in ("normal_sigma_mrad", "normal_with_noise_mrad")),
            row["status"],
        ]
        for row in told["commands"]
    ]
    every = max(1, math.ceil(len(rows) / _SHOWN))
    header = ["UTC", "axis 1", "axis 2", "open [mrad]", "+ noise", "status"]
    table(f"{plan.heliostat}: motor positions; what stays open, of the normal", header, rows[::every])
    if not plan.calibrated:
        say("  as planned, not calibrated: nothing is known of its errors")
        return
    if plan.noise_assumed:
        say("  the noise is assumed, not measured: the calibration had too few redundant measurements to tell it")
    text = ", ".join(f"{name} {_number(value)}" for name, value in zip(_MONTHS, told["month_sigma_mrad"], strict=True))
    say(f"  open over the year, on the 21st [mrad of the normal]: {text}")
    for item in told["next"]:
        say(
            f"  measure next: {item['time_utc']} at {_number(item['axis_1'], 8)}, {_number(item['axis_2'], 8)}; "
            f"leaves {_number(item['sigma_after_mrad'])} mrad over the year"
        )


def _number(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}g}"
