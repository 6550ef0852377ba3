"""Trace the ray tables that `benchmarks/real_field.py` and `benchmarks/outdoors.py` want besides the given ones.

    python benchmarks/real_field_tables.py TABLES                     # all: an hour or two
    python benchmarks/real_field_tables.py TABLES --only 'open_2400'  # some

Needs what `scripts/trace_sionna.py` needs. A table that is there already is left alone. Receivers before and beside the
mirrors are in one table, as ``front:H01_r0`` and ``beside:H01_r0``; suns past the second are for learning patterns.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import traced

from rfpose.scenario import Scenario


def wanted() -> Iterator[tuple[str, str, float, int]]:
    """Yield what is traced, the transmitters, the radio frequency [MHz] and the sun; the most wanted first."""
    for sun in (0, 1):
        for mhz in (433.0, 100.0, 2400.0, 5800.0):
            yield "open", "10", mhz, sun
        for transmitters in ("20", "high"):
            yield "open", transmitters, 433.0, sun
        for mhz in (2400.0, 5800.0):
            for what in ("direct", "ground", "field", "edges"):
                yield what, "10", mhz, sun
    for sun in range(2, 32):
        yield "open", "10", 433.0, sun


def site_of(transmitters: str, mhz: float, sun: int) -> Scenario:
    """Return the site with receivers at both places, its materials those of the frequency."""
    rf_hz = 1e6 * mhz
    places = None if transmitters == "10" else traced.TRANSMITTERS_ENU_M[transmitters]
    site = traced.site_of(rf_hz, "beside", transmitter_enu_m=places)
    names = [(place, k) for place in traced.PLACES_M for k in range(len(traced.PLACES_M[place]))]
    heliostats = [
        h.changed(
            receiver_mirror_m=[traced.PLACES_M[place][k] for place, k in names],
            receiver_ids=[f"{place}.{h.id}_r{k}" for place, k in names],
        )
        for h in site.heliostat
    ]
    soil, concrete = traced.soil(rf_hz), traced.concrete(rf_hz)
    box = {"permittivity": concrete[0], "conductivity_s_per_m": concrete[1]}
    azimuth, elevation = traced.sun_deg(sun)
    return site.changed(
        heliostat=heliostats,
        site={"structures": {"box": [b.changed(**box) for b in site.site.structures.box]}},
        reflection={"model": "fresnel", "permittivity": soil[0], "conductivity_s_per_m": soil[1]},
        simulation={"sun_azimuth_deg": azimuth, "sun_elevation_deg": elevation, "frame_count": 1},
    )


def _tracer() -> ModuleType:
    """Return `scripts/trace_sionna.py`, which is no part of a package."""
    path = Path(__file__).resolve().parents[1] / "scripts" / "trace_sionna.py"
    spec = importlib.util.spec_from_file_location("trace_sionna", path)
    if spec is None or spec.loader is None:
        sys.exit(f"{path}: is missing")
    module = importlib.util.module_from_spec(spec)
    sys.modules["trace_sionna"] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Trace and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="tables whose name matches")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    tracer = _tracer()
    for what, transmitters, mhz, sun in wanted():
        set_of = "" if transmitters == "10" else f"-{transmitters}"
        path = options.folder / f"{what}{set_of}_{mhz:.0f}MHz_sun{sun}.npz"
        if path.exists() or re.search(options.only, path.name) is None:
            continue
        table = tracer.trace(site_of(transmitters, mhz, sun), 0, what)
        # groups of receivers are told apart by a colon, which no identifier of a scenario may hold
        table["rx_names"] = np.array([str(name).replace(".", ":", 1) for name in table["rx_names"]])
        part = path.with_suffix(".part.npz")
        np.savez_compressed(part, **table)
        part.replace(path)
        print(f"{path}: {len(table['rx'])} rays", flush=True)


if __name__ == "__main__":
    main()
