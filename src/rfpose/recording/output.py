"""New HDF5 files that appear whole or not at all, on a disk that may fill at any moment."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py

from rfpose.errors import RecordingError

__all__ = ["Hdf5Output", "refuse_existing", "temporary_beside"]


class Hdf5Output:
    """Make an HDF5 file under a temporary name and give it its own when it is complete.

    HDF5 cannot close a file to which it cannot write: after a full disk it leaks the file, prints at exit, and
    crashes the process (seen with HDF5 1.14 to 2.0). Here it writes into a `_Sink` that never fails; the sink
    keeps the first error, and this class raises it.

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
        The file exists already, or cannot be made.
    """

    def __init__(self, path: Path, *, overwrite: bool, rdcc_nbytes: int = 2**20) -> None:
        refuse_existing(path, overwrite=overwrite)
        self._path = path
        self._overwrite = overwrite
        self._temporary = temporary_beside(path)
        try:
            self._sink = _Sink(self._temporary)
        except OSError as error:
            raise _cannot_write(path, error) from error
        try:
            self.file = h5py.File(self._sink, "w", rdcc_nbytes=rdcc_nbytes)
        except BaseException:
            self.discard()
            raise

    @contextlib.contextmanager
    def writing(self) -> Iterator[h5py.File]:
        """Yield the file for a piece of work; raise `RecordingError` if any of it did not reach the disk."""
        try:
            yield self.file
        except (OSError, RuntimeError, KeyError):
            self._check()  # HDF5 stumbling over what was dropped is not the news
            raise
        self._check()

    def _check(self) -> None:
        if self._sink.error is not None:
            raise _cannot_write(self._path, self._sink.error) from self._sink.error

    def commit(self) -> None:
        """Complete the file and give it its name. Nothing may be open in it any more."""
        with self.writing() as file:
            file.close()
        try:
            self._sink.sync()  # a disk that fills late says so here, before the name is taken
            self._sink.close()
            refuse_existing(self._path, overwrite=self._overwrite)
            self._temporary.replace(self._path)
        except RecordingError:
            raise
        except OSError as error:
            raise _cannot_write(self._path, error) from error

    def discard(self) -> None:
        """Remove the temporary file; after `commit` there is nothing to remove."""
        if hasattr(self, "file") and self.file:
            self._sink.drop()
            with contextlib.suppress(OSError, RuntimeError):  # whatever it is, the file goes
                self.file.close()
        self._sink.close()
        self._temporary.unlink(missing_ok=True)


class _Sink(io.RawIOBase):
    """A file that accepts every write; once one has failed it drops them, for the file is lost anyway."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.error: OSError | None = None
        self._dropping = False
        self._position = 0
        self._file = path.open("w+b", buffering=0)

    def drop(self) -> None:
        """Write nothing from now on."""
        self._dropping = True

    def sync(self) -> None:
        """Wait until the disk has everything; unlike the rest, this raises."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()
        super().close()

    @contextlib.contextmanager
    def _keeping_error(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error
            self.drop()

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: os.fstat(self._file.fileno()).st_size}
        self._position = base[whence] + offset
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer: Any) -> int:
        n_read = os.preadv(self._file.fileno(), [buffer], self._position)
        self._position += n_read
        return n_read

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        done = 0
        with self._keeping_error():
            while done < len(view) and not self._dropping:
                done += os.pwrite(self._file.fileno(), view[done:], self._position + done)
        self._position += len(view)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        size = self._position if size is None else size
        if not self._dropping:
            with self._keeping_error():
                self._file.truncate(size)
        return size


def _cannot_write(path: Path, error: OSError) -> RecordingError:
    return RecordingError(
        f"{path}: cannot write: {error.strerror or error}; free space on the disk, check that the directory exists "
        "and may be written, or write elsewhere"
    )


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise unless ``path`` is free or may be replaced."""
    if path.is_dir():
        raise RecordingError(f"{path}: is a directory; give the name of a file")
    if path.exists() and not overwrite:
        raise RecordingError(f"{path}: exists already; choose another name or add `--force` to replace it")


def temporary_beside(path: Path) -> Path:
    """Return the name under which ``path`` is made before it takes its own."""
    return path.with_name(f".{path.name}.{os.getpid()}.part")
