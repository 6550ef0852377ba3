"""Rays foreseen from the geometry of a site: what is seen, what reflects, what is bent around edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_float_array
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.propagation import _kernels
from rfpose.propagation.rays import Rays
from rfpose.propagation.surroundings import BoxesStanding, PlatesStanding, ReceiverStand, Soil, Surroundings

__all__ = ["Foresight", "foresee"]

IndexArray = npt.NDArray[np.int64]
ComplexArray = npt.NDArray[np.complex128]

SPEED_OF_LIGHT_MPS = 299_792_458.0
_VACUUM_PERMITTIVITY = 8.8541878128e-12
_HAIR = 1e-6
"""Share of a plate's diagonal by which a receiver that lies in its plate stands out of it, to the front."""
_FOOT_M = 0.05
"""Edges lower than this over the ground are a box's foot."""
_BLOCK_LINKS = 30_000
"""Links whose rays are found at once, into room that is used again: tens of megabytes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Foresight:
    """Which rays are foreseen.

    Attributes
    ----------
    visibility
        Whether plates and boxes hide.
    ground
        Rays off the ground, alone and together with the others.
    specular
        Rays off boxes and off plates within ``reach_m``, besides the mirror's own.
    diffracted
        Rays bent once, by edges: of ``none``, of ``boxes`` alone, or of ``all``, plates within ``reach_m`` and, with
        ``own_plate``, the mirror's own among them.
    own_plate
        Rays off the mirror's own plate.
    reach_m
        Plates farther from a mirror's receivers than this hide, but turn nothing to it [m].
    faint
        A ray weaker than this, against the direct one that nothing hinders, is left out; ground rays are not.
    wedge
        Coefficients of diffraction: ``uniform``, exact for metal half-planes; or those of Sionna RT (``sionna``), to
        compare with its tables.
    antenna
        Of the transmitters, upright: ``isotropic``, of gain one, or the pattern of a ``half_wave`` dipole.
    propagation_speed_mps
        [m/s].
    """

    visibility: bool = True
    ground: bool = True
    specular: bool = True
    diffracted: Literal["none", "boxes", "all"] = "all"
    own_plate: bool = True
    reach_m: float = 30.0
    faint: float = 1e-3
    wedge: Literal["uniform", "sionna"] = "uniform"
    antenna: Literal["isotropic", "half_wave"] = "isotropic"
    propagation_speed_mps: float = SPEED_OF_LIGHT_MPS

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        if not self.reach_m >= 0.0:
            raise InvalidInputError(f"`reach_m` must not be negative, got {self.reach_m}")
        if not 0.0 <= self.faint < 1.0:
            raise InvalidInputError(f"`faint` must be from zero to below one, got {self.faint}")
        if self.diffracted not in ("none", "boxes", "all"):
            raise InvalidInputError(f"`diffracted` must be 'none', 'boxes' or 'all', got {self.diffracted!r}")
        if self.wedge not in ("uniform", "sionna"):
            raise InvalidInputError(f"`wedge` must be 'uniform' or 'sionna', got {self.wedge!r}")
        if self.antenna not in ("isotropic", "half_wave"):
            raise InvalidInputError(f"`antenna` must be 'isotropic' or 'half_wave', got {self.antenna!r}")


def foresee(
    transmitter_enu_m: npt.ArrayLike,
    carrier_rf_hz: npt.ArrayLike,
    mirrors: ReceiverStand,
    surroundings: Surroundings,
    options: Foresight | None = None,
) -> Rays:
    """Return the rays that geometry lets one expect, for mirrors in the poses of one frame.

    Direct rays; rays off the ground, off plates and boxes, and off one of these and the ground, in either order; rays
    off the mirror's own plate, also of what the ground or another thing turned before; rays that one edge bends, alone
    or with the ground before or after. Geometrical optics with the uniform theory of diffraction: a point must lie on
    the thing that turns the ray, every leg must be free.

    Parameters
    ----------
    transmitter_enu_m : (transmitter, xyz)
        [m].
    carrier_rf_hz : (transmitter,)
        Radio frequencies of the carriers [Hz].
    mirrors
        Poses and receivers; see `bystanders` for receivers without a mirror.
    surroundings
        What stands about in this frame, the mirrors' own plates among it.
    options
        By default everything.

    Returns
    -------
    Rays
        ``thing`` numbers plates, then boxes, then the ground, as ``surroundings`` has them. A ray that something and
        the ground turned is of that thing.

    Raises
    ------
    InvalidInputError
        Shapes; a carrier that is not above zero.
    GeometryError
        A transmitter or pivot that is not above the ground.
    """
    wanted = Foresight() if options is None else options
    transmitter = as_float_array("transmitter_enu_m", transmitter_enu_m, ("transmitter", 3))
    carrier = as_float_array("carrier_rf_hz", carrier_rf_hz, (len(transmitter),), positive=True)
    if np.any(mirrors.own_plate >= len(surroundings.plates.centre_enu_m)):
        raise InvalidInputError(
            f"`own_plate` must be less than the number of plates, {len(surroundings.plates.centre_enu_m)}, got "
            f"{int(np.max(mirrors.own_plate))}"
        )
    scene = _scene(transmitter, carrier, surroundings, wanted)
    _check_above(transmitter, mirrors, surroundings)
    receivers, middle, spread = _receivers(mirrors, surroundings, wanted)
    n_mirror, n_receiver, n_transmitter = len(receivers.pivot), receivers.place.shape[1], len(transmitter)
    block = max(1, _BLOCK_LINKS // max(1, n_receiver * n_transmitter))
    kinds = _kernels.RayChoice(
        hide=wanted.visibility,
        ground=wanted.ground and surroundings.soil is not None,
        specular=wanted.specular,
        box_edges=wanted.diffracted != "none",
        plate_edges=wanted.diffracted == "all",
        own_plate=wanted.own_plate,
        by_faces=wanted.wedge == "sionna",
        faint=wanted.faint,
    )
    room, count, parts = 8, np.zeros((n_mirror, n_receiver, n_transmitter), np.int64), []
    found = None
    for begin in range(0, n_mirror, block):
        rows = slice(begin, min(begin + block, n_mirror))
        while True:
            if found is None:
                found = _empty((min(block, n_mirror), n_receiver, n_transmitter), room)
            some = receivers._replace(
                pivot=receivers.pivot[rows], rot=receivers.rot[rows], place=receivers.place[rows],
                own=receivers.own[rows], near_start=receivers.near_start[rows.start : rows.stop + 1],
            )  # fmt: skip
            n_row = rows.stop - rows.start
            _kernels.rays_of_mirrors(n_row, scene, kinds, some, middle[rows], spread[rows], found)
            most = int(found.n_ray[:n_row].max(initial=0))
            if most <= room:
                break
            room, found = most + most // 2, None
        count[rows] = found.n_ray[:n_row]
        parts.append(_taken(found, n_row))
    return _gathered(count, parts)


def _scene(
    transmitter: FloatArray, carrier_hz: FloatArray, things: Surroundings, wanted: Foresight
) -> _kernels.StandingThings:
    plates, boxes, soil = things.plates, things.boxes, things.soil
    n_plate, n_box = len(plates.centre_enu_m), len(boxes.base_enu_m)
    half = 0.5 * plates.size_m
    reach = float(np.hypot(*half.T).max(initial=0.0))
    # a plate lies within one cell's side of the cell of its centre, so a ray's own cell and the eight about it suffice
    extent = float(np.ptp(plates.centre_enu_m[:, :2], axis=0).max()) if n_plate else 0.0
    cell = max(2.0 * reach, extent / 1000.0, 1e-9)
    origin = plates.centre_enu_m[:, :2].min(axis=0) if n_plate else np.zeros(2)
    start, member = _cells(plates.centre_enu_m, origin, cell)
    box_rot, box_half = boxes.rot_enu_from_box, 0.5 * boxes.size_m
    box_centre = boxes.base_enu_m + box_half * [0.0, 0.0, 1.0]
    normal = (0.0, 0.0, 1.0) if soil is None else soil.normal_enu
    ground_rot = geometry.rot_enu_from_mirror(normal)
    face_point = [np.array([[0.0, 0.0, 0.0 if soil is None else soil.height_m]]), plates.centre_enu_m]
    face_rot = [ground_rot[None], plates.rot_enu_from_mirror]
    face_half = [np.full((1, 2), np.inf), half]
    for i in range(n_box):
        for k in range(3):
            turned = box_rot[i][:, [(k + 1) % 3, (k + 2) % 3, k]]
            for sign in (1.0, -1.0):
                face_point.append((box_centre[i] + sign * box_half[i, k] * box_rot[i][:, k])[None])
                face_rot.append((turned * [sign, 1.0, sign])[None])
                face_half.append(box_half[i, [(k + 1) % 3, (k + 2) % 3]][None])
    thing = [n_plate + n_box, *range(n_plate), *np.repeat(n_plate + np.arange(n_box), 6)]
    permittivity = np.zeros((n_plate + n_box + 1, len(carrier_hz)), np.complex128)
    permittivity[n_plate:-1] = _complex(boxes.permittivity[:, None], boxes.conductivity_s_per_m[:, None], carrier_hz)
    if soil is not None:
        permittivity[-1] = _complex(soil.permittivity, soil.conductivity_s_per_m, carrier_hz)
    edges = _edges(plates, half, boxes, box_centre, soil)
    return _kernels.StandingThings(
        transmitter=_solid(transmitter),
        wavenumber=2.0 * np.pi * carrier_hz / wanted.propagation_speed_mps,
        dipole=wanted.antenna == "half_wave",
        centre=_solid(plates.centre_enu_m),
        rot=_solid(plates.rot_enu_from_mirror),
        half=_solid(half),
        reach=reach,
        top=float(plates.centre_enu_m[:, 2].max(initial=-np.inf)) + reach,
        x0=float(origin[0]),
        y0=float(origin[1]),
        cell=cell,
        start=start,
        member=member,
        box_centre=_solid(box_centre),
        box_rot=_solid(box_rot),
        box_half=_solid(box_half),
        face_point=_solid(np.concatenate(face_point)),
        face_rot=_solid(np.concatenate(face_rot)),
        face_half=_solid(np.concatenate(face_half)),
        face_thing=np.array(thing, np.int64),
        two_sided=(np.arange(len(thing)) - 1 < n_plate).astype(np.int64) * (np.arange(len(thing)) > 0),
        permittivity=permittivity,
        **edges,
    )


def _edges(
    plates: PlatesStanding, half: FloatArray, boxes: BoxesStanding, box_centre: FloatArray, soil: Soil | None
) -> dict[str, Any]:
    """Return the edges' columns of the scene; edges at the foot of a box, on the ground, have no length."""
    n_plate, n_box = len(half), len(box_centre)
    middle, inward, outward, extent = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty((0, 3))], [np.empty(0)]
    for axis, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)):
        side = sign * plates.rot_enu_from_mirror[:, :, axis]
        middle.append(plates.centre_enu_m + half[:, axis, None] * side)
        inward.append(-side)
        outward.append(plates.rot_enu_from_mirror[:, :, 2])
        extent.append(2.0 * half[:, 1 - axis])
    order = [np.arange(4 * n_plate).reshape(4, n_plate).T.ravel()]
    for along, first, second in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for one, other in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
            a, b = one * boxes.rot_enu_from_box[:, :, first], other * boxes.rot_enu_from_box[:, :, second]
            middle.append(box_centre + 0.5 * (boxes.size_m[:, [first]] * a + boxes.size_m[:, [second]] * b))
            inward.append(-b)
            outward.append(a)
            extent.append(boxes.size_m[:, along])
    order.append(4 * n_plate + np.arange(12 * n_box).reshape(12, n_box).T.ravel())
    row = np.concatenate(order)
    centre, within, out, size = (np.concatenate(one)[row] for one in (middle, inward, outward, extent))
    if soil is not None:
        above = (centre - [0.0, 0.0, soil.height_m]) @ geometry.unit(soil.normal_enu)
        size = np.where(above > _FOOT_M, size, 0.0)
    direction = np.cross(within, out)
    return {
        "edge_from": _solid(centre - 0.5 * size[:, None] * direction),
        "edge_along": _solid(direction),
        "edge_in": _solid(within),
        "edge_out": _solid(out),
        "edge_length": _solid(size),
        "edge_wedge": np.repeat([2.0, 1.5], [4 * n_plate, 12 * n_box]),
        "edge_thing": np.concatenate([np.repeat(np.arange(n_plate), 4), n_plate + np.repeat(np.arange(n_box), 12)]),
    }


