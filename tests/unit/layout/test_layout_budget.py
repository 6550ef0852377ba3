"""The error budget: lines and sum against Monte Carlo through the solvers, single sources against formulas."""

from pathlib import Path

import numpy as np
import pytest

from rfpose import geometry
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.layout import maps
from rfpose.layout.budget import SOURCES, error_budget, target_slope, working_point
from rfpose.layout.budget.world import DrawnSites
from rfpose.measurement import noise_of
from rfpose.scenario import load_scenario
from rfpose.simulator import Simulator

ROOT = Path(__file__).resolve().parents[3]
SUN = geometry.enu_from_azimuth_elevation(np.radians(170.0), np.radians(50.0))


def site(n_heliostat=4, **tables):
    """Table 2 at 100 m with a few heliostats and other settings; `heliostat` settings go to each."""
    shipped = load_scenario(ROOT / "data" / "table2_100m.toml")
    return shipped.changed(heliostat=shipped.heliostat[:n_heliostat]).changed(**tables)


def two_tones(**tables):
    tones = [{"frequency_hz": 750e3, "modulation_index": 0.4}, {"frequency_hz": 7.47e6, "modulation_index": 0.4}]
    return site(
        tone=tones,
        radio={"sample_rate_hz": 60e6},
        heliostat={"pivot_sigma_m": 0.005, "receiver_delay_sigma_s": 20e-12, "carrier_phase": False},
        **tables,
    )


def plan_of(scenario, **settings):
    return working_point(scenario, maps.mirrors_of(scenario, sun_enu=SUN), **settings)


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


