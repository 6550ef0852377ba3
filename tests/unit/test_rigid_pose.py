"""Rigid poses: bad input and what is left open."""

import numpy as np
import pytest

from rfpose.errors import GeometryError, InvalidInputError
from rfpose.geometry import angle_between_rad, rot_enu_from_mirror
from rfpose.multilat import PoseStatus
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, solve_rigid
from rfpose.multilat.rigid.integers import common_offset, solve_ladder

RNG = np.random.default_rng(1)
TRANSMITTER = np.column_stack([RNG.uniform(-100, 100, (8, 2)), RNG.uniform(20, 50, 8)])
PLACES = np.array([[1.0, 0.0, 0.0], [-0.5, 0.8, 0.0], [-0.5, -0.8, 0.0]])
PIVOT, ROT = np.array([[3.0, -10.0, 2.0]]), rot_enu_from_mirror([[0.3, 0.6, 0.7]])


def solve(z=None, *, sigma=1e-4, transmitter_sigma=1e-9, places=PLACES, knowledge=None, start=ROT):
    if z is None:
        receiver = PIVOT[:, None] + np.einsum("mab,rb->mra", ROT, PLACES)
        z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)[:, None] + 7.0
    return solve_rigid(
        MirrorProblem.of(
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
    )


def test_noise_free_ranges_give_the_pose():
    start = ROT @ rot_enu_from_mirror([0, 0, 1]).T @ rot_enu_from_mirror([0.2, 0.1, 1.0])
    found = solve(start=start)
    assert found.status[0] == PoseStatus.OK
    np.testing.assert_allclose(found.rot_enu_from_mirror, ROT, atol=1e-9)
    np.testing.assert_allclose(found.pivot_enu_m, PIVOT, atol=1e-8)
    np.testing.assert_allclose(found.clock_m[0, 0], 7.0, atol=1e-8)


def test_without_calibration_the_pivot_gives_orientation():
    """Transmitter errors of any size cancel between receivers of one mirror (design fact 5)."""
    receiver = PIVOT[:, None] + np.einsum("mab,rb->mra", ROT, PLACES)
    z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)[:, None] + RNG.uniform(-100, 100, 8)
    known = MirrorKnowledge(clock_sigma_m=0.0, pivot_enu_m=PIVOT, pivot_sigma_m=5e-3)
    found = solve(z, transmitter_sigma=np.inf, knowledge=known)
    assert found.status[0] == PoseStatus.OK
    assert angle_between_rad(found.normal_enu, ROT[:, :, 2])[0] < 1e-8


def test_what_is_left_open_is_said():
    z = np.full((1, 1, 3, 8), np.nan)
    assert solve(z).status[0] == PoseStatus.UNKNOWNS
    receiver = PIVOT[:, None] + np.einsum("mab,rb->mra", ROT, PLACES)
    z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)[:, None]
    z[..., 3:] = np.nan  # three transmitters, three clocks: 9 measurements for 9 unknowns less one
    z[0, 0, 2, 2] = np.nan
    assert solve(z).status[0] == PoseStatus.UNDETERMINED
    assert np.isnan(solve(z).normal_enu).all()
    assert "pivot" in PoseStatus.UNDETERMINED.reason


def test_a_mount_holds_the_roll():
    known = MirrorKnowledge(two_axis=True)
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
        solve_ladder(
            MirrorProblem.of_observations(
                TRANSMITTER, PLACES[None], [], start_pivot_enu_m=PIVOT, start_rot_enu_from_mirror=ROT
            )
        )


def test_offsets_a_whole_number_of_every_wavelength_apart_are_one_answer():
    """Carriers on a raster of 200 MHz repeat every 1.5 m: the receiver's clock takes that up, no integer is at risk."""
    rng = np.random.default_rng(3)
    speed, offset_m = 299_792_458.0, 0.2
    for carrier_hz, is_safe in (
        (8.2e9 + 0.4e9 * np.arange(10), True),  # on a raster
        (8.2e9 + 1e6 * np.arange(10), False),  # so close together that neighbouring offsets fit alike
    ):
        wavelength = speed / carrier_hz
        left = offset_m + 1e-4 * rng.standard_normal((5, 3, 10)) + wavelength * rng.integers(-50, 50, (5, 3, 10))
        found, risk = common_offset(left, wavelength, np.full(left.shape, 1e-4))
        assert np.all(risk < 1e-9) == is_safe
        if is_safe:
            np.testing.assert_allclose(found[..., 0], offset_m, atol=6e-4 / np.sqrt(10))
