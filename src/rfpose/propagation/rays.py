"""Rays as the fit of a pose takes them: where each seems to come from, and what field it brings."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray

__all__ = ["RayKind", "Rays"]

ComplexArray = npt.NDArray[np.complex128]


class RayKind(IntEnum):
    """What a ray met on its way; a ray that met several things is of the last kind in this list that it met."""

    DIRECT = 0
    GROUND = 1
    SPECULAR = 2
    DIFFRACTED = 3
    OWN_PLATE = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Rays:
    """Rays of links, link after link; a link is one receiver of one mirror and one transmitter.

    The path of ray k in a pose of pivot p and orientation R is ``|source[k] - (p + R place[k])| + extra[k]``, so that
    one list serves all poses near the one it was made for: a mirror image stays where it is while the receiver moves,
    and a ray from the mirror's own plate is that of a receiver mirrored in it (``place`` differs from the receiver's).
    The field that a link receives is the sum over its rays of ``field[k] · exp(−j 2π/λ path)``, weighed by the
    antenna's response to the direction from which the ray comes: ``source[k] − (p + R place[k])`` in the mirror frame.
    A ray from the mirror's own plate (``place`` differs from the receiver's) arrives elsewhere: from the mirror image
    of that direction in the plate, or, bent, from its edge, where ``place`` is.

    Attributes
    ----------
    first : (link + 1,)
        Rays ``first[l]`` up to ``first[l + 1]`` are those of link l = (mirror × n_receiver + receiver) × n_transmitter
        + transmitter.
    source_enu_m : (ray, xyz)
        Where it seems to come from: the transmitter, its mirror image, the point of an edge [m].
    place_mirror_m : (ray, xyz)
        Where it seems to arrive, from the pivot, in the mirror frame [m].
    extra_m : (ray,)
        Way before the source [m].
    field_enu : (ray, xyz)
        Complex amplitude of the electric field at the receiver, the propagation phase of the path taken off, relative
        to the transmitter's isotropic, vertically polarised field at 1 m: a direct ray of 50 m has
        length 1/50 along the direction's θ unit vector (which points downward; see docs/real-field.md).
    kind : (ray,)
        `RayKind`.
    thing : (ray,)
        What it met last: −1 nothing, else a number of the caller's. Rays of one kind, thing, mirror and transmitter
        have the error of their factor in common.
    """

    first: npt.NDArray[np.int64]
    source_enu_m: FloatArray
    place_mirror_m: FloatArray
    extra_m: FloatArray
    field_enu: ComplexArray
    kind: npt.NDArray[np.int8]
    thing: npt.NDArray[np.int32]

    @property
    def n_ray(self) -> int:
        """Rays of all links."""
        return len(self.kind)
