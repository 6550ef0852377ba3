"""Calibration records in the layout of PAINT, the public database of the Jülich solar tower.

A directory holds one folder a heliostat (``BF57/``) with its properties and a folder of calibration records, the
tower's measurements, and, if known, UTC times of the records (``timestamps.json``). Names are matched loosely, so
that both the database's own dashes and underscores do. A record holds the motor positions of both axes, the sun's
angles as the plant logged them (azimuth from south, east positive, degrees) and the centre of the focal spot in
WGS84 as found by two independent image algorithms, HeliOS and UTIS.

References
----------
PAINT, doi:10.1038/s41560-026-02070-1; https://paint-database.org.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import RecordingError
from rfpose.feedback.mount import Actuator, Mount
from rfpose.feedback.sun import Site, unix_seconds

__all__ = ["ALGORITHMS", "PaintHeliostat", "Target", "enu_from_wgs84", "heliostat_ids", "read_heliostat"]

ALGORITHMS = ("HeliOS", "UTIS")
_MOUNT_FRAME = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # columns north, up, east
_PLANE_M = 0.5
_WGS84_A, _WGS84_E2 = 6378137.0, 6.69437999014e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A plane calibration target.

    Attributes
    ----------
    centre_enu_m : (xyz)
        Its centre, site ENU [m].
    normal_enu : (xyz)
        Unit vector out of its front.
    reach_m
        From the centre to the farthest corner [m]; infinite if the corners are not told.
    """

    centre_enu_m: FloatArray
    normal_enu: FloatArray
    reach_m: float = float("inf")

    def misses(self, spot_enu_m: FloatArray) -> str | None:
        """Say how a spot cannot lie on the target, or None."""
        off = spot_enu_m - self.centre_enu_m
        distance, depth = float(np.linalg.norm(off)), abs(float(off @ self.normal_enu))
        if distance > self.reach_m:
            return (
                f"focal spot off the target: {distance:.1f} m from its centre, its corners are at {self.reach_m:.1f} m"
            )
        if depth > _PLANE_M:
            return f"focal spot off the target: {depth:.1f} m before or behind its plane"
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class PaintHeliostat:
    """One heliostat's records, in the order of time, and its mount as built.

    Attributes
    ----------
    id
        The heliostat's name.
    mount
        Its mount with nominal parameters.
    site
        Where the site frame's origin lies.
    targets
        Plane targets by name.
    record_ids : (record,)
        Numbers of the records that can be used.
    unix_s : (record,)
        Times [s since 1970 UTC]; NaN where unknown.
    count : (record, axis)
        Motor positions.
    sun_enu : (record, xyz)
        Directions towards the sun, as the plant logged them.
    sun_azimuth_rad, sun_elevation_rad : (record,)
        The same as angles, azimuth from north, clockwise [rad].
    spot_enu_m : (record, xyz)
        Centre of the focal spot, mean of the algorithms [m].
    disagreement_m : (record,)
        Distance of the two algorithms' centres [m].
    target : (record,)
        Name of the target.
    skipped
        Why records were left out, by record number.
    """

    id: str
    mount: Mount
    site: Site
    targets: Mapping[str, Target]
    record_ids: npt.NDArray[np.int64]
    unix_s: FloatArray
    count: FloatArray
    sun_enu: FloatArray
    sun_azimuth_rad: FloatArray
    sun_elevation_rad: FloatArray
    spot_enu_m: FloatArray
    disagreement_m: FloatArray
    target: tuple[str, ...]
    skipped: Mapping[str, str]


def enu_from_wgs84(latitude_longitude_height: npt.ArrayLike, origin: npt.ArrayLike) -> FloatArray:
    """Return positions in the ENU frame about an origin, by way of ECEF.

    Parameters
    ----------
    latitude_longitude_height : (..., 3)
        WGS84 [deg, deg, m].
    origin : (3,)
        The same, of the site frame's origin.

    Returns
    -------
    (..., xyz)
        Site ENU [m].
    """
    start = np.asarray(origin, np.float64)
    difference = _ecef(np.asarray(latitude_longitude_height, np.float64)) - _ecef(start)
    latitude, longitude = np.radians(start[:2])
    s, c, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    enu_from_ecef = np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    return np.asarray(difference @ enu_from_ecef.T)


def _ecef(position: FloatArray) -> FloatArray:
    latitude, longitude, height = np.radians(position[..., 0]), np.radians(position[..., 1]), position[..., 2]
    prime = _WGS84_A / np.sqrt(1.0 - _WGS84_E2 * np.sin(latitude) ** 2)
    across = (prime + height) * np.cos(latitude)
    return np.stack(
        [
            across * np.cos(longitude),
            across * np.sin(longitude),
            (prime * (1.0 - _WGS84_E2) + height) * np.sin(latitude),
        ],
        axis=-1,
    )


