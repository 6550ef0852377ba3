"""``rfpose antenna``: patterns of receivers on a metal plate."""

from __future__ import annotations

from pathlib import Path

import click

import rfpose
from rfpose.cli._support import (
    common_options,
    emit_json,
    examples,
    follow_links_option,
    force_option,
    outputs,
    progress,
    say,
    wants_json,
)

__all__ = ["command"]


@click.group(name="antenna")
def command() -> None:
    """Patterns of the receivers' antennas, the metal plate behind them included."""


@command.command(
    name="learn",
    epilog=examples(
        "rfpose antenna learn night.h5 day.h5 -o pattern.h5",
        "rfpose antenna learn night/ -o pattern.h5",
        "rfpose antenna learn night.h5 --survey survey.h5 --start nec.h5 -o pattern.h5",
        'then in the scenario: [antenna] pattern = "pattern.h5"',
    ),
)
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RECORDING...")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Pattern to write (HDF5 or TOML).")
@click.option("--scenario", type=click.Path(path_type=Path), help="Site description; wins over the recordings' own.")
@click.option("--start", type=click.Path(path_type=Path), help="Pattern that the true one is near to, as NEC gives it.")
@click.option(
    "--survey",
    type=click.Path(path_type=Path),
    help="File of `rfpose survey`: mirrors stand where its mounts have them, and not where they were told to.",
)
@click.option(
    "--mount",
    "mounts",
    type=click.Path(path_type=Path),
    help="Mounts that control believed in, if the survey was given them.",
)
@follow_links_option
@force_option
@common_options
def learn(
    recordings: tuple[Path, ...],
    output: Path,
    scenario: Path | None,
    start: Path | None,
    survey: Path | None,
    mounts: Path | None,
    follow_links: bool,
    force: bool,
) -> None:
    """Learn the pattern of the receivers on a type of mirror from recordings of many postures.

    A RECORDING may be a directory or a manifest (recording.toml) of parts, as for process. Recordings that do not all
    hold the same receivers are parts of one.

    Mirrors must be alike, and stand where [posture] or the survey says to a few milliradians. Writes nothing where what
    was learned has not settled.
    """
    inputs = [*recordings, scenario, start, survey, mounts]
    with outputs(output, inputs=inputs, force=force), progress("Learning") as on_progress:
        found = rfpose.learn_pattern(
            recordings,
            output,
            scenario=scenario,
            start=start,
            survey=survey,
            mounts=mounts,
            follow_links=follow_links,
            force=force,
            on_progress=on_progress,
        )
    if wants_json():
        emit_json({"pattern": output, **found.as_dict()})
        return
    say(found.report())
    say(f"wrote {output}")
