"""Kernel of the gusts."""

from __future__ import annotations

from rfpose.jit import kernel_lean


@kernel_lean
def filter_gusts(state, keep, kick, n_plain, slow, noise, out):
    """Gusts [m/s] (mirror, step) from ``noise`` (mirror, step, process), state (mirror, process + 1) in place.

    First-order processes; the first ``n_plain`` as they are, the others less their own slow part, whose state is last
    and follows them by ``slow`` a step.
    """
    n = keep.shape[0]
    for h in range(state.shape[0]):
        for t in range(noise.shape[1]):
            plain = 0.0
            quick = 0.0
            for i in range(n):
                state[h, i] = keep[i] * state[h, i] + kick[i] * noise[h, t, i]
                if i < n_plain:
                    plain += state[h, i]
                else:
                    quick += state[h, i]
            state[h, n] += slow * (quick - state[h, n])
            out[h, t] = plain + quick - state[h, n]
