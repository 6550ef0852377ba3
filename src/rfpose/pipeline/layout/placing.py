"""Better places for a scenario's transmitters, and what more of them would buy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from rfpose.checks import FloatArray
from rfpose.drawing import new_figure
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.layout import maps
from rfpose.layout import optimise as search
from rfpose.layout.maps import Mirrors
from rfpose.layout.optimise import (
    Constraints,
    Costs,
    Criterion,
    Placement,
    Zone,
    evaluate_placement,
)
from rfpose.measurement import noise_of
from rfpose.multilat.normal import MAX_SIGMA_RAD
from rfpose.pipeline.layout.site import Field, Posture, Postures, Site, Sun, load_site, postures_of, stacked
from rfpose.pipeline.site import check_site_solvable, forecast_normals
from rfpose.scenario import PositionForm, Scenario, naming, read_positions
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
    keep: int = 0

    def constraints(self, transmitter_enu_m: FloatArray) -> Constraints:
        """Return the rules with defaults taken from the transmitters as they stand."""
        own_radius = float(np.hypot(transmitter_enu_m[:, 0], transmitter_enu_m[:, 1]).max())
        radius = own_radius if self.radius_m is None else self.radius_m
        for name, value in (("radius_m", self.radius_m), ("separation_m", self.separation_m)):
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
            excluded=tuple(Zone(centre_enu_m=(x, y), radius_m=r) for x, y, r in self.excluded_m),
            separation_m=_SEPARATION * radius if self.separation_m is None else self.separation_m,
            clearance_m=self.clearance_m,
        )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SitePlacement(Shown):
    """Transmitters placed anew: the placement, the scenario with it, and what it was before."""

    placement: Placement
    scenario: Scenario
    before: float
    before_pdop: float
    after_pdop: float

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
        """Write the scenario with the new places; see `Scenario.save`."""
        self.scenario.save(path, force=force)


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
    postures: tuple[Posture, ...]
    field: Mirrors
    constraints: Constraints
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
        moved = self.scenario.with_transmitters(transmitter_enu_m, keep=self.keep)
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
            check_site_solvable(scenario)
    return _Task(
        scenario=scenario, postures=studied, field=stacked([p.mirrors for p in studied]),
        constraints=chosen.constraints(now), keep=chosen.keep, criterion=criterion, statistic=statistic, costs=costs,
        starts=starts, seed=seed,
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
    with naming(scenario):
        found = task.place(n_transmitter or len(now), on_progress)
        better = task.scenario.with_transmitters(maps.check_site(found.transmitter_enu_m), keep=task.keep)
        before = task.value(now)
    return SitePlacement(
        placement=found,
        scenario=better,
        before=before,
        before_pdop=evaluate_placement(now, task.field),
        after_pdop=evaluate_placement(found.transmitter_enu_m, task.field),
    )


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
    axes.plot(count, [row["value"] for row in rows], "o-", color="#0072B2", label="all transmitters")
    lost = np.array([row["without_worst"] for row in rows], np.float64)
    axes.plot(count, np.where(np.isfinite(lost), lost, np.nan), "s--", color="#D55E00", label="the worst one lost")
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
