"""The polled bus of a cluster, and what it delivers to whom and when.

Three tiers [1]_: one central controller, a channel of its own to each cluster's controller, and one serial bus for the
heliostats of a cluster. On the bus only the cluster's controller speaks unasked. Each control interval it sends the
sun's angles to all, then asks one heliostat after the other; the question carries the order that waits for that
heliostat, the answer its step counts and mode.

On such a bus every message has a place in time that is known beforehand, and buses do not touch each other. So an
interval is drawn for the whole field in one go (numpy, a row a heliostat) instead of as one event after the other: a
day of 10 000 heliostats at 4 s has 4 × 10⁸ questions and answers, and a library of discrete events spends Python calls
on each.

References
----------
.. [1] Malan, A heliostat field control system, §3.4-3.5, §5.3, §5.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback.fieldcontrol.packets import PACKET_BYTES, PacketStatus, examine

__all__ = ["BusSettings", "Capacity", "Delivery", "MessageStatus", "capacity", "corrupt", "poll"]

_BITS = 8 * PACKET_BYTES


class MessageStatus(IntEnum):
    """What became of a message."""

    OK = 0
    LOST = 1
    CORRUPTED = 2
    """Its checksum did not fit; thrown away."""
    UNDETECTED = 3
    """Wrong bits, and the checksum fits."""
    LATE = 4
    """An answer after its place in the order: thrown away, and the next answer with it, into which it ran."""
    SILENT = 5
    """Nobody spoke: the cluster's controller is dead, or the heliostat heard no question or has no power."""


