"""Searches side by side: the quadratic model's step by its conditions, whole searches by scipy's."""

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from rfpose.layout.optimise.descent import _kernels, minimised


def models(count):
    """Quadratic models with linear constraints of many sizes; some cannot be met, some begin with multipliers."""
    rng = np.random.default_rng(4)
    for k in range(count):
        n, m = int(rng.integers(2, 25)), int(rng.integers(1, 60))
        root = rng.normal(size=(n, n))
        by = rng.normal(size=(n, m)) * (rng.random((n, m)) < 0.3)
        margin = rng.uniform(-0.1 * (k % 2), 1.0, m)
        begin = np.where(rng.random(m) < 0.2, 1.0, 0.0) * (k % 3 > 0)
        yield root @ root.T + 0.01 * np.eye(n), rng.normal(size=n), margin, by, begin


def test_step_is_the_least_of_the_model():
    refused = 0
    for curvature, slope, margin, by, multiplier in models(200):
        step = np.zeros(len(slope))
        inverse = np.linalg.inv(curvature)
        if not _kernels.model_step(inverse, slope, margin, by, multiplier, step):
            refused += 1
            assert linprog(np.zeros(len(slope)), A_ub=-by.T, b_ub=margin, bounds=(None, None)).status == 2
            continue
        left, scale = margin + by.T @ step, max(1.0, multiplier.max())
        np.testing.assert_allclose(curvature @ step + slope, by @ multiplier, atol=1e-8 * scale)
        assert left.min() > -1e-9
        assert multiplier.min() >= 0.0
        assert np.abs(multiplier * left).max() < 1e-8 * scale
    assert 0 < refused < 50


def test_where_constraints_contradict_a_step_makes_up_for_a_share():
    # x ≥ 1 and x ≤ -1: the best that can be done for both alike
    by, margin = np.array([[1.0, -1.0], [0.0, 0.0]]), np.array([-1.0, -1.0])
    step, multiplier = np.zeros(2), np.zeros(2)
    ease = _kernels.eased_step(np.eye(2), np.array([0.0, 1.0]), margin, by, multiplier, step)
    assert ease == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(step, [0.0, -1.0], atol=1e-9)


def curved(x):
    """Rosenbrock's valley (search,), and its slope."""
    rise, left = x[:, 1:] - x[:, :-1] ** 2, 1.0 - x[:, :-1]
    slope = np.zeros_like(x)
    slope[:, 1:] += 20.0 * rise
    slope[:, :-1] -= 40.0 * rise * x[:, :-1] + 2.0 * left
    return (10.0 * rise**2 + left**2).sum(axis=1), slope


def ball_and_wall(x):
    """Within 1.2 of the origin, beyond 0.5 of it, and beside a wall."""
    square = (x**2).sum(axis=1)
    wall = np.zeros_like(x)
    wall[:, 0] = 1.0
    return (
        np.stack([1.44 - square, square - 0.25, x[:, 0] + 0.3], axis=1),
        np.stack([-2.0 * x, 2.0 * x, wall], axis=2),
    )


def test_searches_end_where_scipys_do():
    rng = np.random.default_rng(1)
    start = rng.uniform(-1.5, 1.5, (20, 4))  # few meet the constraints
    ended = []
    end = minimised(curved, ball_and_wall, start, tolerance=1e-10, on_end=ended.append)
    assert ball_and_wall(end)[0].min() > -1e-9
    assert ended == sorted(ended)
    assert ended[-1] == 20
    for one, begin in zip(end, start, strict=True):
        alone = minimised(curved, ball_and_wall, begin[None], tolerance=1e-10)
        np.testing.assert_array_equal(alone[0], one)
        found = minimize(
            lambda x: curved(x[None])[0][0], begin, jac=lambda x: curved(x[None])[1][0], method="SLSQP",
            constraints=[{"type": "ineq", "fun": lambda x: ball_and_wall(x[None])[0][0],
                          "jac": lambda x: ball_and_wall(x[None])[1][0].T}],
            options={"ftol": 1e-10, "maxiter": 300},
        )  # fmt: skip
        assert curved(one[None])[0][0] == pytest.approx(found.fun, abs=1e-7)
