"""The one place where numba's options are set.

Kernels take arrays and scalars and give arrays back; they do not check, read, write, raise or draw random
numbers. A public function in front of each checks, shapes and names.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numba
from numba.core import event

__all__ = ["kernel", "kernel_fast", "kernel_inline", "kernel_parallel", "kernel_parallel_fast"]

Function = Callable[..., Any]

# OpenMP's pool may be entered from several Python threads; numba's own work queue may not.
numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]

# Reordering and contraction let sums vectorise. "nnan" and "ninf" stay off: NaN is a mark here.
_REORDER = {"reassoc", "contract", "arcp", "nsz"}
_COMMON: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


_log = logging.getLogger(__name__)


def kernel(function: Function) -> Function:
    """Compile a serial kernel with IEEE arithmetic."""
    return _compiled(function)


def kernel_inline(function: Function) -> Function:
    """Compile a small piece that is inlined into the kernels that call it."""
    return _compiled(function, inline="always")


def kernel_parallel(function: Function) -> Function:
    """Compile a kernel whose ``numba.prange`` loops run on all cores."""
    return _compiled(function, parallel=True)


def kernel_fast(function: Function) -> Function:
    """Compile a serial kernel whose sums may be reordered; NaN keeps its meaning."""
    return _compiled(function, fastmath=_REORDER)


def kernel_parallel_fast(function: Function) -> Function:
    """Compile a parallel kernel whose sums may be reordered; NaN keeps its meaning."""
    return _compiled(function, parallel=True, fastmath=_REORDER)


def _compiled(function: Function, **options: Any) -> Function:
    """Hand a function to numba, with its cache if there is a place for it."""
    try:
        return numba.njit(**_COMMON, **options)(function)  # type: ignore[no-any-return]
    except RuntimeError as error:
        if "cache" not in str(error):
            raise
    # neither the package's directory nor the user's may be written
    _teller.can_keep = False
    return numba.njit(**_COMMON | {"cache": False}, **options)(function)  # type: ignore[no-any-return]


class _Teller(event.Listener):
    """Says once in a process that it compiles; what comes out of the cache is not compiled."""

    def __init__(self) -> None:
        self.can_keep = True
        self._told = False

    def on_start(self, event: event.Event) -> None:
        """Hear that a function is about to be compiled."""
        if self._told or not event.data["dispatcher"].py_func.__module__.startswith("rfpose."):
            return
        self._told = True
        _log.info("compiling kernels, once; this takes up to a minute or two")
        if not self.can_keep:
            _log.info(
                "they cannot be kept, since neither the directory of rfpose nor that of the user can be written; set "
                "NUMBA_CACHE_DIR to a directory that can"
            )

    def on_end(self, event: event.Event) -> None:
        """Nothing to say."""


_teller = _Teller()
event.register("numba:compile", _teller)  # type: ignore[no-untyped-call]
