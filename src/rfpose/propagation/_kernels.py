"""Kernels of rays: what hides a way, where planes and edges turn it, and what they make of the electric field.

Points and directions are tuples (x, y, z), fields tuples of complex components in the same frame; time goes as
e^{+jωt}. A wave that went the length L carries the factor e^{-jkL}, which is kept out of all fields here.

Reflection at a plane of normal n and relative permittivity ε, s = sine of the grazing angle, q = √(ε − 1 + s²):

    across the plane of incidence  (s − q) / (s + q),      in it  (ε s − q) / (ε s + q),

the latter's sign kept by the component along n. Metal (ε given as zero): −1 and +1.

Diffraction at the edge of a wedge whose faces stand at the angles 0 and nπ, from φ' and s' to φ and s, β the angle with
the edge, by the uniform theory [1]_, L = s s' sin²β / (s + s'), F its transition function:

    D = −e^{−jπ/4} / (2n √(2πk) sin β) · [T₊(φ−φ') + T₋(φ−φ') + R₀ T₋(φ+φ') + Rₙ T₊(φ+φ')],
    T±(b) = cot((π ± b) / 2n) F(kL a±(b)),      a±(b) = 2 cos²(πnN± − b/2),      N± the integer nearest (b ± π) / 2πn,

R₀, Rₙ the faces' coefficients, for what is not metal by Luebbers' heuristic [2]_; across: the field along the edge.
Sionna RT 2.2 has instead T₊(φ−φ') − T₋(φ+φ') of what the first face reflects and T₋(φ−φ') − T₊(φ+φ') of what goes
through, or of what the second face reflects where it is lit.

References
----------
.. [1] R. G. Kouyoumjian, P. H. Pathak, A uniform geometrical theory of diffraction for an edge in a perfectly
   conducting surface, Proc. IEEE 62 (1974) 1448-1461.
.. [2] R. J. Luebbers, Finite conductivity uniform GTD versus knife edge diffraction, IEEE Trans. AP 32 (1984) 70-76.
.. [3] J. A. C. Weideman, Computation of the complex error function, SIAM J. Numer. Anal. 31 (1994) 1497-1518.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rfpose.jit import kernel, kernel_rows

Float64 = npt.NDArray[np.float64]
Complex128 = npt.NDArray[np.complex128]
Int64 = npt.NDArray[np.int64]

DIRECT, GROUND, SPECULAR, DIFFRACTED, OWN_PLATE = 0, 1, 2, 3, 4
NOTHING = -1
NO_FACE = -1
THE_GROUND = 0  # its number among the faces


def _weideman(n: int) -> tuple[float, Float64]:
    """Scale and coefficients, highest first, of the Faddeeva function's rational approximation [3]_."""
    scale = float(np.sqrt(n / np.sqrt(2.0)))
    t = scale * np.tan(np.arange(1 - 2 * n, 2 * n) * np.pi / (4 * n))
    f = np.concatenate([[0.0], np.exp(-t * t) * (scale * scale + t * t)])
    return scale, np.ascontiguousarray((np.fft.fft(np.fft.fftshift(f)).real / (4 * n))[n:0:-1])


_SCALE, _COEFFICIENT = _weideman(20)
_HALF_TURN = complex(math.sqrt(0.5), math.sqrt(0.5))  # e^{jπ/4}


class StandingThings(NamedTuple):
    """What stands on the site.

    Plates come first among the things, then boxes, then the ground; among the faces the ground is first, then one for
    each plate, then six for each box; edges are four for each plate, then twelve for each box. ``permittivity`` (thing,
    transmitter) is zero for metal.
    """

    transmitter: Float64
    wavenumber: Float64
    dipole: bool
    # plates, by cells of side `cell`: member[start[i, j]:start[i, j + 1]] stand in cell (i, j)
    centre: Float64
    rot: Float64
    half: Float64
    reach: float
    top: float
    x0: float
    y0: float
    cell: float
    start: Int64
    member: Int64
    # boxes
    box_centre: Float64
    box_rot: Float64
    box_half: Float64
    # faces: (face, 3), (face, 3, 3) with the normal in the last column, (face, 2)
    face_point: Float64
    face_rot: Float64
    face_half: Float64
    face_thing: Int64
    two_sided: Int64
    # edges: the point where each begins, its direction, in its first face away from it, out of that face, n, ...
    edge_from: Float64
    edge_along: Float64
    edge_in: Float64
    edge_out: Float64
    edge_length: Float64
    edge_wedge: Float64
    edge_thing: Int64
    permittivity: Complex128


