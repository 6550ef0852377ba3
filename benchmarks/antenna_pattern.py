"""How well an antenna pattern is learned, from how many postures; and which NEC mesh agrees with which.

    python benchmarks/antenna_pattern.py [PATTERN.h5] [--other OTHER.h5] [--save LEARNED.h5]

Truth is a pattern in a file (the shipped one of receivers before a plate, 433 MHz). Carriers: site of
data/table2_100m.toml, direct and ground ray (Fresnel, permittivity 15), of which the ground's is missing on a sixth of
the links; beside them three rays a mirror and transmitter from anywhere above, 3 % of the direct one each, that the
learning is not told of. Postures are believed 5 mrad and 5 mm wrong. Errors are relative to a dipole broadside, after
the best common factor; `of sigma` is their rms over the told one.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from scipy.spatial.transform import Rotation

from rfpose.antenna import AntennaPattern, MirrorType, PostureCarriers, dipole_pattern, learn_pattern
from rfpose.geometry import rot_enu_from_mirror
from rfpose.pipeline.formats.antenna_file import read_pattern, write_pattern
from rfpose.propagation import RayKind, Rays
from rfpose.scenario import load_scenario

DATA = Path(__file__).resolve().parents[1] / "data"
SITE = load_scenario(DATA / "table2_100m.toml")
TRANSMITTER = SITE.transmitter_enu_m
IMAGE = TRANSMITTER * np.array([1.0, 1.0, -1.0])
SPEED = 299_792_458.0
PERMITTIVITY = 15.0
N_MIRROR = 8
TURN_RAD = 0.005 / np.sqrt(3.0)
SHIFT_M = 0.005


def theta_unit(direction: np.ndarray) -> np.ndarray:
    """Return θ̂ of directions, which points downward (…, xyz)."""
    down = np.array([0.0, 0.0, -1.0]) + direction[..., 2:] * direction
    return down / np.linalg.norm(down, axis=-1, keepdims=True)


def fresnel(sine: np.ndarray) -> np.ndarray:
    """Return the ground's coefficient of vertical polarisation at the sine of a grazing angle."""
    root = np.sqrt(PERMITTIVITY - 1.0 + sine**2)
    return (PERMITTIVITY * sine - root) / (PERMITTIVITY * sine + root)


class Mirror:
    """One mirror in one posture: its rays, and what it hears."""

    def __init__(self, truth: AntennaPattern, frequency_hz: float, rng: np.random.Generator) -> None:
        self.place = truth.receiver_mirror_m
        self.pivot = rng.uniform(-90, 90, 3) * [1, 1, 0] + [0, 0, 2.0]
        azimuth, elevation = rng.uniform(0, 2 * np.pi), rng.uniform(np.radians(20), np.radians(75))
        self.rot = rot_enu_from_mirror(
            [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)]
        )
        self.wave_number = 2 * np.pi / (SPEED / frequency_hz)
        receiver = self.pivot + self.place @ self.rot.T
        towards = np.stack([TRANSMITTER, IMAGE])[None] - receiver[:, None, None]
        length = np.linalg.norm(towards, axis=-1)  # (receiver, ray, transmitter)
        direction = towards / length[..., None]
        self.field = theta_unit(direction) / length[..., None]
        self.field[:, 1] *= fresnel(np.abs(direction[:, 1, :, 2]))[..., None]
        self.field[:, 1] *= (rng.random((len(receiver), len(TRANSMITTER))) > 1 / 6)[..., None]
        self.heard = self.hear(truth, frequency_hz, direction, self.field, length).sum(axis=1)
        for _ in range(3):
            way = rng.standard_normal((1, 1, len(TRANSMITTER), 3)) * [1, 1, 0.3]
            way = np.broadcast_to(
                way / np.linalg.norm(way, axis=-1, keepdims=True), (len(receiver), 1, len(TRANSMITTER), 3)
            )
            strength = 0.03 / length[:, :1] * np.exp(2j * np.pi * rng.random((1, 1, len(TRANSMITTER))))
            detour = -np.einsum("rkix,rx->rki", way, receiver - self.pivot)
            self.heard += self.hear(truth, frequency_hz, way, theta_unit(way) * strength[..., None], detour)[:, 0]
        self.heard *= np.exp(2j * np.pi * rng.random(len(TRANSMITTER)))

    def hear(self, truth, frequency_hz, direction, field, length):
        """Return what rays bring (receiver, ray, transmitter)."""
        in_mirror = direction @ self.rot
        receiver = np.broadcast_to(np.arange(len(self.place))[:, None, None], in_mirror.shape[:-1])
        vector = truth.table(frequency_hz).vector(in_mirror.reshape(-1, 3), receiver.ravel()).reshape(in_mirror.shape)
        return np.sum(field @ self.rot * vector, axis=-1) * np.exp(-1j * self.wave_number * length)


