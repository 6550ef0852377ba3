"""Maps agree with the bounds of the solvers; gradients agree with differences."""

import numpy as np
import pytest

from rfpose.layout import maps
from rfpose.layout.maps import ESTIMATORS, dilution, mirrors_facing, normal_map
from rfpose.layout.optimise import CRITERIA
from rfpose.layout.optimise.problem import variances_of
from rfpose.measurement import Estimator, Noise
from rfpose.multilat import dop, normal_bound, position_bound
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, rigid_bound, tilt_sigma_rad
from sites import TABLE_2

TRANSMITTER = 100.0 * TABLE_2
PLACES = np.array([[0.9988, 0.0, 0.0], [-0.4994, 0.865, 0.0], [-0.4994, -0.865, 0.02]])
N = 40


@pytest.fixture(scope="module")
def mirrors():
    point = maps.disc_points(N, radius_m=100.0, height_m=2.0)
    return mirrors_facing(point, PLACES, aim_enu_m=[0.0, 0.0, 50.0], sun_enu=[0.3, -0.5, 0.7], arm_m=0.3)


def noise(calibration, n_tone=1, carrier=None):
    own = np.linspace(1e-3, 2e-3, n_tone * 10).reshape(n_tone, 10)
    return Noise(
        tone_sigma_m=own,
        calibration_sigma_m=np.full_like(own, calibration),
        carrier_sigma_m=None if carrier is None else np.full(10, carrier),
    )


def test_dilution_is_that_of_the_solver(mirrors):
    found = dilution(TRANSMITTER, mirrors.pivot_enu_m)
    cov = position_bound(TRANSMITTER, mirrors.pivot_enu_m, 1.0)
    np.testing.assert_allclose(found.position, dop(TRANSMITTER, mirrors.pivot_enu_m), rtol=1e-12)
    np.testing.assert_allclose(found.vertical, np.sqrt(cov[:, 2, 2]), rtol=1e-12)
    np.testing.assert_allclose(found.horizontal, np.sqrt(cov[:, 0, 0] + cov[:, 1, 1]), rtol=1e-12)


def test_planar_dilution_is_that_of_the_solver():
    circle = np.stack([np.cos(np.arange(5)), np.sin(np.arange(5))], axis=1)
    point = np.array([[0.1, 0.2], [0.7, -0.3], [1.5, 0.0]])
    np.testing.assert_allclose(dilution(circle, point).position, dop(circle, point), rtol=1e-12)


@pytest.mark.parametrize("calibration", [0.0, 5e-4])
def test_independent_bound(mirrors, calibration):
    plan = noise(calibration)
    want = normal_bound(
        TRANSMITTER, mirrors.receiver_enu_m, plan.tone_sigma_m[0], calibration, receiver_mirror_m=PLACES
    )
    got = normal_map(TRANSMITTER, mirrors, plan, ESTIMATORS["independent"])
    np.testing.assert_allclose(got, want.sigma_rad, rtol=1e-10)


@pytest.mark.parametrize("calibration", [0.0, 5e-4])
@pytest.mark.parametrize("n_tone", [1, 2])
@pytest.mark.parametrize(
    ("estimator", "known"),
    [
        (ESTIMATORS["rigid"], {}),
        (ESTIMATORS["shared-clock"], {"clock_sigma_m": 0.0}),
        (ESTIMATORS["carrier"], {"clock_sigma_m": 0.0}),
        (ESTIMATORS["delays"], {}),
        (ESTIMATORS["pivot"], {"clock_sigma_m": 0.0, "pivot_sigma_m": 0.005}),
        (
            Estimator(name="tied", clock_sigma_m=2e-3, two_axis=True, roll_sigma_rad=1e-3),
            {"clock_sigma_m": 2e-3, "two_axis": True, "roll_sigma_rad": 1e-3},
        ),
    ],
    ids=lambda value: value.name if isinstance(value, Estimator) else "",
)
def test_rigid_bound(mirrors, estimator, known, n_tone, calibration):
    plan = noise(calibration, n_tone, carrier=1e-4)
    sigma = np.repeat(plan.tone_sigma_m[:, None], 3, axis=1)
    common = plan.calibration_sigma_m
    if estimator.carrier:
        sigma = np.concatenate([sigma, np.full((1, 3, 10), 1e-4)])
        common = np.concatenate([common, np.full((1, 10), np.inf)])
    cov = rigid_bound(
        MirrorProblem.expected(
            TRANSMITTER,
            mirrors.receiver_mirror_m,
            mirrors.pivot_enu_m,
            mirrors.rot_enu_from_mirror,
            sigma_m=np.repeat(sigma[None], N, axis=0),
            transmitter_sigma_m=common,
            clock_class=np.arange(len(sigma)),
            knowledge=MirrorKnowledge(pivot_enu_m=mirrors.pivot_enu_m, **known),
        )
    )
    got = normal_map(TRANSMITTER, mirrors, plan, estimator)
    # the solver ties a shared clock's receivers with a large finite weight
    np.testing.assert_allclose(got, tilt_sigma_rad(cov, mirrors.normal_enu), rtol=2e-5)


