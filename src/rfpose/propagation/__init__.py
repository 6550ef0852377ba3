"""What a radio wave does between a transmitter and a receiver on a mirror: rays foreseen from the site's geometry."""

from rfpose.propagation.foresight import Foresight, foresee
from rfpose.propagation.rays import RayKind, Rays
from rfpose.propagation.surroundings import BoxesStanding, PlatesStanding, ReceiverStand, Soil, Surroundings, bystanders

__all__ = [
    "BoxesStanding",
    "Foresight",
    "PlatesStanding",
    "RayKind",
    "Rays",
    "ReceiverStand",
    "Soil",
    "Surroundings",
    "bystanders",
    "foresee",
]
