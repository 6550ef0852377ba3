"""From tone phases to range differences: references, whole wavelengths, several tones (Swart et al. §3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat.transmitters import check_unambiguous, distances_m

__all__ = ["RangeDifferences", "RangeStatus", "range_differences"]

# A finer tone's whole wavelengths are fixed only where a wrong number is less likely than this.
WRONG_INTEGER_PROBABILITY = 1e-6
# A range difference must stay this many standard deviations inside half the coarsest wavelength.
AMBIGUITY_MARGIN_SIGMA = 6.0

# A tone brings its own clock offset. With fewer fixed transmitters that offset would take what the tone gives.
MIN_FIXED = 5


class RangeStatus(IntEnum):
    """What became of one range difference; ``reason`` says it in words."""

    OK = 0
    NOT_RECEIVED = 1
    AMBIGUOUS = 2
    TONE_FLOAT = 3
    UNCALIBRATED = 4

    @property
    def reason(self) -> str:
        """The status in words."""
        return _REASON[self]


_REASON = {
    RangeStatus.OK: "measured with every tone",
    RangeStatus.NOT_RECEIVED: "transmitter not received",
    RangeStatus.AMBIGUOUS: "farther from the reference than half the longest wavelength: whole wavelengths unknown",
    RangeStatus.TONE_FLOAT: "a shorter tone was left out: the longer ones are too noisy to count its wavelengths",
    RangeStatus.UNCALIBRATED: "no calibration receiver: the transmitter's own phase is not known",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeDifferences:
    """Ranges to transmitters less the range to a reference; arrays are read-only.

    Attributes
    ----------
    range_difference_m : (..., transmitter)
        Range to each transmitter minus range to the row's reference, up to one constant a row [m];
        NaN = not usable.
    sigma_m : (..., transmitter)
        Standard deviation of ONE transmitter's range from the receiver's own noise [m].
    calibration_sigma_m : (..., transmitter)
        The same from the transmitter phases; this error is common to all receivers of a frame [m].
    reference : (...)
        Index of the reference transmitter; -1 = none received.
    status : (..., transmitter)
        `RangeStatus` as int8.
    """

    range_difference_m: FloatArray
    sigma_m: FloatArray
    calibration_sigma_m: FloatArray
    reference: npt.NDArray[np.int64]
    status: npt.NDArray[np.int8]


def range_differences(
    phase_rad: npt.ArrayLike,
    sigma_rad: npt.ArrayLike,
    transmitter_phase_rad: npt.ArrayLike,
    transmitter_phase_sigma_rad: npt.ArrayLike,
    wavelength_m: npt.ArrayLike,
    transmitter_enu_m: npt.ArrayLike,
) -> RangeDifferences:
    """Turn tone phases into range differences [1]_.

    For each tone, d_i − d_j = −λ/(2π)·[(φ_i − φ_j) − (Φ_i − Φ_j)] + nλ. The longest tone has n = 0 by the choice
    of the reference j (see `check_unambiguous`); each shorter tone's n follows by rounding from the tones before
    it, where that is safe. All tones with known n are then combined by inverse variance.

    Parameters
    ----------
    phase_rad : (..., transmitter, tone)
        Phase of each transmitter's tone at a receiver [rad], any branch. NaN = not received.
    sigma_rad : same shape
        Its standard deviation, of one phase [rad]; not of a difference.
    transmitter_phase_rad : (..., transmitter, tone)
        Electronic phase Φ of each transmitter's tone [rad]; broadcast against ``phase_rad``.
    transmitter_phase_sigma_rad : same shape
        Its standard deviation [rad]; 0 = exactly known.
    wavelength_m : (tone,)
        In any order [m].
    transmitter_enu_m : (transmitter, xyz)
        Site ENU frame [m].

    Returns
    -------
    RangeDifferences

    Raises
    ------
    InvalidInputError
        Shapes that do not fit, a sigma that is not positive.
    GeometryError
        The longest wavelength is too short for the site, see `check_unambiguous`.

    Notes
    -----
    A range difference has the reference's noise too, but that is common to the row, and `locate` gives it to the
    row's clock. The tones' own clock offsets are estimated from all transmitters of the row, so that this holds
    also where the tones weigh differently from transmitter to transmitter.

    References
    ----------
    .. [1] Swart et al., A method for accurate measurement of heliostat mirror orientation, §3.2.
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    wavelength = as_float_array("wavelength_m", wavelength_m, ("tone",), positive=True)
    check_unambiguous(transmitter, wavelength)
    tail = (len(transmitter), len(wavelength))
    phase = as_float_array("phase_rad", phase_rad, ("...", *tail), finite=False)
    arrays = [
        _broadcast("sigma_rad", sigma_rad, phase.shape),
        _broadcast("transmitter_phase_rad", transmitter_phase_rad, phase.shape),
        _broadcast("transmitter_phase_sigma_rad", transmitter_phase_sigma_rad, phase.shape),
    ]
    if np.any(arrays[0] <= 0.0):
        raise InvalidInputError("`sigma_rad` must be greater than zero")
    if np.any(arrays[2] < 0.0):
        raise InvalidInputError("`transmitter_phase_sigma_rad` must not be negative")
    order = np.argsort(-wavelength)
    lead = phase.shape[:-2]
    phase, own, electronic, common = (a.reshape(-1, *tail)[:, :, order] for a in (phase, *arrays))
    wavelength = wavelength[order]
    per_rad = wavelength / (2.0 * np.pi)
    value, own, common = -(phase - electronic) * per_rad, own * per_rad, common * per_rad
    missing = ~(np.isfinite(value) & np.isfinite(own) & np.isfinite(common))
    value, own, common = (np.where(missing, np.nan, a) for a in (value, own, common))

    reference = _choose_references(~missing[:, :, 0], transmitter, wavelength[0])
    rows = np.arange(len(value))
    difference = value - value[rows, reference][:, None, :]
    variance = own**2 + common**2
    difference_variance = variance + variance[rows, reference][:, None, :]
    difference, fixed, ambiguous = _resolve(
        difference, difference_variance, wavelength, distances_m(transmitter)[reference], reference
    )
    combined, share, uncommon = _combine(difference, np.where(fixed, 1.0 / variance, 0.0))
    combined = combined - combined[rows, reference][:, None]
    status = np.full(combined.shape, RangeStatus.OK, np.int8)
    status[~fixed.all(axis=2)] = RangeStatus.TONE_FLOAT
    status[ambiguous] = RangeStatus.AMBIGUOUS
    status[missing[:, :, 0]] = RangeStatus.NOT_RECEIVED
    bad = (status == RangeStatus.AMBIGUOUS) | (status == RangeStatus.NOT_RECEIVED)
    result = {
        "range_difference_m": combined,
        "sigma_m": np.sqrt(np.sum(share**2 * np.where(fixed, own, 0.0) ** 2, axis=2) + uncommon),
        "calibration_sigma_m": np.sqrt(np.sum(share**2 * np.where(fixed, common, 0.0) ** 2, axis=2)),
    }
    reference = np.where(missing[:, :, 0].all(axis=1), -1, reference)
    return RangeDifferences(
        **{name: read_only(np.where(bad, np.nan, a).reshape((*lead, -1))) for name, a in result.items()},
        reference=read_only(reference.reshape(lead)),
        status=read_only(status.reshape((*lead, -1))),
    )


