"""The recording: spectrum, waterfall, analytic tone, phases over frames, health of each line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QRectF, Qt, QTimer
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QHBoxLayout,
    QLabel,
    QSlider,
    QSplitter,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from rfpose.drawing import COLOUR_MAP, SERIES
from rfpose.errors import RfposeError
from rfpose.pipeline.pictures.spectra import (
    FrameLook,
    PhaseTrack,
    Spectrum,
    Waterfall,
    line_health,
    look_at_frame,
    losses,
    phase_track,
    phases_of,
    spectrum,
    waterfall,
)
from rfpose.recording import describe
from rfpose.viewer.state.document import Document
from rfpose.viewer.state.session import Selection, Session
from rfpose.viewer.theme import Theme
from rfpose.viewer.views.parts import PlanPlot, Table, View, plot_in
from rfpose.viewer.workers import Workers

__all__ = ["RecordingView"]

_REDRAW_MS = 120
_TRACK_FRAMES = 100
_PICK_PX = 12.0


class RecordingView(View):
    """What one receiver recorded, and what is made of it."""

    name = "recording"
    title = "Recording"

    def __init__(self, session: Session, workers: Workers, theme: Theme) -> None:
        super().__init__(session, workers, theme)
        self.spectrum: Spectrum | None = None
        self.waterfall: Waterfall | None = None
        self.look: FrameLook | None = None
        self.track: PhaseTrack | None = None
        self._summary: dict[str, Any] | None = None
        self._rest_waits = False
        self._marks: list[Any] = []
        self._refine = QTimer(self, singleShot=True, interval=_REDRAW_MS)
        self._refine.timeout.connect(self._refine_waterfall)
        self._build()
        self.listen(session.opened, self._on_opened)
        self.listen(session.selected, self._on_selected)
        self._on_opened()

    def applies(self) -> bool:
        """Tell whether there is a recording, or a result with its phases."""
        document = self.session.document
        return document is not None and (document.recording is not None or document.result is not None)

    # -- building ----------------------------------------------------------------------------------------

    def _build(self) -> None:
        self.receiver = QComboBox()
        self.receiver.setToolTip("Receiver")
        self.receiver.activated.connect(lambda: self.session.select(receiver=self.receiver.currentText()))
        self.frame = QSlider(Qt.Orientation.Horizontal)
        self.frame.setToolTip("Frame whose spectrum and phases are shown")
        self.frame.valueChanged.connect(lambda value: self.session.select(frame=value))
        self.frame_label = QLabel()
        self.frame_label.setMinimumWidth(120)
        self.transmitter = QComboBox()
        self.transmitter.activated.connect(lambda i: self.session.select(transmitter=i))
        self.reference = QComboBox()
        self.reference.activated.connect(lambda i: self.session.select(reference=i))
        self.tone = QComboBox()
        self.tone.activated.connect(lambda i: self.session.select(tone=i))
        self.corrected = QCheckBox("calibrated")
        self.corrected.setToolTip("Take the transmitters' own phases off, as the calibration receivers tell them")
        self.corrected.setChecked(True)
        self.corrected.toggled.connect(lambda: self._draw_track())
        bar = QHBoxLayout()
        for text, widget in (
            ("Receiver", self.receiver),
            ("Frame", self.frame),
            ("", self.frame_label),
            ("Transmitter", self.transmitter),
            ("less", self.reference),
            ("Tone", self.tone),
            ("", self.corrected),
        ):
            if text:
                bar.addWidget(QLabel(text))
            bar.addWidget(widget, 1 if widget is self.frame else 0)
        self._build_plots()
        self.line_table = Table(("", "carrier\n[dBFS]", "carrier\nSNR [dB]", "tone σ\n[mrad]", "status"))
        self.line_table.itemSelectionChanged.connect(self._line_chosen)
        self.receiver_table = Table(("", "level\n[dBFS]", "clipped", "gaps", "samples\nlost", "blocks"))
        self.receiver_table.itemSelectionChanged.connect(self._receiver_chosen)
        self.frame_facts = QLabel()
        self.frame_facts.setWordWrap(True)
        self.tables = QTabWidget()
        self.tables.addTab(self.line_table, "Transmitters")
        self.tables.addTab(self.receiver_table, "Receivers")
        right = QSplitter(Qt.Orientation.Vertical)
        right.addWidget(self.side)
        below = QWidget()
        column = QVBoxLayout(below)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.frame_facts)
        column.addWidget(self.tables)
        right.addWidget(below)
        right.setSizes([470, 240])
        split = QSplitter(Qt.Orientation.Horizontal)
        split.addWidget(self.graphs)
        split.addWidget(right)
        split.setSizes([800, 470])
        page = QVBoxLayout(self)
        page.addLayout(bar)
        page.addWidget(split, 1)

    def _build_plots(self) -> None:
        theme = self.theme
        self.graphs = pg.GraphicsLayoutWidget()
        self.spectrum_plot = plot_in(self.graphs, theme, x="frequency from the centre [MHz]", y="power [dBFS]", row=0)
        self.spectrum_curve = pg.PlotCurveItem(pen=pg.mkPen(theme.trace, width=1), antialias=False)
        self.spectrum_plot.addItem(self.spectrum_curve)
        self.carriers = pg.ScatterPlotItem(symbol="t", size=11, pen=None, brush=theme.blue)
        self.sidebands = pg.ScatterPlotItem(symbol="o", size=6, pen=None, brush=SERIES[1])
        for item, text in ((self.carriers, "carrier"), (self.sidebands, "sideband")):
            self.spectrum_plot.addItem(item)
            item.setToolTip(text)
        self.chosen_line = pg.InfiniteLine(angle=90, pen=pg.mkPen("#E69F00", width=2))
        self.chosen_line.setVisible(False)
        self.spectrum_plot.addItem(self.chosen_line, ignoreBounds=True)
        self.spectrum_plot.scene().sigMouseClicked.connect(self._spectrum_clicked)
        self.waterfall_plot = plot_in(self.graphs, theme, x="frequency from the centre [MHz]", y="frame", row=1)
        self.waterfall_image = pg.ImageItem(axisOrder="row-major")
        self.waterfall_image.setColorMap(pg.colormap.get(COLOUR_MAP))
        self.waterfall_plot.addItem(self.waterfall_image)
        self.waterfall_plot.setXLink(self.spectrum_plot)
        self.waterfall_plot.sigRangeChanged.connect(lambda *_: self._refine.start())
        self.frame_line = pg.InfiniteLine(angle=0, pen=pg.mkPen("#E69F00", width=1.5))
        self.waterfall_plot.addItem(self.frame_line, ignoreBounds=True)
        self.phase_plot = plot_in(self.graphs, theme, x="time from the first sample [s]", y=None, row=2)
        self.phase_plot.setLabel("left", "phase − mean", units="rad")
        self.phase_plot.getAxis("left").enableAutoSIPrefix(True)
        self.phase_bars = pg.ErrorBarItem(x=np.empty(0), y=np.empty(0), height=np.empty(0), beam=0.0)
        self.phase_curve = pg.PlotDataItem(
            pen=pg.mkPen(theme.blue, width=1.5), symbol="o", symbolSize=6, symbolPen=None
        )
        self.phase_curve.setSymbolBrush(theme.blue)
        self.phase_plot.addItem(self.phase_bars)
        self.phase_plot.addItem(self.phase_curve)
        self.gaps = pg.PlotCurveItem(pen=pg.mkPen(theme.muted, width=6), connect="pairs")
        self.graphs.ci.layout.setRowStretchFactor(0, 4)
        self.graphs.ci.layout.setRowStretchFactor(1, 3)
        self.graphs.ci.layout.setRowStretchFactor(2, 3)
        for plot in (self.spectrum_plot, self.waterfall_plot, self.phase_plot):
            plot.getAxis("left").setWidth(58)
        self.side = pg.GraphicsLayoutWidget()
        self.plan_plot = plot_in(self.side, theme, x="east [m]", y="north [m]", row=0)
        self.plan = PlanPlot(self.plan_plot, theme)
        self.circle_plot = plot_in(self.side, theme, x="in phase (carrier's mean = 1)", y="quadrature", row=1)
        self.circle_plot.setAspectLocked(True)
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        self.circle_plot.addItem(pg.PlotCurveItem(np.cos(turn), np.sin(turn), pen=pg.mkPen(theme.grid, width=1)))
        self.circle = pg.ScatterPlotItem(size=4, pen=None, brush=pg.mkBrush(theme.blue))
        self.circle_plot.addItem(self.circle)

    # -- what happens ------------------------------------------------------------------------------------

    def _on_opened(self) -> None:
        document = self.session.document
        self.spectrum = self.waterfall = self.look = self.track = self._summary = None
        self._fill_controls(document)
        field = None if document is None else document.field
        self.plan.show_site(field)
        if field is not None:
            n = len(field.pivot_enu_m)
            grey = [pg.mkColor(self.theme.muted)]
            east, north = field.pivot_enu_m[:, 0], field.pivot_enu_m[:, 1]
            self.plan.dots.set_data(east, north, np.zeros(n, np.int64), grey, 6.0)
        self.line_table.fill([])
        self.receiver_table.fill([])
        self._draw_spectrum()
        self._draw_waterfall()
        self._draw_look()
        self._draw_track()
        if document is None or not self.applies():
            return
        self._rest_waits = document.recording is not None
        if document.recording is not None:
            starts = document.frame_start_index
            rate_hz = float(document.recording.sample_rate)
            self.spectrum_plot.setXRange(-0.5e-6 * rate_hz, 0.5e-6 * rate_hz, padding=0.01)
            self.waterfall_plot.setYRange(0.0, float(len(starts)), padding=0.0)
            self._refine.stop()
            self._load_spectrum()
        else:
            self._load_receiver()
        self._mark_selection()

    def _load_rest(self) -> None:
        """After the first picture of a recording: everything that takes longer."""
        document = self.session.document
        if not self._rest_waits or document is None or document.recording is None:
            return
        self._rest_waits = False
        self._refine.start()
        self._load_look()
        self._load_receiver()
        self._load_levels(document)

    def _fill_controls(self, document: Document | None) -> None:
        scenario = None if document is None else document.scenario
        names = () if document is None else document.receiver_ids
        transmitters = () if scenario is None else scenario.transmitter_ids
        tones = () if scenario is None else tuple(f"{1e-3 * f:.6g} kHz" for f in scenario.tone_hz)
        for box, items in (
            (self.receiver, names),
            (self.transmitter, transmitters),
            (self.reference, transmitters),
            (self.tone, tones),
        ):
            box.blockSignals(True)
            box.clear()
            box.addItems(list(items))
            box.setEnabled(bool(items))
            box.blockSignals(False)
        self.frame.blockSignals(True)
        self.frame.setRange(0, max((document.n_frame if document else 0) - 1, 0))
        self.frame.setEnabled(document is not None and document.n_frame > 1)
        self.frame.blockSignals(False)
        self.corrected.setEnabled(scenario is not None and bool(scenario.calibration_receiver))

    def _on_selected(self, before: Selection) -> None:
        now = self.session.selection
        if not self.applies():
            return
        if now.receiver != before.receiver:
            self._load_receiver()
            self._refine.start()
        if now.receiver != before.receiver or now.frame != before.frame:
            self._load_spectrum()
            self._load_look()
        if (now.transmitter, now.reference, now.tone) != (before.transmitter, before.reference, before.tone):
            self._draw_look()
            self._draw_track()
        self._mark_selection()

    def _mark_selection(self) -> None:
        document, now = self.session.document, self.session.selection
        if document is None:
            return
        if now.receiver is not None:
            self.receiver.setCurrentText(now.receiver)
            self.receiver_table.choose(self.receiver.currentIndex())
        for box, index in ((self.transmitter, now.transmitter), (self.reference, now.reference), (self.tone, now.tone)):
            box.setCurrentIndex(-1 if index is None else index)
        self.frame.blockSignals(True)
        self.frame.setValue(now.frame)
        self.frame.blockSignals(False)
        self.frame_label.setText(f"{now.frame + 1} of {document.n_frame}")
        self.frame_line.setPos(now.frame + 0.5)
        if document.field is not None:
            self.plan.light_up(document.field, now.transmitter)
        self.line_table.choose(now.transmitter)
        self.chosen_line.setVisible(now.transmitter is not None and document.scenario is not None)
        if now.transmitter is not None and document.scenario is not None:
            self.chosen_line.setPos(1e-6 * float(document.scenario.carrier_hz[now.transmitter]))

    def _spectrum_clicked(self, event: Any) -> None:
        """Choose the transmitter whose line is nearest to the click."""
        if self.spectrum is None or not self.spectrum.line_hz.size:
            return
        plot = self.spectrum_plot
        if event.button() != Qt.MouseButton.LeftButton or not plot.sceneBoundingRect().contains(event.scenePos()):
            return
        x_mhz = plot.vb.mapSceneToView(event.scenePos()).x()
        away_px = np.abs(1e-6 * self.spectrum.line_hz - x_mhz) / plot.vb.viewPixelSize()[0]
        nearest = int(np.argmin(away_px.min(axis=1)))
        if away_px[nearest].min() <= _PICK_PX:
            self.session.select(transmitter=nearest)

    def _line_chosen(self) -> None:
        if self.line_table.currentRow() >= 0:
            self.session.select(transmitter=self.line_table.currentRow())

    def _receiver_chosen(self) -> None:
        row = self.receiver_table.currentRow()
        if row >= 0 and self.receiver.itemText(row):
            self.session.select(receiver=self.receiver.itemText(row))

    # -- work --------------------------------------------------------------------------------------------

    def _frame_start(self) -> int | None:
        """First sample of the frame that is looked at; None where there is none."""
        document = self.session.document
        if document is None or document.recording is None or not len(document.frame_start_index):
            return None
        starts = document.frame_start_index
        return int(starts[min(self.session.selection.frame, len(starts) - 1)])

    def _load_spectrum(self) -> None:
        document, receiver, start = self.session.document, self.session.selection.receiver, self._frame_start()
        if document is None or document.recording is None or receiver is None or start is None:
            return
        recording, scenario, count = document.recording, document.scenario, document.frame_samples
        self.workers.run(
            "Spectrum",
            lambda _: spectrum(recording, receiver, start, count, scenario=scenario),
            self._show_spectrum,
            failed=self._spectrum_failed,
        )

    def _spectrum_failed(self, text: str) -> None:
        self.session.tell(text, is_error=True)
        self._load_rest()

    def _load_look(self) -> None:
        document, receiver, start = self.session.document, self.session.selection.receiver, self._frame_start()
        if document is None or document.recording is None or receiver is None or start is None:
            return
        recording, scenario = document.recording, document.scenario
        if scenario is not None and receiver in scenario.receiver_ids:
            self.workers.run(
                "Demodulating", lambda _: look_at_frame(recording, scenario, receiver, start), self._show_look
            )
        else:
            self._show_look(None)

    def _load_receiver(self) -> None:
        document, now = self.session.document, self.session.selection
        if document is None or now.receiver is None or document.scenario is None:
            return
        scenario, receiver, result, recording = document.scenario, now.receiver, document.result, document.recording
        if receiver not in scenario.receiver_ids:
            self._show_track(None)
        elif result is not None:
            first = int(result.frame_start_index[0]) if len(result.frame_start_index) else 0
            self._show_track(phases_of(result.tones, result.calibration, receiver, scenario, first_index=first))
        elif recording is not None:
            self.workers.run(
                "Phases over frames",
                lambda tell: phase_track(recording, scenario, receiver, n_frame=_TRACK_FRAMES, on_progress=tell),
                self._show_track,
            )

    def _load_levels(self, document: Document) -> None:
        recording = document.recording
        assert recording is not None
        self.workers.run("Levels", lambda _: describe(recording), self._show_levels)

    def _refine_waterfall(self) -> None:
        """Read what the waterfall shows now, at the resolution of the screen."""
        document, now = self.session.document, self.session.selection
        if (
            document is None
            or document.recording is None
            or now.receiver is None
            or not len(document.frame_start_index)
        ):
            return
        recording, receiver = document.recording, now.receiver
        (x_low, x_high), (y_low, y_high) = self.waterfall_plot.viewRange()
        half_hz = 0.5 * float(recording.sample_rate)
        band_hz = (max(1e6 * x_low, -half_hz), min(1e6 * x_high, half_hz))
        n_frame = float(len(document.frame_start_index))
        span = (max(y_low, 0.0), min(y_high, n_frame))
        if span[1] <= span[0] or band_hz[1] <= band_hz[0]:
            return
        box = self.waterfall_plot.vb.screenGeometry()
        size = (max(16, min(box.height(), 400)), max(64, min(box.width(), 2000))) if box is not None else (200, 800)
        self.workers.run(
            "Waterfall",
            lambda tell: waterfall(
                recording,
                receiver,
                document.frame_start_index,
                document.frame_samples,
                span=span,
                band_hz=band_hz,
                n_row=size[0],
                n_column=size[1],
                on_progress=tell,
            ),
            self._show_waterfall,
        )

    # -- drawing -----------------------------------------------------------------------------------------

    def _show_spectrum(self, found: Spectrum | None) -> None:
        self.spectrum = found
        self._draw_spectrum()
        self._load_rest()

    def _draw_spectrum(self) -> None:
        for mark in self._marks:
            self.spectrum_plot.removeItem(mark)
        self._marks = []
        found = self.spectrum
        if found is None:
            self.spectrum_curve.setData([], [])
            for item in (self.carriers, self.sidebands):
                item.setData([], [])
            self.spectrum_plot.setTitle("no samples in this frame" if self._has_frames() else None)
            return
        key = "&nbsp;&nbsp;".join(
            f'<span style="color:{colour}">{text}</span>'
            for colour, text in ((self.theme.blue, "▼ carrier"), (SERIES[1], "● sideband"))
        )
        self.spectrum_plot.setTitle(key if found.line_hz.size else None, size="9pt", color=self.theme.muted)
        self.spectrum_plot.setLabel("left", "power [dBFS]" if found.full_scale else "power [dB of one count²]")
        self.spectrum_curve.setData(1e-6 * found.frequency_hz, found.power_db)
        top = float(found.power_db.max())
        floor = float(np.percentile(found.power_db, 5))
        self.spectrum_plot.setYRange(floor - 5.0, top + 0.22 * (top - floor) + 8.0, padding=0.0)
        if not found.line_hz.size:
            return
        lift = 0.015 * (top - floor) + 1.0
        line_mhz = 1e-6 * found.line_hz
        self.carriers.setData(line_mhz[:, 0], found.line_db[:, 0] + 2.0 * lift)
        self.sidebands.setData(line_mhz[:, 1:].ravel(), found.line_db[:, 1:].ravel() + lift)
        document = self.session.document
        scenario = None if document is None else document.scenario
        if scenario is None:
            return
        for name, x, y in zip(scenario.transmitter_ids, line_mhz[:, 0], found.line_db[:, 0], strict=True):
            mark = pg.TextItem(name, color=self.theme.text, anchor=(0.5, 1.0))
            mark.setPos(float(x), float(y) + 3.5 * lift)
            self.spectrum_plot.addItem(mark, ignoreBounds=True)
            self._marks.append(mark)

    def _has_frames(self) -> bool:
        document = self.session.document
        return document is not None and document.recording is not None and not self.workers_busy("Spectrum")

    def workers_busy(self, key: str) -> bool:
        """Tell whether a job of this name is under way."""
        return any(job.name == key for job in self.workers.jobs)

    def _show_waterfall(self, found: Waterfall) -> None:
        self.waterfall = found
        self._draw_waterfall()

    def _draw_waterfall(self) -> None:
        found = self.waterfall
        if found is None:
            self.waterfall_image.clear()
            return
        known = found.power_db[np.isfinite(found.power_db)]
        low, high = np.percentile(known, [5.0, 99.8]) if known.size else (0.0, 1.0)
        self.waterfall_image.setImage(found.power_db, levels=(float(low), max(float(high), float(low) + 1.0)))
        (x0, x1), (y0, y1) = found.band_hz, found.span
        self.waterfall_image.setRect(QRectF(1e-6 * x0, y0, 1e-6 * (x1 - x0), y1 - y0))

    def _show_look(self, found: FrameLook | None) -> None:
        self.look = found
        self._draw_look()

    def _draw_look(self) -> None:
        document, now = self.session.document, self.session.selection
        self.circle.setData([], [])
        self.circle_plot.setTitle("analytic tone", size="9pt", color=self.theme.muted)
        if self.look is None or document is None or document.scenario is None or document.recording is None:
            self.frame_facts.setText("")
            self.line_table.fill([])
            return
        tones, scenario = self.look.tones, document.scenario
        rows = line_health(tones, scenario.transmitter_ids, document.recording.full_scale)
        self.line_table.fill(
            [
                [
                    row.transmitter_id,
                    f"{row.carrier_db:.1f}",
                    f"{row.carrier_snr_db:.1f}",
                    ", ".join(f"{s:.3g}" for s in row.tone_sigma_mrad),
                    row.reason,
                ]
                for row in rows
            ]
        )
        self.line_table.choose(now.transmitter)
        clock = (
            f"clock {tones.clock_ppm:+.4f} ± {tones.clock_sigma_ppm:.2g} ppm"
            if np.isfinite(tones.clock_ppm)
            else "clock not found"
        )
        clipped = f"{100.0 * tones.clipped_fraction:.3g} % clipped" if np.isfinite(tones.clipped_fraction) else ""
        bad = [row.transmitter_id for row in rows if row.reason != "measured"]
        missing = f"not measured: {', '.join(bad)}" if bad else "all transmitters measured"
        self.frame_facts.setText("   ".join(part for part in (clock, clipped, missing) if part))
        shown = now.transmitter if now.transmitter is not None else 0
        if self.look.analytic.shape[-1] and shown < len(self.look.analytic):
            points = self.look.analytic[shown, now.tone]
            self.circle.setData(points.real, points.imag)
            self.circle_plot.setTitle(
                f"analytic tone of {scenario.transmitter_ids[shown]}", size="9pt", color=self.theme.muted
            )
            self.circle_plot.setRange(xRange=(-1.25, 1.25), yRange=(-1.25, 1.25), padding=0.0)

    def _show_track(self, found: PhaseTrack | None) -> None:
        self.track = found
        self._draw_track()

    def _draw_track(self) -> None:
        document, now = self.session.document, self.session.selection
        self.phase_curve.setData([], [])
        self.phase_bars.setData(x=np.empty(0), y=np.empty(0), height=np.empty(0))
        if self.track is None or document is None or document.scenario is None:
            self.phase_plot.setTitle(None)
            return
        transmitter = now.transmitter if now.transmitter is not None else 0
        if transmitter == now.reference and len(document.scenario.transmitter) > 1:
            transmitter = 1 if now.reference == 0 else 0
        corrected = self.corrected.isChecked() and self.corrected.isEnabled()
        mean, phase, sigma = self.track.difference(transmitter, now.reference, now.tone, corrected=corrected)
        names = document.scenario.transmitter_ids
        known = np.isfinite(phase)
        x = self.track.time_s
        self.phase_curve.setData(x[known], phase[known])
        self.phase_bars.setData(
            x=x[known],
            y=phase[known],
            height=2.0 * np.nan_to_num(sigma[known]),
            beam=0.0,
            pen=pg.mkPen(self.theme.blue, width=1),
        )
        how = "calibrated" if corrected else "as received"
        lost = f", {int((~known).sum())} of {len(phase)} frames not measured" if not known.all() else ""
        worst = f", σ up to {1e3 * float(np.nanmax(sigma)):.3g} mrad" if np.isfinite(sigma).any() else ""
        self.phase_plot.setTitle(
            f"{names[transmitter]} − {names[now.reference]}, {how}: mean {mean:.5f} rad{worst}{lost}",
            size="9pt",
            color=self.theme.muted,
        )

    def _show_levels(self, summary: dict[str, Any]) -> None:
        self._summary = summary
        document = self.session.document
        if document is None or document.recording is None:
            return
        rows = []
        for name, entry in summary["receivers"].items():
            if not entry.get("readable"):
                rows.append([name, "unreadable", "", "", "", ""])
                continue
            level, clipped = entry.get("rms_dbfs"), entry.get("clipped_fraction")
            try:
                gaps, lost = losses(document.recording, name)
            except RfposeError:
                gaps = lost = 0
            rows.append(
                [
                    name,
                    "–" if level is None else f"{level:.1f}",
                    "–" if clipped is None else f"{100.0 * clipped:.3g} %",
                    str(gaps),
                    str(lost),
                    str(entry.get("blocks", 0)),
                ]
            )
        self.receiver_table.fill(rows)
        if summary["problems"] and self.session.message is None:
            more = f" (and {len(summary['problems']) - 1} more)" if len(summary["problems"]) > 1 else ""
            self.session.tell(f"{summary['problems'][0]}{more}")
        self._mark_selection()
