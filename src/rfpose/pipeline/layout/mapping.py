"""The map of a field: what every mirror's normal can be known to, in which postures, and by which transmitters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.drawing import WIDTH_INCH, angle_unit, new_figure
from rfpose.errors import ScenarioError
from rfpose.layout import maps
from rfpose.layout.maps import ESTIMATORS, NormalsStudy, summarise
from rfpose.layout.sensitivity import TransmitterSensitivity, transmitter_sensitivity
from rfpose.layout.sight import visible
from rfpose.measurement import SCENARIO, first_snr
from rfpose.multilat import PoseStatus
from rfpose.pipeline.layout.site import Field, FieldPosture, Postures, Sight, Site, Sun, load_site, postures_of, stacked
from rfpose.pipeline.pictures.plan import draw_mirrors, draw_site, finish_plan
from rfpose.scenario import Scenario, naming
from rfpose.shown import Shown, counted, number
from rfpose.tables import Tabled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rfpose.pipeline.site import SiteForecast

__all__ = ["LayoutMap", "SightMap", "layout_map"]

REFLECTION = "reflection"
"""The scenario's own solver, the ground's coefficient estimated with the poses; where ``[simulation.ground]`` is."""

SITE = "site"
"""What pose ``site`` would state, rays foreseen; only where asked for, since foreseeing them takes its time."""

NAMES = (SCENARIO, *ESTIMATORS, REFLECTION, SITE)
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


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LayoutMap(Shown, Tabled):
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
    unsolved : (heliostat,)
        Where ``site`` is studied: why a mirror is not solved in the first posture in which it is not; empty: it is.
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
    unsolved: tuple[str, ...] = ()

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
        if any(self.unsolved):
            out["site_unsolved"] = {
                name: reason for name, reason in zip(self.heliostat_ids, self.unsolved, strict=True) if reason
            }
        if self.sensitivity:
            out["sensitivity"] = {name: _sensitivity_dict(ids, s) for name, s in self.sensitivity.items()}
        return out

    def headline(self) -> str:
        """Return which scenario, and how many heliostats and postures."""
        counts = f"{counted(len(self.heliostat_ids), 'heliostat')}, {counted(self.n_posture, 'posture')}"
        return f"{self.scenario.name!r}: {counts}"

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return the bound of the normal over the field, by estimator."""
        rows = [[name, *(number(v, 4) for v in summarise(mrad).values())] for name, mrad in self.rms_mrad.items()]
        return ["bound of the normal [mrad]", *summarise(self.pdop)], rows

    def table(self) -> tuple[list[str], list[list[Any]]]:
        """Return one row a heliostat: place, dilution, the normal's bound by estimator, and how much it sees."""
        names = list(self.rms_mrad)
        header = ["id", "east_m", "north_m", "up_m", "pdop", "vdop"]
        header += [f"normal_{name}_{kind}_mrad" for name in names for kind in ("rms", "worst")]
        header += ["seen_mean", "seen_least"] if self.sight else []
        header += ["site_unsolved"] if self.unsolved else []
        rows = []
        for i, name in enumerate(self.heliostat_ids):
            values = [*self.pivot_enu_m[i], self.pdop[i], self.vdop[i]]
            for key in names:
                values += [self.rms_mrad[key][i], self.worst_mrad[key][i]]
            if self.sight is not None:
                values += [self.sight.seen_mean[:, i].mean(), self.sight.seen_least[:, i].min()]
            rows.append([name, *values, *self.unsolved[i : i + 1]])
        return header, rows

    def plot(self, *, estimator: str | None = None) -> Figure:
        """Draw the field from above, each heliostat in the colour of its normal's bound; by default the first's."""
        return _drawn(self, estimator or next(iter(self.rms_mrad)))


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


def layout_map(
    scenario: Site,
    *,
    estimators: Sequence[str] | None = None,
    suns_deg: Sequence[Sun] = (),
    postures: Postures | None = None,
    field: Field = None,
    tone_snr_db: float | None = None,
    sight: Sight | None = None,
    sensitivity: bool = False,
) -> LayoutMap:
    """Return what each mirror's normal can be known to, over a scenario's field or another.

    Parameters
    ----------
    scenario
        The site, or its TOML file.
    estimators
        Out of `NAMES`: ``scenario``, what `rfpose process` makes of it, without reflections; those of
        `rfpose.layout.maps.ESTIMATORS`; ``reflection``: the scenario's own solver with the ground's coefficient
        estimated; and ``site``: what pose ``site`` states, the rays foreseen. None: all that the scenario allows but
        ``site``, which takes its time.
    suns_deg
        Azimuth and elevation of suns; short for ``postures``.
    postures
        Days, years, suns, stow. Without: each heliostat's own normal, else the simulated sun's first posture, else
        level.
    field : (heliostat, xyz)
        Heliostats like the first instead of the scenario's: pivots [m] or a CSV file; see `Scenario.with_field`.
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
        message begins with the file, if there is one.

    Examples
    --------
    >>> import rfpose as rf
    >>> rf.layout_map(rf.shipped_scenario("table2_100m.toml"), estimators=["rigid"])
    <LayoutMap 'Table 2, 100 m field': 12 heliostats, 1 posture>
    """
    site = load_site(scenario, field)
    first_snr(site, tone_snr_db)  # what the caller says is no fault of the file
    with naming(scenario):
        return _map(site, estimators, postures or Postures(suns_deg=suns_deg), tone_snr_db, sight, sensitivity)


