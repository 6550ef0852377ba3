"""Antenna patterns as text: TOML with a row a direction, for tables that were measured, or that people are to read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rfpose.antenna import AntennaPattern
from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.foreign import load_toml

__all__ = ["read_text_pattern", "text_of_pattern"]

_LARGEST_BYTES = 2**26
_KEYS = {"format", "version", "made_by", "step_deg", "receiver"}
_RECEIVER_KEYS = {"place_mirror_m", "axis_mirror", "rows"}
_COLUMNS = 8
_FEWEST_GIVEN = 0.01
"""Of a table's directions: a few rows shall not ask for gigabytes."""
_STEPS_DEG = (0.25, 45.0)


def text_of_pattern(pattern: AntennaPattern, head: Mapping[str, Any]) -> str:
    """Return a pattern as TOML, ``head`` first; unknown directions have no rows.

    Raises
    ------
    InvalidInputError
        Its azimuths are not as far apart as its polar angles, which the text cannot say.
    """
    n_polar, n_azimuth = pattern.response.shape[2:4]
    if n_azimuth != 2 * (n_polar - 1):
        raise InvalidInputError("`pattern` must have one step for both angles to be written as text; write it as .h5")
    step = 180.0 / (n_polar - 1)
    receivers = []
    for r in range(pattern.n_receiver):
        at = np.argwhere(~np.isnan(pattern.response[:, r]).any(axis=-1))
        known = pattern.response[at[:, 0], r, at[:, 1], at[:, 2]]
        size_and_phase = np.stack([np.abs(known), np.degrees(np.angle(known))], axis=-1).reshape(-1, 4)
        sigma = pattern.sigma[at[:, 0], r, at[:, 1], at[:, 2], None]
        rows = np.hstack([pattern.frequency_hz[at[:, 0], None], step * at[:, 1:], size_and_phase, sigma])
        receivers.append(
            {
                "place_mirror_m": pattern.receiver_mirror_m[r].tolist(),
                "axis_mirror": pattern.axis_mirror[r].tolist(),
                "rows": [[float(f"{value:.9g}") for value in row] for row in rows],
            }
        )
    return tomli_w.dumps({**head, "step_deg": step, "receiver": receivers})


def read_text_pattern(path: Path, *, version: int) -> tuple[AntennaPattern, Mapping[str, str]]:
    """Read a pattern from TOML; return it with what it was made by.

    Raises
    ------
    RecordingError
        Something in it is not as it must be: the place is named.
    """
    content = load_toml(path, limit=_LARGEST_BYTES, remedy="docs/antenna-patterns.md says how such a file is written")
    if content.get("version") != version:
        raise RecordingError(
            f"{path}: has version {content.get('version')!r:.40}, this rfpose reads {version}; update rfpose"
        )
    try:
        _refuse_unknown(content, _KEYS, "the file")
        made_by = content.get("made_by", {})
        if not isinstance(made_by, Mapping):
            raise InvalidInputError(f"`made_by` must be a table, got {made_by!r:.40}")
        return _pattern_of(content), {str(key)[:80]: str(value)[:200] for key, value in made_by.items()}
    except InvalidInputError as error:
        raise RecordingError(f"{path}: {error}") from error


def _pattern_of(content: Mapping[str, Any]) -> AntennaPattern:
    step = as_positive("step_deg", content.get("step_deg"))
    n_step = round(180.0 / step) if step >= _STEPS_DEG[0] else 0
    if step > _STEPS_DEG[1] or abs(n_step * step - 180.0) > 1e-6:
        raise InvalidInputError(f"`step_deg` must divide 180 and be from 0.25 to 45, got {step:g}")
    receivers = content.get("receiver")
    if not isinstance(receivers, list) or not all(isinstance(table, Mapping) for table in receivers) or not receivers:
        raise InvalidInputError(
            "one table [[receiver]] or more must be there, with place_mirror_m, axis_mirror and rows"
        )
    places, axes, rows = [], [], []
    for r, table in enumerate(receivers):
        _refuse_unknown(table, _RECEIVER_KEYS, f"receiver {r}")
        places.append(as_float_array(f"receiver {r}: place_mirror_m", table.get("place_mirror_m"), (3,)))
        axes.append(as_float_array(f"receiver {r}: axis_mirror", table.get("axis_mirror"), (3,)))
        rows.append(as_float_array(f"receiver {r}: rows", table.get("rows"), ("row", _COLUMNS)))
    frequency = np.unique(np.concatenate([of_one[:, 0] for of_one in rows]))
    shape = (len(frequency), len(receivers), n_step + 1, 2 * n_step)
    if sum(map(len, rows)) < _FEWEST_GIVEN * np.prod([float(n) for n in shape]):
        raise InvalidInputError(
            f"of the {shape[2]} x {shape[3]} directions of {shape[0]} frequencies fewer than one in a hundred "
            "has a row; "
            "give `step_deg` as far apart as the rows are"
        )
    response, sigma = np.full((*shape, 2), np.nan, np.complex128), np.zeros(shape)
    for r, of_one in enumerate(rows):
        polar, azimuth = _on_grid(of_one[:, 1:3], step, n_step, r)
        at = (np.searchsorted(frequency, of_one[:, 0]), r, polar, azimuth)
        response[at] = of_one[:, 3:6:2] * np.exp(1j * np.radians(of_one[:, 4:7:2]))
        sigma[at] = of_one[:, 7]
    return AntennaPattern(
        frequency_hz=frequency,
        receiver_mirror_m=np.array(places),
        axis_mirror=np.array(axes),
        response=response,
        sigma=sigma,
    )


def _on_grid(angles_deg: FloatArray, step: float, n_step: int, receiver: int) -> tuple[Any, Any]:
    """Return rows and columns of directions (row, [polar, azimuth])."""
    index = np.rint(angles_deg / step)
    off = np.flatnonzero(
        (np.abs(index * step - angles_deg) > 1e-6).any(axis=1)
        | (index < 0).any(axis=1)
        | (index[:, 0] > n_step)
        | (index[:, 1] >= 2 * n_step)
    )
    if len(off):
        polar, azimuth = angles_deg[off[0]]
        raise InvalidInputError(
            f"receiver {receiver}: row {off[0]}: polar {polar:g}, azimuth {azimuth:g} is none of the directions 0, "
            f"{step:g}, … 180 and 0, {step:g}, … {360.0 - step:g}"
        )
    return index[:, 0].astype(np.int64), index[:, 1].astype(np.int64)


def _refuse_unknown(table: Mapping[str, Any], known: set[str], where: str) -> None:
    unknown = [key for key in table if key not in known]
    if unknown:
        raise InvalidInputError(f"{where}: no key is called {unknown[0]!r:.40}; known are {', '.join(sorted(known))}")
