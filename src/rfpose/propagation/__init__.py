"""What a radio wave does between a transmitter and a receiver on a mirror: rays foreseen from the site's geometry."""

from rfpose.propagation.rays import FIELD_DECAYS_AT_M, RayKind, Rays

__all__ = ["FIELD_DECAYS_AT_M", "RayKind", "Rays"]
