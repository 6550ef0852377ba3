"""The file of a tracking run: format ``rfpose-tracking``, HDF5, described in ``docs/tracking.md``."""

from __future__ import annotations

import datetime
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import h5py
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import METHODS, Score, TrackingSimulation, score
from rfpose.feedback.tracking.budget import track_budget
from rfpose.feedback.tracking.loops import loop_margins_of
from rfpose.files import write_atomically
from rfpose.foreign import parse_json
from rfpose.kinds import kind_of
from rfpose.pipeline.formats.columns import (
    ENU,
    Column,
    ColumnWriter,
    Labels,
    dataset_of,
    seconds_since,
    text_label,
    write_names,
)
from rfpose.pipeline.formats.hdf5_values import DAMAGES, FileReader, opened, text_of
from rfpose.pipeline.formats.result import LAST_TIME_S
from rfpose.pipeline.track_iq import IqCheck
from rfpose.recording.hdf5 import find_item
from rfpose.scenario import Scenario
from rfpose.shown import Shown, counted, number, plain
from rfpose.tables import Tabled

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = [
    "FORMAT",
    "VERSION",
    "MethodTrack",
    "Track",
    "is_track",
    "open_track",
    "track_of",
    "write_track",
]

FORMAT = "rfpose-tracking"
VERSION = 2

