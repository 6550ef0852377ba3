"""The receiver's clock offset: one unknown that moves every line together."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rfpose.dsp import _kernels
from rfpose.dsp.bank import LineStreams
from rfpose.dsp.plan import LinePlan

__all__ = ["coarse_clock_ppm", "refine_clock"]

_SEARCH_SAMPLES = 2**17


def coarse_clock_ppm(samples: npt.NDArray[np.int16] | npt.NDArray[np.float32], plan: LinePlan) -> float:
    """Find the clock offset that puts most power under the plan's lines, from one spectrum.

    Parameters
    ----------
    samples : (sample, 2)
        I and Q; at most the first 131 072 samples are used.
    plan
        Lines and the range to search.

    Returns
    -------
    Offset [ppm], good to a fraction of a bin of that spectrum.
    """
    part = samples[:_SEARCH_SAMPLES]
    n_fft = 2 * len(part)
    signal = np.ascontiguousarray(part, np.float32).view(np.complex64)[:, 0]
    spectrum = np.fft.fft(signal * _hanning(len(part)), n_fft)
    widest = float(np.max(np.abs(plan.cycles_per_ppm())))
    step = 0.5 / (n_fft * widest)
    n_side = int(np.ceil(plan.clock_search_ppm / step))
    candidate = step * np.arange(-n_side, n_side + 1)
    cycles = np.array([plan.line_cycles(float(ppm)) for ppm in candidate])
    under = spectrum[np.rint(cycles * n_fft).astype(np.int64) % n_fft]
    score = (under.real.astype(np.float64) ** 2 + under.imag.astype(np.float64) ** 2).sum(axis=1)
    return float(candidate[int(np.argmax(score))])


@lru_cache(maxsize=4)
def _hanning(n: int) -> npt.NDArray[np.float32]:
    return np.hanning(n).astype(np.float32)


def refine_clock(streams: LineStreams, plan: LinePlan, range_ppm: float) -> tuple[float, float, float]:
    """Refine the clock offset to the maximum of the power that the carriers add up to over the frame.

    Maximum likelihood for carriers of unknown complex amplitude that do not overlap, in white noise. The sidebands
    would add a few percent at three times the work.

    Parameters
    ----------
    streams
        Separated at the clock offset to begin with.
    range_ppm
        Search plus and minus this about it; never beyond what one block can tell apart.

    Returns
    -------
    clock_ppm
        Refined offset.
    curvature
        Minus half the second derivative of the log likelihood, before division by the noise [1/ppm²].
    coherence
        Power at the refined offset over what it would be if all blocks added up: one without noise.
    """
    every = 1 + 2 * plan.n_tone
    slope_hop = plan.cycles_per_ppm()[::every] * streams.hop
    steepest = float(np.abs(slope_hop).max())
    n_group = _group_length(streams.n_block, steepest * range_ppm)
    n_part = streams.n_block // n_group
    steepest *= n_group
    step = 0.25 / (n_part * steepest)
    reach = min(range_ppm, 0.45 / steepest)
    n_side = math.ceil(reach / step) if n_part > 1 else 0
    offset, curvature, coherent, incoherent = _kernels.most_coherent(
        streams.stream, every, n_group, slope_hop * n_group, n_side, step
    )
    return streams.clock_ppm + offset, curvature, coherent / incoherent if incoherent > 0.0 else 0.0


def _group_length(n_block: int, turns: float) -> int:
    """Blocks that may be added up: the search then turns a line by no more than a twentieth of a cycle in them.

    ``turns`` is how far the search turns a line from block to block. At least sixteen groups are kept; what does not
    fill a group at the end is left out.
    """
    return max(1, min(int(0.05 / turns) if turns > 0 else n_block, n_block // 16))
