"""Whole wavelengths of ranges, from a prediction that counts the reflections."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.multilat.rigid.integers import common_offset
from rfpose.multilat.rigid.problem import MirrorProblem

__all__ = ["resolve"]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


def resolve(
    problem: MirrorProblem,
    k: int,
    predicted: FloatArray,
    uncertainty: float | tuple[FloatArray, FloatArray],
    offset_m: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Round ranges of wavelength k to the turn nearest to the prediction.

    Without calibration only differences to a transmitter's first receiver mean anything; with a clock for each
    receiver only what is left of them when a receiver's common offset is taken off.

    Parameters
    ----------
    problem, k
    predicted : (mirror, receiver, transmitter)
        Ranges [m].
    uncertainty
        Of the prediction: one standard deviation of all [m], or the derivative (mirror, receiver, transmitter, k) and
        the covariance (mirror, k, k) of what it was made of.
    offset_m : (mirror, receiver, 1), optional
        Receivers' common offsets as a coarser tone gave them: the same clock moves both.

    Returns
    -------
    range_m : (mirror, receiver, transmitter)
        [m].
    wrong_risk : (mirror,)
        Probability that any is wrong (a bound: the sum of them all); 1 where it cannot be judged.
    offset_m : (mirror, receiver, 1)
        Common offset of each receiver; zero where clocks leave none.
    """
    from scipy.special import erfc

    observation, known = problem.observation(k), problem.knowledge
    seen = np.isfinite(observation.range_m)
    left = observation.range_m - predicted
    noise = np.broadcast_to(observation.sigma_m, left.shape) ** 2
    reference = None
    offset_free = True
    if np.isfinite(observation.transmitter_sigma_m).all():
        noise = noise + np.asarray(observation.transmitter_sigma_m)[:, None] ** 2
    else:
        reference = np.argmax(seen, axis=1)[:, None]
        left = left - np.take_along_axis(left, reference, axis=1)
        noise = noise + np.take_along_axis(noise, reference, axis=1)
        offset_free = not np.isfinite(known.clock_sigma_m)
        if not offset_free:
            noise = noise + 2.0 * known.clock_sigma_m**2
    if isinstance(uncertainty, float):
        variance = noise + uncertainty**2
    else:
        variance = noise + _variance(*uncertainty, seen, reference, offset_free)
    sigma = np.sqrt(variance)
    risk = np.zeros(len(left))
    offset = np.zeros((*left.shape[:2], 1))
    if offset_free:
        offset, offset_risk = common_offset(left, observation.wavelength_m, sigma)
        if offset_m is not None:
            longest = float(np.max(observation.wavelength_m))
            offset = offset + np.rint((offset_m - offset) / longest) * longest
        if np.isfinite(known.clock_sigma_m) and np.ptp(observation.wavelength_m) == 0.0:
            # receivers on one clock have one offset: not half a wavelength to either side of a wrap
            whole = float(observation.wavelength_m.flat[0])
            offset = offset - np.rint((offset - offset[:, :1]) / whole) * whole
        left = left - offset
        risk = np.where(seen.any(axis=2), offset_risk, 0.0).sum(axis=1)
    turns = np.rint(left / observation.wavelength_m)
    with np.errstate(invalid="ignore", divide="ignore"):
        wrong = erfc(0.5 * observation.wavelength_m / (np.sqrt(2.0) * sigma))
    risk = np.minimum(risk + np.where(seen, wrong, 0.0).sum(axis=(1, 2)), 1.0)
    risk = np.where(seen.any(axis=(1, 2)) & np.isfinite(risk), risk, 1.0)
    return observation.range_m - turns * observation.wavelength_m, risk, offset


def _variance(
    slope: FloatArray, cov: FloatArray, seen: BoolArray, reference: IntArray | None, offset_free: bool
) -> FloatArray:
    """Variance of predictions from which the same is taken off as from the ranges."""
    if reference is not None:
        slope = slope - np.take_along_axis(slope, reference[..., None], axis=1)
    if offset_free:
        count = np.maximum(seen.sum(axis=2, keepdims=True), 1)[..., None]
        slope = slope - np.where(seen[..., None], slope, 0.0).sum(axis=2, keepdims=True) / count
    return np.asarray(np.einsum("mrik,mrik->mri", slope @ cov[:, None], slope))
