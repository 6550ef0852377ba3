"""What weather stations write: a CSV of one quantity over time in, an even series out, gaps marked."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from rfpose.checks import FloatArray, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.foreign import read_text
from rfpose.sun import unix_seconds

__all__ = ["Quantity", "read_series_csv"]


_LONGEST_BYTES = 2**28
"""Of a record's text: ten years of half minutes."""


_MOST_SAMPLES = 2**28
_MANY_SAMPLES, _LEAST_TOLD = 2**22, 0.01
"""So many samples are made only if the file tells of so much of their time: two lines shall not ask for gigabytes."""
_LAST_UNIX_S = 253_402_300_799.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """What a column holds.

    Attributes
    ----------
    name, units
        The column is called ``name_unit``; what a value in each unit is multiplied by.
    unit
        Of the values returned, as people write it.
    most, beyond
        Greatest value that can be true, and what more would be beyond.
    """

    name: str
    units: Mapping[str, float]
    unit: str
    most: float
    beyond: str


def read_series_csv(
    path: Path | str, quantity: Quantity, *, interval_s: float, longest_gap_s: float
) -> tuple[float, FloatArray]:
    """Read a series at even times.

    The first line names the columns: ``time`` (ISO 8601 with time zone) or ``unix_s``, and the quantity with its unit.
    Further columns are passed over, as are lines that begin with #. An empty value is a gap.

    Parameters
    ----------
    path
        The file.
    quantity
        What is wanted of it.
    interval_s
        Of the series wanted; between the file's samples it is taken in line [s].
    longest_gap_s
        Between samples further apart than this the quantity is unknown, NaN [s].

    Returns
    -------
    start_unix_s, values
        Time of the first sample [s since 1970 UTC], and (time,).

    Raises
    ------
    InvalidInputError
        No file, no such columns, no number, time that goes back or stands still, a value below zero or beyond what can
        be, fewer than two known samples. The message names file, line and remedy.
    """
    path = Path(path)
    text = read_text(path, limit=_LONGEST_BYTES, error=InvalidInputError)
    seconds, values = _parse(path, text, quantity)
    known = np.isfinite(values)
    if known.sum() < 2:
        raise InvalidInputError(
            f"{path}: must hold two or more samples of known {quantity.name}, got {int(known.sum())}"
        )
    at, values = seconds[known], values[known]
    n = int(np.floor((at[-1] - at[0]) / as_positive("interval_s", interval_s) + 1e-9)) + 1
    if n > _MOST_SAMPLES:
        raise InvalidInputError(
            f"{path}: spans {(at[-1] - at[0]) / 86400.0:.0f} days, {n} samples of {interval_s:g} s, more than fit into "
            "memory; check its times, or give a part of it"
        )
    step = np.diff(at)
    told_s = float(step[step <= longest_gap_s].sum())
    if n > _MANY_SAMPLES and told_s < _LEAST_TOLD * (at[-1] - at[0]):
        raise InvalidInputError(
            f"{path}: spans {(at[-1] - at[0]) / 86400.0:.0f} days and tells of {told_s / 86400.0:.3g} of them, as most "
            f"of its samples lie more than {longest_gap_s:g} s apart; check its times, or give a part of it"
        )
    grid = at[0] + interval_s * np.arange(n)
    even = np.interp(grid, at, values)
    after = np.clip(np.searchsorted(at, grid, side="right"), 1, len(at) - 1)
    wide = at[after] - at[after - 1] > longest_gap_s
    inside = (grid > at[after - 1] + 1e-9) & (grid < at[after] - 1e-9)
    even[wide & inside] = np.nan
    return float(at[0]), read_only(even)


def _parse(path: Path, text: str, quantity: Quantity) -> tuple[FloatArray, FloatArray]:
    """Return times [s] and values as the file has them, checked line by line."""
    columns = [f"{quantity.name}_{unit}" for unit in quantity.units]
    lines = [(i, line) for i, line in enumerate(io.StringIO(text), 1) if line.strip() and not line.startswith("#")]
    if not lines:
        raise InvalidInputError(f"{path}: must not be empty; the first line names columns such as time,{columns[0]}")
    rows = [_cells(path, number, line) for number, line in lines]
    header = [name.strip().lower() for name in rows[0]]
    if len(header) == 1 and ";" in header[0]:
        raise InvalidInputError(
            f"{path}: columns are separated by `;`; save it with commas, and with points in numbers"
        )
    clock = next((name for name in ("unix_s", "time") if name in header), None)
    unit = next((unit for unit, column in zip(quantity.units, columns, strict=True) if column in header), None)
    if clock is None or unit is None:
        raise InvalidInputError(
            f"{path}: line {lines[0][0]} must name a column `time` or `unix_s` and one of "
            f"{', '.join(f'`{column}`' for column in columns)}, got {', '.join(header)}"
        )
    i_clock, i_value = header.index(clock), header.index(f"{quantity.name}_{unit}")
    seconds, values = np.empty(len(rows) - 1), np.empty(len(rows) - 1)
    for i, ((number, _), row) in enumerate(zip(lines[1:], rows[1:], strict=True)):
        place = f"{path}: line {number}"
        if len(row) != len(header):
            raise InvalidInputError(f"{place} must have {len(header)} columns, got {len(row)}")
        seconds[i] = _moment(place, row[i_clock].strip(), clock)
        if i and not seconds[i] > seconds[i - 1]:
            raise InvalidInputError(
                f"{place}: time must go on, got {row[i_clock]} after {rows[i][i_clock]}; sort the file"
            )
        values[i] = _value(place, row[i_value].strip(), quantity, unit)
    return seconds, values


def _cells(path: Path, number: int, line: str) -> list[str]:
    try:
        rows = list(csv.reader([line]))
    except csv.Error as error:
        raise InvalidInputError(f"{path}: line {number} is no CSV: {error}; correct it") from error
    return rows[0] if rows else []


def _moment(place: str, text: str, clock: str) -> float:
    if clock == "time":
        try:
            moment = datetime.fromisoformat(text)
            return float(unix_seconds([moment])[0])
        except (ValueError, InvalidInputError) as error:
            raise InvalidInputError(
                f"{place}: `time` must be ISO 8601 with a time zone such as 2024-02-01T10:09:37Z, got {text!r}"
            ) from error
    try:
        value = float(text)
    except ValueError as error:
        raise InvalidInputError(f"{place}: `unix_s` must be a number of seconds, got {text!r}") from error
    if not 0.0 <= value <= _LAST_UNIX_S:
        raise InvalidInputError(f"{place}: `unix_s` must be a time from 1970 to 9999, got {text!r:.60}")
    return value


def _value(place: str, text: str, quantity: Quantity, unit: str) -> float:
    if not text:
        return float("nan")
    column = f"{quantity.name}_{unit}"
    try:
        value = float(text) * quantity.units[unit]
    except ValueError as error:
        raise InvalidInputError(f"{place}: `{column}` must be a number or empty, got {text!r}") from error
    if not value >= 0.0:
        raise InvalidInputError(f"{place}: `{column}` must not be negative, got {text}; mark gaps by an empty field")
    if value > quantity.most:
        raise InvalidInputError(
            f"{place}: `{column}` {text} is {value:.0f} {quantity.unit}, beyond {quantity.beyond}; name the column "
            f"after its unit ({', '.join(f'{quantity.name}_{u}' for u in quantity.units)})"
        )
    return value
