"""Reader of rfpose-iq, the project's own HDF5 layout; see ``docs/recording-format.md``."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, cast

import h5py
import numpy as np

from rfpose.errors import InvalidInputError, RecordingError, RfposeError
from rfpose.foreign import exact_rate
from rfpose.heaps import open_hdf5
from rfpose.kinds import told_kind
from rfpose.recording import keys
from rfpose.recording.alike import Layout
from rfpose.recording.base import STORED_DTYPE, IndexArray, IqArray, Recording, SampleFormat, as_stored
from rfpose.recording.hdf5 import FROM_SAMPLES, FROM_TABLE, find_dataset, find_item, printable
from rfpose.recording.stored import StoredSamples, where_stored
from rfpose.scenario import MAX_SAMPLE_INDEX, Scenario, parse_scenario
from rfpose.truth import Truth

__all__ = ["NativeRecording"]

_REMEDY = "the file is damaged or was not written by rfpose: make it again with `rfpose convert` or `rfpose simulate`"
_HDF5_ERRORS: Final = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError)
"""What h5py raises at what it cannot read or has no type for."""
_RECEIVER_ID: Final = re.compile(r"[A-Za-z0-9_.\-]+")
_INDEX_DTYPE: Final = np.dtype("<i8")
_LARGEST_FREQUENCY_HZ: Final = 1e15
_TRUTH_IDS: Final = ("heliostat_ids", "receiver_ids", "transmitter_ids")
_TRUTH_AXES: Final[dict[str, tuple[str | int, ...]]] = {
    "normal_enu": ("frame", "heliostat", 3),
    "receiver_enu_m": ("frame", "receiver", 3),
    "frame_start_index": ("frame",),
    "transmitter_phase_rad": ("frame", "transmitter", "tone"),
    "clock_ppm": ("receiver",),
    "receiver_delay_s": ("frame", "receiver"),
    "tone_snr": ("frame", "receiver", "transmitter", "tone"),
}


class NativeRecording(Recording):
    """An rfpose-iq file. Open it through `open_recording`."""

    reads_side_by_side = True

    def __init__(self, path: Path, *, scenario: Scenario | None = None, follow_links: bool = False) -> None:
        self._file = _open_hdf5(path)
        self._follow_links = follow_links
        try:
            fields = _Fields(path, self._file, follow_links=follow_links)
            fields.check_format()
            sample_format = fields.text(keys.SAMPLE_FORMAT)
            if sample_format not in STORED_DTYPE:
                raise fields.error(keys.SAMPLE_FORMAT, f"must be int16 or complex64, is {sample_format!r:.60}")
            self._iq: dict[str, h5py.Dataset] = {}
            super().__init__(
                path,
                format="rfpose-iq",
                receiver_ids=fields.receiver_ids(),
                sample_rate=fields.sample_rate(),
                centre_frequency_hz=fields.centre_frequency(),
                sample_format=cast(SampleFormat, sample_format),
                full_scale=fields.full_scale(),
                scenario=scenario if scenario is not None else fields.scenario(),
                truth=fields.truth(),
                provenance=fields.provenance(),
            )
            if not self.receiver_ids:
                raise RecordingError(f"{path}: `/{keys.RECEIVERS}` holds no receiver; {_REMEDY}")
            for receiver_id in self.receiver_ids:
                self._iq[receiver_id] = fields.iq(receiver_id, STORED_DTYPE[sample_format])
            self._fields = fields
            self._offsets: dict[str, IndexArray] = {}
            self._stored: dict[str, StoredSamples | None] = {}
            self._file_number = int(self._file.id.get_vfd_handle()) if self._file.driver == "sec2" else -1
        except BaseException as error:
            self._file.close()
            if isinstance(error, _HDF5_ERRORS) and not isinstance(error, RfposeError):
                raise RecordingError(f"{path}: damaged HDF5 file: {error}; copy it again") from error
            raise

    def close(self) -> None:
        """Close the file."""
        self._file_number = -1  # another file may get the number
        self._file.close()

    def layout(self) -> Layout | None:
        """Return by what other files are known to be like this one; None: only HDF5 can read it."""
        samples, tables, free = {}, {}, []
        try:
            for name in self.receiver_ids:
                stored = self._where(name)
                begin = self._fields.place_of_blocks(name)
                if stored is None or begin is None:
                    return None
                tables[name] = begin, np.column_stack([self._segments_of(name), self._offsets[name]])
                samples[name] = stored
            free = self._fields.places_of_truth()
            return Layout(self, samples=samples, tables=tables, free=free, file_number=self._file_number)
        except (*_HDF5_ERRORS, RecordingError):  # told when it is read
            return None

    def _where(self, receiver_id: str) -> StoredSamples | None:
        if receiver_id not in self._stored:
            # places are of this file, and what links lead to may stand in another
            self._stored[receiver_id] = None if self._follow_links else where_stored(self._iq[receiver_id])
        return self._stored[receiver_id]

    def _load_segments(self, receiver_id: str) -> IndexArray:
        try:
            rows = self._fields.blocks(receiver_id, len(self._iq[receiver_id]))
        except _HDF5_ERRORS as error:
            if isinstance(error, RfposeError):
                raise
            place = f"/{keys.RECEIVERS}/{receiver_id}/{keys.BLOCKS}"
            raise RecordingError(f"{self.path}: cannot read `{place}`: {error}; copy the file again") from error
        self._offsets[receiver_id] = rows[:, 2]
        return rows[:, :2]

    def _read_segment(self, receiver_id: str, i_segment: int, skip: int, out: IqArray) -> None:
        first = int(self._offsets[receiver_id][i_segment]) + skip
        target = as_stored(out, self.sample_format)
        try:
            stored = self._where(receiver_id)
            if stored is not None:
                stored.read(self._file_number, first * target.itemsize, out)
                return
            # the buffer has the file's own compound type, so HDF5 copies bytes and converts nothing
            self._iq[receiver_id].read_direct(target, np.s_[first : first + len(target)])
        except _HDF5_ERRORS as error:
            raise RecordingError(
                f"{self.path}: cannot read `/{keys.RECEIVERS}/{receiver_id}/{keys.IQ}` at {first}: {error}; copy the "
                "file again or check the disk"
            ) from error


@functools.cache
def _type_of(dtype: np.dtype[Any]) -> h5py.h5t.TypeID:
    return h5py.h5t.py_create(dtype, logical=True)


def _is_of(dataset: h5py.Dataset, dtype: np.dtype[Any]) -> bool:
    """Tell whether a dataset has a type; as numpy compares, which is asked only where HDF5's types differ."""
    return bool(dataset.id.get_type().equal(_type_of(dtype))) or dataset.dtype == dtype


