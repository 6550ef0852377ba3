"""Placement under constraints, and what is refused."""

import numpy as np
import pytest

import rfpose as rf
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.layout.maps import check_site, disc_points, mirrors_facing
from rfpose.layout.optimise import (
    Constraints,
    Costs,
    Sightlines,
    Zone,
    efficient,
    evaluate_placement,
    exchange,
    measured,
    optimise,
)
from rfpose.layout.optimise.descent import minimised
from rfpose.layout.optimise.problem import draw_places, problem_of
from rfpose.pipeline.layout import Rules

TRIANGLE = 0.01 * np.array([[1.0, 0.0, 0.0], [-0.5, 0.866, 0.0], [-0.5, -0.866, 0.0]])
FIELD = mirrors_facing(disc_points(100), TRIANGLE, normal_enu=[0.0, -0.5, 1.0])
DISC = Constraints(allowed=(Zone(radius_m=1.0),), height_m=(0.2, 0.5))


@pytest.mark.parametrize("statistic", ["rms", "worst", "p90"])
def test_search_improves_and_repeats(statistic):
    first = optimise(6, FIELD, DISC, statistic=statistic, starts=3, seed=4)
    again = optimise(6, FIELD, DISC, statistic=statistic, starts=3, seed=4)
    np.testing.assert_array_equal(first.transmitter_enu_m, again.transmitter_enu_m)
    rng = np.random.default_rng(0)
    for _ in range(5):
        near = first.transmitter_enu_m + rng.normal(0.0, 0.05, (6, 3))
        near[:, :2] /= np.maximum(1.0, np.linalg.norm(near[:, :2], axis=1))[:, None]
        near[:, 2] = np.clip(near[:, 2], 0.2, 0.5)
        assert evaluate_placement(near, FIELD, statistic=statistic) > first.value * 0.999
    assert first.value == pytest.approx(evaluate_placement(first.transmitter_enu_m, FIELD, statistic=statistic))
    assert first.lost_one > first.value


@pytest.mark.parametrize("statistic", ["rms", "worst", "p90"])
@pytest.mark.parametrize("criterion", ["pdop", "independent", "rigid", "shared-clock"])
def test_slopes_of_the_search_are_those_of_differences(criterion, statistic):
    square = Zone(corner_enu_m=np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]))
    rules = Constraints(
        allowed=(square, Zone(centre_enu_m=(2.0, 0.0), radius_m=0.3)), excluded=(Zone(radius_m=0.2, top_m=0.4),),
        height_m=(0.2, 0.5), separation_m=0.1, clearance_m=0.02, sight=SIGHT,
    )  # fmt: skip
    standing = np.array([[0.0, 0.0, 0.6], [0.9, 0.9, 0.4]])
    problem = problem_of(FIELD, criterion, statistic, 1.0, standing, rules)
    rng = np.random.default_rng(2)
    x = np.stack([draw_places(problem, 6, rng).ravel() for _ in range(3)]) / problem.scale
    step = 1e-6
    value, slope = problem.objective(x)
    margin, by = problem.margins(x)
    assert margin.min() >= 0.0
    for k in range(x.shape[1]):
        moved = step * np.eye(x.shape[1])[k]
        ahead, behind = problem.objective(x + moved)[0], problem.objective(x - moved)[0]
        # ranks of a percentile are held
        assert statistic == "p90" or (ahead - behind) / (2.0 * step) == pytest.approx(slope[:, k], rel=1e-4, abs=1e-5)
        change = (problem.margins(x + moved)[0] - problem.margins(x - moved)[0]) / (2.0 * step)
        np.testing.assert_allclose(change, by[:, k], atol=1e-4)
    for k in range(3):  # each is worked out alike, whichever others are beside it
        alone = (*problem.objective(x[k : k + 1]), *problem.margins(x[k : k + 1]))
        for one, together in zip(alone, (value, slope, margin, by), strict=True):
            np.testing.assert_array_equal(one[0], together[k])


def test_every_constraint_is_met():
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    rules = Constraints(
        allowed=(Zone(corner_enu_m=square), Zone(centre_enu_m=(2.0, 0.0), radius_m=0.3)),
        excluded=(Zone(radius_m=0.5),),
        height_m=(0.2, 0.5),
        separation_m=0.4,
        clearance_m=0.02,
    )
    standing = [[0.0, 0.0, 0.6], [0.9, 0.9, 0.4]]
    best = optimise(7, FIELD, rules, existing_enu_m=standing, starts=3, seed=1)
    np.testing.assert_array_equal(best.transmitter_enu_m[:2], standing)
    new = best.transmitter_enu_m[2:]
    inside = (np.abs(new[:, :2]) <= 1.0 + 1e-5).all(axis=1)
    assert (inside | (np.linalg.norm(new[:, :2] - [2.0, 0.0], axis=1) <= 0.3 + 1e-5)).all()
    assert (np.linalg.norm(new[:, :2], axis=1) >= 0.5 - 1e-5).all()
    assert (new[:, 2] >= 0.2).all()
    assert (new[:, 2] <= 0.5).all()
    apart = np.linalg.norm(best.transmitter_enu_m[:, None, :2] - best.transmitter_enu_m[:, :2], axis=2)
    assert apart[~np.eye(7, dtype=bool)].min() >= 0.4 - 1e-5
    gap = np.linalg.norm(new[:, None, :2] - FIELD.pivot_enu_m[:, :2], axis=2)
    assert gap.min() >= 0.02 - 1e-5


