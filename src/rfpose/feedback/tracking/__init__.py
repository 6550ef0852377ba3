"""The whole field, tracked in simulation: every way of steering mirrors on the same sun, wind, and hidden errors."""

from rfpose.feedback.tracking.methods import METHODS, Method
from rfpose.feedback.tracking.score import Score, score
from rfpose.feedback.tracking.simulation import Portion, TrackingSimulation

__all__ = ["METHODS", "Method", "Portion", "Score", "TrackingSimulation", "score"]
