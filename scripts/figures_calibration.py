"""Radio poses against a drone: how many poses know a mount as well as 240 drone points do; table and picture.

``python scripts/figures_calibration.py [FOLDER]`` prints the numbers that docs/heliostat-calibration.md quotes and
writes radio-against-drone.png (FOLDER: docs/images).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rfpose import geometry
from rfpose.feedback.calibration import PARAMETER_SETS, FieldCalibration, FitSettings, fit_many, posture_jacobian
from rfpose.feedback.drone import CAMERA, fly, gouws_bounds, uniform_priors
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount, command, posture
from rfpose.feedback.optics import reflect
from rfpose.sun import Location, sun_position

TARGET = np.array([11.0, 27.0, 4.25])
START = Mount(pivot_enu_m=np.zeros(3), parameters={"arm_normal_m": 0.4325, "arm_up_m": 0.24})
TRUE = START.replace(axis_2_zero_rad=np.deg2rad(3.0), axis_1_zero_rad=np.deg2rad(-3.0))
SITE = Location(latitude_rad=np.deg2rad(-33.927), longitude_rad=np.deg2rad(18.864), altitude_m=119.0)
LEAST_SQUARES = FitSettings(sigma_known=True, huber=np.inf)
FOUR = PARAMETER_SETS["edwards-4"]
NUMBERS = (3, 10, 30, 100, 300, 1000, 3000, 10000)
# sigma of one component [rad]: RMS of the normal over √2
POSES = {
    "1.69 mrad (paper)": 1.69e-3 / np.sqrt(2.0),
    "0.5 mrad": 0.5e-3 / np.sqrt(2.0),
    "0.1 mrad": 0.1e-3 / np.sqrt(2.0),
}
TRIALS = 150


def a_year() -> np.ndarray:
    """Suns of the tenth of each month of 2018, every forty minutes."""
    days = np.array([f"2018-{month:02d}-10T06:00" for month in range(1, 13)], "datetime64[s]").astype(np.int64)
    suns = sun_position((days[:, None] + 2400 * np.arange(14)).ravel().astype(float), SITE)
    return suns.direction_enu[suns.elevation_rad > 0.1]


YEAR = a_year()


def beam_errors_mrad(found: FieldCalibration) -> np.ndarray:
    """Mean miss of the beam over the year, one a trial [mrad of the beam]."""
    aim = np.broadcast_to(TARGET, YEAR.shape)
    means = []
    for values in found.working:
        fitted = START.replace(**dict(zip(found.free, values, strict=True)))
        got = posture(TRUE, command(fitted, sun_enu=YEAR, target_enu_m=aim).count)
        miss = geometry.angle_between_rad(reflect(got.normal_enu, YEAR), TARGET - got.centre_enu_m)
        means.append(1e3 * np.mean(miss))
    return np.array(means)


def poses(n: int, sigma: float, rng: np.random.Generator) -> Measurements:
    """Radio poses spread over all postures."""
    count = np.column_stack([rng.uniform(-np.pi, np.pi, n), rng.uniform(0.1, 1.4, n)])
    normal = posture(TRUE, count).normal_enu
    error = sigma * rng.standard_normal((n, 3))
    error -= np.sum(error * normal, axis=1, keepdims=True) * normal
    return Measurements.from_normals(count, normal_enu=normal + error, sigma_rad=sigma)


def residuals(found: FieldCalibration) -> tuple[float, float]:
    """Predicted and achieved RMS of the normal over the year's postures, all trials together [mrad]."""
    aim = np.broadcast_to(TARGET, YEAR.shape)
    count = command(TRUE, sun_enu=YEAR, target_enu_m=aim).count
    normal = posture(TRUE, count).normal_enu
    ahead = Measurements.from_normals(count, normal_enu=normal)
    jacobian = posture_jacobian(TRUE, ahead, found.free) * 1.0
    told, got = [], []
    for values, covariance in zip(found.working, found.covariance, strict=True):
        told.append(np.mean(np.einsum("nxf,fg,nxg->n", jacobian, covariance, jacobian)))
        fitted = START.replace(**dict(zip(found.free, values, strict=True)))
        got.append(np.mean(np.sum((posture(fitted, count).normal_enu - normal) ** 2, axis=1)))
    return 1e3 * float(np.sqrt(np.mean(told))), 1e3 * float(np.sqrt(np.mean(got)))


def main(folder: Path) -> None:
    """Fit, print, draw."""
    rng = np.random.default_rng(1)
    flights = fly([TRUE] * TRIALS, target_enu_m=TARGET, n_point=240, rng=rng)
    bounds = gouws_bounds(START)
    nine = FitSettings(sigma_known=True, huber=np.inf, priors=uniform_priors(bounds), bounds=bounds, max_iteration=200)
    drone = {
        "nine parameters and camera offset": beam_errors_mrad(
            fit_many([START] * TRIALS, flights, free=(*PARAMETER_SETS["gouws"], *CAMERA), settings=nine)
        ).mean(),
        "four parameters": beam_errors_mrad(
            fit_many([START] * TRIALS, flights, free=FOUR, settings=LEAST_SQUARES)
        ).mean(),
    }
    for name, value in drone.items():
        print(f"240 drone points, {name}: {value:.4f} mrad of the beam")
    curves: dict[str, np.ndarray] = {}
    for name, sigma in POSES.items():
        line = []
        for n in NUMBERS:
            made = [poses(n, sigma, rng) for _ in range(TRIALS)]
            found = fit_many([START] * TRIALS, made, free=FOUR, settings=LEAST_SQUARES)
            line.append(beam_errors_mrad(found).mean())
            told, got = residuals(found)
            print(f"{n:6d} poses of {name}: beam {line[-1]:.4f} mrad; normal predicted {told:.4f}, achieved {got:.4f}")
        curves[name] = np.array(line)
        # error falls as the root of the number: its constant from all numbers of ten and more
        constant = np.exp(np.mean(np.log(curves[name][1:] * np.sqrt(NUMBERS[1:]))))
        for label, value in drone.items():
            print(f"   as good as 240 drone points with {label}: {(constant / value) ** 2:.0f} poses")
    draw(folder / "radio-against-drone.png", drone, curves)


def draw(path: Path, drone: dict[str, float], curves: dict[str, np.ndarray]) -> None:
    """Draw beam error by number of poses, the drone as level lines."""
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, line in curves.items():
        axes.loglog(NUMBERS, line, "o-", markersize=4, label=f"radio, {name} a pose")
    for (name, value), style in zip(drone.items(), ("--", ":"), strict=True):
        axes.axhline(value, color="0.3", linestyle=style, label=f"drone, 240 points, {name}")
    axes.set_xlabel("radio poses, spread over all postures")
    axes.set_ylabel("mean miss of the beam over a year [mrad]")
    axes.grid(True, which="both", alpha=0.2)
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    print(f"wrote {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1] / "docs" / "images")
