"""Ray tables of fields that this project did not write, as the lines that receivers would measure.

The tables are those of docs/ray-tables.md, the site is that of ``../shared/data/traced``: Table 2's transmitters at
100 m, eight instrumented mirrors of 2 m x 2 m, 32 neighbours, a concrete tower, dry ground. Complex amplitudes of all
lines are summed from the rays directly, without samples; `benchmarks/real_field.py` shows once that samples give the
same.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.antenna import AntennaPattern
from rfpose.dsp import LineStatus, TonePhases
from rfpose.scenario import Scenario, parse_scenario

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Antenna = Callable[["Table", Array], Complex]
"""From a table and the mirrors' rotations (heliostat, 3, 3) to each ray's complex amplitude at its receiver."""

SPEED_MPS = 299_792_458.0
SITE = Path(__file__).with_name("real_field.toml")
SNR_DB = 50.0
"""Of the first tone 60 m from a transmitter, per sample, where the antenna is isotropic."""
REFERENCE_M = 60.0
SUNS_DEG = {0: (120.0, 35.0), 1: (180.0, 60.0), 2: (240.0, 25.0)}
"""Azimuth and elevation of the suns that tables are numbered by."""
PLACES_M = {
    "front": [[0.9988, 0.0, 0.10], [-0.4994, 0.865, 0.10], [-0.4994, -0.865, 0.10]],
    "beside": [[1.12, 0.8, 0.05], [-1.12, 0.8, 0.05], [-1.12, -0.8, 0.05], [1.12, -0.8, 0.05]],
}
"""Receivers in the mirror frame: 10 cm before the plate, and on stubs 12 cm beside its edges."""
FIVE = (0, 2, 4, 6, 9)
"""The transmitters of the design with five: outer ring, inner ring, tower."""
TABLE_2_ENU_M = np.array(
    [
        [100, 0, 20], [50, 86.6, 30], [-50, 86.6, 20], [-100, 0, 30], [-50, -86.6, 20],
        [50, -86.6, 30], [43.3, 25, 40], [-43.3, 25, 40], [0, -50, 40], [0, 0, 50],
    ],
    np.float64,
)  # fmt: skip
TRANSMITTERS_ENU_M = {
    "5": TABLE_2_ENU_M[list(FIVE)],
    "10": TABLE_2_ENU_M,
    "20": np.concatenate(
        [
            TABLE_2_ENU_M,
            [
                [86.6, 50, 30], [0, 100, 20], [-86.6, 50, 30], [-86.6, -50, 20], [0, -100, 30],
                [86.6, -50, 20], [0, 50, 40], [-43.3, -25, 40], [43.3, -25, 40], [20, 0, 30],
            ],
        ]
    ),
    "high": TABLE_2_ENU_M + np.array([0.0, 0.0, 30.0]),
}  # fmt: skip
"""Transmitters of the designs compared."""
_START_UNIX_S = 1_790_000_000


# -- the site ------------------------------------------------------------------------------------------------


def site_of(rf_hz: float, place: str, *, transmitter_enu_m: Array | None = None) -> Scenario:
    """Return the site at a radio frequency with receivers at a place of `PLACES_M`."""
    site = parse_scenario(SITE.read_text(), source=str(SITE)).changed(radio={"centre_frequency_hz": rf_hz})
    names = [{"receiver_ids": [f"{h.id}_r{k}" for k in range(len(PLACES_M[place]))]} for h in site.heliostat]
    like = {"receiver_mirror_m": PLACES_M[place]}
    heliostats = [h.changed(**like, **n) for h, n in zip(site.heliostat, names, strict=True)]
    site = site.changed(heliostat=heliostats)
    if transmitter_enu_m is None:
        return site
    n = len(transmitter_enu_m)
    step = site.carrier_hz[1] - site.carrier_hz[0]
    return site.changed(
        transmitter=[
            {"id": f"T{i + 1}", "position_enu_m": p, "carrier_hz": float((i - 0.5 * (n - 1)) * step)}
            for i, p in enumerate(np.asarray(transmitter_enu_m).tolist())
        ]
    )


def normals_enu(site: Scenario, suns: Iterable[int]) -> Array:
    """Return (frame, mirror, xyz) the normals with which heliostats, then plates, send suns to the aim point."""
    pivot = np.array([mirror.pivot_enu_m for mirror in (*site.heliostat, *site.site.structures.plate)])
    to_aim = np.asarray(site.site.aim_enu_m) - pivot
    toward = [geometry.enu_from_azimuth_elevation(*np.radians(sun_deg(sun))) for sun in suns]
    return np.stack([geometry.bisector_enu(np.broadcast_to(one, to_aim.shape), to_aim) for one in toward])


def sun_deg(sun: int) -> tuple[float, float]:
    """Return azimuth and elevation of the suns that tables are numbered by; further ones are drawn."""
    if sun in SUNS_DEG:
        return SUNS_DEG[sun]
    rng = np.random.default_rng([99, sun])
    return float(rng.uniform(90.0, 270.0)), float(rng.uniform(15.0, 65.0))


def receivers_enu_m(site: Scenario, rot_enu_from_mirror: Array) -> Array:
    """Return (receiver, xyz) where receivers are, calibration receivers last."""
    moving = [
        h.pivot_enu_m + np.array(h.receiver_mirror_m) @ rot.T
        for h, rot in zip(site.heliostat, rot_enu_from_mirror, strict=True)
    ]
    return np.concatenate([*moving, site.calibration_enu_m])


def soil(rf_hz: float) -> tuple[float, float]:
    """Return permittivity and conductivity [S/m] of ITU-R P.2040's medium dry ground, carried on below 1 GHz."""
    return 15.0, max(1e-3, 0.035 * (rf_hz / 1e9) ** 1.63)


