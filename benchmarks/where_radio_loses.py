"""Print what makes a camera-calibrated open loop better than radio: plate, noise, reflection, outage, latency, wind.

    python benchmarks/where_radio_loses.py [--hours 9 12] [--mirrors 12]

data/tracking_100m.toml with one thing changed at a time; normal error, rms over mirrors and time [mrad].
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rfpose.feedback.tracking import TrackingSimulation, score
from rfpose.scenario import Scenario, load_scenario

SCENARIO = Path(__file__).resolve().parents[1] / "data" / "tracking_100m.toml"
METHODS = ("camera-model", "radio", "radio-model", "radio-both")

Change = dict[str, Any]

CASES: tuple[tuple[str, Change, Change], ...] = (
    ("as shipped", {}, {}),
    ("plate never calibrated, 0.6 mrad (1 mm)", {"radio": {"plate_calibration": "none"}}, {}),
    ("plate never calibrated, 0.2 mrad", {"radio": {"plate_calibration": "none", "plate_sigma_mrad": 0.2}}, {}),
    ("plate bends 0.3 mrad in the course of a day", {"radio": {"plate_drift_mrad": 0.3}}, {}),
    ("plate bends 0.6 mrad", {"radio": {"plate_drift_mrad": 0.6}}, {}),
    ("tone SNR 15 dB instead of 45", {"radio": {"tone_snr_db": 15.0}}, {}),
    ("tone SNR 0 dB", {"radio": {"tone_snr_db": 0.0}}, {}),
    ("tone SNR -5 dB", {"radio": {"tone_snr_db": -5.0}}, {}),
    ("tone SNR 15 dB, no carrier phase", {"radio": {"tone_snr_db": 15.0}}, {"carrier_phase": False}),
    ("half of the transmitters hidden at a time", {"radio": {"hidden_transmitters": 0.5}}, {}),
    ("reflection -0.3+0.1j ignored", {"radio": {"ground": "ignored"}}, {}),
    ("half of the frames lost", {"radio": {"lost_frames": 0.5}}, {}),
    ("no radio from 10 to 11 h", {"radio": {"outages": ({"first_hour": 10.0, "last_hour": 11.0},)}}, {}),
    ("no radio from 9.5 to 12 h", {"radio": {"outages": ({"first_hour": 9.5, "last_hour": 12.0},)}}, {}),
    ("latency 20 s, gains reduced", {"radio": {"latency_s": 20.0, "gain_per_s": 0.015,
                                               "integral_gain_per_s2": 4e-5}}, {}),
    ("wind 8 m/s", {"wind": {"mean_speed_mps": 8.0}}, {}),
    ("full motor steps, 1.05 mrad", {"drive": {"microsteps": 8}}, {}),
    ("camera of 10 mm, monthly, with the worm", {"camera": {"spot_sigma_mm": 10.0, "interval_days": 30.0,
                                                            "worm": True}}, {}),
    ("the same; plate never calibrated, 0.6 mrad", {"camera": {"spot_sigma_mm": 10.0, "interval_days": 30.0,
                                                               "worm": True},
                                                    "radio": {"plate_calibration": "none"}}, {}),
)  # fmt: skip


def changed(base: Scenario, change: Change, mirror: Change, hours: tuple[float, float]) -> Scenario:
    """Return the scenario with some keys of [tracking] and of all mirrors replaced."""
    return base.changed(tracking={"first_hour": hours[0], "last_hour": hours[1], **change}, heliostat=mirror)


def main() -> None:
    """Track and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--hours", type=float, nargs=2, default=(9.0, 12.0))
    parser.add_argument("--mirrors", type=int, default=12)
    arguments = parser.parse_args()
    base = load_scenario(SCENARIO)
    print("| changed | " + " | ".join(METHODS) + " | best |")
    print("|---|" + "---|" * (len(METHODS) + 1))
    for name, change, mirror in CASES:
        scenario = changed(base, change, mirror, tuple(arguments.hours))
        simulation = TrackingSimulation(scenario, methods=METHODS, count=arguments.mirrors, seed=1)
        while simulation.done < simulation.n_segment:
            simulation.advance()
        rms = {m: 1e3 * score(simulation.sums(m)).normal_rms_rad for m in METHODS}
        cells = " | ".join(f"{value:.3f}" for value in rms.values())
        print(f"| {name} | {cells} | {min(rms, key=lambda m: rms[m])} |", flush=True)


if __name__ == "__main__":
    main()
