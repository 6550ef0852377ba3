"""What the stages before found, what an estimator finds of one group of mirrors, and small things both need."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc

from rfpose.checks import FloatArray, read_only
from rfpose.dsp import Calibration, TonePhases
from rfpose.multilat import PoseStatus, RangeDifferences
from rfpose.multilat.integrity import GuardedPoses, IntegrityStatus, TransmitterStatus
from rfpose.multilat.integrity.hypotheses import widened
from rfpose.multilat.normal import MAX_SIGMA_RAD
from rfpose.multilat.rigid import Knowledge, RigidPoses, RigidStatus
from rfpose.multilat.rigid.integers import Observation
from rfpose.pipeline.choice import PoseChoice
from rfpose.pipeline.result import FixTable
from rfpose.scenario import Scenario

RESIDUAL_PROBABILITY = 1e-9
"""A pose whose residuals are rarer than this under the reported noise is marked."""

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
_STATUS = {
    RigidStatus.OK: PoseStatus.OK,
    RigidStatus.SINGULAR: PoseStatus.UNDETERMINED,
    RigidStatus.NOT_CONVERGED: PoseStatus.NOT_CONVERGED,
    RigidStatus.NO_START: PoseStatus.TOO_FEW,
    RigidStatus.TOO_FEW: PoseStatus.UNKNOWNS,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Stages:
    """What the stages before found, and how to go on."""

    tones: TonePhases
    calibration: Calibration
    ranges: RangeDifferences
    fixes: FixTable
    scenario: Scenario
    choice: PoseChoice


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """Poses of one group; first axis frame × heliostat. ``status`` is `PoseStatus`."""

    poses: RigidPoses
    status: IntArray
    fixed: BoolArray
    wrong_risk: FloatArray
    method: IntArray
    ranges: list[Observation]
    """As used: integers resolved, NaN where left out."""
    known: Knowledge
    full_cov: FloatArray | None = None
    guard: GuardedPoses | None = None
    probability_all: FloatArray | None = None
    coefficient: npt.NDArray[np.complex128] | None = None
    coefficient_sigma: FloatArray | None = None
    probability_direct: FloatArray | None = None


def pose_status(status: IntArray) -> IntArray:
    """Return `PoseStatus` of `RigidStatus`."""
    return np.array([_STATUS[RigidStatus(s)] for s in status], np.int64)


def residual_probability(poses: RigidPoses) -> FloatArray:
    """Return the probability of residuals as large as these or larger."""
    with np.errstate(invalid="ignore"):
        return np.asarray(chdtrc(np.maximum(poses.dof, 1.0), poses.chi2))


def as_protected(found: Found, missed: float) -> Found:
    """Let covariances say what protection levels do, where something was left out; ``missed`` is theirs."""
    guard = found.guard
    if guard is None:
        return found
    return replace(found, poses=widened(found.poses, _left_out(guard), guard.protection_level_rad, missed))


def _left_out(guard: GuardedPoses) -> BoolArray:
    """(mirror,) whether any transmitter or prior was."""
    excluded = (guard.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1)
    return np.asarray(excluded | guard.prior_rejected.any(axis=1))


def without_vague(found: Found) -> Found:
    """Mark poses that tell less of the normal than would make them solved."""
    vague = ~(found.poses.tilt_sigma_rad <= MAX_SIGMA_RAD)
    return replace(found, status=np.where((found.status == PoseStatus.OK) & vague, PoseStatus.UNCERTAIN, found.status))


def are_doubted(guard: GuardedPoses) -> BoolArray:
    """(mirror,) not explained, or explained by leaving out so much that nothing confirms it."""
    unconfirmed = _left_out(guard) & (guard.status == IntegrityStatus.NO_REDUNDANCY)
    return np.asarray((guard.status == IntegrityStatus.UNEXPLAINED) | unconfirmed)


def keep_where(phases: list[Observation], used: BoolArray) -> list[Observation]:
    """Return the observations with NaN where they are not used."""
    return [replace(o, range_m=np.where(used, o.range_m, np.nan)) for o in phases]


def rows_of(phases: Observation, rows: IntArray) -> Observation:
    """Return the observations of some mirrors."""
    return replace(
        phases,
        range_m=phases.range_m[rows],
        sigma_m=phases.sigma_m[rows],
        transmitter_sigma_m=phases.transmitter_sigma_m[rows],
    )


def put_rows(first: Found, rows: IntArray, second: Found, those: IntArray) -> Found:
    """Return poses with some mirrors' replaced by those of another solution."""
    return cast("Found", _put(first, rows, second, those))


def _put(first: Any, rows: IntArray, second: Any, those: IntArray) -> Any:
    if first is None:
        return None
    if isinstance(first, list):
        return [_put(a, rows, b, those) for a, b in zip(first, second, strict=True)]
    if is_dataclass(first) and not isinstance(first, type):
        by_mirror = [f.name for f in fields(first) if f.name not in ("known", "wavelength_m", "clock_class")]
        values = {name: _put(getattr(first, name), rows, getattr(second, name), those) for name in by_mirror}
        return replace(first, **values)
    out = np.array(first)
    out[rows] = second[those]
    return out


def where_known(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the first where it is finite, else the second."""
    return np.where(np.isfinite(first), first, second)


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
