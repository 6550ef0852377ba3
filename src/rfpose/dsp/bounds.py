"""How good a tone phase can be at all."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError

__all__ = ["phase_bound_rad"]


def phase_bound_rad(n_sample: npt.ArrayLike, snr: npt.ArrayLike) -> FloatArray:
    """Return the Cramér–Rao bound of one transmitter's tone phase, as a standard deviation [rad].

    ``var φ ≥ 1 / (n · snr)`` with ``snr = (a m)² / σ²``: carrier amplitude a, modulation index m, variance σ² of
    the complex noise in the recorded band. Both sidebands used, carrier phase known (it decouples). For a real tone
    of amplitude A in noise of variance σ_r² the same holds with ``snr = A² / (2 σ_r²)``; the difference of two
    tones has the sum of their variances, which is Swart et al. §4.5's
    ``σ_φ² = (1/S)(1/(B₁ SNR₁) + 1/(B₂ SNR₂))`` with the SNR behind a filter of normalised bandwidth B.

    Parameters
    ----------
    n_sample : (...)
        Complex samples in the frame.
    snr : (...)
        Linear, per sample.

    Raises
    ------
    InvalidInputError
        Not greater than zero.
    """
    n = as_float_array("n_sample", n_sample, ("...",), positive=True)
    ratio = np.asarray(snr, np.float64)
    if np.any(ratio <= 0.0):
        raise InvalidInputError("`snr` must be greater than zero (linear, not decibels)")
    return np.asarray(1.0 / np.sqrt(n * ratio))
