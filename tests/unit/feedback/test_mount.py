"""The mount: directions a person can check, the way back, the edges."""

import numpy as np
import pytest

from rfpose import geometry
from rfpose.errors import InvalidInputError
from rfpose.feedback.mount import Actuator, CommandStatus, Mount, command, mount_frame_from_axis, posture
from rfpose.feedback.optics import reflect, target_offset_m

PLAIN = Mount(pivot_enu_m=np.array([10.0, 50.0, 3.0]))
TARGET = np.array([0.0, 0.0, 60.0])


def sun_at(azimuth_deg, elevation_deg):
    return geometry.enu_from_azimuth_elevation(np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg))


def tilted():
    return PLAIN.replace(
        pedestal_tilt_north_rad=0.01, pedestal_tilt_east_rad=-0.02, pedestal_twist_rad=0.03, axis_1_zero_rad=0.1,
        axis_2_zero_rad=-0.05, nonorthogonality_rad=0.01, canting_right_rad=0.005, arm_normal_m=0.4, arm_up_m=0.2,
        pylon_length_m=4.0, axis_1_gain=0.01, gravity_sag_rad=2e-3,
    )  # fmt: skip


def test_plain_mount_is_azimuth_and_elevation():
    count = np.deg2rad([[0.0, 0.0], [90.0, 30.0], [180.0, 90.0]])
    got = posture(PLAIN, count)
    np.testing.assert_allclose(got.normal_enu, sun_at([0, 90, 180], [0, 30, 90]), atol=1e-15)
    np.testing.assert_allclose(got.centre_enu_m, np.tile(PLAIN.pivot_enu_m, (3, 1)))


@pytest.mark.parametrize(
    ("name", "count", "moved"),
    [
        ("pedestal_tilt_north_rad", (0.0, np.pi / 2), (0, 1, 0)),
        ("pedestal_tilt_east_rad", (0.0, np.pi / 2), (1, 0, 0)),
        ("pedestal_twist_rad", (0.0, 0.0), (1, 0, 0)),
        ("axis_1_zero_rad", (0.0, 0.0), (1, 0, 0)),
        ("axis_2_zero_rad", (0.0, 0.0), (0, 0, 1)),
        ("canting_up_rad", (0.0, 0.0), (0, 0, 1)),
        # facing north, the mirror's right hand as seen from the front is west
        ("canting_right_rad", (0.0, 0.0), (-1, 0, 0)),
        ("gravity_sag_rad", (0.0, 0.0), (0, 0, -1)),
        # positive lowers the right hand: a mirror facing up then looks to it
        ("nonorthogonality_rad", (0.0, np.pi / 2), (-1, 0, 0)),
    ],
)
def test_each_error_moves_the_normal_as_it_says(name, count, moved):
    change = posture(PLAIN.replace(**{name: 1e-6}), count).normal_enu - posture(PLAIN, count).normal_enu
    np.testing.assert_allclose(change / 1e-6, moved, atol=2e-6)


def test_arms_and_pylon_move_the_centre():
    facing_east = (np.pi / 2, 0.0)
    mount = PLAIN.replace(arm_normal_m=0.3, arm_up_m=0.2, arm_right_m=0.1, location_north_m=1.0)
    np.testing.assert_allclose(posture(mount, facing_east).centre_enu_m - PLAIN.pivot_enu_m, [0.3, 1.1, 0.2])
    leaning = PLAIN.replace(pylon_length_m=4.0, pedestal_tilt_east_rad=0.01)
    np.testing.assert_allclose(
        posture(leaning, facing_east).centre_enu_m - PLAIN.pivot_enu_m,
        [4.0 * np.sin(0.01), 0.0, 4.0 * (np.cos(0.01) - 1.0)],
    )


def test_linear_actuator_opens_by_the_law_of_cosines():
    drive = Actuator(kind="linear", counts_per_unit=1000.0, stroke_m=3.0, radius_m=4.0, offset_m=5.0)
    mount = Mount(pivot_enu_m=np.zeros(3), actuators=(Actuator(), drive))
    # from the 3-4-5 triangle's cos = 0.8 to the right angle at √41
    angle = posture(mount, (0.0, 1000.0 * (np.sqrt(41.0) - 3.0))).axis_rad[1]
    assert angle == pytest.approx(np.pi / 2 - np.arccos(0.8), abs=1e-12)
    assert np.isnan(posture(mount, (0.0, 1000.0 * 6.1)).normal_enu).all()


