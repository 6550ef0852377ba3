"""Integer least squares: against brute force, and the success that it states."""

import itertools

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.multilat.ambiguity import IntegerStatus, _kernels, integer_least_squares


def random_cov(rng, n, *, common=0.6, own=0.02):
    mix = rng.standard_normal((n, 2))
    return common * mix @ mix.T + own * np.eye(n)


def test_nearest_vectors_are_those_of_brute_force():
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 4) * 20:
        cov, value = random_cov(rng, n), rng.uniform(-2, 2, n)
        found = integer_least_squares(value[None], cov[None], n_candidate=3)
        grid = np.array(list(itertools.product(range(-8, 9), repeat=n)))
        left = grid - value
        norm = np.einsum("ka,ab,kb->k", left, np.linalg.inv(cov), left)
        nearest = np.argsort(norm)[:3]
        np.testing.assert_array_equal(found.integers[0], grid[nearest])
        np.testing.assert_allclose(found.squared_norm[0], norm[nearest], rtol=1e-7)


def test_decorrelation_keeps_the_problem():
    """The new unknowns are an integer combination of the old ones and back, of determinant one, and less correlated."""
    rng = np.random.default_rng(1)
    n = 8
    cov, value = random_cov(rng, n, common=5.0), rng.uniform(-9, 9, n)
    lower, variance, back, z = np.zeros((n, n)), np.empty(n), np.empty((n, n)), value.copy()
    for factor, decorrelate in (
        (_kernels.factor_ltdl, _kernels.decorrelate),
        (_kernels.factor_ltdl.py_func, _kernels.decorrelate.py_func),
    ):
        lower[:], z[:] = 0.0, value
        assert factor(cov, n, lower, variance)
        np.testing.assert_allclose(lower.T @ np.diag(variance) @ lower, cov, rtol=1e-9, atol=1e-9)
        spread_before = variance.max() / variance.min()
        decorrelate(n, lower, variance, z, back)
        np.testing.assert_allclose(back @ z, value, atol=1e-9)
        np.testing.assert_array_equal(back, np.rint(back))
        assert abs(np.linalg.det(back)) == pytest.approx(1.0, abs=1e-6)
        np.testing.assert_allclose(back @ lower.T @ np.diag(variance) @ lower @ back.T, cov, rtol=1e-7, atol=1e-9)
        assert variance.max() / variance.min() < 0.1 * spread_before


def test_wrong_no_more_often_than_stated():
    """20 000 problems of twelve unknowns whose stated risk is between 1e-4 and a half."""
    rng = np.random.default_rng(2)
    n_row, n = 20_000, 12
    mix = 0.3 * rng.standard_normal((n_row, n, 4))
    own = rng.uniform(0.09, 0.16, n_row) ** 2
    cov = mix @ mix.swapaxes(1, 2) + own[:, None, None] * np.eye(n)
    z = rng.integers(-50, 50, (n_row, n))
    value = z + np.einsum("rab,rb->ra", np.linalg.cholesky(cov), rng.standard_normal((n_row, n)))
    found = integer_least_squares(value, cov, n_candidate=60)
    wrong = np.any(found.integers[:, 0] != z, axis=1)
    stated = found.wrong_risk.sum()
    assert 300 < stated < 10_000
    assert wrong.sum() < stated
    assert wrong.sum() > 0.2 * stated  # an upper bound, but not an idle one
    # afterwards: the runners-up's odds say how often the first was wrong
    posterior = found.odds_against / (1.0 + found.odds_against)
    assert posterior.sum() == pytest.approx(wrong.sum(), rel=0.15)
    rounded = np.any(np.rint(value) != z, axis=1)
    assert wrong.sum() < 0.4 * rounded.sum()


def test_rows_that_cannot_be_solved_say_so():
    cov = np.stack([np.eye(2), np.ones((2, 2)), 0.01 * np.eye(2), 0.01 * np.eye(2)])
    value = np.array([[np.nan, 0.0], [0.0, 0.0], [3.1, -2.05], [3.1, np.nan]])
    found = integer_least_squares(value, cov, count=[2, 2, 2, 1])
    assert list(found.status) == [IntegerStatus.NOT_FINITE, IntegerStatus.NOT_POSITIVE] + 2 * [IntegerStatus.OK]
    assert list(found.wrong_risk[:2]) == [1.0, 1.0]
    assert found.integers[2, 0].tolist() == [3, -2]
    assert found.integers[3, 0].tolist() == [3, 0]
    assert found.adop_cycles[2] == pytest.approx(0.1)
    assert integer_least_squares(value, cov, count=[0, 0, 0, 0]).status.tolist() == 4 * [IntegerStatus.NONE]
    with pytest.raises(InvalidInputError, match="count"):
        integer_least_squares(value, cov, count=[3, 2, 2, 2])
    with pytest.raises(InvalidInputError, match="n_candidate"):
        integer_least_squares(value, cov, n_candidate=0)


def test_a_hopeless_search_ends():
    n = 25
    found = integer_least_squares(np.full((1, n), 0.5), 400.0 * np.eye(n)[None])
    assert found.status[0] == IntegerStatus.SEARCH_LIMIT
    assert found.wrong_risk[0] == 1.0
