"""Filter over frames: error with and without it, whether its covariance is true, coasting, speed.

    python benchmarks/moving_mirrors.py

Mirrors turn at rates that walk; a frame measures rotation with 0.5 mrad and pivot with 2 mm in each axis. ``NEES`` is
the mean of errorᵀ·covariance⁻¹·error over degrees of freedom: 1 where the covariance tells the truth.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rfpose.geometry import rot_enu_from_mirror
from rfpose.multilat.filtering import FilteredPoses, FilterSettings, filter_poses

Array = NDArray[np.float64]

ROTATION_SIGMA_RAD, PIVOT_SIGMA_M = 5e-4, 2e-3
FRAME_S = 10.0


def simulate(rng: np.random.Generator, n_frame: int, n_mirror: int, walk: float) -> tuple[Array, Array, Array]:
    """Return true rotations, measured rotations, measured pivots (true pivots are zero)."""
    turn = Rotation.from_matrix(rot_enu_from_mirror(rng.normal([0, 0, 2], 1.0, (n_mirror, 3))))
    rate = 7e-5 * rng.standard_normal((n_mirror, 3))
    true, measured = [], []
    for _ in range(n_frame):
        a, b = rng.standard_normal((2, n_mirror, 3))
        angle = rate * FRAME_S + walk * FRAME_S**1.5 * (a / 2 + b / np.sqrt(12.0))
        rate = rate + walk * np.sqrt(FRAME_S) * a
        turn = Rotation.from_rotvec(angle) * turn
        noise = Rotation.from_rotvec(ROTATION_SIGMA_RAD * rng.standard_normal((n_mirror, 3)))
        true.append(turn.as_matrix())
        measured.append((noise * turn).as_matrix())
    return np.array(true), np.array(measured), PIVOT_SIGMA_M * rng.standard_normal((n_frame, n_mirror, 3))


def errors(found: FilteredPoses, true: Array, frame: int) -> tuple[float, float]:
    """Return the rms angle of the normal [mrad], and NEES of the rotation."""
    left = Rotation.from_matrix(true[frame] @ found.rot_enu_from_mirror[frame].swapaxes(1, 2)).as_rotvec()
    cov = found.cov[frame][:, 3:6, 3:6]
    nees = np.mean(np.einsum("ma,ma->m", left, np.linalg.solve(cov, left[..., None])[..., 0])) / 3.0
    off = found.normal_enu[frame] - true[frame][:, :, 2]
    return float(1e3 * np.sqrt(np.mean(np.sum(off**2, axis=1)))), float(nees)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-n", type=int, default=2000, help="mirrors")
    options = parser.parse_args()
    n_frame, n = 60, options.n
    cov = np.broadcast_to(np.diag(np.repeat([PIVOT_SIGMA_M**2, ROTATION_SIGMA_RAD**2], 3)), (n_frame, n, 6, 6))
    at = FRAME_S * np.arange(n_frame)
    print(
        "| rate walks by [rad/s/√s] | one frame [mrad] | filtered [mrad] | NEES | after 2 min of outage [mrad] | NEES |"
    )
    print("|---|---|---|---|---|---|")
    for walk in (1e-7, 1e-6, 1e-5):
        true, measured, pivot = simulate(np.random.default_rng(1), n_frame, n, walk)
        motion = FilterSettings(rate_walk_radps_per_sqrt_s=walk, rate_sigma_radps=7e-5)
        single = 1e3 * np.sqrt(np.mean(np.sum((measured[-1] - true[-1])[:, :, 2] ** 2, axis=1)))
        filtered, nees = errors(filter_poses(pivot, measured, cov, time_s=at, motion=motion), true, n_frame - 1)
        measured[-12:] = np.nan
        coasted, coasted_nees = errors(filter_poses(pivot, measured, cov, time_s=at, motion=motion), true, n_frame - 1)
        print(f"| {walk:g} | {single:.3f} | {filtered:.3f} | {nees:.3f} | {coasted:.3f} | {coasted_nees:.3f} |")
    begun = time.perf_counter()
    filter_poses(pivot, measured, cov, time_s=at)
    print(f"\n{1e6 * (time.perf_counter() - begun) / (n * n_frame):.2f} µs a mirror and frame")


if __name__ == "__main__":
    main()
