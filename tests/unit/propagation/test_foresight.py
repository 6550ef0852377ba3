"""Rays against closed forms: mirror images, Fresnel, Sommerfeld's half-plane; what hides; what turns with a mirror."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import fresnel

from rfpose.errors import GeometryError, InvalidInputError
from rfpose.geometry import rot_enu_from_mirror, unit
from rfpose.multilat.ground import Surface
from rfpose.multilat.ground.model import fresnel_coefficient
from rfpose.propagation import (
    BoxesStanding,
    Foresight,
    PlatesStanding,
    RayKind,
    Rays,
    ReceiverStand,
    Soil,
    Surroundings,
    _kernels,
    bystanders,
    foresee,
    foresight,
)

CARRIER_HZ = 433e6
SPEED_MPS = 299_792_458.0
WAVENUMBER = 2.0 * np.pi * CARRIER_HZ / SPEED_MPS
BARE = Surroundings()
ALL = Foresight(faint=0.0, reach_m=1e6)


def plates(*those) -> PlatesStanding:
    """Plates given by centre, normal and size."""
    centre, normal, size = (np.array(column, float) for column in zip(*those, strict=True))
    return PlatesStanding(centre_enu_m=centre, rot_enu_from_mirror=rot_enu_from_mirror(normal), size_m=size)


def boxes(base, size, azimuth_deg=0.0, permittivity=5.24) -> BoxesStanding:
    return BoxesStanding(
        base_enu_m=np.array([base], float),
        size_m=np.array([size], float),
        azimuth_rad=np.radians([azimuth_deg]),
        permittivity=np.array([permittivity]),
        conductivity_s_per_m=np.zeros(1),
    )


def rays_to(places, transmitter, surroundings, options=ALL) -> Rays:
    return foresee([transmitter], [CARRIER_HZ], bystanders(np.atleast_2d(places)), surroundings, options)


def ways_m(rays: Rays, stand: ReceiverStand, n_transmitter: int = 1) -> tuple[np.ndarray, np.ndarray]:
    link = np.repeat(np.arange(len(rays.first) - 1), np.diff(rays.first))
    mirror = link // (stand.receiver_mirror_m.shape[1] * n_transmitter)
    place = stand.pivot_enu_m[mirror] + np.einsum("kab,kb->ka", stand.rot_enu_from_mirror[mirror], rays.place_mirror_m)
    return link, np.linalg.norm(rays.source_enu_m - place, axis=1) + rays.extra_m


def theta(direction):
    """Unit vector of growing polar angle."""
    flat = np.hypot(direction[..., 0], direction[..., 1])
    up = direction[..., 2]
    return np.stack([up * direction[..., 0] / flat, up * direction[..., 1] / flat, -flat], axis=-1)


# -- direct and ground -------------------------------------------------------------------------------------------------


def test_the_direct_ray_is_the_convention_of_fields():
    place, transmitter = np.array([3.0, 4.0, 2.0]), np.array([30.0, -40.0, 25.0])
    rays = rays_to(place, transmitter, BARE)
    distance = np.linalg.norm(transmitter - place)
    assert rays.n_ray == 1
    assert (rays.kind[0], rays.thing[0], rays.extra_m[0]) == (RayKind.DIRECT, -1, 0.0)
    np.testing.assert_array_equal(rays.source_enu_m[0], transmitter)
    np.testing.assert_allclose(rays.field_enu[0], theta(unit(place - transmitter)) / distance, rtol=1e-12)


def test_arrays_that_are_read_only_are_not_compiled_for():
    place, transmitter = np.array([[3.0, 4.0, 2.0]]), np.array([[30.0, -40.0, 25.0]])
    stand, carrier = bystanders(place), np.array([CARRIER_HZ])
    rot, own = np.array(stand.rot_enu_from_mirror), np.array(stand.own_plate)
    stand = replace(stand, rot_enu_from_mirror=rot, own_plate=own)
    foresee(transmitter, carrier, stand, BARE)
    known = list(_kernels.rays_of_mirrors.compiled.signatures)
    for array in (transmitter, carrier, rot, own):
        array.flags.writeable = False
    foresee(transmitter, carrier, stand, BARE)
    assert _kernels.rays_of_mirrors.compiled.signatures == known


@pytest.mark.parametrize("far_m", [1.0, 20.0, 77.459667, 300.0, 3e4])
def test_the_ground_ray_is_that_of_the_image_with_fresnels_coefficient(far_m):
    soil = Soil(permittivity=15.0, conductivity_s_per_m=0.02, height_m=-1.0)
    transmitter, place = np.array([far_m, 0.0, 14.0]), np.array([0.0, 0.0, 4.0])
    rays = rays_to(place, transmitter, Surroundings(soil=soil))
    assert rays.kind.tolist() == [RayKind.DIRECT, RayKind.GROUND]
    image = np.array([far_m, 0.0, -16.0])
    way = np.linalg.norm(image - place)
    np.testing.assert_allclose(rays.source_enu_m[1], image)
    arrival = theta(unit(image - place))
    coefficient = fresnel_coefficient(
        Surface(permittivity=15.0, conductivity_s_per_m=0.02), np.arcsin(20.0 / way), CARRIER_HZ
    )
    np.testing.assert_allclose(rays.field_enu[1], coefficient * arrival / way, rtol=1e-9, atol=1e-12)


def test_fresnel_at_the_limits():
    """Straight down (1 − n)/(1 + n), at Brewster's angle nothing, grazing −1."""

    def coefficient(grazing_rad):
        far = 20.0 / np.tan(grazing_rad)
        rays = rays_to([0.0, 0.0, 10.0], [far, 0.0, 10.0], Surroundings(soil=Soil(permittivity=9.0)))
        along = theta(unit(np.array([far, 0.0, -20.0])))
        return (rays.field_enu[1] @ along) * np.hypot(far, 20.0)

    assert coefficient(np.arctan(1.0 / 3.0)) == pytest.approx(0.0, abs=1e-12)
    assert coefficient(1e-4) == pytest.approx(-1.0, abs=2e-3)
    # the vertical coefficient keeps its sign upwards, so that the horizontal part turns around
    assert coefficient(np.pi / 2 - 1e-6) == pytest.approx(0.5, abs=1e-6)


