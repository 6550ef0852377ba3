"""Layout studies of a scenario: maps of its field, better places for its transmitters, where its errors come from.

Each study is loaded when it is first asked for: a map needs nothing of a budget.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

_HOME = {
    "LayoutComparison": "comparing",
    "LayoutMap": "mapping",
    "Postures": "site",
    "Rules": "placing",
    "Sight": "site",
    "SiteBudget": "budgeting",
    "SitePlacement": "placing",
    "SitePlacements": "placing",
    "budget": "budgeting",
    "compare": "comparing",
    "layout_map": "mapping",
    "optimise": "placing",
    "pareto": "placing",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'rfpose.pipeline.layout' has no attribute {name!r}")
    return getattr(import_module(f"rfpose.pipeline.layout.{_HOME[name]}"), name)
