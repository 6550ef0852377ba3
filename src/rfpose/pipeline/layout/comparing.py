"""Layouts side by side: what their normals can be known to, and what their transmitters cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rfpose.drawing import METHOD_COLOURS, SERIES, WIDTH_INCH, angle_unit, blank_figure, plain_numbers
from rfpose.errors import InvalidInputError
from rfpose.layout.maps import summarise
from rfpose.layout.optimise import Costs
from rfpose.pipeline.layout.mapping import LayoutMap, layout_map
from rfpose.pipeline.layout.site import Field, Postures, Site
from rfpose.pipeline.pictures.plan import draw_mirrors, draw_site, finish_plan
from rfpose.scenario import Scenario
from rfpose.shown import Shown, number
from rfpose.tables import Tabled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["LayoutComparison", "compare"]

_MOST_MAPS = 6


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LayoutComparison(Shown, Tabled):
    """Maps of several layouts by the same estimators, in the order given.

    Attributes
    ----------
    names
        What each is called: its file, else its scenario's name.
    maps
        Of each.
    cost
        Of each one's transmitters, as if none stood yet.
    """

    names: tuple[str, ...]
    maps: tuple[LayoutMap, ...]
    cost: tuple[float, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison with stable keys."""
        return {
            "layouts": [
                {
                    "name": name,
                    "scenario": each.scenario.name,
                    "transmitters": len(each.scenario.transmitter),
                    "heliostats": len(each.heliostat_ids),
                    "cost": cost,
                    "pdop": summarise(each.pdop),
                    "normal_mrad": {
                        key: {**summarise(mrad), "undetermined": each.undetermined[key]}
                        for key, mrad in each.rms_mrad.items()
                    },
                    "without_worst_mrad": {key: float(np.max(lost)) for key, lost in each.lost_one_mrad.items()},
                }
                for name, each, cost in zip(self.names, self.maps, self.cost, strict=True)
            ]
        }

    def headline(self) -> str:
        """Return what is compared."""
        return ", ".join(self.names)

    def figures(self) -> tuple[list[str], list[list[str]]]:
        """Return one row a layout."""
        header, rows = self.table()
        return header, [[v if isinstance(v, str) else number(float(v), 4) for v in row] for row in rows]

    def table(self) -> tuple[list[str], list[list[Any]]]:
        """Return one row a layout: how many transmitters, cost, dilution, the normal's bound by estimator."""
        keys = list(self.maps[0].rms_mrad)
        header = ["layout", "transmitters", "cost", "pdop_rms"]
        header += [f"normal_{key}_{kind}_mrad" for key in keys for kind in ("rms", "worst", "without_worst")]
        rows = []
        for each in self.as_dict()["layouts"]:
            row = [each["name"], each["transmitters"], each["cost"], each["pdop"]["rms"]]
            for key in keys:
                normal = each["normal_mrad"][key]
                row += [normal["rms"], normal["worst"], each["without_worst_mrad"].get(key, float("nan"))]
            rows.append(row)
        return header, rows

    def plot(self) -> Figure:
        """Draw each layout's map by the first estimator in the same colours, and all estimators as bars."""
        return _drawn(self)


