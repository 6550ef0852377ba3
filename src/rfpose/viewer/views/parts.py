"""What the views are made of: plots with units, clouds of coloured dots, a plan of the site, tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QPainter, QPen, QTransform
from PySide6.QtWidgets import (
    QAbstractItemView,
    QGraphicsItem,
    QHeaderView,
    QSizePolicy,
    QTableWidget,
    QTableWidgetItem,
    QWidget,
)

from rfpose.checks import FloatArray
from rfpose.drawing import COLOUR_MAP, PINK, VERMILION
from rfpose.pipeline.pictures.field_view import FieldPicture
from rfpose.viewer.state.observed import Signal
from rfpose.viewer.state.session import Session
from rfpose.viewer.theme import Theme, colour_table, see_through
from rfpose.viewer.workers import Workers

__all__ = ["Dots", "PlanPlot", "Scale", "Table", "View", "keep_axes", "pick_on_click", "plot_in", "segments"]

_PICK_PX = 14.0
_LEVELS = 64
_NUMERIC = "0123456789-−+.–n"
_CROWD = 200
"""With more mirrors than this names get a ground of their own to be read on."""
_MANY = 1500
"""Dots above this number are squares without rim and smoothed edges: they are drawn ten times as fast."""


class View(QWidget):
    """A tab of the window. `release` ends its listening; the window calls it before it is thrown away."""

    name = ""
    title = ""

    def __init__(self, session: Session, workers: Workers, theme: Theme) -> None:
        super().__init__()
        self.session, self.workers, self.theme = session, workers, theme
        self._connections: list[Callable[[], None]] = []

    def listen(self, event: Signal, listener: Callable[..., Any]) -> None:
        """Observe until `release`."""
        self._connections.append(event.connect(listener))

    def release(self) -> None:
        """Stop observing."""
        while self._connections:
            self._connections.pop()()

    def applies(self) -> bool:
        """Tell whether there is something to show for the open document."""
        return self.session.document is not None


def plot_in(
    layout: Any, theme: Theme, *, x: str | None, y: str | None, row: int = 0, column: int = 0, **options: Any
) -> Any:
    """Add a plot to a graphics layout, with what its axes show and in which unit."""
    plot = layout.addPlot(row=row, col=column, **options)
    plot.setLabel("bottom", x)
    plot.setLabel("left", y)
    plot.showGrid(x=True, y=True, alpha=0.25)
    plot.hideButtons()
    for side in ("bottom", "left"):
        axis = plot.getAxis(side)
        axis.enableAutoSIPrefix(False)
        axis.setTextPen(theme.text)
        axis.setPen(theme.muted)
    return plot


def keep_axes(plot: Any) -> None:
    """Draw a plot's axes once and keep the picture, until they change: most of a frame's time otherwise."""
    for side in ("left", "bottom", "right", "top"):
        plot.getAxis(side).setCacheMode(QGraphicsItem.CacheMode.DeviceCoordinateCache)


def segments(start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return x and y of separate lines, for a curve with ``connect="pairs"``; those with NaN are left out."""
    seen = np.isfinite(start[:, :2]).all(axis=1) & np.isfinite(end[:, :2]).all(axis=1)
    pairs = np.stack([start[seen, :2], end[seen, :2]], axis=1).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


