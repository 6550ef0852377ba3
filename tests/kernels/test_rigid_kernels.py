"""Rigid-pose kernels: derivative, dense algebra, Python twin."""

import numpy as np
import pytest

from rfpose.geometry import rot_enu_from_mirror
from rfpose.multilat.equations import _kernels as equations
from rfpose.multilat.reflection import direct_rays
from rfpose.multilat.reflection._kernels import work_for
from rfpose.multilat.rigid import _kernels

RNG = np.random.default_rng(0)
TRANSMITTER = RNG.uniform(-100, 100, (7, 3)) + np.array([0, 0, 40])
PLACES = np.array([[1.0, 0.0, 0.1], [-0.5, 0.8, 0.1], [-0.5, -0.8, 0.1]])
PIVOT, ROT = np.array([5.0, -20.0, 2.0]), rot_enu_from_mirror([0.2, 0.7, 0.6])


def ranges(pivot, rot):
    distance, slope = np.empty((1, 3, 7)), np.empty((1, 3, 7, 6))
    scene = direct_rays(TRANSMITTER, 1)
    _kernels.predict(scene, scene.common[0], work_for(0), PLACES, pivot, rot, np.empty(0), distance, slope)
    return distance[0], slope[0]


def turned(theta):
    out = np.empty((3, 3))
    equations.rotate(np.asarray(theta, float), ROT, out)
    return out


def test_rotation_is_the_matrix_exponential():
    from scipy.spatial.transform import Rotation

    for size in (1e-12, 1e-4, 1.0, 3.0):
        theta = size * np.array([0.3, -0.5, 0.8])
        expected = Rotation.from_rotvec(theta).as_matrix() @ ROT
        np.testing.assert_allclose(turned(theta), expected, atol=1e-14)
        out = np.empty((3, 3))
        equations.rotate.py_func(theta, ROT, out)
        np.testing.assert_allclose(out, expected, atol=1e-14)


def test_slopes_are_the_derivative():
    distance, slope = ranges(PIVOT, ROT)
    expected = np.linalg.norm(PIVOT + PLACES @ ROT.T - TRANSMITTER[:, None], axis=-1).T
    np.testing.assert_allclose(distance, expected, rtol=1e-14)
    step = 1e-5
    for a in range(3):
        shift = step * np.eye(3)[a]
        numeric = (ranges(PIVOT + shift, ROT)[0] - ranges(PIVOT - shift, ROT)[0]) / (2 * step)
        np.testing.assert_allclose(slope[..., a], numeric, atol=1e-8)
        numeric = (ranges(PIVOT, turned(shift))[0] - ranges(PIVOT, turned(-shift))[0]) / (2 * step)
        np.testing.assert_allclose(slope[..., 3 + a], numeric, atol=1e-8)


@pytest.mark.parametrize("bias_info", [0.0, 40.0, np.inf])
def test_normal_equations_are_those_of_the_whole_system(bias_info):
    """Eliminating the transmitters' own errors equals estimating them with their prior."""
    distance, slope = ranges(PIVOT, ROT)
    weight = RNG.uniform(0.5, 2.0, (2, 3, 7))
    weight[1, 2, 3] = 0.0
    z = distance + RNG.standard_normal((2, 3, 7))
    clock = RNG.standard_normal((2, 3))
    info, gradient = np.zeros((12, 12)), np.zeros(12)
    info_of_bias = np.full((2, 7), bias_info)
    args = (z, weight, info_of_bias, np.array([0, 1]), distance[None], slope[None], clock)
    chi2 = equations.normal_equations(*args, info, gradient)

    n_bias = 14
    jacobian, left, w = [], [], []
    for g in range(2):
        for r in range(3):
            for i in range(7):
                row = np.zeros(12 + n_bias)
                row[:6] = slope[r, i]
                row[6 + 3 * g + r] = 1.0
                row[12 + 7 * g + i] = np.isfinite(bias_info)
                jacobian.append(row)
                left.append(z[g, r, i] - distance[r, i] - clock[g, r])
                w.append(weight[g, r, i])
    jacobian, left, w = np.array(jacobian), np.array(left), np.array(w)
    whole = jacobian.T @ (w[:, None] * jacobian)
    right = jacobian.T @ (w * left)
    if np.isfinite(bias_info):
        whole[12:, 12:] += bias_info * np.eye(n_bias)
        solve = np.linalg.solve(whole[12:, 12:], np.column_stack([whole[12:, :12], right[12:]]))
        expected = whole[:12, :12] - whole[:12, 12:] @ solve[:, :12]
        expected_right = right[:12] - whole[:12, 12:] @ solve[:, 12]
        expected_chi2 = np.sum(w * left**2) - right[12:] @ solve[:, 12]
    else:
        expected, expected_right, expected_chi2 = whole[:12, :12], right[:12], np.sum(w * left**2)
    np.testing.assert_allclose(np.tril(info), np.tril(expected), atol=1e-9)
    np.testing.assert_allclose(gradient, expected_right, atol=1e-9)
    if np.isfinite(bias_info):
        assert chi2 == pytest.approx(expected_chi2, rel=1e-9)
    twin_info, twin_gradient = np.zeros((12, 12)), np.zeros(12)
    equations.normal_equations.py_func(*args, twin_info, twin_gradient)
    np.testing.assert_allclose(twin_info, info, atol=1e-9)
    np.testing.assert_allclose(twin_gradient, gradient, atol=1e-9)


def test_factor_solves_and_knows_singular_matrices():
    a = RNG.standard_normal((6, 9))
    matrix, b = a @ a.T, RNG.standard_normal(6)
    lower, x = matrix.copy(), b.copy()
    assert equations.factor(lower, len(lower), 1e-13)
    equations.solve_factored(lower, x)
    np.testing.assert_allclose(x, np.linalg.solve(matrix, b), rtol=1e-9)
    cov = np.empty((6, 6))
    equations.covariance(lower, cov)
    np.testing.assert_allclose(cov, np.linalg.inv(matrix), rtol=1e-9)
    assert not equations.factor(a[:, :5] @ a[:, :5].T, len(a), 1e-13)
    assert not equations.factor(np.zeros((3, 3)), 3, 1e-13)
