"""The run: all methods through the same days, on the same sun, wind, hidden errors and lost frames."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, read_only
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.mount import PARAMETERS
from rfpose.feedback.servo import PiLaw, Stepper
from rfpose.feedback.servo._kernels import DriveNumbers, LawNumbers
from rfpose.feedback.servo.margins import Margins
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.capture import N_CAPTURE, TOP_RAD, capture_table
from rfpose.feedback.tracking.hidden import Field, azimuth_course_rad, draw_field, generator
from rfpose.feedback.tracking.instruments import LEARNED, Workshop
from rfpose.feedback.tracking.loops import check_gains
from rfpose.feedback.tracking.methods import Method, choose
from rfpose.feedback.tracking.operation import Operation, Told, who_of
from rfpose.feedback.tracking.radio import RadioModel
from rfpose.feedback.tracking.sky import under_sky
from rfpose.feedback.tracking.timeline import Day, days, site_of
from rfpose.feedback.tracking.wind import Gusts
from rfpose.scenario import Scenario

__all__ = ["Curves", "Simulation", "Sums"]

Arrays = dict[str, npt.NDArray[np.generic]]

SEGMENT_S = 900.0
"""Simulated time between two points at which a run can be taken up again."""
_FORGET_OFFSET_S = 300.0
_FIRST_SIGMA_RAD = 0.3e-3
_EARTH_RADPS = 7.2921159e-5
_FREE = np.array([list(PARAMETERS).index(name) for name in LEARNED])
_SCALE = np.array([PARAMETERS[name] for name in LEARNED])


@dataclass(frozen=True, slots=True, kw_only=True)
class Sums:
    """What one method's mirrors added up to.

    Attributes
    ----------
    total : (day, mirror, sum)
        Sums by the kernels' names.
    by_mode : (day, mirror, mode, 3)
        Seconds, light offered and caught [J/m²] while the field was to work, by `Mode`.
    hours : (mirror, 24, 2)
        Steps and squared normal errors by hour of local mean solar time.
    histogram : (mirror, bin)
        Of normal errors, `BINS_PER_DECADE` a decade from `LOWEST_RAD`.
    """

    total: FloatArray
    by_mode: FloatArray
    hours: FloatArray
    histogram: npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Curves:
    """Courses of one method; time axis is `Simulation.stored_unix_s`.

    Attributes
    ----------
    rms_rad, p95_rad, worst_rad : (time,)
        Normal error over the field at that instant; NaN while nothing has been simulated.
    normal_enu : (time, stored, xyz)
        True normals of the stored mirrors.
    error_rad : (time, stored)
        Their errors; NaN while a mirror is not on the receiver.
    motor_count : (time, stored, axis)
        Motor positions.
    shift_enu : (time, stored, xyz)
        What feedback adds to the normal that the model is asked for.
    flux : (time,)
        Light on the receiver over that of a perfect field on its aim.
    mode_count : (time, mode)
        Mirrors in each `Mode`.
    mode : (time, stored)
        Modes of the stored mirrors.
    """

    rms_rad: FloatArray
    p95_rad: FloatArray
    worst_rad: FloatArray
    normal_enu: FloatArray
    error_rad: FloatArray
    motor_count: FloatArray
    shift_enu: FloatArray
    flux: FloatArray
    mode_count: npt.NDArray[np.int32]
    mode: npt.NDArray[np.int8]


@dataclass(slots=True, kw_only=True)
class _Run:
    """One method under way."""

    method: Method
    loop: _kernels.Loop
    law: LawNumbers
    model: FloatArray
    cov: FloatArray
    state: FloatArray
    ring: FloatArray
    total: FloatArray
    by_mode: FloatArray
    hours: FloatArray
    histogram: npt.NDArray[np.int64]
    curve: FloatArray
    trace: FloatArray
    stored_error: FloatArray
    light: FloatArray
    mode_count: npt.NDArray[np.int32]
    mode: npt.NDArray[np.int8]
    operation: Operation | None = None
    happened: list[dict[str, Any]] = field(default_factory=list)

    def arrays(self) -> Arrays:
        """Return all that changes, by name."""
        return {name: getattr(self, name) for name in _RUN_ARRAYS}


_RUN_ARRAYS = (
    "model", "cov", "state", "ring", "total", "by_mode", "hours", "histogram", "curve", "trace", "stored_error",
    "light", "mode_count", "mode",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Segment:
    """A stretch of one day."""

    i_day: int
    first: int
    end: int
    first_stored: int = field(default=0)


class Simulation:
    """A field tracked by several methods; go through it with `advance`.

    Parameters
    ----------
    scenario
        Site, mirrors, radio, and ``[tracking]``.
    methods
        Names of `METHODS`; none: all that can steer the collector.
    count
        Number of mirrors; None: those of the scenario.
    seed
        Everything random follows from it; what one method meets does not depend on which others run.

    Raises
    ------
    ScenarioError, GeometryError, InvalidInputError
        The scenario cannot be tracked: no mirrors, no site, no sun, an aim point that no mirror reaches, transmitters
        that fix nothing, gains without margin.
    """

    def __init__(
        self, scenario: Scenario, *, methods: Sequence[str] = (), count: int | None = None, seed: int = 0
    ) -> None:
        if isinstance(seed, bool) or seed < 0:
            raise InvalidInputError(f"`seed` must be a non-negative integer, got {seed!r}")
        plan = scenario.tracking
        self.scenario, self.seed = scenario, int(seed)
        self.methods = choose(methods, collector=plan.collector)
        self.days: tuple[Day, ...] = under_sky(scenario, days(scenario), seed=self.seed)
        course = self.days[0].sun_enu[:: max(1, round(60.0 / plan.servo_interval_s))]
        self.field: Field = draw_field(scenario, count=count, seed=self.seed, sun_enu=course)
        self.gusts = Gusts(scenario)
        self.gusts.check_covers(self.days)
        needs_radio = any(m.radio for m in self.methods)
        self.margins: Margins | None = check_gains(scenario) if needs_radio else None
        self.radio = None
        if needs_radio:
            usual = self._wanted_normal(self.days[0], int(np.argmax(self.days[0].sun_enu[:, 2])))
            self.radio = RadioModel(scenario, self.field.pivot_enu_m, usual_normal_enu=usual)
        self._workshop = Workshop(scenario, self.field, self.radio, self.gusts, seed=self.seed)
        self._stride = round(plan.store_interval_s / plan.servo_interval_s)
        self.segments = self._segments()
        self._table = capture_table(scenario)
        if plan.field_control is not None:
            for event in plan.event:  # refuse names that nobody has before days go by
                who_of(event, self.field, plan.field_control.bus.cluster_size)
        n = len(self.field)
        self.stored = np.unique(np.linspace(0, n - 1, min(plan.stored, n)).astype(np.int64))
        self._runs = [self._start(m) for m in self.methods]
        self._gust_state = self.gusts.process.start(generator(self.seed, 1, 0), n)
        self.done = 0
        self._check_reach()

    # -- plan ----------------------------------------------------------------------------------------------

    @property
    def n_segment(self) -> int:
        """Number of stretches to advance through."""
        return len(self.segments)

    @property
    def stored_unix_s(self) -> FloatArray:
        """(time,) instants of the curves, all days in turn [s since 1970 UTC]."""
        return np.concatenate([day.unix_s[:: self._stride] for day in self.days])

    @property
    def stored_sun_enu(self) -> FloatArray:
        """(time, xyz) sun at the curves' instants."""
        return np.concatenate([day.sun_enu[: len(day.unix_s) : self._stride] for day in self.days])

    @property
    def stored_day(self) -> npt.NDArray[np.int64]:
        """(time,) which day each instant belongs to."""
        return np.concatenate([np.full(len(d.unix_s[:: self._stride]), i) for i, d in enumerate(self.days)])

    def _segments(self) -> tuple[_Segment, ...]:
        length = max(1, round(SEGMENT_S / self.scenario.tracking.store_interval_s)) * self._stride
        found, stored = [], 0
        for i, day in enumerate(self.days):
            n_step = len(day.unix_s)
            for first in range(0, n_step, length):
                found.append(
                    _Segment(
                        i_day=i,
                        first=first,
                        end=min(first + length, n_step),
                        first_stored=stored + first // self._stride,
                    )
                )
            stored += -(-n_step // self._stride)
        return tuple(found)

    def _check_reach(self) -> None:
        """Refuse a field of which no mirror reaches its aim at noon."""
        from rfpose.feedback import _kernels as mount_kernels
        from rfpose.feedback.mount import aim_rows

        day = self.days[0]
        noon = day.sun_enu[int(np.argmax(day.sun_enu[:, 2]))]
        dish = bool(self.field.target[0, 3])
        goal = np.broadcast_to(noon, (len(self.field), 1, 3)) if dish else self.field.target[:, None, :3]
        rows = aim_rows(
            np.broadcast_to(noon, (len(self.field), 1, 3)), goal, source_is_point=False, target_is_point=not dish
        )
        _, status = mount_kernels.command_batch(self.field.nominal, self.field.constant, np.ascontiguousarray(rows))
        if np.all(status != 0):
            raise ScenarioError(
                f"no mirror reaches its aim point on {day.date} at noon: {self.field.ids[0]} is "
                f"{'beyond its limits' if status[0, 0] == 2 else 'without a posture'}; check `aim_enu_m` and "
                "[tracking.drive] limits"
            )

    def _loop(self, method: Method) -> tuple[_kernels.Loop, LawNumbers]:
        plan = self.scenario.tracking
        radio, servo = plan.radio, plan.servo_interval_s
        control = round(plan.control_interval_s / servo)
        interval, latency, gain, integral, level = control, 1, 1.0, 0.0, 1.0  # what is seen in a step acts in the next
        if method.feedback == _kernels.RADIO:
            gain, integral = radio.gain_per_s, radio.integral_gain_per_s2
            latency = max(int(np.ceil(radio.latency_s / servo - 1e-9)), 1)
            if latency > (_kernels.N_RING - 1) * interval:
                raise InvalidInputError(
                    f"[tracking.radio] `latency_s` {radio.latency_s:g} is more than {_kernels.N_RING - 1} control "
                    "intervals; shorten it or lengthen `control_interval_s`"
                )
        elif method.feedback == _kernels.ENCODER:
            interval, gain, level = 1, plan.encoder.gain_per_s, 2.0 * np.pi / 2**plan.encoder.bits
        elif method.feedback == _kernels.SUN_SENSOR:
            sensor = plan.sun_sensor
            interval, gain, integral = 1, sensor.gain_per_s, sensor.integral_gain_per_s2
            level = 2e-3 * sensor.range_mrad / sensor.levels
        seconds = interval * servo
        learn = max(1, round(plan.radio_model.learn_interval_s / plan.control_interval_s)) if method.learns else 0
        law = PiLaw(
            gain_per_s=gain,
            integral_gain_per_s2=integral,
            speed_radps=1e-3 * plan.drive.speed_mradps,
            levels=0,
        ).numbers()
        loop = _kernels.Loop(
            feedback=method.feedback,
            interval=interval,
            latency=latency,
            leak=float(np.exp(-seconds / _FORGET_OFFSET_S)) if method.learns else 1.0,
            learn=learn,
            wind_variance=self.gusts.variance_rad2,
            settle=round(plan.settle_s / servo),
            servo_s=servo,
            level=level,
            reach=1e-3 * plan.sun_sensor.range_mrad,
            # an error of the normal moves a heliostat's image by twice itself, a dish's by once: so the tables have it
            per_rad=(N_CAPTURE - 1) / TOP_RAD,
            control=control,
            **self._sky(),
            **self._structure(),
        )
        return loop, law

    def _sky(self) -> dict[str, Any]:
        """Return what a mirror needs to carry a sun that it heard of on."""
        plan, site = self.scenario.tracking, site_of(self.scenario)
        carries = plan.field_control is not None and plan.field_control.between_messages == "carried-on"
        return {
            "pole_n": float(np.cos(site.latitude_rad)),
            "pole_u": float(np.sin(site.latitude_rad)),
            "turn": _EARTH_RADPS * plan.servo_interval_s if carries else 0.0,
        }

    def _structure(self) -> dict[str, Any]:
        """Return how the structure swings."""
        gusts = self.gusts
        (y_y, y_v), (v_y, v_v) = gusts.transition.tolist()
        (root_y, _), (root_vy, root_v) = gusts.root.tolist()
        right, up = gusts.swing_sigma_rad.tolist()
        return {
            "swings": gusts.swings, "y_y": y_y, "y_v": y_v, "v_y": v_y, "v_v": v_v, "root_y": root_y,
            "root_vy": root_vy, "root_v": root_v, "swing_right": right, "swing_up": up,
        }  # fmt: skip

    def _drive(self, axis: int) -> DriveNumbers:
        """Return one axis's motor and gear in counts and servo steps."""
        drive, servo = self.scenario.tracking.drive, self.scenario.tracking.servo_interval_s
        count = 2.0 * np.pi / drive.steps_per_turn
        wait = drive.dead_band_steps * count if drive.dead_band_steps > 0.0 else None
        numbers = Stepper(
            steps_per_turn=drive.steps_per_turn,
            microsteps=drive.microsteps,
            speed_radps=1e-3 * drive.speed_mradps,
            backlash_rad=1e-3 * drive.backlash_mrad[axis],
            stiction_rad=1e-3 * drive.stiction_mrad[axis],
            dead_band_rad=wait,
        ).numbers(servo)
        return DriveNumbers(
            step=numbers.step / count,
            speed=numbers.speed * servo / count,
            half_backlash=numbers.half_backlash / count,
            stiction=numbers.stiction / count,
            dead_band=numbers.dead_band / count,
            lead=numbers.lead / count,
        )

    def _start(self, method: Method) -> _Run:
        n, n_time = len(self.field), len(self.stored_unix_s)
        n_free = len(_FREE)
        loop, law = self._loop(method)
        cov = np.zeros((n, n_free, n_free)) if method.learns else np.zeros((1, n_free, n_free))
        if method.learns:
            cov[:, np.arange(n_free), np.arange(n_free)] = _FIRST_SIGMA_RAD**2
        return _Run(
            method=method,
            loop=loop,
            law=law,
            model=self.field.nominal.copy(),
            cov=cov,
            state=np.zeros((n, _kernels.N_STATE)),
            ring=np.zeros((n, _kernels.N_RING, _kernels.N_ENTRY)),
            total=np.zeros((len(self.days), n, _kernels.N_SUM)),
            by_mode=np.zeros((len(self.days), n, len(Mode), 3)),
            hours=np.zeros((n, 24, 2)),
            histogram=np.zeros((n, _kernels.N_BIN), np.int64),
            curve=np.full((n_time, 4), np.nan),
            trace=np.full((max(len(self.stored), 1), n_time, 8), np.nan),
            stored_error=np.full((n_time, len(self.stored)), np.nan),
            light=np.zeros((n, 2)),
            mode_count=np.zeros((n_time, len(Mode)), np.int32),
            mode=np.full((n_time, len(self.stored)), -1, np.int8),
        )

    # -- go on ---------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Simulate the next stretch of time."""
        segment = self.segments[self.done]
        day = self.days[segment.i_day]
        plan, n = self.scenario.tracking, len(self.field)
        if segment.first == 0:
            self._gust_state[:] = self.gusts.process.start(generator(self.seed, 1, segment.i_day), n)
            for run in self._runs:
                self._begin_day(run, segment.i_day)
        place = (segment.i_day, segment.first)
        n_step = segment.end - segment.first
        control = round(plan.control_interval_s / plan.servo_interval_s)
        n_frame = -(-n_step // control)
        gust = self.gusts.run(
            self._gust_state, generator(self.seed, 2, *place), day.unix_s[segment.first : segment.end]
        )
        rng = generator(self.seed, 3, *place)
        noise = rng.standard_normal((n, n_frame, 2), dtype=np.float32)
        lost = (rng.random((n, n_frame), dtype=np.float32) < plan.radio.lost_frames).astype(np.uint8)
        outage = self._outage(day.hour[segment.first : segment.end])
        spread, bias = np.zeros((n, 3)), np.zeros((n, 2))
        if self.radio is not None:
            errors = self.radio.errors(self._wanted_normal(day, (segment.first + segment.end) // 2), rng)
            spread, bias = errors.spread_rad.copy(), errors.bias_rad.copy()
            lost[~errors.solved] = 1
        draws = _Draws(
            gust=gust,
            swing=self.gusts.draw_swing(rng, (n, n_step)),
            noise=noise,
            lost=lost,
            outage=outage,
            spread=spread,
            bias=bias,
        )
        for run in self._runs:
            self._go_through(run, segment, draws)
            if run.operation is not None and (segment.end == len(day.unix_s)):
                self._end_day(run, segment.i_day)
        self.done += 1

    def _go_through(self, run: _Run, segment: _Segment, draws: _Draws) -> None:
        """Take one method through a stretch: at once, or from word to word of its field control."""
        day, field = self.days[segment.i_day], self.field
        n, n_step = len(field), segment.end - segment.first
        steps = slice(segment.first, segment.end)
        stored = np.full(n, -1, np.int64)
        stored[self.stored] = np.arange(len(self.stored))
        n_stored = -(-n_step // self._stride)
        error, light = np.full((n, n_stored), np.nan), np.zeros((n, n_stored, 2))
        trace = np.full((max(len(self.stored), 1), n_stored, 8), np.nan)
        is_sensor = run.method.feedback == _kernels.SUN_SENSOR
        drift = self._sensor_drift() if is_sensor else field.plate_drift_rad
        true = field.at(day.since_first)
        cov = run.cov if run.method.learns else np.broadcast_to(run.cov, (n, *run.cov.shape[1:])).copy()
        heat, power, hour_of = day.heat[steps].copy(), _power(day)[steps].copy(), day.hour[steps].astype(np.int64)
        sun = day.sun_enu[segment.first : segment.end + run.loop.interval + 1].copy()
        drives, walk = (self._drive(0), self._drive(1)), self._walk()
        told = Told.always_track(field)
        s = 0
        while s < n_step:
            end = n_step
            if run.operation is not None:
                _home(true, field.at(day.since_first), run.operation)
                told = run.operation.tell(
                    segment.first + s, (segment.first, segment.end), state=run.state, model=run.model, true=true,
                    light=run.light, gust=draws.gust,
                )  # fmt: skip
                end = told.until - segment.first
                _home(true, field.at(day.since_first), run.operation)
            at = slice(*(segment.first_stored - (-each // self._stride) for each in (s, end)))
            run.mode_count[at] = np.bincount(told.mode, minlength=len(Mode))
            run.mode[at] = told.mode[self.stored]
            _kernels.advance(
                run.loop, run.law, *drives, self._table,
                segment.first, s, end, told.duty, told.renew, told.scored, told.mode, told.aim, told.goal, told.heard,
                told.age, true, field.constant, field.lean_rad, heat, run.model, cov, _FREE, _SCALE, walk, sun,
                field.target, draws.gust, self.gusts.mean_mps, self.gusts.bend, draws.swing, draws.noise, draws.spread,
                draws.bias, draws.lost, draws.outage, power, drift, field.sensor_bias_rad,
                run.state, run.ring, run.total[segment.i_day], run.by_mode[segment.i_day], run.hours, hour_of,
                run.histogram, self._stride, error, light, stored, trace, run.light,
            )  # fmt: skip
            s = end
        at = slice(segment.first_stored, segment.first_stored + n_stored)
        run.curve[at, :3] = _over_field(error)
        run.curve[at, 3] = light[..., 0].sum(axis=0) / light[..., 1].sum(axis=0)
        run.trace[:, at] = trace
        run.stored_error[at] = error[self.stored].T

    def _first_count(self, day: Day) -> FloatArray:
        """Return about where azimuth motors begin a day, on the turn that leaves its course nearest to the middle."""
        course = day.sun_enu[:: max(1, round(60.0 / self.scenario.tracking.servo_interval_s))]
        first, middle = azimuth_course_rad(self.scenario, self.field.pivot_enu_m, course)
        home, per_rad = self.field.constant[:, 15], self.field.constant[:, 13]
        turns = np.rint((middle - home) / (2.0 * np.pi))
        return np.asarray((first - home - 2.0 * np.pi * turns) * per_rad)

    def _begin_day(self, run: _Run, i_day: int) -> None:
        day = self.days[i_day]
        run.state[:] = 0.0
        run.ring[:] = 0.0
        run.light[:] = 0.0
        run.state[:, _kernels.NEXT] = self._first_count(day)
        run.operation = self._operation(run.method, i_day)
        if run.operation is not None:
            run.operation.park(run.state)
        if run.method.learns and i_day > 0:
            passed = day.since_first - self.days[i_day - 1].since_first
            sigma = 1e-3 * self.scenario.tracking.radio_model.forget_mrad_per_sqrt_day
            run.cov[:, np.arange(len(_FREE)), np.arange(len(_FREE))] += sigma**2 * passed
            return
        run.model[:] = self._workshop.model(run.method, day)

    def _operation(self, method: Method, i_day: int) -> Operation | None:
        if self.scenario.tracking.field_control is None:
            return None
        return Operation(
            self.scenario, self.field, self.gusts, self.days[i_day], i_day=i_day, feedback=method.feedback,
            seed=self.seed,
        )  # fmt: skip

    def _end_day(self, run: _Run, i_day: int) -> None:
        """Keep what field control has to tell of a day."""
        assert run.operation is not None
        run.operation.end()
        run.happened.append({"day": str(self.days[i_day].date)} | run.operation.report())

    def _walk(self) -> FloatArray:
        """Variance that the rolling fit adds to each parameter at a step."""
        plan = self.scenario.tracking.radio_model
        return np.full(len(_FREE), (1e-3 * plan.forget_mrad_per_sqrt_day) ** 2 * plan.learn_interval_s / 86_400.0)

    def _sensor_drift(self) -> FloatArray:
        rng = generator(self.seed, 7)
        return np.asarray(0.5e-3 * self.scenario.tracking.sun_sensor.drift_mrad * rng.standard_normal(len(self.field)))

    def _wanted_normal(self, day: Day, i_step: int) -> FloatArray:
        sun = day.sun_enu[i_step]
        if self.field.target[0, 3]:
            return np.broadcast_to(sun, (len(self.field), 3)).copy()
        return geometry.bisector_enu(self.field.target[:, :3] - self.field.pivot_enu_m, sun)

    def _outage(self, hour: FloatArray) -> npt.NDArray[np.uint8]:
        """(mirror, step) one where the radio is lost."""
        n = len(self.field)
        out = np.zeros((n, len(hour)), np.uint8)
        for i, outage in enumerate(self.scenario.tracking.radio.outages):
            dark = (hour >= outage.first_hour) & (hour < outage.last_hour)
            hit = generator(self.seed, 8, i).random(n) < outage.share
            out |= (hit[:, None] & dark[None]).astype(np.uint8)
        return out

    # -- results -------------------------------------------------------------------------------------------

    def sums(self, name: str) -> Sums:
        """Return what a method's mirrors have added up to so far."""
        run = self._run(name)
        return Sums(
            total=read_only(run.total),
            by_mode=read_only(run.by_mode),
            hours=read_only(run.hours),
            histogram=read_only(run.histogram),
        )

    def happened(self, name: str) -> list[dict[str, Any]]:
        """Return what a method's field control has to tell of each day that is over; empty without field control."""
        return list(self._run(name).happened)

    def curves(self, name: str) -> Curves:
        """Return a method's courses so far."""
        run = self._run(name)
        trace = np.swapaxes(run.trace[: len(self.stored)], 0, 1)
        return Curves(
            rms_rad=read_only(run.curve[:, 0]),
            p95_rad=read_only(run.curve[:, 1]),
            worst_rad=read_only(run.curve[:, 2]),
            normal_enu=read_only(trace[..., :3]),
            error_rad=read_only(run.stored_error),
            motor_count=read_only(trace[..., 3:5]),
            shift_enu=read_only(trace[..., 5:8]),
            flux=read_only(run.curve[:, 3]),
            mode_count=read_only(run.mode_count),
            mode=read_only(run.mode),
        )

    def _run(self, name: str) -> _Run:
        return next(run for run in self._runs if run.method.name == name)

    # -- interruption --------------------------------------------------------------------------------------

    def state(self) -> Arrays:
        """Return all that going on depends on."""
        found: Arrays = {"done": np.array(self.done), "gust": self._gust_state}
        for run in self._runs:
            arrays = run.arrays() | {"happened": np.frombuffer(json.dumps(run.happened).encode(), np.uint8).copy()}
            if run.operation is not None:
                arrays |= {f"operation/{name}": values for name, values in run.operation.state().items()}
            found |= {f"{run.method.name}/{name}": values for name, values in arrays.items()}
        return found

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Go back to what `state` gave, of a run with the same arguments."""
        self.done = int(state["done"])
        self._gust_state[:] = state["gust"]
        i_day = self.segments[max(self.done - 1, 0)].i_day
        for run in self._runs:
            name = run.method.name
            for key, values in run.arrays().items():
                values[...] = state[f"{name}/{key}"]
            run.happened = json.loads(bytes(state[f"{name}/happened"]).decode())
            place = f"{name}/operation/"
            kept = {key[len(place) :]: values for key, values in state.items() if key.startswith(place)}
            if kept:
                run.operation = self._operation(run.method, i_day)
                assert run.operation is not None
                run.operation.restore(kept)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Draws:
    """What a stretch of time brings to all methods alike; see `_kernels.advance`."""

    gust: npt.NDArray[np.float32]
    swing: npt.NDArray[np.float32]
    noise: npt.NDArray[np.float32]
    lost: npt.NDArray[np.uint8]
    outage: npt.NDArray[np.uint8]
    spread: FloatArray
    bias: FloatArray


def _power(day: Day) -> FloatArray:
    """Return the beam as the kernels want it: negative while the field is not to work."""
    return np.where(day.works, day.power_w_per_m2, -1.0)


def _home(true: FloatArray, built: FloatArray, operation: Operation) -> None:
    """Let the true zeros of the axes be where homing left them."""
    true[:, 3:5] = built[:, 3:5] + operation.homing_rad


def _over_field(error: FloatArray) -> FloatArray:
    """(time, 3) rms, 95 % and worst over the mirrors that have an error."""
    out = np.full((error.shape[1], 3), np.nan)
    seen = np.isfinite(error).any(axis=0)
    some = error[:, seen]
    out[seen, 0] = np.sqrt(np.nanmean(some**2, axis=0))
    out[seen, 1] = np.nanpercentile(some, 95.0, axis=0)
    out[seen, 2] = np.nanmax(some, axis=0)
    return out
