"""Writer of rfpose-iq; see ``docs/recording-format.md``."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, get_args

import h5py
import numpy as np

from rfpose import __version__
from rfpose.errors import InvalidInputError, RecordingError, install_remedy
from rfpose.files import Claim
from rfpose.recording import keys
from rfpose.recording.base import (
    COMPONENT_DTYPE,
    FILL_VALUE,
    STORED_DTYPE,
    IqArray,
    Recording,
    SampleFormat,
    as_stored,
)
from rfpose.recording.output import Hdf5Output
from rfpose.scenario import ID_PATTERN, MAX_ID_LENGTH, MAX_SAMPLE_INDEX, Scenario
from rfpose.truth import Truth

__all__ = ["COMPRESSIONS", "RecordingWriter"]

COMPRESSIONS: Final = ("bitshuffle-zstd", "bitshuffle-lz4", "blosc2")
"""What `RecordingWriter` compresses by, all through hdf5plugin; nothing is lost by any."""

_CHUNK_BYTES = 2**20
_SMALLEST_CHUNK_SAMPLES = 2**14
_CACHE_BYTES = 2**26
"""Chunks that are being filled, over all receivers together."""
_RECEIVER_ID = re.compile(ID_PATTERN)


def _filter(compress: str | None) -> dict[str, Any]:
    """Return a dataset's settings for a compression."""
    if compress is None:
        return {}
    if compress not in COMPRESSIONS:
        raise InvalidInputError(f"`compress` must be one of {', '.join(COMPRESSIONS)}, got {compress!r:.40}")
    try:
        import hdf5plugin
    except ImportError as error:
        raise RecordingError(
            f"compression needs the hdf5plugin library ({error}); install it, {install_remedy('compressed')}"
        ) from error
    # a sample's bits of one weight stand together: the upper ones of a weak signal are all alike
    if compress == "blosc2":
        return dict(hdf5plugin.Blosc2(cname="zstd", clevel=1, filters=hdf5plugin.Blosc2.BITSHUFFLE))
    if compress == "bitshuffle-lz4":
        return dict(hdf5plugin.Bitshuffle(cname="lz4"))
    return dict(hdf5plugin.Bitshuffle(cname="zstd", clevel=1))


