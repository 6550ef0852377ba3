"""Views as pictures, and a result as one HTML file, without a screen."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rfpose.errors import InvalidInputError, RfposeError
from rfpose.files import write_atomically

if TYPE_CHECKING:
    from PySide6.QtWidgets import QApplication, QWidget

    from rfpose.viewer.window import MainWindow

__all__ = ["FORMATS", "VIEW_NAMES", "export", "open_window", "save_widget", "settle"]

FORMATS = (".png", ".svg", ".html")
VIEW_NAMES = ("recording", "field", "layout", "tracking", "live")
_TIMEOUT_S = 300.0
_QUIET_S = 0.35
"""Longer than any timer that views start work by."""


def save_widget(widget: QWidget, path: Path) -> None:
    """Write what a widget shows as PNG or SVG.

    Raises
    ------
    InvalidInputError
        ``path`` ends neither in .png nor in .svg.
    RecordingError
        It cannot be written.
    """
    if path.suffix == ".svg":
        write_atomically(path, _svg(widget))
    elif path.suffix == ".png":
        write_atomically(path, png_of(widget))
    else:
        raise InvalidInputError(f"`path` must end in .png or .svg, got {path.name}")


def png_of(widget: QWidget) -> bytes:
    """Return what a widget shows as PNG."""
    from PySide6.QtCore import QBuffer, QByteArray, QIODevice

    data = QByteArray()
    buffer = QBuffer(data)
    buffer.open(QIODevice.OpenModeFlag.WriteOnly)
    widget.grab().save(buffer, "PNG")
    return bytes(data.data())


def _svg(widget: QWidget) -> bytes:
    from PySide6.QtCore import QBuffer, QByteArray, QIODevice, QPoint
    from PySide6.QtGui import QPainter
    from PySide6.QtSvg import QSvgGenerator

    data = QByteArray()
    buffer = QBuffer(data)
    buffer.open(QIODevice.OpenModeFlag.WriteOnly)
    generator = QSvgGenerator()
    generator.setOutputDevice(buffer)
    generator.setSize(widget.size())
    generator.setViewBox(widget.rect())
    generator.setResolution(widget.logicalDpiX())
    painter = QPainter(generator)
    widget.render(painter, QPoint(0, 0))
    painter.end()
    return bytes(data.data())


def settle(app: QApplication, window: MainWindow, *, timeout_s: float = _TIMEOUT_S) -> None:
    """Let all work that was asked for come to its end, and be drawn.

    Raises
    ------
    RfposeError
        It takes too long.
    """
    end = time.monotonic() + timeout_s
    quiet_since: float | None = None
    while True:
        app.processEvents()
        now = time.monotonic()
        if window.workers.jobs:
            quiet_since = None
            if now > end:
                names = ", ".join(job.name for job in window.workers.jobs)
                raise RfposeError(f"{names}: not done after {timeout_s:g} s; try a smaller file")
        elif quiet_since is None:
            quiet_since = now
        elif now - quiet_since > _QUIET_S:
            return
        time.sleep(0.005)


def open_window(
    path: Path,
    *,
    scenario_path: Path | None = None,
    follow_links: bool = False,
    theme: str = "light",
    size: tuple[int, int] = (1280, 800),
) -> tuple[QApplication, MainWindow]:
    """Open a file in a window that nobody sees; the user's settings are neither read nor changed.

    Raises
    ------
    RfposeError
        The file cannot be opened, as its message says.
    """
    import tempfile

    from PySide6.QtCore import QSettings

    from rfpose.viewer.app import check_installed, make_application

    check_installed()
    app = make_application(offscreen=True)
    from rfpose.viewer.preferences import Preferences
    from rfpose.viewer.state.document import open_document
    from rfpose.viewer.state.settings import Settings
    from rfpose.viewer.window import MainWindow

    document = open_document(path, scenario_path=scenario_path, follow_links=follow_links)
    with tempfile.TemporaryDirectory() as folder:
        preferences = Preferences(QSettings(str(Path(folder) / "viewer.ini"), QSettings.Format.IniFormat))
        preferences.save(Settings(theme=theme))
        window = MainWindow(preferences)
    window.resize(*size)
    window.show()
    window.session.show(document)
    settle(app, window)
    return app, window


def export(
    path: Path,
    output: Path,
    *,
    view: str | None = None,
    scenario_path: Path | None = None,
    follow_links: bool = False,
    theme: str = "light",
    size: tuple[int, int] = (1280, 800),
    heliostat: str | None = None,
    transmitter: str | None = None,
    frame: int = 0,
) -> str:
    """Write a view of a file as .png or .svg, or a report of it as .html; return the view's name.

    Parameters
    ----------
    view
        One of `VIEW_NAMES`; that which the window would open with by default.
    size
        Of the window [pixel].
    heliostat, transmitter, frame
        What is selected.

    Raises
    ------
    InvalidInputError
        Another ending, or a view that has nothing to show for this file.
    RfposeError
        The file cannot be opened, or the picture not written.
    """
    if output.suffix not in FORMATS:
        raise InvalidInputError(f"{output}: a picture must end in {', '.join(FORMATS)}")
    app, window = open_window(path, scenario_path=scenario_path, follow_links=follow_links, theme=theme, size=size)
    try:
        _select(window, heliostat=heliostat, transmitter=transmitter, frame=frame)
        if output.suffix == ".html":
            from rfpose.viewer.report import report_html

            refuse_errors(window)
            write_atomically(output, report_html(app, window).encode())
            return "report"
        if view is not None:
            shown = window.views.get(view)
            if shown is None or not shown.applies():
                raise InvalidInputError(f"{path}: view `{view}` has nothing to show for this file")
            window.go_to(view)
        settle(app, window)
        refuse_errors(window)
        save_widget(window.views[window.current()], output)
        return window.current()
    finally:
        window.close()
        app.processEvents()


def refuse_errors(window: MainWindow) -> None:
    """Raise what a window would say, instead of a picture with something missing."""
    message = window.session.message
    if message is not None and message.is_error:
        raise RfposeError(message.text)


def _select(window: MainWindow, *, heliostat: str | None, transmitter: str | None, frame: int) -> None:
    document = window.session.document
    scenario = None if document is None else document.scenario
    chosen: dict[str, int] = {"frame": frame}
    for key, name, names in (
        ("heliostat", heliostat, () if scenario is None else scenario.heliostat_ids),
        ("transmitter", transmitter, () if scenario is None else scenario.transmitter_ids),
    ):
        if name is None:
            continue
        if name not in names:
            listed = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
            raise InvalidInputError(f"there is no {key} `{name}`; choose one of {listed or 'none: no scenario'}")
        chosen[key] = names.index(name)
    window.session.select(**chosen)
    window.session.playback.scrub(frame)


def picture_tag(app: QApplication, window: MainWindow, widget: QWidget, prepare: Callable[[], None]) -> str:
    """Return an HTML image of a widget after ``prepare``."""
    prepare()
    settle(app, window)
    data = base64.b64encode(png_of(widget)).decode()
    return f'<img alt="" src="data:image/png;base64,{data}">'