_SEASONS = {"Dec-Feb": (12, 1, 2), "Mar-May": (3, 4, 5), "Jun-Aug": (6, 7, 8), "Sep-Nov": (9, 10, 11)}
_SERIES = {
    "rms_rad": Column(("time",), "f8", "rad", "normal error over the field at that instant, rms"),
    "p95_rad": Column(("time",), "f8", "rad", "the same, 95 %"),
    "worst_rad": Column(("time",), "f8", "rad", "the same, worst mirror"),
    "normal_enu": Column(("time", "stored", "xyz"), "f8", "1", "true normals of the stored mirrors"),
    "error_rad": Column(("time", "stored"), "f8", "rad", "angle between true and wanted normal"),
    "motor_count": Column(("time", "stored", "axis"), "f8", "steps", "motor positions"),
    "shift_enu": Column(
        ("time", "stored", "xyz"), "f8", "rad", "what feedback adds to the normal that the model is asked for"
    ),
    "flux": Column(("time",), "f8", "1", "light on the receiver over that of a perfect field on its aim"),
    "mode_count": Column(("time", "mode_name"), "i4", "1", "mirrors in each mode, numbered as under mode/name"),
    "mode": Column(("time", "stored"), "i1", "", "modes of the stored mirrors", Mode),
}
_SCORES = {
    "heliostat_rms_rad": Column(("heliostat",), "f8", "rad", "normal error, rms over all days"),
    "heliostat_p95_rad": Column(("heliostat",), "f8", "rad", "normal error, 95 %"),
    "heliostat_worst_rad": Column(("heliostat",), "f8", "rad", "normal error, worst"),
    "heliostat_intercept": Column(
        ("heliostat",), "f8", "1", "light caught over light that a perfect tracker would catch"
    ),
    "hour_rms_rad": Column(("hour",), "f8", "rad", "normal error by hour of local mean solar time"),
    "day_rms_rad": Column(("day",), "f8", "rad", "normal error by day"),
    "day_worst_heliostat_rad": Column(("day",), "f8", "rad", "rms of the day's worst mirror"),
    "day_intercept": Column(("day",), "f8", "1", "by day"),
    "by_mode": Column(("mode_name", "total"), "f8", "s, J/m²", "time and light of a mirror in each mode, all days"),
}
MODE_NAMES = tuple(mode.name.lower() for mode in Mode)
_FIELD = {
    "heliostat/pivot_enu_m": Column(("heliostat", "xyz"), "f8", "m", "nominal pivots"),
    "heliostat/target_enu_m": Column(("heliostat", "xyz"), "f8", "m", "aim points; NaN for a dish"),
    "heliostat/stored": Column(("stored",), "i8", "index", "row of each stored mirror"),
    "time/unix_s": Column(("time",), "f8", "s", "instants of the series, UTC"),
    "time/day": Column(("time",), "i8", "index", "which day each belongs to"),
    "time/sun_enu": Column(("time", "xyz"), "f8", "1", "towards the sun"),
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


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Track(Shown, Tabled):
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

    def headline(self) -> str:
        """Return of what, how much, and the method that catches most light."""
        counts = f"{counted(len(self.heliostat_ids), 'mirror')}, {counted(len(self.dates), 'day')}"
        return f"{self.scenario.name!r}: {counts}, best {self.ranking()[0]}"

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return one row a method, the one that catches most light first; errors of the normal [mrad]."""
        rows = []
        for name in self.ranking():
            found = self.methods[name].summary
            cells = (*(found["normal_mrad"][key] for key in ("rms", "p95", "worst")), found["intercept"])
            rows.append([name, *(number(cell, 4) for cell in cells)])
        return ["method", "rms [mrad]", "95 % [mrad]", "worst [mrad]", "light caught"], rows

    def table(self) -> tuple[list[str], list[list[Any]]]:
        """Return one row a method and mirror: errors of the normal [mrad], intercept."""
        columns = ("heliostat_rms_rad", "heliostat_p95_rad", "heliostat_worst_rad")
        rows: list[list[Any]] = []
        for method in self.methods.values():
            for i, name in enumerate(self.heliostat_ids):
                errors = [1e3 * float(method.scores[c][i]) for c in columns]
                rows.append([method.name, name, *errors, float(method.scores["heliostat_intercept"][i])])
        header = ["method", "heliostat", "normal_rms_mrad", "normal_p95_mrad", "normal_worst_mrad", "intercept"]
        return header, rows

    def series_table(self) -> tuple[list[str], list[list[Any]]]:
        """Return one row a method and instant: errors [mrad], flux, mirrors in each mode, and the stored mirrors.

        Times are the series' own: UTC, and local mean solar time [h].
        """
        modes = [k for k in range(len(Mode)) if any(m.series["mode_count"][:, k].any() for m in self.methods.values())]
        names = [self.heliostat_ids[i] for i in self.stored]
        header = ["method", "day", "time_utc", "solar_hour", "normal_rms_mrad", "normal_p95_mrad", "normal_worst_mrad"]
        header += ["flux", *(f"mirrors_{MODE_NAMES[k]}" for k in modes)]
        header += [*(f"normal_{name}_mrad" for name in names), *(f"mode_{name}" for name in names)]
        hour = np.mod(self.unix_s / 3600.0 + (self.scenario.site.longitude_deg or 0.0) / 15.0, 24.0)
        rows: list[list[Any]] = []
        for name, method in self.methods.items():
            kept = method.series
            for k, unix_s in enumerate(self.unix_s):
                time = datetime.datetime.fromtimestamp(float(unix_s), datetime.UTC)
                errors = [1e3 * float(kept[key][k]) for key in ("rms_rad", "p95_rad", "worst_rad")]
                counts = [int(kept["mode_count"][k, i]) for i in modes]
                mine = [
                    *(1e3 * kept["error_rad"][k]).tolist(),
                    *(MODE_NAMES[i] if i >= 0 else "" for i in kept["mode"][k]),
                ]
                day = self.dates[int(self.day[k])]
                rows.append([name, day, time, float(hour[k]), *errors, float(kept["flux"][k]), *counts, *mine])
        return header, rows

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the run, format ``rfpose-tracking``.

        Parameters
        ----------
        path
            File to write.
        force
            Overwrite what exists.

        Raises
        ------
        RecordingError
            The file exists, or cannot be written.
        """
        write_track(self, path, force=force)

    def to_xarray(self, method: str) -> xr.Dataset:
        """Return what a method did, with labelled dimensions: time, mirrors, modes; needs xarray.

        Series over time have the names of the file, scores ``score_`` before theirs; ``sun_enu`` and the mirrors'
        places are there too.

        Raises
        ------
        InvalidInputError
            xarray is not installed; the run has no such method.
        """
        if method not in self.methods:
            raise InvalidInputError(f"`method` must be one of {', '.join(self.methods)}, got {method!r}")
        found = self.methods[method]
        columns = {name: (column, found.series[name]) for name, column in _SERIES.items()}
        columns |= {f"score_{name}": (column, found.scores[name]) for name, column in _SCORES.items()}
        for place, column in _FIELD.items():
            name = place.partition("/")[2]
            if name not in ("stored", "unix_s"):  # the labels of two dimensions; `day` is the name of a third
                columns["i_day" if name == "day" else name] = (column, getattr(self, name))
        return dataset_of(
            columns, _labels(self), {"scenario": self.scenario.name, "method": found.text, **self.settings}
        )

    def plot(self) -> Figure:
        """Draw error, flux and modes in the course of the first day, errors spread over mirrors, and by day."""
        from rfpose.pipeline.pictures.tracking import draw_track

        return draw_track(self)

    def ranking(self) -> list[str]:
        """Return the methods' names, the one that catches most light first."""
        return sorted(self.methods, key=lambda name: -(self.methods[name].summary["intercept"] or 0.0))

    def _margins(self) -> dict[str, float] | None:
        """Return what the radio loop bears until it oscillates; None without radio in a loop."""
        if not any(METHODS[name].closes_by_radio for name in self.methods if name in METHODS):
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


def track_of(simulation: TrackingSimulation, settings: Mapping[str, str], *, iq: Sequence[IqCheck] = ()) -> Track:
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
            summary=plain(found.as_dict() | _over_the_year(simulation, found) | _foreseen(simulation, method.name)),
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
        iq=tuple(plain(each.as_dict()) for each in iq),
    )


