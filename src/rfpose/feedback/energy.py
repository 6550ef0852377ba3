"""From errors of pointing to energy: error budget, what is intercepted, time lost, energy of a day and a year.

References
----------
Edwards, Arrays of paraboloidal collectors, ch. 4, §5.4.9, §5.4.10, Appendix B. Malan, A heliostat field control system,
(3.3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array, as_positive, read_only
from rfpose.errors import InvalidInputError
from rfpose.feedback.optics import intercept_ratio
from rfpose.sun import Location, sun_position

__all__ = [
    "GRIFFITH",
    "Bursts",
    "Energy",
    "clear_beam_w_m2",
    "combine_errors_rad",
    "dish_capture",
    "dish_capture_at",
    "dish_efficiency",
    "draw_bursts",
    "energy",
    "following_h_per_deg",
    "heliostat_intercept",
    "representative_days",
    "response_loss",
    "spillage",
]

_DEG = 180.0 / np.pi


def combine_errors_rad(parts_rad: Mapping[str, npt.ArrayLike]) -> FloatArray:
    """Return one rms error of a budget: the root of the sum of squares (Edwards §5.4.10) [rad].

    Parameters
    ----------
    parts_rad
        By name, rms over time and over the field: a constant that differs from mirror to mirror counts as random. An
        offset that all mirrors share is no part of it.

    Raises
    ------
    InvalidInputError
        No part, or a negative one.
    """
    if not parts_rad:
        raise InvalidInputError("`parts_rad` must name at least one error")
    total: FloatArray = np.zeros(())
    for name, value in parts_rad.items():
        part = as_float_array(name, value, ("...",))
        if np.any(part < 0.0):
            raise InvalidInputError(f"`{name}` must be an rms error, zero or greater, got {part.min()}")
        total = total + part**2
    return np.asarray(np.sqrt(total), np.float64)


def heliostat_intercept(
    normal_sigma_rad: npt.ArrayLike, *, sun_rad: float = 9.3e-3, slope_error_rad: float = 1.5e-3
) -> FloatArray:
    """Return the mean intercept ratio (Malan 3.3) of errors that scatter alike in two directions.

    Parameters
    ----------
    normal_sigma_rad : (...)
        Standard deviation of the normal in EACH of two directions; its angle is √2 of that, rms [rad].
    """
    sigma = as_float_array("normal_sigma_rad", normal_sigma_rad, ("...",))
    # the square of the angle over 2σ² is exponential: Gauss-Laguerre
    node, weight = np.polynomial.laguerre.laggauss(40)
    angle = sigma[..., None] * np.sqrt(2.0 * node)
    return np.asarray(intercept_ratio(angle, sun_rad=sun_rad, slope_error_rad=slope_error_rad) @ weight)


def following_h_per_deg(h_per_deg: npt.ArrayLike, sigma_rad: npt.ArrayLike) -> FloatArray:
    """Return the accuracy of a dish's mirror with the following error in it, h(B) (Edwards 4.11) [1/deg].

    Parameters
    ----------
    h_per_deg : (...)
        Of the contour alone.
    sigma_rad : (...)
        Following error of the axis in EACH of two directions [rad]. Edwards' own numbers need the total rms divided by
        √2 here.
    """
    h = as_float_array("h_per_deg", h_per_deg, ("...",), positive=True)
    sigma = as_float_array("sigma_rad", sigma_rad, ("...",))
    return np.asarray(h / np.sqrt(1.0 + 2.0 * (_DEG * h * sigma) ** 2))


def _area_scale(h_per_deg: npt.ArrayLike, sigma_rad: npt.ArrayLike, rim_rad: float) -> FloatArray:
    """Return A* (Edwards 4.13)."""
    return np.asarray(_DEG**2 * np.sin(rim_rad) ** 2 * following_h_per_deg(h_per_deg, sigma_rad) ** 2)


def dish_capture(
    area_ratio: npt.ArrayLike, *, h_per_deg: npt.ArrayLike, sigma_rad: npt.ArrayLike = 0.0, rim_rad: float = np.pi / 3.0
) -> FloatArray:
    """Return what a dish's cavity captures, 1 − exp(−A*/A) (Edwards 4.12).

    Parameters
    ----------
    area_ratio : (...)
        A: area of the dish over that of the cavity's aperture.
    h_per_deg, sigma_rad
        As `following_h_per_deg` takes them.
    rim_rad
        Rim angle U [rad].

    Examples
    --------
    >>> from rfpose.feedback.energy import dish_capture
    >>> dish_capture(2000.0, h_per_deg=2.0, sigma_rad=[0.0, 0.01]).round(3).tolist()
    [0.993, 0.743]
    """
    ratio = as_float_array("area_ratio", area_ratio, ("...",), positive=True)
    return np.asarray(-np.expm1(-_area_scale(h_per_deg, sigma_rad, rim_rad) / ratio))


def dish_capture_at(
    error_rad: npt.ArrayLike, area_ratio: float, *, h_per_deg: float, rim_rad: float = np.pi / 3.0
) -> FloatArray:
    """Return what a cavity captures while the dish's axis is off by so much: (4.12) before its average over errors.

    A Gaussian image (4.6) beside the middle of a round aperture. As in (4.10) the error moves it so that its peak
    falls by exp(−(180/π)² h² β²); over errors that scatter by σ in each direction the mean is `dish_capture`.

    Parameters
    ----------
    error_rad : (...)
        β, angle between axis and sun [rad].
    area_ratio, h_per_deg, rim_rad
        As for `dish_capture`.
    """
    from scipy.stats import ncx2  # only where it is needed

    ratio, h = as_positive("area_ratio", area_ratio), as_positive("h_per_deg", h_per_deg)
    edge2 = 2.0 * float(_area_scale(h, 0.0, rim_rad)) / ratio
    offset2 = 2.0 * (_DEG * h * as_float_array("error_rad", error_rad, ("...",))) ** 2
    return np.asarray(ncx2.cdf(edge2, 2, offset2))


def dish_efficiency(
    *,
    h_per_deg: npt.ArrayLike,
    sigma_rad: npt.ArrayLike = 0.0,
    loss_w_m2: float = 2e5,
    beam_w_m2: float = 1000.0,
    reflectivity: float = 0.85,
    rim_rad: float = np.pi / 3.0,
) -> tuple[FloatArray, FloatArray]:
    """Return efficiency and area ratio of the cavity that suits best (Edwards 4.3 with 4.12, solved).

    With κ = q/(Iρ): 1/A = ln(A*/κ)/A*, η = 1 − (κ/A*)(1 + ln(A*/κ)).

    Parameters
    ----------
    loss_w_m2
        q: what a square metre of the cavity's aperture loses [W/m²].
    """
    kappa = as_positive("loss_w_m2", loss_w_m2) / (as_positive("beam_w_m2", beam_w_m2) * reflectivity)
    scale = _area_scale(h_per_deg, sigma_rad, rim_rad)
    gain = np.log(scale / kappa)
    return np.asarray(1.0 - kappa / scale * (1.0 + gain)), np.asarray(scale / gain)


def spillage(intercept: npt.ArrayLike) -> FloatArray:
    """Return what misses the receiver, 1 − intercept."""
    return np.asarray(1.0 - as_float_array("intercept", intercept, ("...",)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Bursts:
    """Sunshine of a year in bursts.

    Attributes
    ----------
    sunshine_h
        Hours of sunshine in a year.
    per_year
        Bursts that count.
    dark_share
        Part of the sunshine that follows a long time without, after which a mirror that can only track is anywhere.
    """

    sunshine_h: float = 2800.0
    per_year: float = 1000.0
    dark_share: float = 0.7


GRIFFITH = Bursts()
"""Griffith, New South Wales, 1975 (Edwards, App. B): 1000 bursts longer than ten minutes hold 98 % of the hours."""


def response_loss(response_s: npt.ArrayLike, *, bursts: Bursts = GRIFFITH) -> FloatArray:
    """Return the part of a year's sunshine that passes before mirrors have turned to the sun (Edwards §5.4.9)."""
    time = as_float_array("response_s", response_s, ("...",))
    return np.asarray(time * bursts.per_year / (bursts.sunshine_h * 3600.0))


