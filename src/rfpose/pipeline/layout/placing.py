"""Better places for a scenario's transmitters, and what more of them would buy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from rfpose.checks import FloatArray
from rfpose.drawing import BLUE, VERMILION, WIDTH_INCH, angle_unit, blank_figure, new_figure
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.files import write_atomically
from rfpose.layout import maps
from rfpose.layout import optimise as search
from rfpose.layout.maps import PosedMirrors
from rfpose.layout.optimise import (
    Constraints,
    Costs,
    Criterion,
    Placement,
    Sightlines,
    Zone,
    evaluate_placement,
)
from rfpose.measurement import noise_of
from rfpose.multilat.normal import MAX_SIGMA_RAD
from rfpose.pipeline.layout.site import (
    Field,
    FieldPosture,
    Postures,
    Site,
    Sun,
    load_site,
    postures_of,
    stacked,
    suns_of,
)
from rfpose.pipeline.layout.text import edited
from rfpose.pipeline.pictures.plan import draw_mirrors, draw_site, finish_plan
from rfpose.scenario import Box, Heliostat, PositionForm, Scenario, naming, read_positions
from rfpose.shown import Shown, number
from rfpose.tables import Tabled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Rules", "SitePlacement", "SitePlacements", "optimise", "pareto"]

SITE = "site"
SiteCriterion = Criterion | Literal["site"]
"""What may be minimised."""

_STARTS_BEFORE_EXCHANGE = 5
_SEPARATION = 0.05
"""Towers keep this share of the radius from each other, unless told otherwise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """Where towers may stand, for `optimise`; all [m].

    Attributes
    ----------
    radius_m, height_m
        Circle about the origin, and antenna heights; by default those that the scenario's transmitters use.
    outline_csv
        Corners of the allowed ground instead of the circle (columns ``east_m``, ``north_m``).
    allowed_m, excluded_m
        Circles (x, y, radius): further ground that may be used, and ground that must not.
    separation_m
        Between towers; default: a twentieth of the radius, since a rigid mirror's optimum would stack them.
    clearance_m
        To heliostats.
    sight_m
        From the lines of sight of mirrors to the aim point, beside or below; 0: towers may stand in them. Default: half
        the diagonal of the largest mirror and half a metre for the mast.
    keep
        The scenario's first so many transmitters stay where they are.
    """

    radius_m: float | None = None
    height_m: tuple[float, float] | None = None
    outline_csv: str | Path | None = None
    allowed_m: Sequence[tuple[float, float, float]] = ()
    excluded_m: Sequence[tuple[float, float, float]] = ()
    separation_m: float | None = None
    clearance_m: float = 0.0
    sight_m: float | None = None
    keep: int = 0

    def constraints(self, scenario: Scenario) -> Constraints:
        """Return the rules with defaults taken from the scenario as it is."""
        transmitter_enu_m = scenario.transmitter_enu_m
        own_radius = float(np.hypot(transmitter_enu_m[:, 0], transmitter_enu_m[:, 1]).max())
        radius = own_radius if self.radius_m is None else self.radius_m
        for name in ("radius_m", "separation_m", "sight_m"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < np.inf:
                raise InvalidInputError(f"`{name}` must be a number of metres, not negative, got {value}")
        if not 0.0 <= self.clearance_m < np.inf:
            raise InvalidInputError(f"`clearance_m` must be a number of metres, not negative, got {self.clearance_m}")
        if self.height_m is not None and not self.height_m[0] <= self.height_m[1]:
            raise InvalidInputError(
                f"`height_m` must be the lowest and the highest, in this order, got {self.height_m}"
            )
        heights = (float(transmitter_enu_m[:, 2].min()), float(transmitter_enu_m[:, 2].max()))
        ground = Zone(radius_m=radius)
        if self.outline_csv is not None:
            ground = Zone(corner_enu_m=read_positions(self.outline_csv, PositionForm(pivot_height_m=0.0))[1][:, :2])
        return Constraints(
            allowed=(ground, *(Zone(centre_enu_m=(x, y), radius_m=r) for x, y, r in self.allowed_m)),
            height_m=heights if self.height_m is None else self.height_m,
            excluded=(
                *(Zone(centre_enu_m=(x, y), radius_m=r) for x, y, r in self.excluded_m),
                *(_around(box) for box in scenario.site.structures.box),
            ),
            separation_m=_SEPARATION * radius if self.separation_m is None else self.separation_m,
            clearance_m=self.clearance_m,
            sight=sightlines(scenario, self.sight_m),
        )


def _around(box: Box) -> Zone:
    """Return the ground of a tower or building; antennas may stand on top."""
    half = 0.5 * np.array(box.size_m[:2]) + _BESIDE_M
    angle = np.radians(box.azimuth_deg)
    rot = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corner = half * [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]] @ rot
    return Zone(corner_enu_m=corner + np.array(box.base_enu_m[:2]), top_m=box.base_enu_m[2] + box.size_m[2] + _BESIDE_M)


