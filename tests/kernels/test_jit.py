"""Kernels of rows: every row once, whoever does it."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from rfpose.jit import kernel_lean, kernel_rows, one_thread


@kernel_rows
def add_one(begin, end, value):
    for i in range(begin, end):
        value[i] += 1.0


@pytest.mark.parametrize("n", [0, 1, 2, 7, 1000])
def test_every_row_is_done_once(n):
    value = np.zeros(n)
    add_one(n, value)
    with one_thread():
        add_one(n, value)
    np.testing.assert_array_equal(value, 2.0)


def test_threads_that_call_at_once_do_not_disturb_each_other():
    values = [np.zeros(500) for _ in range(6)]

    def call(value):
        for _ in range(50):
            add_one(len(value), value)

    threads = [threading.Thread(target=call, args=(value,)) for value in values]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for value in values:
        np.testing.assert_array_equal(value, 50.0)


CALLED = """
from typing import NamedTuple
from rfpose.jit import kernel

class {kind}(NamedTuple):
    value: float

@kernel
def doubled(x):
    return {factor} * x
"""
CALLER = """
import inner_kernels
from inner_kernels import doubled
from rfpose.jit import kernel

@kernel
def of_both(x, more):
    return doubled(x) + more.value
"""
CALL = "import inner_kernels, outer_kernels; print(outer_kernels.of_both(3.0, inner_kernels.{kind}(1.0)))"


def test_a_kernel_is_compiled_anew_when_what_it_calls_changes(tmp_path):
    """Numba looks at the kernel's own file alone: it would go on with the old one, or break where a type is gone."""
    (tmp_path / "outer_kernels.py").write_text(CALLER)
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    for kind, factor, wanted in (("More", 2.0, "7.0"), ("More", 2.50, "8.5"), ("Renamed", 3.125, "10.375")):
        (tmp_path / "inner_kernels.py").write_text(CALLED.format(kind=kind, factor=factor))
        # -B: Python itself takes a file of the same second and size for the one that it has compiled
        command = [sys.executable, "-B", "-c", CALL.format(kind=kind)]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.stdout.strip() == wanted, done.stderr


def test_a_kernel_is_compiled_into_another_though_it_came_out_of_the_cache(tmp_path):
    (tmp_path / "inner_kernels.py").write_text(CALLED.format(kind="More", factor=2.0))
    (tmp_path / "outer_kernels.py").write_text(CALLER)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    alone = "import inner_kernels; print(inner_kernels.doubled(3.0))"
    called = CALL.format(kind="More")
    for call, wanted in ((alone, "6.0"), (f"{alone}; {called}", "6.0\n7.0"), (called, "7.0")):
        command = [sys.executable, "-c", call]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.stdout.strip() == wanted, done.stderr


def test_a_full_disk_costs_what_would_be_kept_and_not_the_work(tmp_path):
    (tmp_path / "inner_kernels.py").write_text(CALLED.format(kind="Shape", factor=2))
    run = (
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)); from inner_kernels import doubled; "
        "print(doubled(3.0))"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    done = subprocess.run([sys.executable, "-c", run], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "6.0\n"
    assert "compiled kernels cannot be kept: File too large" in done.stderr
    assert list(tmp_path.rglob("*.nb*")) == []


@pytest.mark.parametrize("numba_knows", [True, False])
def test_a_numba_without_its_own_option_compiles_all_the_same(monkeypatch, numba_knows):
    from numba.core.cpu import CPUTargetOptions

    if not numba_knows:
        monkeypatch.delattr(next(each for each in CPUTargetOptions.__mro__ if "_nrt" in vars(each)), "_nrt")

    @kernel_lean
    def total(value):
        found = 0.0
        for i in range(len(value)):
            found += value[i]
        return found

    assert total(np.arange(4.0)) == 6.0
    # what is not compiled but comes from the cache is not looked at
    assert ("_nrt" in total.compiled.targetoptions) == numba_knows
