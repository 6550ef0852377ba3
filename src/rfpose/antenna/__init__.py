"""What an antenna on a mirror makes of a wave: tables of its response, looked up with their slope, and learned."""

from rfpose.antenna.currents import MirrorType
from rfpose.antenna.learn import LearnedPattern, PostureCarriers, learn_pattern
from rfpose.antenna.pattern import AntennaPattern, dipole_pattern
from rfpose.antenna.sphere import cartesian, components, grid_directions
from rfpose.antenna.table import PatternTable

__all__ = [
    "AntennaPattern",
    "LearnedPattern",
    "MirrorType",
    "PatternTable",
    "PostureCarriers",
    "cartesian",
    "components",
    "dipole_pattern",
    "grid_directions",
    "learn_pattern",
]
