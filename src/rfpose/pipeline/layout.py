"""Layout studies of a scenario: the map of its field, and better places for its transmitters."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import GeometryError, ScenarioError
from rfpose.geometry import enu_from_azimuth_elevation
from rfpose.layout import maps
from rfpose.layout.fields import read_positions
from rfpose.layout.maps import ESTIMATORS, Mirrors, Noise, summarise
from rfpose.layout.optimise import (
    Constraints,
    Costs,
    Criterion,
    Placement,
    Zone,
    evaluate_placement,
    optimise,
    scenario_with,
)
from rfpose.multilat import check_unambiguous
from rfpose.pipeline.files import write_atomically
from rfpose.pipeline.pictures import _mark, _new_figure, _save
from rfpose.scenario import Scenario, load_scenario

__all__ = ["LayoutMap", "SitePlacement", "draw_layout_map", "map_layout", "optimise_layout", "write_layout_csv"]

Sun = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class LayoutMap:
    """What a field's normals can be known to; rows follow ``heliostat_ids``.

    Attributes
    ----------
    scenario, heliostat_ids, pivot_enu_m
        The field studied [m].
    n_posture
        Postures over which normals are combined.
    pdop, vdop : (heliostat,)
        Dilution of position and of height.
    rms_mrad, worst_mrad : estimator to (heliostat,)
        Bound of the normal over the postures.
    lost_one_mrad : estimator to (transmitter,)
        Rms over the field with each transmitter lost; infinity where a mirror is then undetermined.
    """

    scenario: Scenario
    heliostat_ids: tuple[str, ...]
    pivot_enu_m: FloatArray
    n_posture: int
    pdop: FloatArray
    vdop: FloatArray
    rms_mrad: dict[str, FloatArray]
    worst_mrad: dict[str, FloatArray]
    lost_one_mrad: dict[str, FloatArray]

    def as_dict(self) -> dict[str, Any]:
        """Return the map's summary with stable keys."""
        return {
            "scenario": self.scenario.name,
            "heliostats": len(self.heliostat_ids),
            "postures": self.n_posture,
            "pdop": summarise(self.pdop),
            "vdop": summarise(self.vdop),
            "normal_mrad": {name: summarise(values) for name, values in self.rms_mrad.items()},
            "normal_worst_posture_mrad": {name: summarise(values) for name, values in self.worst_mrad.items()},
            "normal_without_transmitter_mrad": {
                name: dict(zip(self.scenario.transmitter_ids, values, strict=True))
                for name, values in self.lost_one_mrad.items()
            },
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class SitePlacement:
    """Transmitters placed anew: the placement, the scenario with it, and what it was before."""

    placement: Placement
    scenario: Scenario
    before: float
    before_pdop: float
    after_pdop: float

    def as_dict(self) -> dict[str, Any]:
        """Return the placement with stable keys; angles in mrad of the normal."""
        found = self.placement
        factor = 1.0 if found.criterion == "pdop" else 1e3
        return {
            "criterion": found.criterion,
            "statistic": found.statistic,
            "unit": "" if found.criterion == "pdop" else "mrad",
            "value": factor * found.value,
            "before": factor * self.before,
            "without_worst": factor * found.lost_one,
            "pdop_rms": self.after_pdop,
            "pdop_rms_before": self.before_pdop,
            "cost": found.cost,
            "searches": len(found.start_value),
            "searches_failed": int(np.isnan(found.start_value).sum()),
            "transmitters": {t.id: list(t.position_enu_m) for t in self.scenario.transmitter},
        }


def map_layout(
    scenario_path: str | Path,
    *,
    estimators: Sequence[str] = tuple(ESTIMATORS),
    suns_deg: Sequence[Sun] = (),
    field_csv: str | Path | None = None,
    tone_snr_db: float | None = None,
) -> LayoutMap:
    """Return the map of a scenario's heliostats, or of those in a CSV file with the first heliostat's mirror.

    Parameters
    ----------
    scenario_path
        TOML.
    estimators
        Names out of `rfpose.layout.maps.ESTIMATORS`.
    suns_deg
        Azimuth and elevation of suns; each gives the postures that reflect it onto the aim point. Without: each
        heliostat's own normal, else the simulated sun's first posture, else level.
    field_csv
        See `rfpose.layout.fields.read_positions`.
    tone_snr_db
        Overrides the scenario's.

    Raises
    ------
    ScenarioError
        The scenario or CSV is bad; transmitters too few, on a line or plane; heliostats on each other or on a
        transmitter; the field wider than the longest tone resolves; the message begins with the file.
    """
    scenario = _load(scenario_path, field_csv)
    try:
        transmitter = maps.check_site(scenario.transmitter_enu_m)
        check_unambiguous(transmitter, scenario.wavelength_m)
        postures = _postures(scenario, suns_deg)
    except GeometryError as error:
        raise ScenarioError(f"{scenario_path}: {error}") from error
    noise = maps.noise_of(scenario, tone_snr_db=tone_snr_db)
    if noise.carrier_sigma_m is None:
        estimators = [name for name in estimators if not ESTIMATORS[name].carrier]
    dilution = maps.dilution(transmitter, postures[0].pivot_enu_m)
    rms, worst, lost = {}, {}, {}
    for name in estimators:
        sigma = np.array([maps.normal_map(transmitter, m, noise, ESTIMATORS[name]) for m in postures])
        rms[name] = 1e3 * np.sqrt(np.mean(sigma**2, axis=0))
        worst[name] = 1e3 * sigma.max(axis=0)
        lost[name] = _without_each(transmitter, postures, noise, name)
    return LayoutMap(
        scenario=scenario,
        heliostat_ids=scenario.heliostat_ids,
        pivot_enu_m=scenario.pivot_enu_m,
        n_posture=len(postures),
        pdop=dilution.position,
        vdop=dilution.vertical,
        rms_mrad=rms,
        worst_mrad=worst,
        lost_one_mrad=lost,
    )


def _load(path: str | Path, field_csv: str | Path | None) -> Scenario:
    scenario = load_scenario(path)
    if field_csv is None:
        return scenario
    if not scenario.heliostat:
        raise ScenarioError(f"{path}: no heliostat whose mirror the field in {field_csv} could have; add one")
    ids, pivot = read_positions(field_csv)
    like = scenario.heliostat[0].model_dump(exclude_none=True)
    like.pop("normal_enu", None)
    n_receiver = len(scenario.heliostat[0].receiver_mirror_m)
    data = scenario.model_dump(exclude_none=True)
    data["heliostat"] = [
        {**like, "id": name, "pivot_enu_m": tuple(place), "receiver_ids": [f"{name}_r{k}" for k in range(n_receiver)]}
        for name, place in zip(ids, pivot.tolist(), strict=True)
    ]
    simulation = data.get("simulation", {})
    simulation.pop("blocked", None)
    simulation.pop("dropped", None)
    return Scenario.model_validate(data)


def _postures(scenario: Scenario, suns_deg: Sequence[Sun]) -> list[Mirrors]:
    if not suns_deg:
        azimuth, elevation = scenario.simulation.sun_azimuth_deg, scenario.simulation.sun_elevation_deg
        own = all(h.normal_enu is not None for h in scenario.heliostat)
        if own or azimuth is None or elevation is None or scenario.site.aim_enu_m is None:
            return [maps.mirrors_of(scenario)]
        suns_deg = [(float(np.ravel(azimuth)[0]), float(np.ravel(elevation)[0]))]
    suns = [enu_from_azimuth_elevation(np.radians(az), np.radians(el)) for az, el in suns_deg]
    return [maps.mirrors_of(scenario, sun_enu=sun) for sun in suns]


def _without_each(transmitter: FloatArray, postures: list[Mirrors], noise: Noise, name: str) -> FloatArray:
    """Rms over field and postures with each transmitter lost (transmitter,) [mrad]."""
    sigma = np.array([maps.normal_without_each(transmitter, m, noise, ESTIMATORS[name]) for m in postures])
    rms = 1e3 * np.sqrt(np.mean(sigma**2, axis=(0, 2)))
    return np.where(np.isnan(rms), np.inf, rms)


def optimise_layout(
    scenario_path: str | Path,
    *,
    n_transmitter: int | None = None,
    criterion: Criterion = "pdop",
    statistic: str = "rms",
    radius_m: float | None = None,
    height_m: tuple[float, float] | None = None,
    separation_m: float = 0.0,
    clearance_m: float = 0.0,
    excluded_m: Sequence[tuple[float, float, float]] = (),
    keep: int = 0,
    costs: Costs | None = None,
    suns_deg: Sequence[Sun] = (),
    field_csv: str | Path | None = None,
    starts: int = 30,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
) -> SitePlacement:
    """Place a scenario's transmitters anew for its heliostats; see `rfpose.layout.optimise.optimise`.

    Parameters
    ----------
    n_transmitter
        As many as the scenario has, by default.
    radius_m, height_m
        Circle about the origin, and antenna heights; by default those that the scenario's transmitters use [m].
    excluded_m
        Circles (x, y, radius) in which none may stand [m].
    keep
        The scenario's first so many transmitters stay where they are.

    Raises
    ------
    ScenarioError
        As `map_layout`; constraints that cannot be met.
    """
    scenario = _load(scenario_path, field_csv)
    now = scenario.transmitter_enu_m
    if not 0 <= keep <= len(now):
        raise ScenarioError(f"{scenario_path}: cannot keep {keep} transmitters, the scenario has {len(now)}")
    radius = float(np.hypot(now[:, 0], now[:, 1]).max()) if radius_m is None else radius_m
    heights = (float(now[:, 2].min()), float(now[:, 2].max())) if height_m is None else height_m
    rules = Constraints(
        allowed=(Zone(radius_m=radius),),
        height_m=heights,
        excluded=tuple(Zone(centre_enu_m=(x, y), radius_m=r) for x, y, r in excluded_m),
        separation_m=separation_m,
        clearance_m=clearance_m,
    )
    try:
        field = _stacked(_postures(scenario, suns_deg))
        found = optimise(
            n_transmitter or len(now),
            field,
            rules,
            criterion=criterion,
            statistic=statistic,
            existing_enu_m=now[:keep] if keep else None,
            costs=costs,
            sigma_m=1.0 if criterion == "pdop" else _sigma_m(scenario),
            starts=starts,
            seed=seed,
            progress=on_progress,
        )
        better = scenario_with(scenario, found.transmitter_enu_m, n_existing=keep)
    except GeometryError as error:
        raise ScenarioError(f"{scenario_path}: {error}") from error
    sigma = 1.0 if criterion == "pdop" else _sigma_m(scenario)
    return SitePlacement(
        placement=found,
        scenario=better,
        before=evaluate_placement(now, field, criterion=criterion, statistic=statistic, sigma_m=sigma),
        before_pdop=evaluate_placement(now, field),
        after_pdop=evaluate_placement(found.transmitter_enu_m, field),
    )


def _stacked(postures: list[Mirrors]) -> Mirrors:
    """One field of all postures."""
    n = len(postures[0].pivot_enu_m)
    places = [np.broadcast_to(m.receiver_mirror_m, (n, *m.receiver_mirror_m.shape[1:])) for m in postures]
    alike = len(postures[0].receiver_mirror_m) == 1
    return Mirrors(
        pivot_enu_m=np.concatenate([m.pivot_enu_m for m in postures]),
        rot_enu_from_mirror=np.concatenate([m.rot_enu_from_mirror for m in postures]),
        receiver_mirror_m=postures[0].receiver_mirror_m if alike else np.concatenate(places),
    )


def _sigma_m(scenario: Scenario) -> float:
    """Range noise of one transmitter of mean amplitude, all tones together [m]."""
    tone = maps.noise_of(scenario).tone_sigma_m
    return float(np.mean((tone**-2.0).sum(axis=0)) ** -0.5)


def write_layout_csv(found: LayoutMap, path: str | Path) -> None:
    """Write one row a heliostat: place, dilution, and the normal's bound by estimator."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    names = list(found.rms_mrad)
    writer.writerow(
        ["id", "east_m", "north_m", "up_m", "pdop", "vdop"]
        + [f"normal_{name}_{kind}_mrad" for name in names for kind in ("rms", "worst")]
    )
    for i, name in enumerate(found.heliostat_ids):
        values = [*found.pivot_enu_m[i], found.pdop[i], found.vdop[i]]
        for key in names:
            values += [found.rms_mrad[key][i], found.worst_mrad[key][i]]
        writer.writerow([name, *(f"{v:.6g}" for v in values)])
    write_atomically(path, text.getvalue().encode())


def draw_layout_map(found: LayoutMap, path: str | Path, *, estimator: str | None = None) -> None:
    """Draw the field from above, each heliostat in the colour of its normal's bound.

    Raises
    ------
    InvalidInputError
        ``path`` ends neither in .png nor in .svg.
    """
    name = estimator or next(iter(found.rms_mrad))
    mrad = found.rms_mrad[name]
    figure, axes = _new_figure(8.4, 7.2)
    solved = np.isfinite(mrad)
    size = float(np.clip(4000.0 / len(mrad), 6.0, 90.0))
    x, y = found.pivot_enu_m[:, :2].T
    dots = axes.scatter(x[solved], y[solved], c=mrad[solved], cmap="cividis", s=size, zorder=2)
    postures = f", RMS over {found.n_posture} postures" if found.n_posture > 1 else ""
    figure.colorbar(dots, ax=axes, label=f"bound of the mirror normal{postures} [mrad]", shrink=0.85)
    if not solved.all():
        axes.scatter(x[~solved], y[~solved], s=size, marker="x", color="k", label="undetermined")
    _mark(axes, found.scenario.transmitter_enu_m, found.scenario.transmitter_ids, marker="^", label="transmitter")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.set_title(f"{found.scenario.name}: {name}, RMS {summarise(mrad)['rms']:.3g} mrad over the field")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    _save(figure, path)
