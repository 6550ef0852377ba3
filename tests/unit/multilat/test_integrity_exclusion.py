"""Tests on residuals against their definition, exclusion of each kind of error, and bad input."""

from dataclasses import replace

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.geometry import rot_enu_from_mirror
from rfpose.multilat import PoseStatus
from rfpose.multilat.integrity import Alarms, IntegrityStatus, TransmitterStatus, solve_with_integrity
from rfpose.multilat.integrity.guard import log_probability, noncentrality
from rfpose.multilat.integrity.hypotheses import judge
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, solve_rigid
from rfpose.multilat.rigid.weights import used_priors
from sites import TABLE_2

TRANSMITTER = 100.0 * TABLE_2
PLACES = np.array([[1.0, 0, 0], [-0.5, 0.866, 0], [-0.5, -0.866, 0]])
SIGMA = 1e-3
PIVOT = np.array([[40.0, 20.0, 3.0], [-70.0, 30.0, 3.0], [5.0, -60.0, 3.0], [20.0, 10.0, 3.0]])
ROT = rot_enu_from_mirror([[-0.4, -0.2, 0.9], [0.7, -0.3, 0.5], [0.1, 0.6, 0.8], [0.2, 0.1, 0.95]])


def measure(seed, *, n_group=1, calibration=SIGMA, delays=0.0, scale=1.0):
    """Ranges (mirror, group, receiver, transmitter) with noise; a common clock and one delay a receiver [m]."""
    rng = np.random.default_rng(seed)
    receiver = PIVOT[:, None] + np.einsum("mab,rb->mra", ROT, PLACES)
    z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)[:, None]
    z = np.repeat(z, n_group, axis=1)
    z = z + scale * SIGMA * rng.standard_normal(z.shape)
    if np.isinf(calibration):
        z += 5.0 * rng.standard_normal((len(z), n_group, 1, 10))
    else:
        z += scale * calibration * rng.standard_normal((len(z), n_group, 1, 10))
    return z + 3.0 + delays * rng.standard_normal((len(z), 1, 3, 1))


def settings(known=None, calibration=SIGMA, n_group=1):
    return {
        "sigma_m": SIGMA,
        "transmitter_sigma_m": calibration,
        "clock_class": [0] * n_group,
        "start_pivot_enu_m": PIVOT + 0.2,
        "start_rot_enu_from_mirror": ROT,
        "knowledge": known or MirrorKnowledge(clock_sigma_m=0.0),
    }


KNOWN = {
    "one clock, calibrated": (MirrorKnowledge(clock_sigma_m=0.0), 1.5 * SIGMA),
    "three clocks, calibrated": (MirrorKnowledge(), 0.5 * SIGMA),
    "between receivers": (MirrorKnowledge(clock_sigma_m=0.0, pivot_enu_m=PIVOT, pivot_sigma_m=5e-3), np.inf),
    "everything": (
        MirrorKnowledge(clock_sigma_m=2e-3, pivot_enu_m=PIVOT, pivot_sigma_m=5e-3, two_axis=True, roll_sigma_rad=1e-3),
        SIGMA,
    ),
}


