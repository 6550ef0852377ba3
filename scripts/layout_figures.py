"""Draw what Swart et al. say of the transmitters' places: Fig. 7 as a map, Fig. 8, and their four guidelines.

Run ``python scripts/layout_figures.py --help``.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from rfpose.layout.maps import dilution, disc_points

COUNTS = (4, 5, 6, 7)
REACH = 1.6
COLOURS = {4: "#0072B2", 5: "#D55E00", 7: "#CC79A7", 10: "#000000"}
DOMES = (5, 7, 10)
TABLE2 = np.array(
    [
        [1.0, 0.0, 0.2], [0.5, 0.866, 0.3], [-0.5, 0.866, 0.2], [-1.0, 0.0, 0.3], [-0.5, -0.866, 0.2],
        [0.5, -0.866, 0.3], [0.433, 0.25, 0.4], [-0.433, 0.25, 0.4], [0.0, -0.5, 0.4], [0.0, 0.0, 0.5],
    ]
)  # fmt: skip


@dataclass(frozen=True)
class Curve:
    """One guideline's error for one number of transmitters."""

    label: str
    colour: str
    x: np.ndarray
    error: np.ndarray
    dashed: bool = False


@dataclass(frozen=True)
class Guideline:
    """One of the paper's rules, and what breaking it costs."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    log_x: bool = True


def circle(n: int) -> np.ndarray:
    """Return n transmitters evenly on the unit circle (transmitter, xy)."""
    angle = 2.0 * np.pi * np.arange(n) / n
    return np.stack([np.sin(angle), np.cos(angle)], axis=1)


def circle_map(n_transmitter: int, n_point: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the transmitters (transmitter, xy), the axis (point,), and PDOP over √2 (north, east)."""
    # an even number of points keeps clear of the transmitters' own places
    axis = np.linspace(-REACH, REACH, n_point)
    point = np.stack(np.meshgrid(axis, axis), axis=-1)
    return circle(n_transmitter), axis, dilution(circle(n_transmitter), point).position / np.sqrt(2.0)


def rms_over_field(transmitter: np.ndarray, radius: float = 0.8) -> float:
    """Rms of the dilution over a disc, each area alike, over √2 (per sigma of a range difference)."""
    point = disc_points(600, radius_m=radius)[:, : transmitter.shape[1]]
    return float(np.sqrt(np.mean(dilution(transmitter, point).position ** 2) / 2.0))


def apart() -> Guideline:
    """Two transmitters closer and closer on the circle."""
    curves = []
    for n in (4, 5, 7):
        share = np.geomspace(1e-3, 1.0, 40)
        error = []
        for s in share:
            site = circle(n)
            angle = s * 2.0 * np.pi / n
            site[1] = np.sin(angle), np.cos(angle)
            error.append(rms_over_field(site))
        curves.append(Curve(f"{n} transmitters", COLOURS[n], share, np.array(error)))
    return Guideline("1  No two close to each other", "distance of two neighbours, as a share of the even spacing",
                     "rms over the field", curves)  # fmt: skip


def off_the_line() -> Guideline:
    """All transmitters, or three of them, closer and closer to a line."""
    share = np.geomspace(1e-2, 1.0, 40)
    curves = []
    for n in (4, 5, 7):
        # turned, so that squeezing puts no two at one place
        turn = 0.3
        rot = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        error = [rms_over_field(circle(n) @ rot * [1.0, s]) for s in share]
        curves.append(Curve(f"{n}, all of them", COLOURS[n], share, np.array(error)))
    some = []
    for s in share:
        site = circle(4)
        # the first three: the middle one comes onto the line through its neighbours
        foot = 0.5 * (site[0] + site[2])
        site[1] = foot + s * (site[1] - foot)
        some.append(rms_over_field(site))
    curves.append(Curve("4, three of them", COLOURS[4], share, np.array(some), dashed=True))
    return Guideline("2  No three on a line", "extent across the line over that along it", "rms over the field", curves)


def dome(n: int, height: float, base: float = 0.0) -> np.ndarray:
    """Return n - 1 transmitters on a circle at alternating heights, and one in the middle, (transmitter, xyz)."""
    ring = circle(n - 1)
    up = np.where(np.arange(n - 1) % 2 == 0, 0.0, 0.4 * height)
    return np.vstack([np.column_stack([ring, base + up]), [0.0, 0.0, base + height]])


def off_the_plane() -> Guideline:
    """Heights of all transmitters closer and closer to each other, in space."""
    share = np.geomspace(1e-2, 1.0, 40)
    curves = [
        Curve(f"{n} transmitters", COLOURS[n], share, np.array([rms_over_field(dome(n, h)) for h in share]))
        for n in DOMES
    ]
    raised = np.array([rms_over_field(dome(10, h, 0.3)) for h in share])
    curves.append(Curve("10, all raised by 0.3", COLOURS[10], share, raised, dashed=True))
    return Guideline("3  No four in a plane (in space)", "differences of height over the field's radius",
                     "rms over the field", curves)  # fmt: skip


def around() -> Guideline:
    """From the centre of the circle out through it, between two transmitters."""
    radius = np.linspace(0.0, 2.0, 201)
    curves = []
    for n in (4, 5, 7):
        way = np.array([np.sin(np.pi / n), np.cos(np.pi / n)])
        error = dilution(circle(n), radius[:, None] * way).position / np.sqrt(2.0)
        curves.append(Curve(f"{n} transmitters", COLOURS[n], radius, error))
    return Guideline("4  Transmitters around the field", "receiver's distance from the centre, transmitters at 1",
                     "position RMS", curves, log_x=False)  # fmt: skip


