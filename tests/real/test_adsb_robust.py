"""P5 with a robust loss: aircraft from real arrival times (LocaRDS, sets 1-4), and which of them are wrong.

Beside the five arrival times the aircraft's barometric altitude is used, as it was transmitted, as an observation of
its height above the ellipsoid with a sigma of 150 m (pressure altitude; in these data mostly 60 to 190 m too high).
The true position and the geometric altitude are used for nothing but the comparison.
"""

import numpy as np
import pytest

from aircraft import DATA, groups, z_of_altitude
from rfpose.multilat.integrity import locate_robust

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the ADS-B measurements are not here")


def located(spoil_m=0.0, smallest_group=1):
    """Horizontal errors, outliers (five ranges and the height), residuals at the truth, and which rows were spoilt.

    Every fifth row's second arrival is spoilt by ``spoil_m``.
    """
    error, outlier, truth_residual, spoilt = [], [], [], []
    for group in groups():
        n = len(group.range_m)
        if n < smallest_group:
            continue
        ranges = group.range_m.copy()
        ranges[::5, 1] += spoil_m
        east_north = np.zeros((n, 2))
        for _ in range(2):  # the height of the ground under the aircraft is known once the aircraft is
            fixes = locate_robust(
                group.station_enu_m,
                ranges,
                sigma_m=20.0,
                height_enu_m=z_of_altitude(east_north, group.barometric_m, group),
                height_sigma_m=150.0,
                side="above",
            )
            east_north = np.nan_to_num(fixes.position_enu_m[:, :2])
        error.append(group.horizontal_error_m(fixes.position_enu_m))
        outlier.append(np.column_stack([fixes.outlier, fixes.height_outlier]))
        left = ranges - np.linalg.norm(group.true_enu_m[:, None] - group.station_enu_m, axis=-1)
        truth_residual.append(np.abs(left - np.median(left, axis=1, keepdims=True)))
        spoilt.append(np.arange(n) % 5 == 0)
    return tuple(np.concatenate(a) for a in (error, outlier, truth_residual, spoilt))


def test_p5_the_robust_solver_beats_plain_gauss_newton(figure):
    """Plain: median 56 m; a row without a solution counts as infinitely wrong. Most of the gain is the altitude's."""
    error, outlier, truth_residual, _ = located()
    figure("P5 aircraft, robust with barometric height: median horizontal error", np.median(error), "m")
    figure("P5 aircraft, rows with a named outlier", outlier.any(axis=1).sum())
    assert len(error) == 1147
    assert np.median(error) < 50.0
    # rows in which something is named an outlier are off at the true position too
    named = outlier.any(axis=1)
    assert 0.005 < named.mean() < 0.05
    worst = truth_residual.max(axis=1)
    assert np.median(worst[named]) > 2.5 * np.median(worst[~named])


def test_a_spoilt_arrival_is_named(figure):
    """Three kilometres added to one arrival in five rows; five stations and a height leave just two checks."""
    error, outlier, _, spoilt = located(spoil_m=3000.0, smallest_group=15)
    assert spoilt.sum() > 100
    figure("P5 aircraft, 3 km added to one arrival: that one named", 100 * np.mean(outlier[spoilt, 1]), "%")
    assert np.mean(outlier[spoilt].any(axis=1)) > 0.95
    assert np.mean(outlier[spoilt, 1]) > 0.7
    assert np.median(error[spoilt]) < 150.0
