"""jit == Python twin == plain numpy."""

import numpy as np
import pytest

from rfpose.dsp import _kernels

ANYWHERE = np.zeros(1, np.int64)
"""Where folded blocks are put that are not told apart by classes."""


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
    out, arguments = (
        np.zeros((1, n_block, 2 * period), np.float32),
        (w_re, w_im, hop, n_fold, period, ANYWHERE, n_block),
    )
    integer = both(_kernels.fold_i16, samples.view(np.int32).ravel(), *arguments, out)
    as_float = samples.astype(np.float32).view(np.complex64).ravel()
    floating = both(_kernels.fold_c64, as_float, *arguments, out)
    for _, found in (*integer, *floating):
        np.testing.assert_allclose(found[0], expected, atol=0.05)


@pytest.mark.parametrize("place", [(0, 1, 2, 3), (3, 0, 1, 2)])
def test_lines_of_a_class_are_found_in_a_quarter_of_a_folded_block(place):
    period, n_block = 24, 2
    rng = np.random.default_rng(13)
    samples = (rng.standard_normal((period * n_block, 2))).astype(np.float32)
    n = np.arange(period)
    line = np.exp(-2j * np.pi * np.outer(n, n) / period)  # each number of cycles a period
    expected = samples.view(np.complex64).reshape(n_block, period) @ line
    ones, zeros = np.ones(period, np.float32), np.zeros(period, np.float32)
    arguments = samples.view(np.complex64).ravel(), ones, zeros, period, 1, period, np.array(place), n_block
    for _, found in both(_kernels.fold_c64, *arguments, np.empty((4, n_block, period // 2), np.float32)):
        quarter = found[..., : period // 4] + 1j * found[..., period // 4 :]
        for cycles in n:
            by_class = quarter[place[cycles % 4]] @ line[: period // 4, cycles]
            np.testing.assert_allclose(by_class, expected[:, cycles], atol=1e-5)


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


def test_a_zero_where_samples_end_is_no_stretch_of_zeros():
    samples = np.full((261, 2), 7, np.int16)
    samples[-5:] = 0
    for (_, _, zero), _ in both(_kernels.inspect_i16, samples.ravel(), np.int16(2000), 256):
        assert zero == 0
    samples[:] = 0
    for (_, _, zero), _ in both(_kernels.inspect_i16, samples.ravel(), np.int16(2000), 256):
        assert zero == 261


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


def test_turn_back_takes_each_lines_own_frequency_off():
    rng = np.random.default_rng(3)
    block = rng.standard_normal((2, 9, 4)).astype(np.float32)
    cycles = np.array([0.3, -1.7, 0.2])
    place = np.array([[0, 1], [1, 0], [1, 1]])
    plain = np.array([block[c, :, i] + 1j * block[c, :, 2 + i] for c, i in place])
    expected = plain * np.exp(-2j * np.pi * np.outer(cycles, np.arange(9)))
    for kernel in (_kernels.turn_back, _kernels.turn_back.py_func):
        out, tail = np.empty((3, 9), np.complex128), np.empty(3, np.complex128)
        kernel(block, place, cycles, out, tail)
        np.testing.assert_allclose(out, expected, atol=1e-12)
        np.testing.assert_array_equal(tail, 0.0)
        # one block more than there is room for is the tail
        out = np.empty((3, 8), np.complex128)
        kernel(block, place, cycles, out, tail)
        np.testing.assert_allclose(np.column_stack([out, tail]), expected, atol=1e-12)


@pytest.mark.parametrize("n_group", [1, 3])
def test_groups_are_sums_of_turned_blocks(n_group):
    rng = np.random.default_rng(11)
    stream, tail = (rng.standard_normal((2, n)) + 1j * rng.standard_normal((2, n)) for n in (10, 1))
    cycles = np.array([0.013, -0.4])
    turned = np.column_stack([stream, tail]) * np.exp(2j * np.pi * np.outer(cycles, np.arange(11)))
    n_part = 10 // n_group
    parts = turned[:, : n_part * n_group].reshape(2, n_part, n_group).sum(axis=2)
    for kernel in (_kernels.group_lines, _kernels.group_lines.py_func):
        sums, grouped = np.empty(2, np.complex128), np.empty((2, n_part), np.complex128)
        kernel(stream, tail[:, 0], cycles, n_group, sums, grouped)
        np.testing.assert_allclose(grouped, parts, atol=1e-12)
        np.testing.assert_allclose(sums, turned.sum(axis=1), atol=1e-12)


def test_most_coherent_is_where_lines_add_up():
    rng = np.random.default_rng(4)
    slope, block, offset = np.array([0.01, -0.02, 0.005]), np.arange(40), 0.137
    stream = np.exp(2j * np.pi * offset * np.outer(slope, block)) * np.array([[1.0], [2.0j], [-0.5]])
    stream += 0.1 * (rng.standard_normal(stream.shape) + 1j * rng.standard_normal(stream.shape))

    def power(ppm):
        return np.sum(np.abs(np.sum(stream * np.exp(-2j * np.pi * ppm * np.outer(slope, block)), axis=1)) ** 2)

    lines = np.zeros((6, 40), np.complex128)
    lines[::2] = stream
    for kernel in (_kernels.most_coherent, _kernels.most_coherent.py_func):
        found, curvature, height, whole = kernel(lines, 2, 1, slope, 3, 0.2)
        assert power(found) >= max(power(found + d) for d in (-0.01, -1e-3, 1e-3, 0.01))
        assert height == pytest.approx(power(found), rel=1e-10)
        assert whole == pytest.approx(40 * np.sum(np.abs(stream) ** 2))
        bend = (power(found + 0.02) - 2.0 * power(found) + power(found - 0.02)) / 0.02**2
        assert curvature == pytest.approx(-0.5 * bend, rel=1e-3)


def sums_of_unit_line(cycle, back, template, hop, n_sample, start=0.0):
    """Block sums of a line of amplitude one: inside each block by the template, blocks turned back by ``back``."""
    n = np.arange(n_sample)
    line = np.exp(2j * np.pi * cycle * (n - start))
    return np.sum(line * np.exp(-2j * np.pi * template * (n % hop)) * np.exp(-2j * np.pi * back * hop * (n // hop)))


@pytest.mark.parametrize("n_tail", [0, 5])
def test_leakage_is_what_unit_lines_add_to_each_other(n_tail):
    cycles = np.array([0.101, 0.13, -0.31])
    template = np.array([0.1, 0.1299, -0.3102])
    shift, hop, n_block, n_group = 0.0004, 16, 6, 2
    arguments = cycles, template, shift, hop, n_block, n_tail, n_group
    whole, group = (
        np.array(
            [[sums_of_unit_line(c, cycles[a], shift + template[a], hop, length) for c in cycles] for a in range(3)]
        )
        for length in (hop * n_block + n_tail, hop * n_group)
    )
    for kernel in (_kernels.leakage, _kernels.leakage.py_func):
        found_whole, found_group = np.empty((2, 3, 3), np.complex128)
        kernel(*arguments, found_whole, found_group)
        np.testing.assert_allclose(found_whole, whole / np.diag(whole), atol=1e-11)
        np.testing.assert_allclose(found_group, group / np.diag(group), atol=1e-11)


def test_model_and_residual_of_known_lines():
    cycles, template = np.array([0.1003, -0.2401]), np.array([0.1, -0.24])
    hop, n_block, n_tail, n_group = 20, 8, 7, 2
    n_sample, amplitude = hop * n_block + n_tail, np.array([2.0 - 1.0j, 0.5j])
    centre = 0.5 * (n_sample - 1)
    whole, group = np.empty((2, 2, 2), np.complex128)
    _kernels.leakage(cycles, template, 0.0, hop, n_block, n_tail, n_group, whole, group)
    at_start = amplitude * np.exp(-2j * np.pi * cycles * centre)
    inverse = np.linalg.inv(whole)
    # sums of groups as the bank gives them
    n, samples = np.arange(n_sample), (at_start @ np.exp(2j * np.pi * np.outer(cycles, np.arange(n_sample))))
    turned = samples * np.exp(-2j * np.pi * (template[:, None] * (n % hop) + cycles[:, None] * hop * (n // hop)))
    stream = turned[:, : hop * n_block].reshape(2, n_block // n_group, -1).sum(axis=2)
    model = np.empty((2, 4), np.complex128)
    gain, found, leak = np.empty(2), np.empty(2, np.complex128), np.empty((2, 2), np.complex128)
    # two clock offsets between which leakage is taken linearly; what is asked for lies a quarter of the way
    mixing, apart = np.stack([inverse, group]), np.array([[[0.1, -0.2j]], [[0.3j, 0.1]]])
    between = mixing - 0.25 * apart, mixing + 0.75 * apart, 0.25
    for kernel, moments in (
        (_kernels.model_of_lines, _kernels.residual_moments),
        (_kernels.model_of_lines.py_func, _kernels.residual_moments.py_func),
    ):
        arguments = hop, n_block, n_tail, n_group, centre, found, gain, leak, model
        kernel(turned.sum(axis=1), *between, cycles, cycles - template, *arguments)
        np.testing.assert_allclose(found, amplitude, atol=1e-12)
        unit = [sums_of_unit_line(c, c, t, hop, n_sample) for c, t in zip(cycles, template, strict=True)]
        np.testing.assert_allclose(gain, np.abs(inverse.diagonal() / unit), atol=1e-12)
        np.testing.assert_allclose(leak, group, atol=1e-14)
        leaked, span, scatter = group @ model, hop * n_group, np.empty(2)
        turn = 2.0 * np.pi * np.array([1e-4, -2e-4])
        slope, first_model = turn * model[:, 0], model[:, 0].copy()
        first = 0.5 * span - 0.5 - centre
        step, _ = moments(stream, leaked, cycles * span, first_model, turn, first, span, scatter)
        np.testing.assert_allclose(scatter, 0.0, atol=1e-18)
        assert step == pytest.approx(0.0, abs=1e-9)
        # lines that turn by what a hundredth of a ppm makes ask for just that
        back = np.exp(-2j * np.pi * np.outer(cycles * span, np.arange(4)))
        lever = first + span * np.arange(4)
        moved = stream + 0.01j * (slope[:, None] * lever)
        step, power = moments(moved, leaked, cycles * span, first_model, turn, first, span, scatter)
        assert step == pytest.approx(0.01, rel=1e-6)
        assert power == pytest.approx(np.sum(np.abs(slope) ** 2) * np.sum(lever**2))
        # after that step nothing is left but rounding
        assert np.max(scatter) < 1e-9 * np.sum(np.abs(moved - leaked * back) ** 2)


def test_smooth_variance_leaves_a_disturbed_line_its_own():
    disturbed = np.random.default_rng(6).chisquare(60.0, 30) / 60.0
    disturbed[4] = 50.0
    for _, out in both(_kernels.smooth_variance, disturbed, 60.0, np.empty(30)):
        assert out[4] > 25.0
        assert np.max(np.delete(out, 4)) < 2.0


def test_analytic_tones_and_their_mean_phasor():
    rng = np.random.default_rng(7)
    line = rng.standard_normal((10, 6)) + 1j * rng.standard_normal((10, 6))  # two transmitters, two tones
    by_transmitter = line.reshape(2, 5, 6)
    back = by_transmitter[:, :1].conj() / np.abs(by_transmitter[:, :1])
    expected = by_transmitter[:, 1::2] * back + (by_transmitter[:, 2::2] * back).conj()
    for _, found in both(_kernels.analytic_tones, line, 2, np.empty((2, 2, 6), np.complex128)):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    unit = np.mean(expected / np.abs(expected), axis=-1)
    for _, found in both(_kernels.mean_unit_phasor, expected, np.empty((2, 2), np.complex128)):
        np.testing.assert_allclose(found, unit, atol=1e-12)


def test_filtered_lines_are_means_and_scatter():
    rng = np.random.default_rng(8)
    stream = rng.standard_normal((3, 7)) + 1j * rng.standard_normal((3, 7))
    to_centre = np.array([1.0, 1.0j, 0.5 - 0.5j])
    cycles = np.array([0.0, 0.1, -0.27])
    line = stream * to_centre[:, None] * np.exp(2j * np.pi * np.outer(cycles, np.arange(7)))
    for kernel in (_kernels.filtered_lines, _kernels.filtered_lines.py_func):
        own, amplitude, scatter = np.empty_like(stream), np.empty(3, np.complex128), np.empty(3)
        kernel(stream, cycles, to_centre, own, amplitude, scatter)
        np.testing.assert_allclose(own, line)
        np.testing.assert_allclose(amplitude, line.mean(axis=1))
        np.testing.assert_allclose(scatter, np.mean(np.abs(line - line.mean(axis=1)[:, None]) ** 2, axis=1))


def test_tone_quality_marks_weak_tones_and_absent_carriers():
    amplitude = np.array([[10.0, 3.0, 3.0], [10.0j, 3.0, 3.0], [1.0, 3.0, 3.0]], np.complex128)
    variance = np.full((3, 3), 0.5)
    tone = np.array([[6.0], [-2.0j], [6.0]], np.complex128)
    for kernel in (_kernels.tone_quality, _kernels.tone_quality.py_func):
        phase, sigma, status = np.ones((3, 1)), np.empty((3, 1)), np.zeros(3, np.uint8)
        parts = phase, sigma, np.empty((3, 3)), status
        assert kernel(amplitude, variance, tone, np.full((3, 1), 0.01), 25.0, 8.0, 1, 2, *parts) == 0.5
        np.testing.assert_allclose(parts[2], 0.5)
        np.testing.assert_array_equal(status, [0, 2, 1])
        np.testing.assert_array_equal(phase[:, 0], [1.0, np.nan, np.nan])
        np.testing.assert_allclose(sigma[:, 0], [np.sqrt(0.5 / 36.0 + 0.01), np.nan, np.nan])


def spoiled(rng, n_sample):
    """Samples of which two are clipped, one is filled and a stretch is zero; and as complex numbers."""
    samples = rng.integers(-1000, 1000, (n_sample, 2)).astype(np.int16)
    samples[3] = 2000, 0
    samples[40] = -32768, -32768
    samples[64:80] = 0
    samples[-1] = 0, -3000
    return samples, samples[:, 0] + 1j * samples[:, 1].astype(float)


def turns(shift, period, n_fold):
    """Turns of rows, with the kernels' factor, and inside a row; and the same as one factor a sample."""
    row = np.exp(-2j * np.pi * shift * period * np.arange(n_fold))
    ramp = np.exp(-2j * np.pi * shift * np.arange(period))
    parts = [np.stack([z.real, z.imag]).astype(np.float32) for z in (row * 2.0**-16, ramp)]
    return parts, np.multiply.outer(row, ramp).ravel()


@pytest.mark.parametrize("n_fold", [4, 5])
@pytest.mark.parametrize("n_tail", [0, 5, 13, 21])
def test_flat_fold_turns_rows_and_inspects(n_fold, n_tail):
    period, n_block = 8, 3
    n_tap = period * n_fold
    samples, x = spoiled(np.random.default_rng(9), n_tap * n_block + n_tail)
    parts, turn = turns(0.013, period, n_fold)
    n_row = n_block + (n_tail > 0)
    whole = np.concatenate([x, np.zeros(n_row * n_tap - len(x))])  # the last block may be cut short
    expected = (whole.reshape(n_row, n_tap) * turn).reshape(n_row, n_fold, period).sum(axis=1)
    arguments = samples, *parts, ANYWHERE, n_row, np.int16(2000), 16
    for n_seen, counts in ((0, (2, 1, 16)), (64, (1, 0, 16))):
        for found, out in both(
            _kernels.fold_flat_i16, *arguments, n_seen, np.empty((1, n_row, 2 * period), np.float32)
        ):
            assert found == counts
            np.testing.assert_allclose(out[0], np.hstack([expected.real, expected.imag]), atol=0.01)


@pytest.mark.parametrize("n_half", [2, 3])
def test_hann_fold_is_what_weights_sample_by_sample_give(n_half):
    period, n_block = 8, 6
    hop, n_tap = n_half * period, 2 * n_half * period
    samples, x = spoiled(np.random.default_rng(10), hop * (n_block + 1) + 5)
    parts, turn = turns(0.013, period, 2 * n_half)
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(n_tap) + 0.5) / n_tap)
    weight, rising = turn * hann, hann[:hop].astype(np.float32)
    windows = np.array([x[k * hop : k * hop + n_tap] * weight for k in range(n_block)])
    expected = windows.reshape(n_block, 2 * n_half, period).sum(axis=1)
    arguments = samples, *parts, rising, ANYWHERE, n_block, np.int16(2000), 16
    for n_seen, counts in ((0, (2, 1, 16)), (64, (1, 0, 16))):
        for found, out in both(
            _kernels.fold_hann_i16, *arguments, n_seen, np.empty((1, n_block, 2 * period), np.float32)
        ):
            assert found == counts
            np.testing.assert_allclose(out[0], np.hstack([expected.real, expected.imag]), atol=0.01)


def test_smooth_variance_of_equal_lines_is_their_mean():
    variance = np.array([1.0, 1.01, 0.99, 1.0])
    for _, out in both(_kernels.smooth_variance, variance, 60.0, np.empty(4)):
        np.testing.assert_allclose(out, variance.mean())


@pytest.mark.parametrize("n_group", [1, 2])
def test_a_fit_is_its_steps_one_after_the_other(n_group):
    rng = np.random.default_rng(14)
    n_line, n_block, hop, n_tail, centre = 3, 7, 16, 5, 58.0
    n_part, span = n_block // n_group, hop * n_group
    cycles = np.array([0.1, 0.17, -0.23])
    turned, template, slope = cycles + 1e-5, cycles - 2e-4, np.array([1e-3, 2e-3, -1e-3])

    def drawn(*shape):
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    stream, tail = drawn(n_line, n_block), drawn(n_line)
    below, above, part = drawn(2, n_line, n_line), drawn(2, n_line, n_line), 0.3
    sums, grouped = np.empty(n_line, np.complex128), np.empty((n_line, n_part), np.complex128)
    _kernels.group_lines(stream, tail, (turned - cycles) * hop, n_group, sums, grouped)
    amplitude, gain, variance = np.empty(n_line, np.complex128), np.empty(n_line), np.empty(n_line)
    group, model = np.empty((n_line, n_line), np.complex128), np.empty_like(grouped)
    sizes = hop, n_block, n_tail, n_group, centre
    _kernels.model_of_lines(sums, below, above, part, cycles, cycles - template, *sizes, amplitude, gain, group, model)
    first_middle = 0.5 * span - 0.5 - centre
    expected = _kernels.noise_of_lines(
        grouped, group @ model, cycles * span, model[:, 0].copy(), slope, first_middle, span, gain, variance
    )
    for kernel in (_kernels.fit_lines, _kernels.fit_lines.py_func):
        found, own = np.empty(n_line, np.complex128), np.empty(n_line)
        clock = turned, cycles, template, below, above, part, slope
        step = kernel(stream, tail, *clock, hop, n_tail, n_group, centre, found, own)
        np.testing.assert_allclose(step, expected, rtol=1e-9)
        np.testing.assert_allclose(found, amplitude, rtol=1e-12)
        np.testing.assert_allclose(own, variance, rtol=1e-9)
