"""Filter over frames: covariance against scatter, outages, outliers, instants."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rfpose.errors import InvalidInputError
from rfpose.geometry import rot_enu_from_mirror
from rfpose.multilat.filtering import Contradiction, FilterSettings, FilterStatus, _kernels, filter_poses

SIGMA = np.array([2e-3, 2e-3, 5e-3, 4e-4, 6e-4, 3e-4])


def correlated(rng):
    """A covariance with pivot and rotation correlated."""
    mix = np.eye(6) + 0.3 * rng.standard_normal((6, 6))
    return SIGMA[:, None] * (mix @ mix.T) * SIGMA


def simulate(rng, n_frame, n_mirror, *, step=10.0, walk=3e-6, rate=1e-4, exposure=0.0, fine=1):
    """True poses in the middle of frames, and measured mean poses over them."""
    cov = correlated(rng)
    root = np.linalg.cholesky(cov)
    turn = Rotation.from_matrix(rot_enu_from_mirror(rng.normal([0, 0, 2], 1.0, (n_mirror, 3))))
    pivot = rng.uniform(-50, 50, (n_mirror, 3))
    omega = rate * rng.standard_normal((n_mirror, 3))
    middle, measured = [], []
    inside = exposure / fine
    for _ in range(n_frame):
        # frames back to front: the rest of the step, then the exposure in pieces
        turn, omega = advance(rng, turn, omega, step - exposure, walk)
        pieces = []
        for piece in range(fine):
            turn, omega = advance(rng, turn, omega, 0.5 * inside, walk)
            pieces.append(turn)
            if piece == fine // 2:
                middle.append((turn.as_matrix(), omega))
            turn, omega = advance(rng, turn, omega, 0.5 * inside, walk)
        base = middle[-1][0]
        mean = np.mean([(p * Rotation.from_matrix(base).inv()).as_rotvec() for p in pieces], axis=0)
        noise = rng.standard_normal((n_mirror, 6)) @ root.T
        seen = Rotation.from_rotvec(noise[:, 3:]) * Rotation.from_rotvec(mean) * Rotation.from_matrix(base)
        measured.append((pivot + noise[:, :3], seen.as_matrix()))
    truth = pivot, np.array([m[0] for m in middle]), np.array([m[1] for m in middle])
    data = np.array([m[0] for m in measured]), np.array([m[1] for m in measured])
    return truth, data, np.broadcast_to(cov, (n_frame, n_mirror, 6, 6))


def advance(rng, turn, omega, dt, walk):
    """Rate and angle of a random-walk rate, exactly (to first order in the walk)."""
    if dt == 0.0:
        return turn, omega
    a, b = rng.standard_normal((2, *omega.shape))
    change = walk * np.sqrt(dt) * a
    angle = walk * dt**1.5 * (a / 2 + b / np.sqrt(12.0))
    return Rotation.from_rotvec(omega * dt + angle) * turn, omega + change


def error_state(found, truth, frames=slice(None)):
    """Errors (frame, mirror, 9) of pivot, rotation, rate."""
    pivot, rot, rate = truth
    turn = Rotation.from_matrix((rot @ found.rot_enu_from_mirror.swapaxes(-1, -2))[frames].reshape(-1, 3, 3))
    turn = turn.as_rotvec().reshape(*found.rate_enu_radps[frames].shape)
    return np.concatenate([(pivot - found.pivot_enu_m)[frames], turn, (rate - found.rate_enu_radps)[frames]], axis=-1)


def nees(found, truth, frames=slice(None), part=slice(0, 9)):
    e = error_state(found, truth, frames)[..., part]
    cov = found.cov[frames][..., part, part]
    return np.einsum("...a,...a->...", e, np.linalg.solve(cov, e[..., None])[..., 0])


@pytest.mark.parametrize(("step", "exposure", "fine"), [(10.0, 0.0, 1), (10.0, 8.0, 9)])
def test_covariance_tells_the_truth(step, exposure, fine):
    """Mean normalised error squared is nine: 600 mirrors, 9 dof, known to sqrt(2/(9·600)) = 1.9 % at each frame."""
    rng = np.random.default_rng(4)
    n_mirror, walk = 600, 3e-5
    truth, data, cov = simulate(rng, 40, n_mirror, step=step, walk=walk, exposure=exposure, fine=fine, rate=1e-3)
    found = filter_poses(
        *data,
        cov,
        time_s=step * np.arange(40),
        exposure_s=exposure,
        motion=FilterSettings(rate_walk_radps_per_sqrt_s=walk, rate_sigma_radps=1e-3),
    )
    assert np.all(found.status[0] == FilterStatus.STARTED)
    for frame in (0, 1, 5, 39):
        assert nees(found, truth)[frame].mean() == pytest.approx(9.0, rel=0.08)
    late = nees(found, truth, slice(20, None), slice(3, 6))
    assert late.mean() == pytest.approx(3.0, rel=0.06)
    # what walks within a frame is taken as independent of what walks between frames: a little too careful
    assert np.nanmean(found.distance2[1:]) == pytest.approx(6.0, rel=0.02 if exposure == 0.0 else 0.05)
    # filtering helps: a single frame's rotation is less certain
    assert found.tilt_sigma_rad[-1].mean() < 0.7 * found.tilt_sigma_rad[0].mean()


def test_outage_coasts_with_growing_covariance_that_is_true():
    rng = np.random.default_rng(5)
    walk, lost = 1e-5, slice(20, 32)
    truth, data, cov = simulate(rng, 40, 500, walk=walk)
    pivot, rot = np.array(data[0]), np.array(data[1])
    rot[lost] = np.nan
    found = filter_poses(
        pivot, rot, cov, time_s=10.0 * np.arange(40), motion=FilterSettings(rate_walk_radps_per_sqrt_s=walk)
    )
    assert np.all(found.status[lost] == FilterStatus.COASTED)
    assert np.all(np.diff(found.tilt_sigma_rad[19:32], axis=0) > 0)
    assert np.all(found.tilt_sigma_rad[32] < found.tilt_sigma_rad[31])
    assert nees(found, truth)[31].mean() == pytest.approx(9.0, rel=0.09)
    limited = filter_poses(
        pivot,
        rot,
        cov,
        time_s=10.0 * np.arange(40),
        motion=FilterSettings(rate_walk_radps_per_sqrt_s=walk, max_coast_s=55.0),
    )
    assert np.all(limited.status[24] == FilterStatus.COASTED)
    assert np.all(limited.status[25:32] == FilterStatus.LOST)
    assert np.isnan(limited.normal_enu[25:32]).all()
    assert np.all(limited.status[32] == FilterStatus.RESTARTED)


def test_outliers_are_left_out_and_a_jump_is_believed():
    rng = np.random.default_rng(6)
    truth, data, cov = simulate(rng, 30, 50)
    pivot, rot = np.array(data[0]), np.array(data[1])
    turn = Rotation.from_rotvec([0.0, 0.05, 0.0]).as_matrix()
    rot[12, 0] = turn @ rot[12, 0]
    pivot[12, 1] += [0.5, 0, 0]
    rot[20:, 2] = turn @ rot[20:, 2]
    found = filter_poses(
        pivot, rot, cov, time_s=10.0 * np.arange(30), motion=FilterSettings(rate_walk_radps_per_sqrt_s=3e-6)
    )
    assert found.status[12, 0] == found.status[12, 1] == FilterStatus.GATED
    assert Contradiction(found.contradiction[12, 0]) & Contradiction.ROTATION
    assert Contradiction(found.contradiction[12, 1]) & Contradiction.POSITION
    assert list(found.status[19:24, 2]) == [
        FilterStatus.UPDATED,
        FilterStatus.GATED,
        FilterStatus.GATED,
        FilterStatus.RESTARTED,
        FilterStatus.UPDATED,
    ]
    others = np.delete(found.status[1:], [0, 1, 2], axis=1)
    assert np.all(others == FilterStatus.UPDATED)  # 1 350 tests at 1e-6
    assert nees(found, truth)[12, :2].max() < chi2.isf(1e-6, 9)


def test_the_instant_is_the_one_that_is_said():
    """A mirror that turns steadily, no noise to speak of: half a minute later it is where its rate takes it."""
    time = 10.0 * np.arange(20)
    rate = np.array([2e-4, -1e-4, 3e-4])
    first = Rotation.from_matrix(rot_enu_from_mirror([0.2, 0.5, 0.8]))
    rot = (Rotation.from_rotvec(time[:, None] * rate) * first).as_matrix()[:, None]
    cov = np.broadcast_to(np.diag(np.full(6, 1e-14)), (20, 1, 6, 6))
    motion = FilterSettings(rate_walk_radps_per_sqrt_s=1e-9)
    found = filter_poses(np.zeros((20, 1, 3)), rot, cov, time_s=time, delay_s=30.0, motion=motion)
    assert found.time_s[-1] == time[-1] + 30.0
    expected = (Rotation.from_rotvec((time[-1] + 30.0) * rate) * first).as_matrix()
    np.testing.assert_allclose(found.rot_enu_from_mirror[-1, 0], expected, atol=1e-8)
    np.testing.assert_allclose(found.rate_enu_radps[-1, 0], rate, rtol=1e-5)


def test_many_calls_equal_one():
    rng = np.random.default_rng(7)
    _, (pivot, rot), cov = simulate(rng, 12, 20)
    pivot[5, 3], rot[7:9, 4] = np.nan, np.nan
    time = 10.0 * np.arange(12)
    whole = filter_poses(pivot, rot, cov, time_s=time)
    state, rows = None, []
    for k in range(12):
        found = filter_poses(pivot[k : k + 1], rot[k : k + 1], cov[k : k + 1], time_s=time[k : k + 1], state=state)
        state = found.state
        rows.append(found.rot_enu_from_mirror[0])
    np.testing.assert_array_equal(np.array(rows), whole.rot_enu_from_mirror)
    np.testing.assert_array_equal(state.cov, whole.state.cov)


def test_arrays_that_lie_otherwise_or_are_read_only_are_not_compiled_for():
    _, (pivot, rot), cov = simulate(np.random.default_rng(4), 3, 2)
    time = 10.0 * np.arange(3)
    plain = filter_poses(pivot, rot, cov.copy(), time_s=time, usable=np.ones((3, 2), bool))
    known = list(_kernels.filter_many.compiled.signatures)
    usable = np.broadcast_to(np.True_, (3, 2))
    time.flags.writeable = False
    other = filter_poses(np.asfortranarray(pivot), np.asfortranarray(rot), cov, time_s=time, usable=usable)
    assert other.normal_enu.tobytes() == plain.normal_enu.tobytes()
    assert _kernels.filter_many.compiled.signatures == known


def test_marked_measurements_and_missing_starts():
    rng = np.random.default_rng(8)
    _, (pivot, rot), cov = simulate(rng, 4, 2)
    usable = np.ones((4, 2), bool)
    usable[:2, 1] = False
    found = filter_poses(pivot, rot, cov, time_s=np.arange(4.0), usable=usable)
    assert list(found.status[:, 1]) == [
        FilterStatus.UNKNOWN,
        FilterStatus.UNKNOWN,
        FilterStatus.STARTED,
        FilterStatus.UPDATED,
    ]
    assert np.isnan(found.tilt_sigma_rad[:2, 1]).all()


def test_logarithm_of_rotations():
    for vector in ([0, 0, 0], [1e-12, 0, 0], [0.1, -0.2, 0.3], [0, np.pi - 1e-4, 0], [0, np.pi, 0]):
        out = np.empty(3)
        _kernels.rotation_vector(Rotation.from_rotvec(vector).as_matrix(), out)
        np.testing.assert_allclose(Rotation.from_rotvec(out).as_matrix(), Rotation.from_rotvec(vector).as_matrix(),
                                   atol=1e-9)  # fmt: skip


def test_bad_arguments():
    good = (np.zeros((2, 1, 3)), np.tile(np.eye(3), (2, 1, 1, 1)), np.tile(np.eye(6), (2, 1, 1, 1)))
    with pytest.raises(InvalidInputError, match="time_s"):
        filter_poses(*good, time_s=[1.0, 1.0])
    with pytest.raises(InvalidInputError, match="exposure_s"):
        filter_poses(*good, time_s=[0.0, 1.0], exposure_s=-1.0)
    with pytest.raises(InvalidInputError, match="gate_probability"):
        FilterSettings(gate_probability=0.0)
    earlier = filter_poses(*good, time_s=[0.0, 1.0]).state
    with pytest.raises(InvalidInputError, match="increase"):
        filter_poses(*good, time_s=[1.0, 2.0], state=earlier)
