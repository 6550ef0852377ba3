"""From receiver positions to mirror normals, with their covariance (Swart et al. §3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array, read_only
from rfpose.errors import InvalidInputError
from rfpose.geometry import azimuth_elevation_from_enu, cross_matrix, is_collinear
from rfpose.multilat import _kernels
from rfpose.multilat.fix import Fixes, FixStatus, Side, locate
from rfpose.multilat.status import PoseStatus
from rfpose.multilat.transmitters import check_transmitters

__all__ = ["Normals", "Poses", "joint_covariance", "mirror_normal", "solve_poses"]

# Receivers whose spread across their line is below this part of the spread along it fix no normal.
COLLINEAR = 1e-3
# A normal whose RMS angle exceeds this is not solved: so far off, a straight line's covariance says little of it [rad].
MAX_SIGMA_RAD = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Normals:
    """Mirror normals; arrays are read-only. A row is NaN unless its status is OK, RESIDUAL, UNCERTAIN or AMBIGUOUS.

    Attributes
    ----------
    normal_enu : (..., xyz)
        Unit length, site ENU.
    cov_enu : (..., xyz, xyz)
        First-order covariance of the unit normal (rank two: nothing along the normal) [rad²].
    sigma_rad : (...)
        Square root of its trace: RMS angle between estimated and true normal. Of the normal, not of the beam.
    azimuth_rad, elevation_rad : (...)
        Direction of the normal.
    n_receiver : (...)
        Receivers used.
    status : (...)
        `PoseStatus` as int8.
    """

    normal_enu: FloatArray
    cov_enu: FloatArray
    sigma_rad: FloatArray
    azimuth_rad: FloatArray
    elevation_rad: FloatArray
    n_receiver: npt.NDArray[np.int16]
    status: npt.NDArray[np.int8]

    @property
    def ok(self) -> npt.NDArray[np.bool_]:
        """(...) True where the status is OK."""
        return np.asarray(self.status == PoseStatus.OK)


@dataclass(frozen=True, slots=True, kw_only=True)
class Poses:
    """Fixes of all receivers and normals of all mirrors, frame by frame.

    Attributes
    ----------
    fixes : Fixes
        Rows in order (frame, receiver), flattened.
    position_enu_m : (frame, receiver, xyz)
        The fixes' positions [m].
    cov_enu_m2 : (frame, receiver, xyz, xyz)
        Their covariance, calibration included [m²].
    fix_status : (frame, receiver)
        `FixStatus` as int8.
    centre_enu_m : (frame, mirror, xyz)
        Mean of the mirror's located receivers [m].
    normals : Normals
        Arrays with leading axes (frame, mirror).
    """

    fixes: Fixes
    position_enu_m: FloatArray
    cov_enu_m2: FloatArray
    fix_status: npt.NDArray[np.int8]
    centre_enu_m: FloatArray
    normals: Normals


def mirror_normal(
    receiver_enu_m: npt.ArrayLike,
    cov_enu_m2: npt.ArrayLike,
    *,
    receiver_mirror_m: npt.ArrayLike | None = None,
) -> Normals:
    """Return the normal of the plane through a mirror's receivers [1]_.

    Three receivers: the cross product (R₂ − R₁) × (R₃ − R₁). More: the least-squares plane. Its sign is that of
    receivers numbered counter-clockwise as seen from the front.

    Parameters
    ----------
    receiver_enu_m : (..., receiver, xyz)
        Positions, site ENU [m]. A receiver with NaN is left out while three or more remain.
    cov_enu_m2 : (..., 3·receiver, 3·receiver)
        Joint covariance, receiver by receiver (see `joint_covariance`) [m²].
    receiver_mirror_m : (receiver, xyz), optional
        The receivers' places in the mirror frame [m]. With them the numbering is free, and receivers need not lie
        in one plane: the normal is that of the best-fitting (affine) image of the mirror frame's x-y plane.

    Returns
    -------
    Normals
        A normal of `MAX_SIGMA_RAD` or more is UNCERTAIN; receivers on a line, as placed or as located, are COLLINEAR.

    Raises
    ------
    InvalidInputError
        Wrong shapes, fewer than three receivers.

    References
    ----------
    .. [1] Swart et al., A method for accurate measurement of heliostat mirror orientation, §3.5.
    """
    position = as_float_array("receiver_enu_m", receiver_enu_m, ("...", "receiver", 3), finite=False)
    n_receiver = position.shape[-2]
    if n_receiver < 3:
        raise InvalidInputError(f"`receiver_enu_m` must hold three or more receivers, got {n_receiver}")
    lead = position.shape[:-2]
    cov = as_float_array("cov_enu_m2", cov_enu_m2, ("...", 3 * n_receiver, 3 * n_receiver), finite=False)
    if cov.shape[:-2] != lead:
        raise InvalidInputError(
            f"`cov_enu_m2` must have shape {(*lead, 3 * n_receiver, 3 * n_receiver)}, got {cov.shape}"
        )
    mirror = None
    if receiver_mirror_m is not None:
        mirror = as_float_array("receiver_mirror_m", receiver_mirror_m, (n_receiver, 3))
    position = position.reshape(-1, n_receiver, 3)
    cov = cov.reshape(-1, 3 * n_receiver, 3 * n_receiver)
    n = len(position)
    vector = np.full((n, 3), np.nan)
    vector_cov = np.full((n, 3, 3), np.nan)
    used = np.isfinite(position).all(axis=2)
    status = np.full(n, PoseStatus.TOO_FEW, np.int8)
    patterns, pattern = np.unique(used, axis=0, return_inverse=True)
    for k, seen in enumerate(patterns):
        rows = np.flatnonzero(pattern.reshape(-1) == k)
        index = np.flatnonzero(seen)
        if index.size < 3:
            continue
        xyz = np.add.outer(3 * index, np.arange(3)).ravel()
        places = None if mirror is None else mirror[index]
        vector[rows], vector_cov[rows], flat = _plane(position[rows][:, index], cov[rows][:, xyz[:, None], xyz], places)
        status[rows] = np.where(flat, PoseStatus.COLLINEAR, PoseStatus.OK)
    sigma = np.sqrt(np.trace(vector_cov, axis1=1, axis2=2))
    status[(status == PoseStatus.OK) & ~(sigma <= MAX_SIGMA_RAD)] = PoseStatus.UNCERTAIN
    azimuth, elevation = azimuth_elevation_from_enu(vector)
    result = {
        "normal_enu": vector,
        "cov_enu": vector_cov,
        "sigma_rad": sigma,
        "azimuth_rad": azimuth,
        "elevation_rad": elevation,
        "n_receiver": used.sum(axis=1).astype(np.int16),
        "status": status,
    }
    return Normals(**{name: read_only(a.reshape((*lead, *a.shape[1:]))) for name, a in result.items()})


def _plane(
    position: FloatArray, cov: FloatArray, mirror: FloatArray | None
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Return unit normals, their covariance, and which rows are on a line; all receivers are there."""
    centred = position - position.mean(axis=1, keepdims=True)
    scatter = np.einsum("nkx,nky->nxy", centred, centred)
    size, axes = np.linalg.eigh(np.where(np.isfinite(scatter), scatter, 0.0))
    flat = ~(size[:, 1] > COLLINEAR**2 * size[:, 2])
    if mirror is not None and is_collinear(mirror, tolerance=COLLINEAR):
        # located with noise, receivers on a line do not look like it
        flat[:] = True
    with np.errstate(invalid="ignore", divide="ignore"):
        if mirror is not None:
            normal, jacobian = _cross_product(centred, *_affine_rows(mirror))
        elif position.shape[1] == 3:
            normal, jacobian = _cross_product(centred, np.array([-1.0, 1.0, 0.0]), np.array([-1.0, 0.0, 1.0]))
        else:
            normal, jacobian = _least_squares(centred, size, axes)
    normal[flat] = np.nan
    jacobian[flat] = np.nan
    return normal, jacobian @ cov @ np.swapaxes(jacobian, 1, 2), flat


