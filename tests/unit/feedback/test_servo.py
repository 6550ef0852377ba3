import dataclasses

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.feedback.servo import (
    PiLaw,
    ServoState,
    Stepper,
    _kernels,
    check_law,
    design_law,
    is_stable,
    margins,
    run_loop,
    sensitivity,
    servo_step,
)
from rfpose.feedback.servo.rules import EARTH_RADPS
from rfpose.feedback.structure import EDWARDS_MODE, StructureMode, deflect, plate_mode_hz

LINEAR = PiLaw(levels=0, range_rad=1.0, speed_radps=10.0)
STEP = Stepper().step_rad


def follow(state, target, *, law=LINEAR, stepper=None, n_step=1, **settings):
    stepper = stepper or Stepper()
    for i in range(n_step):
        servo_step(target(i), state.axis_rad, state, law=law, stepper=stepper, **settings)
    return state


def rest(n=2):
    return ServoState.at(np.zeros((n, 2)), Stepper())


@pytest.mark.parametrize(("stiff", "latency_s"), [(True, 0.4), (False, 0.0), (False, 2.7)])
def test_limits_of_latency_and_interval_are_where_time_series_turn(stiff, latency_s):
    mode = None if stiff else EDWARDS_MODE
    found = margins(LINEAR, mode, latency_s=latency_s)
    for change, settles in ((0.97, True), (1.03, False)):
        late = latency_s + found.latency_s * change
        run = run_loop(LINEAR, mode, command_rad=np.full((1, 4000), 1e-6), latency_s=late, force=True)
        late_error = np.abs(run.error_rad[0, -100:]).max()
        assert (late_error < 1e-7) == settles
        each = 1.0 + (found.interval_s - 1.0) * change
        assert is_stable(LINEAR, mode, interval_s=each, latency_s=latency_s) == settles


def test_a_loop_without_a_structure_is_not_compiled_for_again():
    still = np.zeros((1, 3))
    run_loop(LINEAR, EDWARDS_MODE, command_rad=still, latency_s=0.4)
    known = list(_kernels.loop_run.signatures)
    run_loop(LINEAR, None, command_rad=still, latency_s=0.4)
    assert _kernels.loop_run.signatures == known


def test_gain_margin_is_the_factor_to_instability():
    found = margins(LINEAR, EDWARDS_MODE, latency_s=1.0)
    for factor, stable in ((0.995, True), (1.005, False)):
        more = dataclasses.replace(
            LINEAR,
            gain_per_s=LINEAR.gain_per_s * found.gain * factor,
            integral_gain_per_s2=LINEAR.integral_gain_per_s2 * found.gain * factor,
        )
        assert is_stable(more, EDWARDS_MODE, interval_s=1.0, latency_s=1.0) == stable


@pytest.mark.parametrize("latency_s", [0.0, 1.0, 3.0])
def test_design_keeps_one_margin_exactly_and_the_other_amply(latency_s):
    law = design_law(EDWARDS_MODE, latency_s=latency_s, integral_ratio_per_s=0.03)
    found = check_law(law, EDWARDS_MODE, latency_s=latency_s, least_gain=1.499, least_phase_rad=np.deg2rad(29.9))
    assert min(found.gain / 1.5, found.phase_rad / np.deg2rad(30.0)) == pytest.approx(1.0, abs=0.01)


def test_unstable_gains_are_refused_by_name_unless_forced():
    wild = PiLaw(gain_per_s=0.5, integral_gain_per_s2=0.025)
    with pytest.raises(InvalidInputError, match=r"unstable: gain margin 0\.\d+ below 1\.50, phase margin"):
        check_law(wild, EDWARDS_MODE, latency_s=1.0)
    with pytest.raises(InvalidInputError, match="force"):
        run_loop(wild, EDWARDS_MODE, command_rad=np.zeros((1, 3)), latency_s=1.0)
    assert not check_law(wild, EDWARDS_MODE, latency_s=1.0, force=True).stable
    with pytest.raises(InvalidInputError, match="integral_ratio_per_s"):
        design_law(EDWARDS_MODE, integral_ratio_per_s=2.0, latency_s=3.0)


