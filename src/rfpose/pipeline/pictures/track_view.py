"""A tracking run as arrays to draw: mirrors, beams at the target, curves of all methods, what happened and when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.geometry import unit
from rfpose.pipeline.formats.track_file import Track
from rfpose.scenario import Scenario
from rfpose.scenario.tracking import Event

__all__ = [
    "MODES",
    "ON_RECEIVER",
    "FieldHappening",
    "Instant",
    "TrackPicture",
    "clock",
    "groups",
    "instant_at",
    "local_hour",
    "mode_text",
    "picture_of_track",
    "site_of_run",
    "telling_instant",
    "what_happened",
]

MODES = tuple(mode.name.lower() for mode in Mode)
ON_RECEIVER = (int(Mode.POINT), int(Mode.TRACK))
"""Modes in which a mirror's light is meant for the receiver; only there its error is scored."""
_NO_BEAM = (int(Mode.STOW), int(Mode.STOWING), int(Mode.APPROACH), int(Mode.EMERGENCY))
_ASTRAY = 0.25
"""Beams of other mirrors off the receiver are drawn if they pass the target within this part of their way."""
_DAY_GAP_S = 3600.0
"""Between two simulated days the curves show a gap of this length, whatever lies between them."""
_LOOKS_AT_SPOTS = 200
_LIT = 0.3
"""Of a perfect field's light: with less hardly a mirror is on the receiver yet."""
_NAMED = 3
"""Of so many mirrors an event is told with their names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldHappening:
    """Something that happened to the field of one method.

    Attributes
    ----------
    day
        Of the run, from 0.
    hour
        Local mean solar time [h]; NaN: no time is kept of it.
    kind
        What it is.
    mark
        A word or three for the time axis; empty: it has no place there.
    text
        In full.
    trouble
        Whether an order was refused, or it did not end well.
    """

    day: int
    hour: float
    kind: Literal["event", "alarm", "calibration", "messages"]
    mark: str
    text: str
    trouble: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Instant:
    """One method at one instant; rows follow the stored mirrors.

    Attributes
    ----------
    normal_enu : (stored, xyz)
    error_mrad : (stored,)
        Angle between true and wanted normal [mrad of the normal]; NaN: not on the receiver, or aim point out of reach.
    beam_end_enu_m : (stored, xyz)
        Where the sun's reflection passes the target [m]; NaN for a dish, for a beam that leads away from it, and for
        mirrors in stow or on their way there and back.
    spot_m : (stored, xy)
        The same, from the aim point: to the right and up as seen from the mirror [m].
    mode : (stored,)
        Numbers of `MODES`.
    """

    normal_enu: FloatArray
    error_mrad: FloatArray
    beam_end_enu_m: FloatArray
    spot_m: FloatArray
    mode: npt.NDArray[np.int64]

    @property
    def on_receiver(self) -> npt.NDArray[np.bool_]:
        """Whether a mirror's light is meant for the receiver (stored,)."""
        return np.isin(self.mode, ON_RECEIVER)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackPicture:
    """A run, ready to be scrubbed through.

    Attributes
    ----------
    track
        The run.
    methods
        Names, in the order of the run.
    hours : (time,)
        Since the first instant, nights left out but for a gap [h].
    time
        UTC of each instant, ISO 8601.
    rms_mrad : name to (time,)
        Over all mirrors on the receiver [mrad of the normal]; NaN while there are none.
    flux : name to (time,)
        Light on the receiver over that of a perfect field on its aim.
    happened : name to happenings
        In the order of days and hours; those without a time at the end of their day.
    pivot_enu_m, target_enu_m : (stored, xyz)
        [m].
    ids
        Of the stored mirrors.
    limit_mrad
        Error that the colours reach to: nearly all of the run lies below.
    spot_limit_m
        Within so much of the aim point, right or up, nearly all beams of mirrors on the receiver pass [m]; NaN for
        dishes.
    """

    track: Track
    methods: tuple[str, ...]
    hours: FloatArray
    time: tuple[str, ...]
    rms_mrad: Mapping[str, FloatArray]
    flux: Mapping[str, FloatArray]
    happened: Mapping[str, tuple[FieldHappening, ...]]
    pivot_enu_m: FloatArray
    target_enu_m: FloatArray
    ids: tuple[str, ...]
    limit_mrad: Mapping[str, float]
    spot_limit_m: Mapping[str, float]

    @property
    def n_instant(self) -> int:
        """Number of instants."""
        return len(self.hours)

    @property
    def under_field_control(self) -> bool:
        """Whether mirrors had modes, messages and events."""
        return any(method.happened for method in self.track.methods.values())

    def at(self, method: str, instant: int) -> Instant:
        """Return what a method's mirrors did at an instant."""
        series = self.track.methods[method].series
        return instant_at(
            np.asarray(series["normal_enu"][instant], np.float64),
            np.asarray(series["error_rad"][instant], np.float64),
            self.track.sun_enu[instant],
            self.pivot_enu_m,
            self.target_enu_m,
            mode=np.asarray(series["mode"][instant], np.int64),
        )

    def mode_counts(self, method: str, instant: int) -> dict[int, int]:
        """Return how many mirrors of the whole field are in each mode that the method's run knows at any time."""
        count = self.track.methods[method].series["mode_count"]
        return {int(k): int(count[instant, k]) for k in np.flatnonzero(count.any(axis=0))}

    def place_h(self, happening: FieldHappening) -> float:
        """Return where on `hours` something happened; NaN: nowhere."""
        first = int(np.argmax(self.track.day == happening.day))
        return float(self.hours[first]) + happening.hour - float(local_hour(self.track)[first])

    def mirror_text(self, method: str, instant: int, row: int) -> str:
        """Return what a stored mirror does at an instant, in words."""
        now, day = self.at(method, instant), self.track.day
        mode = self.track.methods[method].series["mode"][:, row]
        before = np.flatnonzero((mode[:instant] != mode[instant]) | (day[:instant] != day[instant]))
        since = int(before[-1]) + 1 if before.size else 0
        text = f"{self.ids[row]}: {mode_text(int(mode[instant]))}"
        if since and day[since - 1] == day[instant]:
            text += f" since {clock(float(local_hour(self.track)[since]))}"
        if not now.on_receiver[row]:
            return f"{text}, not on the receiver"
        if not np.isfinite(now.error_mrad[row]):
            return f"{text}, cannot face its aim point"
        return f"{text}, error {now.error_mrad[row]:.3g} mrad of the normal"

    def comparison(self, instant: int) -> list[tuple[str, float, float, float, float, float, float]]:
        """Return rows of method, error now, rms, worst mirror's 95 %, worst [mrad], intercept, availability.

        The best is first; milliradians are of the normal.
        """
        rows = []
        for name in self.track.ranking():
            method = self.track.methods[name]
            rows.append(
                (
                    name,
                    float(self.rms_mrad[name][instant]) if self.n_instant else float("nan"),
                    _number(method.summary["normal_mrad"]["rms"]),
                    1e3 * _largest(method.scores["heliostat_p95_rad"]),
                    1e3 * _largest(method.scores["heliostat_worst_rad"]),
                    _number(method.summary["intercept"]),
                    _number(method.summary["availability"]),
                )
            )
        return rows


