"""Time stamps of captures: gaps, clocks and scatter told apart, each from its own making."""

from fractions import Fraction

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.recording.stamps import Capture, parse_stamp, place_captures, stamp_text

RATE = Fraction(10**6)
START = 1_790_000_000 * 10**6


def captures(first_sample, true_index, *, ppm=0.0, jitter_s=(), digits=9, beside=0.0):
    """Captures stamped by a true clock, of a receiver that samples ``ppm`` too slowly."""
    found = []
    for k, (n, index) in enumerate(zip(first_sample, true_index, strict=True)):
        elapsed = Fraction(index - true_index[0]) * (1 + Fraction(ppm) / 10**6)
        late = Fraction(jitter_s[k]) * RATE if len(jitter_s) else 0
        seconds = (true_index[0] + elapsed + Fraction(beside) + late) / RATE
        nanoseconds = round(seconds * 10**digits)
        whole, rest = divmod(nanoseconds, 10**digits)
        text = stamp_text(whole, Fraction(1)).split(".")[0] + (f".{rest:0{digits}d}Z" if digits else "Z")
        found.append(Capture(first_sample=n, stamp=parse_stamp(text, RATE)))
    return found


def test_a_slow_clock_is_fitted_and_told_and_makes_no_gaps():
    n = [k * 10**6 for k in range(20)]
    found = place_captures(captures(n, [START + k for k in n], ppm=20), RATE)
    assert found.start_index == [START + k for k in n]
    assert found.doubts == [
        "its time stamps say that its clock runs 20 ppm slow: counted by the nominal rate, sample times are wrong by "
        "up to 380 samples (380 µs)"
    ]


def test_a_fast_clock_is_no_step_back():
    n = [k * 10**6 for k in range(20)]
    found = place_captures(captures(n, [START + k for k in n], ppm=-50), RATE)
    assert found.start_index == [START + k for k in n]
    assert "clock runs 50 ppm fast" in found.doubts[0]


def test_two_stamps_of_a_fast_clock_are_no_step_back_either():
    found = place_captures(captures([0, 10**6], [START, START + 10**6], ppm=-50), RATE)
    assert found.start_index == [START, START + 10**6]
    assert "50 ppm fast" in found.doubts[0]


def test_gaps_are_found_beside_a_clock():
    n = [k * 10**6 for k in range(12)]
    lost = [0] * 5 + [700] * 4 + [1000] * 3
    found = place_captures(captures(n, [START + k + g for k, g in zip(n, lost, strict=True)], ppm=20), RATE)
    assert [i - START - k for i, k in zip(found.start_index, n, strict=True)] == lost
    assert "20 ppm slow" in found.doubts[0]


def test_stamps_that_scatter_make_no_gaps_but_are_told():
    jitter = np.random.default_rng(4).normal(0, 100e-6, 40)
    jitter[0] = 0.0
    n = [k * 10**6 for k in range(40)]
    found = place_captures(captures(n, [START + k for k in n], jitter_s=jitter), RATE)
    assert found.start_index == [START + k for k in n]
    assert "scatter by" in found.doubts[-1]


def test_stamps_that_scatter_by_tenths_of_a_second_tell_no_time():
    jitter = np.random.default_rng(4).normal(0, 0.4, 40)
    jitter[0] = 0.0
    n = [k * 10**6 for k in range(40)]
    # an index places the samples; what the stamps say is refused all the same
    stamped = captures(n, [START + k for k in n], jitter_s=jitter)
    with pytest.raises(InvalidInputError, match=r"scatter by .* they tell no time; correct or remove them"):
        place_captures([Capture(c.first_sample, c.stamp, START + c.first_sample) for c in stamped], RATE)


def test_one_late_stamp_among_many_is_no_gap():
    jitter = [0.0] * 10
    jitter[4] = 0.3e-3
    n = [k * 10**6 for k in range(10)]
    found = place_captures(captures(n, [START + k for k in n], jitter_s=jitter), RATE)
    assert found.start_index == [START + k for k in n]


def test_bursts_lie_where_their_stamps_say():
    n, index = [0, 500, 1000, 1500], [START, START + 70_000, START + 151_000, START + 10**9]
    found = place_captures(captures(n, index), RATE)
    assert found.start_index == index
    assert found.doubts == []


def test_a_small_step_between_two_stamps_is_told():
    found = place_captures(captures([0, 10**6], [START, START + 10**6 + 20]), RATE)
    assert found.start_index == [START, START + 10**6 + 20]
    assert "begins 20 samples later than the one before it ends: lost, or a slow clock" in found.doubts[0]


def test_a_stamp_beside_the_sample_grid_is_told():
    found = place_captures(captures([0], [START], beside=0.37), RATE)
    assert found.start_index == [START]
    assert found.doubts == [
        "its time stamps lie 0.37 samples (0.37 µs) beside the sample grid, and its samples are taken as on it"
    ]
    # half a microsecond cannot be seen in a stamp of microseconds
    assert place_captures(captures([0], [START], beside=0.37, digits=6), RATE).doubts == []


def test_the_index_is_taken_and_checked_against_the_clock():
    n = [k * 10**6 for k in range(10)]
    stamped = captures(n, [START + k for k in n], ppm=30)
    indexed = [Capture(c.first_sample, c.stamp, START + c.first_sample) for c in stamped]
    found = place_captures(indexed, RATE)
    assert found.start_index == [START + k for k in n]
    assert "30 ppm slow" in found.doubts[0]


def test_a_step_back_that_no_clock_explains_is_refused():
    with pytest.raises(InvalidInputError, match="capture 1 starts 5000 samples before capture 0 ends; correct its"):
        place_captures(captures([0, 10**6], [START, START + 10**6 - 5000]), RATE)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("2016-12-31T23:59:60Z", "a leap second has no Unix time"),
        ("2026-02-30T12:00:00Z", "is '2026-02-30T12:00:00Z', no time of Unix"),
        ("2026-06-21T24:00:00Z", "no time of Unix"),
        ("0000-06-21T12:00:00Z", "no time of Unix"),
        ("1969-12-31T23:59:59Z", "before 1970"),
        ("2026-06-21T12:00:00." + "1" * 50 + "Z", "must look like"),
        ("٢٠٢٦-06-21T12:00:00Z", "must look like"),
        (1, "must look like"),
    ],
)
def test_times_that_are_none(text, words):
    with pytest.raises(InvalidInputError, match=words):
        parse_stamp(text, RATE)


def test_a_time_beyond_the_calendar_is_refused():
    with pytest.raises(InvalidInputError, match="beyond the year 9999"):
        stamp_text(2**61, Fraction(1))


def test_a_stamp_that_is_late_alone_is_no_gap_but_is_told():
    n = [k * 20_000 for k in range(10)]
    wrong = captures(n, [START + k for k in n], jitter_s=[0.3 if k == 4 else 0.0 for k in range(10)])
    found = place_captures(wrong, RATE)
    assert found.start_index == [START + k for k in n]
    assert found.doubts == ["the time stamp of capture 4 lies 300000 samples too late, alone"]
