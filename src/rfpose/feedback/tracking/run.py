"""One method under way: what its mirrors add up to and show, stretch of time by stretch of time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.calibrations import Calibrator
from rfpose.feedback.tracking.engine import Arrays, MethodEngine, StretchDraws, always_track, empty_courses, empty_tally
from rfpose.feedback.tracking.hidden import ZEROS
from rfpose.feedback.tracking.methods import Method
from rfpose.feedback.tracking.operation import Operation
from rfpose.feedback.tracking.plant import Plant

__all__ = ["Curves", "KeptCourses", "MethodRun", "MethodSums", "Segment"]

_BY_DAY = ("total", "by_mode", "by_outage", "hours")
_BY_TIME = ("curve", "trace", "stored_error", "mode_count", "mode")
_ARRAYS = (*_BY_DAY, *_BY_TIME, "histogram", "today")


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptCourses:
    """Of which mirrors courses are kept, by row (stored,), and how many servo steps apart."""

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
class MethodSums:
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
    histogram: npt.NDArray[np.int32]


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
    plant
        Its field.
    calibrator
        Makes the models that it begins days with.
    kept
        Of which mirrors courses are kept.
    """

    def __init__(self, method: Method, plant: Plant, calibrator: Calibrator, kept: KeptCourses) -> None:
        self._method, self._plant, self._calibrator, self._kept = method, plant, calibrator, kept
        n, n_kept, n_day = len(plant.field), len(kept.stored), len(plant.days)
        n_time = sum(-(-len(day.unix_s) // kept.stride) for day in plant.days)
        self._n_outage = len(plant.scenario.tracking.radio.outages)
        self.engine = MethodEngine(method, plant)
        # floats are kept by day and added up in the order of days, whoever simulated which of them
        empty = empty_tally(n, self._n_outage)
        self.total, self.by_mode, self.by_outage, self.hours = (
            np.repeat(part[None], n_day, axis=0) for part in (empty.total, empty.by_mode, empty.by_outage, empty.hours)
        )
        self.histogram, self.today = empty.histogram, np.zeros_like(empty.histogram)
        self.curve = np.full((n_time, 4), np.nan)
        self.trace = np.full((n_time, n_kept, 8), np.nan)
        self.stored_error = np.full((n_time, n_kept), np.nan)
        self.mode_count = np.zeros((n_time, len(Mode)), np.int32)
        self.mode = np.full((n_time, n_kept), -1, np.int8)
        self.happened: list[dict[str, Any] | None] = [None] * n_day
        self._operation: Operation | None = None
        # what a method that learns takes from one day to the next: a day under way can be begun again
        n_learned = n if method.learns and n_day > 1 else 0
        self._evening: Arrays = {
            "model": self.engine.model[:n_learned].copy(),
            "cov": self.engine.cov[:n_learned].copy(),
            "homed": np.zeros(n_learned, np.bool_),
        }

    # -- days ----------------------------------------------------------------------------------------------

    def begin_day(self, i_day: int) -> None:
        """Put motors where the day begins, and take up the model that the method has that morning."""
        plant, day, engine = self._plant, self._plant.days[i_day], self.engine
        self.drop_today()
        for name in _BY_DAY:
            getattr(self, name)[i_day] = 0.0
        engine.rest(plant.first_count(day))
        self._operation = self._operate(i_day)
        if self._operation is not None:
            self._operation.park(engine.state)
        if not self._method.learns or i_day == 0:
            engine.model[:] = self._calibrator.model(self._method, day)
            return
        engine.model[:], engine.cov[:], homed = self._evening.values()
        engine.grow_old(day.since_first - plant.days[i_day - 1].since_first)
        # overnight counts are referenced anew; what was learned of counts that homing moved is worth nothing then
        if homed.any():
            engine.begin_anew(homed, self._calibrator.model(self._method, day))

    def _operate(self, i_day: int) -> Operation | None:
        if self._plant.scenario.tracking.field_control is None:
            return None
        return Operation(self._plant, i_day, feedback=self._method.feedback)

    # -- going on ------------------------------------------------------------------------------------------

    def go_through(self, segment: Segment, draws: StretchDraws) -> None:
        """Take the method through a stretch: at once, or from word to word of its field control."""
        plant, engine, operation, stored = self._plant, self.engine, self._operation, self._kept.stored
        day, stride, n_step = plant.days[segment.i_day], self._kept.stride, segment.end - segment.first
        total, by_mode, by_outage, hours = (getattr(self, name)[segment.i_day] for name in _BY_DAY)
        tally = _kernels.Tally(total, by_mode, by_outage, hours, self.today)
        courses = empty_courses(len(plant.field), stored, n_step, stride)
        stretch = engine.stretch(day, slice(segment.first, segment.end), draws, tally, courses)
        true = stretch.mounts.true
        zeros_as_built = true[:, ZEROS]
        tasks = always_track(plant)
        s = 0
        while s < n_step:
            end = n_step
            if operation is not None:
                until, tasks = operation.tell(segment.first + s, stretch)
                end = until - segment.first
                true[:, ZEROS] = zeros_as_built + operation.homing_rad
            at = slice(*(segment.first_stored - (-each // stride) for each in (s, end)))
            self.mode_count[at] = np.bincount(tasks.mode, minlength=len(Mode))
            self.mode[at] = tasks.mode[stored]
            engine.go(stretch, tasks, s, end)
            s = end
        at = slice(segment.first_stored, segment.first_stored + courses.error.shape[1])
        self.curve[at, :3] = _over_field(courses.error)
        self.curve[at, 3] = courses.light[..., 0].sum(axis=0) / courses.light[..., 1].sum(axis=0)
        self.trace[at] = np.swapaxes(courses.trace[: len(stored)], 0, 1)
        self.stored_error[at] = courses.error[stored].T
        if segment.end == len(day.unix_s):
            self.histogram += self.today
            self.today[:] = 0
            if operation is not None:
                operation.end()
                self.happened[segment.i_day] = {"day": str(day.date)} | operation.report()
            if len(self._evening["homed"]):
                self._evening["model"][:], self._evening["cov"][:] = engine.model, engine.cov
                self._evening["homed"][:] = operation is not None and operation.homing_rad.any(axis=1)

    # -- results -------------------------------------------------------------------------------------------

    def sums(self) -> MethodSums:
        """Return what the mirrors have added up to so far."""
        return MethodSums(
            total=read_only(self.total),
            by_mode=read_only(self.by_mode),
            by_outage=read_only(self.by_outage.sum(axis=0)[:, : self._n_outage]),
            hours=read_only(self.hours.sum(axis=0)),
            histogram=read_only(self.histogram + self.today),
        )

    def curves(self) -> Curves:
        """Return the courses so far."""
        trace = self.trace
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

    # -- days that somebody else goes through --------------------------------------------------------------

    def part(self, days: slice, times: slice) -> Arrays:
        """Return what whole days gave, of a run that went through no others; ``times``: those of its courses."""
        found = {name: getattr(self, name)[days] for name in _BY_DAY}
        found |= {name: getattr(self, name)[times] for name in _BY_TIME}
        return found | {"histogram": self.histogram, "happened": _as_array(self.happened[days])} | self.evening()

    def put(self, days: slice, times: slice, part: Mapping[str, npt.NDArray[Any]]) -> None:
        """Take over what `part` gave elsewhere."""
        for names, at in ((_BY_DAY, days), (_BY_TIME, times)):
            for name in names:
                getattr(self, name)[at] = part[name]
        self.histogram += part["histogram"]
        self.resume_from(part)
        self.happened[days] = _from_array(part["happened"])

    def evening(self) -> Arrays:
        """Return what the method takes from its last day that is over to the next, by name; of no mirror if nothing."""
        return {f"evening/{name}": values for name, values in self._evening.items()}

    def resume_from(self, evening: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what `evening` gave, with the next day."""
        for name, values in self._evening.items():
            values[...] = evening[f"evening/{name}"]

    def drop_today(self) -> None:
        """Forget the day under way; the next to be gone through begins."""
        self.today[:] = 0

    # -- interruption --------------------------------------------------------------------------------------

    def _own_arrays(self) -> Arrays:
        return self.engine.arrays() | {name: getattr(self, name) for name in _ARRAYS} | self.evening()

    def arrays(self) -> Arrays:
        """Return all that going on depends on, by name."""
        found = self._own_arrays()
        found["happened"] = _as_array(self.happened)
        if self._operation is not None:
            found |= {f"operation/{name}": values for name, values in self._operation.state().items()}
        return found

    def restore(self, arrays: Mapping[str, npt.NDArray[Any]], i_day: int) -> None:
        """Go back to what `arrays` gave in the course of a day."""
        for name, values in self._own_arrays().items():
            values[...] = arrays[name]
        self.happened = _from_array(arrays["happened"])
        place = "operation/"
        operation = {k[len(place) :]: v for k, v in arrays.items() if k.startswith(place)}
        self._operation = self._operate(i_day) if operation else None
        if self._operation is not None:
            self._operation.restore(operation)


def _as_array(plain: Any) -> npt.NDArray[np.uint8]:
    return np.frombuffer(json.dumps(plain).encode(), np.uint8).copy()


def _from_array(stored: npt.NDArray[Any]) -> Any:
    return json.loads(bytes(stored).decode())


def _over_field(error: FloatArray) -> FloatArray:
    """(time, 3) rms, 95 % and worst over the mirrors that have an error."""
    out = np.full((error.shape[1], 3), np.nan)
    seen = np.isfinite(error).any(axis=0)
    some = error[:, seen]
    out[seen, 0] = np.sqrt(np.nanmean(some**2, axis=0))
    out[seen, 1] = np.nanpercentile(some, 95.0, axis=0)
    out[seen, 2] = np.nanmax(some, axis=0)
    return out
