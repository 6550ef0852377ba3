"""Published numbers of three theses: Malan's error model, Edwards' alignment, Gouws' drone."""

import numpy as np
import pytest

from rfpose import geometry
from rfpose.feedback import _kernels
from rfpose.feedback.calibration import FitSettings, fit_many
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Actuator, Mount, command, posture, stack_mounts
from rfpose.feedback.optics import intercept_ratio, reflect

LEAST_SQUARES = FitSettings(sigma_known=True, huber=np.inf)


def sun_by_hour_angle(latitude, declination, hour_angle):
    """Direction of the sun in ENU, hour angle positive in the afternoon; no refraction."""
    d, h = np.broadcast_arrays(declination, hour_angle)
    east = -np.cos(d) * np.sin(h)
    north = np.cos(latitude) * np.sin(d) - np.sin(latitude) * np.cos(d) * np.cos(h)
    up = np.sin(latitude) * np.sin(d) + np.cos(latitude) * np.cos(d) * np.cos(h)
    return np.stack([east, north, up], axis=-1)


def day(latitude, declination, n, *, margin=0.02):
    """``n`` directions equally spaced over a day's sunshine."""
    half = np.arccos(np.clip(-np.tan(latitude) * np.tan(declination), -1, 1)) - margin
    return sun_by_hour_angle(latitude, declination, np.linspace(-half, half, n))


# ---- Malan --------------------------------------------------------------------------------------------------------


def test_intercept_ratio():
    # M1
    assert intercept_ratio(0.75e-3) == pytest.approx(0.922, abs=5e-4)
    assert intercept_ratio(1e-3) == pytest.approx(0.90, abs=5e-3)
    assert intercept_ratio([0.0, 12.4e-3]).tolist() == [1.0, 0.0]


def malan_normal(normal_zen, tilt_n, tilt_e, oblique, azimuth_bias, elevation_bias):
    """Malan (4.12)-(4.18) in his zenith, east, north coordinates."""
    elevation = np.arcsin(normal_zen[0]) + elevation_bias
    azimuth = np.arctan2(normal_zen[1], normal_zen[2]) + azimuth_bias
    h = np.array([np.sin(elevation), np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth)])
    e = np.array([0.0, np.sin(azimuth), np.cos(azimuth)])
    cross = np.array([[0, e[2], -e[1]], [-e[2], 0, e[0]], [e[1], -e[0], 0]])
    r_no = np.eye(3) * np.cos(oblique) + (1 - np.cos(oblique)) * np.outer(e, e) + cross * np.sin(oblique)
    cn, sn, ce, se = np.cos(tilt_n), np.sin(tilt_n), np.cos(tilt_e), np.sin(tilt_e)
    about_n = np.array([[cn, sn, 0], [-sn, cn, 0], [0, 0, 1]])
    about_e = np.array([[ce, 0, -se], [0, 1, 0], [se, 0, ce]])
    return about_n @ about_e @ r_no @ h


def test_the_mount_is_malans_model():
    # his tilts are rotations about the north and the east axis: about north leans west, about east leans north
    rng = np.random.default_rng(1)
    for _ in range(20):
        tilt_n, tilt_e, oblique, azimuth_bias, elevation_bias = rng.normal(size=5) * 0.02
        normal = geometry.unit(np.array([0.0, 0.0, 1.5]) + rng.normal(size=3))
        want = malan_normal(normal[[2, 0, 1]], tilt_n, tilt_e, oblique, azimuth_bias, elevation_bias)
        mount = Mount(
            pivot_enu_m=np.zeros(3),
            parameters={
                "pedestal_tilt_east_rad": -tilt_n,
                "pedestal_tilt_north_rad": tilt_e,
                "nonorthogonality_rad": oblique,
                "axis_1_zero_rad": azimuth_bias,
                "axis_2_zero_rad": elevation_bias,
            },
        )
        got = posture(mount, np.array(geometry.azimuth_elevation_from_enu(normal))).normal_enu
        np.testing.assert_allclose(got[[2, 0, 1]], want, atol=1e-14)


