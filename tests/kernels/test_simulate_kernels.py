"""Kernels and phase bookkeeping of the simulator against the formula itself, in plain numpy and in exact rationals."""

import math
from fractions import Fraction

import numpy as np
import pytest

from rfpose.scenario import parse_scenario
from rfpose.simulator import _kernels, _rays

TURN = 2.0**64


def random_rays(rng, *, n_transmitter, n_ray, n_tone):
    def turns(*shape):
        return rng.integers(0, 2**64, shape, dtype=np.uint64)

    return _rays.RayTerms(
        amplitude=rng.uniform(0.2, 2.0, (n_transmitter, n_ray)),
        carrier_turn=turns(n_transmitter, n_ray),
        carrier_step=turns(n_transmitter),
        tone_turn=turns(n_transmitter, n_ray, n_tone),
        tone_step=turns(n_tone),
    )


def by_the_formula(rays, index, samples):
    """Sum of carrier × (1 + Σ m cos) with integer phases, nothing but numpy."""
    n = np.asarray(samples, np.uint64)
    total = np.zeros(len(n), complex)
    for i, p in np.ndindex(rays.amplitude.shape):
        carrier = 2 * np.pi * ((rays.carrier_turn[i, p] + n * rays.carrier_step[i]) / TURN)
        envelope = 1.0
        for q, m in enumerate(index):
            envelope = envelope + m * np.cos(2 * np.pi * ((rays.tone_turn[i, p, q] + n * rays.tone_step[q]) / TURN))
        total += rays.amplitude[i, p] * np.exp(1j * carrier) * envelope
    return total


def summed(rays, index, first, n_sample):
    out = np.full((2, n_sample), np.nan)
    _kernels.sum_of_rays(
        first, rays.amplitude, rays.carrier_turn, rays.carrier_step, index, rays.tone_turn, rays.tone_step, out
    )
    return out[0] + 1j * out[1]


@pytest.mark.parametrize("n_sample", [1, 255, 256, 257, 1000])
@pytest.mark.parametrize(("n_transmitter", "n_ray", "n_tone"), [(1, 1, 1), (10, 1, 1), (4, 2, 3)])
def test_sum_of_rays_is_the_formula(n_sample, n_transmitter, n_ray, n_tone):
    rays = random_rays(np.random.default_rng(5), n_transmitter=n_transmitter, n_ray=n_ray, n_tone=n_tone)
    index = np.linspace(0.5, 0.1, n_tone)
    first = 2**24 - 1000  # the end of the longest frame
    expected = by_the_formula(rays, index, first + np.arange(n_sample))
    np.testing.assert_allclose(summed(rays, index, first, n_sample), expected, rtol=0, atol=1e-12)


def test_sum_of_rays_does_not_depend_on_where_a_stretch_begins():
    rays = random_rays(np.random.default_rng(6), n_transmitter=3, n_ray=2, n_tone=2)
    index = np.array([0.6, 0.3])
    whole = summed(rays, index, 0, 1500)
    np.testing.assert_allclose(summed(rays, index, 777, 723), whole[777:], rtol=0, atol=1e-12)


def test_to_int16_rounds_to_nearest_and_saturates():
    signal = np.array([[0.0, 0.24, 0.26, 5.0, -5.0], [0.1, -0.24, -0.26, 1e9, -1e9]])
    out = np.empty((5, 2), np.int16)
    _kernels.to_int16(signal, np.zeros((5, 2), np.float32), 1.0, 2.0, 7.0, out)
    assert out.tolist() == [[0, 0], [0, 0], [1, -1], [7, 7], [-7, -7]]


def test_noise_is_added_in_units_of_the_signal():
    signal = np.array([[1.0, 2.0], [3.0, 4.0]])
    noise = np.array([[1.0, -1.0], [0.5, 2.0]], np.float32)
    expected = np.array([[1.25, 2.75], [2.125, 4.5]])
    as_float, as_int = np.empty((2, 2), np.float32), np.empty((2, 2), np.int16)
    _kernels.to_float32(signal, noise, 0.25, as_float)
    _kernels.to_int16(signal, noise, 0.25, 8.0, 127.0, as_int)
    np.testing.assert_array_equal(as_float, expected.astype(np.float32))
    np.testing.assert_array_equal(as_int, np.rint(expected * 8.0))


