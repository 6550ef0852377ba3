"""Where to put transmitters: what is allowed, what it costs, and the search."""

from rfpose.layout.optimise.exchange import Measure, exchange, measured
from rfpose.layout.optimise.problem import CRITERIA, Criterion
from rfpose.layout.optimise.rules import Constraints, Costs, Sightlines, Zone
from rfpose.layout.optimise.search import (
    Placement,
    Progress,
    efficient,
    evaluate_placement,
    optimise,
    pegged,
)

__all__ = [
    "CRITERIA",
    "Constraints",
    "Costs",
    "Criterion",
    "Measure",
    "Placement",
    "Progress",
    "Sightlines",
    "Zone",
    "efficient",
    "evaluate_placement",
    "exchange",
    "measured",
    "optimise",
    "pegged",
]
