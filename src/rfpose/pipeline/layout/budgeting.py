"""The error budget of a scenario: where the error of its normals comes from, as a table and a picture."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import GeometryError, InvalidInputError, ScenarioError
from rfpose.files import write_atomically
from rfpose.layout.budget import BudgetLine, ErrorBudget, error_budget, make_plan
from rfpose.pipeline.layout.site import Postures, load_site, postures_of, stacked
from rfpose.pipeline.pictures import _new_figure, _save
from rfpose.scenario import Scenario

__all__ = ["SiteBudget", "budget_layout", "draw_budget", "write_budget_csv"]

_LOST_SHARE = 1e-3
"""Lines below this share of the whole are left out of the picture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteBudget:
    """A scenario's budget over its field and postures."""

    scenario: Scenario
    posture_names: tuple[str, ...]
    budget: ErrorBudget

    def field_rms(self, values: FloatArray) -> float:
        """Rms over heliostats and postures."""
        return _rms(values)

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
            "pose": "rigid" if found.plan.estimator.rigid else "independent",
            "wavelengths_m": [float(row.mean()) for row in found.plan.waves.wavelength_m],
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


def budget_layout(
    scenario_path: str | Path,
    *,
    postures: Postures | None = None,
    field_csv: str | Path | None = None,
    pose: str = "rigid",
    ground: str | None = None,
    n_draw: int = 200,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
) -> SiteBudget:
    """Return the error budget of a scenario's heliostats.

    Parameters
    ----------
    scenario_path, field_csv, postures
        As in `map_layout`.
    pose
        ``rigid``, or ``independent``.
    ground
        Replaces ``[budget] ground``.
    n_draw, seed
        Frames drawn a line, 0 for linear analysis alone; equal seeds give equal results.

    Raises
    ------
    ScenarioError
        As `map_layout`; heliostats that differ in what the solver knows of them; poses that are not determined.
    """
    scenario = load_site(scenario_path, field_csv, settings=None if ground is None else {"ground": ground})
    studied = postures_of(scenario, postures or Postures(), scenario_path)
    try:
        plan = make_plan(scenario, stacked([p.mirrors for p in studied]), pose=pose)
    except (GeometryError, InvalidInputError, ScenarioError) as error:
        raise ScenarioError(f"{scenario_path}: {error}") from error
    found = error_budget(plan, n_draw=n_draw, seed=seed, aim_enu_m=scenario.site.aim_enu_m, progress=on_progress)
    blind = np.flatnonzero(~np.isfinite(found.whole.normal_rad))
    if blind.size:
        name = scenario.heliostat_ids[int(blind[0]) % len(scenario.heliostat)]
        raise ScenarioError(
            f"{scenario_path}: the pose of heliostat `{name}` is not determined by its phases; add transmitters, a "
            "calibration receiver, or a surveyed pivot"
        )
    return SiteBudget(scenario=scenario, posture_names=tuple(p.name for p in studied), budget=found)


def write_budget_csv(found: SiteBudget, path: str | Path) -> None:
    """Write one row a source and heliostat, the field's rms first; mrad of the normal, metres on the target."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    columns = ("normal_mrad", "target_m", "monte_carlo_mrad", "monte_carlo_target_m")
    writer.writerow(["source", "heliostat", *columns, "assumed", "remedy"])
    for line in (*found.budget.lines, found.budget.whole):
        field = found._line_dict(line)
        writer.writerow([line.name, "field", *(f"{field[key]:.6g}" for key in columns), line.assumed, line.remedy])
        each = [
            1e3 * found.by_heliostat(line.normal_rad),
            found.by_heliostat(line.target_m),
            1e3 * found.by_heliostat(line.drawn_normal_rad),
            found.by_heliostat(line.drawn_target_m),
        ]
        for i, name in enumerate(found.scenario.heliostat_ids):
            writer.writerow([line.name, name, *(f"{values[i]:.6g}" for values in each), "", ""])
    write_atomically(path, text.getvalue().encode())


def draw_budget(found: SiteBudget, path: str | Path) -> None:
    """Draw each source's error of the normal as a bar, worst first, with the whole below them.

    Raises
    ------
    InvalidInputError
        ``path`` ends neither in .png nor in .svg.
    """
    whole = found.budget.whole
    lines = [line for line in found.budget.lines if _rms(line.normal_rad) > _LOST_SHARE * _rms(whole.normal_rad)]
    rows = [*lines, whole]
    height = np.arange(len(rows))[::-1]
    linear = np.array([1e3 * _rms(line.normal_rad) for line in rows])
    drawn = np.array([1e3 * _rms(line.drawn_normal_rad) for line in rows])
    figure, axes = _new_figure(9.2, 1.6 + 0.42 * len(rows))
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
    _save(figure, path)
