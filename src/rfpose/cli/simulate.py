"""``rfpose simulate``: a synthetic recording with its truth."""

from __future__ import annotations

from pathlib import Path

import click

import rfpose
from rfpose.cli._support import common_options, emit_json, examples, force_option, outputs, progress, say, wants_json

__all__ = ["command"]


@click.command(
    name="simulate",
    epilog=examples(
        "rfpose simulate site.toml -o recording.h5",
        "rfpose simulate site.toml -o recording.h5 --seed 7 --force",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Recording to write (HDF5).")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Same seed, same recording.")
@force_option
@common_options
def command(scenario: Path, output: Path, seed: int, force: bool) -> None:
    """Write the recording that a site would make, and the truth behind it.

    SCENARIO is a TOML file; its [simulation] table says how many frames, how much noise and which impairments.
    """
    with outputs(output, inputs=[scenario], force=force), progress("Simulating") as on_progress:
        recording = rfpose.simulate(scenario, seed=seed)
        recording.save(output, on_progress=on_progress)
    summary = {"recording": output, **recording.as_dict(), "bytes": output.stat().st_size}
    if wants_json():
        emit_json(summary)
    else:
        say(
            f"{output}: {summary['frames']} frames of {summary['frame_samples']} samples, "
            f"{summary['receivers']} receivers, {summary['bytes'] / 1e6:.0f} MB"
        )
