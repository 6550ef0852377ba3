"""A tracking run as arrays to draw: mirrors, beams at the target, error curves of all methods."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rfpose.checks import FloatArray
from rfpose.geometry import unit
from rfpose.pipeline.track_file import Track

__all__ = ["Instant", "TrackPicture", "instant_at", "picture_of_track"]

_DAY_GAP_S = 3600.0
"""Between two simulated days the curves show a gap of this length, whatever lies between them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Instant:
    """One method at one instant; rows follow the stored mirrors.

    Attributes
    ----------
    normal_enu : (stored, xyz)
    error_mrad : (stored,)
        Angle between true and wanted normal [mrad of the normal]; NaN: aim point out of reach.
    beam_end_enu_m : (stored, xyz)
        Where the sun's reflection passes the target [m]; NaN for a dish, or for a beam that leads away from it.
    spot_m : (stored, xy)
        The same, from the aim point: to the right and up as seen from the mirror [m].
    """

    normal_enu: FloatArray
    error_mrad: FloatArray
    beam_end_enu_m: FloatArray
    spot_m: FloatArray


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
        Over the whole field [mrad of the normal].
    pivot_enu_m, target_enu_m : (stored, xyz)
        [m].
    ids
        Of the stored mirrors.
    limit_mrad
        Error that the colours reach to: nearly all of the run lies below.
    """

    track: Track
    methods: tuple[str, ...]
    hours: FloatArray
    time: tuple[str, ...]
    rms_mrad: Mapping[str, FloatArray]
    pivot_enu_m: FloatArray
    target_enu_m: FloatArray
    ids: tuple[str, ...]
    limit_mrad: Mapping[str, float]

    @property
    def n_instant(self) -> int:
        """Number of instants."""
        return len(self.hours)

    def at(self, method: str, instant: int) -> Instant:
        """Return what a method's mirrors did at an instant."""
        series = self.track.methods[method].series
        return instant_at(
            np.asarray(series["normal_enu"][instant], np.float64),
            np.asarray(series["error_rad"][instant], np.float64),
            self.track.sun_enu[instant],
            self.pivot_enu_m,
            self.target_enu_m,
        )

    def comparison(self, instant: int) -> list[tuple[str, float, float, float, float, float]]:
        """Return rows of method, error now, rms, 95 %, worst [mrad of the normal] and intercept; best first."""
        rows = []
        for name in self.track.ranking():
            scores = self.track.methods[name].scores
            rms = scores["heliostat_rms_rad"]
            rows.append(
                (
                    name,
                    float(self.rms_mrad[name][instant]) if self.n_instant else float("nan"),
                    1e3 * float(np.sqrt(np.nanmean(np.square(rms)))) if np.isfinite(rms).any() else float("nan"),
                    1e3 * _largest(scores["heliostat_p95_rad"]),
                    1e3 * _largest(scores["heliostat_worst_rad"]),
                    _mean(scores["heliostat_intercept"]),
                )
            )
        return rows


def instant_at(
    normal_enu: FloatArray,
    error_rad: FloatArray,
    sun_enu: FloatArray,
    pivot_enu_m: FloatArray,
    target_enu_m: FloatArray,
) -> Instant:
    """Return mirrors with these normals (mirror, xyz) and errors (mirror,), and where their beams go."""
    ray = 2.0 * (normal_enu @ sun_enu)[:, None] * normal_enu - sun_enu
    ahead = target_enu_m - pivot_enu_m
    distance = np.linalg.norm(ahead, axis=1, keepdims=True)
    along = unit(ahead)
    with np.errstate(invalid="ignore", divide="ignore"):
        towards = np.einsum("mx,mx->m", ray, along)[:, None]
        end = pivot_enu_m + ray * np.where(towards > 0.05, distance / towards, np.nan)
    right = unit(np.cross(along, [0.0, 0.0, 1.0]))
    up = np.cross(right, along)
    miss = end - target_enu_m
    return Instant(
        normal_enu=normal_enu,
        error_mrad=1e3 * error_rad,
        beam_end_enu_m=end,
        spot_m=np.stack([np.einsum("mx,mx->m", miss, right), np.einsum("mx,mx->m", miss, up)], axis=1),
    )


def _largest(values: FloatArray) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")


def _mean(values: FloatArray) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")


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
        pivot_enu_m=track.pivot_enu_m[track.stored],
        target_enu_m=track.target_enu_m[track.stored],
        ids=tuple(track.heliostat_ids[i] for i in track.stored),
        limit_mrad=limits,
    )
