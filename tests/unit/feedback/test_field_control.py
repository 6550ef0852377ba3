"""A field's control, stepped as a simulation steps it."""

import numpy as np
import pytest

from rfpose.errors import InvalidInputError
from rfpose.feedback.fieldcontrol.bus import BusSettings
from rfpose.feedback.fieldcontrol.control import ControlledField, FieldSettings
from rfpose.feedback.fieldcontrol.local import spiral_cells
from rfpose.feedback.fieldcontrol.modes import Mode, ModeEvent
from rfpose.feedback.fieldcontrol.motion import move_axes

SUN = np.array([0.1, 0.5, 0.8])
RECEIVER = np.array([0.0, 0.0, 60.0])
TARGET = np.array([0.0, 0.0, 45.0])


class Rig:
    """A field whose axes go where they are told at a tenth of a radian a second."""

    def __init__(self, n=40, *, mode=Mode.STOW, seed=1, settings=None, **bus):
        rng = np.random.default_rng(seed)
        pivot = np.stack([np.linspace(-90.0, 90.0, n), np.full(n, -80.0), np.full(n, 2.0)], axis=1)
        self.control = ControlledField(
            aim_enu_m=RECEIVER,
            pivot_enu_m=pivot,
            calibration_enu_m=TARGET,
            settings=settings,
            bus=BusSettings(**bus),
            mode=mode,
            rng=rng,
        )
        self.aim_axis = np.stack([rng.uniform(-2.0, 2.0, n), rng.uniform(0.3, 1.2, n)], axis=1)
        self.axis = np.zeros((n, 2)) if mode in (Mode.STOW, Mode.STOWING) else self.aim_axis.copy()
        self.time_s = 0.0
        self.history = []
        self.orders = None

    def run(self, seconds, *, step_s=0.5, **inputs):
        for _ in range(round(seconds / step_s)):
            self.orders = self.control.step(
                self.time_s, axis_rad=self.axis, aim_axis_rad=self.aim_axis, sun_enu=SUN, **inputs
            )
            target = np.where(np.isnan(self.orders.target_axis_rad), self.aim_axis, self.orders.target_axis_rad)
            before = self.axis
            self.axis = move_axes(before, target, step_s, rate_rad_s=0.1)
            self.history.append((self.time_s, self.orders.mode, before, self.axis))
            self.time_s += step_s
        return self.orders

    def modes(self):
        return {Mode(m).name for m in self.control.mode}


def test_leaves_stow_azimuth_first_and_returns_elevation_first():
    rig = Rig()
    rig.run(5)
    assert rig.control.command(ModeEvent.APPROACH).accepted.all()
    rig.run(60)
    assert rig.modes() == {"TRACK"}
    np.testing.assert_allclose(rig.axis, rig.aim_axis, atol=2e-3)
    rig.control.command(ModeEvent.STOW)
    rig.run(60)
    assert rig.modes() == {"STOW"}
    np.testing.assert_allclose(rig.axis, 0.0, atol=1e-12)
    n_moved = 0
    for _, mode, before, after in rig.history:
        moved = np.abs(after - before) > 1e-6
        leaving, stowing = mode == Mode.APPROACH, mode == Mode.STOWING
        azimuth_there = np.abs(before[:, 0] - rig.aim_axis[:, 0]) <= 2e-3
        assert not np.any(leaving & moved[:, 1] & ~azimuth_there)
        assert not np.any(stowing & moved[:, 0] & (np.abs(before[:, 1]) > 2e-3))
        n_moved += int((moved[:, 0] & stowing).sum() + (moved[:, 1] & leaving).sum())
    assert n_moved > 100


def test_axes_move_no_faster_than_their_rate_and_no_further_than_their_target():
    axis = np.array([[0.0, 1.0], [0.0, 1.0], [np.nan, 0.5]])
    target = np.array([[1.0, 0.9], [-0.05, np.nan], [0.3, 0.5]])
    moved = move_axes(axis, target, 2.0, rate_rad_s=0.1)
    np.testing.assert_allclose(moved, [[0.2, 0.9], [-0.05, 1.0], [np.nan, 0.5]])
    # 270 degrees in two minutes, the default
    np.testing.assert_allclose(move_axes([[0.0, 0.0]], [[9.0, -9.0]], 120.0), np.radians([[270.0, -270.0]]))


