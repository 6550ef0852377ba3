"""What all layout studies begin with: the site, its field from CSV, and the postures of its mirrors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.geometry import (
    azimuth_elevation_from_enu,
    bisector_enu,
    enu_from_azimuth_elevation,
    rot_enu_from_mirror,
    unit,
)
from rfpose.layout import maps
from rfpose.layout.maps import PosedMirrors
from rfpose.layout.sight import Plates, Tower
from rfpose.multilat import check_unambiguous
from rfpose.scenario import Scenario, naming, scenario_of
from rfpose.sun import Location as SunSite
from rfpose.sun import sun_position

__all__ = [
    "Field",
    "FieldPosture",
    "Postures",
    "Sight",
    "Site",
    "Sun",
    "load_site",
    "postures_of",
    "stacked",
    "suns_of",
]

Site = Scenario | str | Path
"""A scenario, or the file of one."""
Field = str | Path | npt.ArrayLike | None
"""Pivots (heliostat, xyz) [m] instead of the scenario's, or a CSV file of them."""

Sun = tuple[float, float]

_LOWEST_SUN_DEG = 5.0
_DAY_STEP_MIN = 30
_YEAR_STEP_MIN = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Postures:
    """Which postures are studied; without any of these each heliostat's own, or the simulated sun's, or level.

    Attributes
    ----------
    suns_deg
        Azimuth and elevation of suns whose light goes onto the aim point [deg].
    day
        Every half hour of this day with the sun above 5°.
    year
        Every hour, sun above 5°, of the 21st of each month.
    stow
        And face up.
    """

    suns_deg: Sequence[Sun] = ()
    day: date | None = None
    year: int | None = None
    stow: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldPosture:
    """One posture of the whole field.

    Attributes
    ----------
    name
        What it is called.
    mirrors
        The heliostats.
    plate_rot : (plate, 3, 3)
        Orientations of the plates of ``[site.structures]``, which are told what the heliostats are told.
    """

    name: str
    mirrors: PosedMirrors
    plate_rot: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """What may stand in the way: plates of this size about each mirror's centre, and a tower at the origin [m]."""

    plates: Plates
    tower: Tower | None = None


def load_site(site: Site, field: Field = None) -> Scenario:
    """Return a scenario fit for layout studies, with another field if one is given.

    Parameters
    ----------
    site, field
        See `Site`, `Field` and `Scenario.with_field`.

    Raises
    ------
    ScenarioError
        The scenario or field is bad; transmitters too few, on a line or plane; heliostats on each other or on a
        transmitter; the field wider than the longest tone resolves; the message begins with the file, if there is one.
    """
    scenario = scenario_of(site)
    if field is not None:
        scenario = scenario.with_field(field)
    with naming(site):
        check_unambiguous(maps.check_site(scenario.mast_enu_m), scenario.wavelength_m)
        maps.check_clear(scenario)
    return scenario


def suns_of(scenario: Scenario, wanted: Postures) -> list[FloatArray]:
    """Return directions of the suns of the postures to study (xyz); without any the simulated one, if there is one."""
    suns = list(wanted.suns_deg)
    if wanted.day is not None:
        suns += [sun for _, sun in _suns_of_day(scenario, wanted.day, _DAY_STEP_MIN)]
    if wanted.year is not None:
        for month in range(1, 13):
            suns += [sun for _, sun in _suns_of_day(scenario, date(wanted.year, month, 21), _YEAR_STEP_MIN)]
    simulated = scenario.simulated_sun_enu
    return [_direction(sun) for sun in suns] or ([] if simulated is None else [simulated])


