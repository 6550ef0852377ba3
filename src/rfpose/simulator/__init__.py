"""Synthetic recordings, from a time-domain sum of rays."""

from rfpose.simulator._draws import Draws
from rfpose.simulator.simulator import Chunk, Simulator

__all__ = ["Chunk", "Draws", "Simulator"]
