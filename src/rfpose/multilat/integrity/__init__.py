"""Outliers found and left out, and what could still be wrong unnoticed."""

from rfpose.multilat.integrity.exclusion import (
    GuardedPoses,
    IntegrityStatus,
    TransmitterStatus,
    solve_with_integrity,
)

__all__ = ["GuardedPoses", "IntegrityStatus", "TransmitterStatus", "solve_with_integrity"]