def test_daily_errors_of_tilts():
    # M2: Table A.1, whose site, heliostat and day are not told. Best found among 25 places north-east of a 76 m
    # target at Barstow (34.87° N) and 7 days: 130 m east, 250 m north, declination 12°, sun above 20°: within 8 %
    latitude, declination = np.deg2rad(34.87), np.deg2rad(12.0)
    sun = sun_by_hour_angle(latitude, declination, np.linspace(-2.0, 2.0, 200))
    sun = sun[sun[:, 2] > np.sin(np.deg2rad(20.0))]
    aim = np.array([0.0, 0.0, 76.0])
    straight = Mount(pivot_enu_m=np.array([130.0, 250.0, 4.0]))
    count = command(straight, sun_enu=sun, target_enu_m=np.broadcast_to(aim, sun.shape)).count
    north, east, half = "pedestal_tilt_north_rad", "pedestal_tilt_east_rad", 1e-3 / np.sqrt(2.0)
    cases = [{north: 1e-3}, {east: 1e-3}, {north: -half, east: -half}, {north: 1e-3, "axis_2_zero_rad": -1e-3}]
    rms = []
    for errors in cases:
        got = posture(straight.replace(**errors), count)
        miss = geometry.angle_between_rad(reflect(got.normal_enu, sun), aim - got.centre_enu_m)
        rms.append(1e3 * np.sqrt(np.mean(miss**2)))
    np.testing.assert_allclose(rms, [1.64, 1.24, 1.86, 0.63], rtol=0.08)
    assert np.argsort(rms).tolist() == [3, 1, 0, 2]


def test_worm_gear_has_a_period_of_twelve_degrees():
    # M5: 30:1 on the elevation axis
    mount = Mount(
        pivot_enu_m=np.zeros(3),
        actuators=(Actuator(), Actuator(worm_ratio=30.0)),
        parameters={"worm_2_sin_rad": 1e-3, "worm_2_cos_rad": 5e-4},
    )
    angle = np.deg2rad(np.arange(10.0, 70.0, 1.0))
    error = posture(mount, np.column_stack([np.zeros(60), angle])).axis_rad[:, 1] - angle
    np.testing.assert_allclose(error[12:], error[:-12], atol=1e-15)
    assert np.ptp(error) == pytest.approx(2e-3 * np.hypot(1.0, 0.5), rel=0.01)


def test_worm_gear_is_found_in_a_days_tracking():
    # M5, from measurements: amplitude and phase of the periodic term
    rng = np.random.default_rng(2)
    drives = (Actuator(), Actuator(worm_ratio=30.0))
    true = Mount(
        pivot_enu_m=np.array([30.8, -19.2, 1.0]), actuators=drives,
        parameters={"worm_2_sin_rad": 8e-4, "worm_2_cos_rad": -6e-4, "axis_1_zero_rad": -3.8e-3},
    )  # fmt: skip
    sun = day(np.deg2rad(-33.9), 0.1, 200, margin=0.3)
    aim = np.broadcast_to([0.0, 0.0, 13.0], sun.shape)
    count = command(true, sun_enu=sun, target_enu_m=aim).count + 2e-4 * rng.normal(size=(200, 2))
    start = Mount(pivot_enu_m=true.pivot_enu_m, actuators=drives)
    made = Measurements.from_spots(count, sun_enu=sun, spot_enu_m=aim, sigma_rad=2e-4)
    free = ("axis_1_zero_rad", "axis_2_zero_rad", "worm_2_sin_rad", "worm_2_cos_rad")
    found = fit_many([start], [made], free=free, settings=LEAST_SQUARES)
    want = np.array([true.parameters[name] for name in free])
    assert np.all(np.abs(found.estimate[0] - want) < 4.0 * found.sigma[0])


def test_sixteen_bits():
    # M9: a sixteen-bit axis resolves 0.096 mrad
    mount = Mount(pivot_enu_m=np.zeros(3), actuators=(Actuator(counts_per_unit=65536 / (2 * np.pi)), Actuator()))
    step = np.diff(posture(mount, [[0.0, 0.0], [1.0, 0.0]]).axis_rad[:, 0])[0]
    assert 1e3 * step == pytest.approx(0.096, abs=5e-4)