def _map(
    scenario: Scenario,
    estimators: Sequence[str] | None,
    postures: Postures,
    tone_snr_db: float | None,
    sight: Sight | None,
    sensitivity: bool,
) -> LayoutMap:
    transmitter = scenario.transmitter_enu_m
    if estimators is None:
        estimators = [name for name in NAMES if name != SITE and not _lacks(scenario, name, sight)]
    for name in estimators:
        lacking = _lacks(scenario, name, sight)
        if lacking:
            raise ScenarioError(f"estimator `{name}` {lacking}")
    studied = postures_of(scenario, postures)
    seen = (
        None if sight is None else [visible(transmitter, p.mirrors, sight.plates, tower=sight.tower) for p in studied]
    )
    dilution = maps.dilution(transmitter, scenario.pivot_enu_m)
    rms, worst, by_posture, undetermined, lost, response = {}, {}, {}, {}, {}, {}
    unsolved: tuple[str, ...] = ()
    for name in estimators:
        if name == REFLECTION:
            sigma = 1e3 * np.array([_with_reflection(scenario, p, tone_snr_db) for p in studied])
        elif name == SITE:
            forecasts = [_with_site(scenario, p, tone_snr_db) for p in studied]
            sigma = 1e3 * np.array([found.sigma_rad for found in forecasts])
            unsolved = _reasons(np.array([found.status for found in forecasts]))
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
        unsolved=unsolved,
    )


def _lacks(scenario: Scenario, name: str, sight: Sight | None) -> str:
    """Return why an estimator cannot be studied, as the end of a sentence; empty where it can."""
    carrier = name == REFLECTION or (name in ESTIMATORS and ESTIMATORS[name].carrier)
    if name == REFLECTION and scenario.simulation.ground is None:
        return "needs a ground that reflects; add [simulation.ground], or choose another"
    if name == SITE and sight is not None:
        return "foresees for itself what hides ([site.structures]); leave `sight=` away, or choose another"
    if name == REFLECTION and sight is not None:
        return "knows no line of sight; leave `sight=` away, or choose another"
    if carrier and not scenario.has_rf_carriers:
        return (
            "needs carriers whose radio frequencies are above zero; set `radio.centre_frequency_hz`, or choose another"
        )
    return ""


def _with_reflection(scenario: Scenario, posture: FieldPosture, tone_snr_db: float | None) -> FloatArray:
    """(heliostat,) bound of the scenario's own solver when it also estimates the ground's coefficient [rad]."""
    from rfpose.layout.budget import noise_bound, working_point

    snr = {} if tone_snr_db is None else {"tone_snr_db": tone_snr_db}
    return noise_bound(working_point(scenario.changed(budget={"ground": "estimated"}, simulation=snr), posture.mirrors))


def _with_site(scenario: Scenario, posture: FieldPosture, tone_snr_db: float | None) -> SiteForecast:
    rot = np.concatenate([posture.mirrors.rot_enu_from_mirror, posture.plate_rot])
    from rfpose.pipeline.site import forecast_normals

    return forecast_normals(scenario, rot, tone_snr_db=tone_snr_db)


def _reasons(status: npt.NDArray[np.int64]) -> tuple[str, ...]:
    """(heliostat,) why each is not solved, of the first posture (posture, heliostat) in which it is not."""
    first = np.take_along_axis(status, np.argmax(status != PoseStatus.OK, axis=0)[None], axis=0)[0]
    return tuple("" if s == PoseStatus.OK else PoseStatus(s).reason for s in first.tolist())


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


def _without_each(study: NormalsStudy, postures: list[FieldPosture], seen: list[BoolArray] | None) -> FloatArray:
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


def _drawn(found: LayoutMap, name: str) -> Figure:
    mrad = found.rms_mrad[name]
    factor, unit = angle_unit(mrad)
    figure, axes = new_figure(WIDTH_INCH, 6.4)
    dots = draw_mirrors(axes, found.pivot_enu_m, factor * mrad)
    postures = f", RMS over {found.n_posture} postures" if found.n_posture > 1 else ""
    figure.colorbar(dots, ax=axes, label=f"bound of the mirror normal{postures} [{unit}]", shrink=0.85)
    draw_site(axes, found.scenario)
    seen = "\n(what each receiver sees past plates and tower)" if found.sight is not None else ""
    rms = factor * summarise(mrad)["rms"]
    axes.set_title(f"{found.scenario.name}: {name}, RMS {rms:.3g} {unit} over the field{seen}")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    texts = [f"{n} {v:.2g}" if np.isfinite(v) else n for n, v in zip(found.heliostat_ids, factor * mrad, strict=True)]
    finish_plan(axes, found.scenario, found.pivot_enu_m, texts)
    return figure
