"""``rfpose survey``: from recordings of many postures to what does not change."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

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
    table,
    wants_json,
)

__all__ = ["command"]


@click.command(
    name="survey",
    epilog=examples(
        "rfpose survey night.h5 day.h5 -o survey.h5",
        "rfpose survey night/ -o survey.h5",
        "rfpose survey night.h5 --reference camera.csv -o survey.h5",
        "rfpose process recording.h5 --pose site --survey survey.h5 -o result.h5",
    ),
)
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RECORDING...")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Survey to write (HDF5).")
@click.option("--scenario", type=click.Path(path_type=Path), help="Site description; wins over the recordings' own.")
@click.option(
    "--reference",
    type=click.Path(path_type=Path),
    help="CSV of normals from elsewhere, as of a camera: id, frame or time, and normal_e, normal_n, normal_u or "
    "azimuth_deg, elevation_deg.",
)
@click.option(
    "--reference-sigma",
    type=click.FloatRange(min=0.0, min_open=True),
    default=0.1,
    show_default=True,
    help="How good they are, in each of two directions [mrad].",
)
@click.option(
    "--mount",
    type=click.Path(path_type=Path),
    help="Mounts that control believed in (JSON or TOML); without it azimuth over elevation.",
)
@click.option(
    "--motors",
    type=click.Path(path_type=Path),
    help="CSV of motor positions: time_utc, heliostat, axis_1, axis_2; without it motors stood as commanded.",
)
@follow_links_option
@force_option
@common_options
def command(
    recordings: tuple[Path, ...],
    output: Path,
    scenario: Path | None,
    reference: Path | None,
    reference_sigma: float,
    mount: Path | None,
    motors: Path | None,
    follow_links: bool,
    force: bool,
) -> None:
    """Find what does not change over many postures: places of receivers, pivots, transmitters, mounts.

    A RECORDING may be a directory or a manifest (recording.toml) of parts, as for process. Recordings that do not all
    hold the same receivers are parts of one.

    Says what the postures do not tell: how the receivers are turned against the plate, above all, which radio alone
    never tells.
    """
    with (
        outputs(output, inputs=[*recordings, scenario, reference, mount, motors], force=force),
        progress("Surveying") as on_progress,
    ):
        found = rfpose.survey(
            recordings,
            output,
            scenario=scenario,
            reference=reference,
            reference_sigma_rad=1e-3 * reference_sigma,
            mounts=mount,
            motors=motors,
            follow_links=follow_links,
            force=force,
            on_progress=on_progress,
        )
        report = found.as_dict()
    if wants_json():
        emit_json({"survey": output, **report})
        return
    rows = [
        [
            name,
            f"{one['frames']} ({one['frames_worth']:.1f})",
            str(one["rank"]),
            *(f"{x:.3f}" for x in one["normal_sigma_mrad"].values()),
        ]
        for name, one in report["heliostats"].items()
    ]
    header = ["", "frames (worth)", "rank", "before", "now", "+ reference pose", "+ receiver surveyed"]
    table("Normal's error from places [mrad]", header, rows)
    mounts = {name: one["mount"] for name, one in report["heliostats"].items()}
    table("Mounts: what they are off by, and sigma [mrad]; error of their normals", _MOUNT_HEADER, [
        [name, *(_found(one, key) for key in one["parameters"]), *(_mrad(x) for x in one["normal_sigma_mrad"].values())]
        for name, one in mounts.items()
    ])  # fmt: skip
    by_words = _counted(one["undetermined"] for one in report["heliostats"].values())
    for word, count in by_words.items():
        say(f"  {count} heliostats, not determined: {word}")
    for word, count in _counted(one["undetermined"] for one in mounts.values()).items():
        say(f"  {count} heliostats, of the mount not determined: {word}")
    if any("rotation of the receivers" in word for word in by_words):
        say(
            "  radio alone does not tell how receivers are turned against the plate, which the mounts' zeros have in "
            "them; a reference pose would (--reference)"
        )
    for word in report["transmitters_undetermined"]:
        say(f"  not determined: {word}")
    say(f"wrote {output}")


_MOUNT_HEADER = ["", "tilt north", "tilt east", "zero 1", "zero 2", "square", "before", "now", "+ reference pose"]


def _found(mount: dict[str, Any], key: str) -> str:
    return f"{1e3 * mount['parameters'][key]:.2f} ± {1e3 * mount['sigma'][key]:.2f}"


def _mrad(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _counted(lists: Iterable[list[str]]) -> Counter[str]:
    return Counter(word for words in lists for word in words)
