"""One transmitter in ten off: found, left out, and what the normal pays. Table 2's field of 100 m radius.

Three receivers on a circle of 1 m, own noise 1 mm a range, calibration 1 mm a transmitter. Errors are in units of the
1 mm. Usage:

    python benchmarks/integrity.py [--mirrors 2000] [--seed 1] [--false-alarm 0.01]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from rfpose.geometry import rot_enu_from_mirror
from rfpose.multilat.integrity import Alarms, GuardedPoses, IntegrityStatus, TransmitterStatus, solve_with_integrity
from rfpose.multilat.integrity.guard import limit, noncentrality
from rfpose.multilat.integrity.hypotheses import judge
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, solve_rigid

TRANSMITTER = 100.0 * np.array(
    [
        [1, 0, 0.2],
        [0.5, 0.866, 0.3],
        [-0.5, 0.866, 0.2],
        [-1, 0, 0.3],
        [-0.5, -0.866, 0.2],
        [0.5, -0.866, 0.3],
        [0.433, 0.25, 0.4],
        [-0.433, 0.25, 0.4],
        [0, -0.5, 0.4],
        [0, 0, 0.5],
    ]
)
PLACES = np.array([[1.0, 0, 0], [-0.5, 0.866, 0], [-0.5, -0.866, 0]])
SIGMA = 1e-3
SIZES = (5, 7, 10, 15, 20, 50, 100, 1000)


@dataclass(frozen=True)
class Field:
    """Random mirrors, true and measured."""

    pivot: np.ndarray
    rot: np.ndarray
    z: np.ndarray
    settings: dict

    def solve(self, z: np.ndarray, **more: float) -> GuardedPoses:
        """Solve with tests."""
        return solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **self.settings), Alarms(**more))

    def plain(self, z: np.ndarray) -> np.ndarray:
        """Errors of the normal without any test [rad]."""
        return self.error(solve_rigid(MirrorProblem.of(TRANSMITTER, PLACES, z, **self.settings)).normal_enu)

    def error(self, normal: np.ndarray) -> np.ndarray:
        """Angle between found and true normal [rad]."""
        return np.linalg.norm(np.cross(normal, self.rot[:, :, 2]), axis=-1)


def field(n: int, rng: np.random.Generator, *, shared: bool, calibrated: bool = True, noise: float = 1.0) -> Field:
    """Mirrors anywhere in the field, facing anywhere above the horizon."""
    radius, azimuth = 95.0 * np.sqrt(rng.random(n)), rng.uniform(0.0, 2 * np.pi, n)
    pivot = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(n, 3.0)], axis=-1)
    normal = rng.standard_normal((n, 3))
    normal[:, 2] = np.abs(normal[:, 2]) + 0.3
    rot = rot_enu_from_mirror(normal)
    receiver = pivot[:, None] + np.einsum("mab,rb->mra", rot, PLACES)
    z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)
    z = z + noise * SIGMA * rng.standard_normal(z.shape)
    z += noise * (SIGMA if calibrated else 10.0) * rng.standard_normal((n, 1, 10))
    z += 10.0 * rng.standard_normal((n, 1 if shared else 3, 1))
    known = MirrorKnowledge(clock_sigma_m=0.0 if shared else np.inf)
    if not calibrated:
        survey = pivot + 5e-3 * rng.standard_normal(pivot.shape)
        known = MirrorKnowledge(clock_sigma_m=known.clock_sigma_m, pivot_enu_m=survey, pivot_sigma_m=5e-3)
    settings = {
        "sigma_m": SIGMA,
        "transmitter_sigma_m": SIGMA if calibrated else np.inf,
        "clock_class": [0],
        "start_pivot_enu_m": pivot + 0.3,
        "start_rot_enu_from_mirror": rot,
        "knowledge": known,
    }
    return Field(pivot, rot, z[:, None], settings)


def disturb(
    z: np.ndarray, size_sigma: float | np.ndarray, kind: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Disturb one random transmitter of each mirror; return ranges and which it is."""
    n = len(z)
    who = rng.integers(0, 10, n)
    error = np.broadcast_to(size_sigma, n) * SIGMA * rng.choice([-1.0, 1.0], n)
    shape = np.zeros((n, 3))
    if kind == "common":
        shape[:] = 1.0
    elif kind == "one receiver":
        shape[np.arange(n), rng.integers(0, 3, n)] = 1.0
    else:
        shape[:] = rng.standard_normal((n, 3))
        shape *= np.sqrt(3.0) / np.linalg.norm(shape, axis=1, keepdims=True)
    out = z.copy()
    out[np.arange(n), 0, :, who] += error[:, None] * shape
    return out, who


