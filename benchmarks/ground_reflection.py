"""Print how well poses come out where the ground reflects, how that degrades, and how long it takes.

    python benchmarks/ground_reflection.py [--mirrors 200] [--scenarios 10] [--speed | --strong]

Design fact 7: field of Table 2 x100, three receivers 1.73 m apart, phase noise 80 µrad, pivots surveyed to 5 mm, tones
of 0.75 and 7.5 MHz, no calibration receiver, starts 100 mrad off. Errors are of the mirror normal, rms, in mrad.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rfpose import geometry
from rfpose.multilat.ground import GroundSolution, Reflector, Surface, fresnel_coefficient, solve_with_ground
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, Observation, rigid_bound, tilt_sigma_rad
from rfpose.pipeline.bench_multilat import TRANSMITTER_ENU_M

SPEED_MPS = 299_792_458.0
SIGMA_RAD = 80e-6
TONE_HZ = (0.75e6, 7.5e6)
PLACES_M = 1.73 / np.sqrt(3.0) * np.array([[1, 0, 0], [-0.5, np.sqrt(0.75), 0], [-0.5, -np.sqrt(0.75), 0]])

WALL = Reflector(name="wall", point_enu_m=(0.0, 130.0, 0.0), normal_enu=(0.0, -1.0, 0.0))

Array = npt.NDArray[np.float64]
Coefficient = complex | Callable[[Array], npt.NDArray[np.complex128]]


@dataclass(frozen=True)
class Measured:
    """A field as measured, and its truth."""

    carrier_rf_hz: Array
    observations: list[Observation]
    knowledge: MirrorKnowledge
    start_rot: Array
    pivot_true: Array
    rot_true: Array

    def solve(self, reflectors: tuple[Reflector, ...] = (Reflector(),)) -> GroundSolution:
        """Solve from the starts."""
        return solve_with_ground(
            MirrorProblem.of_observations(
                TRANSMITTER_ENU_M,
                PLACES_M,
                self.observations,
                start_pivot_enu_m=np.asarray(self.knowledge.pivot_enu_m),
                start_rot_enu_from_mirror=self.start_rot,
                knowledge=self.knowledge,
            ),
            carrier_rf_hz=self.carrier_rf_hz,
            reflectors=reflectors,
        )

    def error_mrad(self, solution: GroundSolution) -> Array:
        """Angle between solved and true normals."""
        return 1e3 * geometry.angle_between_rad(solution.poses.normal_enu, self.rot_true[:, :, 2])

    def bound_mrad(self) -> float:
        """Bound without any reflection."""
        cov = rigid_bound(
            MirrorProblem.expected(
                TRANSMITTER_ENU_M,
                PLACES_M,
                self.pivot_true,
                self.rot_true,
                sigma_m=np.stack([o.sigma_m for o in self.observations], axis=1),
                transmitter_sigma_m=np.inf,
                clock_class=[o.clock_class for o in self.observations],
                knowledge=self.knowledge,
            )
        )
        return 1e3 * rms(tilt_sigma_rad(cov, self.rot_true[:, :, 2]))


def rms(x: Array) -> float:
    """Root mean square of what is not NaN."""
    return float(np.sqrt(np.nanmean(np.square(x))))


def line(receiver: Array, k: Array, reflections: list[tuple[Reflector, Coefficient]]) -> npt.NDArray[np.complex128]:
    """Amplitude of lines of wavenumber k at receivers."""
    direct = np.linalg.norm(receiver[..., None, :] - TRANSMITTER_ENU_M, axis=-1)
    total = np.exp(-1j * k * direct)
    for plane, coefficient in reflections:
        normal = np.array(plane.normal_enu) / np.linalg.norm(plane.normal_enu)
        height = (TRANSMITTER_ENU_M - np.array(plane.point_enu_m)) @ normal
        ray = receiver[..., None, :] - (TRANSMITTER_ENU_M - 2.0 * height[:, None] * normal)
        length = np.linalg.norm(ray, axis=-1)
        gain = coefficient(ray @ normal / length) if callable(coefficient) else coefficient
        total = total + gain * direct / length * np.exp(-1j * k * length)
    return total


def measure(
    rng: np.random.Generator,
    n_mirror: int,
    rf_hz: float,
    reflections: list[tuple[Reflector, Coefficient]],
    *,
    carrier: bool,
) -> Measured:
    """Draw mirrors over the field and their noisy phases."""
    k = 2 * np.pi * (rf_hz + np.linspace(-18e6, 18e6, len(TRANSMITTER_ENU_M))) / SPEED_MPS
    radius, around = 100.0 * np.sqrt(rng.uniform(0.01, 1.0, n_mirror)), rng.uniform(0, 2 * np.pi, n_mirror)
    pivot = np.stack([radius * np.cos(around), radius * np.sin(around), rng.uniform(2.0, 4.0, n_mirror)], axis=1)
    sun = geometry.enu_from_azimuth_elevation(rng.uniform(1.6, 4.7, n_mirror), rng.uniform(0.4, 1.2, n_mirror))
    rot = geometry.rot_enu_from_mirror(geometry.bisector_enu(np.array([0.0, 0.0, 50.0]) - pivot, sun))
    receiver = pivot[:, None] + np.einsum("mab,rb->mra", rot, PLACES_M)
    shape = (n_mirror, 3, len(TRANSMITTER_ENU_M))
    free = np.full((n_mirror, len(TRANSMITTER_ENU_M)), np.inf)
    c = line(receiver, k, reflections)
    observations = []
    for tone_hz in TONE_HZ:
        kappa = 2 * np.pi * tone_hz / SPEED_MPS
        upper, lower = line(receiver, k + kappa, reflections), line(receiver, k - kappa, reflections)
        phase = np.angle(upper * np.conj(c) + np.conj(lower * np.conj(c))) + SIGMA_RAD * rng.standard_normal(shape)
        phase += rng.uniform(-np.pi, np.pi, len(TRANSMITTER_ENU_M))
        observations.append(
            Observation(
                range_m=-phase / kappa,
                sigma_m=np.full(shape, SIGMA_RAD / kappa),
                transmitter_sigma_m=free,
                wavelength_m=np.full(len(TRANSMITTER_ENU_M), SPEED_MPS / tone_hz),
                clock_class=0,
            )
        )
    if carrier:
        phase = np.angle(c * np.exp(1j * rng.uniform(-np.pi, np.pi, len(TRANSMITTER_ENU_M))))
        observations.append(
            Observation(
                range_m=-(phase + SIGMA_RAD * rng.standard_normal(shape)) / k,
                sigma_m=np.broadcast_to(SIGMA_RAD / k, shape),
                transmitter_sigma_m=free,
                wavelength_m=2 * np.pi / k,
                clock_class=1,
                carrier=True,
            )
        )
    off = 0.1 * geometry.unit(rng.standard_normal((n_mirror, 3)))
    return Measured(
        carrier_rf_hz=k * SPEED_MPS / (2 * np.pi),
        observations=observations,
        knowledge=MirrorKnowledge(
            clock_sigma_m=0.0,
            pivot_enu_m=pivot + 5e-3 * rng.standard_normal((n_mirror, 3)),
            pivot_sigma_m=5e-3,
        ),
        start_rot=Rotation.from_rotvec(off).as_matrix() @ rot,
        pivot_true=pivot,
        rot_true=rot,
    )


def draw_coefficient(rng: np.random.Generator) -> complex:
    """Draw one of random size up to a half and random phase."""
    return complex(rng.uniform(0.02, 0.5) * np.exp(2j * np.pi * rng.uniform()))


def reach(
    n_mirror: int,
    n_scenario: int,
    *,
    rf: tuple[float, ...] = (30e6, 100e6, 433e6),
    size: float | None = None,
) -> None:
    """Print errors with the coefficient estimated, and without; of one ``size`` and random phase where it is given."""
    sizes = "up to 0.5" if size is None else f"of size {size:g}"
    print(f"random coefficients {sizes}, {n_scenario} scenarios of {n_mirror} mirrors; rms of all, mrad of the normal")
    print("RF MHz  carrier   bound, no reflection   estimated  ratio  worst scenario   ignored  hurt  reported  not OK")
    for rf_hz in rf:
        for carrier in (False, True):
            error, bound, worst, ignored, hurt, reported, lost = [], [], 0.0, [], 0, 0, 0
            for seed in range(n_scenario):
                rng = np.random.default_rng(seed)
                drawn = draw_coefficient(rng)
                coefficient = drawn if size is None else drawn / abs(drawn) * size
                field = measure(rng, n_mirror, rf_hz, [(Reflector(), coefficient)], carrier=carrier)
                solution, without = field.solve(), field.solve(())
                error.append(rms(field.error_mrad(solution)))
                bound.append(field.bound_mrad())
                worst = max(worst, error[-1] / bound[-1])
                lost += int((solution.status != 0).sum())
                direct = field.error_mrad(without)
                ignored.append(rms(direct))
                bad = ~(direct <= 3e3 * without.poses.tilt_sigma_rad)
                hurt += int(bad.sum())
                reported += int((solution.probability_direct[bad] < 1e-3).sum())
            print(
                f"{rf_hz / 1e6:6.0f}  {carrier!s:7} {rms(np.array(bound)):14.4f} {rms(np.array(error)):18.4f} "
                f"{rms(np.array(error)) / rms(np.array(bound)):6.2f} {worst:12.2f} {rms(np.array(ignored)):12.1f} "
                f"{hurt:6d} {100 * reported / max(hurt, 1):7.2f} % {lost:5d}"
            )


def degradation(n_mirror: int) -> None:
    """Print errors where the model is not the truth."""
    level = Reflector()
    ground = -0.3 + 0.1j
    soil = Surface(permittivity=6.0, conductivity_s_per_m=0.005)
    print(f"\nmodel: level ground, one coefficient; truth otherwise, {n_mirror} mirrors, mrad of the normal")
    print(
        "RF MHz  carrier  truth                                      rms   median     stated   RESIDUAL  wrong, silent"
    )
    for rf_hz in (30e6, 100e6, 433e6):
        carrier_hz = rf_hz + np.linspace(-18e6, 18e6, len(TRANSMITTER_ENU_M))

        def fresnel(sine: Array, carrier_hz: Array = carrier_hz) -> npt.NDArray[np.complex128]:
            return fresnel_coefficient(soil, np.arcsin(sine), carrier_hz)

        truths: list[tuple[str, list[tuple[Reflector, Coefficient]]]] = [
            ("as modelled", [(level, ground)]),
            ("plane 1 cm lower", [(Reflector(point_enu_m=(0, 0, -0.01)), ground)]),
            ("plane 0.2 m lower", [(Reflector(point_enu_m=(0, 0, -0.2)), ground)]),
            ("plane tilted by 1 degree", [(Reflector(normal_enu=(np.tan(np.radians(1.0)), 0, 1)), ground)]),
            ("coefficient of soil (varies with angle)", [(level, fresnel)]),
            ("a wall of coefficient 0.03 as well", [(level, ground), (WALL, 0.03)]),
            ("a wall of coefficient 0.3 as well", [(level, ground), (WALL, 0.3)]),
        ]
        for carrier in (False, True):
            for name, reflections in truths:
                report(rf_hz, carrier, name, reflections, n_mirror, (level,))
            both = (level, WALL)
            report(rf_hz, carrier, "the wall 0.3, both planes modelled", truths[-1][1], n_mirror, both)
            report(rf_hz, carrier, "soil, its constants modelled", truths[4][1], n_mirror, (Reflector(surface=soil),))


def report(
    rf_hz: float,
    carrier: bool,
    name: str,
    reflections: list[tuple[Reflector, Coefficient]],
    n_mirror: int,
    modelled: tuple[Reflector, ...],
) -> None:
    """Print one row."""
    field = measure(np.random.default_rng(1), n_mirror, rf_hz, reflections, carrier=carrier)
    solution = field.solve(modelled)
    error = field.error_mrad(solution)
    stated = 1e3 * solution.poses.tilt_sigma_rad
    solved = np.isfinite(error)
    silent = np.mean((solution.status == 0) & (error > 4.0 * stated))
    if not solved.any():
        print(f"{rf_hz / 1e6:6.0f}  {carrier!s:7}  {name:40} none solved")
        return
    print(
        f"{rf_hz / 1e6:6.0f}  {carrier!s:7}  {name:40} {rms(error):7.3f} {np.nanmedian(error):8.3f} {rms(stated):9.4f} "
        f"{100 * np.mean(solution.status != 0):9.1f} % {100 * silent:8.1f} %"
    )


def speed(n_mirror: int) -> None:
    """Print times."""
    n_transmitter, n_thread = len(TRANSMITTER_ENU_M), numba.get_num_threads()
    print(f"\n{n_mirror} mirrors, 3 receivers, {n_transmitter} transmitters, 2 tones, {n_thread} threads")
    for rf_hz in (30e6, 100e6, 433e6):
        field = measure(np.random.default_rng(2), n_mirror, rf_hz, [(Reflector(), -0.3 + 0.1j)], carrier=False)
        wall, cpu = [], []
        for _ in range(4):
            start, start_cpu = time.perf_counter(), time.process_time()
            solution = field.solve()
            wall.append(time.perf_counter() - start)
            cpu.append(time.process_time() - start_cpu)
        best = int(np.argmin(wall))
        solved = solution.status == 0
        print(
            f"RF {rf_hz / 1e6:.0f} MHz: {wall[best]:.2f} s, {cpu[best]:.2f} s of processor; "
            f"{int(solved.sum())} solved, rms {rms(field.error_mrad(solution)[solved]):.3f} mrad"
        )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--mirrors", type=int, default=200)
    parser.add_argument("--scenarios", type=int, default=10)
    parser.add_argument("--speed", action="store_true", help="times only")
    parser.add_argument("--strong", action="store_true", help="coefficients of size 0.5 at 433 MHz only")
    arguments = parser.parse_args()
    if arguments.strong:
        reach(arguments.mirrors, arguments.scenarios, rf=(433e6,), size=0.5)
        return
    if not arguments.speed:
        reach(arguments.mirrors, arguments.scenarios)
        degradation(arguments.mirrors)
    speed(10_000)


if __name__ == "__main__":
    main()
