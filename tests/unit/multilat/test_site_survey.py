"""What does not change, surveyed from carriers in many postures: closed form, from direct rays."""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from rfpose import geometry
from rfpose.multilat.site import (
    PostureCorrelation,
    ReferencePoses,
    SiteKnowledge,
    SiteObservations,
    SiteSettings,
    SurveyConstants,
    SurveyPrior,
    Voltages,
    lever_to_turn,
    survey_site,
)
from rfpose.propagation import RayKind, Rays

TRANSMITTERS = np.array(
    [
        [70.0, 0.0, 12.0], [35.0, 60.0, 18.0], [-35.0, 60.0, 12.0], [-70.0, 0.0, 18.0], [-35.0, -60.0, 12.0],
        [35.0, -60.0, 18.0], [30.0, 17.0, 25.0], [-30.0, 17.0, 25.0], [0.0, -35.0, 25.0], [5.0, 8.0, 32.0],
    ]
)  # fmt: skip
PLACES = np.array([[1.0, 0.0, 0.3], [-0.5, 0.87, 0.3], [-0.5, -0.87, 0.3]])
PIVOTS = np.array([[20.0, 5.0, 3.0], [-15.0, 30.0, 3.0], [10.0, -28.0, 3.0], [-32.0, -12.0, 3.0]])
WAVE = 2.0 * np.pi * 2.4e9 / 299_792_458.0 * (1.0 + 1e-4 * np.arange(len(TRANSMITTERS)))
NOISE = 3e-3
N_FRAME = 24
PRIOR = SurveyPrior(
    place_sigma_m=1e-3, pivot_sigma_m=3e-3, transmitter_sigma_m=np.zeros(len(TRANSMITTERS)), delay_sigma_m=0.0
)
SETTINGS = SiteSettings(tail=30.0, own_scale=np.inf, rounds=1)


def direct(constants, pivot, rot):
    """Rays from transmitters straight to receivers, as a site would foresee them."""
    n_frame = len(pivot) // len(PIVOTS)
    place = np.tile(constants.receiver_mirror_m, (n_frame, 1, 1))
    place = np.repeat(place[:, :, None], len(TRANSMITTERS), axis=2).reshape(-1, 3)
    source = np.tile(constants.transmitter_enu_m, (len(pivot) * 3, 1))
    known = np.repeat(np.isfinite(rot[:, 0, 0]), 3 * len(TRANSMITTERS))
    n = int(known.sum())
    mirror = np.repeat(np.arange(len(pivot)), 3 * len(TRANSMITTERS))[known]
    reach = np.linalg.norm(source[known] - pivot[mirror], axis=1)
    rays = Rays(
        first=np.concatenate([[0], np.cumsum(known)]), source_enu_m=source[known], place_mirror_m=place[known],
        extra_m=np.zeros(n), field_enu=np.zeros((n, 3), np.complex128), kind=np.full(n, RayKind.DIRECT, np.int8),
        thing=np.full(n, -1, np.int32),
    )  # fmt: skip
    return Voltages(
        rays=rays, voltage=(1.0 / reach).astype(np.complex128), slope=np.zeros((n, 3), np.complex128),
        soil_slope=np.zeros(n, np.complex128), vague=np.zeros(len(known)), reference_rot=rot,
    )  # fmt: skip


def field_for(constants):
    return lambda pivot, rot, common: direct(constants, pivot, rot)


def postures(rng, n_frame=N_FRAME):
    tilt, azimuth = rng.uniform(0.3, 1.0, (n_frame, len(PIVOTS))), rng.uniform(2.0, 4.3, (n_frame, len(PIVOTS)))
    normal = geometry.enu_from_azimuth_elevation(azimuth, np.pi / 2.0 - tilt)
    return geometry.rot_enu_from_mirror(normal).reshape(-1, 3, 3)


