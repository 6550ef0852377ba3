"""``rfpose layout map``: what each mirror's normal can be known to."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import click

import rfpose
from rfpose.cli._support import (
    check_ending,
    check_scenario,
    common_options,
    emit_json,
    examples,
    force_option,
    outputs,
    progress,
    say,
    table,
    wants_json,
)
from rfpose.cli.layout._options import ESTIMATORS, StudiedHeliostats, field_options
from rfpose.shown import counted

__all__ = ["command"]


@click.command(
    name="map",
    epilog=examples(
        "rfpose layout map site.toml",
        "rfpose layout map site.toml --sun 120 30 --sun 180 60 --estimator rigid --picture map.png --csv map.csv",
        "rfpose layout map site.toml --day 2026-06-21 --stow --line-of-sight 3.2 2.6 --tower 4 60",
        "rfpose layout map site.toml --estimator rigid --sensitivity",
        "rfpose layout map site.toml --estimator site --day 2026-06-21 --csv map.csv",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option("--estimator", "estimators", type=click.Choice(ESTIMATORS), multiple=True,
              help="Default: all that the scenario allows but `site`. `scenario`: as `rfpose process` solves it; "
                   "`site`: as it does with --pose site.")  # fmt: skip
@click.option("--snr", "tone_snr_db", type=float, help="Tone SNR [dB] instead of the scenario's.")
@click.option("--line-of-sight", "sight", type=(float, float), metavar="WIDTH HEIGHT",
              help="Count only what receivers see past plates of this size [m].")  # fmt: skip
@click.option("--behind", is_flag=True, help="Receivers flush with the plate look out of its back.")
@click.option("--tower", type=(float, float), metavar="RADIUS TOP", help="And past a tower at the origin [m].")
@click.option("--sensitivity", is_flag=True, help="What losing, moving and mis-surveying each transmitter does.")
@click.option("--picture", type=click.Path(path_type=Path), help="PNG or SVG, of the first estimator.")
@click.option("--csv", "csv_path", type=click.Path(path_type=Path), help="One row a heliostat.")
@field_options
@force_option
@common_options
def command(
    scenario: Path,
    estimators: tuple[str, ...],
    tone_snr_db: float | None,
    sight: tuple[float, float] | None,
    behind: bool,
    tower: tuple[float, float] | None,
    sensitivity: bool,
    picture: Path | None,
    csv_path: Path | None,
    studied: StudiedHeliostats,
    force: bool,
) -> None:
    """Say what each mirror's normal can be known to, and what the loss of each transmitter costs."""
    if (tower is not None or behind) and sight is None:
        raise click.UsageError("--tower and --behind need --line-of-sight WIDTH HEIGHT, the size of the plates")
    check_ending(picture, ".png", ".svg")
    with outputs(picture, csv_path, inputs=[scenario, studied.field], force=force), progress("Mapping"):
        check_scenario(scenario)
        from rfpose.drawing import save_figure
        from rfpose.layout.sight import Plates, Tower
        from rfpose.pipeline.layout import Sight

        seen = None
        if sight is not None:
            seen = Sight(
                plates=Plates(width_m=sight[0], height_m=sight[1], flush="back" if behind else "front"),
                tower=None if tower is None else Tower(radius_m=tower[0], top_m=tower[1]),
            )
        found = rfpose.layout_map(
            scenario,
            estimators=estimators or None,
            postures=studied.postures(),
            field=studied.field,
            tone_snr_db=tone_snr_db,
            sight=seen,
            sensitivity=sensitivity,
        )
        if picture is not None:
            save_figure(found.plot(), picture)
        if csv_path is not None:
            found.save(csv_path)
    summary = found.as_dict()
    if wants_json():
        emit_json({**summary, "picture": picture, "csv": csv_path})
        return
    _say(summary)


def _say(summary: dict[str, Any]) -> None:
    rows: list[list[str]] = [["PDOP", *_cells(summary["pdop"]), ""], ["VDOP", *_cells(summary["vdop"]), ""]]
    for name, values in summary["normal_mrad"].items():
        rows.append([f"normal, {name} [mrad]", *_cells(values), f"{100.0 * values['undetermined']:.3g} %"])
    names = list(next(iter(summary["normal_by_posture_mrad"].values()), {}))
    postures = f"posture: {names[0]}" if len(names) == 1 else f"{summary['postures']} postures"
    title = f"{summary['scenario']}: {summary['heliostats']} heliostats, {postures}"
    table(title, ["bound", "rms", "median", "95 %", "worst", "unsolved"], rows)
    sight = summary.get("line_of_sight")
    if sight is not None:
        say(f"a receiver sees {sight['seen_mean']:.3g} transmitters on average, {sight['seen_least']:g} at the least")
    _say_postures(summary)
    for reason, count in Counter(summary.get("site_unsolved", {}).values()).most_common():
        say(f"site: {counted(count, 'heliostat')} not solved in every posture: {reason}")
    for name, lost in summary["normal_without_transmitter_mrad"].items():
        worst = max(lost, key=lambda key: lost[key])
        say(f"{name}: losing {worst} is worst, {lost[worst]:.4g} mrad rms")
    for name, response in summary.get("sensitivity", {}).items():
        table(
            f"{name}: rms over the field [mrad], when a transmitter is lost, surveyed 1 mm off, moved by 1 m",
            ["", "lost", "survey E", "N", "U", "move E", "N", "U"],
            [
                [key, f"{one['lost_mrad']:.4g}", *(f"{x:.3g}" for x in one["survey_mrad_per_mm"]),
                 *(f"{x:+.2g}" for x in one["move_mrad_per_m"])]
                for key, one in response.items()
            ],
        )  # fmt: skip


def _say_postures(summary: dict[str, Any]) -> None:
    """One row a posture, where there are several."""
    if summary["postures"] < 2:
        return
    by_posture = summary["normal_by_posture_mrad"]
    sight = summary.get("line_of_sight", {}).get("by_posture")
    names = list(next(iter(by_posture.values()), {}))
    rows = []
    for name in names:
        row = [name, *(f"{values[name]:.4g}" for values in by_posture.values())]
        rows.append(row + ([f"{sight[name]['mean']:.3g}", f"{sight[name]['least']:g}"] if sight else []))
    header = ["posture", *by_posture, *(["seen", "least"] if sight else [])]
    table("rms over the field of the normal's bound [mrad]", header, rows)


def _cells(values: dict[str, float]) -> list[str]:
    return [f"{values[key]:.4g}" for key in ("rms", "median", "p95", "worst")]