class RayChoice(NamedTuple):
    """Which rays to look for."""

    hide: bool
    ground: bool
    specular: bool
    box_edges: bool
    plate_edges: bool
    own_plate: bool
    by_faces: bool
    faint: float


class Receivers(NamedTuple):
    """Mirrors and where their receivers are; ``near`` (pair,) are plates to look at, by mirror from ``near_start``."""

    pivot: Float64
    rot: Float64
    place: Float64
    own: Int64
    near_start: Int64
    near: Int64


class TracedRays(NamedTuple):
    """Rays by link (mirror, receiver, transmitter, ray); ``n_ray`` may exceed the room there is."""

    n_ray: Int64
    source: Float64
    place: Float64
    extra: Float64
    field: Complex128
    kind: npt.NDArray[np.int8]
    thing: npt.NDArray[np.int32]


# -- vectors -----------------------------------------------------------------------------------------------------------


@kernel
def at(array, i):
    """Row of an array as a tuple."""
    return array[i, 0], array[i, 1], array[i, 2]


@kernel
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a, b):
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def minus(a, b):
    """``a − b``."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@kernel
def along(a, f, d):
    """``a + f d``."""
    return a[0] + f * d[0], a[1] + f * d[1], a[2] + f * d[2]


@kernel
def times(f, a):
    """``f a``."""
    return f * a[0], f * a[1], f * a[2]


@kernel
def length(a):
    """Length of a real vector."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@kernel
def size(field):
    """Length of a complex vector."""
    return math.sqrt(abs(field[0]) ** 2 + abs(field[1]) ** 2 + abs(field[2]) ** 2)


@kernel
def towards(a, b):
    """Unit vector from a to b."""
    d = minus(b, a)
    return times(1.0 / length(d), d)


@kernel
def axis(rot, i, column):
    """Column of a rotation."""
    return rot[i, 0, column], rot[i, 1, column], rot[i, 2, column]


# -- what hides --------------------------------------------------------------------------------------------------------


@kernel
def plate_hides(scene, p, a, b):
    """Whether the way from a to b crosses a plate."""
    centre = at(scene.centre, p)
    normal = axis(scene.rot, p, 2)
    da, db = dot(minus(a, centre), normal), dot(minus(b, centre), normal)
    if da * db >= 0.0:
        return False
    d = minus(along(a, da / (da - db), minus(b, a)), centre)
    return (
        abs(dot(d, axis(scene.rot, p, 0))) < scene.half[p, 0] and abs(dot(d, axis(scene.rot, p, 1))) < scene.half[p, 1]
    )


@kernel
def box_hides(scene, i, a, b):
    """Whether the way from a to b goes through a box."""
    low, high = 0.0, 1.0
    centre = at(scene.box_centre, i)
    to_a, way = minus(a, centre), minus(b, a)
    for k in range(3):
        side = axis(scene.box_rot, i, k)
        o, d, half = dot(to_a, side), dot(way, side), scene.box_half[i, k]
        if abs(d) < 1e-12:
            if abs(o) >= half:
                return False
            continue
        first, second = (-half - o) / d, (half - o) / d
        low, high = max(low, min(first, second)), min(high, max(first, second))
    return low < high


@kernel
def plates_hide(scene, a, b, skip, skip_too):
    """Whether any plate but two stands in the way; walks along the ray through the cells."""
    if a[2] > b[2]:
        a, b = b, a
    n_column, n_row = scene.start.shape[0], scene.start.shape[1] - 1
    d = minus(b, a)
    flat, square = math.sqrt(d[0] * d[0] + d[1] * d[1]), dot(d, d)
    end = 1.0
    if d[2] > 0.0:  # above the highest edge of any plate nothing is in the way
        end = min(1.0, (scene.top - a[2]) / d[2])
    if end <= 0.0:
        return False
    n_step = int(end * flat / scene.cell) + 1
    last_i, last_j = -9, -9
    for k in range(n_step + 1):
        f = end * k / n_step
        i = math.floor((a[0] + f * d[0] - scene.x0) / scene.cell)
        j = math.floor((a[1] + f * d[1] - scene.y0) / scene.cell)
        if i == last_i and j == last_j:
            continue
        for column in range(max(0, i - 1), min(n_column, i + 2)):
            first, behind = j - 1, j + 2
            if abs(column - last_i) < 2:  # of a column about the step before only what is new
                first, behind = (max(first, last_j + 2), behind) if j >= last_j else (first, min(behind, last_j - 1))
            first, behind = max(0, first), min(n_row, behind)
            if first >= behind:
                continue
            for q in range(scene.start[column, first], scene.start[column, behind]):
                p = scene.member[q]
                if p in (skip, skip_too):
                    continue
                # distance of the plate's centre from the ray, before its exact outline
                c = minus(at(scene.centre, p), a)
                t = min(1.0, max(0.0, dot(c, d) / square))
                g = along(c, -t, d)
                if dot(g, g) <= scene.reach * scene.reach and plate_hides(scene, p, a, b):
                    return True
        last_i, last_j = i, j
    return False


