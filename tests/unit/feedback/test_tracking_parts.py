"""Parts of the tracking simulation: margins, days, hidden mounts, gusts, radio errors, quantiles."""

import datetime
from pathlib import Path

import numpy as np
import pytest

from rfpose import geometry
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.feedback.energy import dish_capture_at, dish_efficiency
from rfpose.feedback.mount import PARAMETERS
from rfpose.feedback.optics import intercept_ratio
from rfpose.feedback.structure import StructureMode
from rfpose.feedback.tracking import METHODS, _kernels
from rfpose.feedback.tracking.capture import N_CAPTURE, TOP_RAD, capture_table
from rfpose.feedback.tracking.hidden import draw_field, field_positions
from rfpose.feedback.tracking.loops import _swing, check_gains, loop_margins
from rfpose.feedback.tracking.methods import choose
from rfpose.feedback.tracking.radio import RadioByPosture
from rfpose.feedback.tracking.sampled_loop import SampledLoop
from rfpose.feedback.tracking.score import quantile
from rfpose.feedback.tracking.timeline import days, site_of
from rfpose.feedback.tracking.wind import Gusts
from rfpose.feedback.wind.spectrum import wind_deflection
from rfpose.layout.maps import ESTIMATORS, mirrors_facing, normal_map
from rfpose.measurement import Estimator, noise_of
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, rigid_bound
from rfpose.scenario import load_scenario, parse_scenario
from rfpose.sun import sun_position

ROOT = Path(__file__).resolve().parents[3]
DATA = ROOT / "data" / "tracking_100m.toml"


def changed(**tracking):
    """The shipped scenario with keys of [tracking] replaced."""
    return load_scenario(DATA).changed(tracking=tracking)


# ---- margins ------------------------------------------------------------------------------------------------------


def oscillates(gain, integral, interval, latency):
    """Whether the sampled loop grows, by running it: a motor that goes where it is told."""
    shift = ramp = 0.0
    seen = [1.0] * (max(int(np.ceil(latency / interval)), 1))
    peak = []
    for _ in range(4000):
        error = seen.pop(0)
        ramp += integral * interval * error
        shift += interval * (gain * error + ramp)
        seen.append(1.0 - shift)
        peak.append(abs(1.0 - shift))
        if peak[-1] > 1e6:
            return True
    return max(peak[-100:]) > 10.0 * max(peak[:100])


@pytest.mark.parametrize(("gain", "integral"), [(0.06, 0.0), (0.06, 0.0004), (0.1, 0.002)])
@pytest.mark.parametrize(("interval", "latency"), [(1.0, 1.0), (4.0, 1.0), (4.0, 9.0)])
def test_gain_margin_is_where_the_loop_begins_to_grow(gain, integral, interval, latency):
    margin = loop_margins(
        SampledLoop(gain_per_s=gain, integral_gain_per_s2=integral, interval_s=interval, latency_s=latency)
    ).gain
    assert not oscillates(0.97 * margin * gain, 0.97 * margin * integral, interval, latency)
    assert oscillates(1.03 * margin * gain, 1.03 * margin * integral, interval, latency)


def test_margins_of_a_pure_integrator():
    # L = K T / (z − 1): grows from K T = 2 on; unity gain at |z − 1| = K T
    margins = loop_margins(SampledLoop(gain_per_s=0.05, interval_s=4.0, latency_s=0.0))
    assert margins.gain == pytest.approx(10.0, rel=1e-3)
    assert margins.unity_hz == pytest.approx(2.0 * np.arcsin(0.1) / (2.0 * np.pi * 4.0), rel=1e-3)
    assert loop_margins(SampledLoop(gain_per_s=0.05, interval_s=4.0, latency_s=9.0)).gain < margins.gain


def test_gains_without_margin_are_refused_unless_forced():
    assert check_gains(load_scenario(DATA)).gain > 1.5
    hot = changed(radio={"gain_per_s": 0.4})
    with pytest.raises(InvalidInputError, match=r"gain margin of 1\.2.*force_gains"):
        check_gains(hot)
    assert check_gains(changed(radio={"gain_per_s": 0.4, "force_gains": True})).gain < 1.5