def _complex(
    permittivity: FloatArray | float, conductivity_s_per_m: FloatArray | float, frequency_hz: FloatArray
) -> ComplexArray:
    loss = conductivity_s_per_m / (2.0 * np.pi * _VACUUM_PERMITTIVITY * frequency_hz)
    return np.asarray(permittivity - 1j * loss, np.complex128)


def _solid(array: npt.ArrayLike) -> FloatArray:
    """As the kernel takes all arrays: read-only ones would be another type, for which it is compiled anew."""
    return np.require(array, np.float64, ["C", "W"])


def _cells(centre: FloatArray, origin: FloatArray, cell: float) -> tuple[IndexArray, IndexArray]:
    """Return the plates by cell: ``member[start[i, j]:start[i, j + 1]]`` stand in cell (i, j)."""
    if not len(centre):
        return np.zeros((1, 2), np.int64), np.zeros(0, np.int64)
    index = np.floor((centre[:, :2] - origin) / cell).astype(np.int64)
    n_column, n_row = index.max(axis=0) + 1
    flat = index[:, 0] * n_row + index[:, 1]
    member = np.argsort(flat, kind="stable")
    count = np.bincount(flat, minlength=n_column * n_row).reshape(n_column, n_row)
    before = np.concatenate([[0], np.cumsum(count.sum(axis=1))[:-1]])
    start = np.concatenate([np.zeros((n_column, 1), np.int64), np.cumsum(count, axis=1)], axis=1) + before[:, None]
    return np.ascontiguousarray(start), member