def draw_bursts(rng: np.random.Generator, *, n_day: int = 364, day_s: float = 36_000.0) -> list[FloatArray]:
    """Return random days of sunshine with the counts of Griffith's year (Edwards, App. B).

    From there: 1737 bursts and 2800 hours in 364 days, 900 bursts shorter than 12 minutes and 1187 than 30. Assumed, as
    the figures are not to be had: every second day is clear from end to end, on the others lengths are log-uniform
    between these points and up to six hours, and the dark time is split at random.

    Parameters
    ----------
    day_s
        Time with the sun up, ten hours as a year's mean without low suns [s].

    Returns
    -------
    list of (burst, begin-end)
        One array a day, seconds since the sun came up, in order and apart.
    """
    as_positive("day_s", day_s)
    edges = np.log(np.array([60.0, 720.0, 1800.0, 21_600.0]) * day_s / 36_000.0)
    long = 1737.0 - 1187.0 - 182.0
    shares = np.array([900.0, 287.0, long])
    count = shares.sum() / 182.0
    days = []
    for _ in range(n_day):
        if rng.random() < 0.5:
            days.append(np.array([[0.0, day_s]]))
            continue
        length = np.array([day_s])
        while length.sum() >= day_s:
            slot = rng.choice(3, rng.poisson(count), p=shares / shares.sum())
            length = np.exp(rng.uniform(edges[slot], edges[slot + 1]))
        gap = rng.dirichlet(np.ones(len(length) + 1)) * (day_s - length.sum())
        begin = np.cumsum(gap[:-1]) + np.cumsum(length) - length
        days.append(np.stack([begin, begin + length], axis=1))
    return days


