"""Print the speed of multilateration: fixes a second, against scipy, and how near the processor's limit.

    python benchmarks/bench_multilat.py [--seconds 5]

The floating-point count is that of the algorithm (start, Gauss-Newton steps, residuals), divisions and square
roots as one each. The limit is measured: a large matrix multiplication on all threads.
"""

from __future__ import annotations

import argparse
import json
import math
import time

import numba
import numpy as np

from rfpose.pipeline.bench_multilat import TRANSMITTER_ENU_M, measure

# floating-point operations a transmitter: moments of the start, normal equations, residuals; and a solution
FLOP_START, FLOP_STEP, FLOP_RESIDUAL = 46, 47, 13
FLOP_SOLVE_START, FLOP_SOLVE_STEP = 110, 120


def peak_flop_per_s() -> float:
    """Measured rate of a large matrix multiplication, the fastest arithmetic at hand."""
    n = 1536
    a = np.random.default_rng(0).standard_normal((n, n))
    best = math.inf
    for _ in range(8):
        start = time.perf_counter()
        np.matmul(a, a)
        best = min(best, time.perf_counter() - start)
    return 2.0 * n**3 / best


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = measure(arguments.seconds)
    n = len(TRANSMITTER_ENU_M)
    flop = n * (FLOP_START + FLOP_RESIDUAL) + FLOP_SOLVE_START
    flop += result["iterations"] * (n * FLOP_STEP + FLOP_SOLVE_STEP)
    result["flop_per_fix"] = flop
    result["gflop_per_s"] = flop * result["fixes_per_s"] / 1e9
    result["peak_gflop_per_s"] = peak_flop_per_s() / 1e9
    if arguments.json:
        print(json.dumps(result))
        return
    print(f"threads                {numba.get_num_threads()}")
    print(f"fixes/s                {result['fixes_per_s'] / 1e6:.2f} million, {result['iterations']:.2f} steps each")
    print(f"scipy least_squares    {result['scipy_fixes_per_s']:.0f} fixes/s")
    print(f"ratio                  {result['speedup_vs_scipy']:.0f}")
    print(f"largest difference     {result['worst_difference_m']:.1e} m")
    share = result["gflop_per_s"] / result["peak_gflop_per_s"]
    print(
        f"arithmetic             {result['gflop_per_s']:.1f} GFLOP/s of {result['peak_gflop_per_s']:.0f} of matrix "
        f"multiplication ({100 * share:.0f} %), {flop:.0f} a fix"
    )


if __name__ == "__main__":
    main()
