"""Normals from IQ at the paper's parameters: simulate, process, evaluate, against the bound.

    python benchmarks/pose_chain.py --frames 400

Table 2 at a radius of 100 m, one mirror at each place and posture of the table in docs/pose.md, receivers 1.73 m apart,
four calibration receivers, one tone of 750 kHz, no carrier phase. Frames are short and strong, not long and weak:
samples times signal-to-noise ratio, all that the bound depends on, is that of 10⁶ samples in the paper: 0.97 mm.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from rfpose.pipeline.choice import choose
from rfpose.pipeline.evaluate import Evaluation, evaluate
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.pipeline.solve import solve
from rfpose.scenario import Scenario, load_scenario

SHIPPED = Path(__file__).resolve().parents[1] / "data" / "table2_100m.toml"
ROWS = (
    ((1, 0, 0), (-1, 0, 1)),
    ((1, 0, 0), (0, -1, 1)),
    ((0, 1, 0), (0, -1, 1)),
    ((0, 1, 0), (-1, 0, 1)),
    ((0, 0, 0), (-1, 0, 1)),
    ((0, 0, 0), (0, 0, 1)),
)
FRAME_SAMPLES = 8000
RANGE_SIGMA_M = 100.0 * np.sqrt(1.89e-10 / 2.0)
"""Of one transmitter (Swart et al. §4.5 gives the difference's)."""
FORMS = {
    "three fits": {"pose": "independent"},
    "rigid, three clocks": {"pose": "rigid"},
    "rigid, one clock": {"pose": "rigid", "receiver_delay_sigma_s": 0.0},
}


def site(rows: tuple[Any, ...], n_frame: int) -> Scenario:
    """Return the shipped field with one mirror a row."""
    shipped = load_scenario(SHIPPED)
    heliostats = [
        shipped.heliostat[0].changed(
            id=f"M{k}",
            pivot_enu_m=[100.0 * x for x in place],
            normal_enu=list(facing),
            receiver_ids=[f"M{k}_r{r}" for r in range(3)],
            carrier_phase=False,
        )
        for k, (place, facing) in enumerate(rows)
    ]
    calibration_receivers = [
        {"id": f"cal{k}", "position_enu_m": [x, y, 2.5]}
        for k, (x, y) in enumerate([(15, -20), (-40, 30), (50, 50), (-30, -60)])
    ]
    wavelength_m = 299_792_458.0 / shipped.tone_hz[0]
    phase_sigma = 2.0 * np.pi * RANGE_SIGMA_M / wavelength_m
    return shipped.changed(
        heliostat=heliostats,
        calibration_receiver=calibration_receivers,
        radio={"frame_samples": FRAME_SAMPLES, "clock_search_ppm": 2.0},
        simulation={
            "frame_count": n_frame,
            "frame_interval_s": 0.1,
            "tone_snr_db": -10.0 * np.log10(FRAME_SAMPLES * phase_sigma**2),
            "path_loss": "none",
            "clock_offset_ppm": 0.0,
        },
    )


def measure(rows: tuple[Any, ...], n_frame: int, *, seed: int = 7) -> dict[str, Evaluation]:
    """Simulate, process and evaluate; each form of the pose from the same phases."""
    scenario = site(rows, n_frame)
    result = process(simulate(scenario, seed=seed), estimator="correlator")
    out = {}
    for name, form in FORMS.items():
        known = {k: v for k, v in form.items() if k != "pose"}
        told = scenario.changed(heliostat=known)
        choice = choose(told, pose=str(form["pose"]))
        how = {"sample_rate": result.sample_rate, "settings": result.settings, "truth": result.truth}
        out[name] = evaluate(solve(result.tones, told, choice, **how))
    return out


def main() -> None:
    """Print the table of docs/pose.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=400)
    args = parser.parse_args()
    found = measure(ROWS, args.frames)
    print("| mirror at, facing | " + " | ".join(f"{name}: error / bound" for name in found) + " |")
    print("|---" * (1 + len(found)) + "|")
    for k, (place, facing) in enumerate(ROWS):
        cells = []
        for evaluation in found.values():
            row = evaluation.heliostats[k]
            ratio = row.normal_error_mrad.rms / row.bound_mrad
            cells.append(f"{row.normal_error_mrad.rms:.3f} / {row.bound_mrad:.3f} = {ratio:.3f}")
        name = f"({','.join(map(str, place))}), ({','.join(map(str, facing))})".replace("-", "−")
        print(f"| {name} | " + " | ".join(cells) + " |")
    for name, evaluation in found.items():
        print(f"{name}: {evaluation.ratio_to_bound:.3f}, {evaluation.solved} solved, {evaluation.failed} failed")


if __name__ == "__main__":
    main()