@pytest.mark.parametrize("name", KNOWN)
def test_a_statistic_is_the_drop_of_chi2_when_its_part_is_freed(name):
    """Noise a hundredth of sigma keeps the equations linear; then the identity holds to rounding."""
    known, calibration = KNOWN[name]
    z = measure(1, n_group=2, calibration=calibration, scale=0.01)
    keys = settings(known, calibration, n_group=2)
    mirrors = MirrorProblem.of(TRANSMITTER, PLACES, z, **keys)
    poses = solve_rigid(mirrors)
    verdict = judge(mirrors, poses)
    assert verdict.ok.all()

    def drop(ranges, without):
        again = solve_rigid(MirrorProblem.of(TRANSMITTER, PLACES, ranges, **{**keys, "knowledge": without}))
        assert np.all(again.status == PoseStatus.OK)
        tilt = np.einsum("mac,mab,mbd->mcd", ROT[:, :, :2], (again.cov - poses.cov)[:, 3:, 3:], ROT[:, :, :2])
        return poses.chi2 - again.chi2, tilt

    for i in (0, 6, 9):
        ranges = z.copy()
        ranges[..., i] = np.nan
        stat, spread = drop(ranges, known)
        np.testing.assert_allclose(verdict.stat[:, i], stat, rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(verdict.spread_rad2[:, i], spread, rtol=1e-2, atol=1e-10)
        ranges = z.copy()
        ranges[:, :, 1, i] = np.nan
        np.testing.assert_allclose(verdict.link[:, 1, i], drop(ranges, known)[0], rtol=1e-3, atol=1e-6)
    freed = [
        replace(known, pivot_enu_m=None),
        replace(known, two_axis=False),
        replace(known, clock_sigma_m=np.inf),
    ]
    for k, without in enumerate(freed):
        if not used_priors(mirrors)[0, k] or verdict.dof[0, 10 + k] == 0:
            continue
        stat, spread = drop(z, without)
        np.testing.assert_allclose(verdict.stat[:, 10 + k], stat, rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(verdict.spread_rad2[:, 10 + k], spread, rtol=1e-2, atol=1e-10)


def test_every_prior_is_tested_where_it_can_be():
    known, calibration = KNOWN["everything"]
    found = solve_with_integrity(
        MirrorProblem.of(TRANSMITTER, PLACES, measure(2, delays=2e-3), **settings(known, calibration))
    )
    assert found.prior_testable.all()
    assert np.all(found.status == IntegrityStatus.OK)


PATTERNS = {
    "common": ([1.0, 1.0, 1.0], TransmitterStatus.COMMON_ERROR),
    "one receiver": ([0.0, 1.0, 0.0], TransmitterStatus.ONE_RECEIVER),
    "each its own": ([1.0, -1.0, 0.3], TransmitterStatus.MULTIPATH),
}


def test_what_was_chosen_for_fitting_is_less_certain_than_it_looks():
    """Half of the transmitters off by a few sigma, or all a little: where some were left out, errors are as stated."""
    for n_bad, size in ((5, 5.0), (7, 5.0), (10, 2.0)):
        rng = np.random.default_rng(n_bad)
        z = np.concatenate([measure(30 + k) for k in range(200)])
        bad = np.argsort(rng.random((len(z), 10)), axis=1) < n_bad
        z += size * SIGMA * bad[:, None, None, :] * rng.standard_normal(z.shape)
        rot = np.tile(ROT, (200, 1, 1))
        start = {"start_pivot_enu_m": np.tile(PIVOT + 0.2, (200, 1)), "start_rot_enu_from_mirror": rot}
        found = solve_with_integrity(
            MirrorProblem.of(TRANSMITTER, PLACES, z, **{**settings(), **start}), Alarms(false_alarm=1e-3)
        )
        left_out = (found.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1) & found.ok
        assert left_out.sum() > 50
        sigma = found.poses.tilt_sigma_rad[left_out]
        error = np.linalg.norm(found.poses.normal_enu - rot[:, :, 2], axis=1)[left_out]
        assert np.sqrt(np.mean((error / sigma) ** 2)) < 1.3
        assert np.all(error < 5.0 * sigma)
        # the protection level is what it exceeds with the missed-detection probability
        allowed = found.protection_level_rad[left_out] / np.sqrt(-2.0 * np.log(1e-3))
        assert np.all(sigma > 0.999 * allowed)
        assert np.all(sigma < 1.001 * np.sqrt(2.0) * allowed)


@pytest.mark.parametrize("size_sigma", [40.0, 1000.0])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_an_error_is_found_named_and_left_out(pattern, size_sigma):
    shape, cause = PATTERNS[pattern]
    z = measure(3)
    clean = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings()))
    assert np.all(clean.status == IntegrityStatus.OK)
    assert np.all(clean.transmitter_status == TransmitterStatus.OK)
    z[:, 0, :, 4] += size_sigma * SIGMA * np.array(shape)
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings()))
    assert np.all(found.status == IntegrityStatus.EXCLUDED)
    assert np.all(found.transmitter_status[:, 4] == cause)
    assert np.all(np.delete(found.transmitter_status, 4, axis=1) == TransmitterStatus.OK)
    np.testing.assert_array_equal(found.used[:, :, 4].sum(axis=1), 2 if pattern == "one receiver" else 0)
    assert np.all(found.protection_level_rad > 0.99 * clean.protection_level_rad)
    assert "transmitter 4" in found.reasons()[0]
    # the same as if it had never been received
    without = z.copy()
    without[:, 0][~found.used] = np.nan
    np.testing.assert_allclose(
        found.poses.normal_enu,
        solve_rigid(MirrorProblem.of(TRANSMITTER, PLACES, without, **settings())).normal_enu,
        atol=1e-6,
    )


