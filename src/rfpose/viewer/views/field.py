"""The field: plan and space, each mirror in the colour of what is asked, and all about the mirror that is chosen."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor
from PySide6.QtWidgets import (
    QComboBox,
    QHBoxLayout,
    QLabel,
    QSlider,
    QSplitter,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from rfpose.checks import FloatArray
from rfpose.drawing import PINK, SERIES, STATUS_COLOURS
from rfpose.multilat import PoseStatus
from rfpose.pipeline.pictures.field_view import FieldPicture, History, history
from rfpose.viewer.state.session import Selection, Session
from rfpose.viewer.theme import Theme
from rfpose.viewer.views.parts import PlanPlot, Scale, Table, View, plot_in, segments
from rfpose.viewer.views.space import Space
from rfpose.viewer.workers import Workers

__all__ = ["COLOURS", "FieldView"]

COLOURS = {
    "error": "error of the normal [mrad]",
    "sigma": "sigma of the normal [mrad]",
    "status": "status",
    "transmitters": "transmitters seen",
}
_ARROWS = {
    "normals": "normals",
    "errors": "errors of the normals",
    "residuals": "residuals of the chosen mirror",
    "none": "no vectors",
}
_MAX_TABLE = 200


class FieldView(View):
    """Where everything stands and how well each mirror is known."""

    name = "field"
    title = "Field"

    def __init__(self, session: Session, workers: Workers, theme: Theme) -> None:
        super().__init__(session, workers, theme)
        self.history: History | None = None
        self._build()
        self.listen(session.opened, self._on_opened)
        self.listen(session.selected, self._on_selected)
        self._on_opened()

    def applies(self) -> bool:
        """Tell whether the document says where things stand."""
        return self.session.document is not None and self.session.document.field is not None

    def _build(self) -> None:
        theme = self.theme
        self.colour = QComboBox()
        self.colour.activated.connect(lambda _: self._draw())
        self.arrows = QComboBox()
        for key, text in _ARROWS.items():
            self.arrows.addItem(text, key)
        self.arrows.activated.connect(lambda _: self._draw())
        self.frame = QSlider(Qt.Orientation.Horizontal)
        self.frame.valueChanged.connect(lambda value: self.session.select(frame=value))
        self.frame_label = QLabel()
        self.arrow_label = QLabel()
        bar = QHBoxLayout()
        for text, widget in (
            ("Colour", self.colour),
            ("Vectors", self.arrows),
            ("", self.arrow_label),
            ("Frame", self.frame),
            ("", self.frame_label),
        ):
            if text:
                bar.addWidget(QLabel(text))
            bar.addWidget(widget, 1 if widget is self.frame else 0)
        self.map = pg.GraphicsLayoutWidget()
        self.plan_plot = plot_in(self.map, theme, x="east [m]", y="north [m]")
        self.plan = PlanPlot(self.plan_plot, theme)
        self.plan.on_click(lambda i: self.session.select(heliostat=i))
        self.scale = Scale(self.map, theme)
        self.key = self.plan_plot.addLegend(offset=(8, 8), labelTextSize="8pt", brush=pg.mkBrush(theme.base))
        self.key.setVisible(False)
        self._key_items: list[Any] = []
        self.residuals = pg.PlotCurveItem(pen=pg.mkPen(PINK, width=2.5), connect="pairs")
        self.plan_plot.addItem(self.residuals)
        self.space_layout = pg.GraphicsLayoutWidget()
        self.space = Space(self.space_layout, theme)
        self._build_details()
        right = QSplitter(Qt.Orientation.Vertical)
        right.addWidget(self.space_layout)
        right.addWidget(self.details)
        right.setSizes([350, 350])
        split = QSplitter(Qt.Orientation.Horizontal)
        split.addWidget(self.map)
        split.addWidget(right)
        split.setSizes([700, 570])
        page = QVBoxLayout(self)
        page.addLayout(bar)
        page.addWidget(split, 1)

    def _build_details(self) -> None:
        theme = self.theme
        self.headline = QLabel("Click a mirror to see its poses.")
        self.headline.setWordWrap(True)
        graphs = pg.GraphicsLayoutWidget()
        self.offset_plot = plot_in(graphs, theme, x="time [s]", y=None)
        self.offset_plot.addLegend(offset=(-4, 2), labelTextSize="8pt", colCount=2)
        self.offset_curves = [
            self.offset_plot.plot(
                [], [], pen=pg.mkPen(colour, width=1.5), symbol="o", symbolSize=5, symbolBrush=colour, symbolPen=None,
                name=text,
            )
            for colour, text in ((theme.blue, "across (x)"), (SERIES[1], "up (y)"))
        ]  # fmt: skip
        self.band = [
            self.offset_plot.plot([], [], pen=pg.mkPen(theme.muted, width=1, style=Qt.PenStyle.DashLine))
            for _ in range(2)
        ]
        self.ellipse_plot = plot_in(graphs, theme, x=None, y=None, column=1)
        for plot, side, text in (
            (self.offset_plot, "left", "offset"),
            (self.ellipse_plot, "bottom", "across"),
            (self.ellipse_plot, "left", "up"),
        ):
            plot.setLabel(side, text, units="rad")
            plot.getAxis(side).enableAutoSIPrefix(True)
        self.ellipse_plot.setAspectLocked(True)
        self.ellipses = pg.PlotCurveItem(pen=pg.mkPen(theme.muted, width=1), connect="finite")
        self.ellipse_now = pg.PlotCurveItem(pen=pg.mkPen(SERIES[1], width=2))
        self.ellipse_dots = pg.ScatterPlotItem(size=6, pen=None, brush=theme.blue)
        for item in (self.ellipses, self.ellipse_now, self.ellipse_dots):
            self.ellipse_plot.addItem(item)
        residual = pg.GraphicsLayoutWidget()
        self.residual_plot = plot_in(residual, theme, x="transmitter", y="residual [mm]")
        self.residual_bars = pg.BarGraphItem(x=[0.0], height=[0.0], width=0.6, brush=theme.blue, pen=None)
        self.residual_sigma = pg.ErrorBarItem(
            x=np.empty(0), y=np.empty(0), height=np.empty(0), beam=0.3, pen=pg.mkPen(theme.trace, width=1.5)
        )
        self.residual_plot.addItem(self.residual_bars)
        self.residual_plot.addItem(self.residual_sigma)
        self.excluded = Table(("transmitter", "why it had no full part", "how often"))
        self.tabs = QTabWidget()
        self.tabs.addTab(graphs, "Pose over frames")
        self.tabs.addTab(residual, "Residuals")
        self.tabs.addTab(self.excluded, "Excluded")
        self.details = QWidget()
        column = QVBoxLayout(self.details)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.headline)
        column.addWidget(self.tabs, 1)

    # -- what happens ------------------------------------------------------------------------------------

    @property
    def _field(self) -> FieldPicture | None:
        document = self.session.document
        return None if document is None else document.field

    def _on_opened(self) -> None:
        field = self._field
        self.history = None
        self.colour.clear()
        for key, text in COLOURS.items():
            if field is None or field.n_frame == 0 or self._lacks(field, key):
                continue
            self.colour.addItem(text, key)
        self.colour.setEnabled(self.colour.count() > 0)
        self.frame.blockSignals(True)
        self.frame.setRange(0, max((field.n_frame if field else 0) - 1, 0))
        self.frame.setEnabled(field is not None and field.n_frame > 1)
        self.frame.blockSignals(False)
        self.plan.show_site(field)
        self._draw()
        if field is not None:
            self.plan_plot.vb.autoRange(padding=0.08)
        self._draw_history()

    def _lacks(self, field: FieldPicture, key: str) -> bool:
        if key == "error":
            return field.error_mrad is None
        document = self.session.document
        return document is None or document.result is None

    def _on_selected(self, before: Selection) -> None:
        now = self.session.selection
        if now.heliostat != before.heliostat:
            document = self.session.document
            self.history = None
            if document is not None and document.result is not None and now.heliostat is not None:
                result, index = document.result, now.heliostat
                self.workers.run("Poses of a mirror", lambda _: history(result, index), self._show_history)
            self._draw_history()
        elif now.frame != before.frame:
            self._draw_history()
        if (now.heliostat, now.frame, now.transmitter) != (before.heliostat, before.frame, before.transmitter):
            self._draw()

    # -- drawing -----------------------------------------------------------------------------------------

    def _draw(self) -> None:
        field, now = self._field, self.session.selection
        for item in self._key_items:
            self.key.removeItem(item)
        self._key_items = []
        if field is None:
            self.plan.dots.set_data(np.empty(0), np.empty(0), np.empty(0, np.int64), [], 8.0)
            self.plan.lines.setData([], [])
            self.residuals.setData([], [])
            self.plan.pick(None)
            self.space.show(None, np.empty((0, 3)), np.empty(0, np.int64), [])
            return
        frame = min(now.frame, max(field.n_frame - 1, 0))
        self.frame.blockSignals(True)
        self.frame.setValue(frame)
        self.frame.blockSignals(False)
        self.frame_label.setText(
            f"{frame + 1} of {field.n_frame}, {field.time[frame]}" if field.n_frame else "nothing measured"
        )
        colour, table = self._colours(field, frame)
        size = float(np.clip(160.0 / np.sqrt(max(len(field.pivot_enu_m), 1)), 3.0, 15.0))
        self.plan.dots.set_data(field.pivot_enu_m[:, 0], field.pivot_enu_m[:, 1], colour, table, size)
        arrow, text = self._arrow(field, frame)
        self.plan.lines.setData(*segments(field.pivot_enu_m, field.pivot_enu_m + arrow))
        self.arrow_label.setText(text)
        self._draw_residual_vectors(field, frame)
        self.plan.light_up(field, now.transmitter)
        chosen = now.heliostat
        self.plan.pick(None if chosen is None else field.pivot_enu_m[chosen])
        self.space.show(field, arrow, colour, table, heliostat=chosen, transmitter=now.transmitter)

    def _colours(self, field: FieldPicture, frame: int) -> tuple[npt.NDArray[np.int64], list[QColor]]:
        key, n = self.colour.currentData(), len(field.pivot_enu_m)
        self.scale.show(key in ("error", "sigma", "transmitters"))
        self.key.setVisible(key == "status")
        if key == "status":
            return self._status_colours(field.status[frame])
        values, every = np.full(n, np.nan), None
        if key == "error" and field.error_mrad is not None:
            values, every = field.error_mrad[frame], field.error_mrad
        elif key == "sigma":
            values, every = field.sigma_mrad[frame], field.sigma_mrad
        elif key == "transmitters":
            values, every = field.n_transmitter[frame].astype(np.float64), np.array([0.0, len(field.transmitter_ids)])
        known = every[np.isfinite(every)] if every is not None else np.empty(0)
        limits = (0.0 if key != "sigma" else float(known.min()), float(known.max())) if known.size else None
        return self.scale.colours(values, COLOURS.get(key, " "), limits), self.scale.table

    def _status_colours(self, status: npt.NDArray[np.int8]) -> tuple[npt.NDArray[np.int64], list[QColor]]:
        for code in np.unique(status):
            sample = pg.ScatterPlotItem(size=10, pen=None, brush=STATUS_COLOURS[int(code) % len(STATUS_COLOURS)])
            self.key.addItem(sample, f"{PoseStatus(int(code)).reason} ({int((status == code).sum())})"[:70])
            self._key_items.append(sample)
        return status.astype(np.int64) % len(STATUS_COLOURS), [QColor(c) for c in STATUS_COLOURS]

    def _arrow(self, field: FieldPicture, frame: int) -> tuple[FloatArray, str]:
        """Vectors from the mirrors (heliostat, xyz) [m], and what their length means."""
        n, kind = len(field.pivot_enu_m), self.arrows.currentData()
        nothing = np.full((n, 3), np.nan)
        if not field.n_frame or kind in ("none", "residuals"):
            return nothing, ""
        length = 0.10 * field.extent_m
        if kind == "errors":
            if field.error_enu is None:
                return nothing, "no truth known"
            error = field.error_enu[frame]
            known = np.linalg.norm(error, axis=1)
            known = known[np.isfinite(known)]
            if not known.size or known.max() == 0.0:
                return nothing, ""
            worst = float(known.max())
            return error * (length / worst), f"longest {1e3 * worst:.3g} mrad"
        return length * field.normal_enu[frame], ""

    def _draw_residual_vectors(self, field: FieldPicture, frame: int) -> None:
        """From the chosen mirror towards each transmitter, as long as its residual."""
        chosen = self.session.selection.heliostat
        if self.arrows.currentData() != "residuals" or chosen is None or self.history is None:
            self.residuals.setData([], [])
            if self.arrows.currentData() == "residuals":
                self.arrow_label.setText("choose a mirror")
            return
        residual = self.history.residual_mm[frame]
        place = field.pivot_enu_m[chosen]
        towards = field.transmitter_enu_m - place
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        known = residual[np.isfinite(residual)]
        worst = float(np.abs(known).max()) if known.size else 0.0
        if worst == 0.0:
            self.residuals.setData([], [])
            return
        tips = place + towards * (0.25 * field.extent_m / worst * residual)[:, None]
        self.residuals.setData(*segments(np.broadcast_to(place, tips.shape), tips))
        self.arrow_label.setText(f"longest {worst:.3g} mm; away from the transmitter: negative")

    def _show_history(self, found: History) -> None:
        self.history = found
        self._draw_history()
        self._draw()

    def _draw_history(self) -> None:
        document, now, found = self.session.document, self.session.selection, self.history
        for curve in (*self.offset_curves, *self.band, self.ellipses, self.ellipse_now, self.ellipse_dots):
            curve.setData([], [])
        self.residual_bars.setOpts(x=[0.0], height=[0.0], width=0.6)
        self.residual_sigma.setData(x=np.empty(0), y=np.empty(0), height=np.empty(0))
        if document is None or document.field is None or now.heliostat is None or found is None:
            self.excluded.fill([])
            self.headline.setText(self._hint())
            return
        name = document.field.heliostat_ids[now.heliostat]
        frame = min(now.frame, len(found.time_s) - 1)
        what = "measured − true normal" if found.has_truth else "measured normal − its mean"
        level = found.protection_level_mrad[frame]
        guarded = f", protection level {level:.3g} mrad" if np.isfinite(level) else ""
        self.headline.setText(
            f"<b>{name}</b>: azimuth {found.azimuth_deg[frame]:.4f}°, elevation {found.elevation_deg[frame]:.4f}°, "
            f"sigma {found.sigma_mrad[frame]:.3g} mrad of the normal{guarded}; {found.status[frame]}. "
            f"Below: {what}, 95 % ellipse."
        )
        for k, curve in enumerate(self.offset_curves):
            measured = np.isfinite(found.offset_mrad[:, k])
            curve.setData(found.time_s[measured], 1e-3 * found.offset_mrad[measured, k])
        known = np.isfinite(found.sigma_mrad)
        for sign, line in zip((1.0, -1.0), self.band, strict=True):
            line.setData(found.time_s[known], 1e-3 * sign * found.sigma_mrad[known])
        outlined = np.isfinite(found.ellipse_mrad).all(axis=(1, 2))
        outline = 1e-3 * np.pad(found.ellipse_mrad[outlined], ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
        self.ellipses.setData(outline[..., 0].ravel(), outline[..., 1].ravel())
        seen = np.isfinite(found.offset_mrad).all(axis=1)
        self.ellipse_dots.setData(1e-3 * found.offset_mrad[seen, 0], 1e-3 * found.offset_mrad[seen, 1])
        if np.isfinite(found.ellipse_mrad[frame]).all():
            self.ellipse_now.setData(1e-3 * found.ellipse_mrad[frame, :, 0], 1e-3 * found.ellipse_mrad[frame, :, 1])
        for plot in (self.offset_plot, self.ellipse_plot):
            plot.vb.autoRange(padding=0.1)
        (low, high) = self.offset_plot.viewRange()[1]
        self.offset_plot.setYRange(low, high + 0.2 * (high - low), padding=0.0)  # room for the key
        self._draw_residuals(document.field, found, frame)
        rows = [
            [item.transmitter_id, item.reason, f"{item.count} of {item.total} {item.unit}"]
            for item in found.exclusions[:_MAX_TABLE]
        ]
        rows += [["(receivers)", reason, str(count)] for reason, count in found.fix_reasons.items()]
        self.excluded.fill(rows or [["none", "all transmitters had full part", ""]])
        self.tabs.setTabText(2, f"Excluded ({len(found.exclusions)})")

    def _hint(self) -> str:
        document = self.session.document
        if document is None or document.field is None:
            return "Nothing to show: the recording brings no scenario."
        if not document.field.heliostat_ids:
            return "The scenario has no heliostats."
        if document.result is None:
            return "Only a result has poses: run `rfpose process` on the recording and open what it writes."
        return "Click a mirror to see its poses."

    def _draw_residuals(self, field: FieldPicture, found: History, frame: int) -> None:
        residual, sigma = found.residual_mm[frame], found.residual_sigma_mm[frame]
        x = np.arange(len(residual), dtype=np.float64)
        self.residual_bars.setOpts(x=x, height=np.nan_to_num(residual), width=0.6)
        known = np.isfinite(residual) & np.isfinite(sigma)
        self.residual_sigma.setData(x=x[known], y=residual[known], height=2.0 * sigma[known], beam=0.3)
        ticks = [(float(i), name) for i, name in enumerate(field.transmitter_ids)]
        self.residual_plot.getAxis("bottom").setTicks([ticks])
        self.residual_plot.vb.autoRange(padding=0.1)
