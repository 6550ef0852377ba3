"""Pictures of a tracking run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rfpose.checks import FloatArray
from rfpose.drawing import (
    BLUE,
    GREY,
    METHOD_COLOURS,
    MODE_COLOURS,
    SERIES,
    VERMILION,
    WIDTH_INCH,
    angle_unit,
    blank_figure,
    foreground,
    place_names,
    plain_numbers,
)
from rfpose.errors import InvalidInputError
from rfpose.pipeline.formats.track_file import Track
from rfpose.pipeline.pictures.plan import MANY, draw_mirrors
from rfpose.pipeline.pictures.track_view import (
    MODES,
    TrackPicture,
    clock,
    groups,
    local_hour,
    mode_text,
    telling_instant,
    what_happened,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_instant", "draw_methods", "draw_mirror_course", "draw_track", "method_colours"]

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
    heights = {"course": 2.6, "flux": 1.3, "modes": 1.3, "mirrors": 2.2, "days": 2.0}
    figure = blank_figure(WIDTH_INCH, 1.5 + sum(heights[name] for name in panels))
    axes = dict(zip(panels, figure.subplots(len(panels), 1, height_ratios=[heights[n] for n in panels]), strict=True))
    colours = method_colours(track)
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


def method_colours(track: Track) -> dict[str, str]:
    """Return each method's colour."""
    return {name: METHOD_COLOURS.get(name, SERIES[k % len(SERIES)]) for k, name in enumerate(track.methods)}


