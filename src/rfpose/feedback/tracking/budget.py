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

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.feedback import _kernels as mount_kernels
from rfpose.feedback.columns import M, P, columns_of, scales_of
from rfpose.feedback.energy import combine_errors_rad, energy, representative_days
from rfpose.feedback.mount import aim_rows
from rfpose.feedback.servo.margins import is_stable
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.calibrations import (
    STEEP,
    CalibrationPlan,
    calibration_of,
    posture_scatter_rad,
    prior_sigma,
)
from rfpose.feedback.tracking.capture import TOP_RAD
from rfpose.feedback.tracking.hidden import MONTH_DAYS, PLACE, WORMS, sigma_as_built
from rfpose.feedback.tracking.instruments import RadioPoses
from rfpose.feedback.tracking.loops import loop_of
from rfpose.feedback.tracking.methods import Method, choose
from rfpose.feedback.tracking.plant import Plant
from rfpose.feedback.tracking.postures import PosturesInTime
from rfpose.feedback.tracking.radio import RadioByPosture
from rfpose.feedback.tracking.sampled_loop import SampledLoop
from rfpose.feedback.tracking.timeline import Day, site_of
from rfpose.scenario import Scenario

__all__ = ["MethodBudget", "SampledLoop", "mean_intercept", "track_budget"]

_N_MIRROR, _N_DAY, _N_TIME = 48, 12, 48
_HARMONICS = np.arange(1, 17)
_LINES = _HARMONICS**-2.0 / np.sum(_HARMONICS**-2.0)
"""What part of a sawtooth's square each of its harmonics has."""
_TILTS = ("pedestal_tilt_north_rad", "pedestal_tilt_east_rad")

Squares = dict[str, FloatArray]
"""Squared errors by part, (mirror, time) or what broadcasts to it [rad²]."""


# -- result ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodBudget:
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


def track_budget(scenario: Scenario, method: str, *, count: int | None = None) -> MethodBudget:
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
        As `rfpose.feedback.tracking.TrackingSimulation` does, but for gains, which may have any margin above none.
    """
    chosen = choose((method,), collector=scenario.tracking.collector)[0]
    return _Propagation(scenario, chosen, count).budget()


# -- where it comes from -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tracked:
    """Part of a day while it counts: postures of the nominal mirrors, and how fast their axes turn."""

    day: Day
    at: npt.NDArray[np.int64]
    """(time,) steps that stand for all, """
    span_s: float
    """which last so long."""
    postures: PosturesInTime
    speed: FloatArray = field(repr=False)
    """(mirror, time, axis) [rad/s]"""

    @property
    def across(self) -> tuple[FloatArray, FloatArray]:
        """(mirror, time) what the normal turns by when axis 1 or axis 2 turns by one."""
        cosine = self.postures.cos_elevation
        return cosine, np.ones_like(cosine)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Looked:
    """A calibration so many days after the run's first: its looks, and what it makes of them."""

    calibration: CalibrationPlan
    since_first: int
    looks: PosturesInTime


@dataclass(frozen=True, slots=True)
class _Source:
    """Something that makes mirrors point elsewhere, of variance one: at the looks (…, xyz) and while tracking."""

    part: str
    look: FloatArray | None
    track: FloatArray | None


