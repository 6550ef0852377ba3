"""All searches a step at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rfpose.checks import FloatArray
from rfpose.layout.optimise.descent import _kernels
from rfpose.layout.optimise.descent._kernels import Searches

__all__ = ["Function", "minimised"]

Function = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Of places (search, variable): what it is there, and its slope by each variable, which comes before the last axis."""


def minimised(
    objective: Function,
    margins: Function,
    start: FloatArray,
    *,
    tolerance: float,
    on_end: Callable[[int], None] | None = None,
) -> FloatArray:
    """Return where searches end (search, variable): at local least values, if they met the constraints.

    Parameters
    ----------
    objective
        Value (search,) and slope (search, variable). Scaled so that a change of one matters.
    margins
        What must not be negative (search, constraint), and its slope (search, variable, constraint).
    start : (search, variable)
        Where they begin; constraints need not be met there.
    tolerance
        Of value and place, and by how much constraints may be missed in all.
    on_end
        Called with how many searches have ended, where that changed.
    """
    n_search = len(start)
    going = np.arange(n_search)
    margin, by = margins(start)
    found = (*objective(start), margin, by)
    searches = _searches(start, margin.shape[1])
    while len(going):
        _kernels.advance_rows(len(going), going, *found, tolerance, searches)
        left = going[~searches.has_ended[going]]
        if on_end is not None and len(left) < len(going):
            on_end(n_search - len(left))
        going = left
        if len(going):
            place = searches.place[going]
            found = (*objective(place), *margins(place))
    return searches.place


def _searches(start: FloatArray, n_constraint: int) -> Searches:
    n_search, n = start.shape
    return Searches(
        place=start.copy(),
        base=start.copy(),
        inverse=np.tile(np.eye(n), (n_search, 1, 1)),
        step=np.zeros((n_search, n)),
        lagrange=np.zeros((n_search, n)),
        multiplier=np.zeros((n_search, n_constraint)),
        penalty=np.zeros((n_search, n_constraint)),
        level=np.zeros((n_search, 5)),
        tally=np.zeros((n_search, 3), np.int64),
        has_ended=np.zeros(n_search, np.bool_),
    )
