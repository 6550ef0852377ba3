"""What a job writes: a name holds the whole content or what it held before, and one job at a time writes it.

`claim` is the one door. It looks at all outputs and inputs of a job before the work, keeps other processes away while
it lasts, and gives the outputs their names together at the end. Beside an output ``NAME`` there are for that time
``.NAME.lock`` (who writes it) and ``.NAME.part`` (what is written); those of a process that died are taken over by the
next job on the same name.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import stat
import sys
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from rfpose.errors import RecordingError
from rfpose.interruption import check, held_back

try:
    import fcntl
except ImportError:  # no such locks on Windows: there, two jobs on one name are not kept apart
    fcntl = None  # type: ignore[assignment]

__all__ = [
    "Claim",
    "cannot_write",
    "claim",
    "make_directory",
    "release_all",
    "remove",
    "replace_content",
    "write_atomically",
]

_UNLOCKABLE = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL)
"""What a file system says that knows no locks."""


@dataclass(slots=True)
class _Output:
    """One output of a job."""

    path: Path
    """As it was given; for messages."""
    real: Path
    """Without symbolic links: a link stays, and what it names is replaced."""
    lock: BinaryIO | None = None
    whole: bool = False
    """All content is in `part`."""

    @property
    def part(self) -> Path:
        return self.real.with_name(f".{self.real.name}.part")

    @property
    def lock_path(self) -> Path:
        return self.real.with_name(f".{self.real.name}.lock")

    @property
    def replaced(self) -> Path:
        return self.real.with_name(f".{self.real.name}.old")


class Claim:
    """The outputs of one job; `claim` is the usual way to one.

    Parameters
    ----------
    outputs
        Files, or directories if ``directories``; None is left out. What the running `claim` holds is left to it.
    inputs
        Files and directories that the job reads; None is left out.
    force
        Replace what exists.
    directories
        The outputs are directories.
    """

    def __init__(
        self,
        outputs: Iterable[str | Path | None],
        *,
        inputs: Iterable[str | Path | None] = (),
        force: bool = False,
        directories: bool = False,
    ) -> None:
        self._outer = _current.get()
        given = [Path(path) for path in outputs if path is not None]
        named = [_Output(path, Path(os.path.realpath(path))) for path in given]
        self._outputs = [output for output in named if self._outer is None or self._outer.find(output.real) is None]
        self._inputs = [Path(path) for path in inputs if path is not None]
        self._force = force
        self._directories = directories
        self._afterwards: list[Callable[[], None]] = []
        self._own: set[Path] = set()
        """What a job like this one published before it was killed."""
        self._taken = False
        self._halfway = False
        """Some outputs have their names, and others not yet."""

    def look(self) -> None:
        """Raise for what can be seen of the outputs without touching anything; `take` sees the rest."""
        for output in self._outputs:
            self._refuse_kind(output)
            self._refuse_existing(output)

    def take(self) -> None:
        """Look at everything, and keep other jobs away.

        Raises
        ------
        RecordingError
            An output that is an input or another output, exists without ``force``, cannot be written, or is being
            written by another process.
        """
        _claims.append(self)
        for i, output in enumerate(self._outputs):
            for other in self._outputs[:i]:
                if _same(output.real, other.real):
                    raise RecordingError(f"{output.path}: two outputs of this name; give each its own")
            self._refuse_kind(output)
        for output in self._outputs:
            with _writing(output.path):
                output.lock = _lock(output)
        self._own = self._published_by_the_dead()
        for output in self._everything():
            self._refuse_inputs(output)
        for output in self._outputs:
            self._refuse_existing(output)
        for output in self._outputs:
            with _writing(output.path):
                _recover(output)
                if output.lock is not None:
                    _note(output.lock, self._note())
        self._taken = True

    def find(self, path: str | Path) -> _Output | None:
        """Return the output of this name, of this job or one around it."""
        real = Path(os.path.realpath(path))
        for output in self._everything():
            if output.real == real:
                return output
        return None

    def part(self, path: str | Path) -> Path:
        """Return where the content of an output is to be made."""
        return self._found(path).part

    def complete(self, path: str | Path) -> None:
        """Say that all content of an output is in its part, and on the disk."""
        self._found(path).whole = True

    def write(self, path: str | Path, content: bytes) -> None:
        """Make an output from bytes."""
        output = self._found(path)
        with _writing(output.path):
            _write_through(output.part, content)
        output.whole = True

    def afterwards(self, work: Callable[[], None]) -> None:
        """Do something when the outputs have their names: what made up for their absence can go."""
        if self._outer is not None and not self._outputs:
            self._outer.afterwards(work)
        else:
            self._afterwards.append(work)

    def publish(self) -> None:
        """Give the outputs that are whole their names, all of them or, in case of an error of the first, none."""
        check()
        ready = [output for output in self._outputs if output.whole]
        for output in ready:
            self._refuse_kind(output)
            self._refuse_existing(output)
        if ready and len(ready) + len(self._afterwards) > 1 and self._outputs[0].lock is not None:
            # killed between two names, the same job may take what it published for its own and begin again
            self._halfway = True
            with _writing(ready[0].path):
                _note(
                    self._outputs[0].lock, self._note() | {"published": {str(o.real): _identity(o.part) for o in ready}}
                )
        for output in ready:
            with _writing(output.path):
                _take_name(output)
        for work in self._afterwards:
            work()
        self._halfway = False

    def release(self) -> None:
        """Remove what is unfinished, and let other jobs in."""
        for output in reversed(self._outputs):
            if output.lock is None:
                continue
            with contextlib.suppress(OSError):
                if self._taken:
                    remove(output.part)
                # what a dead job published is noted for one like it, and so it is if this one stuck halfway
                if not (self._halfway and output is self._outputs[0]) and (
                    self._taken or "published" not in _read_note(output.lock)
                ):
                    output.lock_path.unlink()
            output.lock.close()
            output.lock = None
        if self in _claims:
            _claims.remove(self)

    # -- what is refused -------------------------------------------------------------------------------------

    def _refuse_kind(self, output: _Output) -> None:
        path, real = output.path, output.real
        if not real.parent.is_dir():
            raise RecordingError(f"{path}: its directory does not exist; make it first: {path.parent}")
        if real.is_dir():
            if not self._directories:
                raise RecordingError(f"{path}: is a directory; give the name of a file")
        elif real.exists():
            if self._directories:
                raise RecordingError(f"{path}: is a file, and a directory is to be made; choose another name")
            if not real.is_file():
                raise RecordingError(f"{path}: is no regular file and is never replaced; choose another name")

    def _refuse_existing(self, output: _Output) -> None:
        if output.real.exists() and not self._force and output.real not in self._own:
            raise RecordingError(f"{output.path}: exists already; choose another name, or `force=True` to overwrite it")

    def _refuse_inputs(self, output: _Output) -> None:
        """Raise if an input would be replaced, whatever `force` says."""
        path, real = output.path, output.real
        for given in self._inputs:
            source = Path(os.path.realpath(given))
            if _same(real, source):
                raise RecordingError(f"{path}: source and target are the same, `{given}`; choose another name")
            if real.is_dir() and real in source.parents:
                raise RecordingError(f"{path}: this job reads `{given}`, which lies in there; choose another name")
            if source.is_dir() and source in real.parents and real.exists() and real not in self._own:
                raise RecordingError(
                    f"{path}: exists in `{given}`, which this job reads; nothing there is replaced, choose another name"
                )

    # -- small pieces ----------------------------------------------------------------------------------------

    def _everything(self) -> list[_Output]:
        return self._outputs + ([] if self._outer is None else self._outer._everything())

    def _found(self, path: str | Path) -> _Output:
        output = self.find(path)
        if output is None:
            raise RecordingError(f"{path}: is no output of this job")
        return output

    def _note(self) -> dict[str, Any]:
        import socket  # here and below: what only jobs that write need would keep help and refusals waiting

        return {
            "process": os.getpid(),
            "host": socket.gethostname(),
            "job": [[str(o.real) for o in self._outputs], sorted(os.path.realpath(path) for path in self._inputs)],
        }

    def _published_by_the_dead(self) -> set[Path]:
        """Return outputs that a job with the same outputs and inputs published before it was killed."""
        if not self._outputs or self._outputs[0].lock is None:
            return set()
        left = _read_note(self._outputs[0].lock)
        if left.get("job") != self._note()["job"]:
            return set()
        return {Path(name) for name, identity in left.get("published", {}).items() if _identity(Path(name)) == identity}


_current: ContextVar[Claim | None] = ContextVar("rfpose.files.claim", default=None)
_claims: list[Claim] = []


@contextlib.contextmanager
def claim(
    *outputs: str | Path | None,
    inputs: Iterable[str | Path | None] = (),
    force: bool = False,
    directories: bool = False,
) -> Iterator[Claim]:
    """Check a job's outputs before its work, keep other jobs from them, publish them when the block ends well.

    Claims may stand in one another, as a command's around its library call's: what the outer one holds is joined by the
    inner one and published by the outer, and what the inner one reads is compared with the outputs of both. If the
    block raises, nothing is published and nothing is left.

    Parameters
    ----------
    outputs, inputs, force, directories
        As for `Claim`.

    Raises
    ------
    RecordingError
        As `Claim.take`; or an output cannot get its name.
    """
    job = Claim(outputs, inputs=inputs, force=force, directories=directories)
    try:
        with held_back():
            job.take()
        token = _current.set(job)
        try:
            yield job
        finally:
            _current.reset(token)
        with held_back():
            job.publish()
    finally:
        with held_back():
            job.release()


def release_all() -> None:
    """Remove whatever is unfinished; for a process that is about to end."""
    for job in reversed(_claims.copy()):
        job.release()


def write_atomically(path: str | Path, content: bytes, *, force: bool = True) -> None:
    """Make a file from bytes, in the running `claim` if that holds it, else at once; ``force``: replace what exists.

    Raises
    ------
    RecordingError
        Writing failed (disk full, no permission); ``path`` is as it was and nothing is left beside it.
    """
    with claim(path, force=force) as job:
        job.write(path, content)


def replace_content(path: Path, content: bytes) -> None:
    """Make or replace a file of a job's own, to which no other job comes; whole or not at all.

    Raises
    ------
    RecordingError
        Writing failed.
    """
    part = path.with_name(f".{path.name}.part")
    with _writing(path):
        try:
            _write_through(part, content)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def cannot_write(path: Path, error: OSError) -> RecordingError:
    """Return what to say of a file that the system does not let us write."""
    return RecordingError(
        f"{path}: cannot write: {error.strerror or error}; free space on the disk, check that the directory may be "
        "written, or write elsewhere"
    )


def make_directory(path: str | Path) -> Path:
    """Make a directory and those above it; an existing one is fine.

    Raises
    ------
    RecordingError
        It cannot be made, or is a file.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{path}: cannot make this directory: {error.strerror or error}") from error
    return path


