"""What must not matter to a fix, and that every receiver of a field is found."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rfpose.multilat import FixStatus, locate, mirror_normal
from sites import TABLE_2

TRANSMITTER = 100.0 * TABLE_2
SIGMA = 0.01
seeds = st.integers(0, 2**31)


def field(rng, n):
    radius, angle = 100.0 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 5.0 * rng.random(n)], axis=-1)


def measure(rng, receiver, sigma=SIGMA):
    distance = np.linalg.norm(receiver[:, None] - TRANSMITTER, axis=-1)
    return distance + sigma * rng.standard_normal(distance.shape) + 100.0 * rng.standard_normal((len(receiver), 1))


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_rigid_motion_moves_the_solution_with_it(seed):
    rng = np.random.default_rng(seed)
    ranges = measure(rng, field(rng, 20))
    R, shift = Rotation.random(rng=rng).as_matrix(), 1000.0 * rng.standard_normal(3)
    here = locate(TRANSMITTER, ranges, sigma_m=SIGMA)
    there = locate(TRANSMITTER @ R.T + shift, ranges, sigma_m=SIGMA, side=None)
    np.testing.assert_allclose(there.position_enu_m, here.position_enu_m @ R.T + shift, atol=1e-7)
    np.testing.assert_allclose(there.cov_enu_m2, R @ here.cov_enu_m2 @ R.T, rtol=1e-5, atol=1e-5 * SIGMA**2)
    np.testing.assert_allclose(there.clock_m, here.clock_m, atol=1e-7)


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_order_of_transmitters_is_irrelevant(seed):
    rng = np.random.default_rng(seed)
    ranges = measure(rng, field(rng, 20))
    ranges[rng.random(ranges.shape) < 0.1] = np.nan
    sigma = rng.uniform(0.005, 0.02, ranges.shape)
    order = rng.permutation(10)
    a = locate(TRANSMITTER, ranges, sigma_m=sigma)
    b = locate(TRANSMITTER[order], ranges[:, order], sigma_m=sigma[:, order])
    np.testing.assert_allclose(a.position_enu_m, b.position_enu_m, atol=1e-7)
    np.testing.assert_allclose(a.residual_m[:, order], b.residual_m, atol=1e-7)
    np.testing.assert_array_equal(a.status, b.status)


@settings(deadline=None, max_examples=30)
@given(seeds, st.floats(-1e4, 1e4))
def test_a_constant_changes_only_the_clock(seed, constant):
    rng = np.random.default_rng(seed)
    ranges = measure(rng, field(rng, 20))
    a, b = (locate(TRANSMITTER, ranges + c, sigma_m=SIGMA) for c in (0.0, constant))
    np.testing.assert_allclose(a.position_enu_m, b.position_enu_m, atol=1e-6)
    np.testing.assert_allclose(a.clock_m - constant, b.clock_m, atol=1e-6)


def test_rows_do_not_know_of_each_other():
    rng = np.random.default_rng(1)
    ranges = measure(rng, field(rng, 200), sigma=0.5)
    together = locate(TRANSMITTER, ranges, sigma_m=0.5)
    for i in (0, 17, 199):
        alone = locate(TRANSMITTER, ranges[i : i + 1], sigma_m=0.5)
        np.testing.assert_array_equal(alone.position_enu_m[0], together.position_enu_m[i])


@pytest.mark.parametrize(
    ("sigma", "missing"), [(1e-3, 0), (0.1, 0), (1.0, 0), (1e-3, 3), (0.1, 3), (1.0, 3), (1e-3, 5)]
)
def test_every_receiver_of_the_field_is_found_from_a_cold_start(sigma, missing):
    """7 x 30 000 receivers: none unsolved, none farther off than 8 of its own sigma (p < 1e-13 each)."""
    rng = np.random.default_rng(6)
    receiver = field(rng, 30_000)
    ranges = measure(rng, receiver, sigma)
    np.put_along_axis(ranges, np.argsort(rng.random(ranges.shape), axis=1)[:, :missing], np.nan, axis=1)
    fixes = locate(TRANSMITTER, ranges, sigma_m=sigma, max_dop=np.inf)
    # with five transmitters a second place may fit as well; one in ten thousand does
    two_places = (fixes.status == FixStatus.AMBIGUOUS) & (missing == 5)
    assert np.all(fixes.ok | two_places)
    assert np.count_nonzero(two_places) <= 3
    offset = fixes.position_enu_m - receiver
    limit = 8.0 * np.sqrt(np.trace(fixes.cov_enu_m2, axis1=1, axis2=2))
    if missing == 5:  # dilution to 100 and more: first-order covariance, and the mirror image nearby
        limit = np.maximum(limit, 1.0)
    assert np.all(np.linalg.norm(offset, axis=1) < limit)


@settings(deadline=None, max_examples=30)
@given(seeds, st.integers(3, 6))
def test_normal_turns_with_the_mirror(seed, n_receiver):
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(n_receiver) + rng.uniform(-0.3, 0.3, n_receiver)) / n_receiver
    mirror = np.stack([np.cos(angle), np.sin(angle), 0.01 * rng.standard_normal(n_receiver)], axis=-1)
    root = rng.standard_normal((3 * n_receiver, 3 * n_receiver))
    cov = 1e-6 * root @ root.T
    R = Rotation.random(rng=rng).as_matrix()
    big = np.kron(np.eye(n_receiver), R)
    a = mirror_normal(mirror, cov)
    b = mirror_normal(mirror @ R.T + [5.0, 6.0, 7.0], big @ cov @ big.T)
    assert a.normal_enu[2] > 0.9
    np.testing.assert_allclose(b.normal_enu, R @ a.normal_enu, atol=1e-12)
    np.testing.assert_allclose(b.cov_enu, R @ a.cov_enu @ R.T, atol=1e-15)
