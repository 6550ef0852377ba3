"""All benchmarks of ``rfpose bench`` under stable keys."""

from __future__ import annotations

from typing import Any

from rfpose.pipeline import bench_dsp, bench_multilat

__all__ = ["run"]


def run(*, seconds: float = 3.0) -> dict[str, Any]:
    """Measure this machine.

    Parameters
    ----------
    seconds
        Time to spend on each measurement [s].

    Returns
    -------
    dict
        ``multilat`` (see `bench_multilat.measure`), ``dsp`` (see `bench_dsp.measure`), ``memory_read_gb_per_s``.
    """
    return {
        "multilat": bench_multilat.measure(seconds),
        "dsp": bench_dsp.measure(seconds),
        "memory_read_gb_per_s": bench_dsp.measure_memory(seconds),
    }
