"""Where the sun is: NREL's SPA as pvlib has it, with refraction, for many times at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError

__all__ = ["Location", "Sun", "site_from_degrees", "sun_position", "unix_seconds", "why_never"]

# ΔT = TT − UT1 has been 69 s to within 0.4 s since 2017; a second is 0.2 µrad of the sun's own motion.
_DELTA_T_S = 69.2
_ALTITUDES_M = (-500.0, 9000.0)
_YEARS = (1900, 2200)
# obliquity of the ecliptic, with what refraction lifts at the horizon
_GREATEST_DECLINATION_DEG = 23.44 + 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Location:
    """Where on Earth the site frame's origin lies, and its air.

    Attributes
    ----------
    latitude_rad, longitude_rad
        WGS84, north and east positive [rad].
    altitude_m
        Above the ellipsoid [m].
    pressure_pa
        Mean air pressure [Pa]; None takes the standard atmosphere's at this altitude. Zero: no refraction.
    temperature_degc
        Mean temperature [°C].

    Raises
    ------
    InvalidInputError
        A latitude or longitude that is not an angle in radians; an altitude, pressure or temperature that no place on
        Earth has.
    """

    latitude_rad: float
    longitude_rad: float
    altitude_m: float = 0.0
    pressure_pa: float | None = None
    temperature_degc: float = 12.0

    def __post_init__(self) -> None:
        if not abs(self.latitude_rad) <= np.pi / 2:
            raise InvalidInputError(
                f"`latitude_rad` must be within ±π/2, got {self.latitude_rad}; degrees go through numpy.deg2rad"
            )
        if not abs(self.longitude_rad) <= 2.0 * np.pi:
            raise InvalidInputError(
                f"`longitude_rad` must be within ±2π, got {self.longitude_rad}; degrees go through numpy.deg2rad"
            )

        if not _ALTITUDES_M[0] <= self.altitude_m <= _ALTITUDES_M[1]:
            raise InvalidInputError(
                f"`altitude_m` must lie between {_ALTITUDES_M[0]:g} and {_ALTITUDES_M[1]:g} m, got {self.altitude_m}"
            )
        if self.pressure_pa is not None and not 0.0 <= self.pressure_pa <= 2e5:
            raise InvalidInputError(f"`pressure_pa` must lie between 0 and 2e5 Pa, got {self.pressure_pa}")
        if not -100.0 <= self.temperature_degc <= 100.0:
            raise InvalidInputError(f"`temperature_degc` must lie within ±100 °C, got {self.temperature_degc}")

    def air_pressure_pa(self) -> float:
        """Stated pressure, or that of the standard atmosphere [Pa]."""
        if self.pressure_pa is not None:
            return self.pressure_pa
        return float(101325.0 * (1.0 - 2.25577e-5 * self.altitude_m) ** 5.25588)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sun:
    """Sun at many times.

    Attributes
    ----------
    azimuth_rad : (time,)
        From north, clockwise, in [0, 2π) [rad].
    elevation_rad : (time,)
        Of the refracted sun [rad]; below the horizon the geometric one.
    direction_enu : (time, xyz)
        Unit vectors towards the sun.
    """

    azimuth_rad: FloatArray
    elevation_rad: FloatArray
    direction_enu: FloatArray


def site_from_degrees(latitude_deg: float, longitude_deg: float, altitude_m: float = 0.0) -> Location:
    """Return the site at a latitude and longitude in degrees, as files and commands give them.

    Parameters
    ----------
    latitude_deg, longitude_deg
        WGS84, north and east positive [deg].
    altitude_m
        Above the ellipsoid [m].

    Raises
    ------
    InvalidInputError
        No number, or no place on Earth.
    """
    values = []
    for name, value, low, high in (
        ("latitude", latitude_deg, -90.0, 90.0),
        ("longitude", longitude_deg, -360.0, 360.0),
        ("altitude", altitude_m, *_ALTITUDES_M),
    ):
        unit = "m" if name == "altitude" else "degrees"
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise InvalidInputError(f"the {name} must lie between {low:g} and {high:g} {unit}, got {value!r:.40}")
        values.append(float(value))
    latitude, longitude = np.radians(values[:2])
    return Location(latitude_rad=float(latitude), longitude_rad=float(longitude), altitude_m=values[2])


def unix_seconds(times: Sequence[datetime | str] | npt.NDArray[np.datetime64]) -> FloatArray:
    """Return seconds since 1970 UTC of datetimes, ISO 8601 texts or numpy datetimes.

    Raises
    ------
    InvalidInputError
        A text that is no time, a datetime without a time zone, a year before 1900 or after 2200.
    """
    if isinstance(times, np.ndarray) and times.dtype.kind == "M":
        return np.asarray(times.astype("datetime64[us]").astype(np.int64) * 1e-6)
    seconds = []
    for item in times:
        try:
            moment = datetime.fromisoformat(item) if isinstance(item, str) else item
        except ValueError as error:
            raise InvalidInputError(
                f"a time must be ISO 8601 such as 2024-02-01T10:09:37Z, got {item!r:.40}"
            ) from error
        if not isinstance(moment, datetime):
            raise InvalidInputError(f"a time must be ISO 8601 such as 2024-02-01T10:09:37Z, got {item!r:.40}")
        if moment.tzinfo is None:
            raise InvalidInputError(f"a time must say its time zone (a trailing Z for UTC), got {item!r:.40}")
        if not _YEARS[0] <= moment.year <= _YEARS[1]:
            raise InvalidInputError(f"a time must lie in the years {_YEARS[0]} to {_YEARS[1]}, got {item!r:.40}")
        seconds.append(moment.astimezone(UTC).timestamp())
    return np.array(seconds, np.float64)


def sun_position(unix_s: npt.ArrayLike, site: Location) -> Sun:
    """Return the apparent sun over a site.

    Parameters
    ----------
    unix_s : (time,)
        Seconds since 1970-01-01 UTC [s].
    site
        Latitude, longitude, altitude and air.

    References
    ----------
    .. [1] I. Reda, A. Andreas, Solar position algorithm for solar radiation applications, Solar Energy 76 (2004),
       as implemented by pvlib.
    """
    from pvlib import spa  # type: ignore[import-untyped]  # pandas comes with it: only where it is needed

    seconds = as_float_array("unix_s", np.atleast_1d(np.asarray(unix_s)), ("time",), finite=False)
    refraction_at_horizon_deg = 0.5667
    rows = spa.solar_position(
        seconds,
        np.degrees(site.latitude_rad),
        np.degrees(site.longitude_rad),
        site.altitude_m,
        site.air_pressure_pa() / 100.0,
        site.temperature_degc,
        _DELTA_T_S,
        refraction_at_horizon_deg,
        1,
    )
    azimuth, elevation = np.radians(np.mod(rows[4], 360.0)), np.radians(rows[2])
    return Sun(
        azimuth_rad=azimuth,
        elevation_rad=elevation,
        direction_enu=geometry.enu_from_azimuth_elevation(azimuth, elevation),
    )


def why_never(azimuth_deg: float, elevation_deg: float, latitude_deg: float | None) -> str:
    """Say why the sun never stands in a direction at a latitude; empty where it may.

    Parameters
    ----------
    azimuth_deg, elevation_deg
        From north, clockwise; above the horizon [deg].
    latitude_deg
        None: anywhere on Earth.

    Notes
    -----
    Of the triangle pole, zenith, sun: sin δ = sin φ sin h + cos φ cos h cos A, and |δ| never exceeds the obliquity.
    """
    if not 0.0 <= elevation_deg <= 90.0:
        return "below the horizon" if elevation_deg < 0.0 else "beyond the zenith"
    if latitude_deg is None:
        return ""
    azimuth, elevation, latitude = np.radians([azimuth_deg, elevation_deg, latitude_deg])
    sine = np.sin(latitude) * np.sin(elevation) + np.cos(latitude) * np.cos(elevation) * np.cos(azimuth)
    declination = float(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))
    if abs(declination) <= _GREATEST_DECLINATION_DEG:
        return ""
    return f"at latitude {latitude_deg:g}° none reaches it (declination {declination:.1f}°, ±23.4° at most)"
