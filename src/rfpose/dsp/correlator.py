"""Maximum likelihood: carrier and sidebands of all transmitters fitted together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import _kernels
from rfpose.dsp.bank import LineStreams

__all__ = ["LineFit", "fit_lines", "smooth_variance"]

ComplexArray = npt.NDArray[np.complex128]

_MAX_GROUPS = 64
"""Groups of blocks from which the noise is read: with thirty lines its sigma is then good to 1 %."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mixing:
    """How lines leak into each other's block sums, each line's own response taken as one.

    It hardly changes with the clock: a step of a thousandth of a ppm moves it by less than 1e-7. A second fit after
    such a step uses it again.

    Attributes
    ----------
    inverse : (line, line)
        Takes the leakage off the sums over a whole frame.
    group : (line, line)
        Leakage in the sums over a group of blocks.
    """

    inverse: ComplexArray
    group: ComplexArray


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
    mixing
        For another fit of the same frame.
    """

    amplitude: ComplexArray
    variance: FloatArray
    clock_step_ppm: float
    clock_step_sigma_ppm: float
    mixing: Mixing


def fit_lines(streams: LineStreams, cycles_per_ppm: FloatArray, mixing: Mixing | None = None) -> LineFit:
    """Fit the amplitudes of all lines to the block sums, by least squares over the whole frame.

    With x = A c + noise and block templates T close to A, solves (Tᴴ A) c = Tᴴ x: unbiased whatever the lines'
    frequencies, and within the templates' small mismatch of maximum likelihood in white noise.

    Parameters
    ----------
    streams
        Of a bank without window.
    cycles_per_ppm : (line,)
        How far the clock moves each line [cycles/sample/ppm].
    mixing
        That of a fit of the same frame at a clock offset close by.
    """
    n_line = len(streams.cycles)
    n_group = max(1, streams.n_block // _MAX_GROUPS)
    n_part = streams.n_block // n_group
    if mixing is None:
        mixing = _mixing(streams, n_group)
    amplitude, own = np.empty((2, n_line), np.complex128)
    model = np.empty((n_line, n_part), np.complex128)
    _kernels.model_of_lines(
        streams.stream.sum(axis=1) + streams.tail,
        mixing.inverse,
        streams.cycles,
        streams.inside_cycles,
        streams.hop,
        streams.n_block,
        streams.n_tail,
        n_group,
        streams.centre,
        amplitude,
        own,
        model,
    )
    # Groups keep the work small in long frames; they are all alike, so that a few blocks at the end may be left out.
    grouped = streams.stream[:, : n_part * n_group]
    if n_group > 1:
        grouped = grouped.reshape(n_line, n_part, n_group).sum(axis=2)
    span = streams.hop * n_group
    scatter = np.empty(n_line)
    step, power = _kernels.residual_moments(
        grouped,
        mixing.group @ model,
        streams.cycles * span,
        2.0 * np.pi * cycles_per_ppm * model[:, 0],
        0.5 * span - 0.5 - streams.centre,
        span,
        scatter,
    )
    n_free = max(1, n_part - 1)
    noise = smooth_variance(scatter / (span * n_free), 2.0 * n_free)
    return LineFit(
        amplitude=amplitude,
        variance=noise * np.abs(mixing.inverse.diagonal() / own),
        clock_step_ppm=step,
        clock_step_sigma_ppm=math.sqrt(0.5 * span * float(noise.mean()) / power) if power > 0.0 else np.inf,
        mixing=mixing,
    )


def _mixing(streams: LineStreams, n_group: int) -> Mixing:
    whole, group = np.empty((2, len(streams.cycles), len(streams.cycles)), np.complex128)
    _kernels.leakage(
        streams.cycles,
        streams.template_cycles,
        streams.shift_cycles,
        streams.hop,
        streams.n_block,
        streams.n_tail,
        n_group,
        whole,
        group,
    )
    return Mixing(inverse=np.asarray(np.linalg.inv(whole), np.complex128), group=group)


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
