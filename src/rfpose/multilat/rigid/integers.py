"""From wrapped phases to poses: coarse tone first, each finer wavelength once its integers are safe.

The pose found so far predicts the next finer range with a known uncertainty. Its integers are rounded where that makes
a wrong one rarer than the stated risk; otherwise the mirror keeps the coarser solution and says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import erfc

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError
from rfpose.multilat.rigid.pose import Knowledge, RigidPoses, RigidStatus, solve_rigid

__all__ = ["Observation", "RigidSolution", "align_points", "common_offset", "solve_ladder"]

BoolArray = npt.NDArray[np.bool_]

_DELAY_REACH_M = 3.0
"""Unknown delays between a mirror's receivers are searched up to this, 10 ns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """One wavelength's phases as ranges: a tone, or the carrier.

    Attributes
    ----------
    range_m : (mirror, receiver, transmitter)
        −λ/(2π) × phase, up to whole wavelengths [m]; NaN = not received.
    sigma_m : (mirror, receiver, transmitter)
        Own noise [m].
    transmitter_sigma_m : (mirror, transmitter)
        Error common to all receivers [m]; infinity where nothing calibrates it.
    wavelength_m : (transmitter,)
        [m].
    clock_class
        0 for tones, 1 for the carrier.
    """

    range_m: FloatArray
    sigma_m: FloatArray
    transmitter_sigma_m: FloatArray
    wavelength_m: FloatArray
    clock_class: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidSolution:
    """Poses, and which wavelengths they rest on.

    Attributes
    ----------
    poses
        The finest solution of each mirror.
    fixed : (mirror, observation)
        Whether an observation's integers were resolved and used.
    wrong_risk : (mirror, observation)
        Probability, beforehand, that any of its integers is wrong; 1 where it could not be judged.
    """

    poses: RigidPoses
    fixed: BoolArray
    wrong_risk: FloatArray


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
    good: BoolArray = np.asarray(np.isfinite(enu).all(axis=(1, 2)))
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


def solve_ladder(
    transmitter_enu_m: npt.ArrayLike,
    receiver_mirror_m: npt.ArrayLike,
    observations: list[Observation],
    *,
    start_pivot_enu_m: npt.ArrayLike,
    start_rot_enu_from_mirror: npt.ArrayLike,
    knowledge: Knowledge | None = None,
    wrong_risk: float = 1e-6,
) -> RigidSolution:
    """Solve poses from the coarsest wavelength down.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    receiver_mirror_m : (mirror, receiver, xyz)
        From the pivot, in the mirror frame [m].
    observations
        Coarsest first; the first one's integers must be resolved already.
    start_pivot_enu_m, start_rot_enu_from_mirror : (mirror, xyz), (mirror, 3, 3)
        Where to begin.
    knowledge
        Clocks, pivot, mount.
    wrong_risk
        Largest probability that any integer of an observation is wrong, for it to be used.

    Raises
    ------
    InvalidInputError
        No observation, or shapes that do not fit.
    """
    if not observations:
        raise InvalidInputError("`observations` must hold at least one wavelength")
    if not 0.0 < wrong_risk < 1.0:
        raise InvalidInputError(f"`wrong_risk` must lie between 0 and 1, got {wrong_risk}")
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    places = as_float_array("receiver_mirror_m", receiver_mirror_m, ("mirror", "receiver", 3))
    n_mirror = len(places)
    fixed = np.zeros((n_mirror, len(observations)), np.bool_)
    risk = np.ones((n_mirror, len(observations)))
    resolved = [np.full(o.range_m.shape, np.nan) for o in observations]
    poses: RigidPoses | None = None
    for k, observation in enumerate(observations):
        if poses is None:
            resolved[k] = observation.range_m
            fixed[:, k], risk[:, k] = True, 0.0
        else:
            ranges, risk[:, k] = _resolve(
                observation,
                transmitter,
                places,
                poses,
                knowledge or Knowledge(),
            )
            safe: BoolArray = np.less_equal(risk[:, k], wrong_risk)
            fixed[:, k] = safe
            resolved[k] = np.where(safe[:, None, None], ranges, np.nan)
        used = observations[: k + 1]
        solution = solve_rigid(
            transmitter,
            places,
            np.stack(resolved[: k + 1], axis=1),
            sigma_m=np.stack([o.sigma_m for o in used], axis=1),
            transmitter_sigma_m=np.stack([o.transmitter_sigma_m for o in used], axis=1),
            clock_class=[o.clock_class for o in used],
            start_pivot_enu_m=start_pivot_enu_m if poses is None else _or(poses.pivot_enu_m, start_pivot_enu_m),
            start_rot_enu_from_mirror=start_rot_enu_from_mirror
            if poses is None
            else _or(poses.rot_enu_from_mirror, start_rot_enu_from_mirror),
            knowledge=knowledge,
        )
        if poses is not None:
            # what made a solved mirror unsolvable is not used for it
            worse = (poses.status == RigidStatus.OK) & (solution.status != RigidStatus.OK)
            fixed[worse, k] = False
            resolved[k][worse] = np.nan
            solution = _merge(solution, poses, worse)
        poses = solution
    assert poses is not None
    return RigidSolution(poses=poses, fixed=fixed, wrong_risk=risk)


def _merge(new: RigidPoses, old: RigidPoses, keep_old: BoolArray) -> RigidPoses:
    """Take each mirror's row from the old poses where told; clock classes that the old ones lack are NaN."""
    arrays = {}
    for name in RigidPoses.__dataclass_fields__:
        array, before = np.array(getattr(new, name)), getattr(old, name)
        if name == "clock_m":
            array[keep_old, : before.shape[1]] = before[keep_old]
        else:
            array[keep_old] = before[keep_old]
        arrays[name] = array
    return RigidPoses(**arrays)


