"""What a tracked field will be off by, part by part, without simulating it; and the light which that costs.

After Edwards, Arrays of paraboloidal collectors, §5.4.10: errors random in time, and errors that are constant for a
mirror but random over the field, add as squares to one rms; that gives the intercept, and the intercept the loss of a
day and of a year. Each part follows from the scenario alone, whatever the seed.

Feedback is taken as linear, with lost frames as a weaker gain. A disturbance is passed on by what the sampled loop
leaves of it at the servo's steps, between measurements too (`SampledLoop.left`). What models do not know of their
mounts is propagated to first order, through the least squares with which the model was fitted.

Left out: mirrors that pass the zenith; radio outages, clouds that blind a sun sensor; modes, messages and events of
field control; the drives' top speed; errors of second order; what a quantised or loose drive does to the loop's gain;
what the loop's corrections make the structure swing by (much only for modes below 1 Hz, or gains near the margin); how
the loop catches up with slow errors of the mount, which its integral leaves less than 0.01 mrad of; corrections of the
zeros that stop within their tolerance; ground reflections in what radio teaches a model.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_positive
from rfpose.errors import InvalidInputError
from rfpose.feedback import _kernels as mount_kernels
from rfpose.feedback.calibrated import PARAMETER_SETS
from rfpose.feedback.drone import drone_sigma_rad
from rfpose.feedback.energy import combine_errors_rad, energy, representative_days
from rfpose.feedback.mount import PARAMETERS, aim_rows
from rfpose.feedback.servo import PiLaw
from rfpose.feedback.servo.margins import is_stable
from rfpose.feedback.sun import sun_position
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.capture import TOP_RAD, capture_table
from rfpose.feedback.tracking.hidden import Field, draw_field
from rfpose.feedback.tracking.instruments import _LARGE, _PRIORS, _TURNS, _WORMS, LEARNED, Workshop
from rfpose.feedback.tracking.methods import Method, choose
from rfpose.feedback.tracking.radio import RadioModel
from rfpose.feedback.tracking.sky import under_sky
from rfpose.feedback.tracking.timeline import Day, days, hour_of_day, site_of
from rfpose.feedback.tracking.wind import Gusts
from rfpose.scenario import Scenario

__all__ = ["Budget", "SampledLoop", "mean_intercept", "track_budget"]

_INDEX = {name: i for i, name in enumerate(PARAMETERS)}
_MOUNT = (
    "pedestal_tilt_north_rad", "pedestal_tilt_east_rad", "axis_1_zero_rad", "axis_2_zero_rad", "nonorthogonality_rad",
    "canting_up_rad", "canting_right_rad", "gravity_sag_rad",
)  # fmt: skip
_PLACE = ("location_east_m", "location_north_m", "location_up_m")
_ZEROS = ("axis_1_zero_rad", "axis_2_zero_rad")
_N_MIRROR, _N_DAY, _N_TIME, _N_RADIO = 48, 12, 48, 6
_HARMONICS = np.arange(1, 17)
_STEEP = 0.3
_MONTH_DAYS = 30.4375


# -- the loop ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledLoop:
    """A PI law on a measurement of the mirror, as the tracking simulation runs it: the mirror follows at once.

    Attributes
    ----------
    gain_per_s, integral_gain_per_s2
        K0, K1.
    interval_s, latency_s
        Between measurements, and from one to the step in which it acts; in whole servo steps, at least one.
    servo_s
        Between servo steps, at which errors count.
    lost
        Part of the measurements that do not arrive.
    """

    gain_per_s: float
    integral_gain_per_s2: float = 0.0
    interval_s: float = 1.0
    latency_s: float = 1.0
    servo_s: float = 1.0
    lost: float = 0.0

    def __post_init__(self) -> None:
        as_positive("interval_s", self.interval_s)
        as_positive("servo_s", self.servo_s)
        if not 0.0 <= self.lost <= 1.0:
            raise InvalidInputError(f"`lost` must be a part, 0 to 1, got {self.lost}")

    def _shape(self) -> tuple[int, int]:
        """Return servo steps between measurements, and from one to where it acts."""
        late = max(int(np.ceil(self.latency_s / self.servo_s - 1e-9)), 1)
        return max(round(self.interval_s / self.servo_s), 1), late

    def _shift(self, frequency_hz: FloatArray) -> npt.NDArray[np.complex128]:
        """Return what the loop shifts the mirror by, for a swinging error of one, from one measurement to the next."""
        n, late = self._shape()
        interval, here = self.interval_s, 1.0 - self.lost
        # the loop takes away all that stands still
        z = np.exp(2j * np.pi * np.maximum(np.abs(frequency_hz), 1e-9) * interval)
        forward = (
            here * interval * (self.gain_per_s + self.integral_gain_per_s2 * interval * z / (z - 1.0)) * z / (z - 1.0)
        )
        return np.asarray(forward / (1.0 + forward * z ** -float(-(-late // n))), np.complex128)

    def left(self, frequency_hz: npt.ArrayLike) -> FloatArray:
        """Return what part of a swinging error is left, rms over the servo steps between measurements.

        Parameters
        ----------
        frequency_hz : (...)
            May lie above half the sampling rate: what is sampled too rarely is followed falsely, and counts.
        """
        frequency = np.asarray(frequency_hz, np.float64)
        n, late = self._shape()
        shift = self._shift(frequency)
        square = np.zeros(frequency.shape)
        for step in range(n):
            turn = np.exp(2j * np.pi * frequency * self.servo_s * step)
            behind = np.exp(2j * np.pi * frequency * self.interval_s * ((step - late) // n))
            square += np.abs(turn - shift * behind) ** 2
        return np.asarray(np.sqrt(square / n))

    @property
    def passed(self) -> float:
        """Rms of the mirror for white measurement noise of rms one."""
        frequency = (np.arange(8192) + 0.5) * 0.5 / 8192 / self.interval_s
        # noise comes at the full gain, but with what arrives only
        return float(np.sqrt(np.mean(np.abs(self._shift(frequency)) ** 2) / max(1.0 - self.lost, 1e-9)))

    def start_rms(self, settle_s: float, span_s: float) -> float:
        """Return the rms that an initial error of one leaves over a span that begins some time after the start."""
        n, late = self._shape()
        here = 1.0 - self.lost
        length = int(np.ceil((settle_s + span_s) / self.servo_s))
        length = min(length, int(settle_s / self.servo_s) + 4000 * n)
        error, pending = np.empty(length), np.zeros(length + late + 1)
        shift = ramp = 0.0
        for g in range(length):
            shift += pending[g]
            error[g] = 1.0 - shift
            if g % n == 0:
                ramp += here * self.integral_gain_per_s2 * self.interval_s * error[g]
                pending[g + late] += self.interval_s * (here * self.gain_per_s * error[g] + ramp)
        after = error[int(settle_s / self.servo_s) :]
        return float(np.sqrt(np.sum(after**2) * self.servo_s / span_s))


# -- result ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """What one method will be off by: angles of the normal, both directions together, rms over field and time [rad].

    Attributes
    ----------
    method
        Its name.
    motor_steps_rad, motor_swing_rad
        Whole steps and dead band; what they make the structure swing by.
    play_rad, stiction_rad
        Of the gears.
    steady_wind_rad, gusts_rad, resonance_rad
        Mean deflection; background (5.20) and resonant (5.19) part.
    radio_noise_rad, reflection_rad
        Noise that the loop passes on; what a reflection does that is not in the pose solver's model.
    plate_rad, plate_drift_rad
        The receivers' plane against the mirror, as far as nothing finds it, and its daily change.
    encoder_rad
        Levels of the encoder.
    sensor_null_rad, sensor_drift_rad, sensor_levels_rad
        Of the sun sensor.
    mount_rad, place_rad, worm_rad
        Tilts, zeros, non-orthogonality, canting and sag; place of the mirror; worm gears: what the model or the loop
        leaves of them.
    heat_rad, creep_rad
        Daily lean of the pedestal, and creep of its foundation since the calibration.
    instrument_rad, fit_rad
        The calibrating instrument's constant error, and the scatter of its looks, by way of the fitted model.
    start_rad
        What is left of the morning's error when scoring begins.
    intercept
        Light caught by errors that scatter by the total over √2 in each direction.
    posture_intercept
        The same with each mirror's own rms at each time, weighted by the light there: where errors differ much from
        posture to posture, as after a correction of the zeros, it is the truer one.
    perfect_intercept
        The same of a perfect tracker; below one for a dish.
    offered_kwh_per_m2, offered_kwh_per_m2_year
        Light on a square metre of mirror over the scenario's days, clear or as recorded (bursts are left out), and
        over a year of whole clear days.
    """

    method: str
    motor_steps_rad: float = 0.0
    motor_swing_rad: float = 0.0
    play_rad: float = 0.0
    stiction_rad: float = 0.0
    steady_wind_rad: float = 0.0
    gusts_rad: float = 0.0
    resonance_rad: float = 0.0
    radio_noise_rad: float = 0.0
    reflection_rad: float = 0.0
    plate_rad: float = 0.0
    plate_drift_rad: float = 0.0
    encoder_rad: float = 0.0
    sensor_null_rad: float = 0.0
    sensor_drift_rad: float = 0.0
    sensor_levels_rad: float = 0.0
    mount_rad: float = 0.0
    place_rad: float = 0.0
    worm_rad: float = 0.0
    heat_rad: float = 0.0
    creep_rad: float = 0.0
    instrument_rad: float = 0.0
    fit_rad: float = 0.0
    start_rad: float = 0.0
    intercept: float = 1.0
    posture_intercept: float = 1.0
    perfect_intercept: float = 1.0
    offered_kwh_per_m2: float = 0.0
    offered_kwh_per_m2_year: float = 0.0

    @property
    def parts_rad(self) -> dict[str, float]:
        """The parts by name, without the unit in it."""
        names = [f.name for f in dataclasses.fields(self) if f.name.endswith("_rad")]
        return {name.removesuffix("_rad"): float(getattr(self, name)) for name in names}

    @property
    def total_rad(self) -> float:
        """Root of the sum of squares."""
        return float(combine_errors_rad(self.parts_rad))

    @property
    def lost_kwh_per_m2(self) -> float:
        """Light that a perfect tracker would catch and this one does not, over the scenario's days."""
        return self.offered_kwh_per_m2 * (self.perfect_intercept - self.intercept)

    @property
    def lost_kwh_per_m2_year(self) -> float:
        """The same over a year, with these days' errors."""
        return self.offered_kwh_per_m2_year * (self.perfect_intercept - self.intercept)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values with stable keys; parts that are nothing are left out."""
        return {
            "method": self.method,
            "parts_mrad": {name: 1e3 * value for name, value in self.parts_rad.items() if value > 0.0},
            "total_mrad": 1e3 * self.total_rad,
            "intercept": self.intercept,
            "posture_intercept": self.posture_intercept,
            "perfect_intercept": self.perfect_intercept,
            "offered_kwh_per_m2": self.offered_kwh_per_m2,
            "lost_kwh_per_m2": self.lost_kwh_per_m2,
            "offered_kwh_per_m2_year": self.offered_kwh_per_m2_year,
            "lost_kwh_per_m2_year": self.lost_kwh_per_m2_year,
        }


def mean_intercept(table: FloatArray, total_rad: npt.ArrayLike) -> FloatArray:
    """Return what errors that scatter alike in two directions catch (...).

    Parameters
    ----------
    table
        Of `rfpose.feedback.tracking.capture.capture_table`.
    total_rad : (...)
        Rms of the angle, √2 of that of each direction [rad].
    """
    # the square of the angle over its mean is exponential: Gauss-Laguerre, as `energy.heliostat_intercept` has it
    node, weight = np.polynomial.laguerre.laggauss(40)
    angle = np.asarray(total_rad, np.float64)[..., None] * np.sqrt(node)
    return np.asarray(np.interp(angle, np.linspace(0.0, TOP_RAD, len(table)), table) @ weight)


def track_budget(scenario: Scenario, method: str, *, count: int | None = None) -> Budget:
    """Predict what a method will be off by on the scenario's days, once `settle_s` have passed.

    Parameters
    ----------
    scenario
        Site, mirrors, radio, and ``[tracking]``.
    method
        One of `rfpose.feedback.tracking.METHODS`.
    count
        Number of mirrors; None: those of the scenario. Up to 48 of them, and up to 12 of the days, stand for all.

    Raises
    ------
    ScenarioError, GeometryError, InvalidInputError
        As `rfpose.feedback.tracking.Simulation` does, but for gains, which may have any margin above none.
    """
    chosen = choose((method,), collector=scenario.tracking.collector)[0]
    return _Budgeter(scenario, chosen, count).budget()


# -- geometry ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Course:
    """Postures of mirrors over times: (mirror, time, …)."""

    sun_enu: FloatArray = field(repr=False)
    """(time, xyz)"""
    heat: FloatArray
    normal_enu: FloatArray
    centre_enu_m: FloatArray
    count: FloatArray
    rows: FloatArray
    seen: npt.NDArray[np.bool_]

    @property
    def axes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Right and up (mirror, time, xyz), cosine of the elevation (mirror, time)."""
        rot = geometry.rot_enu_from_mirror(self.normal_enu)
        return rot[..., 0], rot[..., 1], np.hypot(self.normal_enu[..., 0], self.normal_enu[..., 1])


