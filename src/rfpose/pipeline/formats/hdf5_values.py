"""What readers of our HDF5 files ask before they believe a file: text that is text, arrays that are really there."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np

from rfpose.recording.hdf5 import FROM_SAMPLES, find_dataset

__all__ = ["DAMAGES", "array_of", "text_of"]

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
        There is none. A number is larger than anything that is measured, and would overflow when it is squared.
    """
    dataset = find_dataset(file, place, follow_links=False, per_stored=FROM_SAMPLES)
    if dataset is None:
        raise ValueError("is missing")
    values = np.asarray(dataset[()], dtype=dtype)
    if values.dtype.kind in "fc" and values.size:
        finite = np.where(np.isfinite(values), np.abs(values), 0.0)
        if finite.max() > _LARGEST:
            raise ValueError(f"holds {values.ravel()[int(np.argmax(finite))]:.3g}, which nothing measured is")
    return values
