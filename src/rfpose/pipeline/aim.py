"""Commands for calibrated heliostats: motor positions for an aim point and times, with what stays uncertain."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError
from rfpose.feedback.design import Forecast, forecast, next_postures
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import CommandStatus
from rfpose.files import claim
from rfpose.pipeline.formats.mount_file import StoredMount, read_models
from rfpose.sun import Location, unix_seconds

__all__ = ["CommandPlan", "plan_commands", "write_commands"]

COLUMNS = (
    "time_utc", "heliostat", "axis_1", "axis_2", "status", "sun_azimuth_deg", "sun_elevation_deg",
    "normal_sigma_mrad", "normal_with_noise_mrad",
)  # fmt: skip

_FARTHEST_M = 1e5
_MOST_HOURS = 24.0 * 3660.0  # ten years
_MOST_TIMES = 1_000_000
_MOST_NEXT = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandPlan:
    """Commands of one heliostat.

    Attributes
    ----------
    heliostat
        Its name.
    calibrated
        Whether its mount was fitted; otherwise nothing is known of what stays uncertain.
    noise_assumed
        Whether the scatter about the model is not the measurements' own but what was stated of them.
    unix_s : (time,)
        Times [s since 1970 UTC].
    forecast
        Commands and uncertainty at those times.
    month_sigma_rad : (month,)
        RMS uncertainty of the normal on the 21st of each month of the first time's year [rad]; NaN without sun.
    next_unix_s : (posture,)
        Times of that year whose postures are worth measuring next, best first.
    next_count : (posture, axis)
        Motor positions of those.
    next_sigma_rad : (posture + 1,)
        RMS uncertainty of the normal over the year before the first and after each [rad].
    """

    heliostat: str
    calibrated: bool
    noise_assumed: bool
    unix_s: FloatArray
    forecast: Forecast
    month_sigma_rad: FloatArray
    next_unix_s: FloatArray
    next_count: FloatArray
    next_sigma_rad: FloatArray

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON; milliradians are of the mirror normal."""
        return {
            "heliostat": self.heliostat,
            "calibrated": self.calibrated,
            "noise_assumed": self.noise_assumed,
            "commands": [dict(zip(COLUMNS, row, strict=True)) for row in _rows(self)],
            "month_sigma_mrad": (1e3 * self.month_sigma_rad).tolist(),
            "next": [
                {
                    "time_utc": _iso(when),
                    "axis_1": float(count[0]),
                    "axis_2": float(count[1]),
                    "sigma_after_mrad": after,
                }
                for when, count, after in zip(
                    self.next_unix_s, self.next_count, 1e3 * self.next_sigma_rad[1:], strict=True
                )
            ],
            "year_sigma_mrad": float(1e3 * self.next_sigma_rad[0]) if len(self.next_sigma_rad) else None,
        }


def plan_commands(
    model: Path,
    *,
    target_enu_m: Sequence[float] | None,
    start: str,
    hours: float = 12.0,
    step_s: float = 600.0,
    heliostats: Sequence[str] = (),
    site: Location | None = None,
    n_next: int = 0,
) -> tuple[CommandPlan, ...]:
    """Make commands for times, and say how well the mirrors will point.

    Parameters
    ----------
    model
        Mounts that ``rfpose calibrate`` wrote, or as planned.
    target_enu_m : (xyz)
        Aim point, site ENU [m]; None: a dish, which points at the sun.
    start
        First time, ISO 8601 with its zone.
    hours, step_s
        How long and how often.
    heliostats
        Names; empty: all.
    site
        Where the origin lies; None: as the model's file says.
    n_next
        How many postures to propose for measuring.

    Raises
    ------
    InvalidInputError
        No such heliostat, no site, or times that make no sense.
    """
    content = read_models(model)
    place = site or content.site
    if place is None:
        raise InvalidInputError(f"{model}: does not say where it stands; give `site=` (latitude, longitude, altitude)")
    unix_s = _times(start, hours, step_s)
    names = list(heliostats) or list(content.heliostats)
    unknown = [name for name in names if name not in content.heliostats]
    if unknown:
        known = ", ".join(list(content.heliostats)[:8])
        raise InvalidInputError(f"{model}: has no heliostat {unknown[0]!r}; it has {known}")
    goal = np.zeros(3) if target_enu_m is None else as_float_array("target", target_enu_m, (3,))
    if not np.linalg.norm(goal) <= _FARTHEST_M:
        raise InvalidInputError(f"the aim point must lie within {_FARTHEST_M / 1e3:g} km of the origin, got {goal} m")
    if not 0 <= n_next <= _MOST_NEXT:
        raise InvalidInputError(f"from 0 to {_MOST_NEXT} postures can be proposed, got {n_next}")
    mode: Literal["heliostat", "dish"] = "dish" if target_enu_m is None else "heliostat"
    return tuple(_plan(name, content.heliostats[name], place, unix_s, goal, mode, n_next) for name in names)


