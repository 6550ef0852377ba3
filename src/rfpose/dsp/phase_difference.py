"""Phase difference of two sampled real sinusoids of one frequency, four ways, each with its predicted error [1]_.

All estimators take pairs of real signals ``(..., sample)`` whose leading axes broadcast against each other, so
that one reference may stand against many, and return one phase difference a row. The model of §3.1 is::

    s1[k] = a1 cos(ω k + φ1) + n1[k],        s2[k] = a2 cos(ω k + φ2) + n2[k]

and what is wanted is ``φ21 = φ2 − φ1`` [rad]. The Hilbert method and the correlator give its sign, in
``[−π, π]``; the two dot-product methods give ``|φ21|``, in ``[0, π]``.

Signal-to-noise ratios are linear and per sample: ``snr = (a²/2) / Var[n]``, with the noise variance as it stands
in the samples that the estimator is given. ``bandwidth`` is the noise's equivalent bandwidth over f_s/2, so white
noise has one; noise behind a band-pass filter of ``low`` to ``high`` cycles a sample has ``2 (high − low)``.

References
----------
.. [1] Swart et al., A method for accurate measurement of heliostat mirror orientation, §3.1, §4.1, §4.5.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import scipy.fft

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError

__all__ = [
    "bound_rad",
    "compensated_dot_phase_difference",
    "compensated_dot_sigma_rad",
    "correlator_phase_difference",
    "dot_bias_rad",
    "dot_phase_difference",
    "dot_sigma_rad",
    "hilbert_phase_difference",
    "predicted_sigma_rad",
]

MIN_SAMPLE = 8

ComplexArray = npt.NDArray[np.complex128]


# -- estimators ----------------------------------------------------------------------------------------------


def hilbert_phase_difference(
    s1: npt.ArrayLike,
    s2: npt.ArrayLike,
    *,
    bandpass: tuple[float, float] | None = None,
    edge: int | None = None,
) -> FloatArray:
    """Phase difference by Hilbert transform and averaging of unit phasors, Swart et al. §3.1.3.

    The analytic signals ``h = s + j ŝ`` come from the discrete Fourier transform. Each sample gives a unit phasor
    ``exp(j(Θ2 − Θ1))``; the angle of their mean is the phase difference.

    Parameters
    ----------
    s1, s2 : (..., sample)
        Real signals, same length; leading axes broadcast. NaN or infinity anywhere in a row makes the row NaN.
    bandpass
        Lower and upper edge of an ideal pass band about the tone [cycles/sample], applied in the transform.
        Without it all but the mean passes. Needed once the noise in the samples is no longer small beside the
        tone, because unit phasors weigh every sample alike.
    edge
        Samples left out of the mean at each end. The transform takes the record for one period of a periodic
        signal; where it does not hold a whole number of cycles the analytic signal is wrong at both ends, and
        the phase by about ``1/n`` rad. Default: ``n/64``, at most 256, and with a band-pass at least
        half the reciprocal of its width, which brings that below about ``0.1/n`` rad. Zero is right for a
        whole number of cycles.

    Returns
    -------
    (...)
        ``φ2 − φ1`` [rad], in [−π, π]. NaN: the row holds NaN or infinity, or no signal.

    Raises
    ------
    InvalidInputError
        Different lengths, complex or too short signals, a band that is empty or holds no frequency bin, an
        edge that leaves no samples.

    Notes
    -----
    Standard deviation: `predicted_sigma_rad`, as long as the signal-to-noise ratio behind the band-pass is 10 or
    more; below, unit phasors lose to the correlator.
    """
    x1, x2, bad = _pair(s1, s2)
    n_sample = x1.shape[-1]
    weight = _analytic_weight(n_sample, bandpass)
    first, last = _kept(n_sample, bandpass, edge)
    phasor = _analytic(x2, weight)[..., first:last] * np.conj(_analytic(x1, weight)[..., first:last])
    length = np.abs(phasor)
    np.divide(phasor, length, out=phasor, where=length > 0.0)
    return _finish(np.angle(phasor.mean(axis=-1)), bad)


def dot_phase_difference(s1: npt.ArrayLike, s2: npt.ArrayLike) -> FloatArray:
    """Magnitude of the phase difference by dot product, Swart et al. §3.1.1.

    ``|φ21| = acos(s1·s2 / (‖s1‖ ‖s2‖))``. Noise adds to the norms but not to the product, so the estimate is
    drawn towards π/2 by `dot_bias_rad`, however many samples there are.

    Parameters
    ----------
    s1, s2 : (..., sample)
        Real signals of zero mean, same length; leading axes broadcast.

    Returns
    -------
    (...)
        ``|φ2 − φ1|`` [rad], in [0, π]. NaN: the row holds NaN or infinity, or no signal.

    Raises
    ------
    InvalidInputError
        Different lengths, complex or too short signals.
    """
    x1, x2, bad = _pair(s1, s2)
    power = _mean_product(x1, x1) * _mean_product(x2, x2)
    return _angle_from_cosine(_mean_product(x1, x2), power, bad)


def compensated_dot_phase_difference(
    s1: npt.ArrayLike,
    s2: npt.ArrayLike,
    *,
    noise_variance1: npt.ArrayLike,
    noise_variance2: npt.ArrayLike,
    noise_mean1: npt.ArrayLike = 0.0,
    noise_mean2: npt.ArrayLike = 0.0,
    noise_cross: npt.ArrayLike | None = None,
) -> FloatArray:
    """Magnitude of the phase difference by dot product with noise compensation, Swart et al. §3.1.2.

    ``|φ21| = acos((⟨s1 s2⟩ − u12) / √((⟨s1²⟩ − σ1² − u1²)(⟨s2²⟩ − σ2² − u2²)))``

    Parameters
    ----------
    s1, s2 : (..., sample)
        Real signals, same length; leading axes broadcast.
    noise_variance1, noise_variance2 : (...)
        Variance σ² of the noise in each signal, known beforehand. An error here comes back as a bias.
    noise_mean1, noise_mean2 : (...)
        Mean u of the noise in each signal.
    noise_cross : (...)
        ``u12 = E[n1 n2]``. Default: ``u1 u2``, noises that are uncorrelated.

    Returns
    -------
    (...)
        ``|φ2 − φ1|`` [rad], in [0, π]; a cosine that noise has carried beyond ±1 counts as ±1. NaN: the row
        holds NaN or infinity, or no signal, or its power is not above the noise power given.

    Raises
    ------
    InvalidInputError
        Different lengths, complex or too short signals, a noise variance that is negative or not finite.
    """
    x1, x2, bad = _pair(s1, s2)
    variance1 = as_float_array("noise_variance1", noise_variance1, ("...",))
    variance2 = as_float_array("noise_variance2", noise_variance2, ("...",))
    if np.any(variance1 < 0.0) or np.any(variance2 < 0.0):
        raise InvalidInputError("`noise_variance1` and `noise_variance2` must not be negative")
    mean1 = as_float_array("noise_mean1", noise_mean1, ("...",))
    mean2 = as_float_array("noise_mean2", noise_mean2, ("...",))
    cross = mean1 * mean2 if noise_cross is None else as_float_array("noise_cross", noise_cross, ("...",))
    power1 = _mean_product(x1, x1) - variance1 - mean1**2
    power2 = _mean_product(x2, x2) - variance2 - mean2**2
    power = np.where((power1 > 0.0) & (power2 > 0.0), power1 * power2, 0.0)
    return _angle_from_cosine(_mean_product(x1, x2) - cross, power, bad)


def correlator_phase_difference(
    s1: npt.ArrayLike, s2: npt.ArrayLike, cycles_per_sample: float, *, constant: bool = False
) -> FloatArray:
    """Phase difference by least squares of a cosine and a sine of known frequency.

    Maximum likelihood in white noise: its standard deviation is `bound_rad` at every signal-to-noise ratio that
    leaves no doubt about the cycle.

    Parameters
    ----------
    s1, s2 : (..., sample)
        Real signals, same length; leading axes broadcast. NaN or infinity anywhere in a row makes the row NaN.
    cycles_per_sample
        The tone's frequency over the sample rate, between 0 and 0.5.
    constant
        Fit a constant beside the tone: for signals that are not of zero mean.

    Returns
    -------
    (...)
        ``φ2 − φ1`` [rad], in [−π, π]. NaN: the row holds NaN or infinity, or no signal.

    Raises
    ------
    InvalidInputError
        Different lengths, complex or too short signals, a frequency outside (0, 0.5), a record that spans less
        than half a cycle of the tone or of its alias.
    """
    x1, x2, bad = _pair(s1, s2)
    n_sample = x1.shape[-1]
    if not 0.0 < cycles_per_sample < 0.5:
        raise InvalidInputError(f"`cycles_per_sample` must lie between 0 and 0.5, got {cycles_per_sample!r:.40}")
    if n_sample * min(cycles_per_sample, 0.5 - cycles_per_sample) < 0.5:
        raise InvalidInputError(
            f"`s1` and `s2` must span half a cycle or more, got {n_sample} samples at {cycles_per_sample:.3g} "
            "cycles a sample (or as far from 0.5); lengthen the record"
        )
    angle = 2.0 * np.pi * np.mod(cycles_per_sample * np.arange(n_sample), 1.0)
    model = [np.cos(angle), np.sin(angle)] + ([np.ones(n_sample)] if constant else [])
    design = np.stack(model, axis=-1)
    # the pseudo-inverse of a well-conditioned design: a tall product instead of one solution a row
    inverse = np.linalg.solve(design.T @ design, design.T).T
    phasor1, phasor2 = ((part[..., 0] - 1j * part[..., 1]) for part in (x1 @ inverse, x2 @ inverse))
    return _finish(np.angle(phasor2 * np.conj(phasor1)), bad)


# -- what to expect of them ----------------------------------------------------------------------------------


def predicted_sigma_rad(
    n_sample: npt.ArrayLike,
    snr1: npt.ArrayLike,
    snr2: npt.ArrayLike | None = None,
    bandwidth1: npt.ArrayLike = 1.0,
    bandwidth2: npt.ArrayLike | None = None,
) -> FloatArray:
    """Predict the standard deviation of the Hilbert method and of the correlator, Swart et al. §4.5.

    ``σ_φ² = (1/S) (1/(B1 SNR1) + 1/(B2 SNR2))``

    Parameters
    ----------
    n_sample
        Number of samples S that are averaged.
    snr1, snr2
        Linear, per sample, in the samples as given. ``snr2`` is ``snr1`` unless given.
    bandwidth1, bandwidth2
        Noise bandwidth B over f_s/2. ``bandwidth2`` is ``bandwidth1`` unless given.

    Returns
    -------
    (...)
        [rad], all arguments broadcast.

    Raises
    ------
    InvalidInputError
        An argument that is not a finite number greater than zero, or a bandwidth above one.
    """
    n, g1, g2, b1, b2 = _noise_arguments(n_sample, snr1, snr2, bandwidth1, bandwidth2)
    return np.asarray(np.sqrt((1.0 / (b1 * g1) + 1.0 / (b2 * g2)) / n))


def bound_rad(n_sample: npt.ArrayLike, snr1: npt.ArrayLike, snr2: npt.ArrayLike | None = None) -> FloatArray:
    """Return the Cramér-Rao bound on the phase difference of two real tones of known frequency in white noise.

    Each phase has ``var φ ≥ 1/(S SNR)``; the difference of two has the sum.

    Parameters
    ----------
    n_sample
        Number of samples S.
    snr1, snr2
        Linear, per sample: ``(a²/2)/Var[n]``. ``snr2`` is ``snr1`` unless given.

    Returns
    -------
    (...)
        Least standard deviation of an unbiased estimate [rad].

    Raises
    ------
    InvalidInputError
        An argument that is not a finite number greater than zero.
    """
    return predicted_sigma_rad(n_sample, snr1, snr2)


def dot_bias_rad(phase_rad: npt.ArrayLike, snr1: npt.ArrayLike, snr2: npt.ArrayLike | None = None) -> FloatArray:
    """Return the error that the dot-product method keeps however many samples there are.

    ``acos(cos φ21 / √((1 + 1/SNR1)(1 + 1/SNR2))) − |φ21|``, from §3.1.1 with the noise power in the norms.

    Parameters
    ----------
    phase_rad
        True phase difference [rad].
    snr1, snr2
        Linear, per sample. ``snr2`` is ``snr1`` unless given.

    Returns
    -------
    (...)
        Mean of the estimate minus ``|φ21|`` with φ21 wrapped to [−π, π] [rad].

    Raises
    ------
    InvalidInputError
        A ratio that is not a finite number greater than zero.
    """
    _, g1, g2, _, _ = _noise_arguments(1, snr1, snr2, 1.0, None)
    cosine = np.cos(as_float_array("phase_rad", phase_rad, ("...",)))
    return np.asarray(np.arccos(cosine / np.sqrt((1.0 + 1.0 / g1) * (1.0 + 1.0 / g2))) - np.arccos(cosine))


def dot_sigma_rad(
    n_sample: npt.ArrayLike,
    phase_rad: npt.ArrayLike,
    snr1: npt.ArrayLike,
    snr2: npt.ArrayLike | None = None,
    bandwidth1: npt.ArrayLike = 1.0,
    bandwidth2: npt.ArrayLike | None = None,
) -> FloatArray:
    """Predict the standard deviation of the dot-product method about its biased mean (`dot_bias_rad`).

    To first order in the averages ``⟨s1 s2⟩``, ``⟨s1²⟩``, ``⟨s2²⟩``, with flat noise about the tone.

    Parameters
    ----------
    n_sample
        Number of samples.
    phase_rad
        True phase difference [rad].
    snr1, snr2, bandwidth1, bandwidth2
        As for `predicted_sigma_rad`.

    Returns
    -------
    (...)
        [rad], all arguments broadcast.

    Raises
    ------
    InvalidInputError
        As for `predicted_sigma_rad`; a phase that is not finite.
    """
    n, g1, g2, b1, b2 = _noise_arguments(n_sample, snr1, snr2, bandwidth1, bandwidth2)
    return _dot_sigma(n, phase_rad, g1, g2, b1, b2, power1=1.0 + 1.0 / g1, power2=1.0 + 1.0 / g2)


def compensated_dot_sigma_rad(
    n_sample: npt.ArrayLike,
    phase_rad: npt.ArrayLike,
    snr1: npt.ArrayLike,
    snr2: npt.ArrayLike | None = None,
    bandwidth1: npt.ArrayLike = 1.0,
    bandwidth2: npt.ArrayLike | None = None,
) -> FloatArray:
    """Predict the standard deviation of the compensated dot product when the noise is known exactly.

    To first order it is `predicted_sigma_rad` and, in quadrature, the products of noise with noise over sin φ21::

        (1/S) (1/(max(B1, B2) SNR1 SNR2) + (cos² φ21 / 2)(1/(B1 SNR1²) + 1/(B2 SNR2²))) / sin² φ21

    so it equals the Hilbert method's away from 0 and π and grows without limit towards them.

    Parameters
    ----------
    n_sample
        Number of samples.
    phase_rad
        True phase difference [rad].
    snr1, snr2, bandwidth1, bandwidth2
        As for `predicted_sigma_rad`.

    Returns
    -------
    (...)
        [rad], all arguments broadcast; infinite at a multiple of π.

    Raises
    ------
    InvalidInputError
        As for `predicted_sigma_rad`; a phase that is not finite.
    """
    n, g1, g2, b1, b2 = _noise_arguments(n_sample, snr1, snr2, bandwidth1, bandwidth2)
    return _dot_sigma(n, phase_rad, g1, g2, b1, b2, power1=np.ones(()), power2=np.ones(()))


def _dot_sigma(
    n: FloatArray,
    phase_rad: npt.ArrayLike,
    g1: FloatArray,
    g2: FloatArray,
    b1: FloatArray,
    b2: FloatArray,
    *,
    power1: FloatArray,
    power2: FloatArray,
) -> FloatArray:
    """First-order error of ``acos(c)``, ``c`` a ratio of averages normalised by ``power`` (tone power = 1).

    With u the tones and e the noises, both scaled to tone power one, ``√(p1 p2) δc`` is
    ``⟨(u2 − c/p1 u1) e1⟩ + ⟨(u1 − c/p2 u2) e2⟩ + ⟨e1 e2⟩ − c/2 (⟨e1²⟩'/p1 + ⟨e2²⟩'/p2)``; noise averaged against
    a tone has variance ``1/(S B SNR)``, against itself ``2/(S B SNR²)``, against the other's
    ``1/(S max(B1, B2) SNR1 SNR2)``.
    """
    cosine = np.cos(as_float_array("phase_rad", phase_rad, ("...",)))
    k1, k2 = cosine / power1, cosine / power2
    variance = (
        (1.0 - 2.0 * k1 * cosine + k1**2) / (b1 * g1)
        + (1.0 - 2.0 * k2 * cosine + k2**2) / (b2 * g2)
        + 1.0 / (np.maximum(b1, b2) * g1 * g2)
        + 0.5 * (k1**2 / (b1 * g1**2) + k2**2 / (b2 * g2**2))
    ) / (n * power1 * power2)
    slope = 1.0 - cosine**2 / (power1 * power2)
    with np.errstate(divide="ignore"):
        return np.asarray(np.sqrt(variance / slope))


# -- pieces --------------------------------------------------------------------------------------------------


def _pair(s1: npt.ArrayLike, s2: npt.ArrayLike) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Check a pair of signals; return both with unusable rows set to zero, and which rows of the result those are."""
    checked = []
    for name, signal in (("s1", s1), ("s2", s2)):
        if np.iscomplexobj(signal):
            raise InvalidInputError(f"`{name}` must be real, got complex samples; demodulate first")
        array = as_float_array(name, signal, ("...", "sample"), finite=False)
        bad = ~np.all(np.isfinite(array), axis=-1)
        bad |= np.all(array == array[..., :1], axis=-1) if array.shape[-1] else True
        checked.append((np.where(bad[..., None], 0.0, array) if np.any(bad) else array, bad))
    (x1, bad1), (x2, bad2) = checked
    if x1.shape[-1] != x2.shape[-1]:
        raise InvalidInputError(f"`s1` and `s2` must be of one length, got {x1.shape[-1]} and {x2.shape[-1]} samples")
    if x1.shape[-1] < MIN_SAMPLE:
        raise InvalidInputError(f"`s1` and `s2` must hold {MIN_SAMPLE} samples or more, got {x1.shape[-1]}")
    try:
        return x1, x2, np.logical_or(bad1, bad2)
    except ValueError as error:
        raise InvalidInputError(
            f"leading axes of `s1` and `s2` must broadcast, got {x1.shape[:-1]} and {x2.shape[:-1]}"
        ) from error


