"""A file's report: what was asked, then figures, then tables, in one HTML page that needs nothing else."""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rfpose import __version__
from rfpose.drawing import look, svg_of
from rfpose.errors import InvalidInputError, RfposeError
from rfpose.pipeline.pictures.catalogue import FigureChoice, OpenedFile, draw, opened_file
from rfpose.pipeline.report import page
from rfpose.pipeline.report.others import recording_parts, scenario_parts
from rfpose.pipeline.report.results import mirror_table, result_parts
from rfpose.pipeline.report.tracks import track_parts

__all__ = ["ReportChoice", "report_html"]

_PACKAGES = ("numpy", "scipy", "numba", "h5py", "matplotlib")


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportChoice:
    """What a report shows besides what all have: maps of these frames, and a page for each of these mirrors."""

    frames: tuple[int, ...] = ()
    heliostats: tuple[str, ...] = ()


def report_html(
    path: str | Path,
    choice: ReportChoice | None = None,
    *,
    truth: str | Path | None = None,
    scenario: str | Path | None = None,
    follow_links: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> str:
    """Return the report of a result, tracking run, recording or scenario as one HTML page.

    Light on paper, light or dark on a screen as its owner likes.

    Parameters
    ----------
    path, truth, scenario, follow_links
        As for `rfpose.pipeline.pictures.catalogue.opened_file`.
    choice
        Frames and mirrors to show besides.
    on_progress
        Called with (figures drawn, figures).

    Raises
    ------
    RfposeError
        The file cannot be read; a frame or mirror that it does not have.
    """
    choice = choice or ReportChoice()
    with opened_file(path, truth=truth, scenario=scenario, follow_links=follow_links) as file:
        unknown = [name for name in choice.heliostats if name not in file.heliostat_ids]
        if unknown:
            raise InvalidInputError(f"{path}: has no mirror `{unknown[0]}` whose course is known; choose another")
        asked, tables, settings = _parts(file)
        figures = _figures(file, choice)
        shown = []
        for k, (what, chosen, caption) in enumerate(figures):
            shown.append(_figure(file, what, chosen, caption, name=f"f{k}"))
            if on_progress is not None:
                on_progress(k + 1, len(figures))
        n_first = len(figures) - len(choice.heliostats)
        body = [asked, "<h2>Pictures</h2>", *shown[:n_first], *tables]
        for name, drawn in zip(choice.heliostats, shown[n_first:], strict=True):
            rest = mirror_table(file.result, name) if file.result is not None else ""
            body.append(f'<section class="page"><h2>Heliostat {page.text(name)}</h2>{drawn}{rest}</section>')
        body.append(_ends(file, settings))
        return page.html(f"rfpose: {file.path.name}", [_head(file), *body])


def _parts(file: OpenedFile) -> tuple[str, list[str], Mapping[str, str]]:
    """Return what was asked, tables, and settings."""
    if file.result is not None:
        return (*result_parts(file.result, file.evaluation), file.result.settings)
    if file.track is not None:
        return (*track_parts(file.track), file.track.track.settings)
    if file.recording is not None:
        return (*recording_parts(file.recording), {})
    assert file.scenario is not None
    return (*scenario_parts(file.scenario), {})


def _figures(file: OpenedFile, choice: ReportChoice) -> list[tuple[str, FigureChoice, str]]:
    """Return which figures are drawn: name, choice, caption; those of chosen mirrors last."""
    found: list[tuple[str, FigureChoice, str]]
    if file.result is not None:
        of = "error against the truth" if file.evaluation is not None else "sigma that the result states"
        found = [("map", FigureChoice(), f"The field from above; colours: {of}.")]
        found += [("map", FigureChoice(frame=k), f"The field in frame {k + 1}; colours: {of}.") for k in choice.frames]
        found.append(("errors", FigureChoice(), "How good the normals are, by mirror and over the frames."))
        found.append(("links", FigureChoice(), "What became of each transmitter at the mirrors' receivers."))
        if file.result.choice.pose != "site":
            text = (
                "Where errors come from, by the scenario's [budget], to first order: what this recording cannot show."
            )
            found.append(("budget", FigureChoice(), text))
    elif file.track is not None:
        found = [("methods", FigureChoice(), "How the methods compare, the one that catches most light first.")]
        found.append(
            ("course", FigureChoice(), "Errors, light and modes in the course of the first day; errors by mirror.")
        )
        instants = [FigureChoice(frame=k) for k in choice.frames] or [FigureChoice()]
        found += [("instant", each, "Mirrors and their beams at one instant.") for each in instants]
    elif file.recording is not None:
        frames = [FigureChoice(frame=k) for k in choice.frames] or [FigureChoice()]
        found = [("spectrum", each, "What the band holds in one frame.") for each in frames]
        found.append(("waterfall", FigureChoice(), "What the band holds over the frames."))
    else:
        found = [("layout", FigureChoice(), "What each mirror's normal can be known to, in the scenario's posture.")]
        found.append(("budget", FigureChoice(), "Where errors come from, to first order."))
    by_mirror = file.result is not None or file.track is not None
    if choice.heliostats and not by_mirror:
        raise InvalidInputError(f"{file.path}: pages of mirrors are of results and tracking runs; leave them out")
    return found + [("mirror", FigureChoice(heliostat=name), "") for name in choice.heliostats]


def _figure(file: OpenedFile, what: str, choice: FigureChoice, caption: str, *, name: str) -> str:
    """Return a figure in HTML; where it cannot be drawn, the reason."""
    try:
        with look("page"):
            drawn = svg_of(draw(file, what, choice), name)
    except RfposeError as error:
        if choice.frame is not None:  # the caller's own wish
            raise
        return f'<p class="m">{page.text(caption)} Not drawn: {page.text(error)}.</p>'
    return f"<figure>{drawn}<figcaption>{page.text(caption)}</figcaption></figure>"


def _head(file: OpenedFile) -> str:
    site = "" if file.scenario is None else f" of {file.scenario.name}"
    return f"<h1>{page.text(file.path.name)}</h1><p class='m'>{page.text(file.kind + site)}; rfpose {__version__}</p>"


def _ends(file: OpenedFile, settings: Mapping[str, str]) -> str:
    parts = ["<h2>Settings</h2>", page.facts(settings)] if settings else []
    parts += ["<h2>Versions</h2>", page.facts(_versions())]
    if file.scenario is not None:
        text = page.text(file.scenario.to_toml())
        parts.append(f"<details><summary>The scenario as TOML</summary><pre>{text}</pre></details>")
    return "".join(parts)


def _versions() -> dict[str, str]:
    found = {"rfpose": __version__, "Python": platform.python_version(), "system": platform.platform()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
