"""What nobody in the plant knows: the true mounts, and what wind, heat and time do to them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.feedback.columns import P, columns_of, constant
from rfpose.feedback.mount import Actuator, Mount, check_names
from rfpose.scenario import Scenario

__all__ = [
    "MONTH_DAYS",
    "PLACE",
    "TILTS",
    "WORMS",
    "ZEROS",
    "HiddenField",
    "azimuth_course_rad",
    "draw_field",
    "field_positions",
    "generator",
    "sigma_as_built",
]

MONTH_DAYS = 30.4375
PLACE = ("location_east_m", "location_north_m", "location_up_m")
WORMS = ("worm_1_sin_rad", "worm_1_cos_rad", "worm_2_sin_rad", "worm_2_cos_rad")
TILTS = columns_of(("pedestal_tilt_north_rad", "pedestal_tilt_east_rad"))
ZEROS = columns_of(("axis_1_zero_rad", "axis_2_zero_rad"))
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenField:
    """Mirrors with their true and their nominal mounts; rows are mirrors.

    Attributes
    ----------
    ids, pivot_enu_m
        Names and nominal pivots [m].
    nominal, constant : (mirror, parameter), (mirror, constant)
        Mount as planned, as the kernels read it.
    true : (mirror, parameter)
        Mount as built, at the run's first day; the receivers' plane included.
    lean_rad : (mirror, 2)
        Amplitude of the pedestal's daily lean, towards north and east [rad].
    creep_rad_per_day : (mirror, 2)
        [rad].
    plate_drift_rad : (mirror,)
        Amplitude of the receivers' plane's daily tilt [rad].
    camera_bias_rad, drone_bias_rad, sensor_bias_rad : (mirror, 2)
        Constant errors of these instruments, right and up [rad].
    target : (mirror, 4)
        Aim point [m], and 1 for a dish.
    """

    ids: tuple[str, ...]
    pivot_enu_m: FloatArray
    nominal: FloatArray = field(repr=False)
    constant: FloatArray = field(repr=False)
    true: FloatArray = field(repr=False)
    lean_rad: FloatArray = field(repr=False)
    creep_rad_per_day: FloatArray = field(repr=False)
    plate_drift_rad: FloatArray = field(repr=False)
    camera_bias_rad: FloatArray = field(repr=False)
    drone_bias_rad: FloatArray = field(repr=False)
    sensor_bias_rad: FloatArray = field(repr=False)
    target: FloatArray = field(repr=False)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def is_dish(self) -> bool:
        """Whether the mirrors look at the sun."""
        return bool(self.target[0, 3])

    def some(self, rows: npt.NDArray[np.int64]) -> HiddenField:
        """Return some of the mirrors."""
        values = {f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self) if f.name != "ids"}
        return HiddenField(ids=tuple(self.ids[i] for i in rows), **values)

    def at(self, day: float) -> FloatArray:
        """Return the true mounts so many days after the first (mirror, parameter)."""
        p = self.true.copy()
        p[:, TILTS] += self.creep_rad_per_day * day
        return p


def generator(seed: int, *place: int) -> np.random.Generator:
    """Return the random numbers of one place of a run: the same whatever was drawn before."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, *place])))


def field_positions(scenario: Scenario, count: int | None) -> tuple[tuple[str, ...], FloatArray]:
    """Return names and pivots of the mirrors to track.

    The scenario's first ``count``; if it lists fewer, a field of that many spread evenly over the ring between
    ``inner_radius_m`` and ``field_radius_m``.

    Raises
    ------
    ScenarioError
        No mirror at all.
    """
    listed = len(scenario.heliostat)
    if count is None and not listed:
        raise ScenarioError("the scenario has no heliostats; add some, or say how many with `heliostats=`")
    if count is not None and count < 1:
        raise ScenarioError(f"there must be one heliostat or more, got {count}")
    if count is None or count <= listed:
        n = listed if count is None else count
        return scenario.heliostat_ids[:n], scenario.pivot_enu_m[:n]
    plan = scenario.tracking
    height = float(np.median(scenario.pivot_enu_m[:, 2])) if listed else 2.0
    i = np.arange(count) + 0.5
    radius = np.sqrt(plan.inner_radius_m**2 + i / count * (plan.field_radius_m**2 - plan.inner_radius_m**2))
    places = np.stack([radius * np.cos(_GOLDEN * i), radius * np.sin(_GOLDEN * i), np.full(count, height)], axis=1)
    return tuple(f"H{k + 1:05d}" for k in range(count)), places