@kernel
def free(scene, wanted, a, b, skip, skip_too):
    """Whether nothing but two things, which touch the way's ends, hides b from a; no way is free."""
    if not wanted.hide or (a[0] == b[0] and a[1] == b[1] and a[2] == b[2]):
        return True
    n_plate = scene.centre.shape[0]
    for i in range(scene.box_centre.shape[0]):
        if n_plate + i != skip and n_plate + i != skip_too and box_hides(scene, i, a, b):
            return False
    return n_plate == 0 or not plates_hide(scene, a, b, skip, skip_too)


# -- planes ------------------------------------------------------------------------------------------------------------


@kernel
def height(scene, f, a):
    """Distance of a point from a face's plane, along its normal."""
    return dot(minus(a, at(scene.face_point, f)), axis(scene.face_rot, f, 2))


@kernel
def mirrored(scene, f, a):
    """Mirror image of a point in a face's plane."""
    return along(a, -2.0 * height(scene, f, a), axis(scene.face_rot, f, 2))


@kernel
def meets(scene, f, image, a):
    """Whether a ray that seems to come from an image comes off face f to a, and where it touches it."""
    far, near = height(scene, f, image), height(scene, f, a)
    if far * near >= 0.0 or (near < 0.0 and scene.two_sided[f] == 0):
        return False, a
    point = along(a, near / (near - far), minus(image, a))
    d = minus(point, at(scene.face_point, f))
    inside = (
        abs(dot(d, axis(scene.face_rot, f, 0))) < scene.face_half[f, 0]
        and abs(dot(d, axis(scene.face_rot, f, 1))) < scene.face_half[f, 1]
    )
    return inside, point


@kernel
def launched(scene, direction):
    """Field that the transmitter's antenna sends in a direction, at the unit of distance."""
    flat = math.sqrt(direction[0] * direction[0] + direction[1] * direction[1])
    if flat < 1e-9:  # straight up or down no direction is the vertical one's
        gain = 0.0 if scene.dipole else 1.0
        return gain + 0j, 0j, 0j
    gain = 1.0 + 0j
    if scene.dipole:
        gain = 1.2818 * math.cos(0.5 * math.pi * direction[2]) / flat + 0j
    return gain * direction[2] * direction[0] / flat, gain * direction[2] * direction[1] / flat, -gain * flat


@kernel
def fresnel(permittivity, s):
    """Coefficients of a plane across the plane of incidence and in it; s is the sine of the grazing angle."""
    if permittivity == 0.0:
        return -1.0 + 0j, 1.0 + 0j
    q = np.sqrt(permittivity - 1.0 + s * s)
    return (s - q) / (s + q), (permittivity * s - q) / (permittivity * s + q)


@kernel
def mirrored_way(direction, normal):
    """Direction after reflection."""
    return along(direction, -2.0 * dot(direction, normal), normal)


@kernel
def bounced(scene, t, f, direction, field):
    """Field after reflection at a face of a wave that travels along a direction."""
    return bounced_at(axis(scene.face_rot, f, 2), scene.permittivity[scene.face_thing[f], t], direction, field)


@kernel
def bounced_at(normal, permittivity, direction, field):
    """Field after reflection at a plane."""
    across, within = fresnel(permittivity, abs(dot(direction, normal)))
    side = cross(direction, normal)
    flat = length(side)
    if flat < 1e-9:
        return times(across, field)
    side = times(1.0 / flat, side)
    before, after = cross(side, direction), cross(side, mirrored_way(direction, normal))
    s, p = across * dot(field, side), within * dot(field, before)
    return s * side[0] + p * after[0], s * side[1] + p * after[1], s * side[2] + p * after[2]


