"""The error budget of a tracked field: sampled loops, parts one by one against the simulation, intercept and light."""

import datetime
import json
from pathlib import Path

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.feedback.energy import dish_capture, heliostat_intercept
from rfpose.feedback.tracking import TrackingSimulation, score
from rfpose.feedback.tracking.budget import SampledLoop, mean_intercept, track_budget
from rfpose.feedback.tracking.capture import capture_table
from rfpose.feedback.tracking.timeline import day_of
from rfpose.scenario import load_scenario

DATA = Path(__file__).resolve().parents[3] / "data" / "tracking_100m.toml"
NO_ERRORS = {
    "tilt_sigma_mrad": 0.0, "zero_sigma_mrad": 0.0, "nonorthogonality_sigma_mrad": 0.0, "canting_sigma_mrad": 0.0,
    "location_sigma_mm": 0.0, "worm_sigma_mrad": 0.0, "sag_sigma_mrad": 0.0, "thermal_sigma_mrad": 0.0,
    "creep_sigma_mrad_per_month": 0.0,
}  # fmt: skip
QUIET = {
    "mount_errors": NO_ERRORS,
    "drive": {"steps_per_turn": 4e6, "backlash_mrad": (0.0, 0.0)},
    "wind": {"mean_speed_mps": 0.0},
    "structure": {"natural_hz": 0.0},
    "radio": {"plate_sigma_mrad": 0.0, "plate_calibration": "none", "lost_frames": 0.0, "ground": "none"},
    "sun_sensor": {"offset_sigma_mrad": 0.0, "drift_mrad": 0.0},
}


def changed(hours, *changes):
    """The shipped scenario without field control, keys of [tracking] replaced."""
    site = load_scenario(DATA)
    for change in ({"first_hour": hours[0], "last_hour": hours[1], "field_control": None}, *changes):
        site = site.changed(tracking=change)
    return site


def simulated(scenario, methods, count):
    simulation = TrackingSimulation(scenario, methods=methods, count=count, seed=3)
    while simulation.done < simulation.n_segment:
        simulation.advance()
    return {name: score(simulation.sums(name)) for name in methods}


# ---- loops --------------------------------------------------------------------------------------------------------


def run(loop, disturbance, noise=None):
    """What is left of disturbances (run, servo step), measured with noise: the loop written down once more."""
    n, late = round(loop.interval_s / loop.servo_s), max(int(np.ceil(loop.latency_s / loop.servo_s)), 1)
    shift, ramp = np.zeros(len(disturbance)), np.zeros(len(disturbance))
    due, left = {}, np.empty_like(disturbance)
    for g in range(disturbance.shape[1]):
        shift = shift + due.pop(g, 0.0)
        left[:, g] = disturbance[:, g] - shift
        if g % n == 0:
            seen = left[:, g] + (0.0 if noise is None else noise[:, g])
            ramp = ramp + loop.integral_gain_per_s2 * loop.interval_s * seen
            due[g + late] = loop.interval_s * (loop.gain_per_s * seen + ramp)
    return left


LOOPS = [
    SampledLoop(gain_per_s=0.06, integral_gain_per_s2=4e-4, interval_s=4.0, latency_s=1.0),
    SampledLoop(gain_per_s=0.06, integral_gain_per_s2=4e-4, interval_s=4.0, latency_s=9.0),
    SampledLoop(gain_per_s=0.5, interval_s=1.0, latency_s=1.0),
    SampledLoop(gain_per_s=0.25, integral_gain_per_s2=0.01, interval_s=2.0, latency_s=1.5, servo_s=0.5),
]


@pytest.mark.parametrize("loop", LOOPS)
def test_what_a_loop_leaves_of_a_sine(loop):
    # frequencies with whole periods in the last 4000 s, some above half the sampling rate
    frequency = np.array([0.001, 0.01, 0.03, 0.11, 0.223, 0.4])
    time = np.arange(0.0, 8000.0, loop.servo_s)
    swing = np.sqrt(2.0) * np.sin(2.0 * np.pi * frequency[:, None] * time + 0.3)
    late = run(loop, swing)[:, len(time) // 2 :]
    assert np.sqrt(np.mean(late**2, axis=1)) == pytest.approx(loop.left(frequency), rel=1e-3)


@pytest.mark.parametrize("loop", LOOPS)
def test_noise_that_a_loop_passes(loop):
    rng = np.random.default_rng(7)
    noise = rng.standard_normal((200, 2000))
    late = run(loop, np.zeros_like(noise), noise)[:, 500:]
    # some 200 runs of 1500 s, the loops forget within 60 s: 1 % of the rms
    assert np.std(late) == pytest.approx(loop.passed, rel=0.03)


def test_lost_measurements_weaken_a_loop():
    full, lossy = (
        SampledLoop(gain_per_s=0.06, integral_gain_per_s2=4e-4, interval_s=4.0, lost=lost) for lost in (0.0, 0.5)
    )
    half = SampledLoop(gain_per_s=0.03, integral_gain_per_s2=2e-4, interval_s=4.0)
    assert lossy.left(0.003) == pytest.approx(half.left(0.003), rel=1e-12)
    assert lossy.left(0.003) > 1.5 * full.left(0.003)
    assert lossy.passed == pytest.approx(half.passed * np.sqrt(2.0), rel=1e-12)


def test_a_start_dies_away():
    loop = SampledLoop(gain_per_s=0.1, interval_s=4.0)
    # after k measurements 0.6^k is left, seen by three steps of its interval and one of the next
    left = run(loop, np.ones((1, 2000)))[0, 20:]
    assert loop.start_rms(20.0, 1980.0) == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-9)
    assert loop.start_rms(0.0, 1980.0) > 10.0 * loop.start_rms(20.0, 1980.0)


