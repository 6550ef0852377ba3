"""Poses of rigid mirrors where ground or walls reflect."""

from rfpose.multilat.ground._problem import CalibrationSight
from rfpose.multilat.ground.bound import ground_bound
from rfpose.multilat.ground.guard import guard_with_ground
from rfpose.multilat.ground.model import LEVEL_GROUND, Reflector, Surface, fresnel_coefficient, range_shift_m
from rfpose.multilat.ground.solve import GroundSolution, solve_with_ground

__all__ = [
    "LEVEL_GROUND",
    "CalibrationSight",
    "GroundSolution",
    "Reflector",
    "Surface",
    "fresnel_coefficient",
    "ground_bound",
    "guard_with_ground",
    "range_shift_m",
    "solve_with_ground",
]
