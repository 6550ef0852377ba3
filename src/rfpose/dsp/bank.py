"""The line bank: short sums of the samples against every line, block after block.

Each block of samples is weighted, turned by the receiver's clock offset, folded onto the lines' common grid where
they have one, and multiplied into the lines by one matrix product. What is left of a line's frequency inside a block
is small and known, and accounted for exactly (`LineStreams.response`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from operator import add
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import _kernels
from rfpose.dsp.plan import LinePlan

__all__ = ["ClockRange", "Inspection", "LineBank", "LineStreams", "inspect"]

ComplexArray = npt.NDArray[np.complex128]
Samples = npt.NDArray[np.int16] | npt.NDArray[np.float32]

# Nuttall's four-term window with continuous first derivative: side lobes −93 dB, falling 18 dB an octave
# (Nuttall 1981, IEEE Trans. ASSP 29(1), table II).
NUTTALL = (0.355768, -0.487396, 0.144232, -0.012604)
# Hann's falls as fast from −31 dB: where lines are far apart it stops them as well, and half as many windows cover a
# frame.
HANN = (0.5, -0.5)
BOXCAR = (1.0,)
_OVERLAP = {NUTTALL: 4, HANN: 2, BOXCAR: 1}
"""Windows that cover each sample; at this overlap they add up to a constant."""
_HANN_GAP_BINS = 40.0
"""Lines this far apart leak less than −106 dB into each other under Hann's window."""
_LONGEST_BLOCK = 1600
_LONGEST_FOLDED_BLOCK = 16384
_ZERO_SEGMENT = 256
_TILE_VALUES, _MIN_TILE = 2**18, 32  # float32 values of folded blocks held at a time, which should fit the cache
_MAX_FOLDS = 512  # clock offsets whose turns are kept


class Inspection(NamedTuple):
    """Samples at full scale, fill samples, samples in stretches of zeros, and samples that are NaN or infinite."""

    clipped: int
    fill: int
    zero: int
    not_finite: int

    def added(self, other: Inspection) -> Inspection:
        """Return the counts of both."""
        return Inspection(*map(add, self, other))


NOTHING_WRONG = Inspection(0, 0, 0, 0)


class ClockRange(NamedTuple):
    """How far a receiver's clock may be off, and how far from where it is assumed [ppm]."""

    largest_ppm: float
    error_ppm: float


Fold = Callable[[Samples, int, int, npt.NDArray[np.float32]], Inspection]
"""Folds (sample, 2), of which the first so many were inspected before, into so many rows of (class, block, value)."""


class _Turned(NamedTuple):
    """What a bank needs at a clock offset."""

    cycles: FloatArray
    cycles_hop: FloatArray
    shift_cycles: float
    fold: Fold
    """Of what is folded and inspected in one pass."""


