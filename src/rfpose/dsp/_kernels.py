"""Inner loops of the line bank. Samples come as (sample, 2) int16 or float32; int16 pairs travel as int32.

Where sums may be reordered the inner loop is inlined, not called: a called one is compiled once on its own and once
inside its caller, and which of the two runs would depend on whether the caller came from the cache.
"""

from __future__ import annotations

import math

import numpy as np

from rfpose.jit import kernel, kernel_fast, kernel_inline


@kernel_inline
def _fold_block_i16(pair, weight_re, weight_im, n_fold, period, out):
    """Weight one block, add its n_fold stretches of ``period`` samples: out = [re(period), im(period)]."""
    for j in range(2 * period):
        out[j] = 0.0
    re = out[:period]
    im = out[period:]
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
def _fold_block_c64(sample, weight_re, weight_im, n_fold, period, out):
    """Like `_fold_block_i16` for complex64 samples."""
    for j in range(2 * period):
        out[j] = 0.0
    re = out[:period]
    im = out[period:]
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


@kernel_fast
def fold_i16(pair, weight_re, weight_im, hop, n_fold, period, n_block, out):
    """Fold blocks that start every ``hop`` samples. ``pair`` (sample,) int32, ``out`` (block, 2·period) float32."""
    n_tap = n_fold * period
    for k in range(n_block):
        _fold_block_i16(pair[k * hop : k * hop + n_tap], weight_re, weight_im, n_fold, period, out[k])


@kernel_fast
def fold_c64(sample, weight_re, weight_im, hop, n_fold, period, n_block, out):
    """Like `fold_i16` for (sample,) complex64."""
    n_tap = n_fold * period
    for k in range(n_block):
        _fold_block_c64(sample[k * hop : k * hop + n_tap], weight_re, weight_im, n_fold, period, out[k])


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
def inspect_i16(flat, limit, segment):
    """Return (clipped, fill, samples in all-zero segments); ``limit`` is full scale in counts."""
    clipped = 0
    fill = 0
    zero = 0
    for first in range(0, flat.size, 2 * segment):
        part = flat[first : min(first + 2 * segment, flat.size)]
        lowest, highest = _extremes_i16(part)
        if highest >= limit or lowest <= -limit:
            n_clip, n_fill = _count_i16(part, limit)
            clipped += n_clip
            fill += n_fill
        elif lowest == 0 and highest == 0:
            zero += part.size // 2
    return clipped, fill, zero


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


@kernel_fast
def coherent_power(stream, cycles_per_ppm_hop, offset_ppm, out):
    """Power of every line added up over blocks, for each candidate clock offset.

    ``stream`` (line, block) already turned back by the nominal frequencies, ``cycles_per_ppm_hop`` (line,) cycles a
    line turns a block for one ppm, ``out`` (candidate,).
    """
    n_line, n_block = stream.shape
    for c in range(offset_ppm.size):
        total = 0.0
        for m in range(n_line):
            angle = -2.0 * math.pi * cycles_per_ppm_hop[m] * offset_ppm[c]
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
        out[c] = total


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


@kernel
def turn_back(block, cycles_hop, out):
    """Turn (block, 2·line) float32 back by each line's own frequency: ``out`` (line, block) complex128."""
    n_line, n_block = out.shape
    for m in range(n_line):
        step = _phasor(-cycles_hop[m])
        phasor = complex(1.0, 0.0)
        for k in range(n_block):
            out[m, k] = complex(block[k, m], block[k, n_line + m]) * phasor
            phasor *= step


@kernel
def turn(stream, cycles_hop, out):
    """Turn (line, block) on by ``cycles_hop`` a block."""
    n_line, n_block = out.shape
    for m in range(n_line):
        step = _phasor(cycles_hop[m])
        phasor = complex(1.0, 0.0)
        for k in range(n_block):
            out[m, k] = stream[m, k] * phasor
            phasor *= step


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


@kernel
def group_response(cycles, template, shift, hop, n_group, out):
    """Response of line a's sums over ``n_group`` blocks, turned back by its frequency, to each unit line b."""
    for a in range(cycles.size):
        for b in range(cycles.size):
            inside = dirichlet(cycles[b] - shift - template[a], hop)
            out[a, b] = inside * dirichlet((cycles[b] - cycles[a]) * hop, n_group)


@kernel
def gram(cycles, template, shift, hop, n_block, n_tail, centre, out):
    """Response of the turned-back block sums to unit lines: ``sums = out @ amplitude``.

    A line of frequency ``cycles[m]`` with its phase counted from sample ``centre`` passes template ``shift +
    template[m]`` inside each block of ``hop`` samples; blocks are added after turning back by ``cycles``. The last
    block may hold only ``n_tail`` samples (0: none).
    """
    n_line = cycles.size
    for a in range(n_line):
        for b in range(n_line):
            inside = cycles[b] - shift - template[a]
            between = cycles[b] - cycles[a]
            g = dirichlet(inside, hop) * dirichlet(between * hop, n_block)
            if n_tail > 0:
                angle = 2.0 * math.pi * between * hop * n_block
                g += dirichlet(inside, n_tail) * complex(math.cos(angle), math.sin(angle))
            angle = -2.0 * math.pi * cycles[b] * centre
            out[a, b] = g * complex(math.cos(angle), math.sin(angle))