@dataclass(frozen=True, slots=True)
class Energy:
    """Energy that mirrors send to the receiver.

    Attributes
    ----------
    unix_s : (time,)
        Times [s].
    beam_w_m2 : (time,)
        Direct normal irradiance [W/m²].
    cosine : (time, mirror)
        Of the angle of incidence; zero while the sun is lower than asked for.
    offered_j_m2, caught_j_m2 : (mirror,)
        Energy on a square metre of mirror, and what of it meets the receiver [J/m²].
    """

    unix_s: FloatArray
    beam_w_m2: FloatArray
    cosine: FloatArray
    offered_j_m2: FloatArray
    caught_j_m2: FloatArray


def clear_beam_w_m2(
    elevation_rad: npt.ArrayLike,
    *,
    sky: Literal["ineichen", "edwards"] = "ineichen",
    site: Location | None = None,
    linke_turbidity: float = 3.0,
) -> FloatArray:
    """Return direct normal irradiance under a clear sky [W/m²]; zero below the horizon.

    Parameters
    ----------
    elevation_rad : (...)
        Apparent elevation of the sun [rad].
    sky
        ``"ineichen"``: Ineichen and Perez as pvlib has them. ``"edwards"``: his (3.8), (3.9), for very clear air.
    site
        Altitude and pressure for Ineichen's; None: at the sea.
    linke_turbidity
        For Ineichen's: 2 very clear, 3 clear, 5 hazy.
    """
    elevation = as_float_array("elevation_rad", elevation_rad, ("...",), finite=False)
    up = elevation > 0.0
    height = np.where(up, elevation, 0.5 * np.pi)
    if sky == "edwards":
        earth = 755.6  # radius over the air's height
        mass = np.asarray(np.sqrt((earth * np.sin(height)) ** 2 + 2.0 * earth + 1.0) - earth * np.sin(height))
        beam = 1353.0 * (1.0 - 0.232 * mass**0.427)
    elif sky == "ineichen":
        from pvlib import atmosphere, clearsky  # type: ignore[import-untyped]  # only where it is needed

        zenith = np.rad2deg(0.5 * np.pi - height)
        mass = atmosphere.get_relative_airmass(zenith)
        altitude = 0.0 if site is None else float(site.altitude_m)
        if site is not None:
            mass = atmosphere.get_absolute_airmass(mass, site.air_pressure_pa() or 101_325.0)
        beam = clearsky.ineichen(zenith, mass, linke_turbidity, altitude=altitude)["dni"]
    else:
        raise InvalidInputError(f"`sky` must be 'ineichen' or 'edwards', got {sky!r}")
    return np.asarray(np.where(up, beam, 0.0), np.float64)


