"""Figures of a result: the field, errors, links, one mirror. matplotlib is loaded when one is drawn."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.drawing import (
    BLUE,
    GREEN,
    GREY,
    PINK,
    SERIES,
    VERMILION,
    WIDTH_INCH,
    angle_unit,
    blank_figure,
    foreground,
    new_figure,
    plain_numbers,
)
from rfpose.dsp import LineStatus
from rfpose.errors import InvalidInputError
from rfpose.multilat import PoseStatus
from rfpose.pipeline.evaluate import Evaluation
from rfpose.pipeline.formats.result import Result, frame_time
from rfpose.pipeline.formats.result_summary import left_out_of
from rfpose.pipeline.pictures.field_view import History, history, seen_transmitters
from rfpose.pipeline.pictures.plan import MANY, draw_mirrors, draw_site, finish_plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "COLOURS",
    "Colour",
    "draw_errors",
    "draw_evaluation",
    "draw_field_map",
    "draw_links",
    "draw_mirror",
    "frame_title",
]

Colour = Literal["error", "sigma", "protection", "transmitters"]
COLOURS = {
    "error": "error of the mirror normal",
    "sigma": "sigma of the mirror normal",
    "protection": "protection level of the mirror normal",
    "transmitters": "transmitters seen by a mirror's worst receiver",
}


def draw_field_map(
    result: Result,
    *,
    evaluation: Evaluation | None = None,
    frame: int | None = None,
    colour: Colour | None = None,
    heliostat: int | None = None,
) -> Figure:
    """Draw the field from above: transmitters, heliostats, their normals, and how far off these are.

    A mirror's colour is one of `COLOURS`: with ``evaluation`` its error, else the sigma that the result reports; RMS
    over the frames, or of one ``frame``. Arrows are the normals' horizontal parts in that frame, else in the first in
    which the mirror was solved. A ``heliostat`` is ringed, and named among many.
    """
    key = colour or ("sigma" if evaluation is None else "error")
    values, label = _quantity(result, evaluation, key, frame)
    figure, axes = new_figure(WIDTH_INCH, 6.4)
    scenario, places = result.scenario, result.scenario.pivot_enu_m
    length_m = 0.16 * float(np.ptp(scenario.transmitter_enu_m[:, :2], axis=0).max())
    rows = _first_solved(result) if frame is None else np.full(len(places), frame)
    column = np.arange(len(places))
    if result.truth is not None and len(result.truth.normal_enu) == len(result.frame_start_index):
        true_tip = places + length_m * result.truth.normal_enu[rows, column]
        axes.plot(*_segments(places, true_tip), color=GREY, alpha=0.6, lw=4, solid_capstyle="butt", label="true normal")
    tips = _arrows(axes, places, length_m * result.poses.normal_enu[rows, column])
    limits = (0.0, float(len(scenario.transmitter_ids))) if key == "transmitters" else None
    dots = draw_mirrors(axes, places, values, limits=limits)
    figure.colorbar(dots, ax=axes, label=label, shrink=0.85)
    draw_site(axes, scenario)
    if heliostat is not None:
        axes.scatter(
            places[heliostat, 0], places[heliostat, 1], s=180, facecolors="none", edgecolors=VERMILION, lw=2.0, zorder=5
        )
    axes.set_title(f"{scenario.name}: mirror normals measured by radio\n{frame_title(result, frame)}")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5)
    texts = [f"{n} {v:.2g}" if np.isfinite(v) else n for n, v in zip(scenario.heliostat_ids, values, strict=True)]
    finish_plan(axes, scenario, np.concatenate([places, tips]), texts, chosen=heliostat)
    return figure


def frame_title(result: Result, frame: int | None) -> str:
    """Return which frames a figure shows, in words.

    Raises
    ------
    InvalidInputError
        There is no such frame.
    """
    n = len(result.frame_start_index)
    if frame is None:
        return f"all {n} frames" if n > 1 else "one frame"
    if not 0 <= frame < n:
        raise InvalidInputError(f"`frame` must lie between 0 and {n - 1}, got {frame}")
    time = frame_time(int(result.frame_start_index[frame]), result.sample_rate)
    return f"frame {frame + 1} of {n}, {time:%Y-%m-%d %H:%M:%S} UTC"


def _quantity(result: Result, evaluation: Evaluation | None, key: str, frame: int | None) -> tuple[FloatArray, str]:
    """Return a mirror's value (heliostat,), and what it is with its unit."""
    frame_title(result, frame)
    if key == "transmitters":
        seen = seen_transmitters(result)
        return (seen.min(axis=0) if frame is None else seen[frame]).astype(np.float64), COLOURS[key]
    if key == "error":
        if evaluation is None:
            raise InvalidInputError("`colour` error needs a truth; choose sigma or protection")
        mrad = 1e3 * evaluation.normal_error_rad
    elif key == "sigma":
        mrad = np.where(result.poses.status == PoseStatus.OK, 1e3 * result.poses.sigma_rad, np.nan)
    elif result.integrity is None:
        raise InvalidInputError("`colour` protection needs a result with integrity; choose sigma")
    else:
        mrad = 1e3 * result.integrity.protection_level_rad
    values = _rms(mrad) if frame is None else mrad[frame]
    values = np.where(np.isfinite(values), values, np.nan)
    factor, unit = angle_unit(values)
    over = ", RMS over frames" if frame is None and len(mrad) > 1 else ""
    return factor * values, f"{COLOURS[key]}{over} [{unit}]"


