"""What stands on a site and turns or hides radio waves: mirrors' plates, boxes, the ground."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import InvalidInputError

__all__ = ["BoxesStanding", "PlatesStanding", "ReceiverStand", "Soil", "Surroundings", "bystanders"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlatesStanding:
    """Thin metal rectangles in their postures of one frame.

    Attributes
    ----------
    centre_enu_m : (plate, xyz)
        [m].
    rot_enu_from_mirror : (plate, 3, 3)
        Columns: along the width, along the height, the normal.
    size_m : (plate, 2)
        Width and height [m].
    """

    centre_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    size_m: FloatArray

    def __post_init__(self) -> None:
        """Refuse plates that are none."""
        n = len(as_float_array("centre_enu_m", self.centre_enu_m, ("plate", 3)))
        as_float_array("rot_enu_from_mirror", self.rot_enu_from_mirror, (n, 3, 3))
        as_float_array("size_m", self.size_m, (n, 2), positive=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxesStanding:
    """Upright boxes of one material each.

    Attributes
    ----------
    base_enu_m : (box, xyz)
        Centre of the base [m].
    size_m : (box, 3)
        Along its own x, y and upwards [m].
    azimuth_rad : (box,)
        Of its y side, from north, clockwise [rad].
    permittivity : (box,)
        Relative, real part.
    conductivity_s_per_m : (box,)
        [S/m].
    """

    base_enu_m: FloatArray
    size_m: FloatArray
    azimuth_rad: FloatArray
    permittivity: FloatArray
    conductivity_s_per_m: FloatArray

    def __post_init__(self) -> None:
        """Refuse boxes that are none."""
        n = len(as_float_array("base_enu_m", self.base_enu_m, ("box", 3)))
        as_float_array("size_m", self.size_m, (n, 3), positive=True)
        as_float_array("azimuth_rad", self.azimuth_rad, (n,))
        as_float_array("permittivity", self.permittivity, (n,), positive=True)
        as_float_array("conductivity_s_per_m", self.conductivity_s_per_m, (n,))

    @property
    def rot_enu_from_box(self) -> FloatArray:
        """(box, 3, 3) columns: the box's x, y and up."""
        sine, cosine, rest = np.sin(self.azimuth_rad), np.cos(self.azimuth_rad), np.zeros(len(self.azimuth_rad))
        rows = [[cosine, sine, rest], [-sine, cosine, rest], [rest, rest, rest + 1.0]]
        return np.moveaxis(np.array(rows), 2, 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Soil:
    """A flat ground of one material, smooth.

    Attributes
    ----------
    permittivity, conductivity_s_per_m
        Relative, real part; [S/m].
    height_m
        Where the site's origin is [m].
    normal_enu
        Upwards; need not be of unit length.
    """

    permittivity: float
    conductivity_s_per_m: float = 0.0
    height_m: float = 0.0
    normal_enu: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Refuse what is no ground."""
        if not self.permittivity >= 1.0:
            raise InvalidInputError(f"`permittivity` must be at least one, got {self.permittivity}")
        if not self.conductivity_s_per_m >= 0.0:
            raise InvalidInputError(f"`conductivity_s_per_m` must not be negative, got {self.conductivity_s_per_m}")
        if not as_float_array("normal_enu", self.normal_enu, (3,))[2] > 0.0:
            raise InvalidInputError(f"`normal_enu` of the ground must point upwards, got {self.normal_enu}")


def _no_plates() -> PlatesStanding:
    return PlatesStanding(
        centre_enu_m=np.empty((0, 3)), rot_enu_from_mirror=np.empty((0, 3, 3)), size_m=np.empty((0, 2))
    )


def _no_boxes() -> BoxesStanding:
    none = np.empty(0)
    return BoxesStanding(
        base_enu_m=np.empty((0, 3)), size_m=np.empty((0, 3)), azimuth_rad=none, permittivity=none,
        conductivity_s_per_m=none,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """All that stands about. Things are numbered: plates as they come, then boxes, then the ground.

    Attributes
    ----------
    plates, boxes
    soil
        None: no ground.
    """

    plates: PlatesStanding = field(default_factory=_no_plates)
    boxes: BoxesStanding = field(default_factory=_no_boxes)
    soil: Soil | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceiverStand:
    """Where receivers stand: fixed to mirrors in given poses.

    Attributes
    ----------
    pivot_enu_m : (mirror, xyz)
        [m]. NaN, here or in the orientation: the mirror's links get no rays.
    rot_enu_from_mirror : (mirror, 3, 3)
    receiver_mirror_m : (mirror, receiver, xyz)
        From the pivot, the arm included [m]. NaN: a receiver that the mirror lacks.
    own_plate : (mirror,)
        Which of the plates is the mirror's own; −1: none.
    """

    pivot_enu_m: FloatArray
    rot_enu_from_mirror: FloatArray
    receiver_mirror_m: FloatArray
    own_plate: npt.NDArray[np.int64]

    def __post_init__(self) -> None:
        """Refuse shapes that do not fit."""
        n = len(as_float_array("pivot_enu_m", self.pivot_enu_m, ("mirror", 3), finite=False))
        as_float_array("rot_enu_from_mirror", self.rot_enu_from_mirror, (n, 3, 3), finite=False)
        as_float_array("receiver_mirror_m", self.receiver_mirror_m, (n, "receiver", 3), finite=False)
        if np.shape(self.own_plate) != (n,):
            raise InvalidInputError(f"`own_plate` must have shape ({n},), got {np.shape(self.own_plate)}")


def bystanders(place_enu_m: npt.ArrayLike) -> ReceiverStand:
    """Return receivers without a mirror, such as calibration receivers, each as a stand of its own.

    Parameters
    ----------
    place_enu_m : (bystander, xyz)
        [m].
    """
    place = as_float_array("place_enu_m", place_enu_m, ("bystander", 3))
    n = len(place)
    return ReceiverStand(
        pivot_enu_m=place,
        rot_enu_from_mirror=np.broadcast_to(np.eye(3), (n, 3, 3)),
        receiver_mirror_m=np.zeros((n, 1, 3)),
        own_plate=np.full(n, -1),
    )
