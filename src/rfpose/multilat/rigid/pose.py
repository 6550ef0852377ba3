"""Position and orientation of a mirror from all phases of its receivers at once.

Maximum likelihood for a rigid mirror. What is known enters as it is: the receivers' places on the mirror, their common
oscillator, the surveyed pivot, the two-axis mount, and the transmitters' own errors, which are the same for all
receivers of a frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError
from rfpose.multilat.rigid import _kernels
from rfpose.multilat.rigid.arrays import (
    bias_information,
    clock_ties,
    pivot_prior,
    spread_places,
    start_clock,
    weights,
)
from rfpose.multilat.rigid.knowledge import Knowledge

__all__ = ["Knowledge", "RigidPoses", "RigidStatus", "full_covariance", "rigid_bound", "solve_rigid", "tilt_sigma_rad"]

_MAX_ITERATION = 40
_FLOOR = 1e-13
"""Smallest share of an unknown's information that the other unknowns may leave before it counts as unobserved."""


class RigidStatus(IntEnum):
    """Outcome of one mirror's pose."""

    OK = 0
    SINGULAR = 1
    NOT_CONVERGED = 2
    NO_START = 3
    TOO_FEW = 4

    @property
    def reason(self) -> str:
        """The status in words."""
        return (
            "solved",
            "the measurements leave part of the pose undetermined; give a pivot, a mount, or more transmitters",
            "no convergence",
            "no starting pose",
            "fewer measurements than unknowns",
        )[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidPoses:
    """Poses of many mirrors.

    Attributes
    ----------
    pivot_enu_m : (mirror, xyz)
        [m]; NaN where not solved, like all that follows.
    rot_enu_from_mirror : (mirror, 3, 3)
    clock_m : (mirror, class, receiver)
        Clocks as ranges [m].
    cov : (mirror, 6, 6)
        Of pivot [m] and rotation vector in ENU [rad].
    chi2 : (mirror,)
        Weighted sum of squares left.
    dof : (mirror,)
        Measurements and priors less unknowns: what ``chi2`` should be.
    n_iteration, status : (mirror,)
    """

    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    clock_m: FloatArray
    cov: FloatArray
    chi2: FloatArray
    dof: FloatArray
    n_iteration: npt.NDArray[np.int64]
    status: npt.NDArray[np.int64]

    @property
    def normal_enu(self) -> FloatArray:
        """(mirror, xyz) unit normals."""
        return self.rot_enu_from_mirror[:, :, 2]

    @property
    def tilt_sigma_rad(self) -> FloatArray:
        """(mirror,) rms angle between estimated and true normal [rad]."""
        return tilt_sigma_rad(self.cov, self.normal_enu)


def tilt_sigma_rad(cov: FloatArray, normal_enu: FloatArray) -> FloatArray:
    """Rms angle of the normal from the covariance (…, 6, 6): the rotation's variance less that about the normal."""
    turn = cov[..., 3:, 3:]
    about = np.einsum("...a,...ab,...b->...", normal_enu, turn, normal_enu)
    return np.asarray(np.sqrt(np.trace(turn, axis1=-2, axis2=-1) - about))


def solve_rigid(
    transmitter_enu_m: npt.ArrayLike,
    receiver_mirror_m: npt.ArrayLike,
    range_m: npt.ArrayLike,
    *,
    sigma_m: npt.ArrayLike,
    transmitter_sigma_m: npt.ArrayLike,
    clock_class: npt.ArrayLike,
    start_pivot_enu_m: npt.ArrayLike,
    start_rot_enu_from_mirror: npt.ArrayLike,
    knowledge: Knowledge | None = None,
) -> RigidPoses:
    """Solve rigid poses of many mirrors by Gauss-Newton.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    receiver_mirror_m : (mirror, receiver, xyz) or (receiver, xyz)
        From the pivot, in the mirror frame [m].
    range_m : (mirror, group, receiver, transmitter)
        Range plus clock, integers resolved [m]; NaN = not received. A group is a tone or the carrier.
    sigma_m : as ``range_m`` (broadcast)
        Own noise of each [m].
    transmitter_sigma_m : (mirror, group, transmitter) (broadcast)
        Error common to all receivers: of the calibration; infinity without one [m].
    clock_class : (group,)
        Which clocks a group sees: 0 for tones, 1 for the carrier.
    start_pivot_enu_m, start_rot_enu_from_mirror : (mirror, xyz), (mirror, 3, 3)
        Where to begin; NaN gives status NO_START.
    knowledge
        Clocks, pivot and mount; default: nothing but the mirror's shape.

    Raises
    ------
    InvalidInputError
        Shapes that do not fit, a sigma that is not positive.
    GeometryError
        Receivers on a line.
    """
    known = knowledge or Knowledge()
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    z = as_float_array("range_m", range_m, ("mirror", "group", "receiver", "transmitter"), finite=False)
    n_mirror, n_group, n_receiver, n_transmitter = z.shape
    if n_transmitter != len(transmitter):
        raise InvalidInputError(f"`range_m` has {n_transmitter} transmitters, `transmitter_enu_m` {len(transmitter)}")
    places = spread_places(receiver_mirror_m, n_mirror, n_receiver)
    weight = weights(z, sigma_m)
    bias_info = bias_information(transmitter_sigma_m, (n_mirror, n_group, n_transmitter))
    classes = np.asarray(clock_class, np.int64)
    n_class = int(classes.max()) + 1
    prior, pivot_info = pivot_prior(known, n_mirror)
    own, tie = clock_ties(known.clock_sigma_m, weight, bias_info, classes, n_class)
    pivot = np.array(np.broadcast_to(np.asarray(start_pivot_enu_m, np.float64), (n_mirror, 3)))
    rot = np.array(np.broadcast_to(np.asarray(start_rot_enu_from_mirror, np.float64), (n_mirror, 3, 3)))
    clock = start_clock(transmitter, places, pivot, rot, z, classes, n_class)
    status = np.zeros(n_mirror, np.int64)
    seen = np.sum(weight > 0, axis=(1, 2, 3))
    status[seen < 4] = RigidStatus.TOO_FEW
    status[~(np.isfinite(pivot).all(axis=1) & np.isfinite(rot).all(axis=(1, 2)))] = RigidStatus.NO_START
    cov = np.full((n_mirror, 6, 6), np.nan)
    chi2 = np.full(n_mirror, np.nan)
    n_iteration = np.zeros(n_mirror, np.int64)
    _kernels.solve_many(
        transmitter,
        places,
        np.nan_to_num(z),
        weight,
        bias_info,
        classes,
        prior,
        pivot_info,
        known.roll_sigma_rad**-2 if known.two_axis else 0.0,
        own,
        tie,
        clock.copy(),
        _MAX_ITERATION,
        _FLOOR,
        pivot,
        rot,
        clock,
        cov,
        chi2,
        n_iteration,
        status,
    )
    bad = status != RigidStatus.OK
    for array in (pivot, rot, clock, cov, chi2):
        array[bad] = np.nan
    return RigidPoses(
        pivot_enu_m=pivot,
        rot_enu_from_mirror=rot,
        clock_m=clock,
        cov=cov,
        chi2=chi2,
        dof=_dof(weight, bias_info, known, classes, n_class),
        n_iteration=n_iteration,
        status=status,
    )


def rigid_bound(
    transmitter_enu_m: npt.ArrayLike,
    receiver_mirror_m: npt.ArrayLike,
    pivot_enu_m: npt.ArrayLike,
    rot_enu_from_mirror: npt.ArrayLike,
    *,
    sigma_m: npt.ArrayLike,
    transmitter_sigma_m: npt.ArrayLike,
    clock_class: npt.ArrayLike,
    knowledge: Knowledge | None = None,
) -> FloatArray:
    """Cramér–Rao bound of rigid poses: covariance of pivot [m] and rotation [rad].

    Parameters
    ----------
    pivot_enu_m, rot_enu_from_mirror : (mirror, xyz), (mirror, 3, 3)
        True poses.
    sigma_m : (mirror, group, receiver, transmitter)
        NaN or infinity = not received.
    transmitter_enu_m, receiver_mirror_m, transmitter_sigma_m, clock_class, knowledge
        As in `solve_rigid`.

    Returns
    -------
    (mirror, 6, 6)
        NaN where the pose is not determined. `tilt_sigma_rad` makes the normal's rms angle of it.
    """
    full = full_covariance(
        transmitter_enu_m,
        receiver_mirror_m,
        pivot_enu_m,
        rot_enu_from_mirror,
        sigma_m=sigma_m,
        transmitter_sigma_m=transmitter_sigma_m,
        clock_class=clock_class,
        knowledge=knowledge,
    )
    return full[:, :6, :6]


def full_covariance(
    transmitter_enu_m: npt.ArrayLike,
    receiver_mirror_m: npt.ArrayLike,
    pivot_enu_m: npt.ArrayLike,
    rot_enu_from_mirror: npt.ArrayLike,
    *,
    sigma_m: npt.ArrayLike,
    transmitter_sigma_m: npt.ArrayLike,
    clock_class: npt.ArrayLike,
    knowledge: Knowledge | None = None,
) -> FloatArray:
    """Return the covariance of pivot [m], rotation [rad] and every clock [m], at the given poses.

    Parameters
    ----------
    transmitter_enu_m, receiver_mirror_m, pivot_enu_m, rot_enu_from_mirror, sigma_m, transmitter_sigma_m, clock_class
        As in `rigid_bound`.
    knowledge
        As in `solve_rigid`.

    Returns
    -------
    (mirror, unknown, unknown)
        Order: pivot, rotation, then clocks by class and receiver. NaN where the pose is not determined.
    """
    known = knowledge or Knowledge()
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    sigma = as_float_array("sigma_m", sigma_m, ("mirror", "group", "receiver", "transmitter"), finite=False)
    n_mirror, n_group, n_receiver, n_transmitter = sigma.shape
    places = spread_places(receiver_mirror_m, n_mirror, n_receiver)
    weight = weights(np.where(np.isfinite(sigma), 0.0, np.nan), np.where(np.isfinite(sigma), sigma, 1.0))
    classes = np.asarray(clock_class, np.int64)
    n_class = int(classes.max()) + 1
    bias_info = bias_information(transmitter_sigma_m, (n_mirror, n_group, n_transmitter))
    _, pivot_info = pivot_prior(known, n_mirror)
    n_unknown = 6 + n_class * n_receiver
    cov = np.full((n_mirror, n_unknown, n_unknown), np.nan)
    own, tie = clock_ties(known.clock_sigma_m, weight, bias_info, classes, n_class)
    _kernels.covariance_many(
        transmitter,
        places,
        weight,
        bias_info,
        classes,
        pivot_info,
        known.roll_sigma_rad**-2 if known.two_axis else 0.0,
        own,
        tie,
        _FLOOR,
        np.array(np.broadcast_to(np.asarray(pivot_enu_m, np.float64), (n_mirror, 3))),
        np.array(np.broadcast_to(np.asarray(rot_enu_from_mirror, np.float64), (n_mirror, 3, 3))),
        cov,
    )
    return cov


def _dof(
    weight: FloatArray, bias_info: FloatArray, known: Knowledge, classes: npt.NDArray[np.int64], n_class: int
) -> FloatArray:
    """Measurements and priors less unknowns (mirror,)."""
    seen = weight > 0.0
    n = seen.sum(axis=(1, 2, 3)).astype(np.float64) - 6.0
    n -= (np.any(seen, axis=2) & (bias_info == 0.0)).sum(axis=(1, 2))
    for k in range(n_class):
        clocks = np.any(seen[:, classes == k], axis=(1, 3)).sum(axis=1)
        free = np.minimum(clocks, 1) if np.isfinite(known.clock_sigma_m) else clocks
        # without calibration a common clock is the transmitters' as well, and counted with them
        calibrated = np.any(bias_info[:, classes == k] > 0.0, axis=(1, 2))
        n -= np.where(calibrated, free, np.maximum(free - 1, 0))
    n += 3.0 * (known.pivot_enu_m is not None and np.isfinite(known.pivot_sigma_m)) + float(known.two_axis)
    return np.asarray(n)
