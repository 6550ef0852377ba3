"""A mount found from normals whose errors go together: against draws from the covariance that is told."""

import numpy as np
import pytest
from scipy.stats import chi2

from rfpose import geometry
from rfpose.errors import InvalidInputError
from rfpose.feedback.correlated import AXES_AND_ZEROS, fit_correlated
from rfpose.feedback.mount import Mount, posture

PLANNED = Mount(pivot_enu_m=np.array([5.0, 30.0, 3.0]))
PRIOR = dict(zip(AXES_AND_ZEROS, (10e-3, 10e-3, 50e-3, 50e-3, 2e-3), strict=True))
NOISE_RAD, TURN_RAD = 2e-3, 0.5e-3
N = 20


def postures(rng, n=N):
    """Motor positions over half a day."""
    return np.column_stack([rng.uniform(2.4, 4.0, n), rng.uniform(0.5, 1.2, n)])


def alike(normal, angle_rad=0.12, turn_rad=TURN_RAD):
    """Covariance (posture, xy, posture, xy) of errors that go together in near postures, and of a turn in all."""
    angle = np.arccos(np.clip(normal @ normal.T, -1.0, 1.0))
    by_noise = NOISE_RAD**2 * np.exp(-angle / angle_rad)
    return np.einsum("fg,ab->fagb", by_noise + turn_rad**2, np.eye(2))


def drawn(rng, n=N, **how):
    """A mount that is not as planned, its counts, measured normals, and their covariance."""
    true = PLANNED.replace(**{name: sigma * rng.standard_normal() for name, sigma in PRIOR.items()})
    count = postures(rng, n)
    normal = posture(true, count).normal_enu
    cov = alike(normal, **how)
    off = (np.linalg.cholesky(cov.reshape(2 * n, 2 * n)) @ rng.standard_normal(2 * n)).reshape(n, 2)
    across = geometry.rot_enu_from_mirror(normal)[:, :, :2]
    return true, count, geometry.unit(normal + np.einsum("pxa,pa->px", across, off)), cov


def errors(found, true):
    return np.array([found.mount.parameters[name] - true.parameters[name] for name in AXES_AND_ZEROS])


def nees(draws, told=lambda cov: cov):
    """Normalised squared errors of as many mounts as are drawn, with the covariance that the fit is told."""
    total = 0.0
    for seed in range(draws):
        true, count, normal, cov = drawn(np.random.default_rng([7, seed]))
        found = fit_correlated(PLANNED, count, normal, told(cov), prior_sigma=PRIOR)
        off = errors(found, true)
        total += off @ np.linalg.solve(found.covariance, off)
    return total


def test_mounts_scatter_by_what_is_told():
    n = 40
    low, high = chi2.ppf([1e-3, 1.0 - 1e-3], n * len(PRIOR))
    # small angles' products and the scatter where it is above one: a tenth
    assert low / 1.1 < nees(n) < high * 1.1


def test_errors_taken_for_independent_would_feign_knowledge():
    def white(cov):
        n = len(cov)
        return cov * np.eye(n)[:, None, :, None]

    assert nees(20, white) > 1.5 * chi2.ppf(1.0 - 1e-3, 20 * len(PRIOR))


def test_a_turn_of_all_normals_stays_in_the_zero_until_a_reference_tells():
    _, count, normal, cov = drawn(np.random.default_rng(3), turn_rad=3e-3)
    found = fit_correlated(PLANNED, count, normal, cov, prior_sigma=PRIOR)
    zero = found.sigma[AXES_AND_ZEROS.index("axis_2_zero_rad")]
    assert 3e-3 < zero < 4.5e-3
    before, now, pointed = found.normal_sigma_rad
    assert before > 10.0 * now > 15.0 * pointed


def test_one_posture_does_not_determine_a_mount():
    _, count, normal, cov = drawn(np.random.default_rng(4), n=1)
    found = fit_correlated(PLANNED, count, normal, cov, prior_sigma=PRIOR)
    assert (found.rank, found.n_posture) == (2, 1)
    assert np.isnan(found.scatter)
    assert len(found.undetermined) == 3
    assert any("nonorthogonality_rad" in words for words in found.undetermined)
    many = fit_correlated(PLANNED, *drawn(np.random.default_rng(4))[1:], prior_sigma=PRIOR)
    assert many.rank > found.rank


def test_without_a_posture_a_mount_stays_as_planned():
    count, normal = np.full((3, 2), np.nan), np.full((3, 3), np.nan)
    found = fit_correlated(PLANNED, count, normal, np.full((3, 2, 3, 2), np.nan), prior_sigma=PRIOR)
    assert found.mount.parameters == PLANNED.parameters
    assert (found.rank, found.n_posture, found.undetermined) == (0, 0, AXES_AND_ZEROS)
    np.testing.assert_allclose(found.sigma, list(PRIOR.values()))


def test_postures_that_lack_something_are_left_out():
    _, count, normal, cov = drawn(np.random.default_rng(5))
    whole = fit_correlated(PLANNED, count[3:], normal[3:], cov[3:, :, 3:], prior_sigma=PRIOR)
    count[0], normal[1], cov[2], cov[:, :, 2] = np.nan, np.nan, np.nan, np.nan
    found = fit_correlated(PLANNED, count, normal, cov, prior_sigma=PRIOR)
    assert found.n_posture == N - 3
    np.testing.assert_allclose(found.covariance, whole.covariance)
    assert found.mount.parameters == whole.mount.parameters


def test_normals_that_scatter_more_than_told_widen_the_covariance():
    _, count, normal, cov = drawn(np.random.default_rng(6))
    true = fit_correlated(PLANNED, count, normal, cov, prior_sigma=PRIOR)
    found = fit_correlated(PLANNED, count, normal, cov / 100.0, prior_sigma=PRIOR)
    assert 0.5 < true.scatter < 1.5
    assert found.scatter == pytest.approx(10.0 * true.scatter, rel=0.1)
    np.testing.assert_allclose(
        found.sigma, true.sigma * np.fmax(true.scatter, 0.1) / np.fmax(true.scatter, 1.0), rtol=0.1
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"prior_sigma": {}}, "`prior_sigma` must name one parameter"),
        ({"prior_sigma": {"axis_1_zero_rad": 0.0}}, "sigma above zero"),
        ({"cov_rad2": -np.ones((N, 2, N, 2))}, "not positive definite"),
        ({"count": np.zeros((N - 1, 2))}, "`count`"),
    ],
)
def test_what_is_no_measurement_is_refused(change, said):
    _, count, normal, cov = drawn(np.random.default_rng(8))
    told = {"count": count, "normal_enu": normal, "cov_rad2": cov, "prior_sigma": PRIOR} | change
    with pytest.raises(InvalidInputError, match=said):
        fit_correlated(PLANNED, told.pop("count"), told.pop("normal_enu"), told.pop("cov_rad2"), **told)