def test_zone_depth_and_its_slope():
    arrow = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 1.0]])
    zone = Zone(corner_enu_m=arrow)
    point = np.array([[2.0, 0.4], [3.9, 2.0], [1.0, 3.0], [-1.0, -1.0]])
    depth, slope = zone.depth(point)
    assert depth == pytest.approx([0.4, 0.1, -7.0 / np.sqrt(13.0), -np.sqrt(2.0)])
    step = np.array([1e-6, 2e-6])
    np.testing.assert_allclose(zone.depth(point + step)[0] - depth, slope @ step, atol=1e-11)


def test_costs_count_new_towers_height_and_cable():
    site = np.array([[0.0, 1.0, 2.0], [3.0, 1.0, 4.0], [3.0, 5.0, 6.0]])
    costs = Costs(per_tower=100.0, per_height_m=10.0, per_cable_m=1.0)
    assert costs.of(site) == pytest.approx(300.0 + 120.0 + (1.0 + 3.0 + 4.0))
    assert costs.of(site, 1) == pytest.approx(200.0 + 100.0 + (3.0 + 4.0))


def test_more_transmitters_are_dearer_and_better():
    found = efficient([optimise(n, FIELD, DISC, costs=Costs(per_tower=2.0), starts=2) for n in (5, 6, 8)])
    value = [placement.value for placement, _ in found]
    assert value == sorted(value, reverse=True)
    assert [placement.cost for placement, _ in found] == [10.0, 12.0, 16.0]
    assert all(free for _, free in found)


@pytest.mark.parametrize(
    ("rules", "n", "error", "text"),
    [
        (Constraints(allowed=(Zone(radius_m=1.0),), height_m=(0.2, 0.5), separation_m=1.5), 10, GeometryError, "room"),
        (DISC, 4, GeometryError, "at least 5"),
        (
            Constraints(allowed=(Zone(radius_m=1.0),), excluded=(Zone(radius_m=1.1),), height_m=(0.2, 0.5)),
            6,
            GeometryError,
            "room",
        ),
        (
            Constraints(allowed=(Zone(radius_m=0.5),), height_m=(0.2, 0.5), clearance_m=0.5),
            6,
            GeometryError,
            "room",
        ),
    ],
)
def test_what_cannot_be_met_is_refused(rules, n, error, text):
    with pytest.raises(error, match=text):
        optimise(n, FIELD, rules, starts=1)


def test_heights_the_wrong_way_round_are_refused():
    with pytest.raises(InvalidInputError, match=r"lowest, highest"):
        Constraints(allowed=(Zone(radius_m=1.0),), height_m=(0.5, 0.2))
    with pytest.raises(GeometryError, match="exist already"):
        optimise(5, FIELD, DISC, existing_enu_m=np.column_stack([disc_points(5)[:, :2], np.full(5, 0.3)]), starts=1)


def test_unknown_statistic_is_refused():
    with pytest.raises(InvalidInputError, match="percentile"):
        optimise(6, FIELD, DISC, statistic="mean")


def test_broken_guidelines_are_named():
    ring = np.array([[np.cos(a), np.sin(a), 0.0] for a in range(6)])
    with pytest.raises(GeometryError, match=r"N >= D \+ 2"):
        check_site(ring[:4])
    with pytest.raises(GeometryError, match=r"one plane.*0\.000, 0\.000, 1\.000"):
        check_site(ring)
    with pytest.raises(GeometryError, match="one line"):
        check_site(np.outer(np.arange(6.0), [1.0, 2.0, 0.5]))
    with pytest.raises(GeometryError, match="same place"):
        check_site(np.vstack([ring, ring[2]]) + np.outer(np.arange(7) == 1, [0.0, 0.0, 1.0]))


def well_off(site):
    """Variance at two points: how far the nearest tower is from each, one of them seen from the east only."""
    wanted = np.array([[0.6, 0.2], [-0.5, -0.5]])
    far = np.linalg.norm(site[:, None, :2] - wanted, axis=2)
    far[:, 0] = np.where(site[:, 0] > 0.0, far[:, 0], 10.0)  # a jump: no slope leads there
    return 0.01 + far.min(axis=0) ** 2


