"""How objects show themselves: one line for a prompt, a table for a notebook, plain values for JSON."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["Shown", "counted", "html_table", "listed", "number", "plain"]

_MOST_ROWS = 30


class Shown(ABC):
    """What has a headline and a table of figures: a short ``repr``, and a table in notebooks."""

    __slots__ = ()

    @abstractmethod
    def headline(self) -> str:
        """Return what it is and how it went, in one line."""

    @abstractmethod
    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return header and rows of its main figures."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.headline()}>"

    def _repr_html_(self) -> str:
        return html_table(f"{type(self).__name__} {self.headline()}", *self.figures())


def html_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table for a notebook; of many rows the first."""
    from html import escape

    shown = [*rows[:_MOST_ROWS], *([["…"] * len(header)] if len(rows) > _MOST_ROWS else [])]
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in shown)
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    return f"<table><caption>{escape(title)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def listed(names: Sequence[str], most: int = 5) -> str:
    """Return names with commas between; of many the first, and how many there are."""
    more = f", … ({len(names)})" if len(names) > most else ""
    return ", ".join(names[:most]) + more if names else "none"


def counted(n: int, what: str) -> str:
    """Return how many of something there are, in words."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def number(value: float | None, digits: int = 3) -> str:
    """Return a number of so many digits for a person; a dash for none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def plain(value: Any) -> Any:
    """Turn arrays, paths, tuples and numpy scalars into what JSON knows; what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)