@kernel
def reflected(scene, wanted, t, first, second, a, weak):
    """Whether transmitter t's ray off a face, or off two of them in order, reaches a; the field that it brings.

    ``second`` may be `NO_FACE`. Rays weaker than ``weak`` do not count.
    """
    origin = at(scene.transmitter, t)
    nothing = (0j, 0j, 0j)
    image = mirrored(scene, first, origin)
    thing, thing_too = scene.face_thing[first], NOTHING
    q = a
    if second != NO_FACE:
        ok, q = meets(scene, second, mirrored(scene, second, image), a)
        if not ok:
            return False, nothing
        thing_too = scene.face_thing[second]
    ok, p = meets(scene, first, image, q)
    if not ok:
        return False, nothing
    way = length(minus(p, origin)) + length(minus(q, p)) + length(minus(a, q))
    direction = towards(origin, p)
    field = bounced(scene, t, first, direction, launched(scene, direction))
    if second != NO_FACE:
        field = bounced(scene, t, second, towards(p, q), field)
    field = times(1.0 / way, field)
    if size(field) < weak:
        return False, nothing
    # one call in a loop rather than three: LLVM would inline them all, and compile for minutes
    for x, y, skip, skip_too in ((origin, p, thing, NOTHING), (p, q, thing, thing_too), (q, a, thing_too, NOTHING)):
        if not free(scene, wanted, x, y, skip, skip_too):
            return False, field
    return True, field


@kernel
def in_beam(scene, f, image, a, spread):
    """Whether the line from an image to a passes face f within its half diagonal and ``spread``: no ray else."""
    d = minus(a, image)
    c = minus(at(scene.face_point, f), image)
    g = along(c, -dot(c, d) / max(dot(d, d), 1e-30), d)
    reach = math.sqrt(scene.face_half[f, 0] ** 2 + scene.face_half[f, 1] ** 2) + spread
    return dot(g, g) <= reach * reach


# -- edges -------------------------------------------------------------------------------------------------------------


@kernel
def transition(x):
    """Transition function of the uniform theory, ``2j √x e^{jx} ∫_√x^∞ e^{−jτ²} dτ``, for x ≥ 0."""
    root = math.sqrt(x)
    iz = -_HALF_TURN * root
    below = 1.0 / (_SCALE - iz)
    ratio = (_SCALE + iz) * below
    p = 0j
    for c in _COEFFICIENT:
        p = p * ratio + c
    return math.sqrt(math.pi) * root * _HALF_TURN * (2.0 * p * below * below + below / math.sqrt(math.pi))


@kernel
def wedge_term(n, b, sign, kl):
    """``T±(b)``, sign being that of the index."""
    turns = np.rint((b + sign * math.pi) / (2.0 * math.pi * n))
    cosine = math.cos(math.pi * n * turns - 0.5 * b)
    x = (math.pi + sign * b) / (2.0 * n)
    sine = math.sin(x)
    if abs(sine) < 1e-9:  # on the boundary itself both sides' mean
        return 0j
    return math.cos(x) / sine * transition(2.0 * kl * cosine * cosine)


@kernel
def about_edge(edge, direction):
    """Unit vectors across a direction: the one around the edge, and the one beside it."""
    around = cross(edge, direction)
    around = times(1.0 / length(around), around)
    return around, cross(direction, around)


@kernel
def carried(field, edge, direction, to_end):
    """Field of a wave along a direction, given to one along another with its components about the edge."""
    around, beside = about_edge(edge, direction)
    around_too, beside_too = about_edge(edge, to_end)
    a, b = dot(field, around), dot(field, beside)
    return along(times(a, around_too), b, beside_too)