def test_noise_far_above_the_others_is_called_interference():
    z, sigma = measure(4), np.full((4, 1, 3, 10), SIGMA)
    sigma[..., 2] *= 5.0
    z[..., 2] += np.array([200.0, -150.0, 90.0]) * SIGMA
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **{**settings(), "sigma_m": sigma}))
    assert np.all(found.transmitter_status[:, 2] == TransmitterStatus.INTERFERENCE)


def test_two_errors_are_both_left_out_and_nothing_else():
    z = measure(5)
    z[..., 1] += 60.0 * SIGMA
    z[:, :, 2, 7] -= 45.0 * SIGMA
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings()))
    out = found.transmitter_status > TransmitterStatus.NOT_RECEIVED
    np.testing.assert_array_equal(np.flatnonzero(out.all(axis=0)), [1, 7])
    assert out.sum() == 2 * len(z)
    assert np.isfinite(found.protection_level_rad).all()


def test_a_transmitters_own_error_is_harmless_between_receivers():
    known, _ = KNOWN["between receivers"]
    z = measure(6, calibration=np.inf)
    before = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings(known, np.inf)))
    z[..., 3] += 0.8
    after = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings(known, np.inf)))
    np.testing.assert_array_equal(after.status, before.status)
    np.testing.assert_allclose(after.poses.normal_enu, before.poses.normal_enu, atol=1e-7)
    np.testing.assert_allclose(after.protection_level_rad, before.protection_level_rad, rtol=1e-6)


@pytest.mark.parametrize("off_m", [0.1, 1.0])
def test_a_pivot_that_is_off_is_rejected_not_averaged(off_m):
    survey = PIVOT.copy()
    survey[1, 0] += off_m
    known = MirrorKnowledge(clock_sigma_m=0.0, pivot_enu_m=survey, pivot_sigma_m=5e-3)
    z = measure(7)
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings(known)))
    assert found.status[1] == IntegrityStatus.PRIOR_REJECTED
    np.testing.assert_array_equal(found.prior_rejected, [[False] * 3, [True, False, False], [False] * 3, [False] * 3])
    assert "pivot" in found.reasons()[1]
    assert np.all(found.transmitter_status == TransmitterStatus.OK)
    without = solve_rigid(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings()))
    np.testing.assert_allclose(found.poses.normal_enu[1], without.normal_enu[1], atol=1e-7)
    np.testing.assert_allclose(found.poses.pivot_enu_m[1], PIVOT[1], atol=0.05)


@pytest.mark.parametrize("prior", ["mount", "clocks"])
def test_a_wrong_mount_or_clock_is_rejected(prior):
    z = measure(8)
    if prior == "clocks":
        z[2, 0, 1] += 0.3  # a nanosecond of cable
        known = MirrorKnowledge(clock_sigma_m=0.0)
    else:
        tilted = ROT[2] @ np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]])
        receiver = PIVOT[2] + PLACES @ tilted.T
        z[2, 0] += np.linalg.norm(receiver[:, None] - TRANSMITTER, axis=-1)
        z[2, 0] -= np.linalg.norm((PIVOT[2] + PLACES @ ROT[2].T)[:, None] - TRANSMITTER, axis=-1)
        known = MirrorKnowledge(clock_sigma_m=0.0, two_axis=True)
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings(known)))
    which = ("pivot", "mount", "clocks").index(prior)
    np.testing.assert_array_equal(np.argwhere(found.prior_rejected), [[2, which]])
    assert found.status[2] == IntegrityStatus.PRIOR_REJECTED
    assert found.transmitter_status.max() == TransmitterStatus.OK


def test_without_redundancy_it_says_so():
    """Three transmitters between receivers: one error cannot be seen, so nothing is protected."""
    known, _ = KNOWN["between receivers"]
    known = replace(known, clock_sigma_m=np.inf)
    z = measure(9, calibration=np.inf)[..., [0, 2, 5]]
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER[[0, 2, 5]], PLACES, z, **settings(known, np.inf)))
    assert np.all(found.poses.status == PoseStatus.OK)
    assert np.all(np.isinf(found.protection_level_rad))
    assert np.all(found.status == IntegrityStatus.NO_REDUNDANCY)
    assert not found.ok.any()