def _foreseen(simulation: TrackingSimulation, method: str) -> dict[str, Any]:
    """Return the error budget of a method, which knows nothing of the simulation."""
    budget = track_budget(simulation.scenario, method, count=len(simulation.field)).as_dict()
    del budget["method"]
    return {"budget": budget}


def _over_the_year(simulation: TrackingSimulation, found: Score) -> dict[str, Any]:
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


def write_track(track: Track, path: str | Path, *, force: bool = True) -> None:
    """Write a run in one go; the same run gives the same bytes. Without ``force`` nothing is replaced.

    Raises
    ------
    RecordingError
        The file exists and may not be replaced, or cannot be written; what stood under ``path`` is untouched.
    """
    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v110", "v110")) as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        file.create_dataset("scenario", data=track.scenario.to_toml())
        settings = file.create_group("settings")
        for name, text in sorted(track.settings.items()):
            settings.attrs[name] = text
        write_names(file, "heliostat/id", track.heliostat_ids)
        write_names(file, "day/date", track.dates)
        write_names(file, "mode/name", MODE_NAMES)
        # one set of scales a group, since groups have the names of dimensions and the root has no room for both
        labels = _labels(track)
        writers = {top: ColumnWriter(file.require_group(top), labels) for top in ("heliostat", "time", "method")}
        for place, column in _FIELD.items():
            top, _, name = place.partition("/")
            writers[top].write(file[top], name, column, getattr(track, name))
        file.create_dataset("iq", data=json.dumps(track.iq))
        file.attrs["methods"] = json.dumps(list(track.methods))
        for method in track.methods.values():
            group = file.create_group(f"method/{method.name}")
            group.attrs["text"] = method.text
            group.attrs["summary"] = json.dumps(method.summary)
            group.create_dataset("happened", data=json.dumps(method.happened))
            for name, column in _SERIES.items():
                writers["method"].write(group, name, column, method.series[name])
            for name, column in _SCORES.items():
                writers["method"].write(group.require_group("score"), name, column, method.scores[name])
    write_atomically(path, image.getvalue(), force=force)


def _labels(track: Track) -> Labels:
    """Return what the entries along each dimension are called."""
    return {
        "time": seconds_since(track.unix_s, "seconds", "instant of the series, UTC"),
        "heliostat": text_label(track.heliostat_ids, "heliostat"),
        "stored": text_label([track.heliostat_ids[i] for i in track.stored], "heliostat whose course is kept"),
        "day": text_label(track.dates, "simulated day"),
        "hour": (np.arange(24), {"long_name": "hour of local mean solar time"}),
        "mode_name": text_label(MODE_NAMES, "mode"),
        "axis": (np.array([1, 2]), {"long_name": "axis of the mount"}),
        "xyz": text_label(ENU, "axis of the site's frame"),
        "total": text_label(("seconds", "offered", "caught"), "what is summed"),
    }


def is_track(path: str | Path) -> bool:
    """Tell whether a file says that it is an rfpose-tracking; false for whatever cannot be opened."""
    return kind_of(path) == "track"


