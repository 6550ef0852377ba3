"""Whole wavelengths of rigid mirrors where rounding is not safe: least squares, stated risk, float."""

import numpy as np
import pytest

from rfpose.geometry import angle_between_rad, rot_enu_from_mirror
from rfpose.multilat import PoseStatus
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, Observation
from rfpose.multilat.rigid.integers import IntegerMethod, solve_ladder

SPEED = 299_792_458.0
TRANSMITTER = np.array(
    [
        [100, 0, 20],
        [50, 87, 30],
        [-50, 87, 20],
        [-100, 0, 30],
        [-50, -87, 20],
        [50, -87, 30],
        [0, -50, 40],
        [0, 0, 50.0],
    ]
)
PLACES = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.radians([0, 120, 240])])
N, T = 1500, len(TRANSMITTER)


def site(rng):
    pivot = np.concatenate([rng.uniform(-60, 60, (N, 2)), rng.uniform(2, 3, (N, 1))], axis=1)
    rot = rot_enu_from_mirror(rng.normal([0, 0, 1.5], 1.0, (N, 3)))
    receiver = pivot[:, None] + np.einsum("mab,rb->mra", rot, PLACES)
    return pivot, rot, np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)


def observe(rng, distance, wavelength, own_rad, common_rad, k, clock):
    wavelength = np.broadcast_to(np.asarray(wavelength, float), T)
    to_m = wavelength / (2 * np.pi)
    free = np.isinf(common_rad)
    bias = rng.uniform(-50, 50, (N, 1, T)) if free else to_m * common_rad * rng.standard_normal((N, 1, T))
    whole = distance + clock + bias + to_m * own_rad * rng.standard_normal(distance.shape)
    return whole, Observation(
        range_m=np.mod(whole, wavelength) if k else whole,
        sigma_m=np.broadcast_to(to_m * own_rad, distance.shape),
        transmitter_sigma_m=np.full((N, T), np.inf) if free else np.tile(to_m * common_rad, (N, 1)),
        wavelength_m=wavelength,
        clock_class=k,
    )


def climb(rng, tone_rad, carrier_rad, rf, *, known, clock_spread=0.0, missing=False, carriers=None, **options):
    pivot, rot, distance = site(rng)
    clock = rng.uniform(-100, 100, (N, 1, 1)) + clock_spread * rng.uniform(-1, 1, (N, 3, 1))
    carrier_m = SPEED / (rf + np.linspace(-18e6, 18e6, T)) if carriers is None else carriers
    _, coarse = observe(rng, distance, SPEED / 0.75e6, tone_rad, 0.5 * tone_rad, 0, clock)
    whole, fine = observe(rng, distance, carrier_m, carrier_rad, np.inf, 1, clock)
    if missing:
        fine.range_m[::2, 0, 3] = np.nan
        fine.range_m[::3, 1, :2] = np.nan
    start = rot @ rot_enu_from_mirror([0, 0, 1]).T @ rot_enu_from_mirror([0.07, 0.07, 1.0])
    found = solve_ladder(
        MirrorProblem.of_observations(
            TRANSMITTER,
            np.tile(PLACES, (N, 1, 1)),
            [coarse, fine],
            start_pivot_enu_m=pivot,
            start_rot_enu_from_mirror=start,
            knowledge=known,
        ),
        **options,
    )
    turns = np.rint((found.range_m[:, 1] - whole) / fine.wavelength_m)
    return found, turns, angle_between_rad(found.poses.normal_enu, rot[:, :, 2])


def wrong_between_receivers(turns):
    """Mirrors with integers that differ between receivers of one transmitter."""
    highest = np.where(np.isnan(turns), -np.inf, turns).max(axis=1)
    lowest = np.where(np.isnan(turns), np.inf, turns).min(axis=1)
    return np.any(highest > lowest, axis=1)


@pytest.mark.parametrize("missing", [False, True])
def test_carrier_from_one_tone_where_rounding_is_not_safe(missing):
    """Tone noise of 1.5 mrad leaves receivers within a tenth of a turn at 433 MHz, too little for rounding each."""
    options = {"known": MirrorKnowledge(clock_sigma_m=0.0), "missing": missing}
    rounded, _, _ = climb(np.random.default_rng(3), 1.5e-3, 1.5e-3, 433e6, search=False, **options)
    assert np.mean(rounded.fixed[:, 1]) < 0.5
    found, turns, error = climb(np.random.default_rng(3), 1.5e-3, 1.5e-3, 433e6, **options)
    fixed = found.fixed[:, 1]
    assert np.mean(fixed) > 0.95
    assert np.mean(found.method[:, 1] == IntegerMethod.LEAST_SQUARES) > 0.5
    assert not wrong_between_receivers(turns[fixed]).any()
    assert np.all(found.wrong_risk[fixed, 1] <= 1e-6)
    assert np.mean((error / found.poses.tilt_sigma_rad)[fixed] ** 2) == pytest.approx(1.0, abs=0.08)
    # the same rounding as without a search where it was safe
    np.testing.assert_array_equal(
        found.method[rounded.fixed[:, 1], 1], np.full(rounded.fixed[:, 1].sum(), IntegerMethod.ROUNDED)
    )


def test_the_pose_decides_where_turns_are_too_uncertain_for_a_straight_line():
    found, turns, error = climb(
        np.random.default_rng(3), 3.5e-3, 3.5e-3, 433e6, known=MirrorKnowledge(clock_sigma_m=0.0)
    )
    decided = found.method[:, 1] == IntegerMethod.CONSTRAINED
    assert decided.sum() > 50
    assert not wrong_between_receivers(turns[found.fixed[:, 1]]).any()
    assert np.mean((error / found.poses.tilt_sigma_rad)[decided] ** 2) == pytest.approx(1.0, abs=0.4)


def test_integers_go_wrong_no_more_often_than_stated():
    """Carrier noise of a tenth of a turn: several in a hundred mirrors are wrong, and that was said."""
    found, turns, _ = climb(
        np.random.default_rng(4), 5e-4, 0.8, 100e6, known=MirrorKnowledge(clock_sigma_m=0.0), wrong_risk=0.999
    )
    fixed = found.fixed[:, 1]
    wrong, stated = wrong_between_receivers(turns[fixed]).sum(), found.wrong_risk[fixed, 1].sum()
    assert 20 < wrong < stated
    assert np.all(found.adop_cycles[fixed, 1] < 0.3)
    careful, _, _ = climb(np.random.default_rng(4), 5e-4, 0.8, 100e6, known=MirrorKnowledge(clock_sigma_m=0.0))
    assert not careful.fixed[:, 1].any()
    assert np.all(careful.method[:, 1] == IntegerMethod.FLOAT)
    assert np.mean(careful.poses.status == PoseStatus.OK) > 0.99  # float: the tone's pose stays


def test_unknown_delays_and_equal_carriers():
    """One clock a receiver and one wavelength: only double differences have integers."""
    known = MirrorKnowledge(clock_sigma_m=np.inf)
    found, turns, _ = climb(
        np.random.default_rng(5), 2e-3, 2e-3, 433e6, known=known, clock_spread=0.5, carriers=np.full(T, 0.69)
    )
    searched = found.method[:, 1] >= IntegerMethod.LEAST_SQUARES
    assert searched.mean() > 0.2
    difference = turns[:, 1:] - turns[:, :1]
    double = difference - difference[..., :1]
    assert not np.any(double[found.fixed[:, 1]] != 0)
