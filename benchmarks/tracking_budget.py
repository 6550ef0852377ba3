"""Print predicted error budgets of a tracked field beside what the simulation of the same field finds.

    python benchmarks/tracking_budget.py [--hours 9 15] [--mirrors 192] [--seed 1] [--parts] [--only method|part]

First all methods on data/tracking_100m.toml without field control, then single parts with all others off. Errors of the
normal, rms over mirrors and time [mrad]. Where a part is constant for a mirror (plate, mount) the simulated rms of n
mirrors scatters by some 1/(2 √n) of itself; place and worm, which weigh most on near and fast mirrors, by more.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rfpose.feedback.tracking import Score, TrackingSimulation, score
from rfpose.feedback.tracking.budget import MethodBudget, track_budget
from rfpose.scenario import Scenario, load_scenario

SCENARIO = Path(__file__).resolve().parents[1] / "data" / "tracking_100m.toml"

Change = dict[str, Any]

NO_ERRORS: Change = {
    "tilt_sigma_mrad": 0.0, "zero_sigma_mrad": 0.0, "nonorthogonality_sigma_mrad": 0.0, "canting_sigma_mrad": 0.0,
    "location_sigma_mm": 0.0, "worm_sigma_mrad": 0.0, "sag_sigma_mrad": 0.0, "thermal_sigma_mrad": 0.0,
    "creep_sigma_mrad_per_month": 0.0,
}  # fmt: skip
QUIET: Change = {
    "mount_errors": NO_ERRORS,
    "drive": {"steps_per_turn": 4e6, "backlash_mrad": (0.0, 0.0)},
    "wind": {"mean_speed_mps": 0.0},
    "structure": {"natural_hz": 0.0},
    "radio": {"plate_sigma_mrad": 0.0, "plate_calibration": "none", "lost_frames": 0.0, "ground": "none"},
    "sun_sensor": {"offset_sigma_mrad": 0.0, "drift_mrad": 0.0},
}
"""Perfect mounts, drives and sensors, no wind, fine steps."""

OPEN_AND_CLOSED = ("open-loop", "radio")
STEPS: Change = {"steps_per_turn": 48_000.0}
PARTS: tuple[tuple[str, Sequence[str], Change], ...] = (
    ("wind 8 m/s", OPEN_AND_CLOSED, {"wind": {"mean_speed_mps": 8.0}}),
    ("wind 8 m/s, 30 % of the frames lost", ("radio",),
     {"wind": {"mean_speed_mps": 8.0}, "radio": {"lost_frames": 0.3}}),
    ("wind 8 m/s, latency 9 s", ("radio",), {"wind": {"mean_speed_mps": 8.0}, "radio": {"latency_s": 9.0}}),
    ("wind 8 m/s, structure of 2.2 Hz", OPEN_AND_CLOSED,
     {"wind": {"mean_speed_mps": 8.0}, "structure": {"natural_hz": 2.2}}),
    ("wind 8 m/s", ("sun-sensor",), {"collector": "dish", "wind": {"mean_speed_mps": 8.0}}),
    ("tone SNR -5 dB", ("radio", "radio-both"), {"radio": {"tone_snr_db": -5.0}}),
    ("tone SNR -5 dB, 30 % lost", ("radio",), {"radio": {"tone_snr_db": -5.0, "lost_frames": 0.3}}),
    ("steps of 0.13 mrad", OPEN_AND_CLOSED, {"drive": STEPS}),
    ("steps of 1.05 mrad", OPEN_AND_CLOSED, {"drive": {**STEPS, "microsteps": 8}}),
    ("the same, structure of 2.2 Hz", OPEN_AND_CLOSED,
     {"drive": {**STEPS, "microsteps": 8}, "structure": {"natural_hz": 2.2}}),
    ("dead band of three steps", OPEN_AND_CLOSED, {"drive": {**STEPS, "dead_band_steps": 3.0}}),
    ("play 0.5 mrad", ("open-loop",), {"drive": {"backlash_mrad": (0.5, 0.5)}}),
    ("stiction 0.5 mrad", OPEN_AND_CLOSED, {"drive": {"stiction_mrad": (0.5, 0.5)}}),
    ("encoder, steps of 0.13 mrad", ("encoder",), {"drive": STEPS}),
    ("sun sensor's levels", ("sun-sensor",), {"collector": "dish"}),
    ("sun sensor's levels, steps of 0.13 mrad", ("sun-sensor",), {"collector": "dish", "drive": STEPS}),
    ("place 10 mm", ("radio",), {"mount_errors": {"location_sigma_mm": 10.0}}),
    ("worm gears 1 mrad", ("open-loop",), {"mount_errors": {"worm_sigma_mrad": 1.0}}),
    ("plate 0.6 mrad, found by camera", ("radio", "radio-model"),
     {"radio": {"plate_sigma_mrad": 0.6, "plate_calibration": "camera"}}),
    ("plate bends 0.6 mrad in a day", ("radio",), {"radio": {"plate_drift_mrad": 0.6}}),
)  # fmt: skip


def changed(hours: Sequence[float], *changes: Change) -> Scenario:
    """Return the shipped scenario without field control, keys of [tracking] replaced by one change after the other."""
    site = load_scenario(SCENARIO)
    for change in ({"first_hour": hours[0], "last_hour": hours[1], "field_control": None}, *changes):
        site = site.changed(tracking=change)
    return site


def simulated(scenario: Scenario, methods: Sequence[str], mirrors: int, seed: int) -> dict[str, Score]:
    """Return scores by method."""
    simulation = TrackingSimulation(scenario, methods=methods, count=mirrors, seed=seed)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    return {m.name: score(simulation.sums(m.name)) for m in simulation.methods}


def row(name: str, budget: MethodBudget, found: Score) -> str:
    """Return one line of a table."""
    total, rms = 1e3 * budget.total_rad, 1e3 * found.normal_rms_rad
    return (
        f"| {name} | {total:.3f} | {rms:.3f} | {total / rms:.3f} | {budget.intercept:.4f} | "
        f"{budget.posture_intercept:.4f} | {found.intercept:.4f} | {budget.lost_kwh_per_m2:.3f} | "
        f"{budget.lost_kwh_per_m2_year:.0f} |"
    )


HEAD = (
    "| {} | predicted | simulated | ratio | intercept by one rms | by posture | simulated | lost kWh/m² | in a year |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    """Predict, simulate, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--hours", type=float, nargs=2, default=(9.0, 15.0))
    parser.add_argument("--mirrors", type=int, default=192)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--parts", action="store_true", help="print the parts of each method's budget")
    parser.add_argument("--only", choices=("method", "part"))
    arguments = parser.parse_args()
    hours, n, seed = arguments.hours, arguments.mirrors, arguments.seed
    if arguments.only != "part":
        for what in ("heliostat", "dish"):
            scenario = changed(hours, {"collector": what})
            print(HEAD.format(what))
            for name, found in simulated(scenario, (), n, seed).items():
                budget = track_budget(scenario, name, count=n)
                print(row(f"`{name}`", budget, found), flush=True)
                if arguments.parts:
                    print("  ", ", ".join(f"{k} {v:.3f}" for k, v in budget.as_dict()["parts_mrad"].items()))
    if arguments.only != "method":
        print(HEAD.format("nothing but"))
        for name, methods, change in PARTS:
            scenario = changed((hours[0], min(hours[1], hours[0] + 3.0)), QUIET, change)
            few = min(n, 48)  # of this field none of the first 48 passes the zenith
            for method, found in simulated(scenario, methods, few, seed).items():
                print(row(f"{name}: `{method}`", track_budget(scenario, method, count=few), found), flush=True)


if __name__ == "__main__":
    main()
