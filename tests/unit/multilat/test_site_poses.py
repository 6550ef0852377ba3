"""Pose site: mirrors by the carriers between their receivers, with foreseen rays in the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfpose import geometry
from rfpose.errors import InvalidInputError
from rfpose.multilat import PoseStatus
from rfpose.multilat.site import (
    Common,
    ForeseenMirrors,
    SiteKnowledge,
    SiteObservations,
    SitePoses,
    SiteSettings,
    Voltages,
    fit_site,
    spread_starts,
)
from rfpose.propagation import RayKind, Rays

WAVENUMBER = 2.0 * np.pi / 0.69
TRANSMITTER = np.array(
    [
        [100, 0, 20], [50, 87, 30], [-50, 87, 20], [-100, 0, 30], [-50, -87, 20], [50, -87, 30], [43, 25, 40],
        [0, -50, 40],
    ],
    float,
)  # fmt: skip
PLACES = np.array([[1.1, 0.8, 0.05], [-1.1, 0.8, 0.05], [-1.1, -0.8, 0.05], [1.1, -0.8, 0.05]])
POSTURE_RAD, PIVOT_M = 0.02, 0.005


class World:
    """Mirrors in true poses; rays are images of the transmitters in the ground, by plain sums of complex numbers."""

    def __init__(self, n_mirror: int, *, seed: int, coefficient: complex = 0j, told: complex | None = None) -> None:
        self.rng = np.random.default_rng(seed)
        self.pivot = np.c_[self.rng.uniform(-40, 40, (n_mirror, 2)), np.full(n_mirror, 3.0)]
        normal = geometry.unit(self.rng.normal(size=(n_mirror, 3)) * 0.4 + [0.0, 0.0, 1.0])
        self.rot = geometry.rot_enu_from_mirror(normal)
        self.coefficient = coefficient
        self.told = coefficient if told is None else told
        turned = Rotation.from_rotvec(POSTURE_RAD / np.sqrt(3.0) * self.rng.normal(size=(n_mirror, 3)))
        self.commanded = turned.as_matrix() @ self.rot
        self.surveyed = self.pivot + PIVOT_M * self.rng.normal(size=(n_mirror, 3))
        self.field = self._sum(coefficient)

    def _sum(self, coefficient: complex) -> np.ndarray:
        at = self.pivot[:, None] + np.einsum("mab,rb->mra", self.rot, PLACES)
        total = 0j
        for gain, source in ((1.0, TRANSMITTER), (coefficient, TRANSMITTER * [1.0, 1.0, -1.0])):
            way = np.linalg.norm(source - at[:, :, None], axis=-1)
            total = total + gain / way * np.exp(-1j * WAVENUMBER * way)
        return np.asarray(total)

    def observed(self, *, stray: float = 0.0, noise: float = 1e-7) -> SiteObservations:
        """Turn each transmitter's phase at random; stray fields are relative to the direct one."""
        n, n_rx, n_tx = self.field.shape
        direct = 1.0 / np.linalg.norm(TRANSMITTER - self.pivot[:, None], axis=-1)[:, None]
        draw = self.rng.normal(size=(2, n, n_rx, n_tx))
        carrier = self.field + stray * direct * (draw[0] + 1j * draw[1])
        draw = self.rng.normal(size=(2, n, n_rx, n_tx))
        carrier = carrier + noise * (draw[0] + 1j * draw[1])
        carrier = carrier * np.exp(2j * np.pi * self.rng.random((n, 1, n_tx)))
        return SiteObservations(
            carrier=carrier, sigma=np.full(carrier.shape, noise), wavenumber_radpm=np.full(n_tx, WAVENUMBER)
        )

    def known(self) -> SiteKnowledge:
        n = len(self.pivot)
        return SiteKnowledge(
            receiver_mirror_m=np.tile(PLACES, (n, 1, 1)), pivot_enu_m=self.surveyed, pivot_sigma_m=PIVOT_M,
            commanded_rot=self.commanded, posture_sigma_rad=np.full(n, POSTURE_RAD), roll_sigma_rad=np.inf,
            clock_sigma_m=0.0, unit_field=1.0 / np.linalg.norm(TRANSMITTER - self.surveyed[:, None], axis=-1),
        )  # fmt: skip

    def foreseen(self, pivot: np.ndarray, rot: np.ndarray, common: Common) -> Voltages:
        """Foresee direct rays and, if a coefficient is told, their images."""
        n, n_rx, n_tx = self.field.shape
        wanted = np.isfinite(rot).all(axis=(1, 2))
        kinds = [RayKind.DIRECT] + [RayKind.GROUND] * (self.told != 0j)
        count = np.repeat(np.where(wanted, len(kinds), 0), n_rx * n_tx)
        first = np.concatenate([[0], np.cumsum(count)])
        m, r, t, k = (i.ravel() for i in np.indices((n, n_rx, n_tx, len(kinds))))
        keep = wanted[m]
        m, r, t, k = m[keep], r[keep], t[keep], k[keep]
        source = TRANSMITTER[t] * np.where(k == 1, -1.0, 1.0)[:, None] ** [0, 0, 1]
        way = np.linalg.norm(source - pivot[m] - np.einsum("kab,kb->ka", rot[m], PLACES[r]), axis=1)
        voltage = np.where(k == 1, self.told, 1.0) / way
        rays = Rays(
            first=first, source_enu_m=source, place_mirror_m=PLACES[r], extra_m=np.zeros(len(m)),
            field_enu=np.zeros((len(m), 3), complex), kind=np.array(kinds, np.int8)[k],
            thing=np.full(len(m), -1, np.int32),
        )  # fmt: skip
        return Voltages(
            rays=rays, voltage=voltage.astype(complex), slope=np.zeros((len(m), 3), complex),
            soil_slope=np.zeros(len(m), complex), vague=np.zeros(len(first) - 1), reference_rot=rot,
        )  # fmt: skip

    def fit(self, observed: SiteObservations, known: SiteKnowledge | None = None, **settings: object) -> SitePoses:
        return fit_site(observed, known or self.known(), self.foreseen, SiteSettings(**settings))  # type: ignore[arg-type]

    def errors(self, poses: SitePoses) -> tuple[np.ndarray, np.ndarray]:
        """Return angles [rad] and squared errors over covariance, two angles each, of solved mirrors."""
        ok = poses.status == PoseStatus.OK
        off = poses.normal_enu - self.rot[:, :, 2]
        across = self.rot[:, :, :2]
        two = np.einsum("mxa,mx->ma", across, off)[ok]
        cov = np.einsum("mxa,mxy,myb->mab", across, poses.normal_cov, across)[ok]
        return np.linalg.norm(off[ok], axis=1), np.einsum("ma,mab,mb->m", two, np.linalg.inv(cov), two)