def _check_above(transmitter: FloatArray, mirrors: ReceiverStand, things: Surroundings) -> None:
    if things.soil is None:
        return
    normal = geometry.unit(things.soil.normal_enu)
    for kind, place in (("transmitter", transmitter), ("pivot", mirrors.pivot_enu_m)):
        height = (place - [0.0, 0.0, things.soil.height_m]) @ normal
        if np.any(height <= 0.0):
            i = int(np.nanargmin(height))
            raise GeometryError(
                f"{kind} {i} lies {-height[i]:.3g} m below the ground; correct it, or the ground's height"
            )


def _receivers(
    mirrors: ReceiverStand, things: Surroundings, wanted: Foresight
) -> tuple[_kernels.Receivers, FloatArray, FloatArray]:
    """Return what the kernel wants of the mirrors, and the spheres about their receivers."""
    place = _out_of_plates(mirrors, things)
    at = mirrors.pivot_enu_m[:, None] + np.einsum("mab,mrb->mra", mirrors.rot_enu_from_mirror, place)
    there = np.isfinite(at).all(axis=2)
    middle = (
        np.where(there[..., None], at, 0.0).sum(axis=1)
        / np.where(there.any(axis=1), there.sum(axis=1), np.nan)[:, None]
    )
    spread = np.where(there, np.linalg.norm(at - middle[:, None], axis=2), 0.0).max(axis=1, initial=0.0)
    near_start, near = _near(middle, things.plates.centre_enu_m, wanted.reach_m)
    receivers = _kernels.Receivers(
        pivot=_solid(mirrors.pivot_enu_m),
        rot=_solid(mirrors.rot_enu_from_mirror),
        place=_solid(place),
        own=np.require(mirrors.own_plate, np.int64, ["C", "W"]),
        near_start=near_start,
        near=near,
    )
    return receivers, middle, spread


