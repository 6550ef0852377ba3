"""Aircraft heard by known ground stations: LocaRDS sets 1 to 4, as they lie in the shared data."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "adsb"
SPEED_IN_AIR_MPS = 299_792_458.0 / 1.000225
AXIS_M, FLATTENING = 6_378_137.0, 1.0 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)


class Group(NamedTuple):
    """What one set of stations heard, in the ENU frame below their mean place."""

    station_enu_m: np.ndarray
    range_m: np.ndarray
    """(aircraft, station), up to one constant an aircraft."""
    true_enu_m: np.ndarray
    up_enu: np.ndarray
    """(aircraft, xyz) the vertical at the aircraft, a degree or so off that of the frame."""
    barometric_m: np.ndarray
    origin_m: np.ndarray
    rot_enu_from_ecef: np.ndarray

    def horizontal_error_m(self, position_enu_m: np.ndarray) -> np.ndarray:
        """(aircraft,) distance from the truth across the aircraft's vertical; without a position, infinite."""
        offset = position_enu_m - self.true_enu_m
        across = offset - np.sum(offset * self.up_enu, axis=1, keepdims=True) * self.up_enu
        return np.nan_to_num(np.linalg.norm(across, axis=1), nan=np.inf)

    def error_m(self, position_enu_m: np.ndarray) -> np.ndarray:
        """(aircraft,) distance from the truth; without a position, infinite."""
        return np.nan_to_num(np.linalg.norm(position_enu_m - self.true_enu_m, axis=1), nan=np.inf)


def ecef(latitude_deg: Any, longitude_deg: Any, height_m: Any) -> np.ndarray:
    """WGS84 to Earth-centred coordinates [m]."""
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    n = AXIS_M / np.sqrt(1.0 - ECCENTRICITY_2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (n + height_m) * np.cos(lat) * np.cos(lon),
            (n + height_m) * np.cos(lat) * np.sin(lon),
            (n * (1.0 - ECCENTRICITY_2) + height_m) * np.sin(lat),
        ],
        axis=-1,
    )


def rot_enu_from_ecef(latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """Rows are east, north and up at a place."""
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )


def groups() -> list[Group]:
    """Every set of stations that heard an aircraft."""
    with (DATA / "sensors.csv").open() as file:
        stations = {
            int(r["serial"]): (float(r["latitude"]), float(r["longitude"]), float(r["height"]))
            for r in csv.DictReader(file)
        }
    rows = defaultdict(list)
    for k in (1, 2, 3, 4):
        with (DATA / f"set_{k}.csv").open() as file:
            for row in csv.DictReader(file):
                heard = sorted(json.loads(row["measurements"]))
                ranges = [(m[1] - heard[0][1]) * 1e-9 * SPEED_IN_AIR_MPS for m in heard]
                place = [float(row[key]) for key in ("latitude", "longitude", "geoAltitude", "baroAltitude")]
                rows[tuple(m[0] for m in heard)].append((*place, ranges))
    return [_group([stations[s] for s in serials], found) for serials, found in rows.items()]


def _group(stations: list[tuple[float, float, float]], rows: list[Any]) -> Group:
    latitude, longitude, _ = np.mean(stations, axis=0)
    origin, to_enu = ecef(latitude, longitude, 0.0), rot_enu_from_ecef(latitude, longitude)
    place = np.array([row[:3] for row in rows])
    lat, lon = np.radians(place[:, 0]), np.radians(place[:, 1])
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    return Group(
        station_enu_m=(ecef(*np.array(stations).T) - origin) @ to_enu.T,
        range_m=np.array([row[4] for row in rows]),
        true_enu_m=(ecef(*place.T) - origin) @ to_enu.T,
        up_enu=up @ to_enu.T,
        barometric_m=np.array([row[3] for row in rows]),
        origin_m=origin,
        rot_enu_from_ecef=to_enu,
    )


def z_of_altitude(east_north_m: np.ndarray, altitude_m: np.ndarray, group: Group) -> np.ndarray:
    """ENU z of points at a height above the ellipsoid, by fixed-point iteration (the ground curves away)."""
    z = np.array(altitude_m, np.float64)
    for _ in range(4):
        x, y, w = (np.column_stack([east_north_m, z]) @ group.rot_enu_from_ecef + group.origin_m).T
        across = np.hypot(x, y)
        lat = np.arctan2(w, across * (1.0 - ECCENTRICITY_2))
        for _ in range(4):
            n = AXIS_M / np.sqrt(1.0 - ECCENTRICITY_2 * np.sin(lat) ** 2)
            height = across / np.cos(lat) - n
            lat = np.arctan2(w, across * (1.0 - ECCENTRICITY_2 * n / (n + height)))
        z = z + altitude_m - height
    return z
