"""What the simulator's samples contain, found with a least-squares fit of lines that is written here."""

import itertools
import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfpose.scenario import parse_scenario
from rfpose.simulator import Simulator, simulator

SPEED = 299_792_458.0
RATE = 1e6
CENTRE = 100e6
TONE = 20e3
INDEX = 0.8
N = 20_000
CARRIER = {"A": -300e3, "B": 50e3, "C": 350e3}

SITE = """
name = "small"
[site]
aim_enu_m = [0.0, 0.0, 50.0]
[radio]
sample_rate_hz = 1e6
centre_frequency_hz = 100e6
frame_samples = 20_000
[[tone]]
frequency_hz = 20e3
modulation_index = 0.8
[[transmitter]]
id = "A"
position_enu_m = [100.0, 0.0, 20.0]
carrier_hz = -300e3
[[transmitter]]
id = "B"
position_enu_m = [-50.0, 86.6, 30.0]
carrier_hz = 50e3
amplitude = 0.5
[[transmitter]]
id = "C"
position_enu_m = [-50.0, -86.6, 20.0]
carrier_hz = 350e3
[[calibration_receiver]]
id = "cal"
position_enu_m = [15.0, -20.0, 2.5]
[[heliostat]]
id = "H"
pivot_enu_m = [20.0, 5.0, 3.0]
arm_m = 0.2
normal_enu = [0.2, 0.3, 1.0]
receiver_mirror_m = [[1.0, 0.0, 0.0], [-0.5, 0.866, 0.0], [-0.5, -0.866, 0.0]]
receiver_ids = ["r0", "r1", "r2"]
"""
QUIET = {"tone_snr_db": 300.0, "sample_format": "complex64", "frame_count": 1}


def scenario_with(text=SITE, **simulation):
    return parse_scenario(text).changed(simulation=simulation)


def make(seed=1, text=SITE, **simulation):
    return Simulator(scenario_with(text, **simulation), seed=seed)


def frames_of(simulation):
    """Samples by (receiver, frame), as complex; each frame must be whole."""
    frames = {}
    for chunk in simulation:
        i_frame = int(np.searchsorted(simulation.frame_start_index, chunk.start_index, side="right")) - 1
        frames.setdefault((chunk.receiver_id, i_frame), []).append(chunk)
    result = {}
    for key, chunks in frames.items():
        ends = [c.start_index + len(c.samples) for c in chunks]
        assert [c.start_index for c in chunks[1:]] == ends[:-1]
        x = np.concatenate([c.samples for c in chunks]).astype(float)
        result[key] = x[:, 0] + 1j * x[:, 1]
    return result


def fit_lines(x, ppm=0.0, first=0):
    """Complex amplitude of every line (transmitter, carrier/upper/lower) and the residual, by least squares."""
    eps = ppm * 1e-6
    n = first + np.arange(len(x))
    hz = np.array([f - CENTRE * eps + s for f in CARRIER.values() for s in (0.0, TONE, -TONE)])
    lines = np.exp(2j * np.pi * np.outer(n, hz / (RATE * (1 + eps))))
    amplitude = np.linalg.lstsq(lines, x, rcond=None)[0]
    return amplitude.reshape(len(CARRIER), 3), x - lines @ amplitude


def tone_phase(lines):
    carrier, upper, lower = lines.T
    turn = np.conj(carrier) / abs(carrier)
    return np.angle(upper * turn + np.conj(lower * turn))


def ranges(simulation, i_frame=0):
    """(receiver, transmitter) [m]."""
    scenario = parse_scenario(SITE)
    offset = simulation.truth.receiver_enu_m[i_frame][:, None, :] - scenario.transmitter_enu_m
    return np.linalg.norm(offset, axis=-1)


def assert_same_phase(got, expected, tolerance):
    wrong = np.angle(np.exp(1j * (np.asarray(got) - expected)))
    assert np.max(np.abs(wrong)) < tolerance, wrong


