"""Opening HDF5 files whose heaps of texts are sound: of one damage of these the HDF5 library does not come back.

Texts of any length lie in *global heap collections* (HDF5 file format specification 4.0, III.E), blocks without a
checksum. The library (2.0.0, and those before) goes through such a block object by object, and stands still for ever at
free space that is said to be of no length; it cannot be interrupted from Python. So they are looked through before.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import h5py

__all__ = ["check_heaps", "open_hdf5"]

_COLLECTION: Final = b"GCOL\1\0\0\0"
_COLLECTION_HEAD: Final = 16  # and its length
_OBJECT_HEAD: Final = 16  # index, count of references, nothing, length
_LEAST_BYTES: Final = 4096
_END_BYTES: Final = 2**18
"""Where recordings are long, their texts stand before the samples or after them."""
_WHOLE_BYTES: Final = 2**20


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
        False: of long files a quarter of a MiB at the beginning and at the end is looked at.

    Raises
    ------
    OSError
        It cannot be read, or holds such a heap; says where.
    """
    with path.open("rb") as file:
        length = file.seek(0, 2)
        if everywhere or length <= _WHOLE_BYTES:
            pieces = [(0, length)]
        else:
            pieces = [(0, _END_BYTES), (length - _END_BYTES, length)]
        for begin, end in pieces:
            file.seek(begin)
            _check_piece(file.read(end - begin), begin)


def _check_piece(stored: bytes, offset: int) -> None:
    at = stored.find(_COLLECTION)
    while at >= 0:
        stop = at + int.from_bytes(stored[at + 8 : at + _COLLECTION_HEAD], "little")
        if at + _LEAST_BYTES <= stop <= len(stored):  # else the library refuses it, or it is not whole here
            _check_collection(stored, at, stop, offset)
        at = stored.find(_COLLECTION, at + 1)


def _check_collection(stored: bytes, begin: int, end: int, offset: int) -> None:
    at = begin + _COLLECTION_HEAD
    while at + _OBJECT_HEAD <= end:
        index = int.from_bytes(stored[at : at + 2], "little")
        length = int.from_bytes(stored[at + 8 : at + _OBJECT_HEAD], "little")
        if index == 0 and length < _OBJECT_HEAD:  # the length of free space is said with its head
            raise OSError(f"the heap of texts at byte {offset + begin} is damaged at byte {offset + at}")
        at += length if index == 0 else _OBJECT_HEAD + (length + 7) // 8 * 8