def _out_of_plates(mirrors: ReceiverStand, things: Surroundings) -> FloatArray:
    """(mirror, receiver, xyz) places, those within the mirror's own plate a hair's breadth in front of it [m]."""
    place = np.array(mirrors.receiver_mirror_m, np.float64)
    plates, rows = things.plates, np.flatnonzero(mirrors.own_plate >= 0)
    own = mirrors.own_plate[rows]
    offset = mirrors.pivot_enu_m[rows] - plates.centre_enu_m[own]
    at = offset[:, None] + np.einsum("mab,mrb->mra", mirrors.rot_enu_from_mirror[rows], place[rows])
    x, y, z = np.moveaxis(np.einsum("mba,mrb->mra", plates.rot_enu_from_mirror[own], at), 2, 0)
    hair = (_HAIR * np.hypot(*plates.size_m[own].T))[:, None]
    half = 0.5 * plates.size_m[own]
    flush = (np.abs(x) < half[:, :1]) & (np.abs(y) < half[:, 1:]) & (np.abs(z) < hair)
    place[rows, :, 2] += np.where(flush, hair - z, 0.0)
    return place


def _near(middle: FloatArray, centre: FloatArray, reach_m: float) -> tuple[IndexArray, IndexArray]:
    """Return the plates about each mirror: ``near[start[m]:start[m + 1]]``."""
    from scipy.spatial import KDTree

    rows = np.flatnonzero(np.isfinite(middle).all(axis=1))
    count = np.zeros(len(middle), np.int64)
    near = np.zeros(0, np.int64)
    if len(centre) and len(rows):
        lists = KDTree(middle[rows]).query_ball_tree(KDTree(centre), reach_m)
        count[rows] = [len(one) for one in lists]
        near = np.array([plate for one in lists for plate in sorted(one)], np.int64)
    return np.concatenate([[0], np.cumsum(count)]).astype(np.int64), near


