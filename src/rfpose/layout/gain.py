"""What an error of each range does to each normal: the linear estimator itself, not only its covariance.

`rfpose.layout.maps` needs the covariance alone and takes short cuts to it. A budget, and the question what a wrong
survey does, need the estimator: the derivative of the solved normal by every range and every prior that enters it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError
from rfpose.layout import _kernels
from rfpose.layout.maps import PosedMirrors, plane_slope
from rfpose.measurement import Estimator, Noise, clock_classes
from rfpose.multilat.equations import MirrorPrior

__all__ = ["Gain", "ReflectionBend", "gain_of", "normal_gain"]

_CHUNK = 256
_FLOOR = 1e-13
"""Smallest share of an unknown's information that the others may leave before it counts as unobserved."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gain:
    """Derivatives of the solved normals; NaN where a pose is not determined.

    A normal's error has two components, along the mirror's own x and y axes [rad].

    Attributes
    ----------
    range_slope : (mirror, xy, group, receiver, transmitter)
        By each range [1/m]. A group is a tone or the carrier.
    pivot_slope : (mirror, xy, xyz)
        By the surveyed pivot [1/m]; zero where it is not used.
    shared_slope : (mirror, xy, shared)
        By the unknowns that all mirrors share (reflection coefficients), at the mirror's own ranges.
    shared_range_slope : (mirror, shared, group, receiver, transmitter)
        What each range does to the shared unknowns [1/m].
    shared_pivot_slope : (mirror, shared, xyz)
        What each pivot's survey does to them [1/m].
    cov : (mirror, xy, xy)
        Of the normal's error as the solver itself will state it: noise and priors as it assumes them [rad²].
    """

    range_slope: FloatArray
    pivot_slope: FloatArray
    shared_slope: FloatArray
    shared_range_slope: FloatArray
    shared_pivot_slope: FloatArray
    cov: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectionBend:
    """How reflections bend ranges about the expected poses.

    Attributes
    ----------
    place_slope : (mirror, group, receiver, transmitter, xyz)
        What a receiver's place adds to the range besides the direct ray's direction.
    shared_slope : (mirror, group, receiver, transmitter, shared)
        By real and imaginary part of each coefficient that is estimated [m]; no columns where all are known.
    survey_slope : (group, transmitter, draw)
        By what is known to one standard deviation besides: coordinates of the calibration receivers [m].
    """

    place_slope: FloatArray
    shared_slope: FloatArray
    survey_slope: FloatArray


