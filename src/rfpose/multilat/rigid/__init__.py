"""Poses of rigid mirrors from all phases of their receivers at once.

To be read in this order: what is measured and known (`problem`), what of it weighs how much (`weights`), the fit
(`pose`) and what it finds (`records`); whole wavelengths, one after the other, of a part of the problem (`parts`,
`integers`), and together where rounding is not safe (`search`); where to begin (`start`). `places` and `delays` are
learned over postures and frames.
"""

from rfpose.multilat.rigid.parts import part_of
from rfpose.multilat.rigid.places import ReceiverPlaces, places_bound, refine_places
from rfpose.multilat.rigid.pose import full_covariance, rigid_bound, solve_rigid
from rfpose.multilat.rigid.problem import PRIORS, MirrorKnowledge, MirrorProblem, Observation
from rfpose.multilat.rigid.records import RigidPoses, tilt_sigma_rad

__all__ = [
    "PRIORS",
    "MirrorKnowledge",
    "MirrorProblem",
    "Observation",
    "ReceiverPlaces",
    "RigidPoses",
    "full_covariance",
    "part_of",
    "places_bound",
    "refine_places",
    "rigid_bound",
    "solve_rigid",
    "tilt_sigma_rad",
]