_USABLE = np.isin(np.arange(len(MessageStatus)), (MessageStatus.OK, MessageStatus.UNDETECTED))
"""Whether a message of this status is taken for sound."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusSettings:
    """How messages travel, and how badly.

    Attributes
    ----------
    cluster_size
        Heliostats on one bus; 32 nodes are the most that RS485 drives.
    baud
        Bits a second on a cluster's bus and on its channel to the centre.
    bits_per_byte
        Ten with one start and one stop bit.
    gap_s
        Silence after each message [s].
    reply_s
        From the end of a question to the start of its answer [s].
    control_interval_s
        From one round of questions to the next [s]; longer if the bus needs longer.
    central_retry_s
        Time after which the centre repeats to a cluster what was not acknowledged [s].
    urgent_repeats
        How often an urgent order is sent to all heliostats of a bus, one after the other.
    lost
        Part of messages that vanish.
    bit_error_rate
        Chance of a wrong bit.
    late
        Part of messages that are late.
    late_s
        Mean delay of these, exponential [s].

    Raises
    ------
    InvalidInputError
        A part outside [0, 1), a time or rate that is not positive, more heliostats than addresses.
    """

    cluster_size: int = 32
    baud: float = 9600.0
    bits_per_byte: float = 10.0
    gap_s: float = 2e-3
    reply_s: float = 2e-3
    control_interval_s: float = 4.0
    central_retry_s: float = 0.5
    urgent_repeats: int = 3
    lost: float = 0.0
    bit_error_rate: float = 0.0
    late: float = 0.0
    late_s: float = 0.5

    def __post_init__(self) -> None:
        for name in ("baud", "bits_per_byte", "gap_s", "reply_s", "control_interval_s", "central_retry_s", "late_s"):
            as_positive(name, getattr(self, name))
        for name in ("lost", "bit_error_rate", "late"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise InvalidInputError(f"`{name}` must be at least 0 and below 1, got {getattr(self, name)}")
        if not 1 <= self.cluster_size <= 254:
            raise InvalidInputError(f"`cluster_size` must be 1 … 254 (one-byte addresses), got {self.cluster_size}")
        if self.urgent_repeats < 1:
            raise InvalidInputError(f"`urgent_repeats` must be at least 1, got {self.urgent_repeats}")

    @property
    def packet_s(self) -> float:
        """Time of one packet on the wire [s]."""
        return PACKET_BYTES * self.bits_per_byte / self.baud

    @property
    def slot_s(self) -> float:
        """Time of one question with its answer [s]."""
        return 2.0 * self.packet_s + self.reply_s + 2.0 * self.gap_s

    def round_s(self, n_heliostat: int | None = None) -> float:
        """Shortest control interval of a bus with so many heliostats [s]; the sun to all, then each in turn."""
        n = self.cluster_size if n_heliostat is None else n_heliostat
        return self.packet_s + self.gap_s + n * self.slot_s

    @property
    def interval_s(self) -> float:
        """Control interval that the bus keeps [s]."""
        return max(self.control_interval_s, self.round_s())

    @property
    def corrupted(self) -> float:
        """Chance that a packet has a wrong bit."""
        return float(-np.expm1(_BITS * np.log1p(-self.bit_error_rate)))

    @property
    def failing(self) -> float:
        """Chance that a packet does not get through in one piece."""
        return self.lost + self.corrupted * (1.0 - self.lost)


@dataclass(frozen=True, slots=True, kw_only=True)
class Capacity:
    """Load of one tier.

    Attributes
    ----------
    tier
        Which one.
    n_channel
        Channels of that tier.
    packets
        Packets a control interval on one channel.
    need_bps, have_bps
        Bits a second on one channel, needed without gaps, and there.
    shortest_interval_s
        Control interval below which the channel does not come round, gaps included [s].
    """

    tier: str
    n_channel: int
    packets: int
    need_bps: float
    have_bps: float
    shortest_interval_s: float


def capacity(settings: BusSettings, n_heliostat: int) -> tuple[Capacity, ...]:
    """Return the load of the three tiers, and of one bus for all as what they avoid.

    Parameters
    ----------
    settings
        Bus and control interval.
    n_heliostat
        Heliostats of the field.
    """
    if n_heliostat < 1:
        raise InvalidInputError(f"`n_heliostat` must be at least 1, got {n_heliostat}")
    n_cluster = -(-n_heliostat // settings.cluster_size)
    on_bus = min(settings.cluster_size, n_heliostat)
    bits = PACKET_BYTES * settings.bits_per_byte
    report_s = on_bus * (settings.packet_s + settings.gap_s)

    def row(tier: str, n_channel: int, packets: int, have: float, shortest: float) -> Capacity:
        return Capacity(
            tier=tier,
            n_channel=n_channel,
            packets=packets,
            need_bps=packets * bits / settings.control_interval_s,
            have_bps=have,
            shortest_interval_s=shortest,
        )

    return (
        row("central, all clusters together", 1, n_heliostat, n_cluster * settings.baud, report_s),
        row("centre to one cluster", n_cluster, on_bus, settings.baud, report_s),
        row("bus of one cluster", n_cluster, 1 + 2 * on_bus, settings.baud, settings.round_s(on_bus)),
        row("one bus for all", 1, 1 + 2 * n_heliostat, settings.baud, settings.round_s(n_heliostat)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """What one round brought, a row a heliostat.

    Attributes
    ----------
    sun_s, question_s, answer_s : (heliostat,)
        When the sun's angles and the question reached the heliostat and the answer the cluster's controller [s];
        infinite where they did not, or not in a usable state.
    sun, question, answer : (heliostat,)
        `MessageStatus` of each.
    """

    sun_s: FloatArray
    question_s: FloatArray
    answer_s: FloatArray
    sun: npt.NDArray[np.int8]
    question: npt.NDArray[np.int8]
    answer: npt.NDArray[np.int8]


def poll(
    settings: BusSettings,
    start_s: float,
    *,
    slot: npt.NDArray[np.int64],
    master_alive: npt.NDArray[np.bool_],
    listening: npt.NDArray[np.bool_],
    rng: np.random.Generator,
) -> Delivery:
    """Return what one round of questions brings to a field.

    Parameters
    ----------
    settings
        Bus and its faults.
    start_s
        When the round starts [s].
    slot : (heliostat,)
        Place of each in its bus's order, from 0. Heliostats of one bus stand together, in that order.
    master_alive, listening : (heliostat,)
        Whether its cluster's controller and the heliostat itself work.
    rng
        Source of the faults.
    """
    n = len(slot)
    sun, sun_delay = _fate(settings, n, rng)
    question, question_delay = _fate(settings, n, rng)
    answer, answer_delay = _fate(settings, n, rng)
    cut_off = ~(master_alive & listening)
    sun[cut_off] = MessageStatus.SILENT
    question[cut_off] = MessageStatus.SILENT
    sun_s = start_s + settings.packet_s + sun_delay
    question_s = start_s + 2.0 * settings.packet_s + settings.gap_s + slot * settings.slot_s + question_delay
    heard = _USABLE[question]
    answer[~heard] = MessageStatus.SILENT
    if settings.late > 0.0:
        too_late = heard & (question_delay + answer_delay > settings.gap_s)
        hit = np.zeros(n, np.bool_)
        hit[1:] = too_late[:-1] & (slot[1:] > 0)
        answer[_USABLE[answer] & hit] = MessageStatus.CORRUPTED
        answer[too_late & (answer != MessageStatus.LOST)] = MessageStatus.LATE
    answer_s = question_s + settings.reply_s + settings.packet_s + answer_delay
    return Delivery(
        sun_s=np.where(_USABLE[sun], sun_s, np.inf),
        question_s=np.where(heard, question_s, np.inf),
        answer_s=np.where(answer == int(MessageStatus.OK), answer_s, np.inf),
        sun=sun,
        question=question,
        answer=answer,
    )


def _fate(settings: BusSettings, n: int, rng: np.random.Generator) -> tuple[npt.NDArray[np.int8], FloatArray]:
    """Status and delay [s] of so many messages."""
    draw = rng.random(n)
    status = np.full(n, int(MessageStatus.OK), np.int8)
    delay = np.zeros(n)
    bad = draw < settings.failing
    if bad.any():
        index = np.flatnonzero(bad)
        lost = draw[index] < settings.lost
        status[index[lost]] = MessageStatus.LOST
        wrong = index[~lost]
        status[wrong] = MessageStatus.CORRUPTED
        if wrong.size:
            # bits of a packet as they come: what the checksum misses does not depend on what the packet says
            raw = rng.integers(0, 256, (wrong.size, PACKET_BYTES), dtype=np.uint8)
            raw[:, 4] = 0x55
            raw[:, 11] = raw[:, :11].sum(axis=1, dtype=np.uint64) % 256
            passed = examine(corrupt(raw, settings.bit_error_rate, rng)) == PacketStatus.OK
            status[wrong[passed]] = MessageStatus.UNDETECTED
    if settings.late > 0.0:
        late = rng.random(n) < settings.late
        delay[late] = rng.exponential(settings.late_s, int(late.sum()))
    return status, delay


def corrupt(raw: npt.NDArray[np.uint8], bit_error_rate: float, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Return packets (packet, byte) with at least one wrong bit each, as many as the rate gives.

    Parameters
    ----------
    raw : (packet, byte)
        Sound packets.
    bit_error_rate
        Chance of a wrong bit; the number of them is binomial, none excluded.
    rng
        Source of randomness.
    """
    n_bit = 8 * raw.shape[1]
    # The place of the first wrong bit is geometric over the packet's bits; the rest are independent after it.
    u = rng.random(len(raw))
    any_wrong = -np.expm1(n_bit * np.log1p(-bit_error_rate))
    first = np.floor(np.log1p(-u * any_wrong) / np.log1p(-bit_error_rate)).astype(np.int64)
    first = np.minimum(first, n_bit - 1)
    position = np.arange(n_bit)
    wrong = (position > first[:, None]) & (rng.random((len(raw), n_bit)) < bit_error_rate)
    wrong |= position == first[:, None]
    return raw ^ np.packbits(wrong, axis=1)