REFLECTING = {"simulation": {"ground": {"coefficient": (-0.3, 0.1)}}}
# each Monte Carlo line: 2·n_draw squares or more in common to all mirrors, so that rms scatters by 1/√(4·n_draw)
CASES = {
    "carrier": (site, {"budget": {"calibration_age_s": 100.0}}, {}, 300),
    "two tones, pivot": (two_tones, {"simulation": {"adc_bits": 8}, "budget": {"calibration_age_s": 10.0}}, {}, 300),
    "independent": (two_tones, {"budget": {"multipath_db": -80.0}}, {"pose": "independent"}, 100),
    "ground known": (
        two_tones,
        {**REFLECTING, "budget": {"ground": "known", "ground_coefficient_sigma": 1e-3, "ground_height_sigma_m": 1e-3}},
        {},
        100,
    ),
    "ground known, calibration surveyed": (
        two_tones,
        {
            "simulation": {"ground": {"coefficient": (-0.1, 0.05)}},
            "calibration_receiver": {"survey_sigma_m": 1e-4},  # more is seen, and what is left is of second order
            "budget": {"ground": "known", "ground_coefficient_sigma": 1e-4, "ground_height_sigma_m": 1e-4},
        },
        {},
        100,
    ),
    "faint ground ignored": (
        two_tones,
        {"simulation": {"ground": {"coefficient": (-1e-3, 0.0)}}, "budget": {"multipath_db": None}},
        {},
        100,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_lines_and_their_sum_are_what_the_solver_shows(case):
    make, tables, settings, n_draw = CASES[case]
    found = error_budget(plan_of(make(**tables), **settings), n_draw=n_draw, seed=1)
    assert found.n_failed == 0
    spread = 1.0 / np.sqrt(4.0 * n_draw)
    for line in found.lines:
        if rms(line.normal_rad) < 1e-12:
            assert rms(line.drawn_normal_rad) < 1e-9
        else:
            ratio = rms(line.drawn_normal_rad) / rms(line.normal_rad)
            assert ratio == pytest.approx(1.0, abs=4.5 * spread), line.name
    whole = found.whole
    assert rms(whole.drawn_normal_rad) / rms(whole.normal_rad) == pytest.approx(1.0, abs=4.0 * spread)
    assert rms(whole.normal_rad) ** 2 == pytest.approx(sum(rms(line.normal_rad) ** 2 for line in found.lines))
    sizes = [rms(line.normal_rad) for line in found.lines]
    assert sizes == sorted(sizes, reverse=True)


def test_sum_with_an_estimated_reflection_is_what_the_solver_shows():
    # coefficients are common to all mirrors, so that each mirror's errors reach the others
    plan = plan_of(two_tones(**REFLECTING, budget={"ground": "estimated"}))
    world = DrawnSites(plan, 25, np.random.default_rng(1))
    for source in SOURCES:
        if source.assumed(plan):
            source.disturb(world)
    error = world.normal_errors()
    assert np.isfinite(error).all()
    drawn = np.sqrt(np.mean((error**2).sum(axis=2)))
    linear = error_budget(plan, n_draw=0).whole.normal_rad
    assert drawn / rms(linear) == pytest.approx(1.0, abs=3.0 / np.sqrt(4.0 * 25))


def test_a_wrong_height_moves_the_estimated_coefficient_of_all_mirrors():
    plan = plan_of(two_tones(**REFLECTING, budget={"ground": "estimated"}))
    world = DrawnSites(plan, 1, np.random.default_rng(0))
    world.ground_height_m[:] = plan.scenario.budget.ground_height_sigma_m
    found = error_budget(plan, n_draw=0)
    line = next(line for line in found.lines if line.name == "ground reflection")
    error = np.linalg.norm(world.normal_errors()[0], axis=1)
    np.testing.assert_allclose(error, line.normal_rad, rtol=0.1, atol=0.02 * rms(line.normal_rad))


def lines_of(scenario, **settings):
    found = error_budget(plan_of(scenario, **settings), n_draw=0, aim_enu_m=scenario.site.aim_enu_m)
    return {line.name: line for line in found.lines}


def test_noise_lines_add_up_to_the_map():
    scenario = two_tones(simulation={"adc_bits": 16, "sample_format": "complex64"})
    lines = lines_of(scenario)
    assert "quantisation" not in lines
    noise = noise_of(scenario)
    plan = plan_of(scenario)
    bound = maps.normal_map(scenario.transmitter_enu_m, plan.mirrors, noise, plan.estimator)
    names = ("thermal noise", "calibration noise", "pivot survey", "clock")
    total = np.sqrt(sum(lines[name].normal_rad ** 2 for name in names))
    np.testing.assert_allclose(total, bound, rtol=0.02)


def test_rounding_is_the_simulators():
    scenario = site(n_heliostat=1, simulation={"adc_bits": 6, "frame_count": 1})
    truth = Simulator(scenario, seed=0).truth
    snr = 10.0 ** (scenario.simulation.tone_snr_db / 10.0)
    # the simulator's SNR counts rounding, noise over all
    assert 1.0 + plan_of(scenario).converter_share == pytest.approx(snr / truth.tone_snr.max(), rel=1e-9)


def test_beam_turns_by_twice_the_normal_in_the_plane_of_incidence():
    scenario = site(n_heliostat=3)
    plan = plan_of(scenario)
    aim = np.array(scenario.site.aim_enu_m)
    slope = target_slope(plan.mirrors, aim)
    distance = np.linalg.norm(aim - plan.mirrors.pivot_enu_m, axis=1)
    for m, rot in enumerate(plan.mirrors.rot_enu_from_mirror):
        beam = (aim - plan.mirrors.pivot_enu_m[m]) / distance[m]
        tilt = np.array([1.3e-6, -0.4e-6])
        turned = rot @ np.array([*tilt, 1.0])
        turned /= np.linalg.norm(turned)
        moved = 2.0 * (turned @ SUN) * turned - SUN
        np.testing.assert_allclose(slope[m] @ tilt, distance[m] * (moved - beam), atol=1e-10 * distance[m])


def test_what_is_fixed_to_the_mirror_and_what_drifts():
    plain = lines_of(site(budget={"receiver_plane_sigma_mrad": 0.3}))
    assert plain["receiver plane to glass"].normal_rad == pytest.approx(0.3e-3 * np.sqrt(2.0))
    assert "phase drift" not in plain
    drift = {"transmitter_phase_drift_rad_per_sqrt_h": 0.05}
    young, old = (
        lines_of(two_tones(simulation=drift, budget={"calibration_age_s": age}))["phase drift"].normal_rad
        for age in (10.0, 1000.0)
    )
    np.testing.assert_allclose(old, 10.0 * young)
    # one calibration receiver's noise reaches the mirrors the same way
    one = lines_of(site(simulation=drift, budget={"calibration_age_s": 36.0}))
    plan = plan_of(site())
    sigma_m = 0.05 * np.sqrt(36.0 / 3600.0) * plan.waves.wavelength_m[0, 0] / (2.0 * np.pi)
    share = sigma_m / plan.calibration_thermal_m[0, 0, 0]
    np.testing.assert_allclose(one["phase drift"].normal_rad, share * one["calibration noise"].normal_rad)
    levelled = lines_of(two_tones(simulation=drift, budget={"calibration_age_s": 1e6, "drift_time_scale_s": 10.0}))
    np.testing.assert_allclose(levelled["phase drift"].normal_rad, young)


def test_equal_seeds_equal_draws():
    plan = plan_of(site())
    first, again, other = (error_budget(plan, n_draw=5, seed=seed).whole.drawn_normal_rad for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


@pytest.mark.parametrize(
    ("table", "ground"),
    [
        ({"model": "none"}, "ignored"),
        ({"model": "estimate"}, "estimated"),
        ({"model": "known", "coefficient": (-0.3, 0.1)}, "known"),
        ({"model": "fresnel", "permittivity": 4.0}, "known"),
        ({"model": "fresnel", "permittivity": 4.0, "scaled": True}, "estimated"),
    ],
)
def test_the_budget_models_the_ground_as_process_does(table, ground):
    scenario = two_tones(**REFLECTING, reflection=table)
    assert plan_of(scenario).ground == ground
    assert plan_of(scenario, pose="independent").ground == "ignored"
    assert plan_of(two_tones(**REFLECTING, reflection=table, budget={"ground": "known"})).ground == "known"


def test_what_cannot_be_budgeted_is_refused():
    with pytest.raises(InvalidInputError, match="rigid or independent"):
        plan_of(site(), pose="loose")
    with pytest.raises(InvalidInputError, match="knows no reflection"):
        plan_of(two_tones(**REFLECTING, budget={"ground": "known"}), pose="independent")
    one, *more = site().heliostat
    with pytest.raises(GeometryError, match="pivot survey"):
        plan_of(site().changed(heliostat=[one.changed(pivot_sigma_m=0.01), *more]))


def test_a_larger_site_has_larger_lengths():
    small = site(budget={"transmitter_survey_sigma_m": 0.002, "receiver_delay_sigma_s": 1e-12})
    large = small.scaled(2.0).budget
    assert large.transmitter_survey_sigma_m == 0.004
    assert large.multipath_excess_m == 2.0 * small.budget.multipath_excess_m
    assert large.receiver_delay_sigma_s == 1e-12