def test_a_clean_field_is_solved_to_its_noise() -> None:
    world = World(40, seed=1)
    poses = world.fit(world.observed(noise=1e-6))
    error, squared = world.errors(poses)
    assert (poses.status == PoseStatus.OK).all()
    assert error.max() < 2e-4
    # 80 angles: mean of chi-square over its degrees of freedom has sigma 0.16
    assert 0.5 < squared.mean() / 2.0 < 1.6


@pytest.mark.parametrize("stray", [0.01, 0.1])
def test_what_nothing_foresees_gives_a_larger_sigma_not_a_failure(stray: float) -> None:
    world = World(60, seed=2)
    poses = world.fit(world.observed(stray=stray))
    _, squared = world.errors(poses)
    assert (poses.status == PoseStatus.OK).all()
    assert poses.common.floor == pytest.approx(stray, rel=0.15)
    assert 0.6 < squared.mean() / 2.0 < 1.5
    assert np.mean(squared < 11.83) >= 0.95


def test_a_disturbed_link_counts_less_than_it_would_among_gaussian_ones() -> None:
    world = World(40, seed=3)
    observed = world.observed(stray=0.003)
    hit = observed.carrier.copy()
    hit[:, 1, 2] += 0.6 * np.abs(hit[:, 1, 2]) * np.exp(1j)
    hit[:, 3, 5] *= np.exp(0.8j)
    disturbed = replace(observed, carrier=hit)
    error, squared = world.errors(world.fit(disturbed))
    gaussian, _ = world.errors(world.fit(disturbed, tail=1e6))
    assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean(gaussian**2))
    assert squared.mean() / 2.0 < 1.6
    poses = world.fit(disturbed)
    others = np.ones(hit.shape[1:], bool)
    others[1, 2] = others[3, 5] = False
    assert np.median(poses.weight[:, 1, 2]) < 0.3 < np.median(poses.weight[:, others])


