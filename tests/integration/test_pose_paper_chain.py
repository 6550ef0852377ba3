"""Two rows of the paper's table of normals, IQ simulated through the whole chain."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks" / "pose_chain.py"
N_FRAME = 80
# rms angle [mrad] of three fits, rigid with three clocks, rigid with one (Swart et al. §4.5; independent code)
EXPECTED = {"three fits": (2.65, 2.79), "rigid, three clocks": (2.60, 2.22), "rigid, one clock": (0.49, 0.51)}


def test_two_rows_from_iq_are_at_the_bound():
    spec = importlib.util.spec_from_file_location("pose_chain", BENCHMARK)
    chain = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(chain)
    found = chain.measure((chain.ROWS[0], chain.ROWS[2]), N_FRAME)
    for name, evaluation in found.items():
        assert evaluation.failed == 0
        for row, expected in zip(evaluation.heliostats, EXPECTED[name], strict=True):
            # the table is without calibration noise; four receivers here leave a quarter of the variance
            assert expected - 0.006 < row.bound_mrad < expected * np.sqrt(1.25) + 0.006
            # rms of pairs of unequal angles: at most 1/√(2 n)
            assert row.normal_error_mrad.rms / row.bound_mrad == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * N_FRAME))
            assert row.sigma_mrad == pytest.approx(row.bound_mrad, rel=0.05)
    assert found["rigid, one clock"].heliostats[0].normal_error_mrad.rms < 0.55