def _first_solved(result: Result) -> npt.NDArray[np.intp]:
    """Return (heliostat,) the first frame in which each was solved, else the first."""
    return np.asarray(np.argmax(result.poses.status == PoseStatus.OK, axis=0))


def _rms(values: FloatArray, axis: int = 0) -> FloatArray:
    """Root mean square of what is known; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    square = np.where(known, values, 0.0) ** 2
    return np.asarray(np.sqrt(np.where(count > 0, square.sum(axis=axis) / np.maximum(count, 1), np.nan)))


def _arrows(axes: Axes, places: FloatArray, offset_m: FloatArray) -> FloatArray:
    """Draw the horizontal parts of measured normals from their mirrors; return points along them (point, xyz)."""
    seen = np.isfinite(offset_m).all(axis=1)
    axes.quiver(
        *places[seen, :2].T, *offset_m[seen, :2].T,
        angles="xy", scale_units="xy", scale=1.0, width=0.003, headwidth=4, color=foreground(), zorder=3,
        label="measured normal",
    )  # fmt: skip
    return np.concatenate([places[seen] + part * offset_m[seen] for part in (0.35, 0.7, 1.0)])


def _segments(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return (2, 3·point) coordinates of separate lines, each from a start to an end, NaN between them."""
    return np.stack([start[:, :2], end[:, :2], np.full((len(start), 2), np.nan)], axis=1).reshape(-1, 2).T


# -- how good ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Curve:
    """One thing that is said of every mirror-frame [mrad of the normal] (frame, heliostat)."""

    label: str
    mrad: FloatArray
    colour: str
    marker: str


_STATED = "sigma that the result states"


def _compared(evaluation: Evaluation) -> list[_Curve]:
    error, bound = 1e3 * evaluation.normal_error_rad, 1e3 * evaluation.bound_rad
    return [
        _Curve(label="error against the truth", mrad=error, colour=BLUE, marker="o"),
        _Curve(label="bound of this estimator", mrad=bound, colour=PINK, marker="d"),
    ]


def _curves(result: Result, evaluation: Evaluation | None) -> list[_Curve]:
    sigma = np.where(result.poses.status == PoseStatus.OK, 1e3 * result.poses.sigma_rad, np.nan)
    found = [_Curve(label=_STATED, mrad=sigma, colour=VERMILION, marker="|")]
    if result.integrity is not None:
        level = 1e3 * result.integrity.protection_level_rad
        found.append(_Curve(label="protection level", mrad=level, colour=GREEN, marker=">"))
    if evaluation is not None:
        found = [*_compared(evaluation), *found]
    found = [each for each in found if (np.isfinite(each.mrad) & (each.mrad > 0.0)).any()]
    if not found:
        raise InvalidInputError("no mirror was solved: there is nothing to draw")
    return found


def draw_errors(result: Result, *, evaluation: Evaluation | None = None) -> Figure:
    """Draw how good the normals are: by mirror, RMS over frames, and over the frames, RMS over mirrors.

    With ``evaluation`` error and bound, else what the result says of itself. Of many mirrors their distribution.
    """
    curves = _curves(result, evaluation)
    ids, n_frame = result.scenario.heliostat_ids, len(result.frame_start_index)
    tall = _tall(len(ids))
    rows = [tall, 2.2] if n_frame > 1 else [tall]
    figure = blank_figure(WIDTH_INCH, sum(rows) + 0.9)
    panels = np.atleast_1d(np.asarray(figure.subplots(len(rows), 1, height_ratios=rows)))
    _by_mirror(panels[0], ids, curves, n_frame)
    if n_frame > 1:
        _over_frames(panels[1], result, curves)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.suptitle(f"{result.scenario.name}: how good the normals are", fontsize=10)
    return figure


