"""Occlusion against a plain search over all plates, single cases, and Edwards' shading (V3, V5, V6, V13)."""

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.layout.fields import cornfield
from rfpose.layout.maps import mirrors_facing
from rfpose.layout.sight import Plates, Tower, discs_lit, lit_share, visible

PLACES = np.array([[1.4, 0.0, 0.05], [-0.7, 1.2, 0.05], [-0.7, -1.2, -0.05]])
PLATE = Plates(width_m=3.0, height_m=2.6, arm_m=0.2)


def hidden_plainly(a, b, centre, rot):
    """Whether the straight way meets the rectangle, in the plate's own frame."""
    local = np.array([(p - centre) @ rot for p in (a, b)])
    if local[0, 2] * local[1, 2] >= 0.0:
        return False
    x, y = local[0, :2] + local[0, 2] / (local[0, 2] - local[1, 2]) * (local[1, :2] - local[0, :2])
    return bool(abs(x) < 1.5 and abs(y) < 1.3)


def test_grid_finds_what_a_plain_search_finds():
    rng = np.random.default_rng(3)
    pivot = cornfield(80, column_m=4.0, row_m=4.0, height_m=2.0)
    pivot[:, 2] += rng.uniform(0.0, 1.0, 80)
    normal = rng.normal(size=(80, 3))
    normal[:, 2] = np.abs(normal[:, 2])
    mirrors = mirrors_facing(pivot, PLACES, normal_enu=normal, arm_m=0.2)
    transmitter = np.array([[30.0, 5.0, 8.0], [-25.0, 20.0, 3.0], [0.3, 0.2, 25.0], [5.0, -40.0, 1.0]])
    got = visible(transmitter, mirrors, PLATE)
    centre = pivot + 0.2 * mirrors.normal_enu
    receiver = mirrors.receiver_enu_m
    for m in range(80):
        for r in range(3):
            for t in range(4):
                blocked = any(
                    hidden_plainly(receiver[m, r], transmitter[t], centre[o], mirrors.rot_enu_from_mirror[o])
                    for o in range(80)
                )
                assert got[m, r, t] == (not blocked)
    assert 0.2 < got.mean() < 0.9


def one(normal, place):
    return mirrors_facing([[10.0, 0.0, 2.0]], np.array([place, [1.0, 0.0, 0.1], [0.0, 1.0, 0.1]]), normal_enu=normal)


@pytest.mark.parametrize(
    ("place", "front", "behind"),
    [([0.0, 0.0, 0.1], True, False), ([0.0, 0.0, -0.1], False, True), ([1.6, 0.0, 0.0], True, True)],
    ids=["front", "back", "edge"],
)
def test_own_plate(place, front, behind):
    mirrors = one([-1.0, 0.0, 0.0], place)
    seen = visible([[-50.0, 0.3, 2.0], [70.0, 0.3, 2.0]], mirrors, Plates(width_m=3.0, height_m=3.0))
    assert seen[0, 0].tolist() == [front, behind]


def test_tower_hides_what_is_behind_it_and_not_above():
    mirrors = one([-1.0, 0.0, 0.3], [0.0, 0.0, 0.1])
    tower = Tower(radius_m=2.0, top_m=20.0)
    transmitter = [[-30.0, 0.0, 10.0], [-30.0, 15.0, 10.0], [-30.0, 0.0, 200.0], [5.0, 0.0, 3.0]]
    assert visible(transmitter, mirrors, Plates(width_m=1.0, height_m=1.0), tower=tower)[0, 0].tolist() == [
        False, True, True, True,
    ]  # fmt: skip
    assert visible(transmitter, mirrors, Plates(width_m=1.0, height_m=1.0))[0, 0].all()


def test_plates_have_a_size():
    with pytest.raises(InvalidInputError, match="width_m"):
        Plates(width_m=0.0, height_m=1.0)


