"""Layout studies of a scenario: maps of its field, better places for its transmitters, where its errors come from."""

from rfpose.pipeline.layout.budgeting import SiteBudget, budget_layout, draw_budget, write_budget_csv
from rfpose.pipeline.layout.mapping import LayoutMap, draw_layout_map, map_layout, write_layout_csv
from rfpose.pipeline.layout.placing import (
    Rules,
    SitePlacement,
    SitePlacements,
    draw_placements,
    optimise_layout,
    pareto_layout,
    write_placements_csv,
)
from rfpose.pipeline.layout.site import Sight

__all__ = [
    "LayoutMap",
    "Rules",
    "Sight",
    "SiteBudget",
    "SitePlacement",
    "SitePlacements",
    "budget_layout",
    "draw_budget",
    "draw_layout_map",
    "draw_placements",
    "map_layout",
    "optimise_layout",
    "pareto_layout",
    "write_budget_csv",
    "write_layout_csv",
    "write_placements_csv",
]
