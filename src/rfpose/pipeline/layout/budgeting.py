"""The error budget of a scenario: where the error of its normals comes from, as a table and a picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rfpose.checks import FloatArray
from rfpose.drawing import new_figure
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.layout.budget import (
    BudgetLine,
    ErrorBudget,
    SiteMirrors,
    SitePlan,
    WorkingPoint,
    converter_share_of,
    error_budget,
    site_budget,
    working_point,
)
from rfpose.pipeline.layout.site import Field, FieldPosture, Postures, Site, load_site, postures_of, stacked
from rfpose.pipeline.site import foreseen_mirrors, stray_ranges
from rfpose.scenario import Scenario, naming
from rfpose.shown import Shown, number
from rfpose.tables import Tabled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["SiteBudget", "budget"]

_LOST_SHARE = 1e-3
"""Lines below this share of the whole are left out of the picture."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SiteBudget(Shown, Tabled):
    """A scenario's budget over its field and postures."""

    scenario: Scenario
    posture_names: tuple[str, ...]
    budget: ErrorBudget

    def by_heliostat(self, values: FloatArray) -> FloatArray:
        """(heliostat,) rms over the postures."""
        square = values.reshape(len(self.posture_names), -1) ** 2
        return np.asarray(np.sqrt(square.mean(axis=0)))

    def as_dict(self) -> dict[str, Any]:
        """Return the budget with stable keys; mrad of the normal, metres on the target."""
        found = self.budget
        whole = self._line_dict(found.whole)
        return {
            "scenario": self.scenario.name,
            "heliostats": len(self.scenario.heliostat),
            "postures": len(self.posture_names),
            "pose": found.pose,
            "wavelengths_m": list(found.wavelength_m),
            "draws": found.n_draw,
            "solutions_failed": found.n_failed,
            "sum": {key: whole[key] for key in ("normal_mrad", "target_m", "worst_heliostat_mrad")},
            "monte_carlo": {"normal_mrad": whole["monte_carlo_mrad"], "target_m": whole["monte_carlo_target_m"]},
            "sum_over_monte_carlo": whole["normal_mrad"] / whole["monte_carlo_mrad"],
            "lines": [
                {
                    "source": line.name,
                    "assumed": line.assumed,
                    **self._line_dict(line),
                    "share": (_rms(line.normal_rad) / _rms(found.whole.normal_rad)) ** 2,
                    "remedy": line.remedy,
                }
                for line in found.lines
            ],
        }

    def headline(self) -> str:
        """Return which scenario, and the whole error."""
        return f"{self.scenario.name!r}: {number(1e3 * _rms(self.budget.whole.normal_rad))} mrad of the normal, rms"

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return each source's error of the normal, drawn and on the target, worst first."""
        keys = ("normal_mrad", "monte_carlo_mrad", "target_m")
        lines = [(line.name, self._line_dict(line)) for line in (*self.budget.lines, self.budget.whole)]
        return ["source", "mrad", "drawn", "target [m]"], [[name, *(number(d[k]) for k in keys)] for name, d in lines]

    def table(self) -> tuple[list[str], list[list[Any]]]:
        """Return one row a source and heliostat, the field's rms first; mrad of the normal, metres on the target."""
        columns = ("normal_mrad", "target_m", "monte_carlo_mrad", "monte_carlo_target_m")
        rows: list[list[Any]] = []
        for line in (*self.budget.lines, self.budget.whole):
            field = self._line_dict(line)
            rows.append([line.name, "field", *(field[key] for key in columns), line.assumed, line.remedy])
            each = [
                1e3 * self.by_heliostat(line.normal_rad),
                self.by_heliostat(line.target_m),
                1e3 * self.by_heliostat(line.drawn_normal_rad),
                self.by_heliostat(line.drawn_target_m),
            ]
            for i, name in enumerate(self.scenario.heliostat_ids):
                rows.append([line.name, name, *(values[i] for values in each), "", ""])
        return ["source", "heliostat", *columns, "assumed", "remedy"], rows

    def plot(self) -> Figure:
        """Draw each source's error of the normal as a bar, worst first, with the whole below them."""
        return _drawn(self)

    def _line_dict(self, line: BudgetLine) -> dict[str, float]:
        return {
            "normal_mrad": 1e3 * _rms(line.normal_rad),
            "target_m": _rms(line.target_m),
            "worst_heliostat_mrad": 1e3 * float(np.max(self.by_heliostat(line.normal_rad))),
            "monte_carlo_mrad": 1e3 * _rms(line.drawn_normal_rad),
            "monte_carlo_target_m": _rms(line.drawn_target_m),
        }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def budget(
    scenario: Site,
    *,
    postures: Postures | None = None,
    field: Field = None,
    pose: str = "rigid",
    ground: str | None = None,
    n_draw: int = 200,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
) -> SiteBudget:
    """Return the error budget of a scenario's heliostats.

    Parameters
    ----------
    scenario, field, postures
        As in `layout_map`.
    pose
        ``rigid``, ``independent``, or ``site``: among the rays that the site's geometry lets one foresee.
    ground
        Replaces ``[budget] ground``. Not with pose ``site``, whose ground is that of ``[reflection]``.
    n_draw, seed
        Frames drawn a line, 0 for linear analysis alone; equal seeds give equal results.

    Raises
    ------
    ScenarioError
        As `layout_map`; heliostats that differ in what the solver knows of them; poses that are not determined.

    Examples
    --------
    >>> import rfpose as rf
    >>> found = rf.budget(rf.shipped_scenario("table2_100m.toml"), n_draw=0)
    >>> found.as_dict()["pose"], found.as_dict()["heliostats"]
    ('rigid', 12)
    """
    site = load_site(scenario, field)
    if ground is not None:
        site = site.changed(budget={"ground": ground})
    if ground is not None and pose == "site":
        raise InvalidInputError("pose site has the ground of [reflection]; leave `ground` away, or choose another pose")
    with naming(scenario):
        studied = postures_of(site, postures or Postures())
        wanted: dict[str, Any] = {
            "n_draw": n_draw,
            "seed": seed,
            "aim_enu_m": site.site.aim_enu_m,
            "progress": on_progress,
        }
        if pose == "site":
            found = site_budget(_site_plan(site, studied), **wanted)
        else:
            found = error_budget(_plan(site, studied, pose), **wanted)
        _refuse_blind(site, found, studied)
    return SiteBudget(scenario=site, posture_names=tuple(p.name for p in studied), budget=found)


