"""Measurements of heliostats out of files: radio poses, pictures of a target, a drone's log, PAINT records.

Tables are CSV with a header; motor positions are ``axis_1`` and ``axis_2`` in the mount's counts, times ISO 8601 with
their zone.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rfpose.checks import FloatArray, as_float_array, as_positive
from rfpose.errors import InvalidInputError, RecordingError, RfposeError
from rfpose.feedback.camera.malan import Board, find_spot
from rfpose.feedback.camera.model import spot_sigma_rad, spots_enu_m
from rfpose.feedback.camera.spot import SpotStatus, read_picture
from rfpose.feedback.drone import drone_sigma_rad
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Mount
from rfpose.feedback.paint import heliostat_ids, read_heliostat
from rfpose.foreign import load_toml, read_text
from rfpose.pipeline.formats.mount_file import MountFile, StoredMount
from rfpose.sun import Location, sun_position, unix_seconds

if TYPE_CHECKING:
    from rfpose.pipeline.formats.result import Result

__all__ = ["MotorLog", "SourceMeasurements", "read_camera", "read_drone", "read_paint", "read_radio"]

BOARD_NAME, PICTURES_NAME = "board.toml", "pictures.csv"
_SPOT_SIGMA_M = 0.01
_LARGEST_TABLE_BYTES = 2**28
_LARGEST_NUMBER = 1e12
_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceMeasurements:
    """One source's measurements, by heliostat.

    Attributes
    ----------
    source
        ``"radio"``, ``"camera"``, ``"drone"`` or ``"PAINT"``.
    measurements
        By heliostat's name.
    left_out
        Why rows were left out, by what names them.
    failed
        Why heliostats gave nothing at all, by name.
    """

    source: str
    measurements: Mapping[str, Measurements]
    left_out: Mapping[str, str] = field(default_factory=dict)
    failed: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorLog:
    """Where motors stood.

    Attributes
    ----------
    entries
        By heliostat's name (entry, 3): time [s since 1970 UTC] and the positions of axis 1 and axis 2, in the course of
        time.
    """

    entries: Mapping[str, FloatArray]

    @classmethod
    def read(cls, path: Path) -> MotorLog:
        """Read a CSV file with the columns time_utc, heliostat, axis_1, axis_2."""
        log: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
        for row in _rows(path, ("time_utc", "heliostat", "axis_1", "axis_2")):
            log[row.text["heliostat"]].append((row.unix_s, row.number("axis_1"), row.number("axis_2")))
        return cls(entries={name: np.array(sorted(entries)) for name, entries in log.items()})

    def count(self, name: str, unix_s: float, *, within_s: float = 1.0) -> tuple[float, float] | None:
        """Return the positions nearest to a time; None where none was logged within so many seconds."""
        entries = self.entries.get(name)
        if entries is None:
            return None
        i = int(np.argmin(np.abs(entries[:, 0] - unix_s)))
        return (entries[i, 1], entries[i, 2]) if abs(entries[i, 0] - unix_s) <= within_s else None


def read_radio(results: Sequence[Result | str | Path], motors: Path, *, within_s: float = 1.0) -> SourceMeasurements:
    """Take solved poses of results, each with the motor positions that were logged nearest to its frame.

    Parameters
    ----------
    results
        As `rfpose.process` gives them, or files of them.
    motors
        CSV: time_utc, heliostat, axis_1, axis_2.
    within_s
        A log entry further from the frame than this does not count [s].
    """
    # a result's reader takes longer to load than a PAINT directory to read
    from rfpose.multilat import PoseStatus
    from rfpose.pipeline.formats.result import frame_time
    from rfpose.pipeline.formats.result_file import open_result

    log = MotorLog.read(motors)
    kept: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    left_out = {}
    for i_result, given in enumerate(results):
        result = open_result(given) if isinstance(given, str | Path) else given
        source = Path(given).name if isinstance(given, str | Path) else f"result {i_result}"
        for i, start in enumerate(result.frame_start_index):
            length = result.scenario.radio.frame_samples / result.scenario.radio.sample_rate_hz
            unix_s = frame_time(int(start), result.sample_rate).timestamp() + 0.5 * length
            for h, name in enumerate(result.scenario.heliostat_ids):
                status = PoseStatus(int(result.poses.status[i, h]))
                if not np.isfinite(result.poses.normal_enu[i, h]).all():
                    left_out[f"{source} frame {i} {name}"] = status.reason
                    continue
                count = log.count(name, unix_s, within_s=within_s)
                if count is None:
                    left_out[f"{source} frame {i} {name}"] = f"no motor position within {within_s:g} s"
                    continue
                sigma = max(float(result.poses.sigma_rad[i, h]) / math.sqrt(2.0), 1e-7)
                kept[name].append((unix_s, *count, *result.poses.normal_enu[i, h], sigma))
    if not kept:
        why = next(iter(left_out.values()), "no pose at all")
        raise RecordingError(f"{motors}: no pose has a motor position: {why}; check times and heliostats' names")
    return SourceMeasurements(
        source="radio",
        measurements={
            name: Measurements.from_normals(
                np.array(rows)[:, 1:3],
                normal_enu=np.array(rows)[:, 3:6],
                sigma_rad=np.array(rows)[:, 6],
                receiver_plane=True,
                unix_s=np.array(rows)[:, 0],
            )
            for name, rows in kept.items()
        },
        left_out=left_out,
    )


def read_paint(
    directory: Path, names: Sequence[str], *, algorithm: str = "both"
) -> tuple[SourceMeasurements, MountFile]:
    """Take PAINT records to be fitted together with other sources, and the mounts as built.

    Parameters
    ----------
    directory
        With the heliostats' folders and the tower's.
    names
        Heliostats; empty: all.
    algorithm
        As for `paint.read_heliostat`.
    """
    made, mounts = {}, {}
    left_out: dict[str, str] = {}
    failed: dict[str, str] = {}
    site = None
    for name in names or heliostat_ids(directory):
        try:
            data = read_heliostat(directory, name, algorithm=algorithm)
        except RfposeError as error:
            failed[name] = str(error)
            continue
        made[name] = Measurements.from_spots(
            data.count, sun_enu=data.sun_enu, spot_enu_m=data.spot_enu_m, unix_s=data.order_s
        )
        mounts[name] = StoredMount(mount=data.mount)
        left_out |= {f"{name} record {number}": why for number, why in data.skipped.items()}
        site = data.site
    if not made:
        raise RecordingError(f"{directory}: no heliostat can be used: {next(iter(failed.values()))}")
    gathered = SourceMeasurements(source="PAINT", measurements=made, left_out=left_out, failed=failed)
    return gathered, MountFile(heliostats=mounts, site=site)


def read_drone(path: Path, mounts: Mapping[str, Mount]) -> SourceMeasurements:
    """Take a drone's log: from where it saw which target in which mirror.

    Parameters
    ----------
    path
        CSV: heliostat, axis_1, axis_2, drone_east_m, drone_north_m, drone_up_m, target_east_m, target_north_m,
        target_up_m; time_utc if known.
    mounts
        For the distances that the noise depends on.
    """
    names = ("heliostat", "axis_1", "axis_2", *_enu("drone"), *_enu("target"))
    parts: dict[str, list[list[float]]] = defaultdict(list)
    for i, row in enumerate(_rows(path, names)):
        unix_s = row.unix_s if "time_utc" in row.text else float(i)
        parts[row.text["heliostat"]].append([unix_s, *(row.number(name) for name in names[1:])])
    made = {}
    for name, rows in parts.items():
        table = np.array(rows)
        sigma = drone_sigma_rad(table[:, 3:6], _pivot(path, mounts, name), target_enu_m=table[:, 6:9])
        made[name] = Measurements.from_points(
            table[:, 1:3], source_enu_m=table[:, 3:6], target_enu_m=table[:, 6:9], sigma_rad=sigma, unix_s=table[:, 0]
        )
    return SourceMeasurements(source="drone", measurements=made)


def read_camera(folder: Path, mounts: Mapping[str, Mount], site: Location | None) -> SourceMeasurements:
    """Take a folder of pictures of a target with one heliostat's beam each.

    Parameters
    ----------
    folder
        With ``pictures.csv`` (file, time_utc, heliostat, axis_1, axis_2) and ``board.toml``: centre_enu_m and
        normal_enu of the target, width_m, height_m, marker_centres_m; if wanted mm_per_px, corners_px, shape_px,
        spot_sigma_m.
    mounts
        For the distances that the noise depends on.
    site
        For the sun.
    """
    if site is None:
        raise InvalidInputError(
            f"{folder}: pictures need the sun: add [site] with latitude_deg, longitude_deg to the mounts"
        )
    centre, normal, board, spot_sigma_m = _board(folder / BOARD_NAME)
    left_out = {}
    parts: dict[str, list[list[float]]] = defaultdict(list)
    for row in _rows(folder / PICTURES_NAME, ("file", "time_utc", "heliostat", "axis_1", "axis_2")):
        picture = folder / row.text["file"]
        if not picture.resolve().is_relative_to(folder.resolve()):  # a folder from elsewhere reads no file of ours
            raise RecordingError(f"{folder / PICTURES_NAME}: names {picture}, outside the folder; copy it there")
        spot = find_spot(read_picture(picture), board)
        if spot.status != SpotStatus.OK:
            left_out[row.text["file"]] = f"{spot.status.name.lower().replace('_', ' ')}: {spot.text}"
            continue
        place = spots_enu_m(spot.centre_m, target_enu_m=centre, target_normal_enu=normal)
        parts[row.text["heliostat"]].append([row.unix_s, row.number("axis_1"), row.number("axis_2"), *place])
    if not parts:
        why = "; ".join(f"{name}: {text}" for name, text in list(left_out.items())[:3])
        raise RecordingError(f"{folder}: no picture holds a beam ({why or 'the table is empty'})")
    made = {}
    for name, rows in parts.items():
        table = np.array(rows)
        distance = np.linalg.norm(table[:, 3:6] - _pivot(folder, mounts, name), axis=1)
        try:
            made[name] = Measurements.from_spots(
                table[:, 1:3],
                sun_enu=sun_position(table[:, 0], site).direction_enu,
                spot_enu_m=table[:, 3:6],
                sigma_rad=spot_sigma_rad(spot_sigma_m, distance),
                unix_s=table[:, 0],
            )
        except RfposeError as error:
            raise RecordingError(
                f"{folder}: heliostat {name}: {error}; see {BOARD_NAME} and {PICTURES_NAME}"
            ) from error
    return SourceMeasurements(source="camera", measurements=made, left_out=left_out)


def _board(path: Path) -> tuple[list[float], list[float], Board, float]:
    """Place and shape of the target."""
    if not path.exists():
        raise RecordingError(f"{path}: is missing; it says where the target stands and where its markers are")
    table = load_toml(path)
    try:
        centre, normal = (
            as_float_array(name, table.pop(name), (3,)).tolist() for name in ("centre_enu_m", "normal_enu")
        )
        if not any(normal):
            raise InvalidInputError("`normal_enu` must have a direction, got 0, 0, 0")
        sigma = as_positive("spot_sigma_m", table.pop("spot_sigma_m", _SPOT_SIGMA_M))
        board = Board(**{key: _tuples(value) for key, value in table.items()})
    except KeyError as error:
        raise RecordingError(f"{path}: {error} is missing") from error
    except (TypeError, InvalidInputError) as error:
        raise RecordingError(f"{path}: {error}") from error
    return centre, normal, board, sigma


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _enu(what: str) -> tuple[str, ...]:
    return tuple(f"{what}_{axis}_m" for axis in ("east", "north", "up"))


def _pivot(path: Path, mounts: Mapping[str, Mount], name: str) -> Any:
    if name not in mounts:
        raise RecordingError(f"{path}: heliostat {name!r} has no mount; known are {', '.join(list(mounts)[:8])}")
    return mounts[name].pivot_enu_m


@dataclass(frozen=True, slots=True)
class _Row:
    """A line of a table that knows where it stands."""

    place: str
    text: Mapping[str, str]

    def number(self, name: str) -> float:
        text = self.text[name].strip()
        try:
            value = float(text)
        except ValueError as error:
            hint = "; write decimals with a point" if re.fullmatch(r"[+-]?\d+,\d+", text) else ""
            raise RecordingError(f"{self.place}: {name} must be a number, got {text!r:.40}{hint}") from error
        if not abs(value) <= _LARGEST_NUMBER:
            raise RecordingError(f"{self.place}: {name} must lie within ±{_LARGEST_NUMBER:g}, got {text!r:.40}")
        return value

    @property
    def unix_s(self) -> float:
        try:
            return float(unix_seconds([self.text["time_utc"]])[0])
        except InvalidInputError as error:
            raise RecordingError(f"{self.place}: {error}") from error


def _rows(path: Path, names: Sequence[str]) -> list[_Row]:
    """Lines of a CSV file that has certain columns."""
    text = read_text(path, limit=_LARGEST_TABLE_BYTES)
    try:
        reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
        found = [name.strip() for name in reader.fieldnames or ()]
        missing = [name for name in names if name not in found]
        if missing:
            header = text.lstrip().partition("\n")[0]
            separator = next((words for mark, words in _SEPARATORS.items() if mark in header), None)
            raise RecordingError(
                f"{path}: its columns have {separator} between; save it with commas, and decimals with a point"
                if separator
                else f"{path}: has no column {missing[0]}; needed are {', '.join(names)}"
            )
        reader.fieldnames = found
        rows = [
            _Row(f"{path} line {reader.line_num}", {k: v.strip() if v else "" for k, v in row.items() if k})
            for row in reader
        ]
    except csv.Error as error:
        raise RecordingError(f"{path}: cannot be read as CSV ({error}); save it again") from error
    if not rows:
        raise RecordingError(f"{path}: holds no line below its header")
    return rows
