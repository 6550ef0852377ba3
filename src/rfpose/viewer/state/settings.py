"""What the viewer remembers between runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

__all__ = ["THEMES", "Settings"]

THEMES = ("dark", "light")
_RECENT = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Remembered choices; what cannot be read back is left at its default.

    Attributes
    ----------
    theme
        ``dark`` or ``light``.
    recent
        Files opened last, newest first.
    view
        The view shown last.
    directory
        Where the last file was chosen.
    """

    theme: str = "light"
    recent: tuple[str, ...] = ()
    view: str = ""
    directory: str = ""

    def opened(self, path: str | Path) -> Settings:
        """Return settings with a file put first among the recent ones."""
        name = str(Path(path).absolute())
        rest = tuple(item for item in self.recent if item != name)
        return replace(self, recent=(name, *rest)[:_RECENT], directory=str(Path(name).parent))

    def as_dict(self) -> dict[str, Any]:
        """Return plain values by name."""
        return {
            f.name: list(value) if isinstance(value := getattr(self, f.name), tuple) else value for f in fields(self)
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Settings:
        """Return settings from what was stored, whatever that is."""
        found: dict[str, Any] = {}
        if data.get("theme") in THEMES:
            found["theme"] = data["theme"]
        recent = data.get("recent")
        if isinstance(recent, str):
            recent = [recent]
        if isinstance(recent, list | tuple):
            found["recent"] = tuple(item for item in recent if isinstance(item, str) and item)[:_RECENT]
        for name in ("view", "directory"):
            if isinstance(data.get(name), str):
                found[name] = data[name]
        return cls(**found)
