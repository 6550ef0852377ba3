"""P5: aircraft located from real arrival times at five ground stations (LocaRDS, sets 1-4)."""

import csv
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from rfpose.multilat import locate

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "adsb"
SPEED_IN_AIR_MPS = 299_792_458.0 / 1.000225

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the ADS-B measurements are not here")


def ecef(latitude_deg, longitude_deg, height_m):
    """WGS84 to Earth-centred coordinates [m]."""
    a, f = 6_378_137.0, 1.0 / 298.257223563
    e2 = f * (2.0 - f)
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    n = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    return np.array(
        [
            (n + height_m) * np.cos(lat) * np.cos(lon),
            (n + height_m) * np.cos(lat) * np.sin(lon),
            (n * (1.0 - e2) + height_m) * np.sin(lat),
        ]
    )


def rot_enu_from_ecef(latitude_deg, longitude_deg):
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )


def rows_by_stations():
    """Station numbers -> list of (truth latitude, longitude, height, ranges)."""
    groups = defaultdict(list)
    for k in (1, 2, 3, 4):
        with (DATA / f"set_{k}.csv").open() as file:
            for row in csv.DictReader(file):
                seen = sorted(json.loads(row["measurements"]))
                start = seen[0][1]
                ranges = [(m[1] - start) * 1e-9 * SPEED_IN_AIR_MPS for m in seen]
                place = [float(row[key]) for key in ("latitude", "longitude", "geoAltitude")]
                groups[tuple(m[0] for m in seen)].append((*place, ranges))
    return groups


def test_p5_plain_gauss_newton_from_a_cold_start():
    """Median 56 m horizontal, 315 m in 3-D; a row without a solution counts as infinitely wrong (+10 %)."""
    with (DATA / "sensors.csv").open() as file:
        stations = {
            int(r["serial"]): (float(r["latitude"]), float(r["longitude"]), float(r["height"]))
            for r in csv.DictReader(file)
        }
    horizontal, total = [], []
    for serials, rows in rows_by_stations().items():
        latitude, longitude, _ = np.mean([stations[s] for s in serials], axis=0)
        origin, to_enu = ecef(latitude, longitude, 0.0), rot_enu_from_ecef(latitude, longitude)
        transmitter = np.array([to_enu @ (ecef(*stations[s]) - origin) for s in serials])
        fixes = locate(
            transmitter,
            [row[3] for row in rows],
            sigma_m=50.0,
            side="above",
            max_dop=np.inf,
            min_probability=0.0,
        )
        for row, position in zip(rows, fixes.position_enu_m, strict=True):
            offset = position @ to_enu + origin - ecef(*row[:3])
            east_north = (rot_enu_from_ecef(*row[:2]) @ offset)[:2]
            horizontal.append(np.nan_to_num(np.linalg.norm(east_north), nan=np.inf))
            total.append(np.nan_to_num(np.linalg.norm(offset), nan=np.inf))
    assert len(total) == 1147
    assert np.mean(np.isinf(total)) < 0.04
    assert np.median(horizontal) < 1.1 * 56.0
    assert np.median(total) < 1.1 * 315.0
    solved = np.isfinite(total)
    print(np.median(horizontal), np.median(total), np.median(np.array(total)[solved]))
