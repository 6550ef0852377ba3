"""Where the tasks of a job run: in this process, in processes of this machine, or on the machines of a Dask cluster.

Tasks know nothing of each other and of where they run, and the job puts their results together in its own order, so
that the same job gives the same bytes anywhere. All that is hard about many machines is dask.distributed's: who takes
which task, what becomes of the tasks of a worker that died, how code and results travel.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import logging
import os
import queue
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from rfpose import __version__
from rfpose.errors import ClusterError, InvalidInputError, RfposeError, install_remedy
from rfpose.interruption import ignored

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from distributed import Client, Future
    from threadpoolctl import ThreadpoolController

__all__ = [
    "Engine",
    "Team",
    "gathered",
    "is_elsewhere",
    "n_core",
    "one_thread_of_blas",
    "team_here",
    "team_of",
    "worker_pool",
]

Shared = TypeVar("Shared")
Item = TypeVar("Item")
Found = TypeVar("Found")

_log = logging.getLogger(__name__)

_CONNECT_S = 10.0
_LOOK_S = 5.0
"""How often a job that waits looks whether there is somebody to wait for."""
_ALONE_S = 60.0
"""How long a job waits for a first worker, or another one when the last is gone."""
_CLOSE_S = 10.0
_SWITCH_INTERVAL_S = 1e-4
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h
_KEPT_BYTES = 32 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Engine:
    """Who does a job's tasks; with neither of the two, this process.

    Attributes
    ----------
    scheduler
        Address of a running Dask scheduler, such as ``tcp://host:8786``; its workers do the tasks.
    workers
        Processes of this machine that are started for the job, and share its cores.

    Raises
    ------
    InvalidInputError
        Both are given, or ``workers`` is less than one.
    """

    scheduler: str | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.scheduler is not None and self.workers is not None:
            raise InvalidInputError(
                "`workers` are started here, those of a `scheduler` run already; give one of the two"
            )
        if self.workers is not None and self.workers < 1:
            raise InvalidInputError(f"`workers` must be at least one, got {self.workers}")

    @contextlib.contextmanager
    def used(self) -> Iterator[None]:
        """Give it the tasks of jobs in the block; what it starts for the first of them serves all, and ends with it.

        Examples
        --------
        >>> import rfpose as rf
        >>> from rfpose.engine import Engine
        >>> with Engine(workers=4).used():  # doctest: +SKIP
        ...     rf.process("night.h5", "result.h5")
        """
        with contextlib.ExitStack() as opened:
            token = _chosen.set(_Chosen(self, opened))
            try:
                yield
            finally:
                _chosen.reset(token)


@dataclass(slots=True)
class _Chosen:
    """The engine of a block, and who of it has been asked already."""

    engine: Engine
    opened: contextlib.ExitStack
    team: Team | None = None


_chosen: ContextVar[_Chosen | None] = ContextVar("rfpose.engine", default=None)


def is_elsewhere() -> bool:
    """Tell whether other processes than this one do the tasks of a job that begins now."""
    chosen = _chosen.get()
    return chosen is not None and (chosen.engine.scheduler is not None or chosen.engine.workers is not None)


class Team(Protocol):
    """Those who do the tasks of one job."""

    @property
    def n_at_once(self) -> int:
        """Tasks that run side by side."""

    def map(
        self, function: Callable[[Shared, Item], Found], items: Sequence[Item], shared: Shared
    ) -> Iterator[tuple[int, Found]]:
        """Yield (index of the item, ``function(shared, item)``) as they are done.

        Items that are appended meanwhile are done as well, so that what goes on from one task's result need not wait
        for the others. Elsewhere, function, items and what they share travel by pickle, and so does what is found.

        Raises
        ------
        RfposeError
            As a task raised it; elsewhere it names the worker.
        ClusterError
            The scheduler is gone, no worker is left, or a task kills its workers.
        """


@contextlib.contextmanager
def team_of() -> Iterator[Team]:
    """Yield those who do a job's tasks: of the `Engine` that is used, else the thread that asks.

    Raises
    ------
    ClusterError
        The extra is missing, nobody answers, no worker comes, or one has another version of rfpose.
    """
    chosen = _chosen.get()
    if chosen is None or not is_elsewhere():
        yield _Here(None, 1)
        return
    if chosen.team is None:
        _require_dask()
        n_worker = chosen.engine.workers
        where = chosen.engine.scheduler if n_worker is None else chosen.opened.enter_context(_local_cluster(n_worker))
        client = chosen.opened.enter_context(_client(where))
        _wait_for_workers(client)
        _check_versions(client)
        chosen.team = _Cluster(client)
    yield chosen.team


@contextlib.contextmanager
def team_here(*, alone: bool = False) -> Iterator[Team]:
    """Yield a team of this process's threads, one a core: for tasks that do not share the cores by themselves.

    Parameters
    ----------
    alone
        The thread that asks does all: for tasks of many pieces so short that threads would mostly wait for the
        interpreter, which takes longer to hand over than a piece to do.
    """
    if alone:
        with one_thread_of_blas():
            yield _Here(None, 1)
        return
    with worker_pool() as pool:
        yield _Here(pool, n_core())


def n_core() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


# -- this process --------------------------------------------------------------------------------------------


@contextlib.contextmanager
def worker_pool() -> Iterator[Executor]:
    """Yield a pool with one thread a core, while BLAS keeps to the thread that calls it.

    A frame's matrix products are too small to share; BLAS threads that wait for each other would only take the
    cores from the other receivers.
    """
    # a thread that comes out of a kernel should not wait Python's usual 5 ms for the interpreter
    switch_interval = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    try:
        with one_thread_of_blas(), ThreadPoolExecutor(n_core(), "rfpose") as pool:
            try:
                yield pool
            finally:
                pool.shutdown(wait=True, cancel_futures=True)
    finally:
        sys.setswitchinterval(switch_interval)


def one_thread_of_blas(*, scipy: bool = False) -> contextlib.AbstractContextManager[object]:
    """Keep BLAS to the thread that calls it.

    Parameters
    ----------
    scipy
        Scipy's too, which brings one of its own: it is loaded, since what is not there cannot be held.
    """
    from threadpoolctl import ThreadpoolController

    held: contextlib.AbstractContextManager[object] = (_blas_of_both() if scipy else ThreadpoolController()).limit(
        limits=1, user_api="blas"
    )
    return held


@functools.cache
def _blas_of_both() -> ThreadpoolController:
    """Return the hold on numpy's and scipy's BLAS, which takes milliseconds to find."""
    import scipy.linalg  # noqa: F401 -- loads it
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


class _Here:
    """Done in this process: by a pool of threads, or without one by whoever asks."""

    def __init__(self, pool: Executor | None, n_at_once: int) -> None:
        self._pool = pool
        self.n_at_once = n_at_once

    def map(
        self, function: Callable[[Shared, Item], Found], items: Sequence[Item], shared: Shared
    ) -> Iterator[tuple[int, Found]]:
        if self._pool is None:
            for i, item in enumerate(items):
                yield i, function(shared, item)
            return
        pool, left = self._pool, dict[Any, int]()

        def give(new: Sequence[Item]) -> list[Any]:
            return [pool.submit(function, shared, item) for item in new]

        try:
            for i, future in _in_flight(items, give, queue.SimpleQueue.get, left):
                yield i, future.result()
        finally:
            for future in left:
                future.cancel()


def _in_flight(
    items: Sequence[Item],
    give: Callable[[Sequence[Item]], list[Any]],
    next_done: Callable[[queue.SimpleQueue[Any]], Any],
    left: dict[Any, int],
) -> Iterator[tuple[int, Any]]:
    """Give items out, those that are appended meanwhile, too; yield (index, future) of each that is done.

    ``left`` holds those that are not yet, and nothing the others: what they found may go from the worker's memory.
    """
    done: queue.SimpleQueue[Any] = queue.SimpleQueue()
    n_given = 0
    while True:
        new = items[n_given:]
        if new:
            for i, future in enumerate(give(new), n_given):
                left[future] = i
                future.add_done_callback(done.put)
            n_given += len(new)
        if not left:
            return
        future = next_done(done)
        yield left.pop(future), future
        del future


def gathered(
    function: Callable[[Shared, Item], Found],
    items: Sequence[Item],
    shared: Shared,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[Found]:
    """Return ``function(shared, item)`` of each item, in their order, by `team_of`.

    Parameters
    ----------
    function, items, shared
        As in `Team.map`.
    on_progress
        Called with (items done, items).

    Raises
    ------
    RfposeError, ClusterError
        As `Team.map`.
    """
    found: dict[int, Found] = {}
    with team_of() as team:
        for i, one in team.map(function, items, shared):
            found[i] = one
            if on_progress is not None:
                on_progress(len(found), len(items))
    return [found[i] for i in range(len(items))]


# -- a cluster -----------------------------------------------------------------------------------------------


class _Cluster:
    """The workers of a Dask scheduler."""

    def __init__(self, client: Client) -> None:
        self._client = client

    @property
    def n_at_once(self) -> int:
        with _reaching(self._client):
            return max(1, sum(int(n) for n in self._client.nthreads().values()))

    def map(
        self, function: Callable[[Shared, Item], Found], items: Sequence[Item], shared: Shared
    ) -> Iterator[tuple[int, Found]]:
        left: dict[Future[Any], int] = {}

        def give(new: Sequence[Item]) -> list[Future[Any]]:
            with _reaching(self._client):
                given: list[Future[Any]] = self._client.map(
                    _run, list(new), function=function, shared=shared, version=__version__, pure=False
                )
                return given

        try:
            for i, future in _in_flight(items, give, self._next, left):
                yield i, self._result(future)
        finally:
            with ignored(), contextlib.suppress(Exception):
                if left and self._client.status == "running":
                    self._client.cancel(list(left))

    def _next(self, done: queue.SimpleQueue[Future[Any]]) -> Future[Any]:
        """Return the next that is done, while there is anybody to do it."""
        alone_since: float | None = None
        while True:
            try:
                return done.get(timeout=_LOOK_S)
            except queue.Empty:
                with _reaching(self._client):
                    n_worker = len(self._client.nthreads())
            now = time.monotonic()
            if n_worker:
                alone_since = None
            elif alone_since is None:
                alone_since = now
                _log.warning("%s: no worker is left; waiting %.0f s for one", _address(self._client), _ALONE_S)
            elif now - alone_since > _ALONE_S:
                raise ClusterError(
                    f"{_address(self._client)}: no worker is left; start one: {_start_hint(self._client)}"
                )

    def _result(self, future: Future[Any]) -> Any:
        from distributed.scheduler import KilledWorker

        try:
            with _reaching(self._client):
                return future.result()
        except RfposeError:
            raise
        except KilledWorker as error:
            raise ClusterError(
                f"{_address(self._client)}: {error.allowed_failures + 1} workers died on the same task, the last at "
                f"{error.last_worker.address}; see their logs, and whether they have memory enough"
            ) from error
        except Exception:
            # a worker that joined later, with code of another version, fails in ways of its own
            _check_versions(self._client)
            raise


def _run(item: Any, *, function: Callable[[Any, Any], Any], shared: Any, version: str) -> Any:
    """Do one task on a worker."""
    from distributed import get_worker

    place = f"worker {get_worker().address}"
    if version != __version__:
        raise ClusterError(_differ(place, __version__, version))
    _settle()
    try:
        return function(shared, item)
    except RfposeError as error:
        raise type(error)(f"{place}: {error}") from error


@functools.cache
def _settle() -> None:
    """Keep BLAS to the thread that calls it for as long as this worker lives, see `worker_pool`, and freed memory.

    Dask starts workers with ``MALLOC_TRIM_THRESHOLD_``, by which each array of a frame goes back to the system and its
    pages are asked for anew with the next frame: half as fast. The thresholds are those that glibc else finds.
    """
    one_thread_of_blas(scipy=True)
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    with contextlib.suppress(OSError, AttributeError, TypeError):  # not glibc
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, _KEPT_BYTES)
        mallopt(_M_TRIM_THRESHOLD, 2 * _KEPT_BYTES)


def _require_dask() -> None:
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise ClusterError(
            f"tasks in other processes need dask.distributed; {install_remedy('distributed')}"
        ) from error


@contextlib.contextmanager
def _local_cluster(n_worker: int) -> Iterator[Any]:
    """Start workers on this machine, which end with the block, and with this process however that ends."""
    import dask
    from distributed import LocalCluster
    from distributed.security import Security

    threads = max(1, n_core() // n_worker)
    environment = dict(dask.config.get("distributed.nanny.pre-spawn-environ")) | {"NUMBA_NUM_THREADS": threads}
    # a look at its own stack each 10 ms costs a worker 2 % of a core, and nobody sees what it finds
    quiet = {"distributed.worker.profile.enabled": False}
    with dask.config.set({"distributed.nanny.pre-spawn-environ": environment} | quiet):
        # encrypted, since whoever may speak to a scheduler may run any code, and others may be on this machine
        cluster = LocalCluster(
            n_workers=n_worker,
            threads_per_worker=threads,
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
            security=Security.temporary(),
        )
        try:
            yield cluster
        finally:
            with ignored():
                cluster.close(timeout=_CLOSE_S)


@contextlib.contextmanager
def _client(where: Any) -> Iterator[Client]:
    """Connect to a scheduler for the block."""
    from distributed import Client
    from distributed.comm import get_address_host

    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)  # what goes wrong is told by what is raised
    try:
        if isinstance(where, str):
            get_address_host(where)  # a client of what is no address at all takes 20 s to be given up
        client = Client(where, timeout=_CONNECT_S, set_as_default=False, name="rfpose")
    except (OSError, ValueError, TypeError) as error:
        raise ClusterError(
            f"{where}: no Dask scheduler answers there ({error}); check the address, or start one: `dask scheduler`"
        ) from error
    try:
        yield client
    finally:
        with ignored(), contextlib.suppress(Exception):
            client.close(timeout=_CLOSE_S)


def _address(client: Client) -> str:
    return str(client.scheduler.address) if client.scheduler is not None else "scheduler"


def _start_hint(client: Client) -> str:
    return f"`dask worker {_address(client)}`"


@contextlib.contextmanager
def _reaching(client: Client) -> Iterator[None]:
    """Name the scheduler if it does not answer any more."""
    from concurrent.futures import CancelledError

    from distributed.comm import CommClosedError

    try:
        yield
    except RfposeError:
        raise
    except (CommClosedError, CancelledError, TimeoutError) as error:
        raise ClusterError(f"{_address(client)}: the scheduler does not answer any more ({error})") from error


def _wait_for_workers(client: Client) -> None:
    if not client.nthreads():
        _log.warning("%s: no worker yet; waiting %.0f s for one", _address(client), _ALONE_S)
    try:
        client.wait_for_workers(1, timeout=_ALONE_S)
    except TimeoutError as error:
        raise ClusterError(f"{_address(client)}: no worker came; start one: {_start_hint(client)}") from error


def _check_versions(client: Client) -> None:
    """Refuse a worker with another rfpose, or none."""

    def look() -> str:  # travels as code and not as a name, which another version might not have
        try:
            import rfpose
        except ImportError as error:
            return f"none ({error})"
        return rfpose.__version__

    with _reaching(client):
        found = client.run(look, on_error="ignore")  # of a worker that dies just now, others take the tasks
    for address, version in found.items():
        if version != __version__:
            raise ClusterError(_differ(f"worker {address}", version, __version__))


def _differ(place: str, there: str, here: str) -> str:
    return f"{place}: its rfpose is {there}, and the one that gives the tasks is {here}; install the same on both"