SITE = """
name = "two transmitters, odd numbers"
[radio]
sample_rate_hz = 39_999_999.7
centre_frequency_hz = 433.92e6
frame_samples = 16_777_216
[[tone]]
wavelength_m = 400.0
modulation_index = 0.6
[[tone]]
frequency_hz = 7.4999993e6
modulation_index = 0.3
[[transmitter]]
id = "A"
position_enu_m = [100.0, 0.0, 20.0]
carrier_hz = -9.8765432e6
[[transmitter]]
id = "B"
position_enu_m = [50.0, 86.6, 30.0]
carrier_hz = 4.1e6
[[calibration_receiver]]
id = "c"
position_enu_m = [15.0, -20.0, 2.5]
[simulation.ground]
coefficient = [-0.3, 0.1]
"""


@pytest.mark.parametrize("sample", [0, 1, 255, 256, 123_457, 2**24 - 1])
def test_phases_are_exact_at_samples_since_the_epoch(sample):
    """Every phase to 1e-9 rad against rational arithmetic, 7e16 samples and 2^24 samples into a frame."""
    scenario = parse_scenario(SITE)
    radio, speed = scenario.radio, Fraction(scenario.radio.propagation_speed_mps)
    run_start = 1_782_043_200 * 40_000_000 + 17
    sample_in_run = 10**10 + 3
    clock_ppm, psi, sampling_phase, delay_s = -19.7, 1.2345, 0.617, 3.2e-9
    theta, phi = np.array([0.3, 5.1]), np.array([[1.0, -2.0], [3.0, 0.5]])
    range_m = np.array([[91.0, 93.5], [120.25, 130.125]])
    rays = _rays.make_rays(
        scenario,
        length_m=range_m,
        gain=np.array([1.0, complex(-0.3, 0.1)]) * np.ones((2, 2)),
        pass_factor=np.array([1.0, 0.5]),
        carrier_phase_rad=theta,
        tone_phase_rad=phi,
        delay_s=delay_s,
        clock_ppm=clock_ppm,
        oscillator_phase_rad=psi,
        sampling_phase=sampling_phase,
        run_start_index=run_start,
        sample_in_run=sample_in_run,
    )
    eps = Fraction(clock_ppm * 1e-6)
    rate = radio.sample_rate
    t = Fraction(run_start) / rate + (sample_in_run + sample + Fraction(sampling_phase)) / (rate * (1 + eps))
    mixer = Fraction(radio.centre_frequency_hz) * (1 + eps) * t
    for i, p in np.ndindex(2, 2):
        tau = Fraction(range_m[i, p]) / speed + Fraction(delay_s)
        rf = Fraction(radio.centre_frequency_hz) + Fraction(scenario.carrier_hz[i])
        turns = float((rf * (t - tau) - mixer) % 1)
        reflection = p * math.atan2(0.1, -0.3)
        got = 2 * np.pi * ((int(rays.carrier_turn[i, p]) + sample * int(rays.carrier_step[i])) % 2**64) / TURN
        wrong = got - (2 * np.pi * turns + theta[i] + psi + reflection)
        assert abs(math.remainder(wrong, 2 * np.pi)) < 1e-9
        for q in range(2):
            turns = float(Fraction(scenario.tone_hz[q]) * (t - tau) % 1)
            got = 2 * np.pi * ((int(rays.tone_turn[i, p, q]) + sample * int(rays.tone_step[q])) % 2**64) / TURN
            assert abs(math.remainder(got - (2 * np.pi * turns + phi[i, q]), 2 * np.pi)) < 1e-9
    gain = np.hypot(0.3, 0.1)
    np.testing.assert_allclose(rays.amplitude, [[1.0, gain], [0.5, 0.5 * gain]], rtol=1e-14)
