"""WAV files of IQ: plain, with the ``auxi`` of HDSDR, SDR# and SDRuno, with the GNSS stamps of KiwiSDR; above 4 GiB.

No library reads these: Python's ``wave`` knows neither floats nor RF64 nor more than one chunk of samples, and the
sigmf library, which converts WAV, takes the time of the last change of the file for the time of its first sample.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import numpy as np

from rfpose.errors import InvalidInputError, RecordingError
from rfpose.foreign import exact_rate
from rfpose.kinds import head_of
from rfpose.recording.declared import Declared
from rfpose.recording.flat import FlatRecording, FlatStream, SampleType, sample_type
from rfpose.recording.sidecar import load_sidecar_scenario, receiver_name
from rfpose.recording.stamps import LARGEST_INDEX, Capture, Stamp, place_captures
from rfpose.scenario import Scenario

__all__ = ["WavRecording", "is_wav"]

_TYPES: Final = {(1, 8): "cu8", (1, 16): "ci16_le", (1, 24): "ci24_le", (1, 32): "ci32_le", (3, 32): "cf32_le"}
"""By format code and bits. WAV's bytes have no sign."""
_EXTENSIBLE: Final = 0xFFFE
_OPEN_SIZES: Final = (0, 0xFFFFFFFF)
"""What stands for the length of samples in a file whose recorder was not stopped in order."""
_MOST_CHUNKS: Final = 2_000_000
_MOST_CHANNELS: Final = 2048
_WRAP: Final = 2**32

_GPS_EPOCH_S: Final = 315_964_800
_WEEK_S: Final = 604_800
_LEAP_SECONDS: Final = ((1_483_228_800, 18), (1_435_708_800, 17), (1_341_100_800, 16), (1_230_768_000, 15))
"""GPS is ahead of UTC by so many seconds, since [s since 1970]; as of IERS Bulletin C 71 none is to come."""
_FRESH_S: Final = 60
"""KiwiSDR's stamp is used if its receiver's last solution is no older [s]; 255 means that there was none."""
_NAME_AGREES_S: Final = 5
_RATE_AGREES: Final = Fraction(1, 1000)
_START_AGREES_S: Final = 1
_KIWI_NAME: Final = re.compile(r"(\d{8}T\d{6})Z_(\d+)(?:_(.+?))?_iq", re.ASCII)


class _Chunk(NamedTuple):
    name: bytes
    place: int
    n_byte: int


class _Form(NamedTuple):
    """What the chunk ``fmt`` says, and what is said in its place."""

    type: SampleType
    n_receiver: int
    rate: Fraction
    header_hz: int


@dataclass(slots=True)
class _Read:
    """What a file says: captures with their place and bytes, tuning, and what is doubtful."""

    captures: list[tuple[Capture, int, int]] = field(default_factory=list)
    centre_frequency_hz: float | None = None
    doubts: list[str] = field(default_factory=list)


def is_wav(path: Path) -> bool:
    """Whether a file begins as WAV does; false where it cannot be read."""
    head = head_of(path, 12)
    return head[:4] in (b"RIFF", b"RF64", b"BW64") and head[8:] == b"WAVE"


class WavRecording(FlatRecording):
    """A WAV file; every two channels are the I and Q of a receiver. Open it through `open_recording`."""

    def __init__(
        self,
        path: Path,
        *,
        scenario: Scenario | None = None,
        declared: Declared | None = None,
        follow_links: bool = False,
    ) -> None:
        declared = declared if declared is not None else Declared(format="wav")
        try:
            with path.open("rb") as file:
                chunks = list(_chunks(path, file))
                form = _form(path, file, chunks, declared)
                found = _read(path, file, chunks, form)
        except OSError as error:
            if isinstance(error, RecordingError):
                raise
            raise RecordingError(f"{path}: cannot read: {error.strerror or error}; check the file") from error
        except InvalidInputError as error:
            raise RecordingError(f"{path}: {error}") from error
        try:
            streams = _streams(path, form, found, declared)
        except InvalidInputError as error:
            raise RecordingError(f"{path}: {error}") from error
        centre = declared.centre_frequency_hz
        super().__init__(
            path,
            streams,
            format="wav",
            sample_rate=form.rate,
            centre_frequency_hz=centre if centre is not None else found.centre_frequency_hz,
            scenario=scenario
            if scenario is not None
            else load_sidecar_scenario(path.parent, follow_links=follow_links),
        )


