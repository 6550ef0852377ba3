"""The receiver's clock offset: one unknown that moves every line together."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
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
    signal = part[:, 0].astype(np.float32) + 1j * part[:, 1].astype(np.float32)
    power = np.abs(np.fft.fft(signal * np.hanning(len(part)), n_fft)) ** 2
    widest = float(np.max(np.abs(plan.cycles_per_ppm())))
    step = 0.5 / (n_fft * widest)
    n_side = int(np.ceil(plan.clock_search_ppm / step))
    candidate = step * np.arange(-n_side, n_side + 1)
    score = np.empty(len(candidate))
    for i, ppm in enumerate(candidate):
        bins = np.rint(plan.line_cycles(float(ppm)) * n_fft).astype(np.int64) % n_fft
        score[i] = power[bins].sum()
    return float(candidate[int(np.argmax(score))])


def refine_clock(
    streams: LineStreams, plan: LinePlan, clock_ppm: float, range_ppm: float
) -> tuple[float, float, FloatArray]:
    """Refine the clock offset to the maximum of the power that the carriers add up to over the frame.

    Maximum likelihood for carriers of unknown complex amplitude that do not overlap, in white noise. The sidebands
    would add a few percent at three times the work.

    Parameters
    ----------
    streams
        Separated at ``clock_ppm``.
    range_ppm
        Search plus and minus this about ``clock_ppm``; never beyond what one block can tell apart.

    Returns
    -------
    clock_ppm
        Refined offset.
    curvature
        Minus half the second derivative of the log likelihood, before division by the noise [1/ppm²].
    power : (3,)
        Coherent power at the refined offset, incoherent power, number of blocks.
    """
    every = 1 + 2 * plan.n_tone
    slope_hop = plan.cycles_per_ppm()[::every] * streams.hop
    carrier, n_group = _grouped(streams.stream[::every], float(np.max(np.abs(slope_hop))) * range_ppm)
    slope_hop = slope_hop * n_group
    n_block = carrier.shape[1]
    steepest = float(np.max(np.abs(slope_hop)))
    step = 0.25 / (n_block * steepest) if n_block > 1 else np.inf
    reach = min(range_ppm, 0.45 / steepest)
    n_side = int(np.ceil(reach / step)) if np.isfinite(step) else 0
    offset = 0.0
    if n_side:
        candidate = step * np.arange(-n_side, n_side + 1)
        score = np.empty(len(candidate))
        _kernels.coherent_power(carrier, slope_hop, candidate, score)
        offset = float(candidate[int(np.argmax(score))])
    curvature = np.nan
    if n_block > 1:
        small = 0.1 * step
        score = np.empty(3)
        for _ in range(2):
            _kernels.coherent_power(carrier, slope_hop, offset + small * np.arange(-1.0, 2.0), score)
            bend = score[0] - 2.0 * score[1] + score[2]
            if not bend < 0.0:
                break
            offset -= 0.5 * small * float(score[2] - score[0]) / float(bend)
            curvature = -0.5 * float(bend) / small**2
    coherent = np.empty(1)
    _kernels.coherent_power(carrier, slope_hop, np.array([offset]), coherent)
    incoherent = float(np.sum(np.abs(carrier) ** 2)) * n_block
    return clock_ppm + offset, curvature, np.array([coherent[0], incoherent, float(n_block)])


def _grouped(stream: npt.NDArray[np.complex128], turns: float) -> tuple[npt.NDArray[np.complex128], int]:
    """Add up blocks in groups in which the search turns a line by no more than a twentieth of a cycle.

    ``turns`` is how far the search turns a line from block to block. At least sixteen groups are kept; what does not
    fill a group at the end is left out.
    """
    n_line, n_block = stream.shape
    n_group = max(1, min(int(0.05 / turns) if turns > 0 else n_block, n_block // 16))
    n_part = n_block // n_group
    return np.ascontiguousarray(stream[:, : n_part * n_group].reshape(n_line, n_part, n_group).sum(axis=2)), n_group
