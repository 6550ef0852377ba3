"""Kernels of rows: every row once, whoever does it."""

import threading

import numpy as np
import pytest

from rfpose.jit import kernel_rows, one_thread


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
