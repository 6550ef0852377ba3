"""``rfpose demo``: the whole way on a simulated field."""

from __future__ import annotations

from pathlib import Path

import click

from rfpose.cli._support import (
    CommonOptions,
    common_options,
    emit_json,
    examples,
    force_option,
    progress,
    say,
    wants_json,
    when_written,
)
from rfpose.cli.evaluate import show_evaluation

__all__ = ["command", "write_report"]


@click.command(name="demo", epilog=examples("rfpose demo", "rfpose demo -o field --seed 3 --json"))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("demo"),
    show_default=True,
    help="Directory for recording, result, table and pictures.",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Same seed, same recording.")
@force_option
@common_options
@click.pass_obj
def command(session: CommonOptions, output: Path, seed: int, force: bool) -> None:
    """Simulate a field of 12 heliostats, process the recording, evaluate it, draw it and write a report."""
    from rfpose.pipeline.demo import run_demo

    with progress("Preparing") as shown:
        outcome = run_demo(output, seed=seed, force=force, on_progress=shown, on_stage=shown.stage, report=write_report)
    files = outcome.files
    session.when_interrupted = when_written(*files.values())
    if wants_json():
        emit_json(
            {
                **outcome.evaluation.as_dict(),
                "independent": outcome.independent.as_dict(),
                "files": files,
            }
        )
        return
    show_evaluation(outcome.independent, title="Each receiver located on its own, as published")
    show_evaluation(outcome.evaluation, title="All phases of a mirror at once, carrier included")
    for what, path in files.items():
        say(f"{what.replace('_', ' ')}: {path}")


def write_report(result: Path, report: Path) -> None:
    """Write the report of a result."""
    from rfpose.files import write_atomically
    from rfpose.pipeline.report import report_html

    write_atomically(report, report_html(result).encode())