def draw_guideline(axes: Axes, rule: Guideline) -> None:
    """Draw one panel."""
    for curve in rule.curves:
        axes.plot(curve.x, curve.error, "--" if curve.dashed else "-", color=curve.colour, label=curve.label)
    if rule.log_x:
        axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "2357" else ""))
    axes.tick_params(axis="y", which="minor", labelsize=8)
    axes.set_xlabel(rule.x_label)
    axes.set_ylabel(f"{rule.y_label} / sigma of a range difference", fontsize=9)
    axes.set_title(rule.title, fontsize=10, loc="left")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8, loc="upper left" if not rule.log_x else "best")


def new_figure(width: float, height: float) -> Figure:
    """Return a figure that needs no display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write numbers with six digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([f"{x:.6g}" if isinstance(x, float) else x for x in row] for row in rows)


def figure_7(out: Path, points: int) -> str:
    """Write the map of the error in the plane."""
    figure = new_figure(9.0, 8.2)
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    rows: list[tuple[object, ...]] = []
    for axes, n in zip(panels.flat, COUNTS, strict=True):
        ring, axis, error = circle_map(n, points)
        image = axes.pcolormesh(axis, axis, error, norm=LogNorm(0.5, 20.0), cmap="cividis", rasterized=True)
        lines = axes.contour(axis, axis, error, levels=[1.0, 2.0, 5.0, 10.0], colors="w", linewidths=0.7)
        axes.clabel(lines, fontsize=7, fmt="%g")
        axes.plot(*ring.T, "^", color="#D55E00", ms=8)
        axes.set_aspect("equal")
        axes.set_title(f"{n} transmitters", fontsize=10)
        rows += [(n, float(x), float(y), float(error[j, i])) for j, y in enumerate(axis) for i, x in enumerate(axis)]
    figure.colorbar(image, ax=panels, label="position RMS / sigma of a range difference", shrink=0.8, extend="max")
    figure.suptitle("Fig. 7 (Swart et al.): position error in the plane, transmitters on a unit circle", fontsize=11)
    figure.savefig(out / "fig07_map.png", dpi=130)
    write_csv(out / "fig07_map.csv", ["transmitters", "x", "y", "position_rms_over_sigma_difference"], rows)
    return "fig07_map"


def figure_8(out: Path, points: int) -> str:
    """Write Table 2 from above, over the position error at height zero."""
    axis = np.linspace(-1.25, 1.25, points)
    east, north = np.meshgrid(axis, axis)
    error = dilution(TABLE2, np.stack([east, north, 0.0 * east], axis=-1)).position / np.sqrt(2.0)
    figure = new_figure(8.2, 6.6)
    axes = figure.add_subplot()
    lines = axes.contour(axis, axis, error, levels=[1.0, 1.2, 1.5, 2.0, 3.0, 5.0], colors="0.5", linewidths=0.9)
    axes.clabel(lines, fontsize=8, fmt="%g")
    dots = axes.scatter(TABLE2[:, 0], TABLE2[:, 1], c=TABLE2[:, 2], cmap="cividis", s=110, edgecolors="k", zorder=3)
    for k, place in enumerate(TABLE2):
        axes.annotate(f"{k + 1}", place[:2], (7, 7), textcoords="offset points", fontsize=9)
    axes.plot(np.sin(np.linspace(0, 2 * np.pi, 200)), np.cos(np.linspace(0, 2 * np.pi, 200)), "k:", lw=0.9)
    figure.colorbar(dots, ax=axes, label="height", shrink=0.85)
    axes.set_aspect("equal")
    axes.set_xlabel("x")
    axes.set_ylabel("y")
    axes.set_title("Fig. 8 (Swart et al.): Table 2 from above. Lines: position RMS at height 0\n"
                   "over the sigma of a range difference; dotted: the field", fontsize=10)  # fmt: skip
    figure.savefig(out / "fig08_layout.png", dpi=130)
    flat = zip(east.ravel(), north.ravel(), error.ravel(), strict=True)
    rows = [(float(x), float(y), float(e)) for x, y, e in flat]
    write_csv(out / "fig08_layout.csv", ["x", "y", "position_rms_over_sigma_difference"], rows)
    return "fig08_layout"


def guidelines(out: Path) -> str:
    """Write what breaking each of the four guidelines costs."""
    rules = (apart(), off_the_line(), off_the_plane(), around())
    figure = new_figure(11.0, 8.4)
    for axes, rule in zip(figure.subplots(2, 2).flat, rules, strict=True):
        draw_guideline(axes, rule)
    figure.suptitle("Swart et al.'s four guidelines (§4.2), and what breaking each costs", fontsize=11)
    figure.savefig(out / "guidelines.png", dpi=130)
    rows = [
        (rule.title[0], curve.label, float(x), float(e))
        for rule in rules
        for curve in rule.curves
        for x, e in zip(curve.x, curve.error, strict=True)
    ]
    write_csv(out / "guidelines.csv", ["guideline", "curve", "x", "position_rms_over_sigma_difference"], rows)
    return "guidelines"


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("out/figures"), show_default=True)
@click.option("--points", type=click.IntRange(min=10), default=200, show_default=True, help="A side of the maps.")
def main(out: Path, points: int) -> None:
    """Write fig07_map, fig08_layout and guidelines, each as PNG and CSV."""
    out.mkdir(parents=True, exist_ok=True)
    for name in (figure_7(out, points), figure_8(out, points), guidelines(out)):
        click.echo(f"{out / name}.png, {out / name}.csv")


if __name__ == "__main__":
    main()
