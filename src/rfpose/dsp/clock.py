"""The receiver's clock offset: one unknown that moves every line together."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import _kernels
from rfpose.dsp.bank import LineBank, LineStreams
from rfpose.dsp.plan import LinePlan

__all__ = ["SEARCH_SAMPLES", "ClockSearch", "coarse_clock_ppm", "search_bank"]

ComplexArray = npt.NDArray[np.complex128] | npt.NDArray[np.complex64]
Samples = npt.NDArray[np.int16] | npt.NDArray[np.float32]

SEARCH_SAMPLES = 2**17
_FEWEST_BLOCKS = 32


def coarse_clock_ppm(samples: npt.NDArray[np.int16] | npt.NDArray[np.float32], plan: LinePlan, bank: LineBank) -> float:
    """Find the clock offset that puts most power under the plan's lines, from one spectrum.

    Parameters
    ----------
    samples : (sample, 2)
        I and Q; at most the first `SEARCH_SAMPLES` are used.
    plan
        Lines and the range to search.
    bank
        As `search_bank` makes it for as many samples.

    Returns
    -------
    Offset [ppm], good to a fraction of a bin of that spectrum.
    """
    part = samples[:SEARCH_SAMPLES]
    widest = float(np.max(np.abs(plan.cycles_per_ppm())))
    step = 0.25 / (len(part) * widest)
    n_side = int(np.ceil(plan.clock_search_ppm / step))
    candidate: FloatArray = step * np.arange(-n_side, n_side + 1, dtype=np.float64)
    cycles = plan.line_cycles(candidate[:, None])
    spectrum_at = _whole_spectrum if bank.n_block < _FEWEST_BLOCKS else _spectra_of_lines
    under = spectrum_at(part, bank, cycles)
    score = (under.real.astype(np.float64) ** 2 + under.imag.astype(np.float64) ** 2).sum(axis=1)
    return float(candidate[int(np.argmax(score))])


def search_bank(plan: LinePlan, n_sample: int) -> LineBank:
    """Return the bank whose filters are so wide that a line stays in its own wherever the clock may be."""
    turns = plan.clock_search_ppm * float(np.max(np.abs(plan.cycles_per_ppm())))
    n_tap = max(2, int(0.4 / max(turns, 1e-9)))
    if plan.grid is not None and n_tap > 2 * plan.grid:
        n_tap -= n_tap % (2 * plan.grid)  # halves of whole rows are folded in one pass
    return LineBank(plan, min(n_sample, SEARCH_SAMPLES), windowed=True, n_tap=n_tap)


def _spectra_of_lines(part: Samples, bank: LineBank, cycles: FloatArray) -> ComplexArray:
    """(candidate, line) spectrum at the cycles a sample asked for, from few values of each line over time."""
    streams = bank.streams(part, 0.0)
    n_fft = 2 << (streams.n_block - 1).bit_length()
    spectrum = np.fft.fft(streams.stream * _hanning(streams.n_block), n_fft)
    bins = np.rint((cycles - streams.cycles) * (streams.hop * n_fft)).astype(np.int64) % n_fft
    return np.asarray(np.take_along_axis(spectrum, bins.T, 1).T)


def _whole_spectrum(part: Samples, bank: LineBank, cycles: FloatArray) -> ComplexArray:
    """Like `_spectra_of_lines`, from all samples at once: for short frames, and where lines may be anywhere."""
    n_fft = 2 * len(part)
    signal = np.ascontiguousarray(part, np.float32).view(np.complex64)[:, 0]
    spectrum = np.fft.fft(signal * _hanning(len(part)), n_fft)
    return np.asarray(spectrum[np.rint(cycles * n_fft).astype(np.int64) % n_fft])


@lru_cache(maxsize=4)
def _hanning(n: int) -> npt.NDArray[np.float32]:
    return np.hanning(n).astype(np.float32)


class ClockSearch:
    """Refines a clock offset to the maximum of the power that the carriers add up to over the frame.

    Maximum likelihood for carriers of unknown complex amplitude that do not overlap, in white noise. The sidebands
    would add a few percent at three times the work.

    Parameters
    ----------
    bank
        That separates the lines.
    range_ppm
        Search plus and minus this about the offset to begin with; never beyond what one block can tell apart.
    """

    def __init__(self, bank: LineBank, range_ppm: float) -> None:
        self._every = 1 + 2 * bank.plan.n_tone
        slope_hop = bank.plan.cycles_per_ppm()[:: self._every] * bank.hop
        steepest = float(np.abs(slope_hop).max())
        self._n_group = _group_length(bank.n_block, steepest * range_ppm)
        self._slope = slope_hop * self._n_group
        n_part = bank.n_block // self._n_group
        steepest *= self._n_group
        self._step = 0.25 / (n_part * steepest)
        reach = min(range_ppm, 0.45 / steepest)
        self._n_side = math.ceil(reach / self._step) if n_part > 1 else 0

    def __call__(self, streams: LineStreams) -> tuple[float, float, float]:
        """Refine the offset at which a frame was separated.

        Returns
        -------
        clock_ppm
            Refined offset.
        curvature
            Minus half the second derivative of the log likelihood, before division by the noise [1/ppm²].
        coherence
            Power at the refined offset over what it would be if all blocks added up: one without noise.
        """
        offset, curvature, coherent, incoherent = _kernels.most_coherent(
            streams.stream, self._every, self._n_group, self._slope, self._n_side, self._step
        )
        return streams.clock_ppm + offset, curvature, coherent / incoherent if incoherent > 0.0 else 0.0


def _group_length(n_block: int, turns: float) -> int:
    """Blocks that may be added up: the search then turns a line by no more than a twentieth of a cycle in them.

    ``turns`` is how far the search turns a line from block to block. At least sixteen groups are kept; what does not
    fill a group at the end is left out.
    """
    return max(1, min(int(0.05 / turns) if turns > 0 else n_block, n_block // 16))
