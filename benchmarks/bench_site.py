"""Print how long pose site takes for a plant of mirrors: ground and neighbours' reflections in the model.

python benchmarks/bench_site.py [--mirrors 10000]

Mirrors of 2 m stand 8 m apart, three receivers before each, ten transmitters, a tower, a Fresnel ground. Carriers are
the sums of the foreseen rays with a stray field of 3 % of the direct one; commanded postures are off by 10 mrad about
each axis.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.spatial.transform import Rotation

import rfpose as rf
from rfpose import geometry
from rfpose.multilat import PoseStatus
from rfpose.multilat.site import Common, SiteKnowledge, SiteObservations, fit_site
from rfpose.pipeline.mirrors import mirror_groups
from rfpose.pipeline.site import SiteField, antenna_of
from rfpose.propagation import RayKind

STRAY, POSTURE_RAD, PIVOT_M, APART_M = 0.03, 0.01, 0.005, 8.0


def plant(n: int) -> rf.Scenario:
    """Return a site of so many mirrors."""
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    side = 20.0 + APART_M * np.arange(int(np.ceil(np.sqrt(n))))
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)[:n]
    return site.with_field(np.c_[places, np.full(n, 3.0)]).changed(
        radio={"centre_frequency_hz": 433e6},
        heliostat={
            "width_m": 2.0, "height_m": 2.0, "pivot_sigma_m": PIVOT_M, "receiver_delay_sigma_s": 0.0,
            "receiver_mirror_m": ((0.9988, 0.0, 0.1), (-0.4994, 0.865, 0.1), (-0.4994, -0.865, 0.1)),
        },
        reflection={"model": "fresnel", "permittivity": 15.0, "conductivity_s_per_m": 0.01},
        site={"structures": {"box": [{"id": "tower", "base_enu_m": (0.0, 0.0, 0.0), "size_m": (6.0, 6.0, 46.0)}]}},
        multipath={"foresee": ["ground", "specular"], "reach_m": 1.5 * APART_M},
    )  # fmt: skip


def carriers(field: SiteField, site: rf.Scenario, pivot: np.ndarray, rot: np.ndarray, rng: np.random.Generator):
    """Return what the receivers hear (mirror, receiver, transmitter), and each transmitter's direct field."""
    common = Common(floor=0.05, tail=3.0, factor_scale=np.ones(len(RayKind)), soil_change=0j, soil_sigma=(0.0, 0.0))
    heard = field(pivot, rot, common)
    rays, n_tx = heard.rays, len(site.transmitter)
    n_rx = (len(rays.first) - 1) // len(pivot) // n_tx
    link = np.repeat(np.arange(len(rays.first) - 1), np.diff(rays.first))
    mirror = link // (n_rx * n_tx)
    at = pivot[mirror] + np.einsum("kab,kb->ka", rot[mirror], rays.place_mirror_m)
    path = np.linalg.norm(rays.source_enu_m - at, axis=1) + rays.extra_m
    wavenumber = 2.0 * np.pi * site.carrier_rf_hz / site.radio.propagation_speed_mps
    h = np.zeros(len(rays.first) - 1, complex)
    np.add.at(h, link, heard.voltage * np.exp(-1j * wavenumber[link % n_tx] * path))
    h = h.reshape(len(pivot), n_rx, n_tx)
    direct = 1.0 / np.linalg.norm(site.transmitter_enu_m - pivot[:, None], axis=2)
    draw = rng.normal(size=(2, *h.shape))
    found = h * np.exp(2j * np.pi * rng.random((len(pivot), 1, n_tx)))
    found = found + STRAY * direct[:, None] * (draw[0] + 1j * draw[1])
    return np.where(h == 0.0, np.nan, found), direct, wavenumber


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--mirrors", type=int, default=10_000)
    n = parser.parse_args().mirrors
    site, rng = plant(n), np.random.default_rng(1)
    (group,) = mirror_groups(site)
    pivot = site.pivot_enu_m
    sun = geometry.enu_from_azimuth_elevation(np.radians(180.0), np.radians(60.0))
    rot = geometry.rot_enu_from_mirror(geometry.bisector_enu(np.array([0.0, 0.0, 50.0]) - pivot, sun))
    commanded = Rotation.from_rotvec(POSTURE_RAD * rng.normal(size=(n, 3))).as_matrix() @ rot
    carrier, direct, wavenumber = carriers(SiteField(site, group, rot[None], antenna_of(site)), site, pivot, rot, rng)
    field = SiteField(site, group, commanded[None], antenna_of(site))
    seen = SiteObservations(carrier=carrier, sigma=np.full(carrier.shape, 1e-6), wavenumber_radpm=wavenumber)
    known = SiteKnowledge(
        receiver_mirror_m=group.places_m, pivot_enu_m=pivot + PIVOT_M * rng.normal(size=pivot.shape),
        pivot_sigma_m=PIVOT_M, commanded_rot=commanded, posture_sigma_rad=np.full(n, 2.0 * POSTURE_RAD),
        roll_sigma_rad=np.inf, clock_sigma_m=0.0, unit_field=direct,
    )  # fmt: skip
    for run in ("first, compiling", "again"):
        begin = time.perf_counter()
        poses = fit_site(seen, known, field)
        took = time.perf_counter() - begin
        ok = poses.status == PoseStatus.OK
        mrad = 1e3 * geometry.angle_between_rad(poses.normal_enu, rot[:, :, 2])[ok]
        print(f"{run}: {took:.1f} s, {ok.sum()} of {n} solved, median error {np.median(mrad):.2f} mrad", flush=True)


if __name__ == "__main__":
    main()