# ---- days ---------------------------------------------------------------------------------------------------------


def test_a_day_lasts_while_the_sun_is_high_enough():
    scenario = changed(field_control=None)
    (day,) = days(scenario)
    sun = sun_position(day.unix_s[::600], site_of(scenario))
    np.testing.assert_allclose(day.sun_enu[: len(day.unix_s) : 600], sun.direction_enu, atol=2e-7)
    assert np.rad2deg(sun.elevation_rad.min()) == pytest.approx(10.0, abs=0.2)
    assert np.rad2deg(sun_position([day.unix_s[0] - 60.0], site_of(scenario)).elevation_rad[0]) < 10.0
    assert day.hour[0] < 7.0 < 17.0 < day.hour[-1]
    assert len(day.unix_s) % 4 == 0


def test_sun_below_the_horizon_is_refused():
    polar = load_scenario(DATA).model_copy(update={"site": load_scenario(DATA).site.model_copy(
        update={"latitude_deg": 78.0})})  # fmt: skip
    winter = polar.model_copy(update={"tracking": polar.tracking.model_copy(
        update={"date": datetime.date(2026, 12, 21)})})  # fmt: skip
    with pytest.raises(ScenarioError, match=r"2026-12-21 the sun is never above 10 degrees.*latitude 78"):
        days(winter)


# ---- hidden mounts ------------------------------------------------------------------------------------------------


def radio_model(scenario, normal):
    return RadioByPosture(scenario, scenario.pivot_enu_m, usual_normal_enu=normal)


def field_of(scenario, count=None, seed=1):
    return draw_field(scenario, count=count, seed=seed, sun_enu=days(scenario)[0].sun_enu[::60])


def test_hidden_mounts_scatter_as_told():
    scenario = changed(mount_errors={"tilt_sigma_mrad": 1.5, "fixed": {"axis_2_zero_rad": 4e-3}})
    field = field_of(scenario, 4000)
    index = {name: i for i, name in enumerate(PARAMETERS)}
    off = field.true - field.nominal
    # the scatter of a standard deviation from 4000 draws is 1.1 %
    assert off[:, index["pedestal_tilt_north_rad"]].std() == pytest.approx(1.5e-3, rel=0.05)
    assert off[:, index["location_up_m"]].std() == pytest.approx(0.010, rel=0.05)
    assert np.all(off[:, index["axis_2_zero_rad"]] == 4e-3)
    month = field.at(30.4375)[:, :2] - field.at(0.0)[:, :2]
    assert month.std() == pytest.approx(0.05e-3, rel=0.05)


def test_azimuth_axes_have_the_middle_of_their_travel_on_the_days_course():
    scenario = load_scenario(DATA)
    field = field_of(scenario)
    sun = days(scenario)[0].sun_enu[::60]
    for pivot, home in zip(field.pivot_enu_m, field.constant[:, 15], strict=True):
        normal = geometry.bisector_enu(np.array(scenario.site.aim_enu_m) - pivot, sun)
        azimuth = np.unwrap(geometry.azimuth_elevation_from_enu(normal)[0]) - home
        azimuth -= 2.0 * np.pi * np.rint(0.5 * (azimuth.max() + azimuth.min()) / (2.0 * np.pi))
        assert azimuth.max() == pytest.approx(-azimuth.min(), abs=0.02)


def test_mirrors_to_track():
    scenario = load_scenario(DATA)
    assert field_positions(scenario, None)[0] == scenario.heliostat_ids
    assert field_positions(scenario, 3)[0] == scenario.heliostat_ids[:3]
    ids, pivot = field_positions(scenario, 5000)
    radius = np.hypot(pivot[:, 0], pivot[:, 1])
    assert len(set(ids)) == 5000
    assert 10.0 < radius.min() < 11.0
    assert 99.0 < radius.max() <= 100.0
    # even: half of the mirrors on half of the ring's area
    assert np.mean(radius**2 < 0.5 * (100.0**2 + 10.0**2)) == pytest.approx(0.5, abs=0.01)
    with pytest.raises(ScenarioError, match="one heliostat or more, got 0"):
        field_positions(scenario, 0)
    with pytest.raises(ScenarioError, match="no heliostats"):
        field_positions(scenario.model_copy(update={"heliostat": ()}), None)


