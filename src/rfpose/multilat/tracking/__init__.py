"""Poses of moving mirrors over frames."""

from rfpose.multilat.tracking.poses import (
    Contradiction,
    Motion,
    TrackedPoses,
    TrackState,
    TrackStatus,
    track_poses,
)

__all__ = ["Contradiction", "Motion", "TrackState", "TrackStatus", "TrackedPoses", "track_poses"]
