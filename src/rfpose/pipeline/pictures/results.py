"""Picture of a result. matplotlib is loaded when it is drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.drawing import mark_places, new_figure
from rfpose.multilat import PoseStatus
from rfpose.pipeline.evaluate import Evaluation
from rfpose.pipeline.formats.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_field_map"]

_COLOURS = "cividis"  # reads the same with and without colour vision deficiency, and in grey
_GREY = "0.6"


def draw_field_map(result: Result, *, evaluation: Evaluation | None = None) -> Figure:
    """Draw the field from above: transmitters, heliostats, their normals, and how far off these are.

    With ``evaluation`` a mirror's colour is its RMS error over the frames, else the sigma that the result reports.
    Arrows are the normals' horizontal parts in the first frame in which the mirror was solved.
    """
    figure, axes = new_figure(8.4, 7.2)
    scenario = result.scenario
    places = scenario.pivot_enu_m
    length_m = 0.18 * float(np.ptp(scenario.transmitter_enu_m[:, :2], axis=0).max())
    frame = _first_solved(result)
    column = np.arange(len(places))
    if evaluation is None:
        mrad = np.array([1e3 * _rms(result.poses.sigma_rad[:, i]) for i in column])
        label = "sigma of the mirror normal, RMS over frames [mrad]"
    else:
        mrad = np.array([row.normal_error_mrad.rms for row in evaluation.heliostats])
        label = "error of the mirror normal, RMS over frames [mrad]"
        if result.truth is not None and len(result.truth.normal_enu) == len(result.frame_start_index):
            true_tip = places + length_m * result.truth.normal_enu[frame, column]
            axes.plot(*_segments(places, true_tip), color=_GREY, lw=6, solid_capstyle="butt", label="true normal")
    measured = result.poses.normal_enu[frame, column]
    _arrows(axes, places, length_m * measured)
    solved = np.isfinite(mrad)
    dots = axes.scatter(
        places[solved, 0], places[solved, 1], c=mrad[solved], cmap=_COLOURS, vmin=0.0, s=90, edgecolors="k", zorder=4
    )
    figure.colorbar(dots, ax=axes, label=label, shrink=0.85)
    if not solved.all():
        x, y = places[~solved, :2].T
        axes.scatter(x, y, s=80, marker="x", color="k", zorder=4, label="heliostat, not solved")
    for name, place, value, offset in zip(scenario.heliostat_ids, places, mrad, _behind(measured), strict=True):
        text = f"{name}\n{value:.2g}" if np.isfinite(value) else name
        axes.annotate(text, place[:2], offset, textcoords="offset points", fontsize=7, ha="center", va="center")
    mark_places(axes, scenario.transmitter_enu_m, scenario.transmitter_ids, marker="^", label="transmitter")
    names = tuple(receiver.id for receiver in scenario.calibration_receiver)
    mark_places(axes, scenario.calibration_enu_m, names, marker="s", label="calibration receiver")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.margins(0.08)
    axes.set_title(f"{scenario.name}: mirror normals measured by radio")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def _first_solved(result: Result) -> npt.NDArray[np.intp]:
    """Return (heliostat,) the first frame in which each was solved, else the first."""
    return np.asarray(np.argmax(result.poses.status == PoseStatus.OK, axis=0))


def _rms(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def _arrows(axes: Axes, places: FloatArray, offset_m: FloatArray) -> None:
    """Draw the horizontal parts of measured normals from their mirrors."""
    seen = np.isfinite(offset_m).all(axis=1)
    axes.quiver(
        *places[seen, :2].T, *offset_m[seen, :2].T,
        angles="xy", scale_units="xy", scale=1.0, width=0.003, headwidth=4, color="k", zorder=3,
        label="measured normal",
    )  # fmt: skip


def _segments(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return (2, 3·point) coordinates of separate lines, each from a start to an end, NaN between them."""
    return np.stack([start[:, :2], end[:, :2], np.full((len(start), 2), np.nan)], axis=1).reshape(-1, 2).T


def _behind(normal_enu: FloatArray) -> FloatArray:
    """Return (point, 2) where to put a mirror's name so that its arrow does not cross it [points]."""
    flat = np.nan_to_num(normal_enu[:, :2])
    size = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.where(size > 1e-9, -18.0 * flat / np.maximum(size, 1e-9), [0.0, -18.0])
