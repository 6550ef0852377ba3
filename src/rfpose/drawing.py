"""Figures that need no display, and their files. matplotlib is loaded when one is made."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["blank_figure", "mark_places", "new_figure", "png_of", "save_figure"]

_FORMATS = (".png", ".svg", ".pdf")


def blank_figure(width_inch: float, height_inch: float) -> Figure:
    """Return a figure without axes, known to no window and no `pyplot`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inch, height_inch), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def new_figure(width_inch: float, height_inch: float) -> tuple[Figure, Axes]:
    """Return a figure with one set of axes."""
    figure = blank_figure(width_inch, height_inch)
    return figure, figure.add_subplot()


def mark_places(axes: Axes, places: FloatArray, names: tuple[str, ...], *, marker: str, label: str) -> None:
    """Draw places (place, xyz) from above, each with its name."""
    axes.scatter(places[:, 0], places[:, 1], marker=marker, color="#D55E00", s=60, zorder=3, label=label)
    for name, place in zip(names, places, strict=True):
        axes.annotate(name, place[:2], (6, -11), textcoords="offset points", fontsize=8, color="#A04000")


def png_of(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    return _image(figure, "png")


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, SVG or PDF, by the ending of ``path``.

    Raises
    ------
    InvalidInputError
        Another ending.
    RecordingError
        The file cannot be written.
    """
    path = Path(path)
    if path.suffix not in _FORMATS:
        raise InvalidInputError(f"`path` must end in {', '.join(_FORMATS)}, got {path.name}")
    write_atomically(path, _image(figure, path.suffix[1:]))


def _image(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=130)
    return buffer.getvalue()
