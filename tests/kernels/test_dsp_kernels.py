"""jit == Python twin == plain numpy."""

import numpy as np
import pytest

from rfpose.dsp import _kernels


def both(kernel, *args):
    """Run the compiled kernel and its Python twin on copies; return both results with their output arrays."""
    results = []
    for function in (kernel, kernel.py_func):
        copies = [a.copy() if isinstance(a, np.ndarray) else a for a in args]
        with np.errstate(over="ignore"):
            results.append((function(*copies), copies[-1]))
    return results


@pytest.mark.parametrize(("hop", "n_fold"), [(24, 3), (6, 3), (8, 1)])
def test_fold_is_weight_and_add(hop, n_fold):
    rng = np.random.default_rng(1)
    period, n_block = 8, 5
    n_tap = period * n_fold
    samples = rng.integers(-32768, 32767, (hop * (n_block - 1) + n_tap, 2)).astype(np.int16)
    x = samples[:, 0] + 1j * samples[:, 1]
    weight = np.exp(1j * rng.uniform(0, 6, n_tap))
    w_re, w_im = weight.real.astype(np.float32), weight.imag.astype(np.float32)
    expected = np.empty((n_block, 2 * period))
    for k in range(n_block):
        block = (x[k * hop : k * hop + n_tap] * (w_re + 1j * w_im)).reshape(n_fold, period).sum(axis=0)
        expected[k] = np.concatenate([block.real, block.imag])
    out = np.zeros((n_block, 2 * period), np.float32)
    integer = both(_kernels.fold_i16, samples.view(np.int32).ravel(), w_re, w_im, hop, n_fold, period, n_block, out)
    as_float = samples.astype(np.float32).view(np.complex64).ravel()
    floating = both(_kernels.fold_c64, as_float, w_re, w_im, hop, n_fold, period, n_block, out)
    for _, found in (*integer, *floating):
        np.testing.assert_allclose(found, expected, atol=0.05)


def test_inspect_counts_what_is_wrong():
    samples = np.random.default_rng(2).integers(-100, 100, (1024, 2)).astype(np.int16)
    samples[5] = 2000, 0
    samples[6] = 0, -2000
    samples[7] = -32768, -32768
    samples[256:512] = 0
    for (clipped, fill, zero), _ in both(_kernels.inspect_i16, samples.ravel(), np.int16(2000), 256):
        assert (clipped, fill, zero) == (2, 1, 256)
    floats = samples.astype(np.float32)
    floats[8, 1] = np.nan
    floats[9, 0] = -np.inf
    for (clipped, bad, zero), _ in both(_kernels.inspect_f32, floats.ravel(), 2000.0, 256):
        assert (clipped, bad, zero) == (3, 2, 256)


def test_dirichlet_sums_phasors():
    for cycles in (0.0, 1.0, 0.25, -0.3, 1e-13, 3.0001):
        expected = np.sum(np.exp(2j * np.pi * cycles * np.arange(37)))
        assert _kernels.dirichlet(cycles, 37) == pytest.approx(expected, abs=1e-9)
        assert _kernels.dirichlet.py_func(cycles, 37) == pytest.approx(expected, abs=1e-9)


def test_cosine_sum_response_is_the_windows_spectrum():
    window = np.array([0.355768, -0.487396, 0.144232, -0.012604])
    n = np.arange(64)
    weight = sum(a * np.cos(2 * np.pi * h * (n + 0.5) / 64) for h, a in enumerate(window))
    cycles = np.array([0.0, 0.01, 0.2, -0.07])
    expected = [np.sum(weight * np.exp(2j * np.pi * f * n)) for f in cycles]
    for _, found in both(_kernels.cosine_sum_response, cycles, 64, window, np.empty(4, np.complex128)):
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_turn_back_and_turn_are_inverse_rotations():
    rng = np.random.default_rng(3)
    block = rng.standard_normal((9, 4)).astype(np.float32)
    cycles = np.array([0.3, -1.7])
    expected = (block[:, :2] + 1j * block[:, 2:]).T * np.exp(-2j * np.pi * np.outer(cycles, np.arange(9)))
    for _, found in both(_kernels.turn_back, block, cycles, np.empty((2, 9), np.complex128)):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    for _, found in both(_kernels.turn, expected, cycles, np.empty((2, 9), np.complex128)):
        np.testing.assert_allclose(found, (block[:, :2] + 1j * block[:, 2:]).T, atol=1e-12)


def test_coherent_power_is_the_power_of_the_turned_sum():
    rng = np.random.default_rng(4)
    stream = rng.standard_normal((3, 11)) + 1j * rng.standard_normal((3, 11))
    slope, offset = np.array([0.01, -0.02, 0.005]), np.array([-3.0, 0.0, 1.5])
    expected = [
        np.sum(np.abs(np.sum(stream * np.exp(-2j * np.pi * d * np.outer(slope, np.arange(11))), axis=1)) ** 2)
        for d in offset
    ]
    for _, found in both(_kernels.coherent_power, stream, slope, offset, np.empty(3)):
        np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.parametrize("n_tail", [0, 5])
def test_gram_is_the_response_to_unit_lines(n_tail):
    cycles = np.array([0.101, 0.13, -0.31])
    template = np.array([0.1, 0.1299, -0.3102])
    shift, hop, n_block, centre = 0.0004, 16, 6, 50.0
    n_sample = hop * n_block + n_tail
    n = np.arange(n_sample)
    expected = np.empty((3, 3), complex)
    for a in range(3):
        for b in range(3):
            x = np.exp(2j * np.pi * cycles[b] * (n - centre))
            inside = np.exp(-2j * np.pi * (shift + template[a]) * (n % hop))
            between = np.exp(-2j * np.pi * cycles[a] * hop * (n // hop))
            expected[a, b] = np.sum(x * inside * between)
    out = np.empty((3, 3), np.complex128)
    for _, found in both(_kernels.gram, cycles, template, shift, hop, n_block, n_tail, centre, out):
        np.testing.assert_allclose(found, expected, atol=1e-9)