def test_command_undoes_every_error():
    rng = np.random.default_rng(1)
    sun = sun_at(rng.uniform(100, 260, 50), rng.uniform(10, 80, 50))
    wanted = command(tilted(), sun_enu=sun, target_enu_m=np.tile(TARGET, (50, 1)))
    assert np.all(wanted.status == CommandStatus.OK)
    got = posture(tilted(), wanted.count)
    beam = reflect(got.normal_enu, sun)
    miss = target_offset_m(got.centre_enu_m, beam, target_enu_m=TARGET, target_normal_enu=[0.2, 1.0, -0.7])
    assert np.abs(miss).max() < 1e-9


def test_command_of_a_linear_mount_with_worm_and_limits():
    shape = {"kind": "linear", "counts_per_unit": 154e3, "stroke_m": 0.08, "radius_m": 0.338, "offset_m": 0.335}
    frame = mount_frame_from_axis([1.0, 0, 0], [0, 0, 1.0])
    drives = (
        Actuator(sign=-1, angle_at_zero_rad=-0.03, limits_count=(0, 70e3), worm_ratio=30.0, **shape),
        Actuator(sign=-1, angle_at_zero_rad=0.93, limits_count=(0, 76e3), **shape),
    )
    mount = Mount(
        pivot_enu_m=np.array([5.0, 150.0, 2.0]), rot_enu_from_mount=frame, actuators=drives,
        parameters={"worm_1_sin_rad": 1e-3},
    )  # fmt: skip
    sun = sun_at([120.0, 180.0, 0.0], [30.0, 50.0, 5.0])
    wanted = command(mount, sun_enu=sun, target_enu_m=np.tile(TARGET, (3, 1)))
    assert wanted.status.tolist()[:2] == [0, 0]
    assert wanted.status[2] == CommandStatus.BEYOND_LIMITS or wanted.status[2] == CommandStatus.NO_SOLUTION
    got = posture(mount, wanted.count[:2])
    want = geometry.bisector_enu(sun[:2], TARGET - got.centre_enu_m)
    np.testing.assert_allclose(got.normal_enu, want, atol=1e-10)


def test_dish_points_at_the_sun():
    sun = sun_at([90.0, 200.0], [20.0, 60.0])
    wanted = command(tilted(), sun_enu=sun, mode="dish")
    np.testing.assert_allclose(posture(tilted(), wanted.count).normal_enu, sun, atol=1e-12)
    with pytest.raises(InvalidInputError, match="target_enu_m"):
        command(tilted(), sun_enu=sun)


def test_azimuth_goes_a_turn_further_to_stay_within_its_limits():
    mount = Mount(pivot_enu_m=np.zeros(3), actuators=(Actuator(limits_count=(0.0, 6.0)), Actuator()))
    wanted = command(mount, sun_enu=sun_at([200.0], [10.0]), mode="dish")
    assert wanted.status[0] == CommandStatus.OK
    assert wanted.count[0, 0] == pytest.approx(np.deg2rad(200.0))


def test_beam_meets_a_tilted_target():
    # heliostat 100 m north, target plane leaning back towards it: right is west of a target that faces north
    beam = np.array([0.01, -1.0, 0.02])
    flat = target_offset_m([0.0, 100.0, 0.0], beam, target_enu_m=np.zeros(3), target_normal_enu=[0, 1, 0])
    np.testing.assert_allclose(flat, [-1.0, 2.0], atol=1e-12)
    steep = target_offset_m([0.0, 100.0, 0.0], beam, target_enu_m=np.zeros(3), target_normal_enu=[0, 1, 1])
    # in the plane z = −y: 100 − t = −0.02 t, up along (0, −1, 1)/√2
    t = 100.0 / 0.98
    np.testing.assert_allclose(steep, [-0.01 * t, 0.02 * t * np.sqrt(2.0)], atol=1e-12)
    assert np.isnan(
        target_offset_m([0.0, -1.0, 0.0], beam, target_enu_m=np.zeros(3), target_normal_enu=[0, 1, 0])
    ).all()
    assert np.isnan(reflect([0, 1.0, 0], [0, -1.0, 0.1])).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Actuator(kind="hydraulic"), "rotary"),
        (lambda: Actuator(sign=2), "sign"),
        (lambda: Actuator(limits_count=(5, 5)), "ascending"),
        (lambda: Actuator(kind="linear", stroke_m=80.0, radius_m=0.3, offset_m=0.3), "triangle"),
        (lambda: Mount(pivot_enu_m=np.zeros(3), parameters={"tilt": 1.0}), "no mount parameter"),
        (lambda: Mount(pivot_enu_m=np.zeros(3), parameters={"axis_1_gain": np.nan}), "finite"),
        (lambda: Mount(pivot_enu_m=np.zeros(3), rot_enu_from_mount=np.diag([1.0, 1, -1])), "rotation"),
        (lambda: mount_frame_from_axis([0, 0, 1], [0, 0, 2]), "parallel"),
    ],
)
def test_mistakes_are_named(make, message):
    with pytest.raises(InvalidInputError, match=message):
        make()
