"""Whole wavelengths of simulated mirrors: how often wrong, and how often that was said beforehand.

    python benchmarks/wrong_fix.py            # a million mirrors, some minutes
    python benchmarks/wrong_fix.py -n 20000   # a look

Mirrors stand anywhere in the 100 m field and face anywhere; each is solved from a start 100 mrad off. Every fix whose
residuals are likely is accepted whatever its risk, so that there is something to count, and compared with the truth.
``stated`` is the number of wrong mirrors that the risks stated beforehand add up to. Error and bound are those of the
normal, over the mirrors fixed right.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from rfpose.geometry import angle_between_rad, rot_enu_from_mirror
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, Observation, rigid_bound, tilt_sigma_rad
from rfpose.multilat.rigid.integers import IntegerMethod, RigidSolution, solve_ladder

Array = NDArray[np.float64]

SPEED_MPS = 299_792_458.0
TRANSMITTER_ENU_M = 100.0 * np.array(
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
PLACES_M = 1.73 / np.sqrt(3) * np.array([[np.cos(a), np.sin(a), 0.0] for a in np.radians([0, 120, 240])])
CHUNK = 10_000
ANY_RISK = 1.0 - 1e-12
MARKED = 1e-9
"""Residuals rarer than this mark a pose as not to be trusted, as in the pipeline; such are no fixes."""


@dataclass(frozen=True)
class Case:
    """What is sent, and how noisily it is received."""

    tones_hz: tuple[float, ...]
    carrier_hz: float | None
    phase_sigma_rad: tuple[float, ...]
    """Of each tone, then of the carrier."""

    @property
    def label(self) -> str:
        """The case in words."""
        tones = "{" + ", ".join(f"{f / 1e6:g}" for f in self.tones_hz) + "} MHz"
        return tones if self.carrier_hz is None else f"{tones}, carrier {self.carrier_hz / 1e6:g} MHz"


COARSE, FINE, PAPER = 0.75e6, 6.1e6, 1.58e-5
# the noise of Swart et al. §4.5 first, then noise at which integers go wrong
CASES = [
    Case((COARSE, FINE), None, (PAPER, PAPER)),
    Case((COARSE, FINE), 100e6, (PAPER, PAPER, PAPER)),
    Case((COARSE, FINE), 433e6, (PAPER, PAPER, PAPER)),
    *(Case((COARSE, FINE), None, (0.02, s)) for s in (0.5, 0.6)),
    *(Case((COARSE, FINE), 100e6, (1e-3, 1e-3, s)) for s in (0.5, 0.6)),
    *(Case((COARSE, FINE), 433e6, (1e-3, 1e-3, s)) for s in (0.5, 0.6)),
    *(Case((COARSE,), 433e6, (1e-3, s)) for s in (1e-3, 0.3)),
]


@dataclass
class Count:
    """What a case adds up to."""

    mirrors: int = 0
    fixed: int = 0
    wrong: int = 0
    stated: float = 0.0
    searched: int = 0
    error2: float = 0.0
    seconds: float = 0.0


def draw_mirrors(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Pivots anywhere in the field, normals anywhere upwards."""
    radius, angle = 95 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    pivot = np.stack([radius * np.cos(angle), radius * np.sin(angle), 2 + rng.random(n)], axis=1)
    rot = rot_enu_from_mirror(np.stack([rng.standard_normal(n), rng.standard_normal(n), 1 + rng.random(n)], axis=1))
    return pivot, rot


def observe(rng: np.random.Generator, case: Case, distance: Array) -> tuple[list[Observation], list[Array]]:
    """Measured ranges, wrapped from the second wavelength on, and the same before wrapping."""
    n = len(distance)
    clock = rng.uniform(-100, 100, (n, 1, 1))
    observations, whole = [], []
    noise = case.phase_sigma_rad
    sources: list[tuple[Array, float, float]] = [
        (np.full(10, SPEED_MPS / f), own, 0.6 * own) for f, own in zip(case.tones_hz, noise, strict=False)
    ]
    if case.carrier_hz is not None:
        sources.append((SPEED_MPS / (case.carrier_hz + np.arange(-18e6, 19e6, 4e6)), noise[-1], np.inf))
    for k, (wavelength, own_rad, common_rad) in enumerate(sources):
        to_m = wavelength / (2 * np.pi)
        free = np.isinf(common_rad)
        bias = rng.uniform(-50, 50, (n, 1, 10)) if free else to_m * common_rad * rng.standard_normal((n, 1, 10))
        z = distance + clock + bias + to_m * own_rad * rng.standard_normal(distance.shape)
        whole.append(z)
        observations.append(
            Observation(
                range_m=np.mod(z, wavelength) if k else z,
                sigma_m=np.broadcast_to(to_m * own_rad, distance.shape),
                transmitter_sigma_m=np.full((n, 10), np.inf) if free else np.tile(to_m * common_rad, (n, 1)),
                wavelength_m=wavelength,
                clock_class=k,
            )
        )
    return observations, whole


