"""What an estimator finds of mirrors, and what all estimators do with it."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.multilat.integrity import GuardedPoses, IntegrityStatus, TransmitterStatus
from rfpose.multilat.integrity.hypotheses import widened
from rfpose.multilat.normal import MAX_SIGMA_RAD
from rfpose.multilat.rigid import MirrorProblem, RigidPoses
from rfpose.multilat.status import PoseStatus

__all__ = [
    "RESIDUAL_PROBABILITY",
    "PoseEstimates",
    "are_doubted",
    "joined",
    "protected",
    "put_rows",
    "residual_probability",
    "without_vague",
]

RESIDUAL_PROBABILITY = 1e-9
"""A pose whose residuals are rarer than this under the reported noise is marked."""

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseEstimates:
    """Poses of mirrors, and how they came about; None where an estimator does not look for it.

    Attributes
    ----------
    poses
    status : (mirror,)
        `PoseStatus`.
    fixed, wrong_risk, method : (mirror, group)
        As in `rfpose.multilat.rigid.integers.RigidSolution`.
    problem
        As solved in the end: integers resolved, NaN where left out.
    full_cov : (mirror, unknown, unknown)
        Of pose and clocks, where it is more than that of ``problem`` alone.
    guard
        The tests.
    probability_all : (mirror,)
        Probability of the residuals with nothing left out.
    coefficient, coefficient_sigma : (mirror, reflector), (mirror, reflector, 2)
        Of what reflects.
    probability_direct : (mirror,)
        Of the residuals with the direct ray alone.
    """

    poses: RigidPoses
    status: IntArray
    fixed: BoolArray
    wrong_risk: FloatArray
    method: IntArray
    problem: MirrorProblem
    full_cov: FloatArray | None = None
    guard: GuardedPoses | None = None
    probability_all: FloatArray | None = None
    coefficient: npt.NDArray[np.complex128] | None = None
    coefficient_sigma: FloatArray | None = None
    probability_direct: FloatArray | None = None


def residual_probability(poses: RigidPoses) -> FloatArray:
    """Return the probability of residuals as large as these or larger."""
    from scipy.special import chdtrc

    with np.errstate(invalid="ignore"):
        return np.asarray(chdtrc(np.maximum(poses.dof, 1.0), poses.chi2))


def protected(found: PoseEstimates, missed: float) -> PoseEstimates:
    """Let covariances say what protection levels do, where something was left out; ``missed`` is theirs."""
    guard = found.guard
    if guard is None:
        return found
    return replace(found, poses=widened(found.poses, _left_out(guard), guard.protection_level_rad, missed))


def _left_out(guard: GuardedPoses) -> BoolArray:
    """(mirror,) whether any transmitter or prior was."""
    excluded = (guard.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1)
    return np.asarray(excluded | guard.prior_rejected.any(axis=1))


def without_vague(found: PoseEstimates) -> PoseEstimates:
    """Mark poses that tell less of the normal than would make them solved."""
    vague = ~(found.poses.tilt_sigma_rad <= MAX_SIGMA_RAD)
    return replace(found, status=np.where((found.status == PoseStatus.OK) & vague, PoseStatus.UNCERTAIN, found.status))


def are_doubted(guard: GuardedPoses) -> BoolArray:
    """(mirror,) not explained, or explained by leaving out so much that nothing confirms it."""
    unconfirmed = _left_out(guard) & (guard.status == IntegrityStatus.NO_REDUNDANCY)
    return np.asarray((guard.status == IntegrityStatus.UNEXPLAINED) | unconfirmed)


def put_rows(first: PoseEstimates, rows: IntArray, second: PoseEstimates, those: IntArray) -> PoseEstimates:
    """Return poses with some mirrors' replaced by those of another solution."""
    return cast("PoseEstimates", _put(first, rows, second, those))


def _put(first: Any, rows: IntArray, second: Any, those: IntArray) -> Any:
    if first is None:
        return None
    if isinstance(first, MirrorProblem):
        return replace(first, range_m=_put(first.range_m, rows, second.range_m, those))
    if is_dataclass(first) and not isinstance(first, type):
        values = {f.name: _put(getattr(first, f.name), rows, getattr(second, f.name), those) for f in fields(first)}
        return replace(first, **values)
    out = np.array(first)
    out[rows] = second[those]
    return out


def joined(first: GuardedPoses, second: GuardedPoses) -> GuardedPoses:
    """Join the tests before and after a change of what is used: what the first left out, the second does not see."""
    cause = np.where(
        second.transmitter_status > TransmitterStatus.NOT_RECEIVED, second.transmitter_status, first.transmitter_status
    )
    status = second.status.copy()
    level = second.protection_level_rad.copy()
    quiet = np.isin(second.status, (IntegrityStatus.OK, IntegrityStatus.EXCLUDED))
    excluded = (cause > TransmitterStatus.NOT_RECEIVED).any(axis=1)
    status[quiet & excluded] = IntegrityStatus.EXCLUDED
    # which of several causes an error had is not known better afterwards
    ambiguous = quiet & (first.status == IntegrityStatus.AMBIGUOUS)
    status[ambiguous] = IntegrityStatus.AMBIGUOUS
    level[ambiguous] = np.fmax(level, first.protection_level_rad)[ambiguous]
    lost = quiet & (first.status == IntegrityStatus.UNEXPLAINED)
    status[lost] = IntegrityStatus.UNEXPLAINED
    level[lost] = np.inf
    return replace(
        second,
        status=read_only(status),
        transmitter_status=read_only(cause),
        protection_level_rad=read_only(level),
        prior_testable=read_only(first.prior_testable | second.prior_testable),
        chi2_probability=second.chi2_probability,
    )
