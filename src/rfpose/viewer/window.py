"""The window: tabs of views, menus, messages, progress; files come by menu, drop or command line."""

from __future__ import annotations

import html
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from PySide6.QtCore import QFileSystemWatcher, Qt, QTimer
from PySide6.QtGui import QAction, QCloseEvent, QDragEnterEvent, QDropEvent, QKeySequence
from PySide6.QtWidgets import (
    QApplication,
    QFileDialog,
    QHBoxLayout,
    QLabel,
    QMainWindow,
    QMessageBox,
    QProgressBar,
    QPushButton,
    QStackedWidget,
    QTabWidget,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from rfpose import __version__
from rfpose.pipeline.demo import shipped_scenario
from rfpose.pipeline.pictures.spectra import prepare
from rfpose.viewer.preferences import Preferences
from rfpose.viewer.state.document import Document, Followed, open_document
from rfpose.viewer.state.session import Session
from rfpose.viewer.theme import apply, theme_of
from rfpose.viewer.views.field import FieldView
from rfpose.viewer.views.layout import LayoutView
from rfpose.viewer.views.live import LiveView
from rfpose.viewer.views.parts import View
from rfpose.viewer.views.recording import RecordingView
from rfpose.viewer.views.tracking import TrackingView
from rfpose.viewer.views.welcome import Welcome
from rfpose.viewer.workers import Workers

__all__ = ["VIEWS", "MainWindow"]

VIEWS: tuple[type[View], ...] = (RecordingView, FieldView, LayoutView, TrackingView, LiveView)
_FIRST_VIEW = {"recording": "recording", "result": "field", "scenario": "layout", "track": "tracking"}
_FILES = "All of ours (*.h5 *.hdf5 *.toml *.sigmf-meta *.sigmf-data);;All files (*)"
_BUSY_AFTER_MS = 250
_LOOK_MS = 300
"""Between two looks at a result that is followed."""
_OFTEN = ("Map", "Getting ready", "Live")
"""Jobs that come with every drag or second: their progress is shown only where they last."""
_LONG_S = 1.0
_KEYS = (
    ("Ctrl+O, Ctrl+Shift+O", "open a file, a directory"),
    ("F5", "read the open file again"),
    ("Ctrl+1 … Ctrl+5", "go to a view"),
    ("Page Up, Page Down", "frame before, frame after"),
    ("Space", "play, pause (tracking)"),
    ("[ and ]", "transmitter before, transmitter after"),
    ("Ctrl+Z, Ctrl+Shift+Z", "undo, redo (layout)"),
    ("A, Delete", "add, remove a transmitter (layout)"),
    ("Ctrl+S", "save the layout as a scenario"),
    ("Ctrl+P", "save this view as a picture"),
    ("Ctrl+T", "dark or light"),
    ("Escape", "dismiss the message; cancel what is under way"),
    ("Ctrl+W, Ctrl+Q", "close the file, quit"),
)


class MainWindow(QMainWindow):
    """Everything the viewer shows.

    Parameters
    ----------
    preferences
        Where settings are remembered.
    """

    def __init__(self, preferences: Preferences) -> None:
        super().__init__()
        self.preferences = preferences
        self.settings = preferences.load()
        self.session = Session()
        self.workers = Workers(self.fail, self)
        self.views: dict[str, View] = {}
        self._opening: str | None = None
        self._follow_links = False
        self._followed: Followed | None = None
        self._look_timer = QTimer(self, interval=_LOOK_MS)
        self._look_timer.timeout.connect(self._look)
        self._disconnect: list[Callable[[], None]] = [
            self.session.opened.connect(self._on_opened),
            self.session.said.connect(self._show_message),
        ]
        self.setWindowTitle("rfpose")
        self.setAcceptDrops(True)
        self.resize(1280, 800)
        geometry = preferences.geometry()
        if geometry is not None:
            self.restoreGeometry(geometry)
        self._watcher = QFileSystemWatcher(self)
        self._watcher.fileChanged.connect(self._file_changed)
        self._watcher.directoryChanged.connect(self._file_changed)
        self._build_status()
        self._build_menu()
        self._build_pages()
        self.workers.changed.connect(self._busy_timer.start)
        self.workers.progressed.connect(self._show_busy)
        self.workers.run("Getting ready", lambda _: prepare(), lambda _: None)

    # -- building ----------------------------------------------------------------------------------------

    def _build_pages(self) -> None:
        app = QApplication.instance()
        theme = theme_of(self.settings.theme)
        if isinstance(app, QApplication):
            apply(app, theme)
        for view in self.views.values():
            view.release()
        self.message_bar = QWidget()
        self.message_bar.setAutoFillBackground(True)
        row = QHBoxLayout(self.message_bar)
        row.setContentsMargins(10, 4, 4, 4)
        self.message_label = QLabel()
        self.message_label.setWordWrap(True)
        self.message_label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        close = QToolButton()
        close.setText("×")
        close.setToolTip("Dismiss (Escape)")
        close.clicked.connect(lambda: self.session.dismiss())
        row.addWidget(self.message_label, 1)
        row.addWidget(close)
        self.welcome = Welcome(
            theme,
            open_file=self.ask_file,
            open_directory=self.ask_directory,
            open_example=self.open_example,
            open_path=self.open_path,
        )
        self.welcome.show_recent(self.settings.recent)
        self.views = {kind.name: kind(self.session, self.workers, theme) for kind in VIEWS}
        self.tabs = QTabWidget()
        self.tabs.setDocumentMode(True)
        for view in self.views.values():
            self.tabs.addTab(view, view.title)
        self.pages = QStackedWidget()
        self.pages.addWidget(self.welcome)
        self.pages.addWidget(self.tabs)
        centre = QWidget()
        column = QVBoxLayout(centre)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(0)
        column.addWidget(self.message_bar)
        column.addWidget(self.pages, 1)
        self.setCentralWidget(centre)
        self._show_message()
        self._show_page()

    def _build_status(self) -> None:
        self.busy_label = QLabel()
        self.busy_bar = QProgressBar()
        self.busy_bar.setMaximumWidth(160)
        self.busy_bar.setMaximumHeight(14)
        self.busy_bar.setTextVisible(False)
        self.busy_cancel = QPushButton("Cancel")
        self.busy_cancel.clicked.connect(lambda: self.cancel())
        for widget in (self.busy_label, self.busy_bar, self.busy_cancel):
            self.statusBar().addPermanentWidget(widget)
            widget.hide()
        self.file_label = QLabel()
        self.statusBar().addWidget(self.file_label)
        self._busy_timer = QTimer(self, singleShot=True, interval=_BUSY_AFTER_MS)
        self._busy_timer.timeout.connect(self._show_busy)

    def _build_menu(self) -> None:
        def action(menu: str, text: str, keys: str, slot: Callable[[], object]) -> QAction:
            item = QAction(text, self)
            if keys:
                item.setShortcut(QKeySequence(keys))
            item.triggered.connect(lambda: slot())
            menus[menu].addAction(item)
            return item

        menus = {name: self.menuBar().addMenu(f"&{name}") for name in ("File", "Edit", "View", "Help")}
        action("File", "Open file…", "Ctrl+O", self.ask_file)
        action("File", "Open directory…", "Ctrl+Shift+O", self.ask_directory)
        action("File", "Open the example site", "Ctrl+E", self.open_example)
        action("File", "Scenario for this recording…", "", self.ask_scenario)
        self.reload_action = action("File", "Read again", "F5", self.reload)
        menus["File"].addSeparator()
        action("File", "Save view as picture…", "Ctrl+P", self.ask_picture)
        action("File", "Save layout as scenario…", "Ctrl+S", self._ask_layout)
        menus["File"].addSeparator()
        action("File", "Close file", "Ctrl+W", self.close_document)
        action("File", "Quit", "Ctrl+Q", self.close)
        action("Edit", "Undo", "Ctrl+Z", lambda: self._layout().undo())
        action("Edit", "Redo", "Ctrl+Shift+Z", lambda: self._layout().redo())
        action("Edit", "Add transmitter", "A", lambda: self._in_layout(self._layout().add))
        action("Edit", "Remove transmitter", "Del", lambda: self._in_layout(self._layout().remove))
        for k, kind in enumerate(VIEWS):
            action("View", kind.title, f"Ctrl+{k + 1}", lambda name=kind.name: self.go_to(name))  # type: ignore[misc]
        action("View", "Frame before", "PgUp", lambda: self._step(-1))
        action("View", "Frame after", "PgDown", lambda: self._step(1))
        action("View", "Transmitter before", "[", lambda: self._next_transmitter(-1))
        action("View", "Transmitter after", "]", lambda: self._next_transmitter(1))
        action("View", "Play or pause", "Space", lambda: self.session.playback.toggle())
        action("View", "Dark or light", "Ctrl+T", self.switch_theme)
        action("View", "Dismiss, cancel", "Escape", self._escape)
        action("Help", "Keys", "F1", self.show_keys)
        action("Help", "About", "", self._about)

    def _layout(self) -> LayoutView:
        view = self.views["layout"]
        assert isinstance(view, LayoutView)
        return view

    def _in_layout(self, do: Callable[[], None]) -> None:
        if self.current() == "layout":
            do()

    # -- files -------------------------------------------------------------------------------------------

    def open_path(
        self, path: str | Path, *, scenario_path: str | Path | None = None, follow_links: bool = False
    ) -> None:
        """Open a file in the background; what goes wrong becomes a message."""
        path = Path(path)
        self._opening = str(path)
        self._follow_links = follow_links
        self._stop_following()
        self.workers.cancel()
        self.workers.run(
            "Opening",
            lambda _: open_document(path, scenario_path=scenario_path, follow_links=follow_links),
            self._opened,
            failed=self._open_failed,
        )

    def _opened(self, document: Document) -> None:
        self._opening = None
        self.settings = self.settings.opened(document.path)
        self.preferences.save(self.settings)
        self.welcome.show_recent(self.settings.recent)
        self.session.show(document)

    def _open_failed(self, text: str) -> None:
        self._opening = None
        self.fail(text)

    def close_document(self) -> None:
        """Go back to the first page."""
        self._stop_following()
        self.workers.cancel()
        self.session.show(None)

    def reload(self) -> None:
        """Read the open file again; what was selected stays if it is still there."""
        document = self.session.document
        if document is None:
            return
        path = document.path
        self.workers.cancel()
        self.workers.run(
            "Opening",
            lambda _: open_document(path, follow_links=self._follow_links),
            self._opened_again,
            failed=self._open_failed,
        )

    def _opened_again(self, fresh: Document) -> None:
        before, selection, current = self.session.document, self.session.selection, self.current()
        at_end = before is None or selection.frame == before.n_frame - 1
        if self._followed is None:
            self._opened(fresh)
        else:
            self._opening = None
            self.session.show(fresh)
        self.session.select(
            receiver=selection.receiver,
            transmitter=selection.transmitter,
            frame=fresh.n_frame - 1 if self._followed is not None and at_end else selection.frame,
            heliostat=selection.heliostat,
        )
        if before is not None:
            self.go_to(current)

    # -- a result that is being made ---------------------------------------------------------------------

    def follow_path(self, path: str | Path) -> None:
        """Show a result and, as they come, its new frames; who looks at the last frame goes on to the next."""
        self.close_document()
        self._followed = Followed(path)
        self._look_timer.start()
        self.session.tell(f"{path}: waiting for its first frame")
        self._look()

    def _stop_following(self) -> None:
        self._followed = None
        self._look_timer.stop()

    def _look(self) -> None:
        if self._followed is None or self._opening is not None or not self._followed.has_changed():
            return
        path = self._followed.shown
        if self._followed.complete:
            self._look_timer.stop()
        self._opening = str(path)
        self.workers.run(
            "Live", lambda _: open_document(path), self._opened_again, key="follow", failed=self._open_failed
        )

    def open_example(self) -> None:
        """Open the site that comes with rfpose."""
        self.open_path(shipped_scenario("table2_100m.toml"))

    def ask_file(self) -> None:
        """Let the user choose a file."""
        path, _ = QFileDialog.getOpenFileName(self, "Open", self.settings.directory, _FILES)
        if path:
            self.open_path(path)

    def ask_directory(self) -> None:
        """Let the user choose a directory (Digital RF, SigMF)."""
        path = QFileDialog.getExistingDirectory(self, "Open a recording's directory", self.settings.directory)
        if path:
            self.open_path(path)

    def ask_scenario(self) -> None:
        """Let the user choose the site of the open recording."""
        document = self.session.document
        if document is None or document.recording is None:
            self.session.tell("open a recording first; then choose its scenario", is_error=True)
            return
        path, _ = QFileDialog.getOpenFileName(self, "Scenario", self.settings.directory, "Scenarios (*.toml)")
        if path:
            self.open_path(document.path, scenario_path=path)

    def ask_picture(self) -> None:
        """Let the user choose where this view goes as a picture."""
        path, _ = QFileDialog.getSaveFileName(
            self, "Save view as picture", f"{self.current()}.png", "Pictures (*.png *.svg)"
        )
        if path:
            self.save_picture(path)

    def save_picture(self, path: str | Path) -> None:
        """Write the current view as PNG or SVG."""
        from rfpose.errors import RfposeError
        from rfpose.viewer.export import save_widget

        try:
            save_widget(self.views[self.current()], Path(path))
        except RfposeError as error:
            self.fail(str(error))
        else:
            self.session.tell(f"saved {path}")

    def _ask_layout(self) -> None:
        if self.session.layout is None:
            self.session.tell("open a scenario, or a file that brings one, before saving a layout", is_error=True)
        else:
            self._layout()._ask_save()

    def _file_changed(self, path: str) -> None:
        document = self.session.document
        if document is None or self._opening is not None or self._followed is not None:
            return
        if not document.path.exists():
            self.session.tell(
                f"{document.path}: has vanished; what is shown was read before. Put it back and press F5, or open "
                "another file",
                is_error=True,
            )
        else:
            self.session.tell(f"{document.path.name} has changed on the disk; press F5 to read it again")
            if path not in self._watcher.files() and Path(path).is_file():
                self._watcher.addPath(path)

    # -- what happens ------------------------------------------------------------------------------------

    def _on_opened(self) -> None:
        document = self.session.document
        watched = [*self._watcher.files(), *self._watcher.directories()]
        if watched:
            self._watcher.removePaths(watched)
        if document is not None:
            self._watcher.addPath(str(document.path))
        self._show_page()
        if document is not None:
            self.go_to(_FIRST_VIEW[document.kind])

    def _show_page(self) -> None:
        document = self.session.document
        self.pages.setCurrentWidget(self.welcome if document is None else self.tabs)
        for k, view in enumerate(self.views.values()):
            self.tabs.setTabEnabled(k, view.applies())
        self.setWindowTitle("rfpose" if document is None else f"{document.path.name} – rfpose")
        self.file_label.setText("" if document is None else f"{document.kind}: {document.path}")

    def current(self) -> str:
        """Name of the view that is shown."""
        view = self.tabs.currentWidget()
        return view.name if isinstance(view, View) else ""

    def go_to(self, name: str) -> None:
        """Show a view if it has something to show."""
        view = self.views.get(name)
        if view is not None and view.applies():
            self.tabs.setCurrentWidget(view)

    def switch_theme(self) -> None:
        """From dark to light, or back; all views are made anew over the same state."""
        self.settings = replace(self.settings, theme="light" if self.settings.theme == "dark" else "dark")
        self.preferences.save(self.settings)
        current = self.current()
        self.workers.cancel()
        self._build_pages()
        self.go_to(current)

    def fail(self, text: str) -> None:
        """Say what went wrong."""
        self.session.tell(text, is_error=True)

    def cancel(self) -> None:
        """End what is under way."""
        names = [job.name for job in self.workers.jobs]
        if "Optimiser" in names:
            self._layout().cancel()
        self.workers.cancel()
        if names:
            self.session.tell(f"cancelled: {', '.join(names)}; F5 starts again")

    def _escape(self) -> None:
        if self.workers.jobs:
            self.cancel()
        else:
            self.session.dismiss()

    def _step(self, by: int) -> None:
        if self.current() == "tracking":
            self.session.playback.step(by)
            return
        self.session.select(frame=self.session.selection.frame + by)

    def _next_transmitter(self, by: int) -> None:
        document = self.session.document
        if document is None or document.scenario is None:
            return
        n, now = len(document.scenario.transmitter), self.session.selection.transmitter
        self.session.select(transmitter=(0 if now is None else now + by) % n)

    def _show_message(self) -> None:
        message = self.session.message
        self.message_bar.setVisible(message is not None)
        if message is None:
            return
        theme = theme_of(self.settings.theme)
        colour = theme.warning if message.is_error else theme.accent
        self.message_bar.setStyleSheet(f"background: {theme.base}; border-left: 4px solid {colour};")
        self.message_label.setStyleSheet(f"border: none; color: {theme.text};")
        self.message_label.setText(html.escape(message.text))

    def _show_busy(self) -> None:
        now = time.monotonic()
        jobs = [job for job in self.workers.jobs if job.name not in _OFTEN or now - job.begun_s >= _LONG_S]
        if len(jobs) < len(self.workers.jobs):
            self._busy_timer.start()  # they may turn out to be long
        for widget in (self.busy_label, self.busy_bar, self.busy_cancel):
            widget.setVisible(bool(jobs))
        if jobs:
            self.busy_label.setText(", ".join(dict.fromkeys(job.name for job in jobs)))
            done, total = jobs[0].told
            self.busy_bar.setRange(0, total)  # none: it only moves
            self.busy_bar.setValue(done)

    def show_keys(self) -> None:
        """List the keys."""
        rows = "".join(f"<tr><td><b>{keys}</b>&nbsp;&nbsp;</td><td>{text}</td></tr>" for keys, text in _KEYS)
        box = QMessageBox(self)
        box.setWindowTitle("Keys")
        box.setText(f"<table>{rows}</table>")
        box.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        box.open()

    def _about(self) -> None:
        self.session.tell(f"rfpose {__version__}: where heliostat mirrors point, measured by radio (MIT licence)")

    # -- Qt ----------------------------------------------------------------------------------------------

    def dragEnterEvent(self, event: QDragEnterEvent) -> None:  # noqa: N802 -- Qt's name
        """Take files."""
        if event.mimeData().hasUrls():
            event.acceptProposedAction()

    def dropEvent(self, event: QDropEvent) -> None:  # noqa: N802 -- Qt's name
        """Open the first file that was dropped."""
        paths = [url.toLocalFile() for url in event.mimeData().urls() if url.isLocalFile()]
        if not paths:
            self.fail("only files of this computer can be dropped here")
            return
        event.acceptProposedAction()
        self.open_path(paths[0])
        if len(paths) > 1:
            self.session.tell(f"opening {Path(paths[0]).name}; one file at a time")

    def closeEvent(self, event: QCloseEvent) -> None:  # noqa: N802 -- Qt's name
        """Remember where the window is, end all work, let go of the file."""
        self.preferences.save_geometry(self.saveGeometry())
        self.preferences.save(replace(self.settings, view=self.current()))
        self.workers.stop()
        for view in self.views.values():
            view.release()
        while self._disconnect:
            self._disconnect.pop()()
        if self.session.document is not None:
            self.session.document.close()
        event.accept()
