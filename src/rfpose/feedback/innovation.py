"""A linear process of which one number is seen, excited by one random number a step in place of several."""

from __future__ import annotations

import numpy as np

from rfpose.checks import FloatArray

__all__ = ["one_kick", "steady_root"]

_DOUBLINGS = 64
"""Far beyond what any process takes to become steady: each doubles the number of steps since its beginning."""


def one_kick(transition: FloatArray, noise_cov: FloatArray, seen: FloatArray) -> FloatArray:
    """Return how one random number a step excites a process so that what is seen of it keeps its statistics.

    With ``x' = transition @ x + w``, w white of covariance ``noise_cov``, the Gaussian series ``seen @ x`` is told
    apart from none that has the same covariance at every lag. So does ``x' = transition @ x + kick * e``, e white of
    variance one: its state is what a steady Kalman filter knows from the series so far, and e what each sample brings
    that was not foreseen (the innovations form, [1]_ §9.1). What is added to x from outside is seen as before.

    Parameters
    ----------
    transition : (state, state)
        From one sample to the next; it must die out.
    noise_cov : (state, state)
        Of w.
    seen : (state,)
        Row by which the state is seen.

    Returns
    -------
    (state,)
        Zero where nothing excites the process.

    References
    ----------
    .. [1] Anderson, Moore, Optimal Filtering, 1979.
    .. [2] Chu, Fan, Lin, Wang, Structure-preserving algorithms for periodic discrete-time algebraic Riccati equations,
       2004: the doubling, which unlike a solver by eigenvalues copes with series that almost repeat themselves.
    """
    own = float(seen @ noise_cov @ seen)
    if own == 0.0:
        return np.zeros(len(seen))
    # a sample tells of the state before it through seen @ transition; what its own noise tells is taken out first
    shared, row, one = noise_cov @ seen, seen @ transition, np.eye(len(seen))
    a = (transition - np.outer(shared, row) / own).T
    g = np.outer(row, row) / own
    unknown = noise_cov - np.outer(shared, shared) / own
    for _ in range(_DOUBLINGS):
        both = np.linalg.inv(one + g @ unknown)
        more = a.T @ unknown @ both @ a
        left = a @ both
        a, g = left @ a, _symmetric(g + left @ g @ a.T)
        unknown = _symmetric(unknown + more)
        if np.max(np.abs(more)) <= 1e-15 * np.max(np.abs(unknown)):
            break
    foreseen = transition @ unknown @ transition.T + noise_cov
    return np.asarray(foreseen @ seen / np.sqrt(seen @ foreseen @ seen))


def steady_root(transition: FloatArray, kick: FloatArray) -> FloatArray:
    """Return a root (state, state) of the steady covariance of a process excited by one number a step."""
    from scipy.linalg import solve_discrete_lyapunov

    variance, direction = np.linalg.eigh(solve_discrete_lyapunov(transition, np.outer(kick, kick)))
    return np.asarray(direction * np.sqrt(np.maximum(variance, 0.0)))


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T))
