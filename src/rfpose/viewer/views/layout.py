"""The layout: drag transmitters and watch what every mirror's normal can be known to."""

from __future__ import annotations

from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pyqtgraph as pg
from PySide6.QtCore import QDateTime, Qt, QTimeZone
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QDateTimeEdit,
    QDoubleSpinBox,
    QFileDialog,
    QFormLayout,
    QGridLayout,
    QGroupBox,
    QHBoxLayout,
    QLabel,
    QProgressBar,
    QPushButton,
    QScrollArea,
    QSlider,
    QSpinBox,
    QSplitter,
    QVBoxLayout,
    QWidget,
)

from rfpose.drawing import VERMILION
from rfpose.errors import RfposeError
from rfpose.files import write_atomically
from rfpose.viewer.models.live_layout import (
    ESTIMATOR_NAMES,
    OPTIMISED,
    LiveLayout,
    LiveMap,
    SunPlace,
    field_from_csv,
    place_transmitters,
    sun_of,
)
from rfpose.viewer.state.layout_edit import LayoutEdit
from rfpose.viewer.state.session import Session
from rfpose.viewer.theme import Theme, see_through
from rfpose.viewer.views.parts import Dots, Scale, View, keep_axes, plot_in
from rfpose.viewer.workers import Workers

__all__ = ["LayoutView"]

_POSTURES = (("scenario", "as in the scenario"), ("sun", "reflecting the sun"), ("level", "level"))
_HEIGHT_STEPS = 1000
_PICK_PX = 16.0


