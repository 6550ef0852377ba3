"""The site in three dimensions, drawn without OpenGL: points are projected, a drag turns the eye about the field."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor

from rfpose.checks import FloatArray
from rfpose.drawing import VERMILION
from rfpose.pipeline.pictures.field_view import FieldPicture, project
from rfpose.viewer.theme import Theme
from rfpose.viewer.views.parts import Dots, segments

__all__ = ["Space"]

_RADIANS_PER_PX = 0.008
_LOWEST, _HIGHEST = 0.02, 0.5 * np.pi
_RINGS = 4


class _TurningBox(pg.ViewBox):  # type: ignore[misc]
    """A view box whose left drag turns instead of shifting."""

    def __init__(self) -> None:
        super().__init__(lockAspect=True, enableMenu=False)
        self.turned: Any = None

    def mouseDragEvent(self, event: Any, axis: int | None = None) -> None:  # noqa: N802 -- pyqtgraph's name
        if event.button() == Qt.MouseButton.LeftButton and self.turned is not None:
            event.accept()
            step = event.pos() - event.lastPos()
            self.turned(step.x(), step.y())
        else:
            super().mouseDragEvent(event, axis)


class Space:
    """Transmitters on their masts, mirrors with normals, circles on the ground with their radius in metres."""

    def __init__(self, layout: Any, theme: Theme, *, row: int = 0, column: int = 0) -> None:
        self.theme = theme
        self.azimuth_rad, self.elevation_rad = np.radians(200.0), np.radians(28.0)
        box = _TurningBox()
        box.turned = self.turn
        self.plot = layout.addPlot(row=row, col=column, viewBox=box)
        for side in ("left", "bottom"):
            self.plot.hideAxis(side)
        self.plot.hideButtons()
        muted = pg.mkPen(theme.muted, width=1)
        self._ground = pg.PlotCurveItem(pen=pg.mkPen(theme.grid, width=1), connect="finite")
        self._masts = pg.PlotCurveItem(pen=muted, connect="pairs")
        self._normals = pg.PlotCurveItem(pen=pg.mkPen(theme.trace, width=1.2), connect="pairs")
        self.dots = Dots(rim=theme.muted)
        self._tips = pg.ScatterPlotItem(symbol="t1", size=12, pen=None, brush=VERMILION)
        self._picked = pg.ScatterPlotItem(size=16, pen=pg.mkPen(theme.accent, width=2), brush=None)
        for item in (self._ground, self._masts, self._normals, self.dots, self._tips, self._picked):
            self.plot.addItem(item)
        self._labels: list[Any] = []
        self._field: FieldPicture | None = None
        self._arrow: FloatArray = np.empty((0, 3))
        self._colour: npt.NDArray[np.int64] = np.empty(0, np.int64)
        self._table: list[QColor] = []
        self._chosen: tuple[int | None, int | None] = (None, None)

    def turn(self, right_px: float, down_px: float) -> None:
        """Turn the eye as a drag of so many pixels does."""
        self.azimuth_rad = float(np.mod(self.azimuth_rad + _RADIANS_PER_PX * right_px, 2.0 * np.pi))
        self.elevation_rad = float(np.clip(self.elevation_rad + _RADIANS_PER_PX * down_px, _LOWEST, _HIGHEST))
        self._draw()

    def show(
        self,
        field: FieldPicture | None,
        arrow_m: FloatArray,
        colour: npt.NDArray[np.int64],
        table: list[QColor],
        *,
        heliostat: int | None = None,
        transmitter: int | None = None,
    ) -> None:
        """Draw a field with arrows (heliostat, xyz) from its mirrors [m]."""
        again = field is not self._field
        self._field, self._arrow, self._colour, self._table = field, arrow_m, colour, table
        self._chosen = (heliostat, transmitter)
        if again:
            self._relabel()
        self._draw()
        if again:
            self.plot.vb.autoRange(padding=0.06)

    def _relabel(self) -> None:
        for label in self._labels:
            self.plot.removeItem(label)
        self._labels = []
        if self._field is None:
            return
        names = [(name, self.theme.warning) for name in self._field.transmitter_ids]
        names += [(text, self.theme.muted) for text in ("north", "east")]
        names += [(f"{radius:g} m", self.theme.muted) for radius in self._radii()]
        for text, colour in names:
            label = pg.TextItem(text, color=colour, anchor=(-0.1, 0.9))
            self.plot.addItem(label, ignoreBounds=True)
            self._labels.append(label)

    def _radii(self) -> FloatArray:
        assert self._field is not None
        ground = np.concatenate([self._field.transmitter_enu_m, self._field.pivot_enu_m])
        reach = float(np.nanmax(np.hypot(ground[:, 0], ground[:, 1]), initial=1.0))
        step = reach / _RINGS
        nice = 10.0 ** np.floor(np.log10(step))
        step = nice * min((k for k in (1.0, 2.0, 2.5, 5.0, 10.0) if k * nice >= step), default=10.0)
        return np.asarray(step * np.arange(1, int(np.ceil(reach / step)) + 1))

    def _seen(self, point_enu_m: FloatArray) -> FloatArray:
        return project(point_enu_m, self.azimuth_rad, self.elevation_rad)

    def _draw(self) -> None:
        field = self._field
        if field is None or not (len(field.transmitter_enu_m) + len(field.pivot_enu_m)):
            for curve in (self._ground, self._masts, self._normals, self._tips, self._picked):
                curve.setData([], [])
            self.dots.set_data(np.empty(0), np.empty(0), np.empty(0, np.int64), [], 6.0)
            return
        radii = self._radii()
        angle = np.append(np.linspace(0.0, 2.0 * np.pi, 91), np.nan)
        circle = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        far = float(radii[-1])
        cross = np.array([[-far, 0, 0], [far, 0, 0], [np.nan] * 3, [0, -far, 0], [0, far, 0], [np.nan] * 3])
        rings = self._seen(np.concatenate([*(r * circle for r in radii), cross]))
        self._ground.setData(rings[:, 0], rings[:, 1])
        towers = field.transmitter_enu_m
        tips, feet = self._seen(towers), self._seen(towers * [1.0, 1.0, 0.0])
        self._masts.setData(*segments(feet, tips))
        lit = self._chosen[1]
        self._tips.setData(
            x=tips[:, 0],
            y=tips[:, 1],
            size=[22 if i == lit else 12 for i in range(len(tips))],
            brush=[pg.mkBrush("#E69F00" if i == lit else VERMILION) for i in range(len(tips))],
        )
        mirrors = self._seen(field.pivot_enu_m)
        if len(self._arrow) == len(mirrors):
            self._normals.setData(*segments(mirrors, self._seen(field.pivot_enu_m + self._arrow)))
        size = float(np.clip(60.0 / np.sqrt(max(len(mirrors), 1)), 2.0, 9.0))
        self.dots.set_data(mirrors[:, 0], mirrors[:, 1], self._colour, self._table, size)
        chosen = self._chosen[0]
        ring = mirrors[[chosen]] if chosen is not None else np.empty((0, 3))
        self._picked.setData(ring[:, 0], ring[:, 1])
        marks = np.array([[0.0, far, 0.0], [far, 0.0, 0.0], *([0.0, -r, 0.0] for r in radii)])
        places = np.concatenate([tips, self._seen(marks)])
        for label, place in zip(self._labels, places, strict=True):
            label.setPos(float(place[0]), float(place[1]))