def _empty(shape: tuple[int, int, int], room: int) -> _kernels.TracedRays:
    return _kernels.TracedRays(
        n_ray=np.zeros(shape, np.int64),
        source=np.empty((*shape, room, 3)),
        place=np.empty((*shape, room, 3)),
        extra=np.empty((*shape, room)),
        field=np.empty((*shape, room, 3), np.complex128),
        kind=np.empty((*shape, room), np.int8),
        thing=np.empty((*shape, room), np.int32),
    )


def _taken(found: _kernels.TracedRays, n_row: int) -> tuple[npt.NDArray[np.generic], ...]:
    """Return the rays of the first rows, link after link."""
    used = np.arange(found.extra.shape[3]) < found.n_ray[:n_row, ..., None]
    return tuple(array[:n_row][used] for array in found[1:])


def _gathered(count: IndexArray, parts: list[tuple[npt.NDArray[np.generic], ...]]) -> Rays:
    parts = parts or [_taken(_empty((0, 0, 0), 0), 0)]
    source, place, extra, field, kind, thing = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Rays(
        first=np.concatenate([[0], np.cumsum(count.ravel())]).astype(np.int64),
        source_enu_m=source,
        place_mirror_m=place,
        extra_m=extra,
        field_enu=field,
        kind=kind,
        thing=thing,
    )