# ---- wind ---------------------------------------------------------------------------------------------------------


def test_deflection_grows_with_the_square_of_the_wind():
    slow, fast = (Gusts(changed(wind={"mean_speed_mps": v})) for v in (3.0, 6.0))
    np.testing.assert_allclose(fast.bend_rad(np.zeros(1)), 4.0 * slow.bend_rad(np.zeros(1)))
    assert fast.variance_rad2 == pytest.approx(16.0 * slow.variance_rad2, rel=0.3)


def test_a_wind_record_is_felt_as_it_was(tmp_path):
    (day,) = days(load_scenario(DATA))
    begin = day.unix_s[0] - 10.0
    speed = 3.0 + 2.0 * np.sin(np.arange(40_000) / 50.0)
    path = tmp_path / "wind.csv"
    path.write_text("unix_s,speed_mps\n" + "".join(f"{begin + i:.0f},{v:.4f}\n" for i, v in enumerate(speed)))
    gusts = Gusts(changed(wind={"record": str(path)}))
    gusts.check_covers([day])
    times = day.unix_s[100:200]
    felt = gusts.run(np.zeros((3, 1)), np.random.default_rng(0), times)
    want = np.interp(times, begin + np.arange(40_000), speed) ** 2
    got = gusts.bend_rad(felt.astype(np.float64)) / gusts.bend
    np.testing.assert_allclose(got, np.broadcast_to(want[:, None], (3, 100, 2)), rtol=2e-3)
    assert gusts.mean_mps == pytest.approx(np.sqrt(np.mean(speed**2)), rel=1e-3)
    late = changed(wind={"record": str(path)}, date=datetime.date(2026, 3, 25))
    with pytest.raises(ScenarioError, match="does not reach over 2026-03-25"):
        Gusts(late).check_covers(days(late))


# ---- radio --------------------------------------------------------------------------------------------------------


def test_radio_errors_are_the_estimators_bound():
    # the same numbers by another path: the layout study's map of the shared-clock, carrier, pivot estimator
    scenario = changed(radio={"ground": "none"})
    sun = geometry.enu_from_azimuth_elevation(0.3, 0.8)
    mirrors = mirrors_facing(
        scenario.pivot_enu_m, np.array(scenario.heliostat[0].receiver_mirror_m),
        aim_enu_m=scenario.site.aim_enu_m, sun_enu=sun, arm_m=scenario.heliostat[0].arm_m,
    )  # fmt: skip
    errors = radio_model(scenario, mirrors.normal_enu).errors(mirrors.normal_enu, np.random.default_rng(0))
    as_used = Estimator(name="as used", clock_sigma_m=0.0, carrier=True, pivot_sigma_m=5e-3)
    bound = normal_map(scenario.transmitter_enu_m, mirrors, noise_of(scenario), as_used)
    np.testing.assert_allclose(errors.sigma_rad, bound, rtol=1e-3)
    assert errors.solved.all()
    tones = radio_model(changed(radio={"ground": "none", "tone_snr_db": 0.0}), mirrors.normal_enu)
    worse = tones.errors(mirrors.normal_enu, np.random.default_rng(0)).sigma_rad
    assert np.all(worse > 100.0 * errors.sigma_rad)
    assert "shared-clock" in ESTIMATORS


