"""Plans of a site: what stands where, seen from above, as a figure and in letters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rfpose.checks import FloatArray
from rfpose.drawing import VERMILION, mark_places, new_figure, place_names
from rfpose.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plan_in_letters", "site_plan"]

_NAMED = 40
"""Up to so many mirrors are named."""
_ARROW = 0.06
"""Length of an arrow along a normal, of the plan's width."""


def site_plan(scenario: Scenario) -> Figure:
    """Draw a scenario's site from above: mirrors with where they face, transmitters, receivers, structures, aim point.

    Parameters
    ----------
    scenario

    Returns
    -------
    matplotlib.figure.Figure
    """
    from matplotlib.patches import Polygon

    figure, axes = new_figure(8.4, 7.2)
    for k, box in enumerate(scenario.site.structures.box):
        half = 0.5 * np.array(box.size_m[:2]) * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        sine, cosine = np.sin(np.radians(box.azimuth_deg)), np.cos(np.radians(box.azimuth_deg))
        corners = np.array(box.base_enu_m[:2]) + half @ np.array([[cosine, -sine], [sine, cosine]])
        axes.add_patch(Polygon(corners, color="0.75", zorder=1, label="box" if k == 0 else None))
    pivot, normal = scenario.pivot_enu_m, scenario.posture_enu
    size = float(np.clip(4000.0 / max(len(pivot), 1), 6.0, 70.0))
    plates = np.array([p.pivot_enu_m for p in scenario.site.structures.plate]).reshape(-1, 3)
    if len(plates):
        axes.scatter(
            plates[:, 0], plates[:, 1], s=size, marker="s", facecolor="none", edgecolor="0.5", label="without receivers"
        )
    axes.scatter(pivot[:, 0], pivot[:, 1], s=size, color="#0072B2", zorder=2, label="heliostat")
    faces = np.isfinite(normal).all(axis=1)
    if faces.any():
        width = _ARROW * float(np.ptp(_places(scenario)[:, :2], axis=0).max())
        axes.quiver(
            *pivot[faces, :2].T, *(width * normal[faces, :2]).T, angles="xy", scale_units="xy", scale=1.0,
            color="#0072B2", width=0.003, zorder=2,
        )  # fmt: skip
    mark_places(axes, scenario.transmitter_enu_m, marker="^", label="transmitter")
    if scenario.calibration_receiver:
        mark_places(axes, scenario.calibration_enu_m, marker="s", label="calibration receiver")
    if scenario.site.aim_enu_m is not None:
        axes.scatter(*scenario.site.aim_enu_m[:2], marker="*", s=140, color="#E69F00", zorder=4, label="aim point")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.set_title(scenario.name + (" (arrows: where mirrors face, from above)" if faces.any() else ""))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    _name(axes, scenario)
    return figure


def _name(axes: Axes, scenario: Scenario) -> None:
    """Write the names of what is marked; of heliostats while they are few."""
    marked = [
        (scenario.transmitter_ids, scenario.transmitter_enu_m, VERMILION),
        (tuple(r.id for r in scenario.calibration_receiver), scenario.calibration_enu_m, VERMILION),
    ]
    if len(scenario.heliostat) <= _NAMED:
        marked.append((scenario.heliostat_ids, scenario.pivot_enu_m, "#004B75"))
    names = [name for ids, _, _ in marked for name in ids]
    colours = [colour for ids, _, colour in marked for _ in ids]
    places = np.concatenate([place.reshape(-1, 3)[:, :2] for _, place, _ in marked])
    place_names(axes, places, names, keep_off=_places(scenario)[:, :2], colours=colours)


def plan_in_letters(scenario: Scenario, *, width: int = 64, height: int = 24) -> list[str]:
    """Return a plan of the site in letters, north up: what stands in the same place hides what comes before it here.

    ``o`` heliostats, ``p`` plates without receivers, ``C`` calibration receivers, ``*`` aim point, ``T`` transmitters.

    Parameters
    ----------
    scenario
    width, height
        Letters in a line, and lines, at most; a line is as high as two letters are wide.
    """
    places = _places(scenario)
    if not len(places):
        return []
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
    east, north = (high - low).tolist()
    step = max(east / (width - 1), north / (2 * (height - 1)), 1e-6)
    grid = np.full((round(north / (2.0 * step)) + 1, width), " ", dtype="<U1")
    for letter, some in _groups(scenario):
        column = np.rint((some[:, 0] - low[0]) / step).astype(np.int64)
        row = np.rint((high[1] - some[:, 1]) / (2.0 * step)).astype(np.int64)
        grid[row, column] = letter
    return ["".join(row).rstrip() for row in grid] + [
        f"{' ' * 4}o heliostat, T transmitter, C calibration receiver, * aim point, p plate; north up, "
        f"a letter is {step:.2g} m wide"
    ]


def _groups(scenario: Scenario) -> list[tuple[str, FloatArray]]:
    aim = [] if scenario.site.aim_enu_m is None else [scenario.site.aim_enu_m]
    plates = [p.pivot_enu_m for p in scenario.site.structures.plate]
    groups = (
        ("p", plates),
        ("o", scenario.pivot_enu_m),
        ("C", scenario.calibration_enu_m),
        ("*", aim),
        ("T", scenario.transmitter_enu_m),
    )
    return [(letter, np.array(places, np.float64).reshape(-1, 3)) for letter, places in groups]


def _places(scenario: Scenario) -> FloatArray:
    return np.concatenate([places for _, places in _groups(scenario)])
