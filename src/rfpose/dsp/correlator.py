"""Maximum likelihood: carrier and sidebands of all transmitters fitted together."""

from __future__ import annotations

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
class LineFit:
    """Amplitudes of all lines in one frame.

    Attributes
    ----------
    amplitude : (line,)
        Complex amplitude at the frame's centre.
    variance : (line,)
        Variance of the complex amplitude, from the noise left in the blocks about each line.
    clock_step_ppm, clock_step_sigma_ppm
        How far the residuals ask the clock offset to move, one Gauss-Newton step, and its standard deviation [ppm].
    """

    amplitude: ComplexArray
    variance: FloatArray
    clock_step_ppm: float
    clock_step_sigma_ppm: float


def fit_lines(streams: LineStreams, cycles_per_ppm: FloatArray) -> LineFit:
    """Fit the amplitudes of all lines to the block sums, by least squares over the whole frame.

    With x = A c + noise and block templates T close to A, solves (Tᴴ A) c = Tᴴ x: unbiased whatever the lines'
    frequencies, and within the templates' small mismatch of maximum likelihood in white noise.

    Parameters
    ----------
    streams
        Of a bank without window.
    cycles_per_ppm : (line,)
        How far the clock moves each line [cycles/sample/ppm].
    """
    n_line = len(streams.cycles)
    gram = np.empty((n_line, n_line), np.complex128)
    _kernels.gram(
        streams.cycles,
        streams.template_cycles,
        streams.shift_cycles,
        streams.hop,
        streams.n_block,
        streams.n_tail,
        streams.centre,
        gram,
    )
    inverse = np.linalg.inv(gram)
    amplitude = inverse @ (streams.stream.sum(axis=1) + streams.tail)
    left, n_group = _residual(streams, amplitude)
    n_free = max(1, left.shape[1] - 1)
    noise = smooth_variance(np.sum(np.abs(left) ** 2, axis=1) / (streams.hop * n_group * n_free), 2.0 * n_free)
    step, power = _clock_step(streams, amplitude, left, n_group, cycles_per_ppm)
    group_noise = float(np.mean(noise)) * streams.hop * n_group
    return LineFit(
        amplitude=amplitude,
        variance=noise * np.abs(np.diag(inverse)),
        clock_step_ppm=step,
        clock_step_sigma_ppm=float(np.sqrt(0.5 * group_noise / power)) if power > 0.0 else np.inf,
    )


def _residual(streams: LineStreams, amplitude: ComplexArray) -> tuple[ComplexArray, int]:
    """Return what the fit leaves at each line, (line, group), and how many blocks were added up in a group.

    Leakage between lines is taken into account. Groups keep the work small in long frames; they are all alike, so
    that a few blocks at the end may be left out.
    """
    n_group = max(1, streams.n_block // _MAX_GROUPS)
    n_part = streams.n_block // n_group
    span = streams.hop * n_group
    grouped = streams.stream[:, : n_part * n_group].reshape(len(amplitude), n_part, n_group).sum(axis=2)
    response = np.empty((len(amplitude), len(amplitude)), np.complex128)
    _kernels.group_response(
        streams.cycles, streams.template_cycles, streams.shift_cycles, streams.hop, n_group, response
    )
    # Streams are turned back by each line's own frequency. Turn the model of every line from there into absolute
    # time, pass it through the response, and turn it back by line l's frequency.
    start_turn = np.exp(-2j * np.pi * streams.cycles * streams.centre)
    constant = np.repeat((amplitude * start_turn)[:, None], n_part, axis=1)
    absolute = np.empty_like(constant)
    _kernels.turn(constant, streams.cycles * span, absolute)
    model = np.empty_like(constant)
    _kernels.turn(response @ absolute, -streams.cycles * span, model)
    return np.asarray(grouped - model), n_group


def _clock_step(
    streams: LineStreams, amplitude: ComplexArray, left: ComplexArray, n_group: int, cycles_per_ppm: FloatArray
) -> tuple[float, float]:
    """Return the change of the clock offset that the residuals ask for [ppm], and the power that speaks for it."""
    span = streams.hop * n_group
    middle = span * (np.arange(left.shape[1]) + 0.5) - 0.5 - streams.centre
    turn = np.exp(-2j * np.pi * streams.cycles * streams.centre)
    slope = 2j * np.pi * cycles_per_ppm * amplitude * turn * streams.response() * n_group
    power = float(np.sum(np.abs(slope) ** 2)) * float(np.sum(middle**2))
    step = float(np.sum((slope.conj() * (left @ middle)).real) / power) if power > 0.0 else 0.0
    return step, power


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
    pooled = float(np.mean(variance))
    if not pooled > 0.0 or len(variance) < 3:
        return variance
    log_ratio = np.log(np.maximum(variance, 1e-300))
    excess = float(np.var(log_ratio, ddof=1)) - 2.0 / dof
    if excess <= 0.0:
        return np.full_like(variance, pooled)
    prior_dof = 2.0 / excess
    typical = float(np.exp(np.median(log_ratio)))
    return np.asarray((prior_dof * typical + dof * variance) / (prior_dof + dof))
