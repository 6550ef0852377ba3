"""Frames, rotations, directions."""

import numpy as np
import pytest

from rfpose import geometry
from rfpose.errors import GeometryError, InvalidInputError

RNG = np.random.default_rng(0)


def test_azimuth_is_from_north_clockwise():
    azimuth, elevation = geometry.azimuth_elevation_from_enu([[0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, 0, 1]])
    np.testing.assert_allclose(np.degrees(azimuth), [0, 90, 180, 270])
    np.testing.assert_allclose(np.degrees(elevation), [0, 0, 0, 45])


def test_azimuth_elevation_round_trip():
    v = geometry.unit(RNG.standard_normal((100, 3)))
    np.testing.assert_allclose(
        geometry.enu_from_azimuth_elevation(*geometry.azimuth_elevation_from_enu(v)), v, atol=1e-12
    )


def test_mirror_frame_seen_from_the_front():
    normal = geometry.unit(RNG.standard_normal((100, 3)))
    rot = geometry.rot_enu_from_mirror(normal)
    np.testing.assert_allclose(rot.swapaxes(1, 2) @ rot, np.broadcast_to(np.eye(3), (100, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rot), 1.0)
    np.testing.assert_allclose(rot @ [0, 0, 1], normal, atol=1e-12)
    np.testing.assert_allclose(rot[:, 2, 0], 0.0, atol=1e-12)  # x is horizontal
    assert np.all(rot[:, 2, 1] >= 0.0)  # y points up the mirror
    # a mirror facing north, seen by someone north of it who looks south: west is on the right
    np.testing.assert_allclose(geometry.rot_enu_from_mirror([0, 1, 0]) @ [1, 0, 0], [-1, 0, 0], atol=1e-12)


@pytest.mark.parametrize("normal", [[0, 0, 1], [0, 0, -1]])
def test_flat_mirrors_have_a_frame_too(normal):
    rot = geometry.rot_enu_from_mirror(normal)
    np.testing.assert_allclose(rot.T @ rot, np.eye(3), atol=1e-12)
    assert np.linalg.det(rot) == pytest.approx(1.0)


def test_bisector_reflects_one_direction_into_the_other():
    sun, target = geometry.unit(RNG.standard_normal((2, 50, 3)))
    n = geometry.bisector_enu(sun, target)
    np.testing.assert_allclose(2 * np.sum(n * sun, -1, keepdims=True) * n - sun, target, atol=1e-9)
    assert np.isnan(geometry.bisector_enu([0, 0, 1], [0, 0, -1])).all()


def test_small_angles_are_exact():
    assert geometry.angle_between_rad([1, 0, 0], [1, 1e-9, 0]) == pytest.approx(1e-9, rel=1e-6)
    assert geometry.angle_between_rad([1, 0, 0], [-2, 0, 0]) == pytest.approx(np.pi)


def test_collinear_points():
    assert geometry.is_collinear([[0, 0, 0], [1, 1, 1], [3, 3, 3]])
    assert not geometry.is_collinear([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert geometry.is_collinear([[1, 1, 1]] * 3)
    with pytest.raises(GeometryError, match="three"):
        geometry.is_collinear([[0, 0, 0], [1, 1, 1]])


def test_wrong_shapes_and_nan():
    with pytest.raises(InvalidInputError, match="vector"):
        geometry.unit([1.0, 2.0])
    assert np.isnan(geometry.unit([0, 0, 0])).all()
    assert np.isnan(geometry.rot_enu_from_mirror([np.nan, 0, 1])).all()
