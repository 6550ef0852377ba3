"""Where to put transmitters: what is allowed, what it costs, and the search."""

from rfpose.layout.optimise.rules import Constraints, Costs, Zone
from rfpose.layout.optimise.search import (
    CRITERIA,
    Criterion,
    Placement,
    Progress,
    evaluate_placement,
    optimise,
    pareto,
)

__all__ = [
    "CRITERIA",
    "Constraints",
    "Costs",
    "Criterion",
    "Placement",
    "Progress",
    "Zone",
    "evaluate_placement",
    "optimise",
    "pareto",
]
