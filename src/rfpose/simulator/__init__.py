"""Synthetic recordings, from a time-domain sum of rays."""

from rfpose.simulator._draws import RecordingDraws
from rfpose.simulator.simulator import Chunk, Simulator

__all__ = ["Chunk", "RecordingDraws", "Simulator"]
