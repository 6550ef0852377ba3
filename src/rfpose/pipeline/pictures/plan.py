"""A site from above: mirrors in the colour of a quantity, what transmits, and names that can be read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rfpose.checks import FloatArray
from rfpose.drawing import COLOUR_MAP, PINK, VERMILION, foreground, mark_places, place_names
from rfpose.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection

__all__ = ["MANY", "draw_mirrors", "draw_site", "finish_plan"]

MANY = 60
"""Of more mirrors only those asked for by name are named."""
_RASTER = 1500
"""More marks than these are kept as pixels, also in SVG and PDF."""


def draw_mirrors(
    axes: Axes, places: FloatArray, values: FloatArray, *, limits: tuple[float, float] | None = None
) -> PathCollection:
    """Draw mirrors (mirror, xyz) in the colours of values (mirror,); a cross where there is none."""
    known = np.isfinite(values)
    size = float(np.clip(3000.0 / max(len(values), 1), 5.0, 55.0))
    low, high = limits or (0.0, float(values[known].max()) if known.any() else 1.0)
    raster = len(values) > _RASTER
    x, y = places[:, 0], places[:, 1]
    dots = axes.scatter(
        x[known], y[known], c=values[known], cmap=COLOUR_MAP, vmin=low, vmax=high if high > low else low + 1.0,
        s=size, edgecolors=foreground(), linewidths=0.6 if len(values) < 200 else 0.0, zorder=4, rasterized=raster,
    )  # fmt: skip
    if not known.all():
        axes.scatter(
            x[~known], y[~known], s=size, marker="x", color=foreground(), lw=1.2, zorder=4, label="not solved",
            rasterized=raster,
        )  # fmt: skip
    return dots


def draw_site(axes: Axes, scenario: Scenario) -> None:
    """Draw transmitters and calibration receivers."""
    mark_places(axes, scenario.transmitter_enu_m, marker="^", label="transmitter")
    if scenario.calibration_receiver:
        mark_places(axes, scenario.calibration_enu_m, marker="s", label="calibration receiver", colour=PINK)
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    axes.margins(0.10)


def finish_plan(
    axes: Axes, scenario: Scenario, mirrors: FloatArray, texts: Sequence[str] = (), *, chosen: int | None = None
) -> None:
    """Write the names when all else stands: transmitters', calibration receivers', and ``texts`` of the mirrors.

    Of many mirrors only the chosen one's.
    """
    ink = foreground()
    calibration = scenario.calibration_enu_m.reshape(-1, 3)
    marks = np.concatenate([mirrors[:, :2], scenario.transmitter_enu_m[:, :2], calibration[:, :2]])
    marks = marks[np.isfinite(marks).all(axis=1)]
    kept = range(len(texts)) if len(texts) <= MANY else [] if chosen is None else [chosen]
    names = [*scenario.transmitter_ids, *(r.id for r in scenario.calibration_receiver), *(texts[i] for i in kept)]
    places = np.concatenate([scenario.transmitter_enu_m[:, :2], calibration[:, :2], mirrors[list(kept), :2]])
    colours = [VERMILION] * len(scenario.transmitter_ids) + [PINK] * len(calibration) + [ink] * len(list(kept))
    place_names(axes, places, names, keep_off=marks, colours=colours, n_always=len(names) - len(list(kept)))
