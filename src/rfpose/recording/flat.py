"""Files in which samples lie one after the other: how they are typed, and a recording that reads them in place."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from rfpose.errors import InvalidInputError, RecordingError
from rfpose.recording.base import IndexArray, IqArray, Recording, RecordingFormat, SampleFormat
from rfpose.scenario import Scenario

__all__ = ["SAMPLE_TYPES", "FlatRecording", "FlatStream", "SampleType", "sample_type"]

SAMPLE_TYPES: Final = (
    "ci8", "cu8", "ci16_le", "ci16_be", "ci24_le", "ci24_be", "ci32_le", "ci32_be", "cf32_le", "cf32_be",
)  # fmt: skip
"""As SigMF names them: complex, signed or unsigned integers or floats, their bits, little or big endian. SigMF itself
has none of 24 bits, which sound cards and WAV have."""

_TYPE: Final = re.compile(r"c(i|u|f)(8|16|24|32)(?:_(le|be))?")
_CONVERTED_SAMPLES: Final = 2**18
"""Samples of another type than the recording's are converted in pieces of so many."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleType:
    """How a file holds samples, and what they are read as.

    Attributes
    ----------
    name
        As SigMF names it.
    component
        I or Q as stored; bytes without a meaning (``V3``) where numpy has no such type, see `numbers`.
    big_endian
        Whether the first byte counts most.
    sample_format
        What `Recording.read` gives. Integers of 8 and 16 bits become int16 exactly, floats stay, integers of 24 and 32
        bits become float32, which has 24 bits.
    zero
        Stored value that means zero.
    full_scale
        Largest magnitude after ``zero`` is taken off.
    """

    name: str
    component: np.dtype[Any]
    big_endian: bool = False
    sample_format: SampleFormat
    zero: int = 0
    full_scale: float

    @property
    def sample_bytes(self) -> int:
        """Bytes of one I and one Q."""
        return 2 * self.component.itemsize

    def numbers(self, stored: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Return stored components as numbers of a type that numpy has."""
        if self.component.kind != "V":
            return stored
        # as the upper three of four bytes, shifted down with their sign
        wide = np.zeros((*stored.shape, 4), np.uint8)
        inner = slice(0, 3) if self.big_endian else slice(1, 4)
        wide[..., inner] = np.ascontiguousarray(stored).view(np.uint8).reshape(*stored.shape, 3)
        shifted = wide.view(">i4" if self.big_endian else "<i4")[..., 0]
        numbers: np.ndarray[Any, Any] = np.right_shift(shifted, 8)
        return numbers


def sample_type(name: str) -> SampleType:
    """Return a type by its name; see `SAMPLE_TYPES`. Without ``_le`` or ``_be`` it is little-endian.

    Raises
    ------
    InvalidInputError
        Real samples, or a type that is not read.
    """
    match = _TYPE.fullmatch(name)
    kind, bits, order = match.groups() if match else ("", "", None)
    if match is None or (kind == "u" and bits != "8") or (kind == "f" and bits != "32"):
        raise InvalidInputError(f"`sample_type` must be one of {', '.join(SAMPLE_TYPES)}, got {name!r:.40}")
    big_endian = order == "be"
    component = np.dtype("V3" if bits == "24" else f"{'>' if big_endian else '<'}{kind}{int(bits) // 8}")
    if kind == "f":
        return SampleType(name=name, component=component, sample_format="complex64", full_scale=math.inf)
    return SampleType(
        name=name,
        component=component,
        big_endian=big_endian,
        sample_format="complex64" if bits in ("24", "32") else "int16",
        zero=128 if kind == "u" else 0,
        full_scale=float(2 ** (int(bits) - 1) - 1),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FlatStream:
    """Where the samples of one receiver lie in a file.

    Attributes
    ----------
    file
        The file.
    type
        Of its samples.
    segments : (segment, 3)
        Rows [start index, count, place of the first sample in the file, in bytes].
    channels
        Samples of so many receivers stand side by side; ``segments`` point to the first of them.
    channel
        Which of them is this receiver's.
    doubts
        See `Recording.doubts`.
    time_known
        See `Recording.time_known`.
    """

    file: Path
    type: SampleType
    segments: IndexArray
    channels: int = 1
    channel: int = 0
    doubts: list[str] = field(default_factory=list)
    time_known: bool = True


class FlatRecording(Recording):
    """A recording whose receivers are `FlatStream`; all have the same rate, tuning and sample format.

    Parameters
    ----------
    path, format, sample_rate, centre_frequency_hz, scenario, provenance
        See `Recording`.
    streams
        By receiver.
    """

    def __init__(
        self,
        path: Path,
        streams: Mapping[str, FlatStream],
        *,
        format: RecordingFormat,
        sample_rate: Fraction,
        centre_frequency_hz: float | None,
        scenario: Scenario | None = None,
        provenance: Mapping[str, str] | None = None,
    ) -> None:
        first = next(iter(streams.values())).type
        self._streams = dict(streams)
        self._files: dict[Path, BinaryIO] = {}
        super().__init__(
            path,
            format=format,
            receiver_ids=tuple(streams),
            sample_rate=sample_rate,
            centre_frequency_hz=centre_frequency_hz,
            sample_format=first.sample_format,
            full_scale=max(stream.type.full_scale for stream in streams.values()),
            scenario=scenario,
            provenance=provenance,
        )
        self.doubts = {name: list(stream.doubts) for name, stream in streams.items() if stream.doubts}
        self.time_known = all(stream.time_known for stream in streams.values())

    def files(self) -> list[Path]:
        """Return what it is read from."""
        return [*super().files(), *dict.fromkeys(stream.file for stream in self._streams.values())]

    def close(self) -> None:
        """Close the files of samples."""
        for file in self._files.values():
            file.close()
        self._files.clear()

    def _load_segments(self, receiver_id: str) -> IndexArray:
        return self._streams[receiver_id].segments[:, :2]

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        stream = self._streams[receiver_id]
        width = stream.type.sample_bytes * stream.channels
        place = int(stream.segments[i_segment, 2]) + skip * width
        if stream.channels == 1 and stream.type.component.newbyteorder("=") == out.dtype:
            self._fill(stream.file, place, out)
            if not stream.type.component.isnative:
                out.byteswap(inplace=True)
            return
        for at in range(0, len(out), _CONVERTED_SAMPLES):
            part = out[at : at + _CONVERTED_SAMPLES]
            stored = np.empty((len(part), stream.channels, 2), stream.type.component)
            self._fill(stream.file, place + at * width, stored)
            values = stream.type.numbers(stored[:, stream.channel])
            if stream.type.zero:
                np.subtract(values, stream.type.zero, out=part, dtype=part.dtype, casting="unsafe")
            else:
                np.copyto(part, values, casting="unsafe")

    def _fill(self, path: Path, place: int, out: np.ndarray[Any, Any]) -> None:
        """Fill an array with the bytes of a file from ``place`` on."""
        try:
            if path not in self._files:
                self._files[path] = path.open("rb", buffering=0)
            file = self._files[path]
            file.seek(place)
            rest = out.reshape(-1).view(np.uint8).data
            while rest:  # one call reads 2 GiB at most
                n_read = file.readinto(rest)  # type: ignore[attr-defined]
                if not n_read:
                    raise RecordingError(f"{path}: the file became shorter since it was opened; open it again")
                rest = rest[n_read:]
        except RecordingError:
            raise
        except OSError as error:
            raise RecordingError(f"{path}: cannot read: {error.strerror or error}; check the file") from error