# -- chunks --------------------------------------------------------------------------------------------------


def _chunks(path: Path, file: BinaryIO) -> Iterator[_Chunk]:
    """Yield the chunks; the length of samples beyond 4 GiB is told right."""
    size = path.stat().st_size
    head = file.read(12)
    if len(head) < 12 or head[8:] != b"WAVE":
        raise RecordingError(f"{path}: no WAV file; check that it is the right one")
    large = _large_size(path, file) if head[:4] in (b"RF64", b"BW64") else None
    at, n_chunk = 12, 0
    while at + 8 <= size:
        file.seek(at)
        name, n_byte = struct.unpack("<4sI", file.read(8))
        n_chunk += 1
        if n_chunk > _MOST_CHUNKS:
            raise RecordingError(f"{path}: more than {_MOST_CHUNKS} chunks at byte {at}; the file is damaged")
        if name == b"data":
            left = size - at - 8
            if n_byte == _OPEN_SIZES[1] and large is not None:
                n_byte = large
            elif n_byte in _OPEN_SIZES:
                n_byte = left
            elif left >= n_byte + _WRAP:  # counted modulo 4 GiB by a recorder that knows no RF64
                n_byte += (left - n_byte) // _WRAP * _WRAP
        elif n_byte > size - at - 8:
            raise RecordingError(
                f"{path}: chunk {name!r:.20} at byte {at} says that it has {n_byte} bytes, the file ends after "
                f"{size - at - 8}; it is truncated or damaged: copy it again"
            )
        yield _Chunk(name, at + 8, n_byte)
        # chunks begin at even bytes; those of KiwiSDR, all of even length, do
        at += 8 + n_byte + n_byte % 2


def _large_size(path: Path, file: BinaryIO) -> int:
    """Return the length of samples that RF64's first chunk tells."""
    name, n_byte = struct.unpack("<4sI", file.read(8).ljust(8, b"\0"))
    body = file.read(28)
    if name != b"ds64" or n_byte < 28 or len(body) < 28:
        raise RecordingError(f"{path}: RF64 without its chunk `ds64`; the file is damaged: copy it again")
    return int(struct.unpack("<QQQI", body)[1])


def _body(file: BinaryIO, chunk: _Chunk, limit: int) -> bytes:
    file.seek(chunk.place)
    return file.read(min(chunk.n_byte, limit))