def _open_hdf5(path: Path) -> h5py.File:
    try:
        if not path.is_file():  # a pipe or a device has no end and no beginning to go back to
            raise RecordingError(f"{path}: not a file; give an rfpose-iq file or a directory")
        if path.stat().st_size == 0:
            raise RecordingError(f"{path}: the file is empty; record or simulate again")
        if not h5py.is_hdf5(path):
            with path.open("rb"):  # says so when it is permission that lacks
                pass
            if instead := told_kind(path, wanted="recording"):
                raise RecordingError(f"{path}: no recording, but {instead}; give what was recorded or simulated")
            raise RecordingError(
                f"{path}: not an HDF5 file; give an rfpose-iq file, a Digital RF directory or a SigMF recording"
            )
        # no chunk cache: each sample is read once, straight into the caller's buffer
        return open_hdf5(path, rdcc_nbytes=0)
    except RecordingError:
        raise
    except OSError as error:
        for damage in ("truncated", "damaged"):
            if damage in str(error):
                raise RecordingError(
                    f"{path}: the HDF5 file is {damage} ({error}); copy it again, or record or simulate again"
                ) from error
        raise RecordingError(
            f"{path}: cannot open: {error.strerror or error}; check the file and its rights"
        ) from error


class _Fields:
    """Typed access to what is in the file; whatever is missing or mistyped is named."""

    def __init__(self, path: Path, file: h5py.File, *, follow_links: bool) -> None:
        self._path = path
        self._file = file
        self._follow_links = follow_links
        self._receivers: dict[str, h5py.Group] = {}

    def error(self, place: str, what: str) -> RecordingError:
        """Build the error for an attribute of the root group."""
        return RecordingError(f"{self._path}: attribute `{place}` {what}; {_REMEDY}")

    # -- attributes of the root --------------------------------------------------------------------------

    def check_format(self) -> None:
        """Refuse another format's HDF5, and a version this program does not know."""
        found = self._file.attrs.get(keys.FORMAT)
        found = found if isinstance(found, str) else None
        if found != keys.FORMAT_NAME:
            if self._file.get("rf_data", getlink=True) is not None or "digital_rf_version" in self._file.attrs:
                raise RecordingError(
                    f"{self._path}: this is one file of a Digital RF recording; give the directory above its channels"
                )
            if instead := told_kind(self._path, wanted="recording"):
                raise RecordingError(f"{self._path}: no recording, but {instead}; give what was recorded or simulated")
            raise RecordingError(
                f"{self._path}: an HDF5 file of another format (attribute `{keys.FORMAT}` of `/` must be "
                f"{keys.FORMAT_NAME!r}, is {found!r:.60}); give an rfpose-iq file or convert it with `rfpose convert`"
            )
        version = self.integer(keys.VERSION)
        if version != keys.FORMAT_VERSION:
            raise RecordingError(
                f"{self._path}: {keys.FORMAT_NAME} version {version}; this program reads version "
                f"{keys.FORMAT_VERSION}: install a newer rfpose"
            )

    def _attribute(self, name: str) -> Any:
        if name not in self._file.attrs:
            raise self.error(name, "of `/` is missing")
        return self._file.attrs[name]

    def text(self, name: str) -> str:
        value = self._attribute(name)
        if not isinstance(value, str):
            raise self.error(name, f"of `/` must be text, is {value!r:.60}")
        return value

    def integer(self, name: str) -> int:
        value = self._attribute(name)
        if not isinstance(value, int | np.integer):
            raise self.error(name, f"of `/` must be an integer, is {value!r:.60}")
        return int(value)

    def number(self, name: str) -> float:
        value = self._attribute(name)
        if not isinstance(value, int | float | np.integer | np.floating) or np.isnan(value):
            raise self.error(name, f"of `/` must be a number, is {value!r:.60}")
        return float(value)

    def sample_rate(self) -> Fraction:
        """Return the exact rate, checked."""
        numerator, denominator = self.integer(keys.RATE_NUMERATOR), self.integer(keys.RATE_DENOMINATOR)
        if numerator < 1 or denominator < 1:
            raise self.error(keys.RATE_NUMERATOR, f"gives a rate of {numerator}/{denominator}")
        try:
            return exact_rate(keys.RATE_NUMERATOR, Fraction(numerator, denominator))
        except InvalidInputError as error:
            raise RecordingError(f"{self._path}: attribute {error}; {_REMEDY}") from error

    def centre_frequency(self) -> float | None:
        """Return the tuning, None where the file does not say."""
        if keys.CENTRE_FREQUENCY not in self._file.attrs:
            return None
        value = self.number(keys.CENTRE_FREQUENCY)
        if not (math.isfinite(value) and abs(value) <= _LARGEST_FREQUENCY_HZ):
            raise self.error(keys.CENTRE_FREQUENCY, f"of `/` must be a frequency, is {value:g}")
        return value

    def full_scale(self) -> float:
        """Return the largest component, infinite where there is no limit."""
        value = self.number(keys.FULL_SCALE)
        if not value > 0.0:
            raise self.error(keys.FULL_SCALE, f"of `/` must be greater than zero, is {value:g}")
        return value

    # -- groups and datasets -----------------------------------------------------------------------------

    def _missing(self, place: str, wanted: str) -> RecordingError:
        return RecordingError(f"{self._path}: `{place}` must be {wanted} and is missing or something else; {_REMEDY}")

    def _holds(self, place: str) -> bool:
        return find_item(self._file, place, follow_links=self._follow_links) is not None

    def group(self, name: str) -> h5py.Group:
        item = find_item(self._file, f"/{name}", follow_links=self._follow_links)
        if not isinstance(item, h5py.Group):
            raise self._missing(f"/{name}", "a group")
        return item

    def receiver_ids(self) -> tuple[str, ...]:
        """Return the receivers in file order."""
        found = tuple(self.group(keys.RECEIVERS))
        for name in found:
            if not _RECEIVER_ID.fullmatch(name):
                raise RecordingError(
                    f"{self._path}: `/{keys.RECEIVERS}` holds {printable(name)!r:.60}; a receiver's name may hold "
                    f"letters, digits, `_`, `-` and `.`; {_REMEDY}"
                )
        return found

    def _receiver(self, receiver_id: str) -> h5py.Group | None:
        """Return a receiver's group if it is one; found once, since a file may hold hundreds."""
        if receiver_id not in self._receivers:
            place = f"/{keys.RECEIVERS}/{receiver_id}"
            item = find_item(self._file, place, follow_links=self._follow_links, within=self._receivers_of_file)
            if not isinstance(item, h5py.Group):
                return None
            self._receivers[receiver_id] = item
        return self._receivers[receiver_id]

    @functools.cached_property
    def _receivers_of_file(self) -> h5py.Group:
        return self.group(keys.RECEIVERS)

    def _dataset(
        self, place: str, wanted: str, *, per_stored: int = FROM_TABLE, within: h5py.Group | None = None
    ) -> h5py.Dataset:
        item = find_dataset(self._file, place, follow_links=self._follow_links, per_stored=per_stored, within=within)
        if item is None or item.shape is None:
            raise self._missing(place, wanted)
        return item

    def iq(self, receiver_id: str, dtype: np.dtype[Any]) -> h5py.Dataset:
        """Return a receiver's samples, of exactly the promised type."""
        place = f"/{keys.RECEIVERS}/{receiver_id}/{keys.IQ}"
        dataset = self._dataset(
            place, "a dataset of samples", per_stored=FROM_SAMPLES, within=self._receiver(receiver_id)
        )
        if dataset.id.rank != 1 or not _is_of(dataset, dtype):
            raise RecordingError(
                f"{self._path}: `{place}` must be one-dimensional of type {dtype}, is {dataset.ndim}-dimensional of "
                f"type {dataset.dtype}; {_REMEDY}"
            )
        return dataset

    def blocks(self, receiver_id: str, n_stored: int) -> IndexArray:
        """Return (block, 3) rows [start index, count, offset in iq], checked."""
        place = f"/{keys.RECEIVERS}/{receiver_id}/{keys.BLOCKS}"
        dataset = self._dataset(place, "a table of int64", within=self._receiver(receiver_id))
        shape = dataset.shape
        if len(shape) != 2 or shape[1] != 3 or not _is_of(dataset, _INDEX_DTYPE):
            raise RecordingError(
                f"{self._path}: `{place}` must be int64 of shape (block, 3), is {dataset.dtype} of shape "
                f"{shape}; {_REMEDY}"
            )
        rows: IndexArray = np.empty(shape, _INDEX_DTYPE)
        if rows.size:
            dataset.id.read(h5py.h5s.ALL, h5py.h5s.ALL, rows)  # as `dataset[()]`, which takes several times as long
        start, count, offset = rows[:, 0], rows[:, 1], rows[:, 2]
        # subtractions, not sums: numbers from a damaged file must not overflow into plausible ones
        in_range = (start >= 0) & (start <= MAX_SAMPLE_INDEX) & (count > 0) & (offset >= 0) & (offset <= n_stored)
        in_range &= count <= n_stored - np.clip(offset, 0, n_stored)
        if not in_range.all():
            i = int(np.flatnonzero(~in_range)[0])
            raise RecordingError(
                f"{self._path}: `{place}` row {i} is {rows[i].tolist()} [start, count, offset], which does not lie "
                f"within the {n_stored} samples stored; {_REMEDY}"
            )
        if np.any(start[1:] < start[:-1] + count[:-1]):
            i = int(np.flatnonzero(start[1:] < start[:-1] + count[:-1])[0]) + 1
            raise RecordingError(f"{self._path}: `{place}` row {i} starts before row {i - 1} ends; {_REMEDY}")
        return rows

    def place_of_blocks(self, receiver_id: str) -> int | None:
        """Return where a receiver's table of blocks lies [byte]; None: nowhere as a whole."""
        place = f"/{keys.RECEIVERS}/{receiver_id}/{keys.BLOCKS}"
        begin: int | None = self._dataset(place, "a table of int64", within=self._receiver(receiver_id)).id.get_offset()
        return begin

    def places_of_truth(self) -> list[tuple[int, int]]:
        """Return where numbers of the truth lie, and how long they are [byte]."""
        found = []
        for name in _TRUTH_AXES if self._holds(f"/{keys.TRUTH}") else ():
            if self._holds(f"/{keys.TRUTH}/{name}"):
                dataset = self._dataset(f"/{keys.TRUTH}/{name}", "numbers")
                if (begin := dataset.id.get_offset()) is not None:
                    found.append((begin, dataset.nbytes))
        return found

    def scenario(self) -> Scenario | None:
        """Return the embedded scenario."""
        if not self._holds(f"/{keys.SCENARIO}"):
            return None
        return parse_scenario(self._text_dataset(f"/{keys.SCENARIO}"), source=f"{self._path}:/{keys.SCENARIO}")

    def _text_dataset(self, place: str) -> str:
        dataset = self._dataset(place, "a text")
        if dataset.shape != () or h5py.check_string_dtype(dataset.dtype) is None:
            raise self._missing(place, "a text")
        try:
            return str(dataset.asstr()[()])
        except UnicodeDecodeError as error:
            raise RecordingError(f"{self._path}: `{place}` is not UTF-8; {_REMEDY}") from error

    def provenance(self) -> dict[str, str]:
        """Return the provenance and the writing program."""
        found = {keys.CREATED_BY: printable(self.text(keys.CREATED_BY))}
        if self._holds(f"/{keys.PROVENANCE}"):
            for name, value in self.group(keys.PROVENANCE).attrs.items():
                found[printable(str(name))] = printable(str(value))
        return found

    def truth(self) -> Truth | None:
        """Return what was simulated, if the file says."""
        if not self._holds(f"/{keys.TRUTH}"):
            return None
        self.group(keys.TRUTH)
        found: dict[str, Any] = {name: self._ids(name) for name in _TRUTH_IDS}
        required = {field.name for field in dataclasses.fields(Truth) if field.default is dataclasses.MISSING}
        length: dict[str | int, int] = {
            axis: len(found[f"{axis}_ids"]) for axis in ("heliostat", "receiver", "transmitter")
        }
        for name, axes in _TRUTH_AXES.items():
            place = f"/{keys.TRUTH}/{name}"
            if name not in required and not self._holds(place):
                continue
            dtype = np.dtype("<i8") if name == "frame_start_index" else np.dtype("<f8")
            dataset = self._dataset(place, f"a dataset of {dtype}")
            if dataset.dtype != dtype or dataset.ndim != len(axes):
                raise RecordingError(
                    f"{self._path}: `{place}` must be {dtype} of {len(axes)} dimensions, is {dataset.dtype} of "
                    f"shape {dataset.shape}; {_REMEDY}"
                )
            wanted = tuple(
                axis if isinstance(axis, int) else length.setdefault(axis, n)
                for axis, n in zip(axes, dataset.shape, strict=True)
            )
            if dataset.shape != wanted:
                raise RecordingError(
                    f"{self._path}: `{place}` must be of shape {wanted} like the others, is {dataset.shape}; {_REMEDY}"
                )
            found[name] = dataset[()]
        starts = found.get("frame_start_index")
        if starts is not None and np.any(starts[1:] <= starts[:-1]):
            raise RecordingError(f"{self._path}: `/{keys.TRUTH}/frame_start_index` must ascend; {_REMEDY}")
        return Truth(**found)

    def _ids(self, name: str) -> tuple[str, ...]:
        place = f"/{keys.TRUTH}/{name}"
        dataset = self._dataset(place, "a list of texts")
        if dataset.ndim != 1 or h5py.check_string_dtype(dataset.dtype) is None:
            raise self._missing(place, "a list of texts")
        try:
            return tuple(str(item) for item in dataset.asstr()[()])
        except UnicodeDecodeError as error:
            raise RecordingError(f"{self._path}: `{place}` is not UTF-8; {_REMEDY}") from error
