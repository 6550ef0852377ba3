"""The first thing one sees: what can be opened, and what was opened last."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QHBoxLayout, QLabel, QListWidget, QListWidgetItem, QPushButton, QVBoxLayout, QWidget

from rfpose import __version__
from rfpose.viewer.theme import Theme

__all__ = ["Welcome"]

_KINDS = (
    ("A recording", "rfpose-iq (.h5), a Digital RF directory, SigMF: spectrum, waterfall, phases"),
    ("A result", "what rfpose process writes: every mirror's pose, error, covariance, exclusions"),
    ("A tracking run", "what rfpose track writes: mirrors, beams and the methods' errors, played over the day"),
    ("A scenario", "a site in TOML: drag its transmitters and see what the mirrors can be known to"),
)


class Welcome(QWidget):
    """Buttons to open something, recent files, a hint about dropping."""

    def __init__(
        self,
        theme: Theme,
        *,
        open_file: Callable[[], None],
        open_directory: Callable[[], None],
        open_example: Callable[[], None],
        open_path: Callable[[str], None],
    ) -> None:
        super().__init__()
        self._open_path = open_path
        title = QLabel("rfpose")
        title.setStyleSheet("font-size: 30px; font-weight: 600;")
        version = QLabel(f"version {__version__}: where heliostat mirrors point, measured by radio")
        version.setStyleSheet(f"color: {theme.muted};")
        kinds = QLabel(
            "<table cellspacing='6'>"
            + "".join(f"<tr><td><b>{a}</b></td><td>{b}</td></tr>" for a, b in _KINDS)
            + "</table>"
        )
        kinds.setWordWrap(True)
        buttons = QHBoxLayout()
        for label, action in (
            ("Open a file…  (Ctrl+O)", open_file),
            ("Open a directory…  (Ctrl+Shift+O)", open_directory),
            ("Open the example site  (Ctrl+E)", open_example),
        ):
            button = QPushButton(label)
            button.setMinimumHeight(34)
            button.clicked.connect(lambda _=False, action=action: action())
            buttons.addWidget(button)
        buttons.addStretch(1)
        self.recent = QListWidget()
        self.recent.setMaximumHeight(220)
        self.recent.itemActivated.connect(self._chosen)
        self.recent.itemClicked.connect(self._chosen)
        self.recent_label = QLabel("Opened before")
        hint = QLabel("Or drop a file or a directory anywhere on this window. F1 lists the keys.")
        hint.setStyleSheet(f"color: {theme.muted};")
        inner = QWidget()
        inner.setMaximumWidth(900)
        column = QVBoxLayout(inner)
        for text in (title, version, kinds):
            column.addWidget(text)
        column.addLayout(buttons)
        column.addSpacing(12)
        for widget in (self.recent_label, self.recent, hint):
            column.addWidget(widget)
        page = QVBoxLayout(self)
        page.addStretch(1)
        page.addWidget(inner, 0, Qt.AlignmentFlag.AlignHCenter)
        page.addStretch(2)

    def show_recent(self, paths: tuple[str, ...]) -> None:
        """List what was opened before, newest first; files that are gone are greyed out."""
        self.recent.clear()
        for path in paths:
            item = QListWidgetItem(path)
            item.setData(Qt.ItemDataRole.UserRole, path)
            if not Path(path).exists():
                item.setFlags(Qt.ItemFlag.NoItemFlags)
                item.setText(f"{path}  (not there any more)")
            self.recent.addItem(item)
        self.recent.setVisible(bool(paths))
        self.recent_label.setVisible(bool(paths))

    def _chosen(self, item: QListWidgetItem) -> None:
        path = item.data(Qt.ItemDataRole.UserRole)
        if isinstance(path, str):
            self._open_path(path)
