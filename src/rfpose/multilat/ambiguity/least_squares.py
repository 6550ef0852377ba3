"""Integer least squares: the most likely integers behind real estimates with a covariance."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat.ambiguity import _kernels

__all__ = ["IntegerSolution", "IntegerStatus", "integer_least_squares"]

SEARCH_NODES = 200_000
"""A search is given up after so many nodes; where success is likely, a few hundred do."""


class IntegerStatus(IntEnum):
    """What became of one row; ``reason`` says it in words."""

    OK = _kernels.OK
    NOT_FINITE = _kernels.NOT_FINITE
    NOT_POSITIVE = _kernels.NOT_POSITIVE
    SEARCH_LIMIT = _kernels.SEARCH_LIMIT
    NONE = _kernels.NONE

    @property
    def reason(self) -> str:
        """The status in words."""
        return (
            "found",
            "an estimate is missing",
            "the covariance is not positive definite",
            "too many candidates: the estimates are too uncertain for their integers",
            "no integer was sought",
        )[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class IntegerSolution:
    """Nearest integer vectors; arrays are read-only.

    Attributes
    ----------
    integers : (row, candidate, unknown)
        Nearest first; zero beyond what was found and beyond a row's own unknowns.
    squared_norm : (row, candidate)
        (z − ẑ)ᵀ Q⁻¹ (z − ẑ); infinity where there is no candidate.
    wrong_risk : (row,)
        Probability, beforehand, that the first candidate is wrong: that of sequential rounding after decorrelation,
        an upper bound for integer least squares; 1 where it cannot be judged.
    odds_against : (row,)
        Σ exp(−½ (norm − first norm)) over the other candidates: what the data leave to them, afterwards.
    adop_cycles : (row,)
        Ambiguity dilution of precision, |Q|^(1/2n).
    status : (row,)
        `IntegerStatus`.
    """

    integers: npt.NDArray[np.int64]
    squared_norm: FloatArray
    wrong_risk: FloatArray
    odds_against: FloatArray
    adop_cycles: FloatArray
    status: npt.NDArray[np.int64]


def integer_least_squares(
    value_cycles: npt.ArrayLike,
    cov_cycles2: npt.ArrayLike,
    *,
    count: npt.ArrayLike | None = None,
    n_candidate: int = 2,
) -> IntegerSolution:
    """Find the integer vectors nearest to real estimates in the metric of their covariance [1]_ [2]_.

    Parameters
    ----------
    value_cycles : (row, unknown)
        Real estimates [cycles]. NaN gives NOT_FINITE.
    cov_cycles2 : (row, unknown, unknown)
        Their covariance [cycles²].
    count : (row,), optional
        How many unknowns, the first ones, a row has; all by default.
    n_candidate
        How many nearest vectors to return.

    Raises
    ------
    InvalidInputError
        Shapes that do not fit, no candidate wanted.

    Examples
    --------
    >>> import numpy as np
    >>> from rfpose.multilat.ambiguity import IntegerStatus, integer_least_squares
    >>> found = integer_least_squares([[1.2, -0.1], [0.4, np.nan]], [0.01 * np.eye(2)] * 2)
    >>> found.integers[0, 0].tolist()
    [1, 0]
    >>> [IntegerStatus(status).reason for status in found.status]
    ['found', 'an estimate is missing']

    References
    ----------
    .. [1] Teunissen, The least-squares ambiguity decorrelation adjustment, J. Geodesy 70 (1995) 65–82; success
       probability: J. Geodesy 72 (1998) 606–612 and 73 (1999) 587–593.
    .. [2] Chang, Yang, Zhou, MLAMBDA, J. Geodesy 79 (2005) 552–565: the search.
    """
    value = as_float_array("value_cycles", value_cycles, ("row", "unknown"), finite=False)
    n_row, n_unknown = value.shape
    cov = as_float_array("cov_cycles2", cov_cycles2, (n_row, n_unknown, n_unknown), finite=False)
    counts = np.full(n_row, n_unknown) if count is None else np.asarray(count, np.int64)
    if counts.shape != (n_row,) or np.any((counts < 0) | (counts > n_unknown)):
        raise InvalidInputError(f"`count` must hold {n_row} numbers from 0 to {n_unknown}")
    if n_candidate < 1:
        raise InvalidInputError(f"`n_candidate` must be at least 1, got {n_candidate}")
    integers = np.zeros((n_row, n_candidate, n_unknown), np.int64)
    norm = np.full((n_row, n_candidate), np.inf)
    risk, adop = np.ones(n_row), np.full(n_row, np.nan)
    n_found, status = np.zeros(n_row, np.int64), np.zeros(n_row, np.int64)
    _kernels.fix_many(n_row, counts, value, cov, SEARCH_NODES, integers, norm, risk, adop, n_found, status)
    with np.errstate(invalid="ignore"):
        odds = np.nansum(np.exp(-0.5 * (norm[:, 1:] - norm[:, :1])), axis=1)
    return IntegerSolution(
        integers=read_only(integers),
        squared_norm=read_only(norm),
        wrong_risk=read_only(risk),
        odds_against=read_only(np.where(n_found > 0, odds, np.inf)),
        adop_cycles=read_only(adop),
        status=read_only(status),
    )
