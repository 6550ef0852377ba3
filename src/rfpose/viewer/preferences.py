"""Settings in the place that the system has for them."""

from __future__ import annotations

from PySide6.QtCore import QByteArray, QSettings

from rfpose.viewer.state.settings import Settings

__all__ = ["Preferences"]


class Preferences:
    """Reads and writes `Settings` and the window's place.

    Parameters
    ----------
    store
        Where; the user's own by default.
    """

    def __init__(self, store: QSettings | None = None) -> None:
        self._store = store if store is not None else QSettings("rfpose", "viewer")

    def load(self) -> Settings:
        """Return what was remembered; defaults for the rest."""
        return Settings.from_dict({name: self._store.value(name) for name in ("theme", "recent", "view", "directory")})

    def save(self, settings: Settings) -> None:
        """Remember."""
        for name, value in settings.as_dict().items():
            self._store.setValue(name, value)
        self._store.sync()

    def geometry(self) -> QByteArray | None:
        """Return where the window was; None if unknown."""
        value = self._store.value("geometry")
        return value if isinstance(value, QByteArray) else None

    def save_geometry(self, geometry: QByteArray) -> None:
        """Remember where the window is."""
        self._store.setValue("geometry", geometry)
