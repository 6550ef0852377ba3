"""What drifting transmitters do to normals: calibration receivers, stale or not, against differences between receivers.

    python benchmarks/transmitter_drift.py --frames 100

The mirrors, noise and frames of `pose_chain.py`, pivots surveyed to 5 mm, frames spread over an hour. Electronic phases
of the transmitters walk by 0, 0.1 and 1 rad in that hour. Calibrated in every frame; calibrated in the first three
frames and held since; not calibrated, with no calibration receiver on the site at all.
"""

from __future__ import annotations

import argparse
import logging
from typing import Any

from pose_chain import FRAME_SAMPLES, ROWS, site

from rfpose.pipeline.evaluate import Evaluation, evaluate
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.scenario import Scenario

CLOCKS = {"three clocks": {}, "one clock": {"receiver_delay_sigma_s": 0.0}}
N_CALIBRATED = 3


def drifting(n_frame: int, drift_rad: float, *, stale: bool, mirror: dict[str, Any]) -> Scenario:
    """Return the site, its phases walking by ``drift_rad`` in the hour of the recording."""
    base = site(ROWS, n_frame)
    dropped = [
        {"receiver": c.id, "frame": f, "first_sample": 0, "sample_count": FRAME_SAMPLES}
        for c in base.calibration_receiver
        for f in range(N_CALIBRATED, n_frame)
    ]
    return base.changed(
        heliostat=[h.changed(pivot_sigma_m=0.005, **mirror) for h in base.heliostat],
        simulation={
            "frame_interval_s": 3600.0 / n_frame,
            "transmitter_phase_drift_rad_per_sqrt_h": drift_rad,
            "dropped": dropped if stale else None,
        },
    )


def without_calibration(scenario: Scenario) -> Scenario:
    """Return the site without its calibration receivers."""
    return scenario.changed(calibration_receiver=None, simulation={"dropped": None})


def measure(n_frame: int, drift_rad: float, *, mirror: dict[str, Any], seed: int = 7) -> dict[str, Evaluation]:
    """Simulate, process and evaluate in each form."""
    out = {}
    for stale in (False, True):
        scenario = drifting(n_frame, drift_rad, stale=stale, mirror=mirror)
        recording = simulate(scenario, seed=seed)
        forms: dict[str, dict[str, Any]] = {"three fits": {"pose": "independent"}, "rigid": {}}
        if not stale:
            forms["differences"] = {"scenario": without_calibration(scenario)}
        for name, options in forms.items():
            result = process(recording, estimator="correlator", **options)
            out[f"{name}, stale" if stale else name] = evaluate(result)
    return out


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100)
    n_frame = parser.parse_args().frames
    logging.getLogger("rfpose").setLevel(logging.ERROR)
    print("| clocks | drift in an hour [rad] | form | normal error [mrad] | stated | over bound | failed |")
    print("|---|---|---|---|---|---|---|")
    for clocks, mirror in CLOCKS.items():
        for drift in (0.0, 0.1, 1.0):
            found = measure(n_frame, drift, mirror=mirror)
            for form, e in found.items():
                print(
                    f"| {clocks} | {drift:g} | {form} | {e.normal_error_mrad.rms:.3f} | {e.sigma_mrad:.3f} "
                    f"| {e.ratio_to_bound:.3f} | {e.failed} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