_BESIDE_M = 0.1
"""Between a building and an antenna: more than places are rounded by."""
_MAST_M = 0.5
"""What a mast needs beside a mirror's light."""


def sightlines(scenario: Scenario, clearance_m: float | None = None) -> Sightlines | None:
    """Return the lines from mirrors to the aim point; None without one, or with no clearance."""
    aim = scenario.site.aim_enu_m
    if aim is None or clearance_m == 0.0:
        return None
    pivot = scenario.pivot_enu_m
    if clearance_m is None:
        clearance_m = _MAST_M + max(_half_m(mirror) for mirror in scenario.heliostat)
    return Sightlines(start_enu_m=pivot, end_enu_m=np.broadcast_to(aim, pivot.shape), clearance_m=clearance_m)


def _half_m(mirror: Heliostat) -> float:
    """Return how far a mirror reaches from its middle: by its outline, else by its receivers [m]."""
    if mirror.width_m is not None and mirror.height_m is not None:
        return 0.5 * float(np.hypot(mirror.width_m, mirror.height_m))
    return float(np.linalg.norm(np.asarray(mirror.receiver_mirror_m), axis=1).max())


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerShade:
    """What towers do to mirrors' light.

    Attributes
    ----------
    crossed
        Lines of sight, of so many mirrors, with a tower in their way; None without an aim point.
    shaded
        Mirrors and suns of the postures with a tower between them, of ``mirror_suns``.
    """

    crossed: int | None
    shaded: int
    mirror_suns: int


_SHADE_M = 1000.0