def open_track(path: str | Path) -> Track:
    """Read a tracking run.

    Raises
    ------
    RecordingError
        Missing, truncated, another format or version, or something in it is missing, of another type or shape, or says
        what no run says; the message names the file and the place.

    Examples
    --------
    >>> import rfpose as rf
    >>> rf.open_track("day.h5").to_pandas()  # doctest: +SKIP
    """
    path = Path(path)
    with opened(path, wanted="track", version=VERSION, again=_AGAIN) as file:
        return _Reader(path, file, length=_LENGTH, again=_AGAIN).track()


_AGAIN = "run `rfpose track` again"
_LENGTH = {"xyz": 3, "axis": 2, "hour": 24, "mode_name": len(Mode), "total": 3}


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


class _Reader(FileReader):
    """Reads a tracking run."""

    def track(self) -> Track:
        ids, dates = self._names("heliostat/id"), self._names("day/date")
        self.length |= {"heliostat": len(ids), "day": len(dates)}
        field = {place.partition("/")[2]: self.array(place, column) for place, column in _FIELD.items()}
        self._check_index("heliostat/stored", field["stored"], 0, len(ids))
        self._check_index("time/day", field["day"], 0, len(dates))
        late = ~((field["unix_s"] >= 0.0) & (field["unix_s"] <= LAST_TIME_S))
        if late.any():
            raise self.error("time/unix_s", f"holds {field['unix_s'][late][0]}, no time until the year 9999")
        for date in dates:
            try:
                datetime.date.fromisoformat(date)
            except ValueError as error:
                raise self.error("day/date", f"holds {date!r:.40}, which is no date") from error
        settings = {name: str(value) for name, value in self.group("settings").attrs.items()}
        if not re.fullmatch(r"[0-9]{1,20}", settings.get("seed", "")):
            raise self.error("settings", "lacks the attribute `seed`, or it is no number")
        return Track(
            scenario=self.scenario(),
            settings=settings,
            heliostat_ids=ids,
            dates=dates,
            methods={name: self._method(name) for name in self._json(_TEXTS, "methods", self.file)},
            iq=tuple(self._json(_TABLES, "iq")),
            **field,
        )

    def _method(self, name: str) -> MethodTrack:
        place = f"method/{name}"
        group = self.group(place)
        series = {key: self.array(f"{place}/{key}", column) for key, column in _SERIES.items()}
        self._check_index(f"{place}/mode", series["mode"], -1, len(Mode))
        return MethodTrack(
            name=name,
            text=str(group.attrs.get("text", METHODS[name].text if name in METHODS else name)),
            series=series,
            scores={key: self.array(f"{place}/score/{key}", column) for key, column in _SCORES.items()},
            summary=self._json(_SUMMARY, f"{place} summary", group),
            happened=tuple(self._json(_HAPPENED, f"{place}/happened")),
        )

    def _names(self, place: str) -> tuple[str, ...]:
        dataset = find_item(self.file, f"/{place}", follow_links=False)
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 1 or not h5py.check_string_dtype(dataset.dtype):
            raise self.error(place, "is missing or no list of texts")
        try:
            return tuple(dataset.asstr()[()].tolist())
        except RecordingError:
            raise
        except DAMAGES as error:
            raise self.error(place, f"cannot be read ({error})") from error

    def _json(self, wanted: TypeAdapter[Any], place: str, group: h5py.Group | None = None) -> Any:
        """Return what a text says; that of an attribute of ``group``, named by the place's last word, if given."""
        try:
            raw = text_of(self.file, f"/{place}") if group is None else group.attrs[place.rpartition(" ")[2]]
        except RecordingError:
            raise
        except DAMAGES as error:
            raise self.error(place, f"is missing or no text ({error})") from error
        if not isinstance(raw, str):
            raise self.error(place, "is no text")
        found = parse_json(raw, source=f"{self.path}: `/{place}`", remedy=f"the file is damaged: {_AGAIN}")
        try:
            wanted.validate_python(found)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise self.error(place, f"`{where}`: {first['msg'][:1].lower()}{first['msg'][1:]}") from error
        return found

    def _check_index(self, place: str, values: npt.NDArray[Any], least: int, end: int) -> None:
        bad = values[(values < least) | (values >= end)]
        if bad.size:
            raise self.error(place, f"holds {bad[0]}, which means nothing")