def test_a_wall_reflects_a_vertical_field_as_one_across_the_plane_of_incidence():
    wall = Surroundings(boxes=boxes([0.0, 0.0, -50.0], [2.0, 400.0, 100.0], permittivity=4.0))
    place, transmitter = np.array([31.0, 10.0, 0.0]), np.array([41.0, -10.0, 0.0])
    rays = rays_to(place, transmitter, wall, replace(ALL, diffracted="none"))
    assert rays.kind.tolist() == [RayKind.DIRECT, RayKind.SPECULAR]
    image = np.array([-39.0, -10.0, 0.0])
    np.testing.assert_allclose(rays.source_enu_m[1], image, atol=1e-9)
    way = np.linalg.norm(image - place)
    s = 70.0 / way
    q = np.sqrt(4.0 - 1.0 + s**2)
    np.testing.assert_allclose(rays.field_enu[1], [0, 0, -(s - q) / (s + q) / way], atol=1e-12)


def test_a_sloping_ground_reflects_in_its_own_plane():
    normal = (0.1, 0.0, 1.0)
    rays = rays_to([0, 0, 5.0], [50.0, 20.0, 30.0], Surroundings(soil=Soil(permittivity=1e6, normal_enu=normal)))
    up = unit(normal)
    image = np.array([50.0, 20.0, 30.0]) - 2.0 * (np.array([50.0, 20.0, 30.0]) @ up) * up
    np.testing.assert_allclose(rays.source_enu_m[1], image)
    assert np.linalg.norm(rays.field_enu[1]) * np.linalg.norm(image - [0, 0, 5.0]) == pytest.approx(1.0, abs=0.05)


