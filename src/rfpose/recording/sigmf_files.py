"""SigMF recordings, one a receiver; the sigmf library reads the metadata, the samples are read in place."""

from __future__ import annotations

import contextlib
import json
import math
import re
import warnings
from collections.abc import Iterator
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np

from rfpose.errors import RecordingError
from rfpose.recording.base import IndexArray, IqArray, Recording, SampleFormat
from rfpose.recording.sidecar import load_sidecar_scenario
from rfpose.scenario import Scenario

__all__ = ["DATATYPES", "META_SUFFIX", "SigmfRecording", "import_sigmf"]

META_SUFFIX: Final = ".sigmf-meta"
DATATYPES: Final[dict[SampleFormat, str]] = {"int16": "ci16_le", "complex64": "cf32_le"}
"""What is written; big-endian twins are read as well."""

_LARGEST_DENOMINATOR = 1_000_000
"""A SigMF sample rate is a decimal number; the nearest simple fraction is taken, as for a scenario's."""
_DATETIME = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d+))?Z")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def import_sigmf() -> Any:
    """Return the sigmf module, or say how to get it."""
    try:
        import sigmf
    except ImportError as error:
        raise RecordingError(
            f"SigMF needs the sigmf library ({error}); install it with `pip install 'rfpose[sigmf]'`"
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


class SigmfRecording(Recording):
    """A directory of SigMF recordings, or a single one. Open it through `open_recording`.

    The receiver is named as the file is. A capture's time is its ``core:datetime``; where that agrees with
    ``core:global_index`` to a second, the latter is exact and is taken. Later captures of a file continue by
    ``core:global_index`` if they have it, else by their own time, else without a gap.
    """

    def __init__(self, path: Path, *, scenario: Scenario | None = None) -> None:
        library = import_sigmf()
        if path.is_dir():
            metas = sorted(path.glob(f"*{META_SUFFIX}"))
        else:
            metas = [path.with_suffix(META_SUFFIX)]
        self._streams = {meta.name.removesuffix(META_SUFFIX): _load(library, meta) for meta in metas}
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
            scenario=scenario if scenario is not None else load_sidecar_scenario(metas[0].parent),
            provenance=first.about,
        )

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


def _load(library: Any, meta: Path) -> _Stream:
    with _library_errors(meta):
        json.loads(meta.read_text(encoding="utf-8"))  # the library leaves the file open where this fails
        file = library.sigmffile.fromfile(meta, skip_checksum=True, autoscale=False)
        file.validate()
        found = file.get_global_info()
    datatype = str(found["core:datatype"])
    sample_format = next((name for name, known in DATATYPES.items() if datatype[:4] == known[:4]), None)
    if sample_format is None:
        raise RecordingError(
            f"{meta}: `core:datatype` is {datatype}; rfpose reads ci16 and cf32: convert the recording to one of them"
        )
    if file.data_file is None:
        raise RecordingError(f"{meta}: the file of samples beside it is missing; copy it there")
    captures = file.get_captures() or [{"core:sample_start": 0}]
    for name in ("core:offset", "core:trailing_bytes"):
        if found.get(name, 0):
            raise RecordingError(f"{meta}: `{name}` is not supported; write the recording as one conforming dataset")
    if found.get("core:num_channels", 1) != 1 or any(capture.get("core:header_bytes", 0) for capture in captures):
        raise RecordingError(
            f"{meta}: interleaved channels and headers within the samples are not supported; write one conforming "
            "dataset a receiver"
        )
    if not isinstance(found.get("core:sample_rate"), int | float):
        raise RecordingError(f"{meta}: `core:sample_rate` is missing; add it")
    rate = Fraction(found["core:sample_rate"]).limit_denominator(_LARGEST_DENOMINATOR)
    tunings = {capture.get("core:frequency") for capture in captures}
    if len(tunings) > 1:
        raise RecordingError(
            f"{meta}: the captures have different `core:frequency`: {sorted(map(str, tunings))}; split the recording"
        )
    tuning = tunings.pop()
    about = {name: str(found[name]) for name in ("core:recorder", "core:hw", "core:description") if name in found}
    return _Stream(
        data=Path(file.data_file),
        rate=rate,
        sample_format=sample_format,
        big_endian=datatype.endswith("_be"),
        centre_frequency_hz=None if tuning is None else float(tuning),
        segments=_segments(meta, captures, int(file.sample_count), rate),
        about=about,
    )


def _segments(meta: Path, captures: list[dict[str, Any]], n_sample: int, rate: Fraction) -> IndexArray:
    """Return (segment, 3) rows [start index, count, offset]; see `SigmfRecording` on how time is found."""
    offsets = [int(capture["core:sample_start"]) for capture in captures]
    if offsets[-1] > n_sample:
        raise RecordingError(
            f"{meta}: capture {len(captures) - 1} starts at sample {offsets[-1]} of {n_sample}; the file of samples "
            "is truncated: copy it again"
        )
    first = captures[0]
    global_first = first.get("core:global_index")
    start = _index_of_datetime(meta, first, rate)
    if start is None or (global_first is not None and abs(global_first - start[0]) <= rate):
        reached = int(global_first or 0)
    else:
        reached = start[0]
    anchor = reached
    rows = []
    for i, capture in enumerate(captures):
        count = (offsets[i + 1] if i + 1 < len(offsets) else n_sample) - offsets[i]
        begin = reached
        if i > 0 and global_first is not None and "core:global_index" in capture:
            begin = anchor + int(capture["core:global_index"]) - int(global_first)
        elif i > 0 and (found := _index_of_datetime(meta, capture, rate)) is not None:
            begin, uncertainty = found
            if abs(begin - reached) <= uncertainty:  # the time stamp is too coarse to tell a gap
                begin = reached
        if begin < reached:
            raise RecordingError(
                f"{meta}: capture {i} starts {reached - begin} samples before capture {i - 1} ends; correct its "
                "`core:datetime` or `core:global_index`"
            )
        if count > 0:
            rows.append((begin, count, offsets[i]))
        reached = begin + count
    return np.array(rows, np.int64).reshape(-1, 3)


def _index_of_datetime(meta: Path, capture: dict[str, Any], rate: Fraction) -> tuple[int, int] | None:
    """Return the sample index at a capture's time stamp, and how many samples its last digit is."""
    text = capture.get("core:datetime")
    if text is None:
        return None
    match = _DATETIME.fullmatch(text)
    if match is None:
        raise RecordingError(f"{meta}: `core:datetime` is {text!r}; it must look like 2026-09-21T14:00:00.123Z")
    whole = datetime.fromisoformat(match[1]).replace(tzinfo=UTC) - _EPOCH
    digits = match[2] or ""
    resolution = Fraction(1, 10 ** len(digits))
    seconds = whole.days * 86400 + whole.seconds + int(digits or "0") * resolution
    return round(seconds * rate), math.ceil(resolution * rate)


@contextlib.contextmanager
def _library_errors(meta: Path) -> Iterator[None]:
    """Turn what the library raises or warns of into one line."""
    from jsonschema.exceptions import ValidationError  # type: ignore[import-untyped]  # comes with sigmf

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            yield
    except json.JSONDecodeError as error:
        raise RecordingError(f"{meta}: not valid JSON: {error}; copy the file again") from error
    except (OSError, ValueError, KeyError, TypeError, UserWarning, RuntimeError, ValidationError) as error:
        raise RecordingError(f"{meta}: cannot read: {str(error).splitlines()[0]}; correct or copy it again") from error