@kernel
def bent(scene, wanted, t, e, to_source, to_end, near, far, field):
    """Field after diffraction at edge e of a wave that came ``near`` and goes ``far``, at its end; none within a wedge.

    ``to_source`` and ``to_end`` are unit vectors from the edge; ``field`` is that on the edge.
    """
    n = scene.edge_wedge[e]
    edge, inward, outward = at(scene.edge_along, e), at(scene.edge_in, e), at(scene.edge_out, e)
    before = math.atan2(dot(to_source, outward), dot(to_source, inward)) % (2.0 * math.pi)
    after = math.atan2(dot(to_end, outward), dot(to_end, inward)) % (2.0 * math.pi)
    sine = math.sqrt(max(0.0, 1.0 - dot(to_source, edge) ** 2))
    if before > n * math.pi or after > n * math.pi or sine < 1e-6:
        return 0j, 0j, 0j
    other = times(-1.0, inward)  # out of the second face
    if dot(to_source, outward) < 0.0:  # the first face is the one that the source sees
        outward, other = other, outward
        before, after = n * math.pi - before, n * math.pi - after
    k = scene.wavenumber[t]
    kl = k * near * far / (near + far) * sine * sine
    factor = -_HALF_TURN.conjugate() / (2.0 * n * math.sqrt(2.0 * math.pi * k) * sine)
    factor *= math.sqrt(near / (far * (near + far)))
    on, on_too = wedge_term(n, after - before, 1.0, kl), wedge_term(n, after - before, -1.0, kl)
    off_0, off_n = wedge_term(n, after + before, -1.0, kl), wedge_term(n, after + before, 1.0, kl)
    permittivity, direction = scene.permittivity[scene.edge_thing[e], t], times(-1.0, to_source)
    through = carried(field, edge, direction, to_end)
    if wanted.by_faces:
        first = carried(
            bounced_at(outward, permittivity, direction, field), edge, mirrored_way(direction, outward), to_end
        )
        if n * math.pi > math.pi + before:
            second = through
        else:
            second = carried(
                bounced_at(other, permittivity, direction, field), edge, mirrored_way(direction, other), to_end
            )
        return along(times(factor * (on - off_0), first), factor * (on_too - off_n), second)
    across_0, within_0 = fresnel(permittivity, abs(dot(to_source, outward)))
    across_n, within_n = fresnel(permittivity, abs(dot(to_end, other)))
    around, beside = about_edge(edge, to_end)
    soft = on + on_too + across_0 * off_0 + across_n * off_n
    hard = on + on_too + within_0 * off_0 + within_n * off_n
    a, b = factor * hard * dot(through, around), factor * soft * dot(through, beside)
    return along(times(a, around), b, beside)


@kernel
def edge_point(scene, e, source, end):
    """Whether an edge turns a ray from a source to an end, and where: the same angle to the edge on both sides."""
    along_edge = at(scene.edge_along, e)
    a, b = minus(source, at(scene.edge_from, e)), minus(end, at(scene.edge_from, e))
    za, zb = dot(a, along_edge), dot(b, along_edge)
    ra, rb = length(along(a, -za, along_edge)), length(along(b, -zb, along_edge))
    z = (za * rb + zb * ra) / (ra + rb)
    return ra > 1e-6 and rb > 1e-6 and 0.0 < z < scene.edge_length[e], along(at(scene.edge_from, e), z, along_edge)


@kernel
def edge_in_reach(scene, e, source, end, spread):
    """Whether the edge may turn a ray from a source to some point within ``spread`` of an end."""
    along_edge = at(scene.edge_along, e)
    a, b = minus(source, at(scene.edge_from, e)), minus(end, at(scene.edge_from, e))
    za, zb = dot(a, along_edge), dot(b, along_edge)
    ra, rb = length(along(a, -za, along_edge)), length(along(b, -zb, along_edge))
    if ra + rb <= 2.0 * spread:
        return True
    z = (za * rb + zb * ra) / (ra + rb)
    # by what the point moves at most along the edge: with the end's place along it, and with its distance from it
    slack = spread * (1.0 + (abs(za - zb) + spread) / (ra + rb - spread))
    return -slack < z < scene.edge_length[e] + slack


@kernel
def diffracted(scene, wanted, t, e, before, after, a, weak):
    """Whether transmitter t's ray bent by edge e reaches a, its field, the edge's point, the ways to that and from it.

    The ground may turn the ray ``before`` or ``after``.
    """
    nothing = (0j, 0j, 0j)
    origin = at(scene.transmitter, t)
    source = mirrored(scene, THE_GROUND, origin) if before else origin
    end = mirrored(scene, THE_GROUND, a) if after else a
    ok, q = edge_point(scene, e, source, end)
    if not ok:
        return False, nothing, q, 0.0, 0.0
    near, far = length(minus(q, source)), length(minus(end, q))
    g = origin
    if before:
        ok, g = meets(scene, THE_GROUND, source, q)
    h = a
    if ok and after:
        ok, h = meets(scene, THE_GROUND, end, q)
    if not ok:
        return False, nothing, q, near, far
    field = launched(scene, towards(origin, g if before else q))
    if before:
        field = bounced(scene, t, THE_GROUND, towards(origin, g), field)
    field = times(1.0 / near, field)
    field = bent(scene, wanted, t, e, towards(q, g), towards(q, h), near, far, field)
    if after:
        field = bounced(scene, t, THE_GROUND, towards(q, h), field)
    if size(field) < weak:
        return False, nothing, q, near, far
    thing = scene.edge_thing[e]
    for x, y, skip in ((g, q, thing), (q, h, thing), (origin, g, NOTHING), (h, a, NOTHING)):
        if not free(scene, wanted, x, y, skip, NOTHING):
            return False, field, q, near, far
    return True, field, q, near, far


