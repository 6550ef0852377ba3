"""A layout that is being edited: the field's map after every move, fast enough to drag a transmitter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import GeometryError, RfposeError, ScenarioError
from rfpose.geometry import azimuth_elevation_from_enu, enu_from_azimuth_elevation
from rfpose.layout import maps
from rfpose.layout.maps import ESTIMATORS, PosedMirrors, summarise
from rfpose.layout.optimise import CRITERIA, Constraints, Costs, Criterion, Zone, optimise
from rfpose.measurement import SCENARIO
from rfpose.multilat import check_unambiguous
from rfpose.scenario import Scenario, Transmitter, read_positions

__all__ = [
    "ESTIMATOR_NAMES",
    "OPTIMISED",
    "LayoutChoice",
    "LiveLayout",
    "LiveMap",
    "Postures",
    "SunPlace",
    "field_from_csv",
    "field_of",
    "first_choice",
    "free_carrier_hz",
    "place_transmitters",
    "scenario_of_layout",
    "sun_of",
]

ESTIMATOR_NAMES: tuple[str, ...] = (SCENARIO, *ESTIMATORS)
OPTIMISED: tuple[str, ...] = tuple(CRITERIA)
Postures = Literal["scenario", "sun", "level"]
_CARRIER_TRIES = 400
_POSTURE_WORDS = {
    "own": "each heliostat's own",
    "simulated sun": "reflecting the simulated sun",
    "sun": "reflecting the sun as set",
    "level": "level",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SunPlace:
    """Where the sun stands [degrees]; azimuth from north, clockwise."""

    azimuth_deg: float
    elevation_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LayoutChoice:
    """What the map is made for.

    Attributes
    ----------
    estimator
        One of `ESTIMATOR_NAMES`; ``scenario``: as `rfpose process` solves it, reflections left out.
    tones
        Which of the scenario's tones count; empty: all.
    posture
        ``scenario``: as the scenario has them, see `rfpose.scenario.Scenario.posture_enu`. ``sun``: the sun onto the
        aim point. ``level``.
    sun
        For posture ``sun``.
    per_tower, per_height_m, per_cable_m
        Cost of a tower, of a metre of height, of a metre of cable.
    """

    estimator: str = SCENARIO
    tones: tuple[int, ...] = ()
    posture: Postures = "scenario"
    sun: SunPlace = SunPlace(azimuth_deg=180.0, elevation_deg=45.0)
    per_tower: float = 1.0
    per_height_m: float = 0.0
    per_cable_m: float = 0.0

    @property
    def costs(self) -> Costs:
        """The same for the optimiser."""
        return Costs(per_tower=self.per_tower, per_height_m=self.per_height_m, per_cable_m=self.per_cable_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveMap:
    """The field at one moment of editing.

    Attributes
    ----------
    sigma_mrad : (heliostat,)
        Bound of each normal, RMS angle; NaN where undetermined [mrad of the normal].
    rms_mrad, median_mrad, worst_mrad
        Over the determined mirrors; NaN where there are none.
    worst
        Index of the worst mirror; None where there is none.
    undetermined
        Mirrors without a bound.
    cost
        Of all towers.
    problem
        Why there is no map, in words; else empty.
    """

    sigma_mrad: FloatArray
    rms_mrad: float
    median_mrad: float
    worst_mrad: float
    worst: int | None
    undetermined: int
    cost: float
    problem: str = ""
    made_by: str = ""
    """What the estimator uses, and the posture, in words."""


def field_of(scenario: Scenario) -> FloatArray:
    """Return the scenario's pivots (heliostat, xyz) [m]."""
    return scenario.pivot_enu_m


def field_from_csv(path: str | Path) -> FloatArray:
    """Return pivots (heliostat, xyz) from a table; see `rfpose.scenario.read_positions`."""
    return read_positions(path)[1]


def first_choice(scenario: Scenario) -> LayoutChoice:
    """Return what a scenario is shown with at first: its own estimator, posture and simulated sun."""
    if scenario.simulated_sun_enu is None:
        return LayoutChoice()
    azimuth, elevation = azimuth_elevation_from_enu(scenario.simulated_sun_enu)
    place = SunPlace(azimuth_deg=float(np.degrees(azimuth)) % 360.0, elevation_deg=float(np.degrees(elevation)))
    return LayoutChoice(sun=place)