def concrete(rf_hz: float) -> tuple[float, float]:
    """Return permittivity and conductivity [S/m] of the tower: ITU-R P.2040's concrete, carried on below 1 GHz."""
    return 5.24, 0.0462 * (rf_hz / 1e9) ** 0.7822


# -- directions ----------------------------------------------------------------------------------------------


def spherical_units(direction: Array) -> tuple[Array, Array]:
    """Return the unit vectors of theta and phi (..., xyz) of directions, in the directions' frame."""
    across = np.hypot(direction[..., 0], direction[..., 1])
    x, y = direction[..., 0] / across, direction[..., 1] / across
    theta = np.stack([direction[..., 2] * x, direction[..., 2] * y, -across], axis=-1)
    return theta, np.stack([-y, x, 0.0 * x], axis=-1)


def theta_hat(direction_enu: Array) -> Array:
    """Return the unit vectors (..., xyz) of theta, which point down: a vertical dipole's field."""
    return spherical_units(direction_enu)[0]


def quadratic(x: Array, at: Array) -> Array:
    """Return (at, ...) the weights of three equidistant points in the parabola through them, at x."""
    step = (x - at[1]) / (at[2] - at[1])
    return np.stack([0.5 * step * (step - 1.0), 1.0 - step**2, 0.5 * step * (step + 1.0)])


