"""Print error budgets of three sites, line by line beside Monte Carlo through the solver, and their sums.

    python benchmarks/error_budget.py [--draws 400]

Table 2 scaled to 100 m, twelve heliostats facing the tower under one sun: (1) as `data/table2_100m.toml` has it;
(2) two tones, shared clock, surveyed pivots; (3) the second with a reflecting ground, its coefficient estimated with
the poses. Errors are of the mirror normal, rms over the field, in mrad.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from rfpose import geometry
from rfpose.layout import maps
from rfpose.layout.budget import ErrorBudget, error_budget, working_point
from rfpose.scenario import Scenario, load_scenario

SITE = Path(__file__).resolve().parents[1] / "data" / "table2_100m.toml"
SUN_DEG = (170.0, 55.0)


def sites() -> dict[str, Scenario]:
    """Return the three scenarios by name."""
    # what nothing foresees is no known quantity of a site; -60 dB here to see such a line
    plain = load_scenario(SITE).changed(budget={"multipath_db": -60.0})
    two = plain.changed(
        radio={"sample_rate_hz": 60e6},
        tone=[{"frequency_hz": 750e3, "modulation_index": 0.4}, {"frequency_hz": 7.47e6, "modulation_index": 0.4}],
        heliostat={"pivot_sigma_m": 0.005, "receiver_delay_sigma_s": 20e-12, "carrier_phase": False},
        simulation={"adc_bits": 12},
        budget={"calibration_age_s": 10.0, "refractivity_sigma_ppm": 20.0},
    )
    wet = two.changed(simulation={"ground": {"coefficient": (-0.3, 0.1)}}, budget={"ground": "estimated"})
    return {
        "Table 2 as it stands": plain,
        "two tones, pivots surveyed": two,
        "ground reflects, estimated": wet,
    }


def rms_mrad(values: np.ndarray) -> float:
    """Rms [mrad]."""
    return 1e3 * float(np.sqrt(np.mean(values**2)))


def show(name: str, found: ErrorBudget, took_s: float) -> None:
    """Print one table."""
    print(f"\n{name} ({found.n_draw} draws a line, {found.n_failed} solutions failed, {took_s:.0f} s)")
    print(f"{'source':26}{'first order':>13}{'drawn':>11}{'ratio':>8}{'target [m]':>12}  assumed")
    for line in (*found.lines, found.whole):
        linear, drawn = rms_mrad(line.normal_rad), rms_mrad(line.drawn_normal_rad)
        ratio = f"{linear / drawn:8.3f}" if linear > 0.0 else f"{'-':>8}"
        target = float(np.sqrt(np.mean(line.target_m**2)))
        print(f"{line.name:26}{linear:13.5f}{drawn:11.5f}{ratio}{target:12.5f}  {line.assumed}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=400)
    n_draw = parser.parse_args().draws
    sun = geometry.enu_from_azimuth_elevation(*np.radians(SUN_DEG))
    for name, scenario in sites().items():
        plan = working_point(scenario, maps.mirrors_of(scenario, sun_enu=sun))
        start = time.perf_counter()
        found = error_budget(plan, n_draw=n_draw, seed=1, aim_enu_m=scenario.site.aim_enu_m)
        show(name, found, time.perf_counter() - start)


if __name__ == "__main__":
    main()
