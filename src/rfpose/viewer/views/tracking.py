"""A tracking run: play it, scrub through it; mirrors move, beams meet the target, curves follow the cursor."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt, QTimer
from PySide6.QtWidgets import QComboBox, QHBoxLayout, QLabel, QPushButton, QSlider, QSplitter, QVBoxLayout

from rfpose.pipeline.track_view import TrackPicture
from rfpose.viewer.state.playback import SPEEDS
from rfpose.viewer.state.session import Session
from rfpose.viewer.theme import SERIES, Theme
from rfpose.viewer.views.parts import Dots, Scale, Table, View, keep_axes, plot_in, segments
from rfpose.viewer.workers import Workers

__all__ = ["TrackingView"]

_TICK_MS = 33
_BEAMS = 400
"""With more mirrors than this only so many beams are drawn."""


class TrackingView(View):
    """One method on the plan and at the target, all methods as curves and in a table."""

    name = "tracking"
    title = "Tracking"

    def __init__(self, session: Session, workers: Workers, theme: Theme) -> None:
        super().__init__(session, workers, theme)
        self._picture: TrackPicture | None = None
        self._curves: dict[str, Any] = {}
        self._build()
        self._clock = QTimer(self, interval=_TICK_MS)
        self._clock.timeout.connect(self._tick)
        self._last = 0.0
        self.listen(session.opened, self._on_opened)
        self.listen(session.playback.changed, self._draw)
        self._on_opened()

    def applies(self) -> bool:
        """Tell whether a tracking run is open."""
        return self.session.document is not None and self.session.document.track is not None

    def _build(self) -> None:
        theme, playback = self.theme, self.session.playback
        self.play = QPushButton("Play")
        self.play.setToolTip("Play or pause (Space)")
        self.play.clicked.connect(lambda: playback.toggle())
        self.position = QSlider(Qt.Orientation.Horizontal)
        self.position.valueChanged.connect(lambda value: playback.scrub(value))
        self.moment = QLabel()
        self.moment.setMinimumWidth(160)
        self.speed = QComboBox()
        for factor in SPEEDS:
            self.speed.addItem(f"{10.0 * factor:g} steps/s", 10.0 * factor)
        self.speed.setCurrentIndex(SPEEDS.index(1.0))
        self.speed.activated.connect(lambda _: self._set_speed())
        self.method = QComboBox()
        self.method.activated.connect(lambda _: self._draw())
        bar = QHBoxLayout()
        for text, widget in (
            ("", self.play),
            ("", self.position),
            ("", self.moment),
            ("Speed", self.speed),
            ("Method", self.method),
        ):
            if text:
                bar.addWidget(QLabel(text))
            bar.addWidget(widget, 1 if widget is self.position else 0)
        self.map = pg.GraphicsLayoutWidget()
        self.plan_plot = plot_in(self.map, theme, x="east [m]", y="north [m]")
        self.plan_plot.setAspectLocked(True)
        keep_axes(self.plan_plot)
        self.beams = pg.PlotCurveItem(pen=pg.mkPen(230, 159, 0, 90, width=1), connect="pairs")
        self.normals = pg.PlotCurveItem(pen=pg.mkPen(theme.trace, width=1.5), connect="pairs")
        self.dots = Dots(rim=theme.muted)
        self.target = pg.ScatterPlotItem(symbol="s", size=14, pen=pg.mkPen(theme.text, width=1.5), brush="#CC79A7")
        for item in (self.beams, self.normals, self.dots, self.target):
            self.plan_plot.addItem(item)
        self.scale = Scale(self.map, theme)
        self.graphs = pg.GraphicsLayoutWidget()
        self.spot_plot = plot_in(self.graphs, theme, x="right of the aim point [m]", y="above [m]", row=0)
        self.spot_plot.setAspectLocked(True)
        self.spot_plot.addItem(pg.InfiniteLine(angle=0, pen=pg.mkPen(theme.muted, width=1)), ignoreBounds=True)
        self.spot_plot.addItem(pg.InfiniteLine(angle=90, pen=pg.mkPen(theme.muted, width=1)), ignoreBounds=True)
        self.spots = Dots(rim=theme.muted)
        self.spot_plot.addItem(self.spots)
        self.curve_plot = plot_in(self.graphs, theme, x="time, nights left out [h]", y="rms error [mrad]", row=1)
        self.curve_plot.setLogMode(y=True)
        self.legend = self.curve_plot.addLegend(offset=(-4, 2), labelTextSize="7pt", colCount=5)
        self.cursor_line = pg.InfiniteLine(angle=90, movable=True, pen=pg.mkPen("#E69F00", width=2))
        self.cursor_line.sigDragged.connect(lambda line: self._cursor_dragged(line))
        self.curve_plot.addItem(self.cursor_line, ignoreBounds=True)
        self.table = Table(("method", "now\n[mrad]", "rms\n[mrad]", "worst\n95 %", "worst\n[mrad]", "light\ncaught"))
        self.table.itemSelectionChanged.connect(self._method_chosen)
        right = QSplitter(Qt.Orientation.Vertical)
        right.addWidget(self.graphs)
        right.addWidget(self.table)
        right.setSizes([480, 220])
        split = QSplitter(Qt.Orientation.Horizontal)
        split.addWidget(self.map)
        split.addWidget(right)
        split.setSizes([680, 590])
        page = QVBoxLayout(self)
        page.addLayout(bar)
        page.addWidget(split, 1)

    # -- what happens ------------------------------------------------------------------------------------

    def _on_opened(self) -> None:
        document = self.session.document
        self._picture = picture = None if document is None else document.track
        self.method.clear()
        for curve in self._curves.values():
            self.curve_plot.removeItem(curve)
        self._curves = {}
        self._clock.stop()
        if picture is None:
            return
        self.method.addItems(list(picture.methods))
        best = picture.track.ranking()[:1]
        if best:
            self.method.setCurrentText(best[0])
        for k, name in enumerate(picture.methods):
            style = Qt.PenStyle.SolidLine if k < len(SERIES) else Qt.PenStyle.DashLine
            pen = pg.mkPen(SERIES[k % len(SERIES)], width=1.5, style=style)
            values = picture.rms_mrad[name]
            if not (values > 0.0).any():
                continue  # a path of nothing but NaN takes Qt down
            positive = np.where(values > 0.0, values, np.nan)
            self._curves[name] = self.curve_plot.plot(picture.hours, positive, pen=pen, name=name, connect="finite")
        self._scale_errors(picture)
        if len(picture.pivot_enu_m):
            ground = np.concatenate([picture.pivot_enu_m, picture.target_enu_m])[:, :2]
            ground = ground[np.isfinite(ground).all(axis=1)]
            (x0, y0), (x1, y1) = ground.min(axis=0), ground.max(axis=0)
            pad = 0.08 * max(x1 - x0, y1 - y0, 1.0)
            self.plan_plot.setRange(xRange=(x0 - pad, x1 + pad), yRange=(y0 - pad, y1 + pad), padding=0.0)
        self.position.blockSignals(True)
        self.position.setRange(0, max(picture.n_instant - 1, 0))
        self.position.blockSignals(False)
        self._draw()

    def _scale_errors(self, picture: TrackPicture) -> None:
        """Put room for the key above the curves, and few enough numbers beside them."""
        values = np.concatenate([np.empty(0), *picture.rms_mrad.values()])
        values = values[np.isfinite(values) & (values > 0.0)]
        if not values.size:
            return
        low, high = np.log10(np.percentile(values, 0.5)), np.log10(values.max())
        span = max(high - low, 0.3)
        self.curve_plot.setYRange(low - 0.05 * span, high + 0.6 * span, padding=0.0)
        decades = range(int(np.floor(low)) - 1, int(np.ceil(high)) + 1)
        marks = [(np.log10(k) + d, f"{k * 10.0**d:g}") for d in decades for k in (1, 2, 5)]
        self.curve_plot.getAxis("left").setTicks([marks])

    def _set_speed(self) -> None:
        self.session.playback.frames_per_s = float(self.speed.currentData())

    def _tick(self) -> None:
        now = time.monotonic()
        elapsed, self._last = now - self._last, now
        self.session.playback.tick(elapsed)

    def _cursor_dragged(self, line: Any) -> None:
        if self._picture is not None and self._picture.n_instant:
            self.session.playback.scrub(int(np.argmin(np.abs(self._picture.hours - line.value()))))

    def _method_chosen(self) -> None:
        item = self.table.item(self.table.currentRow(), 0)
        if item is not None and item.text() != self.method.currentText():
            self.method.setCurrentText(item.text())
            self._draw()

    def choose_method(self, name: str) -> None:
        """Show this method's mirrors."""
        self.method.setCurrentText(name)
        self._draw()

    # -- drawing -----------------------------------------------------------------------------------------

    def _draw(self) -> None:
        picture, playback = self._picture, self.session.playback
        if picture is None or not picture.n_instant or not self.method.count():
            return
        if playback.playing and not self._clock.isActive():
            self._last = time.monotonic()
            self._clock.start()
        elif not playback.playing:
            self._clock.stop()
        self.play.setText("Pause" if playback.playing else "Play")
        k, name = min(playback.frame, picture.n_instant - 1), self.method.currentText()
        self.position.blockSignals(True)
        self.position.setValue(k)
        self.position.blockSignals(False)
        self.moment.setText(f"{picture.time[k].replace('T', ' ')} UTC")
        self.cursor_line.setValue(float(picture.hours[k]))
        now = picture.at(name, k)
        colour = self.scale.colours(now.error_mrad, "error of the normal [mrad]", (0.0, picture.limit_mrad[name]))
        pivot = picture.pivot_enu_m
        size = float(np.clip(160.0 / np.sqrt(max(len(pivot), 1)), 3.0, 14.0))
        self.dots.set_data(pivot[:, 0], pivot[:, 1], colour, self.scale.table, size)
        extent = max(float(np.ptp(pivot[:, :2], axis=0).max()), 1.0) if len(pivot) else 1.0
        self.normals.setData(*segments(pivot, pivot + 0.08 * extent * now.normal_enu))
        every = max(1, len(pivot) // _BEAMS)
        self.beams.setData(*segments(pivot[::every], now.beam_end_enu_m[::every]))
        targets = np.unique(picture.target_enu_m[np.isfinite(picture.target_enu_m).all(axis=1)], axis=0)
        self.target.setData(targets[:, 0], targets[:, 1])
        self.spots.set_data(now.spot_m[:, 0], now.spot_m[:, 1], colour, self.scale.table, min(size, 8.0))
        self._draw_table(picture, k, name)

    def _draw_table(self, picture: TrackPicture, k: int, name: str) -> None:
        rows = picture.comparison(k)
        self.table.fill([[row[0], *(f"{v:.3g}" for v in row[1:5]), f"{100.0 * row[5]:.2f} %"] for row in rows])
        names = [row[0] for row in rows]
        self.table.choose(names.index(name) if name in names else None)
