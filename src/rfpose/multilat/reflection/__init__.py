"""What planes that reflect add to ranges."""

from rfpose.multilat.reflection._kernels import SharedGeometry, shifts_at_points
from rfpose.multilat.reflection.direct import direct_rays

__all__ = ["SharedGeometry", "direct_rays", "shifts_at_points"]
