"""Arrays for the kernels of rigid mirrors: weights, priors, ties between clocks, clocks to start from."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.multilat.rigid.knowledge import Knowledge

__all__ = ["bias_information", "clock_ties", "pivot_prior", "spread_places", "start_clock", "weights"]


def spread_places(receiver_mirror_m: npt.ArrayLike, n_mirror: int, n_receiver: int) -> FloatArray:
    """Receivers in the mirror frame, one row a mirror; three or more, not on a line."""
    places = as_float_array("receiver_mirror_m", receiver_mirror_m, ("...", n_receiver, 3))
    for mirror in places.reshape(-1, n_receiver, 3)[:1]:
        if n_receiver < 3 or geometry.is_collinear(mirror):
            raise GeometryError("`receiver_mirror_m` must hold three or more receivers that are not on a line")
    return np.array(np.broadcast_to(places, (n_mirror, n_receiver, 3)))


def weights(z: FloatArray, sigma_m: npt.ArrayLike) -> FloatArray:
    """Return 1/σ² of each range, zero where it is not received."""
    sigma = np.broadcast_to(np.asarray(sigma_m, np.float64), z.shape)
    if np.any(sigma <= 0.0):
        raise InvalidInputError("`sigma_m` must be greater than zero")
    return np.where(np.isfinite(z) & np.isfinite(sigma), 1.0 / np.where(np.isfinite(sigma), sigma, 1.0) ** 2, 0.0)


def bias_information(transmitter_sigma_m: npt.ArrayLike, shape: tuple[int, int, int]) -> FloatArray:
    """Return 1/σ² of what transmitters are off by: zero without calibration, infinite where exact."""
    sigma = np.broadcast_to(np.asarray(transmitter_sigma_m, np.float64), shape)
    with np.errstate(divide="ignore"):
        return np.array(np.where(np.isnan(sigma), 0.0, 1.0 / sigma**2))


def pivot_prior(known: Knowledge, n_mirror: int) -> tuple[FloatArray, FloatArray]:
    """Surveyed pivots (mirror, xyz) and their information (mirror, 3, 3), zero where unknown."""
    info = np.zeros((n_mirror, 3, 3))
    if known.pivot_enu_m is None:
        return np.zeros((n_mirror, 3)), info
    if np.isfinite(known.pivot_sigma_m):
        info[:] = np.eye(3) / known.pivot_sigma_m**2
    return np.array(np.broadcast_to(known.pivot_enu_m, (n_mirror, 3))), info


def clock_ties(
    clock_sigma_m: float,
    weight: FloatArray,
    bias_info: FloatArray,
    classes: npt.NDArray[np.int64],
    n_class: int,
) -> tuple[FloatArray, FloatArray]:
    """Information on each clock and on the differences between clocks.

    Clocks c + δ_r with δ_r of standard deviation s have differences of information 1/(R s²) a pair. Where no
    transmitter is calibrated a common clock is theirs as well: the first receiver's is then held, which says nothing.
    """
    n_mirror, _, n_receiver, _ = weight.shape
    own = np.zeros((n_mirror, n_class, n_receiver))
    tie = np.zeros((n_mirror, n_class, n_receiver, n_receiver))
    for k in range(n_class):
        # each mirror's and class's own scale: no mirror's result depends on its neighbours, and the stiffest tie of a
        # coarse tone stays comparable with what that tone observes
        largest = np.maximum(weight[:, classes == k].max(axis=(1, 2, 3), initial=0.0), 1e-300)
        known = np.any(bias_info[:, classes == k] > 0.0, axis=(1, 2))
        own[:, k, 0] = np.where(known, 0.0, largest)
        # a clock that nothing observes is held as well; it takes part in nothing
        seen = np.any(weight[:, classes == k] > 0.0, axis=(1, 3))
        if np.isfinite(clock_sigma_m):
            own[:, k, 0] = np.where(seen.any(axis=1), own[:, k, 0], largest)
            tie[:, k] = (largest / (n_receiver * np.maximum(clock_sigma_m**2 * largest, 1e-8)))[:, None, None]
        else:
            own[:, k] = np.where(seen, own[:, k], largest[:, None])
    return own, tie


def start_clock(
    transmitter: FloatArray,
    places: FloatArray,
    pivot: FloatArray,
    rot: FloatArray,
    z: FloatArray,
    classes: npt.NDArray[np.int64],
    n_class: int,
) -> FloatArray:
    """One common clock a mirror and class that fits the start pose: the mean of range less distance."""
    receiver = pivot[:, None] + np.einsum("mab,mrb->mra", rot, places)
    distance = np.linalg.norm(receiver[:, :, None] - transmitter, axis=-1)
    out = np.zeros((len(z), n_class, places.shape[1]))
    for k in range(n_class):
        left = z[:, classes == k] - distance[:, None]
        seen = np.isfinite(left)
        count = seen.sum(axis=(1, 2, 3))
        total = np.where(seen, left, 0.0).sum(axis=(1, 2, 3))
        out[:, k] = np.where(count > 0, total / np.maximum(count, 1), 0.0)[:, None]
    return out