# -- links -------------------------------------------------------------------------------------------------------------


@kernel
def put(found, m, r, t, source, place, extra, field, kind, thing):
    """Write a ray down, where there is room."""
    k = found.n_ray[m, r, t]
    found.n_ray[m, r, t] = k + 1
    if k >= found.extra.shape[3]:
        return
    for i in range(3):
        found.source[m, r, t, k, i] = source[i]
        found.place[m, r, t, k, i] = place[i]
        found.field[m, r, t, k, i] = field[i]
    found.extra[m, r, t, k] = extra
    found.kind[m, r, t, k] = kind
    found.thing[m, r, t, k] = thing


@kernel
def in_mirror(receivers, m, a):
    """Point in the mirror's frame, from the pivot."""
    d = minus(a, at(receivers.pivot, m))
    rot = receivers.rot
    return dot(d, axis(rot, m, 0)), dot(d, axis(rot, m, 1)), dot(d, axis(rot, m, 2))


@kernel
def receiver_at(receivers, m, r):
    """Receiver's place on the site."""
    a = at(receivers.pivot, m)
    for k in range(3):
        a = along(a, receivers.place[m, r, k], axis(receivers.rot, m, k))
    return a


@kernel
def off_face(scene, wanted, receivers, found, m, t, f, middle, spread):
    """Add the rays off a face, those that the ground turned before, and those that it turns after."""
    origin = at(scene.transmitter, t)
    image = mirrored(scene, f, origin)
    alone = in_beam(scene, f, image, middle, spread)
    before = wanted.ground and in_beam(
        scene, f, mirrored(scene, f, mirrored(scene, THE_GROUND, origin)), middle, spread
    )
    after = wanted.ground and in_beam(scene, f, image, mirrored(scene, THE_GROUND, middle), spread)
    if not (alone or before or after):
        return
    thing = scene.face_thing[f]
    for r in range(receivers.place.shape[1]):
        a, place = receiver_at(receivers, m, r), at(receivers.place[m], r)
        if math.isnan(a[0]):
            continue
        weak = wanted.faint / length(minus(a, origin))
        for first, second, maybe in ((f, NO_FACE, alone), (THE_GROUND, f, before), (f, THE_GROUND, after)):
            if not maybe:
                continue
            ok, field = reflected(scene, wanted, t, first, second, a, weak)
            if ok:
                source = mirrored(scene, first, origin)
                if second != NO_FACE:
                    source = mirrored(scene, second, source)
                put(found, m, r, t, source, place, 0.0, field, SPECULAR, thing)


@kernel
def off_own_plate(scene, wanted, receivers, found, m, t, first, middle, spread):
    """Add the rays that the mirror's own plate turns last, ``first`` being what turned them before."""
    own = 1 + receivers.own[m]
    origin = at(scene.transmitter, t)
    source = origin
    if first != NO_FACE:
        source = mirrored(scene, first, origin)
        if first != THE_GROUND and not in_beam(scene, first, source, mirrored(scene, own, middle), spread):
            return
    for r in range(receivers.place.shape[1]):
        a = receiver_at(receivers, m, r)
        if math.isnan(a[0]):
            continue
        weak = wanted.faint / length(minus(a, origin))
        one, other = (own, NO_FACE) if first == NO_FACE else (first, own)
        ok, field = reflected(scene, wanted, t, one, other, a, weak)
        if ok:
            # the receiver's image in the plate turns with the mirror, as the receiver does
            image = in_mirror(receivers, m, mirrored(scene, own, a))
            put(found, m, r, t, source, image, 0.0, field, OWN_PLATE, scene.face_thing[own])


