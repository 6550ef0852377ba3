"""From one recording format to another, streamed."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import logging
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np

from rfpose import __version__
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.files import claim
from rfpose.recording.base import IqArray, Recording, WrittenFormat
from rfpose.recording.drf import CENTRE_FREQUENCIES, import_digital_rf
from rfpose.recording.members import members
from rfpose.recording.sidecar import SCENARIO_FILE
from rfpose.recording.sigmf_files import DATATYPES, META_SUFFIX, import_sigmf
from rfpose.recording.stamps import stamp_text
from rfpose.recording.writer import RecordingWriter

__all__ = ["convert"]

_log = logging.getLogger(__name__)

_PIECE_SAMPLES = 2**20
_SUBDIRECTORY_SECONDS = 3600
_FILE_MILLISECONDS = 1000


def convert(
    source: Recording,
    target_path: str | Path,
    *,
    format: str,
    overwrite: bool = False,
    compress: str | None = None,
    verify: bool = True,
    on_progress: Callable[[int, int], None] | None = None,
) -> dict[str, str]:
    """Write a recording in another format, and read it back.

    Samples, their times and gaps, rate and tuning are kept exactly. rfpose-iq keeps scenario, truth and
    provenance too; the other two get the scenario as a file ``scenario.toml`` beside the receivers, where
    `open_recording` finds it, and have no place for truth and full scale.

    Parameters
    ----------
    source
        An open recording.
    target_path
        File (rfpose-iq) or directory (the others) to make.
    format
        ``"rfpose-iq"``, ``"digital-rf"`` or ``"sigmf"``.
    overwrite
        Replace an existing recording, in one step. A directory that holds anything else is never replaced.
    compress
        Of rfpose-iq, one of `rfpose.recording.writer.COMPRESSIONS`; None: not compressed.
    verify
        Read what was written, and compare its checksums with those of what was read.
    on_progress
        Called with samples done and samples in all, over all receivers.

    Returns
    -------
    dict
        SHA-256 of each receiver's samples (int16 or float32, little-endian, I and Q in turn), in order of time.

    Raises
    ------
    InvalidInputError
        Unknown ``format`` or ``compress``, or a format that knows no compression.
    RecordingError
        The target exists, is or holds what is read, or cannot be written; the format's library is missing; the source
        is damaged, or its receivers are tuned apart; what was written reads back as something else.
    """
    if format not in get_args(WrittenFormat):
        raise InvalidInputError(f"`format` must be one of {', '.join(get_args(WrittenFormat))}, got {format!r}")
    if compress is not None and format != "rfpose-iq":
        raise InvalidInputError(f"`compress` is for rfpose-iq, {format} has no place for it")
    _refuse_tunings(source)
    target = Path(target_path)
    digests = _Digests()
    inputs = source.files()
    if format == "rfpose-iq":
        with claim(target, inputs=inputs, force=overwrite) as job:
            _refuse_small_disk(source, target)
            _to_native(source, target, on_progress, compress=compress, digests=digests)
            if verify:
                _verify(job.part(target), target, digests)
        return digests.found()
    stream_writer = _DigitalRfStream if format == "digital-rf" else _SigmfStream
    with claim(target, inputs=inputs, force=overwrite, directories=True) as job:
        if target.exists():
            _refuse_strangers(target)
        _refuse_small_disk(source, target)
        stream_writer.library()
        if source.truth is not None:
            _log.warning("%s: %s has no place for the truth of a simulation; it is left out", target, format)
        with _library_errors(target):
            job.part(target).mkdir()
            _to_directory(source, job.part(target), stream_writer, on_progress, digests=digests)
        if verify:
            _verify(job.part(target), target, digests)
        job.complete(target)
    return digests.found()


class _Digests:
    """Checksums of receivers' samples."""

    def __init__(self) -> None:
        self._hashes: dict[str, Any] = {}

    def add(self, receiver_id: str, samples: IqArray) -> None:
        """Take the next samples of a receiver."""
        self._hashes.setdefault(receiver_id, hashlib.sha256()).update(np.ascontiguousarray(samples).data)

    def found(self) -> dict[str, str]:
        """Return the checksum of each receiver."""
        return {name: found.hexdigest() for name, found in self._hashes.items()}


