"""The one place where numba's options are set.

Kernels take arrays and scalars and give arrays back; they do not check, read, write, raise or draw random
numbers. A public function in front of each checks, shapes and names.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

__all__ = ["kernel", "kernel_fast", "kernel_inline", "kernel_parallel", "kernel_parallel_fast"]

Function = Callable[..., Any]

# OpenMP's pool may be entered from several Python threads; numba's own work queue may not.
numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]

# Reordering and contraction let sums vectorise. "nnan" and "ninf" stay off: NaN is a mark here.
_REORDER = {"reassoc", "contract", "arcp", "nsz"}
_COMMON: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


def kernel(function: Function) -> Function:
    """Compile a serial kernel with IEEE arithmetic."""
    return numba.njit(**_COMMON)(function)  # type: ignore[no-any-return]


def kernel_inline(function: Function) -> Function:
    """Compile a small piece that is inlined into the kernels that call it."""
    return numba.njit(**_COMMON, inline="always")(function)  # type: ignore[no-any-return]


def kernel_parallel(function: Function) -> Function:
    """Compile a kernel whose ``numba.prange`` loops run on all cores."""
    return numba.njit(**_COMMON, parallel=True)(function)  # type: ignore[no-any-return]


def kernel_fast(function: Function) -> Function:
    """Compile a serial kernel whose sums may be reordered; NaN keeps its meaning."""
    return numba.njit(**_COMMON, fastmath=_REORDER)(function)  # type: ignore[no-any-return]


def kernel_parallel_fast(function: Function) -> Function:
    """Compile a parallel kernel whose sums may be reordered; NaN keeps its meaning."""
    return numba.njit(**_COMMON, parallel=True, fastmath=_REORDER)(function)  # type: ignore[no-any-return]
