"""Where to begin: from located receivers, or without calibration from differences between a mirror's receivers.

Receivers of a mirror are metres apart and transmitters much farther, so a receiver's range to transmitter i changes by
u_i · R a, u_i the direction to the pivot and a the receiver's place about the mean of all. What a transmitter itself is
off by and each receiver's clock drop out. That is linear in R: a quadratic form in its nine numbers, minimised over
rotations from the best of many.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.multilat.rigid.problem import MirrorProblem

__all__ = ["align_points", "rotations_from_differences"]

_N_TRIAL = 1500
"""Rotations to begin from, some 15° apart: nearer than the quadratic form's minima are wide."""

_ROWS = 1024
"""Mirrors solved at a time: their matrices are kept."""

_N_STEP = 25
_FLOOR = 1e-9
"""Of the information that nuisance unknowns have anyway, relative: their common constant is not seen."""


def align_points(receiver_mirror_m: npt.ArrayLike, receiver_enu_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Rotation and origin that put mirror coordinates onto measured points best (Kabsch 1976).

    Parameters
    ----------
    receiver_mirror_m : (mirror, receiver, xyz)
        [m].
    receiver_enu_m : (mirror, receiver, xyz)
        [m]; a mirror with a NaN gives NaN.

    Returns
    -------
    origin_enu_m : (mirror, xyz)
    rot_enu_from_mirror : (mirror, 3, 3)
    """
    mirror = as_float_array("receiver_mirror_m", receiver_mirror_m, ("mirror", "receiver", 3))
    enu = as_float_array("receiver_enu_m", receiver_enu_m, mirror.shape, finite=False)
    good: npt.NDArray[np.bool_] = np.asarray(np.isfinite(enu).all(axis=(1, 2)))
    points = np.where(good[:, None, None], enu, mirror)
    mean_mirror, mean_enu = mirror.mean(axis=1, keepdims=True), points.mean(axis=1, keepdims=True)
    cross = np.swapaxes(points - mean_enu, 1, 2) @ (mirror - mean_mirror)
    u, _, vt = np.linalg.svd(cross)
    flip = np.ones((len(mirror), 3))
    flip[:, 2] = np.sign(np.linalg.det(u @ vt))
    rot = (u * flip[:, None, :]) @ vt
    origin = mean_enu[:, 0] - np.einsum("mab,mb->ma", rot, mean_mirror[:, 0])
    rot[~good] = np.nan
    origin[~good] = np.nan
    return origin, rot


def rotations_from_differences(problem: MirrorProblem) -> FloatArray:
    """Orientations of mirrors at known places from ranges whose transmitters' own phases are unknown.

    Parameters
    ----------
    problem
        Begins at the known pivots. Of its first wavelength, whose ranges each have a constant for all receivers, each
        transmitter's, and one for all transmitters, each receiver's.

    Returns
    -------
    (mirror, 3, 3)
        ``rot_enu_from_mirror``, to begin from: what the mirror's size over its distance changes is left out. NaN where
        fewer than two receivers share two transmitters.
    """
    from scipy.spatial.transform import Rotation

    transmitter, places, pivot = problem.transmitter_enu_m, problem.receiver_mirror_m, problem.start_pivot_enu_m
    z, sigma, clock_sigma_m = problem.range_m[:, 0], problem.sigma_m[:, 0], problem.knowledge.clock_sigma_m
    out = np.full((len(places), 3, 3), np.nan)
    trials = Rotation.random(_N_TRIAL, random_state=0).as_matrix()
    for begin in range(0, len(places), _ROWS):
        rows = slice(begin, begin + _ROWS)
        to_mirror = pivot[rows, None] - transmitter
        direction = to_mirror / np.linalg.norm(to_mirror, axis=-1, keepdims=True)
        arm = places[rows] - places[rows].mean(axis=1, keepdims=True)
        info, target = _quadratic(direction, arm, z[rows], sigma[rows], clock_sigma_m)
        out[rows] = _minimise(info, target, trials)
    received = (np.isfinite(z).sum(axis=1) >= 2).sum(axis=1) >= 2
    out[~received] = np.nan
    return out


def _quadratic(
    direction: FloatArray, arm: FloatArray, z: FloatArray, sigma: FloatArray, clock_sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """Information (mirror, 9, 9) and its right side (mirror, 9) about R, clocks and transmitters eliminated."""
    n_mirror, n_receiver, n_transmitter = z.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(np.isfinite(z) & np.isfinite(sigma), sigma**-2.0, 0.0)
    left = np.nan_to_num(z)
    left = left - np.where(weight > 0.0, left, 0.0).sum(axis=1, keepdims=True) / np.maximum(
        (weight > 0.0).sum(axis=1, keepdims=True), 1
    )
    slope = np.einsum("mia,mrb->mriab", direction, arm).reshape(n_mirror, n_receiver, n_transmitter, 9)
    n_other = n_receiver + n_transmitter
    other = np.zeros((n_receiver, n_transmitter, n_other))
    other[np.arange(n_receiver), :, np.arange(n_receiver)] = 1.0
    other[:, np.arange(n_transmitter), n_receiver + np.arange(n_transmitter)] = 1.0
    weighted = weight[..., None] * slope
    info = np.einsum("mria,mrib->mab", weighted, slope)
    cross = np.einsum("mria,rib->mab", weighted, other)
    nuisance = np.einsum("mri,ria,rib->mab", weight, other, other)
    # what no measurement holds (a constant for all, a transmitter not received) is held weakly
    size = np.maximum(weight.max(axis=(1, 2)), 1e-300)
    held = np.full((n_mirror, n_other), _FLOOR) * size[:, None]
    held[:, :n_receiver] += clock_sigma_m**-2.0 if clock_sigma_m > 0.0 else 1e12 * size[:, None]
    nuisance[:, np.arange(n_other), np.arange(n_other)] += held
    right = np.einsum("mria,mri->ma", weighted, left)
    right_other = np.einsum("mri,ria,mri->ma", weight, other, left)
    eliminated = np.linalg.solve(nuisance, np.swapaxes(cross, 1, 2))
    info = info - cross @ eliminated
    return info / size[:, None, None], (right - np.einsum("mba,mb->ma", eliminated, right_other)) / size[:, None]


def _minimise(info: FloatArray, target: FloatArray, trials: FloatArray) -> FloatArray:
    """Rotations R that minimise ½ r' A r − r' b, r the nine numbers of R: the best trial, then Newton's steps."""
    from scipy.spatial.transform import Rotation

    flat = trials.reshape(-1, 9)
    cost = 0.5 * np.einsum("ta,mab,tb->mt", flat, info, flat, optimize=True) - target @ flat.T
    rot = trials[np.argmin(cost, axis=1)]
    generators = np.zeros((3, 3, 3))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        generators[k, i, j], generators[k, j, i] = -1.0, 1.0

    def cost_of(r: FloatArray) -> FloatArray:
        vector = r.reshape(-1, 9)
        return np.asarray(0.5 * np.einsum("ma,mab,mb->m", vector, info, vector) - np.einsum("ma,ma->m", target, vector))

    before = cost_of(rot)
    for _ in range(_N_STEP):
        vector = rot.reshape(-1, 9)
        jacobian = np.einsum("kab,mbc->mkac", generators, rot).reshape(-1, 3, 9)
        gradient = np.einsum("mka,ma->mk", jacobian, np.einsum("mab,mb->ma", info, vector) - target)
        hessian = jacobian @ info @ np.swapaxes(jacobian, 1, 2)
        damping = 1e-9 * np.maximum(np.trace(hessian, axis1=1, axis2=2), 1e-300)
        hessian = hessian + damping[:, None, None] * np.eye(3)
        step = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
        size = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300)
        step = step * np.minimum(1.0, 0.5 / size)
        for _halving in range(6):
            new = Rotation.from_rotvec(step).as_matrix() @ rot
            worse = cost_of(new) > before
            if not worse.any():
                break
            step[worse] *= 0.5
        better = cost_of(new) <= before
        rot = np.where(better[:, None, None], new, rot)
        before = cost_of(rot)
    return np.asarray(rot)
