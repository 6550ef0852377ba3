"""Poses of mirrors as a whole: integers resolved, started again where they fail, guarded, doubted where due."""

from rfpose.multilat.estimation.direct import PoseEstimates, protected, solve_direct
from rfpose.multilat.estimation.two_ray import ReflectionModel, solve_two_ray

__all__ = ["PoseEstimates", "ReflectionModel", "protected", "solve_direct", "solve_two_ray"]