@dataclass(slots=True)
class _Source:
    """Something that makes mirrors point elsewhere, of variance one: at the looks (…, xyz) and while tracking."""

    part: str
    look: FloatArray | None
    track: FloatArray | None


class _Budgeter:
    """Builds one budget."""

    def __init__(self, scenario: Scenario, method: Method, count: int | None) -> None:
        plan = scenario.tracking
        self._scenario, self._method, self._plan = scenario, method, plan
        self._site = site_of(scenario)
        every = days(scenario)
        if plan.sky == "record":
            every = under_sky(scenario, every, seed=0)
        self._every = every
        self._days = [every[i] for i in np.unique(np.linspace(0, len(every) - 1, min(_N_DAY, len(every))).astype(int))]
        course = every[0].sun_enu[:: max(1, round(60.0 / plan.servo_interval_s))]
        whole = draw_field(scenario, count=count, seed=0, sun_enu=course)
        self._some = np.unique(np.linspace(0, len(whole) - 1, min(_N_MIRROR, len(whole))).astype(np.int64))
        self._field = _part_of(whole, self._some)
        self._gusts = Gusts(scenario)
        self._dish = plan.collector == "dish"
        self._radio: RadioModel | None = None
        if method.radio:
            self._check_stable()
            noon = every[0].sun_enu[int(np.argmax(every[0].sun_enu[:, 2]))]
            self._radio = RadioModel(scenario, self._field.pivot_enu_m, usual_normal_enu=self._wanted(noon[None])[:, 0])
        self._workshop = Workshop(scenario, self._field, self._radio, self._gusts, seed=0)
        self._step = 2.0 * np.pi * plan.drive.microsteps / plan.drive.steps_per_turn
        self._loop = self._loop_of()
        self._mirror = method.feedback in (_kernels.RADIO, _kernels.SUN_SENSOR)
        self._square: dict[str, FloatArray] = {}

    def _check_stable(self) -> None:
        plan = self._plan
        interval, late = plan.control_interval_s, plan.radio.latency_s
        law = PiLaw(
            gain_per_s=plan.radio.gain_per_s, integral_gain_per_s2=plan.radio.integral_gain_per_s2, levels=0
        )  # fmt: skip
        beyond = max(int(np.ceil(late / interval - 1e-9)) - 1, 0)
        if not is_stable(law, None, interval_s=interval, latency_s=beyond * interval):
            raise InvalidInputError("[tracking.radio] these gains oscillate: no budget tells how far; lower them")

    def _loop_of(self) -> SampledLoop | None:
        plan, servo = self._plan, self._plan.servo_interval_s
        if self._method.feedback == _kernels.RADIO:
            return SampledLoop(
                gain_per_s=plan.radio.gain_per_s, integral_gain_per_s2=plan.radio.integral_gain_per_s2,
                interval_s=plan.control_interval_s, latency_s=plan.radio.latency_s, servo_s=servo,
                lost=plan.radio.lost_frames,
            )  # fmt: skip
        if self._method.feedback == _kernels.ENCODER:
            return SampledLoop(gain_per_s=plan.encoder.gain_per_s, interval_s=servo, latency_s=servo, servo_s=servo)
        if self._method.feedback == _kernels.SUN_SENSOR:
            sensor = plan.sun_sensor
            return SampledLoop(
                gain_per_s=sensor.gain_per_s, integral_gain_per_s2=sensor.integral_gain_per_s2, interval_s=servo,
                latency_s=servo, servo_s=servo,
            )  # fmt: skip
        return None

    def budget(self) -> Budget:
        """Return the budget: parts are averaged over days, mirrors and times."""
        squares: list[dict[str, float]] = []
        table = capture_table(self._scenario)
        light = np.zeros(2)
        for day in self._days:
            self._square = {}
            light += self._of_day(day, table)
            squares.append({name: float(np.nanmean(value)) for name, value in self._square.items()})
        parts = {f"{name}_rad": float(np.sqrt(np.mean([s[name] for s in squares]))) for name in squares[0]}
        found = Budget(method=self._method.name, **parts)
        day_kwh, year_kwh = self._offered_kwh()
        return dataclasses.replace(
            found,
            intercept=float(mean_intercept(table, found.total_rad)),
            posture_intercept=float(light[0] / light[1]) if light[1] > 0.0 else float("nan"),
            perfect_intercept=float(table[0]),
            offered_kwh_per_m2=day_kwh,
            offered_kwh_per_m2_year=year_kwh,
        )

    def _add(self, part: str, square: npt.ArrayLike) -> None:
        self._square[part] = self._square.get(part, np.zeros(())) + np.asarray(square)

    def _of_day(self, day: Day, table: FloatArray) -> FloatArray:
        """Collect a day's squares by part (mirror, time), or what broadcasts to it; return light caught and offered."""
        scored = np.flatnonzero(
            day.works & (np.arange(len(day.unix_s)) * self._plan.servo_interval_s >= self._plan.settle_s)
        )
        if not scored.size:
            scored = np.arange(len(day.unix_s))
        at = scored[np.linspace(0, len(scored) - 1, min(_N_TIME, len(scored))).astype(np.int64)]
        course = self._course(day.sun_enu[at], day.heat[at], self._field.target[:, :3])
        speed = self._speed(day, at, course)
        span_s = len(scored) * self._plan.servo_interval_s
        self._of_drive(course, speed)
        self._of_wind()
        if self._method.feedback == _kernels.RADIO:
            self._of_radio(course)
        if self._method.feedback == _kernels.SUN_SENSOR:
            self._of_sensor(course)
        self._of_model(day, course, speed, span_s)
        shape = course.count.shape[:2]
        total = np.sqrt(sum((np.broadcast_to(value, shape) for value in self._square.values()), np.zeros(shape)))
        power = day.power_w_per_m2[at] * np.sum(course.normal_enu * course.sun_enu, axis=-1)
        power = np.where(np.isfinite(total), power, 0.0)
        caught = mean_intercept(table, np.nan_to_num(total))
        return np.array([np.sum(power * caught), np.sum(power)])

    # -- where mirrors stand ---------------------------------------------------------------------------------

    def _wanted(self, sun_enu: FloatArray) -> FloatArray:
        """(mirror, time, xyz) normals."""
        shape = (len(self._field), len(sun_enu), 3)
        if self._dish:
            return np.broadcast_to(sun_enu, shape).copy()
        towards = self._field.target[:, None, :3] - self._field.pivot_enu_m[:, None]
        return geometry.bisector_enu(np.broadcast_to(towards, shape), np.broadcast_to(sun_enu, shape))

    def _course(self, sun_enu: FloatArray, heat: FloatArray, target: FloatArray) -> _Course:
        """Return the nominal mirrors' postures that send the sun to targets (mirror, xyz)."""
        shape = (len(self._field), len(sun_enu), 3)
        sun = np.broadcast_to(sun_enu, shape)
        goal = sun if self._dish else np.broadcast_to(target[:, None], shape)
        rows = aim_rows(sun, goal, source_is_point=False, target_is_point=not self._dish)
        nominal, constant = self._field.nominal, self._field.constant
        count, _ = mount_kernels.command_batch(nominal, constant, np.ascontiguousarray(rows))
        seen = np.isfinite(count).all(axis=-1)
        out = mount_kernels.posture_batch(nominal, constant, np.where(seen[..., None], count, 0.0), 0.0)
        return _Course(
            sun_enu=sun_enu, heat=heat, normal_enu=out[..., 2:5], centre_enu_m=out[..., 5:],
            count=np.where(seen[..., None], count, 0.0), rows=rows, seen=seen,
        )  # fmt: skip

    def _jacobian(self, course: _Course, names: tuple[str, ...], *, direct: bool, receiver: bool = False) -> FloatArray:
        """(mirror, time, xyz, name) of the normal less the wanted one; ``direct``: of the normal itself."""
        rows = course.rows
        if direct:
            rows = aim_rows(course.normal_enu, course.normal_enu, source_is_point=False, target_is_point=False)
            rows[..., 9] = float(receiver)
        index = np.array([_INDEX[name] for name in names], np.int64)
        scale = np.array([PARAMETERS[name] for name in names])
        return np.asarray(
            mount_kernels.jacobian_batch(
                self._field.nominal, self._field.constant, course.count, np.ascontiguousarray(rows), course.seen, index,
                scale,
            )
        )  # fmt: skip

    def _speed(self, day: Day, at: npt.NDArray[np.int64], course: _Course) -> FloatArray:
        """(mirror, time, axis) speeds of the axes [rad/s]."""
        beyond = day.sun_enu[at + 1]
        right, up, cosine = course.axes
        moved = (self._wanted(beyond) - self._wanted(course.sun_enu)) / self._plan.servo_interval_s
        return np.stack(
            [np.sum(moved * right, axis=-1) / np.maximum(cosine, 0.05), np.sum(moved * up, axis=-1)], axis=-1
        )

    def _left(self, frequency_hz: npt.ArrayLike) -> FloatArray:
        """Return the square of what feedback leaves of a swinging error of the axes."""
        frequency = np.asarray(frequency_hz, np.float64)
        return np.ones(frequency.shape) if self._loop is None else self._loop.left(frequency) ** 2

    # -- drives ----------------------------------------------------------------------------------------------

    def _of_drive(self, course: _Course, speed: FloatArray) -> None:
        drive = self._plan.drive
        cosine = course.axes[2]
        # teeth of the error: so wide, about a middle that lags behind
        wait = max(drive.dead_band_steps / drive.microsteps, 0.5) if drive.dead_band_steps > 0.0 else 0.5
        width = max(np.floor(wait + 0.5), 1.0) * self._step
        lag = wait * self._step - 0.5 * width
        per_s = np.abs(speed)
        lines = _HARMONICS**-2.0 / np.sum(_HARMONICS**-2.0)
        for axis, across in enumerate((cosine, np.ones_like(cosine))):
            tooth_hz = per_s[..., axis, None] / width * _HARMONICS
            left = self._hunting(self._left(tooth_hz))
            self._add("motor_steps", across**2 * width**2 / 12.0 * (left @ lines))
            if self._gusts.swings:
                self._add("motor_swing", across**2 * width**2 / 12.0 * ((left * self._stirred(tooth_hz)) @ lines))
            slow = np.abs(lag) + 1e-3 * (0.5 * drive.backlash_mrad[axis] + 0.5 * drive.stiction_mrad[axis])
            self._add("play", across**2 * self._of_play(slow, per_s[..., axis], speed[..., axis]))
            stuck = 1e-3 * drive.stiction_mrad[axis]
            if stuck > 0.0:
                left = self._hunting(self._left(per_s[..., axis, None] / stuck * _HARMONICS))
                self._add("stiction", across**2 * stuck**2 / 12.0 * (left @ lines))

    @staticmethod
    def _hunting(left: FloatArray) -> FloatArray:
        """Return the square of what is left of teeth that feedback cannot take away, though it sees them.

        It goes to and fro between two steps, the mean being right: φ(1 − φ) of a step squared, on the average over φ
        twice the tooth's own 1/12. Teeth too quick for it pass as they are.
        """
        return np.asarray(left + 2.0 * np.maximum(1.0 - left, 0.0))

    def _of_play(self, slow_rad: float, per_s: FloatArray, speed: FloatArray) -> FloatArray:
        """Return what an offset that goes with the axis' direction leaves: feedback finds it but after each turn."""
        if self._loop is None:
            return np.full(speed.shape, slow_rad**2)
        turns = np.sum(np.diff(np.sign(speed), axis=1) != 0.0, axis=1, keepdims=True)
        span = 3600.0 * 12.0
        return np.broadcast_to(turns * (2.0 * slow_rad * self._loop.start_rms(0.0, span)) ** 2, speed.shape)

    def _stirred(self, frequency_hz: FloatArray) -> FloatArray:
        """Return the square of the structure's swing for a motor error of one, swinging."""
        gusts, servo = self._gusts, self._plan.servo_interval_s
        back = np.exp(-2j * np.pi * frequency_hz * servo)
        (a, b), (c, d) = gusts.transition.tolist()
        kick = -((1.0 - back) ** 2) / servo
        # x ← Φ (x before + kick of the speed)
        determinant = (1.0 - a * back) * (1.0 - d * back) - b * c * back**2
        return np.asarray(np.abs(((1.0 - d * back) * b + b * back * d) / determinant * kick) ** 2)

    # -- wind ------------------------------------------------------------------------------------------------

    def _of_wind(self) -> None:
        gusts, bend2 = self._gusts, float(np.sum(self._gusts.bend**2))
        sees = self._mirror and self._loop is not None
        self._add("gusts", bend2 * (2.0 * gusts.mean_mps) ** 2 * self._gust_variance(sees))
        if gusts.swings:
            mode = self._plan.structure
            width = mode.damping * mode.natural_hz
            frequency = np.arange(0.5 * width / 20.0, 4.0 * mode.natural_hz, width / 20.0)
            ratio = (frequency / mode.natural_hz) ** 2
            power = 1.0 / ((1.0 - ratio) ** 2 + 4.0 * mode.damping**2 * ratio)
            kept = np.sum(power * (self._left(frequency) if sees else 1.0)) / np.sum(power)
            self._add("resonance", float(np.sum(gusts.swing_sigma_rad**2)) * kept)

    def _gust_variance(self, sees: bool) -> float:
        """Return the variance of gusts that is left [(m/s)²]."""
        if self._plan.wind.record is not None:
            return self._record_variance(sees)
        edges = np.geomspace(1e-6, 50.0, 6000)
        frequency = np.sqrt(edges[1:] * edges[:-1])
        power = self._gusts.process.spectrum(frequency) * np.diff(edges)
        return float(np.sum(power * (self._left(frequency) if sees else 1.0)))

    def _record_variance(self, sees: bool) -> float:
        """Return the same of a measured record over the first day."""
        day = self._days[0]
        gust = self._gusts.run(np.zeros((1, 1)), np.random.default_rng(0), day.unix_s)[0].astype(np.float64)
        power = np.abs(np.fft.rfft(gust)) ** 2 / len(gust) ** 2
        power[1:] *= 2.0
        frequency = np.fft.rfftfreq(len(gust), self._plan.servo_interval_s)
        return float(np.sum(power * (self._left(frequency) if sees else 1.0)))

    # -- radio and sensors -----------------------------------------------------------------------------------

    def _radio_square(self, course: _Course) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(mirror,) variances of noise to the right and up, and (mirror, 2) squares of a reflection's offset [rad²]."""
        assert self._radio is not None
        rng = np.random.default_rng(0)
        at = np.linspace(0, course.count.shape[1] - 1, _N_RADIO).astype(np.int64)
        right, up, offset = [], [], []
        for i in at:
            errors = self._radio.errors(course.normal_enu[:, i], rng)
            spread = np.where(errors.solved[:, None], errors.spread_rad, np.nan)
            right.append(spread[:, 0] ** 2)
            up.append(spread[:, 1] ** 2 + spread[:, 2] ** 2)
            offset.append(errors.bias_rad**2)
        return _mean_known(right), _mean_known(up), np.mean(offset, axis=0)

    def _of_radio(self, course: _Course) -> None:
        assert self._loop is not None
        right, up, offset = self._radio_square(course)
        self._add("radio_noise", (right + up)[:, None] * self._loop.passed**2)
        self._add("reflection", offset.sum(axis=-1)[:, None])
        self._add("plate", self._plate_square().sum(axis=-1)[:, None])
        self._add("plate_drift", self._plate_drift(course)[None] ** 2)

    def _plate_looks(self) -> tuple[int, int]:
        """Return the day and number of looks with which the camera finds the plate."""
        camera = self._plan.camera
        return -max(int(camera.interval_days // 2), 1), camera.points_per_day

    def _plate_square(self) -> FloatArray:
        """(mirror, 2) variance of the plate's tilt that its calibration leaves, right and up."""
        radio, camera = self._plan.radio, self._plan.camera
        if radio.plate_calibration != "camera":
            return np.full((len(self._field), 2), (1e-3 * radio.plate_sigma_mrad) ** 2)
        since, n_look = self._plate_looks()
        looks = self._looks(since, n_look, self._workshop._camera_target())
        right, up, _ = self._radio_square(looks)
        seen = np.mean(self._camera_sigma(looks) ** 2, axis=1)
        constant = (1e-3 * camera.scale_error_sigma_mrad) ** 2
        return np.stack([(seen + right) / n_look + constant, (seen + up) / n_look + constant], axis=-1)

    def _plate_drift(self, course: _Course) -> FloatArray:
        """(time,) tilt to the right that daily warmth leaves."""
        heat = course.heat
        if self._plan.radio.plate_calibration == "camera":
            since, n_look = self._plate_looks()
            heat = heat - np.mean(self._warmth(self._workshop._times(since, n_look)))
        return np.asarray(1e-3 * self._plan.radio.plate_drift_mrad * heat)

    def _of_sensor(self, course: _Course) -> None:
        assert self._loop is not None
        sensor = self._plan.sun_sensor
        level, servo = 2e-3 * sensor.range_mrad / sensor.levels, self._plan.servo_interval_s
        self._add("sensor_null", 2.0 * (1e-3 * sensor.offset_sigma_mrad) ** 2)
        self._add("sensor_drift", 2.0 * (0.5e-3 * sensor.drift_mrad * course.heat[None]) ** 2)
        # about zero the innermost levels are a relay: to and fro by what half a level moves the mirror in a step
        moved = servo * (sensor.gain_per_s + 0.5 * servo * sensor.integral_gain_per_s2) * 0.5 * level
        self._add("sensor_levels", moved**2)

    # -- what is not known of the mounts ---------------------------------------------------------------------

    def _warmth(self, unix_s: FloatArray) -> FloatArray:
        return np.asarray(np.cos(2.0 * np.pi * (hour_of_day(unix_s, self._site) - 15.0) / 24.0))

    def _looks(self, since_first: int, n_look: int, target: FloatArray) -> _Course:
        unix_s = self._workshop._times(since_first, n_look)
        return self._course(sun_position(unix_s, self._site).direction_enu, self._warmth(unix_s), target)

    def _camera_sigma(self, looks: _Course) -> FloatArray:
        """(mirror, look) of one direction of the normal [rad]."""
        distance = np.full(looks.count.shape[:2], 50.0)
        if not self._dish:
            distance = np.linalg.norm(looks.rows[..., 4:7] - looks.centre_enu_m, axis=-1)
        return np.asarray(np.maximum(0.5e-3 * self._plan.camera.spot_sigma_mm / distance, 1e-6))

    def _sigmas(self) -> dict[str, float]:
        """Return the standard deviation of each parameter as built; a fixed one counts with all of its value."""
        e = self._plan.mount_errors
        worm = 1e-3 * e.worm_sigma_mrad / np.sqrt(2.0)
        sigma = {
            "pedestal_tilt_north_rad": 1e-3 * e.tilt_sigma_mrad, "pedestal_tilt_east_rad": 1e-3 * e.tilt_sigma_mrad,
            "axis_1_zero_rad": 1e-3 * e.zero_sigma_mrad, "axis_2_zero_rad": 1e-3 * e.zero_sigma_mrad,
            "nonorthogonality_rad": 1e-3 * e.nonorthogonality_sigma_mrad,
            "canting_up_rad": 1e-3 * e.canting_sigma_mrad, "canting_right_rad": 1e-3 * e.canting_sigma_mrad,
            "gravity_sag_rad": 1e-3 * e.sag_sigma_mrad,
            **dict.fromkeys(_PLACE, 0.001 * e.location_sigma_mm),
            **dict.fromkeys(_WORMS, worm),
        }  # fmt: skip
        nominal = self._field.nominal[0]
        fixed = {name: abs(value - float(nominal[_INDEX[name]])) for name, value in e.fixed.items()}
        # the receivers' plane is drawn apart
        return sigma | {name: value for name, value in fixed.items() if not name.startswith("receiver_plane")}

    def _of_model(self, day: Day, course: _Course, speed: FloatArray, span_s: float) -> None:
        """Add what the model does not know, or of closed loops what they cannot see."""
        before = dict(self._square)
        self._of_knowledge(day, course, speed)
        if self._loop is None:
            return
        morning = sum(float(np.nanmean(value - before.get(name, 0.0))) for name, value in self._square.items())
        if self._method.feedback == _kernels.ENCODER:
            self._square["worm"] = self._of_worm(course, speed)
            level = 2.0 * np.pi / 2**self._plan.encoder.bits
            cosine = course.axes[2]
            self._add("encoder", (1.0 + cosine**2) * (level / np.sqrt(12.0) * self._loop.passed) ** 2)
            return
        # the loop sees normals, not where mirrors stand
        self._square = before
        self._add("place", self._of_place(course))
        self._add("worm", self._of_worm(course, speed))
        self._add("start", morning * self._loop.start_rms(self._plan.settle_s, span_s) ** 2)

    def _of_place(self, course: _Course) -> FloatArray:
        sigma = self._sigmas()
        names = tuple(sigma)
        seen = self._jacobian(course, names, direct=False) - self._jacobian(course, names, direct=True)
        return np.asarray(np.sum((seen * np.array(list(sigma.values()))) ** 2, axis=(-2, -1)))

    def _of_worm(self, course: _Course, speed: FloatArray) -> FloatArray:
        """Return what feedback leaves of a worm's error, which swings as the axis turns."""
        sigma = self._sigmas()
        cosine = course.axes[2]
        total = np.zeros(cosine.shape)
        for axis, across in enumerate((cosine, np.ones_like(cosine))):
            square = sigma[_WORMS[2 * axis]] ** 2 + sigma[_WORMS[2 * axis + 1]] ** 2
            turns_hz = self._plan.drive.worm_ratio * np.abs(speed[..., axis]) / (2.0 * np.pi)
            total += 0.5 * across**2 * square * self._left(turns_hz)
        return total

    def _of_knowledge(self, day: Day, course: _Course, speed: FloatArray) -> None:
        """Propagate all that a model does not know through its calibration to its postures."""
        knowledge, plan = self._method.knowledge, self._plan
        workshop, target = self._workshop, self._workshop._camera_target()
        if knowledge == "nominal":
            self._propagate(day, course, speed, None, (), None)
        elif knowledge in ("bias", "berenguel"):
            days_apart = plan.camera.bias_interval_days if knowledge == "bias" else plan.camera.berenguel_interval_days
            since = workshop._last(day, days_apart)
            looks = self._looks(since, _TURNS, target)
            self._centred(day, course, speed, looks, since)
        elif knowledge == "camera":
            since = workshop._last(day, plan.camera.interval_days)
            looks = self._looks(since, plan.camera.points_per_day, target)
            free = PARAMETER_SETS["malan"] + (_WORMS if plan.camera.worm else ())
            self._propagate(day, course, speed, looks, free, since)
        elif knowledge == "drone":
            since = workshop._last(day, plan.drone.interval_days)
            looks = self._looks(since, plan.drone.points, self._field.target[:, :3])
            free = (*PARAMETER_SETS["edwards-4"], "nonorthogonality_rad")
            self._propagate(day, course, speed, looks, free, since)
        else:
            since = workshop._last(day, plan.radio_model.interval_days)
            looks = self._looks(since, plan.radio_model.points_per_day, self._field.target[:, :3])
            self._propagate(day, course, speed, looks, LEARNED, since)

    def _centred(self, day: Day, course: _Course, speed: FloatArray, looks: _Course, since: int) -> None:
        """As `_propagate` for both zeros from one look, each mirror at a time of its own; mean over these times."""
        kept: dict[str, FloatArray] = self._square
        total: dict[str, FloatArray] = {}
        for i in range(looks.count.shape[1]):
            self._square = {}
            one = _Course(
                sun_enu=looks.sun_enu[i : i + 1], heat=looks.heat[i : i + 1], normal_enu=looks.normal_enu[:, i : i + 1],
                centre_enu_m=looks.centre_enu_m[:, i : i + 1], count=looks.count[:, i : i + 1].copy(),
                rows=looks.rows[:, i : i + 1].copy(), seen=looks.seen[:, i : i + 1],
            )  # fmt: skip
            self._propagate(day, course, speed, one, _ZEROS, since)
            for name, value in self._square.items():
                total[name] = total.get(name, 0.0) + value / looks.count.shape[1]
        self._square = kept
        for name, value in total.items():
            self._add(name, value)
        # taken off in whole steps
        self._add("fit", (1.0 + course.axes[2] ** 2) * self._step**2 / 12.0)

    def _propagate(
        self, day: Day, course: _Course, speed: FloatArray, looks: _Course | None, free: tuple[str, ...],
        since: int | None,
    ) -> None:  # fmt: skip
        """Add the error of each source while tracking, less what the fit makes of it."""
        known = self._jacobian(course, free, direct=False) if free else None
        gain = self._fit_gain(looks, free) if looks is not None else None
        for source in self._sources(day, course, looks, since):
            error = np.zeros((*course.count.shape[:2], 3)) if source.track is None else source.track
            if gain is not None and known is not None and source.look is not None:
                error = error - np.einsum("mtxf,mf->mtx", known, np.einsum("mfly,mly->mf", gain, source.look))
            self._add(source.part, np.where(course.seen, np.sum(error**2, axis=-1), np.nan))
        if gain is not None and looks is not None and known is not None:
            self._add("fit", self._scatter(course, looks, known, gain))

    def _direct(self) -> bool:
        """Whether looks are at normals, not at spots."""
        return self._method.knowledge in ("drone", "radio")

    def _look_sigma(self, looks: _Course) -> FloatArray:
        """(mirror, look, 2) scatter of an instrument's normals, right and up [rad]."""
        knowledge = self._method.knowledge
        if knowledge == "radio":
            right, up, _ = self._radio_square(looks)
            square = np.stack([right, up], axis=-1)[:, None]
        elif knowledge == "drone":
            sigma = drone_sigma_rad(
                looks.centre_enu_m + self._plan.drone.distance_m * looks.sun_enu, looks.centre_enu_m,
                target_enu_m=np.broadcast_to(self._field.target[:, None, :3], looks.centre_enu_m.shape),
            )  # fmt: skip
            square = np.repeat(sigma[..., None] ** 2, 2, axis=-1)
        else:
            square = np.repeat(self._camera_sigma(looks)[..., None] ** 2, 2, axis=-1)
        return np.sqrt(np.broadcast_to(square, (*looks.count.shape[:2], 2)))

    def _fit_gain(self, looks: _Course, free: tuple[str, ...]) -> FloatArray:
        """(mirror, free, look, xyz): what the fit makes of a small turn of a look's normal."""
        jacobian = self._jacobian(looks, free, direct=self._direct(), receiver=self._method.knowledge == "radio")
        own = np.mean(self._look_sigma(looks) ** 2, axis=-1)
        weight = np.where(looks.seen, 1.0 / (own + self._workshop._scatter_rad() ** 2), 0.0)
        prior = np.diag([_PRIORS.get(name, _LARGE)[1] ** -2.0 for name in free])
        prior = np.repeat(prior[None], len(jacobian), axis=0)
        if self._method.knowledge in ("bias", "berenguel"):
            prior[:] = 1e-9 * np.eye(len(free))
            prior[looks.axes[2][:, 0] <= _STEEP, 0, 0] = 1e18
        weighted = jacobian * weight[..., None, None]
        normal = np.einsum("mlxf,mlxg->mfg", weighted, jacobian) + prior
        return np.asarray(np.linalg.solve(normal, np.moveaxis(weighted, 3, 1).reshape(*normal.shape[:2], -1))).reshape(
            *normal.shape[:2], *jacobian.shape[1:3]
        )

    def _scatter(self, course: _Course, looks: _Course, known: FloatArray, gain: FloatArray) -> FloatArray:
        """Return what the scatter of single looks leaves by way of the fit."""
        right, up, cosine = looks.axes
        gusts = self._gusts
        bent = gusts.bend**2 * (2.0 * gusts.mean_mps) ** 2 * self._gust_variance(False) + gusts.swing_sigma_rad**2
        slack = (1e-3 * np.array(self._plan.drive.backlash_mrad)) ** 2 / 12.0
        square = self._look_sigma(looks) ** 2 + bent
        square = square + np.stack([cosine**2 * slack[0], np.full_like(cosine, slack[1])], axis=-1)
        total = np.zeros(course.count.shape[:2])
        for direction, variance in ((right, square[..., 0]), (up, square[..., 1])):
            by_look = np.einsum("mflx,mlx->mfl", gain, direction) * np.sqrt(variance)[:, None]
            spread = np.einsum("mfl,mgl->mfg", by_look, by_look)
            total += np.einsum("mtxf,mfg,mtxg->mt", known, spread, known)
        return total

    def _sources(self, day: Day, course: _Course, looks: _Course | None, since: int | None) -> list[_Source]:
        """Return all that makes mirrors point elsewhere than the model has it."""
        found = self._mount_sources(day, course, looks, since)
        right, up, _ = course.axes
        steady = self._gusts.mean_mps**2 * self._gusts.bend
        at_look = None if looks is None else looks.axes
        for a, direction in enumerate((right, up)):
            seen = None if at_look is None else steady[a] * at_look[a]
            found.append(_Source("steady_wind", seen, steady[a] * direction))
        if at_look is None or looks is None:
            return found
        for a, square in enumerate(self._constant_square().T):
            found.append(_Source("instrument", np.sqrt(square)[:, None, None] * at_look[a], None))
        if self._method.knowledge == "radio":
            found.append(_Source("plate_drift", self._plate_drift(looks)[None, :, None] * at_look[0], None))
        return found

    def _constant_square(self) -> FloatArray:
        """(mirror, 2) variance of the instrument's constant error."""
        knowledge, plan = self._method.knowledge, self._plan
        if knowledge == "radio":
            return self._plate_square()
        sigma = plan.drone.constant_sigma_mrad if knowledge == "drone" else plan.camera.scale_error_sigma_mrad
        return np.full((len(self._field), 2), (1e-3 * sigma) ** 2)

    def _mount_sources(self, day: Day, course: _Course, looks: _Course | None, since: int | None) -> list[_Source]:
        sigma = self._sigmas()
        names = tuple(sigma)
        track = self._jacobian(course, names, direct=False)
        seen = None
        if looks is not None:
            seen = self._jacobian(looks, names, direct=self._direct(), receiver=self._method.knowledge == "radio")
        found = []
        for i, name in enumerate(names):
            part = "place" if name in _PLACE else "worm" if name in _WORMS else "mount"
            found.append(
                _Source(part, None if seen is None else sigma[name] * seen[..., i], sigma[name] * track[..., i])
            )
        e = self._plan.mount_errors
        lean, creep = 1e-3 * e.thermal_sigma_mrad, 1e-3 * e.creep_sigma_mrad_per_month / _MONTH_DAYS
        for i in (names.index("pedestal_tilt_north_rad"), names.index("pedestal_tilt_east_rad")):
            by_day = None if seen is None or looks is None else lean * looks.heat[None, :, None] * seen[..., i]
            found.append(_Source("heat", by_day, lean * course.heat[None, :, None] * track[..., i]))
            grown = None if seen is None or since is None else creep * since * seen[..., i]
            found.append(_Source("creep", grown, creep * day.since_first * track[..., i]))
        return found

    # -- light -----------------------------------------------------------------------------------------------

    def _offered_kwh(self) -> tuple[float, float]:
        """Return the light on a square metre of mirror, over the scenario's days and over a year."""
        towards = None if self._dish else self._field.target[:, :3] - self._field.pivot_enu_m
        low = float(np.deg2rad(self._plan.min_sun_elevation_deg))
        stride = max(1, round(60.0 / self._plan.servo_interval_s))
        total = 0.0
        for day in self._every:
            at = np.flatnonzero(day.works)[::stride]
            found = energy(
                self._site, day.unix_s[at], target_enu=towards, beam_w_m2=day.power_w_per_m2[at], min_elevation_rad=0.0
            )
            total += float(np.mean(found.offered_j_m2))
        times = representative_days(self._site, self._plan.date.year, 12)
        year = energy(self._site, times, target_enu=towards, min_elevation_rad=low)
        return total / 3.6e6, float(np.mean(year.offered_j_m2)) * 365.25 / 12.0 / 3.6e6


def _mean_known(values: list[FloatArray]) -> FloatArray:
    """Return the mean over the first axis of what is no NaN; nothing known: zero."""
    known = np.isfinite(values)
    return np.asarray(np.sum(np.nan_to_num(values), axis=0) / np.maximum(known.sum(axis=0), 1))


def _part_of(whole: Field, some: npt.NDArray[np.int64]) -> Field:
    """Return some mirrors of a field."""
    rows = {f.name: getattr(whole, f.name)[some] for f in dataclasses.fields(whole) if f.name != "ids"}
    return Field(ids=tuple(whole.ids[i] for i in some), **rows)
