"""SigMF recordings, one a receiver; the sigmf library checks the metadata, the samples are read in place."""

from __future__ import annotations

import contextlib
import functools
import lzma
import tarfile
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import numpy as np

from rfpose.errors import InvalidInputError, RecordingError, UnlikeError, install_remedy
from rfpose.foreign import TEXT_BYTES, exact_number, exact_rate, load_json, parse_json
from rfpose.kinds import COMPRESSED_SIGMF
from rfpose.recording.base import IndexArray, SampleFormat
from rfpose.recording.flat import FlatRecording, FlatStream, SampleType, sample_type
from rfpose.recording.hdf5 import FROM_SAMPLES, printable
from rfpose.recording.links import FOLLOW, refuse_outside
from rfpose.recording.sidecar import load_sidecar_scenario
from rfpose.recording.stamps import LARGEST_INDEX, Capture, parse_stamp, place_captures
from rfpose.scenario import Scenario

__all__ = [
    "ARCHIVE_SUFFIX",
    "COLLECTION_SUFFIX",
    "DATATYPES",
    "META_SUFFIX",
    "SigmfRecording",
    "import_sigmf",
]

META_SUFFIX: Final = ".sigmf-meta"
ARCHIVE_SUFFIX: Final = ".sigmf"
COLLECTION_SUFFIX: Final = ".sigmf-collection"
DATATYPES: Final[dict[SampleFormat, str]] = {"int16": "ci16_le", "complex64": "cf32_le"}
"""What is written; `rfpose.recording.flat.SAMPLE_TYPES` are read."""

_CAPTURES_VALIDATED: Final = 100
_SINCE_S: Final = 10**8
"""An index without a time stamp that would lie before 1973 counts from something else than the epoch."""
_MOST_CHANNELS: Final = 1024
_MOST_MEMBERS: Final = 10_000
_PIECE_BYTES: Final = 2**22
_UNPACKED_BYTES: Final = 2**24
"""So much may come out of a compressed archive besides what its size lets one expect."""
_UNSOUND: Final = (
    tarfile.TarError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, ValueError, EOFError, OverflowError, RuntimeError,
)  # fmt: skip
"""What reading a damaged archive raises; RuntimeError: it is encrypted, or packed in a way that is not known."""


def import_sigmf() -> Any:
    """Return the sigmf module, or say how to get it."""
    try:
        import sigmf
    except ImportError as error:
        raise RecordingError(
            f"SigMF needs the sigmf library ({error}); install it, {install_remedy('sigmf')}"
        ) from error
    return sigmf


class _Place(NamedTuple):
    """Where samples lie: a file, or a stretch of bytes in an archive."""

    file: Path
    first: int
    n_byte: int


class _Described(NamedTuple):
    """Metadata that was found, and how to find the samples that it describes."""

    name: str
    where: str
    content: Any
    samples: Callable[[Any], _Place]
    """Takes what ``core:dataset`` says."""


class _Signal(NamedTuple):
    """What one recording's metadata says: the streams of its channels, in their order."""

    streams: list[FlatStream]
    rate: Fraction
    type: SampleType
    centre_frequency_hz: float | None
    about: dict[str, str]


