"""Synthetic recordings, from a time-domain sum of rays."""

from rfpose.simulate._draws import Draws
from rfpose.simulate.simulator import Chunk, Simulator

__all__ = ["Chunk", "Draws", "Simulator"]
