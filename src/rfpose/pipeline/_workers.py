"""Receivers side by side: one thread a core, each with serial kernels and serial BLAS."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

__all__ = ["n_worker", "worker_pool"]


def n_worker() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


_SWITCH_INTERVAL_S = 1e-4


@contextmanager
def worker_pool() -> Iterator[ThreadPoolExecutor]:
    """Yield a pool with one thread a core, while BLAS keeps to the thread that calls it.

    A frame's matrix products are too small to share; BLAS threads that wait for each other would only take the
    cores from the other receivers.
    """
    # a thread that comes out of a kernel should not wait Python's usual 5 ms for the interpreter
    switch_interval = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    try:
        with threadpool_limits(limits=1, user_api="blas"), ThreadPoolExecutor(n_worker(), "rfpose") as pool:
            try:
                yield pool
            finally:
                pool.shutdown(wait=True, cancel_futures=True)
    finally:
        sys.setswitchinterval(switch_interval)
