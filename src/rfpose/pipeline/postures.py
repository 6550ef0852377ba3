"""Where mirrors were told to point, frame by frame."""

from __future__ import annotations

import csv
import io
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.foreign import read_text
from rfpose.scenario import Scenario
from rfpose.sun import unix_seconds

__all__ = ["commanded_normals", "read_postures"]

_log = logging.getLogger(__name__)

_LONGEST_BYTES = 2**28
_ANGLES = ("azimuth_deg", "elevation_deg")
_NORMAL = ("normal_e", "normal_n", "normal_u")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Line:
    """One line of a table of postures: of whom, when (a number of a frame, a time, or always), and the normal."""

    id: str
    frame: int | None
    unix_s: float | None
    normal_enu: FloatArray


def commanded_normals(scenario: Scenario, unix_s: npt.ArrayLike, *, simulated: bool = False) -> FloatArray:
    """Return where a scenario's mirrors were told to point (frame, mirror, xyz), as unit normals.

    Of each mirror the first that is known: the table ``[posture] csv``; its own ``normal_enu``; the sun at the frame's
    time sent to the aim point; the simulated sun of ``[simulation]`` sent there.

    Parameters
    ----------
    scenario
    unix_s : (frame,)
        Time of each frame [s since 1970 UTC]. NaN: unknown.
    simulated
        Whether the frames are simulated: then the simulated sun goes before that of the time.

    Returns
    -------
    (frame, mirror, xyz)
        Of `Scenario.mirrors`, heliostats and plates. NaN: unknown; the log says so once.

    Raises
    ------
    ScenarioError
        The table cannot be used; the message names file and line.
    """
    time = as_float_array("unix_s", unix_s, ("frame",), finite=False)
    mirrors = scenario.mirrors
    out = np.full((len(time), len(mirrors), 3), np.nan)
    if scenario.posture.csv is not None:
        out[:] = read_postures(scenario.posture.csv, [m.id for m in mirrors], time)
    for i, mirror in enumerate(mirrors):
        if mirror.normal_enu is not None:
            _fill(out[:, i], geometry.unit(mirror.normal_enu))
    suns = [scenario.sun_enu(time), _sun_by_hand(scenario, len(time))]
    for sun in reversed(suns) if simulated else suns:
        following = None if sun is None else scenario.following_enu(sun)
        if following is not None:
            _fill(out, following)
    unknown = [m.id for m, gone in zip(mirrors, np.isnan(out).any(axis=(0, 2)), strict=True) if gone]
    if unknown and len(time):
        _log.warning(
            "%d of %d mirrors have frames without a known posture, such as `%s`: they are left out of what is foreseen "
            "there; give [posture] csv, or `site.latitude_deg`, `site.longitude_deg` and `site.aim_enu_m`",
            len(unknown), len(mirrors), unknown[0],
        )  # fmt: skip
    return out


def _fill(out: FloatArray, normal: FloatArray) -> None:
    np.copyto(out, normal, where=np.isnan(out))


def _sun_by_hand(scenario: Scenario, n_frame: int) -> FloatArray | None:
    """(frame, xyz) towards the sun that ``[simulation]`` places by hand, which rests when the simulation has ended."""
    suns = None if scenario.simulation.sun_azimuth_deg is None else scenario.simulated_suns_enu
    return None if suns is None else suns[np.minimum(np.arange(n_frame), len(suns) - 1)]


def read_postures(path: str | Path, ids: list[str], unix_s: npt.ArrayLike) -> FloatArray:
    """Read a table of commanded postures.

    CSV with a header; lines that begin with # are passed over, as are other columns and mirrors. ``id``; when, as
    ``frame`` (a number, from zero), ``time`` (ISO 8601 with time zone) or neither (always); the mirror's normal as
    ``azimuth_deg`` (from north, clockwise) and ``elevation_deg``, or as ``normal_e``, ``normal_n``, ``normal_u``.

    Parameters
    ----------
    path
    ids
        Of the mirrors that are wanted.
    unix_s : (frame,)
        Time of each frame [s since 1970 UTC]. NaN: unknown.

    Returns
    -------
    (frame, mirror, xyz)
        Unit normals; between a mirror's times the normal turns evenly. NaN: not in the table; before its first time or
        after its last.

    Raises
    ------
    ScenarioError
        No such file, no such columns, a cell that is no number or time, two lines for one mirror and instant.
    """
    path = Path(path)
    time = as_float_array("unix_s", unix_s, ("frame",), finite=False)
    wanted = {name: i for i, name in enumerate(ids)}
    by_mirror: dict[str, list[_Line]] = {}
    for line in _lines(path):
        if line.id in wanted:
            by_mirror.setdefault(line.id, []).append(line)
    out = np.full((len(time), len(ids), 3), np.nan)
    for name, lines in by_mirror.items():
        here = out[:, wanted[name]]
        if lines[0].unix_s is not None:
            here[:] = _between(path, name, lines, time)
            continue
        seen = set()
        for one in lines:
            if one.frame in seen:
                when = "" if one.frame is None else f" in frame {one.frame}"
                raise ScenarioError(f"{path}: mirror `{name}` has two postures{when}; remove one")
            seen.add(one.frame)
            if one.frame is None:
                here[:] = one.normal_enu
            elif one.frame < len(time):
                here[one.frame] = one.normal_enu
    return out


