"""The field's messages: twelve bytes each, with address, time stamp, type and checksum [1]_.

    receiver 1 | sender 1 | time stamp 2 | type 1 | payload 6 | checksum 1

Numbers of more than one byte are big-endian. The time stamp counts hundredths of a second and wraps after 655.36 s;
what it counts is not published. The checksum is the sum of the eleven bytes before it, modulo 256 (5.1): every
single wrong bit is found, two wrong bits are missed where they cancel, bytes that change places are never found.

References
----------
.. [1] Malan, A heliostat field control system, Fig. 5.9, (5.1), Appendix D.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError

__all__ = [
    "BROADCAST",
    "MASTER",
    "PACKET_BYTES",
    "RESOLUTION_RAD",
    "MessageType",
    "Packet",
    "PacketStatus",
    "angles_from_counts",
    "counts_from_angles",
    "decode",
    "encode",
    "encode_many",
    "examine",
    "forge",
    "offset_from_payload",
    "offset_payload",
    "step_counts_from_payload",
    "step_counts_payload",
    "sun_from_payload",
    "sun_payload",
]

PACKET_BYTES = 12
MASTER = 0x00
"""Address of a cluster's controller on its bus; its heliostats are 1 … 32."""
BROADCAST = 0xFF
"""Address that every heliostat of a bus listens to."""
RESOLUTION_RAD = 2.0 * math.pi / 65536.0
"""One count of a sixteen-bit axis angle, 0.096 mrad."""

_LAYOUT = struct.Struct(">BBHB6sB")
_STEPS = struct.Struct(">BHHx")
_OFFSET = struct.Struct(">Bhbh")


class MessageType(IntEnum):
    """Types of Malan's Table D.1; those from 0xE0 on are this project's own, for modes that have no type there."""

    QUERY_STEP_COUNTS = 0x01
    UPDATE_STEP_COUNTS = 0x02
    QUERY_POSITION = 0x03
    UPDATE_POSITION = 0x04
    QUERY_STATUS_FLAGS = 0x09
    UPDATE_STATUS_FLAGS = 0x10
    QUERY_GPS_TIME = 0x11
    QUERY_ACCELEROMETER = 0x21
    START_ACCELEROMETER = 0x22
    QUERY_MOVE_DIAGNOSTIC = 0x23
    START_MOVE_DIAGNOSTIC = 0x24
    SOLAR_ANGLES = 0x55
    STATE_STOW = 0xA0
    STATE_APPROACH = 0xA1
    STATE_IDLE = 0xA2
    STATE_TRACK = 0xA3
    ROUGH_STEP = 0xA8
    FINE_STEP = 0xA9
    QUERY_AIM_POSITION = 0xC0
    UPDATE_AIM_POSITION = 0xC1
    QUERY_ROTATION_MATRIX = 0xC2
    UPDATE_ROTATION_MATRIX = 0xC3
    QUERY_BIAS = 0xC4
    UPDATE_BIAS = 0xC5
    MOVE_UP_DOWN = 0xD0
    MOVE_EAST_WEST = 0xD1
    ZERO_COUNTS = 0xD2
    STOW = 0xD3
    LOCK_POSITION = 0xD4
    DEFOCUS = 0xD5
    REFOCUS = 0xD6
    LOCK_AIM = 0xD7
    SEARCH = 0xD8
    STOW_ALL = 0xD9
    POINT = 0xE0
    CALIBRATE = 0xE1


_KNOWN = np.zeros(256, np.bool_)
_KNOWN[[int(kind) for kind in MessageType]] = True


class PacketStatus(IntEnum):
    """What is wrong with bytes that should be a packet."""

    OK = 0
    WRONG_LENGTH = 1
    CHECKSUM = 2
    UNKNOWN_TYPE = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Packet:
    """One message.

    Attributes
    ----------
    receiver, sender
        Addresses on the bus, 0 … 255.
    time_stamp
        Hundredths of a second, 0 … 65535.
    kind
        What the message is.
    payload
        Six bytes; their meaning depends on ``kind``.

    Raises
    ------
    InvalidInputError
        A number that does not fit its bytes, or a payload that is not six bytes.
    """

    receiver: int
    sender: int
    time_stamp: int
    kind: MessageType
    payload: bytes = bytes(6)

    def __post_init__(self) -> None:
        for name, largest in (("receiver", 255), ("sender", 255), ("time_stamp", 65535)):
            if not 0 <= getattr(self, name) <= largest:
                raise InvalidInputError(f"`{name}` must be 0 … {largest}, got {getattr(self, name)}")
        if len(self.payload) != 6:
            raise InvalidInputError(f"`payload` must be six bytes, got {len(self.payload)}")


def encode(packet: Packet) -> bytes:
    """Return the twelve bytes of a packet, checksum included."""
    body = _LAYOUT.pack(packet.receiver, packet.sender, packet.time_stamp, packet.kind, packet.payload, 0)
    return body[:-1] + bytes([sum(body) % 256])


def decode(raw: bytes) -> Packet:
    """Return the packet that bytes hold.

    Raises
    ------
    InvalidInputError
        Not twelve bytes, a checksum that does not fit, or a type that is not known; the message says which.
    """
    if len(raw) != PACKET_BYTES:
        raise InvalidInputError(f"`raw` must be a packet of {PACKET_BYTES} bytes, got {len(raw)}; bytes were lost")
    receiver, sender, stamp, kind, payload, checksum = _LAYOUT.unpack(raw)
    expected = sum(raw[:-1]) % 256
    if checksum != expected:
        raise InvalidInputError(
            f"`raw` is corrupted: its checksum is 0x{checksum:02X}, its bytes give 0x{expected:02X}"
        )
    if not _KNOWN[kind]:
        raise InvalidInputError(f"`raw` has message type 0x{kind:02X}, which is not known")
    return Packet(receiver=receiver, sender=sender, time_stamp=stamp, kind=MessageType(kind), payload=payload)


