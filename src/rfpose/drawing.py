"""Figures that need no display, how they look, and their files. matplotlib is loaded when one is made.

Colours stand here and nowhere else, for paper and for the viewer: Okabe and Ito's palette, which the colour-blind can
tell apart, without its yellow, which cannot be seen on white.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

__all__ = [
    "BLUE",
    "COLOUR_MAP",
    "GREEN",
    "GREY",
    "METHOD_COLOURS",
    "MODE_COLOURS",
    "PICTURE_ENDINGS",
    "PINK",
    "SERIES",
    "STATUS_COLOURS",
    "VERMILION",
    "WIDTH_INCH",
    "Look",
    "angle_unit",
    "blank_figure",
    "foreground",
    "look",
    "mark_places",
    "new_figure",
    "place_names",
    "plain_numbers",
    "png_of",
    "save_figure",
    "svg_of",
]

PICTURE_ENDINGS = (".png", ".svg", ".pdf")
WIDTH_INCH = 7.2
"""Of figures: as wide as the text of a page of A4, so that letters have their size there."""

BLUE, VERMILION, GREEN, PINK, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#7F7F7F"
SERIES = (BLUE, VERMILION, GREEN, PINK, "#56B4E9", "#E69F00", "#8C6BB1", GREY, "#A6761D", "#66A61E")
STATUS_COLOURS = (BLUE, "#E69F00", PINK, VERMILION, "#56B4E9", GREY, GREEN, "#A6761D")
COLOUR_MAP = "cividis"
"""For quantities: reads the same with and without colour vision deficiency, and in grey."""

METHOD_COLOURS = {
    # of `rfpose track`
    "open-loop": GREY,
    "encoder": "#8C6BB1",
    "bias": "#E69F00",
    "berenguel": PINK,
    "camera-model": VERMILION,
    "drone-model": "#A6761D",
    "sun-sensor": "#66A61E",
    "radio": BLUE,
    "radio-model": "#56B4E9",
    "radio-both": GREEN,
    # estimators of normals, of `rfpose layout`
    "scenario": BLUE,
    "independent": VERMILION,
    "rigid": "#56B4E9",
    "shared-clock": GREEN,
    "carrier": PINK,
    "delays": "#E69F00",
    "pivot": "#8C6BB1",
    "reflection": "#A6761D",
    "site": "#66A61E",
    "pdop": GREY,
}
"""By the method's or estimator's name, the same wherever it is drawn."""

MODE_COLOURS = {
    "stow": "#8A929B",
    "stowing": "#C5CAD0",
    "approach": "#9ECAE1",
    "point": "#7CC8AC",
    "track": "#BFE3D4",
    "calibrate": "#E69F00",
    "search": "#F0E442",
    "defocus": PINK,
    "emergency": VERMILION,
    "idle": "#A6761D",
    "power_loss": "#8C6BB1",
    "fault": "#1B1F24",
}
"""By the mode's name; tracking is pale, so that all else is seen."""

Look = Literal["light", "dark", "page"]
_INK = {"light": "#1b1f24", "dark": "#e6e9ed", "page": "#010203"}
_PAPER = {"light": "#ffffff", "dark": "#15181c", "page": "none"}
_GRID = {"light": "#b0b7bf", "dark": "#4a535d", "page": "#8a929b"}


@contextlib.contextmanager
def look(kind: Look = "light") -> Iterator[None]:
    """Draw and save figures on light or dark paper while the block runs; ``page``: as the page around them has it."""
    import matplotlib

    ink, paper = _INK[kind], _PAPER[kind]
    settings: Any = {
        **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), ink),
        **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), paper),
        "legend.facecolor": paper if kind != "page" else "inherit",
        "legend.framealpha": 0.0 if kind == "page" else 0.8,
        "grid.color": _GRID[kind],
        "font.size": 9.0,
        "axes.titlesize": 10.0,
        "axes.labelsize": 9.0,
        "legend.fontsize": 8.0,
        "svg.fonttype": "none",
        "svg.hashsalt": "rfpose",
    }
    with matplotlib.rc_context(settings):
        yield


def foreground() -> str:
    """Return the colour of what is written and outlined in the present look."""
    import matplotlib

    return str(matplotlib.rcParams["text.color"])


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


def mark_places(axes: Axes, places: FloatArray, *, marker: str, label: str, colour: str = VERMILION) -> None:
    """Draw places (place, xyz) from above."""
    axes.scatter(places[:, 0], places[:, 1], marker=marker, color=colour, s=45, zorder=3, label=label)


_ROUND = [(round(np.cos(a), 3), round(np.sin(a), 3)) for a in np.radians([45, -45, 135, -135, 0, 180, 90, -90])]
_LETTER = 0.62
"""Width of a letter over the size of the font."""


