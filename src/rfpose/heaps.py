"""Opening HDF5 files whose heaps of texts are sound: of one damage of these the HDF5 library does not come back.

Texts of any length lie in *global heap collections* (HDF5 file format specification 4.0, III.E), blocks without a
checksum. The library (2.0.0) goes through such a block object by object, and stands still for ever at
free space that is said to be of no length; it cannot be interrupted from Python. So they are looked through before.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

if TYPE_CHECKING:
    import h5py

__all__ = ["check_heaps", "open_hdf5"]

_COLLECTION: Final = b"GCOL\1\0\0\0"
_COLLECTION_HEAD: Final = 16  # and its length
_OBJECT_HEAD: Final = 16  # index, count of references, nothing, length
_LEAST_BYTES: Final = 4096
_END_BYTES: Final = 2**16
"""Where recordings are long, their texts stand before the samples or after them."""
_PIECE_BYTES: Final = 2**20


def open_hdf5(path: Path, *, tables: bool = False, **options: Any) -> h5py.File:
    """Open a file for reading, with ``options`` of `h5py.File`.

    Parameters
    ----------
    tables
        Whether it is one of tables, not of samples: texts may lie anywhere in it.

    Raises
    ------
    OSError
        It cannot be opened, or a heap is damaged so that reading it would not end.
    """
    import h5py

    check_heaps(path, everywhere=tables)
    return h5py.File(path, "r", **options)


def check_heaps(path: Path, *, everywhere: bool) -> None:
    """Refuse a file with a heap that the library would not come back from.

    Parameters
    ----------
    everywhere
        False: heaps of long files are looked for in 64 KiB at the beginning and at the end.

    Raises
    ------
    OSError
        It cannot be read, or holds such a heap; says where.
    """
    with path.open("rb") as file:
        length = file.seek(0, 2)
        for begin, end in _pieces(length, everywhere=everywhere):
            file.seek(begin)
            stored = file.read(end - begin)
            at = stored.find(_COLLECTION)
            while at >= 0:
                _check_collection(file, begin + at, length)
                at = stored.find(_COLLECTION, at + 1)


def _pieces(length: int, *, everywhere: bool) -> Iterator[tuple[int, int]]:
    """Yield where to look; pieces overlap, so that none cuts the beginning of a heap."""
    if not everywhere and length > 2 * _END_BYTES:
        yield from ((0, _END_BYTES), (length - _END_BYTES, length))
        return
    for begin in range(0, length, _PIECE_BYTES):
        yield begin, min(begin + _PIECE_BYTES + len(_COLLECTION) - 1, length)


def _check_collection(file: BinaryIO, begin: int, length: int) -> None:
    file.seek(begin + len(_COLLECTION))
    end = int.from_bytes(file.read(_COLLECTION_HEAD - len(_COLLECTION)), "little")
    if not _LEAST_BYTES <= end <= length - begin:  # the library refuses it
        return
    file.seek(begin)
    stored, at = file.read(end), _COLLECTION_HEAD
    while at + _OBJECT_HEAD <= end:
        index = int.from_bytes(stored[at : at + 2], "little")
        size = int.from_bytes(stored[at + 8 : at + _OBJECT_HEAD], "little")
        if index == 0 and size < _OBJECT_HEAD:  # the size of free space is said with its head
            raise OSError(f"the heap of texts at byte {begin} is damaged at byte {begin + at}")
        at += size if index == 0 else _OBJECT_HEAD + (size + 7) // 8 * 8
