"""``rfpose evaluate``: error against truth and against the bound."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

import rfpose
from rfpose.cli._support import (
    check_there,
    common_options,
    emit_json,
    examples,
    follow_links_option,
    progress,
    say,
    table,
    wants_json,
)

if TYPE_CHECKING:
    from rfpose.pipeline.evaluate import Evaluation, Statistics

__all__ = ["command", "show_evaluation"]


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
@follow_links_option
@common_options
def command(result: Path, truth: Path | None, follow_links: bool) -> None:
    """Compare a result with the truth and with the best that its noise allows.

    Errors are of the mirror normal; the beam's are twice that.
    """
    from rfpose.kinds import check_kind

    check_kind(result, wanted="result")
    check_there(truth)
    with progress("Evaluating"):
        evaluation = rfpose.evaluate(result, truth, follow_links=follow_links)
    if wants_json():
        emit_json(evaluation.as_dict())
        return
    show_evaluation(evaluation, title=str(result))
    table("By heliostat [mrad of the normal]", *evaluation.figures())


def show_evaluation(evaluation: Evaluation, *, title: str) -> None:
    """Print the table of an evaluation."""
    normal, position = evaluation.normal_error_mrad, evaluation.position_error_m
    rows = [
        _row("mirror normal [mrad]", normal, evaluation.bound_mrad, factor=1.0),
        _row("receiver position [mm]", position, evaluation.bound_m, factor=1e3),
    ]
    table(title, ["error", "rms", "median", "worst", "bound"], rows)
    say(
        f"rms over bound: {evaluation.ratio_to_bound:.3f} ± {evaluation.ratio_sigma:.2g} "
        f"(bound from the {evaluation.bound_source}'s noise)"
    )
    protection = evaluation.protection
    if protection is not None:
        say(
            f"protection level: median {protection.level_mrad.median:.3g} mrad of the normal; exceeded in "
            f"{protection.exceeded} of {protection.covered}, {protection.excluded} transmitters left out"
        )
    filtered = evaluation.filtered
    if filtered is not None:
        say(
            f"filtered over frames: {filtered.normal_error_mrad.rms:.3g} mrad of the normal rms, stated "
            f"{filtered.sigma_mrad:.3g}; squared error over stated covariance {filtered.nees:.3g}; "
            f"{filtered.predicted} of {filtered.given} mirror-frames predicted"
        )
    say(f"mirror-frames: {evaluation.solved} solved, {evaluation.failed} failed")
    for reason, count in evaluation.failure_reasons.items():
        say(f"  {count}: {reason}")


def _row(name: str, error: Statistics, bound: float, *, factor: float) -> list[str]:
    return [name, *(f"{factor * value:.3g}" for value in (error.rms, error.median, error.max, bound))]
