"""Layout studies of a scenario: maps of its field, better places for its transmitters, where its errors come from."""

from rfpose.pipeline.layout.budgeting import SiteBudget, budget
from rfpose.pipeline.layout.comparing import LayoutComparison, compare
from rfpose.pipeline.layout.mapping import LayoutMap, layout_map
from rfpose.pipeline.layout.placing import Rules, SitePlacement, SitePlacements, optimise, pareto
from rfpose.pipeline.layout.site import Postures, Sight

__all__ = [
    "LayoutComparison",
    "LayoutMap",
    "Postures",
    "Rules",
    "Sight",
    "SiteBudget",
    "SitePlacement",
    "SitePlacements",
    "budget",
    "compare",
    "layout_map",
    "optimise",
    "pareto",
]
