"""SigMF recordings, one a receiver; the sigmf library reads the metadata, the samples are read in place."""

from __future__ import annotations

import math
import warnings
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np

from rfpose.errors import InvalidInputError, RecordingError, install_remedy
from rfpose.foreign import exact_number, exact_rate, load_json
from rfpose.recording.base import COMPONENT_DTYPE, IndexArray, IqArray, Recording, SampleFormat
from rfpose.recording.links import FOLLOW, refuse_outside
from rfpose.recording.sidecar import load_sidecar_scenario
from rfpose.recording.stamps import LARGEST_INDEX, Capture, parse_stamp, place_captures
from rfpose.scenario import Scenario

__all__ = ["DATATYPES", "META_SUFFIX", "SigmfRecording", "import_sigmf"]

META_SUFFIX: Final = ".sigmf-meta"
DATATYPES: Final[dict[SampleFormat, str]] = {"int16": "ci16_le", "complex64": "cf32_le"}
"""What is written; big-endian twins are read as well."""

_CAPTURES_VALIDATED: Final = 100
_SINCE_S: Final = 10**8
"""An index without a time stamp that would lie before 1973 counts from something else than the epoch."""


def import_sigmf() -> Any:
    """Return the sigmf module, or say how to get it."""
    try:
        import sigmf
    except ImportError as error:
        raise RecordingError(
            f"SigMF needs the sigmf library ({error}); install it, {install_remedy('sigmf')}"
        ) from error
    return sigmf


class _Stream(NamedTuple):
    """One receiver's pair of files."""

    data: Path
    rate: Fraction
    sample_format: SampleFormat
    big_endian: bool
    centre_frequency_hz: float | None
    segments: IndexArray
    """(segment, 3) rows [start index, count, offset in the data file]."""
    about: dict[str, str]
    doubts: list[str]
    time_known: bool


class SigmfRecording(Recording):
    """A directory of SigMF recordings, or a single one. Open it through `open_recording`.

    The receiver is named as the file is. On how time is found see `place_captures`.
    """

    def __init__(self, path: Path, *, scenario: Scenario | None = None, follow_links: bool = False) -> None:
        library = import_sigmf()
        if path.is_dir():
            metas = sorted(path.glob(f"*{META_SUFFIX}"))
        else:
            metas = [path.with_suffix(META_SUFFIX)]
        self._streams = {
            meta.name.removesuffix(META_SUFFIX): _load(library, meta, follow_links=follow_links) for meta in metas
        }
        first = next(iter(self._streams.values()))
        for receiver_id, stream in self._streams.items():
            for what in ("rate", "sample_format", "centre_frequency_hz"):
                if getattr(stream, what) != getattr(first, what):
                    raise RecordingError(
                        f"{path}: `{receiver_id}` and `{metas[0].name.removesuffix(META_SUFFIX)}` differ in {what}: "
                        f"{getattr(stream, what)} and {getattr(first, what)}; put them into separate directories"
                    )
        self._files: dict[str, BinaryIO] = {}
        super().__init__(
            path,
            format="sigmf",
            receiver_ids=tuple(self._streams),
            sample_rate=first.rate,
            centre_frequency_hz=first.centre_frequency_hz,
            sample_format=first.sample_format,
            full_scale=32767.0 if first.sample_format == "int16" else math.inf,
            scenario=scenario
            if scenario is not None
            else load_sidecar_scenario(metas[0].parent, follow_links=follow_links),
            provenance=first.about,
        )
        self.doubts = {name: stream.doubts for name, stream in self._streams.items() if stream.doubts}
        self.time_known = all(stream.time_known for stream in self._streams.values())

    def close(self) -> None:
        """Close the data files."""
        for file in self._files.values():
            file.close()
        self._files.clear()

    def _load_segments(self, receiver_id: str) -> IndexArray:
        return self._streams[receiver_id].segments[:, :2]

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        stream = self._streams[receiver_id]
        try:
            if receiver_id not in self._files:
                self._files[receiver_id] = stream.data.open("rb", buffering=0)
            file = self._files[receiver_id]
            file.seek((int(stream.segments[i_segment, 2]) + skip) * out.itemsize * 2)
            rest = out.data.cast("B")
            while rest:  # one call reads 2 GiB at most
                n_read = file.readinto(rest)  # type: ignore[attr-defined]
                if not n_read:
                    raise RecordingError(f"{stream.data}: the file became shorter since it was opened; open it again")
                rest = rest[n_read:]
        except RecordingError:
            raise
        except OSError as error:
            raise RecordingError(f"{stream.data}: cannot read: {error.strerror or error}; check the file") from error
        if stream.big_endian:
            out.byteswap(inplace=True)