def test_stow_face_up_is_reached_upwards():
    rig = Rig(mode=Mode.TRACK, settings=FieldSettings(stow_axis_rad=(0.0, np.pi / 2)))
    rig.run(5)
    rig.control.emergency()
    rig.run(2)
    assert np.all(rig.axis[:, 1] > rig.aim_axis[:, 1])
    rig.run(120)
    np.testing.assert_allclose(rig.axis, np.broadcast_to([0.0, np.pi / 2], rig.axis.shape), atol=1e-12)


def test_emergency_drops_elevation_alone_then_stows():
    rig = Rig(mode=Mode.TRACK)
    rig.run(5)
    rig.control.emergency("receiver too hot")
    assert rig.control.alarms == ("receiver too hot",)
    rig.run(5)
    assert rig.modes() == {"EMERGENCY"}
    np.testing.assert_allclose(rig.axis[:, 0], rig.aim_axis[:, 0])
    np.testing.assert_allclose(rig.axis[:, 1], rig.aim_axis[:, 1] - 0.15)
    refused = rig.control.command(ModeEvent.REFOCUS)
    assert not refused.accepted.any()
    assert "receiver too hot since 4.5 s; only stow is possible" in refused.reasons[0]
    rig.run(90)
    assert rig.modes() == {"STOW"}
    rig.control.release()
    assert rig.control.command(ModeEvent.APPROACH).accepted.all()


def test_a_silent_cluster_helps_itself_after_the_watchdogs_time():
    rig = Rig(n=96, mode=Mode.TRACK, lost=0.0)
    rig.run(11)  # the third round ends before 9.1 s
    rig.control.fail_cluster(1)
    mine = rig.control.cluster == 1
    rig.run(9)  # 12 s after the last message to the first heliostat, 8.04 s
    assert np.all(rig.control.mode == Mode.TRACK)
    rig.run(4)
    np.testing.assert_array_equal(rig.control.mode == Mode.EMERGENCY, mine)
    assert np.all(rig.control.report_age_s[mine] > 12.0)
    assert np.all(rig.control.report_age_s[~mine] < 6.0)
    assert np.all(rig.orders.sun_age_s[mine] > 12.0)
    rig.run(100)
    np.testing.assert_array_equal(rig.control.mode == Mode.STOW, mine)
    rig.control.repair_cluster(1)
    rig.run(8)
    np.testing.assert_array_equal(rig.control.reported_mode == Mode.STOW, mine)
    assert rig.control.command(ModeEvent.APPROACH, mine).accepted[mine].all()


def test_what_a_dying_controller_was_about_to_say_is_not_heard():
    rig = Rig(n=64, mode=Mode.TRACK)
    rig.run(6)
    rig.control.command(ModeEvent.POINT)
    rig.control.emergency()
    rig.control.fail_cluster(1)
    mine = rig.control.cluster == 1
    rig.run(2.5)
    assert np.all(rig.control.mode[mine] == Mode.TRACK)
    assert np.all(rig.control.mode[~mine] == Mode.EMERGENCY)
    again = Rig(n=64, mode=Mode.TRACK)
    again.run(4.5)  # the round that began at 4 s is under way
    again.control.fail_cluster(1)
    again.run(1)
    assert np.all(again.control.report_age_s[mine] > 3.9)
    assert np.median(again.control.report_age_s[~mine]) < 2.0


def test_without_the_centre_clusters_go_on_then_stow():
    rig = Rig(mode=Mode.TRACK)
    rig.run(5)
    rig.control.fail_centre()
    rig.run(29, wind_mps=20.0)
    assert rig.modes() == {"TRACK"}
    assert np.all(rig.orders.sun_age_s < 5.0)
    assert "the centre is dead since 4.5 s" in rig.control.command(ModeEvent.DEFOCUS).reasons[0]
    with pytest.raises(InvalidInputError, match=r"the centre is dead since 4.5 s and orders nothing"):
        rig.control.emergency()
    rig.run(3)
    assert rig.modes() == {"EMERGENCY"}
    rig.run(90)
    assert rig.modes() == {"STOW"}
    rig.control.repair_centre()
    assert rig.control.alarms == ()
    rig.run(1, wind_mps=20.0)
    assert rig.control.alarms == ("strong wind",)


