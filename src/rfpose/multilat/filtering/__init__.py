"""Poses of moving mirrors over frames."""

from rfpose.multilat.filtering.poses import (
    Contradiction,
    FilteredPoses,
    FilterSettings,
    FilterState,
    FilterStatus,
    filter_poses,
)

__all__ = ["Contradiction", "FilterSettings", "FilterState", "FilterStatus", "FilteredPoses", "filter_poses"]
