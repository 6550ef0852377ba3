"""Regenerate figures of Swart et al., "A method for accurate measurement of heliostat mirror orientation".

Each figure is written as a picture (PNG) and as a table (CSV): simulated points beside the predicted curve.
Run ``python scripts/figures.py --help``.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import click
import matplotlib as mpl
import numpy as np
from figures_simulation import FIGURES, Figure, estimator_rms_rad
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

mpl.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.ticker import LogFormatter

# Okabe and Ito's palette: told apart with every common form of colour blindness
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = "osD^vPX"


def draw(figure: Figure, path: Path) -> None:
    """Write a figure as PNG: markers are simulated, dashed lines predicted."""
    canvas, axes = plt.subplots(figsize=(8.0, 6.2), layout="constrained")
    for i, series in enumerate(figure.series):
        colour = COLOURS[(i if series.colour is None else series.colour) % len(COLOURS)]
        style = {"marker": MARKERS[i % len(MARKERS)], "markersize": 5.5, "markerfacecolor": "none", "linestyle": "none"}
        axes.plot(series.x, series.simulated, color=colour, label=_subscripts(series.label), **style)
        if series.predicted is not None:
            axes.plot(series.x, series.predicted, "--", color=colour, linewidth=1.3)
    for label, value in figure.lines.items():
        axes.axhline(value, color="0.45", linewidth=0.9)
        axes.annotate(label, (0.005, value), xycoords=("axes fraction", "data"), va="bottom", color="0.35")
    axes.plot([], [], "--", color="0.3", linewidth=1.3, label="predicted (same colour)")
    axes.set(xscale=figure.x_scale, yscale=figure.y_scale)
    axes.set(xlabel=_subscripts(figure.x_label), ylabel=_subscripts(figure.y_label))
    if figure.x_ticks is not None:
        axes.set_xticks(figure.x_ticks, [f"{tick:,.0f}" for tick in figure.x_ticks])
    if figure.y_scale == "log":
        axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))
    axes.set_title(_subscripts(figure.note), fontsize=8.5, color="0.3")
    canvas.suptitle(f"Fig. {figure.number} (Swart et al.): {figure.title}", fontsize=11)
    axes.grid(which="major", color="0.88")
    canvas.legend(fontsize=8.5, loc="outside lower center", ncols=2, frameon=False)
    canvas.savefig(path, dpi=140)
    plt.close(canvas)


def _subscripts(text: str) -> str:
    """Set one-letter subscripts as such: ``σ_Δ`` becomes mathematics."""
    return re.sub(r"\b(\w)_(\w)\b", r"$\1_\2$", text)


def tabulate(figure: Figure, path: Path) -> None:
    """Write a figure's points as CSV, one row a point."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["series", figure.x_name, f"{figure.y_name}_simulated", f"{figure.y_name}_predicted"])
        for series in figure.series:
            predicted = [""] * len(series.x) if series.predicted is None else [f"{y:.6g}" for y in series.predicted]
            for x, simulated, expected in zip(series.x, series.simulated, predicted, strict=True):
                writer.writerow([series.label, f"{x:.6g}", f"{simulated:.6g}", expected])


def print_estimators(runs: int, rng: np.random.Generator) -> None:
    """Print the RMS error of each estimator over the signal-to-noise ratio."""
    snr_db = (20, 10, 0, -10, -20)
    with Progress(transient=True) as progress:
        columns = [estimator_rms_rad(10.0 ** (db / 10.0), runs, rng) for db in progress.track(snr_db)]
    table = Table("per-sample SNR, dB", *map(str, snr_db), title=f"RMS error in mrad, 4096 samples, {runs} runs")
    for name in columns[0]:
        table.add_row(name, *(f"{1e3 * column[name]:.4g}" for column in columns))
    Console().print(table)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--figure", "numbers", type=click.Choice([str(n) for n in FIGURES]), multiple=True, help="Default: all.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("out/figures"), show_default=True)
@click.option("--runs", type=click.IntRange(min=2), default=400, show_default=True, help="Monte-Carlo runs a point.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--estimators", is_flag=True, help="Print the table of estimators against the bound, draw nothing.")
def main(numbers: tuple[str, ...], out: Path, runs: int, seed: int, estimators: bool) -> None:
    """Regenerate figures of the paper as PNG and CSV: simulated beside predicted."""
    if estimators:
        print_estimators(runs, np.random.default_rng(seed))
        return
    out.mkdir(parents=True, exist_ok=True)
    with Progress() as progress:
        for number in [int(n) for n in numbers] or list(FIGURES):
            # one stream a figure, so that a figure does not depend on which others were asked for
            rng = np.random.default_rng([seed, number])
            figure = FIGURES[number](runs, rng, lambda points, text: progress.track(points, description=text))
            stem = out / f"fig{number:02d}"
            draw(figure, stem.with_suffix(".png"))
            tabulate(figure, stem.with_suffix(".csv"))
            progress.console.print(f"{stem}.png, {stem}.csv")


if __name__ == "__main__":
    main()
