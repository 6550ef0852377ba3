"""The spline's kernel is its Python twin, and both are scipy's spline."""

import numpy as np
from scipy.interpolate import BSpline

from rfpose.antenna import _kernels, dipole_pattern

TABLE = dipole_pattern([[1.0, 0, 0.1], [0, 1, 0.1]], [0.3, 1, -0.2], 1e8).table(1e8)


def test_compiled_is_plain_python_and_scipys_spline():
    rng = np.random.default_rng(5)
    direction = np.vstack([rng.standard_normal((40, 3)), [[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, -1e-17, 0]]])
    receiver = rng.integers(0, 2, len(direction))
    vector, slope, _ = TABLE.vector_and_slope(direction, receiver)
    n_polar, n_azimuth = TABLE.coefficient.shape[1] - 2, TABLE.coefficient.shape[2] - 3
    cubic = [BSpline(np.arange(-3.0, n + 1.0), np.eye(n), 3) for n in (n_polar + 2, n_azimuth + 3)]
    for n, (x, y, z) in enumerate(direction):
        twin_vector, twin_slope = np.empty(3, complex), np.empty((3, 3), complex)
        _kernels.look_up.py_func(TABLE.coefficient, receiver[n], x, y, z, np.empty((4, 4)), twin_vector, twin_slope)
        np.testing.assert_allclose(vector[n], twin_vector, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(slope[n], twin_slope, rtol=1e-10, atol=1e-10)
        polar, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x) % (2 * np.pi)
        weights = [
            cubic[0](polar / np.pi * (n_polar - 1)),
            cubic[1](azimuth / (2 * np.pi) * n_azimuth),
        ]
        scipys = np.einsum("p,a,pac->c", *weights, TABLE.coefficient[receiver[n]])
        np.testing.assert_allclose(vector[n], scipys, atol=2e-7 if np.hypot(x, y) == 0 else 1e-12)