def test_radio_noise_lies_as_the_pose_has_it():
    # two receivers close together see turns about their line badly: right and up differ, and go together
    scenario = changed(radio={"ground": "none"})
    places = ((0.9, 0.1, 0.0), (-0.5, 0.4, 0.0), (-0.4, -0.3, 0.0))
    mirrors = tuple(h.model_copy(update={"receiver_mirror_m": places, "arm_m": 0.0}) for h in scenario.heliostat)
    scenario = scenario.model_copy(update={"heliostat": mirrors})
    normal = geometry.unit(np.array([0.0, 0.0, 50.0]) - scenario.pivot_enu_m + [10.0, 40.0, 60.0])
    rot = geometry.rot_enu_from_mirror(normal)
    spread = radio_model(scenario, normal).errors(normal, np.random.default_rng(0)).spread_rad
    noise = noise_of(scenario)
    sigma = np.concatenate([noise.tone_sigma_m, noise.carrier_sigma_m[None]])[:, None, :]
    common = np.concatenate([noise.calibration_sigma_m, np.full((1, 10), np.inf)])
    mirrors = MirrorProblem.expected(
        scenario.transmitter_enu_m, places, scenario.pivot_enu_m, rot,
        sigma_m=np.broadcast_to(sigma, (12, 3, 3, 10)), transmitter_sigma_m=common, clock_class=[0, 1, 2],
        knowledge=MirrorKnowledge(clock_sigma_m=0.0, pivot_enu_m=scenario.pivot_enu_m, pivot_sigma_m=5e-3),
    )  # fmt: skip
    cov = rigid_bound(mirrors)[:, 3:, 3:]
    for m in range(12):
        cross = np.cross(np.eye(3), normal[m])  # rows: e_i × n
        of_normal = cross.T @ cov[m] @ cross
        axes = rot[m][:, :2]
        lower = np.array([[spread[m, 0], 0.0], [spread[m, 1], spread[m, 2]]])
        np.testing.assert_allclose(lower @ lower.T, axes.T @ of_normal @ axes, rtol=1e-6, atol=1e-16)
    assert np.all(np.abs(np.log(spread[:, 2] / spread[:, 0])) > 0.2)


def test_hidden_transmitters_cost_accuracy_and_at_last_the_pose():
    scenario = changed(radio={"ground": "none", "hidden_transmitters": 0.4})
    normal = geometry.unit(np.array([0.0, 0.0, 50.0]) - scenario.pivot_enu_m + [0.0, 40.0, 60.0])
    model = radio_model(scenario, normal)
    clear = radio_model(changed(radio={"ground": "none"}), normal).errors(normal, np.random.default_rng(0))
    some = model.errors(normal, np.random.default_rng(0))
    assert np.all(some.sigma_rad[some.solved] >= clear.sigma_rad[some.solved] * (1.0 - 1e-9))
    assert np.any(some.sigma_rad > 1.05 * clear.sigma_rad)
    dark = radio_model(changed(radio={"ground": "none", "hidden_transmitters": 1.0}), normal)
    assert not dark.errors(normal, np.random.default_rng(0)).solved.any()


def test_a_reflection_that_is_ignored_turns_normals():
    scenario = changed(radio={"ground": "ignored"})
    normal = geometry.unit(np.array([0.0, 0.0, 50.0]) - scenario.pivot_enu_m + [0.0, 40.0, 60.0])
    ignored = radio_model(scenario, normal).errors(normal, np.random.default_rng(0))
    estimated = radio_model(load_scenario(DATA), normal).errors(normal, np.random.default_rng(0))
    assert np.sqrt(np.mean(ignored.bias_rad**2)) > 1e-3
    assert not estimated.bias_rad.any()
    assert np.all(estimated.sigma_rad < 3.0 * ignored.sigma_rad)


def test_a_few_mirrors_stand_for_a_large_field_over_reflecting_ground():
    scenario = changed(radio={"ground": "ignored"})
    spread = scenario.simulation.model_copy(update={"path_loss": "free_space"})
    scenario = scenario.model_copy(update={"simulation": spread})
    angle = np.linspace(0.0, 6.0 * np.pi, 201)
    radius = np.linspace(20.0, 90.0, 201)
    pivot = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(201, 2.0)], axis=1)
    normal = geometry.unit(np.array([0.0, 0.0, 50.0]) - pivot + [10.0, 40.0, 60.0])
    errors = RadioByPosture(scenario, pivot, usual_normal_enu=normal).errors(normal, np.random.default_rng(0))
    assert errors.solved.all()
    assert np.all(errors.sigma_rad > 0.0)
    assert np.sqrt(np.mean(errors.bias_rad**2)) > 1e-3