class SigmfRecording(FlatRecording):
    """A directory of SigMF recordings, a single one, an archive or a collection. Open it through `open_recording`.

    The receiver is named as the file is, channels of one file ``NAME_r0``, ``NAME_r1`` and so on. On how time is found
    see `place_captures`. A compressed archive is unpacked beside what other programs keep for a while (``TMPDIR``), and
    removed from there when the recording is closed.
    """

    def __init__(self, path: Path, *, scenario: Scenario | None = None, follow_links: bool = False) -> None:
        library = import_sigmf()
        self._unpacked = contextlib.ExitStack()
        try:
            self._open(library, path, scenario, follow_links=follow_links)
        except BaseException:
            self._unpacked.close()
            raise

    def _open(self, library: Any, path: Path, scenario: Scenario | None, *, follow_links: bool) -> None:
        notes: list[str] = []
        archive = _archive_of(path)
        room = None
        if archive not in (None, "r:"):
            room = Path(self._unpacked.enter_context(tempfile.TemporaryDirectory(prefix="rfpose-sigmf-")))
        described = (
            _described(path, notes, follow_links=follow_links) if archive is None else _in_archive(path, archive, room)
        )
        signals = {found.name: _signal(library, found) for found in described}
        if not signals:
            raise RecordingError(f"{path}: holds no metadata of SigMF; check that it is the right file")
        first_name, first = next(iter(signals.items()))
        for name, signal in signals.items():
            for what, mine, theirs in (
                ("rate", signal.rate, first.rate),
                ("sample type", signal.type.name, first.type.name),
                ("centre frequency", signal.centre_frequency_hz, first.centre_frequency_hz),
            ):
                alike = what == "sample type" and _alike(signal.type, first.type)
                if mine != theirs and not alike:
                    raise UnlikeError(
                        f"{path}: `{name}` and `{first_name}` differ in {what}: {mine} and {theirs}; put them into "
                        "separate directories"
                    )
        folder = path if path.is_dir() else path.parent
        super().__init__(
            path,
            _receivers(path, signals),
            format="sigmf",
            sample_rate=first.rate,
            centre_frequency_hz=first.centre_frequency_hz,
            scenario=scenario if scenario is not None else load_sidecar_scenario(folder, follow_links=follow_links),
            provenance=first.about,
        )
        self.notes = notes

    def files(self) -> list[Path]:
        """Return what it is read from; what was unpacked is nobody else's."""
        if _archive_of(self.path) is not None:
            return [self.path]
        return super().files()

    def close(self) -> None:
        """Close the files of samples, and remove what was unpacked."""
        super().close()
        self._unpacked.close()


def _archive_of(path: Path) -> str | None:
    """Return how an archive is opened, as `tarfile` says it, or ``zip``; None: it is none."""
    if path.suffix == ARCHIVE_SUFFIX and path.is_file():
        return "r:"
    if not path.name.endswith(COMPRESSED_SIGMF):
        return None
    return "zip" if path.suffix == ".zip" else f"r:{path.suffix[1:]}"


def _alike(one: SampleType, other: SampleType) -> bool:
    """Whether two types are read as the same numbers."""
    return (one.sample_format, one.full_scale) == (other.sample_format, other.full_scale)


def _receivers(path: Path, signals: Mapping[str, _Signal]) -> dict[str, FlatStream]:
    """Return the receivers of all channels."""
    found: dict[str, FlatStream] = {}
    for name, signal in signals.items():
        for k, stream in enumerate(signal.streams):
            receiver_id = name if len(signal.streams) == 1 else f"{name}_r{k}"
            if receiver_id in found or (receiver_id != name and receiver_id in signals):
                raise RecordingError(
                    f"{path}: `{receiver_id}` stands beside channel {k} of `{name}`, which is read under the same "
                    "name; rename one of the two"
                )
            found[receiver_id] = stream
    return found


def _described(path: Path, notes: list[str], *, follow_links: bool) -> Iterator[_Described]:
    """Yield the metadata that a path stands for; what a collection lacks is added to ``notes``."""
    if path.is_dir():
        metas = sorted(path.glob(f"*{META_SUFFIX}"))
    elif path.suffix == COLLECTION_SUFFIX:
        metas = _of_collection(path, notes)
    else:
        metas = [path.with_suffix(META_SUFFIX)]
    for meta in metas:
        if not follow_links:
            refuse_outside(meta.parent, meta, named_by=meta)

        def samples(named: Any, meta: Path = meta) -> _Place:
            data = _data_file(meta, named, follow_links=follow_links)
            return _Place(data, 0, data.stat().st_size)

        yield _Described(meta.name.removesuffix(META_SUFFIX), str(meta), load_json(meta), samples)


def _of_collection(path: Path, notes: list[str]) -> list[Path]:
    """Return the metadata files that a collection names beside it."""
    content = load_json(path)
    body = content.get("collection") if isinstance(content, dict) else None
    streams = body.get("core:streams", []) if isinstance(body, dict) else None
    if not isinstance(streams, list):
        raise RecordingError(f"{path}: must hold a `collection` with `core:streams`; correct it")
    found = []
    for i, stream in enumerate(streams):
        name = stream.get("name") if isinstance(stream, dict) else stream  # as a plain name before version 1.0
        if not isinstance(name, str) or not name or Path(name).name != name or "\0" in name or len(name) > 255:
            raise RecordingError(f"{path}: `core:streams` {i} must name a recording beside it, got {name!r:.60}")
        meta = path.with_name(name.removesuffix(META_SUFFIX) + META_SUFFIX)
        if not meta.is_file():
            notes.append(f"`{path.name}` names `{printable(meta.name):.80}`, which is missing")
            continue
        digest = stream.get("hash") if isinstance(stream, dict) else None
        if isinstance(digest, str) and digest.lower() != _sha512(meta):
            notes.append(f"`{meta.name}` was changed since `{path.name}` was written: its checksum differs")
        found.append(meta)
    if not found:
        raise RecordingError(f"{path}: none of the recordings that it names is beside it; copy them there")
    return found


