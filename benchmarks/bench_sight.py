"""Print the time that line of sight of 10 000 heliostats, ten transmitters, three receivers each takes an instant.

python benchmarks/bench_sight.py [--instants 50]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from rfpose.geometry import enu_from_azimuth_elevation
from rfpose.layout.fields import radial_staggered
from rfpose.layout.maps import mirrors_facing
from rfpose.layout.sight import Plates, Tower, visible

PLACES = np.array([[1.0, 0.0, 0.05], [-0.5, 0.9, 0.05], [-0.5, -0.9, 0.05]])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--instants", type=int, default=50)
    instants = parser.parse_args().instants
    pivot = radial_staggered(10_000, first_radius_m=40.0, diagonal_m=4.5, height_m=2.5)
    reach = float(np.hypot(pivot[:, 0], pivot[:, 1]).max())
    angle = 2.0 * np.pi * np.arange(9) / 9
    ring = np.stack([reach * np.cos(angle), reach * np.sin(angle), 20.0 + 10.0 * (np.arange(9) % 2)], axis=1)
    transmitter = np.vstack([ring, [0.0, 0.0, 90.0]])
    plates, tower = Plates(width_m=3.0, height_m=2.5), Tower(radius_m=5.0, top_m=80.0)
    took, seen = 0.0, []
    for k in range(instants + 1):
        day = max(k - 1, 0) / max(instants - 1, 1)
        sun = enu_from_azimuth_elevation(np.radians(70.0 + 220.0 * day), np.radians(8.0 + 60.0 * np.sin(np.pi * day)))
        mirrors = mirrors_facing(pivot, PLACES, aim_enu_m=[0.0, 0.0, 75.0], sun_enu=sun)
        start = time.perf_counter()
        found = visible(transmitter, mirrors, plates, tower=tower)
        if k:  # the first compiles
            took += time.perf_counter() - start
            seen.append(found.sum(axis=2))
    count = np.array(seen)
    print(f"field radius {reach:.0f} m, {instants} instants: {took:.1f} s")
    print(
        f"transmitters seen by a receiver: mean {count.mean():.2f}; fewer than five: {100 * (count < 5).mean():.2f} %"
    )


if __name__ == "__main__":
    main()
