"""A small field tracked live: wind, dead transmitters, stopped motors and an emergency at the press of a button."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QShowEvent
from PySide6.QtWidgets import QComboBox, QHBoxLayout, QLabel, QPushButton, QSplitter, QVBoxLayout

from rfpose.drawing import PINK, VERMILION
from rfpose.viewer.models.live_track import LivePicture, LiveTrack
from rfpose.viewer.state.live import FACTORS, LiveRun
from rfpose.viewer.state.session import Session
from rfpose.viewer.theme import Theme
from rfpose.viewer.views.parts import Dots, Scale, Table, View, plot_in, segments
from rfpose.viewer.workers import Job, Workers

__all__ = ["LiveView"]

_TICK_MS = 100
_FIRST_STEPS = 60
"""Taken at once, so that the mirrors are on their target before anyone looks."""
_ERROR_MRAD = 3.0
"""Where the colours end: twice what a mirror in good order strays."""
_WORK = "Live"


class LiveView(View):
    """The scenario's first mirrors in closed radio loop, faster than the clock."""

    name = "live"
    title = "Live"

    def __init__(self, session: Session, workers: Workers, theme: Theme) -> None:
        super().__init__(session, workers, theme)
        self.live: LiveRun | None = None
        self._asked = False
        self._job: Job | None = None
        self._lines: list[Any] = []
        self._build()
        self._clock = QTimer(self, interval=_TICK_MS)
        self._clock.timeout.connect(self._tick)
        self._last = 0.0
        self.listen(session.opened, self._on_opened)

    def applies(self) -> bool:
        """Tell whether a scenario with heliostats is open."""
        document = self.session.document
        if document is None or document.kind != "scenario" or document.scenario is None:
            return False
        return bool(document.scenario.heliostat) and document.scenario.tracking.collector == "heliostat"

    def release(self) -> None:
        """Stop observing, and the clock."""
        self._clock.stop()
        super().release()

    def showEvent(self, event: QShowEvent) -> None:  # noqa: N802 -- Qt's name
        """Make the field ready when it is first looked at."""
        super().showEvent(event)
        if self.applies() and not self._asked:
            self.start()

    def _build(self) -> None:
        self.run_button = QPushButton("Run")
        self.run_button.clicked.connect(lambda: self.toggle())
        self.factor = QComboBox()
        for factor in FACTORS:
            self.factor.addItem(f"{factor:g} ×", factor)
        self.factor.setCurrentIndex(FACTORS.index(60.0))
        self.factor.activated.connect(lambda _: self._set_factor())
        self.moment = QLabel()
        self.gust_button = self._button("Wind gust", "gust")
        self.transmitter = QComboBox()
        self.kill_button = self._button("Kill transmitter", "kill_transmitter", self.transmitter)
        self.mirror = QComboBox()
        self.stop_button = self._button("Stop motors of", "stop_motor", self.mirror)
        self.emergency_button = self._button("Emergency stow", "emergency")
        self.normal_button = self._button("Back to normal", "normal")
        self.again_button = QPushButton("Anew")
        self.again_button.setToolTip("Begin again in the morning, undisturbed")
        self.again_button.clicked.connect(lambda: self.start())
        bar = QHBoxLayout()
        for widget in (
            self.run_button, self.factor, self.again_button, self.gust_button, self.kill_button, self.transmitter,
            self.stop_button, self.mirror, self.emergency_button, self.normal_button,
        ):  # fmt: skip
            bar.addWidget(widget)
        bar.addStretch(1)
        self.map = pg.GraphicsLayoutWidget()
        self.plan_plot = plot_in(self.map, self.theme, x="east [m]", y="north [m]")
        self.plan_plot.setAspectLocked(True)
        self.beams = pg.PlotCurveItem(pen=pg.mkPen(230, 159, 0, 120, width=1), connect="pairs")
        self.normals = pg.PlotCurveItem(pen=pg.mkPen(self.theme.trace, width=1.5), connect="pairs")
        self.dots = Dots(rim=self.theme.muted)
        self.target = pg.ScatterPlotItem(symbol="s", size=14, pen=pg.mkPen(self.theme.text), brush=PINK)
        self.masts = pg.ScatterPlotItem(symbol="t1", size=14)
        for item in (self.beams, self.normals, self.dots, self.target, self.masts):
            self.plan_plot.addItem(item)
        self.scale = Scale(self.map, self.theme)
        self.graphs = pg.GraphicsLayoutWidget()
        self.spot_plot = plot_in(self.graphs, self.theme, x="right of the aim point [m]", y="above [m]", row=0)
        self.spot_plot.setAspectLocked(True)
        self.spot_plot.setRange(xRange=(-4.0, 4.0), yRange=(-4.0, 4.0))
        for angle in (0, 90):
            line = pg.InfiniteLine(angle=angle, pen=pg.mkPen(self.theme.muted))
            self.spot_plot.addItem(line, ignoreBounds=True)
        self.spots = Dots(rim=self.theme.muted)
        self.spot_plot.addItem(self.spots, ignoreBounds=True)
        self.curve_plot = plot_in(self.graphs, self.theme, x="time [min]", y="rms error [mrad]", row=1)
        self.curve_plot.setLogMode(y=True)
        marks = [(np.log10(k) + d, f"{k * 10.0**d:g}") for d in range(-4, 4) for k in (1, 2, 5)]
        self.curve_plot.getAxis("left").setTicks([marks])
        self.curve = self.curve_plot.plot(pen=pg.mkPen(self.theme.trace, width=1.5), connect="finite")
        self.table = Table(("mirror", "does", "error\n[mrad]", "radio sigma\n[mrad]"))
        self.table.itemSelectionChanged.connect(self._mirror_chosen)
        right = QSplitter(Qt.Orientation.Vertical)
        right.addWidget(self.graphs)
        right.addWidget(self.table)
        right.setSizes([480, 220])
        split = QSplitter()
        split.addWidget(self.map)
        split.addWidget(right)
        split.setSizes([680, 590])
        page = QVBoxLayout(self)
        page.addLayout(bar)
        page.addWidget(self.moment)
        page.addWidget(split, 1)
        self._enable(False)

    def _button(self, text: str, what: str, choice: QComboBox | None = None) -> QPushButton:
        button = QPushButton(text)
        button.clicked.connect(lambda: self.disturb(what, "" if choice is None else choice.currentText()))
        return button

    def _enable(self, on: bool) -> None:
        for widget in (
            self.run_button, self.again_button, self.gust_button, self.kill_button, self.stop_button,
            self.emergency_button, self.normal_button,
        ):  # fmt: skip
            widget.setEnabled(on)

    # -- what happens ------------------------------------------------------------------------------------

    def _on_opened(self) -> None:
        self._clock.stop()
        self.workers.cancel(_WORK)
        self.live, self._asked, self._job = None, False, None
        self._enable(False)
        if self.isVisible() and self.applies():
            self.start()

    def start(self) -> None:
        """Make the field and let it settle on its target, in the background."""
        document = self.session.document
        if document is None or document.scenario is None:
            return
        scenario = document.scenario
        self._clock.stop()
        self._asked, self.live = True, None
        self._enable(False)
        self.again_button.setEnabled(True)
        self.moment.setText("making the field ready …")

        def work(on_progress: Any) -> tuple[LiveTrack, LivePicture | None]:
            track = LiveTrack(scenario)
            return track, track.advance(_FIRST_STEPS, on_progress)

        self._job = self.workers.run(_WORK, work, self._started, failed=self._failed)

    def _started(self, found: tuple[LiveTrack, LivePicture | None]) -> None:
        track, picture = found
        self.live = LiveRun(track)
        self.live.factor = float(self.factor.currentData())
        self.live.changed.connect(self._draw)
        self._job = None
        for box, names in ((self.transmitter, track.transmitter_ids), (self.mirror, track.ids)):
            box.clear()
            box.addItems(list(names))
        self._show_site(track)
        self._enable(True)
        self.live.take(picture)

    def _failed(self, text: str) -> None:
        self._job = None
        self.moment.setText("")
        self.session.tell(text, is_error=True)

    def toggle(self) -> None:
        """Run, or halt."""
        if self.live is not None:
            self._last = time.monotonic()
            self.live.toggle()

    def _set_factor(self) -> None:
        if self.live is not None:
            self.live.factor = float(self.factor.currentData())

    def disturb(self, what: str, name: str = "") -> None:
        """Disturb the field, which runs from then on."""
        if self.live is not None:
            self.live.disturb(what, name)
            if not self.live.running:
                self.toggle()

    def _tick(self) -> None:
        now = time.monotonic()
        elapsed, self._last = now - self._last, now
        if self.live is None:
            return
        if self._job is not None:
            if self._job.is_cancelled:  # by the window: time halts
                self._job = None
                self.live.toggle()
            return
        n = self.live.due(elapsed)
        if n:
            self.advance(n)

    def advance(self, n_step: int) -> None:
        """Take steps in the background."""
        live = self.live
        if live is None:
            return
        self._job = self.workers.run(
            _WORK, lambda tell: live.track.advance(n_step, tell), lambda p: self._stepped(live, p), failed=self._failed
        )

    def _stepped(self, live: LiveRun, picture: LivePicture | None) -> None:
        self._job = None
        live.take(picture)

    def _mirror_chosen(self) -> None:
        item = self.table.item(self.table.currentRow(), 0)
        if item is not None:
            self.mirror.setCurrentText(item.text())

    # -- drawing -----------------------------------------------------------------------------------------

    def _show_site(self, track: LiveTrack) -> None:
        for line in self._lines:
            self.curve_plot.removeItem(line)
        self._lines = []
        self.curve.setData([], [])
        targets = np.unique(track.target_enu_m, axis=0)
        self.target.setData(targets[:, 0], targets[:, 1])
        ground = np.concatenate([track.pivot_enu_m, track.target_enu_m, track.transmitter_enu_m])[:, :2]
        (x0, y0), (x1, y1) = ground.min(axis=0), ground.max(axis=0)
        pad = 0.08 * max(x1 - x0, y1 - y0, 1.0)
        self.plan_plot.setRange(xRange=(x0 - pad, x1 + pad), yRange=(y0 - pad, y1 + pad), padding=0.0)

    def _draw(self) -> None:
        live = self.live
        if live is None:
            return
        if live.running and not self._clock.isActive():
            self._clock.start()
        elif not live.running:
            self._clock.stop()
        self.run_button.setText("Halt" if live.running else "Run")
        if live.picture is None:
            return
        self._draw_field(live.track, live.picture)
        self._draw_curve(live)
        picture = live.picture
        off = f"; off the air: {', '.join(picture.dead)}" if picture.dead else ""
        end = "; the day is over" if picture.over else ""
        self.moment.setText(
            f"{picture.time.replace('T', ' ')} UTC, wind {picture.wind_mps:.1f} m/s, "
            f"rms error {live.rms_mrad[-1]:.3g} mrad of the normal{off}{end}"
        )

    def _draw_field(self, track: LiveTrack, picture: LivePicture) -> None:
        now, pivot = picture.instant, track.pivot_enu_m
        colour = self.scale.colours(now.error_mrad, "error of the normal [mrad]", (0.0, _ERROR_MRAD))
        self.dots.set_data(pivot[:, 0], pivot[:, 1], colour, self.scale.table, 13.0)
        extent = max(float(np.ptp(pivot[:, :2], axis=0).max()), 1.0)
        self.normals.setData(*segments(pivot, pivot + 0.08 * extent * now.normal_enu))
        self.beams.setData(*segments(pivot, now.beam_end_enu_m))
        self.spots.set_data(now.spot_m[:, 0], now.spot_m[:, 1], colour, self.scale.table, 8.0)
        places = track.transmitter_enu_m
        brush = [pg.mkBrush(self.theme.muted if n in picture.dead else VERMILION) for n in track.transmitter_ids]
        self.masts.setData(x=places[:, 0], y=places[:, 1], brush=brush)
        rows = zip(track.ids, picture.mode, now.error_mrad, picture.sigma_mrad, strict=True)
        self.table.fill([[name, does, f"{error:.3g}", f"{sigma:.3g}"] for name, does, error, sigma in rows])

    def _draw_curve(self, live: LiveRun) -> None:
        values = np.array(live.rms_mrad)
        seen = np.isfinite(values) & (values > 0.0)
        if seen.any():  # a path of nothing but NaN takes Qt down
            self.curve.setData(np.array(live.seconds) / 60.0, np.where(seen, values, np.nan))
        for second, text in live.marks[len(self._lines) :]:
            line = pg.InfiniteLine(
                second / 60.0, angle=90, pen=pg.mkPen(VERMILION, style=Qt.PenStyle.DashLine), label=text,
                labelOpts={"position": 0.95, "color": self.theme.text, "rotateAxis": (1, 0), "anchors": [(1, 0)] * 2},
            )  # fmt: skip
            self.curve_plot.addItem(line, ignoreBounds=True)
            self._lines.append(line)
