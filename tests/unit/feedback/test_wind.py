import numpy as np
import pytest
from scipy import signal

from rfpose.errors import InvalidInputError
from rfpose.feedback.structure import StructureMode, swing_transition
from rfpose.feedback.wind import (
    WindLoad,
    admittance,
    gust_process,
    gust_spectrum,
    perfect_servo,
    read_wind_csv,
    stow_mask,
    wind_bend,
    wind_deflection,
)


@pytest.mark.parametrize("speed_mps", [2.0, 5.0, 10.0])
def test_processes_have_the_spectrum(speed_mps):
    process = gust_process(speed_mps)
    frequency = np.geomspace(3e-3, 0.4, 60)
    ratio = process.spectrum(frequency) / gust_spectrum(frequency, speed_mps)
    assert np.abs(ratio - 1.0).max() < 0.17
    assert process.sigma_mps / speed_mps == pytest.approx(0.49, abs=0.03)


def test_drawn_gusts_have_the_spectrum_of_a_plate():
    process = gust_process(5.0, size_m=3.0)
    rng = np.random.default_rng(7)
    gust = process.run(process.start(rng, 60), rng, 8192)
    frequency, power = signal.welch(gust, fs=1.0, nperseg=2048)
    power = power.mean(axis=0)
    for low, high in ((5e-3, 0.02), (0.02, 0.05), (0.05, 0.15)):
        band = (frequency > low) & (frequency < high)
        wanted = gust_spectrum(frequency[band], 5.0) * admittance(frequency[band], 5.0, size_m=3.0)
        assert power[band].sum() == pytest.approx(wanted.sum(), rel=0.08)
    # steady from the first sample on
    assert gust[:, :100].std() == pytest.approx(process.sigma_mps, rel=0.25)


def test_same_seed_same_gusts_and_pieces_continue():
    process = gust_process(6.0)
    one, other = np.random.default_rng(1), np.random.default_rng(1)
    whole = process.run(process.start(one, 1), one, 50)
    state = process.start(other, 1)
    pieces = np.concatenate([process.run(state, other, 20), process.run(state, other, 30)], axis=1)
    assert np.array_equal(whole, pieces)
    assert np.all(gust_process(0.0).run(gust_process(0.0).start(one, 2), one, 9) == 0.0)


def test_background_and_resonance_add_up_to_what_a_record_does():
    mode = StructureMode(natural_hz=0.25, damping=0.1)
    process = gust_process(5.0, interval_s=0.25, size_m=3.0)
    rng = np.random.default_rng(2)
    gust = process.run(process.start(rng, 60), rng, 16_384)
    # first order in the gusts, as (5.14) has it
    bend = wind_bend(1.0, np.sqrt(np.maximum(25.0 + 10.0 * gust, 0.0)), structure=mode, interval_s=0.25)
    linear = 2.0 * 5.0 * gust
    moved = wind_bend(1.0, np.sign(linear) * np.sqrt(np.abs(linear)), structure=mode, interval_s=0.25)
    background, resonant = wind_deflection(1.0, 5.0, mode, size_m=3.0)
    assert np.var(moved[:, 2000:]) == pytest.approx(background + resonant, rel=0.12)
    assert bend.mean() > 25.0


@pytest.mark.parametrize(("hz", "damping", "interval"), [(2.2, 0.02, 1.0), (0.6, 0.1, 1.0), (5.0, 0.3, 0.25)])
def test_a_swing_is_that_of_the_mode_between_samples(hz, damping, interval):
    mode = StructureMode(natural_hz=hz, damping=damping)
    transition, root = swing_transition(mode, interval_s=interval)
    w = mode.natural_radps
    # stays as it is: deflection of variance one, speed of ω²
    stationary = np.diag([1.0, w**2])
    kept = transition @ stationary @ transition.T + root @ root.T
    np.testing.assert_allclose(kept, stationary, rtol=1e-9, atol=1e-9 * w)
    # the same ring-down as scipy's state space of the mode, sampled
    a = np.array([[0.0, 1.0], [-(w**2), -2.0 * damping * w]])
    system = signal.cont2discrete((a, np.zeros((2, 1)), np.eye(2), np.zeros((2, 1))), interval)
    _, seen, _ = signal.dlsim(system, np.zeros((12, 1)), x0=[0.3, -2.0])
    state = np.array([0.3, -2.0])
    for row in seen:
        np.testing.assert_allclose(state, row, atol=1e-9 * w)
        state = transition @ state
    # noise by integration: a thousand small steps of white force 4ζω³
    n, step = 2000, interval / 2000
    small = signal.cont2discrete((a, np.zeros((2, 1)), np.eye(2), np.zeros((2, 1))), step)[0]
    cov = np.zeros((2, 2))
    for _ in range(n):
        cov = small @ cov @ small.T + np.diag([0.0, 4.0 * damping * w**3 * step])
    # first order in ω times the step: 14e-3 at most
    np.testing.assert_allclose(root @ root.T, cov, rtol=0.02, atol=0.02 * w)