def test_two_discs_share_a_lens():
    d = 0.6
    lens = 2.0 * np.arccos(d) / np.pi - d / (0.5 * np.pi) * np.sqrt(1.0 - d**2)
    assert discs_lit([[0.6, 0.0]], diameter_m=1.0) == pytest.approx(1.0 - lens, abs=1e-4)
    assert discs_lit([[0.0, 0.6]], diameter_m=1.0) == pytest.approx(1.0 - lens, abs=1e-4)
    assert discs_lit([[0.0, 0.6], [0.0, 0.6]], diameter_m=1.0) == pytest.approx(1.0 - lens, abs=1e-4)
    assert discs_lit([[0.0, 1.0]], diameter_m=1.0) == 1.0


def square(cover, turned_deg):
    """Places of a square array (dish, xy) in diameters, by ground cover (digest M2, 3.4)."""
    spacing = np.sqrt(np.pi / 4.0 / cover)
    i, j = np.meshgrid(np.arange(-4, 5), np.arange(-4, 5))
    turn = np.radians(turned_deg)
    return spacing * np.stack(
        [(i * np.cos(turn) - j * np.sin(turn)).ravel(), (i * np.sin(turn) + j * np.cos(turn)).ravel()], axis=1
    )


def lit_by_discs(place, sun_enu):
    """What the dish in the middle keeps, by exact areas of discs in the plane across the light (digest M2)."""
    east, north = place.T
    flat = np.hypot(sun_enu[0], sun_enu[1])
    toward = (east * sun_enu[0] + north * sun_enu[1]) / flat
    across = (east * sun_enu[1] - north * sun_enu[0]) / flat
    front = toward > 1e-9
    offset = np.stack([across[front], -toward[front] * sun_enu[2]], axis=1)
    return discs_lit(offset, diameter_m=1.0, n_line=120)


def lit_by_rays(place, sun_enu):
    """The same by the rays that serve radio, past plates that all face the sun."""
    pivot = np.column_stack([place, np.full(len(place), 3.0)])
    mirrors = mirrors_facing(pivot, 0.1 * PLACES, normal_enu=sun_enu)
    middle = int(np.argmin(np.linalg.norm(place, axis=1)))
    dish = Plates(width_m=1.0, height_m=1.0, shape="disc")
    return lit_share(mirrors, dish, sun_enu=sun_enu, rows=[middle])[0]


LIT = {"discs": lit_by_discs, "rays": lit_by_rays}


def annual_lit(place, latitude_deg, lit):
    """Share of the year's direct light that the dish in the middle keeps (digest M1, M2)."""
    latitude = np.radians(latitude_deg)
    kept = total = 0.0
    for year in (np.arange(12) + 0.5) / 24.0 - 0.25:
        declination = np.arcsin(0.40 * np.sin(2.0 * np.pi * year))
        for hour in 2.0 * np.pi * ((np.arange(40) + 0.5) / 40.0 - 0.5):
            s = np.array(
                [
                    -np.cos(declination) * np.sin(hour),
                    np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(hour),
                    np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour),
                ]
            )
            if s[2] < np.sin(np.radians(5.0)):
                continue
            mass = np.sqrt((755.6 * s[2]) ** 2 + 2.0 * 755.6 + 1.0) - 755.6 * s[2]
            light = 1353.0 * (1.0 - 0.232 * mass**0.427)
            kept += light * lit(place, s / np.linalg.norm(s))
            total += light
    return kept / total


@pytest.mark.parametrize("lit", LIT.values(), ids=LIT)
def test_edwards_v3_square_array(lit):
    # V3: f = 0.98; recomputed independently 0.9785
    assert annual_lit(square(0.13, 45.0), -35.0, lit) == pytest.approx(0.9785, abs=0.003)


@pytest.mark.parametrize("lit", LIT.values(), ids=LIT)
def test_edwards_v5_rectangular_array_becomes_square(lit):
    # V5: rows 1.43 D apart; at a ground cover of 0.384 the rectangular array is the square one
    i, j = np.meshgrid(np.arange(-4, 5), np.arange(-4, 5))
    rectangular = np.stack([np.pi / 4.0 / 0.384 / 1.43 * i.ravel(), 1.43 * j.ravel()], axis=1)
    np.testing.assert_allclose(rectangular, square(0.384, 0.0), atol=4 * 0.001)
    assert annual_lit(rectangular, -35.0, lit) == pytest.approx(
        annual_lit(square(0.384, 0.0), -35.0, LIT["discs"]), abs=0.003
    )


