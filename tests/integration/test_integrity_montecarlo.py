"""Integrity over random mirrors: what is promised against what happens.

Tolerances: binomial or normal, five sigma; random mirrors in Table 2's field of 100 m radius (verification.md R1).
"""

from dataclasses import replace

import numpy as np
import pytest

from rfpose.geometry import rot_enu_from_mirror
from rfpose.multilat.integrity import Alarms, IntegrityStatus, TransmitterStatus, solve_with_integrity
from rfpose.multilat.integrity.guard import limit, noncentrality
from rfpose.multilat.integrity.hypotheses import judge
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, solve_rigid
from rfpose.multilat.rigid.weights import equations_of
from sites import TABLE_2

TRANSMITTER = 100.0 * TABLE_2
PLACES = np.array([[1.0, 0, 0], [-0.5, 0.866, 0], [-0.5, -0.866, 0]])
SIGMA = 1e-3


class Field:
    """Random mirrors; shared or separate clocks; calibrated to 1 mm or differences between receivers."""

    def __init__(self, n, seed, *, shared=True, calibrated=True, noise=1.0):
        rng = np.random.default_rng(seed)
        radius, azimuth = 95.0 * np.sqrt(rng.random(n)), rng.uniform(0.0, 2 * np.pi, n)
        pivot = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(n, 3.0)], axis=-1)
        normal = rng.standard_normal((n, 3))
        normal[:, 2] = np.abs(normal[:, 2]) + 0.3
        self.rot = rot_enu_from_mirror(normal)
        receiver = pivot[:, None] + np.einsum("mab,rb->mra", self.rot, PLACES)
        z = np.linalg.norm(receiver[:, :, None] - TRANSMITTER, axis=-1)
        z = z + noise * SIGMA * rng.standard_normal(z.shape)
        z += noise * (SIGMA if calibrated else 5.0) * rng.standard_normal((n, 1, 10))
        z += 5.0 * rng.standard_normal((n, 1 if shared else 3, 1))
        self.z = z[:, None]
        clock = 0.0 if shared else np.inf
        self.known = MirrorKnowledge(clock_sigma_m=clock)
        if not calibrated:
            survey = pivot + 5e-3 * rng.standard_normal(pivot.shape)
            self.known = MirrorKnowledge(clock_sigma_m=clock, pivot_enu_m=survey, pivot_sigma_m=5e-3)
        self.common = SIGMA if calibrated else np.inf
        self.settings = {
            "sigma_m": SIGMA,
            "transmitter_sigma_m": self.common,
            "clock_class": [0],
            "start_pivot_enu_m": pivot + 0.3,
            "start_rot_enu_from_mirror": self.rot,
            "knowledge": self.known,
        }

    def guarded(self, z, **more):
        return solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, z, **self.settings), Alarms(**more))

    def plain(self, z):
        return solve_rigid(MirrorProblem.of(TRANSMITTER, PLACES, z, **self.settings))

    def problem(self, z):
        return MirrorProblem.of(TRANSMITTER, PLACES, z, **self.settings)

    def judged(self, z, poses):
        return judge(self.problem(z), poses)

    def error(self, normal):
        return np.linalg.norm(np.cross(normal, self.rot[:, :, 2]), axis=-1)


def rms(x):
    return np.sqrt(np.mean(x**2))


@pytest.mark.parametrize("calibrated", [True, False], ids=["calibrated", "between"])
@pytest.mark.parametrize("shared", [True, False], ids=["shared", "separate"])
def test_without_errors_every_statistic_is_chi2_and_alarms_are_as_rare_as_stated(shared, calibrated):
    n = 2000
    field = Field(n, 1, shared=shared, calibrated=calibrated)
    poses = field.plain(field.z)
    verdict = field.judged(field.z, poses)
    for stat, dof in ((verdict.stat, verdict.dof), (verdict.link, verdict.link_dof)):
        mean, expected = stat.mean(axis=0), dof[0]
        assert np.all(np.abs(mean - expected) < 5.0 * np.sqrt(2.0 * expected / n) + 1e-9)
    dof = equations_of(field.problem(field.z)).dof
    assert poses.chi2.mean() == pytest.approx(dof[0], abs=5.0 * np.sqrt(2.0 * dof[0] / n))
    found = field.guarded(field.z, false_alarm=0.05)
    assert np.mean(found.status != IntegrityStatus.OK) < 0.05 + 5.0 * np.sqrt(0.05 / n)
    assert np.mean(found.status != IntegrityStatus.OK) > 0.01


