"""What readers of our HDF5 files ask before they believe a file: text that is text, arrays that are really there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

__all__ = ["DAMAGES", "array_of", "format_of", "text_of"]

DAMAGES = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError, MemoryError)
"""What h5py and numpy raise where a file is not what it says."""

_LARGEST = 1e50
_ALWAYS_READ_BYTES = 2**26
_MOST_COMPRESSED = 1100
"""Deflate makes no more than some 1030 bytes of one."""


def format_of(path: str | Path) -> str | None:
    """Return the ``format`` that an HDF5 file gives itself; None for whatever cannot be opened or has none."""
    try:
        with h5py.File(path, "r") as file:
            found = file.attrs.get("format")
    except DAMAGES:
        return None
    return found if isinstance(found, str) else None


def text_of(item: Any) -> str:
    """Return the text that a dataset holds.

    Raises
    ------
    ValueError
        It is missing, no single text, or not UTF-8.
    """
    if not isinstance(item, h5py.Dataset) or item.shape != () or h5py.check_string_dtype(item.dtype) is None:
        raise ValueError("is missing or no text")
    try:
        raw = item[()]
        return raw.decode("utf-8") if isinstance(raw, bytes) else str(raw)
    except UnicodeDecodeError as error:
        raise ValueError(f"is not UTF-8 ({error})") from error


def array_of(dataset: h5py.Dataset, dtype: Any) -> np.ndarray[Any, Any]:
    """Return a dataset's values, after making sure that the file is large enough to hold them.

    Raises
    ------
    ValueError
        The dataset says that it holds more than the file can: reading it would only fill memory. A number is larger
        than anything that is measured, and would overflow when it is squared.
    """
    stored = dataset.id.get_storage_size()
    if dataset.nbytes > max(_ALWAYS_READ_BYTES, _MOST_COMPRESSED * stored):
        raise ValueError(f"claims {dataset.nbytes} bytes, and {stored} are stored")
    values = np.asarray(dataset[()], dtype=dtype)
    if values.dtype.kind in "fc" and values.size:
        finite = np.where(np.isfinite(values), np.abs(values), 0.0)
        if finite.max() > _LARGEST:
            raise ValueError(f"holds {values.ravel()[int(np.argmax(finite))]:.3g}, which nothing measured is")
    return values