def place_names(
    axes: Axes,
    places: FloatArray,
    names: Sequence[str],
    *,
    keep_off: FloatArray,
    colours: Sequence[str] | str,
    n_always: int = 0,
    size: float = 7.0,
) -> None:
    """Write names beside places (place, xy), where they lie over no other name and none of ``keep_off`` (point, xy).

    Call it when all else is drawn and limits stand. A name without room is left out; of the first ``n_always`` it
    stands on a ground of its own.
    """
    figure: Any = axes.figure.figure  # the whole, also of axes in a part
    figure.draw_without_rendering()
    to_points = 72.0 / figure.dpi
    here = to_points * axes.transData.transform(places)
    radius = 5.0
    taken = [
        (x - radius, y - radius, x + radius, y + radius) for x, y in to_points * axes.transData.transform(keep_off)
    ]
    frame = axes.get_window_extent()
    inside = tuple(to_points * v for v in (frame.x0, frame.y0, frame.x1, frame.y1))
    each = [colours] * len(names) if isinstance(colours, str) else list(colours)
    for k, (place, (x, y), name, colour) in enumerate(zip(places, here, names, each, strict=True)):
        lines = name.split("\n")
        width, height = _LETTER * size * max(map(len, lines)), 1.25 * size * len(lines)
        found, ground = None, None
        for away, (right, up) in ((away, way) for away in (6.5, 11.0) for way in _ROUND):
            left = x + right * away + (0.5 * np.sign(round(right, 1)) - 0.5) * width
            low = y + up * away + (0.5 * np.sign(round(up, 1)) - 0.5) * height
            box = (left, low, left + width, low + height)
            if _within(box, inside) and not any(_overlap(box, other) for other in taken):
                found = box
                break
        if found is None and k < n_always:
            found = (x + 6.5, y - 0.5 * height, x + 6.5 + width, y + 0.5 * height)
            ground = {"facecolor": figure.get_facecolor(), "edgecolor": "none", "alpha": 0.75, "pad": 0.5}
        if found is not None:
            offset = (found[0] - x + 0.5 * width, found[1] - y + 0.5 * height)
            written = axes.annotate(
                name, place, offset, textcoords="offset points", fontsize=size, color=colour, ha="center", va="center",
                zorder=6, bbox=ground,
            )  # fmt: skip
            written.set_in_layout(False)
            taken.append(found)


def _within(box: tuple[float, ...], frame: tuple[float, ...]) -> bool:
    return box[0] > frame[0] and box[1] > frame[1] and box[2] < frame[2] and box[3] < frame[3]


def _overlap(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def angle_unit(mrad: FloatArray) -> tuple[float, str]:
    """Return factor and unit that make angles [mrad] numbers one can read: µrad, mrad or rad."""
    known = np.abs(mrad[np.isfinite(mrad)])
    largest = float(known.max()) if known.size else 1.0
    return (1e3, "µrad") if largest < 0.5 else (1.0, "mrad") if largest < 500.0 else (1e-3, "rad")


def plain_numbers(axis: Axis) -> None:
    """Write a logarithmic axis's numbers out, at one, two and five; over many decades at one alone."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    decades = np.log10(high / low) if low > 0.0 else 1.0
    subs = (1.0, 2.0, 5.0) if decades < 2.5 else (1.0, 3.0) if decades < 4.0 else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
    axis.axes.grid(alpha=0.3, which="major")


def png_of(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    return _image(figure, "png")


def svg_of(figure: Figure, name: str) -> str:
    """Return a figure of the look ``page`` as SVG to stand in HTML: its ink is the page's; ids begin with ``name``."""
    text = _image(figure, "svg").decode()
    text = text[text.index("<svg") :].replace(_INK["page"], "currentColor")
    # several figures stand on one page
    text = re.sub(r'\b(id="|xlink:href="#|url\(#)', rf"\g<1>{name}-", text)
    return re.sub(r'<svg [^>]*?viewBox="([^"]+)"[^>]*>', r'<svg viewBox="\1" role="img" '
                  r'xmlns:xlink="http://www.w3.org/1999/xlink">', text, count=1)  # fmt: skip


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
    if path.suffix not in PICTURE_ENDINGS:
        raise InvalidInputError(f"`path` must end in {', '.join(PICTURE_ENDINGS)}, got {path.name}")
    write_atomically(path, _image(figure, path.suffix[1:]))


_UNDATED = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
"""Equal figures are equal bytes."""


def _image(figure: Figure, kind: str) -> bytes:
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "rfpose"}):
        figure.savefig(buffer, format=kind, dpi=130, metadata=_UNDATED[kind])
    return buffer.getvalue()
