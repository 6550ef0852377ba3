"""Print how rays foreseen from geometry agree with path tables that a ray tracer of others made.

python benchmarks/foreseen_rays.py ../shared/data/traced [--variant edges] [--mhz 433] [--sun 0] [--place beside]

The folder holds `paths/VARIANT_FREQMHz_sunK.npz` and the site's numbers in `tools/site_.py`. Rays are matched within
each link by what they met and by their length; diffracted ones with the tracer's own coefficients. With --moments: rays
of the mirror's own plate against what the method of moments has for it (`nec/front_y_433MHz.npz`).
"""

from __future__ import annotations

import argparse
import re
import runpy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rfpose.geometry import rot_enu_from_mirror
from rfpose.propagation import (
    BoxesStanding,
    Foresight,
    PlatesStanding,
    RayKind,
    Rays,
    ReceiverStand,
    Soil,
    Surroundings,
    bystanders,
    foresee,
)

VARIANTS = ("ground", "field", "plates", "edges")
SPEED_MPS = 299_792_458.0
SAME_LENGTH_M = 2e-3


@dataclass
class Traced:
    """One table, and the same site for rfpose."""

    site: dict[str, Any]
    variant: str
    place: str
    carrier_hz: float
    transmitter_enu_m: np.ndarray
    mirrors: ReceiverStand
    surroundings: Surroundings
    link: np.ndarray
    """(ray,) number of the link, as `Rays` counts."""
    field_enu: np.ndarray
    length_m: np.ndarray
    kind: np.ndarray
    code: np.ndarray