def test_a_ground_whose_coefficient_is_off_is_within_its_stated_factor() -> None:
    world = World(40, seed=4, coefficient=-0.3 + 0.1j, told=1.2 * (-0.3 + 0.1j))
    observed = world.observed(stray=3e-3)
    poses = world.fit(observed, factor_sigma={RayKind.GROUND: (0.3, 0.3)})
    error, squared = world.errors(poses)
    exact, _ = world.errors(world.fit(observed, factor_sigma={}))
    assert squared.mean() / 2.0 < 1.6
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(exact**2))


def test_cov_holds_over_many_mirrors_with_a_ground() -> None:
    world = World(200, seed=5, coefficient=-0.5 + 0.2j)
    _, squared = world.errors(world.fit(world.observed(stray=0.02)))
    # 400 angles: sigma of the mean 0.07; the tail of Student's t adds to it
    assert 0.75 < squared.mean() / 2.0 < 1.3


def test_protection_levels_hold_at_their_risk() -> None:
    world = World(400, seed=6)
    poses = world.fit(world.observed(stray=0.05), missed_detection=0.02)
    error, _ = world.errors(poses)
    level = poses.protection_level_rad[poses.status == PoseStatus.OK]
    # 8 of 400 at the stated risk; the level covers the worse of two axes in all directions, so fewer are expected
    assert 0 <= np.count_nonzero(error > level) <= 16
    assert np.median(level / error) < 30.0


def test_mirrors_without_start_or_signal_are_marked_and_the_rest_goes_on() -> None:
    world = World(6, seed=7)
    observed, known = world.observed(stray=0.01), world.known()
    rot, carrier = known.commanded_rot.copy(), observed.carrier.copy()
    rot[1], carrier[2], carrier[3, :, 2:] = np.nan, np.nan, np.nan
    poses = world.fit(replace(observed, carrier=carrier), replace(known, commanded_rot=rot))
    assert [PoseStatus(s) for s in poses.status] == [
        PoseStatus.OK, PoseStatus.NO_POSTURE, PoseStatus.UNKNOWNS, PoseStatus.UNKNOWNS, PoseStatus.OK, PoseStatus.OK,
    ]  # fmt: skip
    for lost in (1, 2, 3):
        assert np.isnan(poses.normal_enu[lost]).all()
        assert np.isnan(poses.protection_level_rad[lost])


def test_delays_between_receivers_that_are_not_known_are_fitted() -> None:
    world = World(40, seed=8)
    observed = world.observed(stray=0.003)
    delay_m = world.rng.normal(size=(40, 4, 1)) * 0.02
    late = replace(observed, carrier=observed.carrier * np.exp(-1j * WAVENUMBER * delay_m))
    _, ignored = world.errors(world.fit(late))
    _, squared = world.errors(world.fit(late, replace(world.known(), clock_sigma_m=0.02)))
    assert 0.6 < squared.mean() / 2.0 < 1.6 < ignored.mean() / 2.0


def test_a_short_wavelength_is_searched_from_several_starts() -> None:
    assert len(spread_starts(0.02, 1.4, 0.69)) == 1
    starts = spread_starts(0.02, 1.4, 0.12)
    assert (starts[0] == 0.0).all()
    assert len(starts) > 6
    assert np.linalg.norm(starts, axis=1).max() < 2.5 * 0.02 + 0.12 / 1.4 / 3.0


