"""Draw the pictures of docs/tracking.md: `python scripts/figures_tracking.py [DIRECTORY]`.

tracking_day.png    the methods over a day of the shipped scenario, and mirror by mirror
tracking_outage.png what an hour and a half without radio does
tracking_events.png a day on which step counts, a cluster and power are lost, and an emergency is called
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import rfpose as rf
from rfpose.drawing import save_figure
from rfpose.feedback.tracking import TrackingSimulation
from rfpose.pipeline.track import TrackChanges

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = ROOT / "data" / "tracking_100m.toml"
OUTAGE = (10.5, 12.0)
EVENTS = (
    {"hour": 9.5, "what": "counts-lost", "heliostats": ("H03",)},
    {"hour": 9.6, "what": "zero-counts", "heliostats": ("H03",)},
    {"hour": 10.0, "what": "calibrate", "heliostats": ("H03",)},
    {"hour": 11.5, "what": "emergency"},
    {"hour": 12.0, "what": "release"},
    {"hour": 13.0, "what": "cluster-fails", "cluster": 0},
    {"hour": 13.1, "what": "cluster-returns", "cluster": 0},
    {"hour": 14.5, "what": "power-fails", "heliostats": ("H05", "H06")},
    {"hour": 14.8, "what": "power-returns", "heliostats": ("H05", "H06")},
)


def draw_outage(path: Path) -> None:
    """Draw the field's error through an outage."""
    outage = {"first_hour": OUTAGE[0], "last_hour": OUTAGE[1]}
    scenario = rf.load_scenario(SCENARIO).changed(
        tracking={"first_hour": 9.5, "last_hour": 13.0, "radio": {"outages": [outage]}}
    )
    methods = ("camera-model", "radio", "radio-model", "radio-both")
    simulation = TrackingSimulation(scenario, methods=methods, seed=0)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    hour = simulation.days[0].hour[:: round(scenario.tracking.store_interval_s)]
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, colour in zip(methods, ("#D55E00", "#0072B2", "#56B4E9", "#009E73"), strict=True):
        axes.plot(hour, 1e3 * simulation.curves(name).rms_rad, color=colour, lw=1.3, label=name)
    axes.axvspan(*OUTAGE, color="0.85", label="no radio")
    axes.set_xlabel("local mean solar time [h]")
    axes.set_ylabel("normal error, rms over 12 mirrors [mrad]")
    axes.set_ylim(0.0, None)
    axes.set_xlim(float(np.min(hour)), float(np.max(hour)))
    axes.grid(alpha=0.3)
    axes.legend(ncols=5, fontsize=8, loc="upper left")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Draw all."""
    directory = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "images"
    directory.mkdir(parents=True, exist_ok=True)
    save_figure(rf.track(SCENARIO).plot(), directory / "tracking_day.png")
    eventful = rf.track(SCENARIO, methods=("camera-model", "radio-both"), changes=TrackChanges(events=EVENTS))
    save_figure(eventful.plot(), directory / "tracking_events.png")
    draw_outage(directory / "tracking_outage.png")


if __name__ == "__main__":
    main()
