"""When a field tracks: the days, their steps, where the sun stands, what its light is worth."""

from __future__ import annotations

import datetime
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import ScenarioError
from rfpose.feedback.energy import clear_beam_w_m2
from rfpose.scenario import Scenario
from rfpose.scenario.tracking import Tracking
from rfpose.sun import Location, sun_position

__all__ = ["Day", "day_of", "days", "heat_of", "hour_of_day", "look_times", "site_of", "ways_s"]

_COARSE_S = 20.0
_MARGIN_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Day:
    """One day's tracking.

    Attributes
    ----------
    date
        Local.
    since_first
        Days since the first day of the run.
    unix_s : (step,)
        Beginnings of the servo steps [s since 1970 UTC].
    sun_enu : (step + lead, xyz)
        Towards the sun; goes on beyond the last step, for commands ahead of time.
    power_w_per_m2 : (step,)
        Beam of the sun, under a clear sky unless `sky.under_sky` has laid clouds on it [W/m²].
    hour : (step,)
        Local mean solar time [h].
    works : (step,)
        Whether the field is to collect; before and after that mirrors come out of stow and go back.
    from_stow
        Whether the mirrors begin in stow: the hours are not cut from the middle of the day.
    """

    date: datetime.date
    since_first: int
    unix_s: FloatArray
    sun_enu: FloatArray
    power_w_per_m2: FloatArray
    hour: FloatArray
    works: npt.NDArray[np.bool_]
    from_stow: bool

    @property
    def heat(self) -> FloatArray:
        """(step,) how warm it is, see `heat_of`."""
        return heat_of(self.hour)


def site_of(scenario: Scenario) -> Location:
    """Return where the field is.

    Raises
    ------
    ScenarioError
        The scenario does not say.
    """
    place = scenario.site
    if place.latitude_deg is None or place.longitude_deg is None:
        raise ScenarioError("[site] `latitude_deg` and `longitude_deg` are missing: they place the sun; add them")
    return Location(
        latitude_rad=float(np.deg2rad(place.latitude_deg)),
        longitude_rad=float(np.deg2rad(place.longitude_deg)),
        altitude_m=place.height_m,
    )


def hour_of_day(unix_s: npt.ArrayLike, site: Location) -> FloatArray:
    """Return local mean solar time [h]."""
    return np.asarray(np.mod(np.asarray(unix_s) / 3600.0 + np.rad2deg(site.longitude_rad) / 15.0, 24.0))


def heat_of(hour: FloatArray) -> FloatArray:
    """Return how warm it is at hours: −1 … 1 over the day, greatest at three in the afternoon."""
    return np.asarray(np.cos(2.0 * np.pi * (hour - 15.0) / 24.0))


def days(scenario: Scenario) -> tuple[Day, ...]:
    """Return the days of a run, each from the sun's rise above the least elevation until it falls below.

    Raises
    ------
    ScenarioError
        No site; a day on which the sun does not rise far enough.
    """
    plan = scenario.tracking
    return tuple(
        day_of(scenario, plan.date + datetime.timedelta(days=i * plan.day_interval), i * plan.day_interval)
        for i in range(plan.days)
    )


def day_of(scenario: Scenario, date: datetime.date, since_first: int, *, whole: bool = False) -> Day:
    """Return one day, or the whole of it whatever the hours within which the field tracks; see `days`."""
    plan, site = scenario.tracking, site_of(scenario)
    first_hour, last_hour = (0.0, 24.0) if whole else (plan.first_hour, plan.last_hour)
    midnight = datetime.datetime(date.year, date.month, date.day, tzinfo=datetime.UTC).timestamp()
    midnight -= np.rad2deg(site.longitude_rad) / 15.0 * 3600.0
    coarse = midnight + np.arange(first_hour * 3600.0, last_hour * 3600.0, _COARSE_S)
    up = sun_position(coarse, site).elevation_rad > np.deg2rad(plan.min_sun_elevation_deg)
    if not up.any():
        raise ScenarioError(
            f"[tracking] on {date} the sun is never above {plan.min_sun_elevation_deg:g} degrees between hours "
            f"{first_hour:g} and {last_hour:g} at latitude {np.rad2deg(site.latitude_rad):.2f}; choose "
            "another `date`, hours, or a lower `min_sun_elevation_deg`"
        )
    begin, end = np.ceil(coarse[up][0]), coarse[up][-1]
    from_stow = plan.field_control is not None and not whole and not up[0]
    way = ways_s(plan) if from_stow else 0.0, ways_s(plan) if plan.field_control and not whole and not up[-1] else 0.0
    lead = max(round(plan.control_interval_s / plan.servo_interval_s), 1) + 1
    # whole frames, so that every stretch of the day begins with one
    n_step = max(int((end - begin + sum(way)) / plan.control_interval_s), 1) * (lead - 1)
    times = begin - way[0] + plan.servo_interval_s * np.arange(n_step + lead)
    # the sun's path is smooth: exact every minute, a cubic through the points between
    from scipy.interpolate import CubicSpline

    knots = np.arange(times[0] - _MARGIN_S, times[-1] + _MARGIN_S, 60.0)
    direction = CubicSpline(knots, sun_position(knots, site).direction_enu)(times)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    elevation = np.arcsin(np.clip(direction[:n_step, 2], -1.0, 1.0))
    return Day(
        date=date,
        since_first=since_first,
        unix_s=read_only(times[:n_step]),
        sun_enu=read_only(direction),
        power_w_per_m2=read_only(clear_beam_w_m2(elevation, site=site)),
        hour=read_only(hour_of_day(times[:n_step], site)),
        works=read_only((times[:n_step] >= begin) & (times[:n_step] <= end)),
        from_stow=from_stow,
    )


def look_times(scenario: Scenario, since_first: int, n: int) -> FloatArray:
    """Return instants evenly spread over the sunshine of a day, so many days after the run's first (n,) [s]."""
    date = scenario.tracking.date + datetime.timedelta(days=since_first)
    unix_s = day_of(scenario, date, since_first, whole=True).unix_s
    return np.linspace(unix_s[0], unix_s[-1], n + 2)[1:-1]


def ways_s(plan: Tracking) -> float:
    """Return how long the farthest way out of stow or back takes, one axis after the other, with some to spare [s].

    Whole control intervals.
    """
    longest = 1.5 * np.pi / (1e-3 * plan.drive.speed_mradps)
    return float(np.ceil((1.1 * longest + 60.0) / plan.control_interval_s) * plan.control_interval_s)
