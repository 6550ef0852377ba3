"""``rfpose track``: a field tracked in simulation, by radio and by what plants do today."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import click

import rfpose
from rfpose.cli._engine import engine_options
from rfpose.cli._support import (
    CommonOptions,
    check_ending,
    check_table,
    common_options,
    emit_json,
    examples,
    force_option,
    gathered,
    outputs,
    progress,
    say,
    table,
    wants_json,
)

__all__ = ["command"]

# names only, since the module that defines them loads numpy
_METHODS = (
    "open-loop", "encoder", "bias", "berenguel", "camera-model", "drone-model", "sun-sensor", "radio", "radio-model",
    "radio-both",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Changes:
    """What the run takes instead of what the scenario says: `rfpose.pipeline.track.TrackChanges`."""

    days: int | None
    day_interval: int | None
    sky: str | None
    events: tuple[dict[str, Any], ...]
    without_field_control: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class _Files:
    """What is written besides the result."""

    csv: Path | None
    parquet: Path | None
    series: Path | None
    picture: Path | None


def _event(text: str) -> dict[str, Any]:
    """Read an event of the command line into the keys of ``[[tracking.event]]``."""
    words = text.split()
    day, _, hour = words[0].rpartition(":") if words else ("", "", "")
    try:
        if not 2 <= len(words) <= 3:
            raise ValueError
        event: dict[str, Any] = {"hour": float(hour), "what": words[1]} | ({"day": int(day)} if day else {})
        if len(words) == 3:
            who = words[2]
            event |= {"cluster": int(who[1:])} if who.startswith("#") else {"heliostats": tuple(who.split(","))}
    except ValueError:
        raise click.BadParameter(
            f"{text!r} must be '[DAY:]HOUR WHAT [WHO]', such as '11.5 emergency', '9 calibrate H01,H02' or "
            "'2:12 cluster-fails #0'",
            param_hint="'--event'",
        ) from None
    return event


def _events(_ctx: click.Context, _option: click.Parameter, texts: tuple[str, ...]) -> tuple[dict[str, Any], ...]:
    return tuple(_event(text) for text in texts)


def _names(_ctx: click.Context, _option: click.Parameter, text: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",")) if text else ()


@click.command(
    name="track",
    epilog=examples(
        "rfpose track data/tracking_100m.toml -o day.h5",
        "rfpose track site.toml -o year.h5 --heliostats 100 --days 12 --day-interval 30 --picture year.png",
        "rfpose track site.toml -o clouds.h5 --days 12 --day-interval 30 --sky bursts",
        "rfpose track site.toml -o field.h5 --heliostats 10000 --methods radio",
        "rfpose track site.toml -o alarm.h5 --event '11.5 emergency' --event '12 release'",
        "rfpose track site.toml -o lost.h5 --event '9.5 counts-lost H03' --event '9.6 zero-counts H03' "
        "--event '10 calibrate H03'",
    ),
)
@click.argument("scenario", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Result to write (HDF5).")
@click.option(
    "--methods",
    metavar="NAMES",
    callback=_names,
    help=f"Comma-separated; default: all that fit. Known: {', '.join(_METHODS)}.",
)
@click.option("--days", type=click.IntRange(min=1), help="How many days; default: the scenario's.")
@click.option("--day-interval", type=click.IntRange(min=1), help="Days from one simulated day to the next.")
@click.option("--heliostats", type=int, help="How many mirrors; more than the scenario lists: spread over its field.")
@click.option(
    "--sky", type=click.Choice(["clear", "bursts"]), help="Clear, or clouds and sun by turns; default: the scenario's."
)
@click.option(
    "--event",
    "events",
    multiple=True,
    metavar="'[DAY:]HOUR WHAT [WHO]'",
    callback=_events,
    help="Something that happens, as in [[tracking.event]]: '11.5 emergency', '9 calibrate H01,H02', "
    "'2:12 cluster-fails #0'. WHO: names, or # and the number of a cluster. May be repeated.",
)
@click.option(
    "--without-field-control", is_flag=True, help="Track from the first second: no modes, messages and events."
)
@click.option(
    "--check-iq",
    metavar="NAMES",
    callback=_names,
    help="Also take these mirrors through samples and the whole chain in 16 postures: does the radio model hold?",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Same seed, same result.")
@click.option("--csv", type=click.Path(path_type=Path), help="Also write one row a method and mirror.")
@click.option("--parquet", type=click.Path(path_type=Path), help="The same as Parquet; needs pyarrow.")
@click.option(
    "--series",
    type=click.Path(path_type=Path),
    help="Also write one row a method and instant: errors, flux, modes; CSV, or Parquet if it ends so.",
)
@click.option("--picture", type=click.Path(path_type=Path), help="PNG or SVG of errors over time and by mirror.")
@engine_options
@force_option
@common_options
@gathered("changes", _Changes)
@gathered("files", _Files)
@click.pass_obj
def command(
    session: CommonOptions,
    scenario: Path,
    output: Path,
    methods: tuple[str, ...],
    heliostats: int | None,
    check_iq: tuple[str, ...],
    seed: int,
    changes: _Changes,
    files: _Files,
    force: bool,
) -> None:
    """Track a field in simulation, by each method on the same sun, wind and hidden errors; rank the methods.

    SCENARIO is a TOML file; its [tracking] table says what mounts, drives, wind, radio and cameras are like.

    Interrupted or killed, the same command goes on where it stopped; the result is the same. Milliradians are of the
    mirror normal; the beam turns by twice as much.
    """
    session.when_interrupted = "interrupted; the same command resumes where it stopped"
    check_ending(files.picture, ".png", ".svg", ".pdf")
    check_table(files.parquet, ".parquet")
    check_table(files.series, ".csv", ".parquet")
    written = asdict(files)
    claimed = outputs(output, *written.values(), inputs=[scenario], force=force)
    with claimed, progress("Tracking") as on_progress:
        from rfpose.drawing import save_figure
        from rfpose.pipeline.track import TrackChanges
        from rfpose.tables import write_csv, write_parquet, write_table

        found = rfpose.track(
            scenario,
            output,
            methods=methods,
            changes=TrackChanges(**asdict(changes)),
            heliostats=heliostats,
            check_iq=check_iq,
            seed=seed,
            force=force,
            on_progress=on_progress,
        )
        if files.csv is not None:
            write_csv(files.csv, *found.table())
        if files.parquet is not None:
            write_parquet(files.parquet, *found.table())
        if files.series is not None:
            write_table(files.series, *found.series_table())
        if files.picture is not None:
            save_figure(found.plot(), files.picture)
        summary = found.as_dict()
    if wants_json():
        emit_json({"result": output, **written, **summary})
        return
    n_day = len(summary["days"])
    table(
        f"{summary['scenario']}: {summary['heliostats']} mirrors, {n_day} day{'s' if n_day > 1 else ''}; "
        "errors of the normal [mrad]",
        ["method", "rms", "budget", "95 %", "worst", "caught", "kWh/m²", "steps"],
        [_row(name, summary["methods"][name]) for name in summary["ranking"]],
    )
    say("  rms, 95 % and worst of all mirrors and seconds; budget: the rms foreseen without simulating; part of a")
    say("  perfect tracker's light caught, light caught by a square metre of mirror; motor steps a mirror and day")
    bears = summary["margins"]
    if bears is not None:
        say(
            f"  radio loop: gain margin {bears['gain']:.1f}, phase margin {bears['phase_deg']:.0f} degrees; bears "
            f"{bears['more_latency_s']:.0f} s more latency, intervals up to {bears['longest_interval_s']:.0f} s"
        )
    for each in summary["iq"]:
        say(
            f"  {each['heliostat']} from samples: {each['solved']} of {each['postures']} postures, "
            f"{each['error_rms_mrad']:.3g} mrad rms; by the model {each['model_rms_mrad']:.3g}"
        )
    for name in summary["ranking"]:
        for i, outage in enumerate(summary["methods"][name]["outages"] if name.startswith("radio") else (), start=1):
            if outage["rms_mrad"] is not None:
                say(
                    f"  {name}: {outage['rms_mrad']:.3g} mrad in outage {i} of the radio, "
                    f"{outage['loss_kwh_per_m2']:.3g} kWh/m² lost by it"
                )
        sun = summary["methods"][name]["sunshine"]
        if sun["response_loss"] is not None:
            say(
                f"  {name}: {sun['bursts']:.4g} times out of clouds, {1e3 * sun['response_loss']:.2g} ‰ of the light "
                f"lost in the first {sun['response_window_s']:.0f} s, {1e3 * sun['turning_loss']:.2g} ‰ by turning"
            )
        if "field_control" in summary["methods"][name]:
            _say_field_control(name, summary["methods"][name])
        if summary["methods"][name]["out_of_reach"]:
            share = 100.0 * summary["methods"][name]["out_of_reach"]
            say(f"  {name}: {share:.2g} % of the time mirrors could not face their aim point")


def _say_field_control(name: str, found: dict[str, Any]) -> None:
    """Print what field control has to tell of a method."""
    away = {mode: value for mode, value in found["modes"].items() if mode not in ("point", "track")}
    lost = sum(value["lost_kwh_per_m2"] for value in away.values())
    if lost > 0.0:
        worst = ", ".join(sorted(away, key=lambda mode: -away[mode]["lost_kwh_per_m2"])[:3])
        say(f"  {name}: {lost:.3g} kWh/m² lost while mirrors were not on the receiver ({worst})")
    for day in found["field_control"]:
        for alarm in day["alarms"]:
            times = [alarm["below_tenth_s"], alarm["off_s"], alarm["stowed_s"]]
            below, off, stowed = ("–" if each is None else f"{each:.0f}" for each in times)
            say(
                f"  {name}, {day['day']}, {alarm['alarm']}: flux below a tenth after {below} s, last mirror off after "
                f"{off} s, all stowed after {stowed} s"
            )
        for each in day["calibrations"]:
            searched = " after a search" if each["searched"] else ""
            say(f"  {name}, {day['day']}: {each['heliostat']} {each['outcome']}{searched}, {each['took_s']:.0f} s")
        for event in day["events"]:
            for why, count in event.get("refused", {}).items():
                say(f"  {name}, {day['day']}, {event['hour']:g} h: {count} mirrors: {why}")


def _row(name: str, found: dict[str, Any]) -> list[str]:
    normal = found["normal_mrad"]
    cells = [normal["rms"], found["budget"]["total_mrad"], normal["p95"], normal["worst"]]
    return [
        name,
        *("–" if value is None else f"{value:.3g}" for value in cells),
        "–" if found["intercept"] is None else f"{found['intercept']:.4f}",
        f"{found['energy_kwh_per_m2']:.3f}",
        f"{found['motor_steps_per_day']:.0f}",
    ]
