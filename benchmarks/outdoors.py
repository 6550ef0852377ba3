"""Print what would bring a real field's poses to 0.3 mrad: radio frequency, stepped carriers, antennas, transmitters.

    python benchmarks/outdoors.py TABLES     # ray tables, by benchmarks/real_field_tables.py

A study in numpy on ray tables of the site of `benchmarks/traced.py` (isotropic antennas beside the plates; ground,
tower, neighbours, diffraction; own plates only where said), apart from the solver: carriers' phases are compared
between a mirror's receivers, direct rays alone in the model, Student-t weights, a floor from the residuals. Starts are
20 mrad off, at 5.8 GHz 5; pivots 5 mm off, with that prior. No noise: reflections decide.

**Stepped carriers.** A transmitter steps its carrier over a band, a megahertz a step; at each step every receiver
measures its complex amplitude. A mirror's receivers share an oscillator, so that each step has one unknown phase in
common (``phases unknown``), or none where transmitters and receivers keep their phases over the steps. ``window``: the
steps of a link are added, turned back by the direct way's length under a Hann window, which passes ways of about that
length only. ``two ways``: amplitudes of direct and ground way, whose lengths geometry knows, are fitted to a link's
steps. Rays are the table's at all steps: their lengths are exact, while Fresnel's and diffraction's dependence on
frequency within the band is left out.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import traced
from scipy.spatial.transform import Rotation
from traced import SPEED_MPS, Table

from rfpose import geometry

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

SUNS = (0, 1)
STEP_HZ = 1e6
PIVOT_SIGMA_M = 0.005
FREEDOM = 3.0
"""Of Student's t."""
ROUNDS = 30
CHOKE_DB = np.array([[-90, -25], [-30, -25], [-20, -20], [-10, -15], [0, -10], [10, -3], [30, 0], [90, 0]], np.float64)
"""Elevation [deg] and gain of an antenna that hears little from below: a choke ring's, upright."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """Rays of one sun, and where everything truly is."""

    table: Table
    pivot_enu_m: Array
    rot_enu_from_mirror: Array
    place_mirror_m: Array

    @property
    def transmitter_enu_m(self) -> Array:
        """(transmitter, xyz)."""
        return self.table.tx_enu_m


def field_of(folder: Path, name: str, mhz: float, sun: int) -> Field:
    """Read the rays of the receivers beside the mirrors."""
    table = Table.read(folder / f"{name}_{mhz:.0f}MHz_sun{sun}.npz")
    site = traced.site_of(1e6 * mhz, "beside")
    n = len(site.heliostat)
    rot = geometry.rot_enu_from_mirror(traced.normals_enu(site, (sun,))[0, :n])
    return Field(
        table=table.at(site, "beside"),
        pivot_enu_m=site.pivot_enu_m,
        rot_enu_from_mirror=rot,
        place_mirror_m=np.array(traced.PLACES_M["beside"]),
    )


# -- what is measured ----------------------------------------------------------------------------------------


def choke_ring(table: Table) -> Array:
    """(ray,) gain of an antenna that hears little from below."""
    elevation = 90.0 - np.degrees(table.theta_r)
    return np.asarray(10.0 ** (np.interp(elevation, *CHOKE_DB.T) / 20.0))


def steps_of(field: Field, rf_hz: Array, gain: Array) -> Complex:
    """Return (mirror, receiver, transmitter, step) what links carry at radio frequencies."""
    table = field.table
    out = np.zeros((len(table.rx_names), len(table.tx_enu_m), len(rf_hz)), np.complex128)
    ray = table.a_theta * gain * (4.0 * np.pi * table.frequency_hz / SPEED_MPS)
    for k, f in enumerate(rf_hz):
        np.add.at(out[:, :, k], (table.rx, table.tx), ray * np.exp(-2j * np.pi * f / SPEED_MPS * table.length_m))
    n_mirror, n_receiver = len(field.pivot_enu_m), len(field.place_mirror_m)
    return out[: n_mirror * n_receiver].reshape(n_mirror, n_receiver, -1, len(rf_hz))


def ways_m(transmitter: Array, pivot: Array, rot: Array, place: Array) -> tuple[Array, Array]:
    """Return (receiver, transmitter) lengths of the direct way and of that over the ground."""
    receiver = pivot + place @ rot.T
    return tuple(np.linalg.norm(receiver[:, None] - transmitter * [1.0, 1.0, sign], axis=-1) for sign in (1.0, -1.0))  # type: ignore[return-value]


def gated(steps: Complex, rf_hz: Array, ways: tuple[Array, Array], *, two_ways: bool, kept: bool) -> Complex:
    """Return (receiver, transmitter) the direct way's amplitude at the band's middle, of (…, step) of one mirror."""
    wave = 2.0 * np.pi * (rf_hz - rf_hz.mean()) / SPEED_MPS
    weight = np.hanning(len(rf_hz) + 2)[1:-1]
    shape = [np.exp(-1j * wave * way[..., None]) for way in (ways if two_ways else ways[:1])]
    basis = np.stack(shape, axis=-1)
    if two_ways:
        inverse = np.linalg.pinv(basis, rcond=1e-2)
    else:
        inverse = (weight / weight.sum() * basis[..., 0].conj())[..., None, :]
    turned = steps
    for _ in range(1 if kept else ROUNDS):
        amplitude = np.einsum("rtkn,rtn->rtk", inverse, turned)
        if kept:
            break
        # the phase that a step has in common is what makes the receivers' sum like its model
        model = np.einsum("rtnk,rtk->rtn", basis, amplitude)
        common = np.sum(steps * model.conj(), axis=0)
        turned = steps * np.exp(-1j * np.angle(common))
    return np.asarray(amplitude[..., 0])


# -- the fit -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """A fitted mirror."""

    rot_enu_from_mirror: Array
    cov: Array
    cost: float


def fit(amplitude: Complex, wavelength_m: float, field: Field, pivot_enu_m: Array, rot: Array) -> Found:
    """Fit a mirror's orientation and pivot to amplitudes (receiver, transmitter) from a start by Gauss-Newton."""
    k, transmitter, place = 2.0 * np.pi / wavelength_m, field.transmitter_enu_m, field.place_mirror_m
    pivot = pivot_enu_m
    relative = np.abs(amplitude) * np.linalg.norm(transmitter - pivot, axis=1)  # one for a direct ray alone
    spread = 1.0 / np.maximum(relative, 1e-3)
    prior = np.diag([1e-9] * 3 + [PIVOT_SIGMA_M**-2] * 3)
    scale, weight = 0.3, np.ones(amplitude.shape)
    for _ in range(ROUNDS):
        arm = place @ rot.T
        ray = (pivot + arm)[:, None] - transmitter
        length = np.linalg.norm(ray, axis=-1)
        unit = ray / length[..., None]
        jacobian = k * np.concatenate([np.cross(arm[:, None], unit), unit], axis=-1)
        info = weight / (scale * spread) ** 2
        turned = amplitude * np.exp(1j * k * length)
        # the phase a transmitter has at a mirror is anything: about where most receivers agree, and eliminated there
        residual = np.angle(turned * np.exp(-1j * np.angle(np.sum(info * turned / np.abs(turned), axis=0))))
        residual = residual - (info * residual).sum(axis=0) / info.sum(axis=0)
        jacobian = jacobian - np.einsum("rt,rtp->tp", info, jacobian) / info.sum(axis=0)[:, None]
        normal = np.einsum("rt,rtp,rtq->pq", info, jacobian, jacobian) + prior
        gradient = np.einsum("rt,rtp,rt->p", info, jacobian, residual)
        gradient[3:] += (pivot - pivot_enu_m) / PIVOT_SIGMA_M**2
        step = -np.linalg.solve(normal, gradient)
        step *= min(1.0, 0.05 / np.linalg.norm(step[:3]))
        rot, pivot = Rotation.from_rotvec(step[:3]).as_matrix() @ rot, pivot + step[3:]
        z = residual / spread
        weight = (FREEDOM + 1.0) / (FREEDOM + (z / scale) ** 2)
        scale = float(np.clip(np.sqrt((weight * z**2).sum() / max(z.size - z.shape[1] - 3.0, 1.0)), 1e-6, 3.0))
    cost = np.sum((FREEDOM + 1.0) * np.log1p((z / scale) ** 2 / FREEDOM) + 2.0 * np.log(scale))
    return Found(rot_enu_from_mirror=rot, cov=np.linalg.inv(normal), cost=float(cost))