@kernel
def round_edges(scene, wanted, receivers, found, m, t, first, behind, middle, spread):
    """Add the rays that edges ``first`` to ``behind`` bend, alone, and with the ground before or after."""
    origin = at(scene.transmitter, t)
    for e in range(first, behind):
        thing = scene.edge_thing[e]
        for before, after in ((False, False), (True, False), (False, True)):
            if (before or after) and not wanted.ground:
                continue
            source = mirrored(scene, THE_GROUND, origin) if before else origin
            if not edge_in_reach(scene, e, source, mirrored(scene, THE_GROUND, middle) if after else middle, spread):
                continue
            for r in range(receivers.place.shape[1]):
                a, place = receiver_at(receivers, m, r), at(receivers.place[m], r)
                if math.isnan(a[0]):
                    continue
                weak = wanted.faint / length(minus(a, origin))
                ok, field, q, near, far = diffracted(scene, wanted, t, e, before, after, a, weak)
                if not ok:
                    continue
                if thing == receivers.own[m]:  # its edges turn with the mirror
                    put(found, m, r, t, source, in_mirror(receivers, m, q), far, field, OWN_PLATE, thing)
                else:
                    seems = mirrored(scene, THE_GROUND, q) if after else q
                    put(found, m, r, t, seems, place, near, field, DIFFRACTED, thing)


@kernel
def unturned(scene, wanted, receivers, found, m, t):
    """Add direct rays and those off the ground."""
    origin = at(scene.transmitter, t)
    ground = scene.face_thing[THE_GROUND]
    for r in range(receivers.place.shape[1]):
        a, place = receiver_at(receivers, m, r), at(receivers.place[m], r)
        if math.isnan(a[0]):
            continue
        if free(scene, wanted, origin, a, NOTHING, NOTHING):
            field = times(1.0 / length(minus(a, origin)), launched(scene, towards(origin, a)))
            put(found, m, r, t, origin, place, 0.0, field, DIRECT, NOTHING)
        if wanted.ground:
            ok, field = reflected(scene, wanted, t, THE_GROUND, NO_FACE, a, 0.0)
            if ok:
                put(found, m, r, t, mirrored(scene, THE_GROUND, origin), place, 0.0, field, GROUND, ground)


@kernel
def face_of(scene, near, i):
    """Face i of those about a mirror: of the plates near it, then of all boxes."""
    return 1 + near[i] if i < len(near) else 1 + scene.centre.shape[0] + i - len(near)


@kernel_rows
def rays_of_mirrors(begin, end, scene, wanted, receivers, middle, spread, found):
    """Find the rays of mirrors; ``middle`` (mirror, xyz) and ``spread`` (mirror,) are spheres about their receivers."""
    # each helper is called at one place: LLVM would inline it everywhere, and compile for minutes
    n_plate, n_edge = scene.centre.shape[0], scene.edge_from.shape[0]
    for m in range(begin, end):
        found.n_ray[m] = 0
        here = at(middle, m)
        if math.isnan(here[0]):
            continue
        own = receivers.own[m]
        near = receivers.near[receivers.near_start[m] : receivers.near_start[m + 1]]
        n_face = len(near) + 6 * scene.box_centre.shape[0]
        for t in range(scene.transmitter.shape[0]):
            unturned(scene, wanted, receivers, found, m, t)
            for i in range(n_face if wanted.specular else 0):
                f = face_of(scene, near, i)
                if f != 1 + own:
                    off_face(scene, wanted, receivers, found, m, t, f, here, spread[m])
            for i in range(-2, (n_face if wanted.specular else 0) if wanted.own_plate and own >= 0 else -2):
                f = face_of(scene, near, i) if i >= 0 else NO_FACE if i == -2 else THE_GROUND
                if f != 1 + own and (f != THE_GROUND or wanted.ground):
                    off_own_plate(scene, wanted, receivers, found, m, t, f, here, spread[m])
            for i in range(-1 if wanted.box_edges else 0, len(near) + 1 if wanted.plate_edges else 0):
                p = near[i] if 0 <= i < len(near) else own
                first, behind = (4 * n_plate, n_edge) if i < 0 else (4 * p, 4 * p + 4)
                if i < 0 or p != own or (i == len(near) and wanted.own_plate and own >= 0):
                    round_edges(scene, wanted, receivers, found, m, t, first, behind, here, spread[m])
