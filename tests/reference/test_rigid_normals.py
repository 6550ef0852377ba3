"""Design fact 4: what the mirror's rigidity and its clock are worth, at the paper's parameters (seed 003 §4.5).

Recomputed there with independent code: S = 10⁶, receiver spacing 0.0173 of the radius, no calibration noise.
"""

from pathlib import Path

import numpy as np
import pytest

from rfpose.geometry import angle_between_rad, rot_enu_from_mirror
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, rigid_bound, solve_rigid, tilt_sigma_rad
from rfpose.scenario import load_scenario

SITE = load_scenario(Path(__file__).resolve().parents[2] / "data" / "table2.toml")
PLACES = np.array(SITE.heliostat[0].receiver_mirror_m)
SIGMA = np.sqrt(1.89e-10 / 2.0)  # of one transmitter; R4's is that of a difference
ROWS = [
    ((1, 0, 0), (-1, 0, 1), 2.60, 0.49),
    ((1, 0, 0), (0, -1, 1), 1.04, 0.83),
    ((0, 1, 0), (0, -1, 1), 2.22, 0.51),
    ((0, 1, 0), (-1, 0, 1), 1.16, 0.84),
    ((0, 0, 0), (-1, 0, 1), 0.80, 0.64),
    ((0, 0, 0), (0, 0, 1), 1.38, 0.71),
]


@pytest.mark.parametrize(("place", "facing", "three_clocks", "one_clock"), ROWS)
@pytest.mark.parametrize("shared", [False, True])
def test_table_of_fact_4(place, facing, three_clocks, one_clock, shared):
    rot = rot_enu_from_mirror(facing)
    knowledge = MirrorKnowledge(clock_sigma_m=0.0 if shared else np.inf)
    common = {"transmitter_sigma_m": 1e-12, "clock_class": [0], "knowledge": knowledge}
    sigma = np.full((1, 1, 3, 10), SIGMA)
    place = np.array([place], float)
    cov = rigid_bound(MirrorProblem.expected(SITE.transmitter_enu_m, PLACES, place, rot[None], sigma_m=sigma, **common))
    bound = tilt_sigma_rad(cov, rot[None, :, 2])[0]
    assert 1e3 * bound == pytest.approx(one_clock if shared else three_clocks, abs=0.006)
    # 4000 runs of two angles each: the rms is known to 0.8 %
    n_run = 4000
    rng = np.random.default_rng(3)
    distance = np.linalg.norm((place + PLACES @ rot.T)[:, None] - SITE.transmitter_enu_m, axis=-1)
    z = distance + 0.2 + SIGMA * rng.standard_normal((n_run, 1, 3, 10))
    start = rot_enu_from_mirror(np.asarray(facing) + 0.05 * rng.standard_normal((n_run, 3)))
    found = solve_rigid(
        MirrorProblem.of(
            SITE.transmitter_enu_m,
            PLACES,
            z,
            sigma_m=SIGMA,
            start_pivot_enu_m=place + 0.01 * rng.standard_normal((n_run, 3)),
            start_rot_enu_from_mirror=start,
            **common,
        )
    )
    assert np.all(found.status == 0)
    error = np.sqrt(np.mean(angle_between_rad(found.normal_enu, rot[:, 2]) ** 2))
    assert error == pytest.approx(bound, rel=0.03)
    assert np.sqrt(np.mean(found.tilt_sigma_rad**2)) == pytest.approx(error, rel=0.03)
    # chi² of n degrees of freedom has a standard deviation of √(2n)
    assert np.mean(found.chi2 / found.dof) == pytest.approx(1.0, abs=5 * np.sqrt(2 / found.dof[0] / n_run))