def sun_of(scenario: Scenario, moment: datetime) -> SunPlace:
    """Return where the sun stands over a scenario's site.

    Raises
    ------
    ScenarioError
        The scenario does not say where the site is.
    """
    from rfpose.sun import Location, sun_position, unix_seconds

    place = scenario.site
    if place.latitude_deg is None or place.longitude_deg is None:
        raise ScenarioError(
            f"scenario `{scenario.name}` has no place on Earth: add `latitude_deg` and `longitude_deg` to [site], or "
            "set the sun's azimuth and elevation by hand"
        )
    site = Location(
        latitude_rad=np.radians(place.latitude_deg),
        longitude_rad=np.radians(place.longitude_deg),
        altitude_m=place.height_m,
    )
    sun = sun_position(unix_seconds([moment]), site)
    return SunPlace(
        azimuth_deg=float(np.degrees(sun.azimuth_rad[0])), elevation_deg=float(np.degrees(sun.elevation_rad[0]))
    )


class LiveLayout:
    """Maps of one field under one choice; make another when the choice or the field changes.

    Parameters
    ----------
    scenario
        Radio plan, mirrors, calibration receivers. Its transmitters are not used.
    choice
        See there.
    pivot_enu_m : (heliostat, xyz), optional
        Another field, with the mirror of the scenario's first heliostat [m].

    Raises
    ------
    ScenarioError, GeometryError
        No heliostat whose mirror could be taken; a posture that cannot be had; heliostats at one place.
    """

    def __init__(self, scenario: Scenario, choice: LayoutChoice, *, pivot_enu_m: FloatArray | None = None) -> None:
        self.choice = choice
        if pivot_enu_m is not None:
            scenario = scenario.with_field(pivot_enu_m)
        self._heliostats = scenario.heliostat
        self._posture = maps.posture_name(scenario) if choice.posture == "scenario" else choice.posture
        self._speed_mps = scenario.radio.propagation_speed_mps
        self._bare = _bare(scenario, choice.tones)
        self._n = len(scenario.heliostat)
        self._field = _mirrors(scenario, choice) if self._n else None

    @property
    def pivot_enu_m(self) -> FloatArray:
        """(heliostat, xyz) [m]."""
        return np.empty((0, 3)) if self._field is None else self._field.pivot_enu_m

    @property
    def field(self) -> PosedMirrors | None:
        """The mirrors in their posture; None where there are none."""
        return self._field

    def evaluate(self, transmitters: Sequence[Transmitter]) -> LiveMap:
        """Return the map for these transmitters; what cannot be mapped says why."""
        cost = self.choice.costs.of(np.array([t.position_enu_m for t in transmitters]).reshape(-1, 3))
        if self._field is None:
            return self._nothing(cost, "the field has no heliostats; add some to the scenario, or load a field")
        try:
            site = self._bare.with_transmitters(transmitters)
            maps.check_site(site.transmitter_enu_m)
            check_unambiguous(site.transmitter_enu_m, site.wavelength_m)
            study = maps.study_of(site, self.choice.estimator, heliostats=self._heliostats)
            sigma = 1e3 * study.bound(self._field)
        except RfposeError as error:
            return self._nothing(cost, str(error))
        summary = summarise(sigma)
        known = np.isfinite(sigma)
        return LiveMap(
            sigma_mrad=sigma,
            rms_mrad=summary["rms"],
            median_mrad=summary["median"],
            worst_mrad=summary["worst"],
            worst=int(np.nanargmax(sigma)) if known.any() else None,
            undetermined=int(len(sigma) - known.sum()),
            cost=cost,
            made_by=f"{self._made_by(study)}; posture: {_POSTURE_WORDS[self._posture]}",
        )

    def _made_by(self, study: maps.NormalsStudy) -> str:
        said = list(dict.fromkeys(maps.in_words(e, self._speed_mps) for e in study.rows))
        return said[0] if len(said) == 1 else f"heliostats differ ({' | '.join(said)})"

    def _nothing(self, cost: float, why: str) -> LiveMap:
        nan = float("nan")
        return LiveMap(
            sigma_mrad=np.full(self._n, np.nan),
            rms_mrad=nan,
            median_mrad=nan,
            worst_mrad=nan,
            worst=None,
            undetermined=self._n,
            cost=cost,
            problem=why,
        )


def _bare(scenario: Scenario, tones: Sequence[int]) -> Scenario:
    """Return the scenario without heliostats: quick to check after each move."""
    kept = tuple(scenario.tone[i] for i in tones) or scenario.tone
    return scenario.changed(heliostat=(), tone=kept, simulation={"blocked": None, "dropped": None})