def best_fit(
    amplitude: Complex, wavelength_m: float, field: Field, pivot: Array, start: Array, reach_rad: float
) -> Found:
    """Fit from starts about one, as far as a commanded posture may be off, closer than a wavelength tells apart."""
    span = np.linspace(-reach_rad, reach_rad, 2 * int(np.ceil(reach_rad / (0.12 * wavelength_m))) + 1)
    turns = [Rotation.from_rotvec([a, b, c]).as_matrix() for a in span for b in span for c in (0.0,)]
    if len(turns) > 49:
        raise ValueError("a start that is off by so many wavelengths is not to be searched")
    found = [fit(amplitude, wavelength_m, field, pivot, start @ turn) for turn in turns]
    return min(found, key=lambda one: one.cost)


# -- the study -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """A row of the table."""

    name: str
    mhz: float
    tables: str = "open"
    band_mhz: float = 0.0
    two_ways: bool = False
    kept: bool = True
    choke: bool = False
    start_rad: float = 0.02


def designs() -> list[Design]:
    """Return the rows."""
    rows = []
    for mhz, start in ((433.0, 0.02), (2400.0, 0.02), (5800.0, 0.005)):
        rows.append(Design(name="one carrier", mhz=mhz, start_rad=start))
        rows.append(Design(name="one carrier, choke ring", mhz=mhz, choke=True, start_rad=start))
        for band in (25.0, 50.0, 100.0, 200.0, 400.0):
            step = {"mhz": mhz, "band_mhz": band, "start_rad": start}
            rows.append(Design(name="stepped, window", **step))
            rows.append(Design(name="stepped, two ways", two_ways=True, **step))
            rows.append(Design(name="stepped, two ways, phases unknown", two_ways=True, kept=False, **step))
        rows.append(
            Design(
                name="stepped, two ways, choke ring",
                mhz=mhz,
                band_mhz=100.0,
                two_ways=True,
                choke=True,
                start_rad=start,
            )
        )
    for mhz, start in ((2400.0, 0.02), (5800.0, 0.005)):
        own = {"mhz": mhz, "tables": "edges", "start_rad": start}
        rows.append(Design(name="one carrier, own plates", **own))
        rows.append(Design(name="stepped, two ways, own plates", band_mhz=100.0, two_ways=True, **own))
        rows.append(Design(name="stepped, two ways, own plates", band_mhz=400.0, two_ways=True, **own))
    rows.append(Design(name="one carrier, 20 transmitters", mhz=433.0, tables="open-20"))
    rows.append(Design(name="one carrier, transmitters 30 m higher", mhz=433.0, tables="open-high"))
    for tables, what in (("open-20", "20 transmitters"), ("open-high", "30 m higher")):
        rows.append(Design(name=f"stepped, two ways, {what}", mhz=433.0, tables=tables, band_mhz=100.0, two_ways=True))
    return rows


