"""The file of a tracking run: format ``rfpose-tracking``, HDF5, described in ``docs/tracking.md``."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import RecordingError, ScenarioError
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import METHODS, Score, Simulation, score
from rfpose.feedback.tracking._kernels import RADIO
from rfpose.feedback.tracking.budget import track_budget
from rfpose.feedback.tracking.loops import loop_margins_of
from rfpose.pipeline.files import write_atomically
from rfpose.pipeline.track_iq import IqCheck
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
        _texts(file, "mode/name", tuple(mode.name.lower() for mode in Mode))
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
    try:
        with h5py.File(path, "r") as file:
            return bool(file.attrs.get("format") == FORMAT)
    except OSError:
        return False


def read_track(path: str | Path) -> Track:
    """Read a run.

    Raises
    ------
    RecordingError
        Missing, not HDF5, another format or version, or something is missing in it; the message names the place.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such file; make it with `rfpose track`")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT or file.attrs.get("version") != VERSION:
                raise RecordingError(f"{path}: is no {FORMAT} of version {VERSION}; make it with `rfpose track`")
            return _read(file, path)
    except RecordingError:
        raise
    except ScenarioError as error:
        raise RecordingError(f"{path}: its scenario is damaged ({error}); run `rfpose track` again") from error
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise RecordingError(
            f"{path}: cannot be read as {FORMAT} ({error}); it is truncated or another kind of file: run again"
        ) from error


def _read(file: h5py.File, path: Path) -> Track:
    methods = {}
    for name in json.loads(file.attrs["methods"]):
        group = file[f"method/{name}"]
        methods[name] = MethodTrack(
            name=name,
            text=str(group.attrs.get("text", METHODS[name].text if name in METHODS else name)),
            series={key: read_only(group[key][()]) for key in _SERIES},
            scores={key: read_only(group[f"score/{key}"][()]) for key in _SCORES},
            summary=json.loads(group.attrs["summary"]),
            happened=tuple(json.loads(group["happened"].asstr()[()])),
        )
    return Track(
        scenario=parse_scenario(file["scenario"].asstr()[()], source=f"{path}, scenario"),
        settings={name: str(value) for name, value in file["settings"].attrs.items()},
        heliostat_ids=tuple(file["heliostat/id"].asstr()[()].tolist()),
        pivot_enu_m=read_only(file["heliostat/pivot_enu_m"][()]),
        target_enu_m=read_only(file["heliostat/target_enu_m"][()]),
        stored=read_only(file["heliostat/stored"][()]),
        dates=tuple(file["day/date"].asstr()[()].tolist()),
        unix_s=read_only(file["time/unix_s"][()]),
        day=read_only(file["time/day"][()]),
        sun_enu=read_only(file["time/sun_enu"][()]),
        methods=methods,
        iq=tuple(json.loads(file["iq"].asstr()[()])),
    )


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