def draw_evaluation(evaluation: Evaluation) -> Figure:
    """Draw error, bound and stated sigma by mirror, RMS over frames; of many mirrors their distribution."""
    ids = tuple(row.id for row in evaluation.heliostats)
    sigma = np.array([[row.sigma_mrad for row in evaluation.heliostats]])
    curves = [*_compared(evaluation), _Curve(label=_STATED, mrad=sigma, colour=VERMILION, marker="|")]
    curves = [each for each in curves if (np.isfinite(each.mrad) & (each.mrad > 0.0)).any()]
    if not curves:
        raise InvalidInputError("no mirror was solved: there is nothing to draw")
    figure, axes = new_figure(WIDTH_INCH, _tall(len(ids)) + 0.9)
    _by_mirror(axes, ids, curves, len(evaluation.normal_error_rad))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    axes.set_title(f"ratio of error to bound {evaluation.ratio_to_bound:.3f} ± {evaluation.ratio_sigma:.2g}")
    return figure


def _tall(n_mirror: int) -> float:
    return 2.8 if n_mirror > MANY else float(np.clip(0.8 + 0.17 * n_mirror, 1.8, 9.0))


def _by_mirror(axes: Axes, ids: tuple[str, ...], curves: list[_Curve], n_frame: int) -> None:
    factor, unit = angle_unit(np.concatenate([_rms(c.mrad) for c in curves]))
    for curve in curves:
        each = factor * _rms(curve.mrad)
        if len(ids) > MANY:
            some = np.sort(each[np.isfinite(each)])
            axes.plot(some, (np.arange(len(some)) + 0.5) / len(some), color=curve.colour, label=curve.label)
        else:
            row = np.arange(len(ids))
            axes.plot(each, row, curve.marker, color=curve.colour, ms=6, mew=1.6, label=curve.label)
    if len(ids) > MANY:
        axes.set_ylabel("part of the mirrors\nthat are better")
    else:
        axes.set_yticks(range(len(ids)), ids, fontsize=8)
        axes.set_ylim(len(ids) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.set_xlabel(f"angle of the normal{', RMS over frames' if n_frame > 1 else ''} [{unit}]")
    plain_numbers(axes.xaxis)
    axes.grid(alpha=0.3)


def _over_frames(axes: Axes, result: Result, curves: list[_Curve]) -> None:
    start = result.frame_start_index
    time_s = (start - start[0]) / float(result.sample_rate)
    factor, unit = angle_unit(np.concatenate([_rms(c.mrad, 1) for c in curves]))
    for curve in curves:
        mark = "." if len(start) < 100 else ""
        axes.semilogy(time_s, factor * _rms(curve.mrad, 1), mark + "-", color=curve.colour, lw=1.0)
    axes.set_xlabel("time from the first frame [s]")
    axes.set_ylabel(f"RMS over\nmirrors [{unit}]")
    plain_numbers(axes.yaxis)


def draw_links(result: Result) -> Figure:
    """Draw what became of each transmitter at the mirrors' receivers: used, left out by tests, not measured and why."""
    scenario = result.scenario
    is_mirror = np.array([row.heliostat is not None for row in scenario.receivers], bool)
    owner = np.array([row.heliostat for row in scenario.receivers if row.heliostat is not None], np.int64)
    status = result.tones.status[:, is_mirror]
    left_out = np.zeros(status.shape, np.bool_)
    if result.integrity is not None:
        left_out = left_out_of(result.integrity)[:, owner] & (status == 0)
    total = max(status.shape[0] * status.shape[1], 1)
    parts = [("used", ((status == 0) & ~left_out).sum(axis=(0, 1)), BLUE)]
    if left_out.any():
        parts.append(("left out: contradicts the rest", left_out.sum(axis=(0, 1)), VERMILION))
    counted = Counter(status[status != 0].tolist())
    colours = (GREY, *SERIES[4:])
    for (code, _), colour in zip(counted.most_common(), colours, strict=False):
        parts.append((LineStatus(int(code)).reason, (status == code).sum(axis=(0, 1)), colour))
    n = len(scenario.transmitter_ids)
    figure, axes = new_figure(WIDTH_INCH, float(np.clip(1.2 + 0.19 * n + 0.2 * len(parts), 2.2, 9.5)))
    base = np.zeros(n)
    for label, count, colour in parts:
        share = 100.0 * count / total
        axes.barh(np.arange(n), share, left=base, color=colour, height=0.72, label=label)
        base += share
    axes.set_yticks(range(n), scenario.transmitter_ids, fontsize=8)
    axes.set_ylim(n - 0.4, -0.6)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of receiver-frames [%]")
    axes.set_title(f"{scenario.name}: what became of each transmitter")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


# -- one mirror ----------------------------------------------------------------------------------------------


def draw_mirror(result: Result, heliostat: int, *, frame: int | None = None) -> Figure:
    """Draw one mirror: its normal over the frames and as it scatters, and residuals towards each transmitter."""
    found = history(result, heliostat)
    name = result.scenario.heliostat_ids[heliostat]
    if not np.isfinite(found.offset_mrad).any():
        raise InvalidInputError(f"heliostat {name} was solved in no frame: there is nothing to draw")
    solved = np.flatnonzero(np.isfinite(found.offset_mrad).all(axis=1))
    shown = int(solved[0]) if frame is None else frame
    frame_title(result, shown)
    factor, unit = angle_unit(found.offset_mrad)
    figure = blank_figure(WIDTH_INCH, 5.6)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.7, 1.0], height_ratios=[1.25, 1.0])
    _draw_offsets(figure.add_subplot(grid[0, 0]), found, factor, unit)
    _draw_scatter(figure.add_subplot(grid[0, 1]), found, shown, factor, unit)
    _draw_residuals(figure.add_subplot(grid[1, :]), result, found, shown)
    than = "the true one" if found.has_truth else "its mean"
    figure.suptitle(
        f"Heliostat {name}: normal less {than}; ringed and below: {frame_title(result, shown)}", fontsize=10
    )
    return figure


