"""Fields of heliostats: positions from CSV, radial staggered and cornfield layouts."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from rfpose.checks import FloatArray, as_positive
from rfpose.errors import GeometryError, InvalidInputError, ScenarioError
from rfpose.foreign import read_text
from rfpose.scenario import Scenario, check_scenario

__all__ = ["cornfield", "radial_staggered", "read_positions", "with_field"]

_COLUMNS = ("east_m", "north_m", "up_m")
_COINCIDENT_M = 1e-3


def read_positions(path: str | Path) -> tuple[tuple[str, ...], FloatArray]:
    """Read heliostat positions from a CSV file with a header ``id, east_m, north_m, up_m`` in any order.

    ``id`` may be missing (rows are then numbered H1, H2, …), ``up_m`` too (then zero). Other columns are ignored.

    Returns
    -------
    ids, pivot_enu_m (heliostat, xyz) [m]

    Raises
    ------
    ScenarioError
        No such file, no header, a column missing or in another unit, a cell that is no number, an identifier twice, two
        heliostats at one place; the message names file and line.
    """
    path = Path(path)
    text = read_text(path, error=ScenarioError, remedy="positions are CSV in UTF-8: correct it")
    try:
        rows = [(k, row) for k, row in enumerate(csv.reader(text.splitlines()), start=1) if "".join(row).strip()]
    except csv.Error as error:
        raise ScenarioError(f"{path}: not CSV: {error}; correct it") from error
    if not rows:
        raise ScenarioError(f"{path}: empty; the first line must be the header `id,east_m,north_m,up_m`")
    header = [cell.strip() for cell in rows[0][1]]
    _check_header(path, header)
    place = {name: header.index(name) for name in ("id", *_COLUMNS) if name in header}
    ids: list[str] = []
    pivots = []
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise ScenarioError(f"{path}: line {line} has {len(row)} cells, the header {len(header)}; mend that line")
        ids.append(row[place["id"]].strip() if "id" in place else f"H{len(ids) + 1}")
        pivots.append([_number(path, line, name, row[place[name]]) if name in place else 0.0 for name in _COLUMNS])
    if not ids:
        raise ScenarioError(f"{path}: a header but no heliostats below it")
    if len(set(ids)) < len(ids):
        twice = next(name for k, name in enumerate(ids) if name in ids[:k])
        raise ScenarioError(f"{path}: heliostat `{twice}` appears twice; identifiers must be unique")
    pivot = np.array(pivots)
    pairs = sorted(KDTree(pivot).query_pairs(_COINCIDENT_M))
    if pairs:
        i, j = pairs[0]
        raise ScenarioError(f"{path}: heliostats `{ids[i]}` and `{ids[j]}` stand at the same place; move or remove one")
    return tuple(ids), pivot


def with_field(scenario: Scenario, ids: Sequence[str], pivot_enu_m: npt.ArrayLike) -> Scenario:
    """Return a scenario with another field, each heliostat like the first, its own posture left out.

    Impairments of receivers are left out, too, since they name those of the old field.

    Raises
    ------
    ScenarioError
        No heliostat whose mirror could be taken; a name that no heliostat may have, or twice.
    """
    if not scenario.heliostat:
        raise ScenarioError(
            f"scenario `{scenario.name}` has no heliostat whose mirror the field could have; add a [[heliostat]]"
        )
    like = scenario.heliostat[0].model_dump(exclude_none=True)
    like.pop("normal_enu", None)
    n_receiver = len(scenario.heliostat[0].receiver_mirror_m)
    data = scenario.model_dump(exclude_none=True)
    data["heliostat"] = [
        {**like, "id": name, "pivot_enu_m": tuple(place), "receiver_ids": [f"{name}_r{k}" for k in range(n_receiver)]}
        for name, place in zip(ids, np.asarray(pivot_enu_m).tolist(), strict=True)
    ]
    simulation = data.get("simulation", {})
    simulation.pop("blocked", None)
    simulation.pop("dropped", None)
    return check_scenario(data)


def _check_header(path: Path, header: list[str]) -> None:
    if len(header) == 1 and ";" in header[0]:
        raise ScenarioError(f"{path}: columns are separated by `;`; save it with commas, and with points in numbers")
    if all(re.fullmatch(r"[-+\d.eE]+", cell) for cell in header if cell):
        raise ScenarioError(f"{path}: line 1 holds numbers, not a header; add the line `east_m,north_m,up_m` above it")
    for name in _COLUMNS[:2]:
        if name in header:
            continue
        stem = name.removesuffix("_m")
        other = [h for h in header if h.split("_")[0].split("[")[0].strip().lower() == stem]
        if other:
            raise ScenarioError(f"{path}: column `{other[0]}` must be `{name}`, in metres; convert and rename it")
        raise ScenarioError(f"{path}: column `{name}` is missing; the header has {', '.join(header)}")


def _number(path: Path, line: int, name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError as error:
        raise ScenarioError(f"{path}: line {line}, `{name}`: {cell.strip()!r} is not a number of metres") from error
    if not np.isfinite(value):
        raise ScenarioError(f"{path}: line {line}, `{name}` must be finite, got {cell.strip()}")
    return value


def radial_staggered(
    n_heliostat: int,
    *,
    first_radius_m: float,
    diagonal_m: float,
    row_spacing_m: float | None = None,
    height_m: float = 0.0,
) -> FloatArray:
    """Return heliostats on circles about the tower at the origin, each in the gap of the two in front of it.

    A zone begins with the azimuth spacing ``diagonal_m`` and keeps its number a row; where the spacing has doubled a
    new zone begins. Rows are filled from the tower outwards.

    Parameters
    ----------
    n_heliostat
        How many.
    first_radius_m
        Of the first row [m].
    diagonal_m
        A mirror's diagonal with its clearance: no two heliostats are closer [m].
    row_spacing_m
        Between rows; ``diagonal_m``·√3/2 (a triangle in the densest rows) by default, and no less [m].

    Returns
    -------
    (heliostat, xyz) [m]
    """
    if n_heliostat < 1:
        raise InvalidInputError(f"`n_heliostat` must be at least one, got {n_heliostat}")
    radius = as_positive("first_radius_m", first_radius_m)
    width = as_positive("diagonal_m", diagonal_m)
    closest = width * np.sqrt(3.0) / 2.0
    step = closest if row_spacing_m is None else as_positive("row_spacing_m", row_spacing_m)
    if step < closest * (1.0 - 1e-9):
        raise GeometryError(f"`row_spacing_m` must be at least {closest:.6g} m for mirrors {width:g} m apart")
    if radius < width:
        raise GeometryError(f"`first_radius_m` must be at least `diagonal_m`, {width:g} m")
    rows: list[FloatArray] = []
    count = 0
    in_zone = int(np.pi / np.arcsin(width / (2.0 * radius)))
    zone_start = radius
    k = 0
    while count < n_heliostat:
        if radius >= 2.0 * zone_start:
            # a new zone: its first row keeps a whole diagonal from the last row of the old
            radius += width - step
            zone_start, k = radius, 0
            in_zone = int(np.pi / np.arcsin(width / (2.0 * radius)))
        angle = 2.0 * np.pi * (np.arange(in_zone) + 0.5 * (k % 2)) / in_zone
        rows.append(np.stack([radius * np.sin(angle), radius * np.cos(angle), np.full(in_zone, height_m)], axis=1))
        count += in_zone
        radius += step
        k += 1
    return np.concatenate(rows)[:n_heliostat]


def cornfield(
    n_heliostat: int,
    *,
    column_m: float,
    row_m: float,
    inner_radius_m: float = 0.0,
    staggered: bool = True,
    height_m: float = 0.0,
) -> FloatArray:
    """Return heliostats in straight rows, every other one shifted by half a column: those nearest the tower.

    Parameters
    ----------
    n_heliostat
        How many.
    column_m, row_m
        East-west and north-south spacing [m].
    inner_radius_m
        Kept free about the tower at the origin [m].

    Returns
    -------
    (heliostat, xyz) [m]
    """
    if n_heliostat < 1:
        raise InvalidInputError(f"`n_heliostat` must be at least one, got {n_heliostat}")
    column, row = as_positive("column_m", column_m), as_positive("row_m", row_m)
    if inner_radius_m < 0.0:
        raise InvalidInputError("`inner_radius_m` must not be negative")
    reach = np.sqrt(inner_radius_m**2 + n_heliostat * column * row / np.pi) + 2.0 * np.hypot(column, row)
    i = np.arange(-int(reach / row) - 1, int(reach / row) + 2)
    j = np.arange(-int(reach / column) - 1, int(reach / column) + 2)
    east = column * (j[None, :] + (0.5 * (i[:, None] % 2) if staggered else 0.0 * i[:, None]))
    north = np.broadcast_to(row * i[:, None].astype(np.float64), east.shape)
    place = np.stack([east.ravel(), north.ravel(), np.full(east.size, float(height_m))], axis=1)
    distance = np.hypot(place[:, 0], place[:, 1])
    order = np.lexsort((place[:, 1], place[:, 0], np.round(distance, 9)))
    order = order[distance[order] >= inner_radius_m]
    return np.asarray(place[order[:n_heliostat]])