class Site:
    """A field whose receivers are not quite where they are said to be."""

    def __init__(self, seed, prior=PRIOR, n_frame=N_FRAME):
        rng = np.random.default_rng(seed)
        self.prior = prior
        self.given = SurveyConstants(
            receiver_mirror_m=np.tile(PLACES, (len(PIVOTS), 1, 1)), pivot_enu_m=PIVOTS,
            transmitter_enu_m=TRANSMITTERS, delay_m=np.zeros((len(PIVOTS), 3)),
        )  # fmt: skip
        self.true = SurveyConstants(
            receiver_mirror_m=PLACES + prior.place_sigma_m * rng.standard_normal((len(PIVOTS), 3, 3)),
            pivot_enu_m=PIVOTS + prior.pivot_sigma_m * rng.standard_normal(PIVOTS.shape),
            transmitter_enu_m=TRANSMITTERS + prior.transmitter_sigma_m[:, None] * rng.standard_normal((10, 3)),
            delay_m=prior.delay_sigma_m * rng.standard_normal((len(PIVOTS), 3)),
        )
        self.rot = postures(rng, n_frame)
        n = len(self.rot)
        pivot = np.tile(self.true.pivot_enu_m, (n_frame, 1))
        place = pivot[:, None] + np.einsum(
            "mab,mrb->mra", self.rot, np.tile(self.true.receiver_mirror_m, (n_frame, 1, 1))
        )
        path = np.linalg.norm(self.true.transmitter_enu_m - place[:, :, None], axis=3)
        path = path + np.tile(self.true.delay_m, (n_frame, 1))[..., None]
        size = 1.0 / np.linalg.norm(TRANSMITTERS - pivot[:, None], axis=2)[:, None]
        phase = -WAVE * path + rng.uniform(-3.0, 3.0, (n, 1, len(TRANSMITTERS)))
        noise = NOISE * (rng.standard_normal(path.shape) + 1j * rng.standard_normal(path.shape))
        commanded = geometry.rot_enu_from_mirror(geometry.unit(self.rot[:, :, 2] + 2e-3 * rng.standard_normal((n, 3))))
        self.seen = SiteObservations(
            carrier=size * (np.exp(1j * phase) + noise), sigma=NOISE * np.broadcast_to(size, path.shape).copy(),
            wavenumber_radpm=WAVE,
        )  # fmt: skip
        self.known = SiteKnowledge(
            receiver_mirror_m=np.tile(PLACES, (n, 1, 1)), pivot_enu_m=np.tile(PIVOTS, (n_frame, 1)), pivot_sigma_m=3e-3,
            commanded_rot=commanded, posture_sigma_rad=np.full(n, 5e-3), roll_sigma_rad=np.inf, clock_sigma_m=0.0,
            unit_field=np.broadcast_to(size[:, 0], (n, len(TRANSMITTERS))).copy(),
        )  # fmt: skip

    def reference(self, every, sigma=1e-4, seed=5):
        rng = np.random.default_rng(seed)
        normal = np.full((len(self.rot), 3), np.nan)
        rows = np.arange(len(self.rot)) // len(PIVOTS) % every == 0
        normal[rows] = geometry.unit(self.rot[rows, :, 2] + sigma * rng.standard_normal((rows.sum(), 3)))
        return ReferencePoses(normal_enu=normal, sigma_rad=np.full(len(self.rot), sigma))

    def survey(self, **more):
        return survey_site(self.seen, self.known, self.given, field_for, prior=self.prior, settings=SETTINGS, **more)

    def own_errors(self, found):
        """(mirror, constant) what is left of places and pivots."""
        parts = [(found.constants.receiver_mirror_m - self.true.receiver_mirror_m).reshape(len(PIVOTS), -1)]
        parts.append(found.constants.pivot_enu_m - self.true.pivot_enu_m)
        if found.cov.shape[1] > 12:
            parts.append(found.constants.delay_m - self.true.delay_m)
        return np.concatenate(parts, axis=1)