# -- ray tables ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rays of one posture of the site; a row a ray.

    ``rx`` and ``tx`` number ``rx_names`` and ``tx_enu_m``; ``a_theta``, ``a_phi`` are field components at the receiver
    in the directions' own unit vectors, lambda / 4 pi d included; ``code`` says what the ray met.
    """

    rx: npt.NDArray[np.int64]
    tx: npt.NDArray[np.int64]
    a_theta: Complex
    a_phi: Complex
    length_m: Array
    theta_t: Array
    theta_r: Array
    phi_r: Array
    code: npt.NDArray[np.str_]
    rx_names: npt.NDArray[np.str_]
    rx_enu_m: Array
    tx_enu_m: Array
    frequency_hz: float

    @classmethod
    def read(cls, path: Path) -> Table:
        """Read a table file."""
        wide = {"i": np.int64, "c": np.complex128, "f": np.float64}
        with np.load(path, allow_pickle=False) as file:
            found = {f.name: file[f.name] for f in fields(cls)}
        columns = {k: v.astype(wide[v.dtype.kind]) if v.dtype.kind in wide else v for k, v in found.items()}
        return cls(**columns | {"frequency_hz": float(columns["frequency_hz"])})  # type: ignore[arg-type]

    def only(self, keep: npt.NDArray[np.bool_]) -> Table:
        """Return the table with those rays alone."""
        per_ray = [f.name for f in fields(self) if f.name not in ("rx_names", "rx_enu_m", "tx_enu_m", "frequency_hz")]
        return replace(self, **{name: getattr(self, name)[keep] for name in per_ray})

    def without(self, pattern: str) -> Table:
        """Return the table without rays whose code matches."""
        return self.only(np.array([re.search(pattern, str(c)) is None for c in self.code], bool))

    def and_rays_of(self, other: Table) -> Table:
        """Return the table with another one's rays behind its own."""
        per_ray = [f.name for f in fields(self) if f.name not in ("rx_names", "rx_enu_m", "tx_enu_m", "frequency_hz")]
        return replace(self, **{name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in per_ray})

    def at(self, site: Scenario, place: str) -> Table:
        """Return the rays of the receivers at a place, numbered as the site numbers its receivers."""
        names = {str(name): k for k, name in enumerate(self.rx_names)}
        rows = [names.get(f"{place}:{name}", names.get(name, -1)) for name in site.receiver_ids]
        new = np.full(len(self.rx_names), -1)
        new[rows] = np.arange(len(rows))
        kept = self.only(new[self.rx] >= 0)
        return replace(kept, rx=new[kept.rx], rx_names=np.array(site.receiver_ids), rx_enu_m=self.rx_enu_m[rows])

    def from_transmitters(self, index: npt.ArrayLike) -> Table:
        """Return the rays of some transmitters, numbered anew in that order."""
        new = np.full(len(self.tx_enu_m), -1)
        new[np.asarray(index)] = np.arange(len(np.asarray(index)))
        kept = self.only(new[self.tx] >= 0)
        return replace(kept, tx=new[kept.tx], tx_enu_m=self.tx_enu_m[np.asarray(index)])

    def of_carriers(self, n: int) -> Table:
        """Return the rays of n carriers at each transmitter's antenna, one after the other."""
        each = [replace(self, tx=n * self.tx + k, tx_enu_m=np.repeat(self.tx_enu_m, n, axis=0)) for k in range(n)]
        whole = each[0]
        for other in each[1:]:
            whole = whole.and_rays_of(other)
        return whole

    def meets_own_plate(self) -> npt.NDArray[np.bool_]:
        """(ray,) whether it met the plate of the receiver's own mirror."""
        own = [name.split(":")[-1].split("_")[0] for name in map(str, self.rx_names)]
        return np.array(
            [
                own[r] in [step.split(":")[-1] for step in str(c).split("+")]
                for r, c in zip(self.rx, self.code, strict=True)
            ]
        )

    def direction_enu(self) -> Array:
        """(ray, xyz) from the receiver towards where the ray comes from."""
        sine = np.sin(self.theta_r)
        return np.stack([sine * np.cos(self.phi_r), sine * np.sin(self.phi_r), np.cos(self.theta_r)], axis=1)

    def field_enu(self) -> Complex:
        """(ray, xyz) the electric field at the receiver, its propagation phase off."""
        cosine, zero = np.cos(self.theta_r), np.zeros(len(self.rx))
        theta = np.stack([cosine * np.cos(self.phi_r), cosine * np.sin(self.phi_r), -np.sin(self.theta_r)], axis=1)
        phi = np.stack([-np.sin(self.phi_r), np.cos(self.phi_r), zero], axis=1)
        return self.a_theta[:, None] * theta + self.a_phi[:, None] * phi


# -- antennas ------------------------------------------------------------------------------------------------


def antenna_isotropic(table: Table, rot_enu_from_mirror: Array) -> Complex:
    """Return what an isotropic, vertically polarised antenna receives."""
    return table.a_theta


def antenna_short_dipole(table: Table, rot_enu_from_mirror: Array) -> Complex:
    """Return what short dipoles along the mirrors' y axes receive, one at broadside; calibration's stand upright."""
    n_mirror_receiver = sum(":" not in n and "_r" in n for n in map(str, table.rx_names))
    per_mirror = n_mirror_receiver // len(rot_enu_from_mirror)
    axis = np.tile([0.0, 0.0, 1.0], (len(table.rx_names), 1))
    axis[:n_mirror_receiver] = np.repeat(rot_enu_from_mirror[:, :, 1], per_mirror, axis=0)
    # the θ unit vector points down where the dipole points up: the sign makes an upright dipole give +a_theta
    return -np.einsum("kx,kx->k", table.field_enu(), axis[table.rx])


def antenna_before_plate(site: Scenario, table: Table, rot_enu_from_mirror: Array, pattern: AntennaPattern) -> Complex:
    """Return (ray, line) what a mirror's receivers make of rays; calibration receivers are isotropic."""
    owner = np.array([-1 if r.heliostat is None else r.heliostat for r in site.receivers])[table.rx]
    first = np.array([site.receiver_rows(i).start for i in range(len(site.heliostat))])
    mirror = np.flatnonzero(owner >= 0)
    rot, own = rot_enu_from_mirror[owner[mirror]], table.rx[mirror] - first[owner[mirror]]
    toward = np.einsum("kx,kxm->km", table.direction_enu()[mirror], rot)
    field = np.einsum("kx,kxm->km", table.field_enu()[mirror], rot)
    known = pattern.frequency_hz
    at = np.stack([(field * pattern.table(f).vector(toward, own)).sum(axis=1) for f in known], axis=1)
    rf_hz = site.radio.centre_frequency_hz + site.line_hz[table.tx]
    out = np.repeat(table.a_theta[:, None], rf_hz.shape[1], axis=1)
    weight = quadratic(rf_hz[mirror], known) if len(known) == 3 else np.ones((1, len(mirror), rf_hz.shape[1]))
    out[mirror] = np.einsum("fkl,kf->kl", weight, at)
    return out


