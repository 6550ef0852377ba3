"""``rfpose plot``: one figure of a result, a tracking run, a recording or a scenario."""

from __future__ import annotations

from pathlib import Path

import click

from rfpose.cli._support import (
    check_ending,
    check_there,
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

__all__ = ["COLOUR_NAMES", "FIGURE_NAMES", "command"]

# names only, since the modules that define them load numpy; a test holds them to what they name
FIGURE_NAMES = ("map", "errors", "links", "mirror", "budget", "layout", "course", "methods", "instant", "spectrum",
                "waterfall")  # fmt: skip
COLOUR_NAMES = ("error", "sigma", "protection", "transmitters")


@click.command(
    name="plot",
    epilog=examples(
        "rfpose plot result.h5 -o map.pdf",
        "rfpose plot result.h5 --what errors -o errors.svg",
        "rfpose plot result.h5 --what mirror --heliostat H05 --frame 2 -o H05.png",
        "rfpose plot result.h5 --what map --colour protection -o protection.png",
        "rfpose plot day.h5 --what methods -o methods.pdf",
        "rfpose plot site.toml --what budget -o budget.png",
    ),
)
@click.argument("file", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Figure: .png, .svg or .pdf.")
@click.option(
    "--what",
    type=click.Choice(FIGURE_NAMES),
    help="Of a result: map (default), errors, links, mirror, budget, layout; of a tracking run: course (default), "
    "methods, instant, mirror; of a recording: spectrum (default), waterfall; of a scenario: layout (default), budget.",
)
@click.option("--frame", type=click.IntRange(min=0), help="This frame (of a run: instant), from 0; default: all.")
@click.option("--heliostat", help="This mirror.")
@click.option("--receiver", help="This receiver of a recording; default: the first.")
@click.option("--method", help="This method of a tracking run; default: the one that catches most light.")
@click.option(
    "--colour", type=click.Choice(COLOUR_NAMES), help="What colours tell on a map; default: error, else sigma."
)
@click.option(
    "--truth", type=click.Path(path_type=Path), help="As for `rfpose evaluate`; default: what the result has."
)
@click.option("--theme", type=click.Choice(("light", "dark")), default="light", show_default=True)
@follow_links_option
@force_option
@common_options
def command(
    file: Path,
    output: Path,
    what: str | None,
    truth: Path | None,
    theme: str,
    follow_links: bool,
    force: bool,
    **chosen: str | int | None,
) -> None:
    """Draw one figure of FILE, made for paper: a result, a tracking run, a recording or a scenario."""
    check_ending(output, ".png", ".svg", ".pdf")
    with outputs(output, inputs=[file, truth], force=force), progress("Drawing"):
        check_there(file, truth)
        from rfpose.drawing import look, save_figure
        from rfpose.pipeline.pictures.catalogue import FigureChoice, draw, opened_file

        with opened_file(file, truth=truth, follow_links=follow_links) as opened, look(theme):  # type: ignore[arg-type]
            save_figure(draw(opened, what, FigureChoice(**chosen)), output)  # type: ignore[arg-type]
    if wants_json():
        emit_json({"file": file, "what": what, "output": output})
    else:
        say(f"{output}: {what or 'figure'} of {file}")
