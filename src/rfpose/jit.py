"""The one place where numba's options are set.

Kernels take arrays and scalars and give arrays back; they do not check, read, write, raise or draw random
numbers. A public function in front of each checks, shapes and names.

Numba itself takes half a second to load. It is loaded when the first kernel is called, so that what calls none (help,
a refusal, most of ``rfpose info``) does not wait for it.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import logging
import os
import pickle
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

__all__ = [
    "Kernel",
    "compilations",
    "kernel",
    "kernel_fast",
    "kernel_inline",
    "kernel_lean",
    "kernel_parallel",
    "kernel_rows",
    "load_numba",
    "one_thread",
    "prange",
    "prefetch",
]

Function = Callable[..., Any]

# Reordering and contraction let sums vectorise. "nnan" and "ninf" stay off: NaN is a mark here.
_REORDER = {"reassoc", "contract", "arcp", "nsz"}
# Nothing calls kernels from C.
_COMMON: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}

_log = logging.getLogger(__name__)


def kernel(function: Function) -> Kernel:
    """Compile a serial kernel with IEEE arithmetic."""
    return Kernel(function)


def kernel_inline(function: Function) -> Kernel:
    """Compile a small piece that is inlined into the kernels that call it."""
    return Kernel(function, inline="always")


def kernel_lean(function: Function) -> Kernel:
    """Compile a serial kernel that makes no arrays, only looks into those handed in.

    It does not count who holds them: threads that work on rows of one array would wait for each other's counting.
    """
    return Kernel(function, _nrt=False)


def kernel_parallel(function: Function) -> Kernel:
    """Compile a kernel whose ``prange`` loops run on all cores."""
    return Kernel(function, parallel=True)


def kernel_rows(function: Function) -> Kernel:
    """Compile a serial kernel ``f(begin, end, …)`` that does some of many rows; called as ``f(n_row, …)``.

    Threads of Python share the rows out and the kernel lets go of the interpreter, so it runs on all cores as one of
    numba's parallel loops does, but is compiled once, not three times over. It returns nothing.
    """
    return _Rows(function)


def kernel_fast(function: Function) -> Kernel:
    """Compile a serial kernel whose sums may be reordered; NaN keeps its meaning."""
    return Kernel(function, fastmath=_REORDER)


prange = range
"""In a kernel: a loop that runs on all cores; numba's own takes this name's place before anything is compiled."""


def prefetch(array: Any, index: int) -> None:
    """In a kernel: ask the memory for an item, maybe beyond the array's end, so that it is there when it is needed."""


class Kernel:
    """A function that numba gets to see when it is first called.

    Attributes
    ----------
    py_func
        The function as it was written, for its twin in tests.
    """

    def __init__(self, function: Function, **options: Any) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self.options = options
        self.compiled: Function | None = None
        _unbound.append(self)

    def __call__(self, *arguments: Any) -> Any:
        """Run the compiled function."""
        return self._bound()(*arguments)

    def _bound(self) -> Function:
        if self.compiled is None:
            _bind()
        assert self.compiled is not None
        return self.compiled


