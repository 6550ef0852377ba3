"""Samples that are read beside the HDF5 library: as it reads them, or left to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from rfpose.recording.hdf5 import PlainFile

N = 1000
VALUES = np.arange(N, dtype="<i4")
STORED: dict[str, dict[str, Any]] = {
    "contiguous": {},
    "one chunk": {"chunks": (2048,), "maxshape": (None,)},
    "many chunks": {"chunks": (64,), "maxshape": (None,)},
}


def _read(path: Path, first: int, count: int) -> tuple[bool, np.ndarray]:
    target = np.zeros(count, "<i4")
    with h5py.File(path) as file:
        done = PlainFile(file).read(file["x"], first, target.data.cast("B"))
    return done, target


@pytest.mark.parametrize("libver", ["earliest", "v110"])
@pytest.mark.parametrize("stored", STORED)
def test_reads_what_the_library_reads(tmp_path: Path, stored: str, libver: str) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w", libver=(libver, "v110")) as file:
        file.create_dataset("before", data=np.ones(77))
        file.create_dataset("x", data=VALUES, **STORED[stored])
    for first, count in ((0, N), (63, 2), (64, 64), (999, 1), (130, 801)):
        done, found = _read(path, first, count)
        assert done
        np.testing.assert_array_equal(found, VALUES[first : first + count])


def test_leaves_to_the_library_what_is_stored_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=VALUES, chunks=(64,), compression="gzip")
    assert not _read(path, 0, 10)[0]
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("x", data=VALUES)
    assert not _read(path, 0, 10)[0]
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=VALUES, external=[(str(tmp_path / "raw"), 0, h5py.h5f.UNLIMITED)])
    assert not _read(path, 0, 10)[0]
    with h5py.File(path, "w") as file:  # the second chunk was never written
        file.create_dataset("x", shape=(N,), dtype="<i4", chunks=(64,))[:64] = VALUES[:64]
    assert _read(path, 0, 64)[0]
    assert not _read(path, 60, 10)[0]
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=VALUES)
    path.write_bytes(path.read_bytes()[:-40])
    with path.open("r+b") as raw:  # HDF5 refuses to open it, so shorten it afterwards
        raw.truncate(path.stat().st_size + 40)
        with h5py.File(path) as file:
            raw.truncate(path.stat().st_size - 40)
            target = np.zeros(N, "<i4")
            assert not PlainFile(file).read(file["x"], 0, target.data.cast("B"))