def test_a_half_wave_dipole_sends_most_to_the_horizon_and_nothing_up():
    dipole = replace(ALL, antenna="half_wave")
    level = rays_to([40.0, 0, 10.0], [0, 0, 10.0], BARE, dipole)
    assert np.linalg.norm(level.field_enu) * 40.0 == pytest.approx(np.sqrt(1.643), rel=1e-3)
    aslant = rays_to([40.0, 0, 50.0], [0, 0, 10.0], BARE, dipole)
    expected = np.sqrt(1.643) * np.cos(np.pi / 2 * np.cos(np.pi / 4)) / np.sin(np.pi / 4)
    assert np.linalg.norm(aslant.field_enu) * np.hypot(40, 40) == pytest.approx(expected, rel=1e-3)
    assert np.linalg.norm(rays_to([0, 0, 50.0], [0, 0, 10.0], BARE, dipole).field_enu) == 0.0
    assert np.linalg.norm(rays_to([0, 0, 50.0], [0, 0, 10.0], BARE).field_enu) * 40.0 == pytest.approx(1.0)


# -- what hides --------------------------------------------------------------------------------------------------------

SCREEN = plates(([10.0, 0.0, 2.0], [1.0, 0.0, 0.0], [2.0, 3.0]))
HUT = boxes([10.0, 0.0, 0.0], [2.0, 4.0, 3.0], azimuth_deg=45.0)
SQUARE = boxes([10.0, 3.0, 0.0], [2.0, 4.0, 3.0])


@pytest.mark.parametrize(
    ("things", "place", "seen"),
    [
        (Surroundings(plates=SCREEN), [20.0, 0.0, 2.0], False),
        (Surroundings(plates=SCREEN), [20.0, 1.99, 4.9], False),
        (Surroundings(plates=SCREEN), [20.0, 2.01, 2.0], True),
        (Surroundings(plates=SCREEN), [20.0, 0.0, 5.1], True),
        (Surroundings(plates=SCREEN), [9.9, 0.0, 2.0], True),
        (Surroundings(boxes=HUT), [20.0, 0.0, 2.0], False),
        (Surroundings(boxes=HUT), [20.0, 0.0, 5.0], True),
        (Surroundings(boxes=HUT), [20.0, 3.5, 2.0], False),  # a corner of it, as it is turned
        (Surroundings(boxes=HUT), [20.0, 6.5, 2.0], True),
        (Surroundings(boxes=HUT), [7.0, 0.0, 2.0], True),
        (Surroundings(boxes=SQUARE), [20.0, 0.0, 2.0], True),  # along its wall, 1 m beside it
        (Surroundings(boxes=SQUARE), [20.0, 6.1, 2.0], False),
    ],
)
def test_a_plate_and_a_box_hide_what_is_behind_them(things, place, seen):
    def n_direct(options):
        return int(np.sum(rays_to(place, [0.0, 0.0, 2.0], things, options).kind == RayKind.DIRECT))

    assert n_direct(ALL) == seen
    assert n_direct(replace(ALL, visibility=False)) == 1


def test_a_ground_ray_needs_both_its_legs():
    soil = Soil(permittivity=15.0)
    lower = plates(([15.0, 0.0, 0.75], [1.0, 0.0, 0.0], [2.0, 1.4]))
    for things, kinds in (
        (Surroundings(soil=soil, plates=lower), [RayKind.DIRECT]),
        (Surroundings(soil=soil), [RayKind.DIRECT, RayKind.GROUND]),
        (Surroundings(soil=soil, plates=SCREEN), [RayKind.GROUND]),
    ):
        rays = rays_to([20.0, 0.0, 2.0], [0.0, 0.0, 2.0], things, Foresight(specular=False, diffracted="none"))
        assert rays.kind.tolist() == kinds


def test_a_mirrors_own_plate_hides_and_a_flush_receiver_looks_out_of_its_front():
    own = plates(([0.0, 0.0, 5.0], [0.0, 0.0, 1.0], [2.0, 2.0]))
    stand = ReceiverStand(
        pivot_enu_m=np.array([[0.0, 0.0, 5.0]]),
        rot_enu_from_mirror=own.rot_enu_from_mirror,
        receiver_mirror_m=np.array([[[0.5, 0.0, 0.1], [0.5, 0.0, 0.0], [0.5, 0.0, -0.1], [1.2, 0.0, -0.1]]]),
        own_plate=np.array([0]),
    )
    for up, seen in ((40.0, [1, 1, 0, 1]), (-40.0, [0, 0, 1, 1])):
        rays = foresee([[3.0, 0.0, up]], [CARRIER_HZ], stand, Surroundings(plates=own), Foresight(diffracted="none"))
        direct = np.add.reduceat(rays.kind == RayKind.DIRECT, rays.first[:-1]) * (np.diff(rays.first) > 0)
        assert direct.tolist() == seen


