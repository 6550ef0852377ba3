"""Calibration records in the layout of PAINT, the public database of the Jülich solar tower.

A directory holds one folder a heliostat (``BF57/``) with its properties and its calibration records, and the tower's
measurements. Names are matched loosely, so that both the database's own dashes and underscores do. UTC times come from
``timestamps.json`` or from the STAC items that lie beside the records. A record holds the motor positions of both axes,
the sun's angles as the plant logged them (azimuth from south, east positive, degrees) and the centre of the focal spot
in WGS84 as found by two independent image algorithms, HeliOS and UTIS. The elevation is that of the refracted sun, as
a mirror sees it: nothing is added to it.

References
----------
PAINT, doi:10.1038/s41560-026-02070-1; https://paint-database.org.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.feedback.mount import Actuator, Mount
from rfpose.geometry import enu_from_wgs84
from rfpose.paint import heliostat_place, key_of, origin_of, place_of, properties_of, read_object
from rfpose.sun import Location, unix_seconds

__all__ = ["ALGORITHMS", "CHOICES", "PaintHeliostat", "PaintTarget", "heliostat_ids", "read_heliostat"]

ALGORITHMS = ("HeliOS", "UTIS")
CHOICES = ("both", "any", *ALGORITHMS)
_MOUNT_FRAME = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # columns north, up, east
_FACING = [0.0, -1.0, 0.0]
_RECORD = re.compile(r"(\d{1,15}).calibration.properties\.json")
_STAC_ITEM = re.compile(r"(\d{1,15}).calibration.item(?:.stac)?\.json")
_MOTORS = ("axis_1_motor_position", "axis_2_motor_position")
# PAINT's n is along the mirror's normal
_ARMS = {
    "arm_right_m": "concentrator_translation_e",
    "arm_normal_m": "concentrator_translation_n",
    "arm_up_m": "concentrator_translation_u",
}
_NO_PLACE = tuple(f"joint_translation_{axis}_{joint}" for joint in (1, 2) for axis in "enu")
_PLANE_M = 0.5
_FARTHEST_M = 1e5


@dataclass(frozen=True, slots=True, kw_only=True)
class PaintTarget:
    """A plane calibration target.

    Attributes
    ----------
    centre_enu_m : (xyz)
        Its centre, site ENU [m].
    normal_enu : (xyz)
        Unit vector out of its front, square to the plane of its corners.
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
        Distance of the two algorithms' centres [m]; NaN with one of them.
    target : (record,)
        Name of the target.
    skipped
        Why records were left out, by record number.
    notes
        Times that could not be read.
    """

    id: str
    mount: Mount
    site: Location
    targets: Mapping[str, PaintTarget]
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
    notes: tuple[str, ...] = ()

    @property
    def order_s(self) -> FloatArray:
        """Times, unknown ones between their neighbours' by number; the numbers themselves if fewer than two are known.

        (record,)
        """
        known = np.isfinite(self.unix_s)
        number = self.record_ids.astype(np.float64)
        if known.sum() < 2:
            return number
        return np.where(known, self.unix_s, np.interp(number, number[known], self.unix_s[known]))


def heliostat_ids(directory: Path) -> tuple[str, ...]:
    """Return the names of the heliostats that have calibration records in a PAINT directory.

    Raises
    ------
    RecordingError
        The directory does not exist or holds none.
    """
    directory = Path(directory)
    try:
        folders = [item for item in directory.iterdir() if item.is_dir()]
    except OSError as error:
        raise RecordingError(
            f"{directory}: cannot be read as a directory ({error.strerror}); give the folder that holds the "
            "heliostats' folders"
        ) from error
    found = tuple(sorted(item.name for item in folders if _numbered(item, _RECORD)))
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
        ``"both"``: mean of HeliOS and UTIS, records with one of them are left out. ``"any"``: mean of those there
        are. Or one of the two by name.

    Raises
    ------
    RecordingError
        The tower's or the heliostat's file is missing, is no JSON, or has a key that is missing or cannot be used;
        or no record can be used. The message names file and key.

    Notes
    -----
    A record that cannot be used is left out, with its reason in ``skipped``. A time that cannot be read is NaN.
    """
    directory = Path(directory)
    if algorithm not in CHOICES:
        raise InvalidInputError(f"no algorithm is called {algorithm!r}; known are {', '.join(CHOICES)}")
    folder = directory / heliostat
    files = _numbered(folder, _RECORD)
    if not files:
        raise RecordingError(
            f"{folder}: no calibration records; known heliostats: {', '.join(heliostat_ids(directory))}"
        )
    origin, tower, tower_path = origin_of(directory)
    targets = _targets(tower, tower_path, origin)
    mount = _mount(*properties_of(folder), origin)
    rows: list[_Record] = []
    skipped: dict[str, str] = {}
    for number, file in files.items():
        try:
            rows.append(_record(number, file, targets, origin, algorithm))
        except (RecordingError, InvalidInputError) as error:
            skipped[str(number)] = str(error)
    if not rows:
        raise RecordingError(
            f"{folder}: none of {len(files)} records can be used, the first since: {next(iter(skipped.values()))}"
        )
    rows.sort(key=lambda row: row.number)  # numbers are given in the order of time; not every record has one
    degrees = np.array([row.sun_deg for row in rows])
    azimuth, elevation = np.mod(np.pi - np.radians(degrees[:, 0]), 2.0 * np.pi), np.radians(degrees[:, 1])
    times, bad_times = _times(directory, heliostat, [row.number for row in rows])
    return PaintHeliostat(
        id=heliostat,
        mount=mount,
        site=Location(
            latitude_rad=float(np.radians(origin[0])),
            longitude_rad=float(np.radians(origin[1])),
            altitude_m=float(origin[2]),
        ),
        targets=targets,
        record_ids=np.array([row.number for row in rows], np.int64),
        unix_s=times,
        count=np.array([row.count for row in rows]),
        sun_enu=geometry.enu_from_azimuth_elevation(azimuth, elevation),
        sun_azimuth_rad=azimuth,
        sun_elevation_rad=elevation,
        spot_enu_m=np.array([row.spot_enu_m for row in rows]),
        disagreement_m=np.array([row.disagreement_m for row in rows]),
        target=tuple(row.target for row in rows),
        skipped=skipped,
        notes=bad_times,
    )


