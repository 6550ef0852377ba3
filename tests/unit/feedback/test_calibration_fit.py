"""The fit: what it finds, what it refuses to tell, and what it says about bad input."""

import itertools

import numpy as np
import pytest
from scipy.optimize import minimize

from rfpose import geometry
from rfpose.errors import InvalidInputError
from rfpose.feedback.alarms import alarms
from rfpose.feedback.calibration import (
    PARAMETER_SETS,
    FitSettings,
    FitStatus,
    RowStatus,
    fit,
    fit_many,
    normal_errors_rad,
    predict,
)
from rfpose.feedback.columns import columns_of, scales_of
from rfpose.feedback.design import forecast, next_postures
from rfpose.feedback.measurements import Measurements, join
from rfpose.feedback.mount import PARAMETERS, Actuator, Mount, command, posture, stack_mounts
from rfpose.feedback.selection import refit, refit_errors_rad, with_priors
from rfpose.feedback.uncertainty import RAYLEIGH_MEDIAN, FitBatch
from rfpose.feedback.validation import chronological_split, leave_one_out_rad, random_splits, rolling_refit
from rfpose.sun import Location

START = Mount(pivot_enu_m=np.array([20.0, 80.0, 3.0]))
TRUE = START.replace(
    pedestal_tilt_north_rad=4e-3, pedestal_tilt_east_rad=-6e-3, axis_1_zero_rad=0.02, axis_2_zero_rad=-0.01,
    nonorthogonality_rad=3e-3, location_east_m=0.05, location_north_m=-0.03, location_up_m=0.02,
)  # fmt: skip
TARGETS = np.array([[0.0, 0.0, 30.0], [0.0, 0.0, 60.0], [15.0, 0.0, 45.0]])
EXACT = FitSettings(sigma_known=True, huber=np.inf)


def suns(rng, n):
    azimuth, elevation = rng.uniform(np.pi / 2, 1.5 * np.pi, n), rng.uniform(0.2, 1.2, n)
    return geometry.enu_from_azimuth_elevation(azimuth, elevation)


def spots(rng, n, *, mount=TRUE, sigma=3e-4, targets=TARGETS, noise=True):
    sun = suns(rng, n)
    aim = targets[np.arange(n) % len(targets)]
    count = command(mount, sun_enu=sun, target_enu_m=aim).count + noise * sigma * rng.normal(size=(n, 2))
    return Measurements.from_spots(count, sun_enu=sun, spot_enu_m=aim, sigma_rad=sigma)


def test_exact_measurements_give_the_exact_mount():
    made = spots(np.random.default_rng(1), 40, noise=False)
    found = fit(START, made, free="malan", settings=EXACT)
    assert found.field.status[0] == FitStatus.OK
    assert found.undetermined == ()
    for name in PARAMETER_SETS["malan"]:
        assert found.estimate[name] == pytest.approx(TRUE.parameters[name], abs=1e-7), name
    assert found.error_rad.max() < 1e-9


def test_noise_is_estimated_where_sigma_is_not_known():
    made = spots(np.random.default_rng(2), 200, sigma=7e-4)
    stated = Measurements(count=made.count, row=np.where(np.arange(10) == 8, 1e-3, made.row), unix_s=made.unix_s)
    found = fit(START, stated, free="malan")
    # noise of 0.7 mrad of each axis angle is less across: cos(elevation) of the mirror, 0.8 to 1
    assert 0.55 < found.field.noise[0] < 0.75


def test_one_target_leaves_the_distance_to_it_open():
    made = spots(np.random.default_rng(3), 60, targets=TARGETS[:1])
    found = fit(START, made, free="malan", settings=EXACT)
    assert found.field.rank[0] == 7
    (group,) = found.undetermined
    assert set(group) == {"location_up_m", "location_east_m", "location_north_m"}
    assert all(np.isnan(found.estimate[name]) and np.isinf(found.sigma[name]) for name in group)
    assert np.isfinite(found.estimate["axis_1_zero_rad"])
    # the mount still predicts: nothing depends on which of the equivalent values was taken
    assert np.median(found.error_rad) < 1e-3


def test_twist_of_the_pedestal_is_the_azimuth_zero():
    made = spots(np.random.default_rng(4), 40)
    found = fit(START, made, free=("pedestal_twist_rad", "axis_1_zero_rad", "axis_2_zero_rad"))
    assert found.undetermined == (("pedestal_twist_rad", "axis_1_zero_rad"),)
    assert np.isfinite(found.estimate["axis_2_zero_rad"])


def test_a_parameter_without_effect_is_a_group_of_its_own():
    made = spots(np.random.default_rng(5), 40)
    found = fit(START, made, free=("axis_1_zero_rad", "worm_1_sin_rad"))
    assert found.undetermined == (("worm_1_sin_rad",),)