def instant_at(
    normal_enu: FloatArray,
    error_rad: FloatArray,
    sun_enu: FloatArray,
    pivot_enu_m: FloatArray,
    target_enu_m: FloatArray,
    *,
    mode: npt.NDArray[np.int64] | None = None,
) -> Instant:
    """Return mirrors with these normals (mirror, xyz) and errors (mirror,), and where their beams go.

    Without ``mode`` (mirror,) all are taken to be on the receiver.
    """
    mode = np.full(len(normal_enu), int(Mode.TRACK)) if mode is None else mode
    ray = 2.0 * (normal_enu @ sun_enu)[:, None] * normal_enu - sun_enu
    ahead = target_enu_m - pivot_enu_m
    distance = np.linalg.norm(ahead, axis=1, keepdims=True)
    along = unit(ahead)
    with np.errstate(invalid="ignore", divide="ignore"):
        towards = np.einsum("mx,mx->m", ray, along)[:, None]
        end = pivot_enu_m + ray * np.where(towards > 0.05, distance / towards, np.nan)
        astray = np.linalg.norm(end - target_enu_m, axis=1) > _ASTRAY * distance[:, 0]
    end[np.isin(mode, _NO_BEAM) | (astray & ~np.isin(mode, ON_RECEIVER))] = np.nan
    right = unit(np.cross(along, [0.0, 0.0, 1.0]))
    up = np.cross(right, along)
    miss = end - target_enu_m
    return Instant(
        normal_enu=normal_enu,
        error_mrad=1e3 * error_rad,
        beam_end_enu_m=end,
        spot_m=np.stack([np.einsum("mx,mx->m", miss, right), np.einsum("mx,mx->m", miss, up)], axis=1),
        mode=mode,
    )