@dataclass(frozen=True, slots=True)
class _Record:
    """What one record's file says."""

    number: int
    count: list[float]
    sun_deg: list[float]
    spot_enu_m: FloatArray
    disagreement_m: float
    target: str


def _record(number: int, file: Path, targets: Mapping[str, PaintTarget], origin: FloatArray, algorithm: str) -> _Record:
    """Read a record, or say why it cannot be used."""
    record = read_object(file)
    spots = enu_from_wgs84([place_of(*spot) for spot in _spots(record, file, algorithm)], origin)
    motors = key_of(record, file, "motor_position")
    count = [_number(key_of(motors, file, name), file, f"motor_position.{name}") for name in _MOTORS]
    sun = [_number(key_of(record, file, name), file, name) for name in ("sun_azimuth", "sun_elevation")]
    if not 0.0 < sun[1] <= 90.0:
        where = "below the horizon" if sun[1] <= 0.0 else "beyond the zenith"
        raise RecordingError(f"{file}: sun {where} (sun_elevation {sun[1]:g} degrees); records need the sun in the sky")
    if abs(sun[0]) > 360.0:
        raise RecordingError(f"{file}: sun_azimuth must be degrees within ±360, got {sun[0]:g}")
    name = str(record.get("target_name", ""))
    middle = spots.mean(axis=0)
    reason = targets[name].misses(middle) if name in targets else None
    if reason is not None:
        raise RecordingError(f"{file}: {reason}")
    if not np.linalg.norm(middle) < _FARTHEST_M:
        raise RecordingError(f"{file}: focal spot {np.linalg.norm(middle) / 1e3:.0f} km from the plant")
    apart = float(np.linalg.norm(spots[0] - spots[-1])) if len(spots) > 1 else float("nan")
    return _Record(number, count, sun, middle, apart, name)