@pytest.mark.parametrize(("change", "word"), [({"interval_s": 0.0}, "interval_s"), ({"lost": 1.5}, "lost")])
def test_loops_refuse_nonsense(change, word):
    with pytest.raises(InvalidInputError, match=word):
        SampledLoop(gain_per_s=0.1, **change)


# ---- parts, one by one --------------------------------------------------------------------------------------------

STEPS = {"steps_per_turn": 48_000.0}
WINDY = {"wind": {"mean_speed_mps": 8.0}}
# 24 mirrors over an hour. Gusts at 8 m/s forget within 24 s: 1800 independent deflections, 1.7 % of the rms; steps,
# noise and levels scatter less. What is left of the tolerance is the linear loop's.
MOVING = [
    (WINDY, {"open-loop": ("gusts", 0.06), "radio": ("gusts", 0.06)}),
    ({**WINDY, "radio": {"lost_frames": 0.3}}, {"radio": ("gusts", 0.06)}),
    ({**WINDY, "radio": {"latency_s": 9.0}}, {"radio": ("gusts", 0.06)}),
    ({**WINDY, "structure": {"natural_hz": 0.7, "damping": 0.02}},
     {"open-loop": ("resonance", 0.06), "radio": ("resonance", 0.06)}),
    ({"radio": {"tone_snr_db": -5.0}}, {"radio": ("radio_noise", 0.04), "radio-both": ("radio_noise", 0.04)}),
    ({"radio": {"tone_snr_db": -5.0, "lost_frames": 0.3}}, {"radio": ("radio_noise", 0.05)}),
    ({"drive": STEPS}, {"open-loop": ("motor_steps", 0.02), "radio": ("motor_steps", 0.04)}),
    ({"drive": {**STEPS, "microsteps": 8}}, {"open-loop": ("motor_steps", 0.04), "radio": ("motor_steps", 0.07)}),
    ({"drive": {**STEPS, "dead_band_steps": 3.0}}, {"open-loop": ("play", 0.03), "radio": ("motor_steps", 0.07)}),
    ({"drive": {"backlash_mrad": (0.5, 0.3)}}, {"open-loop": ("play", 0.03)}),
    ({"drive": {"stiction_mrad": (0.5, 0.5)}}, {"open-loop": ("stiction", 0.05), "radio": ("stiction", 0.08)}),
    ({}, {"encoder": ("encoder", 0.03)}),
    ({"collector": "dish"}, {"sun-sensor": ("sensor_levels", 0.03)}),
]  # fmt: skip


@pytest.mark.parametrize(("change", "expected"), MOVING)
def test_parts_that_move(change, expected):
    scenario = changed((9.0, 10.0), QUIET, change)
    for method, found in simulated(scenario, tuple(expected), 24).items():
        part, tolerance = expected[method]
        budget = track_budget(scenario, method, count=24)
        assert budget.parts_rad[part] > 0.4 * budget.total_rad
        assert found.normal_rms_rad == pytest.approx(budget.total_rad, rel=tolerance), method


