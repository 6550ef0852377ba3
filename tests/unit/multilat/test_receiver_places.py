"""Receiver places from many postures: scatter is the covariance, and what nothing shows is named."""

import numpy as np
import pytest

from rfpose.errors import GeometryError, InvalidInputError
from rfpose.geometry import rot_enu_from_mirror
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem
from rfpose.multilat.rigid.places import places_bound, refine_places

RNG = np.random.default_rng(9)
TRANSMITTER = np.column_stack([RNG.uniform(-100, 100, (9, 2)), RNG.uniform(15, 50, 9)])
DRAWN = np.array([[1, 0, 0.3], [-0.5, 0.8, 0.3], [-0.5, -0.8, 0.3], [0.2, 0.9, 0.3]])
PIVOT = np.array([10.0, -20.0, 3.0])
SIGMA, N_POSTURE = 2e-4, 12


def measure(rng, places, *, calibration=1e-4, clocks=4, rot=None):
    """Ranges of one mirror in many postures, and its true postures."""
    if rot is None:
        rot = rot_enu_from_mirror(rng.normal([0, 0, 1.0], 0.7, (N_POSTURE, 3)))
    receiver = PIVOT + np.einsum("fab,rb->fra", rot, places)
    z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)[:, None]
    n = len(rot)
    free = np.isinf(calibration)
    z = z + (rng.uniform(-9, 9, (n, 1, 1, 9)) if free else calibration * rng.standard_normal((n, 1, 1, 9)))
    z = z + rng.uniform(-9, 9, (n, 1, clocks, 1))
    return z + SIGMA * rng.standard_normal(z.shape), rot


def refine(z, rot, *, calibration=1e-4, knowledge=None, common_pivot=True):
    turned = rot @ rot_enu_from_mirror([0, 0, 1]).T @ rot_enu_from_mirror([0.002, 0.001, 1.0])
    return refine_places(
        MirrorProblem.of(
            TRANSMITTER,
            DRAWN,
            z,
            sigma_m=SIGMA,
            transmitter_sigma_m=calibration,
            clock_class=[0],
            start_pivot_enu_m=np.tile(PIVOT + 1e-3, (len(rot), 1)),
            start_rot_enu_from_mirror=turned,
            knowledge=knowledge,
        ),
        common_pivot=common_pivot,
    )


def apart(places):
    """Distances between receivers, and their derivative by the places."""
    pairs = [(a, b) for a in range(len(places)) for b in range(a)]
    slope = np.zeros((len(pairs), places.size))
    for k, (a, b) in enumerate(pairs):
        unit = (places[a] - places[b]) / np.linalg.norm(places[a] - places[b])
        slope[k, 3 * a : 3 * a + 3], slope[k, 3 * b : 3 * b + 3] = unit, -unit
    return np.array([np.linalg.norm(places[a] - places[b]) for a, b in pairs]), slope


def test_scatter_is_the_covariance():
    """Nine combinations are seen in each of 60 mirrors: the mean square is known to 6 %."""
    rng = np.random.default_rng(1)
    ratios, chi2, before, after = [], [], [], []
    for _ in range(60):
        true = DRAWN + 5e-4 * rng.standard_normal(DRAWN.shape)
        found = refine(*measure(rng, true))
        assert found.converged
        assert found.rank == 9
        value, vector = np.linalg.eigh(found.cov_m2)
        error = vector[:, -9:].T @ (found.receiver_mirror_m - true).ravel()
        ratios.append(np.sum(error**2 / value[-9:]))
        chi2.append(found.chi2 / found.dof)
        before.append(apart(DRAWN)[0] - apart(true)[0])
        after.append(apart(found.receiver_mirror_m)[0] - apart(true)[0])
    assert np.mean(ratios) == pytest.approx(9.0, rel=0.2)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.03)
    assert np.std(after) < 0.15 * np.std(before)