def test_a_servo_takes_what_is_below_its_bandwidth():
    mode = StructureMode(natural_hz=1.0, damping=0.03)
    all_of_it, resonant = wind_deflection(1e-4, [5.0], mode, size_m=4.0)
    left, same = wind_deflection(1e-4, [5.0], mode, size_m=4.0, residual=perfect_servo(0.1))
    assert left[0] < 0.15 * all_of_it[0]
    assert np.array_equal(resonant, same)


def test_load_and_deflection():
    load = WindLoad(area_m2=10.0, lever_m=0.5, stiffness_nm_per_rad=3e4)
    assert load.torque_1mps_nm == pytest.approx(3.0)
    assert load.deflection_1mps_rad == pytest.approx(1e-4)
    assert wind_bend(load.deflection_1mps_rad, np.full(4, 5.0)) == pytest.approx(2.5e-3)
    with pytest.raises(InvalidInputError, match="lever_m"):
        WindLoad(area_m2=10.0, lever_m=0.0, stiffness_nm_per_rad=3e4)


GOOD = "# mast 3\ntime,gust,speed_kmh\n2024-02-01T10:00:00Z,1,18\n2024-02-01T10:00:10+00:00,2,36\n"


def write(tmp_path, text):
    path = tmp_path / "wind.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_record_is_read_in_its_unit_and_made_even(tmp_path):
    record = read_wind_csv(write(tmp_path, GOOD), interval_s=2.0)
    assert record.speed_mps == pytest.approx([5.0, 6.0, 7.0, 8.0, 9.0, 10.0])
    assert record.start_unix_s == 1706781600.0
    assert record.unix_s[-1] - record.unix_s[0] == 10.0


def test_gaps_are_unknown_and_not_bridged(tmp_path):
    text = "unix_s,speed_mps\n0,3\n10,3\n11,\n100,5\n110,5\n"
    record = read_wind_csv(write(tmp_path, text), interval_s=5.0, longest_gap_s=60.0)
    assert np.isnan(record.speed_mps[3:20]).all()
    assert record.speed_mps[[0, 1, 2, 20, 21, 22]] == pytest.approx([3, 3, 3, 5, 5, 5])
    assert np.isfinite(record.speed_mps).sum() == 6
    assert np.isfinite(read_wind_csv(write(tmp_path, text), longest_gap_s=200.0).speed_mps).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "must not be empty"),
        ("time,speed\n", "line 1 must name a column"),
        (GOOD + "2024-02-01T09:00:00Z,1,3\n", "line 5: time must go on"),
        (GOOD + "2024-02-01T10:00:10Z,1,3\n", "line 5: time must go on"),
        (GOOD + "2024-02-01T10:00:20,1,3\n", "line 5: `time` must be ISO 8601 with a time zone"),
        (GOOD + "2024-02-01T10:00:20Z,1,-3\n", "must not be negative"),
        (GOOD + "2024-02-01T10:00:20Z,1,fast\n", "must be a number or empty"),
        (GOOD + "2024-02-01T10:00:20Z,1\n", "line 5 must have 3 columns, got 2"),
        ("unix_s,speed_mps\n0,3\n1,120\n", "beyond any wind"),
        ("unix_s,speed_mps\n0,3\nnan,3\n", "line 3: `unix_s` must be a time"),
        ("unix_s,speed_mps\n0,3\n1,\n", "two or more samples"),
    ],
)
def test_bad_records_are_told_by_line(tmp_path, text, words):
    with pytest.raises(InvalidInputError, match=words):
        read_wind_csv(write(tmp_path, text))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InvalidInputError, match=r"none\.csv: cannot be read: No such file"):
        read_wind_csv(tmp_path / "none.csv")


def test_stow_at_ten_metres_a_second_and_release_after_a_calm_while():
    wind = np.array([4.0, 10.0, 9.0] + [7.0] * 4 + [9.0] + [7.0] * 8)
    mask = stow_mask(wind, interval_s=1.0, release_s=5.0)
    assert mask.tolist() == [False] + [True] * 11 + [False] * 4
    blind = np.array([4.0] + [np.nan] * 6 + [4.0] * 4)
    assert stow_mask(blind, interval_s=1.0, release_s=2.0, longest_gap_s=3.0).tolist() == (
        [False] * 4 + [True] * 4 + [False] * 3
    )
    with pytest.raises(InvalidInputError, match="release_mps"):
        stow_mask(wind, interval_s=1.0, release_mps=12.0)