def _between(path: Path, name: str, lines: list[_Line], unix_s: FloatArray) -> FloatArray:
    at = np.array([one.unix_s for one in lines], np.float64)
    order = np.argsort(at, kind="stable")
    if np.any(np.diff(at[order]) == 0.0):
        raise ScenarioError(f"{path}: mirror `{name}` has two postures at one time; remove one")
    normal = np.array([lines[k].normal_enu for k in order])
    known = np.isfinite(unix_s)
    out = np.full((len(unix_s), 3), np.nan)
    for axis in range(3):
        out[known, axis] = np.interp(unix_s[known], at[order], normal[:, axis], left=np.nan, right=np.nan)
    return geometry.unit(out)


def _lines(path: Path) -> list[_Line]:
    text = read_text(path, limit=_LONGEST_BYTES, error=ScenarioError, remedy="postures are CSV in UTF-8: correct it")
    rows = [(k, row) for k, row in enumerate(io.StringIO(text), start=1) if row.strip() and not row.startswith("#")]
    if not rows:
        raise ScenarioError(
            f"{path}: empty; the first line must name columns such as id,time,azimuth_deg,elevation_deg"
        )
    header = [cell.strip() for cell in _cells(path, *rows[0])]
    if len(header) == 1 and ";" in header[0]:
        raise ScenarioError(f"{path}: columns are separated by `;`; save it with commas, and with points in numbers")
    form = next((names for names in (_ANGLES, _NORMAL) if all(name in header for name in names)), None)
    if "id" not in header or form is None:
        raise ScenarioError(
            f"{path}: line {rows[0][0]} must name the columns `id` and `azimuth_deg`, `elevation_deg` or `normal_e`, "
            f"`normal_n`, `normal_u`, got {', '.join(header)}"
        )
    if "frame" in header and "time" in header:
        raise ScenarioError(f"{path}: has columns `frame` and `time`; keep the one that counts")
    return [_line(f"{path}: line {number}", header, form, _cells(path, number, row)) for number, row in rows[1:]]


def _cells(path: Path, number: int, line: str) -> list[str]:
    try:
        return next(csv.reader([line], strict=True), [])
    except csv.Error as error:
        raise ScenarioError(f"{path}: line {number} is no CSV: {error}; correct it") from error


def _line(place: str, header: list[str], form: tuple[str, ...], cells: list[str]) -> _Line:
    if len(cells) != len(header):
        raise ScenarioError(f"{place} has {len(cells)} cells, the header {len(header)}; mend that line")
    text = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
    values = [_number(place, name, text[name]) for name in form]
    normal = geometry.enu_from_azimuth_elevation(*np.radians(values)) if form == _ANGLES else np.array(values)
    if np.linalg.norm(normal) < 1e-9:
        raise ScenarioError(f"{place}: the normal must not be zero")
    frame, unix_s = None, None
    if "frame" in text:
        number = _number(place, "frame", text["frame"])
        if number < 0 or number != round(number):
            raise ScenarioError(f"{place}: `frame` must be a whole number from zero on, got {text['frame']}")
        frame = int(number)
    elif "time" in text:
        try:
            unix_s = float(unix_seconds([text["time"]])[0])
        except InvalidInputError as error:
            raise ScenarioError(f"{place}: `time`: {error}") from error
    return _Line(id=text["id"], frame=frame, unix_s=unix_s, normal_enu=geometry.unit(normal))


def _number(place: str, name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError as error:
        raise ScenarioError(f"{place}: `{name}` must be a number, got {cell!r:.40}") from error
    if not abs(value) < 1e9:
        raise ScenarioError(f"{place}: `{name}` must be finite and within reason, got {cell}")
    return value