def chi_square_is_expected(error, cov):
    total = float(np.einsum("mp,mpq,mq->", error, np.linalg.inv(cov), error))
    low, high = chi2.ppf([1e-3, 1.0 - 1e-3], error.size)
    assert low < total < high


def sides_off(constants, true):
    """(mirror,) rms error of the sides of the receivers' triangles: what no turn of the mirror changes."""
    sides = [
        np.linalg.norm(c.receiver_mirror_m - np.roll(c.receiver_mirror_m, 1, axis=1), axis=2) for c in (constants, true)
    ]
    return np.sqrt(np.mean((sides[0] - sides[1]) ** 2, axis=1))


def test_places_are_found_within_their_covariance():
    site = Site(1)
    found = site.survey()
    assert found.settled
    chi_square_is_expected(site.own_errors(found), found.cov)
    assert np.all(sides_off(found.constants, site.true) < 0.3 * np.sqrt(2.0) * site.prior.place_sigma_m)


def test_what_radio_cannot_tell_is_named():
    found = Site(2).survey()
    for words in found.undetermined:
        for axis in "xyz":
            assert f"rotation of the receivers against the plate about {axis}" in words
    np.testing.assert_allclose(found.normal_sigma_rad[:, 1], found.normal_sigma_rad[:, 0], rtol=0.05)
    assert np.all(found.normal_sigma_rad[:, 2] < 0.3 * found.normal_sigma_rad[:, 1])


def test_reference_poses_turn_the_receivers_to_the_plate():
    site = Site(3)
    found = site.survey(reference=site.reference(every=3))
    chi_square_is_expected(site.own_errors(found), found.cov)
    left = np.cross(site.rot[:, :, 2], found.poses.normal_enu)
    before = [lever_to_turn(PLACES)[:2] @ (t - PLACES).ravel() for t in site.true.receiver_mirror_m]
    assert np.sqrt(np.mean(np.square(before))) > 4e-4
    assert np.sqrt(np.mean(np.sum(left**2, axis=1))) < 1e-4
    assert np.all(found.normal_sigma_rad[:, 1] < 1e-4)
    for words in found.undetermined:
        assert not any("about x" in w or "about y" in w for w in words)


def test_transmitters_and_delays_are_found_within_their_covariance():
    prior = replace(PRIOR, transmitter_sigma_m=np.full(len(TRANSMITTERS), 5e-3), delay_sigma_m=2e-3)
    site = Site(6, prior=prior)
    found = site.survey(reference=site.reference(every=3))
    off = (found.constants.transmitter_enu_m - site.true.transmitter_enu_m).ravel()
    chi_square_is_expected(site.own_errors(found), found.cov)
    chi_square_is_expected(off[None], found.transmitter_cov[None])
    assert np.all(np.diagonal(found.transmitter_cov) < 5e-3**2 * (1.0 + 1e-9))
    assert np.trace(found.transmitter_cov) < 0.8 * 30 * 5e-3**2
    assert all("delay common to the receivers" in words for words in found.undetermined)


def test_a_mirror_without_frames_keeps_what_was_known():
    site = Site(7, n_frame=4)
    site.seen.carrier[1 :: len(PIVOTS)] = np.nan
    found = site.survey()
    assert found.n_frame.tolist() == [4, 0, 4, 4]
    assert found.rank[1] == 0
    np.testing.assert_array_equal(found.constants.receiver_mirror_m[1], PLACES)
    np.testing.assert_allclose(np.diagonal(found.cov[1]), found.prior_sigma_m**2)


