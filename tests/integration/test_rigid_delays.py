"""Delays between receivers learned over frames (issue: 1 ns apart, drifting)."""

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.geometry import angle_between_rad, rot_enu_from_mirror
from rfpose.multilat.rigid import (
    MirrorKnowledge,
    MirrorProblem,
    full_covariance,
    rigid_bound,
    solve_rigid,
    tilt_sigma_rad,
)
from rfpose.multilat.rigid.delays import learn_delays
from sites import TABLE_2

SPEED = 299_792_458.0
TRANSMITTER = 100.0 * TABLE_2
PLACES = 1.73 / np.sqrt(3) * np.array([[np.cos(a), np.sin(a), 0.0] for a in np.radians([0, 120, 240])])
SIGMA = 1e-3  # of one transmitter's range: the paper's noise on a 100 m field
N_FRAME, N_MIRROR = 60, 40


def run(drift_ps_per_sqrt_min, *, jump_at=None, learn_with=None):
    """Frames a minute apart, mirrors turning; returns errors over bounds of one and of three clocks, and sigma."""
    rng = np.random.default_rng(4)
    rate = drift_ps_per_sqrt_min * 1e-12 * SPEED / np.sqrt(60.0)
    time = 60.0 * np.arange(N_FRAME)
    pivot = np.column_stack([rng.uniform(-90, 90, (N_MIRROR, 2)), np.full(N_MIRROR, 2.0)])
    pivot[:, :2] *= np.minimum(1.0, 95 / np.linalg.norm(pivot[:, :2], axis=1))[:, None]
    begin, end = rng.standard_normal((2, N_MIRROR, 3)) + np.array([0, 0, 1.5])
    delay = 1e-9 * SPEED * rng.standard_normal((N_MIRROR, 3))
    records = {"one": [], "three": [], "pivot": [], "rot": [], "clock": [], "cov": [], "true": []}
    for f in range(N_FRAME):
        rot = rot_enu_from_mirror(begin + (end - begin) * f / N_FRAME)
        receiver = pivot[:, None] + np.einsum("mab,rb->mra", rot, PLACES)
        distance = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)
        delay = delay + rate * np.sqrt(60.0) * rng.standard_normal(delay.shape)
        if jump_at == f:
            delay[:, 1] += 0.5
        z = distance + rng.uniform(-50, 50, (N_MIRROR, 1, 1)) + delay[:, :, None]
        z = z + SIGMA * rng.standard_normal(z.shape)
        common = {"sigma_m": np.full((N_MIRROR, 1, 3, 10), SIGMA), "transmitter_sigma_m": 1e-7, "clock_class": [0]}
        found = solve_rigid(
            MirrorProblem.of(
                TRANSMITTER, PLACES, z[:, None], start_pivot_enu_m=pivot, start_rot_enu_from_mirror=rot, **common
            )
        )
        records["pivot"].append(found.pivot_enu_m)
        records["rot"].append(found.rot_enu_from_mirror)
        records["clock"].append(found.clock_m)
        records["cov"].append(
            full_covariance(
                MirrorProblem.expected(TRANSMITTER, PLACES, found.pivot_enu_m, found.rot_enu_from_mirror, **common)
            )
        )
        records["true"].append(rot)
        for name, sigma in (("one", 0.0), ("three", np.inf)):
            cov = rigid_bound(
                MirrorProblem.expected(
                    TRANSMITTER, PLACES, pivot, rot, knowledge=MirrorKnowledge(clock_sigma_m=sigma), **common
                )
            )
            records[name].append(tilt_sigma_rad(cov, rot[:, :, 2]))
    out = {name: np.array(values) for name, values in records.items()}
    learned = learn_delays(
        out["pivot"],
        out["rot"],
        out["clock"],
        out["cov"],
        time_s=time,
        drift_m_per_sqrt_s=rate if learn_with is None else learn_with,
    )
    normal = learned.rot_enu_from_mirror[..., 2]
    out["error"] = angle_between_rad(normal, out["true"][..., 2])
    out["sigma"] = tilt_sigma_rad(learned.cov, normal)
    out["jumped"] = learned.jumped
    return out


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def test_slow_delays_reach_the_shared_clock():
    out = run(1.0)
    late = slice(45, None)  # 15 frames × 40 mirrors × 2 angles: the rms is known to 2 %
    assert rms(out["error"][late]) <= 1.3 * rms(out["one"][late])
    assert rms(out["error"][0]) == pytest.approx(rms(out["three"][0]), rel=0.35)
    # the covariance tells the truth all the way
    for part in (slice(0, 5), slice(5, 20), slice(20, 45), late):
        count = 2 * out["error"][part].size
        assert rms(out["error"][part] / out["sigma"][part]) == pytest.approx(1.0, abs=4 / np.sqrt(2 * count) + 0.02)