def _cross_product(centred: FloatArray, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return p × q, of length one, and its derivative, for p = Σ a_k R_k and q = Σ b_k R_k in the plane."""
    p = np.einsum("k,nkx->nx", a, centred)
    q = np.einsum("k,nkx->nx", b, centred)
    cross = np.cross(p, q)
    length = np.linalg.norm(cross, axis=1)
    normal = cross / length[:, None]
    # d(p × q) = dp × q + p × dq = −[q]× dp + [p]× dq, then only what is across the normal
    jacobian = np.einsum("nij,k->nikj", -cross_matrix(q), a) + np.einsum("nij,k->nikj", cross_matrix(p), b)
    across = (np.eye(3) - normal[:, :, None] * normal[:, None, :]) / length[:, None, None]
    return normal, across @ jacobian.reshape(len(centred), 3, -1)


def _least_squares(centred: FloatArray, size: FloatArray, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the axis of least scatter, with the sign of the numbering, and its derivative.

    An eigenvector n of S = Σ R_k R_kᵀ moves by Σ_e e (eᵀ dS n)/(λ_n − λ_e) over the other two, e.
    """
    normal = axes[:, :, 0]
    area = np.sum(np.cross(centred, np.roll(centred, -1, axis=1)), axis=1)
    normal = normal * np.where(np.sum(area * normal, axis=1) < 0.0, -1.0, 1.0)[:, None]
    height = np.einsum("nkx,nx->nk", centred, normal)
    jacobian = np.zeros((len(centred), 3, centred.shape[1], 3))
    for other in (1, 2):
        e = axes[:, :, other]
        along = np.einsum("nkx,nx->nk", centred, e)
        change = along[:, :, None] * normal[:, None, :] + height[:, :, None] * e[:, None, :]
        jacobian += e[:, :, None, None] * (change / (size[:, 0] - size[:, other])[:, None, None])[:, None]
    return normal, jacobian.reshape(len(centred), 3, -1)


def _affine_rows(mirror: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return coefficients over receivers of the images of the mirror's x and y axes under the best affine map."""
    centred = mirror - mirror.mean(axis=0)
    inverse = np.linalg.pinv(centred, rcond=COLLINEAR)
    return inverse[0], inverse[1]


def joint_covariance(
    transmitter_enu_m: npt.ArrayLike,
    receiver_enu_m: npt.ArrayLike,
    sigma_m: npt.ArrayLike | float,
    calibration_sigma_m: npt.ArrayLike | float = 0.0,
) -> FloatArray:
    """Return the joint covariance of the fixes of one mirror's receivers.

    Each receiver has its own noise; the noise of the transmitter phases is common to all receivers of a frame, and
    moves a mirror's receivers almost alike. With H = (JᵀWJ)⁻¹JᵀW of each receiver,
    Cov(a, b) = δ_ab·H_a Σ_own H_aᵀ + H_a Σ_cal H_bᵀ, W = (Σ_own + Σ_cal)⁻¹ as `solve_poses` weighs.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    receiver_enu_m : (..., receiver, xyz)
        Solved positions [m]. A receiver with NaN, or with too few transmitters, has NaN rows and columns.
    sigma_m : scalar or broadcastable to (..., receiver, transmitter)
        A receiver's own range noise, of one transmitter [m]. NaN = not received.
    calibration_sigma_m : scalar or broadcastable to (..., receiver, transmitter)
        Range noise of the transmitter phases [m].

    Returns
    -------
    (..., 3·receiver, 3·receiver)
        [m²].

    Raises
    ------
    InvalidInputError
        Wrong shape, a sigma that is not positive, a calibration sigma that is negative.
    """
    transmitter = check_transmitters(transmitter_enu_m)
    position = as_float_array("receiver_enu_m", receiver_enu_m, ("...", "receiver", 3), finite=False)
    shape = (*position.shape[:-1], len(transmitter))
    own = _sigma("sigma_m", sigma_m, shape)
    common = _sigma("calibration_sigma_m", calibration_sigma_m, shape)
    if np.any(own <= 0.0):
        raise InvalidInputError("`sigma_m` must be greater than zero")
    if np.any(common < 0.0):
        raise InvalidInputError("`calibration_sigma_m` must not be negative")
    n_receiver = shape[-2]
    out = np.empty((int(np.prod(shape[:-2], dtype=np.int64)), 3 * n_receiver, 3 * n_receiver))
    _kernels.joint_covariances(
        transmitter,
        position.reshape(-1, n_receiver, 3),
        own.reshape(-1, n_receiver, shape[-1]),
        common.reshape(-1, n_receiver, shape[-1]),
        out,
    )
    return out.reshape(*shape[:-2], 3 * n_receiver, 3 * n_receiver)


def _sigma(name: str, value: npt.ArrayLike | float, shape: tuple[int, ...]) -> FloatArray:
    array = as_float_array(name, value, ("...",), finite=False)
    try:
        return np.ascontiguousarray(np.broadcast_to(array, shape))
    except ValueError as error:
        raise InvalidInputError(f"`{name}` must broadcast to {shape}, got shape {array.shape}") from error


def solve_poses(
    transmitter_enu_m: npt.ArrayLike,
    range_difference_m: npt.ArrayLike,
    *,
    sigma_m: npt.ArrayLike | float,
    calibration_sigma_m: npt.ArrayLike | float = 0.0,
    mirror_rows: Sequence[slice | Sequence[int]],
    receiver_mirror_m: Sequence[npt.ArrayLike] | None = None,
    side: Sequence[Side] | Side = "below",
    max_dop: float = 100.0,
    min_probability: float = 1e-9,
) -> Poses:
    """Locate all receivers of all frames, and return each mirror's normal.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        Site ENU [m].
    range_difference_m : (frame, receiver, transmitter)
        As `range_differences` gives them [m]; NaN = not usable.
    sigma_m : broadcastable to the same shape
        A receiver's own range noise, of one transmitter [m].
    calibration_sigma_m : broadcastable to the same shape
        Range noise of the transmitter phases, common to the receivers of a frame [m].
    mirror_rows
        For each mirror, which rows of the receiver axis are its receivers, numbered counter-clockwise.
    receiver_mirror_m
        For each mirror, (receiver, xyz) places in the mirror frame [m]; see `mirror_normal`.
    side
        As in `locate`; one for all or one a row of the receiver axis.
    max_dop, min_probability
        See `locate`.

    Returns
    -------
    Poses

    Raises
    ------
    InvalidInputError, GeometryError
        As `locate` and `mirror_normal`.
    """
    transmitter = check_transmitters(transmitter_enu_m)
    ranges = as_float_array(
        "range_difference_m", range_difference_m, ("frame", "receiver", len(transmitter)), finite=False
    )
    n_frame, n_receiver, n_transmitter = ranges.shape
    own = _sigma("sigma_m", sigma_m, ranges.shape)
    common = _sigma("calibration_sigma_m", calibration_sigma_m, ranges.shape)
    if np.any(common < 0.0):
        raise InvalidInputError("`calibration_sigma_m` must not be negative")
    rows_of = [np.arange(n_receiver)[rows if isinstance(rows, slice) else list(rows)] for rows in mirror_rows]
    if receiver_mirror_m is not None and len(receiver_mirror_m) != len(rows_of):
        raise InvalidInputError(
            f"`receiver_mirror_m` must have one entry a mirror ({len(rows_of)}), got {len(receiver_mirror_m)}"
        )
    fixes = locate(
        transmitter,
        ranges.reshape(-1, n_transmitter),
        sigma_m=np.hypot(own, common).reshape(-1, n_transmitter),
        side=side if side is None or isinstance(side, str) else list(side) * n_frame,
        max_dop=max_dop,
        min_probability=min_probability,
    )
    position = fixes.position_enu_m.reshape(n_frame, n_receiver, 3)
    fix_status = fixes.status.reshape(n_frame, n_receiver)
    own = np.where(np.isnan(ranges), np.nan, own)
    n_mirror = len(rows_of)
    out = {
        "normal_enu": np.full((n_frame, n_mirror, 3), np.nan),
        "cov_enu": np.full((n_frame, n_mirror, 3, 3), np.nan),
        "sigma_rad": np.full((n_frame, n_mirror), np.nan),
        "azimuth_rad": np.full((n_frame, n_mirror), np.nan),
        "elevation_rad": np.full((n_frame, n_mirror), np.nan),
        "n_receiver": np.zeros((n_frame, n_mirror), np.int16),
        "status": np.zeros((n_frame, n_mirror), np.int8),
    }
    centre = np.full((n_frame, n_mirror, 3), np.nan)
    for mirrors, places in _alike(rows_of, receiver_mirror_m):
        index = np.array([rows_of[m] for m in mirrors])
        cov = joint_covariance(transmitter, position[:, index], own[:, index], common[:, index])
        normals = mirror_normal(position[:, index], cov, receiver_mirror_m=places)
        doubts = {
            PoseStatus.AMBIGUOUS: (fix_status[:, index] == FixStatus.AMBIGUOUS).any(axis=2),
            PoseStatus.RESIDUAL: (fix_status[:, index] == FixStatus.RESIDUAL).any(axis=2),
        }
        for name, array in out.items():
            array[:, mirrors] = getattr(normals, name)
        status = np.array(normals.status)
        for doubt, doubtful in doubts.items():
            status[doubtful & (normals.status == PoseStatus.OK)] = doubt
        out["status"][:, mirrors] = status
        located = np.isfinite(position[:, index])
        with np.errstate(invalid="ignore", divide="ignore"):
            centre[:, mirrors] = np.where(located, position[:, index], 0.0).sum(axis=2) / located.sum(axis=2)
    return Poses(
        fixes=fixes,
        position_enu_m=read_only(position),
        cov_enu_m2=read_only(fixes.cov_enu_m2.reshape(n_frame, n_receiver, 3, 3)),
        fix_status=read_only(fix_status),
        centre_enu_m=read_only(centre),
        normals=Normals(**{name: read_only(array) for name, array in out.items()}),
    )


def _alike(
    rows_of: list[npt.NDArray[np.int64]], receiver_mirror_m: Sequence[npt.ArrayLike] | None
) -> list[tuple[list[int], FloatArray | None]]:
    """Group mirrors with the same number of receivers in the same places, to be solved together."""
    groups: dict[tuple[int, bytes], tuple[list[int], FloatArray | None]] = {}
    for m, rows in enumerate(rows_of):
        if len(rows) < 3:
            raise InvalidInputError(
                f"`mirror_rows` must give three or more receivers a mirror, got {len(rows)} for {m}"
            )
        places = None
        if receiver_mirror_m is not None:
            places = as_float_array(f"receiver_mirror_m[{m}]", receiver_mirror_m[m], (len(rows), 3))
        key = (len(rows), b"" if places is None else places.tobytes())
        groups.setdefault(key, ([], places))[0].append(m)
    return list(groups.values())