def _standing(scenario: Scenario, suns: Sequence[FloatArray]) -> TowerShade:
    lines, tower, pivot = sightlines(scenario), scenario.transmitter_enu_m, scenario.pivot_enu_m
    half = _MAST_M + max(_half_m(mirror) for mirror in scenario.heliostat)
    shaded = 0
    for sun in suns:
        way = Sightlines(start_enu_m=pivot, end_enu_m=pivot + _SHADE_M * sun, clearance_m=half)
        shaded += way.crossed(tower)
    crossed = None if lines is None else lines.crossed(tower)
    return TowerShade(crossed=crossed, shaded=shaded, mirror_suns=len(suns) * len(pivot))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SitePlacement(Shown):
    """Transmitters placed anew: the placement, the scenario with it, and what it was before.

    Attributes
    ----------
    placement, scenario
        After; places in round numbers.
    source
        The scenario's file, whose text `save` changes; None: there is none, or its field was replaced.
    site
        Before.
    before, before_pdop, after_pdop
        What was minimised, and PDOP.
    without_sight
        What was minimised, had towers been allowed in lines of sight; None where they were, or there are none.
    standing_before, standing
        What towers do to mirrors' light.
    """

    placement: Placement
    scenario: Scenario
    source: Path | None
    site: Scenario
    before: float
    before_pdop: float
    after_pdop: float
    without_sight: float | None
    standing_before: TowerShade
    standing: TowerShade

    def as_dict(self) -> dict[str, Any]:
        """Return the placement with stable keys; angles in mrad of the normal."""
        found = self.placement
        factor = _factor(found)
        return {
            "criterion": found.criterion,
            "statistic": found.statistic,
            "unit": "" if found.criterion == "pdop" else "mrad",
            "value": factor * found.value,
            "before": factor * self.before,
            "without_worst": factor * found.lost_one,
            "pdop_rms": self.after_pdop,
            "pdop_rms_before": self.before_pdop,
            "without_sight_lines": None if self.without_sight is None else factor * self.without_sight,
            "sight_lines_crossed": self.standing.crossed,
            "sight_lines_crossed_before": self.standing_before.crossed,
            "mirror_suns": self.standing.mirror_suns,
            "mirror_suns_shaded": self.standing.shaded,
            "mirror_suns_shaded_before": self.standing_before.shaded,
            "cost": found.cost,
            "searches": len(found.start_value),
            "searches_failed": int(np.isnan(found.start_value).sum()),
            "transmitters": {t.id: list(t.position_enu_m) for t in self.scenario.transmitter},
        }

    def headline(self) -> str:
        """Return what was minimised, and how far."""
        found = self.as_dict()
        now = f"{number(found['value'], 4)} {found['unit']}".rstrip()
        return f"{self.scenario.name!r}: {found['criterion']} {found['statistic']} {now}, was {found['before']:.4g}"

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return the transmitters' places."""
        rows = [[t.id, *(f"{x:.3f}" for x in t.position_enu_m)] for t in self.scenario.transmitter]
        return ["transmitter", "east [m]", "north [m]", "up [m]"], rows

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the scenario with the new places: its file's text with comments and all, else see `Scenario.save`.

        Raises
        ------
        RecordingError
            The file exists, or cannot be written.
        """
        text = None if self.source is None else edited(self.source, self.scenario, folder=Path(path).resolve().parent)
        if text is None:
            self.scenario.save(path, force=force)
        else:
            write_atomically(path, text.encode(), force=force)

    def plot(self) -> Figure:
        """Draw the field before and after, each mirror in the colour of its PDOP or of its normal's bound."""
        return _before_and_after(self)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SitePlacements(Shown, Tabled):
    """The best placement for each number of transmitters, and whether none beats it in cost, accuracy and loss."""

    scenario: Scenario
    found: tuple[tuple[Placement, bool], ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the curve with stable keys; angles in mrad of the normal."""
        first = self.found[0][0]
        return {
            "criterion": first.criterion,
            "statistic": first.statistic,
            "unit": "" if first.criterion == "pdop" else "mrad",
            "placements": [
                {
                    "transmitters": len(p.transmitter_enu_m),
                    "cost": p.cost,
                    "value": _factor(p) * p.value,
                    "without_worst": _factor(p) * p.lost_one,
                    "efficient": free,
                    "positions_enu_m": p.transmitter_enu_m.tolist(),
                }
                for p, free in self.found
            ],
        }

    def headline(self) -> str:
        """Return which scenario, and how many numbers of transmitters."""
        return f"{self.scenario.name!r}: {len(self.found)} numbers of transmitters"

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return one row a number of transmitters."""
        header, rows = self.table()
        return header, [[number(float(value), 4) for value in row] for row in rows]

    def table(self) -> tuple[list[str], list[list[Any]]]:
        """Return one row a number of transmitters."""
        summary = self.as_dict()
        unit = f"_{summary['unit']}" if summary["unit"] else ""
        name = f"{summary['criterion']}_{summary['statistic']}"
        header = ["transmitters", "cost", f"{name}{unit}", f"{name}_without_worst{unit}", "efficient"]
        keys = ("cost", "value", "without_worst")
        return header, [
            [row["transmitters"], *(row[key] for key in keys), int(row["efficient"])] for row in summary["placements"]
        ]

    def plot(self) -> Figure:
        """Draw accuracy, whole and with the worst transmitter lost, against number and cost of transmitters."""
        return _drawn(self)


def _factor(placement: Placement) -> float:
    return 1.0 if placement.criterion == "pdop" else 1e3


@dataclass(frozen=True, slots=True, kw_only=True)
class _Task:
    """A scenario made ready for placement."""

    scenario: Scenario
    postures: tuple[FieldPosture, ...]
    field: PosedMirrors
    constraints: Constraints
    suns: tuple[FloatArray, ...]
    keep: int
    criterion: str
    statistic: str
    costs: Costs | None
    starts: int
    seed: int

    @property
    def sigma_m(self) -> float:
        """Range noise [m]; 1: dilution is wanted."""
        return 1.0 if self.criterion in ("pdop", SITE) else _sigma_m(self.scenario)

    def place(self, n_transmitter: int, on_progress: Callable[[int, int], None] | None) -> Placement:
        """Place so many transmitters."""
        now = self.scenario.transmitter_enu_m
        by_slope = self.criterion != SITE
        found = search.optimise(
            n_transmitter,
            self.field,
            self.constraints,
            criterion=cast(Criterion, self.criterion) if by_slope else "shared-clock",
            statistic=self.statistic,
            existing_enu_m=now[: self.keep] if self.keep else None,
            costs=self.costs,
            sigma_m=self.sigma_m,
            starts=self.starts if by_slope else min(self.starts, _STARTS_BEFORE_EXCHANGE),
            seed=self.seed,
            progress=on_progress if by_slope else None,
        )
        if by_slope:
            return found
        return search.exchange(
            found, self.site_variance, self.field, self.constraints, criterion=SITE, costs=self.costs,
            tries=max(self.starts, 2), seed=self.seed, also_from=[now] if n_transmitter == len(now) else [],
            progress=on_progress,
        )  # fmt: skip

    def value(self, transmitter_enu_m: FloatArray) -> float:
        """Return what the criterion says of transmitters."""
        if self.criterion == SITE:
            return search.measured(self.site_variance, transmitter_enu_m, self.statistic)
        return evaluate_placement(
            transmitter_enu_m, self.field, criterion=cast(Criterion, self.criterion), statistic=self.statistic,
            sigma_m=self.sigma_m,
        )  # fmt: skip

    def site_variance(self, transmitter_enu_m: FloatArray) -> FloatArray:
        """(posture × heliostat,) what pose ``site`` would state [rad²]; of a mirror it cannot solve, the most."""
        from rfpose.pipeline.site import forecast_normals

        moved = self.scenario.with_transmitters(transmitter_enu_m)
        sigma = [
            forecast_normals(moved, np.concatenate([p.mirrors.rot_enu_from_mirror, p.plate_rot])).sigma_rad
            for p in self.postures
        ]
        return np.nan_to_num(np.concatenate(sigma), nan=MAX_SIGMA_RAD) ** 2


def _task(
    site: Site,
    field: Field,
    rules: Rules | None,
    postures: Postures,
    *,
    criterion: str,
    statistic: str,
    costs: Costs | None,
    starts: int,
    seed: int,
) -> _Task:
    chosen = rules or Rules()
    scenario = load_site(site, field)
    now = scenario.transmitter_enu_m
    with naming(site):
        if not 0 <= chosen.keep <= len(now):
            raise ScenarioError(f"cannot keep {chosen.keep} transmitters, the scenario has {len(now)}")
        if len(scenario.mast_enu_m) < len(now):
            raise ScenarioError(
                "a transmitter with a `mast` is no place of its own; place one carrier an antenna, then add the others"
            )
        studied = tuple(postures_of(scenario, postures))
        if criterion == SITE:
            from rfpose.pipeline.site import check_site_solvable

            check_site_solvable(scenario)
    return _Task(
        scenario=scenario, postures=studied, field=stacked([p.mirrors for p in studied]),
        constraints=chosen.constraints(scenario), suns=tuple(suns_of(scenario, postures)), keep=chosen.keep,
        criterion=criterion, statistic=statistic, costs=costs, starts=starts, seed=seed,
    )  # fmt: skip


def optimise(
    scenario: Site,
    *,
    n_transmitter: int | None = None,
    criterion: SiteCriterion = "pdop",
    statistic: str = "rms",
    rules: Rules | None = None,
    costs: Costs | None = None,
    suns_deg: Sequence[Sun] = (),
    postures: Postures | None = None,
    field: Field = None,
    starts: int = 30,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
) -> SitePlacement:
    """Place a scenario's transmitters anew for its heliostats; see `rfpose.layout.optimise.optimise`.

    Parameters
    ----------
    scenario, field
        As in `layout_map`.
    n_transmitter
        As many as the scenario has, by default.
    criterion
        One of `rfpose.layout.optimise.CRITERIA`; or ``site``: what pose ``site`` would state among the site's
        reflections. That has no slope: towers are exchanged one after the other (`rfpose.layout.optimise.exchange`),
        from where they stand or from the best for ``shared-clock``, whichever is better.
    rules
        Where they may stand.
    starts
        Random starts; with ``site``, places tried for each tower in each round.
    suns_deg, postures
        As in `layout_map`.

    Raises
    ------
    ScenarioError
        As `layout_map`; constraints that cannot be met.

    Examples
    --------
    >>> import rfpose as rf
    >>> better = rf.optimise(rf.shipped_scenario("table2_100m.toml"), starts=2)
    >>> better.after_pdop < better.before_pdop
    True
    >>> len(better.scenario.transmitter)
    10
    """
    task = _task(
        scenario, field, rules, postures or Postures(suns_deg=suns_deg),
        criterion=criterion, statistic=statistic, costs=costs, starts=starts, seed=seed,
    )  # fmt: skip
    now = task.scenario.transmitter_enu_m
    step_m, sight = _step_m(now), task.constraints.sight
    n, tell = n_transmitter or len(now), on_progress or (lambda _done, _total: None)
    # still clear of it when places are rounded
    wide = None if sight is None else replace(sight, clearance_m=sight.clearance_m + step_m)
    if wide is not None:
        task = replace(task, constraints=replace(task.constraints, sight=wide))
    with naming(scenario):
        if wide is None or criterion == SITE:  # which would take too long twice
            found, without = task.place(n, tell), None
        else:
            free = replace(task, constraints=replace(task.constraints, sight=None))
            found = free.place(n, lambda k, total: tell(k, 2 * total))
            without = found.value
            # the best of all places is the best of those in no line, if it is one of them
            if wide.crossed(found.transmitter_enu_m[task.keep :]):
                found = task.place(n, lambda k, total: tell(total + k, 2 * total))
        kept = replace(task.constraints, sight=sight)
        new = search.pegged(found.transmitter_enu_m[task.keep :], now[: task.keep], task.field, kept, step_m=step_m)
        places = np.vstack([now[: task.keep], new])
        better = task.scenario.with_transmitters(maps.check_site(places))
        before, value = task.value(now), task.value(places)
    return SitePlacement(
        placement=replace(found, transmitter_enu_m=places, value=value),
        scenario=better,
        source=Path(scenario) if field is None and not isinstance(scenario, Scenario) else None,
        site=task.scenario,
        before=before,
        before_pdop=evaluate_placement(now, task.field),
        after_pdop=evaluate_placement(places, task.field),
        without_sight=without,
        standing_before=_standing(task.scenario, task.suns),
        standing=_standing(better, task.suns),
    )


_ROUND = 1e-4
"""Places are written to so much of the site's size."""


def _step_m(transmitter_enu_m: FloatArray) -> float:
    """Return to what places are rounded, so that one can peg them out: a centimetre on a site of 100 m."""
    size = max(float(np.ptp(transmitter_enu_m[:, :2], axis=0).max()), 1e-9)
    return float(10.0 ** np.round(np.log10(_ROUND * size)))


def pareto(
    scenario: Site,
    counts: Sequence[int],
    *,
    criterion: SiteCriterion = "pdop",
    statistic: str = "rms",
    rules: Rules | None = None,
    costs: Costs | None = None,
    postures: Postures | None = None,
    field: Field = None,
    starts: int = 30,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
) -> SitePlacements:
    """Place several numbers of transmitters: cost, accuracy, and what is left when the worst one to lose is lost.

    Parameters
    ----------
    counts
        Numbers of transmitters, those kept included.
    scenario, criterion, statistic, rules, costs, postures, field, starts, seed
        As in `optimise`.

    Raises
    ------
    ScenarioError
        As `optimise`.
    """
    task = _task(
        scenario, field, rules, postures or Postures(),
        criterion=criterion, statistic=statistic, costs=costs, starts=starts, seed=seed,
    )  # fmt: skip
    found = []
    with naming(scenario):
        for k, n in enumerate(counts):
            found.append(task.place(n, None))
            if on_progress is not None:
                on_progress(k + 1, len(counts))
    return SitePlacements(scenario=task.scenario, found=tuple(search.efficient(found)))


def _sigma_m(scenario: Scenario) -> float:
    """Range noise of one transmitter of mean amplitude, all tones together [m]."""
    tone = noise_of(scenario).tone_sigma_m
    return float(np.mean((tone**-2.0).sum(axis=0)) ** -0.5)


def _drawn(curve: SitePlacements) -> Figure:
    summary = curve.as_dict()
    rows = summary["placements"]
    count = [row["transmitters"] for row in rows]
    figure, axes = new_figure(8.0, 5.4)
    axes.plot(count, [row["value"] for row in rows], "o-", color=BLUE, label="all transmitters")
    lost = np.array([row["without_worst"] for row in rows], np.float64)
    axes.plot(count, np.where(np.isfinite(lost), lost, np.nan), "s--", color=VERMILION, label="the worst one lost")
    beaten = [k for k, row in enumerate(rows) if not row["efficient"]]
    if beaten:
        axes.plot([count[k] for k in beaten], [rows[k]["value"] for k in beaten], "x", color="k", ms=9, label="beaten")
    for row in rows:
        axes.annotate(f"{row['cost']:.4g}", (row["transmitters"], row["value"]), (0, -14), fontsize=8,
                      textcoords="offset points", ha="center")  # fmt: skip
    axes.set_xlabel("transmitters (numbers below the points: cost)")
    unit = f" [{summary['unit']} of the normal]" if summary["unit"] else ""
    axes.set_ylabel(f"{summary['criterion']}, {summary['statistic']} over the field{unit}")
    axes.set_xticks(count)
    axes.set_ylim(0.0, None)
    axes.margins(x=0.06)
    axes.grid(alpha=0.3)
    axes.legend()
    axes.set_title(f"{curve.scenario.name}: accuracy against number of transmitters")
    return figure


def _before_and_after(found: SitePlacement) -> Figure:
    from rfpose.pipeline.layout.mapping import layout_map

    shown = [layout_map(site, estimators=[_estimator(found)]) for site in (found.site, found.scenario)]
    is_dop = found.placement.criterion == "pdop"
    values = [each.pdop if is_dop else each.rms_mrad[_estimator(found)] for each in shown]
    factor, unit = (1.0, "") if is_dop else angle_unit(np.concatenate(values))
    label = "PDOP" if is_dop else f"bound of the normal, {_estimator(found)} [{unit}]"
    known = np.concatenate(values)
    limits = (0.0, factor * float(np.nanmax(known)) if np.isfinite(known).any() else 1.0)
    figure = blank_figure(WIDTH_INCH, 4.3)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, site, value, name in zip(panels, (found.site, found.scenario), values, ("before", "after"), strict=True):
        dots = draw_mirrors(axes, site.pivot_enu_m, factor * value, limits=limits)
        draw_site(axes, site)
        rms = factor * float(np.sqrt(np.nanmean(value**2)))
        axes.set_title(f"{name}: RMS {rms:.3g} {unit}".rstrip(), fontsize=9)
    figure.colorbar(dots, ax=list(panels), label=label, shrink=0.8)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(f"{found.scenario.name}: transmitters placed for {found.placement.criterion}", fontsize=10)
    for axes, site in zip(panels, (found.site, found.scenario), strict=True):
        finish_plan(axes, site, site.pivot_enu_m)
    return figure


def _estimator(found: SitePlacement) -> str:
    return "rigid" if found.placement.criterion == "pdop" else found.placement.criterion
