"""Positions of heliostats from CSV."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.foreign import read_text

__all__ = ["read_positions"]

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
    from scipy.spatial import KDTree  # which no other reader of a scenario should wait for

    pivot = np.array(pivots)
    pairs = sorted(KDTree(pivot).query_pairs(_COINCIDENT_M))
    if pairs:
        i, j = pairs[0]
        raise ScenarioError(f"{path}: heliostats `{ids[i]}` and `{ids[j]}` stand at the same place; move or remove one")
    return tuple(ids), pivot


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