def inspect(samples: Samples, full_scale: float) -> Inspection:
    """Count what is wrong with samples (sample, 2); component magnitudes from ``full_scale`` on are clipped."""
    flat = samples.reshape(-1)
    if samples.dtype == np.int16:
        clipped, fill, zero = _kernels.inspect_i16(flat, np.int16(min(full_scale, 32767.0)), _ZERO_SEGMENT)
        return Inspection(clipped, fill, zero, 0)
    clipped, bad, zero = _kernels.inspect_f32(flat, float(full_scale), _ZERO_SEGMENT)
    return Inspection(clipped, 0, zero, bad)


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
    clock_ppm
        The clock offset assumed when the samples were separated [ppm].
    cycles : (line,)
        Frequency of each line at the assumed clock [cycles/sample].
    shift_cycles, template_cycles : scalar, (line,)
        A block's template for a line turns at ``shift + template`` [cycles/sample].
    window
        Cosine-sum coefficients of the weights.
    inspection
        What is wrong with the samples.
    """

    stream: ComplexArray
    tail: ComplexArray
    hop: int
    n_tap: int
    n_tail: int
    n_sample: int
    clock_ppm: float
    cycles: FloatArray
    shift_cycles: float
    template_cycles: FloatArray
    window: tuple[float, ...]
    inspection: Inspection

    @property
    def n_block(self) -> int:
        """Number of whole blocks."""
        return int(self.stream.shape[1])

    @property
    def centre(self) -> float:
        """The frame's centre, to which phases refer [samples from its start]."""
        return 0.5 * (self.n_sample - 1)

    def response(self, cycles: FloatArray | None = None) -> ComplexArray:
        """(line,) response of one block at its start to each line's unit amplitude with phase counted from there.

        Parameters
        ----------
        cycles : (line,)
            Frequency of each line, if the clock is no longer assumed where it was [cycles/sample].
        """
        out = np.empty(len(self.cycles), np.complex128)
        inside = (self.cycles if cycles is None else cycles) - self.shift_cycles - self.template_cycles
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
        stop band). True: overlapping blocks under a window (each line filtered by itself).
    clock
        What is known of the receiver's clock; the more, the longer are the flat blocks and the less is left to do after
        them. None: nothing yet.
    n_tap
        Length of Hann windows [samples], about; None: the longer the better that a frame has room for.
    full_scale
        Component magnitude at which a sample counts as clipped [counts].
    """

    def __init__(
        self,
        plan: LinePlan,
        n_sample: int,
        *,
        windowed: bool,
        clock: ClockRange | None = None,
        n_tap: int | None = None,
        full_scale: float = np.inf,
    ) -> None:
        self.plan = plan
        self.n_sample = n_sample
        self.full_scale = float(full_scale)
        self.window: tuple[float, ...] = HANN
        if not windowed:
            n_tap, self.window = _block_length(plan, n_sample, clock), BOXCAR
        elif n_tap is None:
            n_tap = _window_length(plan, n_sample)
            self.window = _window(plan, n_tap)
        n_tap = min(n_tap, n_sample // 2)
        overlap = _OVERLAP[self.window]
        self.period, self.n_fold = _folding(plan.grid, n_tap, overlap)
        self.n_tap = self.period * self.n_fold
        self.hop = self.n_tap // overlap
        self.n_block = (n_sample - self.n_tap) // self.hop + 1
        self.n_tail = 0 if windowed else n_sample - self.n_block * self.hop
        n_row = self.n_block + (self.n_tail > 0)
        self._tile = min(n_row, max(_MIN_TILE, _TILE_VALUES // (2 * self.period)))
        self.template_cycles = plan.line_hz / plan.sample_rate_hz
        self._classes = _Classes.of(self.template_cycles, self.period, on_grid=self.period == plan.grid)
        n = np.arange(self.n_tap)
        self._envelope = np.sum(
            [a * np.cos(2.0 * np.pi * h * (n + 0.5) / n.size) for h, a in enumerate(self.window)], 0
        )
        self._turned = lru_cache(maxsize=_MAX_FOLDS)(self._turned_at)
        self._weighted = lru_cache(maxsize=_MAX_FOLDS)(self._weighted_at)

    def streams(self, samples: Samples, clock_ppm: float) -> LineStreams:
        """Separate one frame.

        Parameters
        ----------
        samples : (sample, 2)
            I and Q, int16 or float32, C-contiguous.
        clock_ppm
            Assumed clock offset [ppm].
        """
        turned, is_inspected = self._turned(clock_ppm), self.inspects(samples)
        fold = turned.fold if is_inspected else self._weighted(clock_ppm)
        n_line, n_row = len(self.template_cycles), self.n_block + (self.n_tail > 0)
        classes = self._classes
        n_class, n_value, n_column = classes.matrix.shape
        blocks = np.empty((n_class, n_row, n_column), np.float32)
        folded = np.empty((classes.n_folded, self._tile, n_value), np.float32)
        counts = NOTHING_WRONG if is_inspected else inspect(samples, self.full_scale)
        for first in range(0, n_row, self._tile):
            count = min(self._tile, n_row - first)
            end = self.n_sample if first + count == n_row else (first + count - 1) * self.hop + self.n_tap
            n_seen = self.n_tap - self.hop if first else 0
            counts = counts.added(fold(samples[first * self.hop : end], n_seen, count, folded))
            np.matmul(folded[:n_class, :count], classes.matrix, out=blocks[:, first : first + count])
        stream, tail = np.empty((n_line, self.n_block), np.complex128), np.empty(n_line, np.complex128)
        _kernels.turn_back(blocks, classes.place_of_line, turned.cycles_hop, stream, tail)
        return LineStreams(
            stream=stream,
            tail=tail,
            hop=self.hop,
            n_tap=self.n_tap,
            n_tail=self.n_tail,
            n_sample=self.n_sample,
            clock_ppm=clock_ppm,
            cycles=turned.cycles,
            shift_cycles=turned.shift_cycles,
            template_cycles=self.template_cycles,
            window=self.window,
            inspection=counts,
        )

    def inspects(self, samples: Samples) -> bool:
        """Whether samples are folded and inspected in one pass."""
        # of a window's halves the second has the first's weights with another sign, if each is whole rows
        halves = self.window == HANN and self.n_fold % 2 == 0
        return samples.dtype == np.int16 and (self.window == BOXCAR or halves)

    def _turned_at(self, clock_ppm: float) -> _Turned:
        cycles, shift = self.plan.line_cycles(clock_ppm), self.plan.common_shift_cycles(clock_ppm)
        return _Turned(cycles, cycles * self.hop, shift, self._one_pass(*self._turns(shift)))

    def _turns(self, shift_cycles: float) -> tuple[ComplexArray, ComplexArray]:
        """Return what turns the band back by ``shift_cycles`` a sample: (fold,) row by row, (period,) inside a row."""
        row = np.exp(-2j * np.pi * shift_cycles * self.period * np.arange(self.n_fold))
        return row, np.exp(-2j * np.pi * shift_cycles * np.arange(self.period))

    def _one_pass(self, row: ComplexArray, ramp: ComplexArray) -> Fold:
        turns = [np.stack([z.real, z.imag]).astype(np.float32) for z in (row * 2.0**-16, ramp)]
        limit = np.int16(min(self.full_scale, 32767.0))
        place, kernel = self._classes.place, _kernels.fold_flat_i16
        if self.window == HANN:
            kernel = _kernels.fold_hann_i16
            turns.append(self._envelope[: self.hop].astype(np.float32))

        def fold(samples: Samples, n_seen: int, n_block: int, out: npt.NDArray[np.float32]) -> Inspection:
            clipped, fill, zero = kernel(samples, *turns, place, n_block, limit, _ZERO_SEGMENT, n_seen, out)
            return Inspection(clipped, fill, zero, 0)

        return fold

    def _weighted_at(self, clock_ppm: float) -> Fold:
        row, ramp = self._turns(self.plan.common_shift_cycles(clock_ppm))
        weight = (self._envelope * np.multiply.outer(row, ramp).ravel()).astype(np.complex64)
        parts, place = (np.ascontiguousarray(weight.real), np.ascontiguousarray(weight.imag)), self._classes.place

        def fold(samples: Samples, n_seen: int, n_block: int, out: npt.NDArray[np.float32]) -> Inspection:
            is_int = samples.dtype == np.int16
            short = (n_block - 1) * self.hop + self.n_tap - len(samples)
            if short > 0:  # the frame's tail
                samples = np.concatenate([samples, np.zeros((short, 2), samples.dtype)])
            flat = samples.view(np.int32 if is_int else np.complex64).ravel()
            kernel = _kernels.fold_i16 if is_int else _kernels.fold_c64
            kernel(flat, *parts, self.hop, self.n_fold, self.period, place, n_block, out)
            return NOTHING_WRONG

        return fold


def _window(plan: LinePlan, n_tap: int) -> tuple[float, ...]:
    """Hann's window where lines are so far apart that it stops them, else Nuttall's."""
    gap_bins = n_tap * plan.smallest_gap_hz / plan.sample_rate_hz
    return HANN if gap_bins >= _HANN_GAP_BINS else NUTTALL


def _block_length(plan: LinePlan, n_sample: int, clock: ClockRange | None) -> int:
    """Flat blocks: long enough to be cheap, short enough that the clock does not turn a line away from its template.

    About the assumed clock the band's centre stands still, and its edges turn most: by 0.02 cycles, which costs the
    outermost line 0.13 % of its power. The error of the assumed clock turns all lines.
    """
    if clock is None:
        by_clock = 0.04 / max(0.5e-6 * plan.clock_search_ppm, 1e-12)
        return int(max(16, min(_LONGEST_BLOCK, by_clock, n_sample // 16)))
    by_edge = 0.02 / max(0.5e-6 * clock.largest_ppm, 1e-12)
    by_error = 0.04 / max(float(np.max(np.abs(plan.cycles_per_ppm()))) * clock.error_ppm, 1e-12)
    # without a common grid a block is not folded, and a longer one costs as much a sample
    longest = _LONGEST_BLOCK if plan.grid is None else _LONGEST_FOLDED_BLOCK
    return int(max(16, min(longest, by_edge, by_error, n_sample // 64)))


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


@dataclass(frozen=True, slots=True)
class _Classes:
    """How lines are told apart in folded blocks: those of a class share a quarter of the work, see `_kernels._put`.

    Attributes
    ----------
    n_folded
        Classes of folded blocks, of which the first ones hold lines.
    place : (n_folded,)
        Where each class is among them.
    matrix : (class, value, 2·column)
        Multiplies folded [re, im] into [re, im] of a class's lines.
    place_of_line : (line, 2)
        Class and column of each line.
    """

    n_folded: int
    place: npt.NDArray[np.int64]
    matrix: npt.NDArray[np.float32]
    place_of_line: npt.NDArray[np.int64]

    @classmethod
    def of(cls, template_cycles: FloatArray, period: int, *, on_grid: bool) -> _Classes:
        n_folded = 4 if on_grid and period % 4 == 0 else 1
        own = np.rint(template_cycles * period).astype(np.int64) % n_folded
        order = np.array(sorted(range(n_folded), key=lambda c: c not in own))
        place = np.argsort(order)
        column = np.array([np.count_nonzero(own[:m] == own[m]) for m in range(len(own))])
        n_column = int(column.max()) + 1
        n_value = 2 * (period // n_folded)
        matrix = np.zeros((len(np.unique(own)), n_value, 2, n_column), np.float32)
        for m, cycles in enumerate(template_cycles):
            matrix[place[own[m]], :, :, column[m]] = _line_matrix(cycles, period // n_folded)
        return cls(n_folded, place, matrix.reshape(len(matrix), n_value, -1), np.stack([place[own], column], axis=1))


def _line_matrix(template_cycles: float, n: int) -> FloatArray:
    """(2·n, 2): multiplies folded [re, im] into [re, im] of a line."""
    turn = np.exp(-2j * np.pi * np.arange(n) * template_cycles)
    return np.vstack([np.stack([turn.real, turn.imag], axis=1), np.stack([-turn.imag, turn.real], axis=1)])
