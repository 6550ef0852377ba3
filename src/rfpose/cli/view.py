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

__all__ = ["command"]

VIEW_NAMES = ("recording", "field", "layout", "tracking", "live")
THEMES = ("light", "dark")


@click.command(
    name="view",
    epilog=examples(
        "rfpose view",
        "rfpose view recording.h5",
        "rfpose view site.toml --save layout.png",
        "rfpose view result.h5 --view field --heliostat H05 --save field.svg",
        "rfpose view result.h5 --save report.html",
    ),
)
@click.argument("file", type=click.Path(path_type=Path), required=False)
@click.option("--scenario", type=click.Path(path_type=Path), help="Site of a recording that brings none.")
@click.option("--save", type=click.Path(path_type=Path), help="Draw to .png or .svg, or report to .html; no window.")
@click.option("--view", type=click.Choice(VIEW_NAMES), help="Which view to draw; default: that which would open first.")
@click.option("--heliostat", help="Choose this heliostat in the picture.")
@click.option("--transmitter", help="Choose this transmitter in the picture.")
@click.option("--frame", type=click.IntRange(min=0), default=0, show_default=True, help="Frame shown in the picture.")
@click.option("--size", type=(click.IntRange(min=400), click.IntRange(min=300)), default=(1280, 800),
              show_default=True, metavar="WIDTH HEIGHT", help="Size of the window or picture [pixel].")  # fmt: skip
@click.option("--theme", type=click.Choice(THEMES), help="Default: light for pictures, the last one for the window.")
@follow_links_option
@force_option
@common_options
def command(
    file: Path | None,
    scenario: Path | None,
    save: Path | None,
    view: str | None,
    heliostat: str | None,
    transmitter: str | None,
    frame: int,
    size: tuple[int, int],
    theme: str | None,
    follow_links: bool,
    force: bool,
) -> None:
    """Open the viewer, or with --save draw one of its views without a screen."""
    if save is None:
        from rfpose.viewer.app import run

        code = run(file, scenario_path=scenario, theme=theme, size=size, follow_links=follow_links)
        if wants_json():
            emit_json({"file": file, "saved": None, "view": None})
        if code:
            click.get_current_context().exit(code)
        return
    if file is None:
        raise click.UsageError("--save needs a FILE to draw")
    check_ending(save, ".png", ".svg", ".html")
    with outputs(save, inputs=[file, scenario], force=force), progress("Drawing"):
        check_readable(file, follow_links=follow_links)
        if scenario is not None:
            check_there(scenario)
            check_scenario(scenario)
        from rfpose.viewer.app import check_installed
        from rfpose.viewer.export import export

        check_installed()
        shown = export(
            file,
            save,
            view=view,
            scenario_path=scenario,
            follow_links=follow_links,
            theme=theme or THEMES[0],
            size=size,
            heliostat=heliostat,
            transmitter=transmitter,
            frame=frame,
        )
    if wants_json():
        emit_json({"file": file, "saved": save, "view": shown})
    else:
        say(f"{save}: {shown} of {file}")