def _finish(value: FloatArray, bad: npt.NDArray[np.bool_]) -> FloatArray:
    return np.where(bad, np.nan, value)


def _analytic_weight(n_sample: int, bandpass: tuple[float, float] | None) -> FloatArray:
    """Weights of the bins of a real transform that turn it into the analytic signal's; the mean is dropped."""
    frequency = np.arange(n_sample // 2 + 1) / n_sample
    weight = np.full(frequency.shape, 2.0)
    weight[0] = 0.0
    if n_sample % 2 == 0:
        weight[-1] = 1.0  # the bin at half the sample rate is its own mirror image
    if bandpass is not None:
        low, high = bandpass
        if not 0.0 <= low < high <= 0.5:
            raise InvalidInputError(
                f"`bandpass` must be (low, high) with 0 <= low < high <= 0.5 cycles/sample, got {bandpass!r:.60}"
            )
        weight[(frequency < low) | (frequency > high)] = 0.0
        if not np.any(weight):
            raise InvalidInputError(
                f"`bandpass` ({low:.6g}, {high:.6g}) holds no frequency bin of a record of {n_sample} samples; "
                f"widen it to {1.0 / n_sample:.3g} cycles/sample or more, or lengthen the record"
            )
    return weight


def _analytic(x: FloatArray, weight: FloatArray) -> ComplexArray:
    spectrum = np.zeros(x.shape, np.complex128)
    spectrum[..., : len(weight)] = scipy.fft.rfft(x) * weight
    return np.asarray(scipy.fft.ifft(spectrum, overwrite_x=True))


def _kept(n_sample: int, bandpass: tuple[float, float] | None, edge: int | None) -> tuple[int, int]:
    """First sample, and one past the last, that the mean of unit phasors uses."""
    if edge is None:
        edge = min(n_sample // 64, 256)
        if bandpass is not None:
            edge = min(max(edge, math.ceil(0.5 / (bandpass[1] - bandpass[0]))), n_sample // 4)
    if edge < 0 or 2 * edge >= n_sample:
        raise InvalidInputError(f"`edge` must be 0 or more and less than half of {n_sample} samples, got {edge}")
    return edge, n_sample - edge


def _mean_product(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("...k,...k->...", x, y) / x.shape[-1])


def _angle_from_cosine(product: FloatArray, power: FloatArray, bad: npt.NDArray[np.bool_]) -> FloatArray:
    """``acos(product/√power)`` with the cosine held within ±1; NaN where ``bad`` or without power."""
    usable = power > 0.0
    cosine = product / np.sqrt(np.where(usable, power, 1.0))
    return _finish(np.arccos(np.clip(cosine, -1.0, 1.0)), bad | ~usable)


def _noise_arguments(
    n_sample: npt.ArrayLike,
    snr1: npt.ArrayLike,
    snr2: npt.ArrayLike | None,
    bandwidth1: npt.ArrayLike,
    bandwidth2: npt.ArrayLike | None,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    n = as_float_array("n_sample", n_sample, ("...",), positive=True)
    g1 = as_float_array("snr1", snr1, ("...",), positive=True)
    g2 = g1 if snr2 is None else as_float_array("snr2", snr2, ("...",), positive=True)
    b1 = as_float_array("bandwidth1", bandwidth1, ("...",), positive=True)
    b2 = b1 if bandwidth2 is None else as_float_array("bandwidth2", bandwidth2, ("...",), positive=True)
    if np.any(b1 > 1.0) or np.any(b2 > 1.0):
        raise InvalidInputError("`bandwidth1` and `bandwidth2` must not exceed 1 (half the sample rate)")
    return n, g1, g2, b1, b2
