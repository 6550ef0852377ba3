"""Frequencies, clocks and the common grid."""

import numpy as np
import pytest

from rfpose.dsp import LinePlan
from rfpose.dsp.bank import LineBank
from rfpose.dsp.bounds import phase_bound_rad
from rfpose.errors import InvalidInputError


def make(carrier, tone, rate=40e6, **kw):
    return LinePlan.create(carrier, tone, sample_rate_hz=rate, centre_frequency_hz=100e6, **kw)


def test_grid_is_the_shortest_common_repeat():
    assert make([-18e6, 2e6], [750e3]).grid == 160
    assert make([0.0, 4e6], [1e6]).grid == 40
    assert make([0.0, 4e6 + 17.0], [1e6]).grid is None


def test_lines_repeat_after_the_grid():
    plan = make([-18e6, 2e6], [750e3])
    turns = plan.line_cycles(0.0) * plan.grid
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)


def test_clock_moves_every_line_by_its_rf():
    plan = make([-18e6, 2e6], [750e3])
    k = 1 + 20e-6
    rf = 100e6 + plan.line_hz
    np.testing.assert_allclose(plan.line_cycles(20.0), (rf - 100e6 * k) / (40e6 * k), rtol=1e-9)
    slope = (plan.line_cycles(1e-3) - plan.line_cycles(-1e-3)) / 2e-3
    np.testing.assert_allclose(slope, plan.cycles_per_ppm(), rtol=1e-4)


@pytest.mark.parametrize("windowed", [False, True])
@pytest.mark.parametrize("n_sample", [64, 100, 4096, 5000, 400_000])
@pytest.mark.parametrize("carrier", [[-18e6, 2e6], [-18e6 + 17.0, 2e6]])
def test_blocks_lie_inside_the_frame(windowed, n_sample, carrier):
    bank = LineBank(make(carrier, [750e3]), n_sample, windowed=windowed)
    last = (bank.n_block - 1) * bank.hop + bank.n_tap
    assert bank.n_block >= 1
    assert last + bank.n_tail == n_sample if not windowed else last <= n_sample
    assert bank.n_tail < bank.hop


@pytest.mark.parametrize(
    ("carrier", "tone"), [([], [1e6]), ([0.0], []), ([0.0], [-1e6]), ([19.5e6], [750e3]), ([np.nan], [1e6])]
)
def test_impossible_plans_are_refused(carrier, tone):
    with pytest.raises(InvalidInputError):
        make(carrier, tone)


def test_phase_bound():
    assert phase_bound_rad(400_000, 1e4) == pytest.approx(1.5811e-5, rel=1e-4)  # verification data: table2_x100
    with pytest.raises(InvalidInputError):
        phase_bound_rad(1000, -3.0)