def errors_of(design: Design, fields: list[Field]) -> tuple[Array, Array]:
    """Return (mirror-frame,) errors of the normal [rad] and squared errors over their covariance."""
    rng = np.random.default_rng(3)
    rf_hz = 1e6 * design.mhz + np.arange(-0.5e6 * design.band_mhz, 0.5e6 * design.band_mhz + 1.0, STEP_HZ)
    wavelength_m = SPEED_MPS / rf_hz.mean()
    errors, squared = [], []
    for field in fields:
        gain = choke_ring(field.table) if design.choke else np.ones(len(field.table.rx))
        steps = steps_of(field, rf_hz, gain)
        for i, (pivot, rot) in enumerate(zip(field.pivot_enu_m, field.rot_enu_from_mirror, strict=True)):
            off = geometry.unit(rng.standard_normal(3)) * design.start_rad
            start, surveyed = (
                Rotation.from_rotvec(off).as_matrix() @ rot,
                pivot + PIVOT_SIGMA_M * rng.standard_normal(3),
            )
            amplitude = steps[i, :, :, 0]
            if len(rf_hz) > 1:
                ways = ways_m(field.transmitter_enu_m, surveyed, start, field.place_mirror_m)
                amplitude = gated(steps[i], rf_hz, ways, two_ways=design.two_ways, kept=design.kept)
            # a link that nothing reaches has no phase
            amplitude = np.where(np.abs(amplitude) > 0.0, amplitude, 1e-12)
            found = best_fit(amplitude, wavelength_m, field, surveyed, start, design.start_rad)
            normal, true = found.rot_enu_from_mirror[:, 2], rot[:, 2]
            errors.append(float(geometry.angle_between_rad(normal, true)))
            across = rot[:, :2]
            tilt = np.cross(np.eye(3), true) @ across  # how a rotation moves the normal
            spread = tilt.T @ found.cov[:3, :3] @ tilt
            away = across.T @ (normal - true)
            squared.append(float(away @ np.linalg.solve(spread, away)))
    return np.array(errors), np.array(squared)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="ray tables, by benchmarks/real_field_tables.py")
    options = parser.parse_args()
    print("| MHz | design | band MHz | rms / median / max mrad | NEES |")
    print("|---|---|---|---|---|", flush=True)
    for design in designs():
        try:
            fields = [field_of(options.folder, design.tables, design.mhz, sun) for sun in SUNS]
        except FileNotFoundError as error:
            print(f"| {design.mhz:.0f} | {design.name} | | no {Path(error.filename).name} | |", file=sys.stderr)
            continue
        error, squared = errors_of(design, fields)
        mrad = 1e3 * error
        numbers = f"{np.sqrt(np.mean(mrad**2)):.3g} / {np.median(mrad):.3g} / {mrad.max():.3g}"
        band = f"{design.band_mhz:.0f}" if design.band_mhz else ""
        print(f"| {design.mhz:.0f} | {design.name} | {band} | {numbers} | {np.mean(squared) / 2.0:.2g} |", flush=True)


if __name__ == "__main__":
    main()