def test_noise_hurts_another_season_more():
    # M6: fitted at the summer solstice, noise costs about four times as much in winter (his Fig. 4.11), his
    # heliostat and his coefficients (M3)
    rng = np.random.default_rng(3)
    latitude, aim = np.deg2rad(-33.9), np.array([0.0, 0.0, 13.0])
    start = Mount(pivot_enu_m=np.array([30.8, -19.2, 1.0]))
    true = start.replace(
        location_up_m=0.11, location_east_m=1.02, location_north_m=-0.53, pedestal_tilt_north_rad=-13.27e-3,
        pedestal_tilt_east_rad=-4.56e-3, nonorthogonality_rad=-1.92e-3, axis_1_zero_rad=-3.79e-3,
        axis_2_zero_rad=1.12e-3,
    )  # fmt: skip
    tilt = np.deg2rad(23.44)
    seasons = [day(latitude, declination, 40, margin=0.35) for declination in (-tilt, tilt)]
    counts = [command(true, sun_enu=s, target_enu_m=np.broadcast_to(aim, s.shape)).count for s in seasons]
    made = [
        Measurements.from_spots(
            counts[0] + 1e-3 * rng.uniform(-1, 1, (40, 2)),
            sun_enu=seasons[0], spot_enu_m=np.broadcast_to(aim, (40, 3)), sigma_rad=1e-3,
        )
        for _ in range(100)
    ]  # fmt: skip
    found = fit_many([start] * 100, made, free="malan", settings=LEAST_SQUARES)
    p, k = stack_mounts([start] * 100)
    p[:, [list(start.parameters).index(name) for name in found.free]] = found.working
    rms = []
    for sun, count in zip(seasons, counts, strict=True):
        row = Measurements.from_spots(count, sun_enu=sun, spot_enu_m=np.broadcast_to(aim, (40, 3)), sigma_rad=1.0).row
        every = np.repeat(row[None], 100, axis=0)
        use = np.ones((100, 40), np.bool_)
        residual = _kernels.residuals_batch(p, k, np.repeat(count[None], 100, axis=0), every, use)
        rms.append(np.sqrt(np.mean(np.sum(residual**2, axis=-1))))
    assert 2.5 < rms[1] / rms[0] < 7.0


# ---- Edwards ------------------------------------------------------------------------------------------------------

# Table 5.1: error ratio on five evenly spaced days from winter to summer, after calibration on one day; what the
# scan lost is NaN
TABLE_5_1 = {
    (4, "winter", 10): (0.59, 0.66, 0.88, 1.2, 1.3),
    (4, "winter", 20): (0.42, 0.47, 0.66, 0.91, 1.1),
    (4, "winter", 40): (0.30, 0.34, np.nan, 0.64, 0.76),
    (4, "winter", 80): (0.22, 0.25, 0.33, 0.44, 0.50),
    (4, "summer", 10): (0.60, 0.59, 0.58, 0.58, 0.57),
    (4, "summer", 20): (0.38, 0.38, 0.37, 0.37, 0.38),
    (4, "summer", 40): (0.27, 0.26, 0.26, 0.27, 0.27),
    (4, "summer", 80): (0.20, 0.20, 0.20, 0.20, 0.20),
    (6, "winter", 10): (0.73, 0.94, 1.9, 3.3, 4.1),
    (6, "winter", 20): (0.52, 0.63, 1.2, 2.3, 2.7),
    (6, "winter", 40): (0.38, 0.48, 1.0, 1.9, 2.2),
    (6, "winter", 80): (0.27, 0.35, 0.71, 1.4, 1.6),
    (6, "summer", 20): (0.51, 0.48, 0.45, 0.46, 0.47),
    (6, "summer", 40): (0.42, 0.40, 0.37, 0.33, 0.33),
    (6, "summer", 80): (0.28, 0.27, 0.25, 0.24, 0.26),
}
LATITUDE = np.deg2rad(35.0)
DAYS = np.deg2rad(23.44) * np.array([-1.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5), 1.0])
SIGMA = 0.7e-3
# counts run on through south: a gain would see a turn's jump
COLLECTOR = Mount(pivot_enu_m=np.zeros(3), actuators=(Actuator(limits_count=(0.0, 2.0 * np.pi)), Actuator()))


def error_ratio(n_constant, season, n, rng, *, n_run=200):
    """Edwards (5.9): RMS pointing error of the aligned collector over sigma of one axis, on the five days."""
    start = COLLECTOR
    true = start.replace(
        pedestal_tilt_north_rad=0.02, pedestal_tilt_east_rad=-0.01, axis_1_zero_rad=0.03, axis_2_zero_rad=-0.02
    )
    sun = day(LATITUDE, DAYS[0 if season == "winter" else 4], n)
    exact = command(true, sun_enu=sun, mode="dish").count
    made = [
        Measurements.from_normals(exact + SIGMA * rng.normal(size=exact.shape), normal_enu=sun, sigma_rad=SIGMA)
        for _ in range(n_run)
    ]
    found = fit_many([start] * n_run, made, free=f"edwards-{n_constant}", settings=LEAST_SQUARES)
    p, k = stack_mounts([start] * n_run)
    p[:, [list(start.parameters).index(name) for name in found.free]] = found.working
    ratio = []
    for declination in DAYS:
        ahead = day(LATITUDE, declination, 30)
        count = command(true, sun_enu=ahead, mode="dish").count
        normal = _kernels.posture_batch(p, k, np.repeat(count[None], n_run, axis=0), 0.0)[..., 2:5]
        ratio.append(np.sqrt(np.mean(np.sum((normal - ahead) ** 2, axis=-1))) / SIGMA)
    return np.array(ratio)