def site_of_run(track: Track) -> Scenario:
    """Return the scenario with the mirrors that were tracked, which may be more than it lists, or others."""
    if track.scenario.heliostat_ids == track.heliostat_ids:
        return track.scenario
    own = {each.id: each for each in track.scenario.heliostat}
    if all(name in own for name in track.heliostat_ids):  # the first so many
        return track.scenario.changed(heliostat=[own[name] for name in track.heliostat_ids])
    return track.scenario.with_field(track.pivot_enu_m, ids=track.heliostat_ids)


def telling_instant(picture: TrackPicture, method: str) -> tuple[int, str]:
    """Return an instant worth looking at, and why: after an alarm or the first trouble, else that of largest error."""
    happened = [each for each in picture.happened[method] if np.isfinite(picture.place_h(each))]
    flux = picture.flux[method]
    for each in happened:
        k = int(np.searchsorted(picture.hours, picture.place_h(each) - 1e-9))
        if (each.kind == "alarm" or each.trouble) and k < picture.n_instant:
            # an instant later mirrors are on their way
            return min(k + 1, picture.n_instant - 1), f"after {each.mark}"
    error = np.where(np.isfinite(flux) & (flux > _LIT), picture.rms_mrad[method], np.nan)
    if np.isfinite(error).any():
        return int(np.nanargmax(error)), "the largest error of mirrors on the receiver"
    return picture.n_instant // 2, "the middle of the run"


def _largest(values: FloatArray) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def picture_of_track(track: Track) -> TrackPicture:
    """Return a run, ready to be scrubbed through."""
    step = np.diff(track.unix_s, prepend=track.unix_s[:1])
    step = np.where(np.diff(track.day, prepend=track.day[:1]) != 0, _DAY_GAP_S, step)
    limits = {}
    for name, method in track.methods.items():
        error = np.abs(np.asarray(method.series["error_rad"], np.float64))
        known = error[np.isfinite(error)]
        limits[name] = max(1e3 * float(np.percentile(known, 98)), 1e-6) if known.size else 1.0
    return TrackPicture(
        track=track,
        methods=tuple(track.methods),
        hours=np.cumsum(step) / 3600.0,
        time=tuple(str(t) for t in np.round(track.unix_s).astype("datetime64[s]")),
        rms_mrad={name: 1e3 * np.asarray(m.series["rms_rad"], np.float64) for name, m in track.methods.items()},
        flux={name: np.asarray(m.series["flux"], np.float64) for name, m in track.methods.items()},
        happened={name: what_happened(track, name) for name in track.methods},
        pivot_enu_m=track.pivot_enu_m[track.stored],
        target_enu_m=track.target_enu_m[track.stored],
        ids=tuple(track.heliostat_ids[i] for i in track.stored),
        limit_mrad=limits,
        spot_limit_m={name: _spot_limit_m(track, name) for name in track.methods},
    )


