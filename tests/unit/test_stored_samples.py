"""Samples that are read beside the HDF5 library: as it reads them, or left to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from rfpose.recording.stored import where_stored

N = 1000
VALUES = np.arange(N, dtype="<i4")
STORED: dict[str, dict[str, Any]] = {
    "contiguous": {},
    "one chunk": {"chunks": (2048,), "maxshape": (None,)},
    "many chunks": {"chunks": (64,), "maxshape": (None,)},
}


def _read(path: Path, first: int, count: int) -> np.ndarray | None:
    target = np.zeros(count, "<i4")
    with h5py.File(path) as file:
        stored = where_stored(file["x"])
        if stored is None:
            return None
        stored.read(file.id.get_vfd_handle(), 4 * first, target)
    return target


@pytest.mark.parametrize("libver", ["earliest", "v110"])
@pytest.mark.parametrize("stored", STORED)
def test_reads_what_the_library_reads(tmp_path: Path, stored: str, libver: str) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w", libver=(libver, "v110")) as file:
        file.create_dataset("before", data=np.ones(77))
        file.create_dataset("x", data=VALUES, **STORED[stored])
    for first, count in ((0, N), (63, 2), (64, 64), (999, 1), (130, 801)):
        np.testing.assert_array_equal(_read(path, first, count), VALUES[first : first + count])


def test_leaves_to_the_library_what_is_stored_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=VALUES, chunks=(64,), compression="gzip")
    assert _read(path, 0, 10) is None
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("x", data=VALUES)
    assert _read(path, 0, 10) is None
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=VALUES, external=[(str(tmp_path / "raw"), 0, h5py.h5f.UNLIMITED)])
    assert _read(path, 0, 10) is None
    with h5py.File(path, "w") as file:  # the second chunk was never written
        file.create_dataset("x", shape=(N,), dtype="<i4", chunks=(64,))[:64] = VALUES[:64]
    assert _read(path, 0, 64) is None


def test_a_file_that_ends_before_is_told(tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=VALUES)
    with h5py.File(path) as file, path.open("r+b") as raw:
        stored = where_stored(file["x"])
        raw.truncate(path.stat().st_size - 40)
        assert stored is not None
        with pytest.raises(OSError, match="the file ends at"):
            stored.read(file.id.get_vfd_handle(), 0, np.zeros(N, "<i4"))
