"""Where the heliostats of a plant stand, as PAINT, the database of the Jülich solar tower, has it.

References
----------
PAINT, doi:10.1038/s41560-026-02070-1; https://paint-database.org.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import RecordingError
from rfpose.foreign import load_json

__all__ = [
    "PaintPlan",
    "heliostat_place",
    "key_of",
    "origin_of",
    "place_of",
    "properties_of",
    "read_object",
    "read_plan",
]

_HIGHEST_M = 1e4


@dataclass(frozen=True, slots=True, kw_only=True)
class PaintPlan:
    """The heliostats of a PAINT directory.

    Attributes
    ----------
    ids
        Their names.
    pivot_enu_m : (heliostat, xyz)
        Their places about the plant's origin [m].
    origin_deg_m
        Latitude, longitude [deg] and height [m] of the plant's origin, WGS84.
    """

    ids: tuple[str, ...]
    pivot_enu_m: FloatArray
    origin_deg_m: tuple[float, float, float]


def read_plan(directory: str | Path) -> PaintPlan:
    """Read where the heliostats of a PAINT directory stand: one folder each, and the tower's measurements.

    Raises
    ------
    RecordingError
        No such directory, a file that is missing or cannot be used, or no heliostat; the message names file and key.
    """
    directory = Path(directory)
    try:
        folders = sorted(item for item in directory.iterdir() if item.is_dir())
    except OSError as error:
        raise RecordingError(
            f"{directory}: cannot be read as a directory ({error.strerror}); check the path"
        ) from error
    origin, _, _ = origin_of(directory)
    found = {}
    for folder in folders:
        if any(_properties_pattern(folder.name).search(path.name) for path in _json_files(folder)):
            properties, path = properties_of(folder)
            found[folder.name] = heliostat_place(properties, path, origin)
    if not found:
        raise RecordingError(f"{directory}: no heliostat folder with properties (ID/ID_properties.json)")
    latitude, longitude, height = origin.tolist()
    return PaintPlan(
        ids=tuple(found), pivot_enu_m=np.array(list(found.values())), origin_deg_m=(latitude, longitude, height)
    )


def origin_of(directory: Path) -> tuple[FloatArray, dict[str, Any], Path]:
    """Return the plant's origin (latitude, longitude, height), the tower's measurements, and their file."""
    path = _one_file(directory, re.compile(r"tower.measurements\.json$"), "the tower's measurements")
    tower = read_object(path)
    plant = key_of(tower, path, "power_plant_properties")
    return place_of(key_of(plant, path, "coordinates"), f"{path}: power_plant_properties.coordinates"), tower, path


def properties_of(folder: Path) -> tuple[dict[str, Any], Path]:
    """Return a heliostat's properties and their file."""
    path = _one_file(folder, _properties_pattern(folder.name), "the heliostat's properties")
    return read_object(path), path


def _properties_pattern(heliostat: str) -> re.Pattern[str]:
    """Return what the names of files with a heliostat's properties are like."""
    return re.compile(rf"({re.escape(heliostat)}.*|heliostat.)properties\.json$")


def heliostat_place(properties: dict[str, Any], path: Path, origin: FloatArray) -> FloatArray:
    """Return a heliostat's pivot (xyz) about the plant's origin [m]."""
    place = place_of(key_of(properties, path, "heliostat_position"), f"{path}: heliostat_position")
    return geometry.enu_from_wgs84(place, origin)


def _json_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*.json") if "alibration" not in p.name)


def _one_file(folder: Path, pattern: re.Pattern[str], what: str) -> Path:
    """Find the file below ``folder`` whose name ends as the pattern says."""
    paths = [path for path in _json_files(folder) if pattern.search(path.name)]
    if not paths:
        raise RecordingError(f"{folder}: no file for {what} (name like {pattern.pattern!r}); fetch it from PAINT")
    return paths[0]


def read_object(path: Path) -> dict[str, Any]:
    """Return the JSON object of a file."""
    content = load_json(path, remedy="fetch it again")
    if not isinstance(content, dict):
        raise RecordingError(f"{path}: must hold one JSON object, got a {type(content).__name__}; fetch it again")
    return content


def key_of(content: Any, path: Path, key: str) -> Any:
    """Return what an object has under a key; ``path`` names its file."""
    if not isinstance(content, dict) or key not in content:
        raise RecordingError(f"{path}: has no {key!r}; fetch it again")
    return content[key]


def place_of(value: Any, where: str) -> FloatArray:
    """Latitude, longitude and height out of a file."""
    if (
        not isinstance(value, list)
        or len(value) != 3
        or any(isinstance(x, bool) or not isinstance(x, int | float) for x in value)
    ):
        raise RecordingError(f"{where}: [latitude, longitude, height] was expected, got {value!r:.60}; correct it")
    place = np.array(value, np.float64)
    if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 360.0 and abs(place[2]) <= _HIGHEST_M):
        raise RecordingError(f"{where}: must be degrees and metres on Earth, got {value!r:.60}; correct it")
    return place