def _draw_offsets(axes: Axes, found: History, factor: float, unit: str) -> None:
    mark = "." if len(found.time_s) < 100 else ""
    for k, (colour, text) in enumerate(((BLUE, "across the mirror (x)"), (VERMILION, "up the mirror (y)"))):
        axes.plot(found.time_s, factor * found.offset_mrad[:, k], mark + "-", color=colour, lw=1.0, label=text)
    # sigma is of both axes together
    band = factor * found.sigma_mrad / np.sqrt(2.0)
    axes.fill_between(found.time_s, -band, band, color=GREY, alpha=0.25, lw=0, label="1 sigma of one axis")
    axes.set_xlabel("time from the first frame [s]")
    axes.set_ylabel(f"offset of the normal [{unit}]")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 1.18), ncols=3, frameon=False, fontsize=7, columnspacing=1.0)


def _draw_scatter(axes: Axes, found: History, shown: int, factor: float, unit: str) -> None:
    for k, outline in enumerate(found.ellipse_mrad):
        if np.isfinite(outline).all() and (k == shown or len(found.ellipse_mrad) <= 30):
            mine = k == shown
            colour, width = (VERMILION, 1.6) if mine else (GREY, 0.5)
            axes.plot(*(factor * outline).T, color=colour, lw=width, zorder=3 if mine else 1)
    axes.plot(*(factor * found.offset_mrad).T, "o", color=BLUE, ms=3.5, zorder=2)
    axes.axhline(0.0, color=GREY, lw=0.6)
    axes.axvline(0.0, color=GREY, lw=0.6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"across [{unit}]; ellipses hold 95 %")
    axes.set_ylabel(f"up [{unit}]")
    axes.grid(alpha=0.3)


def _draw_residuals(axes: Axes, result: Result, found: History, shown: int) -> None:
    names = result.scenario.transmitter_ids
    mm, sigma = found.residual_mm[shown], found.residual_sigma_mm[shown]
    known = np.isfinite(mm)
    place = np.arange(len(names))
    if known.any():
        axes.bar(place[known], mm[known], color=BLUE, width=0.6)
        zero, bars = np.zeros(int(known.sum())), sigma[known]
        axes.errorbar(place[known], zero, yerr=bars, fmt="none", ecolor=foreground(), capsize=3, lw=1.0)
    else:
        axes.annotate("ranges are not known without a calibration receiver", (0.5, 0.5), xycoords="axes fraction",
                      ha="center")  # fmt: skip
    for k in place[~known] if known.any() else ():
        axes.annotate("not\nused", (k, 0.0), ha="center", va="center", fontsize=7, color=VERMILION)
    axes.axhline(0.0, color=GREY, lw=0.6)
    axes.set_xticks(place, names, fontsize=8, rotation=90 if len(names) > 16 else 0)
    axes.set_xlim(-0.7, len(names) - 0.3)
    axes.set_ylabel("range residual, mean of\nthe receivers [mm]")
    axes.set_xlabel("transmitter; bars of one sigma of one range")
    axes.grid(axis="y", alpha=0.3)
