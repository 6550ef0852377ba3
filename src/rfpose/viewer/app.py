"""Starting the viewer, and saying in one line what is missing where it cannot start."""

from __future__ import annotations

import ctypes
import importlib.util
import logging
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rfpose.errors import RfposeError, install_remedy

if TYPE_CHECKING:
    from PySide6.QtWidgets import QApplication

__all__ = ["check_display", "check_installed", "make_application", "run"]

_log = logging.getLogger(__name__)

DEBIAN_PACKAGES = {
    "libEGL.so": "libegl1",
    "libGL.so": "libgl1",
    "libxkbcommon.so": "libxkbcommon0",
    "libxkbcommon-x11.so": "libxkbcommon-x11-0",
    "libfontconfig.so": "libfontconfig1",
    "libdbus-1.so": "libdbus-1-3",
    "libglib-2.0.so": "libglib2.0-0",
    "libgthread-2.0.so": "libglib2.0-0",
    "libxcb-cursor.so": "libxcb-cursor0",
    "libxcb-icccm.so": "libxcb-icccm4",
    "libxcb-image.so": "libxcb-image0",
    "libxcb-keysyms.so": "libxcb-keysyms1",
    "libxcb-randr.so": "libxcb-randr0",
    "libxcb-render-util.so": "libxcb-render-util0",
    "libxcb-shape.so": "libxcb-shape0",
    "libxcb-xinerama.so": "libxcb-xinerama0",
    "libxcb-xkb.so": "libxcb-xkb1",
    "libX11-xcb.so": "libx11-xcb1",
}
"""Debian package of each library that Qt loads and a bare machine may lack."""

SCREEN_PACKAGES = (
    "libxcb-cursor0 libxcb-icccm4 libxcb-image0 libxcb-keysyms1 libxcb-randr0 libxcb-render-util0 libxcb-shape0 "
    "libxcb-xkb1 libxkbcommon-x11-0 libx11-xcb1"
)
_WITHOUT_SCREEN = "pictures need no screen: rfpose view FILE --save out.png"


def check_installed() -> None:
    """Make sure that PySide6 and pyqtgraph are there and can be loaded.

    Raises
    ------
    RfposeError
        What to install.
    """
    missing = [name for name in ("PySide6", "pyqtgraph") if importlib.util.find_spec(name) is None]
    if missing:
        raise RfposeError(f"the viewer needs {' and '.join(missing)}; install them, {install_remedy('gui')}")
    import PySide6

    if sys.version_info < (3, 12) and PySide6.__version__.startswith("6.12.0"):
        # built for interpreters whose None is never counted: an older one dies after some thousand calls
        raise RfposeError("PySide6 6.12.0 crashes Python 3.11; install another: pip install 'PySide6-Essentials<6.12'")
    try:
        from PySide6 import QtSvg, QtWidgets  # noqa: F401
    except ImportError as error:
        raise RfposeError(_missing_library(str(error))) from error


def _missing_library(text: str) -> str:
    found = re.search(r"(lib[\w.+-]+?\.so)[\w.]*: cannot open shared object", text)
    if found is None:
        return f"PySide6 cannot be loaded ({text}); install it anew: pip install --force-reinstall PySide6-Essentials"
    package = DEBIAN_PACKAGES.get(found.group(1))
    remedy = f"apt install {package}" if package else f"install the system package that holds {found.group(1)}"
    return f"Qt lacks the library {found.group(1)}; install it (Debian, Ubuntu: {remedy})"


def check_display() -> None:
    """Make sure that there is a screen to open a window on; Qt itself would abort the program.

    Raises
    ------
    RfposeError
        No screen, one that does not answer, or libraries that are missing.
    """
    if not sys.platform.startswith("linux") or os.environ.get("QT_QPA_PLATFORM", "").split(":")[0] not in ("", "xcb"):
        return
    wayland, x11 = os.environ.get("WAYLAND_DISPLAY"), os.environ.get("DISPLAY")
    if wayland and (Path(os.environ.get("XDG_RUNTIME_DIR", "/")) / wayland).exists():
        return
    if not x11:
        raise RfposeError(
            "no screen: neither DISPLAY nor WAYLAND_DISPLAY is set; log in with a desktop or `ssh -X` "
            f"({_WITHOUT_SCREEN})"
        )
    import PySide6

    plugin = Path(next(iter(PySide6.__path__))) / "Qt" / "plugins" / "platforms" / "libqxcb.so"
    try:
        ctypes.CDLL(str(plugin))
    except OSError as error:
        raise RfposeError(
            f"{_missing_library(str(error))}; all that a window needs: apt install {SCREEN_PACKAGES}"
        ) from error
    try:
        xcb = ctypes.CDLL("libxcb.so.1")
    except OSError:
        return
    xcb.xcb_connect.restype = ctypes.c_void_p
    xcb.xcb_connection_has_error.argtypes = [ctypes.c_void_p]
    xcb.xcb_disconnect.argtypes = [ctypes.c_void_p]
    connection = xcb.xcb_connect(None, None)
    refused = xcb.xcb_connection_has_error(connection)
    xcb.xcb_disconnect(connection)
    if refused:
        raise RfposeError(f"the screen DISPLAY={x11} does not answer; check it and its rights ({_WITHOUT_SCREEN})")


def make_application(*, offscreen: bool = False) -> QApplication:
    """Return the application, made if there is none yet."""
    if offscreen:
        os.environ["QT_QPA_PLATFORM"] = "offscreen"
    from PySide6.QtCore import qInstallMessageHandler
    from PySide6.QtWidgets import QApplication

    from rfpose.viewer.theme import ensure_font

    found = QApplication.instance()
    if found is None and offscreen:
        # what Qt's own stand-in for a screen cannot do is no news to who asks for a picture
        qInstallMessageHandler(lambda _kind, _context, text: _log.debug("Qt: %s", text))
    app = found if isinstance(found, QApplication) else QApplication([sys.argv[0]])
    app.setApplicationName("rfpose")
    app.setApplicationDisplayName("rfpose")
    ensure_font(app)
    return app


def run(
    path: Path | None = None,
    *,
    scenario_path: Path | None = None,
    theme: str | None = None,
    size: tuple[int, int] | None = None,
    follow_links: bool = False,
    follow: bool = False,
) -> int:
    """Open the window and return its exit code when it is closed; ``follow``: show frames as they come.

    Raises
    ------
    RfposeError
        The extra, a library or a screen is missing; the message says what to do.
    """
    check_installed()
    check_display()
    app = make_application()
    from dataclasses import replace

    from rfpose.viewer.preferences import Preferences
    from rfpose.viewer.window import MainWindow

    preferences = Preferences()
    if theme is not None:
        preferences.save(replace(preferences.load(), theme=theme))
    window = MainWindow(preferences)
    if size is not None and preferences.geometry() is None:
        window.resize(*size)
    window.show()
    if path is not None and follow:
        window.follow_path(path)
    elif path is not None:
        window.open_path(path, scenario_path=scenario_path, follow_links=follow_links)
    return int(app.exec())