def _load(library: Any, meta: Path, *, follow_links: bool) -> _Stream:
    if not follow_links:
        refuse_outside(meta.parent, meta, named_by=meta)
    content = load_json(meta)
    try:
        _check_schema(library, content)
        return _stream(meta, content, follow_links=follow_links)
    except InvalidInputError as error:
        raise RecordingError(f"{meta}: {error}; correct the file") from error
    except RecordingError:
        raise
    except OSError as error:  # a name that is too long, a folder that may not be looked into
        what = error.strerror or error
        raise RecordingError(f"{meta}: cannot read the file of samples: {what}; check its name and rights") from error


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


def _stream(meta: Path, content: dict[str, Any], *, follow_links: bool) -> _Stream:
    found = content["global"]
    datatype = str(found["core:datatype"])
    sample_format = next((name for name, known in DATATYPES.items() if datatype[:4] == known[:4]), None)
    if sample_format is None:
        raise InvalidInputError(
            f"`core:datatype` is {datatype:.20}; rfpose reads ci16 and cf32: convert the recording to one of them"
        )
    for name in ("core:offset", "core:trailing_bytes"):
        if found.get(name, 0):
            raise InvalidInputError(f"`{name}` is not supported; write the recording as one conforming dataset")
    captures = content.get("captures") or [{"core:sample_start": 0}]
    if found.get("core:num_channels", 1) != 1 or any(capture.get("core:header_bytes", 0) for capture in captures):
        raise InvalidInputError(
            "interleaved channels and headers within the samples are not supported; write one conforming dataset a "
            "receiver"
        )
    if "core:sample_rate" not in found:
        raise InvalidInputError("`core:sample_rate` is missing; add it")
    rate = exact_rate("core:sample_rate", found["core:sample_rate"])
    data = _data_file(meta, found.get("core:dataset"), follow_links=follow_links)
    n_sample, rest = divmod(data.stat().st_size, 2 * COMPONENT_DTYPE[sample_format].itemsize)
    if rest:
        raise RecordingError(
            f"{data}: does not hold an integer number of samples of {datatype}: {rest} bytes are left; copy it again"
        )
    segments, doubts, time_known = _segments(captures, n_sample, rate)
    return _Stream(
        data=data,
        rate=rate,
        sample_format=sample_format,
        big_endian=datatype.endswith("_be"),
        centre_frequency_hz=_tuning(captures),
        segments=segments,
        about={name: str(found[name]) for name in ("core:recorder", "core:hw", "core:description") if name in found},
        doubts=doubts,
        time_known=time_known,
    )


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


def _segments(captures: list[dict[str, Any]], n_sample: int, rate: Fraction) -> tuple[IndexArray, list[str], bool]:
    """Return (segment, 3) rows [start index, count, offset], what is doubtful, and whether the time is known."""
    found = [_capture(i, capture, rate) for i, capture in enumerate(captures)]
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
        (start, end - capture.first_sample, capture.first_sample)
        for start, capture, end in zip(timing.start_index, found, ends, strict=True)
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
    return np.array(rows, np.int64).reshape(-1, 3), doubts, time_known


def _capture(i: int, capture: dict[str, Any], rate: Fraction) -> Capture:
    """Check what is used of a capture."""
    if not isinstance(capture, dict):
        raise InvalidInputError(f"capture {i} must be a JSON object, got {capture!r:.60}")
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
    return Capture(first_sample=counts[0] or 0, stamp=stamp, global_index=counts[1])
