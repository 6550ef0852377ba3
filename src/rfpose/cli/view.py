"""``rfpose view``: look at a recording, a result, a scenario; or draw them without a screen."""

from __future__ import annotations

from pathlib import Path

import click

from rfpose.cli._support import (
    check_ending,
    check_readable,
    check_scenario,
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
from rfpose.errors import InvalidInputError, RecordingError

__all__ = ["command"]

VIEW_NAMES = ("recording", "field", "layout", "tracking", "live")
THEMES = ("light", "dark")
_WINDOW = (1280, 800)


@click.command(
    name="view",
    epilog=examples(
        "rfpose view",
        "rfpose view recording.h5",
        "rfpose view site.toml --save layout.png",
        "rfpose view result.h5 --view field --heliostat H05 --save field.pdf",
        "rfpose view result.h5 --follow",
        "rfpose view result.h5 --save report.html",
        "rfpose view result.h5 --save report.html --frame 0 --frame 4 --heliostat H05 --heliostat H11",
    ),
)
@click.argument("file", type=click.Path(path_type=Path), required=False)
@click.option("--scenario", type=click.Path(path_type=Path), help="Site of a recording that brings none.")
@click.option("--save", type=click.Path(path_type=Path), help="Figure (.png, .svg, .pdf) or report (.html); no window.")
@click.option(
    "--view", type=click.Choice(VIEW_NAMES), help="Whose figure to draw; default: that which would open first."
)
@click.option(
    "--heliostat", "heliostats", multiple=True, help="Choose this mirror; repeated, a page of a report for each."
)
@click.option("--frame", "frames", type=click.IntRange(min=0), multiple=True,
              help="Show this frame, from 0; repeated, a map for each in a report.")  # fmt: skip
@click.option("--size", type=(click.IntRange(min=400), click.IntRange(min=300)), metavar="WIDTH HEIGHT",
              help="Of the window [pixel]; figures have the width of a page.")  # fmt: skip
@click.option("--follow", is_flag=True, help="FILE is a result that `rfpose process --follow` makes: show frames as "
              "they come.")  # fmt: skip
@click.option("--theme", type=click.Choice(THEMES), help="Default: light for pictures, the last one for the window.")
@follow_links_option
@force_option
@common_options
def command(
    file: Path | None,
    scenario: Path | None,
    save: Path | None,
    view: str | None,
    heliostats: tuple[str, ...],
    frames: tuple[int, ...],
    size: tuple[int, int] | None,
    follow: bool,
    theme: str | None,
    follow_links: bool,
    force: bool,
) -> None:
    """Open the viewer; or with --save draw a figure as `rfpose plot` does, or write a report, without a screen."""
    if save is None:
        from rfpose.viewer.app import run

        if heliostats or frames or view:
            raise click.UsageError("--view, --heliostat and --frame go with --save; in the window they are clicked")
        if follow and (file is None or scenario is not None):
            raise click.UsageError("--follow needs the FILE of a result, which brings its scenario")
        code = run(
            file, scenario_path=scenario, theme=theme, size=size or _WINDOW, follow_links=follow_links, follow=follow
        )
        if wants_json():
            emit_json({"file": file, "saved": None, "view": None})
        if code:
            click.get_current_context().exit(code)
        return
    if follow:
        raise click.UsageError("--follow is of the window; a figure is drawn once")
    if file is None:
        raise click.UsageError("--save needs a FILE to draw")
    if size is not None:
        raise click.UsageError("--size is of the window; figures have the width of a page")
    check_ending(save, ".png", ".svg", ".pdf", ".html")
    if save.suffix == ".html":
        if view is not None or theme is not None:
            raise click.UsageError("a report holds all views and has the reader's theme; leave --view and --theme out")
    elif max(len(heliostats), len(frames)) > 1:
        raise click.UsageError("a figure shows one --heliostat and one --frame; a report (.html) takes several")
    with outputs(save, inputs=[file, scenario], force=force), progress("Drawing") as on_progress:
        check_readable(file, follow_links=follow_links)
        if scenario is not None:
            check_there(scenario)
            check_scenario(scenario)
        if save.suffix == ".html":
            from rfpose.files import write_atomically
            from rfpose.pipeline.report import ReportChoice, report_html

            chosen = ReportChoice(frames=frames, heliostats=heliostats)
            page = report_html(file, chosen, scenario=scenario, follow_links=follow_links, on_progress=on_progress)
            write_atomically(save, page.encode())
            shown = "report"
        else:
            from rfpose.drawing import look, save_figure
            from rfpose.pipeline.pictures.catalogue import FigureChoice, draw, opened_file

            source = _recording_of(file) if view == "recording" else file
            chosen_one = FigureChoice(frame=next(iter(frames), None), heliostat=next(iter(heliostats), None))
            with opened_file(source, scenario=scenario, follow_links=follow_links) as opened:
                shown, what = _figure(opened.kind, view)
                with look("dark" if theme == "dark" else "light"):
                    save_figure(draw(opened, what, chosen_one), save)
    if wants_json():
        emit_json({"file": file, "saved": save, "view": shown})
    else:
        say(f"{save}: {shown} of {file}")


_FIGURES = {
    "result": {"field": "map", "layout": "layout", "recording": "spectrum"},
    "track": {"tracking": "instant", "layout": "layout"},
    "recording": {"recording": "spectrum", "layout": "layout"},
    "scenario": {"layout": "layout"},
}
"""By kind of file and view, the figure of `rfpose plot`; the first is drawn by default."""


def _figure(kind: str, view: str | None) -> tuple[str, str]:
    """Return view and figure; the first of the kind by default."""
    known = _FIGURES[kind]
    name = view or next(iter(known))
    if name not in known:
        raise InvalidInputError(f"view `{name}` has no figure of a {kind}; choose one of {', '.join(known)}")
    return name, known[name]


def _recording_of(file: Path) -> Path:
    """Return the recording that a result was made of, if it lies beside it; what is no result as it is."""
    from rfpose.kinds import kind_of

    if kind_of(file) != "result":
        return file
    from rfpose.pipeline.formats.result_file import open_result

    name = open_result(file).settings.get("recording", "")
    beside = file.parent / name
    if not name or not beside.exists():
        raise RecordingError(f"{file}: its recording `{name}` is not beside it; put it into {file.parent}")
    return beside