def _or(first: FloatArray, second: npt.ArrayLike) -> FloatArray:
    return np.where(np.isfinite(first), first, np.asarray(second, np.float64))


def _resolve(
    observation: Observation,
    transmitter: FloatArray,
    places: FloatArray,
    poses: RigidPoses,
    known: Knowledge,
) -> tuple[FloatArray, FloatArray]:
    """Round the integers of one observation; return resolved ranges and the risk that any is wrong (mirror,)."""
    arm = np.einsum("mab,mrb->mra", poses.rot_enu_from_mirror, places)
    to_receiver = (poses.pivot_enu_m[:, None] + arm)[:, :, None] - transmitter
    distance = np.linalg.norm(to_receiver, axis=-1)
    direction = to_receiver / distance[..., None]
    slope = np.concatenate([direction, np.cross(arm[:, :, None], direction)], axis=-1)
    wavelength = observation.wavelength_m
    left = observation.range_m - distance
    calibrated = np.isfinite(observation.transmitter_sigma_m).all()
    # what clocks add is found from the ranges themselves: the mean over transmitters says nothing about integers
    centred = slope - slope.mean(axis=2, keepdims=True)
    offset_free = True
    if calibrated:
        slope = centred
        noise = observation.sigma_m**2 + observation.transmitter_sigma_m[:, None] ** 2
    else:
        # only differences between receivers mean anything
        left = left - left[:, :1]
        noise = observation.sigma_m**2 + observation.sigma_m[:, :1] ** 2
        offset_free = not np.isfinite(known.clock_sigma_m)
        slope = centred - centred[:, :1] if offset_free else slope - slope[:, :1]
        noise = noise if offset_free else noise + 2.0 * known.clock_sigma_m**2
    predicted = np.einsum("mria,mab,mrib->mri", slope, poses.cov, slope)
    sigma = np.sqrt(predicted + noise)
    offset_risk = np.zeros(left.shape[:2])
    if offset_free:
        offset, offset_risk = common_offset(left, wavelength, sigma)
        left = left - offset
    turns = np.rint(left / wavelength)
    with np.errstate(invalid="ignore"):
        wrong = erfc(0.5 * wavelength / (np.sqrt(2.0) * sigma))
    wrong = np.where(np.isfinite(wrong), wrong, 1.0)  # a mirror without a pose so far predicts nothing
    risk = np.where(np.isfinite(left), wrong, 0.0).sum(axis=(1, 2)) + offset_risk[:, 0 if calibrated else 1 :].sum(
        axis=1
    )
    risk = np.where(np.isfinite(left).any(axis=(1, 2)), np.minimum(risk, 1.0), 1.0)
    return observation.range_m - turns * wavelength, risk


def common_offset(left: FloatArray, wavelength: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the common offset of ranges known up to whole wavelengths, per receiver, and the risk of a wrong one.

    With one wavelength the offset is near zero; any multiple of it does as well. With unequal wavelengths (carriers)
    it is the one within ±`_DELAY_REACH_M` that fits best, and the runner-up tells how safely.

    Parameters
    ----------
    left, sigma : (mirror, receiver, transmitter)
        Ranges less their prediction, NaN = not received; what they may scatter [m].
    wavelength : (transmitter,)
        [m].

    Returns
    -------
    offset_m : (mirror, receiver, 1)
    risk : (mirror, receiver)
    """
    seen = np.isfinite(left)
    count = np.maximum(seen.sum(axis=2, keepdims=True), 1)
    if np.ptp(wavelength) == 0.0:
        phasor = np.where(seen, np.exp(2j * np.pi * np.nan_to_num(left) / wavelength), 0.0)
        mean = np.angle(phasor.sum(axis=2, keepdims=True)) / (2 * np.pi) * wavelength[0]
        return np.asarray(mean), np.zeros(left.shape[:2])
    steps = int(np.ceil(4.0 * _DELAY_REACH_M / float(np.min(wavelength)))) + 1
    offsets, scores = [], []
    for begin in np.linspace(-_DELAY_REACH_M, _DELAY_REACH_M, steps):
        offset = np.full(count.shape, begin)
        for _ in range(4):
            wrapped = np.where(seen, left - offset, 0.0)
            wrapped = wrapped - np.rint(wrapped / wavelength) * wavelength
            offset = offset + wrapped.sum(axis=2, keepdims=True) / count
        offsets.append(offset)
        with np.errstate(invalid="ignore"):
            scores.append(np.where(seen, (wrapped / sigma) ** 2, 0.0).sum(axis=2))
    all_offsets, score = np.stack(offsets), np.nan_to_num(np.stack(scores), nan=np.inf)
    best = np.argmin(score, axis=0)[None]
    chosen = np.take_along_axis(all_offsets, best[..., None], axis=0)[0]
    lowest = np.take_along_axis(score, best, axis=0)
    # several beginnings end at the same offset; the runner-up is the best of the others
    apart = np.abs(all_offsets - chosen)[..., 0] > 0.25 * float(np.min(wavelength))
    with np.errstate(invalid="ignore"):
        odds = np.where(apart, np.exp(-0.5 * np.minimum(score - lowest, 1400.0)), 0.0).sum(axis=0)
    return chosen, np.nan_to_num(np.minimum(odds, 1.0), nan=1.0)
