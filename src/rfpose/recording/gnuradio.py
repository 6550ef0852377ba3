"""GNU Radio's files with a detached header (File Meta Sink): ``NAME`` holds samples, ``NAME.hdr`` what they are.

GNU Radio is no package of Python's index; its headers, serialised polymorphic types, are read here.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np

from rfpose.errors import InvalidInputError, RecordingError
from rfpose.foreign import TEXT_BYTES, exact_number, exact_rate
from rfpose.kinds import head_of
from rfpose.recording.flat import FlatRecording, FlatStream, SampleType, sample_type
from rfpose.recording.hdf5 import printable
from rfpose.recording.links import refuse_outside
from rfpose.recording.sidecar import load_sidecar_scenario, receiver_name
from rfpose.recording.stamps import LARGEST_INDEX, Capture, Stamp, place_captures
from rfpose.scenario import Scenario

__all__ = ["HEADER_SUFFIX", "GnuRadioRecording", "is_gnuradio_header"]

HEADER_SUFFIX: Final = ".hdr"
_TYPES: Final = {0: "ci8", 1: "ci16_le", 2: "ci32_le", 5: "cf32_le"}
"""By GNU Radio's gr_file_types; the machine that wrote them is taken to be little-endian, as all that run it are."""
_BEGINNING: Final = re.compile(
    rb"[\x07\x09]\x07\x02\x00"
    rb"(?:\x04strt|\x04size|\x04type|\x04cplx|\x05bytes|\x07version|\x07rx_rate|\x07rx_time)"
)
"""A dictionary whose first key is one of a header's; which comes first, GNU Radio's versions and its updates change."""
_TRUE, _FALSE, _SYMBOL, _INT32, _DOUBLE, _COMPLEX, _NULL, _PAIR = range(8)
_VECTOR, _DICT, _UNIFORM, _UINT64, _TUPLE, _INT64 = range(8, 14)
_NUMBERS: Final = {_INT32: ">i", _DOUBLE: ">d", _UINT64: ">Q", _INT64: ">q"}
_DEPTH: Final = 32
_SAME_S: Final = Fraction(1, 10**9)
_SINCE_S: Final = 10**8
"""A time before 1973 counts from the start of a device, not from the epoch."""


def is_gnuradio_header(path: Path) -> bool:
    """Whether a file begins as a detached header does; false where it cannot be read."""
    return _BEGINNING.match(head_of(path, 12)) is not None


class GnuRadioRecording(FlatRecording):
    """A file of samples with its detached header; one receiver, named as the file. Open it through `open_recording`."""

    def __init__(self, path: Path, *, scenario: Scenario | None = None, follow_links: bool = False) -> None:
        if path.suffix != HEADER_SUFFIX:
            raise RecordingError(
                f"{path}: GNU Radio's header stands among the samples; write it detached (File Meta Sink, Detached "
                "Header: On)"
            )
        data = path.with_suffix("")
        if not follow_links:
            refuse_outside(path.parent, data, named_by=path)
        if not data.is_file():
            raise RecordingError(f"{path}: the file of samples beside it is missing: `{data.name}`; copy it there")
        try:
            with path.open("rb") as file:
                content = file.read(TEXT_BYTES + 1)
            if len(content) > TEXT_BYTES:
                raise InvalidInputError(f"is longer than {TEXT_BYTES:_} bytes, more than a header may hold")
            headers = list(_headers(content))
            kind, rate = _kind(headers)
            stream, tuned = _stream(data, headers, kind, rate)
        except InvalidInputError as error:
            raise RecordingError(f"{path}: {error}; copy it again, or read the samples as raw ones") from error
        except OSError as error:
            if isinstance(error, RecordingError):
                raise
            raise RecordingError(f"{path}: cannot read: {error.strerror or error}; check the file") from error
        super().__init__(
            path,
            {receiver_name(data.stem): stream},
            format="gnuradio",
            sample_rate=rate,
            centre_frequency_hz=tuned,
            scenario=scenario
            if scenario is not None
            else load_sidecar_scenario(path.parent, follow_links=follow_links),
        )


def _headers(content: bytes) -> Iterator[dict[str, Any]]:
    """Yield the header of each segment with its extra entries."""
    at = 0
    while at < len(content):
        entries, at = _parse(content, at, 0)
        extra: Any = []
        if at < len(content):
            extra, at = _parse(content, at, 0)
        yield {**_as_dict(extra), **_as_dict(entries)}


def _as_dict(value: Any) -> dict[str, Any]:
    if not isinstance(value, list):
        raise InvalidInputError("holds no dictionary where a header must stand")
    found = {}
    for entry in value:
        if not isinstance(entry, list) or len(entry) < 2 or not isinstance(entry[0], str):
            raise InvalidInputError("holds no dictionary where a header must stand")
        found[entry[0]] = entry[1] if len(entry) == 2 else entry[1:]
    return found


def _parse(content: bytes, at: int, depth: int) -> tuple[Any, int]:
    """Return a value and where the next one begins; lists are walked, not nested.

    A pair is a list of two; a list's end, the empty list, is left out.
    """
    if depth > _DEPTH:
        raise InvalidInputError(f"is nested deeper than {_DEPTH} at byte {at}")
    tag, at = _take(content, at, ">B")
    if tag in (_TRUE, _FALSE):
        return tag == _TRUE, at
    if tag == _NULL:
        return [], at
    if tag in _NUMBERS:
        return _take(content, at, _NUMBERS[tag])
    if tag == _COMPLEX:
        return complex(*struct.unpack(">2d", _bytes(content, at, 16))), at + 16
    if tag == _SYMBOL:
        n_byte, at = _take(content, at, ">H")
        return printable(_bytes(content, at, n_byte).decode("utf-8", "replace")), at + n_byte
    if tag in (_VECTOR, _TUPLE):
        count, at = _take(content, at, ">I")
        items = []
        for _ in range(min(count, len(content))):
            item, at = _parse(content, at, depth + 1)
            items.append(item)
        return tuple(items), at
    if tag in (_PAIR, _DICT):
        items = []
        while True:
            item, at = _parse(content, at, depth + 1)
            items.append(item)
            following = content[at : at + 1]
            if following not in (bytes([_PAIR]), bytes([_DICT])):
                break
            at += 1
        last, at = _parse(content, at, depth + 1)
        return items if last == [] else [*items, last], at
    raise InvalidInputError(f"holds a value of type {tag} at byte {at - 1}, which no header has")