def gain_of(transmitter_enu_m: npt.ArrayLike, mirrors: PosedMirrors, noise: Noise, estimator: Estimator) -> Gain:
    """Return the gain of an estimator for noise as `rfpose.layout.maps` counts it.

    With it, Σ slope² σ² over own noise, and over sums of slopes for what receivers share, is the square of
    `rfpose.layout.maps.normal_map`.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    mirrors, noise, estimator
        See `rfpose.layout.maps`.

    Raises
    ------
    InvalidInputError
        Shapes that do not fit; an estimator that needs the carrier where ``noise`` has none.
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    own, common = noise.groups(carrier=estimator.carrier)
    sigma = own[:, None] * noise.loss(transmitter, mirrors.receiver_enu_m)[:, None]
    return normal_gain(transmitter, mirrors, sigma, common, clock_classes(len(own)), estimator)


def normal_gain(
    transmitter_enu_m: npt.ArrayLike,
    mirrors: PosedMirrors,
    sigma_m: npt.ArrayLike,
    transmitter_sigma_m: npt.ArrayLike,
    clock_class: npt.ArrayLike,
    estimator: Estimator,
    *,
    reflection: ReflectionBend | None = None,
) -> Gain:
    """Return the derivative of each mirror's solved normal by its ranges and priors.

    Generalised least squares about the expected poses, with the weights that the solver would use.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    mirrors
        Expected poses.
    sigma_m : (mirror, group, receiver, transmitter)
        Own noise that the solver assumes [m]; infinity = not received.
    transmitter_sigma_m : (group, transmitter)
        Error common to all receivers that it assumes; infinity = not calibrated [m].
    clock_class : (group,)
        Which clocks a group sees.
    estimator
        Clocks, pivot and mount as the solver knows them.
    reflection
        In the model of the solver; rigid estimators only.

    Raises
    ------
    InvalidInputError
        Shapes that do not fit.
    """
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    n_mirror, n_receiver = len(mirrors.pivot_enu_m), mirrors.receiver_mirror_m.shape[1]
    common = as_float_array("transmitter_sigma_m", transmitter_sigma_m, ("group", len(transmitter)), finite=False)
    shape = (n_mirror, len(common), n_receiver, len(transmitter))
    sigma = as_float_array("sigma_m", sigma_m, shape, finite=False, positive=True)
    classes = np.asarray(clock_class, np.int64)
    if classes.shape != (len(common),):
        raise InvalidInputError(f"`clock_class` must have shape ({len(common)},), got {classes.shape}")
    if reflection is not None and not estimator.rigid:
        raise InvalidInputError("`reflection` needs a rigid estimator: single receivers are located by direct rays")
    parts = []
    for begin in range(0, n_mirror, _CHUNK):
        rows = slice(begin, begin + _CHUNK)
        part = _part(mirrors, rows)
        if not estimator.rigid:
            parts.append(_independent(transmitter, part, sigma[rows], common))
            continue
        bent = None
        if reflection is not None:
            bent = replace(
                reflection, place_slope=reflection.place_slope[rows], shared_slope=reflection.shared_slope[rows]
            )
        parts.append(_rigid(transmitter, part, sigma[rows], common, classes, estimator, bent))
    range_slope, pivot_slope, cov, shared_slope, by_range, by_pivot, schur = (
        np.concatenate(arrays) for arrays in zip(*parts, strict=True)
    )
    if shared_slope.shape[2]:
        inverse = np.linalg.inv(schur.sum(axis=0))
        cov = cov + shared_slope @ inverse @ np.swapaxes(shared_slope, 1, 2)
        by_range, by_pivot = (
            np.einsum("pq,mqgrt->mpgrt", inverse, by_range),
            np.einsum("pq,mqx->mpx", inverse, by_pivot),
        )
    return Gain(
        range_slope=range_slope,
        pivot_slope=pivot_slope,
        shared_slope=shared_slope,
        shared_range_slope=by_range,
        shared_pivot_slope=by_pivot,
        cov=cov,
    )


def _part(mirrors: PosedMirrors, rows: slice) -> PosedMirrors:
    places = mirrors.receiver_mirror_m
    return PosedMirrors(
        pivot_enu_m=mirrors.pivot_enu_m[rows],
        rot_enu_from_mirror=mirrors.rot_enu_from_mirror[rows],
        receiver_mirror_m=places if len(places) == 1 else places[rows],
    )


def _directions(transmitter: FloatArray, mirrors: PosedMirrors) -> FloatArray:
    """(mirror, receiver, transmitter, xyz) unit vectors from transmitters to receivers."""
    offset = mirrors.receiver_enu_m[:, :, None] - transmitter
    return np.asarray(offset / np.linalg.norm(offset, axis=-1, keepdims=True))


def _independent(
    transmitter: FloatArray, mirrors: PosedMirrors, sigma: FloatArray, common: FloatArray
) -> tuple[FloatArray, ...]:
    """Each receiver by itself, then the plane through them."""
    n_mirror, n_group, n_receiver, n_transmitter = sigma.shape
    u = _directions(transmitter, mirrors)[:, None]
    weight = 1.0 / (sigma**2 + common[:, None] ** 2)
    mean = np.einsum("mgrt,mgrta->mgra", weight, np.broadcast_to(u, (*sigma.shape, 3)))
    total = weight.sum(axis=3)[..., None]
    centred = u - (mean / np.where(total > 0.0, total, 1.0))[:, :, :, None]
    rows = weight[..., None] * centred
    place_gain = _inverse(np.einsum("mgrta,mgrtb->mrab", rows, centred))
    slope = np.broadcast_to(plane_slope(mirrors.receiver_mirror_m), (n_mirror, n_receiver, 3, 3))[:, :, :2]
    by_place = np.einsum("mrkc,mac->mrka", slope, mirrors.rot_enu_from_mirror)
    out = np.einsum("mrka,mrab,mgrtb->mkgrt", by_place, place_gain, rows)
    # a receiver that is located by itself takes what is common to all of a mirror's for noise of its own; the normal's
    # covariance does not
    together = out.sum(axis=3)
    cov = np.einsum("mkgrt,mgrt,mlgrt->mkl", out, sigma**2, out)
    cov = cov + np.einsum("mkgt,gt,mlgt->mkl", together, common**2, together)
    return out, np.zeros((n_mirror, 2, 3)), cov, *_nothing_shared(n_mirror, n_group, n_receiver, n_transmitter)


def _nothing_shared(n_mirror: int, n_group: int, n_receiver: int, n_transmitter: int) -> tuple[FloatArray, ...]:
    shape = (n_group, n_receiver, n_transmitter)
    return tuple(
        np.zeros(size) for size in ((n_mirror, 2, 0), (n_mirror, 0, *shape), (n_mirror, 0, 3), (n_mirror, 0, 0))
    )


def _rigid(
    transmitter: FloatArray,
    mirrors: PosedMirrors,
    sigma: FloatArray,
    common: FloatArray,
    classes: npt.NDArray[np.int64],
    estimator: Estimator,
    reflection: ReflectionBend | None,
) -> tuple[FloatArray, ...]:
    """All receivers in one fit; the transmitters' common errors come off as weighted means over receivers."""
    n_mirror, n_group, n_receiver, n_transmitter = sigma.shape
    rot = mirrors.rot_enu_from_mirror
    direction = np.broadcast_to(_directions(transmitter, mirrors)[:, None], (*sigma.shape, 3))
    n_shared = n_survey = 0
    if reflection is not None:
        direction = direction + reflection.place_slope
        n_shared, n_survey = reflection.shared_slope.shape[-1], reflection.survey_slope.shape[-1]
    arm = mirrors.receiver_enu_m - mirrors.pivot_enu_m[:, None]
    clock = _clock_columns(classes, n_receiver, shared=estimator.clock_sigma_m == 0.0)
    n_known = 6 + clock.shape[-1]
    n_pose = n_known + n_survey
    rows = np.zeros((*sigma.shape, n_pose + n_shared))
    rows[..., :3] = direction
    rows[..., 3:6] = np.cross(arm[:, None, :, None], direction)
    rows[..., 6:n_known] = clock[None, :, :, None]
    if reflection is not None:
        rows[..., n_known:n_pose] = reflection.survey_slope[None, :, None]
        rows[..., n_pose:] = reflection.shared_slope
    weight = sigma**-2.0
    with np.errstate(divide="ignore"):
        bias_info = common**-2.0
    total = weight.sum(axis=2) + bias_info
    mean = np.einsum("mgrt,mgrtk->mgtk", weight, rows) / np.where(total > 0.0, total, 1.0)[..., None]
    weighed = weight[..., None] * (rows - mean[:, :, None])
    info = np.einsum("mgrtk,mgrtl->mkl", rows, weighed)
    info[:, :n_known, :n_known] += _prior(estimator, rot, weight, bias_info, classes)
    info[:, n_known:n_pose, n_known:n_pose] += np.eye(n_survey)
    flat = weighed.reshape(n_mirror, -1, n_pose + n_shared)
    pose = _inverse(info[:, :n_pose, :n_pose])
    to_normal = np.zeros((n_mirror, 2, n_pose))
    to_normal[:, 0, 3:6], to_normal[:, 1, 3:6] = rot[:, :, 1], -rot[:, :, 0]
    solve = to_normal @ pose
    out = (solve @ np.swapaxes(flat[:, :, :n_pose], 1, 2)).reshape(n_mirror, 2, *sigma.shape[1:])
    pivot_info = estimator.pivot_sigma_m**-2.0
    pivot, cov = solve[:, :, :3] * pivot_info, solve @ np.swapaxes(to_normal, 1, 2)
    if not n_shared:
        return out, pivot, cov, *_nothing_shared(n_mirror, n_group, n_receiver, n_transmitter)
    cross = info[:, n_pose:, :n_pose]
    follow = cross @ pose
    by_range = np.swapaxes(flat[:, :, n_pose:] - flat[:, :, :n_pose] @ np.swapaxes(follow, 1, 2), 1, 2)
    schur = info[:, n_pose:, n_pose:] - follow @ np.swapaxes(cross, 1, 2)
    shared = -solve @ np.swapaxes(cross, 1, 2)
    by_range = by_range.reshape(n_mirror, n_shared, *sigma.shape[1:])
    return out, pivot, cov, shared, by_range, -follow[:, :, :3] * pivot_info, schur