class _Rows(Kernel):
    """A kernel of rows ``begin`` to ``end``, called with how many there are."""

    def __call__(self, n_row: int, *arguments: Any) -> None:
        compiled = self._bound()
        n_thread = 1 if getattr(_here, "alone", False) else load_numba().config.NUMBA_NUM_THREADS
        n_piece = min(n_row, _PIECES * n_thread) if n_thread > 1 else 1
        if n_piece < 2:
            compiled(0, n_row, *arguments)
            return
        edges = iter([(n_row * i // n_piece, n_row * (i + 1) // n_piece) for i in range(n_piece)])

        def work() -> None:
            for begin, end in edges:  # whoever is free takes the next piece
                compiled(begin, end, *arguments)

        helping = [_pool().submit(work) for _ in range(n_thread - 1)]
        try:
            work()
        finally:
            for helper in helping:
                if not helper.cancel():
                    helper.result()


_PIECES = 8  # a thread; the more, the less one waits for another at the end
_here = threading.local()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run kernels of this thread on it alone: where there are few rows, others would only be waited for."""
    before = getattr(_here, "alone", False)
    _here.alone = True
    try:
        yield
    finally:
        _here.alone = before


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(load_numba().config.NUMBA_NUM_THREADS - 1, thread_name_prefix="rfpose-rows")


if hasattr(os, "register_at_fork"):  # a forked process has none of the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


_unbound: list[Kernel] = []
_lock = threading.RLock()


def _bind() -> None:
    """Hand every kernel that was written down so far to numba.

    Compiled code looks its callees up among the globals of its module, so there each kernel makes room for what numba
    made of it.
    """
    with _lock:
        numba = load_numba()
        made = list(_unbound)
        for one in made:
            one.compiled = _compiled(numba, one.py_func, one.options)
        for one in made:
            names = one.py_func.__globals__
            for name, value in list(names.items()):
                if type(value) is Kernel and value.compiled is not None:  # those of rows are called from Python only
                    names[name] = value.compiled
                elif value is prange:
                    names[name] = numba.prange
        del _unbound[: len(made)]


@functools.cache
def load_numba() -> Any:
    """Load numba and set what holds for all kernels."""
    import numba
    from numba.core import event

    class Listener(event.Listener):
        def on_start(self, event: event.Event) -> None:
            _teller.hear(event.data["dispatcher"].py_func.__module__)

        def on_end(self, event: event.Event) -> None:
            pass

    _take_scipy_as_there()
    # OpenMP's pool may be entered from several Python threads; numba's own work queue may not.
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]
    event.register("numba:compile", Listener())  # type: ignore[no-untyped-call]
    _teach_prefetch(numba)
    return numba


def _teach_prefetch(numba: Any) -> None:
    """Tell numba what `prefetch` is in compiled code: one instruction, which numba has no name for."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        ir = importlib.import_module("llvmlite.ir")
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        place = builder.bitcast(builder.gep(data, [arguments[1]]), ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        to_read, kept_close, of_data = number(0), number(3), number(1)
        told = ir.FunctionType(ir.VoidType(), [place.type, number, number, number])
        function = numba.core.cgutils.get_or_insert_function(builder.module, told, "llvm.prefetch.p0")
        builder.call(function, [place, to_read, kept_close, of_data])
        return context.get_dummy_value()

    ask = numba.extending.intrinsic(lambda _, array, index: (numba.types.void(array, index), generate))
    numba.extending.overload(prefetch)(lambda array, index: lambda array, index: ask(array, index))


@functools.cache
def _cache_class() -> Any:
    """Return numba's cache of compiled kernels with what it lacks for ours.

    It readies for compiling only when something is compiled: numba's own loads all that its compiler knows about Python
    and numpy, 0.2 s, before it looks. And a kernel is compiled anew when another file changes whose kernels are part of
    it: numba's own looks at the kernel's file alone, and breaks where a type that it keeps is gone.
    """
    from numba.core.caching import FunctionCache
    from numba.core.runtime.nrt import rtsys

    class KernelCache(FunctionCache):
        def __init__(self, py_func: Function) -> None:
            super().__init__(py_func)  # type: ignore[no-untyped-call]
            self._cache_file._source_stamp = _stamps(py_func.__module__)

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            rtsys.initialize(target_context)
            with self._guard_against_spurious_io_errors(), _bitcode_left_for_later(target_context.codegen()):
                try:
                    return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]
                except (AttributeError, ImportError, pickle.UnpicklingError, EOFError):
                    self.flush()  # type: ignore[no-untyped-call]
                    return None

        def save_overload(self, sig: Any, data: Any) -> None:
            try:
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]
            except OSError as error:  # a full disk; what was compiled serves this process
                _teller.hear_unkept(error)

    return KernelCache


@contextlib.contextmanager
def _bitcode_left_for_later(codegen: Any) -> Iterator[None]:
    """While it lasts, compiled code is loaded without the bitcode by which it is compiled into other kernels.

    Few processes compile any, and reading it takes about as long as all else of a kernel's loading.
    """
    before, codegen._library_class = codegen._library_class, _library_class()
    try:
        yield
    finally:
        codegen._library_class = before


@functools.cache
def _library_class() -> Any:
    """Return numba's compiled code whose bitcode is read when a kernel asks for it that is being compiled."""
    import llvmlite.binding as llvm
    from numba.core.codegen import JITCodeLibrary

    nothing = llvm.parse_assembly("").as_bitcode()

    class KernelLibrary(JITCodeLibrary):
        _bitcode: bytes | None = None

        @classmethod
        def _unserialize(cls, codegen: Any, state: Any) -> Any:
            name, kind, data = state
            if kind != "object":
                return super()._unserialize(codegen, state)  # type: ignore[no-untyped-call]
            machine_code, bitcode = data
            library = super()._unserialize(codegen, (name, kind, (machine_code, nothing)))  # type: ignore[no-untyped-call]
            library._shared_module, library._bitcode = None, bitcode
            return library

        def _get_module_for_linking(self) -> Any:
            if self._shared_module is None and self._bitcode is not None:
                self._shared_module = llvm.parse_bitcode(self._bitcode)
            return super()._get_module_for_linking()  # type: ignore[no-untyped-call]

        def get_pointer_to_function(self, name: str) -> Any:
            if self._bitcode is not None:  # numba knows no names of it, and asks for the kernel alone
                return self._codegen._engine.get_function_address(name)
            return super().get_pointer_to_function(name)  # type: ignore[no-untyped-call]

    return KernelLibrary


def _stamps(name: str) -> tuple[tuple[str, int, int], ...]:
    """Return time and size of a module of kernels and of those whose kernels and types it uses."""
    found: dict[str, tuple[str, int, int]] = {}
    waiting = [name]
    while waiting:
        name = waiting.pop()
        module = sys.modules.get(name)
        if name in found or module is None or not getattr(module, "__file__", None):
            continue
        about = Path(str(module.__file__)).stat()
        found[name] = (name, about.st_mtime_ns, about.st_size)
        for value in vars(module).values():
            other = str(getattr(value, "__name__" if isinstance(value, ModuleType) else "__module__", ""))
            waiting += [other] if other.endswith("_kernels") else []
    return tuple(sorted(found.values()))


def _take_scipy_as_there() -> None:
    """Spare numba the loading of `scipy.linalg`, half a second, by which it only learns that scipy is installed.

    Kernels with products of matrices find BLAS by themselves when they run.
    """
    from numba.np import linalg

    ask = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        linalg.ensure_blas = ask


def _understood(options: dict[str, Any], target: type) -> dict[str, Any]:
    """Leave out what this numba does not know; what is of its own and may go only saves time."""
    return {name: value for name, value in options.items() if not name.startswith("_") or hasattr(target, name)}


def _compiled(numba: Any, function: Function, options: dict[str, Any]) -> Function:
    """Hand a function to numba, with its cache if there is a place for it."""
    from numba.core.cpu import CPUTargetOptions

    dispatcher = numba.njit(**_understood(_COMMON | options, CPUTargetOptions))(function)
    try:
        dispatcher._cache = _cache_class()(function)
    except RuntimeError as error:
        if "cache" not in str(error):
            raise
        # neither the package's directory nor the user's may be written
        _teller.can_keep = False
    return dispatcher  # type: ignore[no-any-return]


class _Teller:
    """Says once in a process that it compiles; what comes out of the cache is not compiled."""

    def __init__(self) -> None:
        self.can_keep = True
        self.count = 0
        self._told = False

    def hear(self, module: str) -> None:
        """Take note that a function of a module is about to be compiled."""
        if not module.startswith("rfpose."):
            return
        self.count += 1
        if self._told:
            return
        self._told = True
        _log.info("compiling kernels, once; this takes up to a minute or two (`rfpose warm-up` compiles all of them)")
        if not self.can_keep:
            _log.info(
                "they cannot be kept, since neither the directory of rfpose nor that of the user can be written; set "
                "NUMBA_CACHE_DIR to a directory that can"
            )

    def hear_unkept(self, error: OSError) -> None:
        """Take note that a compiled kernel could not be written."""
        if self.can_keep:
            _log.warning("compiled kernels cannot be kept: %s", error.strerror or error)
        self.can_keep = False


_teller = _Teller()


def compilations() -> int:
    """Return how many kernels this process has compiled; what comes out of the cache is none."""
    return _teller.count