# ---- methods, scores ----------------------------------------------------------------------------------------------


def test_methods_are_chosen_by_name():
    assert [m.name for m in choose((), collector="heliostat")] == [n for n in METHODS if n != "sun-sensor"]
    assert "sun-sensor" in [m.name for m in choose((), collector="dish")]
    with pytest.raises(InvalidInputError, match="'sonar'; known are open-loop"):
        choose(("sonar",), collector="heliostat")
    with pytest.raises(InvalidInputError, match="cannot steer a heliostat"):
        choose(("sun-sensor",), collector="heliostat")
    with pytest.raises(InvalidInputError, match="each method once"):
        choose(("radio", "radio"), collector="heliostat")


def test_quantiles_from_the_histogram():
    rng = np.random.default_rng(1)
    angles = np.abs(rng.normal(0.0, 3e-4, 100_000))
    slot = (_kernels.BINS_PER_DECADE * np.log10(np.maximum(angles, 1e-6) / _kernels.LOWEST_RAD)).astype(int)
    histogram = np.bincount(slot, minlength=_kernels.N_BIN)[None]
    assert quantile(histogram, 0.95)[0] == pytest.approx(np.quantile(angles, 0.95), rel=0.01)
    assert np.isnan(quantile(np.zeros((1, _kernels.N_BIN), int), 0.95)[0])


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ("control_interval_s = 2.5", "multiple of `servo_interval_s`"),
        ("first_hour = 14.0\nlast_hour = 9.0", "must be before `last_hour`"),
        ("inner_radius_m = 200.0", "`inner_radius_m` must be less"),
        ("[tracking.radio]\noutages = [{first_hour = 12.0, last_hour = 11.0}]", "must be before `last_hour`"),
        ("[tracking.wind]\nspeed = 3.0", "unknown key"),
    ],
)
def test_contradictory_tracking_tables_are_refused(table, complaint):
    plain = load_scenario(ROOT / "data" / "table2_100m.toml").to_toml()
    with pytest.raises(ScenarioError, match=complaint):
        parse_scenario(f"{plain}\n[tracking]\n{table}\n")


# ---- captures -----------------------------------------------------------------------------------------------------


def looked_up(table, error):
    per_rad = (N_CAPTURE - 1) / TOP_RAD
    return np.array([_kernels._caught(e, table, per_rad) for e in error])


@pytest.mark.parametrize("ratio", [0.5, 1.0, 1.4])
def test_a_heliostats_capture_is_that_of_its_aperture(ratio):
    error = np.random.default_rng(1).uniform(0.0, 20e-3, 300)
    got = looked_up(capture_table(changed(aperture={"image_ratio": ratio})), error)
    want = intercept_ratio(error, slope_error_rad=1.5e-3, aperture_ratio=ratio)
    # steps of 31 µrad on discs of 6.15 mrad; where one leaves the other the curve has a kink, and a root of the step:
    # 31/6150 of 2/π at most by the slope
    np.testing.assert_allclose(got, want, atol=2e-4)
    assert looked_up(capture_table(changed(aperture={"image_ratio": ratio})), [0.0])[0] == min(1.0, ratio**2)


@pytest.mark.parametrize("area", [None, 800.0, 3000.0])
def test_a_dishs_capture_is_edwards_before_his_average(area):
    aperture = {"h_per_deg": 3.0, "rim_deg": 50.0} | ({} if area is None else {"area_ratio": area})
    site = changed(collector="dish", aperture=aperture)
    rim = np.deg2rad(50.0)
    ratio = area or float(dish_efficiency(h_per_deg=3.0, loss_w_m2=2e5, rim_rad=rim)[1])
    error = np.random.default_rng(2).uniform(0.0, 30e-3, 300)
    want = dish_capture_at(error, ratio, h_per_deg=3.0, rim_rad=rim)
    np.testing.assert_allclose(looked_up(capture_table(site), error), want, atol=1e-5)
    assert looked_up(capture_table(site), [TOP_RAD, 1.0, np.nan]).tolist() == [0.0, 0.0, 0.0]