def test_arrays_of_other_mirrors_are_refused() -> None:
    world = World(3, seed=9)
    other = World(4, seed=9)
    with pytest.raises(InvalidInputError, match="same mirrors"):
        world.fit(world.observed(), other.known())
    with pytest.raises(InvalidInputError, match="one shape"):
        SiteObservations(carrier=np.ones((2, 3, 4), complex), sigma=np.ones((2, 3)), wavenumber_radpm=np.ones(4))


@pytest.mark.parametrize("told", [0j, -0.5 + 0.2j])
def test_the_forecast_is_the_covariance_of_weighed_phases(told: complex) -> None:
    world = World(3, seed=5, coefficient=told)
    known, floor, tail, noise = world.known(), 0.02, 8.0, 1e-4
    exact = SiteSettings(floor=floor, tail=tail, factor_sigma={}, soil_sigma=(0.0, 0.0))
    sigma = np.full(world.field.shape, noise)
    found = ForeseenMirrors.of(sigma, np.full(len(TRANSMITTER), WAVENUMBER), known, world.foreseen, exact).poses()
    assert (found.status == PoseStatus.OK).all()

    def field(m: int, w: np.ndarray) -> np.ndarray:
        rot = Rotation.from_rotvec(w[:3]).as_matrix() @ known.commanded_rot[m]
        at = known.pivot_enu_m[m] + w[3:] + PLACES @ rot.T
        total = 0j
        for gain, source in ((1.0, TRANSMITTER), (told, TRANSMITTER * [1.0, 1.0, -1.0])):
            # a ray's voltage is that of where the mirror stands
            there = known.pivot_enu_m[m] + PLACES @ known.commanded_rot[m].T
            way, stands = (np.linalg.norm(source - a[:, None], axis=-1) for a in (at, there))
            total = total + gain / stands * np.exp(-1j * WAVENUMBER * way)
        return np.asarray(total).ravel()

    for m in range(3):
        h = field(m, np.zeros(6))
        slope = np.stack([np.angle(field(m, 1e-6 * e) / field(m, -1e-6 * e)) / 2e-6 for e in np.eye(6)], axis=1)
        rows = np.hstack([slope, np.tile(np.eye(len(TRANSMITTER)), (len(PLACES), 1))])
        stray = floor * np.tile(known.unit_field[m], len(PLACES))
        heavy = (tail + 3.0) / (tail + 1.0)  # Student's t against a normal distribution of its scale; priors have none
        rows *= (np.abs(h) / np.hypot(noise, stray) / np.sqrt(heavy))[:, None]
        info = rows.T @ rows
        normal = known.commanded_rot[m][:, 2]
        roll = min(POSTURE_RAD / np.hypot(*normal[:2]), 1.0)
        info[:3, :3] += (np.eye(3) - np.outer(normal, normal)) / POSTURE_RAD**2 + np.outer(normal, normal) / roll**2
        info[3:6, 3:6] += np.eye(3) / PIVOT_M**2
        cross = np.cross(np.eye(3), normal)
        expected = cross.T @ np.linalg.inv(info)[:3, :3] @ cross
        np.testing.assert_allclose(found.normal_cov[m], expected, rtol=2e-3, atol=1e-3 * np.trace(expected))


def test_a_forecast_without_anything_to_begin_from_says_so() -> None:
    world = World(3, seed=5)
    known = world.known()
    known.commanded_rot[1] = np.nan
    sigma = np.full(world.field.shape, 1e-6)
    wavenumber = np.full(len(TRANSMITTER), WAVENUMBER)
    found = ForeseenMirrors.of(sigma, wavenumber, known, world.foreseen).poses()
    assert found.status.tolist() == [PoseStatus.OK, PoseStatus.NO_POSTURE, PoseStatus.OK]
    assert np.isnan(found.normal_cov[1]).all()
    given = ForeseenMirrors.of(sigma, wavenumber, known, world.foreseen, SiteSettings(floor=0.05, tail=3.0)).poses()
    np.testing.assert_array_equal(found.cov, given.cov)
