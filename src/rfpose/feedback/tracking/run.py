"""One method under way: its mirrors' state, what they add up to, and how it goes through a stretch of time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.mount import PARAMETERS
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.hidden import Field, azimuth_course_rad, generator
from rfpose.feedback.tracking.instruments import LEARNED, Workshop
from rfpose.feedback.tracking.loops import drive_numbers, loop_numbers
from rfpose.feedback.tracking.methods import Method
from rfpose.feedback.tracking.operation import Operation, Told
from rfpose.feedback.tracking.timeline import Day
from rfpose.feedback.tracking.wind import Gusts
from rfpose.scenario import Scenario

__all__ = ["Curves", "Draws", "MethodRun", "Segment", "Sums", "World"]

Arrays = dict[str, npt.NDArray[Any]]

_FIRST_SIGMA_RAD = 0.3e-3
_FREE = np.array([list(PARAMETERS).index(name) for name in LEARNED])
_SCALE = np.array([PARAMETERS[name] for name in LEARNED])
_ARRAYS = (
    "model", "cov", "state", "ring", "total", "by_mode", "by_outage", "hours", "histogram", "curve", "trace",
    "stored_error", "light", "mode_count", "mode",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """What all methods of a run share.

    Attributes
    ----------
    scenario, seed, field, gusts, days
        The run.
    workshop
        Makes the models that methods begin with.
    table
        Of `capture.capture_table`.
    stored : (stored,)
        Rows of the mirrors whose courses are kept.
    stride
        Servo steps between two instants that are kept.
    """

    scenario: Scenario
    seed: int
    field: Field
    gusts: Gusts
    days: tuple[Day, ...]
    workshop: Workshop
    table: FloatArray
    stored: npt.NDArray[np.int64]
    stride: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """A stretch of one day, from step ``first`` to before ``end``; ``first_stored`` among all instants kept."""

    i_day: int
    first: int
    end: int
    first_stored: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Draws:
    """What a stretch of time brings to all methods alike; see `_kernels.advance`."""

    gust: npt.NDArray[np.float32]
    swing: npt.NDArray[np.float32]
    noise: npt.NDArray[np.float32]
    lost: npt.NDArray[np.uint8]
    outage: npt.NDArray[np.uint8]
    spread: FloatArray
    bias: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Sums:
    """What one method's mirrors added up to.

    Attributes
    ----------
    total : (day, mirror, sum)
        Sums by the kernels' names.
    by_mode : (day, mirror, mode, 3)
        Seconds, light offered and caught [J/m²] while the field was to work, by `Mode`.
    by_outage : (mirror, outage, 4)
        Steps, squared normal errors, light offered and caught while radio was out, all days.
    hours : (mirror, 24, 2)
        Steps and squared normal errors by hour of local mean solar time.
    histogram : (mirror, bin)
        Of normal errors, `BINS_PER_DECADE` a decade from `LOWEST_RAD`.
    """

    total: FloatArray
    by_mode: FloatArray
    by_outage: FloatArray
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


class MethodRun:
    """One method under way.

    Parameters
    ----------
    method
        Which.
    world
        What it shares with the others.
    """

    def __init__(self, method: Method, world: World) -> None:
        self.method, self._world = method, world
        n, n_free, n_kept = len(world.field), len(_FREE), len(world.stored)
        n_time = sum(-(-len(day.unix_s) // world.stride) for day in world.days)
        self.loop, self.law = loop_numbers(world.scenario, method, world.gusts)
        self.model = world.field.nominal.copy()
        self.cov = np.zeros((n if method.learns else 1, n_free, n_free))
        if method.learns:
            self.cov[:, np.arange(n_free), np.arange(n_free)] = _FIRST_SIGMA_RAD**2
        self.state = np.zeros((n, _kernels.N_STATE))
        self.ring = np.zeros((n, _kernels.N_RING, _kernels.N_ENTRY))
        self.total = np.zeros((len(world.days), n, _kernels.N_SUM))
        self.by_mode = np.zeros((len(world.days), n, len(Mode), 3))
        self.by_outage = np.zeros((n, max(len(world.scenario.tracking.radio.outages), 1), 4))
        self.hours = np.zeros((n, 24, 2))
        self.histogram = np.zeros((n, _kernels.N_BIN), np.int64)
        self.curve = np.full((n_time, 4), np.nan)
        self.trace = np.full((max(n_kept, 1), n_time, 8), np.nan)
        self.stored_error = np.full((n_time, n_kept), np.nan)
        self.light = np.zeros((n, 2))
        self.mode_count = np.zeros((n_time, len(Mode)), np.int32)
        self.mode = np.full((n_time, n_kept), -1, np.int8)
        self.happened: list[dict[str, Any]] = []
        self._operation: Operation | None = None

    # -- days ----------------------------------------------------------------------------------------------

    def begin_day(self, i_day: int) -> None:
        """Put motors where the day begins, and take up the model that the method has that morning."""
        world, day = self._world, self._world.days[i_day]
        self.state[:] = 0.0
        self.ring[:] = 0.0
        self.light[:] = 0.0
        self.state[:, _kernels.NEXT] = self._first_count(day)
        # overnight counts are referenced anew; what was learned of counts that homing moved is worth nothing then
        homed = None if self._operation is None else self._operation.homing_rad.any(axis=1)
        self._operation = self._operate(i_day)
        if self._operation is not None:
            self._operation.park(self.state)
        if self.method.learns and i_day > 0:
            passed = day.since_first - world.days[i_day - 1].since_first
            sigma = 1e-3 * world.scenario.tracking.radio_model.forget_mrad_per_sqrt_day
            self.cov[:, np.arange(len(_FREE)), np.arange(len(_FREE))] += sigma**2 * passed
            if homed is not None and homed.any():
                self.model[homed] = world.workshop.model(self.method, day)[homed]
                self.cov[homed] = _FIRST_SIGMA_RAD**2 * np.eye(len(_FREE))
            return
        self.model[:] = world.workshop.model(self.method, day)

    def _operate(self, i_day: int) -> Operation | None:
        world = self._world
        if world.scenario.tracking.field_control is None:
            return None
        return Operation(
            world.scenario, world.field, world.gusts, world.days[i_day], i_day=i_day, feedback=self.method.feedback,
            seed=world.seed,
        )  # fmt: skip

    def _first_count(self, day: Day) -> FloatArray:
        """Return about where azimuth motors begin a day, on the turn that leaves its course nearest to the middle."""
        scenario, field = self._world.scenario, self._world.field
        course = day.sun_enu[:: max(1, round(60.0 / scenario.tracking.servo_interval_s))]
        first, middle = azimuth_course_rad(scenario, field.pivot_enu_m, course)
        home, per_rad = field.constant[:, 15], field.constant[:, 13]
        turns = np.rint((middle - home) / (2.0 * np.pi))
        return np.asarray((first - home - 2.0 * np.pi * turns) * per_rad)

    # -- going on ------------------------------------------------------------------------------------------

    def go_through(self, segment: Segment, draws: Draws) -> None:
        """Take the method through a stretch: at once, or from word to word of its field control."""
        world, operation = self._world, self._operation
        field, day, plan = world.field, world.days[segment.i_day], world.scenario.tracking
        n, n_step = len(field), segment.end - segment.first
        steps = slice(segment.first, segment.end)
        kept = np.full(n, -1, np.int64)
        kept[world.stored] = np.arange(len(world.stored))
        n_kept = -(-n_step // world.stride)
        error, light = np.full((n, n_kept), np.nan), np.zeros((n, n_kept, 2))
        trace = np.full((max(len(world.stored), 1), n_kept, 8), np.nan)
        built = field.at(day.since_first)
        true = built.copy()
        cov = self.cov if self.method.learns else np.broadcast_to(self.cov, (n, *self.cov.shape[1:])).copy()
        walk = np.full(
            len(_FREE),
            (1e-3 * plan.radio_model.forget_mrad_per_sqrt_day) ** 2 * plan.radio_model.learn_interval_s / 86_400.0,
        )
        heat, hour_of = day.heat[steps].copy(), day.hour[steps].astype(np.int64)
        # negative: the field is not to work
        power = np.where(day.works, day.power_w_per_m2, -1.0)[steps].copy()
        sun = day.sun_enu[segment.first : segment.end + self.loop.interval + 1].copy()
        drives, drift = [drive_numbers(world.scenario, axis) for axis in (0, 1)], self._drift_rad()
        told = Told.always_track(field)
        advance = partial(_kernels.advance_some, 0, n) if n <= _kernels.FEW else _kernels.advance
        s = 0
        while s < n_step:
            end = n_step
            if operation is not None:
                told = operation.tell(
                    segment.first + s, (segment.first, segment.end), state=self.state, model=self.model, true=true,
                    light=self.light, gust=draws.gust,
                )  # fmt: skip
                end = told.until - segment.first
                true[:, 3:5] = built[:, 3:5] + operation.homing_rad
            at = slice(*(segment.first_stored - (-each // world.stride) for each in (s, end)))
            self.mode_count[at] = np.bincount(told.mode, minlength=len(Mode))
            self.mode[at] = told.mode[world.stored]
            advance(
                self.loop, self.law, *drives, world.table,
                segment.first, s, end, told.duty, told.renew, told.scored, told.mode, told.aim, told.goal, told.heard,
                told.age, true, field.constant, field.lean_rad, heat, self.model, cov, _FREE, _SCALE, walk, sun,
                field.target, draws.gust, world.gusts.mean_mps, world.gusts.bend, draws.swing, draws.noise,
                draws.spread, draws.bias, draws.lost, draws.outage, power, drift, field.sensor_bias_rad,
                self.state, self.ring, self.total[segment.i_day], self.by_mode[segment.i_day], self.by_outage,
                self.hours, hour_of, self.histogram, world.stride, error, light, kept, trace, self.light,
            )  # fmt: skip
            s = end
        at = slice(segment.first_stored, segment.first_stored + n_kept)
        self.curve[at, :3] = _over_field(error)
        self.curve[at, 3] = light[..., 0].sum(axis=0) / light[..., 1].sum(axis=0)
        self.trace[:, at] = trace
        self.stored_error[at] = error[world.stored].T
        if operation is not None and segment.end == len(day.unix_s):
            operation.end()
            self.happened.append({"day": str(day.date)} | operation.report())

    def _drift_rad(self) -> FloatArray:
        """(mirror,) amplitude of what the method's instrument drifts by in a day [rad]."""
        world = self._world
        if self.method.feedback != _kernels.SUN_SENSOR:
            return world.field.plate_drift_rad
        draw = generator(world.seed, 7).standard_normal(len(world.field))
        return np.asarray(0.5e-3 * world.scenario.tracking.sun_sensor.drift_mrad * draw)

    # -- results -------------------------------------------------------------------------------------------

    def sums(self) -> Sums:
        """Return what the mirrors have added up to so far."""
        return Sums(
            total=read_only(self.total),
            by_mode=read_only(self.by_mode),
            by_outage=read_only(self.by_outage[:, : len(self._world.scenario.tracking.radio.outages)]),
            hours=read_only(self.hours),
            histogram=read_only(self.histogram),
        )

    def curves(self) -> Curves:
        """Return the courses so far."""
        trace = np.swapaxes(self.trace[: len(self._world.stored)], 0, 1)
        return Curves(
            rms_rad=read_only(self.curve[:, 0]),
            p95_rad=read_only(self.curve[:, 1]),
            worst_rad=read_only(self.curve[:, 2]),
            normal_enu=read_only(trace[..., :3]),
            error_rad=read_only(self.stored_error),
            motor_count=read_only(trace[..., 3:5]),
            shift_enu=read_only(trace[..., 5:8]),
            flux=read_only(self.curve[:, 3]),
            mode_count=read_only(self.mode_count),
            mode=read_only(self.mode),
        )

    # -- interruption --------------------------------------------------------------------------------------

    def arrays(self) -> Arrays:
        """Return all that going on depends on, by name."""
        found: Arrays = {name: getattr(self, name) for name in _ARRAYS}
        found["happened"] = np.frombuffer(json.dumps(self.happened).encode(), np.uint8).copy()
        if self._operation is not None:
            found |= {f"operation/{name}": values for name, values in self._operation.state().items()}
        return found

    def restore(self, arrays: Mapping[str, npt.NDArray[Any]], i_day: int) -> None:
        """Go back to what `arrays` gave in the course of a day."""
        for name in _ARRAYS:
            getattr(self, name)[...] = arrays[name]
        self.happened = json.loads(bytes(arrays["happened"]).decode())
        self._operation = self._operate(i_day)
        if self._operation is not None:
            place = "operation/"
            self._operation.restore({k[len(place) :]: v for k, v in arrays.items() if k.startswith(place)})


def _over_field(error: FloatArray) -> FloatArray:
    """(time, 3) rms, 95 % and worst over the mirrors that have an error."""
    out = np.full((error.shape[1], 3), np.nan)
    seen = np.isfinite(error).any(axis=0)
    some = error[:, seen]
    out[seen, 0] = np.sqrt(np.nanmean(some**2, axis=0))
    out[seen, 1] = np.nanpercentile(some, 95.0, axis=0)
    out[seen, 2] = np.nanmax(some, axis=0)
    return out
