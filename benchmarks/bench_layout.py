"""Print the speed of layout maps against one numpy solution a point, in the same run, and the optimiser's results.

python benchmarks/bench_layout.py [--optimise]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from rfpose.layout import maps
from rfpose.layout.maps import ESTIMATORS, PosedMirrors
from rfpose.layout.optimise import CRITERIA, Constraints, Zone, evaluate_placement, optimise
from rfpose.measurement import Noise
from rfpose.pipeline.bench_multilat import TRANSMITTER_ENU_M

PLACES = np.array([[0.9988, 0.0, 0.0], [-0.4994, 0.865, 0.0], [-0.4994, -0.865, 0.0]])
SIGMA_M, CARRIER_M = 1e-3, 1e-5
N_LOOP = 200


def field(n: int, scale: float = 100.0) -> PosedMirrors:
    """Mirrors all over a disc, facing the tower under one sun."""
    point = maps.disc_points(n, radius_m=scale)
    return maps.mirrors_facing(
        point, PLACES * scale / 100.0, aim_enu_m=[0.0, 0.0, 0.5 * scale], sun_enu=[0.0, -0.5, 0.7]
    )


def best(function: Callable[[], Any], rounds: int = 15) -> float:
    """Seconds of the fastest round."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def loop(mirrors: PosedMirrors, name: str, n: int) -> np.ndarray:
    """One mirror after the other in numpy: rows of the Jacobian, normal matrix, inverse."""
    out = np.empty(n)
    t = TRANSMITTER_ENU_M
    estimator = ESTIMATORS.get(name)
    for i in range(n):
        if estimator is None:
            u = mirrors.pivot_enu_m[i] - t
            u /= np.linalg.norm(u, axis=1)[:, None]
            j = np.column_stack([u, -np.ones(len(t))])
            out[i] = np.sqrt(np.trace(np.linalg.inv(j.T @ j)[:3, :3]))
            continue
        rot = mirrors.rot_enu_from_mirror[i]
        arm = PLACES @ rot.T
        if not estimator.rigid:
            cov = np.zeros((9, 9))
            for r in range(3):
                u = mirrors.pivot_enu_m[i] + arm[r] - t
                u /= np.linalg.norm(u, axis=1)[:, None]
                j = np.column_stack([u, -np.ones(len(t))]) / SIGMA_M
                cov[3 * r : 3 * r + 3, 3 * r : 3 * r + 3] = np.linalg.inv(j.T @ j)[:3, :3]
            p, q = arm[1] - arm[0], arm[2] - arm[0]
            cross = np.cross(p, q)
            length = np.linalg.norm(cross)
            eye = np.eye(3)
            across = (eye - np.outer(cross, cross) / length**2) / length
            dp, dq = np.cross(eye, q).T, np.cross(p, eye).T
            jac = across @ np.hstack([-dp - dq, dp, dq])
            out[i] = np.sqrt(np.trace(jac @ cov @ jac.T))
            continue
        shared = estimator.clock_sigma_m == 0.0
        n_clock = 1 if shared else 3
        n_class = 2 if estimator.carrier else 1
        size = 6 + n_clock * n_class
        info = np.zeros((size, size))
        for k in range(n_class):
            sum_rows = np.zeros((len(t), size))
            weight = (CARRIER_M if k else SIGMA_M) ** -2
            for r in range(3):
                u = mirrors.pivot_enu_m[i] + arm[r] - t
                u /= np.linalg.norm(u, axis=1)[:, None]
                rows = np.zeros((len(t), size))
                rows[:, :3] = u
                rows[:, 3:6] = np.cross(arm[r], u)
                rows[:, 6 + k * n_clock + (0 if shared else r)] = 1.0
                info += weight * rows.T @ rows
                sum_rows += rows
            if k:
                info -= weight / 3.0 * sum_rows.T @ sum_rows
                info[6 + k * n_clock, 6 + k * n_clock] += weight
        info[:3, :3] += np.eye(3) / estimator.pivot_sigma_m**2
        turn = np.linalg.inv(info)[3:6, 3:6]
        out[i] = np.sqrt(np.trace(turn) - rot[:, 2] @ turn @ rot[:, 2])
    return out


def speed() -> None:
    """Print times of maps and of redraws."""
    many, some = field(10_000), field(2000)
    noise = Noise(
        tone_sigma_m=np.full((1, 10), SIGMA_M),
        calibration_sigma_m=np.zeros((1, 10)),
        carrier_sigma_m=np.full(10, CARRIER_M),
    )
    print(f"threads {numba.get_num_threads()}; ten transmitters; the loop does {N_LOOP} mirrors")
    print(f"{'':14}{'10 000 [ms]':>12}{'2000 [ms]':>12}{'numpy [us each]':>17}{'ratio':>8}{'difference':>12}")
    for name in ("pdop", *ESTIMATORS):

        def of(mirrors: PosedMirrors, name: str = name) -> np.ndarray:
            if name == "pdop":
                return maps.dilution(TRANSMITTER_ENU_M, mirrors.pivot_enu_m).position
            return maps.normal_map(TRANSMITTER_ENU_M, mirrors, noise, ESTIMATORS[name])

        values = of(many)
        apart = np.abs(loop(many, name, N_LOOP) / values[:N_LOOP] - 1.0).max()
        each = best(lambda name=name: loop(many, name, N_LOOP), 5) / N_LOOP
        full, small = best(lambda of=of: of(many)), best(lambda of=of: of(some))
        print(f"{name:14}{1e3 * full:12.2f}{1e3 * small:12.2f}{1e6 * each:17.0f}{each / full * 1e4:8.0f}{apart:12.1e}")


def placements() -> None:
    """Print what placement gains under Table 2's own limits, over the disc, each area alike."""
    table2 = TRANSMITTER_ENU_M / 100.0
    search, dense = field(400, 1.0), field(20_000, 1.0)
    rules = Constraints(allowed=(Zone(radius_m=1.0),), height_m=(0.2, 0.5))
    print(
        f"\n{'minimised':14}{'s':>6}"
        + "".join(f"{c:>14}" for c in CRITERIA)
        + "   (rms; normals in rad per unit of range)"
    )
    print(f"{'Table 2':20}" + "".join(f"{evaluate_placement(table2, dense, criterion=c):14.4f}" for c in CRITERIA))
    for criterion in CRITERIA:
        start = time.perf_counter()
        found = optimise(10, search, rules, criterion=criterion, starts=30, seed=1)
        took = time.perf_counter() - start
        values = [evaluate_placement(found.transmitter_enu_m, dense, criterion=c) for c in CRITERIA]
        print(f"{criterion:14}{took:6.1f}" + "".join(f"{v:14.4f}" for v in values))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--optimise", action="store_true", help="Also place transmitters (a few minutes).")
    arguments = parser.parse_args()
    speed()
    if arguments.optimise:
        placements()


if __name__ == "__main__":
    main()
