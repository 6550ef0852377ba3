"""``rfpose evaluate``: error against truth and against the bound."""

from __future__ import annotations

from pathlib import Path

import click

from rfpose.cli._support import common_options, emit_json, examples, say, table, wants_json

__all__ = ["command"]


@click.command(
    name="evaluate",
    epilog=examples(
        "rfpose evaluate result.h5",
        "rfpose evaluate result.h5 --truth truth.json --json",
    ),
)
@click.argument("result", type=click.Path(path_type=Path))
@click.option(
    "--truth", type=click.Path(path_type=Path), help="Recording with truth, or JSON; else what the result carries."
)
@common_options
def command(result: Path, truth: Path | None) -> None:
    """Compare a result with the truth and with the best that its noise allows.

    Errors are of the mirror normal; the beam's are twice that.
    """
    from rfpose.pipeline.evaluate import evaluate, read_truth
    from rfpose.pipeline.result_file import read_result

    found = read_result(result)
    evaluation = evaluate(found, None if truth is None else read_truth(truth, found.scenario))
    if wants_json():
        emit_json(evaluation.as_dict())
        return
    table(str(result), *evaluation.as_table())
    table("By heliostat", *evaluation.heliostat_table())
    for reason, count in evaluation.failure_reasons.items():
        say(f"  {count} mirror-frames failed: {reason}")
