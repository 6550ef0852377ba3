"""The shipped pattern against responses by NEC that this project did not write."""

from pathlib import Path

import numpy as np
import pytest

from rfpose.pipeline.formats.antenna_file import read_pattern

ROOT = Path(__file__).resolve().parents[2]
RESPONSES = ROOT.parent / "shared" / "data" / "traced" / "nec" / "front_y_433MHz.npz"

pytestmark = pytest.mark.skipif(not RESPONSES.exists(), reason="no traced responses in shared data (traced is absent)")


def test_the_shipped_pattern_is_what_was_computed_ray_by_ray():
    with np.load(RESPONSES) as file:
        at = int(np.argmin(np.abs(file["freqs"] - 433.0)))
        direction, response = file["direction"], file["response"][at]
    pattern = read_pattern(ROOT / "data" / "antenna_front_433MHz.h5").pattern
    receiver = np.broadcast_to(np.arange(pattern.n_receiver)[:, None, None], direction.shape[:-1])
    towards = direction.reshape(-1, 3)
    vector, _, sigma = pattern.table(433e6).vector_and_slope(towards, receiver.ravel())
    flat = np.hypot(towards[:, 0], towards[:, 1])
    cos_a, sin_a = towards[:, 0] / flat, towards[:, 1] / flat
    theta = np.stack([towards[:, 2] * cos_a, towards[:, 2] * sin_a, -flat], axis=1)
    phi = np.stack([-sin_a, cos_a, np.zeros_like(flat)], axis=1)
    found = np.stack([np.sum(vector * theta, axis=1), np.sum(vector * phi, axis=1)], axis=1)
    theirs = response.reshape(-1, 2)
    factor = np.vdot(theirs, found) / np.vdot(theirs, theirs)
    # the same mesh: what is left is a table of 6 degrees and single precision
    np.testing.assert_allclose(found, factor * theirs, atol=2e-4)
    assert 0.001 < np.median(sigma) < 0.03
