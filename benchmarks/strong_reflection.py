"""From IQ to normals with coefficients of size 0.5 at 433 MHz, begun as `rfpose process` begins.

    python benchmarks/strong_reflection.py

Four mirrors of the shipped field in four frames, tones of 0.75 and 7.5 MHz, 46 dB a sample, pivots surveyed to 5 mm,
one clock a mirror, calibration receivers as shipped. Ratios are rms error of solved mirror-frames over their bound.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rfpose.pipeline.evaluate import evaluate
from rfpose.pipeline.process import process
from rfpose.pipeline.simulate import simulate
from rfpose.scenario import Scenario, load_scenario

SHIPPED = Path(__file__).resolve().parents[1] / "data" / "table2_100m.toml"
SIZE = 0.4995
PHASES_RAD = (0.0, 1.5, 3.0, 4.5)


def site(coefficient: complex) -> Scenario:
    """Return four heliostats of the shipped field, carriers far enough apart for 7.5 MHz tones."""
    shipped = load_scenario(SHIPPED)
    return shipped.changed(
        heliostat=[h.changed(pivot_sigma_m=0.005, receiver_delay_sigma_s=0.0) for h in shipped.heliostat[:4]],
        radio={
            "sample_rate_hz": 64e6,
            "frame_samples": 4000,
            "clock_search_ppm": 2.0,
            "centre_frequency_hz": 433e6,
        },
        tone=[{"frequency_hz": f, "modulation_index": 0.4} for f in (0.75e6, 7.5e6)],
        transmitter=[t.changed(carrier_hz=-16.2e6 + 3.6e6 * i) for i, t in enumerate(shipped.transmitter)],
        simulation={
            "frame_count": 4,
            "frame_interval_s": 1.0,
            "tone_snr_db": 46.0,
            "sun_azimuth_deg": 170.0,
            "path_loss": "free_space",
            "ground": {"coefficient": (coefficient.real, coefficient.imag)},
        },
    )


def main() -> None:
    """Print the table."""
    print("| coefficient | found | solved | marked | over bound |")
    print("|---|---|---|---|---|")
    for phase in PHASES_RAD:
        coefficient = complex(SIZE * np.exp(1j * phase))
        result = process(simulate(site(coefficient), seed=5), estimator="correlator", reflection="estimate")
        evaluation = evaluate(result)
        reflection = result.reflection
        found = complex(np.nan) if reflection is None else complex(reflection.coefficient[0, 0, 0])
        print(
            f"| {coefficient:+.4f} | {found:+.4f} | {evaluation.solved} | {evaluation.failed} "
            f"| {evaluation.ratio_to_bound:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