@pytest.mark.parametrize("name", ["independent", "rigid", "shared-clock", "carrier"])
def test_hidden_transmitter_is_a_missing_one(mirrors, name):
    plan = noise(5e-4, carrier=1e-4)
    seen = np.ones((N, 3, 10), bool)
    seen[:, :, 4] = False
    got = normal_map(TRANSMITTER, mirrors, plan, ESTIMATORS[name], visible=seen)
    lost = maps.normal_without_each(TRANSMITTER, mirrors, plan, ESTIMATORS[name])[4]
    np.testing.assert_allclose(got, lost, rtol=1e-9)
    assert (got > normal_map(TRANSMITTER, mirrors, plan, ESTIMATORS[name])).all()


@pytest.mark.parametrize("name", ["independent", "rigid", "shared-clock"])
def test_free_space_loss_is_a_noise_that_grows_with_range(mirrors, name):
    one = mirrors_facing(mirrors.pivot_enu_m[:1], PLACES * 1e-6, normal_enu=[0.0, 0.0, 1.0])
    plan = noise(0.0)
    distance = np.linalg.norm(one.pivot_enu_m - TRANSMITTER, axis=1)
    far = Noise(tone_sigma_m=plan.tone_sigma_m, calibration_sigma_m=plan.calibration_sigma_m, reference_range_m=70.0)
    same = Noise(tone_sigma_m=plan.tone_sigma_m * distance / 70.0, calibration_sigma_m=plan.calibration_sigma_m)
    got = normal_map(TRANSMITTER, one, far, ESTIMATORS[name])
    np.testing.assert_allclose(got, normal_map(TRANSMITTER, one, same, ESTIMATORS[name]), rtol=1e-5)


def test_mirror_that_sees_too_little_is_nan(mirrors):
    seen = np.ones((N, 3, 10), bool)
    seen[3, 0, 1:7] = False
    got = normal_map(TRANSMITTER, mirrors, noise(0.0), ESTIMATORS["independent"], visible=seen)
    assert np.flatnonzero(np.isnan(got)).tolist() == [3]


@pytest.mark.parametrize("criterion", CRITERIA)
def test_gradient_is_the_difference(mirrors, criterion):
    slope = variances_of(TRANSMITTER[None], mirrors, criterion, 1e-3)[1][0]
    step = np.array([2.0, -1.0, 3.0]) * 1e-4
    ahead, behind = TRANSMITTER.copy(), TRANSMITTER.copy()
    ahead[6] += step
    behind[6] -= step
    variance, _ = variances_of(np.stack([ahead, behind]), mirrors, criterion, 1e-3)
    change = 0.5 * (variance[0] - variance[1])
    np.testing.assert_allclose(slope[:, 6] @ step, change, rtol=1e-4, atol=1e-7 * np.abs(change).max())


@pytest.mark.parametrize(
    ("criterion", "estimator"), [("independent", "independent"), ("rigid", "rigid"), ("shared-clock", "shared-clock")]
)
def test_what_is_optimised_is_what_is_mapped(mirrors, criterion, estimator):
    variance = variances_of(TRANSMITTER[None], mirrors, criterion, 1e-3)[0][0]
    got = normal_map(TRANSMITTER, mirrors, Noise.uniform(10, 1e-3), ESTIMATORS[estimator])
    np.testing.assert_allclose(np.sqrt(variance), got, rtol=1e-9)
