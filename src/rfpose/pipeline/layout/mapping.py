"""The map of a field: what every mirror's normal can be known to, in which postures, and by which transmitters."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import GeometryError, InvalidInputError, ScenarioError
from rfpose.files import write_atomically
from rfpose.layout import maps
from rfpose.layout.budget import make_plan, noise_bound
from rfpose.layout.maps import ESTIMATORS, Study, summarise
from rfpose.layout.sensitivity import TransmitterSensitivity, transmitter_sensitivity
from rfpose.layout.sight import visible
from rfpose.measurement import SCENARIO
from rfpose.pipeline.layout.site import Posture, Postures, Sight, Sun, load_site, postures_of, stacked
from rfpose.pipeline.pictures import _mark, _new_figure, _save
from rfpose.scenario import Scenario, check_scenario

__all__ = ["LayoutMap", "SightMap", "draw_layout_map", "map_layout", "write_layout_csv"]

REFLECTION = "reflection"
"""The scenario's own solver, the ground's coefficient estimated with the poses; where ``[simulation.ground]`` is."""

NAMES = (SCENARIO, *ESTIMATORS, REFLECTION)
"""Estimators to study; the first is that of `rfpose process`."""

BoolArray = npt.NDArray[np.bool_]

_MOST_LOST_POSTURES = 12
"""For the loss of each transmitter, this many of the postures stand for all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SightMap:
    """How many transmitters receivers see.

    Attributes
    ----------
    seen_mean, seen_least : (posture, heliostat)
        Over a heliostat's receivers.
    seen_share : (transmitter,)
        By which share of receivers and postures each transmitter is seen.
    """

    seen_mean: FloatArray
    seen_least: FloatArray
    seen_share: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class LayoutMap:
    """What a field's normals can be known to; rows follow ``heliostat_ids``.

    Attributes
    ----------
    scenario, heliostat_ids, pivot_enu_m
        The field studied [m].
    posture_names
        Postures over which normals are combined.
    pdop, vdop : (heliostat,)
        Dilution of position and of height, everything in view.
    rms_mrad, worst_mrad : estimator to (heliostat,)
        Bound of the normal over the postures in which it is determined.
    by_posture_mrad : estimator to (posture,)
        Rms over the field, of what is determined.
    undetermined : estimator to share
        Of heliostats and postures.
    lost_one_mrad : estimator to (transmitter,)
        Rms over the field with each transmitter lost; infinity where a mirror is then undetermined.
    sight
        With line of sight; else everything is in view.
    sensitivity : estimator to its response
        Where asked for.
    """

    scenario: Scenario
    heliostat_ids: tuple[str, ...]
    pivot_enu_m: FloatArray
    posture_names: tuple[str, ...]
    pdop: FloatArray
    vdop: FloatArray
    rms_mrad: dict[str, FloatArray]
    worst_mrad: dict[str, FloatArray]
    by_posture_mrad: dict[str, FloatArray]
    undetermined: dict[str, float]
    lost_one_mrad: dict[str, FloatArray]
    sight: SightMap | None = None
    sensitivity: dict[str, TransmitterSensitivity] = field(default_factory=dict)

    @property
    def n_posture(self) -> int:
        """Number of postures."""
        return len(self.posture_names)

    def as_dict(self) -> dict[str, Any]:
        """Return the map's summary with stable keys."""
        ids = self.scenario.transmitter_ids
        out: dict[str, Any] = {
            "scenario": self.scenario.name,
            "heliostats": len(self.heliostat_ids),
            "postures": self.n_posture,
            "pdop": summarise(self.pdop),
            "vdop": summarise(self.vdop),
            "normal_mrad": {
                name: {**summarise(values), "undetermined": self.undetermined[name]}
                for name, values in self.rms_mrad.items()
            },
            "normal_worst_posture_mrad": {name: summarise(values) for name, values in self.worst_mrad.items()},
            "normal_by_posture_mrad": {
                name: dict(zip(self.posture_names, values, strict=True))
                for name, values in self.by_posture_mrad.items()
            },
            "normal_without_transmitter_mrad": {
                name: dict(zip(ids, values, strict=True)) for name, values in self.lost_one_mrad.items()
            },
        }
        if self.sight is not None:
            seen = self.sight
            out["line_of_sight"] = {
                "seen_mean": float(seen.seen_mean.mean()),
                "seen_least": float(seen.seen_least.min()),
                "by_posture": {
                    name: {"mean": float(mean.mean()), "least": float(least.min())}
                    for name, mean, least in zip(self.posture_names, seen.seen_mean, seen.seen_least, strict=True)
                },
                "transmitter_seen_share": dict(zip(ids, seen.seen_share, strict=True)),
            }
        if self.sensitivity:
            out["sensitivity"] = {name: _sensitivity_dict(ids, s) for name, s in self.sensitivity.items()}
        return out


