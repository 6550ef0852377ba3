"""Where a site is, what stands on it besides what takes part in the radio, and where mirrors are told to point."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from rfpose.errors import ScenarioError
from rfpose.foreign import beside
from rfpose.scenario.positions import read_positions
from rfpose.scenario.records import Identifier, NonNegative, Point, Positive, Record

__all__ = ["Box", "Posture", "Site", "StructurePlate", "Structures", "fill_structures"]

_SAME_PLACE_M = 1.0
"""A plan of the field may be coarser than the survey of the mirrors with receivers."""


class Box(Record):
    """An upright box: a tower, a building, a container."""

    id: Identifier
    base_enu_m: Point
    """Centre of its base."""
    size_m: tuple[Positive, Positive, Positive]
    """Along its own x, y and upwards."""
    azimuth_deg: float = 0.0
    """Of its y side, from north, clockwise."""
    permittivity: Annotated[float, Field(ge=1)] = 5.24
    """Relative, real part; default: concrete (ITU-R P.2040)."""
    conductivity_s_per_m: NonNegative = 0.02

    def holds(self, place_enu_m: Point) -> bool:
        """Whether a place lies within the box or on its faces."""
        sine, cosine = math.sin(math.radians(self.azimuth_deg)), math.cos(math.radians(self.azimuth_deg))
        east, north, up = (a - b for a, b in zip(place_enu_m, self.base_enu_m, strict=True))
        x, y = east * cosine - north * sine, east * sine + north * cosine
        width, depth, height = self.size_m
        return abs(x) <= 0.5 * width and abs(y) <= 0.5 * depth and 0.0 <= up <= height


class StructurePlate(Record):
    """A mirror without receivers: it hides and reflects."""

    id: Identifier
    pivot_enu_m: Point
    width_m: Positive
    height_m: Positive
    arm_m: NonNegative = 0.0
    """Its centre lies this far from the pivot along the normal."""
    normal_enu: Point | None = None
    """Its posture, unless ``[posture]`` knows better; without both it follows the sun as mirrors do."""

    @model_validator(mode="before")
    @classmethod
    def _has_a_size(cls, data: Any) -> Any:
        if isinstance(data, Mapping):
            missing = [f"`{key}`" for key in ("width_m", "height_m") if data.get(key) is None]
            if missing:
                raise ValueError(
                    f"plate `{data.get('id', '?')}` has no {' and no '.join(missing)}; give it there, or in "
                    "[site.structures] for all plates"
                )
        return data

    @model_validator(mode="after")
    def _points_somewhere(self) -> StructurePlate:
        if self.normal_enu is not None and math.hypot(*self.normal_enu) < 1e-9:
            raise ValueError("`normal_enu` must not be zero")
        return self


class Structures(Record):
    """What hides and turns radio waves."""

    box: tuple[Box, ...] = ()
    plate: tuple[StructurePlate, ...] = ()


class Site(Record):
    """Where the field is. Latitude and longitude place the sun; they are not needed to process radio."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] | None = None
    height_m: float = 0.0
    aim_enu_m: Point | None = None
    """Aim point of the heliostats (the tower's receiver)."""
    structures: Structures = Structures()


class Posture(Record):
    """Where mirrors are told to point."""

    sigma_rad: Positive = 0.02
    """How far a mirror's orientation may be off what was told, each axis."""
    csv: str | None = None
    """Table of commanded postures; its path from where the command is run."""


def fill_structures(data: dict[str, Any], folder: Path | None = None) -> None:
    """Give each plate what ``[site.structures]`` says of all of them, and read its ``csv`` of their places.

    The scenario that comes of it holds all plates itself. Rows of the file that the scenario lists by the same name at
    the same place, as heliostats or plates, are passed over: a plan of the whole field will do.

    Raises
    ------
    ScenarioError
        The file cannot be used.
    """
    site = data.get("site")
    table = site.get("structures") if isinstance(site, dict) else None
    if not isinstance(table, dict):
        return
    common = {key: table.pop(key) for key in ("width_m", "height_m", "arm_m") if key in table}
    plates = table.get("plate", [])
    if not isinstance(plates, list):
        return
    path = table.pop("csv", None)
    if path is not None:
        if not isinstance(path, str):
            raise ScenarioError(f"`site.structures.csv` must be the path of a file, got {path!r:.80}")
        plates = table["plate"] = [
            *plates,
            *_plates_of(beside(path, folder), [*_tables(data.get("heliostat")), *_tables(plates)]),
        ]
    for plate in plates:
        if isinstance(plate, dict):
            for key, value in common.items():
                plate.setdefault(key, value)


def _tables(tables: Any) -> list[dict[str, Any]]:
    return [one for one in tables if isinstance(one, dict)] if isinstance(tables, list) else []


def _plates_of(path: Path, listed: list[dict[str, Any]]) -> list[dict[str, Any]]:
    ids, pivot = read_positions(path)
    known = {one.get("id"): one.get("pivot_enu_m") for one in listed}
    places: list[list[float]] = pivot.tolist()
    return [
        {"id": name, "pivot_enu_m": place}
        for name, place in zip(ids, places, strict=True)
        if not _same_place(known.get(name), place)
    ]


def _same_place(place: Any, other: list[float]) -> bool:
    try:
        return math.dist(place, other) < _SAME_PLACE_M
    except (TypeError, ValueError):  # none, or no place, which the scenario's own checks will say
        return False
