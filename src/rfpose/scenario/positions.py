"""Positions of heliostats from CSV."""

from __future__ import annotations

import csv
import logging
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.foreign import read_text
from rfpose.scenario._words import in_words
from rfpose.scenario.records import ID_PATTERN, MAX_ID_LENGTH, Record

__all__ = ["Columns", "PositionForm", "check_form", "read_positions"]

_log = logging.getLogger(__name__)

_METRES = {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048}
_AXES = ("east", "north", "up")
_KNOWN = {"east": ("east", "pos-x"), "north": ("north", "pos-y"), "up": ("up", "pos-z")}
"""What columns are called here and by SolarPILOT, whose lengths are metres, x east and y north."""
_IDS = ("id", "name", "heliostat")
_CELL = re.compile(r"(.*?)\s*(?:_([a-z]+)|\[\s*([^\]]*?)\s*\]|\(\s*([^)]*?)\s*\))?", re.IGNORECASE)
_COINCIDENT_M = 1e-3

_Row = tuple[int, list[str]]
ColumnName = Annotated[str, Field(min_length=1, max_length=200)]


class Columns(Record):
    """Headers of a table of positions, where they are none that are known."""

    id: ColumnName | None = None
    east: ColumnName | None = None
    north: ColumnName | None = None
    up: ColumnName | None = None


class PositionForm(Record):
    """How a table of positions is to be read."""

    columns: Columns = Columns()
    """Headers by what they hold; without them known ones: ours and SolarPILOT's."""
    unit: Literal["m", "km", "cm", "mm", "ft"] | None = None
    """Of columns whose headers name none."""
    pivot_height_m: float | None = None
    """Pivots are so far above the table's heights; where it has no heights, so far above zero."""


def check_form(data: Mapping[str, Any]) -> PositionForm:
    """Return a form from plain values.

    Raises
    ------
    ScenarioError
        An unknown key or unit.
    """
    try:
        return PositionForm.model_validate(data)
    except ValidationError as error:
        raise ScenarioError(in_words(error)) from error


def read_positions(path: str | Path, form: PositionForm | None = None) -> tuple[tuple[str, ...], FloatArray]:
    """Read heliostat positions from a CSV file with a header ``id, east_m, north_m, up_m`` in any order.

    SolarPILOT's ``Pos-x, Pos-y, Pos-z`` are known, too. ``id`` may be missing (rows are then numbered H1, H2, …). Units
    are those of the headers (``east_ft``, ``Pos-x [m]``) or of a line of units below them. Other columns are ignored.

    Parameters
    ----------
    path
        The file.
    form
        Names of columns, their unit and the pivots' height. Given, heights must be told: by a column, which may not be
        zero throughout, or by ``pivot_height_m``. Without it a table without heights lies at zero, which the log says.

    Returns
    -------
    ids, pivot_enu_m (heliostat, xyz) [m]

    Raises
    ------
    ScenarioError
        No such file, no header, a column missing or in an unknown unit, a cell that is no number, an identifier twice,
        two heliostats at one place, no heights; the message names file and line.
    """
    path = Path(path)
    header, rows = _rows(path)
    place = _places(path, header, Columns() if form is None else form.columns)
    metres, rows = _metres(path, header, place, rows, None if form is None else form.unit)
    if not rows:
        raise ScenarioError(f"{path}: a header but no heliostats below it")
    ids = [row[place["id"]].strip() if "id" in place else f"H{k}" for k, (_, row) in enumerate(rows, start=1)]
    pivot = np.zeros((len(rows), 3))
    for axis, name in enumerate(_AXES):
        if name in place:
            column = place[name]
            pivot[:, axis] = [metres[name] * _number(path, line, header[column], row[column]) for line, row in rows]
    if len(set(ids)) < len(ids):
        twice = next(name for k, name in enumerate(ids) if name in ids[:k])
        raise ScenarioError(f"{path}: heliostat `{twice}` appears twice; identifiers must be unique")
    _raise_to_height(path, header[place["up"]] if "up" in place else None, pivot, form)
    if form is not None:
        _check_names(path, ids, rows)
    from scipy.spatial import KDTree  # which no other reader of a scenario should wait for

    pairs = sorted(KDTree(pivot).query_pairs(_COINCIDENT_M))
    if pairs:
        i, j = pairs[0]
        raise ScenarioError(f"{path}: heliostats `{ids[i]}` and `{ids[j]}` stand at the same place; move or remove one")
    return tuple(ids), pivot


def _rows(path: Path) -> tuple[list[str], list[_Row]]:
    """Return the header, and the other lines that hold something, with their numbers."""
    text = read_text(path, error=ScenarioError, remedy="positions are CSV in UTF-8: correct it")
    try:
        rows = [(k, row) for k, row in enumerate(csv.reader(text.splitlines()), start=1) if "".join(row).strip()]
    except csv.Error as error:
        raise ScenarioError(f"{path}: not CSV: {error}; correct it") from error
    if not rows:
        raise ScenarioError(f"{path}: empty; the first line must be the header `id,east_m,north_m,up_m`")
    header = [cell.strip() for cell in rows[0][1]]
    _check_header(path, header)
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise ScenarioError(f"{path}: line {line} has {len(row)} cells, the header {len(header)}; mend that line")
    return header, rows[1:]