def _spots(record: Mapping[str, Any], file: Path, algorithm: str) -> list[tuple[Any, str]]:
    """Focal spots of the wanted algorithms, each with the words that name its place."""
    spots = record.get("focal_spot")
    if not isinstance(spots, dict) or not any(spots.get(name) for name in ALGORITHMS):
        raise RecordingError(f"{file}: no focal spot; measure again")
    wanted: tuple[str, ...] = ALGORITHMS if algorithm == "both" else (algorithm,)
    if algorithm == "any":
        wanted = tuple(name for name in ALGORITHMS if spots.get(name))
    for name in wanted:
        if not spots.get(name):
            has = ", ".join(found for found in ALGORITHMS if spots.get(found))
            raise RecordingError(f"{file}: no focal spot from {name} (has {has}); algorithm any takes what there is")
    return [(spots[name], f"{file}: focal_spot.{name}") for name in wanted]


def _numbered(folder: Path, pattern: re.Pattern[str]) -> dict[int, Path]:
    """Files of a heliostat whose names begin with a record's number, by that number."""
    found = {}
    for path in sorted([*folder.glob("*.json"), *folder.glob("[Cc]alibration/*.json")]):
        match = pattern.fullmatch(path.name)
        if match:
            found[int(match[1])] = path
    return dict(sorted(found.items()))