@pytest.mark.parametrize(("n_constant", "season", "n"), list(TABLE_5_1))
def test_table_5_1(n_constant, season, n):
    # V28: within 20 % on the day of calibration and 45 % elsewhere; the thesis had 40 runs a cell, 15 %
    got = error_ratio(n_constant, season, n, np.random.default_rng(n))
    want = np.array(TABLE_5_1[n_constant, season, n])
    off = np.abs(got / want - 1.0)
    same = 0 if season == "winter" else 4
    assert off[same] < 0.20
    assert np.nanmax(off) < 0.45


def test_error_ratio_is_the_root_of_constants_over_measurements():
    # same day: r ≈ √(p/N), a little less since azimuth's noise counts by the cosine of the elevation
    for n_constant, n in ((4, 40), (6, 80)):
        got = error_ratio(n_constant, "summer", n, np.random.default_rng(5))[4]
        assert got == pytest.approx(np.sqrt(n_constant / n), rel=0.15)


def test_a_days_fixes_find_the_axis():
    # V41: four constants from one day near Canberra; the axis' latitude and longitude to 1 mrad at 0.3 mrad residual
    rng = np.random.default_rng(6)
    latitude = -0.616
    true = COLLECTOR.replace(pedestal_tilt_north_rad=-0.003, pedestal_tilt_east_rad=0.002 * np.cos(latitude))
    sun = day(latitude, np.deg2rad(15.6), 40, margin=0.2)
    count = command(true, sun_enu=sun, mode="dish").count + 3e-4 / np.sqrt(2) * rng.normal(size=(40, 2))
    made = Measurements.from_normals(count, normal_enu=sun)
    found = fit_many([Mount(pivot_enu_m=np.zeros(3))], [made], free="edwards-4")
    # leaning north by t raises the axis' latitude by t
    assert latitude + found.estimate[0, 0] == pytest.approx(-0.619, abs=1e-3)
    assert found.estimate[0, 1] / np.cos(latitude) == pytest.approx(0.002, abs=1e-3)


def test_cross_axis_effect_of_an_azimuth_error():
    # V50: an azimuth error Δφ about a vertical axis costs ¼ sin 2θ Δφ² of elevation, 0.25 Δφ² at 45°
    step = 0.01
    for elevation, factor in ((np.pi / 4, 0.25), (0.3, 0.25 * np.sin(0.6))):
        mount = Mount(pivot_enu_m=np.zeros(3))
        here, there = posture(mount, [[0.0, elevation], [step, elevation]]).normal_enu
        # elevation above the great circle through the first direction and the horizontal across it
        rise = np.arctan2(there[2], there[1]) - elevation
        assert rise == pytest.approx(factor * step**2, rel=1e-3)
        assert here[0] == 0.0


def test_quantisation_of_an_encoder():
    # V39: 0.29 of a step rms an axis, 1.4 times that for both
    rng = np.random.default_rng(7)
    step = 1e-3
    count = rng.uniform(-0.3, 0.3, (20000, 2))
    mount = Mount(pivot_enu_m=np.zeros(3))
    exact, rounded = (posture(mount, c).normal_enu for c in (count * [1, 0.1], np.rint(count * [1, 0.1] / step) * step))
    rms = np.sqrt(np.mean(np.sum((exact - rounded) ** 2, axis=1)))
    assert rms / step == pytest.approx(1.4 * 0.29, rel=0.02)


# ---- Gouws --------------------------------------------------------------------------------------------------------

