"""Table 2 of Swart et al.: its dilution, and how much better its own limits allow (verification R1, R2, R9)."""

import numpy as np
import pytest

from rfpose.layout.maps import dilution, disc_points, mirrors_facing
from rfpose.layout.optimise import Constraints, Zone, evaluate_placement, optimise
from sites import TABLE_2

PLACES = 0.01 * np.array([[1.0, 0.0, 0.0], [-0.5, 0.866, 0.0], [-0.5, -0.866, 0.0]])


def disc(n):
    return mirrors_facing(disc_points(n), PLACES, normal_enu=[0.0, 0.0, 1.0])


def test_dilution_at_the_centre_and_the_edge():
    # R2 counts per sigma of a difference, larger by √2
    found = dilution(TABLE_2, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]).position / np.sqrt(2.0)
    assert found == pytest.approx([1.010, 1.853], abs=1e-3)


def test_rms_over_the_disc_converges():
    # every area alike; R2's 2.143 is no such average (docs/layout.md)
    assert evaluate_placement(TABLE_2, disc(20_000)) == pytest.approx(2.0455, abs=1e-3)
    assert evaluate_placement(TABLE_2, disc(5000)) == pytest.approx(2.0455, abs=2e-3)


def test_better_places_within_table2s_limits():
    rules = Constraints(allowed=(Zone(radius_m=1.0),), height_m=(0.2, 0.5))
    found = optimise(10, disc(200), rules, starts=4, seed=1)
    site = found.transmitter_enu_m
    assert np.hypot(site[:, 0], site[:, 1]).max() <= 1.0 + 1e-5
    assert site[:, 2].min() >= 0.2
    assert site[:, 2].max() <= 0.5
    assert evaluate_placement(site, disc(20_000)) <= 1.78


def test_planar_error_falls_with_transmitters_and_rises_outside():
    # R9, Fig. 7
    inside, outside = [], []
    for n in (4, 5, 6, 7):
        angle = 2.0 * np.pi * np.arange(n) / n
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        # between two transmitters, where the dilution is worst
        way = np.array([np.cos(np.pi / n), np.sin(np.pi / n)])
        inside.append(dilution(circle, 0.3 * way).position)
        outside.append(dilution(circle, 1.6 * way).position)
    assert (np.diff(inside) < 0.0).all()
    assert (np.array(outside) > 3.0 * np.array(inside)).all()