def _plan(site: Scenario, studied: list[FieldPosture], pose: str) -> WorkingPoint:
    """Return the working point of an estimator that knows straight rays, with what other rays do to it."""
    plan = working_point(site, stacked([p.mirrors for p in studied]), pose=pose)
    shaped = site.site.structures.box or any(m.width_m is not None for m in site.mirrors)
    if not (shaped and site.has_rf_carriers):
        return plan
    shifts = [
        stray_ranges(site, np.concatenate([p.mirrors.rot_enu_from_mirror, p.plate_rot]), plan.waves.tone_hz)
        for p in studied
    ]
    mirrors = np.concatenate([mirror for mirror, _ in shifts])
    # calibration receivers are the same for all rows: of several postures they have the mean
    calibration = np.mean([there for _, there in shifts], axis=0)[:, : plan.waves.n_tone]
    return replace(plan, stray_m=mirrors, calibration_stray_m=calibration)


def _site_plan(site: Scenario, studied: list[FieldPosture]) -> SitePlan:
    """Foresee a field in all its postures."""
    parts, n = [], len(site.heliostat)
    for k, posture in enumerate(studied):
        rot = np.concatenate([posture.mirrors.rot_enu_from_mirror, posture.plate_rot])
        parts += [SiteMirrors(rows=k * n + column, foreseen=part) for column, part in foreseen_mirrors(site, rot)]
    mirrors = stacked([p.mirrors for p in studied])
    return SitePlan(
        scenario=site,
        mirrors=mirrors,
        parts=tuple(parts),
        converter_share=converter_share_of(site, mirrors.receiver_enu_m),
    )


def _refuse_blind(site: Scenario, found: ErrorBudget, studied: list[FieldPosture]) -> None:
    blind = np.flatnonzero(~np.isfinite(found.whole.normal_rad))
    if not blind.size:
        return
    posture, heliostat = divmod(int(blind[0]), len(site.heliostat))
    name = site.heliostat_ids[heliostat]
    if found.pose == "site":
        raise ScenarioError(
            f"heliostat `{name}` receives too little to be solved in posture `{studied[posture].name}`; a map by "
            "estimator `site` says of each mirror why"
        )
    raise ScenarioError(
        f"the pose of heliostat `{name}` is not determined by its phases; add transmitters, a calibration "
        "receiver, or a surveyed pivot"
    )


def _drawn(found: SiteBudget) -> Figure:
    whole = found.budget.whole
    lines = [line for line in found.budget.lines if _rms(line.normal_rad) > _LOST_SHARE * _rms(whole.normal_rad)]
    rows = [*lines, whole]
    height = np.arange(len(rows))[::-1]
    linear = np.array([1e3 * _rms(line.normal_rad) for line in rows])
    drawn = np.array([1e3 * _rms(line.drawn_normal_rad) for line in rows])
    figure, axes = new_figure(9.2, 1.6 + 0.42 * len(rows))
    colours = ["#0072B2"] * len(lines) + ["0.35"]
    axes.barh(height, linear, color=colours, height=0.6, label="to first order (grey: root of the sum of squares)")
    if np.isfinite(drawn).any():
        axes.plot(drawn, height, "|", color="#D55E00", ms=15, mew=2.5, label="Monte Carlo through the solver")
    for y, mrad, line in zip(height, linear, rows, strict=True):
        target = _rms(line.target_m)
        text = f"{mrad:.3g} mrad" + (f", {target:.2g} m" if np.isfinite(target) else "")
        axes.annotate(text, (max(mrad, np.nan_to_num(float(drawn[rows.index(line)]))), y), (8, 0), va="center",
                      fontsize=8, textcoords="offset points")  # fmt: skip
    axes.set_yticks(height, [line.name for line in rows])
    axes.set_xlabel("error of the mirror normal, RMS over the field [mrad]; after the comma: on the target")
    axes.set_xlim(0.0, 1.28 * float(np.nanmax(np.concatenate([linear, drawn]))))
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    axes.set_title(f"{found.scenario.name}: error budget")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure
