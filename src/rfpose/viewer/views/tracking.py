"""A tracking run: play it, scrub through it; mirrors move, beams meet the target, curves follow, events are marked."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QColor
from PySide6.QtWidgets import (
    QComboBox,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QPushButton,
    QSlider,
    QSplitter,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from rfpose.drawing import PINK
from rfpose.pipeline.pictures.track_view import FieldHappening, Instant, TrackPicture, clock, groups
from rfpose.pipeline.pictures.tracking import method_colours
from rfpose.viewer.state.playback import SPEEDS
from rfpose.viewer.state.session import Selection, Session
from rfpose.viewer.theme import Theme
from rfpose.viewer.views.modes import ModeLegend, away_marks
from rfpose.viewer.views.parts import Dots, Scale, Table, View, keep_axes, pick_on_click, plot_in, segments
from rfpose.viewer.workers import Workers

__all__ = ["TrackingView"]

_TICK_MS = 33
_BEAMS = 400
"""With more mirrors than this only so many beams are drawn."""
_MARK_ROOM = 0.035
"""Marks nearer to each other than this part of the time axis share a number."""
_MOST_NUMBERS = 30


class TrackingView(View):
    """One method on the plan and at the target, all methods as curves and in a table."""

    name = "tracking"
    title = "Tracking"

    def __init__(self, session: Session, workers: Workers, theme: Theme) -> None:
        super().__init__(session, workers, theme)
        self._picture: TrackPicture | None = None
        self._curves: list[tuple[Any, Any]] = []
        self._marks: list[tuple[Any, Any]] = []
        self._picked: int | None = None
        self._build()
        self._clock = QTimer(self, interval=_TICK_MS)
        self._clock.timeout.connect(self._tick)
        self._last = 0.0
        self.listen(session.opened, self._on_opened)
        self.listen(session.playback.changed, self._draw)
        self.listen(session.selected, self._on_selected)
        self._on_opened()

    def applies(self) -> bool:
        """Tell whether a tracking run is open."""
        return self.session.document is not None and self.session.document.track is not None

    def _build(self) -> None:
        playback = self.session.playback
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
        self.method.activated.connect(lambda _: self._show_method())
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
        self._build_plan()
        self._build_graphs()
        self._build_tables()
        left = QWidget()
        column = QVBoxLayout(left)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.map, 1)
        column.addWidget(self.mirror_text)
        right = QSplitter(Qt.Orientation.Vertical)
        right.addWidget(self.graphs)
        right.addWidget(self.tables)
        right.setSizes([510, 190])
        split = QSplitter(Qt.Orientation.Horizontal)
        split.addWidget(left)
        split.addWidget(right)
        split.setSizes([680, 590])
        page = QVBoxLayout(self)
        page.addLayout(bar)
        page.addWidget(split, 1)

    def _build_plan(self) -> None:
        theme = self.theme
        self.map = pg.GraphicsLayoutWidget()
        self.plan_plot = plot_in(self.map, theme, x="east [m]", y="north [m]")
        self.plan_plot.setAspectLocked(True)
        keep_axes(self.plan_plot)
        self.beams = pg.PlotCurveItem(pen=pg.mkPen(230, 159, 0, 90, width=1), connect="pairs")
        self.normals = pg.PlotCurveItem(pen=pg.mkPen(theme.trace, width=1.5), connect="pairs")
        self.dots = Dots(rim=theme.muted)
        self.away = pg.ScatterPlotItem(pxMode=True)
        self.target = pg.ScatterPlotItem(symbol="s", size=14, pen=pg.mkPen(theme.text, width=1.5), brush=PINK)
        self.ring = pg.ScatterPlotItem(size=24, pen=pg.mkPen(theme.accent, width=2.5), brush=None, pxMode=True)
        for item in (self.beams, self.normals, self.dots, self.away, self.target, self.ring):
            self.plan_plot.addItem(item)
        self.legend_of_modes = ModeLegend(self.plan_plot, theme)
        self.scale = Scale(self.map, theme)
        pick_on_click(self.plan_plot, self.dots, self.pick)
        self.mirror_text = QLabel()
        self.mirror_text.setWordWrap(True)

    def _build_graphs(self) -> None:
        theme = self.theme
        self.graphs = pg.GraphicsLayoutWidget()
        self.spot_plot = plot_in(self.graphs, theme, x="right of the aim point [m]", y="above [m]", row=0)
        self.spot_plot.setAspectLocked(True)
        for angle in (0, 90):
            line = pg.InfiniteLine(angle=angle, pen=pg.mkPen(theme.muted, width=1))
            self.spot_plot.addItem(line, ignoreBounds=True)
        self.spots = Dots(rim=theme.muted)
        self.spot_plot.addItem(self.spots, ignoreBounds=True)
        self.curve_plot = plot_in(self.graphs, theme, x=None, y="rms error [mrad]", row=1)
        self.curve_plot.setLogMode(y=True)
        self.curve_plot.getAxis("bottom").setStyle(showValues=False)
        self.legend = self.curve_plot.addLegend(offset=(-4, 2), labelTextSize="7pt", colCount=5)
        self.flux_plot = plot_in(self.graphs, theme, x="time, nights left out [h]", y="flux", row=2)
        self.flux_plot.setXLink(self.curve_plot)
        self.flux_plot.setToolTip("Light on the receiver over that of a perfect field on its aim")
        self.cursor_lines = []
        for plot in (self.curve_plot, self.flux_plot):
            plot.getAxis("left").setWidth(48)
            line = pg.InfiniteLine(angle=90, movable=True, pen=pg.mkPen("#E69F00", width=2))
            line.setZValue(20)
            line.sigDragged.connect(lambda line: self._cursor_dragged(line))
            plot.addItem(line, ignoreBounds=True)
            self.cursor_lines.append(line)
        for row, height_px in enumerate((190, 160, 120)):
            self.graphs.ci.layout.setRowPreferredHeight(row, height_px)
            self.graphs.ci.layout.setRowStretchFactor(row, height_px)

    def _build_tables(self) -> None:
        self.table = Table(
            ("method", "now\n[mrad]", "rms\n[mrad]", "worst\n95 %", "worst\n[mrad]", "light\ncaught", "available")
        )
        self.table.explain(5, "Part of a perfect tracker's light, while on the receiver")
        self.table.explain(
            6, "Light caught over light offered in all modes: what stow, ways, calibrations and faults cost, too"
        )
        self.table.itemSelectionChanged.connect(self._method_chosen)
        self.story = Table(("", "solar time", "what happened"))
        self.story.verticalHeader().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.story.itemSelectionChanged.connect(self._happening_chosen)
        self.tables = QTabWidget()
        self.tables.addTab(self.table, "Methods")
        self.tables.addTab(self.story, "What happened")

    # -- what happens ------------------------------------------------------------------------------------

    def _on_opened(self) -> None:
        document = self.session.document
        self._picture = picture = None if document is None else document.track
        self.method.clear()
        for plot, curve in self._curves:
            plot.removeItem(curve)
        self._curves, self._picked = [], None
        self._clock.stop()
        if picture is None:
            return
        self.method.addItems(list(picture.methods))
        best = picture.track.ranking()[:1]
        if best:
            self.method.setCurrentText(best[0])
        self._draw_curves(picture)
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
        self._on_selected(self.session.selection)
        self._show_method()

    def _draw_curves(self, picture: TrackPicture) -> None:
        nights = np.flatnonzero(np.diff(picture.track.day)) + 1
        hours = np.insert(picture.hours, nights, np.nan)
        colours = method_colours(picture.track)
        for name in picture.methods:
            pen = pg.mkPen(colours[name], width=1.5)
            error, flux = (np.insert(each[name], nights, np.nan) for each in (picture.rms_mrad, picture.flux))
            if (error > 0.0).any():  # a path of nothing but NaN takes Qt down
                positive = np.where(error > 0.0, error, np.nan)
                curve = self.curve_plot.plot(hours, positive, pen=pen, name=name, connect="finite")
                self._curves.append((self.curve_plot, curve))
            if np.isfinite(flux).any():
                curve = self.flux_plot.plot(hours, flux, pen=pen, connect="finite")
                self._curves.append((self.flux_plot, curve))

    def _show_method(self) -> None:
        """Show what belongs to the chosen method and stays while time goes on."""
        picture, name = self._picture, self.method.currentText()
        if picture is None or not name:
            return
        self.legend_of_modes.show(picture.mode_counts(name, 0) if picture.n_instant else {})
        self.legend_of_modes.set_visible(picture.under_field_control)
        reach = picture.spot_limit_m[name]
        if np.isfinite(reach) and reach > 0.0:
            self.spot_plot.setRange(xRange=(-reach, reach), yRange=(-reach, reach), padding=0.05)
        self._tell_story(picture, name)
        self._draw()

    def _tell_story(self, picture: TrackPicture, name: str) -> None:
        """List what happened, and mark on the time axes what has its place there."""
        for plot, item in self._marks:
            plot.removeItem(item)
        self._marks = []
        happened = picture.happened[name]
        numbers = self._mark(picture, happened)
        several = len(picture.track.dates) > 1
        rows = []
        for each, number in zip(happened, numbers, strict=True):
            date = f"{picture.track.dates[each.day]} " if several else ""
            rows.append([number, f"{date}{clock(each.hour)}", each.text])
        self.story.fill(rows)
        self.story.warn([i for i, each in enumerate(happened) if each.trouble], self.theme.warning)
        self.tables.setTabVisible(1, bool(happened))

    def _mark(self, picture: TrackPicture, happened: tuple[FieldHappening, ...]) -> list[str]:
        """Draw a line for each happening, those close together as one, and return their numbers; empty: no line."""
        places = np.array([picture.place_h(each) if each.mark else np.nan for each in happened])
        order = [int(i) for i in np.argsort(places, kind="stable") if np.isfinite(places[i])]
        numbers = [""] * len(happened)
        together = groups([float(places[i]) for i in order], _MARK_ROOM * float(np.ptp(picture.hours)))
        for number, group in enumerate(together, start=1):
            members = [order[j] for j in group]
            for i in members:
                numbers[i] = str(number)
            text = "\n".join(f"{clock(happened[i].hour)} {happened[i].text}" for i in members)
            label = str(number) if len(together) <= _MOST_NUMBERS else ""
            self._add_mark(float(places[members[0]]), label, text, any(happened[i].trouble for i in members))
        return numbers

    def _add_mark(self, place_h: float, label: str, text: str, trouble: bool) -> None:
        colour = self.theme.warning if trouble else self.theme.muted
        for plot in (self.curve_plot, self.flux_plot):
            shown = label if plot is self.flux_plot else ""
            line = pg.InfiniteLine(
                place_h, angle=90, pen=pg.mkPen(colour, width=1, style=Qt.PenStyle.DotLine), label=shown or None,
                labelOpts={"position": 0.92, "color": colour, "movable": False},
            )  # fmt: skip
            line.setToolTip(text)
            plot.addItem(line, ignoreBounds=True)
            self._marks.append((plot, line))

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
        flux = np.concatenate([np.empty(0), *picture.flux.values()])
        top = float(np.max(flux, initial=1.0, where=np.isfinite(flux)))
        self.flux_plot.setYRange(0.0, 1.25 * top if picture.under_field_control else 1.05 * top, padding=0.0)

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
            self.choose_method(item.text())

    def _happening_chosen(self) -> None:
        """Go to when the chosen row happened."""
        picture, row = self._picture, self.story.currentRow()
        happened = () if picture is None else picture.happened[self.method.currentText()]
        if picture is None or not 0 <= row < len(happened):
            return
        place = picture.place_h(happened[row])
        if np.isfinite(place):
            self.session.playback.scrub(int(np.searchsorted(picture.hours, place - 1e-9)))

    def choose_method(self, name: str) -> None:
        """Show this method's mirrors."""
        self.method.setCurrentText(name)
        self._show_method()

    def pick(self, row: int) -> None:
        """Tell of this one of the drawn mirrors."""
        picture = self._picture
        if picture is None:
            return
        self._picked = row
        document = self.session.document
        known = () if document is None or document.scenario is None else document.scenario.heliostat_ids
        if picture.ids[row] in known:
            self.session.select(heliostat=known.index(picture.ids[row]))
        self._draw()

    def _on_selected(self, _: Selection) -> None:
        """Follow the heliostat that is selected elsewhere, if its course is kept."""
        picture, document, chosen = self._picture, self.session.document, self.session.selection.heliostat
        if picture is None or document is None or document.scenario is None or chosen is None:
            return
        name = document.scenario.heliostat_ids[chosen]
        row = picture.ids.index(name) if name in picture.ids else None
        if row is not None and row != self._picked:
            self._picked = row
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
        for line in self.cursor_lines:
            line.setValue(float(picture.hours[k]))
        self._draw_field(picture, name, picture.at(name, k))
        self.legend_of_modes.show(picture.mode_counts(name, k))
        self._draw_picked(picture, name, k)
        self._draw_table(picture, k, name)

    def _draw_field(self, picture: TrackPicture, name: str, now: Instant) -> None:
        colour = self.scale.colours(now.error_mrad, "error of the normal [mrad]", (0.0, picture.limit_mrad[name]))
        pivot = picture.pivot_enu_m
        size = float(np.clip(160.0 / np.sqrt(max(len(pivot), 1)), 3.0, 14.0))
        blank = np.where(now.on_receiver, colour, len(self.scale.table))
        self.dots.set_data(pivot[:, 0], pivot[:, 1], blank, [*self.scale.table, QColor(self.theme.plot)], size)
        self.away.setData(**away_marks(self.theme, pivot, now, size))
        extent = max(float(np.ptp(pivot[:, :2], axis=0).max()), 1.0) if len(pivot) else 1.0
        self.normals.setData(*segments(pivot, pivot + 0.08 * extent * now.normal_enu))
        every = max(1, len(pivot) // _BEAMS)
        self.beams.setData(*segments(pivot[::every], now.beam_end_enu_m[::every]))
        targets = np.unique(picture.target_enu_m[np.isfinite(picture.target_enu_m).all(axis=1)], axis=0)
        self.target.setData(targets[:, 0], targets[:, 1])
        spot = now.spot_m
        self.spots.set_data(spot[:, 0], spot[:, 1], colour, self.scale.table, min(size, 8.0))

    def _draw_picked(self, picture: TrackPicture, name: str, k: int) -> None:
        row = self._picked
        if row is None:
            self.ring.setData([], [])
            self.mirror_text.setText("Click a mirror to see what it does.")
            return
        self.ring.setData(picture.pivot_enu_m[row : row + 1, 0], picture.pivot_enu_m[row : row + 1, 1])
        self.mirror_text.setText(picture.mirror_text(name, k, row))

    def _draw_table(self, picture: TrackPicture, k: int, name: str) -> None:
        rows = picture.comparison(k)
        self.table.fill(
            [
                [
                    row[0],
                    *(f"{v:.3g}" if np.isfinite(v) else "–" for v in row[1:5]),
                    *(f"{100.0 * v:.2f} %" if np.isfinite(v) else "–" for v in row[5:]),
                ]
                for row in rows
            ]
        )
        names = [row[0] for row in rows]
        self.table.choose(names.index(name) if name in names else None)