def _verify(written: Path, target: Path, digests: _Digests) -> None:
    """Raise unless what stands on the disk reads as what was written."""
    from rfpose.recording.opening import open_recording

    again = _Digests()
    with open_recording(written) as recording:
        for receiver_id, _, samples in _pieces(recording, None):
            again.add(receiver_id, samples)
    wanted, found = digests.found(), again.found()
    for receiver_id in wanted:
        if found.get(receiver_id) != wanted[receiver_id]:
            raise RecordingError(
                f"{target}: what was written of receiver `{receiver_id}` reads back as something else; check disk and "
                "memory, and convert again"
            )


def _pieces(source: Recording, on_progress: Callable[[int, int], None] | None) -> Iterator[tuple[str, int, IqArray]]:
    """Yield (receiver, start index, samples) of everything recorded, receiver by receiver; the buffer is reused."""
    total = _total_samples(source)
    buffer = np.empty((_PIECE_SAMPLES, 2), source.component_dtype)
    done = 0
    for receiver_id in source.receiver_ids:
        for start, count in source.blocks(receiver_id).tolist():
            for at in range(start, start + count, _PIECE_SAMPLES):
                take = min(_PIECE_SAMPLES, start + count - at)
                yield receiver_id, at, source.read(receiver_id, at, take, out=buffer)
                done += take
                if on_progress is not None:
                    on_progress(done, total)


def _refuse_small_disk(source: Recording, target: Path) -> None:
    """Raise before anything is written if the disk cannot hold it; Digital RF's library dies noisily of that."""
    n_byte = _total_samples(source) * 2 * source.component_dtype.itemsize
    free = shutil.disk_usage(target.parent).free
    if free < n_byte:
        raise RecordingError(
            f"{target}: needs {n_byte / 1e9:.3g} GB, the disk has {free / 1e9:.3g} GB free; free space on it, or write "
            "elsewhere"
        )


def _refuse_tunings(source: Recording) -> None:
    """No format that is written can say of receivers that they are tuned apart."""
    for name, tuned in source.tunings.items():
        raise RecordingError(
            f"{source.path}: receiver `{name}` is tuned to {tuned:.12g} Hz, others to "
            f"{source.centre_frequency_hz:.12g} Hz, and one file has one tuning; convert the parts apart"
        )


def _total_samples(source: Recording) -> int:
    return sum(int(source.blocks(name)[:, 1].sum()) for name in source.receiver_ids)


def _to_native(
    source: Recording,
    target: Path,
    on_progress: Callable[[int, int], None] | None,
    *,
    compress: str | None,
    digests: _Digests,
) -> None:
    provenance = {**source.provenance, "converted_from": f"{source.format}: {source.path.name}"}
    with RecordingWriter.like(target, source, provenance=provenance, compress=compress) as writer:
        for receiver_id, start, samples in _pieces(source, on_progress):
            writer.write(receiver_id, start, samples)
            digests.add(receiver_id, samples)
        if source.truth is not None:
            writer.write_truth(source.truth)


# -- formats that are directories ----------------------------------------------------------------------------


class _Stream(ABC):
    """Writes one receiver of a directory format."""

    def __init__(self, directory: Path, receiver_id: str, source: Recording) -> None:
        self.directory = directory
        self.receiver_id = receiver_id
        self.source = source

    @staticmethod
    @abstractmethod
    def library() -> Any:
        """Return the format's library, or raise when it is not installed."""

    @abstractmethod
    def write(self, start_index: int, samples: IqArray) -> None:
        """Append samples."""

    @abstractmethod
    def finish(self) -> None:
        """Complete the files."""

    @abstractmethod
    def close(self) -> None:
        """Let the files go, complete or not."""


