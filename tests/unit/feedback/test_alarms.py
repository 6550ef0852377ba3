"""The slope that an alarm of drift goes by."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import theilslopes

from rfpose.feedback import alarms


@pytest.mark.parametrize("n", [3, 10, 41])
def test_the_slope_is_scipys(n: int) -> None:
    rng = np.random.default_rng(n)
    part, at = rng.normal(size=n), np.sort(rng.uniform(0.0, 10.0, n))
    for times in (np.arange(n), at, np.concatenate([at[: n // 2], at[: n - n // 2]])):  # the last: some at one time
        assert alarms._slope(part, times) == theilslopes(part, times).slope
    assert alarms._slope(part, np.zeros(n)) == 0.0  # scipy has no slope here
