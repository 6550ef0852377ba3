"""``rfpose sample``: made-up measurements, for commands that need some."""

from __future__ import annotations

from pathlib import Path

import click

from rfpose.cli._support import common_options, emit_json, examples, force_option, outputs, progress, say, wants_json

__all__ = ["KIND_NAMES", "command"]

# Written out so that --help need not load what makes them; a test holds them to what they name.
KIND_NAMES = ("paint", "camera", "drone", "motors")

_NEXT = {
    "paint": "rfpose calibrate {d}",
    "camera": "rfpose calibrate --mount {d}/planned.toml --camera {d}/pictures -o models.json",
    "drone": "rfpose calibrate --mount {d}/planned.toml --drone {d}/flight.csv -o models.json",
    "motors": "rfpose calibrate --mount {d}/planned.toml --radio {d}/night.h5 --motors {d}/motors.csv -o models.json",
}


@click.command(
    name="sample",
    epilog=examples(
        "rfpose sample paint paint",
        "rfpose sample camera board",
        "rfpose sample drone flight",
        "rfpose sample motors night",
    ),
)
@click.argument("kind", type=click.Choice(KIND_NAMES))
@click.argument("directory", type=click.Path(path_type=Path))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Same seed, same files.")
@force_option
@common_options
def command(kind: str, directory: Path, seed: int, force: bool) -> None:
    """Write a directory of made-up measurements, to try a command with.

    KIND: `paint`, calibration records in PAINT's layout; `camera`, pictures of a target; `drone`, a flight's log;
    `motors`, a result of radio with the log of the motors. Nothing in DIRECTORY was measured, as a file there says.
    """
    with outputs(directory, force=force, directories=True), progress("Making"):
        from rfpose.pipeline.samples import write_sample

        files = write_sample(kind, directory, seed=seed, force=True)
    if wants_json():
        emit_json({"directory": directory, "kind": kind, "synthetic": True, "files": list(files)})
        return
    say(f"{directory}: {len(files)} files, made up (nothing was measured); try")
    say(f"  {_NEXT[kind].format(d=directory)}")