# -- plates ------------------------------------------------------------------------------------------------------------


def test_a_plate_reflects_where_its_point_lies_on_it():
    """The image's ray, all of the field; beyond the rim no ray."""
    plate = plates(([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [2.0, 2.0]))
    transmitter = np.array([-10.0, 0.5, 10.0])
    for x, reflects in ((8.1, True), (10.0, True), (11.9, True), (12.1, False), (7.9, False)):
        place = np.array([x, 0.5, 10.0])
        rays = rays_to(place, transmitter, Surroundings(plates=plate), replace(ALL, diffracted="none"))
        assert np.sum(rays.kind == RayKind.SPECULAR) == reflects
        if reflects:
            image = transmitter * [1, 1, -1]
            way = np.linalg.norm(image - place)
            np.testing.assert_allclose(rays.source_enu_m[1], image, atol=1e-12)
            field = theta(unit(image - place)) / way  # metal: the vertical part stays as it is
            np.testing.assert_allclose(rays.field_enu[1], field, atol=1e-12)


def test_ground_and_plate_in_either_order():
    """Each ray that meets both is that of the image of an image, and belongs to the plate."""
    wall = plates(([0.0, 0.0, 10.0], [1.0, 0.0, 0.0], [40.0, 19.9]))
    things = Surroundings(plates=wall, soil=Soil(permittivity=15.0))
    rays = rays_to([10.0, 0.0, 4.0], [30.0, 5.0, 8.0], things, replace(ALL, diffracted="none"))
    two = np.flatnonzero((rays.kind == RayKind.SPECULAR) & (rays.source_enu_m[:, 2] < 0.0))
    # a vertical wall: the two orders have one image, and the wall's point tells which of them there is
    assert len(two) == 1
    np.testing.assert_allclose(rays.source_enu_m[two[0]], [-30.0, 5.0, -8.0], atol=1e-9)
    assert rays.thing[two].tolist() == [0]
    assert rays.kind.tolist().count(RayKind.SPECULAR) == 2


# -- edges -------------------------------------------------------------------------------------------------------------


def half_plane(rho_m, phi, phi_source, soft):
    """Sommerfeld's solution for a plane wave on a half-plane at φ = 0, time as e^{+jωt}; B. D. Born & Wolf §11.5."""

    def part(angle):
        s, c = fresnel(-np.sqrt(2.0 * WAVENUMBER * rho_m) * np.cos(angle / 2.0) * np.sqrt(2.0 / np.pi))
        tail = np.sqrt(np.pi / 2.0) * ((0.5 - c) - 1j * (0.5 - s))
        return np.exp(0.25j * np.pi + 1j * WAVENUMBER * rho_m * np.cos(angle)) / np.sqrt(np.pi) * tail

    return part(phi - phi_source) + (-1.0 if soft else 1.0) * part(phi + phi_source)


WIDE_M, FAR_M = 2e4, 8e3
# columns: along the width, along the height, the normal; the edge of interest runs along z (soft) or along x (hard)
UPRIGHT = np.stack([[1, 0, 0], [0, 0, 1], [0, -1, 0]], axis=1).astype(float)


def about_the_edge(soft, phi, rho_m):
    """Place at an angle from a half-plane's face: the plate lies at φ = 0."""
    if soft:
        return rho_m * np.stack([np.cos(phi), -np.sin(phi), 0.0 * phi], axis=-1)
    return rho_m * np.stack([0.0 * phi, -np.cos(phi), np.sin(phi)], axis=-1)


def around_half_plane(soft, rho_m, phi, phi_source):
    """Field about the edge of a half-plane, against that of the wave without it: E along the edge, or H."""
    plate = PlatesStanding(
        centre_enu_m=np.array([[0.5 * WIDE_M, 0, 0] if soft else [0, -0.5 * WIDE_M, 0]]),
        rot_enu_from_mirror=(UPRIGHT if soft else np.eye(3))[None],
        size_m=np.array([[WIDE_M, WIDE_M]]),
    )
    transmitter = about_the_edge(soft, np.array(phi_source), FAR_M)
    place = about_the_edge(soft, phi, rho_m)
    rays = rays_to(place, transmitter, Surroundings(plates=plate))
    link, way = ways_m(rays, bystanders(place))
    near = (rays.kind != RayKind.DIFFRACTED) | (np.linalg.norm(rays.source_enu_m, axis=1) < 0.1 * WIDE_M)
    travel = unit(place[link] - rays.source_enu_m)
    value = rays.field_enu[:, 2] if soft else np.cross(travel, rays.field_enu)[:, 0]
    start = unit(-transmitter)
    alone = theta(start)[2] if soft else np.cross(start, theta(start))[0]
    out = np.zeros(len(place), complex)
    np.add.at(out, link[near], (value / alone * np.exp(-1j * WAVENUMBER * (way - FAR_M)) * FAR_M)[near])
    return out


@pytest.mark.parametrize("soft", [True, False], ids=["E along the edge", "H along the edge"])
@pytest.mark.parametrize("phi_source_deg", [50.0, 85.0, 130.0])
@pytest.mark.parametrize("rho_m", [0.2, 1.5])
def test_all_rays_about_a_half_plane_are_sommerfelds_field(soft, phi_source_deg, rho_m):
    phi, source = np.radians(np.linspace(3.0, 357.0, 90)), np.radians(phi_source_deg)
    found = around_half_plane(soft, rho_m, phi, source)
    # the source is 8 km off, not infinitely far: its wave is curved by k ρ² / 2 R
    tolerance = 5e-5 + 1.5 * WAVENUMBER * rho_m**2 / FAR_M
    np.testing.assert_allclose(found, half_plane(rho_m, phi, source, soft), atol=tolerance)


@pytest.mark.parametrize("soft", [True, False])
def test_on_the_shadow_boundary_half_the_field_is_left_and_nothing_jumps(soft):
    source = np.radians(70.0)
    boundary = np.pi + source
    phi = boundary + np.array([-1e-5, 1e-5])
    before, after = around_half_plane(soft, 1.0, phi, source)
    assert abs(before - after) < 1e-3
    without = np.exp(1j * WAVENUMBER * np.cos(boundary - source))
    reflected_at_boundary = half_plane(1.0, boundary, source, soft) - 0.5 * without
    assert abs(before - reflected_at_boundary) == pytest.approx(0.5, abs=0.01)


def test_reception_is_reciprocal_over_ground_and_metal():
    """Antennas along θ at both ends: who sends and who receives does not matter."""
    things = Surroundings(
        plates=plates(
            ([5.0, 3.0, 2.5], [0.3, -1.0, 0.6], [2.0, 2.0]), ([-2.0, -4.0, 2.0], [0.0, 1.0, 0.4], [3.0, 2.0])
        ),
        soil=Soil(permittivity=15.0, conductivity_s_per_m=0.01),
    )
    a, b = np.array([12.0, 1.0, 6.0]), np.array([0.5, -1.0, 1.5])

    def heard(sender, receiver):
        rays = rays_to(receiver, sender, things)
        _, way = ways_m(rays, bystanders(receiver[None]))
        kinds = {RayKind(k) for k in rays.kind}
        arrival = theta(unit(rays.source_enu_m - receiver))
        return np.sum(rays.field_enu * arrival, axis=1) * np.exp(-1j * WAVENUMBER * way), kinds, way

    one, kinds, way = heard(a, b)
    other, _, way_back = heard(b, a)
    assert {RayKind.DIRECT, RayKind.GROUND, RayKind.DIFFRACTED} <= kinds
    np.testing.assert_allclose(np.sort(way), np.sort(way_back), rtol=1e-12)
    np.testing.assert_allclose(one[np.argsort(way)], other[np.argsort(way_back)], atol=1e-12)


def test_edges_can_be_those_of_boxes_alone():
    things = Surroundings(plates=SCREEN, boxes=boxes([10.0, 12.0, 0.0], [2.0, 4.0, 3.0]), soil=Soil(permittivity=15.0))
    bent = {}
    for which in ("none", "boxes", "all"):
        rays = rays_to([20.0, 3.0, 2.0], [0.0, 0.0, 2.5], things, replace(ALL, diffracted=which))
        bent[which] = set(rays.thing[rays.kind == RayKind.DIFFRACTED].tolist())
    assert bent == {"none": set(), "boxes": {1}, "all": {0, 1}}


# -- the mirror's own plate --------------------------------------------------------------------------------------------


def test_rays_of_the_own_plate_turn_with_the_mirror():
    """Their paths in a pose nearby are those foreseen there: the images' exactly, the edges' to second order."""
    pivot, normal = np.array([[20.0, 5.0, 3.0]]), np.array([[0.3, -0.6, 0.8]])
    place = np.array([[[1.12, 0.8, 0.05], [-0.5, 0.8, 0.1], [-0.5, -0.8, 0.1]]])
    transmitters = np.array([[100.0, -20.0, 30.0], [-50.0, -86.0, 20.0], [0.0, -50.0, 40.0]])
    arm = 0.2

    def there(turn):
        rot = rot_enu_from_mirror(unit(normal + turn))
        own = PlatesStanding(
            centre_enu_m=pivot + arm * rot[:, :, 2], rot_enu_from_mirror=rot, size_m=np.array([[2.0, 2.0]])
        )
        stand = ReceiverStand(
            pivot_enu_m=pivot,
            rot_enu_from_mirror=rot,
            receiver_mirror_m=np.add(place, [0.0, 0.0, arm]),
            own_plate=np.array([0]),
        )
        things = Surroundings(plates=own, soil=Soil(permittivity=15.0))
        return stand, foresee(transmitters, np.full(3, CARRIER_HZ), stand, things, replace(ALL, specular=False))

    stand, rays = there(0.0)
    moved_stand, moved = there(1e-4 * np.array([1.0, 0.5, -0.3]))
    np.testing.assert_array_equal(rays.first, moved.first)
    np.testing.assert_array_equal(rays.kind, moved.kind)
    predicted = ways_m(rays, moved_stand, 3)[1]
    wanted = ways_m(moved, moved_stand, 3)[1]
    own = rays.kind == RayKind.OWN_PLATE
    images = own & (rays.extra_m == 0.0)
    static = own & (rays.source_enu_m[:, 2] > 0.0)
    assert images.sum() >= 5
    assert (own & ~images).sum() >= 5
    np.testing.assert_allclose(predicted[images], wanted[images], atol=1e-9)
    link = ways_m(rays, stand, 3)[0]
    receiver = (pivot + (place[0] + [0.0, 0.0, arm]) @ stand.rot_enu_from_mirror[0].T)[link // 3]
    up = stand.rot_enu_from_mirror[0, :, 2]
    mirrored = receiver - 2.0 * ((receiver - pivot) @ up - arm)[:, None] * up
    np.testing.assert_allclose(
        ways_m(rays, stand, 3)[1][images], np.linalg.norm(rays.source_enu_m - mirrored, axis=1)[images]
    )
    still = ways_m(rays, stand, 3)[1]
    assert np.abs(wanted - still)[static & ~images].max() > 2e-5
    assert np.abs(predicted - wanted)[own].max() < 0.4 * np.abs(wanted - still)[own].max()


# -- records and limits ------------------------------------------------------------------------------------------------


def crowd(n_mirror=7):
    """Mirrors with plates, a box and ground: links with more rays than there is room for at first."""
    rng = np.random.default_rng(5)
    pivot = np.column_stack([rng.uniform(-20, 20, (n_mirror, 2)), np.full(n_mirror, 2.5)])
    rot = rot_enu_from_mirror(rng.normal([0.0, -0.5, 1.0], 0.4, (n_mirror, 3)))
    own = PlatesStanding(centre_enu_m=pivot, rot_enu_from_mirror=rot, size_m=np.full((n_mirror, 2), 3.0))
    place = np.broadcast_to([[1.7, 1.0, 0.05], [-1.7, 1.0, 0.05], [0.0, -1.7, 0.05]], (n_mirror, 3, 3)).copy()
    place[2, 1] = np.nan
    rot = rot.copy()
    stand = ReceiverStand(
        pivot_enu_m=pivot, rot_enu_from_mirror=rot, receiver_mirror_m=place, own_plate=np.arange(n_mirror)
    )
    rot[4] = np.nan
    things = Surroundings(plates=own, boxes=boxes([30.0, 0.0, 0.0], [5.0, 5.0, 30.0]), soil=Soil(permittivity=15.0))
    transmitter = np.array([[60.0, 10.0, 20.0], [-50.0, 30.0, 25.0], [0.0, -60.0, 30.0]])
    return transmitter, np.full(3, CARRIER_HZ), stand, things


def test_links_of_what_is_not_known_have_no_rays():
    rays = foresee(*crowd(), Foresight(faint=0.0))
    count = np.diff(rays.first).reshape(7, 3, 3)
    assert (count[4] == 0).all()
    assert (count[2, 1] == 0).all()
    assert count.max() > 8
    assert (count > 0).sum() > 40
    assert np.isfinite(rays.field_enu).all()
    assert set(rays.thing.tolist()) <= set(range(-1, 9))
    assert (rays.thing[rays.kind == RayKind.GROUND] == 8).all()


def test_blocks_of_mirrors_make_no_difference(monkeypatch):
    whole = foresee(*crowd(), ALL)
    monkeypatch.setattr(foresight, "_BLOCK_LINKS", 18)
    parts = foresee(*crowd(), ALL)
    for name in Rays.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))