def _sha512(path: Path) -> str:
    import hashlib

    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha512").hexdigest()


class _Member(NamedTuple):
    """A file in an archive; ``first``: where its bytes lie in an archive that is not compressed."""

    name: str
    n_byte: int
    open: Callable[[], IO[bytes] | None]
    first: int


def _members(path: Path, how: str) -> Iterator[_Member]:
    if how == "zip":
        with zipfile.ZipFile(path) as packed:
            for info in packed.infolist():
                if not info.is_dir():
                    yield _Member(info.filename, info.file_size, functools.partial(packed.open, info), 0)
        return
    with tarfile.open(path, how) as archive:  # type: ignore[call-overload]
        for member in archive:
            if member.isreg() and not member.issparse():
                open_it = functools.partial(archive.extractfile, member)
                yield _Member(member.name, member.size, open_it, member.offset_data)


def _in_archive(path: Path, how: str, room: Path | None) -> Iterator[_Described]:
    """Yield what an archive holds; samples are read where they lie in it, those of a compressed one in ``room``."""
    metas: dict[str, str] = {}
    data: dict[str, _Place] = {}
    left = _UNPACKED_BYTES + FROM_SAMPLES * path.stat().st_size
    try:
        for i, member in enumerate(_members(path, how)):
            if i >= _MOST_MEMBERS:
                raise RecordingError(f"{path}: more than {_MOST_MEMBERS} members; unpack it and give the directory")
            name = printable(Path(member.name).name)
            if name.endswith(META_SUFFIX):
                metas[name] = _meta_in(path, name, member)
            elif room is None:
                data[name] = _Place(path, member.first, member.n_byte)
            else:
                left -= member.n_byte
                if left < 0:
                    raise RecordingError(
                        f"{path}: would unpack to more than {FROM_SAMPLES} times its size; check the archive"
                    )
                data[name] = _unpacked(path, member, room / str(i))
    except _UNSOUND as error:
        if isinstance(error, RecordingError):
            raise
        kind = "uncompressed" if room is None else "compressed"
        raise RecordingError(
            f"{path}: no sound {kind} archive ({error!s:.100}); unpack it by other means and give the directory"
        ) from error
    except OSError as error:  # among them what gzip raises
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"{path}: cannot read: {error.strerror or error!s:.100}; check the archive") from error
    size = path.stat().st_size
    for name, text in sorted(metas.items()):
        where = f"{path}: {name}"

        def samples(named: Any, name: str = name, where: str = where) -> _Place:
            wanted = named if named is not None else name.removesuffix(META_SUFFIX) + ".sigmf-data"
            found = data.get(wanted) if isinstance(wanted, str) else None
            if found is None:
                raise RecordingError(f"{where}: its samples, `{wanted!r:.80}`, are not in the archive; make it again")
            if found.file == path and found.first + found.n_byte > size:
                raise RecordingError(f"{where}: the archive is truncated; copy it again")
            return found

        yield _Described(name.removesuffix(META_SUFFIX), where, parse_json(text, source=where), samples)


def _meta_in(path: Path, name: str, member: _Member) -> str:
    """Return metadata out of an archive."""
    file = member.open()
    stored = b"" if file is None else file.read(TEXT_BYTES + 1)
    if len(stored) > TEXT_BYTES:
        raise RecordingError(f"{path}: `{name}` is longer than {TEXT_BYTES:_} bytes; check the archive")
    try:
        return stored.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: its metadata is not UTF-8; make the archive again") from error


def _unpacked(path: Path, member: _Member, target: Path) -> _Place:
    """Unpack a file of samples."""
    file = member.open()
    assert file is not None  # only regular files are looked at
    try:
        out = target.open("wb")
    except OSError as error:
        raise _no_room(path, target, error) from error
    with file, out:
        while piece := file.read(_PIECE_BYTES):
            try:
                out.write(piece)
                out.flush()
            except OSError as error:
                raise _no_room(path, target, error) from error
    return _Place(target, 0, target.stat().st_size)


