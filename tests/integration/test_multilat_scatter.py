"""Monte-Carlo scatter == reported covariance == bound, within 5 %.

20 000 trials: one sigma of a variance is 1 %, so 5 % is five.
"""

import numpy as np
import pytest

from rfpose.geometry import rot_enu_from_mirror
from rfpose.multilat import joint_covariance, locate, normal_bound, position_bound, solve_poses
from sites import TABLE_2

N = 20_000
TRANSMITTER = 100.0 * TABLE_2
UNEQUAL = np.array([1.0, 2.0, 1.5, 3.0, 0.7, 1.0, 5.0, 1.2, 0.8, 1.0]) * 1e-3
MISSING = np.where(np.arange(10) % 4 == 1, np.nan, UNEQUAL)
SQUARE = np.array([[1.5, 1.0, 0.0], [-1.5, 1.0, 0.0], [-1.5, -1.0, 0.0], [1.5, -1.0, 0.0]])
TRIANGLE = np.array([[1.0, 0.0, 0.0], [-0.5, 0.866, 0.0], [-0.5, -0.866, 0.0]])


def assert_covariance(sample, expected, rank):
    """Variances along the expected covariance's own axes agree within 5 %, correlations too."""
    value, axes = np.linalg.eigh(expected)
    white = (sample - sample.mean(axis=0)) @ axes[:, -rank:] / np.sqrt(value[-rank:])
    np.testing.assert_allclose(np.cov(white.T), np.eye(rank), atol=0.05)


@pytest.mark.parametrize("sigma", [np.full(10, 1e-3), UNEQUAL, MISSING], ids=["equal", "unequal", "missing"])
@pytest.mark.parametrize("place", [(0.0, 0.0, 2.0), (95.0, 20.0, 1.0)])
def test_position(sigma, place):
    rng = np.random.default_rng(12)
    measured = np.linalg.norm(TRANSMITTER - place, axis=1) + sigma * rng.standard_normal((N, 10))
    fixes = locate(TRANSMITTER, measured - measured[:, :1], sigma_m=sigma)
    assert fixes.ok.all()
    reported = fixes.cov_enu_m2.mean(axis=0)
    assert_covariance(fixes.position_enu_m, reported, rank=3)
    np.testing.assert_allclose(position_bound(TRANSMITTER, place, sigma), reported, rtol=1e-3, atol=1e-12)
    error = fixes.position_enu_m - place
    assert np.all(np.abs(error.mean(axis=0)) < 5.0 * np.sqrt(np.diag(reported) / N))
    n_free = np.isfinite(sigma).sum() - 4
    assert fixes.chi2.mean() == pytest.approx(n_free, abs=5 * np.sqrt(2 * n_free / N))


@pytest.mark.parametrize("mirror", [TRIANGLE, SQUARE], ids=["three", "four"])
@pytest.mark.parametrize("known", [False, True], ids=["numbered", "known"])
@pytest.mark.parametrize("sigma", [UNEQUAL, MISSING], ids=["unequal", "missing"])
def test_normal_with_calibration_noise_common_to_the_receivers(mirror, known, sigma):
    """Calibration noise twice the receivers' own: taken as independent, it would spoil the covariance by far."""
    rng = np.random.default_rng(13)
    facing = np.array([-0.4, -0.5, 0.8])
    n_receiver = len(mirror)
    receiver = np.array([60.0, 30.0, 3.0]) + mirror @ rot_enu_from_mirror(facing).T
    calibration = 2.0 * np.roll(UNEQUAL, 3)
    own = np.broadcast_to(sigma, (n_receiver, 10)) * (1.0 + 0.3 * np.arange(n_receiver))[:, None]
    measured = np.linalg.norm(receiver[:, None] - TRANSMITTER, axis=-1)
    measured = measured + own * rng.standard_normal((N, n_receiver, 10))
    measured += calibration * rng.standard_normal((N, 1, 10))
    poses = solve_poses(
        TRANSMITTER,
        measured - measured[:, :, :1],
        sigma_m=own,
        calibration_sigma_m=calibration,
        mirror_rows=[range(n_receiver)],
        receiver_mirror_m=[mirror] if known else None,
    )
    normals = poses.normals
    assert normals.ok.all()
    reported = normals.cov_enu[:, 0].mean(axis=0)
    assert_covariance(normals.normal_enu[:, 0], reported, rank=2)
    bound = normal_bound(TRANSMITTER, receiver, own, calibration, receiver_mirror_m=mirror if known else None)
    assert bound.sigma_rad == pytest.approx(np.sqrt(np.trace(reported)), rel=0.01)
    assert_covariance(
        poses.position_enu_m.reshape(N, -1), joint_covariance(TRANSMITTER, receiver, own, calibration), 3 * n_receiver
    )
    apart = normal_bound(TRANSMITTER, receiver, np.hypot(own, calibration))
    assert apart.sigma_rad > 1.3 * bound.sigma_rad