def _bytes(content: bytes, at: int, count: int) -> bytes:
    if at + count > len(content):
        raise InvalidInputError(f"ends within a value at byte {at}: it is truncated")
    return content[at : at + count]


def _take(content: bytes, at: int, form: str) -> tuple[Any, int]:
    n_byte = struct.calcsize(form)
    return struct.unpack(form, _bytes(content, at, n_byte))[0], at + n_byte


def _kind(headers: list[dict[str, Any]]) -> tuple[SampleType, Fraction]:
    """Return type and rate, which all segments must have."""
    if not headers:
        raise InvalidInputError("holds no header")
    first = headers[0]
    for i, header in enumerate(headers):
        for name in ("rx_rate", "size", "type", "cplx"):
            if name not in header:
                raise InvalidInputError(f"segment {i}: `{name}` is missing")
            if header[name] != first[name]:
                raise InvalidInputError(
                    f"segment {i}: `{name}` is {header[name]!r:.40}, it was {first[name]!r:.40} before; split it"
                )
    if first["cplx"] is not True or first["type"] not in _TYPES:
        raise InvalidInputError(
            f"holds {'complex' if first['cplx'] is True else 'real'} samples of type {first['type']!r:.40}; rfpose "
            "reads complex integers of 8, 16 and 32 bits and complex floats"
        )
    kind = sample_type(_TYPES[first["type"]])
    if first["size"] not in (kind.sample_bytes, kind.component.itemsize):
        raise InvalidInputError(f"`size` is {first['size']!r:.40}: vectors of samples are not read; write a stream")
    return kind, exact_rate("rx_rate", first["rx_rate"])


def _stream(
    data: Path, headers: list[dict[str, Any]], kind: SampleType, rate: Fraction
) -> tuple[FlatStream, float | None]:
    """Lay the segments out in time; what the last header counts too much or too little is told."""
    n_stored = data.stat().st_size // kind.sample_bytes
    captures, first = [], 0
    stamps = _stamps(headers, kind, rate)
    for i, header in enumerate(headers):
        n_byte = exact_number("bytes", header.get("bytes"))
        if n_byte.denominator != 1 or n_byte < 0:
            raise InvalidInputError(f"segment {i}: `bytes` must be a count, got {header.get('bytes')!r:.40}")
        captures.append(Capture(first_sample=min(first, n_stored), stamp=stamps[i]))
        first += int(n_byte) // kind.sample_bytes
    doubts = []
    if first != n_stored:
        doubts.append(
            f"its header counts {first} samples, its file holds {n_stored}: its recorder was not stopped in order"
        )
    time_known = captures[0].stamp is not None
    if not time_known:
        doubts.append("its header does not say when it was recorded (rx_time): it is not known")
    timing = place_captures(captures, rate)
    ends = [capture.first_sample for capture in captures[1:]] + [n_stored]
    rows = [
        (start, end - capture.first_sample, capture.first_sample * kind.sample_bytes)
        for start, capture, end in zip(timing.start_index, captures, ends, strict=True)
        if end > capture.first_sample
    ]
    if any(not 0 <= start < LARGEST_INDEX - count for start, count, _ in rows):
        raise InvalidInputError("its times lie beyond what 64 bits can count")
    tunings = {header["rx_freq"] for header in headers if isinstance(header.get("rx_freq"), int | float)}
    if len(tunings) > 1:
        raise InvalidInputError(
            f"the tuning changes ({', '.join(map(str, sorted(tunings)[:4]))} Hz); split the recording"
        )
    stream = FlatStream(
        file=data,
        type=kind,
        segments=np.array(rows, np.int64).reshape(-1, 3),
        doubts=[*doubts, *timing.doubts],
        time_known=time_known,
    )
    return stream, float(exact_number("rx_freq", tunings.pop())) if tunings else None


def _stamps(headers: list[dict[str, Any]], kind: SampleType, rate: Fraction) -> list[Stamp | None]:
    """Return when segments begin, None where a header tells nothing that its receiver measured.

    A header that is written because of a tag without a time, such as a gain, repeats the time of the segment before;
    one that is written because a segment is full has that of the segment before and what that should last. Either may
    be too early, and neither knows more than the count of samples.
    """
    said = [_seconds(header) for header in headers]
    stamps: list[Stamp | None] = []
    for i, seconds in enumerate(said):
        before = said[i - 1] if i else None
        if seconds is None or (i == 0 and seconds < _SINCE_S):
            stamps.append(None)
            continue
        if before is not None:
            lasts = exact_number("bytes", headers[i - 1].get("bytes")) / kind.sample_bytes / rate
            if min(abs(seconds - before), abs(seconds - before - lasts)) < _SAME_S:
                stamps.append(None)
                continue
        stamps.append(Stamp(samples=seconds * rate, resolution=rate / 10**9))
    return stamps


def _seconds(header: dict[str, Any]) -> Fraction | None:
    value = header.get("rx_time")
    if not isinstance(value, tuple) or len(value) != 2:
        return None
    return exact_number("rx_time", value[0]) + exact_number("rx_time", value[1])
