"""Choosing tones: what is promised holds in simulation, and what cannot be had is refused in words."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.special import erfcinv

from rfpose.cli._app import app
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.multilat import range_differences
from rfpose.multilat.tones import design_tones, ladder_risk, ladder_sigma_m

REACH = 120.0
SCENARIO = str(Path(__file__).parents[3] / "data" / "table2_100m.toml")


def design(**settings):
    return design_tones(**{"reach_m": REACH, "phase_sigma_rad": 2e-3, "range_sigma_m": 1e-3, **settings})


def test_the_set_reaches_what_was_asked_with_equal_steps():
    for n_tone, wanted in ((2, 2e-3), (3, 1e-4), (4, 1e-6)):
        found = design(range_sigma_m=wanted, success=0.99)
        assert len(found.frequency_hz) <= n_tone
        assert found.range_sigma_m == pytest.approx(wanted, rel=1e-6)
        assert found.wrong_risk <= 0.01
        assert np.all(np.diff(found.wavelength_m) < 0)
        assert found.wavelength_m[0] > 2 * REACH
        np.testing.assert_allclose(found.step_risk[1:], found.step_risk[1], rtol=1e-3, atol=1e-300)
        assert ladder_sigma_m(found.wavelength_m, found.phase_sigma_rad)[-1] == pytest.approx(found.range_sigma_m)


def test_stated_risk_is_the_rate_of_wrong_integers():
    """Two tones so far apart that 1 in 20 goes wrong: 40 000 differences, counted."""
    sigma, coarse = 0.02, 250.0
    x = erfcinv(0.05)
    fine = coarse * 4 * x * sigma / (2 * np.pi) * 1.002
    stated = ladder_risk([coarse, fine], sigma)[1]
    rng = np.random.default_rng(3)
    n = 40_000
    before = coarse * sigma / (2 * np.pi) * (rng.standard_normal(n) - rng.standard_normal(n))
    after = fine * sigma / (2 * np.pi) * (rng.standard_normal(n) - rng.standard_normal(n))
    wrong = np.mean(np.rint((before - after) / fine) != 0)
    assert wrong == pytest.approx(stated, abs=4 * np.sqrt(stated / n))
    assert ladder_risk([coarse, fine], sigma, n_difference=10)[1] == pytest.approx(1 - (1 - stated) ** 10)


def test_designed_tones_are_fixed_by_the_estimator():
    found = design(range_sigma_m=1e-3, success=1 - 1e-6, n_difference=7)
    rng = np.random.default_rng(4)
    transmitter = np.column_stack([55 * np.cos(np.arange(8)), 55 * np.sin(np.arange(8)), 10 + np.arange(8)])
    receiver = rng.uniform(-20, 20, (500, 3))
    distance = np.linalg.norm(receiver[:, None] - transmitter, axis=-1)
    phase = -2 * np.pi * distance[..., None] / found.wavelength_m
    phase = phase + found.phase_sigma_rad * rng.standard_normal(phase.shape)
    ranges = range_differences(phase, found.phase_sigma_rad, 0.0, 1e-9, found.wavelength_m, transmitter)
    assert np.all(ranges.status == 0)
    rows = np.arange(500)
    truth = distance - distance[rows, ranges.reference][:, None]
    error = (ranges.range_difference_m - truth)[np.arange(8) != ranges.reference[:, None]]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(np.sqrt(2) * found.range_sigma_m, rel=0.05)


def test_one_tone_where_one_is_enough():
    found = design(range_sigma_m=1.0)
    assert len(found.frequency_hz) == 1
    assert found.wrong_risk == 0.0


def test_what_cannot_be_had_is_refused_with_the_remedy():
    with pytest.raises(GeometryError, match="field wider than the coarse wavelength"):
        design(band_hz=(5e6, 1e9))
    with pytest.raises(InvalidInputError, match="band too narrow"):
        design(band_hz=(1e5, 1e7))
    with pytest.raises(InvalidInputError, match="allow more tones"):
        design(range_sigma_m=1e-6, n_tone=2)
    with pytest.raises(InvalidInputError, match="too large for any coarse tone"):
        design(phase_sigma_rad=0.5)
    for bad in ({"success": 1.0}, {"band_hz": (2.0, 1.0)}, {"n_tone": 0}, {"n_difference": 0}, {"share": "all"}):
        with pytest.raises(InvalidInputError):
            design(**bad)


def test_sharing_costs():
    free, power, index = (design(range_sigma_m=2e-3, share=share) for share in ("none", "power", "index"))
    assert free.frequency_hz[-1] < power.frequency_hz[-1] < index.frequency_hz[-1]
    assert index.phase_sigma_rad == pytest.approx(len(index.frequency_hz) * 2e-3)


def test_command_names_tones_for_a_scenario():
    run = CliRunner().invoke(
        app, ["layout", "tones", SCENARIO, "--accuracy-mrad", "0.05", "--band", "1e5", "1e9", "--json"]
    )
    assert run.exit_code == 0, run.output
    found = json.loads(run.stdout)
    assert found["normal_mrad"] == pytest.approx(0.05, rel=1e-6)
    assert found["wrong_risk"] <= 1e-6
    run = CliRunner().invoke(app, ["layout", "tones", SCENARIO, "--accuracy-mrad", "0.01", "--band", "1e5", "2e6"])
    assert run.exit_code == 3
    assert "band too narrow" in run.output
