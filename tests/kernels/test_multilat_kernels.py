"""Kernels of multilateration: compiled == Python twin == plain numpy; Jacobian == finite difference."""

import numpy as np
import pytest

from rfpose.multilat import _kernels as k

N_TRANSMITTER = 6
PARTS = (
    "load_group",
    "_moments",
    "_solve_linear",
    "start_group",
    "start_given",
    "_normal_equations",
    "_invert",
    "_step",
    "_linearise",
    "iterate_group",
    "_residuals",
    "_unequal",
    "dop_group",
    "residual_group",
    "store_group",
)


@pytest.fixture
def group():
    """One group of lanes at random positions with random weights and ranges."""
    rng = np.random.default_rng(7)
    transmitter = rng.standard_normal((N_TRANSMITTER, 3))
    delta = rng.standard_normal((N_TRANSMITTER, k.LANES))
    w = rng.uniform(0.5, 2.0, (N_TRANSMITTER, k.LANES))
    w[2, 3] = 0.0
    ws = np.zeros(k.WORKSPACE)
    ws[k.X : k.C + k.LANES] = rng.standard_normal(4 * k.LANES)
    return transmitter, delta, w, ws


def lanes(ws, offset):
    return ws[offset : offset + k.LANES]


def residuals(group, shift=(0.0, 0.0, 0.0, 0.0)):
    """(transmitter, lane) residuals from the kernel, with every lane's unknowns moved by ``shift``."""
    transmitter, delta, w, ws = group
    moved = ws.copy()
    for offset, by in zip((k.X, k.Y, k.Z, k.C), shift, strict=True):
        moved[offset : offset + k.LANES] += by
    out = np.empty_like(delta)
    k.residual_group(N_TRANSMITTER, transmitter, delta, w, moved, out)
    return out


def numerical_jacobian(group, step=1e-6):
    """(transmitter, lane, unknown) by central differences."""
    columns = []
    for axis in range(4):
        shift = np.zeros(4)
        shift[axis] = step
        columns.append((residuals(group, shift) - residuals(group, -shift)) / (2.0 * step))
    return np.stack(columns, axis=-1)


def test_normal_equations_are_those_of_the_numerical_jacobian(group):
    transmitter, delta, w, ws = group
    J, error = numerical_jacobian(group), residuals(group)
    k._linearise(transmitter, delta, w, ws)
    JWJ = np.einsum("tli,tl,tlj->lij", J, w, J)
    JWe = np.einsum("tli,tl,tl->li", J, w, error)
    names = {(0, 0): k.AXX, (0, 1): k.AXY, (0, 2): k.AXZ, (1, 1): k.AYY, (1, 2): k.AYZ, (2, 2): k.AZZ, (3, 3): k.W}
    for (i, j), offset in names.items():
        np.testing.assert_allclose(lanes(ws, offset), JWJ[:, i, j], atol=1e-8)
    # the clock's column is kept with the sign of u, not of the Jacobian
    for i, offset in enumerate((k.BX, k.BY, k.BZ)):
        np.testing.assert_allclose(lanes(ws, offset), -JWJ[:, i, 3], atol=1e-8)
    for i, offset in enumerate((k.GX, k.GY, k.GZ)):
        np.testing.assert_allclose(lanes(ws, offset), JWe[:, i], atol=1e-8)
    np.testing.assert_allclose(lanes(ws, k.GC), -JWe[:, 3], atol=1e-8)