# Constant for a mirror: of n = 200 mirrors and two directions 1/(2 √n) of the rms, 3.5 %; places weigh most on mirrors
# that stand near, some 60 of them: 6 %. Three sigma.
CONSTANT = [
    ("plate", "radio", {"radio": {"plate_sigma_mrad": 0.6, "plate_calibration": "camera"}}, 0.11),
    ("instrument", "radio-model", {"radio": {"plate_sigma_mrad": 0.6, "plate_calibration": "camera"}}, 0.11),
    ("plate_drift", "radio", {"radio": {"plate_drift_mrad": 0.6}}, 0.15),  # one direction: 5 %
    ("sensor_null", "sun-sensor", {"collector": "dish", "sun_sensor": {"offset_sigma_mrad": 0.3}}, 0.11),
    ("sensor_drift", "sun-sensor", {"collector": "dish", "sun_sensor": {"drift_mrad": 2.0}}, 0.15),
    ("place", "radio", {"mount_errors": {"location_sigma_mm": 10.0}}, 0.18),
    ("mount", "open-loop", {"mount_errors": {"tilt_sigma_mrad": 2.0}}, 0.11),
    ("mount", "open-loop", {"mount_errors": {"zero_sigma_mrad": 2.0}}, 0.11),
    ("worm", "open-loop", {"mount_errors": {"worm_sigma_mrad": 1.0}}, 0.15),
    ("heat", "open-loop", {"mount_errors": {"thermal_sigma_mrad": 0.5}}, 0.11),
    ("worm", "camera-model", {"mount_errors": {"worm_sigma_mrad": 1.0}, "camera": {"spot_sigma_mm": 1.0}}, 0.15),
    ("creep", "camera-model", {"mount_errors": {"creep_sigma_mrad_per_month": 0.5}, "camera": {"spot_sigma_mm": 1.0}},
     0.15),
    ("fit", "camera-model", {"camera": {"spot_sigma_mm": 100.0}}, 0.11),
    ("instrument", "drone-model", {"drone": {"constant_sigma_mrad": 0.5}}, 0.15),
    ("fit", "bias", {"camera": {"spot_sigma_mm": 100.0}}, 0.20),  # mirrors and hours apart weigh differently
]  # fmt: skip


@pytest.mark.parametrize(("part", "method", "change", "tolerance"), CONSTANT)
def test_a_part_that_is_constant_for_a_mirror(part, method, change, tolerance):
    scenario = changed((9.0, 9.2), QUIET, change)
    budget = track_budget(scenario, method, count=200)
    assert budget.parts_rad[part] > 0.6 * budget.total_rad
    assert simulated(scenario, (method,), 200)[method].normal_rms_rad == pytest.approx(budget.total_rad, rel=tolerance)


def test_nothing_wrong_leaves_nothing():
    budget = track_budget(changed((9.0, 10.0), QUIET), "open-loop", count=12)
    step = 2.0 * np.pi / 4e6
    assert budget.total_rad < 2.0 * step / np.sqrt(12.0)
    assert budget.intercept == pytest.approx(1.0, abs=1e-4)


def test_a_steady_wind_bends_open_loops_and_is_taken_out_of_closed_and_calibrated_ones():
    scenario = changed((9.0, 10.0), QUIET, {"wind": {"mean_speed_mps": 8.0}})
    assert track_budget(scenario, "open-loop").steady_wind_rad == pytest.approx(64e-3 * np.hypot(3e-3, 6e-3))
    assert track_budget(scenario, "radio").steady_wind_rad == 0.0
    assert track_budget(scenario, "camera-model").steady_wind_rad < 0.05e-3


def test_the_plate_as_mounted_and_its_daily_bend():
    mounted = changed((9.0, 10.0), QUIET, {"radio": {"plate_sigma_mrad": 0.6, "plate_drift_mrad": 0.6}})
    budget = track_budget(mounted, "radio")
    heat = day_of(mounted, mounted.tracking.date, 0).heat[120:]
    assert budget.plate_rad == pytest.approx(0.6e-3 * np.sqrt(2.0))
    assert budget.plate_drift_rad == pytest.approx(0.6e-3 * np.sqrt(np.mean(heat**2)), rel=0.01)
    # a camera's sixteen looks, 45 days before, take off the mean bend of their day
    calibrated = changed((9.0, 10.0), QUIET, {"radio": {"plate_drift_mrad": 0.6, "plate_calibration": "camera"}})
    before = day_of(mounted, mounted.tracking.date - datetime.timedelta(days=45), -45, whole=True)
    looks = before.heat[np.linspace(0, len(before.heat) - 1, 18).astype(int)[1:-1]]
    left = 0.6e-3 * np.sqrt(np.mean((heat - looks.mean()) ** 2))
    assert track_budget(calibrated, "radio").plate_drift_rad == pytest.approx(left, rel=0.01)