def test_fast_delays_fall_back_to_three_clocks_not_worse():
    out = run(100.0)
    late = slice(10, None)
    assert rms(out["error"][late]) <= 1.05 * rms(out["three"][late])
    assert rms(out["error"][late] / out["sigma"][late]) == pytest.approx(1.0, abs=0.05)


def test_a_jump_is_noticed_and_learned_anew():
    out = run(1.0, jump_at=30)
    assert out["jumped"][30].all()
    assert not out["jumped"][:30].any()
    assert not out["jumped"][31:].any()
    assert rms(out["error"][30] / out["sigma"][30]) < 1.5
    assert rms(out["error"][55:]) < 1.6 * rms(out["one"][55:])


def test_a_clock_that_nothing_told_of_keeps_what_is_known():
    """Two classes: the second is seen in frames 0, 1 and 3; in frame 2 its numbers are placeholders."""
    n_frame, n_unknown = 4, 6 + 6
    rot = np.broadcast_to(np.eye(3), (n_frame, 1, 3, 3))
    clock = np.zeros((n_frame, 1, 2, 3))
    clock[:, 0, 0] = [0.0, 0.1, 0.2]
    clock[:, 0, 1] = [0.0, 0.3, -0.1]
    clock[2, 0, 1] = 77.0 * np.arange(3)
    cov = np.broadcast_to(1e-6 * np.eye(n_unknown), (n_frame, 1, n_unknown, n_unknown))
    observed = np.ones(clock.shape, bool)
    observed[2, 0, 1] = False
    settings = {"time_s": np.arange(4.0), "drift_m_per_sqrt_s": 1e-5, "observed": observed}
    learned = learn_delays(np.zeros((n_frame, 1, 3)), rot, clock, cov, **settings)
    assert not learned.jumped.any()
    np.testing.assert_allclose(learned.difference_m[:, 0], [[0.1, 0.2, 0.3, -0.1]] * n_frame, atol=1e-9)
    sigma = np.sqrt(np.einsum("fmdd->fmd", learned.difference_cov_m2)[:, 0])
    assert np.all(sigma[2, :2] < sigma[1, :2])
    assert np.all(sigma[2, 2:] >= sigma[1, 2:])
    assert np.all(sigma[3, 2:] < sigma[1, 2:])
    with pytest.raises(InvalidInputError, match="observed"):
        learn_delays(np.zeros((n_frame, 1, 3)), rot, clock, cov, **{**settings, "observed": observed[:2]})


def test_bad_arguments():
    zero = np.zeros((2, 1, 1, 3))
    common = {"time_s": [0.0, 0.0], "drift_m_per_sqrt_s": 1.0}
    with pytest.raises(InvalidInputError, match="time_s"):
        learn_delays(np.zeros((2, 1, 3)), np.zeros((2, 1, 3, 3)), zero, np.zeros((2, 1, 9, 9)), **common)
    with pytest.raises(InvalidInputError, match="cov"):
        learn_delays(np.zeros((2, 1, 3)), np.zeros((2, 1, 3, 3)), zero, np.zeros((2, 1, 6, 6)), **common)
