"""P5 with a robust loss: aircraft from real arrival times (LocaRDS, sets 1-4), and which of them are wrong.

Beside the five arrival times the aircraft's barometric altitude is used, as it was transmitted, as an observation of
its height above the ellipsoid with a sigma of 150 m (pressure altitude; in these data mostly 60 to 190 m too high).
The true position and the geometric altitude are used for nothing but the comparison.
"""

import csv
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from rfpose.multilat.integrity import locate_robust

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "adsb"
SPEED_IN_AIR_MPS = 299_792_458.0 / 1.000225
AXIS_M, FLATTENING = 6_378_137.0, 1.0 / 298.257223563

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the ADS-B measurements are not here")


def ecef(latitude_deg, longitude_deg, height_m):
    """WGS84 to Earth-centred coordinates [m]."""
    e2 = FLATTENING * (2.0 - FLATTENING)
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    n = AXIS_M / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (n + height_m) * np.cos(lat) * np.cos(lon),
            (n + height_m) * np.cos(lat) * np.sin(lon),
            (n * (1.0 - e2) + height_m) * np.sin(lat),
        ],
        axis=-1,
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


def z_of_altitude(east_north_m, altitude_m, origin, to_enu):
    """ENU z of points at a height above the ellipsoid, by fixed-point iteration (the ground curves away)."""
    z = np.array(altitude_m, np.float64)
    e2 = FLATTENING * (2.0 - FLATTENING)
    for _ in range(4):
        x, y, w = (np.column_stack([east_north_m, z]) @ to_enu + origin).T
        across = np.hypot(x, y)
        lat = np.arctan2(w, across * (1.0 - e2))
        for _ in range(4):
            n = AXIS_M / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
            height = across / np.cos(lat) - n
            lat = np.arctan2(w, across * (1.0 - e2 * n / (n + height)))
        z = z + altitude_m - height
    return z


def rows_by_stations():
    """Station numbers -> list of (latitude, longitude, geometric altitude, barometric altitude, ranges)."""
    groups = defaultdict(list)
    for k in (1, 2, 3, 4):
        with (DATA / f"set_{k}.csv").open() as file:
            for row in csv.DictReader(file):
                seen = sorted(json.loads(row["measurements"]))
                ranges = [(m[1] - seen[0][1]) * 1e-9 * SPEED_IN_AIR_MPS for m in seen]
                place = [float(row[key]) for key in ("latitude", "longitude", "geoAltitude", "baroAltitude")]
                groups[tuple(m[0] for m in seen)].append((*place, ranges))
    return groups


def located(spoil_m=0.0, smallest_group=1):
    """Horizontal errors, outliers (five ranges and the height), residuals at the truth, and which rows were spoilt.

    Every fifth row's second arrival is spoilt by ``spoil_m``.
    """
    with (DATA / "sensors.csv").open() as file:
        stations = {
            int(r["serial"]): (float(r["latitude"]), float(r["longitude"]), float(r["height"]))
            for r in csv.DictReader(file)
        }
    error, outlier, truth_residual, spoilt = [], [], [], []
    for serials, rows in rows_by_stations().items():
        if len(rows) < smallest_group:
            continue
        latitude, longitude, _ = np.mean([stations[s] for s in serials], axis=0)
        origin, to_enu = ecef(latitude, longitude, 0.0), rot_enu_from_ecef(latitude, longitude)
        transmitter = np.array([to_enu @ (ecef(*stations[s]) - origin) for s in serials])
        ranges = np.array([row[4] for row in rows])
        ranges[::5, 1] += spoil_m
        altitude = np.array([row[3] for row in rows])
        east_north = np.zeros((len(rows), 2))
        for _ in range(2):  # the height of the ground under the aircraft is known once the aircraft is
            fixes = locate_robust(
                transmitter,
                ranges,
                sigma_m=20.0,
                height_enu_m=z_of_altitude(east_north, altitude, origin, to_enu),
                height_sigma_m=150.0,
                side="above",
            )
            east_north = np.nan_to_num(fixes.position_enu_m[:, :2])
        truth = (ecef(*np.array([row[:3] for row in rows]).T) - origin) @ to_enu.T
        offset = fixes.position_enu_m - truth
        error.append(np.nan_to_num(np.linalg.norm(offset[:, :2], axis=1), nan=np.inf))
        outlier.append(np.column_stack([fixes.outlier, fixes.height_outlier]))
        left = ranges - np.linalg.norm(truth[:, None] - transmitter, axis=-1)
        truth_residual.append(np.abs(left - np.median(left, axis=1, keepdims=True)))
        spoilt.append(np.arange(len(rows)) % 5 == 0)
    return tuple(np.concatenate(a) for a in (error, outlier, truth_residual, spoilt))


def test_p5_the_robust_solver_beats_plain_gauss_newton():
    """Plain: median 56 m; a row without a solution counts as infinitely wrong. Most of the gain is the altitude's."""
    error, outlier, truth_residual, _ = located()
    assert len(error) == 1147
    assert np.median(error) < 50.0
    # rows in which something is named an outlier are off at the true position too
    named = outlier.any(axis=1)
    assert 0.005 < named.mean() < 0.05
    worst = truth_residual.max(axis=1)
    print(np.median(error), named.sum(), np.median(worst[named]), np.median(worst[~named]))
    assert np.median(worst[named]) > 2.5 * np.median(worst[~named])


def test_a_spoilt_arrival_is_named():
    """Three kilometres added to one arrival in five rows; five stations and a height leave just two checks."""
    error, outlier, _, spoilt = located(spoil_m=3000.0, smallest_group=15)
    assert spoilt.sum() > 100
    print(spoilt.sum(), np.mean(outlier[spoilt].any(axis=1)), np.mean(outlier[spoilt, 1]))
    assert np.mean(outlier[spoilt].any(axis=1)) > 0.95
    assert np.mean(outlier[spoilt, 1]) > 0.7
    assert np.median(error[spoilt]) < 150.0
