"""Pictures of a tracking run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rfpose.drawing import blank_figure
from rfpose.pipeline.formats.track_file import Track
from rfpose.pipeline.pictures.track_view import groups, local_hour, mode_text, what_happened

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

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
_MODE_COLOURS = (
    "#8A929B", "#C5CAD0", "#F0E442", "#9ECAE1", "#DCEBF5", "#E69F00", "#8C510A", "#CC79A7", "#D55E00", "#56B4E9",
    "#000000", "#6A3D9A",
)  # fmt: skip
"""By mode; tracking is pale, so that all else is seen."""
_FROM_BELOW = (4, 3, 5, 6, 7, 9, 2, 1, 0, 8, 10, 11)
"""Modes as they are stacked: those on the receiver first."""
_LABEL_ROOM = 0.018
"""Least distance of two labels, as a part of the time axis."""
_MOST_LABELS = 24


def draw_track(track: Track) -> Figure:
    """Draw a run: error, flux and modes in the course of the first day, spread over mirrors, by day.

    Modes are those of the method that catches most light; without field control they are left out.
    """
    several, best = len(track.dates) > 1, track.ranking()[0]
    panels = ["course", "flux", *(["modes"] if track.methods[best].happened else []), "mirrors"]
    panels += ["days"] if several else []
    heights = {"course": 3.2, "flux": 1.5, "modes": 1.5, "mirrors": 2.8, "days": 2.4}
    figure = blank_figure(10.0, 1.3 + sum(heights[name] for name in panels))
    axes = dict(zip(panels, figure.subplots(len(panels), 1, height_ratios=[heights[n] for n in panels]), strict=True))
    colours = {name: _COLOURS.get(name, "#444444") for name in track.methods}
    _course(axes["course"], track, colours)
    _flux(axes["flux"], track, colours)
    if "modes" in axes:
        _modes(axes["modes"], track, best)
    _share_time([axes[name] for name in ("course", "flux", "modes") if name in axes], track)
    _mark(axes["course"], [axes[name] for name in ("course", "flux", "modes") if name in axes], track, best)
    _mirrors(axes["mirrors"], track, colours)
    if several:
        _by_day(axes["days"], track, colours)
    handles, labels = axes["flux"].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
    figure.suptitle(f"{track.scenario.name}: {len(track.heliostat_ids)} mirrors")
    return figure


def _course(axes: Axes, track: Track, colours: dict[str, str]) -> None:
    first = track.day == 0
    hour = local_hour(track)[first]
    for name, method in track.methods.items():
        axes.semilogy(hour, 1e3 * method.series["rms_rad"][first], color=colours[name], lw=1.0)
    axes.set_ylabel("normal error, rms over\nmirrors on target [mrad]")
    _plain_numbers(axes.yaxis)


def _flux(axes: Axes, track: Track, colours: dict[str, str]) -> None:
    first = track.day == 0
    hour = local_hour(track)[first]
    for name, method in track.methods.items():
        axes.plot(hour, method.series["flux"][first], color=colours[name], lw=1.0, label=name)
    axes.set_ylim(0.0, max(1.05, axes.get_ylim()[1]))
    axes.set_ylabel("flux, of a\nperfect field's")
    axes.grid(alpha=0.3)


def _modes(axes: Axes, track: Track, name: str) -> None:
    """Stack the numbers of mirrors in those modes that the first day knows."""
    from matplotlib.ticker import MaxNLocator

    first = track.day == 0
    count = track.methods[name].series["mode_count"][first]
    modes = [k for k in _FROM_BELOW if count[:, k].any()]
    axes.stackplot(
        local_hour(track)[first], count[:, modes].T, step="post", labels=[mode_text(k) for k in modes], lw=0.0,
        colors=[_MODE_COLOURS[k] for k in modes],
    )  # fmt: skip
    axes.set_ylim(0, len(track.heliostat_ids))
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_ylabel(f"mirrors,\n{name}")
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(modes), fontsize=7, frameon=False, handlelength=1.2,
        columnspacing=1.2, borderaxespad=0.1,
    )  # fmt: skip


def _share_time(panels: list[Axes], track: Track) -> None:
    """Give panels one time axis, with numbers under the lowest."""
    for axes in panels[:-1]:
        axes.sharex(panels[-1])
        axes.tick_params(labelbottom=False)
    hour = local_hour(track)[track.day == 0]
    pad = 0.01 * float(np.ptp(hour)) + 1e-3
    panels[-1].set_xlim(hour.min() - pad, hour.max() + pad)
    panels[-1].set_xlabel(f"local mean solar time on {track.dates[0]} [h]")


def _mark(top: Axes, panels: list[Axes], track: Track, name: str) -> None:
    """Draw a thin line where something happened on the first day, and write above the top panel what."""
    marks = [each for each in what_happened(track, name) if each.day == 0 and each.mark and np.isfinite(each.hour)]
    for axes in panels:
        for each in marks:
            axes.axvline(each.hour, color="#B2182B" if each.trouble else "0.35", lw=0.7, ls=":")
    left, right = top.get_xlim()
    room = _LABEL_ROOM * (right - left)
    together = groups([each.hour for each in marks], 0.25 * room)[:_MOST_LABELS]
    places = _apart([marks[group[0]].hour for group in together], room)
    for group, place in zip(together, places, strict=True):
        words = ", ".join(dict.fromkeys(marks[i].mark for i in group))
        top.annotate(
            words, (marks[group[0]].hour, 1.0), (place, 1.07), xycoords=top.get_xaxis_transform(), fontsize=7,
            textcoords=top.get_xaxis_transform(), rotation=40, rotation_mode="anchor", va="bottom",
            arrowprops={"arrowstyle": "-", "lw": 0.5, "color": "0.35", "shrinkA": 0.0, "shrinkB": 0.0},
        )  # fmt: skip


def _apart(places: list[float], least: float) -> list[float]:
    """Push sorted places to the right until each is far enough from the one before."""
    found: list[float] = []
    for place in places:
        found.append(max(place, found[-1] + least) if found else place)
    return found


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