def _form(path: Path, file: BinaryIO, chunks: Sequence[_Chunk], declared: Declared) -> _Form:
    chunk = next((chunk for chunk in chunks if chunk.name == b"fmt "), None)
    body = b"" if chunk is None else _body(file, chunk, 40)
    if len(body) < 16:
        raise RecordingError(f"{path}: has no chunk `fmt `, which tells how samples are stored; copy it again")
    code, n_channel, rate, _, width, bits = struct.unpack("<HHIIHH", body[:16])
    if code == _EXTENSIBLE and len(body) >= 26:
        code = struct.unpack("<H", body[24:26])[0]
    name = _TYPES.get((code, bits))
    if name is None:
        raise RecordingError(
            f"{path}: holds samples of {bits} bits (format {code}); rfpose reads integers of 8, 16, 24 and 32 bits "
            "and floats of 32 bits: record or convert it to one of them"
        )
    kind = declared.type if declared.type is not None else sample_type(name)
    if n_channel % 2 or not 2 <= n_channel <= _MOST_CHANNELS:
        raise RecordingError(
            f"{path}: has {n_channel} channel{'' if n_channel == 1 else 's'}; IQ needs two for each receiver: record I "
            "and Q, not sound"
        )
    if width != n_channel * bits // 8 or kind.sample_bytes * n_channel != 2 * width:
        raise RecordingError(f"{path}: {n_channel} channels of {bits} bits do not take {width} bytes; copy it again")
    if declared.receiver_ids and len(declared.receiver_ids) != n_channel // 2:
        n_receiver = n_channel // 2
        raise InvalidInputError(
            f"has {n_receiver} receiver{'' if n_receiver == 1 else 's'}, but {len(declared.receiver_ids)} are named; "
            "name as many as it has"
        )
    exact = declared.sample_rate
    if exact is None:
        try:
            exact = exact_rate("sample rate", rate)
        except InvalidInputError as error:
            raise InvalidInputError(f"its header gives no rate: {error}; give it as `sample_rate=RATE`") from error
    return _Form(kind, n_channel // 2, exact, rate)


# -- samples and times ---------------------------------------------------------------------------------------


def _read(path: Path, file: BinaryIO, chunks: Sequence[_Chunk], form: _Form) -> _Read:
    found = _Read()
    width, size = form.type.sample_bytes * form.n_receiver, path.stat().st_size
    kiwi = [chunk for chunk in chunks if chunk.name == b"kiwi"]
    stamps = iter(_kiwi_stamps(path, file, kiwi, form.rate, found))
    stamp: Stamp | None = None
    n_sample = 0
    for chunk in chunks:
        if chunk.name == b"kiwi":
            stamp = next(stamps)
        if chunk.name != b"data":
            continue
        n_byte = min(chunk.n_byte, size - chunk.place)
        if n_byte < chunk.n_byte:
            found.doubts.append(f"{chunk.n_byte - n_byte} of its bytes are missing at its end: it is truncated")
        found.captures.append((Capture(first_sample=n_sample, stamp=stamp), chunk.place, n_byte // width))
        n_sample += n_byte // width
        stamp = None
    if not found.captures:
        raise RecordingError(f"{path}: has no chunk `data`, so no samples; copy it again")
    if (name := _KIWI_NAME.match(path.name)) is not None:
        found.centre_frequency_hz = float(name[2])
    auxi = next((chunk for chunk in chunks if chunk.name == b"auxi"), None)
    if auxi is not None and not kiwi:
        _read_auxi(_body(file, auxi, 64), form.rate, n_sample, found)
    return found


def _read_auxi(body: bytes, rate: Fraction, n_sample: int, found: _Read) -> None:
    """Take start and tuning from the chunk that SpectraVue began with and others took over; times are UTC."""
    if len(body) < 36 or body[:1] == b"<" or body[:2] == b"\xff\xfe":
        found.doubts.append("its chunk `auxi` is of another form than that of HDSDR, SDR# and SDRuno, and is not used")
        return
    start, stop = (_system_time(body[at : at + 16]) for at in (0, 16))
    found.centre_frequency_hz = float(struct.unpack("<I", body[32:36])[0]) or None
    if start is None:
        found.doubts.append("its chunk `auxi` holds no time of a calendar")
        return
    capture, place, count = found.captures[0]
    stamp = Stamp(samples=start * rate, resolution=rate / 1000)
    found.captures[0] = Capture(first_sample=capture.first_sample, stamp=stamp), place, count
    lasts = n_sample / rate
    if stop is not None and stop > start and abs(stop - start - lasts) > 1 + lasts / 1000:
        found.doubts.append(
            f"its header says that it recorded for {float(stop - start):.6g} s, its samples last {float(lasts):.6g} s: "
            "samples were lost, or the rate is another"
        )


def _system_time(body: bytes) -> Fraction | None:
    """Return a SYSTEMTIME of Windows as seconds since 1970, or None."""
    year, month, _, day, hour, minute, second, millisecond = struct.unpack("<8H", body)
    try:
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    if year < 1970 or millisecond > 999:
        return None
    return int(whole.timestamp()) + Fraction(millisecond, 1000)


def _kiwi_stamps(
    path: Path, file: BinaryIO, chunks: Sequence[_Chunk], rate: Fraction, found: _Read
) -> list[Stamp | None]:
    """Return one stamp a chunk, None where it is stale or repeated; the file's name tells the week."""
    if not chunks:
        return []
    name = _KIWI_NAME.match(path.name)
    named_s = None if name is None else _name_seconds(name[1])
    if named_s is None:
        found.doubts.append(
            "its GNSS stamps tell the time of the week, and its name does not tell the week, as "
            "20260921T140000Z_10000000_STATION_iq.wav would"
        )
        return [None] * len(chunks)
    leap = next((seconds for since, seconds in _LEAP_SECONDS if named_s >= since), 14)
    stamps: list[Stamp | None] = []
    stale = repeated = 0
    last: Fraction | None = None
    for chunk in chunks:
        body = _body(file, chunk, 10)
        age, _, second, nanosecond = struct.unpack("<BBII", body.ljust(10, b"\xff"))
        of_week = second + Fraction(nanosecond, 10**9)
        if len(body) < 10 or age > _FRESH_S or second >= _WEEK_S or nanosecond >= 10**9:
            stale += 1
            stamps.append(None)
            continue
        # the week in which it lies nearest to the stamp before, else to the file's name
        near = (named_s if last is None else last) + leap - _GPS_EPOCH_S
        unix_s = of_week + round((near - of_week) / _WEEK_S) * _WEEK_S + _GPS_EPOCH_S - leap
        if unix_s == last:
            repeated += 1
            stamps.append(None)
            continue
        last = unix_s
        stamps.append(Stamp(samples=unix_s * rate, resolution=rate / 10**9))
    known = [stamp for stamp in stamps if stamp is not None]
    if stale:
        found.doubts.append(f"{stale} of its {len(chunks)} GNSS stamps are stale and not used")
    if repeated:
        found.doubts.append(f"{repeated} of its {len(chunks)} GNSS stamps repeat the one before and are not used")
    if known and abs(known[0].samples / rate - named_s) > _NAME_AGREES_S:
        found.doubts.append(
            f"its GNSS stamps begin {float(known[0].samples / rate - named_s):+.3f} s from the time in its name"
        )
    return stamps


def _name_seconds(text: str) -> int | None:
    try:
        return int(datetime.strptime(text, "%Y%m%dT%H%M%S").replace(tzinfo=UTC).timestamp())
    except ValueError:
        return None


def _otherwise(form: _Form, found: _Read, declared: Declared) -> list[str]:
    """Return where what was given contradicts the header; a rate may be known better than in whole numbers."""
    doubts = []
    if form.header_hz and abs(form.rate - form.header_hz) > _RATE_AGREES * form.rate:
        doubts.append(f"its header says {form.header_hz} samples/s; {float(form.rate):.12g} was given, and is taken")
    tuned, given = found.centre_frequency_hz, declared.centre_frequency_hz
    if tuned is not None and given is not None and tuned != given:
        doubts.append(f"its header says that it was tuned to {tuned:.12g} Hz; {given:.12g} was given, and is taken")
    stamp = found.captures[0][0].stamp
    if stamp is not None and declared.start_s is not None:
        later_s = float(declared.start_s - stamp.samples / form.rate)
        if abs(later_s) > _START_AGREES_S:
            beside = "earlier" if later_s > 0 else "later"
            doubts.append(f"its header says that it began {abs(later_s):.6g} s {beside} than was given, which is taken")
    return doubts


def _streams(path: Path, form: _Form, found: _Read, declared: Declared) -> dict[str, FlatStream]:
    """Lay the captures out in time, the same for all receivers of the file."""
    first = next((i for i, (capture, _, _) in enumerate(found.captures) if capture.stamp is not None), None)
    captures = [capture for capture, _, _ in found.captures]
    doubts = [*found.doubts, *_otherwise(form, found, declared)]
    time_known = True
    if declared.start_s is not None:
        given = Stamp(samples=declared.start_s * form.rate, resolution=Fraction(1))
        captures = [Capture(first_sample=c.first_sample, stamp=None if i else given) for i, c in enumerate(captures)]
    elif first is None:
        time_known = False
        doubts.append("it does not say when it was recorded; say so with `start`")
    elif first > 0:  # the first with a stamp tells of those before it
        stamp = captures[first].stamp
        assert stamp is not None
        before = Stamp(stamp.samples - captures[first].first_sample, stamp.resolution)
        captures[0] = Capture(first_sample=0, stamp=before)
    timing = place_captures(captures, form.rate)
    rows = [
        (start, count, place)
        for start, (_, place, count) in zip(timing.start_index, found.captures, strict=True)
        if count
    ]
    if any(not 0 <= start < LARGEST_INDEX - count for start, count, _ in rows):
        raise InvalidInputError("its times lie beyond what 64 bits can count; correct them")
    segments = np.array(rows, np.int64).reshape(-1, 3)
    stem = _KIWI_NAME.match(path.name)
    own = receiver_name(stem[3] if stem is not None and stem[3] else path.stem)
    names = declared.receiver_ids or (
        (own,) if form.n_receiver == 1 else tuple(f"{own}_r{k}" for k in range(form.n_receiver))
    )
    return {
        name: FlatStream(
            file=path,
            type=form.type,
            segments=segments,
            channels=form.n_receiver,
            channel=k,
            doubts=[*doubts, *timing.doubts],
            time_known=time_known,
        )
        for k, name in enumerate(names)
    }