def heliostat_ids(directory: Path) -> tuple[str, ...]:
    """Return the names of the heliostats that have calibration records in a PAINT directory.

    Raises
    ------
    RecordingError
        The directory does not exist or holds none.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise RecordingError(f"{directory}: no such directory; give the folder that holds the heliostats' folders")
    found = tuple(sorted(item.name for item in directory.iterdir() if item.is_dir() and _record_files(item)))
    if not found:
        raise RecordingError(
            f"{directory}: no heliostat folder with calibration records (ID/calibration/*_calibration_properties.json)"
        )
    return found


def read_heliostat(directory: Path, heliostat: str, *, algorithm: str = "both") -> PaintHeliostat:
    """Read one heliostat of a PAINT directory.

    Parameters
    ----------
    directory
        Folder with the heliostats' folders and the tower's measurements.
    heliostat
        Name such as ``"BF57"``.
    algorithm
        ``"both"``: mean of HeliOS and UTIS, records with one of them are left out; or one of the two by name.

    Raises
    ------
    RecordingError
        A file is missing, is no JSON, or lacks a key; the message names it.
    """
    directory = Path(directory)
    if algorithm != "both" and algorithm not in ALGORITHMS:
        raise RecordingError(f"{directory}: no algorithm {algorithm!r}; known are both, {', '.join(ALGORITHMS)}")
    folder = directory / heliostat
    files = _record_files(folder)
    if not files:
        raise RecordingError(
            f"{folder}: no calibration records; known heliostats: {', '.join(heliostat_ids(directory))}"
        )
    tower_path = _one_file(directory, r"tower.measurements\.json$", "the tower's measurements")
    tower = _read_json(tower_path)
    origin = _key(tower, tower_path, "power_plant_properties", "coordinates")
    path = _one_file(folder, rf"{re.escape(heliostat)}.*properties\.json$", "the heliostat's properties")
    mount = _mount(_read_json(path), path, origin)
    times, targets = _times(directory, heliostat), _targets(tower, origin)
    wanted = ALGORITHMS if algorithm == "both" else (algorithm,)
    rows: list[tuple[float, int, list[float], list[float], FloatArray, float, str]] = []
    skipped: dict[str, str] = {}
    for number, file in files.items():
        record = _read_json(file)
        reason = _unusable(record, wanted)
        if reason is not None:
            skipped[str(number)] = reason
            continue
        motors = _key(record, file, "motor_position")
        spots = enu_from_wgs84([record["focal_spot"][name] for name in wanted], origin)
        target = targets.get(str(record.get("target_name", "")))
        reason = target.misses(spots.mean(axis=0)) if target else None
        if reason is not None:
            skipped[str(number)] = reason
            continue
        rows.append(
            (
                times.get(number, np.nan),
                number,
                [_number(_key(motors, file, f"axis_{a}_motor_position"), file) for a in (1, 2)],
                [_number(_key(record, file, f"sun_{name}"), file) for name in ("azimuth", "elevation")],
                spots.mean(axis=0),
                float(np.linalg.norm(spots[0] - spots[-1])),
                str(record.get("target_name", "")),
            )
        )
    if not rows:
        raise RecordingError(f"{folder}: none of {len(files)} records can be used: {next(iter(skipped.values()))}")
    rows.sort(key=lambda row: row[1])  # numbers are given in the order of time; not every record has one
    degrees = np.array([row[3] for row in rows])
    azimuth, elevation = np.mod(np.pi - np.radians(degrees[:, 0]), 2.0 * np.pi), np.radians(degrees[:, 1])
    return PaintHeliostat(
        id=heliostat,
        mount=mount,
        site=Site(
            latitude_rad=float(np.radians(origin[0])),
            longitude_rad=float(np.radians(origin[1])),
            altitude_m=float(origin[2]),
        ),
        targets=targets,
        record_ids=np.array([row[1] for row in rows], np.int64),
        unix_s=np.array([row[0] for row in rows]),
        count=np.array([row[2] for row in rows]),
        sun_enu=geometry.enu_from_azimuth_elevation(azimuth, elevation),
        sun_azimuth_rad=azimuth,
        sun_elevation_rad=elevation,
        spot_enu_m=np.array([row[4] for row in rows]),
        disagreement_m=np.array([row[5] for row in rows]) if len(wanted) > 1 else np.full(len(rows), np.nan),
        target=tuple(row[6] for row in rows),
        skipped=skipped,
    )


def _record_files(folder: Path) -> dict[int, Path]:
    """Calibration records of a heliostat by number."""
    found = {}
    for path in folder.glob("[Cc]alibration/*.json"):
        match = re.fullmatch(r"(\d+).calibration.properties\.json", path.name)
        if match:
            found[int(match[1])] = path
    return dict(sorted(found.items()))


def _one_file(folder: Path, pattern: str, what: str) -> Path:
    """Find the file below ``folder`` whose name ends as the pattern says."""
    paths = sorted(p for p in folder.rglob("*.json") if re.search(pattern, p.name) and "alibration" not in p.name)
    if not paths:
        raise RecordingError(f"{folder}: no file for {what} (name like {pattern!r})")
    return paths[0]


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: is not JSON: {error}; fetch it again") from error
    if not isinstance(content, dict):
        raise RecordingError(f"{path}: must hold one JSON object, got a {type(content).__name__}")
    return content


def _key(content: Any, path: Path, *keys: str) -> Any:
    """Follow keys into nested objects; a missing one is named."""
    for key in keys:
        if not isinstance(content, dict) or key not in content:
            raise RecordingError(f"{path}: has no {'.'.join(keys)!r} (missing {key!r})")
        content = content[key]
    return content


def _number(value: Any, path: Path) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}: a number was expected, got {value!r:.40}") from error
    if not np.isfinite(number):
        raise RecordingError(f"{path}: a finite number was expected, got {value!r:.40}")
    return number


def _unusable(record: Mapping[str, Any], wanted: tuple[str, ...]) -> str | None:
    """Why a record cannot be used, or None."""
    spots = record.get("focal_spot")
    if not isinstance(spots, dict) or not spots:
        return "no focal spot"
    for name in wanted:
        spot = spots.get(name)
        if not (isinstance(spot, list) and len(spot) == 3 and all(isinstance(x, int | float) for x in spot)):
            return f"no focal spot from {name} (has {', '.join(spots)})"
    if float(record.get("sun_elevation", 90.0)) <= 0.0:
        return "sun below the horizon"
    return None


def _times(directory: Path, heliostat: str) -> dict[int, float]:
    """UTC times by record number; empty where there is no file."""
    path = directory / "timestamps.json"
    if not path.is_file():
        return {}
    table = _read_json(path)
    keys = [key for key in table if key.startswith(f"{heliostat}_")]
    return {
        int(key.rsplit("_", 1)[1]): float(t)
        for key, t in zip(keys, unix_seconds([table[k] for k in keys]), strict=True)
    }


def _targets(tower: Mapping[str, Any], origin: Any) -> dict[str, Target]:
    """Plane targets of the tower."""
    return {
        name: Target(
            centre_enu_m=enu_from_wgs84(entry["coordinates"]["center"], origin),
            normal_enu=geometry.unit(entry["normal_vector"]),
            reach_m=_reach_m(entry["coordinates"], origin),
        )
        for name, entry in tower.items()
        if isinstance(entry, dict) and entry.get("type") == "planar"
    }


def _reach_m(coordinates: Mapping[str, Any], origin: Any) -> float:
    """Distance from a target's centre to its farthest corner."""
    corners = [place for name, place in coordinates.items() if name != "center"]
    if not corners:
        return float("inf")
    off = enu_from_wgs84(corners, origin) - enu_from_wgs84(coordinates["center"], origin)
    return float(np.linalg.norm(off, axis=-1).max())


