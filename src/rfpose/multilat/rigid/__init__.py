"""Poses of rigid mirrors from all phases of their receivers at once."""

from rfpose.multilat.rigid.places import ReceiverPlaces, places_bound, refine_places
from rfpose.multilat.rigid.pose import (
    MirrorKnowledge,
    MirrorProblem,
    Observation,
    RigidPoses,
    full_covariance,
    rigid_bound,
    solve_rigid,
    tilt_sigma_rad,
)

__all__ = [
    "MirrorKnowledge",
    "MirrorProblem",
    "Observation",
    "ReceiverPlaces",
    "RigidPoses",
    "full_covariance",
    "places_bound",
    "refine_places",
    "rigid_bound",
    "solve_rigid",
    "tilt_sigma_rad",
]
