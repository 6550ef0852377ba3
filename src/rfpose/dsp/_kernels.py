"""Inner loops of the line bank. Samples come as (sample, 2) int16 or float32; int16 pairs are taken as int32.

Where sums may be reordered the inner loop is inlined, not called: a called one is compiled once on its own and once
inside its caller, and which of the two runs would depend on whether the caller came from the cache.
"""

from __future__ import annotations

import math

import numpy as np

from rfpose.jit import kernel, kernel_fast, kernel_inline, prefetch

_AHEAD_SAMPLES, _LINE_SAMPLES = 4096, 16  # from what is folded to what is asked of the memory; in a cache line
_STRETCH_SEGMENTS = 16


@kernel_inline
def _fold_block_i16(pair, weight_re, weight_im, n_fold, period, re, im):
    """Weight one block, add its n_fold stretches of ``period`` samples to ``re`` and ``im``."""
    for j in range(period):
        re[j] = 0.0
        im[j] = 0.0
    for r in range(n_fold):
        base = r * period
        x = pair[base : base + period]
        gr = weight_re[base : base + period]
        gi = weight_im[base : base + period]
        for j in range(period):
            # low half is I, high half is Q: shifts instead of a strided load keep the loop in vector registers
            v = x[j]
            i = np.float32(np.int32(v << np.int32(16)) >> np.int32(16))
            q = np.float32(np.int32(v) >> np.int32(16))
            re[j] += i * gr[j] - q * gi[j]
            im[j] += i * gi[j] + q * gr[j]


@kernel_inline
def _fold_block_c64(sample, weight_re, weight_im, n_fold, period, re, im):
    """Like `_fold_block_i16` for complex64 samples."""
    for j in range(period):
        re[j] = 0.0
        im[j] = 0.0
    for r in range(n_fold):
        base = r * period
        x = sample[base : base + period]
        gr = weight_re[base : base + period]
        gi = weight_im[base : base + period]
        for j in range(period):
            i = x[j].real
            q = x[j].imag
            re[j] += i * gr[j] - q * gi[j]
            im[j] += i * gi[j] + q * gr[j]


@kernel
def _extremes_i16(flat):
    """Return the smallest and the largest component of a short stretch."""
    lowest = np.int16(0)
    highest = np.int16(0)
    for j in range(flat.size):
        v = flat[j]
        if v > highest:
            highest = v
        if v < lowest:
            lowest = v
    return lowest, highest


@kernel
def _count_i16(flat, limit):
    """Count samples at full scale and fill samples; only called where there are some."""
    n_clip = 0
    n_fill = 0
    for j in range(0, flat.size, 2):
        i = flat[j]
        q = flat[j + 1]
        if i == -32768 and q == -32768:
            n_fill += 1
        elif i >= limit or i <= -limit or q >= limit or q <= -limit:
            n_clip += 1
    return n_clip, n_fill


@kernel
def _zero_samples(flat, looked, ahead, segment):
    """Count samples of segments that are all zero: of others the first few tell.

    What is left at the end and shorter counts with what lies before it: a single zero means nothing.
    """
    n_zero = 0
    for first in range(looked, ahead, segment):
        last = min(first + segment, ahead)
        j = 2 * max(last - segment, 0)
        while j < 2 * last and flat[j] == 0:
            j += 1
        if j == 2 * last:
            n_zero += last - first
    return n_zero


