"""``rfpose process``: from a recording to mirror normals."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

import rfpose
from rfpose.cli._engine import engine_options
from rfpose.cli._support import (
    CommonOptions,
    check_table,
    common_options,
    declared_options,
    emit_json,
    examples,
    follow_links_option,
    force_option,
    gathered,
    outputs,
    progress,
    say,
    table,
    wants_json,
)

if TYPE_CHECKING:
    from rfpose.pipeline.follow import Follow
    from rfpose.pipeline.formats.result import Result
    from rfpose.recording.declared import Declared

__all__ = ["ESTIMATOR_NAMES", "POSE_NAMES", "REFLECTION_NAMES", "command"]

# Written out so that --help need not load the signal processing; a test holds them to what they name.
ESTIMATOR_NAMES = ("hilbert", "correlator", "dot", "dot-compensated")
POSE_NAMES = ("rigid", "site", "independent")
REFLECTION_NAMES = ("estimate", "ignore")


@dataclass(frozen=True, slots=True, kw_only=True)
class _How:
    """Arguments of `rfpose.process` that say how."""

    estimator: str
    pose: str
    reflection: str | None
    integrity: bool | None
    filtered: bool | None
    survey: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Following:
    """Options of ``--follow``."""

    follow: bool
    idle_timeout_s: float
    until: str | None
    lateness_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tables:
    """Tables to write besides the result."""

    csv: Path | None
    parquet: Path | None


@click.command(
    name="process",
    epilog=examples(
        "rfpose process recording.h5 -o result.h5",
        "rfpose process recording.h5 -o result.h5 --csv poses.csv --estimator correlator",
        "rfpose process measured/drf --scenario site.toml -o result.h5",
        "rfpose process recording.h5 -o result.h5 --reflection estimate",
        "rfpose process recording.h5 -o result.h5 --filter",
        "rfpose process night/*.h5 cal0/ mirror*.sigmf-meta -o result.h5",
        "rfpose process /data/night -o result.h5 --scheduler tcp://host:8786",
        "rfpose process /data/night -o result.h5 --follow --idle-timeout 600",
    ),
)
@click.argument("recording", nargs=-1, required=True, type=click.Path(path_type=Path))
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
    help="How a mirror's normal follows: from all phases of its receivers at once; from the carriers among the "
    "reflections that the site's geometry lets one expect; or from each receiver located on its own, as published.",
)
@click.option(
    "--reflection",
    type=click.Choice(REFLECTION_NAMES),
    help="Estimate the ground's reflection with the poses, or leave reflections out of the model. "
    "[default: as the scenario's [reflection] says]",
)
@click.option(
    "--integrity/--no-integrity",
    default=None,
    help="Test residuals, leave bad transmitters out, give protection levels. "
    "[default: as the scenario's [integrity] says: on]",
)
@click.option(
    "--filter/--no-filter",
    "filtered",
    default=None,
    help="Also filter poses over frames: mirrors turn steadily, outages are bridged. "
    "[default: as the scenario's [motion] says: off]",
)
@click.option(
    "--survey",
    type=click.Path(path_type=Path),
    help="Take receivers' places, pivots and transmitters from a file of `rfpose survey`.",
)
@click.option("--csv", type=click.Path(path_type=Path), help="Also write the poses as CSV.")
@click.option("--parquet", type=click.Path(path_type=Path), help="Also write the poses as Parquet; needs pyarrow.")
@click.option("--profile", is_flag=True, help="Also tell the seconds of each stage, and what takes longest.")
@click.option(
    "--follow",
    is_flag=True,
    help="RECORDING is being written: solve each frame when it is complete. Frames so far are in RESULT.partial.",
)
@click.option("--idle-timeout", "idle_timeout_s", type=click.FloatRange(min=0.0, min_open=True), default=60.0,
              show_default=True, help="With --follow: it has ended when nothing came for so long [s].")  # fmt: skip
@click.option("--until", metavar="TIME", help="With --follow: end with the first frame then or later, as "
              "2026-09-21T14:00:00Z.")  # fmt: skip
@click.option("--lateness", "lateness_s", type=click.FloatRange(min=0.0), default=1.0, show_default=True,
              help="With --follow: wait so long for receivers that lag behind the others [s].")  # fmt: skip
@declared_options
@engine_options
@follow_links_option
@force_option
@common_options
@gathered("how", _How)
@gathered("following", _Following)
@gathered("tables", _Tables)
@click.pass_obj
def command(
    session: CommonOptions,
    recording: tuple[Path, ...],
    output: Path,
    scenario: Path | None,
    how: _How,
    following: _Following,
    tables: _Tables,
    profile: bool,
    declared: Declared | None,
    follow_links: bool,
    force: bool,
) -> None:
    """Find receiver positions and mirror normals in a recording.

    RECORDING is an rfpose-iq file, a Digital RF directory, SigMF, or another of the known formats; those that hold no
    scenario need --scenario. Several are one recording: receivers apart, one after the other, formats mixed; so are
    those in a directory, and those that a manifest names (recording.toml).

    Interrupted or killed, the same command goes on where it stopped; the result is the same. With --follow the
    recording may still be written, or begin later: Digital RF, or a directory of closed rfpose-iq files.
    """
    session.when_interrupted = "interrupted; the same command resumes where it stopped"
    claimed = outputs(output, tables.csv, tables.parquet, inputs=[*recording, scenario, how.survey], force=force)
    with claimed, contextlib.ExitStack() as open_files:
        on_progress = None if following.follow else open_files.enter_context(progress("Measuring"))
        check_table(tables.parquet, ".parquet")
        given: Any = _follow(recording, following, output, session, is_declared=declared is not None) or recording
        if declared is not None:
            given = open_files.enter_context(
                rfpose.open_recording(recording, declared=declared, follow_links=follow_links)
            )
        result = rfpose.process(
            given,
            output,
            scenario=scenario,
            **asdict(how),
            follow_links=follow_links,
            force=force,
            on_progress=on_progress,
        )
        from rfpose.pipeline.formats.result_summary import pose_table, write_poses_csv
        from rfpose.tables import write_parquet

        if tables.csv is not None:
            write_poses_csv(result, tables.csv)
        if tables.parquet is not None:
            write_parquet(tables.parquet, *pose_table(result))
        summary = result.summary()
    if wants_json():
        told = {"profile": result.profile} if profile else {}
        emit_json({"result": output, **asdict(tables), **summary, **told})
        return
    table(
        str(output),
        ["", "solved", "failed"],
        [
            ["mirror poses", str(summary["poses"]["solved"]), str(summary["poses"]["failed"])],
            ["receiver fixes", str(summary["fixes"]["solved"]), str(summary["fixes"]["failed"])],
        ],
    )
    for what in ("poses", "fixes", "transmitters"):
        for reason, count in summary[what]["reasons"].items():
            say(f"  {count} {what}: {reason}")
    for line in _findings(summary):
        say(f"  {line}")
    if profile and result.profile is not None:
        _say_profile(result.profile)


def _follow(
    recording: tuple[Path, ...], following: _Following, output: Path, session: CommonOptions, *, is_declared: bool
) -> Follow | None:
    """Return how the recording is followed; None: it is complete."""
    context = click.get_current_context()
    if not following.follow:
        for name in ("idle_timeout_s", "until", "lateness_s"):
            if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
                raise click.UsageError("--idle-timeout, --until and --lateness go with --follow")
        return None
    if is_declared:
        raise click.UsageError("--follow reads Digital RF and rfpose-iq; leave --format out")
    if len(recording) > 1:
        raise click.UsageError("--follow takes one RECORDING; let the recorders write into one directory")
    from rfpose.pipeline.follow import Follow
    from rfpose.pipeline.formats.journal import partial_of
    from rfpose.recording.declared import seconds_of

    kept = partial_of(output)
    goes_on = f"interrupted; frames so far are in {kept}, and the same command goes on where it stopped"
    session.when_interrupted = goes_on if kept.exists() else "interrupted; no frame was complete yet"
    if not recording[0].exists():
        click.echo(f"rfpose: note: {recording[0]}: not there yet; waiting for it", err=True)
    return Follow(
        recording[0],
        idle_timeout_s=following.idle_timeout_s,
        until_s=None if following.until is None else seconds_of(following.until, "`until`"),
        lateness_s=following.lateness_s,
        on_frame=_Heard(session, goes_on),
    )


class _Heard:
    """Says now and then how far a recording is followed."""

    def __init__(self, session: CommonOptions, goes_on: str) -> None:
        self._session, self._goes_on = session, goes_on
        self._n_frame, self._said_at = 0, -math.inf

    def __call__(self, result: Result) -> None:
        self._n_frame += 1
        self._session.when_interrupted = self._goes_on
        if time.monotonic() - self._said_at < _SAID_EVERY_S:
            return
        self._said_at = time.monotonic()
        from rfpose.multilat import PoseStatus

        solved, wanted = int((result.poses.status == PoseStatus.OK).sum()), result.poses.status.size
        at = _frame_text(result)
        click.echo(f"rfpose: {self._n_frame} frames; that of {at}: {solved} of {wanted} poses solved", err=True)


_SAID_EVERY_S = 10.0


def _frame_text(result: Result) -> str:
    """Return when the last frame of a result began."""
    from rfpose.pipeline.formats.result import frame_time

    return f"{frame_time(int(result.frame_start_index[-1]), result.sample_rate):%Y-%m-%dT%H:%M:%SZ}"


def _say_profile(profile: Mapping[str, Any]) -> None:
    """Tell where the time went."""
    table("Seconds by stage", ["", "s"], [[name, f"{value:.2f}"] for name, value in profile["seconds"].items()])
    if profile["samples_per_s"] is not None:
        rate, cores = profile["samples_per_s"] / 1e6, profile["cores"]
        say(f"  {rate:,.0f} million samples a second read and measured, on {cores} cores")
    say(f"  longest: {profile['bound_by']}")


def _findings(summary: dict[str, Any]) -> list[str]:
    """Put what the estimator of poses found besides poses into words."""
    out = []
    integrity = summary.get("integrity", {})
    for reason, count in integrity.get("reasons", {}).items():
        out.append(f"{count} mirror-frames {reason}")
    for name, reasons in integrity.get("excluded", {}).items():
        out.extend(f"transmitter {name} left out of {count}: {reason}" for reason, count in reasons.items())
    if integrity.get("protection_level_mrad") is not None:
        out.append(f"protection level, median: {integrity['protection_level_mrad']:.3g} mrad of the normal")
    for name, c in summary.get("reflection", {}).get("coefficients", {}).items():
        value = "" if c["real"] is None else f": {c['real']:+.4f} {c['imag']:+.4f}j, sigma {c['sigma']:.2g}"
        out.append(f"reflection of {name} {c['status']}{value}")
    site = summary.get("site", {})
    if site.get("floor") is not None:
        out.append(f"{site['disturbed']} of {site['links']} links hear more than is foreseen and count less")
        out.append(f"field that nothing foresees, median: {site['floor']:.2g} of the direct one")
    delays = summary.get("delays", {})
    if delays.get("last_sigma_ps") is not None:
        out.append(f"receiver delays learned to {delays['last_sigma_ps']:.3g} ps, {delays['jumps']} jumps")
    filtered = summary.get("filtered", {})
    out.extend(f"{count} mirror-frames filtered: {reason}" for reason, count in filtered.get("reasons", {}).items())
    return out