def test_measured_wind(tmp_path):
    seconds = np.arange(0, 8 * 3600)
    speed = np.sqrt(25.0 + 10.0 * np.sin(2.0 * np.pi * seconds / 20.0))  # the square swings by 10
    stamp = np.datetime64("2026-03-20T05:00:00") + seconds.astype("timedelta64[s]")
    path = tmp_path / "wind.csv"
    path.write_text("time,speed_mps\n" + "".join(f"{t}Z,{v:.5f}\n" for t, v in zip(stamp, speed, strict=True)))
    scenario = changed((9.0, 10.0), QUIET, {"wind": {"record": str(path)}})
    swings = 10.0 / np.sqrt(2.0) * 1e-3 * np.hypot(3e-3, 6e-3)
    assert track_budget(scenario, "open-loop").gusts_rad == pytest.approx(swings, rel=0.01)
    loop = SampledLoop(gain_per_s=0.06, integral_gain_per_s2=4e-4, interval_s=4.0)
    assert track_budget(scenario, "radio").gusts_rad == pytest.approx(swings * float(loop.left(0.05)), rel=0.01)


# ---- the whole ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("methods", "tolerance"),
    [(("radio", "radio-both", "radio-model"), 0.1),
     (("open-loop", "encoder", "bias", "berenguel", "camera-model", "drone-model"), 0.25)],
)  # fmt: skip
def test_methods_as_shipped(methods, tolerance):
    # the plate and the places, half of the radio methods' error, scatter by 5 % for 96 mirrors
    scenario = changed((9.0, 9.5), {"radio": {"ground": "none"}})  # saves the search for what a reflection costs
    for method, found in simulated(scenario, methods, 96).items():
        budget = track_budget(scenario, method, count=96)
        assert found.normal_rms_rad == pytest.approx(budget.total_rad, rel=tolerance), method
        assert 1.0 - found.intercept == pytest.approx(1.0 - budget.posture_intercept, rel=1.5 * tolerance)
        # what is on offer does not depend on errors
        offered = found.energy_j_per_m2 / found.intercept / 3.6e6
        assert offered == pytest.approx(budget.offered_kwh_per_m2, rel=0.05)


def test_creep_grows_over_the_days_and_starts_anew_after_a_calibration():
    creeping = {"mount_errors": {"creep_sigma_mrad_per_month": 0.5}, "camera": {"interval_days": 30.0}}
    creep = [
        track_budget(changed((9.0, 10.0), QUIET, creeping, change), "camera-model").creep_rad
        for change in ({}, {"days": 2, "day_interval": 14}, {"days": 2, "day_interval": 30})
    ]
    # 15 days old on the first day, 29 a fortnight later, 15 again a month later
    assert creep[1] / creep[0] == pytest.approx(np.sqrt(0.5 * (1.0 + (29.0 / 15.0) ** 2)), rel=0.02)
    assert creep[2] == pytest.approx(creep[0], rel=0.05)


def test_a_fixed_error_counts_with_all_of_its_value():
    fixed = {"mount_errors": {"fixed": {"axis_2_zero_rad": 3e-3}}}
    assert track_budget(changed((9.0, 10.0), QUIET, fixed), "open-loop").mount_rad == pytest.approx(3e-3, rel=0.02)


def test_intercept_is_that_of_errors_in_two_directions():
    total = np.array([0.2e-3, 1e-3, 3e-3])
    heliostat = changed((9.0, 10.0))
    expected = heliostat_intercept(total / np.sqrt(2.0), slope_error_rad=1.5e-3)
    assert mean_intercept(capture_table(heliostat), total) == pytest.approx(expected, abs=1e-4)
    dish = changed((9.0, 10.0), {"collector": "dish", "aperture": {"area_ratio": 2000.0}})
    expected = dish_capture(2000.0, h_per_deg=3.9, sigma_rad=total / np.sqrt(2.0))
    assert mean_intercept(capture_table(dish), total) == pytest.approx(expected, abs=1e-4)


def test_summary_and_light():
    budget = track_budget(changed((9.0, 15.0)), "radio")
    told = json.loads(json.dumps(budget.as_dict()))
    assert np.hypot.reduce(list(told["parts_mrad"].values())) == pytest.approx(told["total_mrad"])
    assert told["parts_mrad"]["plate"] == pytest.approx(1e3 * budget.plate_rad)
    assert "encoder" not in told["parts_mrad"]
    lost = told["offered_kwh_per_m2"] * (1.0 - told["intercept"])
    assert told["lost_kwh_per_m2"] == pytest.approx(lost)
    # a year of whole days is some 550 times these six hours
    assert 400.0 < told["lost_kwh_per_m2_year"] / told["lost_kwh_per_m2"] < 700.0


def test_refusals():
    scenario = changed((9.0, 10.0))
    with pytest.raises(InvalidInputError, match="no tracking method"):
        track_budget(scenario, "gyroscope")
    with pytest.raises(InvalidInputError, match="cannot steer"):
        track_budget(scenario, "sun-sensor")
    wild = changed((9.0, 10.0), {"radio": {"gain_per_s": 1.0, "force_gains": True}})
    with pytest.raises(InvalidInputError, match="oscillate"):
        track_budget(wild, "radio")