def test_wind_of_ten_metres_a_second_stows_and_calm_releases():
    rig = Rig(mode=Mode.TRACK, settings=FieldSettings(wind_release_s=30.0))
    rig.run(5, wind_mps=9.99)
    assert rig.control.alarms == ()
    rig.run(2, wind_mps=10.0)
    assert rig.control.alarms == ("strong wind",)
    assert rig.modes() == {"STOWING"}
    rig.run(60, wind_mps=8.5)
    assert rig.modes() == {"STOW"}
    assert "strong wind" in rig.control.command(ModeEvent.APPROACH).reasons[0]
    rig.run(29, wind_mps=7.0)
    assert rig.control.alarms == ("strong wind",)
    rig.run(3, wind_mps=7.0)
    assert rig.control.alarms == ()
    assert rig.modes() == {"STOW"}


def test_unknown_wind_stows_after_a_gap():
    rig = Rig(mode=Mode.TRACK)
    rig.run(60, wind_mps=np.nan)
    assert rig.modes() == {"TRACK"}
    rig.run(2, wind_mps=np.nan)
    assert rig.control.alarms == ("wind unknown",)
    assert rig.modes() == {"STOWING"}
    rig.run(1, wind_mps=2.0)
    assert rig.control.alarms == ()


def test_night_stows_and_refuses():
    rig = Rig(mode=Mode.TRACK)
    rig.run(5)
    for _ in range(200):
        orders = rig.control.step(
            rig.time_s, axis_rad=rig.axis, aim_axis_rad=rig.aim_axis, sun_enu=np.array([1.0, 0.0, -0.01])
        )
        target = np.where(np.isnan(orders.target_axis_rad), rig.aim_axis, orders.target_axis_rad)
        rig.axis = move_axes(rig.axis, target, 0.5, rate_rad_s=0.1)
        rig.time_s += 0.5
    assert rig.modes() == {"STOW"}
    assert "sun below the horizon" in rig.control.command(ModeEvent.APPROACH).reasons[0]


def test_contradicting_orders_are_refused_and_safer_ones_replace():
    rig = Rig(mode=Mode.TRACK)
    rig.run(5)
    control = rig.control
    assert control.command(ModeEvent.POINT, [3]).accepted[3]
    assert control.command(ModeEvent.POINT, [3]).accepted[3]  # the same again is no contradiction
    answer = control.command(ModeEvent.HOLD, [3])
    assert answer.reasons == {3: "HOLD refused: contradicts POINT, which is on its way"}
    assert control.command(ModeEvent.DEFOCUS, [3]).accepted[3]
    assert control.command(ModeEvent.STOW, [3]).accepted[3]
    assert "contradicts STOW" in control.command(ModeEvent.DEFOCUS, [3]).reasons[3]
    assert np.flatnonzero(control.waiting).tolist() == [3]
    rig.run(8)
    assert np.flatnonzero(control.mode == Mode.STOWING).tolist() == [3]
    assert not control.waiting.any()


def test_modes_refuse_what_does_not_fit():
    rig = Rig(mode=Mode.TRACK)
    answer = rig.control.command(ModeEvent.APPROACH, [1, 2])
    assert set(answer.reasons) == {1, 2}
    assert not answer.accepted.any()
    assert answer.reasons[1] == "APPROACH refused: it tracks its aim already"


def test_heliostat_refuses_what_the_centre_could_not_know():
    rig = Rig(mode=Mode.TRACK)
    rig.run(4)
    rig.control.command(ModeEvent.POINT, [0])
    rig.control.power_off([0])
    rig.control.power_on([0])
    rig.run(5)
    assert rig.control.mode[0] == Mode.IDLE
    assert not rig.control.waiting[0]


def test_one_place_on_the_calibration_target():
    rig = Rig(mode=Mode.TRACK)
    rig.run(5)
    answer = rig.control.command(ModeEvent.CALIBRATE, [4, 9])
    assert np.flatnonzero(answer.accepted).tolist() == [4]
    assert answer.reasons == {9: "CALIBRATE refused: the calibration target is taken"}
    orders = rig.run(8)
    assert orders.mode[4] == Mode.CALIBRATE
    np.testing.assert_allclose(orders.aim_enu_m[4], TARGET)
    assert "is taken" in rig.control.command(ModeEvent.CALIBRATE, [9]).reasons[9]
    assert rig.control.command(ModeEvent.TRACK, [4]).accepted[4]
    rig.run(8)
    assert rig.control.command(ModeEvent.CALIBRATE, [9]).accepted[9]