class Stray(Site):
    """A field in which things that nobody foresaw turn what is received, alike in near postures."""

    ANGLE_RAD, SIZE = np.radians(12.0), 0.06

    def __init__(self, seed, prior=PRIOR, n_frame=N_FRAME):
        super().__init__(seed, prior, n_frame)
        rng = np.random.default_rng([seed, 1])
        for m in range(len(PIVOTS)):
            normal = self.rot[m :: len(PIVOTS), :, 2]
            angle = np.arccos(np.clip(normal @ normal.T, -1.0, 1.0))
            lower = np.linalg.cholesky(np.exp(-angle / self.ANGLE_RAD) + 1e-9 * np.eye(n_frame))
            shape = (n_frame, 3 * len(TRANSMITTERS))
            stray = lower @ (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
            one = self.seen.carrier[m :: len(PIVOTS)]
            self.seen.carrier[m :: len(PIVOTS)] = one * (1.0 + self.SIZE * stray.reshape(one.shape))


def test_how_errors_go_together_over_posture_is_found():
    found = Stray(11).survey().correlation
    # four mirrors with a few independent stretches of thirty links each
    assert 0.7 * Stray.ANGLE_RAD < found.angle_rad < 1.5 * Stray.ANGLE_RAD
    assert found.share > 0.8
    white = Site(11).survey()
    assert white.correlation.share < 0.1
    assert np.all(white.n_independent > 0.9 * N_FRAME)


WHITE = PostureCorrelation(share=0.0, angle_rad=1.0)


def sites_and_surveys(prior, correlation):
    """Fields of few postures, and what is found in them."""
    for seed in range(20, 24):
        site = Stray(seed, prior, n_frame=12)
        site.prior = replace(prior, correlation=correlation)
        yield site, site.survey()


def nees_of_constants(correlation):
    """Mean squared errors over what is told."""
    found = [
        np.einsum("mp,mpq,mq->m", (e := site.own_errors(one)), np.linalg.inv(one.cov), e) / e.shape[1]
        for site, one in sites_and_surveys(PRIOR, correlation)
    ]
    return np.mean(found)


def nees_of_mean_normals(correlation):
    """The same of a mirror's mean normal, where its receivers are exactly where they are said to be."""
    exact = replace(PRIOR, place_sigma_m=1e-5, pivot_sigma_m=1e-5)
    found = []
    for site, one in sites_and_surveys(exact, correlation):
        off = np.einsum("mxa,mx->ma", site.rot[:, :, :2], one.poses.normal_enu - site.rot[:, :, 2])
        for m in range(len(PIVOTS)):
            mean = off[m :: len(PIVOTS)].mean(axis=0)
            found.append(mean @ np.linalg.solve(one.normal_cov(m).mean(axis=(0, 2)), mean) / 2.0)
    return np.mean(found)


def test_near_postures_do_not_feign_knowledge():
    # sixteen mirrors of twelve constants, of whose directions the priors hold half
    own = nees_of_constants(None)
    assert 0.6 < own < 1.4
    assert nees_of_constants(WHITE) > 1.3 * own


def test_normals_of_near_postures_have_their_errors_in_common():
    # thirty-two components: a fourth is one standard deviation
    mean = nees_of_mean_normals(None)
    assert 0.4 < mean < 1.7
    assert nees_of_mean_normals(WHITE) > 1.7 * mean


def test_frames_of_one_posture_are_worth_one():
    normal = np.tile([[0.0, 0.6, 0.8]], (5, 1))
    normal[4] = [0.6, 0.0, 0.8]
    alike = PostureCorrelation(share=1.0, angle_rad=0.05)
    np.testing.assert_allclose(alike.worth(normal), [0.25, 0.25, 0.25, 0.25, 1.0], rtol=1e-5)
    normal[1] = np.nan
    np.testing.assert_allclose(alike.worth(normal), [1 / 3, 0.0, 1 / 3, 1 / 3, 1.0], rtol=1e-5)
    half = PostureCorrelation(share=0.5, angle_rad=0.05)
    np.testing.assert_allclose(half.worth(normal)[0], 0.5, rtol=1e-5)


def test_camera_normals_count_for_themselves_however_near_the_postures():
    site = Stray(13, n_frame=12)
    many = site.survey(reference=site.reference(every=1, sigma=1e-3))
    few = site.survey(reference=site.reference(every=6, sigma=1e-3))
    assert np.all(many.normal_sigma_rad[:, 1] < few.normal_sigma_rad[:, 1])
