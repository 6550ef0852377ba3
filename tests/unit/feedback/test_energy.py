import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.feedback.energy import (
    clear_beam_w_m2,
    combine_errors_rad,
    dish_capture,
    dish_capture_at,
    draw_bursts,
    energy,
    heliostat_intercept,
    representative_days,
    spillage,
)
from rfpose.feedback.optics import intercept_ratio
from rfpose.sun import Location

CANBERRA = Location(latitude_rad=np.deg2rad(-35.0), longitude_rad=np.deg2rad(149.0))


def test_budget_adds_squares():
    assert combine_errors_rad({"wind": 3e-4, "servo": [4e-4, 0.0]}) == pytest.approx([5e-4, 3e-4])
    with pytest.raises(InvalidInputError, match="servo"):
        combine_errors_rad({"servo": -1e-4})
    with pytest.raises(InvalidInputError, match="at least one"):
        combine_errors_rad({})


def test_mean_intercept_is_the_mean():
    rng = np.random.default_rng(1)
    sigma = 1e-3
    drawn = intercept_ratio(np.hypot(*(sigma * rng.standard_normal((2, 100_000)))))
    assert heliostat_intercept(sigma) == pytest.approx(drawn.mean(), abs=5.0 * drawn.std() / np.sqrt(1e5))
    assert heliostat_intercept(0.0) == pytest.approx(1.0)
    assert spillage(heliostat_intercept([0.0, sigma]))[1] == pytest.approx(1.0 - drawn.mean(), abs=1e-3)


def test_dish_capture_is_the_mean_of_a_wandering_image():
    # image of spread 1/(h√2) about the axis, aperture as the formula has it, wandering by sigma in each direction
    h, sigma, area = 3.9, 2e-3, 2000.0
    rng = np.random.default_rng(2)
    spread = np.hypot(np.deg2rad(1.0) / (h * np.sqrt(2.0)), sigma)
    aperture = np.sqrt(np.sin(np.pi / 3.0) ** 2 / area)
    caught = np.mean(np.hypot(*(spread * rng.standard_normal((2, 200_000)))) < aperture)
    assert dish_capture(area, h_per_deg=h, sigma_rad=sigma) == pytest.approx(caught, abs=0.004)


@pytest.mark.parametrize("sigma", [0.0, 0.3e-3, 1e-3, 3e-3, 8e-3])
@pytest.mark.parametrize(("h", "rim_deg", "area"), [(3.9, 60.0, 2000.0), (2.0, 45.0, 500.0)])
def test_capture_at_an_error_averages_to_edwards(h, rim_deg, area, sigma):
    # β²/2σ² of errors that scatter alike in two directions is exponential: Gauss-Laguerre
    node, weight = np.polynomial.laguerre.laggauss(80)
    rim = np.deg2rad(rim_deg)
    mean = dish_capture_at(sigma * np.sqrt(2.0 * node), area, h_per_deg=h, rim_rad=rim) @ weight
    assert mean == pytest.approx(dish_capture(area, h_per_deg=h, sigma_rad=sigma, rim_rad=rim), rel=1e-6)


def test_capture_at_an_error_is_what_of_an_image_beside_falls_in():
    h, area, rng, n = 1.2, 2000.0, np.random.default_rng(4), 200_000
    spread = np.deg2rad(1.0) / (h * np.sqrt(2.0))
    aperture = np.sin(np.pi / 3.0) / np.sqrt(area)
    image = spread * rng.standard_normal((2, n))
    for error in (0.0, 5e-3, 20e-3):
        caught = np.mean(np.hypot(image[0] + error, image[1]) < aperture)
        scatter = np.sqrt(caught * (1.0 - caught) / n)
        assert dish_capture_at(error, area, h_per_deg=h) == pytest.approx(caught, abs=4.0 * scatter)
    falling = dish_capture_at(np.linspace(0.0, 50e-3, 100), area, h_per_deg=h)
    assert np.all(np.diff(falling) < 0.0)
    with pytest.raises(InvalidInputError, match="area_ratio"):
        dish_capture_at(0.0, 0.0, h_per_deg=h)