def test_plates_out_of_reach_hide_but_turn_nothing():
    transmitter, carrier, stand, things = crowd()
    near = foresee(transmitter, carrier, stand, things, Foresight(reach_m=0.0, faint=0.0))
    others = (near.thing >= 0) & (near.thing < 7)
    assert (near.kind[others] == RayKind.OWN_PLATE).all()
    far = foresee(transmitter, carrier, stand, things, ALL)
    assert np.sum(near.kind == RayKind.DIRECT) == np.sum(far.kind == RayKind.DIRECT)


def test_faint_rays_are_left_out_and_no_others():
    transmitter, carrier, stand, things = crowd()
    everything = foresee(transmitter, carrier, stand, things, ALL)
    some = foresee(transmitter, carrier, stand, things, replace(ALL, faint=0.02))
    place = stand.pivot_enu_m[:, None] + np.einsum("mab,mrb->mra", stand.rot_enu_from_mirror, stand.receiver_mirror_m)
    distance = np.linalg.norm(transmitter - place[:, :, None], axis=3).ravel()
    link, _ = ways_m(everything, stand, 3)
    relative = np.linalg.norm(everything.field_enu, axis=1) * distance[link]
    assert some.n_ray == np.sum((relative >= 0.02) | (everything.kind == RayKind.GROUND))


def test_what_cannot_be_is_refused():
    transmitter, carrier, stand, things = crowd()
    with pytest.raises(GeometryError, match="transmitter 1 lies 2 m below the ground"):
        foresee([[0, 0, 5.0], [0, 0, -2.0]], carrier[:2], stand, things)
    with pytest.raises(InvalidInputError, match="`carrier_rf_hz` must be greater than zero"):
        foresee(transmitter, -carrier, stand, things)
    with pytest.raises(InvalidInputError, match="`own_plate` must be less than the number of plates, 0"):
        foresee(transmitter, carrier, stand, BARE)
    with pytest.raises(InvalidInputError, match="size_m"):
        plates(([0, 0, 0], [0, 0, 1], [2.0, 0.0]))
    for wrong in ({"diffracted": "some"}, {"wedge": "sharp"}, {"antenna": "dish"}, {"faint": 1.0}, {"reach_m": -1.0}):
        with pytest.raises(InvalidInputError, match=f"`{next(iter(wrong))}` must"):
            Foresight(**wrong)
