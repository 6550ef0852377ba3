"""The estimator's gain: its squares are the maps, and single errors move the solvers' normals as it says."""

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.layout import maps
from rfpose.layout.gain import ReflectionBend, gain_of, normal_gain
from rfpose.layout.maps import ESTIMATORS, mirrors_facing, normal_map
from rfpose.layout.sensitivity import transmitter_sensitivity
from rfpose.measurement import Estimator, Noise
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, solve_rigid

TRANSMITTER = 100.0 * np.array(
    [
        [1.0, 0.0, 0.2], [0.5, 0.866, 0.3], [-0.5, 0.866, 0.2], [-1.0, 0.0, 0.3], [-0.5, -0.866, 0.2],
        [0.5, -0.866, 0.3], [0.433, 0.25, 0.4], [-0.433, 0.25, 0.4], [0.0, -0.5, 0.4], [0.0, 0.0, 0.5],
    ]
)  # fmt: skip
PLACES = np.array([[0.9988, 0.0, 0.0], [-0.4994, 0.865, 0.0], [-0.4994, -0.865, 0.0]])
TIED = Estimator(name="tied", clock_sigma_m=2e-3, pivot_sigma_m=0.005, carrier=True)


@pytest.fixture(scope="module")
def mirrors():
    point = maps.disc_points(300, radius_m=100.0, height_m=2.0)
    return mirrors_facing(point, PLACES, aim_enu_m=[0.0, 0.0, 50.0], sun_enu=[0.3, -0.5, 0.7], arm_m=0.3)


def noise(calibration, range_m=None):
    own = np.linspace(1e-3, 2e-3, 20).reshape(2, 10)
    return Noise(
        tone_sigma_m=own,
        calibration_sigma_m=np.full_like(own, calibration),
        carrier_sigma_m=np.full(10, 1e-4),
        reference_range_m=range_m,
    )


@pytest.mark.parametrize("range_m", [None, 70.0])
@pytest.mark.parametrize("calibration", [0.0, 5e-4])
@pytest.mark.parametrize("estimator", [*ESTIMATORS.values(), TIED], ids=lambda e: e.name)
def test_squares_of_the_gain_are_the_map(mirrors, estimator, calibration, range_m):
    plan = noise(calibration, range_m)
    slope = gain_of(TRANSMITTER, mirrors, plan, estimator)
    own, common = plan.tone_sigma_m, plan.calibration_sigma_m
    if estimator.carrier:
        own = np.vstack([own, plan.carrier_sigma_m])
        common = np.vstack([common, np.zeros(10)])
    sigma = own[:, None]
    if range_m is not None:
        distance = np.linalg.norm(mirrors.receiver_enu_m[:, :, None] - TRANSMITTER, axis=-1)
        sigma = own[:, None] * distance[:, None] / range_m
    variance = np.einsum("mkgrt,mgrt->m", slope.range_slope**2, np.broadcast_to(sigma, (300, len(own), 3, 10)) ** 2)
    variance += np.einsum("mkgt,gt->m", slope.range_slope.sum(axis=3) ** 2, common**2)
    if np.isfinite(estimator.pivot_sigma_m):
        variance += (slope.pivot_slope**2).sum(axis=(1, 2)) * estimator.pivot_sigma_m**2
    if estimator.clock_sigma_m > 0.0 and np.isfinite(estimator.clock_sigma_m):
        for g in range(len(own)):
            by_clock = slope.range_slope[:, :, g].sum(axis=3)
            variance += (by_clock**2).sum(axis=(1, 2)) * estimator.clock_sigma_m**2
    np.testing.assert_allclose(np.sqrt(variance), normal_map(TRANSMITTER, mirrors, plan, estimator), rtol=1e-10)
    np.testing.assert_allclose(np.trace(slope.cov, axis1=1, axis2=2), variance, rtol=1e-10)


def solved(mirrors, transmitter, ranges, estimator):
    """Normals that the solver finds when it believes in the places of ``transmitter``."""
    return solve_rigid(
        MirrorProblem.of(
            transmitter,
            mirrors.receiver_mirror_m,
            ranges,
            sigma_m=noise(0.0).tone_sigma_m[:1, None],
            transmitter_sigma_m=0.0,
            clock_class=[0],
            start_pivot_enu_m=mirrors.pivot_enu_m,
            start_rot_enu_from_mirror=mirrors.rot_enu_from_mirror,
            knowledge=MirrorKnowledge(clock_sigma_m=estimator.clock_sigma_m),
        )
    ).normal_enu


@pytest.mark.parametrize("name", ["rigid", "shared-clock"])
def test_a_wrong_survey_does_what_is_said(mirrors, name):
    plan = Noise(tone_sigma_m=noise(0.0).tone_sigma_m[:1], calibration_sigma_m=np.zeros((1, 10)))
    ranges = np.linalg.norm(mirrors.receiver_enu_m[:, :, None] - TRANSMITTER, axis=-1)[:, None]
    there = np.array([[15.0, -20.0, 2.5]])
    for calibration in (None, there):
        found = transmitter_sensitivity(TRANSMITTER, mirrors, plan, ESTIMATORS[name], calibration_enu_m=calibration)
        for transmitter, axis in ((0, 0), (8, 2)):
            step = 1e-4
            believed = TRANSMITTER.copy()
            believed[transmitter, axis] += step
            measured = ranges.copy()
            if calibration is not None:
                # the phase was calibrated with the range to where the transmitter is believed to be
                wrong = np.linalg.norm(there - believed, axis=1) - np.linalg.norm(there - TRANSMITTER, axis=1)
                measured = measured + wrong
            error = solved(mirrors, believed, measured, ESTIMATORS[name]) - mirrors.normal_enu
            rms = np.sqrt(np.mean((error**2).sum(axis=1))) / step
            assert found.survey_rad_per_m[transmitter, axis] == pytest.approx(rms, rel=2e-3)


def test_loss_and_move_are_those_of_the_map(mirrors):
    plan = noise(5e-4)
    found = transmitter_sensitivity(TRANSMITTER, mirrors, plan, ESTIMATORS["carrier"])
    whole = np.sqrt(np.mean(normal_map(TRANSMITTER, mirrors, plan, ESTIMATORS["carrier"]) ** 2))
    assert found.normal_rad == pytest.approx(whole)
    assert (found.lost_rad > whole).all()
    moved = TRANSMITTER + np.outer(np.arange(10) == 3, [0.0, 0.0, 1.0])
    after = np.sqrt(np.mean(normal_map(moved, mirrors, plan, ESTIMATORS["carrier"]) ** 2))
    assert found.move_rad_per_m[3, 2] == pytest.approx(after - whole, rel=0.1)


def test_single_receivers_know_no_reflection(mirrors):
    none = ReflectionBend(
        place_slope=np.zeros((300, 1, 3, 10, 3)),
        shared_slope=np.zeros((300, 1, 3, 10, 0)),
        survey_slope=np.zeros((1, 10, 0)),
    )
    with pytest.raises(InvalidInputError, match="rigid"):
        normal_gain(
            TRANSMITTER, mirrors, np.ones((300, 1, 3, 10)), np.zeros((1, 10)), [0], ESTIMATORS["independent"],
            reflection=none,
        )  # fmt: skip