def _times(start: str, hours: float, step_s: float) -> FloatArray:
    """Return the times of the commands [s since 1970 UTC], as many as are sensible."""
    if not (0.0 <= hours <= _MOST_HOURS and 0.0 < step_s < np.inf):
        raise InvalidInputError(
            f"`hours` must lie between 0 and {_MOST_HOURS:g} h and `step_s=` must be "
            f"greater than zero seconds, got {hours:g} h, {step_s:g} s"
        )
    n_step = 3600.0 * hours / step_s
    if n_step > _MOST_TIMES:
        raise InvalidInputError(
            f"{n_step:.3g} commands a heliostat are more than {_MOST_TIMES}; take a longer `step_s=`"
        )
    first = unix_seconds([start])[0]
    return np.asarray(first + np.arange(0.0, 3600.0 * hours + 0.5 * step_s, step_s))


def _plan(
    name: str,
    stored: StoredMount,
    site: Location,
    unix_s: FloatArray,
    target: FloatArray,
    mode: Literal["heliostat", "dish"],
    n_next: int,
) -> CommandPlan:
    year = datetime.fromtimestamp(unix_s[0], UTC).year
    days = unix_seconds([f"{year}-{month:02d}-21T00:00:00Z" for month in range(1, 13)])
    hours = days[:, None] + 1800.0 * np.arange(48)
    whole = forecast(stored, site=site, unix_s=hours.ravel(), target_enu_m=target, mode=mode)
    variance = (whole.sigma_normal_rad**2).reshape(hours.shape)
    up = np.isfinite(variance)
    month = np.sqrt(np.where(up, variance, 0.0).sum(axis=1) / np.where(up.any(axis=1), up.sum(axis=1), np.nan))
    good = np.flatnonzero(np.isfinite(whole.commands.count).all(axis=1))
    when, count, trace = np.empty(0), np.empty((0, 2)), np.empty(0)
    if n_next and stored.calibrated and len(good):
        sun = whole.sun.direction_enu[good]
        noise = max(stored.noise_rad, 1e-6) if np.isfinite(stored.noise_rad) else 1e-3
        could = (
            Measurements.from_normals(whole.commands.count[good], normal_enu=sun, sigma_rad=noise)
            if mode == "dish"
            else Measurements.from_spots(
                whole.commands.count[good],
                sun_enu=sun,
                spot_enu_m=np.broadcast_to(target, sun.shape),
                sigma_rad=noise,
            )
        )
        design = next_postures(stored, could, n_posture=n_next)
        when, count = hours.ravel()[good][design.chosen], could.count[design.chosen]
        trace = np.sqrt(design.trace)
    return CommandPlan(
        heliostat=name,
        calibrated=stored.calibrated,
        noise_assumed=stored.noise_assumed,
        unix_s=unix_s,
        forecast=forecast(stored, site=site, unix_s=unix_s, target_enu_m=target, mode=mode),
        month_sigma_rad=month if stored.calibrated else np.full(12, np.nan),
        next_unix_s=when,
        next_count=count,
        next_sigma_rad=trace,
    )


def write_commands(path: Path, plans: Sequence[CommandPlan], *, force: bool = False) -> None:
    """Write commands as CSV, one row a heliostat and time.

    Raises
    ------
    RecordingError
        The file exists and ``force`` is not set, or cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for plan in plans:
        for row in _rows(plan):
            writer.writerow(["" if isinstance(value, float) and np.isnan(value) else value for value in row])
    with claim(path, force=force) as job:
        job.write(path, text.getvalue().encode())


def _rows(plan: CommandPlan) -> list[list[Any]]:
    """Rows of `COLUMNS`."""
    told, sun = plan.forecast, plan.forecast.sun
    known = plan.calibrated
    return [
        [
            _iso(when),
            plan.heliostat,
            float(told.commands.count[i, 0]),
            float(told.commands.count[i, 1]),
            _status(int(told.commands.status[i]), float(sun.elevation_rad[i])),
            round(float(np.degrees(sun.azimuth_rad[i])), 6),
            round(float(np.degrees(sun.elevation_rad[i])), 6),
            round(1e3 * float(told.sigma_normal_rad[i]), 6) if known else float("nan"),
            round(1e3 * float(told.sigma_total_rad[i]), 6) if known else float("nan"),
        ]
        for i, when in enumerate(plan.unix_s)
    ]


def _status(status: int, sun_elevation_rad: float) -> str:
    if sun_elevation_rad <= 0.0:
        return "sun down"
    return {CommandStatus.OK: "ok", CommandStatus.NO_SOLUTION: "out of reach"}.get(
        CommandStatus(status), "beyond limits"
    )


def _iso(unix_s: float) -> str:
    return datetime.fromtimestamp(float(unix_s), UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