def _clock_columns(classes: npt.NDArray[np.int64], n_receiver: int, *, shared: bool) -> FloatArray:
    """(group, receiver, clock) which clock a receiver's range of a group holds."""
    n_clock = 1 if shared else n_receiver
    out = np.zeros((len(classes), n_receiver, (int(classes.max()) + 1) * n_clock))
    for g, k in enumerate(classes):
        for r in range(n_receiver):
            out[g, r, k * n_clock + (0 if shared else r)] = 1.0
    return out


def _prior(
    estimator: Estimator, rot: FloatArray, weight: FloatArray, bias_info: FloatArray, classes: npt.NDArray[np.int64]
) -> FloatArray:
    """(mirror, unknown, unknown) what is known of pose and clocks.

    A common clock that is the transmitters' own is held, which says nothing.
    """
    n_mirror, n_class, shared = len(rot), int(classes.max()) + 1, estimator.clock_sigma_m == 0.0
    n_clock = 1 if shared else weight.shape[2]
    held = np.zeros((n_mirror, n_class, n_clock))
    for k in range(n_class):
        if not np.any(bias_info[classes == k] > 0.0):
            held[:, k, 0] = np.maximum(weight[:, classes == k].sum(axis=(1, 2, 3)), 1.0)
    tie = 0.0 if shared else estimator.clock_sigma_m**-2.0 / n_clock
    prior = MirrorPrior(
        pivot=np.zeros((n_mirror, 3)),
        pivot_info=np.tile(np.eye(3) * estimator.pivot_sigma_m**-2.0, (n_mirror, 1, 1)),
        roll_info=np.full(n_mirror, estimator.roll_sigma_rad**-2.0 if estimator.two_axis else 0.0),
        clock_own=held,
        clock_tie=np.full((n_mirror, n_class, n_clock, n_clock), tie),
        clock=np.zeros((n_mirror, n_class, n_clock)),
    )
    out = np.zeros((n_mirror, 6 + n_class * n_clock, 6 + n_class * n_clock))
    _kernels.prior_rows(n_mirror, prior, rot, out)
    return out + np.swapaxes(np.tril(out, -1), 1, 2)


def _inverse(info: FloatArray) -> FloatArray:
    """Inverse of each symmetric matrix, scaled to a unit diagonal first; NaN where it is singular."""
    size = np.einsum("...kk->...k", info)
    good = np.all(size > 0.0, axis=-1) & np.isfinite(info).all(axis=(-2, -1))
    root = np.sqrt(np.where(good[..., None], size, 1.0))
    scaled = np.where(good[..., None, None], info / (root[..., :, None] * root[..., None, :]), np.eye(info.shape[-1]))
    good &= np.linalg.eigvalsh(scaled)[..., 0] > _FLOOR
    scaled[~good] = np.eye(info.shape[-1])
    out = np.linalg.inv(scaled) / (root[..., :, None] * root[..., None, :])
    out[~good] = np.nan
    return np.asarray(out)
