"""Outliers found and left out, and what could still be wrong unnoticed."""

from rfpose.multilat.integrity.guard import solve_with_integrity
from rfpose.multilat.integrity.records import Alarms, GuardedPoses, IntegrityStatus, TransmitterStatus
from rfpose.multilat.integrity.robust import RobustFixes, locate_robust

__all__ = [
    "Alarms",
    "GuardedPoses",
    "IntegrityStatus",
    "RobustFixes",
    "TransmitterStatus",
    "locate_robust",
    "solve_with_integrity",
]