def _broadcast(name: str, value: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    array = as_float_array(name, value, ("...",), finite=False)
    try:
        return np.broadcast_to(array, shape)
    except ValueError as error:
        raise InvalidInputError(
            f"`{name}` must broadcast to the shape of `phase_rad` {shape}, got {array.shape}"
        ) from error


def _choose_references(
    received: npt.NDArray[np.bool_], transmitter_enu_m: FloatArray, wavelength_m: float
) -> npt.NDArray[np.int64]:
    """Choose each row's reference: with most transmitters within half a wavelength, then with the nearest far one."""
    distance = distances_m(transmitter_enu_m)
    patterns, pattern = np.unique(received, axis=0, return_inverse=True)
    choice = np.zeros(len(patterns), np.int64)
    for k, seen in enumerate(patterns):
        candidates = np.flatnonzero(seen)
        if candidates.size:
            to_seen = distance[np.ix_(candidates, candidates)]
            safe = np.sum(to_seen < wavelength_m / 2.0, axis=1)
            choice[k] = candidates[np.lexsort((to_seen.max(axis=1), -safe))[0]]
    return choice[pattern.reshape(-1)]


def _resolve(
    difference: FloatArray,
    variance: FloatArray,
    wavelength_m: FloatArray,
    distance_m: FloatArray,
    reference: npt.NDArray[np.int64],
) -> tuple[FloatArray, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Add whole wavelengths to each tone's range differences, the longest tone first.

    Returns differences, which of them have a known n, and which transmitters are ambiguous.
    """
    is_reference = np.arange(difference.shape[1]) == reference[:, None]
    with np.errstate(invalid="ignore"):
        margin = AMBIGUITY_MARGIN_SIGMA * np.sqrt(variance[:, :, 0])
        ambiguous = ~is_reference & ~(distance_m + margin < wavelength_m[0] / 2.0)
        out = difference - wavelength_m * np.round(difference / wavelength_m)
        fixed = np.zeros(difference.shape, bool)
        fixed[:, :, 0] = np.isfinite(difference[:, :, 0]) & ~ambiguous
        so_far, so_far_variance = out[:, :, 0].copy(), variance[:, :, 0].copy()
        for q in range(1, len(wavelength_m)):
            from scipy.special import erfc  # which one tone does without

            n = np.round((so_far - out[:, :, q]) / wavelength_m[q])
            out[:, :, q] += n * wavelength_m[q]
            room = wavelength_m[q] / 2.0 / np.sqrt(2.0 * (so_far_variance + variance[:, :, q]))
            fixed[:, :, q] = fixed[:, :, 0] & (is_reference | (erfc(room) < WRONG_INTEGER_PROBABILITY))
            fixed[:, :, q] &= np.isfinite(out[:, :, q])
            enough = np.minimum(MIN_FIXED, fixed[:, :, 0].sum(axis=1))
            fixed[:, :, q] &= (fixed[:, :, q].sum(axis=1) >= enough)[:, None]
            share = np.where(fixed[:, :, q], so_far_variance / (so_far_variance + variance[:, :, q]), 0.0)
            so_far = np.where(fixed[:, :, q], so_far + share * (out[:, :, q] - so_far), so_far)
            so_far_variance = so_far_variance * (1.0 - share)
    return out, fixed, ambiguous


def _combine(difference: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Combine tones by weight, with one free offset a row and tone (the reference's noise); tone 0 sets the zero.

    Model: difference_iq = x_i + b_q + noise of variance 1/weight_iq, b_0 = 0. Returns x, each tone's share in it, and
    what the uncertainty of b adds to the variance of x where a transmitter's shares differ from the row's mean (where
    they do not, b moves all x alike, which is the clock's affair).
    """
    value = np.where(weight > 0.0, difference, 0.0)
    total = weight.sum(axis=2, keepdims=True)
    share = weight / np.where(total > 0.0, total, 1.0)
    n_free = value.shape[2] - 1
    if n_free == 0:
        return value[:, :, 0], share, np.zeros(value.shape[:2])
    # normal equations of b after the x_i are eliminated, in units of each tone's weight; an unused tone gets b = 0
    matrix = -np.einsum("rip,riq->rpq", weight, share)[:, 1:, 1:]
    of_tone = weight.sum(axis=1)[:, 1:]
    matrix[:, np.arange(n_free), np.arange(n_free)] += of_tone
    right = np.einsum("riq,riq->rq", weight, value - np.sum(share * value, axis=2, keepdims=True))[:, 1:]
    unit = np.sqrt(np.where(of_tone > 0.0, of_tone, 1.0))
    matrix = matrix / (unit[:, :, None] * unit[:, None, :]) + 1e-12 * np.eye(n_free)
    inverse = np.linalg.inv(matrix) / (unit[:, :, None] * unit[:, None, :])
    offset = np.einsum("rpq,rq->rp", inverse, right)
    value[:, :, 1:] -= offset[:, None, :]
    mean = np.sum(total * share, axis=1, keepdims=True) / np.maximum(np.sum(total, axis=1, keepdims=True), 1e-300)
    uncommon = np.where(total > 0.0, share - mean, 0.0)[:, :, 1:]
    return np.sum(share * value, axis=2), share, np.einsum("rip,rpq,riq->ri", uncommon, inverse, uncommon)
