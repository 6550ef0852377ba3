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
from rfpose.feedback.mount import PARAMETERS, Mount, command, posture, stack_mounts

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


def radio_against_drone() -> None:
    """Beam error over a year by number of radio poses, and the drone's with 240 points."""
    rng = np.random.default_rng(1)
    target = np.array([11.0, 27.0, 4.25])
    start = Mount(pivot_enu_m=np.zeros(3), parameters={"arm_normal_m": 0.4325, "arm_up_m": 0.24})
    true = start.replace(axis_2_zero_rad=np.deg2rad(3.0), axis_1_zero_rad=np.deg2rad(-3.0))
    hour = np.linspace(-1.2, 1.2, 9)
    latitude = np.deg2rad(-33.9)
    year = []
    for d in np.deg2rad([-23.4, -12.0, 0.0, 12.0, 23.4]):
        north = np.cos(latitude) * np.sin(d) - np.sin(latitude) * np.cos(d) * np.cos(hour)
        up = np.sin(latitude) * np.sin(d) + np.cos(latitude) * np.cos(d) * np.cos(hour)
        year.append(np.stack([-np.cos(d) * np.sin(hour), north, up], axis=-1))
    sun = np.concatenate(year)
    aim = np.broadcast_to(target, sun.shape)

    def beam_error_mrad(made: list[Measurements], free: tuple[str, ...], settings: FitSettings) -> float:
        found = fit_many([start] * len(made), made, free=free, settings=settings)
        total = []
        for values in found.working:
            got = posture(
                true,
                command(start.replace(**dict(zip(free, values, strict=True))), sun_enu=sun, target_enu_m=aim).count,
            )
            beam = 2.0 * np.sum(got.normal_enu * sun, axis=1, keepdims=True) * got.normal_enu - sun
            total.append(np.mean(geometry.angle_between_rad(beam, target - got.centre_enu_m)))
        return 1e3 * float(np.mean(total))

    gps = np.array([5.602, 5.781, 8.866]) * 1e-3
    made = []
    for _ in range(20):
        bearing = np.arctan2(target[0], target[1]) + rng.uniform(-2.6, 2.6, 240)
        drone = 32.0 * geometry.enu_from_azimuth_elevation(bearing, np.arcsin(rng.uniform(0.05, 0.99, 240)))
        toward = geometry.unit(drone)
        for _ in range(12):
            count = command(true, sun_enu=toward, target_enu_m=np.broadcast_to(target, drone.shape)).count
            toward = geometry.unit(drone - posture(true, count).centre_enu_m)
        seen = drone + gps * rng.normal(size=drone.shape)
        made.append(Measurements.from_points(count, source_enu_m=seen, target_enu_m=target, sigma_rad=1e-4))
    free = PARAMETER_SETS["edwards-4"]
    # Gouws' bounds as priors: a place to 50 mm, arms to 10 and 100 mm, each uniform
    place = {f"location_{axis}_m": (0.0, 0.029) for axis in ("east", "north", "up")}
    arms = {"arm_normal_m": (0.4325, 0.0058), "arm_up_m": (0.24, 0.058)}
    survey = FitSettings(sigma_known=True, huber=np.inf, priors=place | arms)
    nine, four = beam_error_mrad(made, PARAMETER_SETS["gouws"], survey), beam_error_mrad(made, free, LEAST_SQUARES)
    print(f"240 drone points: {nine:.3f} mrad of the beam with nine parameters, {four:.3f} with four")
    for sigma in (1.69e-3 / np.sqrt(2.0), 0.3e-3):
        line = []
        for n in (10, 30, 100, 300, 1000, 3000):
            made = []
            for _ in range(20):
                count = np.column_stack([rng.uniform(-2.0, 2.0, n), rng.uniform(0.1, 1.4, n)])
                normal = posture(true, count).normal_enu + sigma * rng.normal(size=(n, 3))
                made.append(Measurements.from_normals(count, normal_enu=normal, sigma_rad=sigma))
            line.append(f"{n}: {beam_error_mrad(made, free, LEAST_SQUARES):.3f}")
        print(f"radio poses of {1e3 * sigma:.2f} mrad a component, beam error by number: {', '.join(line)}")


if __name__ == "__main__":
    speed(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
    radio_against_drone()