@kernel
def _inspect_until_i16(flat, limit, segment, looked, end, found):
    """Inspect segments from sample ``looked`` on until ``end`` is passed; return how far that is.

    ``found`` (3,) counts clipped and fill samples, and those of segments that are all zero.
    """
    n_sample = flat.size // 2
    end = min(end, n_sample)
    while looked < end:
        n_segment = min((end - looked + segment - 1) // segment, _STRETCH_SEGMENTS)
        ahead = min(looked + n_segment * segment, n_sample)
        stretch = flat[2 * looked : 2 * ahead]
        lowest, highest = _extremes_i16(stretch)
        if highest >= limit or lowest <= -limit:
            clipped, fill = _count_i16(stretch, limit)
            found[0] += clipped
            found[1] += fill
        found[2] += _zero_samples(flat, looked, ahead, segment)
        looked = ahead
    return looked


@kernel_inline
def _ask_ahead(pair, first, count):
    """Ask the memory for samples that are folded later: what a processor foresees by itself ends with each page."""
    for j in range(first + _AHEAD_SAMPLES, first + _AHEAD_SAMPLES + count, _LINE_SAMPLES):
        prefetch(pair, j)


@kernel_inline
def _add_row_i16(x, a, c, re, im):
    """Add one row of samples turned by a + jc; ``a`` and ``c`` carry a factor 2⁻¹⁶.

    I and Q are left in the upper half of 32 bits, where they need a shift or a mask less than in the lower.
    """
    for j in range(x.size):
        v = x[j]
        i = np.float32(np.int32(v << np.int32(16)))
        q = np.float32(np.int32(v & np.int32(-65536)))
        re[j] += i * a - q * c
        im[j] += i * c + q * a


@kernel_inline
def _add_two_rows_i16(x0, x1, a0, c0, a1, c1, re, im):
    """Like `_add_row_i16` for two rows: the sums are loaded and stored half as often."""
    for j in range(x0.size):
        v0 = x0[j]
        v1 = x1[j]
        i0 = np.float32(np.int32(v0 << np.int32(16)))
        q0 = np.float32(np.int32(v0 & np.int32(-65536)))
        i1 = np.float32(np.int32(v1 << np.int32(16)))
        q1 = np.float32(np.int32(v1 & np.int32(-65536)))
        re[j] += (i0 * a0 - q0 * c0) + (i1 * a1 - q1 * c1)
        im[j] += (i0 * c0 + q0 * a0) + (i1 * c1 + q1 * a1)


@kernel_inline
def _turn_inside(re, im, ramp_re, ramp_im):
    for j in range(re.size):
        turned = re[j] * ramp_re[j] - im[j] * ramp_im[j]
        im[j] = re[j] * ramp_im[j] + im[j] * ramp_re[j]
        re[j] = turned


@kernel_inline
def _put_sum_and_difference(first, after, sums, differences):
    for j in range(first.size):
        sums[j] = first[j] + after[j]
        differences[j] = first[j] - after[j]


@kernel_inline
def _put(re, im, place, k, out):
    """Bring a folded block (period,) into row k of ``out`` (class, block, 2·period/class); spoils ``re`` and ``im``.

    Of four classes a line of c + 4i cycles in a period is in the c-th, which is put where ``place`` (4,) says: a line's
    product with the quarters of a period differs from its product with the first by factors (−j)^c, so that they are
    added up once for all lines of a class.
    """
    if out.shape[0] == 1:
        for j in range(re.size):
            out[0, k, j] = re[j]
            out[0, k, re.size + j] = im[j]
        return
    n = re.size // 4
    half = 2 * n
    for part in (re, im):
        for j in range(half):
            first = part[j]
            after = part[half + j]
            part[j] = first + after
            part[half + j] = first - after
    even = out[place[0], k]
    other = out[place[2], k]
    _put_sum_and_difference(re[:n], re[n:half], even[:n], other[:n])
    _put_sum_and_difference(im[:n], im[n:half], even[n:], other[n:])
    back = out[place[1], k]
    on = out[place[3], k]
    _put_sum_and_difference(re[half : half + n], im[half + n :], back[:n], on[:n])
    _put_sum_and_difference(im[half : half + n], re[half + n :], on[n:], back[n:])


@kernel_fast
def fold_flat_i16(samples, row, ramp, place, n_block, limit, segment, n_seen, out):
    """Fold and inspect in one pass over memory: blocks side by side, each row of a period turned as a whole.

    ``samples`` (sample, 2) int16; ``row`` (2, fold) are real and imaginary part of what turns row by row and carry a
    factor 2⁻¹⁶, ``ramp`` (2, period) of what turns what is left inside a row; ``place`` and ``out`` as `_put`. The last
    block may be cut short. Returns (clipped, fill, samples in all-zero segments) of all samples but the first
    ``n_seen``.
    """
    flat = samples.reshape(samples.size)
    pair = flat.view(np.int32)
    row_re = row[0]
    row_im = row[1]
    ramp_re = ramp[0]
    ramp_im = ramp[1]
    n_fold = row_re.size
    period = ramp_re.size
    n_sample = pair.size
    found = np.zeros(3, np.int64)
    looked = n_seen
    re = np.empty(period, np.float32)
    im = np.empty(period, np.float32)
    for k in range(n_block):
        re[:] = np.float32(0.0)
        im[:] = np.float32(0.0)
        looked = _inspect_until_i16(flat, limit, segment, looked, (k + 1) * n_fold * period, found)
        for r in range(0, n_fold, 2):
            first = (k * n_fold + r) * period
            end = first + 2 * period
            _ask_ahead(pair, first, end - first)
            if r + 1 < n_fold and end <= n_sample:
                x = pair[first : first + period]
                after = pair[first + period : end]
                _add_two_rows_i16(x, after, row_re[r], row_im[r], row_re[r + 1], row_im[r + 1], re, im)
                continue
            for one in range(r, min(r + 2, n_fold)):
                first = min((k * n_fold + one) * period, n_sample)
                _add_row_i16(pair[first : min(first + period, n_sample)], row_re[one], row_im[one], re, im)
        _turn_inside(re, im, ramp_re, ramp_im)
        _put(re, im, place, k, out)
    _inspect_until_i16(flat, limit, segment, looked, n_sample, found)
    return found[0], found[1], found[2]


@kernel_inline
def _add_hann_row_i16(x, weight, a, c, sums):
    """Add one row, turned by a + jc, to the plain sum and to the weighted one."""
    for j in range(x.size):
        v = x[j]
        i = np.float32(np.int32(v << np.int32(16)))
        q = np.float32(np.int32(v & np.int32(-65536)))
        re = i * a - q * c
        im = i * c + q * a
        sums[0, j] += re
        sums[1, j] += im
        sums[2, j] += weight[j] * re
        sums[3, j] += weight[j] * im


@kernel_inline
def _add_two_hann_rows_i16(x0, x1, weight0, weight1, a0, c0, a1, c1, sums):
    """Like `_add_hann_row_i16` for two rows: the sums are loaded and stored half as often."""
    for j in range(x0.size):
        v0 = x0[j]
        v1 = x1[j]
        i0 = np.float32(np.int32(v0 << np.int32(16)))
        q0 = np.float32(np.int32(v0 & np.int32(-65536)))
        i1 = np.float32(np.int32(v1 << np.int32(16)))
        q1 = np.float32(np.int32(v1 & np.int32(-65536)))
        re0 = i0 * a0 - q0 * c0
        im0 = i0 * c0 + q0 * a0
        re1 = i1 * a1 - q1 * c1
        im1 = i1 * c1 + q1 * a1
        sums[0, j] += re0 + re1
        sums[1, j] += im0 + im1
        sums[2, j] += weight0[j] * re0 + weight1[j] * re1
        sums[3, j] += weight0[j] * im0 + weight1[j] * im1


@kernel_fast
def fold_hann_i16(samples, row, ramp, rising, place, n_block, limit, segment, n_seen, out):
    """Fold under Hann windows that cover each sample twice, and inspect, in one pass over memory.

    As `fold_flat_i16`, with ``row`` (2, fold) of a whole window and ``n_block`` windows; ``rising`` (fold/2 · period,)
    is a window's first half. What a sample lacks of one under one window it has under the next, so that half a window
    is added up twice, plain and weighted: weighted it belongs to the window that begins with it, and what is left of
    the plain sum to the one before.
    """
    flat = samples.reshape(samples.size)
    pair = flat.view(np.int32)
    row_re = row[0]
    row_im = row[1]
    ramp_re = ramp[0]
    ramp_im = ramp[1]
    n_half = row_re.size // 2
    period = ramp_re.size
    n_sample = pair.size
    # of the second half against the first
    scale = np.float32(1.0) / (row_re[0] * row_re[0] + row_im[0] * row_im[0])
    on_re = (row_re[n_half] * row_re[0] + row_im[n_half] * row_im[0]) * scale
    on_im = (row_im[n_half] * row_re[0] - row_re[n_half] * row_im[0]) * scale
    two = np.empty((2, 4, period), np.float32)
    re = np.empty(period, np.float32)
    im = np.empty(period, np.float32)
    found = np.zeros(3, np.int64)
    looked = n_seen
    for s in range(n_block + 1):
        now = two[s % 2]
        now[:] = np.float32(0.0)
        looked = _inspect_until_i16(flat, limit, segment, looked, (s + 1) * n_half * period, found)
        for r in range(0, n_half, 2):
            first = (s * n_half + r) * period
            _ask_ahead(pair, first, 2 * period)
            x = pair[first : first + period]
            weight = rising[r * period : (r + 1) * period]
            if r + 1 < n_half:
                after = pair[first + period : first + 2 * period]
                weight_after = rising[(r + 1) * period : (r + 2) * period]
                _add_two_hann_rows_i16(
                    x, after, weight, weight_after, row_re[r], row_im[r], row_re[r + 1], row_im[r + 1], now
                )
            else:
                _add_hann_row_i16(x, weight, row_re[r], row_im[r], now)
        if s == 0:
            continue
        before = two[(s - 1) % 2]
        for j in range(period):
            left_re = now[0, j] - now[2, j]
            left_im = now[1, j] - now[3, j]
            re[j] = before[2, j] + left_re * on_re - left_im * on_im
            im[j] = before[3, j] + left_re * on_im + left_im * on_re
        _turn_inside(re, im, ramp_re, ramp_im)
        _put(re, im, place, s - 1, out)
    _inspect_until_i16(flat, limit, segment, looked, n_sample, found)
    return found[0], found[1], found[2]


@kernel_fast
def fold_i16(pair, weight_re, weight_im, hop, n_fold, period, place, n_block, out):
    """Fold blocks that start every ``hop`` samples: ``pair`` (sample,) int32; ``place`` and ``out`` as `_put`."""
    n_tap = n_fold * period
    re = np.empty(period, np.float32)
    im = np.empty(period, np.float32)
    for k in range(n_block):
        _fold_block_i16(pair[k * hop : k * hop + n_tap], weight_re, weight_im, n_fold, period, re, im)
        _put(re, im, place, k, out)


@kernel_fast
def fold_c64(sample, weight_re, weight_im, hop, n_fold, period, place, n_block, out):
    """Like `fold_i16` for (sample,) complex64."""
    n_tap = n_fold * period
    re = np.empty(period, np.float32)
    im = np.empty(period, np.float32)
    for k in range(n_block):
        _fold_block_c64(sample[k * hop : k * hop + n_tap], weight_re, weight_im, n_fold, period, re, im)
        _put(re, im, place, k, out)


@kernel
def inspect_i16(flat, limit, segment):
    """Return (clipped, fill, samples in all-zero segments); ``limit`` is full scale in counts."""
    found = np.zeros(3, np.int64)
    _inspect_until_i16(flat, limit, segment, 0, flat.size // 2, found)
    return found[0], found[1], found[2]


@kernel
def inspect_f32(flat, limit, segment):
    """Return (clipped, not finite, samples in all-zero segments) over interleaved float32 I and Q."""
    clipped = 0
    bad = 0
    zero = 0
    for first in range(0, flat.size, 2 * segment):
        last = min(first + 2 * segment, flat.size)
        n_zero = 0
        for j in range(first, last, 2):
            i = flat[j]
            q = flat[j + 1]
            if not (math.isfinite(i) and math.isfinite(q)):
                bad += 1
            elif abs(i) >= limit or abs(q) >= limit:
                clipped += 1
            elif i == 0.0 and q == 0.0:
                n_zero += 1
        if 2 * n_zero == last - first:
            zero += n_zero
    return clipped, bad, zero


@kernel_inline
def _power_at(stream, cycles_hop, offset):
    """Power of every line added up over blocks, turned back by ``offset`` times ``cycles_hop`` a block."""
    n_line, n_block = stream.shape
    total = 0.0
    for m in range(n_line):
        angle = -2.0 * math.pi * cycles_hop[m] * offset
        sr = math.cos(angle)
        si = math.sin(angle)
        # Horner's rule from the last block back: one complex multiply-add a block
        ar = 0.0
        ai = 0.0
        for k in range(n_block - 1, -1, -1):
            z = stream[m, k]
            t = ar * sr - ai * si + z.real
            ai = ar * si + ai * sr + z.imag
            ar = t
        total += ar * ar + ai * ai
    return total


@kernel_fast
def most_coherent(stream, every, n_group, cycles_per_ppm_hop, n_side, step):
    """Offset [ppm] at which carriers add up to most power: the best of ±``n_side`` steps, then parabolas.

    ``stream`` (line, block) already turned back by the nominal frequencies, of which each ``every``-th line is a
    carrier and ``n_group`` blocks are added up first; ``cycles_per_ppm_hop`` (carrier,) cycles it turns a group for
    one ppm. Returns the offset, minus half the second derivative there (NaN: no maximum), the power there, and the
    power if all groups added up.
    """
    n_part = stream.shape[1] // n_group
    carrier = np.zeros((cycles_per_ppm_hop.size, n_part), np.complex128)
    incoherent = 0.0
    for m in range(carrier.shape[0]):
        for k in range(n_part):
            for i in range(n_group):
                carrier[m, k] += stream[m * every, k * n_group + i]
            incoherent += carrier[m, k].real ** 2 + carrier[m, k].imag ** 2
    offset = 0.0
    best = -1.0
    for c in range(-n_side, n_side + 1):
        power = _power_at(carrier, cycles_per_ppm_hop, c * step)
        if power > best:
            best = power
            offset = c * step
    curvature = math.nan
    small = 0.1 * step
    if n_part > 1:
        for _ in range(4):
            below = _power_at(carrier, cycles_per_ppm_hop, offset - small)
            here = _power_at(carrier, cycles_per_ppm_hop, offset)
            above = _power_at(carrier, cycles_per_ppm_hop, offset + small)
            bend = below - 2.0 * here + above
            if not bend < 0.0:
                break
            offset -= 0.5 * small * (above - below) / bend
            curvature = -0.5 * bend / small**2
    return offset, curvature, _power_at(carrier, cycles_per_ppm_hop, offset), incoherent * n_part


@kernel
def dirichlet(cycles, n):
    """Sum of exp(j2π·cycles·i) for i = 0 … n−1."""
    turn = cycles - math.floor(cycles + 0.5)
    half = math.pi * turn
    if abs(turn) < 1e-12:
        size = float(n)
    else:
        size = math.sin(half * n) / math.sin(half)
    angle = half * (n - 1)
    return complex(size * math.cos(angle), size * math.sin(angle))


@kernel
def _phasor(cycles):
    angle = 2.0 * math.pi * (cycles - math.floor(cycles))
    return complex(math.cos(angle), math.sin(angle))


@kernel_inline
def _phasors(cycles_hop, n_block, out):
    """exp(j2π·cycles_hop·k) for k = 0 … n_block−1, by four recurrences that do not wait for each other."""
    one = _phasor(cycles_hop)
    step = _phasor(4.0 * cycles_hop)
    p0 = complex(1.0, 0.0)
    p1 = one
    p2 = one * one
    p3 = p2 * one
    whole = n_block - n_block % 4
    for k in range(0, whole, 4):
        out[k] = p0
        out[k + 1] = p1
        out[k + 2] = p2
        out[k + 3] = p3
        p0 *= step
        p1 *= step
        p2 *= step
        p3 *= step
    for k in range(whole, n_block):
        out[k] = p0
        p0 *= one


@kernel
def turn_back(block, place, cycles_hop, out, tail):
    """Turn lines back by their own frequencies: ``out`` (line, block) complex128.

    ``block`` (class, block, 2·column) float32 holds real and then imaginary parts, ``place`` (line, 2) the class and
    column of each line. One block more than ``out`` takes is the frame's tail, and goes to ``tail`` (line,).
    """
    n_line, n_block = out.shape
    n_column = block.shape[2] // 2
    phasor = np.empty(n_block + 1, np.complex128)
    for m in range(n_line):
        _phasors(-cycles_hop[m], n_block + 1, phasor)
        own = block[place[m, 0]]
        i = place[m, 1]
        for k in range(n_block):
            out[m, k] = complex(own[k, i], own[k, n_column + i]) * phasor[k]
        tail[m] = 0.0
        if own.shape[0] > n_block:
            tail[m] = complex(own[n_block, i], own[n_block, n_column + i]) * phasor[n_block]


@kernel
def group_lines(stream, tail, cycles_hop, n_group, sums, grouped):
    """Turn (line, block) on by ``cycles_hop`` a block and add it up: over the frame with its tail, and over groups."""
    n_line, n_block = stream.shape
    n_part = grouped.shape[1]
    phasor = np.empty(n_block + 1, np.complex128)
    for m in range(n_line):
        _phasors(cycles_hop[m], n_block + 1, phasor)
        total = tail[m] * phasor[n_block]
        for k in range(n_part):
            part = 0.0j
            for i in range(k * n_group, (k + 1) * n_group):
                part += stream[m, i] * phasor[i]
            grouped[m, k] = part
            total += part
        for i in range(n_part * n_group, n_block):
            total += stream[m, i] * phasor[i]
        sums[m] = total


@kernel
def model_of_lines(
    sums,
    below,
    above,
    part,
    cycles,
    inside_cycles,
    hop,
    n_block,
    n_tail,
    n_group,
    centre,
    amplitude,
    gain,
    group,
    model,
):
    """Amplitudes of all lines from their sums over a frame, and what each adds to each group of blocks.

    ``below`` and ``above`` (2, line, line), between which the clock has gone ``part`` of the way: what takes the
    leakage off ``sums``, and the leakage in groups, which goes to ``group`` (line, line). ``inside_cycles`` is how fast
    a line turns against its template. ``amplitude`` (line,) has its phase at ``centre``; ``gain`` (line,) is its
    variance over that of a sum of so many samples; ``model`` (line, group) is in absolute time.
    """
    n_line, n_part = model.shape
    phasor = np.empty(n_part, np.complex128)
    for a in range(n_line):
        total = 0.0j
        for b in range(n_line):
            total += (below[0, a, b] + part * (above[0, a, b] - below[0, a, b])) * sums[b]
            group[a, b] = below[1, a, b] + part * (above[1, a, b] - below[1, a, b])
        block = dirichlet(inside_cycles[a], hop)
        own = block * n_block + dirichlet(inside_cycles[a], n_tail)
        gain[a] = abs((below[0, a, a] + part * (above[0, a, a] - below[0, a, a])) / own)
        at_start = total / own
        amplitude[a] = at_start * _phasor(cycles[a] * centre)
        first = at_start * block * n_group
        _phasors(cycles[a] * hop * n_group, n_part, phasor)
        for k in range(n_part):
            model[a, k] = first * phasor[k]


@kernel
def residual_moments(stream, model, cycles_span, first, slope, first_middle, span, scatter):
    """Power that ``model`` leaves of ``stream`` (line, group) at each line, and how it asks the clock to move.

    The model is in absolute time, the stream turned back by ``cycles_span`` a group. ``slope`` (line,) is how far a ppm
    turns a line in a sample [rad], ``first`` (line,) what a line puts into the first group; groups' middles lie
    ``first_middle`` + k·``span`` samples from the centre.
    ``scatter`` (line,) sums squares as they are after the step. Returns the Gauss-Newton step [ppm] and its weight.
    """
    n_line, n_part = stream.shape
    phasor = np.empty(n_part, np.complex128)
    along = np.empty(n_line)
    weight = np.empty(n_line)
    lever = 0.0
    for k in range(n_part):
        lever += (first_middle + k * span) ** 2
    for m in range(n_line):
        _phasors(-cycles_span[m], n_part, phasor)
        square = 0.0
        moment = 0.0j
        for k in range(n_part):
            left = stream[m, k] - model[m, k] * phasor[k]
            square += left.real * left.real + left.imag * left.imag
            moment += left * (first_middle + k * span)
        scatter[m] = square
        along[m] = slope[m] * (first[m].conjugate() * moment).imag
        weight[m] = slope[m] ** 2 * (first[m].real ** 2 + first[m].imag ** 2) * lever
    power = weight.sum()
    step = along.sum() / power if power > 0.0 else 0.0
    for m in range(n_line):
        scatter[m] = max(scatter[m] - 2.0 * step * along[m] + step * step * weight[m], 0.0)
    return step, power


@kernel
def smooth_variance(variance, dof, out):
    """Draw variances towards their typical value as far as their own scatter allows; see `dsp.correlator`."""
    n = variance.size
    pooled = 0.0
    for m in range(n):
        pooled += variance[m] / n
        out[m] = variance[m]
    if not pooled > 0.0 or n < 3:
        return
    log_ratio = np.empty(n)
    for m in range(n):
        log_ratio[m] = math.log(max(variance[m], 1e-300))
    excess = log_ratio.var() * n / (n - 1) - 2.0 / dof
    if excess <= 0.0:
        out[:] = pooled
        return
    prior_dof = 2.0 / excess
    typical = math.exp(np.median(log_ratio))
    for m in range(n):
        out[m] = (prior_dof * typical + dof * variance[m]) / (prior_dof + dof)


@kernel
def noise_of_lines(stream, model, cycles_span, first, slope, first_middle, span, gain, variance):
    """Variance of each line's amplitude from what `residual_moments` finds; returns the clock's step and its sigma."""
    n_line, n_part = stream.shape
    scatter = np.empty(n_line)
    step, power = residual_moments(stream, model, cycles_span, first, slope, first_middle, span, scatter)
    n_free = max(1, n_part - 1)
    smooth_variance(scatter / (span * n_free), 2.0 * n_free, variance)
    sigma = math.sqrt(0.5 * span * variance.mean() / power) if power > 0.0 else math.inf
    for m in range(n_line):
        variance[m] *= gain[m]
    return step, sigma


@kernel
def _product(a, b, out):
    """Product of (row, inner) and (inner, column) complex128; numba's own would load scipy."""
    for i in range(a.shape[0]):
        row = out[i]
        row[:] = 0.0
        for k in range(a.shape[1]):
            factor = a[i, k]
            other = b[k]
            for j in range(row.size):
                row[j] += factor * other[j]


@kernel
def fit_lines(
    stream,
    tail,
    turned_cycles,
    cycles,
    template_cycles,
    below,
    above,
    part,
    slope,
    hop,
    n_tail,
    n_group,
    centre,
    amplitude,
    variance,
):
    """Fit all lines of a frame: `group_lines`, `model_of_lines` and `noise_of_lines` one after the other.

    One call, since each lets go of the interpreter, and threads would wait for it anew. ``turned_cycles`` (line,) were
    the lines' frequencies when ``stream`` was turned back, ``cycles`` are; ``template_cycles`` those of the templates,
    with the band's shift. Gives ``amplitude`` and ``variance`` (line,); returns the clock's step and its sigma.
    """
    n_line, n_block = stream.shape
    n_part = n_block // n_group
    span = hop * n_group
    sums = np.empty(n_line, np.complex128)
    gain = np.empty(n_line)
    grouped = np.empty((n_line, n_part), np.complex128)
    model = np.empty((n_line, n_part), np.complex128)
    leaked = np.empty((n_line, n_part), np.complex128)
    group = np.empty((n_line, n_line), np.complex128)
    group_lines(stream, tail, (turned_cycles - cycles) * hop, n_group, sums, grouped)
    inside = cycles - template_cycles
    model_of_lines(
        sums, below, above, part, cycles, inside, hop, n_block, n_tail, n_group, centre, amplitude, gain, group, model
    )
    # Groups keep the work small in long frames; they are alike, so that a few blocks at the end may be left out.
    _product(group, model, leaked)
    first = model[:, 0].copy()
    first_middle = 0.5 * span - 0.5 - centre
    return noise_of_lines(grouped, leaked, cycles * span, first, slope, first_middle, span, gain, variance)


@kernel
def filtered_lines(stream, cycles_hop, to_centre, line, amplitude, scatter):
    """Turn (line, block) on by ``cycles_hop`` a block and refer it to the frame's centre: ``line``.

    ``amplitude`` and ``scatter`` (line,) are each line's mean and mean square distance from it.
    """
    n_line, n_block = stream.shape
    phasor = np.empty(n_block, np.complex128)
    for m in range(n_line):
        _phasors(cycles_hop[m], n_block, phasor)
        total = 0.0j
        for k in range(n_block):
            line[m, k] = stream[m, k] * (phasor[k] * to_centre[m])
            total += line[m, k]
        mean = total / n_block
        square = 0.0
        for k in range(n_block):
            left = line[m, k] - mean
            square += left.real * left.real + left.imag * left.imag
        amplitude[m] = mean
        scatter[m] = square / n_block


@kernel_inline
def _unit(z):
    """Return z over its length, NaN where it has none."""
    return z * (1.0 / math.sqrt(z.real * z.real + z.imag * z.imag))


@kernel
def analytic_tones(line, n_tone, out):
    """(transmitter, tone, block) analytic tones U C*/|C| + (L C*/|C|)* of (transmitter × line, block) amplitudes."""
    n_transmitter, _, n_block = out.shape
    n_own = 1 + 2 * n_tone
    for i in range(n_transmitter):
        for k in range(n_block):
            back = _unit(line[i * n_own, k]).conjugate()
            for q in range(n_tone):
                lower = line[i * n_own + 2 + 2 * q, k] * back
                out[i, q, k] = line[i * n_own + 1 + 2 * q, k] * back + lower.conjugate()


@kernel
def mean_unit_phasor(tone, out):
    """Mean over the last axis of (transmitter, tone, block) phasors brought to length one."""
    n_transmitter, n_tone, n_block = tone.shape
    for i in range(n_transmitter):
        for q in range(n_tone):
            total = 0.0j
            for k in range(n_block):
                total += _unit(tone[i, q, k])
            out[i, q] = total / n_block


@kernel
def tone_quality(
    amplitude, variance, tone, added, least_carrier, least_tone, absent, weak, phase, sigma, line_sigma, status
):
    """Sigma of each tone's phase; NaN, with a status, where the tone or its carrier is too weak to have one.

    ``amplitude`` and ``variance`` (transmitter, line): carrier, then upper and lower sideband of each tone; ``tone``,
    ``added`` variance, ``phase``, ``sigma`` (transmitter, tone). ``line_sigma`` (transmitter, line) is that of an
    amplitude's part; ``status`` holds 0 already. Returns the lines' median variance.
    """
    n_transmitter, n_tone = tone.shape
    for i in range(n_transmitter):
        for m in range(variance.shape[1]):
            line_sigma[i, m] = math.sqrt(0.5 * variance[i, m])
        for q in range(n_tone):
            noise = variance[i, 1 + 2 * q] + variance[i, 2 + 2 * q]
            power = tone[i, q].real ** 2 + tone[i, q].imag ** 2
            sigma[i, q] = math.sqrt(0.5 * noise / power + added[i, q])
            if power < least_tone * noise:
                status[i] = weak
        if amplitude[i, 0].real ** 2 + amplitude[i, 0].imag ** 2 < least_carrier * variance[i, 0]:
            status[i] = absent
        if status[i] != 0:
            phase[i] = math.nan
            sigma[i] = math.nan
    return np.median(variance)


@kernel
def cosine_sum_response(cycles, n, window, out):
    """Sum of w[i]·exp(j2π·cycles·i) with w[i] = Σ_h a_h cos(2πh(i + ½)/n), for each frequency."""
    for m in range(cycles.size):
        total = window[0] * dirichlet(cycles[m], n)
        for h in range(1, window.size):
            half_turn = _phasor(0.5 * h / n)
            total += 0.5 * window[h] * half_turn * dirichlet(cycles[m] + h / n, n)
            total += 0.5 * window[h] * half_turn.conjugate() * dirichlet(cycles[m] - h / n, n)
        out[m] = total


@kernel_inline
def _sum_of_phasors(one, all_of_them, n):
    """1 + z + … + z^(n−1) from z and zⁿ."""
    below = one - 1.0
    size = below.real * below.real + below.imag * below.imag
    if size < 1e-16:
        return complex(float(n), 0.0)
    return (all_of_them - 1.0) * below.conjugate() / size


@kernel
def leakage(cycles, template, shift, hop, n_block, n_tail, n_group, whole, group):
    """What a unit line adds to the turned-back block sums of every other, over what it adds to its own.

    A line of frequency ``cycles[b]`` passes template ``shift + template[a]`` inside each block of ``hop`` samples;
    blocks are added after turning back by ``cycles[a]``. ``whole`` (line a, line b): over ``n_block`` blocks and a
    last one of only ``n_tail`` samples (0: none). ``group``: over the first ``n_group`` blocks. A sum of phasors needs
    only its step and its end, and those are products of one number a line: no sines for every pair.
    """
    n_line = cycles.size
    # of each line, and of each template
    step = np.empty((n_line, 2), np.complex128)
    end = np.empty((n_line, 2), np.complex128)
    tail = np.empty((n_line, 2), np.complex128)
    hop_turn = np.empty(n_line, np.complex128)
    whole_turn = np.empty(n_line, np.complex128)
    group_turn = np.empty(n_line, np.complex128)
    for m in range(n_line):
        for side, f in enumerate((cycles[m] - shift, template[m])):
            step[m, side] = _phasor(f)
            end[m, side] = _phasor(f * hop)
            tail[m, side] = _phasor(f * n_tail)
        hop_turn[m] = _phasor(cycles[m] * hop)
        whole_turn[m] = _phasor(cycles[m] * hop * n_block)
        group_turn[m] = _phasor(cycles[m] * hop * n_group)
    for b in range(n_line):
        own = cycles[b] - shift - template[b]
        block = dirichlet(own, hop)
        over_whole = 1.0 / (block * n_block + dirichlet(own, n_tail))
        over_group = 1.0 / (block * n_group)
        for a in range(n_line):
            if a == b:
                whole[a, a] = 1.0
                group[a, a] = 1.0
                continue
            inside_step = step[b, 0] * step[a, 1].conjugate()
            inside = _sum_of_phasors(inside_step, end[b, 0] * end[a, 1].conjugate(), hop)
            between = hop_turn[b] * hop_turn[a].conjugate()
            before_tail = whole_turn[b] * whole_turn[a].conjugate()
            added = inside * _sum_of_phasors(between, before_tail, n_block)
            if n_tail > 0:
                added += before_tail * _sum_of_phasors(inside_step, tail[b, 0] * tail[a, 1].conjugate(), n_tail)
            whole[a, b] = added * over_whole
            added = inside * _sum_of_phasors(between, group_turn[b] * group_turn[a].conjugate(), n_group)
            group[a, b] = added * over_group