GPS_SIGMA_M = np.array([5.602, 5.781, 8.866]) * 1e-3  # G1: east, north, up
GOUWS_TARGET = np.array([11.0, 27.0, 4.25])
GOUWS_BOUNDS = {
    "location_up_m": (-0.05, 0.05), "location_east_m": (-0.05, 0.05), "location_north_m": (-0.05, 0.05),
    "pedestal_tilt_north_rad": (-0.0437, 0.0437), "pedestal_tilt_east_rad": (-0.0437, 0.0437),
    "axis_1_zero_rad": (-0.175, 0.175), "axis_2_zero_rad": (-0.175, 0.175),
    "arm_normal_m": (0.4225, 0.4425), "arm_up_m": (0.14, 0.34),
}  # fmt: skip
# uniform within the bounds: as a prior, their middle and a third of the squared half-width
GOUWS_PRIORS = {name: ((low + high) / 2, (high - low) / np.sqrt(12)) for name, (low, high) in GOUWS_BOUNDS.items()}
GOUWS_FIT = FitSettings(sigma_known=True, huber=np.inf, bounds=GOUWS_BOUNDS, priors=GOUWS_PRIORS)


def drone_calibrations(mounts, n, rng, *, distance_m=32.0):
    """Random drone positions that see the target in the mirror, as the GPS tells them."""
    made = []
    for mount in mounts:
        toward = geometry.azimuth_elevation_from_enu(GOUWS_TARGET)[0]
        azimuth, elevation = toward + rng.uniform(-2.6, 2.6, n), np.arcsin(rng.uniform(0.05, 0.99, n))
        drone = distance_m * geometry.enu_from_azimuth_elevation(azimuth, elevation)
        sun = geometry.unit(drone)
        for _ in range(12):
            count = command(mount, sun_enu=sun, target_enu_m=np.broadcast_to(GOUWS_TARGET, drone.shape)).count
            sun = geometry.unit(drone - posture(mount, count).centre_enu_m)
        seen = drone + GPS_SIGMA_M * rng.normal(size=drone.shape)
        sigma = 0.5 * float(np.mean(GPS_SIGMA_M)) / distance_m
        made.append(Measurements.from_points(count, source_enu_m=seen, target_enu_m=GOUWS_TARGET, sigma_rad=sigma))
    return made


def yearly_beam_error_mrad(mounts, found, start):
    """Mean angle by which beams miss the target over a year's suns, commanded by the fitted mounts."""
    year = np.concatenate([day(np.deg2rad(-33.9), d, 9, margin=0.3) for d in np.deg2rad([-23.4, -12, 0, 12, 23.4])])
    aim = np.broadcast_to(GOUWS_TARGET, year.shape)
    means = []
    for i, true in enumerate(mounts):
        fitted = start.replace(**dict(zip(found.free, found.working[i], strict=True)))
        got = posture(true, command(fitted, sun_enu=year, target_enu_m=aim).count)
        beam = 2.0 * np.sum(got.normal_enu * year, axis=1, keepdims=True) * got.normal_enu - year
        means.append(1e3 * np.mean(geometry.angle_between_rad(beam, GOUWS_TARGET - got.centre_enu_m)))
    return np.array(means)


def test_drone_calibration_of_his_first_heliostat():
    # G3: 0.429 mrad of the beam over a year with 10 points, 0.116 with 240; ten heliostats' draws of noise each
    start = Mount(pivot_enu_m=np.zeros(3), parameters={"arm_normal_m": 0.4325, "arm_up_m": 0.24})
    true = start.replace(axis_2_zero_rad=np.deg2rad(3.0), axis_1_zero_rad=np.deg2rad(-3.0))
    for n, wanted in ((10, 0.429), (240, 0.116)):
        made = drone_calibrations([true] * 10, n, np.random.default_rng(n))
        found = fit_many([start] * 10, made, free="gouws", settings=GOUWS_FIT)
        assert np.mean(yearly_beam_error_mrad([true] * 10, found, start)) < wanted


def test_a_hundred_random_heliostats():
    # G4: 240 points, at least 86 % below 0.3 mrad and all below 0.6
    rng = np.random.default_rng(8)
    start = Mount(pivot_enu_m=np.zeros(3), parameters={"arm_normal_m": 0.4325, "arm_up_m": 0.24})
    mounts = []
    for _ in range(100):
        drawn = {name: rng.uniform(0.8 * low, 0.8 * high) for name, (low, high) in GOUWS_BOUNDS.items()}
        drawn |= {"arm_normal_m": 0.4325 + rng.uniform(-8e-3, 8e-3), "arm_up_m": 0.24 + rng.uniform(-0.08, 0.08)}
        mounts.append(start.replace(**drawn))
    found = fit_many([start] * 100, drone_calibrations(mounts, 240, rng), free="gouws", settings=GOUWS_FIT)
    error = yearly_beam_error_mrad(mounts, found, start)
    assert np.mean(error < 0.3) >= 0.86
    assert error.max() < 0.6