def _spot_limit_m(track: Track, name: str) -> float:
    """Return how far from the aim point beams pass, but for a few; from a part of the instants."""
    series = track.methods[name].series
    found = [np.empty(0)]
    for k in range(0, len(track.unix_s), max(1, len(track.unix_s) // _LOOKS_AT_SPOTS)):
        now = instant_at(
            np.asarray(series["normal_enu"][k], np.float64),
            np.asarray(series["error_rad"][k], np.float64),
            track.sun_enu[k],
            track.pivot_enu_m[track.stored],
            track.target_enu_m[track.stored],
            mode=np.asarray(series["mode"][k], np.int64),
        )
        found.append(np.abs(now.spot_m[now.on_receiver]).max(axis=1))
    reach = np.concatenate(found)
    reach = reach[np.isfinite(reach)]
    return float(np.percentile(reach, 98)) if reach.size else float("nan")


def mode_text(mode: int) -> str:
    """Return a mode's name as words; negative: none is kept."""
    return MODES[mode].replace("_", " ") if mode >= 0 else "–"


def local_hour(track: Track) -> FloatArray:
    """Return local mean solar time of all instants (time,) [h]."""
    return np.asarray(np.mod(track.unix_s / 3600.0 + (track.scenario.site.longitude_deg or 0.0) / 15.0, 24.0))


def clock(hour: float) -> str:
    """Return an hour of the day as hours and minutes; nothing for NaN."""
    if not np.isfinite(hour):
        return ""
    minutes = round(60.0 * hour)
    return f"{minutes // 60 % 24:02d}:{minutes % 60:02d}"


def groups(places: Sequence[float], least: float) -> list[list[int]]:
    """Return indices of sorted places, those together that are less than ``least`` from the first of their group."""
    found: list[list[int]] = []
    for i, place in enumerate(places):
        if found and place - places[found[-1][0]] < least:
            found[-1].append(i)
        else:
            found.append([i])
    return found


def what_happened(track: Track, method: str) -> tuple[FieldHappening, ...]:
    """Return what happened to a method's field, in the order of days and hours; empty without field control."""
    found: list[FieldHappening] = []
    for day, report in enumerate(track.methods[method].happened):
        agenda = [event for event in track.scenario.tracking.event if event.day in (None, day + 1)]
        timed = [_event(day, entry, agenda, len(track.heliostat_ids)) for entry in report["events"]]
        timed += [_alarm(day, entry) for entry in report["alarms"]]
        found += sorted(timed, key=lambda each: each.hour)
        found += [_calibration(day, entry) for entry in report["calibrations"]]
        found.append(_messages(day, report["messages"]))
    return tuple(found)


def _event(day: int, entry: Mapping[str, Any], agenda: list[Event], n_mirror: int) -> FieldHappening:
    what, who = entry["what"].replace("-", " "), _who(entry, agenda, n_mirror)
    text = f"{what}: {who}" if who else str(what)
    refused: Mapping[str, int] = entry.get("refused", {})
    if refused:
        reasons = (f"{count} × {why.partition(' refused: ')[2] or why}" for why, count in refused.items())
        text += f"; refused: {', '.join(reasons)}"
    mark = f"{what} {who}" if who and len(who) <= 4 else str(what)
    return FieldHappening(day=day, hour=entry["hour"], kind="event", mark=mark, text=text, trouble=bool(refused))


def _who(entry: Mapping[str, Any], agenda: list[Event], n_mirror: int) -> str:
    """Return whom an event concerned, by the scenario's own words where they are short; empty: all the field."""
    for i, event in enumerate(agenda):
        if event.what == entry["what"] and event.hour == entry["hour"]:
            del agenda[i]  # two of the same hour are two entries
            if event.cluster is not None:
                return f"cluster {event.cluster}"
            if 0 < len(event.heliostats) <= _NAMED:
                return ", ".join(event.heliostats)
            break
    return "" if entry["heliostats"] == n_mirror else _mirrors(entry["heliostats"])


def _mirrors(n: int) -> str:
    return "1 mirror" if n == 1 else f"{n} mirrors"


def _alarm(day: int, entry: Mapping[str, Any]) -> FieldHappening:
    parts = []
    for key, what in (
        ("below_tenth_s", "flux below a tenth"),
        ("off_s", "last mirror off"),
        ("stowed_median_s", "half stowed"),
        ("stowed_s", "all stowed"),
    ):
        after = entry[key]
        parts.append(f"{what} after {after:.0f} s" if after is not None else f"{what}: not within half an hour")
    late = any(entry[key] is None for key in ("below_tenth_s", "off_s", "stowed_s"))
    text = f"alarm, {entry['alarm']}: {', '.join(parts)}"
    return FieldHappening(day=day, hour=entry["hour"], kind="alarm", mark=entry["alarm"], text=text, trouble=late)


def _calibration(day: int, entry: Mapping[str, Any]) -> FieldHappening:
    text = f"{entry['heliostat']} calibrated: {entry['outcome']}{' after a search' if entry['searched'] else ''}"
    if entry["offset_mm"] is not None:
        text += f", {np.hypot(*entry['offset_mm']):.0f} mm beside the middle"
    return FieldHappening(
        day=day,
        hour=float("nan"),
        kind="calibration",
        mark="",
        text=f"{text}, took {entry['took_s']:.0f} s",
        trouble=entry["outcome"] not in ("on target", "corrected"),
    )


def _messages(day: int, entry: Mapping[str, int]) -> FieldHappening:
    parts = []
    for key, what in (("sun", "sun angles"), ("question", "questions"), ("answer", "answers")):
        by_fate = {name.partition("_")[2]: n for name, n in entry.items() if name.startswith(f"{key}_")}
        missed = sum(by_fate.values()) - by_fate.get("ok", 0)
        parts.append(f"{100.0 * missed / max(sum(by_fate.values()), 1):.1f} % of {what}")
    refused, alone = entry["orders_refused"], entry["watchdog_emergencies"]
    return FieldHappening(
        day=day,
        hour=float("nan"),
        kind="messages",
        mark="",
        text=f"messages missed: {', '.join(parts)}; {entry['orders_sent']} orders sent, {refused} refused by mirrors; "
        f"{alone} emergencies by watchdog",
        trouble=refused > 0 or alone > 0,
    )
