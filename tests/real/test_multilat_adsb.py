"""P5: aircraft located from real arrival times at five ground stations (LocaRDS, sets 1-4)."""

import numpy as np
import pytest

from aircraft import DATA, groups
from rfpose.multilat import locate

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the ADS-B measurements are not here")


def test_p5_plain_gauss_newton_from_a_cold_start(figure):
    """Median 56 m horizontal, 315 m in 3-D; a row without a solution counts as infinitely wrong (+10 %)."""
    horizontal, total = [], []
    for group in groups():
        fixes = locate(
            group.station_enu_m, group.range_m, sigma_m=50.0, side="above", max_dop=np.inf, min_probability=0.0
        )
        horizontal.append(group.horizontal_error_m(fixes.position_enu_m))
        total.append(group.error_m(fixes.position_enu_m))
    horizontal, total = np.concatenate(horizontal), np.concatenate(total)
    figure("P5 aircraft, plain Gauss-Newton: median error, horizontal", np.median(horizontal), "m")
    figure("P5 aircraft, plain Gauss-Newton: median error, 3-D", np.median(total), "m")
    assert len(total) == 1147
    assert np.mean(np.isinf(total)) < 0.04
    assert np.median(horizontal) < 1.1 * 56.0
    assert np.median(total) < 1.1 * 315.0
