"""Range differences to receiver positions, and those to mirror normals."""

from rfpose.multilat.bounds import dop, normal_bound, position_bound, tilt_rms_from_position
from rfpose.multilat.filtering import FilteredPoses, FilterSettings, FilterStatus, filter_poses
from rfpose.multilat.fix import Fixes, FixStatus, locate
from rfpose.multilat.normal import Normals, Poses, joint_covariance, mirror_normal, solve_poses
from rfpose.multilat.ranges import RangeDifferences, RangeStatus, range_differences
from rfpose.multilat.status import PoseStatus
from rfpose.multilat.transmitters import check_unambiguous

__all__ = [
    "FilterSettings",
    "FilterStatus",
    "FilteredPoses",
    "FixStatus",
    "Fixes",
    "Normals",
    "PoseStatus",
    "Poses",
    "RangeDifferences",
    "RangeStatus",
    "check_unambiguous",
    "dop",
    "filter_poses",
    "joint_covariance",
    "locate",
    "mirror_normal",
    "normal_bound",
    "position_bound",
    "range_differences",
    "solve_poses",
    "tilt_rms_from_position",
]