class _Propagation:
    """Propagates the errors of one method."""

    def __init__(self, scenario: Scenario, method: Method, count: int | None) -> None:
        plan = scenario.tracking
        if plan.sky == "bursts":  # what they cut off is not the method's doing
            scenario = scenario.model_copy(update={"tracking": plan.model_copy(update={"sky": "clear"})})
        self._scenario, self._method, self._plan = scenario, method, plan
        self._plant = plant = Plant(scenario, count=count, seed=0).sample(_N_MIRROR)
        self._field, self._gusts = plant.field, plant.gusts
        self._loop = loop_of(scenario, method.feedback)
        self._radio: RadioPoses | None = None
        model: RadioByPosture | None = None
        if method.radio:
            self._check_stable()
            model = RadioByPosture(scenario, plant.field.pivot_enu_m, usual_normal_enu=plant.usual_normal_enu())
            self._radio = RadioPoses(plant, model)
        self._calibration = calibration_of(method.knowledge, plant, model)
        self._sees_mirror = method.feedback in (_kernels.RADIO, _kernels.SUN_SENSOR)
        self._sigma = sigma_as_built(scenario) | self._fixed()

    def _check_stable(self) -> None:
        loop = loop_of(self._scenario, _kernels.RADIO)
        assert loop is not None
        if not is_stable(loop.law, None, interval_s=loop.interval_s, latency_s=loop.delay_s):
            raise InvalidInputError("[tracking.radio] these gains oscillate: no budget tells how far; lower them")

    def _fixed(self) -> dict[str, float]:
        """Return parameters that all mirrors have alike: such a one counts with all of its value."""
        nominal, fixed = self._field.nominal[0], self._plan.mount_errors.fixed
        # the receivers' plane is drawn apart
        return {
            name: abs(value - float(nominal[getattr(P, name)]))
            for name, value in fixed.items()
            if not name.startswith("receiver_plane")
        }

    def budget(self) -> MethodBudget:
        """Return the budget: parts are averaged over days, mirrors and times."""
        every, table = self._plant.days, self._plant.table
        squares: list[dict[str, float]] = []
        light = np.zeros(2)
        for i in np.unique(np.linspace(0, len(every) - 1, min(_N_DAY, len(every))).astype(int)):
            tracked = self._tracked(every[i])
            found = self._squares(tracked)
            light += self._light(tracked, found)
            squares.append({name: float(np.nanmean(value)) for name, value in found.items()})
        parts = {f"{name}_rad": float(np.sqrt(np.mean([s[name] for s in squares]))) for name in squares[0]}
        budget = MethodBudget(method=self._method.name, **parts)
        day_kwh, year_kwh = self._offered_kwh()
        return dataclasses.replace(
            budget,
            intercept=float(mean_intercept(table, budget.total_rad)),
            posture_intercept=float(light[0] / light[1]) if light[1] > 0.0 else float("nan"),
            perfect_intercept=float(table[0]),
            offered_kwh_per_m2=day_kwh,
            offered_kwh_per_m2_year=year_kwh,
        )

    def _squares(self, tracked: _Tracked) -> Squares:
        """Return a day's squares by part."""
        found = self._of_drive(tracked) | self._of_wind()
        if self._method.feedback == _kernels.RADIO:
            found |= self._of_radio(tracked)
        if self._method.feedback == _kernels.SUN_SENSOR:
            found |= self._of_sensor(tracked)
        return found | self._of_model(tracked)

    def _light(self, tracked: _Tracked, squares: Squares) -> FloatArray:
        """Return light caught and offered, each posture with its own errors."""
        shape = tracked.postures.seen.shape
        total = np.sqrt(sum((np.broadcast_to(value, shape) for value in squares.values()), np.zeros(shape)))
        facing = np.sum(tracked.postures.normal_enu * tracked.postures.sun_enu, axis=-1)
        power = np.where(np.isfinite(total), tracked.day.power_w_per_m2[tracked.at] * facing, 0.0)
        caught = mean_intercept(self._plant.table, np.nan_to_num(total))
        return np.array([np.sum(power * caught), np.sum(power)])

    # -- where mirrors stand ---------------------------------------------------------------------------------

    def _tracked(self, day: Day) -> _Tracked:
        servo_s = self._plan.servo_interval_s
        scored = np.flatnonzero(day.works & (np.arange(len(day.unix_s)) * servo_s >= self._plan.settle_s))
        if not scored.size:
            scored = np.arange(len(day.unix_s))
        at = scored[np.linspace(0, len(scored) - 1, min(_N_TIME, len(scored))).astype(np.int64)]
        postures = self._plant.nominal_postures(day.sun_enu[at], day.heat[at], self._field.target[:, :3])
        right, up = postures.right_up
        now, later = (np.stack([self._plant.wanted_normal_enu(day, i) for i in at + ahead], axis=1) for ahead in (0, 1))
        moved = (later - now) / servo_s
        across = np.sum(moved * right, axis=-1) / np.maximum(postures.cos_elevation, 0.05)
        speed = np.stack([across, np.sum(moved * up, axis=-1)], axis=-1)
        return _Tracked(day=day, at=at, span_s=len(scored) * servo_s, postures=postures, speed=speed)

    def _jacobian(
        self, postures: PosturesInTime, names: tuple[str, ...], *, direct: bool = False, of_receiver_plane: bool = False
    ) -> FloatArray:
        """(mirror, time, xyz, name) of the normal less the wanted one; ``direct``: of the normal itself."""
        rows = postures.rows
        if direct:
            rows = aim_rows(postures.normal_enu, postures.normal_enu, source_is_point=False, target_is_point=False)
            rows[..., M.of_receiver_plane] = float(of_receiver_plane)
        return np.asarray(
            mount_kernels.jacobian_batch(
                self._field.nominal, self._field.constant, postures.count, np.ascontiguousarray(rows), postures.seen,
                columns_of(names), scales_of(names),
            )
        )  # fmt: skip

    def _seen_jacobian(self, looked: _Looked, names: tuple[str, ...]) -> FloatArray:
        """Return the same of what a calibration's instrument sees."""
        instrument = looked.calibration.instrument
        return self._jacobian(
            looked.looks, names, direct=not instrument.sees_spots, of_receiver_plane=instrument.sees_receiver_plane
        )

    def _left(self, frequency_hz: npt.ArrayLike) -> FloatArray:
        """Return the square of what feedback leaves of a swinging error of the axes."""
        frequency = np.asarray(frequency_hz, np.float64)
        return np.ones(frequency.shape) if self._loop is None else self._loop.left(frequency) ** 2

    # -- drives ----------------------------------------------------------------------------------------------

    def _of_drive(self, tracked: _Tracked) -> Squares:
        drive, step = self._plan.drive, self._plan.drive.step_rad
        # a sawtooth of the error: so wide, about a middle that lags behind
        wait = max(drive.dead_band_steps / drive.microsteps, 0.5) if drive.dead_band_steps > 0.0 else 0.5
        width = max(np.floor(wait + 0.5), 1.0) * step
        lag = wait * step - 0.5 * width
        zero = np.zeros(tracked.postures.seen.shape)
        found: Squares = {"motor_steps": zero}
        if self._gusts.swings:
            found["motor_swing"] = zero
        found["play"] = zero
        for axis, across in enumerate(tracked.across):
            speed = tracked.speed[..., axis]
            tooth_hz = np.abs(speed)[..., None] / width * _HARMONICS
            left = _hunting(self._left(tooth_hz))
            saw = across**2 * width**2 / 12.0
            found["motor_steps"] = found["motor_steps"] + saw * (left @ _LINES)
            if self._gusts.swings:
                found["motor_swing"] = found["motor_swing"] + saw * ((left * self._stirred(tooth_hz)) @ _LINES)
            slow = np.abs(lag) + 1e-3 * (0.5 * drive.backlash_mrad[axis] + 0.5 * drive.stiction_mrad[axis])
            found["play"] = found["play"] + across**2 * self._of_play(slow, speed)
            stuck = 1e-3 * drive.stiction_mrad[axis]
            if stuck > 0.0:
                left = _hunting(self._left(np.abs(speed)[..., None] / stuck * _HARMONICS))
                found["stiction"] = found.get("stiction", zero) + across**2 * stuck**2 / 12.0 * (left @ _LINES)
        return found

    def _of_play(self, slow_rad: float, speed: FloatArray) -> FloatArray:
        """Return what an offset that goes with the axis' direction leaves: feedback finds it but after each turn."""
        if self._loop is None:
            return np.full(speed.shape, slow_rad**2)
        turns = np.sum(np.diff(np.sign(speed), axis=1) != 0.0, axis=1, keepdims=True)
        span = 3600.0 * 12.0
        return np.broadcast_to(turns * (2.0 * slow_rad * self._loop.start_rms(0.0, span)) ** 2, speed.shape)

    def _stirred(self, frequency_hz: FloatArray) -> FloatArray:
        """Return the square of the structure's swing for a motor error of one, swinging."""
        servo = self._plan.servo_interval_s
        back = np.exp(-2j * np.pi * frequency_hz * servo)
        (a, b), (c, d) = self._gusts.transition.tolist()
        kick = -((1.0 - back) ** 2) / servo
        # x ← Φ (x before + kick of the speed)
        determinant = (1.0 - a * back) * (1.0 - d * back) - b * c * back**2
        return np.asarray(np.abs(((1.0 - d * back) * b + b * back * d) / determinant * kick) ** 2)

    # -- wind ------------------------------------------------------------------------------------------------

    def _of_wind(self) -> Squares:
        gusts = self._gusts
        left = (2.0 * gusts.mean_mps) ** 2 * self._gust_variance(self._sees_mirror)
        found: Squares = {"gusts": np.asarray(np.sum(gusts.bend**2) * left)}
        if gusts.swings:
            mode = self._plan.structure
            width = mode.damping * mode.natural_hz
            frequency = np.arange(0.5 * width / 20.0, 4.0 * mode.natural_hz, width / 20.0)
            ratio = (frequency / mode.natural_hz) ** 2
            power = 1.0 / ((1.0 - ratio) ** 2 + 4.0 * mode.damping**2 * ratio)
            kept = np.sum(power * (self._left(frequency) if self._sees_mirror else 1.0)) / np.sum(power)
            found["resonance"] = np.asarray(np.sum(gusts.swing_sigma_rad**2) * kept)
        return found

    def _gust_variance(self, sees: bool) -> float:
        """Return the variance of gusts that is left [(m/s)²]; of a record over the first day."""
        frequency: FloatArray
        if self._gusts.recorded:
            day = self._plant.days[0]
            gust = self._gusts.run(np.zeros((1, 1)), np.random.default_rng(0), day.unix_s)[0].astype(np.float64)
            power = np.abs(np.fft.rfft(gust)) ** 2 / len(gust) ** 2
            power[1:] *= 2.0
            frequency = np.asarray(np.fft.rfftfreq(len(gust), self._plan.servo_interval_s), np.float64)
        else:
            edges = np.geomspace(1e-6, 50.0, 6000)
            frequency = np.sqrt(edges[1:] * edges[:-1])
            power = self._gusts.process.spectrum(frequency) * np.diff(edges)
        return float(np.sum(power * (self._left(frequency) if sees else 1.0)))

    # -- radio and sensors -----------------------------------------------------------------------------------

    def _of_radio(self, tracked: _Tracked) -> Squares:
        assert self._loop is not None
        assert self._radio is not None
        frame = self._radio.expected(tracked.postures)
        return {
            "radio_noise": frame.noise.sum(axis=-1)[:, None] * self._loop.passed**2,
            "reflection": frame.bias.sum(axis=-1)[:, None],
            "plate": self._radio.constant_variance_rad2().sum(axis=-1)[:, None],
            "plate_drift": self._radio.drift_sigma_rad(tracked.postures.heat)[None] ** 2,
        }

    def _of_sensor(self, tracked: _Tracked) -> Squares:
        sensor, servo = self._plan.sun_sensor, self._plan.servo_interval_s
        # about zero the innermost levels are a relay: to and fro by what half a level moves the mirror in a step
        moved = servo * (sensor.gain_per_s + 0.5 * servo * sensor.integral_gain_per_s2) * 0.5 * sensor.level_rad
        return {
            "sensor_null": np.asarray(2.0 * (1e-3 * sensor.offset_sigma_mrad) ** 2),
            "sensor_drift": 2.0 * (0.5e-3 * sensor.drift_mrad * tracked.postures.heat[None]) ** 2,
            "sensor_levels": np.asarray(moved**2),
        }

    # -- what is not known of the mounts ---------------------------------------------------------------------

    def _of_model(self, tracked: _Tracked) -> Squares:
        """Return what the model does not know, or of closed loops what they cannot see."""
        unknown = self._of_knowledge(tracked)
        if self._loop is None:
            return unknown
        if self._method.feedback == _kernels.ENCODER:
            one, other = tracked.across
            level = self._plan.encoder.level_rad / np.sqrt(12.0) * self._loop.passed
            return unknown | {"worm": self._of_worm(tracked), "encoder": (other + one**2) * level**2}
        # the loop sees normals, not where mirrors stand
        morning = sum(float(np.nanmean(value)) for value in unknown.values())
        return {
            "place": self._of_place(tracked.postures),
            "worm": self._of_worm(tracked),
            "start": np.asarray(morning * self._loop.start_rms(self._plan.settle_s, tracked.span_s) ** 2),
        }

    def _of_place(self, postures: PosturesInTime) -> FloatArray:
        names = tuple(self._sigma)
        seen = self._jacobian(postures, names) - self._jacobian(postures, names, direct=True)
        return np.asarray(np.sum((seen * np.array(list(self._sigma.values()))) ** 2, axis=(-2, -1)))

    def _of_worm(self, tracked: _Tracked) -> FloatArray:
        """Return what feedback leaves of a worm's error, which swings as the axis turns."""
        total = np.zeros(tracked.postures.seen.shape)
        for axis, across in enumerate(tracked.across):
            square = self._sigma[WORMS[2 * axis]] ** 2 + self._sigma[WORMS[2 * axis + 1]] ** 2
            turns_hz = self._plan.drive.worm_ratio * np.abs(tracked.speed[..., axis]) / (2.0 * np.pi)
            total += 0.5 * across**2 * square * self._left(turns_hz)
        return total

    def _of_knowledge(self, tracked: _Tracked) -> Squares:
        """Propagate all that a model does not know through its calibration to its postures."""
        calibration = self._calibration
        if calibration is None:
            return self._propagated(tracked, None)
        since = calibration.last(tracked.day)
        looks = self._plant.nominal_looks(since, calibration.n_look, calibration.instrument.target_enu_m)
        if not calibration.corrections:
            return self._propagated(tracked, _Looked(calibration=calibration, since_first=since, looks=looks))
        # both zeros from one look, each mirror at a time of its own: the mean over these times
        total: Squares = {}
        for i in range(calibration.n_look):
            one = _Looked(calibration=calibration, since_first=since, looks=looks.only(i))
            for name, value in self._propagated(tracked, one).items():
                total[name] = total.get(name, np.zeros(())) + value / calibration.n_look
        # taken off in whole steps
        one_axis, other = tracked.across
        total["fit"] = total["fit"] + (other + one_axis**2) * self._plan.drive.step_rad**2 / 12.0
        return total

    def _propagated(self, tracked: _Tracked, looked: _Looked | None) -> Squares:
        """Return the error of each source while tracking, less what the calibration makes of it."""
        found: Squares = {}
        known = gain = None
        if looked is not None:
            known = self._jacobian(tracked.postures, looked.calibration.free)
            gain = self._fit_gain(looked)
        seen = tracked.postures.seen
        for source in self._sources(tracked, looked):
            error = np.zeros((*seen.shape, 3)) if source.track is None else source.track
            if gain is not None and known is not None and source.look is not None:
                error = error - np.einsum("mtxf,mf->mtx", known, np.einsum("mfly,mly->mf", gain, source.look))
            square = np.where(seen, np.sum(error**2, axis=-1), np.nan)
            found[source.part] = found.get(source.part, np.zeros(())) + square
        if looked is not None and known is not None and gain is not None:
            found["fit"] = self._scatter(looked, known, gain)
        return found

    def _fit_gain(self, looked: _Looked) -> FloatArray:
        """(mirror, free, look, xyz): what the calibration makes of a small turn of a look's normal."""
        calibration, looks = looked.calibration, looked.looks
        free = calibration.free
        jacobian = self._seen_jacobian(looked, free)
        own = np.mean(calibration.instrument.variance_rad2(looks), axis=-1)
        weight = np.where(looks.seen, 1.0 / (own + posture_scatter_rad(self._plant) ** 2), 0.0)
        prior = np.diag([prior_sigma(name) ** -2.0 for name in free])
        prior = np.repeat(prior[None], len(jacobian), axis=0)
        if calibration.corrections:
            prior[:] = 1e-9 * np.eye(len(free))
            prior[looks.cos_elevation[:, 0] <= STEEP, 0, 0] = 1e18
        weighted = jacobian * weight[..., None, None]
        normal = np.einsum("mlxf,mlxg->mfg", weighted, jacobian) + prior
        return np.asarray(np.linalg.solve(normal, np.moveaxis(weighted, 3, 1).reshape(*normal.shape[:2], -1))).reshape(
            *normal.shape[:2], *jacobian.shape[1:3]
        )

    def _scatter(self, looked: _Looked, known: FloatArray, gain: FloatArray) -> FloatArray:
        """Return what the scatter of single looks leaves by way of the calibration."""
        looks, gusts = looked.looks, self._gusts
        right, up = looks.right_up
        cosine = looks.cos_elevation
        bent = gusts.bend**2 * (2.0 * gusts.mean_mps) ** 2 * self._gust_variance(False) + gusts.swing_sigma_rad**2
        slack = (1e-3 * np.array(self._plan.drive.backlash_mrad)) ** 2 / 12.0
        square = looked.calibration.instrument.variance_rad2(looks) + bent
        square = square + np.stack([cosine**2 * slack[0], np.full_like(cosine, slack[1])], axis=-1)
        total = np.zeros(known.shape[:2])
        for direction, variance in ((right, square[..., 0]), (up, square[..., 1])):
            by_look = np.einsum("mflx,mlx->mfl", gain, direction) * np.sqrt(variance)[:, None]
            spread = np.einsum("mfl,mgl->mfg", by_look, by_look)
            total += np.einsum("mtxf,mfg,mtxg->mt", known, spread, known)
        return total

    def _sources(self, tracked: _Tracked, looked: _Looked | None) -> list[_Source]:
        """Return all that makes mirrors point elsewhere than the model has it."""
        found = self._mount_sources(tracked, looked)
        steady = self._gusts.mean_mps**2 * self._gusts.bend
        at_look = None if looked is None else looked.looks.right_up
        for a, direction in enumerate(tracked.postures.right_up):
            seen = None if at_look is None else steady[a] * at_look[a]
            found.append(_Source("steady_wind", seen, steady[a] * direction))
        if looked is None or at_look is None:
            return found
        instrument = looked.calibration.instrument
        for a, square in enumerate(instrument.constant_variance_rad2().T):
            found.append(_Source("instrument", np.sqrt(square)[:, None, None] * at_look[a], None))
        if isinstance(instrument, RadioPoses):
            drift = instrument.drift_sigma_rad(looked.looks.heat)
            found.append(_Source("plate_drift", drift[None, :, None] * at_look[0], None))
        return found

    def _mount_sources(self, tracked: _Tracked, looked: _Looked | None) -> list[_Source]:
        names = tuple(self._sigma)
        track = self._jacobian(tracked.postures, names)
        seen = None if looked is None else self._seen_jacobian(looked, names)
        found = []
        for i, (name, sigma) in enumerate(self._sigma.items()):
            part = "place" if name in PLACE else "worm" if name in WORMS else "mount"
            found.append(_Source(part, None if seen is None else sigma * seen[..., i], sigma * track[..., i]))
        e = self._plan.mount_errors
        lean, creep = 1e-3 * e.thermal_sigma_mrad, 1e-3 * e.creep_sigma_mrad_per_month / MONTH_DAYS
        for i in (names.index(name) for name in _TILTS):
            warm = tracked.postures.heat[None, :, None]
            by_day = grown = None
            if seen is not None and looked is not None:
                by_day = lean * looked.looks.heat[None, :, None] * seen[..., i]
                grown = creep * looked.since_first * seen[..., i]
            found.append(_Source("heat", by_day, lean * warm * track[..., i]))
            found.append(_Source("creep", grown, creep * tracked.day.since_first * track[..., i]))
        return found

    # -- light -----------------------------------------------------------------------------------------------

    def _offered_kwh(self) -> tuple[float, float]:
        """Return the light on a square metre of mirror, over the scenario's days and over a year."""
        site, mirrors = site_of(self._scenario), self._field
        towards = None if mirrors.is_dish else mirrors.target[:, :3] - mirrors.pivot_enu_m
        stride = max(1, round(60.0 / self._plan.servo_interval_s))
        total = 0.0
        for day in self._plant.days:
            at = np.flatnonzero(day.works)[::stride]
            found = energy(
                site, day.unix_s[at], target_enu=towards, beam_w_m2=day.power_w_per_m2[at], min_elevation_rad=0.0
            )
            total += float(np.mean(found.offered_j_m2))
        times = representative_days(site, self._plan.date.year, 12)
        low = float(np.deg2rad(self._plan.min_sun_elevation_deg))
        year = energy(site, times, target_enu=towards, min_elevation_rad=low)
        return total / 3.6e6, float(np.mean(year.offered_j_m2)) * 365.25 / 12.0 / 3.6e6


def _hunting(left: FloatArray) -> FloatArray:
    """Return the square of what is left of teeth that feedback cannot take away, though it sees them.

    It goes to and fro between two steps, the mean being right: φ(1 − φ) of a step squared, on the average over φ
    twice the tooth's own 1/12. Teeth too quick for it pass as they are.
    """
    return np.asarray(left + 2.0 * np.maximum(1.0 - left, 0.0))
