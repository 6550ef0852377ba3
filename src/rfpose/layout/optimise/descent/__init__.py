"""Local searches side by side: sequential quadratic programming from many starts.

Kraft's method (DFVLR-FB 88-28, 1988) as `scipy.optimize` has it as SLSQP: a quadratic model of the Lagrangian, learned
from slopes, whose least under linear constraints is the next step, as far as it lowers value and missed constraints
together. Here all starts take their steps at the same time, so that one call works out values and margins of all of
them; and scipy's optimisers take longer to load than the field of some mirrors to search.
"""

from rfpose.layout.optimise.descent.side_by_side import Function, minimised

__all__ = ["Function", "minimised"]
