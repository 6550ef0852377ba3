"""Derivatives against finite differences; the arrow's covariance against one large matrix."""

from dataclasses import replace

import numpy as np
import pytest

from rfpose.multilat.equations import rotate
from rfpose.multilat.ground import Reflector, Surface, _problem, model
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, Observation

SPEED = 299_792_458.0
TRANSMITTER = np.array([[100.0, 0, 20], [50, 86.6, 30], [-50, 86.6, 20], [-100, 0, 30], [0, -50, 40.0], [0, 0, 50]])
PLACES = np.array([[1.0, 0.0, 0.0], [-0.5, 0.86, 0.0], [-0.5, -0.86, 0.1]])
CARRIER_RF_HZ = 100e6 + 2e6 * np.arange(6)
TONE_HZ = np.array([0.75e6, 7.5e6, 0.0])
PLANES = {
    "ground": [Reflector()],
    "ground and wall": [Reflector(normal_enu=(0.02, 0, 1)), Reflector(normal_enu=(-1, 0, 0), point_enu_m=(150, 0, 0))],
    "fresnel": [Reflector(surface=Surface(permittivity=6.0, conductivity_s_per_m=0.01), scaled=True)],
    "fresnel across": [Reflector(surface=Surface(permittivity=6.0, polarisation="horizontal"), scaled=True)],
}


def make_problem(planes, *, calibration=None, n_mirror=2):
    rng = np.random.default_rng(3)
    scene = model.build_scene(
        TRANSMITTER,
        planes,
        carrier_rf_hz=CARRIER_RF_HZ,
        tone_hz=TONE_HZ,
        free_space=True,
        propagation_speed_mps=SPEED,
    )
    shape = (n_mirror, 3, len(TRANSMITTER))
    observations = [
        Observation(
            range_m=rng.uniform(50.0, 100.0, shape),
            sigma_m=np.full(shape, sigma),
            transmitter_sigma_m=np.full((n_mirror, len(TRANSMITTER)), np.inf),
            wavelength_m=np.full(len(TRANSMITTER), 40.0),
            clock_class=k,
            carrier=k == 1,
        )
        for sigma, k in ((5e-3, 0), (5e-4, 0), (2e-4, 1))
    ]
    pivot = rng.uniform(-40.0, 40.0, (n_mirror, 3))
    pivot[:, 2] = 3.0
    rot = np.array([np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(n_mirror)])
    rot *= np.linalg.det(rot)[:, None, None]
    known = MirrorKnowledge(clock_sigma_m=np.inf, pivot_enu_m=pivot, pivot_sigma_m=5e-3)
    mirrors = MirrorProblem.of_observations(
        TRANSMITTER, PLACES, observations, start_pivot_enu_m=pivot, start_rot_enu_from_mirror=rot, knowledge=known
    )
    problem = _problem.build(scene, mirrors, calibration=np.empty((0, 3)) if calibration is None else calibration)
    state = problem.begin(pivot, rot, np.zeros(n_mirror, np.int64))
    return problem, state


def turned(state, m, axis, step):
    out = state.copy()
    if axis < 3:
        out.pivot[m, axis] += step
    else:
        theta = np.zeros(3)
        theta[axis - 3] = step
        rot = np.empty((3, 3))
        rotate(theta, state.rot[m], rot)
        out.rot[m] = rot
    return out


@pytest.mark.parametrize("planes", PLANES.values(), ids=PLANES.keys())
@pytest.mark.parametrize("calibrated", [False, True])
def test_derivatives_are_those_of_the_ranges(planes, calibrated):
    calibration = np.array([[15.0, -20.0, 2.5], [-30.0, 5.0, 3.0]]) if calibrated else None
    problem, state = make_problem(planes, calibration=calibration)
    parameter = np.array([0.3, -0.2, -0.15, 0.1])[: problem.n_parameter]
    _, slope = problem.predict(state, parameter)
    step = 1e-6
    for axis in range(6):
        up, _ = problem.predict(turned(state, 1, axis, step), parameter)
        down, _ = problem.predict(turned(state, 1, axis, -step), parameter)
        np.testing.assert_allclose(slope[1, ..., axis], ((up - down) / (2 * step))[1], atol=2e-6)
    for c in range(problem.n_parameter):
        change = np.zeros(problem.n_parameter)
        change[c] = step
        up, _ = problem.predict(state, parameter + change)
        down, _ = problem.predict(state, parameter - change)
        np.testing.assert_allclose(slope[..., 6 + c], (up - down) / (2 * step), atol=2e-6)


def test_covariance_with_estimated_coefficient_is_that_of_one_large_matrix():
    problem, state = make_problem(PLANES["ground"])
    parameter = np.array([-0.3, 0.1])
    predicted, slope = problem.predict(state, parameter)
    # measurements that fit exactly, so that the fit stays where it is
    state.clock[:] = 0.0
    prior = problem.mirrors.prior._replace(clock=np.zeros_like(state.clock))
    mirrors = problem.mirrors._replace(z=predicted + 0.7, prior=prior)
    problem = replace(problem, mirrors=mirrors)
    problem.fit(state, parameter)
    assert (state.status == 0).all()
    assert np.all(state.chi2 < 1e-6)
    reflection = np.linalg.inv(state.schur.sum(axis=0))
    follow = state.follow[:, :6]
    stated = state.cov[:, :6, :6] + follow @ reflection @ np.swapaxes(follow, 1, 2)

    n_mirror, n_group, n_receiver, n_transmitter = predicted.shape
    own = 6 + 2 * n_receiver + n_group * n_transmitter
    size = n_mirror * own + 2
    info = np.zeros((size, size))
    for m in range(n_mirror):
        for g in range(n_group):
            for r in range(n_receiver):
                for i in range(n_transmitter):
                    row = np.zeros(size)
                    row[m * own : m * own + 6] = slope[m, g, r, i, :6]
                    row[m * own + 6 + (g == 2) * n_receiver + r] = 1.0
                    row[m * own + 6 + 2 * n_receiver + g * n_transmitter + i] = 1.0
                    row[-2:] = slope[m, g, r, i, 6:]
                    info += problem.mirrors.weight[m, g, r, i] * np.outer(row, row)
        pivot = slice(m * own, m * own + 3)
        info[pivot, pivot] += np.eye(3) / 5e-3**2
        for first in (m * own + 6, m * own + 6 + n_receiver):
            # the transmitters' own errors hold a common clock as well
            info[first, first] += 1e6
    large = np.linalg.pinv(info, rcond=1e-14, hermitian=True)
    for m in range(n_mirror):
        block = large[m * own : m * own + 6, m * own : m * own + 6]
        scale = np.sqrt(np.outer(np.diag(block), np.diag(block)))
        np.testing.assert_allclose(stated[m] / scale, block / scale, atol=1e-5)
    np.testing.assert_allclose(reflection, large[-2:, -2:], rtol=1e-5)
