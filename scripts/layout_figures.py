"""Draw the map of Swart et al.'s Fig. 7: position error in the plane with transmitters on a circle.

Run ``python scripts/layout_figures.py --help``.
"""

from __future__ import annotations

import csv
from pathlib import Path

import click
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from rfpose.layout.maps import dilution

COUNTS = (4, 5, 6, 7)
REACH = 1.6


def circle_map(n_transmitter: int, n_point: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the transmitters (transmitter, xy), the axis (point,), and PDOP over √2 (north, east)."""
    angle = 2.0 * np.pi * np.arange(n_transmitter) / n_transmitter
    circle = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    # an even number of points keeps clear of the transmitters' own places
    axis = np.linspace(-REACH, REACH, n_point)
    point = np.stack(np.meshgrid(axis, axis), axis=-1)
    return circle, axis, dilution(circle, point).position / np.sqrt(2.0)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("out/figures"), show_default=True)
@click.option("--points", type=click.IntRange(min=10), default=200, show_default=True, help="A side of the map.")
def main(out: Path, points: int) -> None:
    """Write fig07_map.png and fig07_map.csv."""
    out.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(9.0, 8.2), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    rows = []
    for axes, n in zip(panels.flat, COUNTS, strict=True):
        circle, axis, error = circle_map(n, points)
        image = axes.pcolormesh(axis, axis, error, norm=LogNorm(0.5, 20.0), cmap="cividis", rasterized=True)
        lines = axes.contour(axis, axis, error, levels=[1.0, 2.0, 5.0, 10.0], colors="w", linewidths=0.7)
        axes.clabel(lines, fontsize=7, fmt="%g")
        axes.plot(*circle.T, "^", color="#D55E00", ms=8)
        axes.set_aspect("equal")
        axes.set_title(f"{n} transmitters", fontsize=10)
        rows += [(n, x, y, error[j, i]) for j, y in enumerate(axis) for i, x in enumerate(axis)]
    figure.colorbar(image, ax=panels, label="position RMS / sigma of a range difference", shrink=0.8, extend="max")
    figure.suptitle("Fig. 7 (Swart et al.): position error in the plane, transmitters on a unit circle", fontsize=11)
    figure.savefig(out / "fig07_map.png", dpi=130)
    with (out / "fig07_map.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["transmitters", "x", "y", "position_rms_over_sigma_difference"])
        writer.writerows((n, f"{x:.6g}", f"{y:.6g}", f"{e:.6g}") for n, x, y, e in rows)
    click.echo(f"{out / 'fig07_map.png'}, {out / 'fig07_map.csv'}")


if __name__ == "__main__":
    main()