def _mount(properties: Mapping[str, Any], path: Path, origin: Any) -> Mount:
    """Mount of a heliostat whose axis 1 lies east-west and whose axis 2 lies in the mirror's plane."""
    content = dict(properties)
    kinematics = _key(content, path, "kinematics_properties")
    entries = _key(kinematics, path, "actuators")
    if len(entries) != 2:
        raise RecordingError(f"{path}: two actuators were expected, got {len(entries)}")
    return Mount(
        pivot_enu_m=enu_from_wgs84(_key(content, path, "heliostat_position"), origin),
        rot_enu_from_mount=_MOUNT_FRAME,
        # axis 1 lowers the normal towards south as it opens; axis 2 turns it about the mirror's own upright
        actuators=(_actuator(entries[0], path, -1), _actuator(entries[1], path, 1)),
        parameters={"arm_normal_m": _number(_key(kinematics, path, "concentrator_translation_n"), path)},
    )


def _actuator(entry: Any, path: Path, direction: int) -> Actuator:
    def value(name: str) -> float:
        return _number(_key(entry, path, name), path)

    kind = _key(entry, path, "type_axis")
    if kind != "linear":
        raise RecordingError(f"{path}: only linear actuators are known in this layout, got {kind!r}")
    turning = -1 if value("clockwise_axis_movement") else 1
    return Actuator(
        kind="linear",
        counts_per_unit=value("increment"),
        sign=direction * turning,
        angle_at_zero_rad=direction * value("initial_angle"),
        stroke_m=value("initial_stroke_length"),
        radius_m=value("pivot_radius"),
        offset_m=value("offset"),
        limits_count=(value("min_increment"), value("max_increment")),
    )
