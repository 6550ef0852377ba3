"""How the modes of field control look on a plan: a shape and a colour each, and a key that counts mirrors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyqtgraph as pg

from rfpose.checks import FloatArray
from rfpose.drawing import MODE_COLOURS
from rfpose.pipeline.pictures.track_view import MODES, ON_RECEIVER, Instant, mode_text
from rfpose.viewer.theme import Theme

__all__ = ["ModeLegend", "away_marks"]

_SYMBOLS = {
    "stow": "s",
    "stowing": "t",
    "approach": "t1",
    "point": "o",
    "track": "o",
    "calibrate": "d",
    "search": "star",
    "defocus": "p",
    "emergency": "x",
    "idle": "h",
    "power_loss": "t2",
    "fault": "+",
}
"""Mirrors on the receiver are dots in the colour of their error; green stands for it in the key."""


def away_marks(theme: Theme, pivot_enu_m: FloatArray, now: Instant, size_px: float) -> dict[str, Any]:
    """Return what a scatter plot needs to put the marks of their modes on mirrors that are not on the receiver."""
    rows = np.flatnonzero(~now.on_receiver & (now.mode >= 0))
    names = [MODES[k] for k in now.mode[rows]]
    return {
        "x": pivot_enu_m[rows, 0],
        "y": pivot_enu_m[rows, 1],
        "symbol": [_SYMBOLS[name] for name in names],
        "brush": [pg.mkBrush(MODE_COLOURS[name]) for name in names],
        "pen": pg.mkPen(theme.text, width=1),
        "size": max(size_px - 2.0, 4.0),
    }


class ModeLegend:
    """A key in the corner of a plot: the modes that a run knows, and how many of all mirrors are in each now."""

    def __init__(self, plot: Any, theme: Theme) -> None:
        self._theme = theme
        self.key = pg.LegendItem(
            offset=(8, 8), labelTextColor=theme.text, labelTextSize="8pt", brush=pg.mkBrush(theme.plot), verSpacing=-2
        )
        self.key.setParentItem(plot.vb)
        self._modes: tuple[int, ...] = ()

    def show(self, count: Mapping[int, int]) -> None:
        """Show these numbers of mirrors by mode."""
        if tuple(count) != self._modes:
            self.key.clear()
            self._modes = tuple(count)
            for k in self._modes:
                symbol, colour = _SYMBOLS[MODES[k]], MODE_COLOURS[MODES[k]]
                item = pg.ScatterPlotItem(symbol=symbol, size=10, brush=colour, pen=pg.mkPen(self._theme.text, width=1))
                self.key.addItem(item, mode_text(k))
        for (_, label), k in zip(self.key.items, self._modes, strict=True):
            text = f"{mode_text(k)} {count[k]}" + (", coloured by error" if k in ON_RECEIVER and count[k] else "")
            label.setText(text, color=self._theme.text if count[k] else self._theme.muted)

    def set_visible(self, visible: bool) -> None:
        """Show or hide the key."""
        self.key.setVisible(visible)

    @property
    def texts(self) -> tuple[str, ...]:
        """What stands in the key."""
        return tuple(label.text for _, label in self.key.items)