def test_exchange_follows_a_measure_that_has_no_slope_and_keeps_the_rules():
    rules = Constraints(
        allowed=DISC.allowed, height_m=DISC.height_m, separation_m=0.3,
        excluded=(Zone(centre_enu_m=(0.6, 0.2), radius_m=0.1),),
    )  # fmt: skip
    begin = optimise(6, FIELD, rules, starts=1, existing_enu_m=[[0.0, 0.0, 0.4]])
    calls = []
    found = exchange(
        begin, well_off, FIELD, rules, criterion="near", tries=60, seed=3, progress=lambda k, n: calls.append((k, n))
    )
    assert found.criterion == "near"
    # 0.1 from the first place, which no tower may come nearer to; at the second
    least = np.sqrt(0.01 + 0.5 * 0.1**2)
    assert least <= found.value < 1.15 * least
    assert found.value == measured(well_off, found.transmitter_enu_m, "rms")
    assert found.value < measured(well_off, begin.transmitter_enu_m, "rms")
    np.testing.assert_array_equal(found.transmitter_enu_m[0], begin.transmitter_enu_m[0])
    ground = found.transmitter_enu_m[:, :2]
    apart = np.linalg.norm(ground[:, None] - ground, axis=2) + np.eye(6)
    assert apart.min() >= 0.3 - 1e-6
    assert np.linalg.norm(ground - [0.6, 0.2], axis=1).min() >= 0.1
    assert found.lost_one > found.value
    assert calls[-1] == (25, 25)
    again = exchange(begin, well_off, FIELD, rules, criterion="near", tries=60, seed=3)
    np.testing.assert_array_equal(found.transmitter_enu_m, again.transmitter_enu_m)


def test_exchange_begins_with_the_best_that_meets_the_rules():
    begin = optimise(6, FIELD, DISC, starts=1)
    good, bad = begin.transmitter_enu_m.copy(), begin.transmitter_enu_m.copy()
    good[0, :2], bad[0, :2] = [0.6, 0.2], [5.0, 0.0]
    found = exchange(begin, well_off, FIELD, DISC, criterion="near", tries=2, also_from=[good, bad])
    assert len(found.start_value) == 2
    assert found.start_value[1] == measured(well_off, good, "rms")
    with pytest.raises(InvalidInputError, match="tries"):
        exchange(begin, well_off, FIELD, DISC, criterion="near", tries=1)


AIM = np.array([0.0, 0.0, 0.5])
PIVOTS = np.array([[0.8, 0.0, 0.02], [0.0, 0.6, 0.02], [-0.5, -0.5, 0.02]])
SIGHT = Sightlines(start_enu_m=PIVOTS, end_enu_m=np.broadcast_to(AIM, (3, 3)), clearance_m=0.05)


def test_tower_is_clear_of_a_line_beside_it_or_below() -> None:
    tower = np.array([[0.4, 0.0, 0.2], [0.4, 0.0, 0.3], [0.4, 0.12, 0.3], [0.0, 0.0, 0.5], [1.2, 0.0, 0.4]])
    # the first line passes x = 0.4 at a height of 0.26; where it ends stands the receiver's own tower
    assert SIGHT.margin(tower) == pytest.approx([0.01, -0.04 - 0.01, 0.07, 0.0, 0.35])
    assert [SIGHT.crossed(each[None]) for each in tower] == [0, 1, 0, 0, 0]
    assert SIGHT.crossed(np.vstack([tower, [[0.0, 0.3, 0.45]]])) == 2


def test_slope_of_clearance_is_that_of_differences() -> None:
    rng = np.random.default_rng(5)
    tower = np.column_stack([rng.uniform(-1.0, 1.0, (200, 2)), rng.uniform(0.05, 0.5, 200)])
    margin, slope = SIGHT.margins(tower)
    np.testing.assert_array_equal(margin[:, 0], SIGHT.margin(tower))
    step = 1e-7 * rng.normal(size=(200, 3))
    change = SIGHT.margin(tower + step) - margin[:, 0]
    # but for the few that lie on an edge, where another line becomes the worst
    assert np.mean(np.abs(change - (slope[:, 0] * step).sum(axis=1)) < 1e-3 * 1e-7) > 0.98


