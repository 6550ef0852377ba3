"""Phase difference of real tones: values, bad rows, wrong arguments."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import hilbert

from rfpose.dsp.phase_difference import (
    bound_rad,
    compensated_dot_phase_difference,
    compensated_dot_sigma_rad,
    correlator_phase_difference,
    dot_bias_rad,
    dot_phase_difference,
    dot_sigma_rad,
    hilbert_phase_difference,
    predicted_sigma_rad,
)
from rfpose.errors import InvalidInputError

FREQUENCY = 0.1
N_SAMPLE = 1000


def tone(phase_rad, n_sample=N_SAMPLE, frequency=FREQUENCY, amplitude=1.0):
    phase = np.asarray(phase_rad)[..., None]
    return amplitude * np.cos(2 * np.pi * frequency * np.arange(n_sample) + phase)


ALL = {
    "hilbert": hilbert_phase_difference,
    "bandpass": lambda a, b: hilbert_phase_difference(a, b, bandpass=(0.08, 0.12)),
    "dot": dot_phase_difference,
    "compensated": lambda a, b: compensated_dot_phase_difference(a, b, noise_variance1=0.0, noise_variance2=0.0),
    "correlator": lambda a, b: correlator_phase_difference(a, b, FREQUENCY),
}
SIGNED = ("hilbert", "bandpass", "correlator")
METHODS = pytest.mark.parametrize("name", ALL)


@METHODS
@pytest.mark.parametrize("difference", [-3.0, -1.4, -0.2, 0.5, 2.9])
def test_clean_tones(name, difference):
    got = ALL[name](tone(0.3, amplitude=2.0), tone(0.3 + difference, amplitude=0.5))
    want = difference if name in SIGNED else abs(difference)
    assert got.shape == ()
    assert got == pytest.approx(want, abs=1e-9)


@METHODS
def test_one_reference_against_many(name):
    differences = np.array([[0.1, -2.0, 1.0], [3.0, 0.7, -0.4]])
    got = ALL[name](tone(0.2), tone(0.2 + differences))
    np.testing.assert_allclose(got, differences if name in SIGNED else np.abs(differences), atol=1e-9)


@METHODS
@pytest.mark.parametrize("bad", ["nan", "inf", "zero", "constant"])
@pytest.mark.parametrize("side", [0, 1])
def test_bad_row_is_nan_and_the_rest_goes_on(name, bad, side):
    signals = [tone([0.0, 0.1, 0.2]), tone([0.5, 0.6, 0.7])]
    signals[side] = signals[side].copy()
    if bad in ("nan", "inf"):
        signals[side][1, 17] = float(bad)
    else:
        signals[side][1] = 0.0 if bad == "zero" else 3.0
    before = signals[side].copy()
    got = ALL[name](*signals)
    assert np.isnan(got[1])
    np.testing.assert_allclose(got[[0, 2]], 0.5, atol=1e-9)
    np.testing.assert_array_equal(signals[side], before)


@METHODS
def test_wrong_shapes_raise(name):
    method = ALL[name]
    with pytest.raises(InvalidInputError, match="one length"):
        method(tone(0.0), tone(0.0, n_sample=999))
    with pytest.raises(InvalidInputError, match="8 samples or more, got 7"):
        method(tone(0.0, n_sample=7), tone(0.0, n_sample=7))
    with pytest.raises(InvalidInputError, match="must hold 8 samples or more, got 0"):
        method(np.zeros(0), np.zeros(0))
    with pytest.raises(InvalidInputError, match="broadcast"):
        method(tone([0.0, 1.0]), tone([0.0, 1.0, 2.0]))
    with pytest.raises(InvalidInputError, match="`s2` must be real"):
        method(tone(0.0), tone(0.0).astype(complex))
    with pytest.raises(InvalidInputError, match="`s1` must be numeric"):
        method("signal", tone(0.0))


@pytest.mark.parametrize("n_sample", [1000, 1001])
def test_hilbert_equals_scipy(n_sample):
    rng = np.random.default_rng(1)
    s1, s2 = rng.standard_normal((2, 5, n_sample))
    h1, h2 = (hilbert(s - s.mean(axis=-1, keepdims=True), axis=-1) for s in (s1, s2))
    want = np.angle(np.mean(np.exp(1j * (np.angle(h2) - np.angle(h1))), axis=-1))
    np.testing.assert_allclose(hilbert_phase_difference(s1, s2, edge=0), want, atol=1e-12)


def test_hilbert_default_edge_removes_the_end_error():
    rng = np.random.default_rng(2)
    phase1, phase2 = rng.uniform(-np.pi, np.pi, (2, 200))
    s1, s2 = (tone(p, frequency=0.10113, n_sample=4000) for p in (phase1, phase2))

    def rms(**settings):
        error = hilbert_phase_difference(s1, s2, **settings) - (phase2 - phase1)
        return np.sqrt(np.mean(np.angle(np.exp(1j * error)) ** 2))

    # a jump at the ends of the periodic record: about 1/n without trimming
    assert 0.3 / 4000 < rms(edge=0) < 3.0 / 4000
    assert rms() < 0.1 / 4000
    band = (0.096, 0.106)
    assert 0.3 / 4000 < rms(edge=0, bandpass=band) < 3.0 / 4000
    assert rms(bandpass=band) < 0.2 / 4000


def test_hilbert_bandpass_removes_another_tone_and_a_constant():
    other = 5.0 * np.cos(2 * np.pi * 0.3 * np.arange(N_SAMPLE))
    s1, s2 = tone(0.1) + other + 7.0, tone(1.3) - other - 7.0
    assert hilbert_phase_difference(s1, s2, bandpass=(0.08, 0.12)) == pytest.approx(1.2, abs=1e-9)
    assert abs(hilbert_phase_difference(s1, s2) - 1.2) > 0.1


@pytest.mark.parametrize("band", [(0.2, 0.1), (0.1, 0.1), (-0.1, 0.1), (0.1, 0.6), (float("nan"), 0.1)])
def test_hilbert_refuses_an_empty_band(band):
    with pytest.raises(InvalidInputError, match="`bandpass` must be"):
        hilbert_phase_difference(tone(0.0), tone(1.0), bandpass=band)


def test_hilbert_refuses_a_band_without_bins_and_an_edge_without_samples():
    with pytest.raises(InvalidInputError, match="no frequency bin"):
        hilbert_phase_difference(tone(0.0), tone(1.0), bandpass=(0.1001, 0.1002))
    for edge in (-1, 500):
        with pytest.raises(InvalidInputError, match="`edge` must be"):
            hilbert_phase_difference(tone(0.0), tone(1.0), edge=edge)


def test_dot_products_with_known_noise_powers():
    # orthogonal "noise" of known power: other tones with whole numbers of cycles, shared in part
    n1 = 0.5 * tone(0.0, frequency=0.2)
    n2 = 0.5 * tone(0.0, frequency=0.2) + 0.3 * tone(0.0, frequency=0.3)
    s1, s2 = tone(0.4) + n1 + 0.1, tone(1.6) + n2 - 0.2
    got = compensated_dot_phase_difference(
        s1,
        s2,
        noise_variance1=0.125,
        noise_variance2=0.125 + 0.045,
        noise_mean1=0.1,
        noise_mean2=-0.2,
        noise_cross=0.125 - 0.02,
    )
    assert got == pytest.approx(1.2, abs=1e-12)
    plain = (0.5 * np.cos(1.2) + 0.105) / np.sqrt((0.5 + 0.125 + 0.01) * (0.5 + 0.17 + 0.04))
    assert dot_phase_difference(s1, s2) == pytest.approx(np.arccos(plain), abs=1e-12)


def test_compensated_dot_default_cross_is_the_product_of_means():
    got = compensated_dot_phase_difference(
        tone(0.0) + 0.1, tone(1.0) - 0.2, noise_variance1=0, noise_variance2=0, noise_mean1=0.1, noise_mean2=-0.2
    )
    assert got == pytest.approx(1.0, abs=1e-12)


def test_compensated_dot_without_power_left_is_nan_and_beyond_one_is_clipped():
    variance = np.array([0.0, 0.6])
    s1, s2 = tone([0.0, 0.0]), tone([0.3, 0.3])
    got = compensated_dot_phase_difference(s1, s2, noise_variance1=variance, noise_variance2=0.0)
    np.testing.assert_array_equal(np.isnan(got), [False, True])
    # both powers short: still no angle, though their product is positive
    assert np.isnan(compensated_dot_phase_difference(s1[0], s2[0], noise_variance1=0.6, noise_variance2=0.6))
    assert compensated_dot_phase_difference(s1[0], s1[0], noise_variance1=0.1, noise_variance2=0.1) == 0.0
    with pytest.raises(InvalidInputError, match="must not be negative"):
        compensated_dot_phase_difference(s1, s2, noise_variance1=-0.1, noise_variance2=0.0)


@pytest.mark.parametrize("frequency", [0.0, 0.5, -0.1, 0.7, float("nan")])
def test_correlator_refuses_frequencies(frequency):
    with pytest.raises(InvalidInputError, match="`cycles_per_sample`"):
        correlator_phase_difference(tone(0.0), tone(1.0), frequency)


def test_correlator_refuses_less_than_half_a_cycle():
    with pytest.raises(InvalidInputError, match="half a cycle"):
        correlator_phase_difference(tone(0.0), tone(1.0), 0.4 / N_SAMPLE)


def test_correlator_fits_a_part_of_a_cycle_beside_a_constant():
    frequency = 1.3 / N_SAMPLE
    s1, s2 = tone(0.2, frequency=frequency) + 4.0, tone(1.5, frequency=frequency) - 2.0
    assert correlator_phase_difference(s1, s2, frequency, constant=True) == pytest.approx(1.3, abs=1e-9)
    assert abs(correlator_phase_difference(s1, s2, frequency) - 1.3) > 0.1


def test_predictions_take_numbers_and_arrays():
    assert predicted_sigma_rad(1000, 10.0).shape == ()
    assert predicted_sigma_rad([100, 1000], 10.0).shape == (2,)
    assert bound_rad(4096, 100.0) == pytest.approx(np.sqrt(2 / 4096 / 100.0), rel=1e-14)
    assert bound_rad(4096, 100.0, 25.0) == pytest.approx(np.sqrt((1 / 100 + 1 / 25) / 4096), rel=1e-14)
    want = np.sqrt((1 / (0.5 * 100) + 1 / (0.25 * 25)) / 4096)
    assert predicted_sigma_rad(4096, 100.0, 25.0, 0.5, 0.25) == pytest.approx(want, rel=1e-14)


@pytest.mark.parametrize("snr", [0.0, -1.0, float("nan")])
def test_predictions_refuse_bad_ratios(snr):
    for function in (
        lambda: predicted_sigma_rad(100, snr),
        lambda: bound_rad(100, 1.0, snr),
        lambda: dot_bias_rad(1.0, snr),
        lambda: dot_sigma_rad(100, 1.0, snr),
        lambda: compensated_dot_sigma_rad(100, 1.0, snr),
    ):
        with pytest.raises(InvalidInputError, match="`snr"):
            function()
    with pytest.raises(InvalidInputError, match="must not exceed 1"):
        predicted_sigma_rad(100, 1.0, bandwidth1=1.5)


def test_dot_bias_vanishes_at_right_angles_and_draws_towards_them():
    assert dot_bias_rad(np.pi / 2, 10.0) == pytest.approx(0.0, abs=1e-15)
    assert dot_bias_rad(0.5, 10.0) > 0.0 > dot_bias_rad(-2.6, 10.0)
    assert dot_bias_rad(0.0, 10.0) == pytest.approx(np.arccos(1 / 1.1))


RUNS = 3000
# four standard errors of a standard deviation over RUNS runs
FOUR_SIGMA = 4.0 / np.sqrt(2.0 * RUNS)


@pytest.mark.parametrize("difference", [0.4, 1.5, -2.5])
@pytest.mark.parametrize(("snr1", "snr2"), [(5.0, 5.0), (20.0, 4.0)])
def test_scatter_follows_the_predictions(difference, snr1, snr2):
    rng = np.random.default_rng(int(1000 + 10 * difference + snr1))
    phase1 = rng.uniform(-np.pi, np.pi, RUNS)
    var1, var2 = 0.5 / snr1, 0.5 / snr2
    s1 = tone(phase1, n_sample=400) + np.sqrt(var1) * rng.standard_normal((RUNS, 400))
    s2 = tone(phase1 + difference, n_sample=400) + np.sqrt(var2) * rng.standard_normal((RUNS, 400))

    plain = dot_phase_difference(s1, s2)
    sigma = dot_sigma_rad(400, difference, snr1, snr2)
    assert np.std(plain) == pytest.approx(sigma, rel=FOUR_SIGMA + 0.02)
    bias = np.mean(plain) - abs(difference)
    assert bias == pytest.approx(dot_bias_rad(difference, snr1, snr2), abs=5 * sigma / np.sqrt(RUNS) + sigma**2)

    exact = compensated_dot_phase_difference(s1, s2, noise_variance1=var1, noise_variance2=var2)
    sigma = compensated_dot_sigma_rad(400, difference, snr1, snr2)
    # the next order of the arc cosine, a few per cent here
    assert np.std(exact) == pytest.approx(sigma, rel=FOUR_SIGMA + 0.04)

    best = correlator_phase_difference(s1, s2, FREQUENCY)
    assert np.std(best - difference) == pytest.approx(bound_rad(400, snr1, snr2), rel=FOUR_SIGMA + 0.01)
    assert abs(np.mean(best - difference)) < 5 * bound_rad(400, snr1, snr2) / np.sqrt(RUNS)
