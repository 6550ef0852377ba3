"""Dark and light, colours that the colour-blind can tell apart, and a font where the system has none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyqtgraph as pg
from PySide6.QtGui import QColor, QFont, QFontDatabase, QPalette
from PySide6.QtWidgets import QApplication

from rfpose.drawing import BLUE, COLOUR_MAP

__all__ = ["Theme", "apply", "colour_table", "ensure_font", "see_through", "theme_of"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Theme:
    """Colours of one theme, as ``#rrggbb``."""

    name: str
    window: str
    base: str
    plot: str
    text: str
    muted: str
    grid: str
    accent: str
    warning: str
    trace: str
    blue: str


def see_through(colour: str) -> QColor:
    """Return a colour that what lies behind still shines through."""
    found = QColor(colour)
    found.setAlpha(190)
    return found


_LIGHT = Theme(
    name="light",
    window="#f3f4f6",
    base="#ffffff",
    plot="#ffffff",
    text="#1b1f24",
    muted="#5d6670",
    grid="#c9ced4",
    accent="#0b62a8",
    warning="#a83c00",
    trace="#3c444d",
    blue=BLUE,
)
_DARK = Theme(
    name="dark",
    window="#22272d",
    base="#323941",
    plot="#15181c",
    text="#e6e9ed",
    muted="#9aa4af",
    grid="#3b434c",
    accent="#4aa3e0",
    warning="#ff9a57",
    trace="#b9c2cc",
    blue="#56B4E9",
)


def theme_of(name: str) -> Theme:
    """Return a theme by name; light where the name says nothing."""
    return _DARK if name == "dark" else _LIGHT


def apply(app: QApplication, theme: Theme) -> None:
    """Put a theme on the application and on plots made from now on."""
    app.setStyle("Fusion")
    palette = QPalette()
    role = QPalette.ColorRole
    for place, colour in (
        (role.Window, theme.window),
        (role.Base, theme.base),
        (role.AlternateBase, theme.window),
        (role.Button, theme.window),
        (role.ToolTipBase, theme.base),
        (role.WindowText, theme.text),
        (role.Text, theme.text),
        (role.ButtonText, theme.text),
        (role.ToolTipText, theme.text),
        (role.PlaceholderText, theme.muted),
        (role.Highlight, theme.accent),
        (role.HighlightedText, "#ffffff"),
        (role.Link, theme.accent),
    ):
        palette.setColor(place, QColor(colour))
    for place in (role.WindowText, role.Text, role.ButtonText):
        palette.setColor(QPalette.ColorGroup.Disabled, place, QColor(theme.muted))
    app.setPalette(palette)
    pg.setConfigOptions(background=theme.plot, foreground=theme.text, antialias=True)


def ensure_font(app: QApplication) -> None:
    """Bring the font that matplotlib ships where the system offers none, so that text is seen anywhere."""
    if QFontDatabase.families():
        return
    import matplotlib

    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for name in ("DejaVuSans.ttf", "DejaVuSans-Bold.ttf", "DejaVuSansMono.ttf"):
        QFontDatabase.addApplicationFont(str(folder / name))
    app.setFont(QFont("DejaVu Sans", 10))


def colour_table(n: int = 256) -> npt.NDArray[np.uint8]:
    """Return the map for quantities (entry, rgb)."""
    table = pg.colormap.get(COLOUR_MAP).getLookupTable(nPts=n)
    return np.asarray(table[:, :3], np.uint8)
