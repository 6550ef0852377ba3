"""The line bank: short sums of the samples against every line, block after block.

Each block of samples is weighted, turned by the receiver's clock offset, folded onto the lines' common grid where
they have one, and multiplied into the lines by one matrix product. What is left of a line's frequency inside a block
is small and known, and accounted for exactly (`LineStreams.response`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import _kernels
from rfpose.dsp.plan import LinePlan

__all__ = ["LineBank", "LineStreams"]

ComplexArray = npt.NDArray[np.complex128]

# Nuttall's four-term window with continuous first derivative: side lobes −93 dB, falling 18 dB an octave
# (Nuttall 1981, IEEE Trans. ASSP 29(1), table II).
NUTTALL = (0.355768, -0.487396, 0.144232, -0.012604)
BOXCAR = (1.0,)
_WINDOW_OVERLAP = 4  # the four-term window adds up to a constant at a hop of a quarter
_MAX_TILE_VALUES = 2**22  # float32 values of folded blocks held at a time


@dataclass(frozen=True, slots=True, kw_only=True)
class LineStreams:
    """Each line's complex amplitude over time, turned back to zero frequency at the assumed clock offset.

    Attributes
    ----------
    stream : (line, block)
        Sum over a block of weight × sample, turned back by the line's frequency × the block's start.
    tail : (line,)
        The same for the samples after the last whole block (boxcar only, else zero).
    hop, n_tap, n_tail, n_sample
        Block spacing, block length, length of the tail, length of the frame [samples].
    cycles : (line,)
        Frequency of each line at the assumed clock [cycles/sample].
    shift_cycles, template_cycles : scalar, (line,)
        A block's template for a line turns at ``shift + template`` [cycles/sample].
    window
        Cosine-sum coefficients of the weights.
    """

    stream: ComplexArray
    tail: ComplexArray
    hop: int
    n_tap: int
    n_tail: int
    n_sample: int
    cycles: FloatArray
    shift_cycles: float
    template_cycles: FloatArray
    window: tuple[float, ...]

    @property
    def n_block(self) -> int:
        """Number of whole blocks."""
        return int(self.stream.shape[1])

    @property
    def centre(self) -> float:
        """The frame's centre, to which phases refer [samples from its start]."""
        return 0.5 * (self.n_sample - 1)

    def at_clock(self, plan: LinePlan, from_ppm: float, to_ppm: float) -> LineStreams:
        """Return the streams turned back for another clock offset (templates stay as they were)."""
        cycles = plan.line_cycles(to_ppm)
        back = (plan.line_cycles(from_ppm) - cycles) * self.hop
        stream = np.empty_like(self.stream)
        _kernels.turn(self.stream, back, stream)
        return LineStreams(
            stream=stream,
            tail=self.tail * np.exp(2j * np.pi * back * self.n_block),
            hop=self.hop,
            n_tap=self.n_tap,
            n_tail=self.n_tail,
            n_sample=self.n_sample,
            cycles=cycles,
            shift_cycles=self.shift_cycles,
            template_cycles=self.template_cycles,
            window=self.window,
        )

    def response(self) -> ComplexArray:
        """(line,) response of one block at its start to each line's unit amplitude with phase counted from there."""
        inside = self.cycles - self.shift_cycles - self.template_cycles
        out = np.empty(len(inside), np.complex128)
        _kernels.cosine_sum_response(inside, self.n_tap, np.array(self.window), out)
        return out