def draw_field(scenario: Scenario, *, count: int | None, seed: int, sun_enu: FloatArray) -> HiddenField:
    """Draw the mirrors of a run; azimuth axes have the middle of their travel on the course ``sun_enu`` (time, xyz).

    Raises
    ------
    ScenarioError
        No mirrors, no aim point, a fixed parameter that no mount has.
    """
    plan = scenario.tracking
    ids, pivot = field_positions(scenario, count)
    n = len(ids)
    rng = generator(seed, 0)
    is_dish = plan.collector == "dish"
    if scenario.site.aim_enu_m is None and not is_dish:
        raise ScenarioError("[site] `aim_enu_m` is missing: the mirrors have nothing to face; add it")
    nominal, constants = _nominal(scenario, ids, pivot, azimuth_course_rad(scenario, pivot, sun_enu)[1])
    true = _true(scenario, nominal, rng)
    lean = 1e-3 * rng.standard_normal((n, 2))
    e = plan.mount_errors
    plate = 1e-3 * plan.radio.plate_sigma_mrad * rng.standard_normal((n, 2))
    true[:, P.receiver_plane_up_rad] = plate[:, 0]
    true[:, P.receiver_plane_right_rad] = plate[:, 1]
    target = np.zeros((n, 4))
    target[:, 3] = float(is_dish)
    if not is_dish:
        target[:, :3] = scenario.site.aim_enu_m
    return HiddenField(
        ids=ids,
        pivot_enu_m=pivot,
        nominal=nominal,
        constant=constants,
        true=true,
        lean_rad=e.thermal_sigma_mrad * lean,
        creep_rad_per_day=e.creep_sigma_mrad_per_month / MONTH_DAYS * 1e-3 * rng.standard_normal((n, 2)),
        plate_drift_rad=1e-3 * plan.radio.plate_drift_mrad * rng.standard_normal(n),
        camera_bias_rad=1e-3 * plan.camera.scale_error_sigma_mrad * rng.standard_normal((n, 2)),
        drone_bias_rad=1e-3 * plan.drone.constant_sigma_mrad * rng.standard_normal((n, 2)),
        sensor_bias_rad=1e-3 * plan.sun_sensor.offset_sigma_mrad * rng.standard_normal((n, 2)),
        target=target,
    )


def azimuth_course_rad(scenario: Scenario, pivot: FloatArray, sun_enu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the azimuth at which each mirror begins a course of the sun, and the middle of its travel [rad].

    Followed without a jump, so that a course across north or past the zenith has one middle.
    """
    low, high = np.full(len(pivot), np.inf), np.full(len(pivot), -np.inf)
    azimuth = first = np.zeros(len(pivot))
    for i, sun in enumerate(sun_enu):
        normal = np.broadcast_to(sun, pivot.shape)
        if scenario.tracking.collector == "heliostat":
            normal = geometry.bisector_enu(np.asarray(scenario.site.aim_enu_m) - pivot, normal)
        found = geometry.azimuth_elevation_from_enu(normal)[0]
        azimuth = found if i == 0 else azimuth + np.mod(found - azimuth + np.pi, 2.0 * np.pi) - np.pi
        first = azimuth if i == 0 else first
        low, high = np.minimum(low, azimuth), np.maximum(high, azimuth)
    return np.asarray(first), np.asarray(0.5 * (low + high))


def _nominal(
    scenario: Scenario, ids: tuple[str, ...], pivot: FloatArray, home_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return parameters and constants of mounts as planned."""
    drive = scenario.tracking.drive
    per_rad = drive.steps_per_turn / (2.0 * np.pi)
    axes = tuple(
        Actuator(
            counts_per_unit=per_rad,
            limits_count=(np.deg2rad(limits[0]) * per_rad, np.deg2rad(limits[1]) * per_rad),
            worm_ratio=drive.worm_ratio,
        )
        for limits in (drive.azimuth_limits_deg, drive.elevation_limits_deg)
    )
    like = Mount(pivot_enu_m=np.zeros(3), actuators=(axes[0], axes[1]))
    p = np.repeat(like.parameter_vector()[None], len(pivot), axis=0)
    k = np.repeat(like.constant_vector()[None], len(pivot), axis=0)
    arms = {h.id: h.arm_m for h in scenario.heliostat}
    usual = next(iter(arms.values()), 0.0)
    p[:, P.arm_normal_m] = [arms.get(name, usual) for name in ids]
    constant(k, "angle_at_zero_rad")[:, 0] = home_rad
    constant(k, "pivot_enu_m")[:] = pivot
    return p, k


def sigma_as_built(scenario: Scenario) -> dict[str, float]:
    """Return the standard deviations of mounts' parameters over a field, by name [rad, m]."""
    e = scenario.tracking.mount_errors
    return {
        **dict.fromkeys(("pedestal_tilt_north_rad", "pedestal_tilt_east_rad"), 1e-3 * e.tilt_sigma_mrad),
        **dict.fromkeys(("axis_1_zero_rad", "axis_2_zero_rad"), 1e-3 * e.zero_sigma_mrad),
        "nonorthogonality_rad": 1e-3 * e.nonorthogonality_sigma_mrad,
        **dict.fromkeys(("canting_up_rad", "canting_right_rad"), 1e-3 * e.canting_sigma_mrad),
        **dict.fromkeys(PLACE, 1e-3 * e.location_sigma_mm),
        **dict.fromkeys(WORMS, 1e-3 * e.worm_sigma_mrad / np.sqrt(2.0)),
        "gravity_sag_rad": 1e-3 * e.sag_sigma_mrad,
    }


def _true(scenario: Scenario, nominal: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw mounts as built."""
    fixed = scenario.tracking.mount_errors.fixed
    check_names(fixed)
    true = nominal.copy()
    for name, spread in sigma_as_built(scenario).items():
        true[:, getattr(P, name)] += spread * rng.standard_normal(len(true))
    for name, value in fixed.items():
        true[:, getattr(P, name)] = value
    return true
