"""What a second tone is worth: bound of the normal with {0.75, f} MHz over that with 0.75 MHz alone.

    python benchmarks/two_tones.py

Random mirrors of the 100 m field, one clock a receiver and tone, transmitters calibrated. Phase noise is that of one
tone at the paper's parameters (15.8 µrad) where a row does not say otherwise.
"""

from __future__ import annotations

import numpy as np
from wrong_fix import PLACES_M, SPEED_MPS, TRANSMITTER_ENU_M, draw_mirrors

from rfpose.multilat.rigid import MirrorProblem, rigid_bound, tilt_sigma_rad

N_MIRROR = 2000
SIGMA_RAD = 1.58e-5


def normal_rms_mrad(tones_hz: tuple[float, ...], sigma_rad: tuple[float, ...]) -> float:
    """Rms of the bound over the field [mrad]."""
    pivot, rot = draw_mirrors(np.random.default_rng(0), N_MIRROR)
    own = [
        np.full((N_MIRROR, 3, 10), SPEED_MPS / f / (2 * np.pi) * s) for f, s in zip(tones_hz, sigma_rad, strict=True)
    ]
    cov = rigid_bound(
        MirrorProblem.expected(
            TRANSMITTER_ENU_M,
            np.tile(PLACES_M, (N_MIRROR, 1, 1)),
            pivot,
            rot,
            sigma_m=np.stack(own, axis=1),
            transmitter_sigma_m=1e-9,
            clock_class=np.arange(len(tones_hz)),
        )
    )
    return float(1e3 * np.sqrt(np.mean(tilt_sigma_rad(cov, rot[:, :, 2]) ** 2)))


def main() -> None:
    """Print one row a set of tones."""
    alone = normal_rms_mrad((0.75e6,), (SIGMA_RAD,))
    rows = [
        ("{0.75} MHz", (0.75e6,), (1.0,)),
        ("{6.1} MHz, integers known", (6.1e6,), (1.0,)),
        ("{0.75, 6.1} MHz, each with the index of the one", (0.75e6, 6.1e6), (1.0, 1.0)),
        ("{0.75, 6.1} MHz, the fine one's index 2 % larger", (0.75e6, 6.1e6), (1.0, 1 / 1.02)),
        ("{0.75, 6.21} MHz, each with the index of the one", (0.75e6, 6.21e6), (1.0, 1.0)),
        ("{0.75, 6.1} MHz, the index shared evenly", (0.75e6, 6.1e6), (2.0, 2.0)),
        ("{0.75, 6.1} MHz, a tenth of the index for the coarse one", (0.75e6, 6.1e6), (10.0, 1 / 0.9)),
    ]
    print("| tones | normal [mrad] | over 0.75 MHz alone | 1/√Σ(f·index)² |")
    print("|---|---|---|---|")
    for label, tones, noise in rows:
        error = normal_rms_mrad(tones, tuple(SIGMA_RAD * n for n in noise))
        simple = 0.75e6 / np.sqrt(sum((f / n) ** 2 for f, n in zip(tones, noise, strict=True)))
        print(f"| {label} | {error:.4f} | {error / alone:.4f} | {simple:.4f} |")


if __name__ == "__main__":
    main()