def test_step_and_covariance_equal_numpys_solution_of_the_normal_equations(group):
    transmitter, delta, w, ws = group
    before = np.stack([lanes(ws, o).copy() for o in (k.X, k.Y, k.Z, k.C)], axis=-1)
    offset = before[:, None, :3] - transmitter
    distance = np.linalg.norm(offset, axis=-1)
    J = np.concatenate([offset / distance[..., None], -np.ones((*distance.shape, 1))], axis=-1)
    error = distance - before[:, 3:] - delta.T
    JWJ = np.einsum("lti,tl,ltj->lij", J, w, J)
    JWe = np.einsum("lti,tl,lt->li", J, w, error)
    step = -np.linalg.solve(JWJ, JWe[..., None])[..., 0]
    long = np.linalg.norm(step[:, :3], axis=1) > 1.0
    lanes(ws, k.ACTIVE)[:] = 1.0
    k._linearise(transmitter, delta, w, ws)
    k._invert(0.0, ws)
    assert k._step(0.0, 1.0, ws) > 0
    after = np.stack([lanes(ws, o) for o in (k.X, k.Y, k.Z, k.C)], axis=-1)
    np.testing.assert_allclose((after - before)[~long], step[~long], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm((after - before)[long, :3], axis=1), 1.0, rtol=1e-9)
    assert 0 < long.sum() < k.LANES
    inverse = np.linalg.inv(JWJ)
    np.testing.assert_allclose(lanes(ws, k.QXX), inverse[:, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(lanes(ws, k.QXZ), inverse[:, 0, 2], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(lanes(ws, k.QZZ), inverse[:, 2, 2], rtol=1e-9)


def test_linear_start_is_exact_without_noise(group):
    transmitter, delta, w, ws = group
    truth = np.stack([lanes(ws, o).copy() for o in (k.X, k.Y, k.Z)], axis=-1)
    delta[:] = np.linalg.norm(truth[None] - transmitter[:, None], axis=-1) - 0.7
    w[2, 3] = 1.0
    k.start_group(transmitter, delta, w, 0.0, ws)
    for axis, offset in enumerate((k.X, k.Y, k.Z)):
        np.testing.assert_allclose(lanes(ws, offset), truth[:, axis], atol=1e-7)
    np.testing.assert_allclose(lanes(ws, k.C), 0.7, atol=1e-7)


def solve(n_transmitter=9, given=False):
    """Every output of `locate_rows` for a few dozen rows with unequal weights and gaps."""
    rng = np.random.default_rng(11)
    n = 3 * k.LANES - 5
    transmitter = np.zeros((n_transmitter + n_transmitter % 2, 3))
    transmitter[:n_transmitter] = rng.uniform(-1.0, 1.0, (n_transmitter, 3))
    receiver = rng.uniform(-0.5, 0.5, (n, 3))
    ranges = 50.0 * np.linalg.norm(receiver[:, None] - transmitter[:n_transmitter], axis=-1)
    ranges += 1e-3 * rng.standard_normal(ranges.shape)
    ranges[rng.random(ranges.shape) < 0.15] = np.nan
    weight = (50.0 / rng.uniform(5e-4, 2e-3, ranges.shape)) ** 2
    start = receiver + 0.05 if given else np.empty((0, 3))
    out = (
        np.empty((n, 3)),
        np.empty(n),
        np.empty((n, 3, 3)),
        np.empty(n),
        np.empty(ranges.shape),
        np.empty(n),
        np.empty(n, np.int16),
        np.empty(n, np.int16),
        np.empty(n, np.int8),
    )
    arguments = (transmitter, ranges, weight, start, 50.0, np.array([3.0, -2.0, 1.0]), 0.0, 30, 1e-12, 1.0, 5)
    return arguments, out


@pytest.mark.parametrize("given", [False, True])
def test_compiled_kernel_equals_its_python_twin(monkeypatch, given):
    arguments, compiled = solve(given=given)
    k.locate_rows(3, *arguments, *compiled)
    _, python = solve(given=given)
    for name in PARTS:
        monkeypatch.setattr(k, name, getattr(k, name).py_func)
    with np.errstate(all="ignore"):
        k.locate_rows.py_func(0, 3, *arguments, *python)
    assert np.sum(compiled[-1] == k.OK) > 30
    for a, b in zip(compiled, python, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_gain_is_the_pseudo_inverse(monkeypatch):
    rng = np.random.default_rng(3)
    transmitter = rng.standard_normal((7, 3))
    place = np.array([0.2, 0.1, -0.4])
    weight = rng.uniform(1.0, 9.0, 7)
    weight[4] = np.nan
    h, twin, u = np.empty((3, 7)), np.empty((3, 7)), np.empty((3, 7))
    k.gain(transmitter, *place, weight, h, u)
    k.gain.py_func(transmitter, *place, weight, twin, u)
    np.testing.assert_allclose(h, twin, rtol=1e-12, atol=1e-15)
    q = np.nan_to_num(weight)
    offset = place - transmitter
    J = np.concatenate([offset / np.linalg.norm(offset, axis=1, keepdims=True), -np.ones((7, 1))], axis=1)
    expected = np.linalg.solve(J.T @ (q[:, None] * J), J.T * q)[:3]
    np.testing.assert_allclose(h, expected, rtol=1e-9, atol=1e-12)


def test_joint_covariance_equals_its_python_twin(monkeypatch):
    rng = np.random.default_rng(4)
    transmitter = rng.standard_normal((7, 3))
    position = rng.uniform(-0.3, 0.3, (5, 3, 3))
    own, common = rng.uniform(1.0, 2.0, (2, 5, 3, 7))
    own[2, 1, 3:] = np.nan
    compiled, python = np.empty((5, 9, 9)), np.empty((5, 9, 9))
    k.joint_covariances(transmitter, position, own, common, compiled)
    monkeypatch.setattr(k, "gain", k.gain.py_func)
    k.joint_covariances.py_func(transmitter, position, own, common, python)
    np.testing.assert_allclose(compiled, python, rtol=1e-9, atol=1e-12)
    assert np.isnan(compiled[2, 3:6]).all()
    assert np.isfinite(compiled[2, :3, :3]).all()
