"""The file of a tracking run: format ``rfpose-tracking``, HDF5, described in ``docs/tracking.md``."""

from __future__ import annotations

import csv
import datetime
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from rfpose.checks import FloatArray, read_only
from rfpose.errors import RecordingError, ScenarioError
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import METHODS, Score, Simulation, score
from rfpose.feedback.tracking._kernels import RADIO
from rfpose.feedback.tracking.budget import track_budget
from rfpose.feedback.tracking.loops import loop_margins_of
from rfpose.files import write_atomically
from rfpose.foreign import parse_json
from rfpose.kinds import check_kind, kind_of
from rfpose.pipeline.hdf5_values import DAMAGES, array_of, text_of
from rfpose.pipeline.result import LAST_TIME_S
from rfpose.pipeline.track_iq import IqCheck
from rfpose.recording.hdf5 import find_item
from rfpose.scenario import Scenario, parse_scenario

__all__ = [
    "FORMAT",
    "VERSION",
    "MethodTrack",
    "Track",
    "is_track",
    "read_track",
    "track_of",
    "write_track",
    "write_track_csv",
]

FORMAT = "rfpose-tracking"
VERSION = 2

_SEASONS = {"Dec-Feb": (12, 1, 2), "Mar-May": (3, 4, 5), "Jun-Aug": (6, 7, 8), "Sep-Nov": (9, 10, 11)}
_SERIES = {
    "rms_rad": ("rad", "time", "normal error over the field at that instant, rms"),
    "p95_rad": ("rad", "time", "the same, 95 %"),
    "worst_rad": ("rad", "time", "the same, worst mirror"),
    "normal_enu": ("1", "time, stored, xyz", "true normals of the stored mirrors"),
    "error_rad": ("rad", "time, stored", "angle between true and wanted normal"),
    "motor_count": ("steps", "time, stored, axis", "motor positions"),
    "shift_enu": ("rad", "time, stored, xyz", "what feedback adds to the normal that the model is asked for"),
    "flux": ("1", "time", "light on the receiver over that of a perfect field on its aim"),
    "mode_count": ("", "time, mode", "mirrors in each mode, numbered as under mode/name"),
    "mode": ("", "time, stored", "modes of the stored mirrors"),
}
_SCORES = {
    "heliostat_rms_rad": ("rad", "heliostat", "normal error, rms over all days"),
    "heliostat_p95_rad": ("rad", "heliostat", "normal error, 95 %"),
    "heliostat_worst_rad": ("rad", "heliostat", "normal error, worst"),
    "heliostat_intercept": ("1", "heliostat", "light caught over light that a perfect tracker would catch"),
    "hour_rms_rad": ("rad", "hour", "normal error by hour of local mean solar time"),
    "day_rms_rad": ("rad", "day", "normal error by day"),
    "day_worst_heliostat_rad": ("rad", "day", "rms of the day's worst mirror"),
    "day_intercept": ("1", "day", "by day"),
    "by_mode": ("s, J/m²", "mode, seconds-offered-caught", "time and light of a mirror in each mode, all days"),
}
_INTEGERS = ("mode_count", "mode", "stored", "day")
MODE_NAMES = tuple(mode.name.lower() for mode in Mode)
_FIELD = {
    "heliostat/pivot_enu_m": ("m", "heliostat, xyz", "nominal pivots"),
    "heliostat/target_enu_m": ("m", "heliostat, xyz", "aim points; NaN for a dish"),
    "heliostat/stored": ("", "stored", "row of each stored mirror"),
    "time/unix_s": ("s", "time", "instants of the series, UTC"),
    "time/day": ("", "time", "which day each belongs to"),
    "time/sun_enu": ("1", "time, xyz", "towards the sun"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodTrack:
    """What one method did; arrays as in the file, by name.

    Attributes
    ----------
    name, text
        Of the method.
    series
        ``rms_rad``, ``p95_rad``, ``worst_rad`` (time,); ``normal_enu`` (time, stored, xyz), ``error_rad`` (time,
        stored), ``motor_count`` (time, stored, axis), ``shift_enu`` (time, stored, xyz), ``flux`` (time,),
        ``mode_count`` (time, mode), ``mode`` (time, stored).
    scores
        ``heliostat_…`` (heliostat,), ``hour_rms_rad`` (24,), ``day_…`` (day,), ``by_mode`` (mode, 3).
    summary
        Plain values, as `Score.as_dict` gives them.
    happened
        Of each day under field control: ``events``, ``alarms``, ``calibrations``, ``messages``.
    """

    name: str
    text: str
    series: Mapping[str, npt.NDArray[Any]]
    scores: Mapping[str, npt.NDArray[Any]]
    summary: Mapping[str, Any]
    happened: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """A tracking run.

    Attributes
    ----------
    scenario
        As it was run.
    settings
        Seed, methods, version, as text.
    heliostat_ids, pivot_enu_m, target_enu_m, stored
        The mirrors, (heliostat, xyz) [m], and the rows of those whose courses are kept.
    dates
        Of the simulated days.
    unix_s, day, sun_enu
        Instants of the series.
    methods
        By name, in the order of the run.
    iq
        Mirrors of which samples were made, as `rfpose.pipeline.track_iq.IqCheck.as_dict` has them.
    """

    scenario: Scenario
    settings: Mapping[str, str]
    heliostat_ids: tuple[str, ...]
    pivot_enu_m: FloatArray
    target_enu_m: FloatArray
    stored: npt.NDArray[np.int64]
    dates: tuple[str, ...]
    unix_s: FloatArray
    day: npt.NDArray[np.int64]
    sun_enu: FloatArray
    methods: Mapping[str, MethodTrack]
    iq: tuple[Mapping[str, Any], ...] = ()

    def ranking(self) -> list[str]:
        """Return the methods' names, the one that catches most light first."""
        return sorted(self.methods, key=lambda name: -(self.methods[name].summary["intercept"] or 0.0))

    def _margins(self) -> dict[str, float] | None:
        """Return what the radio loop bears until it oscillates; None without radio in a loop."""
        if not any(METHODS[name].feedback == RADIO for name in self.methods if name in METHODS):
            return None
        found = loop_margins_of(self.scenario)
        return {
            "gain": found.gain,
            "phase_deg": float(np.rad2deg(found.phase_rad)),
            "more_latency_s": found.latency_s,
            "longest_interval_s": found.interval_s,
        }

    def as_dict(self) -> dict[str, Any]:
        """Return the run's summary with stable keys."""
        return {
            "scenario": self.scenario.name,
            "heliostats": len(self.heliostat_ids),
            "days": list(self.dates),
            "seed": int(self.settings["seed"]),
            "iq": [dict(each) for each in self.iq],
            "margins": self._margins(),
            "ranking": self.ranking(),
            "methods": {
                name: dict(method.summary) | ({"field_control": list(method.happened)} if method.happened else {})
                for name, method in self.methods.items()
            },
        }


def track_of(simulation: Simulation, settings: Mapping[str, str], *, iq: Sequence[IqCheck] = ()) -> Track:
    """Gather what a finished simulation found, and what samples of some of its mirrors did."""
    field = simulation.field
    target = field.target[:, :3].copy()
    target[field.target[:, 3] > 0.0] = np.nan
    methods = {}
    for method in simulation.methods:
        curves, found = simulation.curves(method.name), score(simulation.sums(method.name))
        methods[method.name] = MethodTrack(
            name=method.name,
            text=method.text,
            series={name: getattr(curves, name) for name in _SERIES},
            scores={name: getattr(found, name) for name in _SCORES},
            summary=_plain(found.as_dict() | _over_the_year(simulation, found) | _foreseen(simulation, method.name)),
            happened=tuple(simulation.happened(method.name)),
        )
    return Track(
        scenario=simulation.scenario,
        settings=dict(settings),
        heliostat_ids=field.ids,
        pivot_enu_m=read_only(field.pivot_enu_m),
        target_enu_m=read_only(target),
        stored=read_only(simulation.stored),
        dates=tuple(str(day.date) for day in simulation.days),
        unix_s=read_only(simulation.stored_unix_s),
        day=read_only(simulation.stored_day),
        sun_enu=read_only(simulation.stored_sun_enu),
        methods=methods,
        iq=tuple(_plain(each.as_dict()) for each in iq),
    )


def _foreseen(simulation: Simulation, method: str) -> dict[str, Any]:
    """Return the error budget of a method, which knows nothing of the simulation."""
    budget = track_budget(simulation.scenario, method, count=len(simulation.field)).as_dict()
    del budget["method"]
    return {"budget": budget}


def _over_the_year(simulation: Simulation, found: Score) -> dict[str, Any]:
    """Return errors by season, and what days that stand for a year make of one: light caught and lost [kWh/m²]."""
    plan = simulation.scenario.tracking
    month = np.array([day.date.month for day in simulation.days])
    seasons = {}
    for name, months in _SEASONS.items():
        squares = found.day_rms_rad[np.isin(month, months)] ** 2
        if np.isfinite(squares).any():
            seasons[name] = 1e3 * float(np.sqrt(np.nanmean(squares)))
    year = None
    if plan.days > 1 and 330 <= plan.days * plan.day_interval <= 400:
        _, offered, caught = found.by_mode.sum(axis=0) / plan.days * 365.25 / 3.6e6
        year = {"caught_kwh_per_m2": caught, "lost_kwh_per_m2": offered - caught}
    return {"season_rms_mrad": seasons, "year": year}


def _plain(found: Mapping[str, Any]) -> dict[str, Any]:
    """Give lists instead of arrays, None instead of NaN: as JSON would give them back."""

    def plain(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, np.ndarray | list):
            return [plain(item) for item in value]
        if isinstance(value, np.generic):
            value = value.item()
        if value is None or isinstance(value, str):
            return value
        return None if not np.isfinite(value) else value

    result: dict[str, Any] = plain(found)
    return result


def write_track(track: Track, path: str | Path) -> None:
    """Write a run in one go; the same run gives the same bytes.

    Raises
    ------
    RecordingError
        The file cannot be written; what stood under ``path`` is untouched.
    """
    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v110", "v110")) as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        file.create_dataset("scenario", data=track.scenario.to_toml())
        settings = file.create_group("settings")
        for name, text in sorted(track.settings.items()):
            settings.attrs[name] = text
        _texts(file, "heliostat/id", track.heliostat_ids)
        _texts(file, "day/date", track.dates)
        _texts(file, "mode/name", MODE_NAMES)
        for place, name in (
            ("heliostat/pivot_enu_m", "pivot_enu_m"),
            ("heliostat/target_enu_m", "target_enu_m"),
            ("heliostat/stored", "stored"),
            ("time/unix_s", "unix_s"),
            ("time/day", "day"),
            ("time/sun_enu", "sun_enu"),
        ):
            _write(file, place, getattr(track, name), _FIELD[place])
        file.create_dataset("iq", data=json.dumps(track.iq))
        file.attrs["methods"] = json.dumps(list(track.methods))
        for method in track.methods.values():
            group = file.create_group(f"method/{method.name}")
            group.attrs["text"] = method.text
            group.attrs["summary"] = json.dumps(method.summary)
            group.create_dataset("happened", data=json.dumps(method.happened))
            for name, key in _SERIES.items():
                _write(group, name, method.series[name], key)
            for name, key in _SCORES.items():
                _write(group, f"score/{name}", method.scores[name], key)
    write_atomically(path, image.getvalue())


def _write(file: h5py.Group, place: str, values: npt.NDArray[Any], key: tuple[str, str, str]) -> None:
    unit, axes, meaning = key
    dataset = file.create_dataset(place, data=np.asarray(values))
    dataset.attrs["unit"], dataset.attrs["axes"], dataset.attrs["meaning"] = unit, axes, meaning


def _texts(file: h5py.File, place: str, texts: tuple[str, ...]) -> None:
    file.create_dataset(place, data=np.array(texts, dtype=object), dtype=h5py.string_dtype())


def is_track(path: str | Path) -> bool:
    """Tell whether a file says that it is an rfpose-tracking; false for whatever cannot be opened."""
    return kind_of(path) == "track"


def read_track(path: str | Path) -> Track:
    """Read a tracking run.

    Raises
    ------
    RecordingError
        Missing, truncated, another format or version, or something in it is missing, of another type or shape, or says
        what no run says; the message names the file and the place.
    """
    path = Path(path)
    check_kind(path, wanted="track")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("version") != VERSION:
                raise RecordingError(f"{path}: is no {FORMAT} of version {VERSION}; {_AGAIN}")
            return _Reader(path, file).track()
    except RecordingError:
        raise
    except DAMAGES as error:
        raise RecordingError(
            f"{path}: cannot be read as {FORMAT} ({error}); it is truncated or another kind of file: {_AGAIN}"
        ) from error


_AGAIN = "run `rfpose track` again"


class _Checked(BaseModel):
    """A part of a method's JSON that something shows; what else stands there may be anything."""

    model_config = ConfigDict(extra="allow", strict=True)


class _Errors(_Checked):
    rms: float | None
    p95: float | None
    worst: float | None


class _OfMode(_Checked):
    hours: float
    offered_kwh_per_m2: float
    lost_kwh_per_m2: float


class _Summary(_Checked):
    normal_mrad: _Errors
    intercept: float | None
    availability: float | None
    energy_kwh_per_m2: float
    modes: dict[Literal[MODE_NAMES], _OfMode]  # type: ignore[valid-type]


class _Event(_Checked):
    hour: float
    what: str
    heliostats: int
    refused: dict[str, int] = {}


class _Alarm(_Checked):
    hour: float
    alarm: str
    below_tenth_s: float | None
    off_s: float | None
    stowed_median_s: float | None
    stowed_s: float | None


class _Calibration(_Checked):
    heliostat: str
    outcome: str
    searched: bool
    took_s: float
    offset_mm: list[float] | None


class _Messages(_Checked):
    __pydantic_extra__: dict[str, int]
    orders_sent: int
    orders_refused: int
    watchdog_emergencies: int


class _Happened(_Checked):
    events: list[_Event]
    alarms: list[_Alarm]
    calibrations: list[_Calibration]
    messages: _Messages


_HAPPENED = TypeAdapter(list[_Happened])
_TEXTS = TypeAdapter(list[str])
_TABLES = TypeAdapter(list[dict[str, Any]])
_SUMMARY = TypeAdapter(_Summary)


class _Reader:
    """Reads one open file; each complaint names the file and the place in it."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self._path = path
        self._file = file
        self._length = {"xyz": 3, "axis": 2, "hour": 24, "mode": len(Mode), "seconds-offered-caught": 3}

    def track(self) -> Track:
        ids, dates = self._names("heliostat/id"), self._names("day/date")
        self._length |= {"heliostat": len(ids), "day": len(dates)}
        field = {place.partition("/")[2]: self._array(place, key[1]) for place, key in _FIELD.items()}
        self._check_index("heliostat/stored", field["stored"], 0, len(ids))
        self._check_index("time/day", field["day"], 0, len(dates))
        late = ~((field["unix_s"] >= 0.0) & (field["unix_s"] <= LAST_TIME_S))
        if late.any():
            raise self._error("time/unix_s", f"holds {field['unix_s'][late][0]}, no time until the year 9999")
        for date in dates:
            try:
                datetime.date.fromisoformat(date)
            except ValueError as error:
                raise self._error("day/date", f"holds {date!r:.40}, which is no date") from error
        settings = {name: str(value) for name, value in self._group("settings").attrs.items()}
        if not re.fullmatch(r"[0-9]{1,20}", settings.get("seed", "")):
            raise self._error("settings", "lacks the attribute `seed`, or it is no number")
        try:
            scenario = parse_scenario(text_of(self._file, "/scenario"), source=f"{self._path}:/scenario")
        except ScenarioError as error:
            raise RecordingError(f"{error}; the run is damaged: {_AGAIN}") from error
        except ValueError as error:
            raise self._error("scenario", str(error)) from error
        return Track(
            scenario=scenario,
            settings=settings,
            heliostat_ids=ids,
            dates=dates,
            methods={name: self._method(name) for name in self._json(_TEXTS, "methods", self._file)},
            iq=tuple(self._json(_TABLES, "iq")),
            **field,
        )

    def _method(self, name: str) -> MethodTrack:
        place = f"method/{name}"
        group = self._group(place)
        series = {key: self._array(f"{place}/{key}", axes) for key, (_, axes, _) in _SERIES.items()}
        self._check_index(f"{place}/mode", series["mode"], -1, len(Mode))
        return MethodTrack(
            name=name,
            text=str(group.attrs.get("text", METHODS[name].text if name in METHODS else name)),
            series=series,
            scores={key: self._array(f"{place}/score/{key}", axes) for key, (_, axes, _) in _SCORES.items()},
            summary=self._json(_SUMMARY, f"{place} summary", group),
            happened=tuple(self._json(_HAPPENED, f"{place}/happened")),
        )

    def _error(self, place: str, what: str) -> RecordingError:
        return RecordingError(f"{self._path}: `/{place}` {what}; the run is damaged: {_AGAIN}")

    def _group(self, place: str) -> h5py.Group:
        found = find_item(self._file, f"/{place}", follow_links=False)
        if not isinstance(found, h5py.Group):
            raise self._error(place, "is missing or no group")
        return found

    def _names(self, place: str) -> tuple[str, ...]:
        dataset = find_item(self._file, f"/{place}", follow_links=False)
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or not h5py.check_string_dtype(dataset.dtype):
            raise self._error(place, "is missing or no list of texts")
        try:
            return tuple(dataset.asstr()[()].tolist())
        except RecordingError:
            raise
        except DAMAGES as error:
            raise self._error(place, f"cannot be read ({error})") from error

    def _json(self, wanted: TypeAdapter[Any], place: str, group: h5py.Group | None = None) -> Any:
        """Return what a text says; that of an attribute of ``group``, named by the place's last word, if given."""
        try:
            raw = text_of(self._file, f"/{place}") if group is None else group.attrs[place.rpartition(" ")[2]]
        except RecordingError:
            raise
        except DAMAGES as error:
            raise self._error(place, f"is missing or no text ({error})") from error
        if not isinstance(raw, str):
            raise self._error(place, "is no text")
        found = parse_json(raw, source=f"{self._path}: `/{place}`", remedy=f"the run is damaged: {_AGAIN}")
        try:
            wanted.validate_python(found)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise self._error(place, f"`{where}`: {first['msg'][:1].lower()}{first['msg'][1:]}") from error
        return found

    def _array(self, place: str, axes: str) -> npt.NDArray[Any]:
        dataset = find_item(self._file, f"/{place}", follow_links=False)
        name = place.rpartition("/")[2]
        kind = "iu" if name in _INTEGERS else "f"
        if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in kind:
            raise self._error(place, f"is missing or holds no {'integers' if kind == 'iu' else 'numbers'}")
        wanted = axes.split(", ")
        lengths = [self._length.setdefault(axis, n) for axis, n in zip(wanted, dataset.shape, strict=False)]
        if len(wanted) != dataset.ndim or tuple(lengths) != dataset.shape:
            raise self._error(place, f"has shape {dataset.shape}, not ({axes})")
        try:
            return read_only(array_of(self._file, f"/{place}", dataset.dtype.newbyteorder("=")))
        except RecordingError:
            raise
        except DAMAGES as error:
            raise self._error(place, str(error)) from error

    def _check_index(self, place: str, values: npt.NDArray[Any], least: int, end: int) -> None:
        bad = values[(values < least) | (values >= end)]
        if bad.size:
            raise self._error(place, f"holds {bad[0]}, which means nothing")


def write_track_csv(track: Track, path: str | Path) -> None:
    """Write one row a method and mirror: errors of the normal [mrad], intercept."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["method", "heliostat", "normal_rms_mrad", "normal_p95_mrad", "normal_worst_mrad", "intercept"])
    columns = ("heliostat_rms_rad", "heliostat_p95_rad", "heliostat_worst_rad")
    for method in track.methods.values():
        for i, name in enumerate(track.heliostat_ids):
            errors = [f"{1e3 * method.scores[c][i]:.6g}" for c in columns]
            writer.writerow([method.name, name, *errors, f"{method.scores['heliostat_intercept'][i]:.6g}"])
    write_atomically(path, text.getvalue().encode())
