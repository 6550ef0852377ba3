"""``rfpose simulate``: a synthetic recording with its truth."""

from __future__ import annotations

import contextlib
from pathlib import Path

import click

import rfpose
from rfpose.cli._support import (
    CommonOptions,
    common_options,
    emit_json,
    examples,
    force_option,
    outputs,
    progress,
    say,
    wants_json,
)

__all__ = ["command"]


@click.command(
    name="simulate",
    epilog=examples(
        "rfpose simulate site.toml -o recording.h5",
        "rfpose simulate site.toml -o recording.h5 --seed 7 --force",
        "rfpose simulate site.toml -o night --live",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    help="Recording to write (HDF5); with --live a directory.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Same seed, same recording.")
@click.option("--live", is_flag=True, help="Write as a recorder would: a closed file a frame, when the frame is over.")
@click.option("--pace", type=click.FloatRange(min=0.0, min_open=True), default=1.0, show_default=True,
              help="With --live: seconds of the recording in a second.")  # fmt: skip
@force_option
@common_options
@click.pass_obj
def command(
    session: CommonOptions, scenario: Path, output: Path, seed: int, live: bool, pace: float, force: bool
) -> None:
    """Write the recording that a site would make, and the truth behind it.

    SCENARIO is a TOML file; its [simulation] table says how many frames, how much noise and which impairments.
    """
    held = contextlib.nullcontext() if live else outputs(output, inputs=[scenario], force=force)
    with held, progress("Simulating") as on_progress:
        recording = rfpose.simulate(scenario, seed=seed)
        if live:
            session.when_interrupted = "interrupted; frames so far are in the directory"
            recording.record(output, pace=pace, force=force, on_progress=on_progress)
        else:
            recording.save(output, on_progress=on_progress)
    n_byte = sum(file.stat().st_size for file in (output.glob("frame-*.h5") if live else [output]))
    summary = {"recording": output, **recording.as_dict(), "bytes": n_byte}
    if wants_json():
        emit_json(summary)
    else:
        say(
            f"{output}: {summary['frames']} frames of {summary['frame_samples']} samples, "
            f"{summary['receivers']} receivers, {summary['bytes'] / 1e6:.0f} MB"
        )