def compare(
    scenarios: Sequence[Site],
    *,
    estimators: Sequence[str] | None = None,
    postures: Postures | None = None,
    field: Field = None,
    costs: Costs | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> LayoutComparison:
    """Compare layouts: each as `layout_map` has it, by the same estimators.

    Parameters
    ----------
    scenarios
        Two or more.
    estimators
        As in `layout_map`; None: those that all of them allow.
    postures, field
        As in `layout_map`, the same for all.
    costs
        Of transmitters.
    on_progress
        Called with (layouts done, layouts).

    Raises
    ------
    InvalidInputError
        Fewer than two; no estimator that all allow.
    ScenarioError
        As `layout_map`.
    """
    if len(scenarios) < 2:
        raise InvalidInputError(f"`scenarios` must be two or more to compare, got {len(scenarios)}")
    found = []
    for k, site in enumerate(scenarios):
        found.append(layout_map(site, estimators=estimators, postures=postures, field=field))
        if on_progress is not None:
            on_progress(k + 1, len(scenarios))
    common = [key for key in found[0].rms_mrad if all(key in each.rms_mrad for each in found)]
    if not common:
        raise InvalidInputError("`estimators`: there is none that all of these layouts allow; name one")
    price = costs or Costs()
    return LayoutComparison(
        names=_names(scenarios),
        maps=tuple(_only(each, common) for each in found),
        cost=tuple(price.of(each.scenario.transmitter_enu_m) for each in found),
    )


def _only(found: LayoutMap, keys: Sequence[str]) -> LayoutMap:
    kept = {key: found.rms_mrad[key] for key in keys}
    lost = {key: value for key, value in found.lost_one_mrad.items() if key in keys}
    return replace(found, rms_mrad=kept, lost_one_mrad=lost)


def _names(scenarios: Sequence[Site]) -> tuple[str, ...]:
    """Return what tells layouts apart: names of files, with their folders where these are alike."""
    given = [each.name if isinstance(each, Scenario) else Path(each).name for each in scenarios]
    if len(set(given)) == len(given):
        return tuple(given)
    return tuple(f"{k + 1}: {name}" for k, name in enumerate(given))


def _drawn(found: LayoutComparison) -> Figure:
    first = next(iter(found.maps[0].rms_mrad))
    shown = min(len(found.maps), _MOST_MAPS)
    columns = min(shown, 3)
    rows = -(-shown // columns)
    tall, low = 2.6 * rows, 0.9 + 0.13 * len(found.maps) * len(found.maps[0].rms_mrad)
    figure = blank_figure(WIDTH_INCH, tall + low)
    halves: Any = figure.subfigures(2, 1, height_ratios=[tall, low])
    upper, lower = halves
    panels = np.atleast_1d(np.asarray(upper.subplots(rows, columns, squeeze=False))).ravel()
    every = np.concatenate([each.rms_mrad[first] for each in found.maps])
    factor, unit = angle_unit(every)
    limits = (0.0, factor * float(np.nanmax(every)) if np.isfinite(every).any() else 1.0)
    for axes, name, each in zip(panels, found.names, found.maps, strict=False):
        dots = draw_mirrors(axes, each.pivot_enu_m, factor * each.rms_mrad[first], limits=limits)
        draw_site(axes, each.scenario)
        axes.set_title(name, fontsize=9)
    for axes in panels[shown:]:
        axes.set_visible(False)
    upper.colorbar(dots, ax=list(panels[:shown]), label=f"bound of the normal,\n{first} [{unit}]", shrink=0.8)
    _bars(lower.subplots(), found)
    figure.suptitle("Layouts compared: bound of the mirror normal", fontsize=10)
    for axes, each in zip(panels[:shown], found.maps, strict=False):
        finish_plan(axes, each.scenario, each.pivot_enu_m)
    return figure


def _bars(axes: Any, found: LayoutComparison) -> None:
    keys = list(found.maps[0].rms_mrad)
    values = np.array([[summarise(each.rms_mrad[key])["rms"] for key in keys] for each in found.maps])
    factor, unit = angle_unit(values)
    place, high = np.arange(len(found.maps)), 0.8 / len(keys)
    for k, key in enumerate(keys):
        colour = METHOD_COLOURS.get(key, SERIES[k % len(SERIES)])
        here = place + (k - 0.5 * (len(keys) - 1)) * high
        bars = axes.barh(here, factor * values[:, k], high, color=colour, label=key)
        axes.bar_label(bars, fmt="%.3g", fontsize=6, padding=2)
    axes.set_yticks(place, found.names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    low, high_end = axes.get_xlim()
    axes.set_xlim(low, high_end * 1.5)
    plain_numbers(axes.xaxis)
    axes.set_xlabel(f"RMS over the field [{unit}]")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=7)
    axes.grid(axis="x", alpha=0.3)
