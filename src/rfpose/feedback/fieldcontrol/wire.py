"""The middle tier: clusters' controllers, the orders that wait there, and the buses to the heliostats."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.feedback.fieldcontrol import packets
from rfpose.feedback.fieldcontrol.bus import BusSettings, MessageStatus, poll
from rfpose.feedback.fieldcontrol.local import NOTHING, Heliostats
from rfpose.feedback.fieldcontrol.modes import Mode, ModeEvent
from rfpose.feedback.fieldcontrol.packets import MessageType
from rfpose.feedback.fieldcontrol.records import BoolArray, FieldSettings

__all__ = ["MESSAGE_OF_COMMAND", "Wire"]

MESSAGE_OF_COMMAND = {
    ModeEvent.STOW: MessageType.STOW,
    ModeEvent.APPROACH: MessageType.STATE_APPROACH,
    ModeEvent.POINT: MessageType.POINT,
    ModeEvent.TRACK: MessageType.STATE_TRACK,
    ModeEvent.CALIBRATE: MessageType.CALIBRATE,
    ModeEvent.SEARCH: MessageType.SEARCH,
    ModeEvent.DEFOCUS: MessageType.DEFOCUS,
    ModeEvent.REFOCUS: MessageType.REFOCUS,
    ModeEvent.HOLD: MessageType.STATE_IDLE,
    ModeEvent.EMERGENCY: MessageType.STOW_ALL,
    ModeEvent.ZERO_COUNTS: MessageType.ZERO_COUNTS,
}
"""The message that carries each command."""
_COMMAND_OF_MESSAGE = {kind: event for event, kind in MESSAGE_OF_COMMAND.items()}


class Wire:
    """Messages between the centre and the heliostats, and what each side knows of the other.

    Parameters
    ----------
    heliostats
        Who listens.
    bus
        Buses and their faults.
    settings
        Behaviour of the field.
    start_s
        Time at the start [s].
    rng
        Source of faults.
    """

    STATE = (
        "next_round_s",
        "pending",
        "pending_s",
        "done",
        "urgent_s",
        "reported_mode",
        "reported_axis_rad",
        "reported_s",
        "alive",
        "round_sun_enu",
        "round_s",
        "arrival_s",
        "fate",
        "n_fate",
        "n_sent",
    )

    def __init__(
        self,
        heliostats: Heliostats,
        *,
        bus: BusSettings,
        settings: FieldSettings,
        start_s: float,
        rng: np.random.Generator,
    ) -> None:
        n = len(heliostats.mode)
        self.heliostats = heliostats
        self.bus = bus
        self.cluster = np.arange(n) // bus.cluster_size
        self.watchdog_s = settings.watchdog_intervals * bus.interval_s
        self.rng = rng
        self.next_round_s = start_s
        self.pending = np.full(n, NOTHING, np.int8)
        self.pending_s = np.full(n, np.inf)
        self.done = np.zeros(n, np.bool_)
        self.urgent_s = np.full(n, np.inf)
        self.reported_mode = heliostats.mode.copy()
        self.reported_axis_rad = np.full((n, 2), np.nan)
        self.reported_s = np.full(n, -np.inf)
        self.alive = np.ones(int(self.cluster[-1]) + 1, np.bool_)
        self.round_sun_enu = np.full(3, np.nan)
        self.round_s = start_s
        self.arrival_s = np.full((3, n), np.inf)
        self.fate = np.zeros((2, n), np.int8)
        self.n_fate = np.zeros((3, len(MessageStatus)), np.int64)
        self.n_sent = 0

    def send(self, command: ModeEvent, to: BoolArray, now_s: float, *, urgent: bool, from_centre: bool = True) -> None:
        """Put an order on its way: the centre repeats it to each cluster until that has it."""
        fresh = to & (self.pending != command)
        if not fresh.any():
            return
        self.n_sent += int(fresh.sum())
        bus = self.bus
        tries = self.rng.geometric(1.0 - bus.failing, len(self.alive)) - 1
        travel_s = bus.packet_s + bus.central_retry_s * tries if from_centre else np.zeros(len(self.alive))
        at_cluster_s = (now_s + travel_s)[self.cluster]
        self.pending[fresh] = command
        self.pending_s[fresh] = at_cluster_s[fresh]
        self.done[fresh] = False
        self.urgent_s[fresh] = np.inf
        if urgent:
            # it waits for the end of the question in progress, then is sent to all, several times
            heard = self.rng.random((bus.urgent_repeats, len(to))) >= bus.failing
            first = np.where(heard.any(axis=0), heard.argmax(axis=0) + 1.0, np.inf)
            wait = bus.slot_s + first * (bus.packet_s + bus.gap_s)
            reachable = fresh & self.alive[self.cluster] & (self.heliostats.mode != Mode.POWER_LOSS)
            self.urgent_s[reachable] = (at_cluster_s + wait)[reachable]

    def fail(self, cluster: int) -> None:
        """Let a cluster's controller die with all that it was about to say."""
        self.alive[cluster] = False
        self.silence(np.flatnonzero(self.cluster == cluster))

    def silence(self, index: npt.NDArray[np.int64]) -> None:
        """Let nothing that is on the wire reach heliostats."""
        self.arrival_s[:, index] = np.inf
        self.urgent_s[index] = np.inf

    def communicate(self, now_s: float, sun_enu: FloatArray) -> None:
        """Let the buses work until now."""
        while self.next_round_s <= now_s:
            self._deliver(self.next_round_s)
            self._begin_round(self.next_round_s, sun_enu)
            self.next_round_s += self.bus.interval_s
        self._deliver(now_s)

    def rest(self, until_s: float) -> bool:
        """Whether nothing is on the wire until a time that does more than be heard, before the next round."""
        if (self.urgent_s <= until_s).any():
            return False
        # what forged messages say is drawn in the order in which they are taken up
        forged = self.fate == int(MessageStatus.UNDETECTED)
        if forged.any() and (forged & (self.arrival_s[:2] <= until_s)).any():
            return False
        # an order waits for its question; with a dead cluster's controller it may wait for long
        waits = (self.pending != NOTHING) & ~self.done
        return not (waits.any() and (waits & (self.arrival_s[1] <= until_s)).any())

    def _begin_round(self, start_s: float, sun_enu: FloatArray) -> None:
        """Draw a round; what of the last one is still on its way is out of date and dropped."""
        brought = poll(
            self.bus,
            start_s,
            slot=self.heliostats.slot,
            master_alive=self.alive[self.cluster],
            listening=self.heliostats.mode != int(Mode.POWER_LOSS),
            rng=self.rng,
        )
        self.arrival_s = np.array([brought.sun_s, brought.question_s, brought.answer_s])
        self.fate = np.array([brought.sun, brought.question])
        self.n_fate += [np.bincount(status, minlength=len(MessageStatus)) for status in (*self.fate, brought.answer)]
        said = packets.sun_from_payload(self._sun_payload(sun_enu))
        self.round_sun_enu = geometry.enu_from_azimuth_elevation(*said)
        self.round_s = start_s

    @staticmethod
    def _sun_payload(sun_enu: FloatArray) -> bytes:
        azimuth, elevation = geometry.azimuth_elevation_from_enu(sun_enu)
        return packets.sun_payload(float(azimuth), float(elevation))

    def _deliver(self, until_s: float) -> None:
        """Let everything arrive that does until a time."""
        if (self.urgent_s <= until_s).any():
            urgent = np.flatnonzero(self.urgent_s <= until_s)
            self.heliostats.hear(urgent, self.urgent_s[urgent])
            self.urgent_s[urgent] = np.inf
            self._obey(urgent, until_s)
        arrived = self.arrival_s <= until_s
        if not arrived.any():
            return
        for i, receive in enumerate((self._hear_sun, self._hear_question, self._hear_answer)):
            index = arrived[i].nonzero()[0]
            if index.size:
                at_s = self.arrival_s[i, index]
                self.arrival_s[i, index] = np.inf
                receive(index, at_s, until_s)

    def _hear_sun(self, index: npt.NDArray[np.int64], at_s: FloatArray, now_s: float) -> None:
        self.heliostats.hear(index, at_s)
        good = self.fate[0, index] == int(MessageStatus.OK)
        self.heliostats.believe_sun(index[good], self.round_sun_enu[None], self.round_s, fresh_s=self.watchdog_s)
        for i in index[~good]:
            self._hear_forged_sun(int(i))

    def _hear_forged_sun(self, i: int) -> None:
        """Sun angles with wrong bits that the checksum missed: taken for what they say."""
        raw = self._forged(packets.BROADCAST, MessageType.SOLAR_ANGLES, self._sun_payload(self.round_sun_enu))
        if raw[0] == packets.BROADCAST and raw[4] == MessageType.SOLAR_ANGLES:
            said = geometry.enu_from_azimuth_elevation(*packets.sun_from_payload(raw[5:11].tobytes()))
            self.heliostats.believe_sun(np.array([i]), said[None], self.round_s, fresh_s=self.watchdog_s)

    def _forged(self, receiver: int, kind: MessageType, payload: bytes = bytes(6)) -> npt.NDArray[np.uint8]:
        stamp = int(self.round_s * 100.0) & 0xFFFF
        raw = packets.encode_many([receiver], packets.MASTER, stamp, kind, np.frombuffer(payload, np.uint8))
        return np.asarray(packets.forge(raw, self.rng)[0])

    def _hear_question(self, index: npt.NDArray[np.int64], at_s: FloatArray, now_s: float) -> None:
        self.heliostats.hear(index, at_s)
        good = self.fate[1, index] == int(MessageStatus.OK)
        ordered = (self.pending[index] != NOTHING) & (self.pending_s[index] <= at_s)
        self._obey(index[good & ordered], now_s)
        for i in index[~good]:
            self._hear_forged_question(int(i), now_s)

    def _hear_forged_question(self, i: int, now_s: float) -> None:
        """Do as a question with wrong bits says that the checksum missed, if it still is for this heliostat."""
        waits = self.pending[i] != NOTHING
        kind = MESSAGE_OF_COMMAND[ModeEvent(self.pending[i])] if waits else MessageType.QUERY_STEP_COUNTS
        address = int(self.heliostats.slot[i]) + 1
        raw = self._forged(address, kind)
        if raw[0] == address and int(raw[4]) in _COMMAND_OF_MESSAGE:
            self.heliostats.apply(np.array([i]), _COMMAND_OF_MESSAGE[MessageType(int(raw[4]))], now_s)

    def _hear_answer(self, index: npt.NDArray[np.int64], at_s: FloatArray, now_s: float) -> None:
        """Take a report over; an order that was obeyed or refused is done with."""
        self.reported_mode[index] = self.heliostats.mode[index]
        axis = self.heliostats.axis_rad.take(index, axis=0)
        known = np.where(np.isnan(axis), 0.0, axis)
        self.reported_axis_rad[index] = packets.angles_from_counts(packets.counts_from_angles(known))
        self.reported_s[index] = at_s
        self.pending[index[self.done[index]]] = NOTHING

    def _obey(self, index: npt.NDArray[np.int64], now_s: float) -> None:
        """Do what is ordered, once: the time stamp tells a repeated order."""
        index = index[(self.pending[index] != NOTHING) & ~self.done[index]]
        if index.size == 0:
            return
        self.done[index] = True
        for event in np.unique(self.pending[index]):
            self.heliostats.apply(index[self.pending[index] == event], ModeEvent(event), now_s)
