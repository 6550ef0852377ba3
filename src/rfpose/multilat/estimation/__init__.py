"""Poses of mirrors as a whole: integers resolved, started again where they fail, guarded, doubted where due."""

from rfpose.multilat.estimation.direct import solve_direct
from rfpose.multilat.estimation.found import Found, protected, without_vague
from rfpose.multilat.estimation.two_ray import Reflections, solve_two_ray

__all__ = ["Found", "Reflections", "protected", "solve_direct", "solve_two_ray", "without_vague"]
