"""``rfpose calibrate``: fit heliostats' mounts to measurements."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rfpose.cli._support import common_options, emit_json, examples, force_option, say, table, wants_json

if TYPE_CHECKING:
    from rfpose.pipeline.calibrate import HeliostatReport

__all__ = ["command"]

_SHOWN_ALARMS = 12


@click.command(
    name="calibrate",
    epilog=examples(
        "rfpose calibrate paint/ --heliostat BF57",
        "rfpose calibrate paint/ --parameters level-7 -o models.toml --picture errors.png",
    ),
)
@click.argument("directory", type=click.Path(path_type=Path))
@click.option("--heliostat", "heliostats", multiple=True, metavar="ID", help="Only this one; may be repeated.")
@click.option(
    "--parameters",
    default="level-full",
    show_default=True,
    metavar="SET",
    help="Free parameters: a set's name, or names with commas between.",
)
@click.option("--output", "-o", type=click.Path(path_type=Path), help="Write the models: .json or .toml.")
@click.option("--picture", type=click.Path(path_type=Path), help="Draw the errors: .png, .pdf, .svg.")
@force_option
@common_options
def command(
    directory: Path,
    heliostats: tuple[str, ...],
    parameters: str,
    output: Path | None,
    picture: Path | None,
    force: bool,
) -> None:
    """Fit the mounts of a PAINT directory and say how far to trust them.

    Errors are of the mirror normal; the beam's are twice that. Held-out: ten random splits, 60 % fitted, 40 % judged.
    """
    from rfpose.pipeline.calibrate import calibrate_paint, draw_errors, write_models

    free = tuple(parameters.split(",")) if "," in parameters or parameters.endswith(("_rad", "_m")) else parameters
    reports = calibrate_paint(directory, heliostats=heliostats, free=free)
    if output is not None:
        write_models(output, reports, force=force)
    if picture is not None:
        draw_errors(picture, reports)
    if wants_json():
        emit_json({"heliostats": [report.as_dict() for report in reports], "parameters": parameters})
        return
    _show(reports)
    for path in (output, picture):
        if path is not None:
            say(f"wrote {path}")


def _show(reports: tuple[HeliostatReport, ...]) -> None:
    """Print errors, parameters and alarms."""
    plain = [report.as_dict() for report in reports]
    rows = [
        [
            item["heliostat"],
            f"{item['used']}/{item['records'] + len(item['skipped'])}",
            *(f"{item[key]:.3f}" for key in ("train_median_mrad", "held_out_median_mrad", "chronological_median_mrad")),
            f"{item['rank']}/{len(item['parameters'])}",
            str(len(item["alarms"])),
        ]
        for item in plain
    ]
    header = ["", "used", "fitted", "held out", "later 40 %", "rank", "alarms"]
    table("Median error of the mirror normal [mrad]", header, rows)
    for item in plain:
        values = [
            [name, *_shown(name, entry["estimate"], entry["sigma"])] for name, entry in item["parameters"].items()
        ]
        table(f"{item['heliostat']}: parameters", ["", "estimate", "sigma", "unit"], values)
        for group in item["undetermined"]:
            say(f"  undetermined, the data cannot tell apart: {', '.join(group)}")
        for number, reason in item["skipped"].items():
            say(f"  record {number} left out: {reason}")
        outliers = [alarm for alarm in item["alarms"] if alarm["kind"] == "outlier"]
        if outliers:
            say(f"  {len(outliers)} records are off by more than 5 mrad, first {outliers[0]['first_record']}")
        for alarm in [alarm for alarm in item["alarms"] if alarm["kind"] != "outlier"][:_SHOWN_ALARMS]:
            size, axis = alarm["size_mrad"], alarm["axis"]
            if alarm["kind"] == "shift":
                say(f"  axis {axis} shifts by {size:+.1f} mrad at record {alarm['first_record']}")
            else:
                last = alarm["last_record"]
                say(f"  axis {axis} drifts by {size:+.1f} mrad, records {alarm['first_record']} to {last}")


def _shown(name: str, estimate: float, sigma: float) -> list[str]:
    """Estimate and sigma in units for a person."""
    factor, unit = (1e3, "mrad") if name.endswith("_rad") else (1e3, "mm") if name.endswith("_m") else (1e3, "1e-3")
    if math.isnan(estimate):
        return ["-", "-", unit]
    return [f"{factor * estimate:.3f}", f"{factor * sigma:.3f}", unit]
