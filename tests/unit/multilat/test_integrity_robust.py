"""Positions with gross errors among the ranges."""

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.multilat import FixStatus, locate
from rfpose.multilat.integrity import locate_robust
from sites import TABLE_2

TRANSMITTER = 100.0 * TABLE_2
SIGMA = 1e-3
N = 300


def measure(seed):
    rng = np.random.default_rng(seed)
    radius, azimuth = 95.0 * np.sqrt(rng.random(N)), rng.uniform(0.0, 2 * np.pi, N)
    place = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(N, 3.0)], axis=-1)
    ranges = np.linalg.norm(place[:, None] - TRANSMITTER, axis=-1) + SIGMA * rng.standard_normal((N, 10))
    return place, ranges - ranges[:, :1], rng


def test_without_outliers_it_is_least_squares():
    _, ranges, _ = measure(1)
    plain = locate(TRANSMITTER, ranges, sigma_m=SIGMA)
    found = locate_robust(TRANSMITTER, ranges, sigma_m=SIGMA, outlier_sigma=6.0)
    assert found.ok.all()
    assert not found.outlier.any()
    np.testing.assert_allclose(found.position_enu_m, plain.position_enu_m, atol=0.01 * SIGMA)
    np.testing.assert_allclose(found.cov_enu_m2, plain.cov_enu_m2, rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(found.chi2, plain.chi2, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("size_m", [0.1, 1.0, 30.0])
def test_an_outlier_is_named_and_left_out(size_m):
    place, ranges, rng = measure(2)
    who = rng.integers(0, 10, N)
    ranges[np.arange(N), who] += size_m
    found = locate_robust(TRANSMITTER, ranges, sigma_m=SIGMA)
    assert np.mean(found.outlier[np.arange(N), who]) > 0.98
    error = np.linalg.norm(found.position_enu_m - place, axis=1)
    plain = np.linalg.norm(locate(TRANSMITTER, ranges, sigma_m=SIGMA).position_enu_m - place, axis=1)
    assert np.median(error) < 5.0 * SIGMA
    assert np.nanmedian(plain) > 5.0 * np.median(error)


def test_a_height_far_from_the_ranges_is_named():
    place, ranges, _ = measure(3)
    height = place[:, 2].copy()
    height[:5] += 1.0
    found = locate_robust(TRANSMITTER, ranges, sigma_m=SIGMA, height_enu_m=height, height_sigma_m=5e-3)
    np.testing.assert_array_equal(np.flatnonzero(found.height_outlier)[:5], np.arange(5))
    assert found.height_outlier.sum() < 8
    without = locate_robust(TRANSMITTER, ranges, sigma_m=SIGMA)
    fewer = found.cov_enu_m2[5:, 2, 2] < without.cov_enu_m2[5:, 2, 2]
    assert np.mean(fewer) > 0.98


def test_a_height_makes_up_for_a_transmitter():
    """Four transmitters and a height: what plain fixes refuse."""
    place, ranges, _ = measure(4)
    ranges[:, [2, 4, 6, 7, 8, 9]] = np.nan
    assert np.all(locate(TRANSMITTER, ranges, sigma_m=SIGMA).status == FixStatus.TOO_FEW)
    found = locate_robust(TRANSMITTER, ranges, sigma_m=SIGMA, height_enu_m=place[:, 2], height_sigma_m=1e-2)
    error = np.linalg.norm(found.position_enu_m - place, axis=1)
    assert np.median(error) < 0.05
    assert np.mean(found.status == FixStatus.OK) > 0.9


def test_bad_rows_leave_the_others_alone():
    _, ranges, _ = measure(5)
    good = locate_robust(TRANSMITTER, ranges, sigma_m=SIGMA)
    ranges[0] = np.nan
    ranges[1, 3:] = np.nan
    found = locate_robust(TRANSMITTER, ranges, sigma_m=SIGMA)
    np.testing.assert_array_equal(found.status[:2], [FixStatus.TOO_FEW] * 2)
    assert np.isnan(found.position_enu_m[:2]).all()
    np.testing.assert_allclose(found.position_enu_m[2:], good.position_enu_m[2:], atol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [{"outlier_sigma": 0.0}, {"min_probability": 1.0}, {"height_enu_m": np.zeros(N)}],
    ids=["outlier_sigma", "min_probability", "height_sigma_m"],
)
def test_settings_are_checked(wrong):
    _, ranges, _ = measure(6)
    with pytest.raises(InvalidInputError):
        locate_robust(TRANSMITTER, ranges, sigma_m=SIGMA, **wrong)


def test_two_sides_that_fit_alike_are_said_to_do_so():
    level = TRANSMITTER * [1.0, 1.0, 0.0] + [0.0, 0.0, 10.0]
    place = np.array([[10.0, 20.0, 2.0], [-30.0, 10.0, 18.0]])
    ranges = np.linalg.norm(place[:, None] - level, axis=-1)
    assert np.all(locate_robust(level, ranges, sigma_m=SIGMA, side=None).status == FixStatus.AMBIGUOUS)
    found = locate_robust(level, ranges, sigma_m=SIGMA, side=None, height_enu_m=place[:, 2], height_sigma_m=1.0)
    assert found.ok.all()
    np.testing.assert_allclose(found.position_enu_m, place, atol=1e-3)
