"""Pictures of a tracking run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rfpose.pipeline.pictures import _save
from rfpose.pipeline.track_file import Track

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

__all__ = ["draw_track"]

_COLOURS = {
    "open-loop": "#000000",
    "encoder": "#999999",
    "bias": "#E69F00",
    "berenguel": "#CC79A7",
    "camera-model": "#D55E00",
    "drone-model": "#8C510A",
    "sun-sensor": "#F0E442",
    "radio": "#0072B2",
    "radio-model": "#56B4E9",
    "radio-both": "#009E73",
}


def draw_track(track: Track, path: str | Path) -> None:
    """Draw a run: error over the field in the course of the first day, spread over mirrors, by day.

    Raises
    ------
    InvalidInputError
        ``path`` ends neither in .png nor in .svg.
    RecordingError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    several = len(track.dates) > 1
    figure = Figure(figsize=(10.0, 10.0 if several else 7.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(3 if several else 2, 1)
    colours = {name: _COLOURS.get(name, "#444444") for name in track.methods}
    _course(grid[0], track, colours)
    _mirrors(grid[1], track, colours)
    if several:
        _by_day(grid[2], track, colours)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
    figure.suptitle(f"{track.scenario.name}: {len(track.heliostat_ids)} mirrors")
    _save(figure, path)


def _course(axes: Axes, track: Track, colours: dict[str, str]) -> None:
    first = track.day == 0
    longitude = track.scenario.site.longitude_deg or 0.0
    hour = np.mod(track.unix_s[first] / 3600.0 + longitude / 15.0, 24.0)
    for name, method in track.methods.items():
        axes.semilogy(hour, 1e3 * method.series["rms_rad"][first], color=colours[name], lw=1.0, label=name)
    axes.set_xlabel(f"local mean solar time on {track.dates[0]} [h]")
    axes.set_ylabel("normal error, rms\nover the field [mrad]")
    _plain_numbers(axes.yaxis)


def _mirrors(axes: Axes, track: Track, colours: dict[str, str]) -> None:
    for name, method in track.methods.items():
        rms = np.sort(1e3 * method.scores["heliostat_rms_rad"])
        rms = rms[np.isfinite(rms)]
        axes.semilogx(rms, (np.arange(len(rms)) + 0.5) / max(len(rms), 1), color=colours[name], lw=1.3)
    axes.set_xlabel("normal error of a mirror, rms over all days [mrad]")
    axes.set_ylabel("part of the mirrors\nthat are better")
    _plain_numbers(axes.xaxis)


def _by_day(axes: Axes, track: Track, colours: dict[str, str]) -> None:
    for name, method in track.methods.items():
        axes.semilogy(1e3 * method.scores["day_rms_rad"], "o-", color=colours[name], ms=3, lw=1.0)
    axes.set_xticks(range(len(track.dates)), track.dates, rotation=45, ha="right", fontsize=7)
    axes.set_ylabel("normal error, rms\nof a day [mrad]")
    _plain_numbers(axes.yaxis)


def _plain_numbers(axis: Axis) -> None:
    """Write a logarithmic axis's numbers out, at one, two and five."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
    axis.axes.grid(alpha=0.3, which="both")
