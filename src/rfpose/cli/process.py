"""``rfpose process``: from a recording to mirror normals."""

from __future__ import annotations

from pathlib import Path

import click

from rfpose.cli._support import (
    Session,
    common_options,
    emit_json,
    examples,
    force_option,
    progress,
    say,
    table,
    wants_json,
)

__all__ = ["ESTIMATOR_NAMES", "POSE_NAMES", "command"]

# Written out so that --help need not load the signal processing; a test holds them to rfpose.dsp.
ESTIMATOR_NAMES = ("hilbert", "correlator", "dot", "dot-compensated")
POSE_NAMES = ("rigid", "independent")


@click.command(
    name="process",
    epilog=examples(
        "rfpose process recording.h5 -o result.h5",
        "rfpose process recording.h5 -o result.h5 --csv poses.csv --estimator correlator",
        "rfpose process measured/drf --scenario site.toml -o result.h5",
    ),
)
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Result to write (HDF5).")
@click.option("--scenario", type=click.Path(path_type=Path), help="Site description; wins over the recording's own.")
@click.option(
    "--estimator",
    type=click.Choice(ESTIMATOR_NAMES),
    default="hilbert",
    show_default=True,
    help="How tone phases are measured.",
)
@click.option(
    "--pose",
    type=click.Choice(POSE_NAMES),
    default="rigid",
    show_default=True,
    help="How a mirror's normal follows: from all phases of its receivers at once, or from each receiver located on "
    "its own, as published.",
)
@click.option("--csv", "csv_path", type=click.Path(path_type=Path), help="Also write the poses as CSV.")
@force_option
@common_options
@click.pass_obj
def command(
    session: Session,
    recording: Path,
    output: Path,
    scenario: Path | None,
    estimator: str,
    pose: str,
    csv_path: Path | None,
    force: bool,
) -> None:
    """Find receiver positions and mirror normals in a recording.

    RECORDING is an rfpose-iq file, a Digital RF directory or a SigMF file; the last two need --scenario.

    Interrupted or killed, the same command goes on where it stopped; the result is the same.
    """
    from rfpose.pipeline.files import refuse_existing
    from rfpose.pipeline.process import process
    from rfpose.pipeline.result_file import summarise, write_poses_csv

    session.when_interrupted = "interrupted; the same command resumes where it stopped"
    if csv_path is not None:
        refuse_existing(csv_path, force=force)
    with progress("Measuring") as on_progress:
        result = process(
            recording,
            output,
            scenario_path=scenario,
            estimator=estimator,
            pose=pose,
            force=force,
            on_progress=on_progress,
        )
    if csv_path is not None:
        write_poses_csv(result, csv_path)
    summary = summarise(result)
    if wants_json():
        emit_json({"result": output, "csv": csv_path, **summary})
        return
    table(
        str(output),
        ["", "solved", "failed"],
        [
            ["mirror poses", str(summary["poses"]["solved"]), str(summary["poses"]["failed"])],
            ["receiver fixes", str(summary["fixes"]["solved"]), str(summary["fixes"]["failed"])],
        ],
    )
    for what in ("poses", "fixes", "tones"):
        for reason, count in summary[what]["reasons"].items():
            say(f"  {count} {what}: {reason}")