def test_sensitivity_is_what_a_loop_leaves_of_a_swing():
    frequency, n = 0.02, 4000
    swing = 1e-4 * np.sin(2.0 * np.pi * frequency * np.arange(n))[None]
    run = run_loop(LINEAR, EDWARDS_MODE, command_rad=np.zeros((1, n)), disturbance_rad=swing)
    left = np.std(run.error_rad[0, n // 2 :]) / np.std(swing[0, n // 2 :])
    assert left == pytest.approx(sensitivity(LINEAR, EDWARDS_MODE, frequency)[0], rel=1e-3)


def test_integral_follows_the_sun_without_lag_and_through_lost_frames():
    law = PiLaw(levels=0)
    command = EARTH_RADPS * np.arange(1200.0)[None]
    assert np.abs(run_loop(law, EDWARDS_MODE, command_rad=command).error_rad[0, 600:]).max() < 1e-6
    state = ServoState.at([[0.0, 0.0]], Stepper(steps_per_turn=4.8e6))
    fine = Stepper(steps_per_turn=4.8e6)
    for i in range(1000):
        lost = 700 <= i < 760
        want = np.full((1, 2), np.nan if lost else EARTH_RADPS * (i + 1))
        servo_step(want, state.axis_rad, state, law=law, stepper=fine)
        if i > 690:
            assert np.abs(state.axis_rad - EARTH_RADPS * (i + 1)).max() < 4.0 * fine.step_rad + EARTH_RADPS


def test_no_winding_up_after_a_long_slew():
    law = PiLaw(levels=0, gain_per_s=0.2, integral_gain_per_s2=0.01, range_rad=1.0)
    run = run_loop(law, None, command_rad=np.full((1, 2000), 0.3))
    assert run.angle_rad.max() < 0.3 * 1.01
    assert np.abs(run.error_rad[0, -1]) < 1e-6
    assert np.abs(run.speed_radps).max() <= law.speed_radps * (1.0 + 1e-12)


def test_saturated_error_is_full_speed_and_speeds_are_whole_steps():
    law = PiLaw(speed_step_radps=2e-5)
    run = run_loop(law, EDWARDS_MODE, command_rad=np.full((1, 40), 0.02))
    assert run.speed_radps[0, :10] == pytest.approx(1e-3)
    steps = run.speed_radps / 2e-5
    assert np.abs(steps - np.rint(steps)).max() < 1e-6


def test_dead_band_leaves_small_errors_alone():
    law = PiLaw(levels=0, dead_band_rad=1e-3)
    assert np.all(run_loop(law, None, command_rad=np.full((1, 50), 0.9e-3)).speed_radps == 0.0)
    assert np.any(run_loop(law, None, command_rad=np.full((1, 50), 1.1e-3)).speed_radps != 0.0)


def test_motor_goes_in_whole_steps_no_faster_than_it_can():
    state = rest()
    stepper = Stepper(microsteps=8, speed_radps=2.5e-3)
    before = state.motor_rad.copy()
    for _ in range(30):
        servo_step(np.full((2, 2), 0.02), state.motor_rad, state, law=LINEAR, stepper=stepper)
        move = state.motor_rad - before
        before = state.motor_rad.copy()
        assert np.abs(move).max() <= 2.5e-3
        assert np.rint(move / stepper.step_rad) * stepper.step_rad == pytest.approx(move, abs=1e-12)
    assert np.any(move == 0.0) or np.abs(before - 0.02).max() < 2.0 * stepper.step_rad


def test_backlash_and_stiction_hold_the_axis():
    loose = Stepper(backlash_rad=10.0 * STEP)
    state = follow(rest(), lambda i: np.full((2, 2), 0.02), stepper=loose, n_step=200)
    gap = state.motor_rad - state.axis_rad
    assert np.abs(gap).max() <= 5.0 * STEP + 1e-12
    sticky = Stepper(stiction_rad=20.0 * STEP)
    law = dataclasses.replace(LINEAR, integral_gain_per_s2=0.0)
    state = rest()
    for _ in range(8):
        servo_step(np.full((2, 2), 15.0 * STEP), state.motor_rad, state, law=law, stepper=sticky)
    assert np.all(state.axis_rad == 0.0)
    assert np.all(state.motor_rad > 5.0 * STEP)


def test_step_and_wait_spares_starts_and_stays_within_its_band():
    band = 8.0 * STEP
    course = lambda i: np.full((1, 2), EARTH_RADPS * (i + 1))  # noqa: E731
    fast = dataclasses.replace(LINEAR, gain_per_s=0.5, integral_gain_per_s2=0.0)
    states = {}
    for name, stepper in {"always": Stepper(), "waits": Stepper(dead_band_rad=band, lead_rad=band)}.items():
        state = ServoState.at([[0.0, 0.0]], stepper)
        for i in range(1000):
            servo_step(course(i), state.axes[..., 1], state, law=fast, stepper=stepper)
        states[name] = state
        assert np.abs(state.motor_rad - state.axes[..., 1]).max() <= (1.5 * STEP if name == "always" else band + STEP)
    starts = {name: state.counts[0, 0, 1] for name, state in states.items()}
    assert starts["waits"] < starts["always"] / 8.0
    assert states["waits"].counts[0, 0, 0] == pytest.approx(states["always"].counts[0, 0, 0], abs=20)


def test_counts_of_the_kernel_are_those_of_the_path():
    state = rest(1)
    rng = np.random.default_rng(3)
    path = [state.motor_rad.copy()]
    for i in range(400):
        want = 3e-3 * np.sin(0.05 * i) + 3e-4 * rng.standard_normal((1, 2))
        servo_step(want, state.axis_rad, state, law=PiLaw(), stepper=Stepper())
        path.append(state.motor_rad.copy())
    step = np.rint(np.diff(np.stack(path, axis=-1), axis=-1) / STEP)[0]
    moves = step != 0.0
    steps, starts, reversals, busy = np.moveaxis(state.counts[0], -1, 0)
    assert np.array_equal(np.rint(steps), np.abs(step).sum(axis=-1))
    assert np.array_equal(starts, moves[:, 0] + np.sum(moves[:, 1:] & ~moves[:, :-1], axis=-1))
    assert np.array_equal(reversals, [np.sum(np.diff(np.sign(row[row != 0.0])) != 0.0) for row in step])
    assert np.array_equal(busy, moves.sum(axis=-1))


def test_a_field_is_its_axes_one_by_one():
    rng = np.random.default_rng(4)
    want = 4e-3 * rng.standard_normal((60, 5, 2))
    field = rest(5)
    alone = [rest(1) for _ in range(5)]
    for row in want:
        servo_step(row, field.axis_rad, field, law=PiLaw(), stepper=Stepper(backlash_rad=2e-4))
        for i, each in enumerate(alone):
            servo_step(row[i : i + 1], each.axis_rad, each, law=PiLaw(), stepper=Stepper(backlash_rad=2e-4))
    assert np.array_equal(field.axes, np.concatenate([each.axes for each in alone]))


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: PiLaw(levels=31), "even"),
        (lambda: PiLaw(gain_per_s=0.0), "gain_per_s"),
        (lambda: PiLaw(integral_gain_per_s2=-1.0), "integral_gain_per_s2"),
        (lambda: Stepper(backlash_rad=-1.0), "backlash_rad"),
        (lambda: Stepper(dead_band_rad=1e-4, lead_rad=2e-4), "hunt"),
        (lambda: Stepper(speed_radps=1e-6).numbers(1.0), "one step"),
        (lambda: StructureMode(damping=1.2), "damping"),
        (lambda: margins(PiLaw(), None, latency_s=-1.0), "latency_s"),
        (lambda: follow(rest(), lambda i: np.zeros((3, 2))), "command_rad"),
    ],
)
def test_bad_settings_are_named(make, word):
    with pytest.raises(InvalidInputError, match=word):
        make()


def test_structure_answers_as_its_frequency_response():
    mode = StructureMode(natural_hz=0.1, damping=0.1)
    for frequency in (0.02, 0.1, 0.2):
        load = np.sin(2.0 * np.pi * frequency * 0.25 * np.arange(8000))
        out = deflect(load, mode, interval_s=0.25)
        assert np.std(out[4000:]) / np.std(load[4000:]) == pytest.approx(mode.gain(frequency), rel=0.02)
    assert deflect(np.full(50, 2e-3), mode, interval_s=1.0) == pytest.approx(2e-3)


def test_frequency_of_a_flapping_dish():
    found = plate_mode_hz(0.6, density_kg_m3=7800.0, thickness_m=5e-3, deflection_1mps_rad=1e-4, diameter_m=5.0)
    assert (2.0 * np.pi * found) ** 2 == pytest.approx(0.6 / (7800.0 * 5e-3 * 1e-4 * 2.5))