def test_all_at_one_posture_tells_two_things_only():
    made = spots(np.random.default_rng(6), 1)
    many = made.take(np.zeros(30, np.int64))
    found = fit(START, many, free="edwards-4")
    assert found.field.rank[0] == 2
    assert sorted(itertools.chain(*found.undetermined)) == sorted(PARAMETER_SETS["edwards-4"])


def test_radio_alone_does_not_know_the_receiver_plane_but_with_a_camera_does():
    rng = np.random.default_rng(7)
    free = (*PARAMETER_SETS["edwards-4"], "receiver_plane_up_rad", "receiver_plane_right_rad")
    leaning = TRUE.replace(receiver_plane_up_rad=5e-3, receiver_plane_right_rad=-8e-3)
    count = np.column_stack([rng.uniform(2.0, 4.5, 60), rng.uniform(0.2, 1.3, 60)])
    normal = posture(leaning, count, receiver_plane=True).normal_enu
    radio = Measurements.from_normals(count, normal_enu=normal, sigma_rad=2e-4, receiver_plane=True)
    base = TRUE.replace(axis_1_zero_rad=0.0, axis_2_zero_rad=0.0)
    alone = fit(base, radio, free=free, settings=EXACT)
    assert {"axis_2_zero_rad", "receiver_plane_up_rad"} in [set(group) for group in alone.undetermined]
    both = fit(base, join([radio, spots(rng, 10, noise=False)]), free=free, settings=EXACT)
    assert both.undetermined == ()
    assert both.estimate["receiver_plane_up_rad"] == pytest.approx(5e-3, abs=1e-6)
    assert both.estimate["receiver_plane_right_rad"] == pytest.approx(-8e-3, abs=1e-6)
    assert both.estimate["axis_2_zero_rad"] == pytest.approx(-0.01, abs=1e-6)


def test_a_drone_serves_as_well():
    rng = np.random.default_rng(8)
    point = TRUE.pivot_enu_m + 60.0 * geometry.enu_from_azimuth_elevation(
        rng.uniform(2.0, 4.0, 30), rng.uniform(0.5, 1.2, 30)
    )
    count = []
    for p in point:
        sun = geometry.unit(p - TRUE.pivot_enu_m)
        for _ in range(30):  # the source is near: its direction depends on where the centre comes to lie
            wanted = command(TRUE, sun_enu=sun, target_enu_m=TARGETS[0]).count
            sun = geometry.unit(p - posture(TRUE, wanted).centre_enu_m)
        count.append(wanted)
    made = Measurements.from_points(np.array(count), source_enu_m=point, target_enu_m=TARGETS[0])
    found = fit(START, made, free="malan", settings=EXACT)
    assert found.undetermined == ()
    assert found.estimate["location_east_m"] == pytest.approx(0.05, abs=1e-6)


def test_outliers_do_not_pull():
    made = spots(np.random.default_rng(9), 60)
    count = made.count.copy()
    count[::6] += 0.05
    bad = Measurements(count=count, row=made.row, unix_s=made.unix_s)
    robust, plain = (fit(START, bad, free="edwards-4", settings=s) for s in (FitSettings(), EXACT))
    good = np.arange(60) % 6 > 0
    assert np.median(robust.error_rad[good]) < 1e-3 < 3e-3 < np.median(plain.error_rad[good])


def test_same_optimum_as_nelder_mead():
    made = spots(np.random.default_rng(10), 30)
    names = PARAMETER_SETS["edwards-4"]
    found = fit(START, made, free=names, settings=EXACT)

    def cost(x):
        tried = START.replace(**{name: v * PARAMETERS[name] for name, v in zip(names, x, strict=True)})
        return 1e6 * np.sum((2.0 * np.sin(0.5 * normal_errors_rad(tried, made))) ** 2)

    best = minimize(cost, np.zeros(4), method="Nelder-Mead", options={"maxiter": 4000, "xatol": 1e-6, "fatol": 1e-12})
    assert best.success
    scale = np.array([PARAMETERS[name] for name in names])
    np.testing.assert_allclose(found.field.working[0], best.x * scale, atol=1e-3 * found.field.sigma[0].min())


def test_bounds_hold_and_priors_pull():
    made = spots(np.random.default_rng(11), 40)
    bounded = fit(START, made, free="edwards-4", settings=FitSettings(bounds={"axis_1_zero_rad": (-0.01, 0.01)}))
    assert bounded.estimate["axis_1_zero_rad"] == pytest.approx(0.01)
    one = made.take(slice(0, 1))
    priors = dict.fromkeys(PARAMETER_SETS["edwards-4"], (0.0, 1e-4))
    pulled = fit(START, one, free="edwards-4", settings=FitSettings(sigma_known=True, priors=priors))
    assert pulled.undetermined == ()
    assert max(pulled.sigma.values()) <= 1e-4 * (1 + 1e-6)


