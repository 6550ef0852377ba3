"""Parts of a mirror problem hold what was asked for, and nothing else."""

import numpy as np

from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, part_of

RNG = np.random.default_rng(0)
N_MIRROR, N_GROUP, N_RECEIVER, N_TRANSMITTER = 4, 3, 3, 6
RANGE_M = RNG.uniform(10.0, 100.0, (N_MIRROR, N_GROUP, N_RECEIVER, N_TRANSMITTER))
PIVOT = RNG.uniform(-50.0, 50.0, (N_MIRROR, 3))
PROBLEM = MirrorProblem.of(
    RNG.uniform(-50.0, 50.0, (N_TRANSMITTER, 3)),
    [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]],
    RANGE_M,
    sigma_m=0.01 * RANGE_M,
    transmitter_sigma_m=0.02,
    clock_class=[0, 1, 1],
    start_pivot_enu_m=PIVOT,
    start_rot_enu_from_mirror=np.eye(3),
    knowledge=MirrorKnowledge(pivot_enu_m=PIVOT + 0.1, pivot_sigma_m=0.01),
)


def test_mirrors_and_wavelengths_are_taken_together():
    """Rows may be repeated, as candidates of one mirror are."""
    rows = np.array([2, 0, 2])
    part = part_of(PROBLEM, groups=slice(2), mirrors=rows)
    np.testing.assert_array_equal(part.range_m, RANGE_M[rows, :2])
    np.testing.assert_array_equal(part.sigma_m, 0.01 * RANGE_M[rows, :2])
    np.testing.assert_array_equal(part.clock_class, [0, 1])
    np.testing.assert_array_equal(part.start_pivot_enu_m, PIVOT[rows])
    np.testing.assert_array_equal(part.knowledge.pivot_enu_m, PIVOT[rows] + 0.1)


def test_links_and_beginnings_are_of_the_mirrors_taken():
    """A pose that was not solved leaves a mirror where it began."""
    rows = np.array([3, 1])
    used = RNG.random((2, N_RECEIVER, N_TRANSMITTER)) < 0.5
    begin = np.array([[1.0, 2.0, 3.0], [np.nan] * 3]), np.stack([np.diag([1.0, -1.0, -1.0]), np.full((3, 3), np.nan)])
    part = part_of(PROBLEM, mirrors=rows, used=used, begin=begin)
    np.testing.assert_array_equal(part.range_m, np.where(used[:, None], RANGE_M[rows], np.nan))
    np.testing.assert_array_equal(part.start_pivot_enu_m, [[1.0, 2.0, 3.0], PIVOT[1]])
    np.testing.assert_array_equal(part.start_rot_enu_from_mirror, [np.diag([1.0, -1.0, -1.0]), np.eye(3)])