class LineBank:
    """Separates the lines of a plan in frames of one length.

    Parameters
    ----------
    plan
        The lines.
    n_sample
        Frame length [samples].
    windowed
        False: blocks without overlap and flat weights (for a joint least-squares fit of all lines, which needs no
        stop band). True: overlapping blocks under a Nuttall window (each line filtered by itself).
    """

    def __init__(self, plan: LinePlan, n_sample: int, *, windowed: bool) -> None:
        self.plan = plan
        self.n_sample = n_sample
        self.window = NUTTALL if windowed else BOXCAR
        n_tap = _window_length(plan, n_sample) if windowed else _block_length(plan, n_sample)
        self.period, self.n_fold = _folding(plan.grid, n_tap, _WINDOW_OVERLAP if windowed else 1)
        self.n_tap = self.period * self.n_fold
        self.hop = self.n_tap // _WINDOW_OVERLAP if windowed else self.n_tap
        self.n_block = (n_sample - self.n_tap) // self.hop + 1
        self.n_tail = 0 if windowed else n_sample - self.n_block * self.hop
        self._template = plan.line_hz / plan.sample_rate_hz
        self._matrix = _line_matrix(self._template, self.period)
        self._weights = lru_cache(maxsize=64)(self._make_weights)

    def _make_weights(self, shift_cycles: float) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        n = np.arange(self.n_tap)
        flat = sum(a * np.cos(2.0 * np.pi * h * (n + 0.5) / self.n_tap) for h, a in enumerate(self.window))
        weight = flat * np.exp(-2j * np.pi * shift_cycles * n)
        return weight.real.astype(np.float32), weight.imag.astype(np.float32)

    def streams(self, samples: npt.NDArray[np.int16] | npt.NDArray[np.float32], clock_ppm: float) -> LineStreams:
        """Separate one frame.

        Parameters
        ----------
        samples : (sample, 2)
            I and Q, int16 or float32, C-contiguous, finite.
        clock_ppm
            Assumed clock offset [ppm].
        """
        cycles = self.plan.line_cycles(clock_ppm)
        shift = self.plan.common_shift_cycles(clock_ppm)
        weight_re, weight_im = self._weights(shift)
        n_line = len(cycles)
        blocks = np.empty((self.n_block, 2 * n_line), np.float32)
        tile = max(1, _MAX_TILE_VALUES // (2 * self.period))
        folded = np.empty((min(tile, self.n_block), 2 * self.period), np.float32)
        for first in range(0, self.n_block, tile):
            count = min(tile, self.n_block - first)
            self._fold(samples[first * self.hop :], weight_re, weight_im, count, folded)
            np.matmul(folded[:count], self._matrix, out=blocks[first : first + count])
        stream = np.empty((n_line, self.n_block), np.complex128)
        _kernels.turn_back(blocks, cycles * self.hop, stream)
        tail = np.zeros((n_line, 1), np.complex128)
        if self.n_tail:
            last = np.zeros((self.n_tap, 2), samples.dtype)
            last[: self.n_tail] = samples[self.n_sample - self.n_tail :]
            self._fold(last, weight_re, weight_im, 1, folded)
            turn = np.exp(-2j * np.pi * cycles * (self.hop * self.n_block))
            block = (folded[:1] @ self._matrix)[0]
            tail[:, 0] = (block[:n_line] + 1j * block[n_line:]) * turn
        return LineStreams(
            stream=stream,
            tail=tail[:, 0],
            hop=self.hop,
            n_tap=self.n_tap,
            n_tail=self.n_tail,
            n_sample=self.n_sample,
            cycles=cycles,
            shift_cycles=shift,
            template_cycles=self._template,
            window=self.window,
        )

    def _fold(
        self,
        samples: npt.NDArray[np.int16] | npt.NDArray[np.float32],
        weight_re: npt.NDArray[np.float32],
        weight_im: npt.NDArray[np.float32],
        n_block: int,
        out: npt.NDArray[np.float32],
    ) -> None:
        if samples.dtype == np.int16:
            flat = samples.view(np.int32).ravel()
            _kernels.fold_i16(flat, weight_re, weight_im, self.hop, self.n_fold, self.period, n_block, out)
        else:
            flat_c = samples.view(np.complex64).ravel()
            _kernels.fold_c64(flat_c, weight_re, weight_im, self.hop, self.n_fold, self.period, n_block, out)


def _block_length(plan: LinePlan, n_sample: int) -> int:
    """Flat blocks: long enough to be cheap, short enough that the clock's search range does not turn a line away.

    A line turning 0.04 cycles inside a block loses 0.3 % of its power to the template.
    """
    half_band = 0.5 * plan.sample_rate_hz
    slope = (half_band * plan.clock_search_ppm * 1e-6) / plan.sample_rate_hz
    by_clock = 0.04 / slope if slope > 0 else np.inf
    return int(max(16, min(1600, by_clock, n_sample // 16)))


def _window_length(plan: LinePlan, n_sample: int) -> int:
    """Windowed blocks: narrow filters for a high SNR behind them, but few samples lost at the frame's ends."""
    shortest = 5.0 * plan.sample_rate_hz / plan.smallest_gap_hz
    return int(min(max(shortest, n_sample // 64), 8192, n_sample // 2))


def _folding(grid: int | None, n_tap: int, multiple: int) -> tuple[int, int]:
    """Return (period, folds) with period × folds near ``n_tap`` and divisible by ``multiple``.

    Flat blocks (multiple 1) are never longer than asked, windows never shorter.
    """
    if grid is not None:
        step = grid * multiple // math.gcd(grid, multiple)
        n_step = n_tap // step if multiple == 1 else -(-n_tap // step)
        if n_step and step * n_step <= max(n_tap, 2 * n_tap * (multiple > 1)):
            return grid, n_step * step // grid
    return -(-n_tap // multiple) * multiple, 1


def _line_matrix(template_cycles: FloatArray, period: int) -> npt.NDArray[np.float32]:
    """(2·period, 2·line): multiplies folded [re, im] into [re, im] of each line."""
    turn = np.exp(-2j * np.pi * np.outer(np.arange(period), template_cycles))
    top = np.hstack([turn.real, turn.imag])
    bottom = np.hstack([-turn.imag, turn.real])
    return np.ascontiguousarray(np.vstack([top, bottom]), np.float32)
