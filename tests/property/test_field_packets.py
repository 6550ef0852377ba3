"""Twelve-byte messages: what goes in comes out, and what is spoilt is told apart as far as a sum can."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfpose.errors import InvalidInputError
from rfpose.feedback.fieldcontrol import packets
from rfpose.feedback.fieldcontrol.bus import corrupt
from rfpose.feedback.fieldcontrol.packets import MessageType, Packet, PacketStatus

byte = st.integers(0, 255)
word = st.integers(0, 65535)
packet = st.builds(
    Packet,
    receiver=byte,
    sender=byte,
    time_stamp=word,
    kind=st.sampled_from(MessageType),
    payload=st.binary(min_size=6, max_size=6),
)


@given(packet)
def test_round_trip(sent):
    raw = packets.encode(sent)
    assert len(raw) == 12
    assert packets.decode(raw) == sent
    assert packets.examine(np.frombuffer(raw, np.uint8))[0] == PacketStatus.OK


@given(packet)
def test_bytes_lie_where_the_figure_says(sent):
    raw = packets.encode(sent)
    assert (raw[0], raw[1], raw[4]) == (sent.receiver, sent.sender, sent.kind)
    assert raw[2] * 256 + raw[3] == sent.time_stamp
    assert raw[5:11] == sent.payload
    assert raw[11] == (sum(raw[:11])) % 256


@given(st.lists(packet, min_size=1, max_size=8))
def test_many_at_once_are_the_same_bytes(sent):
    many = packets.encode_many(
        [p.receiver for p in sent],
        [p.sender for p in sent],
        [p.time_stamp for p in sent],
        [p.kind for p in sent],
        np.array([list(p.payload) for p in sent]),
    )
    assert [row.tobytes() for row in many] == [packets.encode(p) for p in sent]


@given(packet, st.integers(0, 95))
def test_every_single_wrong_bit_is_found(sent, bit):
    raw = bytearray(packets.encode(sent))
    raw[bit // 8] ^= 1 << (bit % 8)
    with pytest.raises(InvalidInputError, match=r"corrupted: its checksum is 0x.. its bytes give 0x..|corrupted"):
        packets.decode(bytes(raw))
    assert packets.examine(np.frombuffer(bytes(raw), np.uint8))[0] == PacketStatus.CHECKSUM


@given(packet, st.integers(0, 11))
def test_lost_bytes_are_found(sent, n):
    raw = packets.encode(sent)[:n]
    with pytest.raises(InvalidInputError, match=f"12 bytes, got {n}"):
        packets.decode(raw)
    assert packets.examine(np.frombuffer(raw, np.uint8))[0] == PacketStatus.WRONG_LENGTH


def test_unknown_type_is_named():
    raw = packets.encode_many([1], [0], [0], [0x77], np.zeros(6))[0]
    assert packets.examine(raw)[0] == PacketStatus.UNKNOWN_TYPE
    with pytest.raises(InvalidInputError, match="message type 0x77"):
        packets.decode(raw.tobytes())


@settings(deadline=None)
@given(packet, st.integers(0, 2**32 - 1))
def test_forged_packets_pass_and_differ(sent, seed):
    raw = np.frombuffer(packets.encode(sent), np.uint8)[None]
    forged = packets.forge(raw, np.random.default_rng(seed))
    assert np.unpackbits(raw ^ forged).sum() == 2
    assert packets.examine(forged)[0] in (PacketStatus.OK, PacketStatus.UNKNOWN_TYPE)


def test_two_wrong_bits_are_missed_as_often_as_they_cancel():
    # Equal weights in two bytes, opposite senses: (66 pairs x 8 weights) / 2, and the other half of the highest weight,
    # over all pairs of 96 bits. Tolerance: four sigma of a binomial.
    rng = np.random.default_rng(2)
    n = 200_000
    raw = packets.encode_many(
        rng.integers(0, 256, n), rng.integers(0, 256, n), rng.integers(0, 65536, n), 0x55, rng.integers(0, 256, (n, 6))
    )
    first = rng.integers(0, 96, n)
    second = (first + rng.integers(1, 96, n)) % 96
    wrong = np.zeros((n, 96), np.uint8)
    wrong[np.arange(n), first] = wrong[np.arange(n), second] = 1
    spoilt = raw ^ np.packbits(wrong, axis=1)
    missed = np.mean(packets.examine(spoilt) != PacketStatus.CHECKSUM)
    expected = (66 * 8 / 2 + 66 / 2) / (96 * 95 / 2)
    assert abs(missed - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / n)


@pytest.mark.parametrize("rate", [1e-4, 1e-2, 0.2])
def test_wrong_bits_come_as_often_as_the_rate_says(rate):
    # Given at least one: mean 96 p / (1 - (1 - p)^96), the same at every bit. Five sigma.
    rng = np.random.default_rng(3)
    n = 20_000
    bit = np.unpackbits(corrupt(np.zeros((n, 12), np.uint8), rate, rng), axis=1)
    assert bit.any(axis=1).all()
    each = rate / (1.0 - (1.0 - rate) ** 96)
    assert np.all(np.abs(bit.mean(axis=0) - each) < 5.0 * np.sqrt(each * (1.0 - each) / n))


@given(byte, word, word)
def test_step_counts_round_trip(index, azimuth, elevation):
    assert packets.step_counts_from_payload(packets.step_counts_payload(index, azimuth, elevation)) == (
        index,
        azimuth,
        elevation,
    )


@given(st.floats(0.0, 2.0 * np.pi), st.floats(-np.pi / 2, np.pi / 2))
def test_sun_round_trips_to_half_a_thousandth_of_a_degree(azimuth, elevation):
    back = packets.sun_from_payload(packets.sun_payload(azimuth, elevation))
    half = np.radians(0.5e-3) * (1.0 + 1e-9)
    assert abs((back[0] - azimuth + np.pi) % (2.0 * np.pi) - np.pi) <= half
    assert abs(back[1] - elevation) <= half


@given(byte, st.floats(-1.27, 1.27), st.floats(-327.0, 327.0), st.floats(-327.0, 327.0))
def test_aim_round_trips_to_half_a_centimetre(index, east, north, up):
    back = packets.offset_from_payload(packets.offset_payload(index, east, north, up))
    assert back[0] == index
    np.testing.assert_allclose(back[1:], (east, north, up), atol=5.001e-3)


@given(st.floats(-100.0, 100.0))
def test_axis_angle_round_trips_to_half_a_count(angle):
    back = packets.angles_from_counts(packets.counts_from_angles(angle))
    assert -np.pi <= back < np.pi
    assert abs((back - angle + np.pi) % (2.0 * np.pi) - np.pi) <= 0.5 * packets.RESOLUTION_RAD * (1.0 + 1e-6)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Packet(receiver=256, sender=0, time_stamp=0, kind=MessageType.STOW), "`receiver` must be 0 … 255"),
        (lambda: Packet(receiver=1, sender=0, time_stamp=-1, kind=MessageType.STOW), "`time_stamp` must be"),
        (lambda: Packet(receiver=1, sender=0, time_stamp=0, kind=MessageType.STOW, payload=b"1"), "six bytes, got 1"),
        (lambda: packets.offset_payload(1, 2.0, 0.0, 0.0), "a payload cannot hold"),
        (lambda: packets.step_counts_payload(1, 70_000, 0), "a payload cannot hold"),
        (lambda: packets.sun_payload(0.0, 2.0), "`elevation_rad` must be within"),
    ],
)
def test_what_does_not_fit_is_refused(make, says):
    with pytest.raises(InvalidInputError, match=says):
        make()