# ---- a sun that is carried on -------------------------------------------------------------------------------------


def test_a_heard_sun_is_carried_on_as_the_sky_turns():
    scenario = load_scenario(DATA)
    (day,) = days(scenario)
    site = site_of(scenario)
    loop = _kernels.Loop(**dict.fromkeys(_kernels.Loop._fields, 0))._replace(
        pole_n=np.cos(site.latitude_rad), pole_u=np.sin(site.latitude_rad)
    )
    out = np.empty(3)
    for at in range(1000, 35_000, 3000):
        _kernels._carried(day.sun_enu[at], 7.2921159e-5 * 60.0, loop, out)
        # a minute of 4.4 mrad: the sun's own way among the stars is 1/365 of it, 12 µrad, and refraction changes by
        # 0.15 mrad a degree at ten degrees of height, which it rises in five minutes
        assert np.linalg.norm(out - day.sun_enu[at + 60]) < 45e-6
        assert np.linalg.norm(day.sun_enu[at + 60] - day.sun_enu[at]) > 4e-3
        assert np.linalg.norm(out) == pytest.approx(1.0, abs=1e-9)


# ---- structure ----------------------------------------------------------------------------------------------------


def test_the_kernels_swing_has_the_winds_variance_and_rings_down():
    gusts = Gusts(changed(structure={"natural_hz": 2.2, "damping": 0.02}, wind={"mean_speed_mps": 7.0}))
    mode = StructureMode(natural_hz=2.2, damping=0.02)
    want = [float(wind_deflection(b, 7.0, mode, size_m=2.0)[1]) for b in gusts.bend]
    np.testing.assert_allclose(gusts.swing_sigma_rad**2, want, rtol=1e-12)
    loop = _kernels.Loop(**dict.fromkeys(_kernels.Loop._fields, 0))._replace(servo_s=1.0, **_swing(gusts))
    noise = gusts.draw_swing(np.random.default_rng(3), (200, 500))
    state, seen = np.zeros((200, _kernels.N_STATE)), []
    for s in range(500):
        for i in range(200):
            _kernels._swing(loop, noise[i, s], 0.0, 0.0, state[i])
        seen.append(state[:, [_kernels.SWING, _kernels.SWING + 2]].copy())
    late = np.array(seen)[60:]
    # ringing lasts 3.6 s: of 88 000 samples some 25 000 are free; five sigma of their variance
    np.testing.assert_allclose(np.mean(late**2, axis=(0, 1)), want, rtol=5.0 * np.sqrt(2.0 / 25_000.0))
    assert gusts.variance_rad2 > np.mean(want)
    # a motor that stops: free vibration from the speed that it took away
    one, v = np.zeros(_kernels.N_STATE), 40e-3
    one[_kernels.RATE] = v
    w, still = mode.natural_radps, np.zeros(2)
    wd = w * np.sqrt(1.0 - 0.02**2)
    for t in range(1, 20):
        _kernels._swing(loop, still, 0.0, 0.0, one)
        expected = v / wd * np.exp(-0.02 * w * t) * np.sin(wd * t)
        assert one[_kernels.SWING] == pytest.approx(expected, abs=1e-9 * v)
        assert one[_kernels.SWING + 2] == 0.0


def test_a_stiff_structure_draws_nothing_and_does_not_swing():
    gusts = Gusts(changed(structure={"natural_hz": 0.0}))
    assert not gusts.swings
    assert gusts.draw_swing(np.random.default_rng(0), (3, 100)).shape == (3, 0, 2)
    assert not gusts.swing_rad(np.random.default_rng(0), (3, 5)).any()
    soft = Gusts(changed(structure={"natural_hz": 2.2}))
    drawn = soft.swing_rad(np.random.default_rng(0), (20_000,))
    # 0.7 % is the scatter of a standard deviation of so many
    np.testing.assert_allclose(drawn.std(axis=0), soft.swing_sigma_rad, rtol=0.03)
