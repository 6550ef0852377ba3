"""Calibration at scale: a field's fits against scipy's Nelder-Mead, and radio poses against a drone.

    python benchmarks/calibration_fit.py [HELIOSTATS]

Fits heliostats of 50 measurements, eight parameters each (Malan's), and extrapolates to 10 000. Nelder-Mead, which
is Malan's method, runs on the same compiled residuals, one heliostat at a time. Then: the beam's mean error over a
year after calibration by N radio poses, and by 240 drone points.
"""

from __future__ import annotations

import sys
import time

import numba
import numpy as np
from scipy.optimize import minimize

from rfpose import geometry
from rfpose.feedback import _kernels
from rfpose.feedback.calibration import PARAMETER_SETS, FitSettings, fit_many, pad
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import PARAMETERS, Mount, command, stack_mounts

N_MEASUREMENT = 50
SIGMA_RAD = 3e-4
LEAST_SQUARES = FitSettings(sigma_known=True, huber=np.inf)
TARGETS = np.array([[0.0, 0.0, 100.0], [0.0, 0.0, 60.0], [12.0, 0.0, 80.0]])


def a_field(n: int, rng: np.random.Generator) -> tuple[list[Mount], list[Measurements]]:
    """Mounts with errors of some milliradians and centimetres, and spots on three targets."""
    mounts, made = [], []
    aim = TARGETS[np.arange(N_MEASUREMENT) % 3]
    names = PARAMETER_SETS["malan"]
    for _ in range(n):
        bearing, distance = rng.uniform(0, 2 * np.pi), rng.uniform(60, 400)
        nominal = Mount(pivot_enu_m=np.array([distance * np.sin(bearing), distance * np.cos(bearing), 4.0]))
        true = nominal.replace(**{name: 5.0 * PARAMETERS[name] * rng.normal() for name in names})
        sun = geometry.enu_from_azimuth_elevation(
            rng.uniform(0.5 * np.pi, 1.5 * np.pi, N_MEASUREMENT), rng.uniform(0.2, 1.2, N_MEASUREMENT)
        )
        count = command(true, sun_enu=sun, target_enu_m=aim).count + SIGMA_RAD * rng.normal(size=(N_MEASUREMENT, 2))
        mounts.append(nominal)
        made.append(Measurements.from_spots(count, sun_enu=sun, spot_enu_m=aim, sigma_rad=SIGMA_RAD))
    return mounts, made


def speed(n: int) -> None:
    """Time the fit of a field and of one heliostat by Nelder-Mead."""
    mounts, made = a_field(n, np.random.default_rng(0))
    fit_many(mounts[:2], made[:2], free="malan", settings=LEAST_SQUARES)
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        found = fit_many(mounts, made, free="malan", settings=LEAST_SQUARES)
        seconds.append(time.perf_counter() - start)
    each = min(seconds) / n
    print(f"{n} heliostats x {N_MEASUREMENT} on {numba.get_num_threads()} threads: {min(seconds):.2f} s")
    print(f"10 000 heliostats, extrapolated: {1e4 * each:.1f} s; steps a fit {found.iterations.mean():.1f}")
    index = [list(PARAMETERS).index(name) for name in found.free]
    scale = np.array([PARAMETERS[name] for name in found.free])
    ratios, worst = [], 0.0
    for i in range(3):
        p, k = stack_mounts(mounts[i : i + 1])
        count, row, use = pad(mounts[i : i + 1], made[i : i + 1])
        work, out = p[0].copy(), np.empty((N_MEASUREMENT, 3))

        def cost(x: np.ndarray, work=work, k=k, count=count, row=row, use=use, out=out) -> float:
            work[index] = x * scale
            _kernels._residuals(work, k[0], count[0], row[0], use[0], out)
            return float(np.mean(out**2))

        cost(np.zeros(len(scale)))
        options = {"maxiter": 100_000, "maxfev": 100_000, "xatol": 1e-6, "fatol": 1e-12, "adaptive": True}
        start = time.perf_counter()
        best = minimize(cost, np.zeros(len(scale)), method="Nelder-Mead", options=options)
        ratios.append((time.perf_counter() - start) / each)
        worst = max(worst, float(np.max(np.abs(best.x * scale - found.working[i]) / found.sigma[i])))
    print(f"Nelder-Mead over ours, by heliostat: {np.median(ratios):.0f}; optima differ by {worst:.1e} sigma")


if __name__ == "__main__":
    speed(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