@pytest.mark.parametrize("size", [20.0, 200.0, 1000.0])
@pytest.mark.parametrize("kind", ["common", "one receiver", "each its own"])
@pytest.mark.parametrize("shared", [True, False], ids=["shared", "separate"])
def test_one_transmitter_off_is_left_out(shared, kind, size):
    """99 % from 20 sigma (0.985 of 800: sampling), normal error within 1.2 of that without the error."""
    n = 800
    field = Field(n, 2, shared=shared)
    rng = np.random.default_rng(3)
    who, at = rng.integers(0, 10, n), np.arange(n)
    shape = np.ones((n, 3))
    if kind == "one receiver":
        shape = np.eye(3)[rng.integers(0, 3, n)]
    elif kind == "each its own":
        shape = rng.standard_normal((n, 3))
        shape *= np.sqrt(3.0) / np.linalg.norm(shape, axis=1, keepdims=True)
    z = field.z.copy()
    z[at, 0, :, who] += size * SIGMA * shape
    found = field.guarded(z)
    assert np.mean(found.transmitter_status[at, who] > TransmitterStatus.NOT_RECEIVED) > 0.985
    error = field.error(found.poses.normal_enu)
    assert rms(error) < 1.2 * rms(field.error(field.plain(field.z).normal_enu))
    assert np.sum(error > found.protection_level_rad) <= 1


@pytest.mark.parametrize("shared", [True, False], ids=["shared", "separate"])
def test_errors_exceed_the_protection_level_no_more_often_than_stated(shared):
    """The error that tilts most for its trace, of the transmitter that sets the level, at sizes about the worst."""
    n, missed = 250, 0.1
    field = Field(n, 4, shared=shared, noise=0.0)
    clean = field.guarded(field.z)
    who, at = clean.worst_transmitter, np.arange(n)
    rng = np.random.default_rng(5)
    worst, slope = np.zeros_like(field.z), np.zeros(n)
    for _ in range(30):
        trial = np.zeros_like(field.z)
        trial[at, 0, :, who] = SIGMA * rng.standard_normal((n, 3))
        poses = field.plain(field.z + trial)
        verdict = field.judged(field.z + trial, poses)
        trace = np.sqrt(verdict.stat[at, who])
        tilt = field.error(poses.normal_enu) / trace
        better = tilt > slope
        slope[better] = tilt[better]
        worst[better] = (trial / trace[:, None, None, None])[better]
    dof = verdict.dof[at, who]
    hidden = np.sqrt(noncentrality(limit(5e-3 / 43, dof), dof, missed))
    # the level holds the tilt of an error just as large as may be missed, and no more than it must
    noise = np.sqrt(-2.0 * np.log(missed)) * clean.poses.tilt_sigma_rad
    level = field.guarded(field.z, missed_detection=missed).protection_level_rad
    assert np.all(hidden * slope < level)
    assert np.median((hidden * slope + noise) / level) > 0.85
    silent = 0
    for scale in (0.7, 1.0, 1.3):
        beyond = 0
        for _ in range(4):
            z = field.z + scale * hidden[:, None, None, None] * worst
            z = z + SIGMA * (rng.standard_normal(z.shape) + rng.standard_normal((n, 1, 1, 10)))
            found = field.guarded(z, missed_detection=missed)
            beyond += np.sum(field.error(found.poses.normal_enu) > found.protection_level_rad)
            silent += np.sum(found.status == IntegrityStatus.OK)
        assert beyond < missed * 4 * n
    assert silent > 0.05 * 12 * n  # most were indeed too small to be seen


def test_a_weaker_statement_gives_a_smaller_level():
    field = Field(200, 6)
    levels = [field.guarded(field.z, missed_detection=p).protection_level_rad for p in (1e-1, 1e-3, 1e-5)]
    assert np.all(levels[0] < levels[1])
    assert np.all(levels[1] < levels[2])


def test_two_errors_are_found_or_covered():
    """Two errors of 30 sigma can look like others; then more is left out, or the level says so."""
    n = 1000
    field = Field(n, 7)
    rng = np.random.default_rng(8)
    pair = np.argsort(rng.random((n, 10)), axis=1)[:, :2]
    z = field.z.copy()
    for k in range(2):
        z[np.arange(n), 0, :, pair[:, k]] += 30.0 * SIGMA * rng.choice([-1.0, 1.0], n)[:, None]
    found = field.guarded(z)
    out = found.transmitter_status > TransmitterStatus.NOT_RECEIVED
    assert np.mean(np.take_along_axis(out, pair, axis=1).all(axis=1)) > 0.85
    assert rms(field.error(found.poses.normal_enu)) < 1.3 * rms(field.error(field.plain(field.z).normal_enu))
    assert np.sum(field.error(found.poses.normal_enu) > found.protection_level_rad) <= 2


def test_a_pivot_prior_that_contradicts_a_few_mirrors_costs_only_those():
    field = Field(300, 9)
    pivot = field.settings["start_pivot_enu_m"] - 0.3
    survey = pivot + 5e-3 * np.random.default_rng(10).standard_normal(pivot.shape)
    survey[:20, 1] += 1.0
    known = replace(field.known, pivot_enu_m=survey, pivot_sigma_m=5e-3)
    settings = {**field.settings, "knowledge": known}
    found = solve_with_integrity(MirrorProblem.of(TRANSMITTER, PLACES, field.z, **settings))
    assert found.prior_rejected[:20, 0].all()
    assert found.prior_rejected[20:].mean() < 0.02
    error = field.error(found.poses.normal_enu)
    assert rms(error[:20]) < 2.0 * rms(error[20:])