def test_tower_between_lines_is_kept_clear_of_both() -> None:
    # on the line that halves the angle between the first two lines of sight
    middle = PIVOTS[0, :2] / np.linalg.norm(PIVOTS[0, :2]) + PIVOTS[1, :2] / np.linalg.norm(PIVOTS[1, :2])
    tower = np.array([[*(0.2 * middle), 0.6], [0.4, 0.1, 0.6]])
    margin, slope = SIGHT.margins(tower)
    assert margin[0, :2] == pytest.approx([margin[0, 0]] * 2, abs=1e-12)
    assert abs(slope[0, 0] - slope[0, 1]).max() > 0.5
    # the other has one line that is nearest by far
    np.testing.assert_array_equal(margin[1], margin[1, :1].repeat(3))
    np.testing.assert_array_equal(slope[1], slope[1, :1].repeat(3, axis=0))


def test_search_keeps_new_towers_out_of_lines_of_sight() -> None:
    bare = optimise(7, FIELD, DISC, starts=2, seed=3)
    angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    ring = np.column_stack([0.95 * np.cos(angle), 0.95 * np.sin(angle), np.full(12, 0.02)])
    sight = Sightlines(start_enu_m=ring, end_enu_m=np.broadcast_to(AIM, ring.shape), clearance_m=0.06)
    rules = Constraints(allowed=DISC.allowed, height_m=DISC.height_m, sight=sight)
    kept = optimise(7, FIELD, rules, starts=2, seed=3)
    assert sight.crossed(bare.transmitter_enu_m) > 0
    assert sight.margin(kept.transmitter_enu_m).min() > -1e-5
    assert kept.value >= bare.value * 0.999


def test_search_that_an_edge_stops_begins_its_model_anew():
    point = disc_points(12, radius_m=0.8)
    sight = Sightlines(start_enu_m=point, end_enu_m=np.broadcast_to(AIM, point.shape), clearance_m=0.25)
    rules = Constraints(allowed=DISC.allowed, height_m=DISC.height_m, sight=sight)
    problem = problem_of(mirrors_facing(point, TRIANGLE, normal_enu=[0.0, -0.5, 1.0]), "pdop", "rms", 1.0,
                         np.empty((0, 3)), rules)  # fmt: skip
    rng, calls = np.random.default_rng(0), []
    start = np.stack([draw_places(problem, 6, rng).ravel() for _ in range(20)]) / problem.scale

    def counted(x):
        calls.append(len(x))
        return problem.objective(x)

    end = minimised(counted, problem.margins, start, tolerance=1e-7)
    # one that tries the same step again and again takes thousands
    assert len(calls) < 600
    assert problem.objective(end)[0].min() < 0.785


def test_above_its_top_an_excluded_place_is_free():
    zone = Zone(corner_enu_m=np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]), top_m=10.0)
    place = np.array([[2.0, 1.0, 3.0], [2.0, 1.0, 9.5], [2.0, 1.0, 12.0], [5.0, 1.0, 3.0]])
    depth, slope = zone.inside(place)
    assert depth == pytest.approx([1.0, 0.5, -2.0, -1.0])
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        np.testing.assert_allclose((zone.inside(place + step)[0] - depth) / 1e-6, slope[:, axis], atol=1e-6)


def test_no_tower_is_placed_inside_a_building():
    site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    wanted = rf.optimise(site, starts=2).scenario.transmitter_enu_m
    boxes = [
        {
            "id": f"box{k}",
            "base_enu_m": (*place[:2], 0.0),
            "size_m": (6.0, 9.0, float(place[2]) + 1.0),
            "azimuth_deg": 30,
        }
        for k, place in enumerate(wanted[:3])
    ]
    built = site.changed(transmitter=[
        t.changed(position_enu_m=(1.3 * t.position_enu_m[0], *t.position_enu_m[1:]))
        for t in site.transmitter
    ], site={"structures": {"box": boxes}})  # fmt: skip
    found = rf.optimise(built, starts=2, rules=Rules(radius_m=100.0, height_m=(20.0, 50.0))).scenario
    assert not any(box.holds(t.position_enu_m) for box in found.site.structures.box for t in found.transmitter)
    assert all(box.holds(tuple(place)) for box, place in zip(found.site.structures.box, wanted[:3], strict=True))


def test_lines_of_sight_are_searched_for_only_where_the_best_places_stand_in_them():
    site, searched = rf.load_scenario(rf.shipped_scenario("table2_100m.toml")), []
    for sight_m in (None, 8.0, 0.0):
        told: list[tuple[int, int]] = []
        found = rf.optimise(site, starts=2, rules=Rules(sight_m=sight_m), on_progress=lambda *k: told.append(k))  # noqa: B023
        searched.append((sight_m, found.without_sight is not None, max(told)))
        if sight_m:
            assert found.without_sight is not None
            assert found.placement.value > found.without_sight
        elif sight_m is None:  # but for places in round numbers the same
            assert found.placement.value == pytest.approx(found.without_sight, rel=1e-4)
        assert found.standing.crossed in (None, 0)
    assert searched == [(None, True, (2, 4)), (8.0, True, (4, 4)), (0.0, False, (2, 2))]
