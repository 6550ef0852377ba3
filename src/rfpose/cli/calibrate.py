"""``rfpose calibrate``: fit heliostats' mounts to measurements."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

import rfpose
from rfpose.cli._engine import engine_options
from rfpose.cli._support import (
    CommonOptions,
    check_directory,
    check_ending,
    check_there,
    common_options,
    emit_json,
    examples,
    force_option,
    gathered,
    in_options,
    outputs,
    progress,
    say,
    table,
    wants_json,
)

if TYPE_CHECKING:
    from rfpose.pipeline.calibrate import Calibrations

__all__ = ["command"]

_SHOWN_ALARMS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sources:
    """What measured the heliostats: arguments of `rfpose.calibrate`."""

    directory: Path | None
    mounts: Path | None
    radio: tuple[Path, ...]
    motors: Path | None
    camera: Path | None
    drone: Path | None

    def check(self) -> None:
        """Refuse what does not go together."""
        directory, mounts, radio, camera, drone = self.directory, self.mounts, self.radio, self.camera, self.drone
        if directory is None and mounts is None:
            raise click.UsageError("give a PAINT DIRECTORY, or --mount with --radio, --camera or --drone")
        if directory is None and not (radio or camera or drone):
            raise click.UsageError("--mount needs measurements: a PAINT DIRECTORY, --radio, --camera or --drone")
        if bool(radio) != (self.motors is not None):
            raise click.UsageError(
                "--radio and --motors belong together: a pose alone does not say what the motors did"
            )


@click.command(
    name="calibrate",
    epilog=examples(
        "rfpose calibrate paint/ --heliostat BF57",
        "rfpose calibrate paint/ --parameters level-7 -o models.toml --picture errors.png",
        "rfpose calibrate --mount planned.toml --radio night.h5 --motors motors.csv -o models.json",
        "rfpose calibrate --mount planned.toml --radio night.h5 --motors motors.csv --camera pictures/",
        "rfpose calibrate --mount planned.toml --drone flight.csv --parameters gouws-camera -o models.json",
    ),
)
@click.argument("directory", type=click.Path(path_type=Path), required=False)
@click.option("--mount", "mounts", type=click.Path(path_type=Path), help="Mounts as planned or calibrated before.")
@click.option("--radio", multiple=True, type=click.Path(path_type=Path), help="Result of `process`; may be repeated.")
@click.option("--motors", type=click.Path(path_type=Path), help="CSV of motor positions for --radio.")
@click.option("--camera", type=click.Path(path_type=Path), help="Folder of pictures, pictures.csv and board.toml.")
@click.option("--drone", type=click.Path(path_type=Path), help="CSV of a drone's log.")
@click.option("--heliostat", "heliostats", multiple=True, metavar="ID", help="Only this one; may be repeated.")
@click.option(
    "--parameters",
    metavar="SET",
    default="auto",
    show_default=True,
    help="Free parameters: auto (as many as the records carry), a set's name, or names with commas between.",
)
@click.option(
    "--algorithm",
    type=click.Choice(("both", "any", "HeliOS", "UTIS")),
    default="both",
    show_default=True,
    help="Focal spot of PAINT records: mean of both, of what there is, or one; records without it are left out.",
)
@click.option("--output", "-o", type=click.Path(path_type=Path), help="Write the models: .json or .toml.")
@click.option("--picture", type=click.Path(path_type=Path), help="Draw the errors: .png, .pdf, .svg.")
@engine_options
@force_option
@common_options
@gathered("sources", _Sources)
def command(
    sources: _Sources,
    heliostats: tuple[str, ...],
    parameters: str,
    algorithm: str,
    output: Path | None,
    picture: Path | None,
    force: bool,
) -> None:
    """Fit mounts to a PAINT directory or to poses, pictures and flights, and say how far to trust them.

    Several sources of a heliostat go into one fit; without --mount it begins with the mounts that PAINT describes.
    A heliostat that cannot be read or fitted is left out, with the reason; the others go on.
    Errors are of the mirror normal; the beam's are twice that. Held-out: ten random splits, 60 % fitted, 40 % judged.
    Radio poses need motor positions, and a second source to tell the receivers' plane from the mirror.
    """
    sources.check()
    check_ending(output, ".json", ".toml")
    check_ending(picture, ".png", ".pdf", ".svg")
    inputs = [sources.directory, sources.mounts, *sources.radio, sources.motors, sources.camera, sources.drone]
    with outputs(output, picture, inputs=inputs, force=force), progress("Fitting"):
        check_there(*inputs)
        check_directory(sources.directory)
        from rfpose.drawing import save_figure
        from rfpose.feedback.mount import PARAMETERS

        given = asdict(sources)
        reports = rfpose.calibrate(
            given.pop("directory"),
            **given,
            heliostats=heliostats,
            parameters=tuple(parameters.split(",")) if "," in parameters or parameters in PARAMETERS else parameters,
            algorithm=algorithm,
        )
        if output is not None:
            reports.save(output)
        if picture is not None:
            save_figure(reports.plot(), picture)
    if wants_json():
        emit_json(
            {
                "heliostats": [report.as_dict() for report in reports],
                "skipped": dict(reports.skipped),
                "parameters": parameters,
            }
        )
    else:
        _show(reports)
    for name, reason in reports.skipped.items():
        click.echo(f"rfpose: heliostat {name} left out: {reason}", err=True)
    if wants_json():
        return
    for path in (output, picture):
        if path is not None:
            say(f"wrote {path}")


def _show(reports: Calibrations) -> None:
    """Print errors, parameters and alarms."""
    plain = [report.as_dict() for report in reports]
    rows = [
        [
            item["heliostat"],
            f"{item['used']}/{item['records'] + (len(item['skipped']) if 'PAINT' in item['sources'] else 0)}",
            *(_number(item[key]) for key in ("train_median_mrad", "held_out_median_mrad", "chronological_median_mrad")),
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
        if item["choice"]:
            say(f"  chosen: {item['choice']['chosen']}: {item['choice']['reason']}")
        carried = f"{item['parameters_carried']:.1f} of {len(item['parameters'])} parameters"
        assumed = ", assumed" if item["noise_assumed"] else ""
        say(f"  carried by the records: {carried}; noise {item['noise_mrad']:.2f} mrad{assumed}")
        for group in item["undetermined"]:
            say(f"  undetermined, the data cannot tell apart: {', '.join(group)}")
        for note in item["notes"]:
            say(f"  note: {in_options(note, click.get_current_context().ensure_object(CommonOptions).options)}")
        if "PAINT" in item["sources"] or item is plain[-1]:
            for number, reason in list(item["skipped"].items())[:_SHOWN_ALARMS]:
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


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"


def _shown(name: str, estimate: float, sigma: float) -> list[str]:
    """Estimate and sigma in units for a person."""
    factor, unit = (1e3, "mrad") if name.endswith("_rad") else (1e3, "mm") if name.endswith("_m") else (1e3, "1e-3")
    if math.isnan(estimate):
        return ["-", "-", unit]
    return [f"{factor * estimate:.3f}", f"{factor * sigma:.3f}", unit]