@pytest.mark.parametrize("lit", LIT.values(), ids=LIT)
def test_edwards_v13_turned_array_shades_less(lit):
    # V13, recomputed: 25° S 0.9569 against 0.9485
    turned, straight = (annual_lit(square(0.23, turn), -25.0, lit) for turn in (45.0, 0.0))
    assert turned == pytest.approx(0.9569, abs=0.003)
    assert straight == pytest.approx(0.9485, abs=0.003)


def row(spacing):
    return np.stack([np.zeros(11), spacing * np.arange(-5, 6)], axis=1)


@pytest.mark.parametrize("lit", LIT.values(), ids=LIT)
def test_edwards_v6_shading_in_a_row(lit):
    # V6, recomputed shading at three spacings, 35° S
    kept = [annual_lit(row(x), -35.0, lit) for x in (1.05, 1.28, 1.43)]
    assert kept == pytest.approx([0.946, 0.9825, 0.9925], abs=0.003)


def test_edwards_v6_best_spacing():
    # V6: 35° S, links 10 $/m, dishes of 5 m at 50 $/m²: best spacing 1.28 D
    spacing = np.arange(1.05, 1.6, 0.01)
    kept = np.array([annual_lit(row(x), -35.0, lit_by_discs) for x in spacing])
    cost = (50.0 * np.pi * 25.0 / 4.0 + 2.0 * 10.0 * 5.0 * spacing) / kept
    assert spacing[np.argmin(cost)] == pytest.approx(1.28, abs=0.03)


def test_light_that_a_neighbour_blocks():
    # a wall of a mirror halfway to the aim, its shadow elsewhere: half of the light behind it is lost
    mirrors = mirrors_facing(
        [[0.0, 0.0, 2.0], [10.0, 0.0, 2.0], [60.0, 0.0, 2.0]],
        PLACES,
        normal_enu=[[1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0]],
    )
    plate = Plates(width_m=2.0, height_m=2.0)
    aim = [20.0, 0.0, 2.0]
    lit = lit_share(mirrors, plate, sun_enu=[0.0, 0.0, 1.0], n_side=40)
    sent = lit_share(mirrors, plate, sun_enu=[0.0, 0.0, 1.0], aim_enu_m=aim, n_side=40)
    # the upright one stands edge-on to the zenith, the third looks away from the aim
    assert lit[[0, 2]] == pytest.approx([1.0, 1.0])
    assert sent[0] == pytest.approx(0.0, abs=0.01)
    assert sent[2] == 0.0
    apart = mirrors_facing([[0.0, 0.0, 2.0], [10.0, 1.0, 2.0]], PLACES, normal_enu=[[1.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    half = lit_share(apart, plate, sun_enu=[0.0, 0.0, 1.0], aim_enu_m=[1e4, 0.0, 2.0], n_side=40)[0]
    assert half == pytest.approx(0.5, abs=0.03)
    with pytest.raises(InvalidInputError, match="above the horizon"):
        lit_share(mirrors, plate, sun_enu=[1.0, 0.0, -0.1])


@pytest.mark.parametrize("side", ["front", "back"])
def test_flush_receivers_look_out_of_one_side(side):
    mirrors = one([-1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    seen = visible([[-50.0, 0.3, 2.0], [70.0, 0.3, 2.0]], mirrors, Plates(width_m=3.0, height_m=3.0, flush=side))
    assert seen[0, 0].tolist() == [side == "front", side == "back"]


def test_face_up_in_stow_sees_what_stands_above_its_plate():
    mirrors = one([0.0, 0.0, 1.0], [0.0, 0.0, 0.1])
    high, low = [-50.0, 0.0, 30.0], [5.0, 0.0, 0.5]
    plate = Plates(width_m=3.0, height_m=3.0)
    assert visible([high, low], mirrors, plate)[0, 0].tolist() == [True, False]
    behind = one([0.0, 0.0, 1.0], [0.0, 0.0, -0.1])
    assert visible([high, low], behind, plate)[0, 0].tolist() == [False, True]
