"""Rigid poses: bad input and what is left open."""

import numpy as np
import pytest

from rfpose.errors import GeometryError, InvalidInputError
from rfpose.geometry import angle_between_rad, rot_enu_from_mirror
from rfpose.multilat.rigid import Knowledge, RigidStatus, solve_rigid
from rfpose.multilat.rigid.integers import solve_ladder

RNG = np.random.default_rng(1)
TRANSMITTER = np.column_stack([RNG.uniform(-100, 100, (8, 2)), RNG.uniform(20, 50, 8)])
PLACES = np.array([[1.0, 0.0, 0.0], [-0.5, 0.8, 0.0], [-0.5, -0.8, 0.0]])
PIVOT, ROT = np.array([[3.0, -10.0, 2.0]]), rot_enu_from_mirror([[0.3, 0.6, 0.7]])


def solve(z=None, *, sigma=1e-4, transmitter_sigma=1e-9, places=PLACES, knowledge=None, start=ROT):
    if z is None:
        receiver = PIVOT[:, None] + np.einsum("mab,rb->mra", ROT, PLACES)
        z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)[:, None] + 7.0
    return solve_rigid(
        TRANSMITTER,
        places,
        z,
        sigma_m=sigma,
        transmitter_sigma_m=transmitter_sigma,
        clock_class=[0],
        start_pivot_enu_m=PIVOT,
        start_rot_enu_from_mirror=start,
        knowledge=knowledge,
    )


def test_noise_free_ranges_give_the_pose():
    start = ROT @ rot_enu_from_mirror([0, 0, 1]).T @ rot_enu_from_mirror([0.2, 0.1, 1.0])
    found = solve(start=start)
    assert found.status[0] == RigidStatus.OK
    np.testing.assert_allclose(found.rot_enu_from_mirror, ROT, atol=1e-9)
    np.testing.assert_allclose(found.pivot_enu_m, PIVOT, atol=1e-8)
    np.testing.assert_allclose(found.clock_m[0, 0], 7.0, atol=1e-8)


def test_without_calibration_the_pivot_gives_orientation():
    """Transmitter errors of any size cancel between receivers of one mirror (design fact 5)."""
    receiver = PIVOT[:, None] + np.einsum("mab,rb->mra", ROT, PLACES)
    z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)[:, None] + RNG.uniform(-100, 100, 8)
    known = Knowledge(clock_sigma_m=0.0, pivot_enu_m=PIVOT, pivot_sigma_m=5e-3)
    found = solve(z, transmitter_sigma=np.inf, knowledge=known)
    assert found.status[0] == RigidStatus.OK
    assert angle_between_rad(found.normal_enu, ROT[:, :, 2])[0] < 1e-8


def test_what_is_left_open_is_said():
    z = np.full((1, 1, 3, 8), np.nan)
    assert solve(z).status[0] == RigidStatus.TOO_FEW
    receiver = PIVOT[:, None] + np.einsum("mab,rb->mra", ROT, PLACES)
    z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)[:, None]
    z[..., 3:] = np.nan  # three transmitters, three clocks: 9 measurements for 9 unknowns less one
    z[0, 0, 2, 2] = np.nan
    assert solve(z).status[0] == RigidStatus.SINGULAR
    assert np.isnan(solve(z).normal_enu).all()
    assert "pivot" in RigidStatus.SINGULAR.reason


def test_a_mount_holds_the_roll():
    known = Knowledge(two_axis=True)
    found = solve(_ranges() + 1e-2 * RNG.normal(size=(1, 1, 3, 8)), sigma=1e-2, knowledge=known)
    assert abs(found.rot_enu_from_mirror[0, 2, 0]) < 1e-5
    free = solve(_ranges() + 1e-2 * RNG.normal(size=(1, 1, 3, 8)), sigma=1e-2)
    assert abs(free.rot_enu_from_mirror[0, 2, 0]) > 1e-5


def _ranges():
    receiver = PIVOT[:, None] + np.einsum("mab,rb->mra", ROT, PLACES)
    return np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)[:, None] + 7.0


def test_bad_arguments():
    with pytest.raises(GeometryError, match="line"):
        solve(places=np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]))
    with pytest.raises(InvalidInputError, match="sigma_m"):
        solve(sigma=0.0)
    with pytest.raises(InvalidInputError, match="transmitters"):
        solve(np.zeros((1, 1, 3, 5)))
    with pytest.raises(InvalidInputError, match="observations"):
        solve_ladder(TRANSMITTER, PLACES[None], [], start_pivot_enu_m=PIVOT, start_rot_enu_from_mirror=ROT)