def rms(x: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(x**2)))


def table_of_sizes(n: int, seed: int, *, shared: bool, kind: str, false_alarm: float) -> Table:
    """Return detection and error against the size of the error."""
    clocks = "one clock a mirror" if shared else "one clock a receiver"
    table = Table(
        "size [sigma]", "found", "left out", "others too", "rms / undisturbed", "rms / without it",
        "untested", "beyond PL",
        title=f"{kind}, {clocks}",
    )  # fmt: skip
    for size in SIZES:
        rng = np.random.default_rng(seed)
        mirrors = field(n, rng, shared=shared)
        clean = rms(mirrors.plain(mirrors.z))
        z, who = disturb(mirrors.z, size, kind, rng)
        without = z.copy()
        without[np.arange(n), :, :, who] = np.nan
        found = mirrors.solve(z, false_alarm=false_alarm)
        error = mirrors.error(found.poses.normal_enu)
        out = found.transmitter_status > TransmitterStatus.NOT_RECEIVED
        hit = out[np.arange(n), who]
        table.add_row(
            str(size), f"{np.mean(found.status != IntegrityStatus.OK):.4f}", f"{hit.mean():.4f}",
            f"{np.mean(out.sum(axis=1) > hit):.4f}", f"{rms(error) / clean:.3f}",
            f"{rms(error) / rms(mirrors.plain(without)):.3f}", f"{rms(mirrors.plain(z)) / clean:.2f}",
            f"{np.sum(error > found.protection_level_rad)} / {n}",
        )  # fmt: skip
    return table


def table_of_alarms(n: int, seed: int) -> Table:
    """Return false alarms against their stated probability."""
    table = Table("clocks", "form", "stated", "found", title="Nothing wrong: mirrors not found OK")
    for shared in (True, False):
        for calibrated in (True, False):
            mirrors = field(n, np.random.default_rng(seed), shared=shared, calibrated=calibrated)
            for stated in (1e-1, 1e-2, 1e-3):
                found = mirrors.solve(mirrors.z, false_alarm=stated)
                table.add_row(
                    "one" if shared else "three", "calibrated" if calibrated else "between receivers", f"{stated:g}",
                    f"{np.mean(found.status != IntegrityStatus.OK):.4f}",
                )  # fmt: skip
    return table


def table_of_chosen(n: int, seed: int) -> Table:
    """Return errors in sigmas of what was left, and of what is stated, where transmitters were left out."""
    table = Table(
        "form", "disturbed of ten", "size [sigma]", "solved so", "of what was left: rms", "most",
        "of what is stated: rms", "most", title="Many transmitters disturbed, one clock a mirror, false alarm 0.001",
    )  # fmt: skip
    for calibrated in (True, False):
        for n_bad, size in ((1, 20.0), (5, 2.0), (5, 5.0), (5, 20.0), (7, 2.0), (7, 5.0), (10, 2.0), (10, 5.0)):
            rng = np.random.default_rng(seed)
            mirrors = field(n, rng, shared=True, calibrated=calibrated)
            bad = np.argsort(rng.random((n, 10)), axis=1) < n_bad
            z = mirrors.z + size * SIGMA * bad[:, None, None, :] * rng.standard_normal(mirrors.z.shape)
            found = mirrors.solve(z, false_alarm=1e-3)
            out = (found.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1) & found.ok
            out &= ~found.prior_rejected.any(axis=1)
            left = solve_rigid(
                MirrorProblem.of(TRANSMITTER, PLACES, np.where(found.used[:, None], z, np.nan), **mirrors.settings)
            )
            error = mirrors.error(found.poses.normal_enu)[out]
            ratios = [error / poses.tilt_sigma_rad[out] for poses in (left, found.poses)]
            table.add_row(
                "calibrated" if calibrated else "between receivers", str(n_bad), f"{size:g}", f"{out.mean():.3f}",
                *(text for ratio in ratios for text in (f"{rms(ratio):.2f}", f"{ratio.max(initial=0.0):.1f}")),
            )  # fmt: skip
    return table


