"""Kernels of rays against plain numpy: the transition function, and the walk through cells against plate by plate."""

from __future__ import annotations

import numpy as np
from scipy.special import wofz

from rfpose.geometry import rot_enu_from_mirror
from rfpose.propagation import Foresight, PlatesStanding, Surroundings, _kernels, bystanders, foresee


def test_the_transition_function_is_the_complementary_error_functions():
    x = np.concatenate([[0.0], np.geomspace(1e-8, 1e4, 200)])
    wanted = np.sqrt(np.pi * x) * np.exp(0.25j * np.pi) * wofz(np.exp(0.75j * np.pi) * np.sqrt(x))
    np.testing.assert_allclose([_kernels.transition(value) for value in x], wanted, atol=1e-6)


def hidden(a, b, plates: PlatesStanding) -> bool:
    normal = plates.rot_enu_from_mirror[:, :, 2]
    da, db = ((p - plates.centre_enu_m) * normal for p in (a, b))
    da, db = da.sum(axis=1), db.sum(axis=1)
    crosses = da * db < 0.0
    point = a + (da / (da - db))[:, None] * (b - a) - plates.centre_enu_m
    x, y = (np.abs(np.sum(point * plates.rot_enu_from_mirror[:, :, k], axis=1)) for k in (0, 1))
    return bool(np.any(crosses & (x < 0.5 * plates.size_m[:, 0]) & (y < 0.5 * plates.size_m[:, 1])))


def test_the_walk_through_cells_finds_what_going_plate_by_plate_finds():
    rng = np.random.default_rng(11)
    n = 1200
    plates = PlatesStanding(
        centre_enu_m=np.column_stack([rng.uniform(-60, 60, (n, 2)), rng.uniform(1, 4, n)]),
        rot_enu_from_mirror=rot_enu_from_mirror(rng.normal(size=(n, 3))),
        size_m=rng.uniform(0.5, 4.0, (n, 2)),
    )
    place = np.column_stack([rng.uniform(-70, 70, (60, 2)), rng.uniform(0.5, 8, 60)])
    sender = np.column_stack([rng.uniform(-90, 90, (40, 2)), rng.uniform(0.5, 15, 40)])
    alone = Foresight(ground=False, specular=False, diffracted="none", own_plate=False)
    rays = foresee(sender, np.full(40, 433e6), bystanders(place), Surroundings(plates=plates), alone)
    wanted = np.array([[not hidden(b, a, plates) for a in sender] for b in place])
    assert 0.2 < wanted.mean() < 0.8
    np.testing.assert_array_equal(np.diff(rays.first).reshape(60, 40) == 1, wanted)