def test_too_many_errors_are_not_explained_away():
    z = measure(10)
    z[0, 0] += 0.1 * np.random.default_rng(0).standard_normal((3, 10))
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings()))
    assert found.status[0] == IntegrityStatus.UNEXPLAINED
    assert np.isinf(found.protection_level_rad[0])
    assert np.all(found.status[1:] == IntegrityStatus.OK)


def test_only_testing_leaves_the_pose_alone():
    z = measure(11)
    z[..., 4] += 0.05
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings()), Alarms(max_excluded=0))
    np.testing.assert_array_equal(
        found.poses.normal_enu, solve_rigid(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings())).normal_enu
    )
    assert np.all(found.status == IntegrityStatus.UNEXPLAINED)


def test_bad_rows_leave_the_others_alone():
    z = measure(12)
    good = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **settings()))
    z[0] = np.nan
    z[2, :, :, 3] = np.nan
    keys = settings()
    keys["start_pivot_enu_m"] = keys["start_pivot_enu_m"].copy()
    keys["start_pivot_enu_m"][1] = np.nan
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **keys))
    np.testing.assert_array_equal(found.status, [6, 6, 0, 0])
    assert np.isnan(found.poses.normal_enu[:2]).all()
    assert np.isinf(found.protection_level_rad[:2]).all()
    assert found.transmitter_status[2, 3] == TransmitterStatus.NOT_RECEIVED
    np.testing.assert_array_equal(found.poses.normal_enu[3], good.poses.normal_enu[3])


@pytest.mark.parametrize("wrong", [{"false_alarm": 0.0}, {"missed_detection": 1.0}, {"max_excluded": -1}])
def test_settings_are_checked(wrong):
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        Alarms(**wrong)


def test_log_probability_far_out():
    """exp(−x/2) for two degrees of freedom; the recurrence Q(k+2) = Q(k) + term for four."""
    x = np.array([1.0, 30.0, 700.0, 1e4, 1e8])
    np.testing.assert_allclose(log_probability(x, np.full(5, 2)), -x / 2, rtol=1e-9)
    np.testing.assert_allclose(log_probability(x, np.full(5, 4)), -x / 2 + np.log1p(x / 2), rtol=1e-6)
    np.testing.assert_array_equal(log_probability(x, np.zeros(5, np.int64)), 0.0)


def test_noncentrality_is_missed_as_often_as_stated():
    rng = np.random.default_rng(14)
    found = noncentrality(np.array([20.0]), np.array([3]), 0.05)[0]
    x = rng.standard_normal((200_000, 3))
    x[:, 0] += np.sqrt(found)
    missed = np.mean(np.sum(x**2, axis=1) < 20.0)
    assert missed == pytest.approx(0.05, abs=5 * np.sqrt(0.05 * 0.95 / 200_000))


def test_a_receiver_that_hears_nothing_brings_no_clock():
    """What is counted against chi² in the test of all residuals is what the solver itself counts."""
    z = measure(14, n_group=2)
    z[:, :, 2] = np.nan
    mirrors = MirrorProblem.of(
        TRANSMITTER, PLACES, z, **settings(MirrorKnowledge(pivot_enu_m=PIVOT, pivot_sigma_m=5e-3), n_group=2)
    )
    poses = solve_rigid(mirrors)
    # two receivers' ranges by ten transmitters in two wavelengths and a pivot, less pose and two clocks
    np.testing.assert_array_equal(poses.dof, 2 * z.shape[3] * 2 + 3 - 6 - 2)
    # what the solver determines its tests judge: as if the receiver were not there
    found = solve_with_integrity(mirrors)
    assert np.all(found.status == IntegrityStatus.OK)
    assert found.ok.all()
    assert np.all(judge(mirrors, poses).ok)


def test_a_wavelength_that_is_not_resolved_brings_no_clock():
    z = measure(15, n_group=2)
    keys = {**settings(n_group=2), "clock_class": [0, 1]}
    z[:, 1] = np.nan
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **keys))
    alone = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z[:, :1], **settings()))
    np.testing.assert_array_equal(found.status, alone.status)
    np.testing.assert_allclose(found.protection_level_rad, alone.protection_level_rad, rtol=1e-6)