def test_leave_one_out_is_the_refit_without_it():
    made = spots(np.random.default_rng(12), 12)
    left_out = leave_one_out_rad(START, made, free="edwards-4")
    without = fit(START, made.take(np.arange(12) != 5), free="edwards-4")
    assert left_out[5] == pytest.approx(normal_errors_rad(without.mount, made)[5], rel=1e-6)


def test_errors_alone_are_those_of_the_refit_with_all_that_is_known_of_it():
    made = spots(np.random.default_rng(14), 21)
    masks = np.random.default_rng(15).random((6, 21)) < 0.7
    masks[3, 1:] = False
    masks[4] = False
    free = PARAMETER_SETS["edwards-4"]
    for settings in (with_priors(START, free), FitSettings()):
        errors, found = refit(START, made, masks, free, settings)
        np.testing.assert_array_equal(refit_errors_rad(START, made, masks, free, settings), errors)
        assert np.isnan(errors[4]).all() == (found.status[4] == FitStatus.TOO_FEW)


def test_scatter_is_the_median_of_what_takes_part():
    made = spots(np.random.default_rng(16), 9)
    p, k = (np.repeat(rows, 4, axis=0) for rows in stack_mounts([START]))
    use = np.ones((4, 9), np.bool_)
    use[1, 2], use[2] = False, False
    batch = FitBatch(
        k=k, count=np.repeat(made.count[None], 4, axis=0), row=np.repeat(made.row[None], 4, axis=0), use=use,
        index=columns_of(()), scale=scales_of(()), prior_weight=np.zeros(0),
    )  # fmt: skip
    norm = np.linalg.norm(batch.residual(p, slice(None))[0], axis=-1)
    wanted = [np.median(norm[row]) if row.any() else 0.0 for row in use]
    np.testing.assert_allclose(batch.scatter(p), np.array(wanted) / RAYLEIGH_MEDIAN, rtol=1e-12)


def test_splits_keep_what_they_say_apart():
    made = spots(np.random.default_rng(13), 50)
    random = random_splits(START, made, free="edwards-4", rng=np.random.default_rng(0), n_split=4)
    assert random.is_train.sum(axis=1).tolist() == [30] * 4
    one = fit(START, made.take(random.is_train[2]), free="edwards-4")
    test = normal_errors_rad(one.mount, made.take(~random.is_train[2]))
    assert random.test_median_rad[2] == pytest.approx(np.median(test), rel=1e-6)
    late = chronological_split(START, made, free="edwards-4")
    assert late.is_train[0].tolist() == [True] * 30 + [False] * 20
    with pytest.raises(InvalidInputError, match="free fewer"):
        chronological_split(START, made.take(slice(0, 5)), free="malan")


def test_rolling_refit_follows_a_drift():
    rng = np.random.default_rng(14)
    made = spots(rng, 60)
    count = made.count + np.column_stack([np.linspace(0.0, 0.02, 60), np.zeros(60)])
    moving = Measurements(count=count, row=made.row, unix_s=made.unix_s)
    rolled = rolling_refit(START, moving, free="edwards-4", window=15)
    fixed = chronological_split(START, moving, free="edwards-4", train_part=0.25)
    assert len(rolled.error_rad) == 45
    assert np.median(rolled.error_rad[-20:]) < 0.3 * np.nanmedian(fixed.error_rad[0, -20:])


def test_alarms_name_the_axis_the_place_and_the_size():
    made = spots(np.random.default_rng(15), 120)
    count = made.count.copy()
    count[70:, 1] += 6e-3
    count[20, 0] += 0.1
    found = fit(START, Measurements(count=count, row=made.row, unix_s=made.unix_s), free="malan")
    raised = alarms(found)
    shift = [a for a in raised if a.kind == "shift"]
    assert [(a.axis, a.first) for a in shift] == [(2, 70)]
    assert shift[0].size_rad == pytest.approx(6e-3, abs=1e-3)
    assert 20 in [a.first for a in raised if a.kind == "outlier" and a.axis == 1]
    assert alarms(fit(START, made, free="malan")) == ()


def test_slow_drift_is_an_alarm():
    made = spots(np.random.default_rng(16), 80)
    count = made.count + np.column_stack([np.linspace(-2e-3, 2e-3, 80), np.zeros(80)])
    found = fit(START, Measurements(count=count, row=made.row, unix_s=made.unix_s), free="edwards-4")
    total = [a for a in alarms(found, shift_rad=3e-3) if a.kind == "drift" and a.axis == 1]
    assert total
    assert total[0].size_rad == pytest.approx(4e-3, rel=0.3)


