"""The real widgets, driven without a screen."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from PySide6.QtCore import QEvent, QMimeData, QPointF, Qt, QUrl
from PySide6.QtGui import QDropEvent, QMouseEvent
from PySide6.QtWidgets import QApplication

from rfpose.errors import RecordingError
from rfpose.pipeline.follow import Follow
from rfpose.pipeline.pictures.field_view import FieldPicture
from rfpose.pipeline.process import process
from rfpose.scenario import load_scenario
from rfpose.viewer.preferences import Preferences
from rfpose.viewer.state.document import Document
from rfpose.viewer.views.field import FieldView
from rfpose.viewer.views.layout import LayoutView
from rfpose.viewer.views.recording import RecordingView
from rfpose.viewer.views.tracking import TrackingView
from rfpose.viewer.window import MainWindow

Wait = Callable[..., None]


def recording_of(window: MainWindow) -> RecordingView:
    view = window.views["recording"]
    assert isinstance(view, RecordingView)
    return view


def field_of(window: MainWindow) -> FieldView:
    view = window.views["field"]
    assert isinstance(view, FieldView)
    return view


def layout_of(window: MainWindow) -> LayoutView:
    view = window.views["layout"]
    assert isinstance(view, LayoutView)
    return view


def mouse(graphs, kind: QEvent.Type, place: QPointF, held: bool) -> None:
    """Send one mouse event to a graphics view, at a place of its scene."""
    viewport = graphs.viewport()
    local = QPointF(graphs.mapFromScene(place))
    button = Qt.MouseButton.LeftButton if kind != QEvent.Type.MouseMove else Qt.MouseButton.NoButton
    buttons = Qt.MouseButton.LeftButton if held else Qt.MouseButton.NoButton
    event = QMouseEvent(kind, local, viewport.mapToGlobal(local), button, buttons, Qt.KeyboardModifier.NoModifier)
    QApplication.sendEvent(viewport, event)


def click(graphs, plot, x: float, y: float) -> None:
    """Click at data coordinates of a plot."""
    place = plot.vb.mapViewToScene(QPointF(x, y))
    mouse(graphs, QEvent.Type.MouseMove, place, held=False)
    mouse(graphs, QEvent.Type.MouseButtonPress, place, held=True)
    mouse(graphs, QEvent.Type.MouseButtonRelease, place, held=False)


def drag(qtbot, graphs, plot, start: tuple[float, float], end: tuple[float, float], steps: int = 8) -> None:
    """Drag from one place to another, in data coordinates."""
    path = np.linspace(start, end, steps + 1)
    places = [plot.vb.mapViewToScene(QPointF(*map(float, point))) for point in path]
    mouse(graphs, QEvent.Type.MouseMove, places[0], held=False)
    mouse(graphs, QEvent.Type.MouseButtonPress, places[0], held=True)
    for place in places[1:]:
        qtbot.wait(15)
        mouse(graphs, QEvent.Type.MouseMove, place, held=True)
    mouse(graphs, QEvent.Type.MouseButtonRelease, places[-1], held=False)


# -- opening -------------------------------------------------------------------------------------------------


def test_first_window_offers_recent_files_and_opens_one_that_is_clicked(
    preferences: Preferences, files: dict[str, Path], qtbot, wait: Wait
) -> None:
    preferences.save(preferences.load().opened("/not/there.h5").opened(files["scenario"]))
    window = MainWindow(preferences)
    qtbot.addWidget(window)
    window.show()
    assert window.pages.currentWidget() is window.welcome
    recent = window.welcome.recent
    assert recent.count() == 2
    assert recent.item(1).flags() == Qt.ItemFlag.NoItemFlags
    recent.itemClicked.emit(recent.item(0))
    wait(window, lambda: window.session.document is not None)
    assert window.current() == "layout"
    window.close()


@pytest.mark.parametrize(("kind", "view"), [("recording", "recording"), ("result", "field"), ("scenario", "layout")])
def test_each_kind_opens_its_view(window: MainWindow, files: dict[str, Path], wait: Wait, kind: str, view: str) -> None:
    window.open_path(files[kind])
    wait(window, lambda: window.session.document is not None)
    assert window.current() == view
    assert files[kind].name in window.windowTitle()
    assert window.settings.recent[0] == str(files[kind])


def test_dropped_file_is_opened(window: MainWindow, files: dict[str, Path], wait: Wait) -> None:
    data = QMimeData()
    data.setUrls([QUrl.fromLocalFile(str(files["scenario"]))])
    event = QDropEvent(
        QPointF(50, 50), Qt.DropAction.CopyAction, data, Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
    )
    window.dropEvent(event)
    wait(window, lambda: window.session.document is not None)
    assert window.session.document.path == files["scenario"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("bad.h5", b"no HDF5", "not an HDF5 file"),
        (
            "bad.toml",
            b"name = 'a'\nradio = { sample_rate_hz = 'x', centre_frequency_hz = 1, frame_samples = 64 }\n"
            b"tone = [{ frequency_hz = 1 }]\ntransmitter = [{ id = 'T', position_enu_m = [0, 0, 0], carrier_hz = 0 }]",
            "`radio.sample_rate_hz`",
        ),
    ],
)
def test_bad_file_is_a_message_and_what_was_open_stays(
    window: MainWindow, files: dict[str, Path], tmp_path: Path, wait: Wait, name: str, content: bytes, message: str
) -> None:
    window.open_path(files["scenario"])
    wait(window, lambda: window.session.document is not None)
    (tmp_path / name).write_bytes(content)
    window.open_path(tmp_path / name)
    wait(window, lambda: window.session.message is not None)
    assert window.session.message.is_error
    assert message in window.session.message.text
    assert window.message_bar.isVisible()
    assert window.session.document.path == files["scenario"]


def test_missing_file_is_a_message(window: MainWindow, tmp_path: Path, wait: Wait) -> None:
    window.open_path(tmp_path / "gone.h5")
    wait(window, lambda: window.session.message is not None)
    assert "no such file" in window.session.message.text


def test_truncated_samples_are_a_message_not_a_dead_window(
    window: MainWindow, files: dict[str, Path], tmp_path: Path, wait: Wait
) -> None:
    """The table of blocks promises more than there is."""
    path = tmp_path / "rec.h5"
    path.write_bytes(files["recording"].read_bytes())
    with h5py.File(path, "r+") as file:
        file["receivers/H01_r0/blocks"][0, 1] = 10**9
    window.open_path(path)
    wait(window, lambda: window.session.message is not None)
    assert "does not lie within" in window.session.message.text


def test_file_that_vanishes_and_one_that_grows_are_said(
    window: MainWindow, files: dict[str, Path], tmp_path: Path, wait: Wait
) -> None:
    path = tmp_path / "site.toml"
    path.write_text(files["scenario"].read_text())
    window.open_path(path)
    wait(window, lambda: window.session.document is not None)
    path.write_text(files["scenario"].read_text() + "# more\n")
    wait(window, lambda: window.session.message is not None and "press F5" in window.session.message.text)
    path.unlink()
    wait(window, lambda: "has vanished" in window.session.message.text)
    window.reload()
    wait(window, lambda: "cannot be read" in window.session.message.text)
    assert window.session.document is not None


def test_growing_recording_is_read_again_with_what_was_selected(
    window: MainWindow, files: dict[str, Path], tmp_path: Path, wait: Wait
) -> None:
    path = tmp_path / "rec.h5"
    path.write_bytes(files["recording"].read_bytes())
    with h5py.File(path, "r+") as file:
        for name in file["receivers"]:
            blocks = file[f"receivers/{name}/blocks"][()]
            del file[f"receivers/{name}/blocks"]
            file[f"receivers/{name}/blocks"] = blocks[:1]
    window.open_path(path)
    wait(window, lambda: window.session.document is not None)
    assert len(window.session.document.frame_start_index) == 1
    window.session.select(receiver="H02_r1", transmitter=4)
    wait(window)
    path.unlink()
    path.write_bytes(files["recording"].read_bytes())
    window.reload()
    wait(window, lambda: len(window.session.document.frame_start_index) == 3)
    assert window.session.selection.receiver == "H02_r1"
    assert window.session.selection.transmitter == 4
    assert window.current() == "recording"


# -- recording -----------------------------------------------------------------------------------------------


def test_click_on_a_carrier_lights_its_transmitter_up(
    window: MainWindow, files: dict[str, Path], qtbot, wait: Wait
) -> None:
    window.open_path(files["recording"])
    view = recording_of(window)
    wait(window, lambda: view.spectrum is not None and view.waterfall is not None and view.look is not None)
    found = view.spectrum
    carrier_mhz = 1e-6 * float(found.line_hz[6, 0])
    click(view.graphs, view.spectrum_plot, carrier_mhz, float(found.line_db[6, 0]))
    assert window.session.selection.transmitter == 6
    sizes = [spot.size() for spot in view.plan.transmitters.points()]
    assert int(np.argmax(sizes)) == 6
    assert view.chosen_line.isVisible()
    assert view.chosen_line.value() == pytest.approx(carrier_mhz)
    assert view.line_table.currentRow() == 6
    # a sideband is its transmitter's, too; where there is no line nothing is chosen
    click(view.graphs, view.spectrum_plot, 1e-6 * float(found.line_hz[2, 1]), -60.0)
    assert window.session.selection.transmitter == 2
    click(view.graphs, view.spectrum_plot, 1e-6 * float(found.line_hz[2, 0]) + 2.0, -60.0)
    assert window.session.selection.transmitter == 2


def test_frames_receivers_and_calibration_are_shown(window: MainWindow, files: dict[str, Path], wait: Wait) -> None:
    window.open_path(files["recording"])
    view = recording_of(window)
    # each is loaded by itself
    wait(window, lambda: all(found is not None for found in (view.track, view.waterfall, view.look)))
    wait(window, lambda: view.receiver_table.rowCount() == 7)
    assert view.waterfall.power_db.shape[1] >= 64
    assert np.isfinite(view.waterfall.power_db).all()
    assert view.line_table.item(3, 4).text() == "carrier not found above the noise"  # T4 is blocked at H01
    assert "not measured: T4" in view.frame_facts.text()
    window.session.select(transmitter=1)
    calibrated = view.phase_curve.getData()[1].copy()
    title = view.phase_plot.titleLabel.text
    view.corrected.setChecked(False)
    assert view.phase_plot.titleLabel.text != title
    assert len(view.phase_curve.getData()[1]) == len(calibrated) == 3
    window.session.select(receiver="H02_r0", frame=1)  # this one lost samples
    wait(window, lambda: view.line_table.rowCount() > 0 and "not recorded" in view.line_table.item(0, 4).text())
    rows = {view.receiver_table.item(i, 0).text(): i for i in range(view.receiver_table.rowCount())}
    lost = {name: [view.receiver_table.item(i, j).text() for j in (3, 4)] for name, i in rows.items()}
    assert lost.pop("H02_r0") == ["1", "2000"]
    assert set(map(tuple, lost.values())) == {("0", "0")}


def test_waterfall_follows_the_zoom(window: MainWindow, files: dict[str, Path], wait: Wait) -> None:
    window.open_path(files["recording"])
    view = recording_of(window)
    wait(window, lambda: view.waterfall is not None)
    view.spectrum_plot.setXRange(-19.0, -17.0, padding=0.0)
    wait(window, lambda: view.waterfall.band_hz[1] < -16e6)
    assert view.waterfall.band_hz[0] == pytest.approx(-19e6, abs=1e3)


# -- field ---------------------------------------------------------------------------------------------------


def test_click_on_a_mirror_shows_its_poses_and_exclusions(
    window: MainWindow, files: dict[str, Path], wait: Wait
) -> None:
    window.open_path(files["result"])
    wait(window, lambda: window.session.document is not None)
    view = field_of(window)
    field = window.session.document.field
    click(view.map, view.plan_plot, *map(float, field.pivot_enu_m[0, :2]))
    assert window.session.selection.heliostat == 0
    wait(window, lambda: view.history is not None)
    assert "H01" in view.headline.text()
    rows = [[view.excluded.item(i, j).text() for j in range(3)] for i in range(view.excluded.rowCount())]
    assert ["T4", "carrier not found above the noise", "9 of 9 receiver-frames"] in rows
    assert np.isfinite(view.history.ellipse_mrad).all()
    for key in ("error", "sigma", "status", "transmitters"):
        view.colour.setCurrentIndex(view.colour.findData(key))
        view.colour.activated.emit(view.colour.currentIndex())
        assert view.colour.currentData() == key
        assert bool(view.key.items) == (key == "status")
    view.arrows.setCurrentIndex(view.arrows.findData("residuals"))
    view._draw()
    assert "mm" in view.arrow_label.text()


def test_space_turns_by_a_drag(window: MainWindow, files: dict[str, Path], qtbot, wait: Wait) -> None:
    window.open_path(files["result"])
    wait(window, lambda: window.session.document is not None)
    view = field_of(window)
    before = view.space.azimuth_rad
    drag(qtbot, view.space_layout, view.space.plot, (0.0, 0.0), (40.0, 0.0))
    assert view.space.azimuth_rad != before


def bare_field(n: int, n_frame: int = 1) -> FieldPicture:
    k = np.arange(n) + 0.5
    radius, angle = 90.0 * np.sqrt(k / max(n, 1)), 2.399963 * k
    pivot = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, 2.0)], axis=1)
    normal = np.full((n_frame, n, 3), np.nan)
    normal[:, ::2] = (0.0, 0.0, 1.0)
    towers = np.array([[100.0, 0, 20], [0, 100, 30], [-100, 0, 20], [0, -100, 30], [0, 0, 50]])
    return FieldPicture(
        name="spiral",
        transmitter_ids=tuple(f"T{i}" for i in range(5)),
        transmitter_enu_m=towers,
        calibration_ids=(),
        calibration_enu_m=np.empty((0, 3)),
        heliostat_ids=tuple(f"H{i}" for i in range(n)),
        pivot_enu_m=pivot,
        time=("now",) * n_frame,
        time_s=np.arange(n_frame, dtype=np.float64),
        normal_enu=normal,
        error_mrad=None,
        sigma_mrad=np.where(np.isfinite(normal[..., 0]), 0.5, np.nan),
        status=np.zeros((n_frame, n), np.int8),
        n_transmitter=np.full((n_frame, n), 5, np.int64),
    )


@pytest.mark.parametrize("n", [0, 1, 100_000])
def test_fields_of_any_size_are_drawn(window: MainWindow, files: dict[str, Path], n: int) -> None:
    document = Document(
        path=files["scenario"],
        kind="scenario",
        scenario=load_scenario(files["scenario"]),
        field=bare_field(n),
        frame_start_index=np.empty(0, np.int64),
    )
    window.session.show(document)
    window.go_to("field")
    view = field_of(window)
    view.grab()
    assert len(view.plan.dots._x) == n


def test_mirrors_without_a_pose_are_grey_and_the_rest_is_drawn(
    window: MainWindow, files: dict[str, Path], tmp_path: Path, wait: Wait
) -> None:
    path = tmp_path / "result.h5"
    path.write_bytes(files["result"].read_bytes())
    with h5py.File(path, "r+") as file:
        for name in ("normal_enu", "cov_enu", "sigma_rad", "azimuth_rad", "elevation_rad", "centre_enu_m"):
            file[f"poses/{name}"][:, 0] = np.nan
        file["poses/status"][:, 0] = 1
    window.open_path(path)
    wait(window, lambda: window.session.document is not None)
    window.session.select(heliostat=0)
    view = field_of(window)
    wait(window, lambda: view.history is not None)
    assert "fewer than three receivers" in view.headline.text()
    view.colour.setCurrentIndex(view.colour.findData("sigma"))
    view.colour.activated.emit(view.colour.currentIndex())
    view.grab()
    assert "is not beside" in window.session.message.text


# -- layout --------------------------------------------------------------------------------------------------


@pytest.fixture
def laid_out(window: MainWindow, files: dict[str, Path], wait: Wait) -> LayoutView:
    window.open_path(files["scenario"])
    view = layout_of(window)
    wait(window, lambda: view.map is not None)
    return view


def test_drag_moves_a_transmitter_and_the_map_follows(
    window: MainWindow, laid_out: LayoutView, qtbot, wait: Wait
) -> None:
    view, edit = laid_out, window.session.layout
    before = view.map
    drag(qtbot, view.graphs, view.plot, (100.0, 0.0), (60.0, -30.0))
    wait(window, lambda: view.map is not before and not view._busy)
    assert edit.find("T1").position_enu_m[:2] == pytest.approx((60.0, -30.0), abs=3.0)
    assert edit.find("T1").position_enu_m[2] == 20.0
    assert view.map.rms_mrad != before.rms_mrad
    assert view.chosen == "T1"
    assert view.place[0].value() == pytest.approx(60.0, abs=3.0)
    qtbot.keyClick(window, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)
    assert edit.transmitters == edit.scenario.transmitter
    wait(window, lambda: view.map.rms_mrad == pytest.approx(before.rms_mrad))


def test_locked_transmitter_cannot_be_dragged(window: MainWindow, laid_out: LayoutView, qtbot) -> None:
    view, edit = laid_out, window.session.layout
    view.choose("T1")
    view.lock.setChecked(True)
    drag(qtbot, view.graphs, view.plot, (100.0, 0.0), (60.0, -30.0))
    assert edit.find("T1").position_enu_m == (100.0, 0.0, 20.0)
    assert not view.place[0].isEnabled()


def test_height_slider_spins_add_remove(window: MainWindow, laid_out: LayoutView, wait: Wait) -> None:
    view, edit = laid_out, window.session.layout
    view.choose("T2")
    view.height_slider.setValue(1000)
    assert edit.find("T2").position_enu_m[2] == pytest.approx(100.0)
    view.place[1].setValue(12.5)
    assert edit.find("T2").position_enu_m[1] == 12.5
    view.add_button.click()
    assert edit.ids[-1] == "T11"
    assert view.chosen == "T11"
    view.remove_button.click()
    assert "T11" not in edit.ids
    wait(window, lambda: view.map is not None and view.map.cost == 10.0)


def test_too_few_transmitters_are_said_and_undo_brings_the_map_back(
    window: MainWindow, laid_out: LayoutView, wait: Wait
) -> None:
    view, edit = laid_out, window.session.layout
    for name in edit.ids[:6]:
        view.choose(name)
        view.remove()
    wait(window, lambda: "at least 5" in view.figures.text())
    for _ in range(6):
        view.undo()
    wait(window, lambda: not view.map.problem)


def test_estimator_posture_and_time_of_day(window: MainWindow, laid_out: LayoutView, wait: Wait) -> None:
    view, edit = laid_out, window.session.layout
    with_carrier = view.map.rms_mrad
    view.estimator.setCurrentText("shared-clock")
    view.estimator.activated.emit(2)
    wait(window, lambda: view.map.rms_mrad > 2.0 * with_carrier)
    moment = view.moment.dateTime().addSecs(-3600)
    view.moment.setDateTime(moment)
    wait(window, lambda: edit.choice.posture == "sun")
    assert 0.0 < edit.choice.sun.elevation_deg < 40.0  # a winter's day at 34° south
    assert view.sun_elevation.value() == pytest.approx(edit.choice.sun.elevation_deg, abs=0.06)


def test_optimiser_runs_and_is_undone(window: MainWindow, laid_out: LayoutView, wait: Wait) -> None:
    view, edit = laid_out, window.session.layout
    view.choose("T10")
    view.lock.setChecked(True)
    view.starts.setValue(1)
    before = edit.transmitters
    view.run_button.click()
    wait(window, lambda: edit.transmitters != before)
    assert edit.find("T10").position_enu_m == (0.0, 0.0, 50.0)
    assert view.run_button.isEnabled()
    view.undo_button.click()
    assert edit.transmitters == before


def test_cancelled_optimiser_leaves_the_layout_alone(
    window: MainWindow, laid_out: LayoutView, qtbot, wait: Wait
) -> None:
    view, edit = laid_out, window.session.layout
    view.starts.setValue(500)
    view.separation.setValue(0.0)
    view.run_button.click()
    assert view.cancel_button.isEnabled()
    job = next(job for job in window.workers.jobs if job.name == "Optimiser")
    edit.move("T1", east=90.0)  # the window is free meanwhile
    view.cancel_button.click()
    assert job.is_cancelled
    assert job.wait(30.0)
    qtbot.wait(50)
    assert edit.find("T1").position_enu_m[0] == 90.0
    assert edit.transmitters[1:] == edit.scenario.transmitter[1:]
    assert view.run_button.isEnabled()


def test_layout_is_saved_as_a_scenario(window: MainWindow, laid_out: LayoutView, tmp_path: Path, wait: Wait) -> None:
    window.session.layout.move("T1", east=77.0)
    laid_out.save_scenario(tmp_path / "new.toml")
    wait(window, lambda: (tmp_path / "new.toml").exists())
    assert load_scenario(tmp_path / "new.toml").transmitter_enu_m[0, 0] == 77.0


def test_field_from_a_table_and_a_bad_table(
    window: MainWindow, laid_out: LayoutView, tmp_path: Path, wait: Wait
) -> None:
    (tmp_path / "field.csv").write_text("id,east_m,north_m\nA,10,20\nB,30,40\nC,-20,5\n")
    laid_out.load_field(tmp_path / "field.csv")
    wait(window, lambda: len(laid_out.map.sigma_mrad) == 3 and not laid_out._busy)
    (tmp_path / "bad.csv").write_text("id,east_m,north_m\nA,ten,20\n")
    laid_out.load_field(tmp_path / "bad.csv")
    wait(window, lambda: window.session.message is not None)
    assert "line 2" in window.session.message.text


def test_site_without_heliostats_says_what_to_add(
    window: MainWindow, files: dict[str, Path], tmp_path: Path, wait: Wait
) -> None:
    site = load_scenario(files["scenario"])
    path = tmp_path / "empty.toml"
    site.changed(heliostat=(), simulation=None).save(path)
    window.open_path(path)
    view = layout_of(window)
    wait(window, lambda: view.map is not None)
    assert "no heliostats" in view.figures.text()


# -- work, themes, closing -----------------------------------------------------------------------------------


def test_newer_work_takes_the_place_of_older(window: MainWindow, qtbot) -> None:
    gate, heard = threading.Event(), []
    window.workers.run("Thing", lambda _: gate.wait(10.0), lambda _: heard.append("old"))
    window.workers.run("Thing", lambda _: "new", heard.append)
    qtbot.waitUntil(lambda: heard == ["new"], timeout=5000)
    gate.set()
    qtbot.waitUntil(lambda: not window.workers._jobs, timeout=5000)
    assert heard == ["new"]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (RecordingError("rec.h5: damaged; copy it again"), "rec.h5: damaged; copy it again"),
        (OSError(5, "Input/output error", "disk.h5"), "disk.h5: Input/output error; check the file"),
        (MemoryError(), "out of memory"),
        (ZeroDivisionError("oops"), "unexpected ZeroDivisionError: oops; please report"),
    ],
)
def test_error_in_work_becomes_a_message(window: MainWindow, qtbot, error: Exception, message: str) -> None:
    def work(_: object) -> None:
        raise error

    window.workers.run("Thing", work, lambda _: None)
    qtbot.waitUntil(lambda: window.session.message is not None, timeout=5000)
    assert message in window.session.message.text
    qtbot.keyClick(window, Qt.Key.Key_Escape)
    assert window.session.message is None


@pytest.mark.parametrize(("name", "after_s"), [("Thing", 0.0), ("Map", 1.0)])
def test_work_that_lasts_shows_how_far_it_is(window: MainWindow, qtbot, name: str, after_s: float) -> None:
    go_on, end = threading.Event(), threading.Event()

    def work(on_progress: Callable[[int, int], None]) -> None:
        go_on.wait(10.0)
        on_progress(3, 8)
        end.wait(10.0)

    window.show()
    begun = time.monotonic()
    window.workers.run(name, work, lambda _: None, key="here")
    qtbot.waitUntil(lambda: window.busy_bar.isVisible() and name in window.busy_label.text(), timeout=5000)
    assert time.monotonic() - begun > after_s
    assert window.busy_bar.maximum() == 0
    go_on.set()
    qtbot.waitUntil(lambda: (window.busy_bar.value(), window.busy_bar.maximum()) == (3, 8), timeout=5000)
    end.set()
    qtbot.waitUntil(lambda: not window.busy_bar.isVisible(), timeout=5000)


def test_garbage_is_collected_in_the_windows_thread_only(window: MainWindow, qtbot) -> None:
    # elsewhere a Qt object in a cycle would end outside its thread, which aborts the program now and then
    ended: list[threading.Thread] = []

    class Knot:
        def __init__(self) -> None:
            self.itself = self

        def __del__(self) -> None:
            ended.append(threading.current_thread())

    def work(progress: Callable[[int, int], None]) -> None:
        for _ in range(20_000):
            Knot()

    window.workers.run("Knots", work, lambda _: None)
    qtbot.waitUntil(lambda: len(ended) > 1000, timeout=30_000)
    assert set(ended) == {threading.main_thread()}


def test_theme_changes_over_the_same_state(window: MainWindow, laid_out: LayoutView, wait: Wait) -> None:
    window.session.layout.move("T1", east=70.0)
    wait(window)
    before = window.settings.theme
    window.switch_theme()
    wait(window, lambda: layout_of(window).map is not None)
    assert layout_of(window) is not laid_out
    assert window.settings.theme != before
    assert window.preferences.load().theme == window.settings.theme
    assert window.current() == "layout"
    assert layout_of(window).place[0].value() == 70.0


def test_closing_during_work_ends_it(preferences: Preferences, files: dict[str, Path], qtbot, wait: Wait) -> None:
    window = MainWindow(preferences)
    qtbot.addWidget(window)
    window.show()
    window.open_path(files["scenario"])
    wait(window, lambda: layout_of(window).map is not None)
    view = layout_of(window)
    view.starts.setValue(500)
    view.separation.setValue(0.0)
    view.run_button.click()
    jobs = window.workers.jobs
    assert jobs
    window.close()
    assert not window.workers.jobs
    assert all(job.is_cancelled for job in jobs)
    # a search goes on to the end of its present start, heard by nobody
    assert all(job.wait(60.0) for job in jobs)
    qtbot.wait(50)
    assert window.session.layout.transmitters == window.session.layout.scenario.transmitter


def test_closing_while_a_recording_is_read(preferences: Preferences, files: dict[str, Path], qtbot) -> None:
    window = MainWindow(preferences)
    qtbot.addWidget(window)
    window.show()
    window.open_path(files["recording"])
    qtbot.waitUntil(lambda: window.session.document is not None, timeout=30_000)
    window.close()  # spectrum, levels and phases are under way
    qtbot.wait(50)
    assert not window.workers.jobs


def test_keys_walk_through_views_frames_and_transmitters(
    window: MainWindow, files: dict[str, Path], qtbot, wait: Wait
) -> None:
    window.open_path(files["result"])
    wait(window, lambda: window.session.document is not None)
    qtbot.keyClick(window, Qt.Key.Key_1, Qt.KeyboardModifier.ControlModifier)
    assert window.current() == "recording"
    qtbot.keyClick(window, Qt.Key.Key_PageDown)
    assert window.session.selection.frame == 1
    qtbot.keyClick(window, Qt.Key.Key_BracketRight)
    qtbot.keyClick(window, Qt.Key.Key_BracketRight)
    assert window.session.selection.transmitter == 1
    qtbot.keyClick(window, Qt.Key.Key_W, Qt.KeyboardModifier.ControlModifier)
    assert window.pages.currentWidget() is window.welcome


def test_tracking_run_is_played_and_scrubbed(
    window: MainWindow, tmp_path_factory: pytest.TempPathFactory, qtbot, wait: Wait
) -> None:
    from rfpose.pipeline.demo import shipped_scenario
    from rfpose.pipeline.track import track

    path = tmp_path_factory.mktemp("track") / "day.h5"
    hours = {"first_hour": 11.0, "last_hour": 12.0}
    short = load_scenario(shipped_scenario("tracking_100m.toml")).changed(tracking=hours)
    run = track(short, path, methods=["open-loop", "encoder"], heliostats=6)
    window.open_path(path)
    wait(window, lambda: window.session.document is not None)
    assert window.current() == "tracking"
    view = window.views["tracking"]
    assert isinstance(view, TrackingView)
    view.choose_method("encoder")
    assert view.table.rowCount() == 2
    view.position.setValue(len(run.unix_s) - 5)
    assert window.session.playback.frame == len(run.unix_s) - 5
    error = 1e3 * run.methods["encoder"].series["error_rad"][len(run.unix_s) - 5]
    picture = window.session.document.track.at("encoder", len(run.unix_s) - 5)
    np.testing.assert_allclose(picture.error_mrad, error)
    view.play.click()
    qtbot.waitUntil(lambda: window.session.playback.frame == len(run.unix_s) - 1, timeout=10_000)
    assert not window.session.playback.playing
    assert view.play.text() == "Play"


def test_a_result_that_is_made_is_followed_to_its_end(window, wait, files: dict[str, Path], tmp_path: Path) -> None:
    output, frames = tmp_path / "live.h5", []

    def stop_after_two(result) -> None:
        frames.append(result)
        if len(frames) == 2:
            raise KeyboardInterrupt

    window.follow_path(output)
    assert "waiting for its first frame" in window.session.message.text
    with pytest.raises(KeyboardInterrupt):
        process(Follow(files["recording"], on_frame=stop_after_two), output)
    wait(window, lambda: window.session.document is not None)
    assert (window.session.document.n_frame, window.session.selection.frame) == (2, 1)
    window.session.select(heliostat=1)
    process(Follow(files["recording"]), output)
    wait(window, lambda: window.session.document.path == output)
    assert (window.session.document.n_frame, window.session.selection.frame) == (3, 2)
    assert window.session.selection.heliostat == 1
    assert window.current() == "field"