def _no_room(path: Path, target: Path, error: OSError) -> RecordingError:
    return RecordingError(
        f"{path}: cannot be unpacked into {target.parent.parent}: {error.strerror or error}; set TMPDIR to a directory "
        "with room for it, or unpack it and give the directory"
    )


def _signal(library: Any, found: _Described) -> _Signal:
    try:
        _check_schema(library, found.content)
        return _read(found)
    except InvalidInputError as error:
        raise RecordingError(f"{found.where}: {error}; correct the file") from error
    except RecordingError:
        raise
    except OSError as error:  # a name that is too long, a folder that may not be looked into
        what = error.strerror or error
        raise RecordingError(
            f"{found.where}: cannot read the file of samples: {what}; check its name and rights"
        ) from error


def _check_schema(library: Any, content: Any) -> None:
    """Let the library check names and types; annotations are not used, and captures beyond the first are alike."""
    from jsonschema.exceptions import ValidationError  # type: ignore[import-untyped]  # comes with sigmf

    if not isinstance(content, dict):
        raise InvalidInputError(f"must hold one JSON object, got {type(content).__name__}")
    found = {name: content.get(name, {} if name == "global" else []) for name in ("global", "captures", "annotations")}
    for name, kind in (("global", dict), ("captures", list)):
        if not isinstance(found[name], kind):
            raise InvalidInputError(f"`{name}` must be a JSON {kind.__name__}, got {found[name]!r:.60}")
    general = {key: value for key, value in found["global"].items() if key != "core:dataset"}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what it would rather see is no fault of the samples
            library.validate.validate(
                {"global": general, "captures": found["captures"][:_CAPTURES_VALIDATED], "annotations": []}
            )
    except ValidationError as error:
        place = ".".join(str(part) for part in error.absolute_path)
        what = str(error.message).splitlines()[0]
        raise InvalidInputError(f"cannot read: {f'`{place}`: ' if place else ''}{what:.200}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InvalidInputError(f"cannot read: no SigMF metadata ({type(error).__name__}: {error})"[:200]) from error


def _read(found: _Described) -> _Signal:
    general = found.content["global"]
    datatype = str(general["core:datatype"])
    try:
        kind = sample_type(datatype)
    except InvalidInputError as error:
        raise InvalidInputError(f"`core:datatype` is {datatype:.20}; {error}") from error
    if "core:sample_rate" not in general:
        raise InvalidInputError("`core:sample_rate` is missing; add it")
    rate = exact_rate("core:sample_rate", general["core:sample_rate"])
    n_channel = _count(general, "core:num_channels", 1)
    if not 1 <= n_channel <= _MOST_CHANNELS:
        raise InvalidInputError(f"`core:num_channels` must be 1 to {_MOST_CHANNELS}, is {n_channel}")
    offset = _count(general, "core:offset")
    captures = found.content.get("captures") or [{"core:sample_start": offset}]
    for i, capture in enumerate(captures):
        if not isinstance(capture, dict):
            raise InvalidInputError(f"capture {i} must be a JSON object, got {capture!r:.60}")
    headers = [_count(capture, "core:header_bytes") for capture in captures]
    place = found.samples(general.get("core:dataset"))
    width = kind.sample_bytes * n_channel
    n_byte = place.n_byte - sum(headers) - _count(general, "core:trailing_bytes")
    n_sample, rest = divmod(n_byte, width)
    if rest or n_sample < 0:
        channels = "" if n_channel == 1 else f" in {n_channel} channels"
        raise RecordingError(
            f"{place.file}: does not hold an integer number of samples of {datatype}{channels}: "
            f"{rest if n_sample >= 0 else n_byte} bytes are left; copy it again"
        )
    rows, doubts, time_known = _segments(captures, n_sample, rate, offset=offset)
    # a segment's samples follow those before it and all headers up to its own
    before = np.cumsum(np.array(headers, np.int64))[rows[:, 3]]
    segments = np.stack([rows[:, 0], rows[:, 1], place.first + before + rows[:, 2] * width], axis=1)
    streams = [
        FlatStream(
            file=place.file,
            type=kind,
            segments=segments,
            channels=n_channel,
            channel=k,
            doubts=doubts,
            time_known=time_known,
        )
        for k in range(n_channel)
    ]
    about = {
        name: printable(str(general[name]))
        for name in ("core:recorder", "core:hw", "core:description")
        if name in general
    }
    return _Signal(streams, rate, kind, _tuning(captures), about)


def _count(data: Mapping[str, Any], name: str, default: int = 0) -> int:
    """Return a number of something that can be counted."""
    value = data.get(name, default)
    exact = exact_number(name, value)
    if exact.denominator != 1 or not 0 <= exact < LARGEST_INDEX:
        raise InvalidInputError(f"`{name}` must be a whole number below {LARGEST_INDEX}, got {value!r:.40}")
    return int(exact)


def _data_file(meta: Path, named: Any, *, follow_links: bool) -> Path:
    """Return the file of samples, which stands beside the metadata."""
    data = meta.with_suffix(".sigmf-data")
    if named is not None:
        if not isinstance(named, str) or not named or "\0" in named:
            raise InvalidInputError(f"`core:dataset` must be a file name, got {named!r:.60}")
        data = meta.parent / named
        if not follow_links and data.name != named:
            raise RecordingError(
                f"{meta}: `core:dataset` names {named!r:.200}, which is not a file beside it and is not read; {FOLLOW}"
            )
    if not follow_links:
        refuse_outside(meta.parent, data, named_by=meta)
    if not data.is_file():
        raise RecordingError(f"{meta}: the file of samples beside it is missing: `{data.name}`; copy it there")
    return data


def _tuning(captures: list[dict[str, Any]]) -> float | None:
    tunings = {capture.get("core:frequency") for capture in captures}
    if len(tunings) > 1:
        shown = ", ".join(sorted(map(str, tunings))[:4])
        raise InvalidInputError(f"the captures have different `core:frequency`: {shown}; split the recording")
    tuning = tunings.pop()
    return None if tuning is None else float(exact_number("core:frequency", tuning))


def _segments(
    captures: list[dict[str, Any]], n_sample: int, rate: Fraction, *, offset: int
) -> tuple[IndexArray, list[str], bool]:
    """Return (segment, 4) rows [start index, count, sample, capture], doubts, and whether the time is known."""
    found = [_capture(i, capture, rate, offset=offset) for i, capture in enumerate(captures)]
    ends = [c.first_sample for c in found[1:]] + [n_sample]
    for i, (capture, end) in enumerate(zip(found, ends, strict=True)):
        if capture.first_sample > n_sample:
            raise InvalidInputError(
                f"capture {i} starts at sample {capture.first_sample} of {n_sample}; the file of samples is truncated: "
                "copy it again"
            )
        if end < capture.first_sample:
            raise InvalidInputError(f"capture {i + 1} has a `core:sample_start` before that of capture {i}")
    timing = place_captures(found, rate)
    for i, start in enumerate(timing.start_index):
        if not 0 <= start < LARGEST_INDEX:
            raise InvalidInputError(f"capture {i} starts at sample {start} since 1970, more than 64 bits can count")
    rows = [
        (start, end - capture.first_sample, capture.first_sample, i)
        for i, (start, capture, end) in enumerate(zip(timing.start_index, found, ends, strict=True))
        if end > capture.first_sample
    ]
    doubts = timing.doubts
    time_known = found[0].stamp is not None or (found[0].global_index or 0) >= rate * _SINCE_S
    if not time_known:
        what = "no `core:datetime`" if found[0].global_index is not None else "neither `core:datetime` nor an index"
        doubts = [
            f"its metadata has {what}: when it was recorded is not known, nor how it lies to the other receivers",
            *doubts,
        ]
    return np.array(rows, np.int64).reshape(-1, 4), doubts, time_known


def _capture(i: int, capture: dict[str, Any], rate: Fraction, *, offset: int) -> Capture:
    """Check what is used of a capture; the file's first sample has the number ``offset``."""
    counts = []
    for name in ("core:sample_start", "core:global_index"):
        value = capture.get(name)
        if (value is None and name == "core:sample_start") or isinstance(value, bool):
            raise InvalidInputError(f"capture {i}: `{name}` must be a whole number, got {value!r}")
        exact = None if value is None else exact_number(name, value)
        if exact is not None and (exact.denominator != 1 or not 0 <= exact < LARGEST_INDEX):
            raise InvalidInputError(
                f"capture {i}: `{name}` must be a whole number below {LARGEST_INDEX}, got {value!r:.40}"
            )
        counts.append(None if exact is None else int(exact))
    stamp = None if capture.get("core:datetime") is None else parse_stamp(capture["core:datetime"], rate)
    first = (counts[0] or 0) - offset
    if first < 0:
        raise InvalidInputError(f"capture {i} has a `core:sample_start` before `core:offset`, {offset}")
    return Capture(first_sample=first, stamp=stamp, global_index=counts[1])
