"""Kernel of the gusts."""

from __future__ import annotations

from rfpose.jit import kernel_lean


@kernel_lean
def filter_gusts(state, keep, kick, n_plain, slow, gust):
    """Gusts [m/s] in place of random numbers of variance one (mirror, step), state (mirror, process + 1) in place.

    First-order processes; the first ``n_plain`` as they are, the others less their own slow part, whose state is last
    and follows them by ``slow`` a step. ``kick`` is what a random number adds to each in the end.
    """
    n = keep.shape[0]
    # the slow part has some of its kick from those that it follows
    rest = kick[n]
    for i in range(n_plain, n):
        rest -= slow * kick[i]
    for h in range(state.shape[0]):
        for t in range(gust.shape[1]):
            noise = gust[h, t]
            plain = 0.0
            quick = 0.0
            for i in range(n):
                state[h, i] = keep[i] * state[h, i] + kick[i] * noise
                if i < n_plain:
                    plain += state[h, i]
                else:
                    quick += state[h, i]
            state[h, n] += slow * (quick - state[h, n]) + rest * noise
            gust[h, t] = plain + quick - state[h, n]