def _mirrors(scenario: Scenario, choice: LayoutChoice) -> PosedMirrors:
    if choice.posture == "scenario":
        return maps.mirrors_of(scenario)
    if choice.posture == "level":
        return maps.mirrors_of(scenario, normal_enu=[0.0, 0.0, 1.0])
    if scenario.site.aim_enu_m is None:
        raise ScenarioError(
            f"scenario `{scenario.name}` has no aim point: add `aim_enu_m` to [site], or choose another posture"
        )
    if choice.sun.elevation_deg <= 0.0:
        raise ScenarioError(
            f"the sun is {-choice.sun.elevation_deg:.1f}° below the horizon; choose another time of day"
        )
    sun = enu_from_azimuth_elevation(np.radians(choice.sun.azimuth_deg), np.radians(choice.sun.elevation_deg))
    return maps.mirrors_of(scenario, sun_enu=sun)


def free_carrier_hz(scenario: Scenario, transmitters: Sequence[Transmitter]) -> float:
    """Return a carrier in the band whose lines stay farthest from those of the transmitters.

    Raises
    ------
    ScenarioError
        The band has no room.
    """
    radio = scenario.radio
    half = 0.5 * radio.sample_rate_hz
    margin = radio.clock_search_ppm * 1e-6 * (radio.centre_frequency_hz + half)
    usable = half - 1.01 * margin - float(scenario.tone_hz.max())
    offset = np.concatenate([[0.0], scenario.tone_hz, -scenario.tone_hz])
    taken = (np.array([t.carrier_hz for t in transmitters])[:, None] + offset).ravel()
    if not len(taken):
        return 0.0
    candidate = np.linspace(-usable, usable, _CARRIER_TRIES)
    gap = np.abs(candidate[:, None, None] + offset[:, None] - taken).min(axis=(1, 2))
    best = int(np.argmax(gap))
    if usable <= 0.0 or gap[best] < 2.0 * radio.sample_rate_hz / radio.frame_samples:
        raise ScenarioError(
            "the band has no room for another carrier; raise `radio.sample_rate_hz`, or remove a transmitter"
        )
    return float(candidate[best])


def scenario_of_layout(
    scenario: Scenario, transmitters: Sequence[Transmitter], *, pivot_enu_m: FloatArray | None = None
) -> Scenario:
    """Return the scenario with these transmitters, and with another field if one is given; checked.

    Raises
    ------
    ScenarioError
        The layout contradicts itself; the message points to the key.
    """
    if pivot_enu_m is not None:
        scenario = scenario.with_field(pivot_enu_m)
    return scenario.with_transmitters(transmitters)


def place_transmitters(
    layout: LiveLayout,
    transmitters: Sequence[Transmitter],
    locked: Sequence[bool],
    *,
    criterion: Criterion = "pdop",
    statistic: str = "rms",
    separation_m: float = 0.0,
    starts: int = 10,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[Transmitter, ...]:
    """Return the transmitters with those that are not locked moved to where the field is known best.

    They stay within the circle about the origin, and between the heights, that all of them span now.

    Raises
    ------
    GeometryError
        Everything is locked; no field; no layout meets the limits.
    """
    if layout.field is None:
        raise GeometryError("the field has no heliostats; add some to the scenario, or load a field")
    if all(locked):
        raise GeometryError("every transmitter is locked; unlock those that may move")
    places = np.array([t.position_enu_m for t in transmitters], np.float64)
    held = np.array(locked, bool)
    found = optimise(
        len(places),
        layout.field,
        Constraints(
            allowed=(Zone(radius_m=max(float(np.hypot(places[:, 0], places[:, 1]).max()), 1.0)),),
            height_m=(float(places[:, 2].min()), float(places[:, 2].max())),
            separation_m=separation_m,
        ),
        criterion=criterion,
        statistic=statistic,
        existing_enu_m=places[held] if held.any() else None,
        costs=layout.choice.costs,
        starts=starts,
        seed=seed,
        also_from=[places[~held]],
        progress=on_progress,
    )
    moved = iter(found.transmitter_enu_m[int(held.sum()) :].tolist())
    return tuple(
        t if hold else t.model_copy(update={"position_enu_m": tuple(next(moved))})
        for t, hold in zip(transmitters, held, strict=True)
    )