def test_no_calibration_target_no_calibration():
    control = ControlledField(
        aim_enu_m=RECEIVER, pivot_enu_m=np.zeros((2, 3)), mode=Mode.TRACK, rng=np.random.default_rng(0)
    )
    assert "no calibration target" in control.command(ModeEvent.CALIBRATE).reasons[1]


def _searching(settings):
    rig = Rig(mode=Mode.TRACK, settings=settings)
    rig.run(5)
    rig.control.command(ModeEvent.CALIBRATE, [0])
    rig.run(8)
    rig.control.command(ModeEvent.SEARCH, [0])
    while rig.control.mode[0] != Mode.SEARCH:
        rig.run(0.5)
    return rig


def test_search_goes_round_the_target_until_it_is_found():
    rig = _searching(FieldSettings(search_step_m=0.5, search_dwell_s=2.0))
    aims = []
    for _ in range(9):
        aims.append(rig.orders.aim_enu_m[0] - TARGET)
        rig.run(2)
    way = -rig.control._heliostats._right_enu[0]
    across = np.array(aims) @ -way
    up = np.array(aims)[:, 2]
    got = np.round(np.stack([across, up], axis=1) / 0.5).astype(int)
    assert {tuple(cell) for cell in got} == {(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    assert tuple(got[0]) == (0, 0)
    found = np.zeros(40, np.bool_)
    found[0] = True
    rig.run(0.5, found=found)
    assert rig.control.mode[0] == Mode.CALIBRATE


def test_search_gives_up_beside_the_receiver():
    rig = _searching(FieldSettings(search_dwell_s=1.0, search_cells=5))
    orders = rig.run(6)
    assert rig.control.mode[0] == Mode.DEFOCUS
    aside = orders.aim_enu_m[0] - RECEIVER
    assert np.linalg.norm(aside) == pytest.approx(15.0)
    assert aside[2] == 0.0


@pytest.mark.parametrize("n", [1, 9, 25, 49])
def test_spiral_fills_squares_without_a_gap(n):
    cells = spiral_cells(n)
    half = int(np.sqrt(n)) // 2
    whole = {(i, j) for i in range(-half, half + 1) for j in range(-half, half + 1)}
    assert {tuple(cell) for cell in cells} == whole
    assert np.all(np.abs(np.diff(cells, axis=0)).sum(axis=1) == 1)


def test_lost_feedback_points_and_back_tracks_unless_ordered():
    rig = Rig(mode=Mode.TRACK)
    valid = np.ones(40, np.bool_)
    valid[[2, 3]] = False
    rig.run(1, feedback_valid=valid)
    assert np.flatnonzero(rig.control.mode == Mode.POINT).tolist() == [2, 3]
    rig.run(1)
    assert rig.modes() == {"TRACK"}
    rig.control.command(ModeEvent.POINT, [5])
    rig.run(10)
    assert np.flatnonzero(rig.control.mode == Mode.POINT).tolist() == [5]
    rig.control.command(ModeEvent.TRACK, [5])
    rig.run(10)
    assert rig.modes() == {"TRACK"}


def test_power_loss_keeps_the_counts_and_nothing_moves():
    rig = Rig(mode=Mode.TRACK)
    rig.run(5)
    off = np.arange(40) < 10
    at = rig.axis.copy()
    rig.control.power_off(off)
    rig.aim_axis = rig.aim_axis + 0.05
    orders = rig.run(20)
    np.testing.assert_array_equal(rig.control.mode == Mode.POWER_LOSS, off)
    np.testing.assert_allclose(orders.target_axis_rad[off], at[off])
    rig.control.power_on(off)
    rig.run(5)
    np.testing.assert_array_equal(rig.control.mode == Mode.IDLE, off)
    np.testing.assert_array_equal(rig.control.reported_mode == Mode.IDLE, off)
    rig.control.command(ModeEvent.STOW, off)
    rig.run(60)
    np.testing.assert_array_equal(rig.control.mode == Mode.STOW, off)


def test_what_is_on_the_wire_is_not_heard_without_power():
    rig = Rig(mode=Mode.TRACK)
    rig.run(6)
    rig.control.emergency()
    rig.control.power_off([3])
    rig.control.power_on([3])
    rig.run(1.5)
    assert rig.control.mode[3] == Mode.IDLE
    assert np.all(np.delete(rig.control.mode, 3) == Mode.EMERGENCY)
    rig.run(4)  # asked in the next round
    assert rig.modes() == {"EMERGENCY"}


def test_without_counts_a_heliostat_waits_to_be_zeroed():
    rig = Rig(mode=Mode.TRACK)
    rig.run(5)
    rig.control.power_off([7])
    rig.control.power_on([7], counts_kept=False)
    rig.run(6)
    assert rig.control.mode[7] == Mode.FAULT
    assert "zero them first" in rig.control.command(ModeEvent.STOW, [7]).reasons[7]
    rig.control.emergency()
    at = rig.axis[7].copy()
    rig.run(60)
    np.testing.assert_allclose(rig.axis[7], at)
    assert rig.control.command(ModeEvent.ZERO_COUNTS, [7]).accepted[7]
    rig.run(6)
    assert rig.control.command(ModeEvent.STOW, [7]).accepted[7]
    rig.run(60)
    assert rig.modes() == {"STOW"}


def test_orders_are_repeated_until_everyone_has_them():
    rig = Rig(n=320, mode=Mode.TRACK, lost=0.4, settings=FieldSettings(watchdog_intervals=50.0))
    rig.run(2)
    rig.control.command(ModeEvent.DEFOCUS)
    rig.run(4)
    some = np.mean(rig.control.mode == Mode.DEFOCUS)
    assert 0.3 < some < 0.9
    rig.run(80)
    assert rig.modes() == {"DEFOCUS"}
    assert not rig.control.waiting.any()


def test_a_repeated_order_is_obeyed_once():
    """The answer is lost, the centre repeats REFOCUS; the heliostat tracks by then and must not refuse it."""
    rig = Rig(n=320, mode=Mode.DEFOCUS, lost=0.4, settings=FieldSettings(watchdog_intervals=50.0))
    rig.run(2)
    rig.control.command(ModeEvent.REFOCUS)
    refused = 0
    for _ in range(60):
        refused += int((rig.run(1, step_s=1.0).refused >= 0).sum())
    assert rig.modes() == {"TRACK"}
    assert refused == 0


def test_sun_is_heard_to_a_thousandth_of_a_degree_and_ages():
    rig = Rig(mode=Mode.TRACK)
    orders = rig.run(3.5)
    error = np.linalg.norm(orders.sun_enu - SUN / np.linalg.norm(SUN), axis=1)
    assert 0.0 < error.max() < np.radians(0.75e-3)
    np.testing.assert_allclose(orders.sun_age_s, 3.0)


def test_forged_suns_are_heard_and_few_of_them_believed():
    def wrong(jump_rad):
        settings = FieldSettings(sun_jump_rad=jump_rad)
        rig = Rig(n=3200, mode=Mode.TRACK, bit_error_rate=5e-3, settings=settings)
        sun, count = SUN / np.linalg.norm(SUN), 0
        for _ in range(25):
            rig.run(4, step_s=4.0)
            count += int((np.linalg.norm(rig.orders.sun_enu - sun, axis=1) > 0.02).sum())
        return count

    believed_all, believed = wrong(10.0), wrong(5e-3)
    assert believed_all > 100
    assert believed < 0.5 * believed_all


def test_sun_angles_far_from_fresh_ones_are_not_believed():
    rig = Rig(n=4, mode=Mode.TRACK)
    local = rig.control._heliostats
    local.sun_enu[:3], local.sun_s[:3] = SUN / np.linalg.norm(SUN), 100.0
    said = local.sun_enu[:1] + np.array([[0.0, 0.004, 0.0]])
    local.believe_sun(np.array([0]), said, 104.0, fresh_s=12.0)  # as near as the sun may be
    local.believe_sun(np.array([1]), said + 0.1, 104.0, fresh_s=12.0)  # too far
    local.believe_sun(np.array([2]), said + 0.1, 113.0, fresh_s=12.0)  # too far from what is too old
    local.believe_sun(np.array([3]), said + 0.1, 104.0, fresh_s=12.0)  # nothing heard before
    np.testing.assert_array_equal(local.sun_s, [104.0, 100.0, 113.0, 104.0])


def test_sixteen_bit_reports():
    # Malan, §3.4.2: sixteen bits for a turn are 0.096 mrad.
    rig = Rig(mode=Mode.TRACK)
    rig.run(5)
    error = np.abs(rig.control.reported_axis_rad - rig.axis)
    assert 2e-5 < error.max() <= 0.5 * 9.6e-5
    assert rig.control.reported_axis_rad.shape == (40, 2)


def test_an_aim_out_of_reach_is_said_and_waited_for():
    rig = Rig()
    rig.aim_axis[6] = np.nan
    rig.run(2)
    rig.control.command(ModeEvent.APPROACH)
    orders = rig.run(60)
    assert np.flatnonzero(orders.unreachable).tolist() == [6]
    assert orders.mode[6] == Mode.APPROACH
    np.testing.assert_allclose(rig.axis[6], 0.0)
    assert np.all(np.delete(orders.mode, 6) == Mode.TRACK)


def test_a_field_put_away_and_taken_up_goes_on_the_same():
    bus = {"lost": 0.2, "bit_error_rate": 1e-3, "late": 0.1}
    whole, begun, resumed = (Rig(n=100, mode=Mode.TRACK, seed=5, **bus) for _ in range(3))

    def first_half(rig):
        rig.run(20)
        rig.control.fail_cluster(1)
        rig.control.command(ModeEvent.DEFOCUS, np.arange(0, 100, 7))
        rig.run(7, wind_mps=11.0)

    first_half(whole)
    first_half(begun)
    resumed.control.restore(begun.control.state())
    resumed.axis, resumed.time_s = begun.axis, begun.time_s
    for rig in (whole, resumed):
        rig.run(60)
    for name in ("mode", "target_axis_rad", "aim_enu_m", "sun_enu", "sun_age_s", "alarms"):
        np.testing.assert_array_equal(getattr(whole.orders, name), getattr(resumed.orders, name))
    assert whole.control.state()["centre"].tobytes() == resumed.control.state()["centre"].tobytes()


def test_state_of_another_field_is_refused():
    with pytest.raises(InvalidInputError, match="does not fit this field"):
        Rig(n=10).control.restore(Rig(n=11).control.state())


def _step(control, **changes):
    n = control.n_heliostat
    inputs = {"axis_rad": np.zeros((n, 2)), "aim_axis_rad": np.zeros((n, 2)), "sun_enu": SUN, **changes}
    return control.step(inputs.pop("time_s", 1.0), **inputs)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda c: _step(c, time_s=-1.0), "`time_s` must not go back, got -1"),
        (lambda c: _step(c, wind_mps=-3.0), "`wind_mps` must not be negative"),
        (lambda c: _step(c, axis_rad=np.zeros((3, 2))), r"`axis_rad` must have shape \(40, 2\)"),
        (lambda c: _step(c, sun_enu=[np.nan, 0, 1]), "`sun_enu` must be finite"),
        (lambda c: c.command(ModeEvent.ARRIVED), "`command` must be one of"),
        (lambda c: c.command(ModeEvent.STOW, [40]), "`heliostats` must be indices below 40"),
        (lambda c: c.command(ModeEvent.STOW, [True, False]), "`heliostats` must be a mask of 40"),
        (lambda c: c.fail_cluster(2), "`cluster` must be 0 … 1, got 2"),
        (lambda c: c.emergency("strong wind"), "which come and go by themselves"),
    ],
)
def test_wrong_calls_say_what_is_wrong(call, says):
    with pytest.raises(InvalidInputError, match=says):
        call(Rig().control)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"pivot_enu_m": np.zeros((0, 3))}, "at least one heliostat"),
        ({"aim_enu_m": np.zeros((3, 3))}, "`aim_enu_m` must have shape"),
        ({"mode": [0, 1, 2]}, "`mode` must be one `Mode`"),
        ({"mode": 77}, "`mode` must be one `Mode`"),
    ],
)
def test_wrong_fields_say_what_is_wrong(change, says):
    given = {"aim_enu_m": RECEIVER, "pivot_enu_m": np.zeros((2, 3)), "rng": np.random.default_rng(0), **change}
    with pytest.raises(InvalidInputError, match=says):
        ControlledField(**given)


@pytest.mark.parametrize(
    "change",
    [
        {"emergency_hold_s": -1.0},
        {"watchdog_intervals": 0.0},
        {"wind_release_mps": 12.0},
        {"stow_axis_rad": (0.0, 0.0, 0.0)},
    ],
)
def test_wrong_settings_are_refused(change):
    with pytest.raises(InvalidInputError, match=next(iter(change))):
        FieldSettings(**change)