# -- one ray ---------------------------------------------------------------------------------------------------


def test_tone_phase_differences_are_range_differences():
    sim = make(**QUIET)
    phi = sim.truth.transmitter_phase_rad[0, :, 0]
    for i, receiver in enumerate(sim.receiver_ids):
        lines, residual = fit_lines(frames_of(sim)[receiver, 0])
        assert np.max(abs(residual)) < 2e-6
        np.testing.assert_allclose(abs(lines), np.outer([1.0, 0.5, 1.0], [1.0, INDEX / 2, INDEX / 2]), atol=1e-7)
        measured = tone_phase(lines)
        expected = phi - 2 * np.pi * TONE / SPEED * ranges(sim)[i]
        assert_same_phase(measured - measured[0], expected - expected[0], 1e-6)


def test_tones_run_in_true_time_since_the_epoch():
    sim = make(**QUIET)
    start_s = int(sim.frame_start_index[0]) / RATE  # a whole number of seconds: the tone's phase there is zero
    assert start_s == 1_782_043_200
    for i, receiver in enumerate(sim.receiver_ids):
        expected = sim.truth.transmitter_phase_rad[0, :, 0] - 2 * np.pi * TONE / SPEED * ranges(sim)[i]
        expected = expected + 2 * np.pi * TONE * sim.draws.sampling_phase[i] / RATE
        assert_same_phase(tone_phase(fit_lines(frames_of(sim)[receiver, 0])[0]), expected, 1e-6)


def test_receivers_on_one_oscillator_differ_in_carrier_phase_by_the_path_alone():
    sim = make(clock_offset_ppm=20.0, **QUIET)
    frames, d, ppm = frames_of(sim), ranges(sim), sim.truth.clock_ppm
    assert ppm[0] == ppm[1] == ppm[2] != ppm[3]
    carrier = np.array([fit_lines(frames[r, 0], ppm[i])[0][:, 0] for i, r in enumerate(sim.receiver_ids)])
    rf = CENTRE + np.array(list(CARRIER.values()))
    for i in (1, 2):
        assert_same_phase(np.angle(carrier[i] / carrier[0]), -2 * np.pi * rf * (d[i] - d[0]) / SPEED, 1e-6)


def test_separate_oscillators_differ():
    text = SITE.replace('id = "H"', 'id = "H"\noscillator = "separate"')
    draws = make(text=text, clock_offset_ppm=5.0).draws
    for values in (draws.clock_ppm, draws.oscillator_phase_rad, draws.sampling_phase):
        assert len(set(values.tolist())) == 4
    assert np.max(np.abs(draws.clock_ppm)) <= 5.0
    assert np.all((draws.sampling_phase >= 0) & (draws.sampling_phase < 1))