def read(folder: Path, variant: str, mhz: int, sun: int, place: str) -> Traced:
    """Read a table; ``place`` is ``front``, ``beside`` or ``cal``."""
    site = runpy.run_path(str(folder / "tools" / "site_.py"))
    with np.load(folder / "paths" / f"{variant}_{mhz}MHz_sun{sun}.npz") as file:
        table = {key: file[key] for key in file.files}
    carrier = float(table["frequency_hz"])
    plates, names = standing_plates(site, variant, sun)
    mirrors = standing_mirrors(site, place, sun, names)
    wanted = [k for k, name in enumerate(table["rx_names"]) if str(name).startswith(place)]
    row = np.full(len(table["rx_names"]), -1)
    row[wanted] = np.arange(len(wanted))
    code = table["code"].astype(str)
    use = (row[table["rx"]] >= 0) & np.array(["D:ground" not in c for c in code])
    theta, phi = table["theta_r"].astype(float)[use], table["phi_r"].astype(float)[use]
    theta_hat = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)], axis=1)
    phi_hat = np.stack([-np.sin(phi), np.cos(phi), 0.0 * phi], axis=1)
    field = table["a_theta"][use, None] * theta_hat + table["a_phi"][use, None] * phi_hat
    n_receiver, n_transmitter = mirrors.receiver_mirror_m.shape[1], len(table["tx_enu_m"])
    receiver = row[table["rx"][use]]
    owner = [names.index(name) if name in names else -2 for name in site["PIVOT"]]
    own = np.array(owner)[receiver // n_receiver] if place != "cal" else np.full(len(receiver), -2)
    return Traced(
        site=site,
        variant=variant,
        place=place,
        carrier_hz=carrier,
        transmitter_enu_m=table["tx_enu_m"],
        mirrors=mirrors,
        surroundings=Surroundings(
            plates=plates, boxes=standing_boxes(site, variant, carrier), soil=soil(site, carrier)
        ),
        link=receiver * n_transmitter + table["tx"][use],
        field_enu=field * (4.0 * np.pi * carrier / SPEED_MPS),
        length_m=table["length_m"][use],
        kind=np.array([kind_of(c, names[o] if o >= 0 else "") for c, o in zip(code[use], own, strict=True)]),
        code=code[use],
    )


def standing_plates(site: dict[str, Any], variant: str, sun: int) -> tuple[PlatesStanding, list[str]]:
    """Neighbours, and the mirrors themselves where the variant has them."""
    place = {} if variant == "ground" else dict(site["neighbours"]())
    if variant in ("plates", "edges"):
        place |= site["PIVOT"]
    centre = np.array(list(place.values())).reshape(-1, 3)
    normal = np.array([site["normal"](p, site["SUNS"][sun]) for p in centre]).reshape(-1, 3)
    size = np.full((len(centre), 2), 2.0 * site["HALF"])
    rot = rot_enu_from_mirror(normal)
    return PlatesStanding(centre_enu_m=centre, rot_enu_from_mirror=rot, size_m=size), list(place)


def standing_boxes(site: dict[str, Any], variant: str, carrier_hz: float) -> BoxesStanding:
    """Stand the tower up."""
    n = 0 if variant == "ground" else 1
    permittivity, conductivity = site["concrete"](carrier_hz)
    return BoxesStanding(
        base_enu_m=np.zeros((n, 3)),
        size_m=np.array([site["TOWER"]] * n).reshape(-1, 3),
        azimuth_rad=np.zeros(n),
        permittivity=np.full(n, permittivity),
        conductivity_s_per_m=np.full(n, conductivity),
    )


def soil(site: dict[str, Any], carrier_hz: float) -> Soil:
    """Return the ground."""
    permittivity, conductivity = site["soil"](carrier_hz)
    return Soil(permittivity=permittivity, conductivity_s_per_m=conductivity)


def standing_mirrors(site: dict[str, Any], place: str, sun: int, names: list[str]) -> ReceiverStand:
    """Stand the instrumented mirrors, or the calibration receivers, where the table has them."""
    if place == "cal":
        return bystanders(site["CAL"])
    pivot = np.array(list(site["PIVOT"].values()))
    normal = np.array([site["normal"](p, site["SUNS"][sun]) for p in pivot])
    return ReceiverStand(
        pivot_enu_m=pivot,
        rot_enu_from_mirror=rot_enu_from_mirror(normal),
        receiver_mirror_m=np.broadcast_to(site["PLACES"][place], (len(pivot), *site["PLACES"][place].shape)),
        own_plate=np.array([names.index(name) if name in names else -1 for name in site["PIVOT"]]),
    )


def kind_of(code: str, own: str) -> int:
    """Kind of a ray of the table, met in order; ``own`` is the name of the receiver's own plate."""
    if not code:
        return RayKind.DIRECT
    if code == "R:ground":
        return RayKind.GROUND
    if own and any(met.split(":")[1] == own for met in code.split("+")):
        return RayKind.OWN_PLATE
    return RayKind.DIFFRACTED if "D:" in code else RayKind.SPECULAR


def lengths_m(rays: Rays, mirrors: ReceiverStand, n_transmitter: int) -> tuple[np.ndarray, np.ndarray]:
    """Return each ray's link, and its length in these poses."""
    link = np.repeat(np.arange(len(rays.first) - 1), np.diff(rays.first))
    mirror = link // (mirrors.receiver_mirror_m.shape[1] * n_transmitter)
    place = np.einsum("kab,kb->ka", mirrors.rot_enu_from_mirror[mirror], rays.place_mirror_m)
    way = rays.source_enu_m - mirrors.pivot_enu_m[mirror] - place
    return link, np.linalg.norm(way, axis=1) + rays.extra_m


def matched(traced: Traced, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each ray of the table, which foreseen ray it is (−1: none), and the lengths of the foreseen."""
    _, way = lengths_m(rays, traced.mirrors, len(traced.transmitter_enu_m))
    partner, taken = np.full(len(traced.link), -1), np.zeros(rays.n_ray, bool)
    for k in np.argsort(-np.linalg.norm(traced.field_enu, axis=1)):
        mine = np.arange(rays.first[traced.link[k]], rays.first[traced.link[k] + 1])
        mine = mine[(rays.kind[mine] == traced.kind[k]) & ~taken[mine]]
        if len(mine):
            best = mine[np.argmin(np.abs(way[mine] - traced.length_m[k]))]
            if abs(way[best] - traced.length_m[k]) < SAME_LENGTH_M:
                partner[k], taken[best] = best, True
    return partner, way


def summed(link: np.ndarray, field: np.ndarray, way_m: np.ndarray, carrier_hz: float, n_link: int) -> np.ndarray:
    """(link, xyz) field of all rays together."""
    out = np.zeros((n_link, 3), complex)
    np.add.at(out, link, field * np.exp(-2j * np.pi * carrier_hz / SPEED_MPS * way_m)[:, None])
    return out


def phases_apart(traced: Traced, rays: Rays, only: np.ndarray | None = None) -> tuple[float, float]:
    """Return rms and median phase [rad] between summed upward fields, over links whose direct ray the table has.

    ``only`` are the foreseen rays that count.
    """
    n_link = len(rays.first) - 1
    link, way = lengths_m(rays, traced.mirrors, len(traced.transmitter_enu_m))
    theirs = summed(traced.link, traced.field_enu, traced.length_m, traced.carrier_hz, n_link)[:, 2]
    use = np.arange(rays.n_ray) if only is None else only
    ours = summed(link[use], rays.field_enu[use], way[use], traced.carrier_hz, n_link)[:, 2]
    seen = np.zeros(n_link, bool)
    seen[traced.link[traced.kind == RayKind.DIRECT]] = True
    apart = np.abs(np.angle(ours * theirs.conj()))[seen & (np.abs(ours) > 0)]
    return float(np.sqrt(np.mean(apart**2))), float(np.median(apart))


STEPS = {
    "direct, no obstacles": Foresight(
        visibility=False, ground=False, specular=False, diffracted="none", own_plate=False
    ),
    "and visibility": Foresight(ground=False, specular=False, diffracted="none", own_plate=False),
    "and ground": Foresight(specular=False, diffracted="none", own_plate=False),
    "and specular": Foresight(diffracted="none", own_plate=False),
    "and own plate": Foresight(diffracted="none"),
    "and edges of boxes": Foresight(diffracted="boxes"),
    "and all edges": Foresight(),
    "boxes', as the tracer": Foresight(diffracted="boxes", wedge="sionna"),
    "all, as the tracer": Foresight(wedge="sionna"),
}


def generic(code: str) -> str:
    """Code without the numbers of mirrors."""
    return re.sub(r"H\d+n\d+", "neighbour", re.sub(r"H\d+(?!n|\d)", "mirror", code)) or "direct"


def report(traced: Traced) -> None:
    """Print a table's comparison."""
    options = Foresight(reach_m=1e3, faint=0.0, wedge="sionna")
    rays = foresee(
        traced.transmitter_enu_m, np.full(10, traced.carrier_hz), traced.mirrors, traced.surroundings, options
    )
    partner, way = matched(traced, rays)
    print("  kind         table  both missed  extra | ratio - 1: median, 95 % | length, rms µm")
    for kind in RayKind:
        table, ours = traced.kind == kind, int(np.sum(rays.kind == kind))
        both = np.flatnonzero(table & (partner >= 0))
        mine, theirs = rays.field_enu[partner[both]], traced.field_enu[both]
        ratio = np.sum(mine * theirs.conj(), axis=1) / np.sum(np.abs(theirs) ** 2, axis=1)
        off = np.quantile(np.abs(ratio - 1.0), [0.5, 0.95]) if len(both) else [np.nan, np.nan]
        apart = np.sqrt(np.mean((way[partner[both]] - traced.length_m[both]) ** 2)) if len(both) else np.nan
        counts = f"{table.sum():5d} {len(both):5d} {table.sum() - len(both):6d} {ours - len(both):6d}"
        print(f"  {kind.name.lower():12} {counts} | {off[0]:11.1e} {off[1]:11.1e} | {1e6 * apart:10.2f}")
    missed = np.flatnonzero(partner < 0)
    for code in sorted({generic(traced.code[k]) for k in missed}):
        some = [k for k in missed if generic(traced.code[k]) == code]
        level = np.linalg.norm(traced.field_enu[some], axis=1) * traced.length_m[some]
        print(
            f"  missed {code}: {len(some)}, strongest {20 * np.log10(level.max()):.1f} dB of a free ray of its length"
        )
    print_phases("rays of the table", traced, rays, partner[partner >= 0])
    carrier = np.full(len(traced.transmitter_enu_m), traced.carrier_hz)
    for name, step in STEPS.items():
        some = foresee(traced.transmitter_enu_m, carrier, traced.mirrors, traced.surroundings, step)
        print_phases(name, traced, some)


def print_phases(name: str, traced: Traced, rays: Rays, only: np.ndarray | None = None) -> None:
    """Print how far the summed field's phase is off."""
    rms, median = phases_apart(traced, rays, only)
    n_ray = rays.n_ray if only is None else len(only)
    print(f"  {name:23} {n_ray:6d} rays, phase of the sum off by rms {rms:.3f}, median {median:.4f} rad")


OWN_PLATE_STEPS = {
    "direct": Foresight(visibility=False, ground=False, specular=False, diffracted="none", own_plate=False),
    "and visibility": Foresight(ground=False, specular=False, diffracted="none", own_plate=False),
    "and its reflection": Foresight(ground=False, specular=False, diffracted="none"),
    "and its edges": Foresight(ground=False, specular=False, reach_m=0.0, faint=0.0),
    "edges, as the tracer": Foresight(ground=False, specular=False, reach_m=0.0, faint=0.0, wedge="sionna"),
}


def own_plate_by_moments(folder: Path, sun: int) -> dict[str, tuple[float, float]]:
    """Return what is left of the moments' responses, relative, and the median phase off, by what is foreseen."""
    traced = read(folder, "plates", 433, sun, "front")
    stand = replace(traced.mirrors, own_plate=np.arange(len(traced.mirrors.pivot_enu_m)))
    plates = PlatesStanding(
        centre_enu_m=stand.pivot_enu_m,
        rot_enu_from_mirror=stand.rot_enu_from_mirror,
        size_m=np.full((len(stand.pivot_enu_m), 2), 2.0 * traced.site["HALF"]),
    )
    with np.load(folder / "nec" / "front_y_433MHz.npz") as file:
        response = file["response"][1, sun, :, :, :, 0] / np.linalg.norm(file["free"])
    place = stand.pivot_enu_m[:, None] + np.einsum("mab,mrb->mra", stand.rot_enu_from_mirror, stand.receiver_mirror_m)
    way = traced.transmitter_enu_m - place[:, :, None]
    distance = np.linalg.norm(way, axis=-1)
    vertical = np.einsum("mab,mrta->mrtb", stand.rot_enu_from_mirror, theta_of(way))
    seen = np.einsum("mab,mrta->mrtb", stand.rot_enu_from_mirror, way / distance[..., None])
    beside = np.stack([-seen[..., 1], seen[..., 0], 0.0 * seen[..., 0]], axis=-1)
    beside /= np.linalg.norm(beside, axis=-1, keepdims=True)
    theirs = np.sum(response * np.stack([np.sum(theta_of(seen) * vertical, -1), np.sum(beside * vertical, -1)], -1), -1)
    out = {}
    for name, step in OWN_PLATE_STEPS.items():
        rays = foresee(traced.transmitter_enu_m, np.full(10, 433e6), stand, Surroundings(plates=plates), step)
        link, length = lengths_m(rays, stand, 10)
        across = stand.rot_enu_from_mirror[link // theirs[0].size, :, 1]
        field = np.sum(rays.field_enu * across, axis=1) * distance.ravel()[link]
        ours = np.zeros(theirs.size, complex)
        np.add.at(ours, link, field * np.exp(-2j * np.pi * 433e6 / SPEED_MPS * (length - distance.ravel()[link])))
        scale = np.vdot(ours, theirs) / np.vdot(ours, ours)
        left = np.linalg.norm(theirs.ravel() - scale * ours) / np.linalg.norm(theirs)
        heard = np.minimum(np.abs(ours), np.abs(theirs.ravel())) > 0.05
        phase = np.angle(scale * ours * theirs.ravel().conj())[heard]
        out[name] = (float(left), float(np.median(np.abs(phase))))
    return out


def theta_of(way: np.ndarray) -> np.ndarray:
    """Return unit vectors of growing polar angle."""
    flat = np.hypot(way[..., 0], way[..., 1])
    theta = np.stack([way[..., 2] * way[..., 0] / flat, way[..., 2] * way[..., 1] / flat, -flat], axis=-1)
    return np.asarray(theta / np.linalg.norm(way, axis=-1, keepdims=True))


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--variant", choices=VARIANTS)
    parser.add_argument("--mhz", type=int)
    parser.add_argument("--sun", type=int)
    parser.add_argument("--place", choices=("front", "beside", "cal"))
    parser.add_argument("--moments", action="store_true", help="only the mirror's own plate against moments")
    given = parser.parse_args()
    if given.moments:
        for sun in (0, 1) if given.sun is None else [given.sun]:
            for name, (left, phase) in own_plate_by_moments(given.folder, sun).items():
                print(f"sun {sun}: {name:22} leaves {left:.3f} of the response, median phase off {phase:.3f} rad")
        return
    for variant in [given.variant] if given.variant else VARIANTS:
        for mhz in [given.mhz] if given.mhz else (433, 100):
            for sun in (0, 1) if given.sun is None else [given.sun]:
                for place in [given.place] if given.place else ("front", "beside", "cal"):
                    print(f"{variant}, {mhz} MHz, sun {sun}, {place}")
                    report(read(given.folder, variant, mhz, sun, place))


if __name__ == "__main__":
    main()