def test_next_posture_is_the_best_of_all():
    rng = np.random.default_rng(17)
    made = spots(rng, 6)
    found = fit(START, made, free="edwards-4", settings=EXACT)
    candidates = spots(rng, 25)
    design = next_postures(found, candidates, n_posture=3, criterion="parameters")
    scale = np.array([PARAMETERS[name] for name in found.free])
    traces = []
    for i in range(25):
        more = join([made, candidates.take(slice(i, i + 1))])
        again = fit(found.mount, more, free="edwards-4", settings=EXACT)
        traces.append(np.sum((again.field.sigma[0] / scale) ** 2))
    assert design.chosen[0] == np.argmin(traces)
    assert design.trace[1] == pytest.approx(min(traces), rel=0.02)
    assert np.all(np.diff(design.trace) < 0.0)


def test_prediction_knows_its_uncertainty_and_forecast_uses_it():
    rng = np.random.default_rng(18)
    found = fit(START, spots(rng, 40), free="edwards-4", settings=EXACT)
    ahead = predict(found, spots(rng, 20))
    assert np.all((ahead.sigma_rad > 2e-5) & (ahead.sigma_rad < 3e-4))
    site = Location(latitude_rad=0.6, longitude_rad=0.0)
    day = forecast(found, site=site, unix_s=1.71e9 + 3600.0 * np.arange(24), target_enu_m=TARGETS[0])
    up = day.sun.elevation_rad > 0.0
    assert 8 <= up.sum() <= 16
    assert np.isnan(day.commands.count[~up]).all()
    assert np.all(day.sigma_total_rad[up] > day.sigma_normal_rad[up])


def test_too_few_measurements():
    with pytest.raises(InvalidInputError, match="8 free parameters need 4 or more measurements, got 3"):
        fit(START, spots(np.random.default_rng(19), 3), free="malan")


def test_bad_rows_are_left_out_with_a_reason():
    made = spots(np.random.default_rng(20), 12)
    mount = Mount(pivot_enu_m=START.pivot_enu_m, actuators=(Actuator(limits_count=(-7.0, 7.0)), Actuator()))
    row, count = made.row.copy(), made.count.copy()
    row[1, 2] = -0.1
    row[2, 4] = np.nan
    count[3, 0] = 9.0
    found = fit(mount, Measurements(count=count, row=row, unix_s=made.unix_s), free="offsets")
    want = [RowStatus.SUN_BELOW_HORIZON, RowStatus.NOT_FINITE, RowStatus.BEYOND_LIMITS]
    assert found.row_status[1:4].tolist() == want
    assert found.used.sum() == 9
    with pytest.raises(InvalidInputError, match="1 sun below horizon"):
        fit(mount, Measurements(count=count, row=row, unix_s=made.unix_s).take(slice(1, 2)), free="offsets")


@pytest.mark.parametrize(
    ("east", "north", "message"),
    [(-1, -1, "from south"), (-1, 1, "counter-clockwise"), (1, -1, "from south and counter-clockwise")],
)
def test_another_azimuth_convention_is_recognised(east, north, message):
    made = spots(np.random.default_rng(21), 20)
    row = made.row * np.array([east, north, 1, 1, 1, 1, 1, 1, 1, 1.0])
    with pytest.raises(InvalidInputError, match=message):
        fit(START, Measurements(count=made.count, row=row, unix_s=made.unix_s), free="offsets")


def test_degrees_for_radians_are_recognised():
    made = spots(np.random.default_rng(22), 20)
    wrong = Measurements(count=np.degrees(made.count), row=made.row, unix_s=made.unix_s)
    with pytest.raises(InvalidInputError, match="radians"):
        fit(START, wrong, free="offsets")


def test_a_field_goes_on_past_a_heliostat_that_cannot_be_fitted():
    rng = np.random.default_rng(23)
    parts = [spots(rng, 20), spots(rng, 1), spots(rng, 30)]
    found = fit_many([START] * 3, parts, free="edwards-4")
    assert found.status.tolist() == [FitStatus.OK, FitStatus.TOO_FEW, FitStatus.OK]
    assert np.isnan(found.estimate[1]).all()
    assert np.isfinite(found.sigma[[0, 2]]).all()


@pytest.mark.parametrize(
    ("free", "settings", "message"),
    [
        ("all", {}, "no parameter set"),
        (("axis_1_zero_rad", "axis_1_zero_rad"), {}, "each once"),
        (("axis_3_zero_rad",), {}, "no mount parameter"),
        ("offsets", {"bounds": {"axis_1_zero_rad": (1.0, 0.0)}}, "ascending"),
        ("offsets", {"priors": {"axis_1_zero_rad": (0.0, 0.0)}}, "greater than zero"),
        ("offsets", {"huber": 0.0}, "huber"),
    ],
)
def test_mistakes_are_named(free, settings, message):
    with pytest.raises(InvalidInputError, match=message):
        fit(START, spots(np.random.default_rng(24), 5), free=free, settings=FitSettings(**settings))
