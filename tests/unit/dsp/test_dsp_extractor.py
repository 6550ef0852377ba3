"""What one frame gives, and what bad samples give."""

import numpy as np
import pytest

from rfpose.dsp import ESTIMATORS, LinePlan, LineStatus, ToneExtractor
from rfpose.dsp.clock import SEARCH_SAMPLES, coarse_clock_ppm, search_bank
from rfpose.errors import InvalidInputError

CARRIER = np.array([-18e6, -6e6, 2e6, 14e6])
RATE, CENTRE = 40e6, 100e6


@pytest.fixture
def plan():
    return LinePlan.create(CARRIER, [750e3], sample_rate_hz=RATE, centre_frequency_hz=CENTRE)


@pytest.fixture
def frame(fdm_samples):
    def make(n_sample=16384, seed=1, **kw):
        setup = {"carrier_hz": CARRIER, "tone_hz": 750e3, "rate_hz": RATE, "centre_hz": CENTRE, "snr": 100.0, **kw}
        return fdm_samples(n_sample, np.random.default_rng(seed), **setup)

    return make


def differences(phase):
    return np.angle(np.exp(1j * (phase - phase[0])))


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_phase_differences_come_out_with_sign(plan, frame, estimator, dtype):
    samples, phase, _ = frame(clock_ppm=-12.0, dtype=dtype)
    found = ToneExtractor(plan, estimator, full_scale=32767 if dtype == np.int16 else np.inf).measure(samples)
    error = np.angle(np.exp(1j * (differences(found.phase_rad) - differences(phase))))
    assert np.all(found.status == LineStatus.OK)
    assert np.all(np.abs(error) < 6 * np.sqrt(2) * found.sigma_rad)
    assert found.clock_ppm == pytest.approx(-12.0, abs=5 * found.clock_sigma_ppm)


def test_amplitudes_refer_to_the_frame_centre(plan, frame):
    samples, phase, theta = frame(dtype=np.float32, snr=1e4)
    for estimator in ("hilbert", "correlator"):
        found = ToneExtractor(plan, estimator, full_scale=np.inf).measure(samples)
        np.testing.assert_allclose(found.carrier, np.exp(1j * theta), atol=8 * found.carrier_sigma.max())
        upper = 0.4 * np.exp(1j * (theta[:, None] + phase))
        np.testing.assert_allclose(found.sideband[..., 0], upper, atol=8 * found.sideband_sigma.max())
        lower = 0.4 * np.exp(1j * (theta[:, None] - phase))
        np.testing.assert_allclose(found.sideband[..., 1], lower, atol=8 * found.sideband_sigma.max())
        assert found.noise_variance == pytest.approx(0.64 / 1e4, rel=0.1)


def test_a_clock_that_jumped_is_found_again(plan, frame):
    samples, phase, _ = frame(clock_ppm=31.0)
    found = ToneExtractor(plan).measure(samples, clock_ppm=0.0)
    assert found.clock_ppm == pytest.approx(31.0, abs=0.1)
    error = np.angle(np.exp(1j * (differences(found.phase_rad) - differences(phase))))
    assert np.all(np.abs(error) < 6 * np.sqrt(2) * found.sigma_rad)


@pytest.mark.parametrize("n_sample", [400, 3000, 16384, 200_000])
@pytest.mark.parametrize("clock_ppm", [-49.5, -20.3, 0.0, 7.7, 49.5])
def test_a_clock_is_found_over_the_whole_search_range(plan, frame, n_sample, clock_ppm):
    samples, _, _ = frame(n_sample, clock_ppm=clock_ppm)
    found = coarse_clock_ppm(samples, plan, search_bank(plan, n_sample))
    # the nearest candidate or the one beside it: they lie a quarter of the spectrum's bin apart
    bin_ppm = 1.0 / (min(n_sample, SEARCH_SAMPLES) * np.abs(plan.cycles_per_ppm()).max())
    assert found == pytest.approx(clock_ppm, abs=0.5 * bin_ppm)