# -- lines ---------------------------------------------------------------------------------------------------


def lines_of(site: Scenario, table: Table, amplitude: Complex) -> Complex:
    """Return (receiver, transmitter, line) the sum over rays, each line at its own frequency; one at 60 m.

    ``amplitude`` (ray,) is what the antenna makes of each, or (ray, line) where that depends on frequency.
    """
    out = np.zeros((len(table.rx_names), *site.line_hz.shape), np.complex128)
    scaled = amplitude.reshape(len(table.rx), -1) * (4.0 * np.pi * REFERENCE_M * table.frequency_hz / SPEED_MPS)
    rf_hz = site.radio.centre_frequency_hz + site.line_hz[table.tx]
    turns = rf_hz * (table.length_m / SPEED_MPS)[:, None]
    np.add.at(out, (table.rx, table.tx), scaled * np.exp(-2j * np.pi * turns))
    return out


def measured(site: Scenario, lines: Complex, *, seed: int, snr_db: float = SNR_DB) -> TonePhases:
    """Return what `rfpose.dsp` would measure of lines (frame, receiver, transmitter, line), noise included.

    Transmitters have phases of their own, oscillators another one a frame; mirrors' receivers share theirs.
    """
    rng = np.random.default_rng(seed)
    n_frame, _, n_transmitter, n_line = lines.shape
    index = np.array([t.modulation_index for t in site.tone])
    carrier_rad = rng.uniform(-np.pi, np.pi, n_transmitter)
    tone_rad = rng.uniform(-np.pi, np.pi, (n_transmitter, len(index)))
    sent = np.ones((n_transmitter, n_line), np.complex128)
    sent[:, 1::2], sent[:, 2::2] = 0.5 * index * np.exp(1j * tone_rad), 0.5 * index * np.exp(-1j * tone_rad)
    sent *= np.exp(1j * carrier_rad)[:, None]
    owner = [receiver.oscillator for receiver in site.receivers]
    oscillators = list(dict.fromkeys(owner))
    oscillator_rad = rng.uniform(-np.pi, np.pi, (n_frame, len(oscillators)))[:, [oscillators.index(o) for o in owner]]
    n_sample = site.radio.frame_samples
    noise_variance = index[0] ** 2 * 10.0 ** (-snr_db / 10.0)
    sigma = np.sqrt(0.5 * noise_variance / n_sample)
    noise = sigma * (rng.standard_normal(lines.shape) + 1j * rng.standard_normal(lines.shape))
    seen = lines * sent * np.exp(1j * oscillator_rad)[:, :, None, None] + noise
    return _tone_phases(site, seen, sigma, noise_variance)


def _tone_phases(site: Scenario, seen: Complex, sigma: float, noise_variance: float) -> TonePhases:
    """Return the record of lines whose real and imaginary parts have the standard deviation ``sigma``."""
    n_frame, n_receiver = seen.shape[:2]
    start = np.array([(_START_UNIX_S + 60 * k) * site.radio.sample_rate for k in range(n_frame)], np.int64)
    carrier, upper, lower = seen[..., 0], seen[..., 1::2], seen[..., 2::2]
    turned = carrier.conj()[..., None] / np.maximum(np.abs(carrier), 1e-300)[..., None]
    tone = upper * turned + (lower * turned).conj()
    tone_sigma = np.sqrt(2.0) * sigma / np.maximum(np.abs(tone), 1e-300)
    # the thresholds of rfpose.dsp.extractor
    absent = np.abs(carrier) ** 2 < 25.0 * 2.0 * sigma**2
    weak = (np.abs(tone) ** 2 < 8.0 * 4.0 * sigma**2).any(axis=-1)
    status = np.where(absent, LineStatus.ABSENT, np.where(weak, LineStatus.WEAK, LineStatus.OK)).astype(np.uint8)
    bad = (status != LineStatus.OK)[..., None]
    each = np.zeros((n_frame, n_receiver))
    return TonePhases(
        receiver_ids=site.receiver_ids,
        transmitter_ids=site.transmitter_ids,
        tone_hz=site.tone_hz,
        frame_start_index=start,
        phase_rad=np.where(bad, np.nan, np.angle(tone)),
        sigma_rad=np.where(bad, np.nan, tone_sigma),
        carrier=carrier,
        carrier_sigma=np.full(carrier.shape, sigma),
        sideband=np.stack([upper, lower], axis=-1),
        sideband_sigma=np.full((*upper.shape, 2), sigma),
        clock_ppm=each,
        clock_sigma_ppm=each + 1e-6,
        noise_variance=each + noise_variance,
        clipped_fraction=each,
        status=status,
    )
