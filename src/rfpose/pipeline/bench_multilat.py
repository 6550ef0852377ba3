"""How many fixes a second, against what one would write with scipy, in the same run."""

from __future__ import annotations

import time

import numpy as np
from scipy.optimize import least_squares

from rfpose.checks import FloatArray, as_positive
from rfpose.multilat import locate

__all__ = ["measure"]

N_RECEIVER = 100_000
N_SCIPY = 50
SIGMA_M = 1e-3
# Table 2 of Swart et al., for a field of 100 m radius
TRANSMITTER_ENU_M = 100.0 * np.array(
    [
        [1.0, 0.0, 0.2],
        [0.5, 0.866, 0.3],
        [-0.5, 0.866, 0.2],
        [-1.0, 0.0, 0.3],
        [-0.5, -0.866, 0.2],
        [0.5, -0.866, 0.3],
        [0.433, 0.25, 0.4],
        [-0.433, 0.25, 0.4],
        [0.0, -0.5, 0.4],
        [0.0, 0.0, 0.5],
    ]
)


def measure(seconds: float) -> dict[str, float]:
    """Measure cold-start fixes through `rfpose.multilat.locate`, covariance included, and the same through scipy.

    Ten transmitters (Table 2, 100 m), millimetre noise, receivers all over the disc. Scipy solves one receiver
    after the other by `scipy.optimize.least_squares` with its Jacobian given, from the middle of the field.
    Rounds of both alternate until the time is up; each rate is that of its best round, so that what else runs on
    the machine counts least.

    Parameters
    ----------
    seconds
        Time to spend, compilation aside [s]; three rounds of each are done at least.

    Returns
    -------
    dict
        ``fixes_per_s``, ``scipy_fixes_per_s``, ``speedup_vs_scipy``; ``iterations`` is the mean number of
        Gauss-Newton steps, ``worst_difference_m`` the largest distance between the two answers.
    """
    seconds = as_positive("seconds", seconds)
    rng = np.random.default_rng(20)
    ranges = _ranges(rng)
    fixes = locate(TRANSMITTER_ENU_M, ranges, sigma_m=SIGMA_M)
    ours, theirs = np.inf, np.inf
    end = time.perf_counter() + seconds
    rounds = 0
    while rounds < 3 or time.perf_counter() < end:
        for _ in range(5):
            start = time.perf_counter()
            fixes = locate(TRANSMITTER_ENU_M, ranges, sigma_m=SIGMA_M)
            ours = min(ours, (time.perf_counter() - start) / N_RECEIVER)
        start = time.perf_counter()
        reference = np.array([_scipy_fix(row) for row in ranges[:N_SCIPY]])
        theirs = min(theirs, (time.perf_counter() - start) / N_SCIPY)
        rounds += 1
    difference = np.linalg.norm(fixes.position_enu_m[:N_SCIPY] - reference, axis=1)
    return {
        "fixes_per_s": 1.0 / ours,
        "scipy_fixes_per_s": 1.0 / theirs,
        "speedup_vs_scipy": theirs / ours,
        "iterations": float(fixes.n_iteration.mean()),
        "worst_difference_m": float(difference.max()),
    }


def _ranges(rng: np.random.Generator) -> FloatArray:
    """(receiver, transmitter) noisy range differences to the last transmitter [m]."""
    radius = 100.0 * np.sqrt(rng.random(N_RECEIVER))
    angle = 2.0 * np.pi * rng.random(N_RECEIVER)
    receiver = np.stack([radius * np.cos(angle), radius * np.sin(angle), 5.0 * rng.random(N_RECEIVER)], axis=-1)
    distance = np.linalg.norm(receiver[:, None] - TRANSMITTER_ENU_M, axis=-1)
    distance += SIGMA_M * rng.standard_normal(distance.shape)
    return np.asarray(distance - distance[:, -1:])


def _scipy_fix(range_difference_m: FloatArray) -> FloatArray:
    """One receiver's position by scipy, from the middle of the field."""

    def residual(b: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(b[:3] - TRANSMITTER_ENU_M, axis=1) - b[3] - range_difference_m)

    def jacobian(b: FloatArray) -> FloatArray:
        offset = b[:3] - TRANSMITTER_ENU_M
        unit = offset / np.linalg.norm(offset, axis=1, keepdims=True)
        return np.concatenate([unit, -np.ones((len(unit), 1))], axis=1)

    solution = least_squares(
        residual, np.array([0.0, 0.0, 2.0, 50.0]), jac=jacobian, xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    return np.asarray(solution.x[:3])
