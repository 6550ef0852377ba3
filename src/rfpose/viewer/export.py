"""Windows without a screen, and photographs of what they show."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from rfpose.errors import InvalidInputError, RfposeError
from rfpose.files import write_atomically

if TYPE_CHECKING:
    from PySide6.QtWidgets import QApplication, QWidget

    from rfpose.viewer.window import MainWindow

__all__ = ["VIEW_NAMES", "open_window", "png_of", "save_widget", "settle"]

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
