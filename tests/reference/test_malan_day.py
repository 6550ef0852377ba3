"""Malan's prototype (rows M3 and M4): his coefficients, his two days, 2 and 6 September 2012 at Stellenbosch."""

import numpy as np
import pytest

from rfpose import geometry
from rfpose.feedback.calibration import PARAMETER_SETS, FitSettings, fit
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import Actuator, Mount, command, posture
from rfpose.feedback.optics import reflect, target_offset_m
from rfpose.sun import Location, sun_position, unix_seconds

SITE = Location(latitude_rad=np.deg2rad(-33.93), longitude_rad=np.deg2rad(18.86), altitude_m=120.0)
AIM = np.array([0.0, 0.0, 13.0])
TABLE_6_1 = {
    "location_up_m": 0.11, "location_east_m": 1.02, "location_north_m": -0.53,
    "pedestal_tilt_north_rad": -13.27e-3, "pedestal_tilt_east_rad": -4.56e-3, "nonorthogonality_rad": -1.92e-3,
    "axis_1_zero_rad": -3.79e-3, "axis_2_zero_rad": 1.12e-3,
}  # fmt: skip
WORM = ("worm_1_sin_rad", "worm_1_cos_rad", "worm_2_sin_rad", "worm_2_cos_rad")
# §6.3 and §4.3 of his text
SITES = {"30.8 m south, 19.2 m east": (19.2, -30.8, 1.2), "30.8 m east, 19.2 m south": (30.8, -19.2, 1.0)}
LEAST_SQUARES = FitSettings(sigma_known=True, huber=np.inf)


def nominal(site):
    drives = (Actuator(worm_ratio=30.0), Actuator(worm_ratio=30.0))
    return Mount(pivot_enu_m=np.array(SITES[site]), actuators=drives)


def suns(date, step_s):
    """From 8:30 to 17:00 of local time."""
    start = unix_seconds([f"{date}T06:30:00Z"])[0]
    return sun_position(start + np.arange(0.0, 8.5 * 3600.0, step_s), SITE).direction_enu


def spots(true, sun, rng, sigma):
    aim = np.broadcast_to(AIM, sun.shape)
    count = command(true, sun_enu=sun, target_enu_m=aim).count
    return Measurements.from_spots(
        count + sigma * rng.normal(size=count.shape), sun_enu=sun, spot_enu_m=aim, sigma_rad=sigma
    )


def miss_mrad(true, believed, sun):
    """RMS angle of the beam from the aim on the target."""
    aim = np.broadcast_to(AIM, sun.shape)
    got = posture(true, command(believed, sun_enu=sun, target_enu_m=aim).count)
    miss = geometry.angle_between_rad(reflect(got.normal_enu, sun), AIM - got.centre_enu_m)
    return 1e3 * np.sqrt(np.mean(miss**2))


@pytest.mark.parametrize("site", SITES)
def test_a_day_of_spots_gives_his_coefficients_back(site):
    # M3: half-hourly on 2 September; a day at one target leaves the place open, so that it takes a surveyor's 0.5 m
    priors = {name: (0.0, 0.5) for name in TABLE_6_1 if name.startswith("location")}
    settings = FitSettings(sigma_known=True, huber=np.inf, priors=priors)
    made = spots(nominal(site).replace(**TABLE_6_1), suns("2012-09-02", 1800.0), np.random.default_rng(1), 1e-5)
    found = fit(nominal(site), made, free="malan", settings=settings)
    for name, value in TABLE_6_1.items():
        assert abs(found.field.working[0][found.free.index(name)] - value) < 4.0 * max(found.sigma[name], 1e-4), name
    # the other day is met whichever of the equivalent places was taken
    later = suns("2012-09-06", 600.0)
    assert miss_mrad(nominal(site).replace(**TABLE_6_1), found.mount, later) < 0.1
    assert miss_mrad(nominal(site).replace(**TABLE_6_1), nominal(site), later) > 20.0


def test_which_of_the_two_sites_is_his():
    # M3, M4: his target lies 36.3 m away as surveyed and 37.3 m with the coefficients: on the ground, and only south
    distance = {}
    for site in SITES:
        centre = posture(nominal(site).replace(**TABLE_6_1), [0.0, 0.0]).centre_enu_m
        assert np.hypot(*nominal(site).pivot_enu_m[:2]) == pytest.approx(36.3, abs=0.05)
        distance[site] = np.hypot(*centre[:2])
    assert distance["30.8 m south, 19.2 m east"] == pytest.approx(37.3, abs=0.05)
    assert distance["30.8 m east, 19.2 m south"] == pytest.approx(37.44, abs=0.01)


def test_normals_off_by_his_error_miss_by_his_millimetres(figure):
    # M4: 0.97 mrad of the normal, 1.94 on the target if it were doubled throughout, 70.1 mm at 37.3 m, which is
    # 1.88 mrad. Across the plane of incidence a beam turns by less than twice: 1.84 mrad over his day
    rng = np.random.default_rng(2)
    true = nominal("30.8 m south, 19.2 m east").replace(**TABLE_6_1)
    sun = np.repeat(suns("2012-09-06", 60.0), 40, axis=0)
    aim = np.broadcast_to(AIM, sun.shape)
    got = posture(true, command(true, sun_enu=sun, target_enu_m=aim).count)
    beam = reflect(got.normal_enu + 0.97e-3 / np.sqrt(2.0) * rng.normal(size=sun.shape), sun)
    miss = 1e3 * np.sqrt(np.mean(geometry.angle_between_rad(beam, AIM - got.centre_enu_m) ** 2))
    figure("M4 beam for 0.97 mrad of the normal (1.94 if doubled, 1.88 by 70.1 mm at 37.3 m)", miss, "mrad")
    assert miss < 1.94
    assert miss == pytest.approx(70.1 / 37.3, rel=0.03)
    # Malan (4.22): the target's plane faces the heliostat
    off = target_offset_m(
        got.centre_enu_m, beam, target_enu_m=AIM, target_normal_enu=got.centre_enu_m.mean(axis=0) - AIM
    )
    assert 1e3 * np.sqrt(np.mean(np.sum(off**2, axis=1))) == pytest.approx(70.1, rel=0.04)


def test_a_worm_gear_explains_his_corrected_day():
    # M4: eight coefficients from 2 September leave 1.94 mrad on 6 September if the gears err by 1.25 mrad once in 12°
    # (his §6.3 suspects them); with the gears in the model nothing of it stays
    rng = np.random.default_rng(3)
    site = "30.8 m south, 19.2 m east"
    true = nominal(site).replace(**TABLE_6_1, worm_1_sin_rad=1.25e-3, worm_2_sin_rad=1.25e-3)
    priors = {name: (0.0, 0.5) for name in TABLE_6_1 if name.startswith("location")}
    settings = FitSettings(sigma_known=True, huber=np.inf, priors=priors)
    later = suns("2012-09-06", 60.0)
    eight = fit(nominal(site), spots(true, suns("2012-09-02", 1800.0), rng, 1e-4), free="malan", settings=settings)
    assert miss_mrad(true, eight.mount, later) == pytest.approx(1.94, rel=0.05)
    full = fit(
        nominal(site), spots(true, suns("2012-09-02", 300.0), rng, 1e-4),
        free=(*PARAMETER_SETS["malan"], *WORM), settings=settings,
    )  # fmt: skip
    assert miss_mrad(true, full.mount, later) < 0.3
