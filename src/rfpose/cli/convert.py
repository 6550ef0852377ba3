"""``rfpose convert``: recordings between formats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rfpose.cli._support import (
    common_options,
    declared_options,
    emit_json,
    examples,
    follow_links_option,
    force_option,
    outputs,
    progress,
    say,
    wants_json,
)

if TYPE_CHECKING:
    from rfpose.recording.declared import Declared

__all__ = ["COMPRESSION_NAMES", "FORMAT_NAMES", "command"]

# Written out so that --help need not load h5py; a test holds them to rfpose.recording.
FORMAT_NAMES = ("rfpose-iq", "digital-rf", "sigmf")
COMPRESSION_NAMES = ("bitshuffle-zstd", "bitshuffle-lz4", "blosc2")


@click.command(
    name="convert",
    epilog=examples(
        "rfpose convert measured/drf -o recording.h5 --scenario site.toml",
        "rfpose convert recording.h5 -o measured/drf --to digital-rf",
        "rfpose convert h01.iq -o h01.h5 --format raw --sample-type ci16_le --rate 4e7 --start 2026-09-21T14:00:00Z",
    ),
)
@click.argument("recording", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="File or directory to make.")
@click.option(
    "--to", "format_name", type=click.Choice(FORMAT_NAMES), default="rfpose-iq", show_default=True, help="Format."
)
@click.option(
    "--compress",
    type=click.Choice(COMPRESSION_NAMES),
    help="Of rfpose-iq: make it smaller without loss. [default: not]",
)
@click.option(
    "--verify/--no-verify", default=True, show_default=True, help="Read what was written, and compare checksums."
)
@click.option("--scenario", type=click.Path(path_type=Path), help="Site description to go with it.")
@declared_options
@follow_links_option
@force_option
@common_options
def command(
    recording: tuple[Path, ...],
    output: Path,
    format_name: Any,
    compress: str | None,
    verify: bool,
    scenario: Path | None,
    declared: Declared | None,
    follow_links: bool,
    force: bool,
) -> None:
    """Write a recording in another format; samples, times and gaps stay exactly as they are."""
    directories = format_name != FORMAT_NAMES[0]
    claimed = outputs(output, inputs=[*recording, scenario], force=force, directories=directories)
    with claimed, progress("Converting") as on_progress:
        from rfpose.recording import convert, note_doubts, open_recording
        from rfpose.scenario import load_scenario

        given = None if scenario is None else load_scenario(scenario)
        with open_recording(recording, scenario=given, declared=declared, follow_links=follow_links) as source:
            digests = convert(
                source,
                output,
                format=format_name,
                overwrite=force,
                compress=compress,
                verify=verify,
                on_progress=on_progress,
            )
            note_doubts(source)
            found = {
                "recording": output,
                "format": format_name,
                "receivers": len(source.receiver_ids),
                "sha256": digests,
            }
    if wants_json():
        emit_json(found)
    else:
        say(f"{output}: {format_name}, {found['receivers']} receivers")
