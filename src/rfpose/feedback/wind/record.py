"""Wind as it was measured: CSV in, an even record out, and when mirrors belong into stow."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.sun import unix_seconds

__all__ = ["WindRecord", "read_wind_csv", "stow_mask"]

_UNITS = {"mps": 1.0, "kmh": 1.0 / 3.6, "knots": 1852.0 / 3600.0, "mph": 0.44704}
_STRONGEST_MPS = 75.0
"""More than any anemometer at the height of a mirror has survived."""


@dataclass(frozen=True, slots=True)
class WindRecord:
    """Wind at even times.

    Attributes
    ----------
    start_unix_s
        Of the first sample, seconds since 1970-01-01 UTC [s].
    interval_s
        Between samples [s].
    speed_mps : (time,)
        NaN in gaps [m/s].
    """

    start_unix_s: float
    interval_s: float
    speed_mps: FloatArray

    @property
    def unix_s(self) -> FloatArray:
        """Times of the samples [s]."""
        return np.asarray(self.start_unix_s + self.interval_s * np.arange(len(self.speed_mps)), np.float64)

    @property
    def known_share(self) -> float:
        """Part of the samples that is no gap."""
        return float(np.isfinite(self.speed_mps).mean())


def read_wind_csv(path: Path | str, *, interval_s: float = 1.0, longest_gap_s: float = 60.0) -> WindRecord:
    """Read a wind record.

    The first line names the columns: ``time`` (ISO 8601 with time zone) or ``unix_s``, and ``speed_`` with the unit:
    ``speed_mps``, ``speed_kmh``, ``speed_knots`` or ``speed_mph``. Further columns are passed over, as are lines that
    begin with #. An empty speed is a gap.

    Parameters
    ----------
    path
        The file.
    interval_s
        Of the record wanted; between the file's samples the wind is taken in line [s].
    longest_gap_s
        Between samples further apart than this the wind is unknown, NaN [s].

    Raises
    ------
    InvalidInputError
        No file, no such columns, no number, time that goes back or stands still, a speed below zero or beyond any
        wind, fewer than two known samples. The message names file, line and remedy.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"{path}: must be a readable text file; {error}") from error
    seconds, speed = _parse(path, text)
    known = np.isfinite(speed)
    if known.sum() < 2:
        raise InvalidInputError(f"{path}: must hold two or more samples of known speed, got {int(known.sum())}")
    at, values = seconds[known], speed[known]
    n = int(np.floor((at[-1] - at[0]) / as_positive("interval_s", interval_s) + 1e-9)) + 1
    grid = at[0] + interval_s * np.arange(n)
    even = np.interp(grid, at, values)
    after = np.clip(np.searchsorted(at, grid, side="right"), 1, len(at) - 1)
    wide = at[after] - at[after - 1] > longest_gap_s
    inside = (grid > at[after - 1] + 1e-9) & (grid < at[after] - 1e-9)
    even[wide & inside] = np.nan
    return WindRecord(start_unix_s=float(at[0]), interval_s=float(interval_s), speed_mps=read_only(even))


def _parse(path: Path, text: str) -> tuple[FloatArray, FloatArray]:
    """Return times [s] and speeds [m/s] as the file has them, checked line by line."""
    lines = [(i, line) for i, line in enumerate(io.StringIO(text), 1) if line.strip() and not line.startswith("#")]
    if not lines:
        raise InvalidInputError(f"{path}: must not be empty; the first line names columns such as time,speed_mps")
    rows = list(csv.reader(line for _, line in lines))
    header = [name.strip().lower() for name in rows[0]]
    clock = next((name for name in ("unix_s", "time") if name in header), None)
    unit = next((unit for unit in _UNITS if f"speed_{unit}" in header), None)
    if clock is None or unit is None:
        raise InvalidInputError(
            f"{path}: line {lines[0][0]} must name a column `time` or `unix_s` and one of "
            f"{', '.join(f'`speed_{u}`' for u in _UNITS)}, got {', '.join(header)}"
        )
    i_clock, i_speed = header.index(clock), header.index(f"speed_{unit}")
    seconds, speed = np.empty(len(rows) - 1), np.empty(len(rows) - 1)
    for i, ((number, _), row) in enumerate(zip(lines[1:], rows[1:], strict=True)):
        place = f"{path}: line {number}"
        if len(row) != len(header):
            raise InvalidInputError(f"{place} must have {len(header)} columns, got {len(row)}")
        seconds[i] = _moment(place, row[i_clock].strip(), clock)
        if i and not seconds[i] > seconds[i - 1]:
            raise InvalidInputError(
                f"{place}: time must go on, got {row[i_clock]} after {rows[i][i_clock]}; sort the file"
            )
        speed[i] = _speed(place, row[i_speed].strip(), unit)
    return seconds, speed


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
    if not np.isfinite(value):
        raise InvalidInputError(f"{place}: `unix_s` must be finite, got {text!r}")
    return value


def _speed(place: str, text: str, unit: str) -> float:
    if not text:
        return float("nan")
    try:
        value = float(text) * _UNITS[unit]
    except ValueError as error:
        raise InvalidInputError(f"{place}: `speed_{unit}` must be a number or empty, got {text!r}") from error
    if value < 0.0:
        raise InvalidInputError(
            f"{place}: `speed_{unit}` must not be negative, got {text}; mark gaps by an empty field"
        )
    if value > _STRONGEST_MPS:
        raise InvalidInputError(
            f"{place}: `speed_{unit}` {text} is {value:.0f} m/s, beyond any wind; name the column after its unit "
            f"({', '.join(f'speed_{u}' for u in _UNITS)})"
        )
    return value


def stow_mask(
    speed_mps: npt.ArrayLike,
    *,
    interval_s: float,
    stow_mps: float = 10.0,
    release_mps: float = 8.0,
    release_s: float = 600.0,
    longest_gap_s: float = 60.0,
) -> npt.NDArray[np.bool_]:
    """Return when mirrors belong into stow for the wind.

    Parameters
    ----------
    speed_mps : (time,)
        Wind [m/s], NaN unknown; unknown for longer than ``longest_gap_s`` counts as strong.
    interval_s
        Between samples [s].
    stow_mps
        Stow from this wind on [m/s].
    release_mps, release_s
        Come back once the wind has stayed below this [m/s] for this long [s].

    Returns
    -------
    (time,)
    """
    speed = as_float_array("speed_mps", speed_mps, ("time",), finite=False)
    if not release_mps <= stow_mps:
        raise InvalidInputError(f"`release_mps` {release_mps} must not exceed `stow_mps` {stow_mps}")
    gap_n = longest_gap_s / as_positive("interval_s", interval_s)
    out = np.zeros(len(speed), np.bool_)
    stowed, calm, blind = False, 0.0, 0
    for i, value in enumerate(speed):
        blind = 0 if np.isfinite(value) else blind + 1
        strong = value >= stow_mps or blind > gap_n
        calm = calm + interval_s if value < release_mps else 0.0
        stowed = strong or (stowed and calm < release_s)
        out[i] = stowed
    return out