def _metres(
    path: Path, header: list[str], place: dict[str, int], rows: list[_Row], told: str | None
) -> tuple[dict[str, float], list[_Row]]:
    """Return the metres of one unit of each column of lengths, and the rows without a line of units."""
    lengths = {name: k for name, k in place.items() if name in _AXES}
    below = {name: rows[0][1][k].strip(" []()").lower() for name, k in lengths.items()} if rows else {}
    if not below or not all(unit in _METRES for unit in below.values()):
        below = {}
    metres = {name: _unit(path, name, header[k], below.get(name) or told) for name, k in lengths.items()}
    return metres, rows[1:] if below else rows


def _check_header(path: Path, header: list[str]) -> None:
    if len(header) == 1 and ";" in header[0]:
        raise ScenarioError(f"{path}: columns are separated by `;`; save it with commas, and with points in numbers")
    if all(re.fullmatch(r"[-+\d.eE]+", cell) for cell in header if cell):
        raise ScenarioError(f"{path}: line 1 holds numbers, not a header; add the line `east_m,north_m,up_m` above it")


def _places(path: Path, header: list[str], columns: Columns) -> dict[str, int]:
    """Column of each of id, east, north, up that the table has."""
    stems = [_stem_unit(cell)[0] for cell in header]
    out = {}
    for name, known in (("id", _IDS), *_KNOWN.items()):
        told = getattr(columns, name)
        if told is not None:
            if told not in header:
                raise ScenarioError(
                    f"{path}: has no column `{told}`, which `columns.{name}` names; the header has {', '.join(header)}"
                )
            out[name] = header.index(told)
            continue
        found = [k for k, stem in enumerate(stems) if stem in known]
        # our own names first, if a table has several
        found.sort(key=lambda k: known.index(stems[k]))
        if found:
            out[name] = found[0]
        elif name in ("east", "north"):
            raise ScenarioError(
                f"{path}: column `{name}_m` is missing; the header has {', '.join(header)}. Rename the one that it is, "
                f"or name it in a scenario's [heliostats.columns]"
            )
    return out


def _stem_unit(cell: str) -> tuple[str, str | None]:
    """Take a header apart: what it is, in small letters, and the unit that it names."""
    found = _CELL.fullmatch(cell)
    assert found is not None
    return found[1].strip().lower(), next((group.lower() for group in found.groups()[1:] if group), None)


def _unit(path: Path, name: str, cell: str, told: str | None) -> float:
    """Metres of one unit of a column: by its header, else as told; SolarPILOT's are metres."""
    stem, own = _stem_unit(cell)
    unit = own if stem in _KNOWN[name] or own in _METRES else None
    unit = unit or told or ("m" if stem.startswith("pos-") else None)
    if unit in _METRES:
        return _METRES[unit]
    if unit is None:
        raise ScenarioError(
            f"{path}: column `{cell}` says no unit; rename it to `{name}_m`, or give `unit` in [heliostats] of a "
            "scenario"
        )
    raise ScenarioError(f"{path}: column `{cell}` must be `{name}_m`, in metres; convert and rename it")


def _raise_to_height(path: Path, column: str | None, pivot: FloatArray, form: PositionForm | None) -> None:
    if form is None:
        if column is None:
            _log.warning("%s: has no heights; its places are taken at height zero; add a column `up_m`", path)
        return
    if form.pivot_height_m is not None:
        pivot[:, 2] += form.pivot_height_m
    elif column is None:
        raise ScenarioError(f"{path}: has no column of heights; add `up_m`, or give `pivot_height_m` in [heliostats]")
    elif not np.any(pivot[:, 2]):
        raise ScenarioError(
            f"{path}: all heights in `{column}` are zero; give `pivot_height_m` in [heliostats], how high pivots are "
            "above them (0 if they are the pivots' own)"
        )


def _check_names(path: Path, ids: list[str], rows: list[_Row]) -> None:
    for name, (line, _) in zip(ids, rows, strict=True):
        if not re.fullmatch(ID_PATTERN, name) or len(name) > MAX_ID_LENGTH:
            raise ScenarioError(
                f"{path}: line {line}: heliostat {name!r:.60} cannot be called so; names are up to "
                f"{MAX_ID_LENGTH} letters, digits, `_`, `-`, `.`: rename it"
            )


def _number(path: Path, line: int, name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError as error:
        raise ScenarioError(f"{path}: line {line}, `{name}`: {cell.strip()!r} is not a number") from error
    if not math.isfinite(value):
        raise ScenarioError(f"{path}: line {line}, `{name}` must be finite, got {cell.strip()}")
    return value
