"""Where samples lie in an HDF5 file: read from there by several threads at once, which HDF5 itself does one by one."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

__all__ = ["StoredSamples", "read_at", "where_stored"]

_CAN = hasattr(os, "preadv") and hasattr(h5py.h5d.DatasetID, "chunk_iter")  # not on Windows; HDF5 from 1.14 on


@dataclass(frozen=True, slots=True)
class StoredSamples:
    """Pieces of one length in which a dataset's bytes lie, the last one perhaps used in part.

    Attributes
    ----------
    offset : (piece,)
        Where each begins in the file [byte].
    piece_bytes
        How long each is [byte].
    """

    offset: npt.NDArray[np.int64]
    piece_bytes: int

    def read(self, file_number: int, first_byte: int, out: npt.NDArray[Any]) -> None:
        """Fill a C-contiguous array with the dataset's bytes from one on.

        Parameters
        ----------
        file_number
            Descriptor of the open file.
        first_byte
            In the dataset.
        out
            Is filled as a whole.

        Raises
        ------
        OSError
            The file cannot be read, or ends before.
        """
        view = memoryview(out.data).cast("B")
        done = 0
        while done < len(view):
            i_piece, skip = divmod(first_byte + done, self.piece_bytes)
            take = min(len(view) - done, self.piece_bytes - skip)
            read_at(file_number, int(self.offset[i_piece]) + skip, view[done : done + take])
            done += take


def read_at(file_number: int, offset: int, out: memoryview) -> None:
    """Fill a buffer of bytes from a place in a file; OSError: it cannot be read, or ends before."""
    done = 0
    while done < len(out):
        n_read = os.preadv(file_number, [out[done:]], offset + done)
        if not n_read:
            raise OSError(f"the file ends at {offset + done}")
        done += n_read


def where_stored(dataset: h5py.Dataset) -> StoredSamples | None:
    """Return where a one-dimensional dataset lies in its file; None: only HDF5 can tell or read it.

    Parameters
    ----------
    dataset
        Compressed ones, ones that stand elsewhere, and ones of which a part was never written are left to HDF5.
    """
    settings = dataset.id.get_create_plist()
    layout, item_bytes = settings.get_layout(), dataset.id.get_type().get_size()
    if not _CAN or settings.get_nfilters() or settings.get_external_count() or not len(dataset):
        return None
    if dataset.file.userblock_size or dataset.file.driver != "sec2":
        return None
    if layout == h5py.h5d.CONTIGUOUS:
        begin = dataset.id.get_offset()
        return None if begin is None else StoredSamples(np.array([begin]), len(dataset) * item_bytes)
    if layout != h5py.h5d.CHUNKED:
        return None
    n_item = int(dataset.chunks[0])
    offset = np.full(-(-len(dataset) // n_item), -1)

    def put(chunk: Any) -> None:
        offset[chunk.chunk_offset[0] // n_item] = chunk.byte_offset

    dataset.id.chunk_iter(put)
    return StoredSamples(offset, n_item * item_bytes) if (offset >= 0).all() else None