@pytest.mark.parametrize("ratio", [0.4, 1.0, 1.7])
def test_two_discs_overlap_as_points_in_them_do(ratio):
    rng, n = np.random.default_rng(5), 100_000
    radius = 0.5 * 9.3e-3 + 1.5e-3
    at, turn = radius * np.sqrt(rng.random(n)), 2.0 * np.pi * rng.random(n)
    for error in (0.0, 0.3 * radius, abs(ratio - 1.0) * radius, radius, 1.3 * radius, (ratio + 1.01) * radius):
        inside = np.mean(np.hypot(at * np.cos(turn) - error, at * np.sin(turn)) < ratio * radius)
        got = intercept_ratio(error, aperture_ratio=ratio)
        assert got == pytest.approx(inside, abs=4.0 * np.sqrt(max(inside * (1.0 - inside), 1e-5) / n))


@pytest.mark.parametrize(("latitude", "expected"), [(-25.0, 13.6e9), (-35.0, 13.3e9)])
def test_v1_v2_a_year_of_clear_sky(latitude, expected):
    site = Location(latitude_rad=np.deg2rad(latitude), longitude_rad=np.deg2rad(149.0))
    time = representative_days(site, 2026, 12)
    found = energy(site, time, sky="edwards", min_elevation_rad=np.deg2rad(5.0))
    assert found.offered_j_m2[0] * 365.25 / 12 == pytest.approx(expected, rel=0.01)


def test_energy_of_heliostats_has_the_cosine_and_the_intercept():
    time = representative_days(CANBERRA, 2026, 1, step_s=120.0)
    target = np.array([[0.0, 1.0, 0.3], [0.0, -1.0, 0.3]])
    found = energy(CANBERRA, time, target_enu=target, intercept=[0.9, 0.8])
    assert found.caught_j_m2 == pytest.approx(found.offered_j_m2 * [0.9, 0.8])
    # south of the equator the sun stands north: a target there is nearer to the sun
    assert found.offered_j_m2[0] > found.offered_j_m2[1]
    high = np.argmax(found.beam_w_m2)
    assert found.cosine[high, 0] > found.cosine[high, 1]
    assert np.all(found.cosine[0] == 0.0)
    dish = energy(CANBERRA, time)
    assert dish.offered_j_m2[0] > found.offered_j_m2[0]


def test_measured_beam_and_gaps_between_days():
    time = np.concatenate([1_790_000_000.0 + 60.0 * np.arange(3), 1_790_000_000.0 + 86_400.0 + 60.0 * np.arange(3)])
    beam = [1000.0, 1000.0, 1000.0, np.nan, 500.0, 500.0]
    found = energy(CANBERRA, time, beam_w_m2=beam, min_elevation_rad=-2.0)
    assert found.offered_j_m2 == pytest.approx([120_000.0 + 15_000.0 + 30_000.0])
    with pytest.raises(InvalidInputError, match="ascend"):
        energy(CANBERRA, time[::-1])
    with pytest.raises(InvalidInputError, match="intercept"):
        energy(CANBERRA, time, intercept=np.ones((2, 2)))


def test_clear_sky_of_the_library_is_near_the_other_one():
    elevation = np.deg2rad([20.0, 40.0, 70.0])
    assert clear_beam_w_m2(elevation) == pytest.approx(clear_beam_w_m2(elevation, sky="edwards"), rel=0.25)
    assert np.all(clear_beam_w_m2([-0.1, -1.0]) == 0.0)
    with pytest.raises(InvalidInputError, match="sky"):
        clear_beam_w_m2(elevation, sky="cloudy")


def test_bursts_have_griffiths_counts():
    days = draw_bursts(np.random.default_rng(3), n_day=1820)
    length = np.concatenate([day[:, 1] - day[:, 0] for day in days])
    per_year = 364.0 / 1820.0
    assert len(length) * per_year == pytest.approx(1737.0, rel=0.15)
    assert (length < 720.0).sum() * per_year == pytest.approx(900.0, rel=0.15)
    assert (length < 1800.0).sum() * per_year == pytest.approx(1187.0, rel=0.15)
    assert length.sum() / 3600.0 * per_year == pytest.approx(2800.0, rel=0.10)
    assert length[length > 600.0].sum() / length.sum() == pytest.approx(0.98, abs=0.01)
    for day in days:
        assert np.all(np.diff(day.ravel()) > 0.0)
        assert day.size == 0 or (day[0, 0] >= 0.0 and day[-1, 1] <= 36_000.0)
