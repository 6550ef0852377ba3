"""Maximum likelihood: carrier and sidebands of all transmitters fitted together."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import _kernels
from rfpose.dsp.bank import LineBank, LineStreams

__all__ = ["JointFit", "LineFit", "smooth_variance"]

ComplexArray = npt.NDArray[np.complex128]

_MAX_GROUPS = 64
"""Groups of blocks from which the noise is read: with thirty lines its sigma is then good to 1 %."""


_NODE_CYCLES = 0.02
"""From one clock offset at which leakage is computed to the next: the band's edges turn by as much in a frame."""
_MAX_NODE_PPM = 0.1
_MAX_NODES = 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class LineFit:
    """Amplitudes of all lines in one frame.

    Attributes
    ----------
    amplitude : (line,)
        Complex amplitude at the frame's centre; a small step of the clock does not move it.
    variance : (line,)
        Variance of the complex amplitude, from the noise left in the blocks about each line after the clock's step.
    clock_step_ppm, clock_step_sigma_ppm
        How far the residuals ask the clock offset to move, one Gauss-Newton step, and its standard deviation [ppm].
    """

    amplitude: ComplexArray
    variance: FloatArray
    clock_step_ppm: float
    clock_step_sigma_ppm: float


class JointFit:
    """Fits the amplitudes of all lines to the block sums of one bank, by least squares over the whole frame.

    With x = A c + noise and block templates T close to A, solves (Tᴴ A) c = Tᴴ x: unbiased whatever the lines'
    frequencies, and within the templates' small mismatch of maximum likelihood in white noise. How lines leak into
    each other's sums is computed at clock offsets `step_ppm` apart, kept, and taken linearly between them: what that
    leaves out is below 1e-7 of a line.

    Parameters
    ----------
    bank
        Without window.
    """

    def __init__(self, bank: LineBank) -> None:
        self.plan = bank.plan
        self.n_group = max(1, bank.n_block // _MAX_GROUPS)
        self.step_ppm = _node_step_ppm(bank)
        self._slope = 2.0 * np.pi * bank.plan.cycles_per_ppm()
        self._mixing = lru_cache(maxsize=_MAX_NODES)(lambda turned, node: _mixing(bank, turned, node, self.n_group))

    def node_ppm(self, clock_ppm: float) -> float:
        """Return the offset nearest to a clock's at which leakage is known: streams are to be separated there."""
        return self.step_ppm * round(clock_ppm / self.step_ppm)

    def __call__(self, streams: LineStreams, clock_ppm: float) -> LineFit:
        """Fit one frame.

        Parameters
        ----------
        streams
            Separated at a `node_ppm`.
        clock_ppm
            Where the clock is now assumed [ppm].
        """
        cycles = self.plan.line_cycles(clock_ppm)
        below = math.floor(clock_ppm / self.step_ppm)
        turned = round(streams.clock_ppm / self.step_ppm)
        amplitude, variance = np.empty(len(cycles), np.complex128), np.empty(len(cycles))
        step, sigma = _kernels.fit_lines(
            streams.stream,
            streams.tail,
            streams.cycles,
            cycles,
            streams.template_cycles + streams.shift_cycles,
            self._mixing(turned, below),
            self._mixing(turned, below + 1),
            clock_ppm / self.step_ppm - below,
            self._slope,
            streams.hop,
            streams.n_tail,
            self.n_group,
            streams.centre,
            amplitude,
            variance,
        )
        return LineFit(amplitude=amplitude, variance=variance, clock_step_ppm=step, clock_step_sigma_ppm=sigma)


def _node_step_ppm(bank: LineBank) -> float:
    turns = bank.n_sample * 1e-6 * float(np.ptp(bank.plan.line_hz)) / bank.plan.sample_rate_hz
    return min(_MAX_NODE_PPM, _NODE_CYCLES / turns) if turns > 0.0 else _MAX_NODE_PPM


def _mixing(bank: LineBank, turned: int, node: int, n_group: int) -> ComplexArray:
    """How lines leak into each other's sums, each line's own response taken as one.

    (2, line, line): what takes the leakage off the sums over a whole frame, and the leakage in the sums over a group of
    blocks. The band was turned back by the shift at one node, the clock is at the other.
    """
    step_ppm, plan = _node_step_ppm(bank), bank.plan
    cycles = plan.line_cycles(node * step_ppm)
    shift = plan.common_shift_cycles(turned * step_ppm)
    mixing = np.empty((2, len(cycles), len(cycles)), np.complex128)
    _kernels.leakage(
        cycles, bank.template_cycles, shift, bank.hop, bank.n_block, bank.n_tail, n_group, mixing[0], mixing[1]
    )
    mixing[0] = np.linalg.inv(mixing[0])
    return mixing


def smooth_variance(variance: FloatArray, dof: float) -> FloatArray:
    """Draw noisy variance estimates towards their mean as far as their own scatter allows.

    Empirical Bayes (Smyth 2004, Stat. Appl. Genet. Mol. Biol. 3(1), §4): under white noise every line gets the
    pooled value; a line beside an interferer keeps its own.

    Parameters
    ----------
    variance : (line,)
        One estimate a line.
    dof
        Degrees of freedom of each.
    """
    out = np.empty(len(variance))
    _kernels.smooth_variance(variance, dof, out)
    return out