def remove(path: Path) -> None:
    """Delete a file or a tree, if it is there."""
    if path.is_dir() and not path.is_symlink():
        import shutil

        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Name the file in what the system says."""
    try:
        yield
    except RecordingError:
        raise
    except OSError as error:
        raise cannot_write(path, error) from error


def _write_through(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _same(one: Path, other: Path) -> bool:
    """Tell whether two names are one file, through hard links too."""
    if one == other:
        return True
    try:
        return os.path.samefile(one, other)
    except OSError:
        return False


def _identity(path: Path) -> list[int]:
    try:
        found = path.stat()
    except OSError:
        return []
    return [found.st_ino, found.st_size, found.st_mtime_ns]


# -- locks ---------------------------------------------------------------------------------------------------


def _lock(output: _Output) -> BinaryIO:
    """Return the lock file, locked; the lock ends with the process, the file may stay."""
    path = output.lock_path
    while True:
        file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o644), "r+b", buffering=0)
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = _read_note(file)
            file.close()
            named = f"process {who['process']} on {who['host']}" if "process" in who else "another process"
            raise RecordingError(
                f"{output.path}: is being written by {named}; wait until it is done, or choose another name"
            ) from None
        except OSError as error:
            if error.errno not in _UNLOCKABLE:
                file.close()
                raise
        # the one that held it before may have removed the file that is now locked
        with contextlib.suppress(FileNotFoundError):
            if fcntl is None or os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()


def _note(lock: BinaryIO, content: dict[str, Any]) -> None:
    text = json.dumps(content).encode()
    lock.seek(0)
    lock.write(text)
    lock.truncate(len(text))
    os.fsync(lock.fileno())


def _read_note(lock: BinaryIO) -> dict[str, Any]:
    try:
        lock.seek(0)
        found = json.loads(lock.read())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


# -- names ---------------------------------------------------------------------------------------------------


def _recover(output: _Output) -> None:
    """Remove what a killed job left beside an output; a directory that it was about to replace gets its name back."""
    remove(output.part)
    if output.replaced.is_dir():
        if output.real.exists():
            remove(output.replaced)
        else:
            output.replaced.rename(output.real)


def _take_name(output: _Output) -> None:
    """Give the part its name."""
    if output.real.is_file():
        with contextlib.suppress(OSError):
            output.part.chmod(stat.S_IMODE(output.real.stat().st_mode))
    if not output.real.is_dir() or not any(output.real.iterdir()):
        output.part.replace(output.real)
    elif not _exchange(output.part, output.real):
        output.real.rename(output.replaced)
        output.part.rename(output.real)
        remove(output.replaced)


_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two names in one step, so that neither is ever without content; False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    import ctypes

    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    found: int = rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE)
    return found == 0
