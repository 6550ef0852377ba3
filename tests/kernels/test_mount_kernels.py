"""The mount's kernel against rotations written with scipy, and its derivatives against differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfpose.feedback import _kernels
from rfpose.feedback.calibration import PARAMETER_SETS, fit, fit_many, posture_jacobian
from rfpose.feedback.columns import CONSTANTS, P, constant
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import PARAMETERS, Actuator, Mount, command, posture, stack_mounts

LEVEL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def random_mount(rng, *, linear=False):
    values = {name: rng.normal() * 10.0 * size for name, size in PARAMETERS.items() if not name.startswith("actuator")}
    values["pylon_length_m"] = 3.0
    actuators = (Actuator(worm_ratio=30.0), Actuator(worm_ratio=17.0))
    if linear:
        shape = {"counts_per_unit": 154e3, "stroke_m": 0.08, "radius_m": 0.338, "offset_m": 0.335, "worm_ratio": 30.0}
        actuators = (
            Actuator(kind="linear", sign=-1, angle_at_zero_rad=-0.03, **shape),
            Actuator(kind="linear", sign=-1, angle_at_zero_rad=0.93, **shape),
        )
    return Mount(
        pivot_enu_m=rng.normal(size=3) * 50.0, rot_enu_from_mount=LEVEL, actuators=actuators, parameters=values
    )


def twin(mount, count):
    """Normal and centre of one posture, composed of scipy's rotations."""
    p = mount.parameters
    angles = []
    for i, actuator in enumerate(mount.actuators, start=1):
        travel = count[i - 1] / actuator.counts_per_unit * (1.0 + p[f"axis_{i}_gain"])
        if actuator.kind == "linear":
            a, b, start = (p[f"actuator_{i}_{side}_m"] for side in ("radius", "offset", "stroke"))
            opening = [np.arccos((a**2 + b**2 - c**2) / (2 * a * b)) for c in (start, start + travel)]
            travel = opening[1] - opening[0]
        angle = actuator.angle_at_zero_rad + actuator.sign * travel + p[f"axis_{i}_zero_rad"]
        turn = actuator.worm_ratio * angle
        angle += p[f"worm_{i}_sin_rad"] * np.sin(turn) + p[f"worm_{i}_cos_rad"] * np.cos(turn)
        angles.append(angle)
    # mirror frame (right, up, normal) -> mount frame: seen from the front, right is west for a mirror facing north
    mirror = np.column_stack([[-1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])
    azimuth = Rotation.from_rotvec([0.0, 0.0, -angles[0]])
    oblique = Rotation.from_rotvec([0.0, -p["nonorthogonality_rad"], 0.0])
    elevation = Rotation.from_rotvec([angles[1], 0.0, 0.0])
    ahead = azimuth.apply([0.0, p["axis_offset_m"], 0.0])
    drive = azimuth * oblique * elevation
    pedestal = (
        Rotation.from_rotvec([0.0, p["pedestal_tilt_east_rad"], 0.0])
        * Rotation.from_rotvec([-p["pedestal_tilt_north_rad"], 0.0, 0.0])
        * Rotation.from_rotvec([0.0, 0.0, -p["pedestal_twist_rad"]])
    )
    frame = pedestal * Rotation.from_matrix(mount.rot_enu_from_mount)
    normal = np.array([p["canting_right_rad"], p["canting_up_rad"], 1.0])
    normal = frame.apply(drive.apply(mirror @ (normal / np.linalg.norm(normal))))
    up = np.array([0.0, 0.0, 1.0])
    normal = normal - p["gravity_sag_rad"] * (up - normal[2] * normal)
    arm = drive.apply(mirror @ [p["arm_right_m"], p["arm_up_m"], p["arm_normal_m"]]) + ahead
    pylon = np.array([0.0, 0.0, p["pylon_length_m"]])
    place = mount.pivot_enu_m + [p[f"location_{axis}_m"] for axis in ("east", "north", "up")]
    return normal / np.linalg.norm(normal), place + frame.apply(arm) + pedestal.apply(pylon) - pylon


@pytest.mark.parametrize("linear", [False, True], ids=["rotary", "linear"])
def test_posture_is_the_product_of_rotations(linear):
    rng = np.random.default_rng(1)
    for _ in range(5):
        mount = random_mount(rng, linear=linear)
        count = rng.uniform(10e3, 60e3, 2) if linear else rng.uniform(-1.0, 1.0, 2)
        normal, centre = twin(mount, count)
        got = posture(mount, count)
        np.testing.assert_allclose(got.normal_enu, normal, atol=1e-12)
        np.testing.assert_allclose(got.centre_enu_m, centre, atol=1e-10)


def test_commands_stay_near_whatever_worm_is_believed_in():
    # a rolling fit may for a while believe in a gear whose error turns faster than its axis
    sun = np.random.default_rng(4).normal(size=(200, 3))
    sun[:, 2] = np.abs(sun[:, 2])
    axes = (Actuator(worm_ratio=30.0), Actuator(worm_ratio=30.0))
    plain = Mount(pivot_enu_m=np.zeros(3), actuators=axes)
    odd = plain.replace(worm_1_cos_rad=0.035, worm_2_sin_rad=-0.035)
    target = np.array([0.0, 0.0, 50.0])
    off = command(odd, sun_enu=sun, target_enu_m=target).count - command(plain, sun_enu=sun, target_enu_m=target).count
    assert np.max(np.abs(off)) <= 0.035 + 1e-12


def test_jacobian_is_the_differences_of_the_twin():
    rng = np.random.default_rng(2)
    mount = random_mount(rng, linear=True)
    count = rng.uniform(10e3, 60e3, (4, 2))
    normal = posture(mount, count).normal_enu
    rows = Measurements.from_normals(count, normal_enu=normal)
    free = tuple(name for name in PARAMETERS if not name.startswith("receiver"))
    got = posture_jacobian(mount, rows, free)
    for f, name in enumerate(free):
        h = 1e-4 * PARAMETERS[name]
        high, low = (mount.replace(**{name: mount.parameters[name] + s * h}) for s in (1, -1))
        want = np.array([(twin(high, c)[0] - twin(low, c)[0]) / (2 * h) for c in count])
        np.testing.assert_allclose(got[..., f], want, rtol=2e-6, atol=2e-7 * max(1.0, np.abs(want).max()), err_msg=name)


def test_columns_are_where_mounts_have_them():
    shape = {"stroke_m": 0.08, "radius_m": 0.338, "offset_m": 0.335}
    mount = Mount(
        pivot_enu_m=np.array([1.0, 2.0, 3.0]),
        rot_enu_from_mount=LEVEL,
        actuators=(
            Actuator(counts_per_unit=4.0, angle_at_zero_rad=5.0, worm_ratio=6.0, limits_count=(7.0, 8.0)),
            Actuator(kind="linear", sign=-1, counts_per_unit=9.0, angle_at_zero_rad=10.0, worm_ratio=11.0,
                     limits_count=(12.0, 13.0), **shape),
        ),
        parameters={name: float(i) for i, name in enumerate(PARAMETERS) if not name.startswith("actuator")},
    )  # fmt: skip
    parameters, constants = mount.parameter_vector(), mount.constant_vector()
    assert len(parameters) == len(PARAMETERS)
    assert len(constants) == sum(CONSTANTS.values())
    for name, value in mount.parameters.items():
        assert parameters[getattr(P, name)] == value
    expected = {
        "rot_enu_from_mount": LEVEL.ravel(), "is_linear": (0, 1), "sign": (1, -1), "counts_per_unit": (4, 9),
        "angle_at_zero_rad": (5, 10), "worm_ratio": (6, 11), "pivot_enu_m": (1, 2, 3), "lowest_count": (7, 12),
        "highest_count": (8, 13),
    }  # fmt: skip
    assert list(expected) == list(CONSTANTS)
    for name, values in expected.items():
        np.testing.assert_array_equal(constant(constants, name), values, err_msg=name)


def test_columns_of_axes_are_spaced_as_kernels_step_through_them():
    # kernels add the axis, for a worm twice the axis, and count through xyz
    for name, other in zip(PARAMETERS, list(PARAMETERS)[1:], strict=False):
        if "_1_" in name and not name.startswith("worm"):
            assert other == name.replace("_1_", "_2_")
    assert P.worm_2_sin_rad - P.worm_1_sin_rad == P.worm_2_cos_rad - P.worm_1_cos_rad == 2
    for part in ("location", "drone_camera"):
        east, north, up = (getattr(P, f"{part}_{axis}_m") for axis in ("east", "north", "up"))
        assert (north, up) == (east + 1, east + 2)


def test_batch_is_one_by_one():
    rng = np.random.default_rng(3)
    count = np.array([np.pi, 0.8]) + rng.uniform(-0.3, 0.3, (20, 2))
    mount = Mount(pivot_enu_m=np.zeros(3), parameters={"axis_1_zero_rad": 3e-3})
    made = Measurements.from_normals(
        count, normal_enu=posture(mount, count).normal_enu + 1e-4 * rng.normal(size=(20, 3))
    )
    start = Mount(pivot_enu_m=np.zeros(3))
    together = fit_many([start] * 3, [made, made.take(slice(0, 12)), made], free="edwards-4")
    alone = fit(start, made.take(slice(0, 12)), free="edwards-4")
    np.testing.assert_allclose(together.working[1], alone.field.working[0], atol=1e-12)
    np.testing.assert_array_equal(together.working[0], together.working[2])
    assert together.free == PARAMETER_SETS["edwards-4"]


@pytest.mark.parametrize("sag", [1e-3, 0.0])
def test_a_command_is_the_same_from_wherever_it_begins(sag):
    """Right beside it, near by, far off, beyond the zenith, and without a guess."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        values = {"pedestal_tilt_north_rad": 5e-3, "arm_normal_m": 0.3, "axis_offset_m": 0.1, "gravity_sag_rad": sag}
        mount = Mount(pivot_enu_m=np.zeros(3), actuators=(Actuator(), Actuator()), parameters=values)
        p, k = (rows[0] for rows in stack_mounts([mount]))
        prepared, state, wanted = np.empty(_kernels.N_PREPARED), np.empty(6), np.empty(3)
        _kernels.prepare(p, k, prepared)
        row = np.zeros(_kernels.N_ROW)
        row[:3] = [0.5 * rng.normal(), 0.5 * rng.normal(), 1.0]
        row[:3] /= np.linalg.norm(row[:3])
        row[4:8] = [*rng.normal(size=2) * 40.0, 30.0, 1.0]
        found = []
        for near in (np.full(2, np.nan), 0.01, 0.01, 5e-6, 5e-6, np.array([rng.normal(), 1.1]), np.array([3.0, 2.0])):
            near = found[0][0] + near * rng.normal(size=2) if isinstance(near, float) else near
            counts = np.empty(2)
            assert _kernels.command_one(p, k, prepared, row, near, counts, state, wanted) == 0
            found.append((near, counts, wanted.copy()))
        for near, counts, normal in found[1:]:
            np.testing.assert_allclose(near, found[0][0], atol=1e-12)
            np.testing.assert_allclose(counts, found[0][1], rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(normal, found[0][2], atol=1e-12)