def worst_direction(n: int, seed: int, *, shared: bool) -> tuple[Field, np.ndarray, np.ndarray]:
    """Mirrors without noise, each with the error of one transmitter that tilts the normal most for its trace.

    Returns the mirrors, the errors (mirror, group, receiver, transmitter) with a statistic of one, and the number of
    degrees of freedom. The search is by trial: 40 directions for the transmitter that sets the protection level.
    """
    mirrors = field(n, np.random.default_rng(seed), shared=shared, noise=0.0)
    who = mirrors.solve(mirrors.z).worst_transmitter
    rng = np.random.default_rng(seed + 1)
    at = np.arange(n)
    best, best_slope = np.zeros_like(mirrors.z), np.zeros(n)
    for _ in range(40):
        error = np.zeros_like(mirrors.z)
        error[at, 0, :, who] = SIGMA * rng.standard_normal((n, 3))
        problem = MirrorProblem.of(TRANSMITTER, PLACES, mirrors.z + error, **mirrors.settings)
        poses = solve_rigid(problem)
        verdict = judge(problem, poses)
        stat = verdict.stat[at, who]
        slope = mirrors.error(poses.normal_enu) / np.sqrt(stat)
        better = slope > best_slope
        best[better] = (error / np.sqrt(stat)[:, None, None, None])[better]
        best_slope[better] = slope[better]
    return mirrors, best, verdict.dof[at, who]


def table_of_protection(n: int, seed: int) -> Table:
    """Return how often normals are farther off than the protection level, errors put where they hurt most unseen."""
    table = Table(
        "clocks", "missed, stated", "size / size missed so", "no alarm", "no alarm and beyond", "beyond",
        title=f"Protection level: {n} mirrors x 40 draws, each with its worst error",
    )  # fmt: skip
    for shared in (True, False):
        mirrors, error, dof = worst_direction(n, seed, shared=shared)
        rng = np.random.default_rng(seed + 2)
        for missed in (1e-1, 1e-2, 1e-3):
            size = np.sqrt(noncentrality(limit(5e-3 / 43, dof), dof, missed))
            for scale in (0.7, 1.0, 1.3, 2.0):
                silent = silent_beyond = beyond = 0
                for _ in range(40):
                    z = mirrors.z + scale * size[:, None, None, None] * error
                    z = z + SIGMA * (rng.standard_normal(z.shape) + rng.standard_normal((n, 1, 1, 10)))
                    found = mirrors.solve(z, missed_detection=missed)
                    off = mirrors.error(found.poses.normal_enu) > found.protection_level_rad
                    none = found.status == IntegrityStatus.OK
                    silent, silent_beyond = silent + none.sum(), silent_beyond + (none & off).sum()
                    beyond += off.sum()
                table.add_row(
                    "one" if shared else "three", f"{missed:g}", f"{scale:g}", f"{silent / n / 40:.5f}",
                    f"{silent_beyond / n / 40:.5f}", f"{beyond / n / 40:.5f}",
                )  # fmt: skip
    return table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mirrors", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--false-alarm", type=float, default=1e-2)
    args = parser.parse_args()
    console = Console(width=120)
    for shared in (True, False):
        for kind in ("common", "one receiver", "each receiver its own"):
            console.print(
                table_of_sizes(args.mirrors, args.seed, shared=shared, kind=kind, false_alarm=args.false_alarm)
            )
    console.print(table_of_alarms(10 * args.mirrors, args.seed))
    console.print(table_of_chosen(args.mirrors, args.seed))
    console.print(table_of_protection(max(args.mirrors // 4, 1), args.seed))
    mirrors = field(10_000, np.random.default_rng(args.seed), shared=True)
    z, _ = disturb(mirrors.z, 20.0, "common", np.random.default_rng(args.seed))
    for name, ranges in (("nothing wrong", mirrors.z), ("every mirror disturbed", z)):
        begin = time.perf_counter()
        mirrors.solve(ranges)
        console.print(f"10 000 mirrors, {name}: {time.perf_counter() - begin:.2f} s")


if __name__ == "__main__":
    main()