class RecordingWriter:
    """Write an rfpose-iq file, as a context manager.

    The file grows under a temporary name beside ``path`` and takes its name when the block ends without an
    exception, or with the `rfpose.files.claim` around it that holds ``path``. Otherwise it is removed, and whatever was
    at ``path`` stays as it was. Interruptions wait until HDF5 has returned. Nothing that depends on the time of writing
    goes into it: equal input gives equal bytes.

    Parameters
    ----------
    path
        File to make.
    scenario
        The site, embedded as text; None when it is not known.
    receiver_ids
        Receivers, in the order in which readers will see them.
    sample_rate
        Exact rate [1/s].
    centre_frequency_hz
        Radio frequency at baseband zero [Hz]; None when it is not known.
    sample_format
        ``"int16"`` or ``"complex64"``.
    full_scale
        Largest magnitude that I or Q can take (32767 for a 16-bit digitiser); infinite when there is no limit.
    provenance
        How the samples came about, text by name.
    overwrite
        Replace an existing file.
    compress
        One of `COMPRESSIONS`, by which samples are made smaller without loss; None: they are not.

    Raises
    ------
    InvalidInputError
        An argument makes no sense.
    RecordingError
        hdf5plugin is missing; the file exists already; or, when the block begins, is being written by another process
        or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        scenario: Scenario | None,
        receiver_ids: Sequence[str],
        sample_rate: Fraction,
        centre_frequency_hz: float | None,
        sample_format: SampleFormat,
        full_scale: float,
        provenance: Mapping[str, str],
        overwrite: bool = False,
        compress: str | None = None,
    ) -> None:
        if sample_format not in get_args(SampleFormat):
            raise InvalidInputError(f"`sample_format` must be int16 or complex64, got {sample_format!r}")
        if sample_rate <= 0:
            raise InvalidInputError(f"`sample_rate` must be greater than zero, got {sample_rate}")
        if not full_scale > 0:
            raise InvalidInputError(f"`full_scale` must be greater than zero, got {full_scale}")
        if not receiver_ids or len(set(receiver_ids)) != len(receiver_ids):
            raise InvalidInputError("`receiver_ids` must name at least one receiver, and none twice")
        for receiver_id in receiver_ids:
            if not _RECEIVER_ID.fullmatch(receiver_id) or len(receiver_id) > MAX_ID_LENGTH:
                raise InvalidInputError(
                    f"`receiver_ids` may hold letters, digits, `_`, `-` and `.`, {MAX_ID_LENGTH} at most, got "
                    f"{receiver_id!r:.200}"
                )
        self._filter = _filter(compress)
        self.path = Path(path)
        Claim([self.path], force=overwrite).look()
        self._overwrite = overwrite
        self._scenario = scenario
        self._receiver_ids = tuple(receiver_ids)
        self._sample_rate = Fraction(sample_rate)
        self._centre_frequency_hz = centre_frequency_hz
        self._sample_format: SampleFormat = sample_format
        self._full_scale = float(full_scale)
        self._provenance = dict(provenance)
        self._output: Hdf5Output | None = None
        self.n_byte = 0
        """Size of the file when it is complete."""
        self._iq: dict[str, h5py.Dataset] = {}
        self._blocks: dict[str, list[list[int]]] = {name: [] for name in self._receiver_ids}
        self._stored = dict.fromkeys(self._receiver_ids, 0)

    @classmethod
    def like(
        cls,
        path: str | Path,
        recording: Recording,
        *,
        provenance: Mapping[str, str] | None = None,
        overwrite: bool = False,
        compress: str | None = None,
    ) -> Self:
        """Return a writer of what another recording holds: its site, receivers, rate, tuning and type.

        Parameters
        ----------
        path, overwrite, compress
            As for the class.
        recording
            What is to be written, or something like it.
        provenance
            As for the class; None: that of the recording.

        Raises
        ------
        InvalidInputError, RecordingError
            As the class.
        """
        return cls(
            path,
            scenario=recording.scenario,
            receiver_ids=recording.receiver_ids,
            sample_rate=recording.sample_rate,
            centre_frequency_hz=recording.centre_frequency_hz,
            sample_format=recording.sample_format,
            full_scale=recording.full_scale,
            provenance=recording.provenance if provenance is None else provenance,
            overwrite=overwrite,
            compress=compress,
        )

    def __enter__(self) -> Self:
        cache = _CACHE_BYTES // len(self._receiver_ids)
        self._output = Hdf5Output(self.path, overwrite=self._overwrite, rdcc_nbytes=cache)
        try:
            with self._output.writing() as file:
                self._create(file)
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._finish()
        finally:
            self._discard()

    def write(self, receiver_id: str, start_index: int, samples: IqArray) -> None:
        """Append samples of one receiver.

        Parameters
        ----------
        receiver_id
            One of those given at the start.
        start_index
            Index of the first sample since the Unix epoch. Where it lies beyond the end of what was written
            last, the samples between are recorded as lost; it may not lie before.
        samples : (sample, 2)
            I and Q: int16 counts, or float32 for ``"complex64"``.

        Raises
        ------
        InvalidInputError
            No such receiver, wrong shape or type, or a step back in time.
        RecordingError
            Disk full, or another failure to write.
        """
        if receiver_id not in self._blocks:
            raise InvalidInputError(
                f"`receiver_id` must be one of {', '.join(self._receiver_ids)}; got {receiver_id!r}"
            )
        dtype = COMPONENT_DTYPE[self._sample_format]
        if samples.ndim != 2 or samples.shape[1] != 2 or samples.dtype != dtype:
            raise InvalidInputError(
                f"`samples` must be {dtype.name} of shape (sample, 2), got {samples.dtype} of shape {samples.shape}"
            )
        blocks = self._blocks[receiver_id]
        reached = blocks[-1][0] + blocks[-1][1] if blocks else 0
        if start_index < reached:
            raise InvalidInputError(
                f"`start_index` must not go back: `{receiver_id}` is written up to {reached}, got {start_index}"
            )
        if start_index + len(samples) > MAX_SAMPLE_INDEX:
            raise InvalidInputError(f"`start_index` must stay below {MAX_SAMPLE_INDEX}, got {start_index}")
        if len(samples) == 0:
            return
        output = self._opened()
        dataset = self._iq[receiver_id]
        offset = self._stored[receiver_id]
        with output.writing():
            dataset.resize((offset + len(samples),))
            dataset.write_direct(
                as_stored(np.ascontiguousarray(samples), self._sample_format),
                dest_sel=np.s_[offset : offset + len(samples)],
            )
        if blocks and start_index == reached:
            blocks[-1][1] += len(samples)
        else:
            blocks.append([int(start_index), len(samples), offset])
        self._stored[receiver_id] = offset + len(samples)

    def write_truth(self, truth: Truth) -> None:
        """Write what was simulated; once."""
        with self._opened().writing() as file:
            group = file.create_group(keys.TRUTH)
            for field in dataclasses.fields(truth):
                value = getattr(truth, field.name)
                if field.name.endswith("_ids"):
                    group.create_dataset(field.name, data=list(value), dtype=h5py.string_dtype(), shape=(len(value),))
                elif value is not None:
                    dtype = np.int64 if field.name == "frame_start_index" else np.float64
                    group.create_dataset(field.name, data=np.asarray(value, dtype))

    # -- the file ----------------------------------------------------------------------------------------

    def _create(self, file: h5py.File) -> None:
        attrs = file.attrs
        attrs[keys.FORMAT] = keys.FORMAT_NAME
        attrs[keys.VERSION] = np.int64(keys.FORMAT_VERSION)
        attrs[keys.RATE_NUMERATOR] = np.int64(self._sample_rate.numerator)
        attrs[keys.RATE_DENOMINATOR] = np.int64(self._sample_rate.denominator)
        if self._centre_frequency_hz is not None:
            attrs[keys.CENTRE_FREQUENCY] = float(self._centre_frequency_hz)
        attrs[keys.SAMPLE_FORMAT] = self._sample_format
        attrs[keys.FULL_SCALE] = self._full_scale
        attrs[keys.CREATED_BY] = f"rfpose {__version__}"
        provenance = file.create_group(keys.PROVENANCE)
        for name in sorted(self._provenance):
            provenance.attrs[name] = self._provenance[name]
        if self._scenario is not None:
            file.create_dataset(keys.SCENARIO, data=self._scenario.to_toml(), dtype=h5py.string_dtype())
        form = self._sample_format
        fill = as_stored(np.full((1, 2), FILL_VALUE[form], COMPONENT_DTYPE[form]), form)[0]
        receivers = file.create_group(keys.RECEIVERS, track_order=True)
        for receiver_id in self._receiver_ids:
            self._iq[receiver_id] = receivers.create_group(receiver_id).create_dataset(
                keys.IQ,
                shape=(0,),
                maxshape=(None,),
                chunks=(self._chunk_samples(),),
                dtype=STORED_DTYPE[form],
                fillvalue=fill,
                **self._filter,
            )

    def _chunk_samples(self) -> int:
        """Return the length of a chunk: up to 1 MiB, and a whole number of them a frame, so that frames align."""
        largest = _CHUNK_BYTES // STORED_DTYPE[self._sample_format].itemsize
        if self._scenario is None:
            return largest
        frame = self._scenario.radio.frame_samples
        if frame < _SMALLEST_CHUNK_SAMPLES:
            return frame * math.ceil(_SMALLEST_CHUNK_SAMPLES / frame)
        return math.ceil(frame / math.ceil(frame / largest))

    def _finish(self) -> None:
        output = self._opened()
        with output.writing() as file:
            for receiver_id, blocks in self._blocks.items():
                table = np.array(blocks, np.int64).reshape(-1, 3)
                file[keys.RECEIVERS][receiver_id].create_dataset(keys.BLOCKS, data=table)
        self._iq.clear()
        output.commit()
        self.n_byte = output.n_byte

    def _discard(self) -> None:
        """Remove what is unfinished; after a success there is nothing."""
        self._iq.clear()
        if self._output is not None:
            self._output.discard()
            self._output = None

    def _opened(self) -> Hdf5Output:
        if self._output is None:
            raise InvalidInputError(f"the writer of {self.path} is not open: use it in a `with` statement")
        return self._output
