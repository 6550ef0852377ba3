"""What readers of our HDF5 files ask before they believe a file: text that is text, arrays that are really there."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from rfpose.checks import read_only
from rfpose.errors import RecordingError, ScenarioError
from rfpose.heaps import open_hdf5
from rfpose.kinds import check_kind
from rfpose.pipeline.formats.columns import Column
from rfpose.recording.hdf5 import FROM_SAMPLES, find_dataset, find_item
from rfpose.scenario import Scenario, parse_scenario

__all__ = ["DAMAGES", "FileReader", "array_of", "opened", "text_of"]

DAMAGES = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError, MemoryError)
"""What h5py and numpy raise where a file is not what it says."""

_LARGEST = 1e50


def text_of(file: h5py.File, place: str) -> str:
    """Return the text that the dataset at an absolute place holds.

    Raises
    ------
    RecordingError
        It lies in another file.
    ValueError
        It is missing, no single text, or not UTF-8.
    """
    item = find_dataset(file, place, follow_links=False, per_stored=FROM_SAMPLES)
    if item is None or item.shape != () or h5py.check_string_dtype(item.dtype) is None:
        raise ValueError("is missing or no text")
    try:
        raw = item[()]
        return raw.decode("utf-8") if isinstance(raw, bytes) else str(raw)
    except UnicodeDecodeError as error:
        raise ValueError(f"is not UTF-8 ({error})") from error


def array_of(file: h5py.File, place: str, dtype: Any) -> np.ndarray[Any, Any]:
    """Return the values of the dataset at an absolute place, which lie in the file and are as many as it can hold.

    Raises
    ------
    RecordingError
        They lie in another file, or more are declared than can be stored.
    ValueError
        There is none. A number is larger than its type takes, or than anything that is measured, and would overflow
        when it is squared.
    """
    dataset = find_dataset(file, place, follow_links=False, per_stored=FROM_SAMPLES)
    if dataset is None:
        raise ValueError("is missing")
    stored = dataset[()]
    values = np.asarray(stored, dtype=dtype)
    if values.dtype.kind in "iu" and not np.array_equal(values, stored):  # a code that wraps may look like another
        raise ValueError(f"holds {stored[values != stored].flat[0]}, which means nothing")
    if values.dtype.kind in "fc" and values.size:
        finite = np.where(np.isfinite(values), np.abs(values), 0.0)
        if float(finite.max()) > _LARGEST:
            raise ValueError(f"holds {values.ravel()[int(np.argmax(finite))]:.3g}, which nothing measured is")
    return values


@contextlib.contextmanager
def opened(path: Path, *, wanted: str, version: int, again: str) -> Iterator[h5py.File]:
    """Open a ``result``, ``track`` or ``antenna`` of `rfpose.kinds`; what h5py and numpy raise becomes our error.

    Raises
    ------
    RecordingError
        Missing, another kind of file or version, or damaged; ``again`` says what to do.
    """
    check_kind(path, wanted=wanted)
    try:
        with open_hdf5(path, tables=True) as file:
            found = file.attrs.get("version")
            if found != version:
                raise RecordingError(f"{path}: has version {found}, this rfpose reads {version}; {again}")
            yield file
    except RecordingError:
        raise
    except DAMAGES as error:
        raise RecordingError(
            f"{path}: cannot be read ({error}); it is truncated or another kind of file: {again}"
        ) from error


class FileReader:
    """Reads one open file of ours; each complaint names the file, the place in it, and what to do.

    Parameters
    ----------
    path
        For the messages.
    file
        Open for reading.
    length
        Of dimensions that are known; those of others are what the first column that has them says.
    again
        What to do about a damaged file.
    """

    def __init__(self, path: Path, file: h5py.File, *, length: Mapping[str, int], again: str) -> None:
        self.path, self.file, self.again = path, file, again
        self.length = dict(length)

    def error(self, place: str, what: str) -> RecordingError:
        """Return the complaint about a place."""
        return RecordingError(f"{self.path}: `/{place}` {what}; the file is damaged: {self.again}")

    def scenario(self) -> Scenario:
        """Return the scenario that the file carries."""
        try:
            return parse_scenario(text_of(self.file, "/scenario"), source=f"{self.path}:/scenario")
        except ScenarioError as error:
            raise RecordingError(f"{error}; the file is damaged: {self.again}") from error
        except ValueError as error:
            raise self.error("scenario", str(error)) from error

    def group(self, place: str) -> h5py.Group:
        """Return a group."""
        found = find_item(self.file, f"/{place}", follow_links=False)
        if not isinstance(found, h5py.Group):
            raise self.error(place, "is missing or no group")
        return found

    def array(self, place: str, column: Column) -> npt.NDArray[Any]:
        """Return a column's values, of its type and as long as the file's other columns say."""
        dataset = find_item(self.file, f"/{place}", follow_links=False)
        if not isinstance(dataset, h5py.Dataset):
            raise self.error(place, "is missing")
        dtype = np.dtype(column.dtype)
        if dataset.dtype.kind not in ("iu" if dtype.kind in "iu" else dtype.kind):
            raise self.error(place, f"holds {dataset.dtype}, not {dtype}")
        fits = len(column.dims) == dataset.ndim and all(
            self.length.get(dim, n) == n for dim, n in zip(column.dims, dataset.shape, strict=True)
        )
        if not fits:
            raise self.error(place, f"has shape {dataset.shape}, not ({', '.join(column.dims)})")
        for dim, n in zip(column.dims, dataset.shape, strict=True):
            self.length.setdefault(dim, n)
        try:
            return read_only(array_of(self.file, f"/{place}", dtype))
        except RecordingError:
            raise
        except DAMAGES as error:
            raise self.error(place, str(error)) from error