class _DigitalRfStream(_Stream):
    library = staticmethod(import_digital_rf)

    def __init__(self, directory: Path, receiver_id: str, source: Recording) -> None:
        super().__init__(directory, receiver_id, source)
        channel = directory / receiver_id
        channel.mkdir()
        rate = source.sample_rate
        self._first = int(source.blocks(receiver_id)[0, 0])
        self._writer = self.library().DigitalRFWriter(
            str(channel),
            np.dtype("<i2") if source.sample_format == "int16" else np.dtype("<c8"),
            subdir_cadence_secs=_SUBDIRECTORY_SECONDS,
            file_cadence_millisecs=_FILE_MILLISECONDS,
            start_global_index=self._first,
            sample_rate_numerator=rate.numerator,
            sample_rate_denominator=rate.denominator,
            uuid_str=receiver_id,
            is_complex=True,
            is_continuous=False,  # with gaps, rather than with fill values in them
            marching_periods=False,
        )
        if source.centre_frequency_hz is not None:
            metadata = channel / "metadata"
            metadata.mkdir()
            self.library().DigitalMetadataWriter(
                str(metadata), _SUBDIRECTORY_SECONDS, 1, rate.numerator, rate.denominator, "metadata"
            ).write(self._first, {CENTRE_FREQUENCIES: np.array([[source.centre_frequency_hz]])})

    def write(self, start_index: int, samples: IqArray) -> None:
        self._writer.rf_write(samples, start_index - self._first)

    def finish(self) -> None:
        self.close()

    def close(self) -> None:
        self._writer.close()


class _SigmfStream(_Stream):
    library = staticmethod(import_sigmf)

    def __init__(self, directory: Path, receiver_id: str, source: Recording) -> None:
        super().__init__(directory, receiver_id, source)
        self._data = (directory / f"{receiver_id}.sigmf-data").open("xb")
        self._sha512 = hashlib.sha512()

    def write(self, start_index: int, samples: IqArray) -> None:
        self._data.write(samples.data)
        self._sha512.update(samples.data)

    def close(self) -> None:
        self._data.close()

    def finish(self) -> None:
        self._data.flush()
        os.fsync(self._data.fileno())
        meta = self.library().SigMFFile(
            global_info={
                "core:datatype": DATATYPES[self.source.sample_format],
                "core:sample_rate": float(self.source.sample_rate),
                "core:recorder": f"rfpose {__version__}",
                "core:sha512": self._sha512.hexdigest(),
            },
        )
        offset = 0
        for start, count in self.source.blocks(self.receiver_id).tolist():
            capture = {"core:global_index": start, "core:datetime": stamp_text(start, self.source.sample_rate)}
            if self.source.centre_frequency_hz is not None:
                capture["core:frequency"] = self.source.centre_frequency_hz
            meta.add_capture(offset, metadata=capture)
            offset += count
        meta.tofile(str(self.directory / f"{self.receiver_id}{META_SUFFIX}"))


def _to_directory(
    source: Recording,
    directory: Path,
    stream_writer: type[_Stream],
    on_progress: Callable[[int, int], None] | None,
    *,
    digests: _Digests,
) -> None:
    recorded = False
    for receiver_id, pieces in itertools.groupby(_pieces(source, on_progress), key=lambda piece: piece[0]):
        with contextlib.closing(stream_writer(directory, receiver_id, source)) as stream:
            for _, start, samples in pieces:
                stream.write(start, samples)
                digests.add(receiver_id, samples)
            stream.finish()
        recorded = True
    if not recorded:
        raise RecordingError(f"{source.path}: no samples to convert; check it with `rfpose info`")
    for receiver_id in source.receiver_ids:
        if not len(source.blocks(receiver_id)):
            _log.warning("%s: receiver `%s` recorded nothing and is left out", source.path, receiver_id)
    if source.scenario is not None:
        (directory / SCENARIO_FILE).write_text(source.scenario.to_toml(), encoding="utf-8")


@contextlib.contextmanager
def _library_errors(target: Path) -> Iterator[None]:
    """Turn what the formats' libraries raise when they cannot write into ours."""
    try:
        yield
    except RecordingError:
        raise
    except (OSError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise RecordingError(
            f"{target}: cannot write the recording: {reason}; free space on the disk, check that the directory above "
            "exists and may be written, or write elsewhere"
        ) from error


def _refuse_strangers(target: Path) -> None:
    """Raise unless a directory holds a recording and nothing else, for all of it is thrown away."""
    own = set(members(target))
    strangers = sorted(path for path in target.rglob("*") if not path.is_dir() and path not in own)
    if not own and (strangers or any(target.iterdir())):
        raise RecordingError(f"{target}: a directory that is not a recording is never replaced; choose another name")
    if strangers:
        raise RecordingError(
            f"{target}: holds `{strangers[0].relative_to(target)}`, which is no part of a recording, and is not "
            "replaced; move that away, or choose another name"
        )