@pytest.mark.parametrize("estimator", ["hilbert", "correlator"])
def test_absent_carrier_is_one_bad_row(plan, frame, estimator):
    samples, phase, _ = frame(carrier_hz=CARRIER[[0, 1, 3]])
    found = ToneExtractor(plan, estimator).measure(samples)
    assert list(found.status) == [LineStatus.OK, LineStatus.OK, LineStatus.ABSENT, LineStatus.OK]
    assert np.isnan(found.phase_rad[2]).all()
    assert np.isfinite(found.phase_rad[[0, 1, 3]]).all()
    error = np.angle(np.exp(1j * (differences(found.phase_rad[[0, 1, 3]]) - differences(phase))))
    assert np.all(np.abs(error) < 6 * np.sqrt(2) * found.sigma_rad[[0, 1, 3]])


def test_weak_tone_is_marked(plan, frame):
    samples, _, _ = frame(modulation=0.002, snr=1e-3, n_sample=4096)
    assert LineStatus.WEAK in ToneExtractor(plan, "correlator").measure(samples).status


def test_noise_alone_gives_nothing(plan):
    noise = np.random.default_rng(5).integers(-500, 500, (16384, 2)).astype(np.int16)
    for estimator in ESTIMATORS:
        assert np.all(ToneExtractor(plan, estimator).measure(noise).status == LineStatus.ABSENT)


@pytest.mark.parametrize(
    ("spoil", "status"),
    [
        (lambda x: np.zeros_like(x), LineStatus.NO_SIGNAL),
        (
            lambda x: np.where((np.arange(len(x)) // 512 == 3)[:, None], 0, x).astype(x.dtype),
            LineStatus.MISSING_SAMPLES,
        ),
        (lambda x: np.clip(x.astype(np.int32) * 3, -32767, 32767).astype(x.dtype), LineStatus.CLIPPED),
    ],
)
def test_bad_integer_samples_are_named(plan, frame, spoil, status):
    found = ToneExtractor(plan).measure(spoil(frame()[0]))
    assert np.all(found.status == status)
    assert np.isnan(found.phase_rad).all()
    assert LineStatus(status).reason


def test_fill_value_means_missing(plan, frame):
    samples = frame()[0]
    samples[100:110] = -32768
    assert np.all(ToneExtractor(plan).measure(samples).status == LineStatus.MISSING_SAMPLES)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite_floats_are_named(plan, frame, value):
    samples = frame(dtype=np.float32)[0]
    samples[777, 1] = value
    assert np.all(ToneExtractor(plan, full_scale=np.inf).measure(samples).status == LineStatus.NOT_FINITE)


@pytest.mark.parametrize(
    "samples",
    [np.zeros((10, 2), np.int16), np.zeros(4096, np.int16), np.zeros((4096, 2)), np.zeros((4096, 3), np.int16)],
)
def test_wrong_arrays_are_refused(plan, samples):
    with pytest.raises(InvalidInputError, match="samples"):
        ToneExtractor(plan).measure(samples)


def test_unknown_estimator_is_refused(plan):
    with pytest.raises(InvalidInputError, match="hilbert"):
        ToneExtractor(plan, "fft")


def test_an_interferer_raises_only_its_neighbours_sigma(plan, frame):
    samples, _, _ = frame(dtype=np.float32, n_sample=65536)
    t = np.arange(len(samples)) / RATE
    swept = 0.1 * np.exp(2j * np.pi * ((2e6 + 752e3) * t + 3e3 / (2 * np.pi) * np.sin(2 * np.pi * 900 * t)))
    spoilt = samples + np.stack([swept.real, swept.imag], -1).astype(np.float32)
    for estimator in ("hilbert", "correlator"):
        extractor = ToneExtractor(plan, estimator, full_scale=np.inf)
        clean, dirty = extractor.measure(samples).sigma_rad[:, 0], extractor.measure(spoilt).sigma_rad[:, 0]
        assert dirty[2] > 1.5 * clean[2]
        np.testing.assert_allclose(dirty[[0, 1, 3]], clean[[0, 1, 3]], rtol=0.25)
