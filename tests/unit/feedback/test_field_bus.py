"""A cluster's polled bus: when messages come, how many, and what faults do to them."""

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.feedback.fieldcontrol.bus import BusSettings, MessageStatus, capacity, poll

N_CLUSTER = 300


def _round(bus, *, start_s=0.0, seed=1, n_cluster=N_CLUSTER, master=True, listening=True):
    n = n_cluster * bus.cluster_size
    return poll(
        bus,
        start_s,
        slot=np.arange(n) % bus.cluster_size,
        master_alive=np.broadcast_to(np.asarray(master), (n,)),
        listening=np.broadcast_to(np.asarray(listening), (n,)),
        rng=np.random.default_rng(seed),
    )


def test_times_of_a_round_follow_from_baud_and_gaps():
    bus = BusSettings(baud=9600.0, gap_s=2e-3, reply_s=3e-3)
    got = _round(bus, start_s=100.0, n_cluster=2)
    packet_s = 12 * 10 / 9600  # eight data bits, start and stop bit
    assert bus.packet_s == pytest.approx(packet_s)
    np.testing.assert_allclose(got.sun_s, 100.0 + packet_s)
    slot_s = packet_s + 3e-3 + packet_s + 2 * 2e-3
    first = 100.0 + packet_s + 2e-3 + packet_s
    np.testing.assert_allclose(got.question_s.reshape(2, 32), np.broadcast_to(first + slot_s * np.arange(32), (2, 32)))
    np.testing.assert_allclose(got.answer_s - got.question_s, 3e-3 + packet_s)
    assert got.answer_s.max() <= 100.0 + bus.round_s()


def test_next_question_starts_after_the_answer_before():
    bus = BusSettings()
    got = _round(bus, n_cluster=1)
    starts = got.question_s - bus.packet_s
    assert np.all(starts[1:] - got.answer_s[:-1] >= bus.gap_s - 1e-12)


def test_bus_too_slow_for_the_interval_stretches_it():
    bus = BusSettings(baud=1200.0, control_interval_s=4.0)
    assert bus.round_s() > 4.0
    assert bus.interval_s == bus.round_s()
    assert BusSettings().interval_s == 4.0


def test_interval_for_one_milliradian_is_reached_by_clusters_and_not_by_one_bus():
    # Malan, §3.2.2: 1 mrad at the earth's rate is 13.75 s; §3.5.3: 313 clusters for 10 000 heliostats.
    interval_s = 1e-3 / (2.0 * np.pi / 86400.0)
    assert interval_s == pytest.approx(13.75, abs=5e-3)
    together, channel, bus, one = capacity(BusSettings(baud=9600.0, control_interval_s=interval_s), 10_000)
    assert bus.n_channel == channel.n_channel == 313
    assert bus.shortest_interval_s < interval_s
    assert channel.shortest_interval_s < interval_s
    assert one.shortest_interval_s > interval_s
    assert together.need_bps == pytest.approx(10_000 * 120 / interval_s)
    assert together.need_bps < together.have_bps
    assert bus.need_bps == pytest.approx(65 * 120 / interval_s)


@pytest.mark.parametrize(("lost", "rate"), [(0.05, 0.0), (0.0, 1e-3), (0.2, 5e-3)])
def test_parts_of_lost_and_corrupted_messages(lost, rate):
    # Question and answer of the same heliostat must both come through. Five sigma of a binomial.
    got = _round(BusSettings(lost=lost, bit_error_rate=rate))
    n = len(got.sun)
    wrong = (1.0 - lost) * (1.0 - (1.0 - rate) ** 96)
    through = 1.0 - lost - wrong

    def near(part, expected):
        return abs(part - expected) <= 5.0 * np.sqrt(max(expected * (1.0 - expected), 1e-12) / n)

    for status in (got.sun, got.question):
        assert near(np.mean(status == MessageStatus.LOST), lost)
        assert near(np.mean((status == MessageStatus.CORRUPTED) | (status == MessageStatus.UNDETECTED)), wrong)
        # what the sum misses is a few percent of packets with two wrong bits or more
        assert np.mean(status == MessageStatus.UNDETECTED) <= 0.07 * wrong * (1.0 - (1.0 - rate) ** 95)
    assert near(np.mean(got.question == MessageStatus.OK), through) or rate > 0.0
    heard = np.isfinite(got.question_s)
    assert near(np.mean(np.isfinite(got.answer_s)), np.mean(heard) * through)
    assert np.all(got.answer[~heard] == MessageStatus.SILENT)


def test_undetected_errors_arrive_and_detected_ones_do_not():
    got = _round(BusSettings(bit_error_rate=2e-2))
    assert np.sum(got.sun == MessageStatus.UNDETECTED) > 50
    np.testing.assert_array_equal(
        np.isfinite(got.sun_s), (got.sun == MessageStatus.OK) | (got.sun == MessageStatus.UNDETECTED)
    )


def test_a_late_answer_runs_into_the_next_and_not_into_another_bus():
    got = _round(BusSettings(late=0.05, late_s=1.0))
    late = got.answer == MessageStatus.LATE
    assert 0.05 < late.mean() < 0.2  # question, answer, or both: 1 - 0.95² = 0.0975, less those within the gap
    after = np.zeros_like(late)
    after[1:] = late[:-1]
    slot = np.arange(len(late)) % 32
    spoilt = got.answer == MessageStatus.CORRUPTED
    np.testing.assert_array_equal(spoilt, after & (slot > 0) & ~late)
    assert np.all(np.isinf(got.answer_s[late | spoilt]))
    assert np.all(np.isfinite(got.question_s))


def test_dead_master_and_deaf_heliostat_are_silent():
    n = 4 * 32
    master = np.arange(n) // 32 != 1
    listening = np.arange(n) != 5
    got = _round(BusSettings(), n_cluster=4, master=master, listening=listening)
    silent = ~master | ~listening
    for status, time_s in ((got.sun, got.sun_s), (got.question, got.question_s), (got.answer, got.answer_s)):
        np.testing.assert_array_equal(status == MessageStatus.SILENT, silent)
        np.testing.assert_array_equal(np.isinf(time_s), silent)


def test_same_seed_same_round():
    bus = BusSettings(lost=0.1, bit_error_rate=1e-3, late=0.1)
    first, second = _round(bus, seed=7), _round(bus, seed=7)
    np.testing.assert_array_equal(first.answer_s, second.answer_s)
    assert np.any(first.answer_s != _round(bus, seed=8).answer_s)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"lost": 1.0}, "`lost` must be at least 0 and below 1"),
        ({"bit_error_rate": -0.1}, "`bit_error_rate` must"),
        ({"baud": 0.0}, "`baud` must be"),
        ({"cluster_size": 300}, "`cluster_size` must be 1 … 254"),
        ({"urgent_repeats": 0}, "`urgent_repeats` must be at least 1"),
    ],
)
def test_settings_say_what_is_wrong(wrong, says):
    with pytest.raises(InvalidInputError, match=says):
        BusSettings(**wrong)


def test_no_field_no_capacity():
    with pytest.raises(InvalidInputError, match="`n_heliostat` must be at least 1"):
        capacity(BusSettings(), 0)