def encode_many(
    receiver: npt.ArrayLike,
    sender: npt.ArrayLike,
    time_stamp: npt.ArrayLike,
    kind: npt.ArrayLike,
    payload: npt.ArrayLike,
) -> npt.NDArray[np.uint8]:
    """Return the bytes of many packets (packet, byte).

    Parameters
    ----------
    receiver, sender, time_stamp, kind : (packet,)
        Whole numbers; taken modulo what their bytes hold.
    payload : (packet, 6)
        Bytes.
    """
    receiver, sender, time_stamp, kind = np.broadcast_arrays(
        *(np.asarray(item).astype(np.int64) for item in (receiver, sender, time_stamp, kind))
    )
    out = np.empty((receiver.size, PACKET_BYTES), np.uint8)
    for column, value in enumerate((receiver, sender, time_stamp >> 8, time_stamp, kind)):
        out[:, column] = (value & 0xFF).astype(np.uint8)
    out[:, 5:11] = payload
    out[:, 11] = out[:, :11].sum(axis=1, dtype=np.uint64) % 256
    return out


def examine(raw: npt.NDArray[np.uint8]) -> npt.NDArray[np.int8]:
    """Return the `PacketStatus` of many packets' bytes (packet, byte)."""
    raw = np.atleast_2d(raw)
    if raw.shape[1] != PACKET_BYTES:
        return np.full(len(raw), PacketStatus.WRONG_LENGTH, np.int8)
    wrong = raw[:, :11].sum(axis=1, dtype=np.uint64) % 256 != raw[:, 11]
    unknown = ~_KNOWN[raw[:, 4]]
    return np.where(wrong, PacketStatus.CHECKSUM, np.where(unknown, PacketStatus.UNKNOWN_TYPE, PacketStatus.OK)).astype(
        np.int8
    )


def forge(raw: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Return packets (packet, byte) with two wrong bits that the checksum misses, the commonest error it misses.

    Bits of equal weight in two bytes, one from 0 to 1 and one from 1 to 0; of the highest weight any two.
    """
    out = raw.copy()
    first, second = np.triu_indices(PACKET_BYTES - 1, 1)
    for row in out:
        bit = np.unpackbits(row[: PACKET_BYTES - 1, None], axis=1)
        blind = bit[first] != bit[second]
        blind[:, 0] = True
        pair, weight = np.unravel_index(rng.choice(np.flatnonzero(blind)), blind.shape)
        row[[first[pair], second[pair]]] ^= np.uint8(128 >> int(weight))
    return out


def counts_from_angles(angle_rad: npt.ArrayLike) -> npt.NDArray[np.uint16]:
    """Return axis angles [rad] as sixteen-bit counts, whole turns dropped; the last half count is rounded."""
    turns = np.asarray(angle_rad, np.float64) / RESOLUTION_RAD
    return np.rint(turns).astype(np.int64).astype(np.uint16)


def angles_from_counts(count: npt.ArrayLike) -> FloatArray:
    """Return the axis angles of sixteen-bit counts, in [−π, π) [rad]."""
    return np.asarray(np.asarray(count).astype(np.uint16).astype(np.int16) * RESOLUTION_RAD)


def step_counts_payload(index: int, azimuth_count: int, elevation_count: int) -> bytes:
    """Return the payload of `QUERY_STEP_COUNTS`' answer and of `UPDATE_STEP_COUNTS`."""
    return _pack(_STEPS, index, azimuth_count, elevation_count)


def step_counts_from_payload(payload: bytes) -> tuple[int, int, int]:
    """Return heliostat index and the counts of both axes."""
    index, azimuth, elevation = _STEPS.unpack(payload)
    return index, azimuth, elevation


def sun_payload(azimuth_rad: float, elevation_rad: float) -> bytes:
    """Return the payload of `SOLAR_ANGLES`: thousandths of a degree in three bytes each, azimuth in [0°, 360°)."""
    azimuth = round(math.degrees(azimuth_rad) * 1000.0) % 360000
    elevation = round(math.degrees(elevation_rad) * 1000.0)
    if abs(elevation) > 90000:
        raise InvalidInputError(f"`elevation_rad` must be within ±π/2, got {elevation_rad}")
    return azimuth.to_bytes(3, "big") + elevation.to_bytes(3, "big", signed=True)


def sun_from_payload(payload: bytes) -> tuple[float, float]:
    """Return azimuth and elevation of the sun [rad]."""
    azimuth = int.from_bytes(payload[:3], "big")
    elevation = int.from_bytes(payload[3:], "big", signed=True)
    return math.radians(azimuth / 1000.0), math.radians(elevation / 1000.0)


def offset_payload(index: int, east_m: float, north_m: float, up_m: float) -> bytes:
    """Return the payload of `UPDATE_AIM_POSITION`: centimetres, ±327.67 m north and up, ±1.27 m east."""
    return _pack(_OFFSET, index, round(north_m * 100.0), round(east_m * 100.0), round(up_m * 100.0))


def offset_from_payload(payload: bytes) -> tuple[int, float, float, float]:
    """Return heliostat index and east, north, up [m]."""
    index, north, east, up = _OFFSET.unpack(payload)
    return index, east / 100.0, north / 100.0, up / 100.0


def _pack(layout: struct.Struct, *values: int) -> bytes:
    try:
        return layout.pack(*values)
    except struct.error as error:
        raise InvalidInputError(f"a payload cannot hold {values}: {error}") from error
