"""Normals: the numbering rule, missing receivers, lines, many mirrors at once."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfpose.errors import InvalidInputError
from rfpose.geometry import rot_enu_from_mirror, unit
from rfpose.multilat import PoseStatus, joint_covariance, mirror_normal, solve_poses
from rfpose.multilat.fix import FixStatus

TRANSMITTER = np.array(
    [[100, 0, 20], [50, 87, 30], [-50, 87, 20], [-100, 0, 30], [-50, -87, 20], [50, -87, 30], [0, 0, 50]], float
)
TRIANGLE = np.array([[1.0, 0.0, 0.0], [-0.5, 0.9, 0.0], [-0.5, -0.9, 0.0]])
SQUARE = np.array([[1.5, 1.0, 0.0], [-1.5, 1.0, 0.0], [-1.5, -1.0, 0.0], [1.5, -1.0, 0.0]])
BOWL = np.array([[1.5, 1.0, 0.1], [-1.5, 1.0, 0.1], [-1.5, -1.0, 0.1], [1.5, -1.0, 0.1], [0.2, 0.1, -0.1]])
FACING = unit([-0.3, -0.5, 0.8])


def placed(mirror, facing=FACING):
    return np.array([20.0, 30.0, 2.0]) + mirror @ rot_enu_from_mirror(facing).T


def identity(n):
    return 1e-6 * np.eye(3 * n)


@pytest.mark.parametrize("mirror", [TRIANGLE, SQUARE])
def test_counter_clockwise_numbering_gives_the_front(mirror):
    n = len(mirror)
    front = mirror_normal(placed(mirror), identity(n))
    np.testing.assert_allclose(front.normal_enu, FACING, atol=1e-12)
    back = mirror_normal(placed(mirror)[::-1], identity(n))
    np.testing.assert_allclose(back.normal_enu, -FACING, atol=1e-12)
    assert front.azimuth_rad == pytest.approx(np.mod(np.arctan2(-0.3, -0.5), 2 * np.pi))
    assert front.elevation_rad == pytest.approx(np.arcsin(FACING[2]))


@pytest.mark.parametrize("mirror", [TRIANGLE, SQUARE, BOWL])
def test_known_places_make_numbering_free_and_need_no_plane(mirror):
    order = np.random.default_rng(1).permutation(len(mirror))
    normals = mirror_normal(placed(mirror)[order], identity(len(mirror)), receiver_mirror_m=mirror[order])
    np.testing.assert_allclose(normals.normal_enu, FACING, atol=1e-12)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("n", [3, 5])
@pytest.mark.parametrize("noise", [0.002, 0.01])
@pytest.mark.parametrize("width", [1e-6, 3e-4, 2e-3, 0.02, 0.2])
def test_receivers_nearly_on_a_line_claim_no_normal(width, noise, n, known):
    """Places on 1 m by ``width``: what is called OK is off by what it says."""
    rng = np.random.default_rng(4)
    angle = 2.0 * np.pi * np.arange(n) / n
    places = np.stack([np.cos(angle), width * np.sin(angle), 0.0 * angle], axis=-1)
    rot = Rotation.random(1000, random_state=rng).as_matrix()
    position = np.einsum("mab,kb->mka", rot, places) + noise * rng.standard_normal((1000, n, 3))
    cov = np.broadcast_to(noise**2 * np.eye(3 * n), (1000, 3 * n, 3 * n))
    found = mirror_normal(position, cov, receiver_mirror_m=places if known else None)
    assert np.isfinite(found.normal_enu[found.ok]).all()
    assert np.all(found.sigma_rad[found.ok] <= 0.1)
    off = np.linalg.norm(found.normal_enu - rot[:, :, 2], axis=1)
    assert np.all(off[found.ok] < 8.0 * found.sigma_rad[found.ok])
    if width < 1e-3:
        assert not found.ok.any()
        if known:
            assert np.all(found.status == PoseStatus.COLLINEAR)
    if width == 0.2 and noise == 0.002:
        assert found.ok.all()


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("mirror", [TRIANGLE, SQUARE, BOWL])
def test_covariance_is_that_of_the_numerical_derivative(mirror, known):
    n = len(mirror)
    places = mirror if known else None
    position = placed(mirror)
    rng = np.random.default_rng(2)
    if not known and n > 3:
        position = position + 0.02 * rng.standard_normal(position.shape)
    root = rng.standard_normal((3 * n, 3 * n))
    cov = 1e-6 * root @ root.T
    J = np.empty((3, 3 * n))
    for i in range(3 * n):
        step = np.zeros(3 * n)
        step[i] = 1e-6
        step = step.reshape(n, 3)
        ends = [mirror_normal(position + s * step, cov, receiver_mirror_m=places).normal_enu for s in (1, -1)]
        J[:, i] = (ends[0] - ends[1]) / 2e-6
    expected = J @ cov @ J.T
    got = mirror_normal(position, cov, receiver_mirror_m=places).cov_enu
    np.testing.assert_allclose(got, expected, atol=1e-7 * np.abs(expected).max())
    np.testing.assert_allclose(got @ mirror_normal(position, cov, receiver_mirror_m=places).normal_enu, 0.0, atol=1e-15)


def test_a_missing_receiver_is_left_out_while_three_remain():
    position = np.stack([placed(SQUARE)] * 3)
    position[1, 2] = np.nan
    position[2, :2] = np.nan
    cov = np.broadcast_to(identity(4), (3, 12, 12)).copy()
    cov[1, 6:9] = np.nan
    cov[1, :, 6:9] = np.nan
    normals = mirror_normal(position, cov)
    assert normals.status.tolist() == [PoseStatus.OK, PoseStatus.OK, PoseStatus.TOO_FEW]
    assert normals.n_receiver.tolist() == [4, 3, 2]
    np.testing.assert_allclose(normals.normal_enu[:2], [FACING, FACING], atol=1e-12)
    assert normals.sigma_rad[1] > normals.sigma_rad[0]
    assert np.isnan(normals.normal_enu[2]).all()
    assert all(PoseStatus(s).reason for s in normals.status)


@pytest.mark.parametrize("n", [3, 4])
def test_receivers_on_a_line_are_marked(n):
    line = np.linspace(0, 1, n)[:, None] * [1.0, 2.0, 0.5] + [4.0, 5.0, 6.0]
    normals = mirror_normal(np.stack([line, placed(SQUARE)[:n]]), np.broadcast_to(identity(n), (2, 3 * n, 3 * n)))
    assert normals.status.tolist() == [PoseStatus.COLLINEAR, PoseStatus.OK]
    assert np.isnan(normals.normal_enu[0]).all()
    assert np.isnan(normals.cov_enu[0]).all()


def test_calibration_noise_alone_moves_receivers_together():
    position = placed(TRIANGLE)
    apart = joint_covariance(TRANSMITTER, position, 1e-3)
    assert np.all(apart[:3, 3:6] == 0.0)
    both = joint_covariance(TRANSMITTER, position, 1e-6, 1e-3)
    a, b, cross = both[:3, :3], both[3:6, 3:6], both[:3, 3:6]
    difference = a + b - cross - cross.T
    assert np.trace(difference) < 1e-3 * np.trace(a)
    np.testing.assert_allclose(both, both.T, rtol=1e-12)


def mirrors(n_frame=3, n_mirror=4):
    rng = np.random.default_rng(5)
    facing = unit(rng.standard_normal((n_frame, n_mirror, 3)) * [0.3, 0.3, 0.1] + [0, 0, 0.8])
    pivot = rng.uniform(-60, 60, (n_mirror, 3)) * [1, 1, 0] + [0, 0, 2]
    receiver = pivot[:, None] + np.einsum("kx,fmyx->fmky", TRIANGLE, rot_enu_from_mirror(facing))
    receiver = receiver.reshape(n_frame, -1, 3)
    return facing, np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)


def test_all_mirrors_of_all_frames():
    facing, ranges = mirrors()
    rows = [slice(0, 3), [3, 4, 5], range(6, 9), slice(9, 12)]
    poses = solve_poses(TRANSMITTER, ranges - ranges[..., :1], sigma_m=1e-3, calibration_sigma_m=1e-3, mirror_rows=rows)
    np.testing.assert_allclose(poses.normals.normal_enu, facing, atol=1e-7)
    assert poses.normals.ok.all()
    assert poses.centre_enu_m.shape == (3, 4, 3)
    ranges[1, 4] = np.nan
    ranges[2, 0, 3] += 1.0
    poses = solve_poses(TRANSMITTER, ranges, sigma_m=1e-3, mirror_rows=rows, receiver_mirror_m=[TRIANGLE] * 4)
    assert poses.normals.status[1].tolist() == [0, PoseStatus.TOO_FEW, 0, 0]
    assert poses.normals.status[2].tolist() == [PoseStatus.RESIDUAL, 0, 0, 0]
    assert poses.fix_status[1, 4] == FixStatus.NOT_FINITE
    assert np.isfinite(poses.normals.normal_enu[2, 0]).all()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"mirror_rows": [[0, 1]]}, "three or more"),
        ({"receiver_mirror_m": [TRIANGLE]}, "receiver_mirror_m"),
        ({"sigma_m": 0.0}, "sigma_m"),
        ({"calibration_sigma_m": -1.0}, "calibration_sigma_m"),
        ({"sigma_m": np.ones(3)}, "sigma_m"),
        ({"range_difference_m": np.zeros((2, 7))}, "range_difference_m"),
    ],
)
def test_mistakes_are_named(change, match):
    _, ranges = mirrors()
    arguments = {"range_difference_m": ranges, "sigma_m": 1e-3, "mirror_rows": [slice(0, 3), slice(3, 6)]} | change
    with pytest.raises(InvalidInputError, match=match):
        solve_poses(TRANSMITTER, arguments.pop("range_difference_m"), **arguments)


@pytest.mark.parametrize(
    ("position", "cov"), [(np.zeros((2, 3)), np.eye(6)), (np.zeros((3, 2)), np.eye(9)), (TRIANGLE, np.eye(6))]
)
def test_wrong_shapes_are_named(position, cov):
    with pytest.raises(InvalidInputError, match="must"):
        mirror_normal(position, cov)