def energy(
    site: Location,
    unix_s: npt.ArrayLike,
    *,
    target_enu: npt.ArrayLike | None = None,
    intercept: npt.ArrayLike = 1.0,
    min_elevation_rad: float = float(np.deg2rad(10.0)),
    sky: Literal["ineichen", "edwards"] = "ineichen",
    beam_w_m2: npt.ArrayLike | None = None,
) -> Energy:
    """Return the energy over the times given, by the trapezoid rule: of a day, or of days that stand for a year.

    Parameters
    ----------
    site
        Where.
    unix_s : (time,)
        Times, ascending [s]; a step longer than an hour separates days and counts nothing.
    target_enu : (mirror, xyz)
        Directions from the mirrors to their target; None: one dish, which faces the sun.
    intercept : (time, mirror) or what broadcasts to it
        Part caught.
    min_elevation_rad
        No energy from a sun lower than this [rad].
    sky
        Of `clear_beam_w_m2`.
    beam_w_m2 : (time,)
        Measured direct normal irradiance instead [W/m²]; NaN counts nothing.

    Raises
    ------
    InvalidInputError
        Times that do not ascend, or shapes that differ.
    """
    time = as_float_array("unix_s", unix_s, ("time",))
    if np.any(np.diff(time) <= 0.0):
        raise InvalidInputError("`unix_s` must ascend")
    sun = sun_position(time, site)
    if beam_w_m2 is None:
        beam = clear_beam_w_m2(sun.elevation_rad, sky=sky, site=site)
    else:
        beam = np.nan_to_num(as_float_array("beam_w_m2", beam_w_m2, (len(time),), finite=False))
    cosine = np.ones((len(time), 1))
    if target_enu is not None:
        target = geometry.unit(as_float_array("target_enu", target_enu, ("mirror", 3)))
        # the normal bisects sun and target
        cosine = np.sqrt(0.5 * np.maximum(1.0 + sun.direction_enu @ target.T, 0.0))
    cosine = np.where((sun.elevation_rad >= min_elevation_rad)[:, None], cosine, 0.0)
    part = as_float_array("intercept", intercept, ("...",))
    try:
        part = np.broadcast_to(part, cosine.shape)
    except ValueError as error:
        raise InvalidInputError(f"`intercept` must fit (time, mirror) {cosine.shape}, got {part.shape}") from error
    power = beam[:, None] * cosine
    step = np.diff(time)
    weight = np.where(step <= 3600.0, step, 0.0)[:, None]

    def total(values: FloatArray) -> FloatArray:
        return np.asarray(np.sum(0.5 * (values[1:] + values[:-1]) * weight, axis=0))

    return Energy(
        unix_s=read_only(time),
        beam_w_m2=read_only(beam),
        cosine=read_only(cosine),
        offered_j_m2=read_only(total(power)),
        caught_j_m2=read_only(total(power * part)),
    )


def representative_days(site: Location, year: int, n_day: int, *, step_s: float = 300.0) -> FloatArray:
    """Return times of days spread evenly over a year [s]; their energy times 365.25/n_day is that of the year.

    Parameters
    ----------
    site
        Days go from midnight to midnight by its mean sun.
    n_day
        Days, 1 to 365.
    step_s
        Between times [s].
    """
    if not 1 <= n_day <= 365:
        raise InvalidInputError(f"`n_day` must be 1 to 365, got {n_day}")
    midnight_s = 86_400.0 * -site.longitude_rad / (2.0 * np.pi)
    first = float(np.datetime64(f"{year:04d}-01-01", "s").astype(np.int64)) + midnight_s
    day = np.floor((np.arange(n_day) + 0.5) * 365.25 / n_day)
    of_day = np.arange(0.0, 86_400.0, as_positive("step_s", step_s))
    return np.asarray((first + day[:, None] * 86_400.0 + of_day).ravel(), np.float64)
