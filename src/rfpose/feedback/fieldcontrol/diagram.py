"""The table of modes as a picture. matplotlib is loaded when one is drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rfpose.checks import FloatArray
from rfpose.feedback.fieldcontrol.modes import COMMANDS, TRANSITIONS, Mode, ModeEvent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_modes"]

_PLACE: dict[Mode, tuple[float, float]] = {
    Mode.STOW: (0.0, 4.0),
    Mode.APPROACH: (2.6, 6.4),
    Mode.POINT: (6.6, 6.4),
    Mode.TRACK: (12.4, 6.4),
    Mode.STOWING: (0.9, 1.6),
    Mode.DEFOCUS: (6.6, 2.2),
    Mode.CALIBRATE: (12.4, 2.2),
    Mode.SEARCH: (12.4, -0.6),
    Mode.EMERGENCY: (3.4, -0.2),
    Mode.IDLE: (4.6, -1.8),
    Mode.POWER_LOSS: (0.0, -1.8),
    Mode.FAULT: (0.0, -3.6),
}
_COLOUR = {"command": "#0072B2", "itself": "#D55E00"}
# These happen in most modes and would hide the rest; they are told in words below the picture.
_COMMON = (ModeEvent.EMERGENCY, ModeEvent.HEARTBEAT_LOST, ModeEvent.STOW, ModeEvent.HOLD, ModeEvent.POWER_OFF)
_HALF = np.array([0.95, 0.34])


def draw_modes() -> Figure:
    """Return the picture of the table: what leads from which mode to which."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for mode, place in _PLACE.items():
        axes.text(
            *place,
            mode.name.replace("_", " "),
            ha="center",
            va="center",
            fontsize=11,
            bbox={"boxstyle": "round,pad=0.45", "facecolor": "white", "edgecolor": "black"},
            zorder=3,
        )
    for (before, after), events in _arrows().items():
        _draw_arrow(axes, before, after, events)
    axes.text(7.4, -3.5, _in_words(), ha="center", va="center", fontsize=10)
    for kind, y in (("command", -1.6), ("itself", -2.0)):
        label = "ordered" if kind == "command" else "noticed by the heliostat itself"
        axes.plot([9.4, 10.0], [y, y], color=_COLOUR[kind], lw=1.6)
        axes.text(10.15, y, label, va="center", fontsize=10, color=_COLOUR[kind])
    axes.set(xlim=(-1.3, 13.8), ylim=(-4.5, 7.1))
    axes.set_axis_off()
    return figure


def _arrows() -> dict[tuple[Mode, Mode], list[ModeEvent]]:
    """Events of each arrow that is drawn; staying in a mode is not."""
    arrows: dict[tuple[Mode, Mode], list[ModeEvent]] = {}
    for before, row in TRANSITIONS.items():
        for event, after in row.items():
            if before != after and not (event in _COMMON and len(_from(event)) > 3):
                arrows.setdefault((before, after), []).append(event)
    return arrows


def _from(event: ModeEvent) -> list[Mode]:
    """Modes that an event leaves."""
    return [mode for mode, row in TRANSITIONS.items() if event in row and row[event] != mode]


def _in_words() -> str:
    """Return what is not drawn."""
    lines = []
    for event in _COMMON:
        modes = _from(event)
        to = {TRANSITIONS[mode][event] for mode in modes}
        name = event.name if event in COMMANDS else event.name.lower()
        where = ", ".join(mode.name.replace("_", " ") for mode in modes)
        if len(modes) > len(Mode) - 2:
            where = "every other mode"
        lines.append(f"{name.replace('_', ' ')} leads to {next(iter(to)).name.replace('_', ' ')} from {where}")
    return "\n".join(lines)


def _draw_arrow(axes: Axes, before: Mode, after: Mode, events: list[ModeEvent]) -> None:
    """Draw one arrow, to the left of its way so that there and back lie apart, with its events beside it."""
    start, end = np.array(_PLACE[before]), np.array(_PLACE[after])
    way = end - start
    left = np.array([-way[1], way[0]]) / float(np.hypot(*way))
    kinds = ["command" if event in COMMANDS else "itself" for event in events]
    start, end = start + 0.11 * left, end + 0.11 * left
    axes.annotate(
        "",
        xy=tuple(end - _edge(way)),
        xytext=tuple(start + _edge(way)),
        arrowprops={
            "arrowstyle": "-|>",
            "color": _COLOUR[kinds[0]] if len(set(kinds)) == 1 else "0.35",
            "lw": 1.4,
            "shrinkA": 0,
            "shrinkB": 0,
        },
    )
    level, upright = abs(way[1]) < 1e-9, abs(way[0]) < 1e-9
    # on a slope the label stands on the line, nearer to its start, where other slopes do not cross
    beside = start + (0.5 if level or upright else 0.33) * way
    beside = beside + left * (0.12 if upright else (0.16 + 0.14 * len(events)) if level else 0.0)
    for i, (event, kind) in enumerate(zip(events, kinds, strict=True)):
        name = event.name if kind == "command" else event.name.lower()
        axes.text(
            beside[0],
            beside[1] + 0.28 * (0.5 * (len(events) - 1) - i),
            name.replace("_", " "),
            fontsize=9,
            color=_COLOUR[kind],
            ha=("left" if left[0] > 0.0 else "right") if upright else "center",
            va="center",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
            zorder=4,
        )


def _edge(way: FloatArray) -> FloatArray:
    """Return the way from the middle of a box to where it leaves the box."""
    scale = float(np.min(_HALF / np.maximum(np.abs(way), 1e-9)))
    return np.asarray(way * min(scale, 0.45))