def is_wrong(solution: RigidSolution, observations: list[Observation], whole: list[Array]) -> NDArray[np.bool_]:
    """Mirrors with a wrong integer, the common ones apart that clocks and transmitters take up."""
    wrong = np.zeros(len(whole[0]), np.bool_)
    for k in range(1, len(observations)):
        turns = np.rint((solution.range_m[:, k] - whole[k]) / observations[k].wavelength_m)
        if np.isinf(observations[k].transmitter_sigma_m).any():
            off = turns - turns[:, :1]
        else:
            off = turns - turns[:, :1, :1]
        wrong |= solution.fixed[:, k] & np.any(off != 0, axis=(1, 2))
    return wrong


def run(case: Case, n: int, seed: int) -> Count:
    """Simulate and solve ``n`` mirrors."""
    count = Count()
    places = np.tile(PLACES_M, (CHUNK, 1, 1))
    known = MirrorKnowledge(clock_sigma_m=0.0)
    turn = rot_enu_from_mirror([0, 0, 1]).T @ rot_enu_from_mirror([0.07, 0.07, 1.0])
    for chunk in range(-(-n // CHUNK)):
        rng = np.random.default_rng([seed, chunk])
        pivot, rot = draw_mirrors(rng, CHUNK)
        receiver = pivot[:, None] + np.einsum("mab,mrb->mra", rot, places)
        observations, whole = observe(rng, case, np.linalg.norm(receiver[:, :, None] - TRANSMITTER_ENU_M, axis=-1))
        begun = time.perf_counter()
        found = solve_ladder(
            MirrorProblem.of_observations(
                TRANSMITTER_ENU_M,
                places,
                observations,
                start_pivot_enu_m=pivot + 0.3 * rng.standard_normal((CHUNK, 3)),
                start_rot_enu_from_mirror=rot @ turn,
                knowledge=known,
            ),
            wrong_risk=ANY_RISK,
        )
        count.seconds += time.perf_counter() - begun
        cov = rigid_bound(
            MirrorProblem.expected(
                TRANSMITTER_ENU_M,
                places,
                pivot,
                rot,
                sigma_m=np.stack([o.sigma_m for o in observations], axis=1),
                transmitter_sigma_m=np.stack([o.transmitter_sigma_m for o in observations], axis=1),
                clock_class=np.arange(len(observations)),
                knowledge=known,
            )
        )
        wrong = is_wrong(found, observations, whole)
        with np.errstate(invalid="ignore"):
            trusted = chi2.sf(found.poses.chi2, found.poses.dof) > MARKED
        fixed = found.fixed.all(axis=1) & trusted
        right = fixed & ~wrong
        error = angle_between_rad(found.poses.normal_enu, rot[:, :, 2]) / tilt_sigma_rad(cov, rot[:, :, 2])
        count.mirrors += CHUNK
        count.fixed += int(fixed.sum())
        count.wrong += int((wrong & fixed).sum())
        count.stated += float(-np.expm1(np.log1p(-np.minimum(found.wrong_risk, ANY_RISK)).sum(axis=1))[fixed].sum())
        searched = np.isin(found.method, (IntegerMethod.LEAST_SQUARES, IntegerMethod.CONSTRAINED))
        count.searched += int((searched.any(axis=1) & fixed).sum())
        count.error2 += float(np.sum(error[right] ** 2))
    return count


def main() -> None:
    """Print one row a case."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-n", type=int, default=1_000_000, help="mirrors a case")
    parser.add_argument("--case", type=int, action="append", help="row numbers, from 0; default all")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(
        "| tones, carrier | phase noise [mrad] | mirrors | fixed | by search | stated wrong | wrong | error/bound | s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for i in options.case or range(len(CASES)):
        case = CASES[i]
        c = run(case, options.n, options.seed)
        ratio = np.sqrt(c.error2 / max(c.fixed - c.wrong, 1))
        noise = ", ".join(f"{1e3 * x:g}" for x in case.phase_sigma_rad)
        row = (case.label, noise, c.mirrors, c.fixed, c.searched, f"{c.stated:.3g}", c.wrong, f"{ratio:.3f}")
        print("| " + " | ".join(map(str, row)) + f" | {c.seconds:.0f} |", flush=True)


if __name__ == "__main__":
    main()