def test_without_calibration_distances_between_receivers_are_seen():
    rng = np.random.default_rng(2)
    ratios = []
    for _ in range(40):
        true = DRAWN + 5e-4 * rng.standard_normal(DRAWN.shape)
        z, rot = measure(rng, true, calibration=np.inf, clocks=1)
        known = MirrorKnowledge(clock_sigma_m=0.0, pivot_enu_m=PIVOT, pivot_sigma_m=5e-3)
        found = refine(z, rot, calibration=np.inf, knowledge=known)
        distance, slope = apart(found.receiver_mirror_m)
        cov = slope @ found.cov_m2 @ slope.T
        error = distance - apart(true)[0]
        ratios.append(error @ np.linalg.solve(cov, error))
    assert np.mean(ratios) == pytest.approx(6.0, rel=0.25)  # six distances, 40 mirrors: known to 9 %


def test_what_nothing_shows_is_named():
    rng = np.random.default_rng(3)
    z, rot = measure(rng, DRAWN)
    found = refine(z, rot)
    assert len(found.unseen_names) == 3
    assert all("rotation of all receivers against the glass" in name for name in found.unseen_names)
    # a common rotation of the receivers about the pivot moves no result
    turn = rot_enu_from_mirror([0, 0, 1]).T @ rot_enu_from_mirror([0.01, 0.0, 1.0])
    turned, _ = measure(np.random.default_rng(3), DRAWN @ turn.T, rot=rot @ turn.T)
    np.testing.assert_allclose(refine(turned, rot).chi2, refine(measure(np.random.default_rng(3), DRAWN, rot=rot)[0],
                                                              rot).chi2, rtol=1e-6)  # fmt: skip
    free = refine(z, rot, common_pivot=False)
    assert free.rank == 6
    assert sum("shift" in name for name in free.unseen_names) == 3
    mount = refine(z, rot, knowledge=MirrorKnowledge(two_axis=True))
    assert mount.rank == 11
    assert mount.unseen_names[0].startswith("rotation of all receivers against the glass about (1.00, 0.00")


def bound(rot, **settings):
    return places_bound(
        MirrorProblem.expected(
            TRANSMITTER,
            DRAWN,
            np.tile(PIVOT, (len(rot), 1)),
            rot,
            sigma_m=np.full((len(rot), 1, 4, 9), SIGMA),
            transmitter_sigma_m=1e-4,
            clock_class=[0],
            **settings,
        )
    )


def test_planned_postures_show_which_are_needed():
    azimuth_only = np.array([[np.sin(a), np.cos(a), 0.0] for a in np.linspace(0, 2, 6)])
    axis = bound(rot_enu_from_mirror(azimuth_only))
    assert axis.rank == 8
    # turned about the vertical only: where the receivers are along it is the pivot's height as well
    shift = [name for name in axis.unseen_names if name.startswith("shift")]
    assert len(shift) == 1
    assert "(0.00, 1.00, 0.00)" in shift[0].replace("-", "")
    both = bound(rot_enu_from_mirror(azimuth_only + [0.0, 0.0, 0.5] * np.arange(6)[:, None]))
    assert both.rank == 9
    one = bound(rot_enu_from_mirror([[0.2, 0.3, 1.0]]))
    assert one.rank == 6
    many = bound(rot_enu_from_mirror(np.random.default_rng(0).normal([0, 0, 1.0], 0.7, (48, 3))))
    few = bound(rot_enu_from_mirror(np.random.default_rng(0).normal([0, 0, 1.0], 0.7, (12, 3))))
    assert many.sigma_m.max() < 0.75 * few.sigma_m.max()


def test_bad_arguments():
    z, rot = measure(np.random.default_rng(4), DRAWN)
    with pytest.raises(InvalidInputError, match="posture"):
        refine(z[:0], rot[:0])
    with pytest.raises(GeometryError, match="line"):
        refine_places(
            MirrorProblem.of(
                TRANSMITTER,
                DRAWN * [1, 0, 0],
                z,
                sigma_m=SIGMA,
                transmitter_sigma_m=1.0,
                clock_class=[0],
                start_pivot_enu_m=np.tile(PIVOT, (len(rot), 1)),
                start_rot_enu_from_mirror=rot,
            )
        )
