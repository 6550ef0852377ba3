"""New HDF5 files that appear whole or not at all, whatever comes between: a full disk, an interruption, no memory."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py

from rfpose.errors import RecordingError
from rfpose.files import Claim, cannot_write
from rfpose.interruption import held_back

__all__ = ["Hdf5Output"]


class Hdf5Output:
    """Make an HDF5 file under a temporary name and give it its own when it is complete.

    HDF5 cannot close a file to which it cannot write: after a full disk it leaks the file, prints at exit, and
    crashes the process (seen with HDF5 1.14 to 2.0). And an exception that comes up in a Python file object is lost:
    h5py cannot hand it through HDF5, which takes the samples for written. Here it writes into a `_Sink` that never
    fails; the sink keeps the first error, and this class raises it. Interruptions wait until HDF5 has returned.

    Parameters
    ----------
    path
        File to make.
    overwrite
        Replace an existing file.
    rdcc_nbytes
        Chunk cache of each dataset [byte].

    Raises
    ------
    RecordingError
        The file exists already, cannot be made, or is being written by another process.
    """

    def __init__(self, path: Path, *, overwrite: bool, rdcc_nbytes: int = 2**20) -> None:
        self._path = path
        self._claim = Claim([path], force=overwrite)
        self._sink: _Sink | None = None
        self.n_byte = 0
        """Size of the complete file."""
        try:
            with held_back():
                self._claim.take()
                self._sink = _Sink(self._claim.part(path))
                self.file = h5py.File(self._sink, "w", libver=("v110", "v110"), rdcc_nbytes=rdcc_nbytes)
            self._check()
        except BaseException as error:
            self.discard()
            if isinstance(error, OSError) and not isinstance(error, RecordingError):
                raise cannot_write(path, error) from error
            raise

    @contextlib.contextmanager
    def writing(self) -> Iterator[h5py.File]:
        """Yield the file for a piece of work; raise `RecordingError` if any of it did not reach the disk."""
        try:
            with held_back():
                yield self.file
        except Exception:
            self._check()  # HDF5 stumbling over what was dropped is not the news
            raise
        self._check()

    def _check(self) -> None:
        error = None if self._sink is None else self._sink.error
        if isinstance(error, OSError):
            raise cannot_write(self._path, error) from error
        if error is not None:
            raise error

    def commit(self) -> None:
        """Complete the file and give it its name. Nothing may be open in it any more."""
        assert self._sink is not None
        with self.writing() as file:
            file.close()
        try:
            self._sink.sync()  # a disk that fills late says so here, before the name is taken
            self.n_byte = self._sink.size()
            self._sink.close()
        except OSError as error:
            raise cannot_write(self._path, error) from error
        with held_back():
            self._claim.complete(self._path)
            self._claim.publish()

    def discard(self) -> None:
        """Remove the temporary file; after `commit` there is nothing to remove."""
        with held_back():
            if self._sink is not None:
                self._sink.drop()
                if hasattr(self, "file") and self.file:
                    with contextlib.suppress(Exception):  # whatever it is, the file goes
                        self.file.close()
                self._sink.close()
            self._claim.release()


class _Sink(io.RawIOBase):
    """A file that accepts every write; once one has failed it drops them, for the file is lost anyway.

    HDF5 calls each method from C, where an exception would be lost: none leaves them.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.error: BaseException | None = None
        self._dropping = False
        self._position = 0
        self._end = 0
        self._file = path.open("w+b", buffering=0)

    def drop(self) -> None:
        """Write nothing from now on."""
        self._dropping = True

    def sync(self) -> None:
        """Wait until the disk has everything; unlike the rest, this raises."""
        os.fsync(self._file.fileno())

    def size(self) -> int:
        """Return the length of the file [byte]."""
        return os.fstat(self._file.fileno()).st_size

    def close(self) -> None:
        self._file.close()
        super().close()

    @contextlib.contextmanager
    def _keeping_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:  # noqa: BLE001 -- KeyboardInterrupt and MemoryError too; `Hdf5Output` raises it
            self.error = self.error or error
            self.drop()

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._end}
        self._position = base[whence] + offset
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        done = 0
        with self._keeping_error():
            while done < len(view) and not self._dropping:
                n_read = os.preadv(self._file.fileno(), [view[done:]], self._position + done)
                if not n_read:
                    break
                done += n_read
        self._position += done
        return done

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        done = 0
        with self._keeping_error():
            while done < len(view) and not self._dropping:
                done += os.pwrite(self._file.fileno(), view[done:], self._position + done)
        self._position += len(view)
        self._end = max(self._end, self._position)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        size = self._position if size is None else size
        with self._keeping_error():
            if not self._dropping:
                self._file.truncate(size)
        self._end = size
        return size