def _course(axes: Axes, track: Track, colours: dict[str, str]) -> None:
    first = track.day == 0
    hour = local_hour(track)[first]
    for name, method in track.methods.items():
        axes.semilogy(hour, 1e3 * method.series["rms_rad"][first], color=colours[name], lw=1.0)
    axes.set_ylabel("normal error, rms over\nmirrors on target [mrad]")
    plain_numbers(axes.yaxis)


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
        colors=[MODE_COLOURS[MODES[k]] for k in modes],
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
            axes.axvline(each.hour, color=VERMILION if each.trouble else GREY, lw=0.7, ls=":")
    left, right = top.get_xlim()
    room = _LABEL_ROOM * (right - left)
    together = groups([each.hour for each in marks], 0.25 * room)[:_MOST_LABELS]
    places = _apart([marks[group[0]].hour for group in together], room)
    for group, place in zip(together, places, strict=True):
        words = ", ".join(dict.fromkeys(marks[i].mark for i in group))
        top.annotate(
            words, (marks[group[0]].hour, 1.0), (place, 1.07), xycoords=top.get_xaxis_transform(), fontsize=7,
            textcoords=top.get_xaxis_transform(), rotation=40, rotation_mode="anchor", va="bottom",
            arrowprops={"arrowstyle": "-", "lw": 0.5, "color": GREY, "shrinkA": 0.0, "shrinkB": 0.0},
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
    plain_numbers(axes.xaxis)


def _by_day(axes: Axes, track: Track, colours: dict[str, str]) -> None:
    for name, method in track.methods.items():
        axes.semilogy(1e3 * method.scores["day_rms_rad"], "o-", color=colours[name], ms=3, lw=1.0)
    axes.set_xticks(range(len(track.dates)), track.dates, rotation=45, ha="right", fontsize=7)
    axes.set_ylabel("normal error, rms\nof a day [mrad]")
    plain_numbers(axes.yaxis)


def draw_methods(track: Track) -> Figure:
    """Draw how the methods compare: error of the normal beside what its budget foresaw, and light caught."""
    names = track.ranking()
    colours, row = method_colours(track), np.arange(len(names))
    figure = blank_figure(WIDTH_INCH, 1.4 + 0.26 * len(names))
    error, light = figure.subplots(1, 2, width_ratios=[1.7, 1.0], sharey=True)
    found = [track.methods[name].summary for name in names]
    shade = [colours[name] for name in names]
    for key, marker, label in (("rms", "o", "rms"), ("p95", "|", "95 %"), ("worst", ">", "worst")):
        mrad = np.array([_known(each["normal_mrad"][key]) for each in found])
        error.scatter(mrad, row, marker=marker, s=46, color=shade, linewidths=1.8, zorder=3)
        error.plot([], [], marker, color=foreground(), label=label)
    foreseen = np.array([_known(each.get("budget", {}).get("total_mrad")) for each in found])
    if np.isfinite(foreseen).any():
        error.scatter(foreseen, row, marker="D", s=60, facecolors="none", edgecolors=foreground(), zorder=2)
        error.plot([], [], "D", color=foreground(), mfc="none", label="rms foreseen by the error budget")
    error.set_xscale("log")
    error.set_yticks(row, names)
    error.set_ylim(len(names) - 0.4, -0.6)
    error.set_xlabel("error of the normal, mirrors on the receiver [mrad]")
    plain_numbers(error.xaxis)
    caught = np.array([100.0 * _known(each["intercept"]) for each in found])
    light.barh(row, caught, color=shade, height=0.65)
    light.set_xlim(0.0, 100.0)
    light.set_xlabel("light caught [% of a perfect\ntracker's, on the receiver]")
    light.grid(axis="x", alpha=0.3)
    figure.legend(*error.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.suptitle(f"{track.scenario.name}: how the methods compare", fontsize=10)
    return figure


def _known(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def draw_instant(
    picture: TrackPicture, *, method: str | None = None, instant: int | None = None, chosen: int | None = None
) -> Figure:
    """Draw a method's mirrors and beams at an instant, and where the beams meet the target.

    By default of the method that catches most light, at a telling instant; the title says which and why.

    Raises
    ------
    InvalidInputError
        No such method or instant.
    """
    track = picture.track
    name = method or track.ranking()[0]
    if name not in track.methods:
        raise InvalidInputError(f"`method` must be one of {', '.join(track.methods)}, got {name!r}")
    if not picture.n_instant:
        raise InvalidInputError("the run keeps no instant: there is nothing to draw")
    if instant is not None and not 0 <= instant < picture.n_instant:
        raise InvalidInputError(f"`frame` must lie between 0 and {picture.n_instant - 1}, got {instant}")
    k, why = telling_instant(picture, name) if instant is None else (instant, "")
    now = picture.at(name, k)
    has_spots = bool(np.isfinite(now.spot_m).any())
    figure = blank_figure(WIDTH_INCH, 5.0 if has_spots else 6.0)
    panels = np.atleast_1d(
        np.asarray(figure.subplots(1, 2 if has_spots else 1, width_ratios=[2.2, 1.0][: 1 + has_spots]))
    )
    plan = panels[0]
    pivot = picture.pivot_enu_m
    lines = np.stack([pivot[:, :2], now.beam_end_enu_m[:, :2], np.full((len(pivot), 2), np.nan)], axis=1)
    if np.isfinite(now.beam_end_enu_m).any():
        plan.plot(*lines.reshape(-1, 2).T, color="#E69F00", lw=0.7, alpha=0.8, zorder=1, label="beam")
    factor, unit = angle_unit(np.array([picture.limit_mrad[name]]))
    on = now.on_receiver
    if on.any():
        limit = factor * picture.limit_mrad[name]
        dots = draw_mirrors(plan, pivot[on], factor * now.error_mrad[on], limits=(0.0, limit))
        figure.colorbar(dots, ax=plan, label=f"error of the normal [{unit}]", shrink=0.8, location="left")
    for mode in np.unique(now.mode[~on]):
        mine = ~on & (now.mode == mode)
        mark = MODE_COLOURS[MODES[mode]] if mode >= 0 else GREY
        label = f"{mode_text(int(mode))} ({int(mine.sum())})"
        plan.scatter(
            *pivot[mine, :2].T, marker="s", s=34, color=mark, edgecolors=foreground(), lw=0.6, label=label, zorder=4
        )
    aim = np.unique(picture.target_enu_m[np.isfinite(picture.target_enu_m).all(axis=1)], axis=0)
    if len(aim):
        plan.scatter(*aim[:, :2].T, marker="*", s=110, color=VERMILION, zorder=5, label="aim point")
    plan.set_xlabel("east [m]")
    plan.set_ylabel("north [m]")
    plan.set_aspect("equal")
    plan.grid(alpha=0.3)
    plan.margins(0.16)
    if has_spots:
        _spots(panels[1], picture, name, k)
    local = clock(float(local_hour(track)[k]))
    when = f"{picture.time[k].replace('T', ' ')} UTC, {local} solar time{f': {why}' if why else ''}"
    figure.suptitle(f"{track.scenario.name}, {name}\n{when}", fontsize=10)
    figure.legend(*plan.get_legend_handles_labels(), loc="outside lower center", ncols=5)
    kept = range(len(pivot)) if len(pivot) <= MANY else [] if chosen is None else [chosen]
    marks = np.concatenate([pivot[:, :2], aim[:, :2]])
    names = [picture.ids[i] for i in kept]
    place_names(plan, pivot[list(kept), :2], names, keep_off=marks, colours=foreground())
    return figure


def _spots(axes: Axes, picture: TrackPicture, name: str, k: int) -> None:
    now = picture.at(name, k)
    axes.axhline(0.0, color=GREY, lw=0.6)
    axes.axvline(0.0, color=GREY, lw=0.6)
    axes.plot(*now.spot_m.T, "o", color=BLUE, ms=4)
    reach = picture.spot_limit_m[name]
    if np.isfinite(reach) and reach > 0.0:
        axes.set_xlim(-1.05 * reach, 1.05 * reach)
        axes.set_ylim(-1.05 * reach, 1.05 * reach)
    axes.set_aspect("equal")
    axes.set_xlabel("right of the aim point [m]")
    axes.set_ylabel("above [m]")
    axes.set_title("where beams pass the target", fontsize=9)
    axes.grid(alpha=0.3)


def draw_mirror_course(picture: TrackPicture, row: int) -> Figure:
    """Draw a stored mirror's error over the first day by every method, and its mode by the method that catches most."""
    track = picture.track
    first = track.day == 0
    hour, colours = local_hour(track)[first], method_colours(track)
    best = track.ranking()[0]
    modes = np.asarray(track.methods[best].series["mode"][:, row])[first]
    has_modes = bool((modes >= 0).any())
    figure = blank_figure(WIDTH_INCH, 3.6 if has_modes else 3.1)
    panels = np.atleast_1d(
        np.asarray(figure.subplots(2 if has_modes else 1, 1, height_ratios=[6.0, 1.0][: 1 + has_modes], sharex=True))
    )
    for name, method in track.methods.items():
        error = 1e3 * np.abs(np.asarray(method.series["error_rad"][:, row], np.float64))[first]
        if np.isfinite(error).any():
            panels[0].semilogy(hour, error, color=colours[name], lw=1.0, label=name)
    panels[0].set_ylabel("error of the normal,\non the receiver [mrad]")
    plain_numbers(panels[0].yaxis)
    if has_modes:
        _mode_strip(panels[1], hour, modes, best)
    panels[-1].set_xlabel(f"local mean solar time on {track.dates[0]} [h]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    figure.suptitle(f"Heliostat {picture.ids[row]}", fontsize=10)
    return figure


def _mode_strip(axes: Axes, hour: FloatArray, modes: np.ndarray, name: str) -> None:
    ends = np.append(hour, 2.0 * hour[-1] - hour[-2] if len(hour) > 1 else hour[-1] + 1e-3)
    for mode in np.unique(modes[modes >= 0]):
        mine = modes == mode
        spans = [(ends[i], ends[i + 1] - ends[i]) for i in np.flatnonzero(mine)]
        axes.broken_barh(spans, (0.0, 1.0), color=MODE_COLOURS[MODES[mode]], lw=0.0, label=mode_text(int(mode)))
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks([])
    axes.set_ylabel(f"mode,\n{name}", fontsize=7, rotation=0, ha="right", va="center")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, fontsize=7, frameon=False, handlelength=1.2)