def _number(value: Any, path: Path, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise RecordingError(f"{path}: {key}: a number was expected, got {value!r:.40}; correct it")
    return float(value)


def _times(directory: Path, heliostat: str, numbers: Sequence[int]) -> tuple[FloatArray, tuple[str, ...]]:
    """UTC times of records, NaN where unknown, and what could not be read of them."""
    path = directory / "timestamps.json"
    stated: dict[int, tuple[Any, str]] = {}
    if path.exists():
        table = read_object(path)
        stated = {
            n: (table[f"{heliostat}_{n}"], f"{path}: {heliostat}_{n}") for n in numbers if f"{heliostat}_{n}" in table
        }
    items = _numbered(directory / heliostat, _STAC_ITEM)
    notes, seconds = [], np.full(len(numbers), np.nan)
    for i, number in enumerate(numbers):
        try:
            if number in stated:
                text, where = stated[number]
            elif number in items:
                where = f"{items[number]}: properties.datetime"
                text = key_of(
                    key_of(read_object(items[number]), items[number], "properties"), items[number], "datetime"
                )
            else:
                continue
            seconds[i] = _moment(text, where)
        except RecordingError as error:
            notes.append(f"{error}; record {number} goes by its number alone")
    return seconds, tuple(notes)


def _moment(text: Any, where: str) -> float:
    if not isinstance(text, str):
        raise RecordingError(f"{where}: a time such as 2024-02-01T10:09:37Z was expected, got {text!r:.40}")
    try:
        return float(unix_seconds([text])[0])
    except InvalidInputError as error:
        raise RecordingError(f"{where}: {error}") from error


def _targets(tower: Mapping[str, Any], path: Path, origin: FloatArray) -> dict[str, PaintTarget]:
    """Plane targets of the tower."""
    return {
        name: _target(entry, path, name, origin)
        for name, entry in tower.items()
        if isinstance(entry, dict) and entry.get("type") == "planar"
    }


def _target(entry: Mapping[str, Any], path: Path, name: str, origin: FloatArray) -> PaintTarget:
    """Plane through a target's corners; ``normal_vector`` only says which side is its front.

    PAINT's is grid north for every target, 2.8 to 5.5 mrad off the plane of the corners.
    """
    coordinates = key_of(entry, path, "coordinates")
    if not isinstance(coordinates, dict) or "center" not in coordinates:
        raise RecordingError(f"{path}: {name}.coordinates has no 'center'; fetch it again")
    places = {key: place_of(value, f"{path}: {name}.coordinates.{key}") for key, value in coordinates.items()}
    centre = enu_from_wgs84(places.pop("center"), origin)
    front = key_of(entry, path, "normal_vector")
    if not isinstance(front, list) or len(front) != 3 or not all(isinstance(x, int | float) for x in front):
        raise RecordingError(f"{path}: {name}.normal_vector: [east, north, up] was expected, got {front!r:.40}")
    normal = geometry.unit(front)
    if not np.isfinite(normal).all():
        raise RecordingError(f"{path}: {name}.normal_vector: must have a direction, got {front!r:.40}")
    if not places:
        return PaintTarget(centre_enu_m=centre, normal_enu=normal)
    corners = enu_from_wgs84(list(places.values()), origin)
    _, size, axes = np.linalg.svd(corners - corners.mean(axis=0))
    if len(corners) > 2 and size[1] > 0.1:  # metres: corners in a line span no plane
        normal = axes[2] * (1.0 if axes[2] @ normal > 0.0 else -1.0)
    return PaintTarget(
        centre_enu_m=centre, normal_enu=normal, reach_m=float(np.linalg.norm(corners - centre, axis=-1).max())
    )


def _mount(properties: dict[str, Any], path: Path, origin: FloatArray) -> Mount:
    """Mount of a heliostat whose axis 1 lies east-west and whose axis 2 lies in the mirror's plane."""
    kinematics = key_of(properties, path, "kinematics_properties")
    entries = key_of(kinematics, path, "actuators")
    if not isinstance(entries, list) or len(entries) != 2:
        raise RecordingError(f"{path}: kinematics_properties.actuators: two were expected, got {entries!r:.40}")
    _refuse_other_geometry(properties, kinematics, path)
    arms = {
        parameter: _number(kinematics.get(key, 0.0), path, f"kinematics_properties.{key}")
        for parameter, key in _ARMS.items()
    }
    return Mount(
        pivot_enu_m=heliostat_place(properties, path, origin),
        rot_enu_from_mount=_MOUNT_FRAME,
        # axis 1 lowers the normal towards south as it opens; axis 2 turns it about the mirror's own upright
        actuators=(_actuator(entries[0], path, 1), _actuator(entries[1], path, 2)),
        parameters=arms,
    )


def _refuse_other_geometry(properties: Mapping[str, Any], kinematics: Mapping[str, Any], path: Path) -> None:
    """Refuse what the model has no place for: it would be off by as much, without a word."""
    facing = properties.get("initial_orientation", _FACING)
    if facing != _FACING:
        raise RecordingError(
            f"{path}: initial_orientation: only {_FACING} (south, as in Jülich) is known, got {facing!r:.40}; "
            "describe the mount in a file for `mounts=`"
        )
    for key in _NO_PLACE:
        value = _number(kinematics.get(key, 0.0), path, f"kinematics_properties.{key}")
        if value != 0.0:
            raise RecordingError(
                f"{path}: kinematics_properties.{key}: the model has axes that cross and no place for {value:g} m; "
                "describe the mount in a file for `mounts=`"
            )


def _actuator(entry: Any, path: Path, axis: int) -> Actuator:
    place = f"kinematics_properties.actuators[{axis - 1}]"

    def value(name: str) -> float:
        return _number(key_of(entry, path, name), path, f"{place}.{name}")

    kind = key_of(entry, path, "type_axis")
    if kind != "linear":
        raise RecordingError(
            f"{path}: {place}.type_axis: only linear actuators are known in this layout, got {kind!r:.40}; "
            "describe the mount in a file for `mounts=`"
        )
    for name in ("offset_shift", "radius_shift"):
        shift = _number(entry.get(name, 0.0), path, f"{place}.{name}")
        if shift != 0.0:
            raise RecordingError(
                f"{path}: {place}.{name}: how a shift enters is not known here, got {shift:g}; add it to "
                f"{'offset' if name == 'offset_shift' else 'pivot_radius'} and set it to zero"
            )
    for name in ("increment", "initial_stroke_length", "pivot_radius", "offset"):
        if not value(name) > 0.0:
            raise RecordingError(f"{path}: {place}.{name}: must be greater than zero, got {value(name):g}; correct it")
    direction = -1 if axis == 1 else 1
    turning = -1 if value("clockwise_axis_movement") else 1
    try:
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
    except InvalidInputError as error:
        raise RecordingError(f"{path}: {place}: {error}; correct it") from error
