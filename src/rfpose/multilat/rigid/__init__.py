"""Poses of rigid mirrors from all phases of their receivers at once."""

from rfpose.multilat.rigid.pose import (
    Knowledge,
    RigidPoses,
    RigidStatus,
    full_covariance,
    rigid_bound,
    solve_rigid,
    tilt_sigma_rad,
)

__all__ = [
    "Knowledge",
    "RigidPoses",
    "RigidStatus",
    "full_covariance",
    "rigid_bound",
    "solve_rigid",
    "tilt_sigma_rad",
]