def carriers(mirrors: list[Mirror], frequency_hz: float, rng: np.random.Generator) -> PostureCarriers:
    """Return what the learning gets: rays and postures as they are believed."""
    n = len(mirrors)
    field = np.array([mirror.field for mirror in mirrors]).transpose(0, 1, 3, 2, 4)  # the rays of a link last
    source = np.broadcast_to(np.stack([TRANSMITTER, IMAGE], axis=1), field.shape)
    place = np.broadcast_to(mirrors[0].place[None, :, None, None], field.shape)
    n_ray = field.size // 3
    off = Rotation.from_rotvec(TURN_RAD * rng.standard_normal((n, 3))).as_matrix()
    return PostureCarriers(
        amplitude=np.array([mirror.heard for mirror in mirrors]),
        rays=Rays(
            first=np.arange(0, n_ray + 1, 2),
            source_enu_m=source.reshape(-1, 3),
            place_mirror_m=place.reshape(-1, 3),
            extra_m=np.zeros(n_ray),
            field_enu=field.reshape(-1, 3).astype(complex),
            kind=np.tile([RayKind.DIRECT, RayKind.GROUND], n_ray // 2).astype(np.int8),
            thing=np.full(n_ray, -1, np.int32),
        ),
        pivot_enu_m=np.array([mirror.pivot for mirror in mirrors]) + SHIFT_M * rng.standard_normal((n, 3)),
        rot_enu_from_mirror=np.array([mirror.rot for mirror in mirrors]) @ off,
        wavelength_m=np.full(len(TRANSMITTER), SPEED / frequency_hz),
        rotation_sigma_rad=TURN_RAD,
        pivot_sigma_m=SHIFT_M,
    )


def apart(found: AntennaPattern, truth: AntennaPattern, frequency_hz: float) -> tuple[float, float]:
    """Return the rms error over the sphere, and over the told sigma."""
    direction = np.random.default_rng(1).standard_normal((3000, 3))
    receiver = np.arange(len(direction)) % truth.n_receiver
    true = truth.table(frequency_hz).vector(direction, receiver)
    vector, _, sigma = found.table(frequency_hz).vector_and_slope(direction, receiver)
    factor = np.vdot(vector, true) / np.vdot(vector, vector)
    square = np.sum(np.abs(factor * vector - true) ** 2, axis=1) / 4.0
    return float(np.sqrt(square.mean())), float(np.sqrt(np.mean(square / np.maximum(sigma, 1e-12) ** 2)))


@click.command()
@click.argument("pattern", type=click.Path(path_type=Path), default=DATA / "antenna_front_433MHz.h5")
@click.option("--other", type=click.Path(path_type=Path), help="Compare with this pattern, and learn nothing.")
@click.option("--save", type=click.Path(path_type=Path), help="Write what was learned from most postures.")
def main(pattern: Path, other: Path | None, save: Path | None) -> None:
    """Print how well a pattern is learned, or how far two are apart."""
    truth = read_pattern(pattern).pattern
    frequency_hz = float(truth.frequency_hz[len(truth.frequency_hz) // 2])
    if other is not None:
        error, of_sigma = apart(truth, read_pattern(other).pattern, frequency_hz)
        print(f"rms difference {error:.4f}, {of_sigma:.2f} of the first one's sigma")
        return
    lone = dipole_pattern(truth.receiver_mirror_m, truth.axis_mirror, frequency_hz)
    print(f"dipoles alone: rms error {apart(lone, truth, frequency_hz)[0]:.3f}")
    mirror = MirrorType(receiver_mirror_m=truth.receiver_mirror_m, axis_mirror=truth.axis_mirror, plate_m=(2.0, 2.0))
    for n_posture in (2, 5, 10, 30):
        rng = np.random.default_rng(n_posture)
        mirrors = [Mirror(truth, frequency_hz, rng) for _ in range(n_posture * N_MIRROR)]
        learned = learn_pattern(carriers(mirrors, frequency_hz, rng), mirror, frequency_hz=frequency_hz)
        error, of_sigma = apart(learned.pattern, truth, frequency_hz)
        print(
            f"{n_posture:2d} postures x {N_MIRROR}: rms error {error:.3f}, {of_sigma:.2f} of sigma; left of the direct "
            f"field {learned.floor:.3f}, held out {learned.floor_held_out:.3f}, dipoles {learned.floor_dipole:.3f}"
        )
    if save is not None:
        settings = {"learned from": f"{n_posture} postures x {N_MIRROR} mirrors, by benchmarks/antenna_pattern.py"}
        write_pattern(save, learned.pattern, settings=settings, force=True)


if __name__ == "__main__":
    main()
