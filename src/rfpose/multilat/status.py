"""What became of a mirror's pose: one list and one table of reasons for all solvers, from the kernels to the file."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

__all__ = ["PoseStatus", "has_start"]


class PoseStatus(IntEnum):
    """What became of one mirror; ``reason`` says it in words. The numbers stand in result files."""

    OK = 0
    TOO_FEW = 1
    COLLINEAR = 2
    RESIDUAL = 3
    UNDETERMINED = 4
    NOT_CONVERGED = 5
    UNEXPLAINED = 6
    BEHIND_REFLECTOR = 7
    UNKNOWNS = 8
    UNCERTAIN = 9
    AMBIGUOUS = 10
    NO_POSTURE = 11

    @property
    def reason(self) -> str:
        """The status in words."""
        return _REASON[self]


_REASON = {
    PoseStatus.OK: "solved",
    PoseStatus.TOO_FEW: "fewer than three receivers of the mirror were located",
    PoseStatus.COLLINEAR: "the located receivers lie on one line",
    PoseStatus.RESIDUAL: "solved, but a receiver's residuals are far above what the sigma of the ranges allows",
    PoseStatus.UNDETERMINED: "the measurements leave part of the pose open; more transmitters or a surveyed pivot help",
    PoseStatus.NOT_CONVERGED: "the pose did not converge",
    PoseStatus.UNEXPLAINED: "solved, but residuals are larger than noise and a few bad transmitters explain: "
    "a reflection that is not in the model?",
    PoseStatus.BEHIND_REFLECTOR: "a receiver lies behind a reflecting plane (below the ground)",
    PoseStatus.UNCERTAIN: "the normal is known to no better than 0.1 rad; a better signal, receivers farther apart or "
    "known delays would help",
    PoseStatus.AMBIGUOUS: "two poses fit alike, mirrored in the transmitters' plane; transmitters of unequal heights "
    "or a surveyed pivot would tell",
    PoseStatus.NO_POSTURE: "no commanded posture to begin from: give a [posture] table, or a posture file",
    PoseStatus.UNKNOWNS: "fewer measurements than unknowns: more transmitters received, a surveyed pivot, a mount or "
    "known delays would help",
}


def has_start(status: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """Whether a solver may go on, or begin again, from where each mirror stands: it is solved, or ended unsolved."""
    return np.isin(status, (PoseStatus.OK, PoseStatus.UNDETERMINED, PoseStatus.NOT_CONVERGED))