def test_clock_offset_moves_and_stretches_the_lines():
    sim = make(clock_offset_ppm=30.0, **QUIET)
    x = frames_of(sim)["cal", 0]
    eps = sim.truth.clock_ppm[3] * 1e-6
    assert abs(eps) > 3e-6
    _, residual = fit_lines(x, sim.truth.clock_ppm[3])
    assert np.max(abs(residual)) < 2e-6
    # frequencies from the data: phase from the first to the second half of the frame
    halves = [fit_lines(part, first=k * N // 2)[0] for k, part in enumerate(np.split(x, 2))]
    measured_hz = np.angle(halves[1] / halves[0]) / (2 * np.pi * (N // 2)) * RATE
    nominal = np.array(list(CARRIER.values()))[:, None] + np.array([0.0, TONE, -TONE])
    expected_hz = (nominal - CENTRE * eps) / (1 + eps) - nominal
    # the fit at nominal frequencies is biased by lines 30 Hz off leaking into each other; 100 Hz is one bin
    wrap = RATE / (N // 2)
    wrong = (measured_hz - expected_hz + wrap / 2) % wrap - wrap / 2
    assert np.max(abs(wrong)) < 0.05 * wrap


def test_path_loss():
    sim = make(path_loss="free_space", reference_range_m=80.0, **QUIET)
    frames, d = frames_of(sim), ranges(sim)
    for i, receiver in enumerate(sim.receiver_ids):
        carrier = fit_lines(frames[receiver, 0])[0][:, 0]
        np.testing.assert_allclose(abs(carrier), [1.0, 0.5, 1.0] * (80.0 / d[i]), rtol=1e-6)


def test_two_tones():
    text = SITE.replace("modulation_index = 0.8", "modulation_index = 0.5\n[[tone]]\nfrequency_hz = 31e3\n")
    text = text.replace("31e3\n", "31e3\nmodulation_index = 0.3")
    sim = make(text=text, **QUIET)
    x, n = frames_of(sim)["cal", 0], np.arange(N)
    d, phi = ranges(sim)[3], sim.truth.transmitter_phase_rad[0]
    t = n / RATE
    start = sim.draws.sampling_phase[3] / RATE
    hz = np.array(list(CARRIER.values()))
    total = np.zeros(N, complex)
    for i, amplitude in enumerate([1.0, 0.5, 1.0]):
        tau = d[i] / SPEED
        envelope = 1.0
        for q, (tone_hz, m) in enumerate([(20e3, 0.5), (31e3, 0.3)]):
            envelope = envelope + m * np.cos(2 * np.pi * tone_hz * (t + start - tau) + phi[i, q])
        phase = sim.draws.carrier_phase_rad[i] + sim.draws.oscillator_phase_rad[3] - 2 * np.pi * (CENTRE + hz[i]) * tau
        total += amplitude * envelope * np.exp(1j * (2 * np.pi * hz[i] * (t + start) + phase))
    np.testing.assert_allclose(x, total, rtol=0, atol=2e-6)


# -- two rays and obstacles ------------------------------------------------------------------------------------


@pytest.mark.parametrize("path_loss", ["none", "free_space"])
def test_ground_reflection_acts_on_carrier_and_sidebands(path_loss):
    """Each line is multiplied by 1 + ρ (d1/d2) exp(−j2π f_RF (d2 − d1)/c) of its own RF frequency."""
    common = QUIET | {"path_loss": path_loss}
    rho, height = -0.3 + 0.1j, -30.0
    plain = make(**common)
    ground = make(ground={"coefficient": [rho.real, rho.imag], "height_m": height}, **common)
    assert plain.truth.tone_snr == pytest.approx(ground.truth.tone_snr)  # of the direct ray
    transmitters = parse_scenario(SITE).transmitter_enu_m
    rf = CENTRE + np.array(list(CARRIER.values()))[:, None] + np.array([0.0, TONE, -TONE])
    for i, receiver in enumerate(plain.receiver_ids):
        ratio = fit_lines(frames_of(ground)[receiver, 0])[0] / fit_lines(frames_of(plain)[receiver, 0])[0]
        receiver_enu_m = plain.truth.receiver_enu_m[0, i]
        horizontal = np.hypot(*(receiver_enu_m - transmitters).T[:2])
        d1 = np.hypot(horizontal, receiver_enu_m[2] - transmitters[:, 2])[:, None]
        d2 = np.hypot(horizontal, (receiver_enu_m[2] - height) + (transmitters[:, 2] - height))[:, None]
        loss = d1 / d2 if path_loss == "free_space" else 1.0
        expected = 1.0 + rho * loss * np.exp(-2j * np.pi * rf * (d2 - d1) / SPEED)
        np.testing.assert_allclose(ratio, expected, rtol=0, atol=3e-6)
        assert abs(expected[0, 1] - expected[0, 2]) > 1e-3  # the sidebands differ: no reflection of carrier alone


def test_blocked_transmitter_is_weak_where_and_when_said():
    sim = make(
        blocked=[
            {"transmitter": "B", "receivers": ["H"], "first_frame": 1, "last_frame": 1},
            {"transmitter": "C", "receivers": ["cal", "r1"], "attenuation_db": 20.0},
            {"transmitter": "A", "first_frame": 2, "attenuation_db": 6.0},
        ],
        **(QUIET | {"frame_count": 3}),
    )
    frames = frames_of(sim)
    got = np.array(
        [[abs(fit_lines(frames[r, k])[0][:, 0]) for r in sim.receiver_ids] for k in range(3)]
    )  # frame, receiver, transmitter
    expected = np.tile([1.0, 0.5, 1.0], (3, 4, 1))
    expected[1, :3, 1] = 0.0
    expected[:, [1, 3], 2] = 0.1
    expected[2, :, 0] *= 10 ** (-6 / 20)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6)
    clear = make(**(QUIET | {"frame_count": 3})).truth.tone_snr[..., 0]
    np.testing.assert_allclose(sim.truth.tone_snr[..., 0] / clear, (expected / [1.0, 0.5, 1.0]) ** 2, atol=1e-9)


def test_obstacle_hides_the_reflected_ray_too():
    ground = {"coefficient": [0.5, 0.0], "height_m": -1.0}
    sim = make(ground=ground, blocked=[{"transmitter": "A"}], **QUIET)
    assert np.max(abs(fit_lines(frames_of(sim)["r0", 0])[0][0])) < 1e-6


# -- delays, drifts, frames ------------------------------------------------------------------------------------


def test_receiver_delay_shifts_carrier_and_tone():
    plain, late = make(**QUIET), make(receiver_delay_s=2e-9, **QUIET)
    delay_s = late.truth.receiver_delay_s[0]
    assert len(set(delay_s)) == 4
    rf = CENTRE + np.array(list(CARRIER.values()))
    for i, receiver in enumerate(plain.receiver_ids):
        a, b = (fit_lines(frames_of(s)[receiver, 0])[0] for s in (plain, late))
        assert_same_phase(np.angle(b[:, 0] / a[:, 0]), -2 * np.pi * rf * delay_s[i], 1e-6)
        assert_same_phase(tone_phase(b) - tone_phase(a), -2 * np.pi * TONE * delay_s[i], 1e-6)


def test_drifts_are_random_walks_of_the_stated_rate():
    sim = make(
        frame_count=400,
        frame_interval_s=30.0,
        receiver_delay_s=1e-9,
        receiver_delay_drift_s_per_sqrt_min=5e-12,
        transmitter_phase_drift_rad_per_sqrt_h=0.2,
    )
    phi, delay_s = sim.truth.transmitter_phase_rad[..., 0], sim.truth.receiver_delay_s
    step = np.angle(np.exp(1j * np.diff(phi, axis=0))) / (0.2 * np.sqrt(30.0 / 3600.0))
    for steps in (step, np.diff(delay_s, axis=0) / (5e-12 * np.sqrt(0.5))):
        z = (np.mean(steps**2) - 1.0) / np.sqrt(2.0 / steps.size)  # chi-square
        assert abs(z) < 4.0
        assert abs(np.mean(steps)) * np.sqrt(steps.size) < 4.0


def test_draws_over_many_seeds_have_the_stated_distribution():
    n_seed = 100
    sims = [make(seed=s, receiver_delay_s=1e-9, clock_offset_ppm=5.0, frame_count=1) for s in range(n_seed)]
    delay_s = np.array([s.truth.receiver_delay_s[0] for s in sims])
    assert abs(np.mean(delay_s**2) / 1e-18 - 1.0) < 4.0 * np.sqrt(2.0 / delay_s.size)
    phi = np.array([s.truth.transmitter_phase_rad[0] for s in sims])
    assert np.all((phi > -np.pi) & (phi <= np.pi))
    ppm = np.array([s.truth.clock_ppm[[0, 3]] for s in sims])
    assert np.max(np.abs(ppm)) <= 5.0
    for uniform in (phi / np.pi, np.array([s.draws.carrier_phase_rad for s in sims]) / np.pi - 1.0, ppm / 5.0):
        assert abs(np.mean(uniform)) < 4.0 / np.sqrt(3.0 * uniform.size)
        assert abs(np.mean(uniform**2) - 1.0 / 3.0) < 4.0 * np.sqrt(4.0 / 45.0 / uniform.size)


@pytest.mark.parametrize("interval_s", [0.0, N / RATE])
def test_frames_back_to_back_continue(interval_s):
    """One set of phasors fits two frames, clock offset and all."""
    sim = make(clock_offset_ppm=40.0, **(QUIET | {"frame_count": 2, "frame_interval_s": interval_s}))
    assert np.diff(sim.frame_start_index) == N
    frames = frames_of(sim)
    for i, receiver in enumerate(sim.receiver_ids):
        both = np.concatenate([frames[receiver, 0], frames[receiver, 1]])
        assert np.max(abs(fit_lines(both, sim.truth.clock_ppm[i])[1])) < 3e-6


def test_frames_with_pauses_start_on_time():
    sim = make(clock_offset_ppm=40.0, **(QUIET | {"frame_count": 3, "frame_interval_s": 60.0}))
    np.testing.assert_array_equal(np.diff(sim.frame_start_index), 60_000_000)
    for i, receiver in enumerate(sim.receiver_ids):
        ppm = sim.truth.clock_ppm[i]
        lines = [fit_lines(frames_of(sim)[receiver, k], ppm)[0] for k in range(3)]
        for later in lines[1:]:  # 60 s are whole turns of tone and carriers; the mixer has gone on
            assert_same_phase(tone_phase(later), tone_phase(lines[0]), 1e-6)
        mixer = -2 * np.pi * CENTRE * ppm * 1e-6 * 60.0
        assert_same_phase(np.angle(lines[1][:, 0] / lines[0][:, 0]), mixer, 1e-5)


def test_odd_rate_and_interval_give_whole_sample_numbers():
    text = SITE.replace("sample_rate_hz = 1e6", "sample_rate_hz = 999_999.7")
    sim = make(text=text, **(QUIET | {"frame_count": 4, "frame_interval_s": 0.1}))
    assert sim.frame_start_index.dtype == np.int64
    exact = (1_782_043_200 + 0.1 * np.arange(4)) * 999_999.7
    assert np.max(np.abs(sim.frame_start_index - exact)) <= 1.0


# -- noise and converter ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("snr_db", [30.0, -10.0])
def test_noise_is_white_with_the_stated_variance(snr_db):
    noisy = make(**(QUIET | {"tone_snr_db": snr_db}))
    clean = make(**QUIET)
    noise = np.array([frames_of(noisy)[r, 0] - frames_of(clean)[r, 0] for r in noisy.receiver_ids])
    variance = INDEX**2 / 10 ** (snr_db / 10)
    count = noise.size
    assert abs(np.mean(abs(noise) ** 2) / variance - 1) < 4 / np.sqrt(count)
    assert abs(np.mean(noise**2)) / variance < 4 / np.sqrt(count)  # circular
    for lag in (1, 2, 256):
        assert abs(np.mean(noise[:, lag:] * np.conj(noise[:, :-lag]))) / variance < 4 / np.sqrt(count)
    for a, b in itertools.combinations(noise, 2):
        assert abs(np.mean(a * np.conj(b))) / variance < 4 / np.sqrt(N)
    assert noisy.truth.tone_snr[0, 0, 0, 0] == pytest.approx(10 ** (snr_db / 10), rel=1e-12)
    assert noisy.truth.tone_snr[0, 0, 1, 0] == pytest.approx(0.25 * 10 ** (snr_db / 10), rel=1e-12)


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_converter_rounds_to_its_step(bits):
    snr_db = 20.0  # noise above one step of 8 bits, so that the rounding error is uniform
    integer = make(tone_snr_db=snr_db, adc_bits=bits, frame_count=1)
    exact = make(**(QUIET | {"tone_snr_db": snr_db}))
    assert integer.sample_format == "int16"
    assert integer.full_scale == 2 ** (bits - 1) - 1
    assert exact.full_scale == math.inf
    for receiver in integer.receiver_ids:
        counts = frames_of(integer)[receiver, 0]
        wrong = counts - frames_of(exact)[receiver, 0] * integer.counts_per_unit
        parts = np.concatenate([wrong.real, wrong.imag])
        assert np.max(np.abs(parts)) < 0.5 + 1e-2
        # a uniform error has variance 1/12 and kurtosis 1.8: the estimate's sigma is sqrt(0.8 / n) of it
        assert abs(np.var(parts) * 12 - 1) < 5 * np.sqrt(0.8 / parts.size)
    sigma2 = INDEX**2 / 10 ** (snr_db / 10) + 2 / 12 / integer.counts_per_unit**2
    assert integer.truth.tone_snr[0, 0, 0, 0] == pytest.approx(INDEX**2 / sigma2, rel=1e-12)


def test_full_scale_is_the_largest_possible_peak():
    sim = make(tone_snr_db=50.0, headroom_db=0.0)
    peak = 2.5 * (1 + INDEX) + 4 * INDEX / np.sqrt(2 * 10**5)
    assert sim.full_scale / sim.counts_per_unit == pytest.approx(peak, rel=1e-12)
    more = make(tone_snr_db=50.0, headroom_db=3.0)
    assert sim.counts_per_unit / more.counts_per_unit == pytest.approx(10 ** (3 / 20), rel=1e-12)


def test_negative_headroom_clips():
    loud, quiet = make(headroom_db=-8.0, frame_count=1), make(headroom_db=0.0, frame_count=1)
    for receiver in loud.receiver_ids:
        magnitude = [np.abs(frames_of(sim)[receiver, 0].view(float)) for sim in (loud, quiet)]
        assert np.max(magnitude[0]) == 32767
        assert np.mean(magnitude[0] == 32767) > 0.01
        assert np.max(magnitude[1]) < 32767


# -- lost samples, order, seeds --------------------------------------------------------------------------------


def test_lost_samples_are_left_out_and_the_rest_is_untouched():
    dropped = [
        {"receiver": "r1", "frame": 1, "first_sample": 100, "sample_count": 50},
        {"receiver": "r1", "frame": 1, "first_sample": 120, "sample_count": 400},
        {"receiver": "cal", "frame": 0, "first_sample": N - 1, "sample_count": 1},
    ]
    whole, holed = make(frame_count=2), make(frame_count=2, dropped=dropped)
    assert holed.total_samples == whole.total_samples - 421 == 8 * N - 421
    expected = {(c.receiver_id, c.start_index): c.samples for c in whole}
    start = whole.frame_start_index
    got = list(holed)
    assert sum(len(c.samples) for c in got) == holed.total_samples
    pieces = [(c.start_index - start[1], len(c.samples)) for c in got if c.receiver_id == "r1"][1:]
    assert pieces == [(0, 100), (520, N - 520)]
    for chunk in got:
        frame_start = start[0] if chunk.start_index < start[1] else start[1]
        offset = chunk.start_index - frame_start
        full = expected[chunk.receiver_id, frame_start]
        np.testing.assert_array_equal(chunk.samples, full[offset : offset + len(chunk.samples)])


def test_a_frame_lost_altogether_yields_nothing():
    sim = make(dropped=[{"receiver": "r0", "frame": 0, "first_sample": 0, "sample_count": N}], frame_count=1)
    assert [c.receiver_id for c in sim] == ["r1", "r2", "cal"]


stretch = st.tuples(st.integers(0, 40), st.integers(0, 12)).map(lambda s: (s[0], s[0] + s[1]))


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 20), st.integers(1, 30), st.lists(stretch, max_size=4))
def test_kept_stretches_are_the_complement(first, length, lost):
    mask = np.zeros(64, bool)
    mask[first : first + length] = True
    for a, b in lost:
        mask[a:b] = False
    kept = simulator._kept_stretches(first, first + length, sorted(lost))
    again = np.zeros(64, bool)
    for a, b in kept:
        assert a < b
        assert not again[a:b].any()
        again[a:b] = True
    np.testing.assert_array_equal(again, mask)


IMPAIRED = {
    "frame_count": 3,
    "frame_interval_s": 1.0,
    "clock_offset_ppm": 10.0,
    "receiver_delay_s": 1e-9,
    "receiver_delay_drift_s_per_sqrt_min": 1e-11,
    "transmitter_phase_drift_rad_per_sqrt_h": 0.1,
}


def test_a_seed_fixes_everything():
    first, again, other = (list(make(seed=s, **IMPAIRED)) for s in (3, 3, 4))
    for a, b, c in zip(first, again, other, strict=True):
        assert (a.receiver_id, a.start_index) == (b.receiver_id, b.start_index) == (c.receiver_id, c.start_index)
        np.testing.assert_array_equal(a.samples, b.samples)
        assert not np.array_equal(a.samples, c.samples)


def test_iterating_again_gives_the_same():
    sim = make(**IMPAIRED)
    part = list(itertools.islice(sim, 5))  # leaves the first pass in the middle
    for a, b in zip(part, sim, strict=False):
        np.testing.assert_array_equal(a.samples, b.samples)


def test_a_longer_recording_begins_like_a_shorter_one():
    short, long = make(**(IMPAIRED | {"frame_count": 1})), make(**IMPAIRED)
    for a, b in zip(short, long, strict=False):
        assert a.receiver_id == b.receiver_id
        np.testing.assert_array_equal(a.samples, b.samples)


def test_long_frames_come_in_bounded_pieces_without_a_seam():
    n = 2 * simulator.CHUNK_SAMPLES + 1000
    text = SITE.replace("frame_samples = 20_000", f"frame_samples = {n}")
    sim = make(text=text, clock_offset_ppm=20.0, **QUIET)
    chunks = [c for c in sim if c.receiver_id == "r2"]
    assert [len(c.samples) for c in chunks] == [simulator.CHUNK_SAMPLES] * 2 + [1000]
    assert simulator.CHUNK_SAMPLES <= 2**18
    assert all(c.samples.dtype == np.float32 for c in chunks)
    x = frames_of(sim)["r2", 0]
    seam = simulator.CHUNK_SAMPLES
    for part in (slice(seam - 5000, seam + 5000), slice(n - 5000, n)):
        assert np.max(abs(fit_lines(x[part], sim.truth.clock_ppm[2])[1])) < 3e-6
    noisy = [c.samples for c in make(text=text, **(QUIET | {"tone_snr_db": 0.0})) if c.receiver_id == "r2"]
    clean = [c.samples for c in make(text=text, **QUIET) if c.receiver_id == "r2"]
    a, b = (p - q for p, q in zip(noisy[:2], clean[:2], strict=True))
    assert abs(np.mean(a * b)) < 4 * np.var(a) / np.sqrt(a.size)  # each piece has noise of its own


def test_memory_does_not_grow_with_length():
    text = SITE.replace("frame_samples = 20_000", "frame_samples = 16_777_216")
    sim = make(text=text, frame_count=1000)
    tracemalloc.start()
    try:
        n_sample = sum(len(chunk.samples) for chunk in itertools.islice(sim, 20))
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert n_sample == 20 * simulator.CHUNK_SAMPLES
    # a frame of int16 would be 67 MB; a chunk with its buffers is 4 MB, a few of them at a time
    assert peak_bytes < 40e6
