"""Print the time that rays of 10 000 heliostats, ten transmitters, three receivers each take to foresee.

python benchmarks/bench_propagation.py [--mirrors 10000]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from rfpose.geometry import enu_from_azimuth_elevation
from rfpose.layout.fields import radial_staggered
from rfpose.layout.maps import mirrors_facing
from rfpose.propagation import BoxesStanding, Foresight, PlatesStanding, ReceiverStand, Soil, Surroundings, foresee

PLACES = np.array([[1.6, 0.0, 0.05], [-1.6, 1.35, 0.05], [-1.6, -1.35, 0.05]])
STEPS = {
    "direct and visibility": Foresight(ground=False, specular=False, own_plate=False, diffracted="none"),
    "and ground": Foresight(specular=False, own_plate=False, diffracted="none"),
    "and specular, plates within 8 m": Foresight(own_plate=False, diffracted="none", reach_m=8.0),
    "and own plate": Foresight(diffracted="none", reach_m=8.0),
    "and edges of boxes": Foresight(diffracted="boxes", reach_m=8.0),
    "all edges": Foresight(reach_m=8.0),
    "all edges, plates within 15 m": Foresight(reach_m=15.0),
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mirrors", type=int, default=10_000)
    n = parser.parse_args().mirrors
    pivot = radial_staggered(n, first_radius_m=40.0, diagonal_m=4.5, height_m=2.5)
    reach = float(np.hypot(pivot[:, 0], pivot[:, 1]).max())
    angle = 2.0 * np.pi * np.arange(9) / 9
    ring = np.stack([reach * np.cos(angle), reach * np.sin(angle), 20.0 + 10.0 * (np.arange(9) % 2)], axis=1)
    transmitter = np.vstack([ring, [0.0, 0.0, 90.0]])
    sun = enu_from_azimuth_elevation(np.radians(150.0), np.radians(45.0))
    mirrors = mirrors_facing(pivot, PLACES, aim_enu_m=[0.0, 0.0, 75.0], sun_enu=sun)
    plates = PlatesStanding(
        centre_enu_m=pivot, rot_enu_from_mirror=mirrors.rot_enu_from_mirror, size_m=np.tile([3.0, 2.5], (n, 1))
    )
    tower = BoxesStanding(
        base_enu_m=np.zeros((1, 3)), size_m=np.array([[8.0, 8.0, 80.0]]), azimuth_rad=np.zeros(1),
        permittivity=np.array([5.24]), conductivity_s_per_m=np.array([0.02]),
    )  # fmt: skip
    things = Surroundings(plates=plates, boxes=tower, soil=Soil(permittivity=15.0, conductivity_s_per_m=0.01))
    stand = ReceiverStand(
        pivot_enu_m=pivot, rot_enu_from_mirror=mirrors.rot_enu_from_mirror,
        receiver_mirror_m=np.broadcast_to(PLACES, (n, *PLACES.shape)), own_plate=np.arange(n),
    )  # fmt: skip
    carrier = np.full(len(transmitter), 433e6)
    foresee(transmitter, carrier, stand, things, Foresight(reach_m=0.0))  # compiles
    print(f"{n} heliostats of 3.0 m x 2.5 m, {len(PLACES)} receivers, {len(transmitter)} transmitters, 433 MHz")
    for name, options in STEPS.items():
        start, worked = time.perf_counter(), time.process_time()
        rays = foresee(transmitter, carrier, stand, things, options)
        took, worked = time.perf_counter() - start, time.process_time() - worked
        per_link = rays.n_ray / (len(rays.first) - 1)
        print(f"{name:32} {took:6.2f} s ({worked:6.2f} s of all cores), {per_link:5.2f} rays a link")


if __name__ == "__main__":
    main()