def _sensitivity_dict(ids: tuple[str, ...], found: TransmitterSensitivity) -> dict[str, Any]:
    """Loss [mrad], survey [mrad per mm], and move [mrad per m]."""
    return {
        name: {
            "lost_mrad": 1e3 * found.lost_rad[k],
            "survey_mrad_per_mm": list(found.survey_rad_per_m[k]),
            "move_mrad_per_m": list(1e3 * found.move_rad_per_m[k]),
        }
        for k, name in enumerate(ids)
    }


def map_layout(
    scenario_path: str | Path,
    *,
    estimators: Sequence[str] | None = None,
    suns_deg: Sequence[Sun] = (),
    postures: Postures | None = None,
    field_csv: str | Path | None = None,
    tone_snr_db: float | None = None,
    sight: Sight | None = None,
    sensitivity: bool = False,
) -> LayoutMap:
    """Return the map of a scenario's heliostats, or of those in a CSV file with the first heliostat's mirror.

    Parameters
    ----------
    scenario_path
        TOML.
    estimators
        Out of `NAMES`: ``scenario``, what `rfpose process` makes of it, without reflections; those of
        `rfpose.layout.maps.ESTIMATORS`; and ``reflection``: the scenario's own solver with the ground's coefficient
        estimated. None: all that the scenario allows.
    suns_deg
        Azimuth and elevation of suns; short for ``postures``.
    postures
        Days, years, suns, stow. Without: each heliostat's own normal, else the simulated sun's first posture, else
        level.
    field_csv
        See `rfpose.layout.fields.read_positions`.
    tone_snr_db
        Overrides the scenario's.
    sight
        What may stand in the way; normals are then bounded by what each receiver sees.
    sensitivity
        Also say what each transmitter's loss, survey and place do.

    Raises
    ------
    ScenarioError
        The scenario or CSV is bad; transmitters too few, on a line or plane; heliostats on each other or on a
        transmitter; the field wider than the longest tone resolves; an estimator that the scenario does not allow. The
        message begins with the file.
    """
    scenario = load_site(scenario_path, field_csv)
    transmitter = scenario.transmitter_enu_m
    if estimators is None:
        estimators = [name for name in NAMES if not _lacks(scenario, name, sight)]
    for name in estimators:
        lacking = _lacks(scenario, name, sight)
        if lacking:
            raise ScenarioError(f"{scenario_path}: estimator `{name}` {lacking}")
    studied = postures_of(scenario, postures or Postures(suns_deg=suns_deg), scenario_path)
    seen = (
        None if sight is None else [visible(transmitter, p.mirrors, sight.plates, tower=sight.tower) for p in studied]
    )
    dilution = maps.dilution(transmitter, scenario.pivot_enu_m)
    rms, worst, by_posture, undetermined, lost, response = {}, {}, {}, {}, {}, {}
    for name in estimators:
        if name == REFLECTION:
            sigma = 1e3 * np.array([_with_reflection(scenario, p, tone_snr_db, scenario_path) for p in studied])
        else:
            study = maps.study_of(scenario, name, tone_snr_db=tone_snr_db)
            sigma = 1e3 * np.array(
                [study.bound(p.mirrors, visible=None if seen is None else seen[k]) for k, p in enumerate(studied)]
            )
            lost[name] = _without_each(study, studied, seen)
            if sensitivity and len(study.rows) == 1:
                response[name] = transmitter_sensitivity(
                    transmitter,
                    stacked([studied[k].mirrors for k in _some(len(studied))]),
                    study.noise,
                    next(iter(study.rows)),
                    calibration_enu_m=scenario.calibration_enu_m,
                )
        rms[name], by_posture[name] = _rms(sigma, 0), _rms(sigma, 1)
        worst[name] = np.where(np.isfinite(sigma).any(axis=0), np.fmax.reduce(sigma, axis=0), np.nan)
        undetermined[name] = float(np.isnan(sigma).mean())
    return LayoutMap(
        scenario=scenario,
        heliostat_ids=scenario.heliostat_ids,
        pivot_enu_m=scenario.pivot_enu_m,
        posture_names=tuple(p.name for p in studied),
        pdop=dilution.position,
        vdop=dilution.vertical,
        rms_mrad=rms,
        worst_mrad=worst,
        by_posture_mrad=by_posture,
        undetermined=undetermined,
        lost_one_mrad=lost,
        sight=None if seen is None else _sight_map(np.array(seen)),
        sensitivity=response,
    )


