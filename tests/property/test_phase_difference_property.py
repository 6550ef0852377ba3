"""Phase difference of real tones: what must hold whatever the signals are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfpose.dsp.phase_difference import correlator_phase_difference, dot_phase_difference, hilbert_phase_difference

METHODS = {
    "hilbert": hilbert_phase_difference,
    "correlator": lambda a, b: correlator_phase_difference(a, b, 0.1),
    "dot": dot_phase_difference,
}


@pytest.mark.parametrize("name", METHODS)
@given(
    phases=st.tuples(st.floats(-3.1, 3.1), st.floats(-3.1, 3.1)),
    gains=st.tuples(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6)),
    noise=st.floats(0.0, 0.5),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=30, deadline=None)
def test_gain_does_not_matter_and_swapping_turns_the_sign(name, phases, gains, noise, seed):
    method = METHODS[name]
    n = 200
    angle = 2 * np.pi * 0.1 * np.arange(n)
    s1, s2 = (np.cos(angle + p) for p in phases)
    s1, s2 = (s + noise * e for s, e in zip((s1, s2), np.random.default_rng(seed).standard_normal((2, n)), strict=True))
    plain = method(s1, s2)
    # through the cosine: its inverse magnifies rounding near 0 and π
    assert np.cos(method(gains[0] * s1, gains[1] * s2)) == pytest.approx(np.cos(plain), abs=1e-9)
    turned = plain if name == "dot" else -plain
    assert np.exp(1j * method(s2, s1)) == pytest.approx(np.exp(1j * turned), abs=1e-9)
    assert np.cos(method(s1, -s2)) == pytest.approx(-np.cos(plain), abs=1e-9)
