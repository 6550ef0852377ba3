"""One random number a step in place of several: the same covariance at every lag."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from rfpose.feedback.innovation import one_kick, steady_root
from rfpose.feedback.structure import StructureMode, swing_transition
from rfpose.feedback.wind import gust_process


def covariances(transition, noise_cov, seen, lags=200):
    """Covariance of what is seen of a steady process, by lag."""
    x = solve_discrete_lyapunov(transition, noise_cov) @ seen
    found = []
    for _ in range(lags):
        found.append(seen @ x)
        x = transition @ x
    return np.array(found)


def gusts_apart(process):
    """Transition, noise and row of a gust process whose parts are each excited by themselves."""
    n = len(process.time_s)
    keep = np.exp(-process.interval_s / process.time_s)
    slow = 1.0 - np.exp(-process.interval_s / process.slow_s)
    transition, excited = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n))
    for i in range(n):
        transition[i, i] = keep[i]
        excited[i, i] = np.sqrt(process.variance_m2ps2[i] * (1.0 - keep[i] ** 2))
        if i >= process.n_plain:
            transition[n, i], excited[n, i] = slow * keep[i], slow * excited[i, i]
    transition[n, n] = 1.0 - slow
    return transition, excited @ excited.T, np.append(np.ones(n), -1.0)


@pytest.mark.parametrize(
    ("hz", "damping", "interval"), [(2.2, 0.02, 1.0), (0.6, 0.1, 1.0), (5.0, 0.3, 0.25), (0.5, 1e-3, 0.01)]
)
def test_a_swing_excited_by_one_number_has_the_same_covariances(hz, damping, interval):
    transition, root = swing_transition(StructureMode(natural_hz=hz, damping=damping), interval_s=interval)
    seen = np.array([1.0, 0.0])
    kick = one_kick(transition, root @ root.T, seen)
    wanted = covariances(transition, root @ root.T, seen)
    assert wanted[0] == pytest.approx(1.0)
    np.testing.assert_allclose(covariances(transition, np.outer(kick, kick), seen), wanted, atol=1e-9)


# the last one's samples nearly repeat themselves: a solver by eigenvalues gives up there
@pytest.mark.parametrize(
    ("speed", "interval", "size"), [(4.0, 1.0, 2.0), (10.0, 0.25, 0.0), (0.5, 0.05, 1.0), (0.1, 5.0, 0.0)]
)
def test_gusts_excited_by_one_number_have_the_same_covariances(speed, interval, size):
    process = gust_process(speed, interval_s=interval, size_m=size)
    transition, noise, seen = gusts_apart(process)
    wanted = covariances(transition, noise, seen)
    found = covariances(transition, np.outer(process.kick_mps, process.kick_mps), seen)
    np.testing.assert_allclose(found, wanted, atol=1e-9 * wanted[0])
    # and they begin as they go on
    began = process.start_root_mps @ process.start_root_mps.T
    assert seen @ began @ seen == pytest.approx(wanted[0], rel=1e-9)
    np.testing.assert_allclose(
        transition @ began @ transition.T + np.outer(process.kick_mps, process.kick_mps), began, atol=1e-9 * began.max()
    )


def test_gusts_are_drawn_by_that_kick():
    process = gust_process(4.0, interval_s=1.0, size_m=2.0)
    transition, _, seen = gusts_apart(process)
    state = process.start(np.random.default_rng(1), 3)
    foreseen, noise = state.copy(), np.random.default_rng(2).standard_normal((3, 50))
    found = process.run(state, np.random.default_rng(2), 50)
    for t in range(50):
        foreseen = foreseen @ transition.T + noise[:, t, None] * process.kick_mps
        np.testing.assert_allclose(found[:, t], foreseen @ seen, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(state, foreseen, rtol=1e-9, atol=1e-12)


def test_what_nothing_excites_stays():
    assert not one_kick(np.diag([0.5, 0.9]), np.zeros((2, 2)), np.ones(2)).any()
    assert not steady_root(np.diag([0.5, 0.9]), np.zeros(2)).any()
    assert not gust_process(0.0).kick_mps.any()


def test_a_single_process_is_kicked_as_it_is():
    assert one_kick(np.array([[0.8]]), np.array([[0.25]]), np.array([2.0])) == pytest.approx(0.5)