def postures_of(scenario: Scenario, wanted: Postures) -> list[FieldPosture]:
    """Return the postures to study.

    Raises
    ------
    ScenarioError, GeometryError
        A date without the site's latitude and longitude; a sun without an aim point; a day without sun.
    """
    suns = [(f"sun {az:g} {el:g}", (az, el)) for az, el in wanted.suns_deg]
    if wanted.day is not None:
        suns += _suns_of_day(scenario, wanted.day, _DAY_STEP_MIN)
    if wanted.year is not None:
        for month in range(1, 13):
            suns += _suns_of_day(scenario, date(wanted.year, month, 21), _YEAR_STEP_MIN)
    if (wanted.day is not None or wanted.year is not None) and not suns:
        raise ScenarioError(f"the sun stays below {_LOWEST_SUN_DEG:g}° on that day; choose another")
    found = [_posture(scenario, name, sun_enu=_direction(sun)) for name, sun in suns]
    if wanted.stow:
        found.append(_posture(scenario, "stow", normal_enu=np.array([0.0, 0.0, 1.0])))
    return found or [_posture(scenario, maps.posture_name(scenario))]


def _posture(
    scenario: Scenario, name: str, *, sun_enu: FloatArray | None = None, normal_enu: FloatArray | None = None
) -> FieldPosture:
    mirrors = maps.mirrors_of(scenario, normal_enu=normal_enu, sun_enu=sun_enu)
    plates = scenario.site.structures.plate
    own = [None if sun_enu is not None or normal_enu is not None else p.normal_enu for p in plates]
    sun = scenario.simulated_sun_enu if sun_enu is None and normal_enu is None else sun_enu
    normal = np.tile([0.0, 0.0, 1.0] if normal_enu is None else normal_enu, (len(plates), 1))
    if sun is not None and plates:
        place = np.array([p.pivot_enu_m for p in plates])
        normal = bisector_enu(np.asarray(scenario.site.aim_enu_m) - place, sun)
    for i, told in enumerate(own):
        if told is not None:
            normal[i] = unit(told)
    return FieldPosture(name=name, mirrors=mirrors, plate_rot=rot_enu_from_mirror(normal))


def _direction(sun_deg: Sun) -> FloatArray:
    return enu_from_azimuth_elevation(np.radians(sun_deg[0]), np.radians(sun_deg[1]))


def _suns_of_day(scenario: Scenario, day: date, step_min: int) -> list[tuple[str, Sun]]:
    """Suns of one day, midnight to midnight by the site's own sun, above the lowest useful elevation."""
    site = scenario.site
    if site.latitude_deg is None or site.longitude_deg is None:
        raise ScenarioError("a date needs [site] `latitude_deg` and `longitude_deg`; add them, or give `suns_deg=`")
    midnight = datetime(day.year, day.month, day.day, tzinfo=UTC) - timedelta(hours=site.longitude_deg / 15.0)
    times = [midnight + timedelta(minutes=m) for m in range(0, 24 * 60, step_min)]
    place = SunSite(
        latitude_rad=np.radians(site.latitude_deg),
        longitude_rad=np.radians(site.longitude_deg),
        altitude_m=site.height_m,
    )
    azimuth, elevation = azimuth_elevation_from_enu(sun_position([t.timestamp() for t in times], place).direction_enu)
    return [
        (f"{time:%Y-%m-%d %H:%M}Z", (float(np.degrees(az)), float(np.degrees(el))))
        for time, az, el in zip(times, azimuth, elevation, strict=True)
        if el >= np.radians(_LOWEST_SUN_DEG)
    ]


def stacked(postures: Sequence[PosedMirrors]) -> PosedMirrors:
    """Return one field of all postures, posture by posture."""
    n = len(postures[0].pivot_enu_m)
    places = [np.broadcast_to(m.receiver_mirror_m, (n, *m.receiver_mirror_m.shape[1:])) for m in postures]
    alike = len(postures[0].receiver_mirror_m) == 1
    return PosedMirrors(
        pivot_enu_m=np.concatenate([m.pivot_enu_m for m in postures]),
        rot_enu_from_mirror=np.concatenate([m.rot_enu_from_mirror for m in postures]),
        receiver_mirror_m=postures[0].receiver_mirror_m if alike else np.concatenate(places),
    )
