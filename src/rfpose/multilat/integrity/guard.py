"""What all estimators' tests share: test, leave out the likeliest culprit, test again, bound what is hidden."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError
from rfpose.multilat.equations import MirrorArrays
from rfpose.multilat.integrity.hypotheses import (
    Verdict,
    largest_eigenvalue,
    limit,
    log_probability,
    noncentrality,
    quiet_median,
    tilt_quantile,
    widened,
)
from rfpose.multilat.rigid import RigidPoses
from rfpose.multilat.rigid.problem import PRIORS
from rfpose.multilat.status import PoseStatus

__all__ = ["Alarms", "Guard", "GuardedPoses", "IntegrityStatus", "TransmitterStatus"]

BoolArray = npt.NDArray[np.bool_]
StatusArray = npt.NDArray[np.int8]
IntArray = npt.NDArray[np.int64]

# Reported noise this many times the usual is called interference.
NOISY = 3.0
# Sigmas from which a receiver's residual of what was left out counts for the pattern of the error.
CLEAR = 10.0


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


class Guard(ABC):
    """The loop over all mirrors; an estimator says how it tests (`judge`) and how it leaves out (`leave_out`).

    Hypotheses are numbered: whole transmitters first, then `PRIORS`.

    Parameters
    ----------
    poses
        Solved with all there is.
    mirrors
        What they were solved with.
    alarms
    n_test
        How many single tests share the false alarms.
    """

    def __init__(self, poses: RigidPoses, mirrors: MirrorArrays, alarms: Alarms, n_test: int) -> None:
        n_mirror, _, _, self.n_transmitter = mirrors.z.shape
        self.mirrors = mirrors
        self.poses: dict[str, npt.NDArray[Any]] = {f.name: np.array(getattr(poses, f.name)) for f in fields(poses)}
        self.weight = mirrors.weight.copy()
        self.dropped = np.zeros((n_mirror, len(PRIORS)), np.bool_)
        self.max_excluded, self.missed = alarms.max_excluded, alarms.missed_detection
        self.global_alarm = alarms.false_alarm / 2.0
        self.single_alarm = alarms.false_alarm / 2.0 / n_test
        self.status = np.full(n_mirror, IntegrityStatus.NOT_SOLVED, np.int8)
        self.status[poses.status == PoseStatus.OK] = IntegrityStatus.OK
        self.transmitter_status = np.zeros((n_mirror, self.n_transmitter), np.int8)
        self.transmitter_status[~np.any(self.weight > 0.0, axis=(1, 2))] = TransmitterStatus.NOT_RECEIVED
        self.testable = np.zeros((n_mirror, len(PRIORS)), np.bool_)
        self.probability = np.full(n_mirror, np.nan)
        self.own_level = np.full(n_mirror, np.inf)
        self.worst = np.full(n_mirror, -1, np.int64)

    # -- what estimators differ in

    @abstractmethod
    def judge(self, rows: IntArray) -> Verdict:
        """Test every hypothesis about some mirrors."""

    @abstractmethod
    def leave_out(self, rows: IntArray, verdict: Verdict, single: FloatArray) -> IntArray:
        """Leave out each failing mirror's likeliest culprit; return the mirrors to be tested again."""

    def other_level(self) -> FloatArray:
        """(mirror,) protection level against an error found having another cause; NaN where none is likely."""
        return np.full(len(self.status), np.nan)

    # -- the loop

    def run(self) -> None:
        """Test; leave out; solve again; until all is consistent or nothing helps."""
        rows = np.flatnonzero(self.status != IntegrityStatus.NOT_SOLVED)
        for step in range(self.max_excluded + 1):
            bad, verdict, single = self._test(rows)
            if step < self.max_excluded:
                rows = self.leave_out(rows[bad], verdict, single)

    def alarm(
        self, verdict: Verdict, chi2: npt.NDArray[Any], dof: npt.NDArray[Any]
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Whether anything is wrong; log-probabilities of all hypotheses; of chi²."""
        overall = log_probability(chi2, np.rint(dof).astype(np.int64))
        single = log_probability(verdict.stat, verdict.dof)
        links = log_probability(verdict.link, verdict.link_dof)
        alarm = overall < np.log(self.global_alarm)
        alarm |= (single < np.log(self.single_alarm)).any(axis=1)
        alarm |= (links < np.log(self.single_alarm)).any(axis=(1, 2))
        return np.asarray(alarm), single, overall

    def _test(self, rows: IntArray) -> tuple[IntArray, Verdict, FloatArray]:
        """Test mirrors and note what comes out; return which fail, and their statistics."""
        verdict = self.judge(rows)
        alarm, single, overall = self.alarm(verdict, self.poses["chi2"][rows], self.poses["dof"][rows])
        self.probability[rows] = np.exp(overall)
        self.testable[rows] |= verdict.dof[:, self.n_transmitter :] > 0
        self.protect(rows, verdict)
        bad = np.flatnonzero(alarm)
        self.status[rows[bad]] = IntegrityStatus.UNEXPLAINED
        return bad, verdict.take(bad), single[bad]

    def without(self, rows: IntArray, hypothesis: int) -> tuple[FloatArray, BoolArray]:
        """Weights and dropped priors of some mirrors if a hypothesis were left out."""
        weight, dropped = self.weight[rows], self.dropped[rows]
        if hypothesis < self.n_transmitter:
            weight[..., hypothesis] = 0.0
        else:
            dropped[:, hypothesis - self.n_transmitter] = True
        return weight, dropped

    def accept(
        self, rows: IntArray, weight: FloatArray, dropped: BoolArray, poses: dict[str, npt.NDArray[Any]]
    ) -> None:
        """Take poses for those of some mirrors, with what they were solved with."""
        self.weight[rows], self.dropped[rows] = weight, dropped
        for name, array in poses.items():
            self.poses[name][rows] = array

    def mark(self, rows: IntArray) -> None:
        """Status of mirrors from which something was left out."""
        left = self.dropped[rows].any(axis=1)
        self.status[rows] = np.where(left, IntegrityStatus.PRIOR_REJECTED, IntegrityStatus.EXCLUDED)

    # -- what was wrong

    def pattern(
        self, rows: IntArray, who: IntArray, predicted: FloatArray, *, alike: float
    ) -> tuple[IntArray, IntArray]:
        """Name each mirror's pattern of errors, seen from a pose without them; the receiver if it is only one, else −1.

        Parameters
        ----------
        rows, who : (mirror,)
            Mirrors, and the transmitter of each that was left out.
        predicted : (mirror, group, receiver)
            Its ranges by the pose [m].
        alike
            Residuals that differ by less, relative to the largest, are called common.
        """
        mirrors = self.mirrors
        left = mirrors.z[rows, :, :, who] - predicted - self.poses["clock_m"][rows][:, mirrors.clock_class]
        own = mirrors.weight[rows, :, :, who]
        with np.errstate(divide="ignore"):
            sigma = mirrors.bias_info[rows, :, who][..., None] ** -0.5
        free = np.isinf(sigma)
        middle = quiet_median(np.where(own > 0.0, left, np.nan))[..., None]
        # without calibration nothing that all receivers have in common is an error
        left = np.where(free, left - middle, left)
        size = np.where(own > 0.0, np.abs(left), 0.0)
        with np.errstate(divide="ignore"):
            small = CLEAR * np.where(free, own**-0.5, np.hypot(own**-0.5, sigma))
        clear = np.any(size > small, axis=1)
        apart = np.max(np.where(own > 0.0, np.abs(left - middle), 0.0), axis=(1, 2))
        common = np.all(clear, axis=1) & (apart < alike * size.max(axis=(1, 2)))
        one = clear.sum(axis=1) == 1
        cause = np.where(common, TransmitterStatus.COMMON_ERROR, TransmitterStatus.MULTIPATH)
        return np.where(one, TransmitterStatus.ONE_RECEIVER, cause), np.where(one, np.argmax(clear, axis=1), -1)

    def noisy(self, rows: IntArray, who: IntArray) -> BoolArray:
        """Whether a transmitter's reported noise is far above that of the mirror's others."""
        with np.errstate(divide="ignore"):
            sigma = np.where(self.weight[rows] > 0.0, self.weight[rows] ** -0.5, np.nan)
        usual = quiet_median(sigma.reshape(*sigma.shape[:2], -1))
        own = sigma[np.arange(len(rows)), :, :, who]
        return np.asarray((own > NOISY * usual[:, :, None]).any(axis=(1, 2)))

    # -- protection

    def protect(self, rows: IntArray, verdict: Verdict) -> None:
        """Protection level against one more faulty transmitter."""
        dof = verdict.dof[:, : self.n_transmitter]
        spread = np.sqrt(np.maximum(largest_eigenvalue(verdict.spread_rad2[:, : self.n_transmitter]), 0.0))
        hidden_bias = np.sqrt(noncentrality(limit(self.single_alarm, dof), dof, self.missed))
        with np.errstate(invalid="ignore"):
            bias = np.where(dof > 0, hidden_bias * spread, 0.0)
        bias[verdict.hidden[:, : self.n_transmitter]] = np.inf
        noise = tilt_quantile(self.missed) * np.sqrt(largest_eigenvalue(verdict.cov_rad2))
        self.own_level[rows] = np.where(verdict.ok, bias.max(axis=1) + noise, np.inf)
        self.worst[rows] = np.argmax(bias, axis=1)

    def n_left_out(self, rows: IntArray) -> IntArray:
        """How many transmitters and priors were left out of some mirrors."""
        left_out = self.transmitter_status[rows] > TransmitterStatus.NOT_RECEIVED
        return np.asarray(left_out.sum(axis=1) + self.dropped[rows].sum(axis=1))

    def result(self) -> GuardedPoses:
        """Put everything together."""
        others = self.other_level()
        level = np.fmax(self.own_level, others)
        ambiguous = others > self.own_level
        explained = np.isin(self.status, (IntegrityStatus.EXCLUDED, IntegrityStatus.PRIOR_REJECTED))
        self.status[ambiguous & explained] = IntegrityStatus.AMBIGUOUS
        unprotected = np.isin(self.status, (IntegrityStatus.UNEXPLAINED, IntegrityStatus.NOT_SOLVED))
        level[unprotected | ~np.isfinite(level)] = np.inf
        self.status[np.isinf(level) & ~unprotected] = IntegrityStatus.NO_REDUNDANCY
        poses = RigidPoses(**{name: read_only(array) for name, array in self.poses.items()})
        left_out: BoolArray = np.asarray(self.n_left_out(np.arange(len(level))) > 0)
        return GuardedPoses(
            poses=widened(poses, left_out, level, self.missed),
            status=read_only(self.status),
            transmitter_status=read_only(self.transmitter_status),
            used=read_only(np.asarray((self.weight > 0.0).any(axis=1))),
            prior_rejected=read_only(self.dropped),
            prior_testable=read_only(self.testable),
            chi2_probability=read_only(self.probability),
            protection_level_rad=read_only(level),
            worst_transmitter=read_only(np.where(ambiguous | unprotected, -1, self.worst)),
        )