class Dots(pg.GraphicsObject):  # type: ignore[misc]
    """Many dots, each in one of a few dozen colours; drawn a colour at a time, so that thousands are quick."""

    def __init__(self, size_px: float = 8.0, *, rim: str | None = None) -> None:
        super().__init__()
        self._size = size_px
        self._rim = None if rim is None else QColor(rim)
        self._all: Any = None
        self._x = self._y = np.empty(0)
        self._groups: list[tuple[QColor, Any]] = []
        self._bounds = QRectF()

    def set_data(
        self, x: FloatArray, y: FloatArray, colour: npt.NDArray[np.int64], table: Sequence[QColor], size_px: float
    ) -> None:
        """Show dots (dot,) in colours ``table[colour]``; those without a finite place are left out."""
        self.prepareGeometryChange()
        seen = np.isfinite(x) & np.isfinite(y)
        self._x, self._y, self._size = np.asarray(x), np.asarray(y), size_px
        self._groups = []
        self._all = None
        if self._rim is not None and seen.any():
            self._all = pg.functions.arrayToQPolygonF(self._x[seen], self._y[seen])
        for k in np.unique(colour[seen]) if seen.any() else ():
            mine = seen & (colour == k)
            self._groups.append((table[int(k)], pg.functions.arrayToQPolygonF(self._x[mine], self._y[mine])))
        self._bounds = QRectF()
        if seen.any():
            low = QPointF(float(x[seen].min()), float(y[seen].min()))
            self._bounds = QRectF(low, QPointF(float(x[seen].max()), float(y[seen].max())))
        self.informViewBoundsChanged()
        self.update()

    def paint(self, painter: QPainter, *_: Any) -> None:
        """Draw, a colour at a time."""
        painter.setRenderHint(QPainter.RenderHint.Antialiasing, len(self._x) < _MANY)
        # Qt draws a round point as a line of a fixed length in the units at hand: in pixels it cannot be seen
        transform = painter.worldTransform()
        painter.setWorldTransform(QTransform())
        groups = self._groups
        if self._all is not None and self._rim is not None and len(self._x) < _MANY:
            groups = [(self._rim, self._all), *groups]
        for colour, polygon in groups:
            pen = QPen(colour, self._size + (2.0 if colour is self._rim else 0.0))
            pen.setCapStyle(Qt.PenCapStyle.RoundCap if len(self._x) < _MANY else Qt.PenCapStyle.SquareCap)
            painter.setPen(pen)
            painter.drawPoints(transform.map(polygon))
        painter.setWorldTransform(transform)

    def boundingRect(self) -> QRectF:  # noqa: N802 -- Qt's name
        """Where there is something to draw."""
        pixel = self.pixelVectors()
        if pixel[0] is None:
            return self._bounds
        pad_x, pad_y = pixel[0].x() * self._size, abs(pixel[1].y()) * self._size
        return self._bounds.adjusted(-pad_x, -pad_y, pad_x, pad_y)

    def dataBounds(self, axis: int, frac: float = 1.0, orthoRange: Any = None) -> tuple[float | None, float | None]:  # noqa: N802
        """Range along an axis, for pyqtgraph's own ranging."""
        if not self._groups:
            return None, None
        box = self._bounds
        return (box.left(), box.right()) if axis == 0 else (box.top(), box.bottom())

    def pixelPadding(self) -> float:  # noqa: N802
        """How far a dot reaches beyond its place [pixel]."""
        return 0.5 * self._size

    def nearest(self, place: QPointF) -> int | None:
        """Return the dot at a place in its own coordinates; None where none is near."""
        if not len(self._x):
            return None
        pixel = self.pixelVectors()
        if pixel[0] is None:
            return None
        across = np.hypot((self._x - place.x()) / pixel[0].x(), (self._y - place.y()) / abs(pixel[1].y()))
        if not np.isfinite(across).any():
            return None
        best = int(np.nanargmin(across))
        return best if across[best] <= max(_PICK_PX, self._size) else None


def pick_on_click(plot: Any, dots: Dots, heard: Callable[[int], None]) -> None:
    """Call ``heard`` with the index of a dot that is clicked on a plot."""

    def clicked(event: Any) -> None:
        if event.button() != Qt.MouseButton.LeftButton or not plot.sceneBoundingRect().contains(event.scenePos()):
            return
        index = dots.nearest(plot.vb.mapSceneToView(event.scenePos()))
        if index is not None:
            heard(index)

    plot.scene().sigMouseClicked.connect(clicked)


class Scale:
    """Colours for a quantity, with a bar that says what they mean."""

    def __init__(self, layout: Any, theme: Theme, *, row: int = 0, column: int = 1) -> None:
        self.table = [QColor(*map(int, rgb)) for rgb in colour_table(_LEVELS)] + [QColor(theme.muted)]
        self.bar = pg.ColorBarItem(
            values=(0.0, 1.0), colorMap=pg.colormap.get(COLOUR_MAP), interactive=False, width=14, label=" "
        )
        self.bar.getAxis("right").setTextPen(theme.text)
        self.bar.getAxis("left").setTextPen(theme.text)
        for side in ("left", "right"):
            self.bar.getAxis(side).setCacheMode(QGraphicsItem.CacheMode.DeviceCoordinateCache)
        layout.addItem(self.bar, row=row, col=column)

    def colours(
        self, values: FloatArray, label: str, limits: tuple[float, float] | None = None
    ) -> npt.NDArray[np.int64]:
        """Return the colour of each value (dot,), NaN in grey, and write limits and label on the bar."""
        known = np.isfinite(values)
        if limits is None:
            limits = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 1.0)
        low, high = limits
        if not high > low:
            low, high = low - 0.5 * max(abs(low), 1e-9), high + 0.5 * max(abs(high), 1e-9)
        self.bar.setLevels((low, high))
        self.bar.getAxis("left").setLabel(label)
        place = (np.where(known, values, low) - low) / (high - low)
        index = np.clip((place * _LEVELS).astype(np.int64), 0, _LEVELS - 1)
        return np.where(known, index, _LEVELS)

    def show(self, visible: bool) -> None:
        """Show or hide the bar."""
        self.bar.setVisible(visible)


