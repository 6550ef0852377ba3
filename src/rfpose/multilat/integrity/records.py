"""What tests of residuals are told, and what they say."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.multilat.rigid.problem import PRIORS
from rfpose.multilat.rigid.records import RigidPoses

__all__ = ["Alarms", "GuardedPoses", "IntegrityStatus", "TransmitterStatus", "Verdict"]

BoolArray = npt.NDArray[np.bool_]
StatusArray = npt.NDArray[np.int8]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarms:
    """When tests of residuals speak up.

    Attributes
    ----------
    false_alarm
        Probability that a mirror without any error is not found OK. Half of it goes to chi² of all residuals, half
        is shared by the single tests.
    missed_detection
        Probability of the protection level.
    max_excluded
        Transmitters and priors to leave out of one mirror, at most; 0 only tests.

    Raises
    ------
    InvalidInputError
        A probability outside (0, 1), a negative ``max_excluded``.
    """

    false_alarm: float = 1e-2
    missed_detection: float = 1e-3
    max_excluded: int = 4

    def __post_init__(self) -> None:
        for name in ("false_alarm", "missed_detection"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"`{name}` must lie between 0 and 1, got {getattr(self, name)}")
        if self.max_excluded < 0:
            raise InvalidInputError(f"`max_excluded` must not be negative, got {self.max_excluded}")


class IntegrityStatus(IntEnum):
    """What the tests say of one mirror; ``reason`` says it in words."""

    OK = 0
    EXCLUDED = 1
    PRIOR_REJECTED = 2
    AMBIGUOUS = 3
    NO_REDUNDANCY = 4
    UNEXPLAINED = 5
    NOT_SOLVED = 6

    @property
    def reason(self) -> str:
        """The status in words."""
        return _REASON[self]


_REASON = {
    IntegrityStatus.OK: "consistent",
    IntegrityStatus.EXCLUDED: "consistent after transmitters were left out",
    IntegrityStatus.PRIOR_REJECTED: "consistent after something known beforehand was left out: it contradicts the data",
    IntegrityStatus.AMBIGUOUS: "an error was found, but which of several causes it has cannot be told; the protection "
    "level covers them all",
    IntegrityStatus.NO_REDUNDANCY: "an error of some transmitter could tilt the normal without trace; more "
    "transmitters, a calibration or a surveyed pivot would help",
    IntegrityStatus.UNEXPLAINED: "residuals that leaving out a few transmitters or priors does not explain",
    IntegrityStatus.NOT_SOLVED: "no pose",
}


class TransmitterStatus(IntEnum):
    """What the tests say of one transmitter at one mirror; all from 2 on were left out."""

    OK = 0
    NOT_RECEIVED = 1
    COMMON_ERROR = 2
    ONE_RECEIVER = 3
    MULTIPATH = 4
    INTERFERENCE = 5

    @property
    def reason(self) -> str:
        """The status in words."""
        return (
            "used",
            "not received",
            "the same error at all receivers of the mirror: transmitter or its calibration off, or path blocked",
            "an error at one receiver only: blocked or reflected on the way there",
            "errors that differ between receivers: reflections",
            "noise far above the others' and an error beyond it: interference",
        )[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardedPoses:
    """Rigid poses with what the tests say of them; arrays are read-only.

    Attributes
    ----------
    poses
        After all exclusions; where there were any, the covariance is as wide as the protection level (`widened`). A
        pose whose ``status`` here is UNEXPLAINED keeps its numbers; they are not to be trusted.
    status : (mirror,)
        `IntegrityStatus` as int8.
    transmitter_status : (mirror, transmitter)
        `TransmitterStatus` as int8.
    used : (mirror, receiver, transmitter)
        Which were used in the end.
    prior_rejected : (mirror, prior)
        Which of `rfpose.multilat.rigid.problem.PRIORS` (pivot, mount, clocks) contradicts the data and was left out.
    prior_testable : (mirror, prior)
        Whether the data could contradict it at all.
    chi2_probability : (mirror,)
        Probability of larger residuals than those left, if nothing is wrong.
    protection_level_rad : (mirror,)
        With any one transmitter wrong by whatever amount, the normal is off by more than this, unnoticed, no more
        often than the missed-detection probability [rad, of the normal]; infinite where nothing protects it.
    worst_transmitter : (mirror,)
        The one that sets it; −1: another explanation of an error found, or no pose.
    """

    poses: RigidPoses
    status: StatusArray
    transmitter_status: StatusArray
    used: BoolArray
    prior_rejected: BoolArray
    prior_testable: BoolArray
    chi2_probability: FloatArray
    protection_level_rad: FloatArray
    worst_transmitter: IntArray

    @property
    def ok(self) -> BoolArray:
        """(mirror,) True where all that is left is consistent and the protection level finite."""
        return np.asarray(np.isfinite(self.protection_level_rad))

    def reasons(self) -> tuple[str, ...]:
        """Each mirror's status in words, with transmitters and priors by name."""
        return tuple(self._reason(m) for m in range(len(self.status)))

    def _reason(self, m: int) -> str:
        parts = [IntegrityStatus(self.status[m]).reason]
        for i in np.flatnonzero(self.transmitter_status[m] > TransmitterStatus.NOT_RECEIVED):
            parts.append(f"transmitter {i}: {TransmitterStatus(self.transmitter_status[m, i]).reason}")
        parts += [f"prior rejected: {name}" for name, no in zip(PRIORS, self.prior_rejected[m], strict=True) if no]
        return "; ".join(parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Statistics of all hypotheses: transmitters first, then `PRIORS`.

    Attributes
    ----------
    ok : (mirror,)
        Whether the pose was determined at all; False: the rest is 0.
    stat, dof : (mirror, hypothesis)
        Drop of chi², and degrees of freedom; 0 = cannot be tested.
    hidden : (mirror, hypothesis)
        Part of the fault leaves no trace in the residuals, yet tilts the normal.
    shift_rad : (mirror, hypothesis, 2)
        What the fault, as estimated, did to the normal: rotation about the mirror's x and y axes.
    spread_rad2 : (mirror, hypothesis, 2, 2)
        What leaving it free adds to the covariance of that rotation.
    cov_rad2 : (mirror, 2, 2)
        Covariance of that rotation, nothing left free.
    common, common_dof : (mirror, transmitter)
        The same for an error common to all receivers.
    link, link_dof : (mirror, receiver, transmitter)
        The same for an error at one receiver.
    """

    ok: BoolArray
    stat: FloatArray
    dof: IntArray
    hidden: BoolArray
    shift_rad: FloatArray
    spread_rad2: FloatArray
    cov_rad2: FloatArray
    common: FloatArray
    common_dof: IntArray
    link: FloatArray
    link_dof: IntArray

    def take(self, rows: IntArray) -> Verdict:
        """Select mirrors."""
        return Verdict(**{f.name: getattr(self, f.name)[rows] for f in fields(Verdict)})