class LayoutView(View):
    """Transmitters as handles over the map of the field."""

    name = "layout"
    title = "Layout"

    def __init__(self, session: Session, workers: Workers, theme: Theme) -> None:
        super().__init__(session, workers, theme)
        self.map: LiveMap | None = None
        self.chosen: str | None = None
        self._engine: LiveLayout | None = None
        self._edit: LayoutEdit | None = None
        self._busy = self._again = self._filling = False
        self._handles: dict[str, Any] = {}
        self._limits: tuple[float, float] | None = None
        self._build()
        self.listen(session.opened, self._on_opened)
        self._edit_connections: list[Any] = []
        self._on_opened()

    def applies(self) -> bool:
        """Tell whether there is a scenario."""
        return self.session.layout is not None

    def release(self) -> None:
        """Stop observing."""
        super().release()
        self._leave_edit()

    def _leave_edit(self) -> None:
        while self._edit_connections:
            self._edit_connections.pop()()

    # -- building ----------------------------------------------------------------------------------------

    def _build(self) -> None:
        theme = self.theme
        self.graphs = pg.GraphicsLayoutWidget()
        self.plot = plot_in(self.graphs, theme, x="east [m]", y="north [m]")
        self.plot.setAspectLocked(True)
        keep_axes(self.plot)
        self.dots = Dots(rim=theme.muted)
        self.plot.addItem(self.dots)
        self.worst = pg.ScatterPlotItem(size=20, pen=pg.mkPen(VERMILION, width=2.5), brush=None)
        self.plot.addItem(self.worst)
        self.plot.scene().sigMouseClicked.connect(self._clicked)
        self.scale = Scale(self.graphs, theme)
        self.figures = QLabel()
        self.figures.setTextFormat(Qt.TextFormat.RichText)
        self.figures.setWordWrap(True)
        panel = QWidget()
        column = QVBoxLayout(panel)
        column.addWidget(self.figures)
        column.addWidget(self._build_transmitter())
        column.addWidget(self._build_choice())
        column.addWidget(self._build_optimiser())
        column.addLayout(self._build_files())
        column.addStretch(1)
        scroll = QScrollArea()
        scroll.setWidget(panel)
        scroll.setWidgetResizable(True)
        scroll.setMinimumWidth(panel.minimumSizeHint().width() + 24)
        scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        split = QSplitter(Qt.Orientation.Horizontal)
        split.addWidget(self.graphs)
        split.addWidget(scroll)
        split.setSizes([880, 390])
        split.setCollapsible(1, False)
        page = QVBoxLayout(self)
        page.addWidget(split)

    def _build_transmitter(self) -> QGroupBox:
        box = QGroupBox("Transmitter")
        grid = QGridLayout(box)
        self.which = QComboBox()
        self.which.activated.connect(lambda _: self.choose(self.which.currentText()))
        self.lock = QCheckBox("locked")
        self.lock.toggled.connect(self._lock)
        grid.addWidget(self.which, 0, 0, 1, 2)
        grid.addWidget(self.lock, 0, 2)
        self.place: list[QDoubleSpinBox] = []
        for k, text in enumerate(("east", "north", "height")):
            spin = QDoubleSpinBox(decimals=2, minimum=-1e5, maximum=1e5, suffix=" m")
            spin.setKeyboardTracking(False)
            spin.setToolTip(f"{text} in the site frame [m]")
            spin.valueChanged.connect(lambda value, k=k: self._typed(k, value))
            grid.addWidget(QLabel(text), 1, k)
            grid.addWidget(spin, 2, k)
            self.place.append(spin)
        self.height_slider = QSlider(Qt.Orientation.Horizontal)
        self.height_slider.setRange(0, _HEIGHT_STEPS)
        self.height_slider.setToolTip("Height of the antenna in the site frame")
        self.height_slider.sliderPressed.connect(self._slider_pressed)
        self.height_slider.sliderReleased.connect(self._slider_released)
        self.height_slider.valueChanged.connect(self._slid)
        grid.addWidget(self.height_slider, 3, 0, 1, 3)
        self.add_button = QPushButton("Add")
        self.add_button.setToolTip("Add a transmitter in the middle of the view (A)")
        self.add_button.clicked.connect(lambda: self.add())
        self.remove_button = QPushButton("Remove")
        self.remove_button.setToolTip("Remove the chosen transmitter (Delete)")
        self.remove_button.clicked.connect(lambda: self.remove())
        self.undo_button = QPushButton("Undo")
        self.undo_button.setToolTip("Ctrl+Z")
        self.undo_button.clicked.connect(lambda: self.undo())
        self.redo_button = QPushButton("Redo")
        self.redo_button.setToolTip("Ctrl+Shift+Z")
        self.redo_button.clicked.connect(lambda: self.redo())
        row = QHBoxLayout()
        for button in (self.add_button, self.remove_button, self.undo_button, self.redo_button):
            row.addWidget(button)
        grid.addLayout(row, 4, 0, 1, 3)
        return box

    def _build_choice(self) -> QGroupBox:
        box = QGroupBox("Map")
        form = QFormLayout(box)
        self.estimator = QComboBox()
        self.estimator.addItems(list(ESTIMATOR_NAMES))
        self.estimator.activated.connect(lambda _: self._choose(estimator=self.estimator.currentText()))
        form.addRow("Estimator", self.estimator)
        self.tones = QHBoxLayout()
        form.addRow("Tones", self.tones)
        self.posture = QComboBox()
        for key, text in _POSTURES:
            self.posture.addItem(text, key)
        self.posture.activated.connect(lambda _: self._choose(posture=self.posture.currentData()))
        form.addRow("Posture", self.posture)
        self.sun_azimuth = QDoubleSpinBox(minimum=0.0, maximum=360.0, suffix="°", decimals=1)
        self.sun_elevation = QDoubleSpinBox(minimum=0.1, maximum=90.0, suffix="°", decimals=1)
        for spin in (self.sun_azimuth, self.sun_elevation):
            spin.setKeyboardTracking(False)
            spin.valueChanged.connect(lambda _: self._sun_typed())
        row = QHBoxLayout()
        self.sun_azimuth.setPrefix("az. ")
        self.sun_elevation.setPrefix("el. ")
        row.addWidget(self.sun_azimuth)
        row.addWidget(self.sun_elevation)
        form.addRow("Sun", row)
        self.moment = QDateTimeEdit()
        self.moment.setDisplayFormat("yyyy-MM-dd HH:mm 'UTC'")
        self.moment.setTimeZone(QTimeZone.utc())
        self.moment.setDateTime(QDateTime.fromSecsSinceEpoch(1_782_043_200, QTimeZone.utc()))
        self.moment.dateTimeChanged.connect(lambda _: self._moment_changed())
        form.addRow("Time of day", self.moment)
        self.costs: list[QDoubleSpinBox] = []
        row = QHBoxLayout()
        for text, value in (("tower", 1.0), ("m height", 0.0), ("m cable", 0.0)):
            spin = QDoubleSpinBox(decimals=2, maximum=1e6, value=value)
            spin.setKeyboardTracking(False)
            spin.setToolTip(f"Cost per {text}")
            spin.valueChanged.connect(lambda _: self._costs_typed())
            part = QVBoxLayout()
            part.addWidget(QLabel(f"per {text}"))
            part.addWidget(spin)
            row.addLayout(part)
            self.costs.append(spin)
        form.addRow("Cost", row)
        return box

    def _build_optimiser(self) -> QGroupBox:
        box = QGroupBox("Optimise")
        grid = QGridLayout(box)
        self.criterion = QComboBox()
        self.criterion.addItems(list(OPTIMISED))
        self.statistic = QComboBox()
        self.statistic.addItems(["rms", "p95", "worst"])
        self.starts = QSpinBox(minimum=1, maximum=500, value=10)
        self.starts.setToolTip("Searches from so many random starts")
        self.separation = QDoubleSpinBox(maximum=1e5, suffix=" m", value=5.0)
        self.separation.setToolTip("Least distance between two towers")
        for k, (text, widget) in enumerate(
            (
                ("minimise", self.criterion),
                ("over the field", self.statistic),
                ("starts", self.starts),
                ("towers apart", self.separation),
            )
        ):
            grid.addWidget(QLabel(text), 2 * (k // 2), k % 2)
            grid.addWidget(widget, 2 * (k // 2) + 1, k % 2)
        self.progress = QProgressBar()
        self.progress.setFormat("")
        self.progress.setValue(0)
        self.run_button = QPushButton("Optimise")
        self.run_button.setToolTip("Locked transmitters stay; the others stay within the circle and heights of all")
        self.run_button.clicked.connect(lambda: self.optimise())
        self.cancel_button = QPushButton("Cancel")
        self.cancel_button.setEnabled(False)
        self.cancel_button.clicked.connect(lambda: self.cancel())
        grid.addWidget(self.progress, 4, 0, 1, 2)
        grid.addWidget(self.run_button, 5, 0)
        grid.addWidget(self.cancel_button, 5, 1)
        return box

    def _build_files(self) -> QHBoxLayout:
        row = QHBoxLayout()
        load = QPushButton("Field from CSV…")
        load.setToolTip("Study another field; each of its heliostats has the mirror of the scenario's first")
        load.clicked.connect(lambda: self._ask_field())
        save = QPushButton("Save as scenario…")
        save.clicked.connect(lambda: self._ask_save())
        row.addWidget(load)
        row.addWidget(save)
        return row

    # -- the document ------------------------------------------------------------------------------------

    def _on_opened(self) -> None:
        self._leave_edit()
        self._edit, self._engine, self.map, self.chosen = self.session.layout, None, None, None
        self._busy = self._again = False
        self._limits = None
        for handle in self._handles.values():
            self.plot.removeItem(handle)
        self._handles = {}
        self.setEnabled(self._edit is not None)
        if self._edit is None:
            self.figures.setText("")
            self.dots.set_data(np.empty(0), np.empty(0), np.empty(0, np.int64), [], 8.0)
            return
        self._edit_connections = [
            self._edit.moved.connect(self._on_moved),
            self._edit.chosen.connect(self._prepare),
        ]
        self._fill_choice(self._edit)
        self._show_handles()
        self.chosen = self._edit.ids[0] if self._edit.ids else None
        self._place_handles()
        self._show_chosen()
        self._show_all()
        self._prepare()

    def _fill_choice(self, edit: LayoutEdit) -> None:
        self._filling = True
        while self.tones.count():
            item = self.tones.takeAt(0)
            widget = item.widget() if item is not None else None
            if widget is not None:
                widget.deleteLater()
        choice = edit.choice
        for k, hertz in enumerate(edit.scenario.tone_hz):
            box = QCheckBox(f"{1e-3 * hertz:.5g} kHz")
            box.setChecked(not choice.tones or k in choice.tones)
            box.toggled.connect(lambda _: self._tones_ticked())
            self.tones.addWidget(box)
        self._show_choice()
        self._filling = True
        site = edit.scenario.site
        placed = site.latitude_deg is not None and site.longitude_deg is not None
        self.moment.setEnabled(placed)
        self.moment.setToolTip(
            "Puts the sun where it stands over the site at this time" if placed
            else "The scenario has no [site] latitude_deg and longitude_deg: set the sun by hand"
        )  # fmt: skip
        self._filling = False

    def _show_choice(self) -> None:
        """Bring the controls to what is chosen, whoever chose it."""
        if self._edit is None:
            return
        choice, self._filling = self._edit.choice, True
        self.estimator.setCurrentText(choice.estimator)
        self.posture.setCurrentIndex(self.posture.findData(choice.posture))
        self.sun_azimuth.setValue(choice.sun.azimuth_deg)
        self.sun_elevation.setValue(max(choice.sun.elevation_deg, self.sun_elevation.minimum()))
        self._filling = False

    def _show_all(self) -> None:
        """Put everything into the picture, once: the range does not follow a drag."""
        edit = self._edit
        if edit is None:
            return
        pivot = edit.scenario.pivot_enu_m if edit.pivot_enu_m is None else edit.pivot_enu_m
        ground = np.concatenate([np.array([t.position_enu_m for t in edit.transmitters]).reshape(-1, 3), pivot])[:, :2]
        if len(ground):
            (x0, y0), (x1, y1) = ground.min(axis=0), ground.max(axis=0)
            pad = 0.06 * max(x1 - x0, y1 - y0, 1.0)
            self.plot.setRange(xRange=(x0 - pad, x1 + pad), yRange=(y0 - pad, y1 + pad), padding=0.0)

    # -- the map -----------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Make the mirrors ready for a choice; then the map follows."""
        edit = self._edit
        if edit is None:
            return
        scenario, choice, pivot = edit.scenario, edit.choice, edit.pivot_enu_m
        self._limits = None
        self._show_choice()
        self.workers.run("Field", lambda _: LiveLayout(scenario, choice, pivot_enu_m=pivot), self._prepared)

    def _prepared(self, engine: LiveLayout) -> None:
        self._engine = engine
        self._ask_map()

    def _ask_map(self) -> None:
        """Have the map made for what stands now; while one is made, only the newest wish is kept."""
        engine, edit = self._engine, self._edit
        if engine is None or edit is None:
            return
        if self._busy:
            self._again = True
            return
        self._busy, self._again = True, False
        transmitters = edit.transmitters
        self.workers.run("Map", lambda _: engine.evaluate(transmitters), self._show_map, failed=self._map_failed)

    def _map_failed(self, text: str) -> None:
        self._busy = False
        self.session.tell(text, is_error=True)

    def _show_map(self, found: LiveMap) -> None:
        self._busy = False
        engine, edit = self._engine, self._edit
        if engine is None or edit is None:
            return
        self.map = found
        sigma = found.sigma_mrad
        known = sigma[np.isfinite(sigma)]
        if known.size and (self._limits is None or not self._limits[0] <= found.median_mrad <= self._limits[1]):
            self._limits = (float(known.min()), 1.3 * float(known.max()))
        pivot = engine.pivot_enu_m
        if len(pivot) == len(sigma):
            colour = self.scale.colours(sigma, "bound of the normal, RMS angle [mrad]", self._limits)
            size = float(np.clip(260.0 / np.sqrt(max(len(pivot), 1)), 3.0, 16.0))
            self.dots.set_data(pivot[:, 0], pivot[:, 1], colour, self.scale.table, size)
        if found.worst is not None:
            self.worst.setData([pivot[found.worst, 0]], [pivot[found.worst, 1]])
        else:
            self.worst.setData([], [])
        self._show_figures(found)
        if self._again:
            self._ask_map()

    def _show_figures(self, found: LiveMap) -> None:
        edit = self._edit
        if edit is None:
            return
        if found.problem:
            self.figures.setText(
                f'<span style="color:{self.theme.warning}"><b>No map:</b> {escape(found.problem)}</span>'
            )
            return
        worst = "–"
        if found.worst is not None:
            ids = edit.scenario.heliostat_ids
            worst = ids[found.worst] if edit.pivot_enu_m is None else f"H{found.worst + 1}"
        lost = f"<br><b>{found.undetermined}</b> mirrors undetermined" if found.undetermined else ""
        self.figures.setText(
            f"<b>{len(found.sigma_mrad)}</b> mirrors, bound of the normal (RMS angle)<br>"
            f"{escape(found.made_by)}<br>"
            f"rms <b>{found.rms_mrad:.4g}</b> mrad, median {found.median_mrad:.4g} mrad<br>"
            f"worst <b>{found.worst_mrad:.4g}</b> mrad at <b>{worst}</b> (ringed)<br>"
            f"cost <b>{found.cost:.6g}</b>, {len(edit.transmitters)} transmitters{lost}"
        )

    # -- handles -----------------------------------------------------------------------------------------

    def _on_moved(self) -> None:
        edit = self._edit
        if edit is None:
            return
        if set(edit.ids) != set(self._handles):
            self._show_handles()
        self._place_handles()
        if self.chosen not in edit.ids:
            self.choose(edit.ids[-1] if edit.ids else None)
        else:
            self._show_chosen()
        self._ask_map()

    def _show_handles(self) -> None:
        edit = self._edit
        if edit is None:
            return
        for name in tuple(self._handles):
            if name not in edit.ids:
                self.plot.removeItem(self._handles.pop(name))
        for name in edit.ids:
            if name not in self._handles:
                handle = pg.TargetItem(
                    size=15, symbol="t1", pen=pg.mkPen(self.theme.text, width=1.5), brush=VERMILION,
                    hoverBrush="#E69F00", label=name,
                    labelOpts={"color": self.theme.text, "offset": (8, 8), "fill": see_through(self.theme.plot)},
                )  # fmt: skip
                handle.sigPositionChanged.connect(lambda item, name=name: self._dragged(name, item))
                handle.sigPositionChangeFinished.connect(lambda _: self._drag_ended())
                handle.setZValue(10)
                self._handles[name] = handle
                self.plot.addItem(handle, ignoreBounds=True)
        self._place_handles()

    def _place_handles(self) -> None:
        edit = self._edit
        if edit is None:
            return
        self._filling = True
        for transmitter in edit.transmitters:
            handle = self._handles[transmitter.id]
            handle.setPos(transmitter.position_enu_m[0], transmitter.position_enu_m[1])
            locked = transmitter.id in edit.locked
            handle.movable = not locked
            colour = self.theme.muted if locked else "#E69F00" if transmitter.id == self.chosen else VERMILION
            handle.setBrush(pg.mkBrush(colour))
        self._filling = False

    def _dragged(self, name: str, handle: Any) -> None:
        if self._filling or self._edit is None:
            return
        self._edit.begin_drag()
        self.chosen = name
        place = handle.pos()
        self._edit.move(name, east=float(place.x()), north=float(place.y()))

    def _drag_ended(self) -> None:
        if not self._filling and self._edit is not None:
            self._edit.end_drag()

    def _clicked(self, event: Any) -> None:
        """Choose the handle nearest to a click."""
        if self._edit is None or event.button() != Qt.MouseButton.LeftButton:
            return
        if not self.plot.sceneBoundingRect().contains(event.scenePos()) or not self._edit.transmitters:
            return
        place = self.plot.vb.mapSceneToView(event.scenePos())
        pixel_x, pixel_y = self.plot.vb.viewPixelSize()
        spots = np.array([t.position_enu_m[:2] for t in self._edit.transmitters])
        away = np.hypot((spots[:, 0] - place.x()) / pixel_x, (spots[:, 1] - place.y()) / pixel_y)
        if away.min() <= _PICK_PX:
            self.choose(self._edit.ids[int(np.argmin(away))])

    # -- the chosen transmitter --------------------------------------------------------------------------

    def choose(self, name: str | None) -> None:
        """Look at a transmitter."""
        self.chosen = name
        if self._edit is not None and name in self._edit.ids:
            index = (
                self._edit.scenario.transmitter_ids.index(name) if name in self._edit.scenario.transmitter_ids else None
            )
            self.session.select(transmitter=index)
        self._place_handles()
        self._show_chosen()

    def _show_chosen(self) -> None:
        edit = self._edit
        if edit is None:
            return
        self._filling = True
        if [self.which.itemText(i) for i in range(self.which.count())] != list(edit.ids):
            self.which.clear()
            self.which.addItems(list(edit.ids))
        known = self.chosen is not None and self.chosen in edit.ids
        self.which.setCurrentIndex(edit.ids.index(self.chosen) if known and self.chosen is not None else -1)
        locked = known and self.chosen in edit.locked
        for widget in (*self.place, self.height_slider):
            widget.setEnabled(bool(known and not locked))
        self.lock.setEnabled(known)
        self.lock.setChecked(bool(locked))
        if known and self.chosen is not None:
            place = edit.find(self.chosen).position_enu_m
            for spin, value in zip(self.place, place, strict=True):
                spin.setValue(value)
            low, high = self._heights()
            self.height_slider.setValue(round(_HEIGHT_STEPS * (place[2] - low) / (high - low)))
        self.remove_button.setEnabled(bool(known and not locked))
        self.undo_button.setEnabled(edit.can_undo)
        self.redo_button.setEnabled(edit.can_redo)
        self._filling = False

    def _heights(self) -> tuple[float, float]:
        """Range of the slider [m]: from the ground to twice the highest antenna of the scenario."""
        edit = self._edit
        if edit is None or not edit.scenario.transmitter:
            return 0.0, 1.0
        heights = edit.scenario.transmitter_enu_m[:, 2]
        low, high = min(0.0, float(heights.min())), 2.0 * float(np.abs(heights).max())
        return low, max(high, low + 1.0)

    def _typed(self, axis: int, value: float) -> None:
        if self._filling or self._edit is None or self.chosen is None:
            return
        self._edit.move(self.chosen, **{("east", "north", "up")[axis]: value})

    def _slider_pressed(self) -> None:
        if self._edit is not None:
            self._edit.begin_drag()

    def _slider_released(self) -> None:
        if self._edit is not None:
            self._edit.end_drag()

    def _slid(self, value: int) -> None:
        if self._filling or self._edit is None or self.chosen is None:
            return
        low, high = self._heights()
        self._edit.move(self.chosen, up=low + (high - low) * value / _HEIGHT_STEPS)

    def _lock(self, on: bool) -> None:
        if not self._filling and self._edit is not None and self.chosen is not None:
            self._edit.lock(self.chosen, on)

    def add(self) -> None:
        """Add a transmitter in the middle of what is shown, as high as the others on average."""
        edit = self._edit
        if edit is None:
            return
        (x0, x1), (y0, y1) = self.plot.viewRange()
        heights = [t.position_enu_m[2] for t in edit.transmitters] or [10.0]
        try:
            # a little off the very middle, where a tower often stands
            name = edit.add(0.5 * (x0 + x1) + 0.03 * (x1 - x0), 0.5 * (y0 + y1), float(np.mean(heights)))
        except RfposeError as error:
            self.session.tell(str(error), is_error=True)
            return
        self.choose(name)

    def remove(self) -> None:
        """Take the chosen transmitter away."""
        if self._edit is None or self.chosen is None:
            return
        try:
            self._edit.remove(self.chosen)
        except RfposeError as error:
            self.session.tell(str(error), is_error=True)

    def undo(self) -> None:
        """Take the last step back."""
        if self._edit is not None:
            self._edit.undo()

    def redo(self) -> None:
        """Do it again."""
        if self._edit is not None:
            self._edit.redo()

    # -- choices -----------------------------------------------------------------------------------------

    def _choose(self, **changes: Any) -> None:
        if not self._filling and self._edit is not None:
            self._edit.choose(**changes)

    def _tones_ticked(self) -> None:
        boxes = [self.tones.itemAt(i).widget() for i in range(self.tones.count())]  # type: ignore[union-attr]
        ticked = tuple(i for i, box in enumerate(boxes) if isinstance(box, QCheckBox) and box.isChecked())
        if not ticked and not self._filling:
            self.session.tell("at least one tone must count; tick one", is_error=True)
            return
        self._choose(tones=() if len(ticked) == len(boxes) else ticked)

    def _sun_typed(self) -> None:
        self._choose(sun=SunPlace(azimuth_deg=self.sun_azimuth.value(), elevation_deg=self.sun_elevation.value()))

    def _moment_changed(self) -> None:
        edit = self._edit
        if self._filling or edit is None:
            return
        moment = datetime.fromtimestamp(self.moment.dateTime().toSecsSinceEpoch(), UTC)
        scenario = edit.scenario
        self.workers.run("Sun", lambda _: sun_of(scenario, moment), self._sun_found)

    def _sun_found(self, sun: SunPlace) -> None:
        if self._edit is None:
            return
        self._edit.choose(sun=sun, posture="sun")

    def _costs_typed(self) -> None:
        tower, height, cable = (spin.value() for spin in self.costs)
        self._choose(per_tower=tower, per_height_m=height, per_cable_m=cable)

    # -- optimiser ---------------------------------------------------------------------------------------

    def optimise(self) -> None:
        """Search better places in the background; the layout may be edited meanwhile."""
        engine, edit = self._engine, self._edit
        if engine is None or edit is None:
            return
        transmitters, locked = edit.transmitters, [t.id in edit.locked for t in edit.transmitters]
        criterion, statistic = self.criterion.currentText(), self.statistic.currentText()
        starts, separation = self.starts.value(), self.separation.value()
        self._searching(True)
        job = self.workers.run(
            "Optimiser",
            lambda tell: place_transmitters(
                engine,
                transmitters,
                locked,
                criterion=criterion,  # type: ignore[arg-type]
                statistic=statistic,
                separation_m=separation,
                starts=starts,
                on_progress=tell,
            ),
            self._optimised,
            failed=self._search_failed,
        )
        self.progress.setFormat("%v of %m starts")
        self.progress.setMaximum(starts + 1)
        job.progressed.connect(lambda done, total: self._search_progress(done, total))

    def _search_progress(self, done: int, total: int) -> None:
        self.progress.setMaximum(total)
        self.progress.setValue(done)

    def _searching(self, on: bool) -> None:
        self.run_button.setEnabled(not on)
        self.cancel_button.setEnabled(on)
        self.progress.setValue(0)

    def _optimised(self, found: Any) -> None:
        self._searching(False)
        if self._edit is None:
            return
        self._edit.replace(found)
        self.session.tell("the transmitters stand where the optimiser put them; Undo brings the old places back")

    def _search_failed(self, text: str) -> None:
        self._searching(False)
        self.session.tell(text, is_error=True)

    def cancel(self) -> None:
        """End the search; the layout stays as it is."""
        self.workers.cancel("Optimiser")
        self._searching(False)
        self.session.tell("the search was cancelled; the layout is as it was")

    # -- files -------------------------------------------------------------------------------------------

    def _ask_field(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Field of heliostats", "", "Tables (*.csv);;All files (*)")
        if path:
            self.load_field(path)

    def load_field(self, path: str | Path) -> None:
        """Study the heliostats of a CSV table."""
        self.workers.run("Field from CSV", lambda _: field_from_csv(path), self._field_loaded)

    def _field_loaded(self, pivot: Any) -> None:
        if self._edit is not None:
            self._edit.use_field(pivot)
            self._show_all()

    def _ask_save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Save as scenario", "layout.toml", "Scenarios (*.toml)")
        if path:
            self.save_scenario(path if path.endswith(".toml") else f"{path}.toml")

    def save_scenario(self, path: str | Path) -> None:
        """Write the layout as a scenario, checked."""
        edit = self._edit
        if edit is None:
            return

        def work(_: Any) -> str:
            write_atomically(path, edit.to_scenario().to_toml().encode())
            return str(path)

        self.workers.run("Saving", work, lambda name: self.session.tell(f"saved {name}"))