class PlanPlot:
    """The site from above, on a plot: transmitters, calibration receivers, heliostats with their normals."""

    def __init__(self, plot: Any, theme: Theme, *, names: bool = True) -> None:
        self.plot, self.theme, self._names = plot, theme, names
        plot.setAspectLocked(True)
        self.lines = pg.PlotCurveItem(pen=pg.mkPen(theme.trace, width=1.5), connect="pairs")
        self.dots = Dots(rim=theme.muted)
        self.picked = pg.ScatterPlotItem(size=20, pen=pg.mkPen(theme.accent, width=2.5), brush=None, pxMode=True)
        self.transmitters = pg.ScatterPlotItem(symbol="t1", size=14, pxMode=True)
        self.calibration = pg.ScatterPlotItem(symbol="s", size=9, pen=None, brush=PINK, pxMode=True)
        for item in (self.lines, self.dots, self.picked, self.transmitters, self.calibration):
            plot.addItem(item)
        self.transmitters.setZValue(30)
        self.calibration.setZValue(30)
        self.labels: list[Any] = []
        self._fill: QColor | None = None

    def show_site(self, field: FieldPicture | None) -> None:
        """Draw what stands still."""
        for label in self.labels:
            self.plot.removeItem(label)
        self.labels = []
        if field is None:
            for item in (self.transmitters, self.calibration):
                item.setData([], [])
            return
        self.light_up(field, None)
        places = field.calibration_enu_m
        self.calibration.setData(places[:, 0], places[:, 1])
        self._fill = see_through(self.theme.plot) if len(field.pivot_enu_m) > _CROWD else None
        if self._names:
            for name, place in zip(field.transmitter_ids, field.transmitter_enu_m, strict=True):
                self._label(name, place, self.theme.warning)
            for name, place in zip(field.calibration_ids, places, strict=True):
                self._label(name, place, self.theme.muted)

    def light_up(self, field: FieldPicture, chosen: int | None) -> None:
        """Draw the transmitters, one of them large and bright."""
        places = field.transmitter_enu_m
        on = [i == chosen for i in range(len(places))]
        self.transmitters.setData(
            x=places[:, 0],
            y=places[:, 1],
            size=[26 if lit else 14 for lit in on],
            brush=[pg.mkBrush("#E69F00" if lit else VERMILION) for lit in on],
            pen=[pg.mkPen(self.theme.text, width=2) if lit else pg.mkPen(None) for lit in on],
        )

    def _label(self, name: str, place: FloatArray, colour: str) -> None:
        label = pg.TextItem(name, color=colour, anchor=(-0.15, 1.05), fill=self._fill)
        label.setZValue(20)
        label.setPos(float(place[0]), float(place[1]))
        self.plot.addItem(label, ignoreBounds=True)
        self.labels.append(label)

    def pick(self, place: FloatArray | None) -> None:
        """Put a ring about a place, or take it away."""
        if place is None or not np.isfinite(place[:2]).all():
            self.picked.setData([], [])
        else:
            self.picked.setData([float(place[0])], [float(place[1])])

    def on_click(self, heard: Callable[[int], None]) -> None:
        """Call ``heard`` with the index of a heliostat that is clicked."""
        pick_on_click(self.plot, self.dots, heard)


class Table(QTableWidget):
    """Rows of text; the whole row is chosen."""

    def __init__(self, header: Sequence[str]) -> None:
        super().__init__(0, len(header))
        self.setHorizontalHeaderLabels(list(header))
        self.verticalHeader().hide()
        self.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
        self.setAlternatingRowColors(True)
        self.horizontalHeader().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.horizontalHeader().setStretchLastSection(True)
        self.verticalHeader().setDefaultSectionSize(22)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)

    def fill(self, rows: Sequence[Sequence[str]]) -> None:
        """Show these rows; the chosen row stays chosen."""
        chosen = self.currentRow()
        self.blockSignals(True)
        self.setRowCount(len(rows))
        for i, row in enumerate(rows):
            for j, text in enumerate(row):
                item = QTableWidgetItem(text)
                if j and (not text or text[0] in _NUMERIC):
                    item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
                self.setItem(i, j, item)
        if 0 <= chosen < len(rows):
            self.selectRow(chosen)
        self.blockSignals(False)

    def explain(self, column: int, text: str) -> None:
        """Say what a column means, to who stays on its head with the mouse."""
        head = self.horizontalHeaderItem(column)
        if head is not None:
            head.setToolTip(text)

    def warn(self, rows: Sequence[int], colour: str) -> None:
        """Write these rows in another colour."""
        for item in (self.item(i, j) for i in rows for j in range(self.columnCount())):
            if item is not None:
                item.setForeground(QColor(colour))

    def choose(self, row: int | None) -> None:
        """Mark a row without telling anyone."""
        self.blockSignals(True)
        if row is None:
            self.clearSelection()
        else:
            self.selectRow(row)
        self.blockSignals(False)