def _lacks(scenario: Scenario, name: str, sight: Sight | None) -> str:
    """Return why an estimator cannot be studied, as the end of a sentence; empty where it can."""
    carrier = name == REFLECTION or (name in ESTIMATORS and ESTIMATORS[name].carrier)
    if name == REFLECTION and scenario.simulation.ground is None:
        return "needs a ground that reflects; add [simulation.ground], or choose another"
    if name == REFLECTION and sight is not None:
        return "knows no line of sight; leave --line-of-sight away, or choose another"
    if carrier and not scenario.has_rf_carriers:
        return (
            "needs carriers whose radio frequencies are above zero; set `radio.centre_frequency_hz`, or choose another"
        )
    return ""


def _with_reflection(scenario: Scenario, posture: Posture, tone_snr_db: float | None, path: str | Path) -> FloatArray:
    """(heliostat,) bound of the scenario's own solver when it also estimates the ground's coefficient [rad]."""
    data = scenario.model_dump(exclude_none=True)
    data["budget"] = {**data.get("budget", {}), "ground": "estimated"}
    if tone_snr_db is not None:
        data["simulation"] = {**data.get("simulation", {}), "tone_snr_db": tone_snr_db}
    try:
        return noise_bound(make_plan(check_scenario(data), posture.mirrors))
    except (GeometryError, InvalidInputError, ScenarioError) as error:
        raise ScenarioError(f"{path}: {error}") from error


def _rms(sigma: FloatArray, axis: int) -> FloatArray:
    """Rms of what is finite along an axis; NaN where nothing is."""
    good = np.isfinite(sigma)
    count = good.sum(axis=axis)
    square = np.where(good, sigma, 0.0) ** 2
    return np.asarray(np.sqrt(square.sum(axis=axis) / np.where(count > 0, count, np.nan)))


def _sight_map(seen: BoolArray) -> SightMap:
    """Count what (posture, heliostat, receiver, transmitter) says is seen."""
    count = seen.sum(axis=3)
    return SightMap(
        seen_mean=count.mean(axis=2),
        seen_least=count.min(axis=2).astype(np.float64),
        seen_share=seen.mean(axis=(0, 1, 2)),
    )


def _some(n_posture: int) -> list[int]:
    """Postures spread over all, few enough."""
    if n_posture <= _MOST_LOST_POSTURES:
        return list(range(n_posture))
    return [int(k) for k in np.linspace(0, n_posture - 1, _MOST_LOST_POSTURES).round()]


def _without_each(study: Study, postures: list[Posture], seen: list[BoolArray] | None) -> FloatArray:
    """Rms over field and postures with each transmitter lost (transmitter,) [mrad]; with sight, of what is left."""
    sigma = np.concatenate(
        [
            study.without_each(postures[k].mirrors, visible=None if seen is None else seen[k])
            for k in _some(len(postures))
        ],
        axis=1,
    )
    rms = 1e3 * (np.sqrt(np.mean(sigma**2, axis=1)) if seen is None else _rms(sigma, 1))
    return np.where(np.isnan(rms), np.inf, rms)


def write_layout_csv(found: LayoutMap, path: str | Path) -> None:
    """Write one row a heliostat: place, dilution, the normal's bound by estimator, and how much it sees."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    names = list(found.rms_mrad)
    header = ["id", "east_m", "north_m", "up_m", "pdop", "vdop"]
    header += [f"normal_{name}_{kind}_mrad" for name in names for kind in ("rms", "worst")]
    writer.writerow(header + (["seen_mean", "seen_least"] if found.sight else []))
    for i, name in enumerate(found.heliostat_ids):
        values = [*found.pivot_enu_m[i], found.pdop[i], found.vdop[i]]
        for key in names:
            values += [found.rms_mrad[key][i], found.worst_mrad[key][i]]
        if found.sight is not None:
            values += [found.sight.seen_mean[:, i].mean(), found.sight.seen_least[:, i].min()]
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
    seen = "\n(what each receiver sees past plates and tower)" if found.sight is not None else ""
    axes.set_title(f"{found.scenario.name}: {name}, RMS {summarise(mrad)['rms']:.3g} mrad over the field{seen}")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    _save(figure, path)
