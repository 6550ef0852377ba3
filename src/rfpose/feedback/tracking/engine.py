"""The engine of a tracked field: mirrors of one method, their state, and how they go through steps of a day."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.feedback.columns import columns_of, scales_of
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.calibrations import LEARNED
from rfpose.feedback.tracking.hidden import generator
from rfpose.feedback.tracking.loops import steering_of
from rfpose.feedback.tracking.methods import Method
from rfpose.feedback.tracking.plant import Plant
from rfpose.feedback.tracking.timeline import Day
from rfpose.jit import load_numba

__all__ = ["Arrays", "MethodEngine", "StretchDraws", "always_track", "empty_courses", "empty_tally"]

Arrays = dict[str, npt.NDArray[Any]]

_FIRST_SIGMA_RAD = 0.3e-3
_PART = 4096
"""So many steps of a mirror are worth a thread."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StretchDraws:
    """What a stretch of time brings to all methods alike; see `_kernels.Weather` and `_kernels.Readings`."""

    mean_mps: float
    gust: npt.NDArray[np.float32]
    swing: npt.NDArray[np.float32]
    noise: npt.NDArray[np.float32]
    lost: npt.NDArray[np.uint8]
    outage: npt.NDArray[np.uint8]
    pattern: npt.NDArray[np.int64]
    spread: FloatArray
    bias: FloatArray


class MethodEngine:
    """Mirrors of one method; `stretch` prepares steps of a day, `go` takes the mirrors through them.

    Parameters
    ----------
    method
        How they are steered.
    plant
        What they are.

    Attributes
    ----------
    loop
        How the method steers, in the kernels' numbers.
    model : (mirror, parameter)
        What is believed of the mounts.
    cov : (mirror, free, free)
        Of the rolling fit; nothing is free without one.
    state, ring, light
        See `_kernels.Memory`.
    """

    def __init__(self, method: Method, plant: Plant) -> None:
        self.method, self._plant = method, plant
        n, self._free = len(plant.field), columns_of(LEARNED if method.learns else ())
        self._steering = steering_of(plant.scenario, method, plant.gusts, plant.table)
        self.loop = self._steering.loop
        self.model = plant.field.nominal.copy()
        self.cov = np.repeat(_FIRST_SIGMA_RAD**2 * np.eye(len(self._free))[None], n, axis=0)
        self.state = np.zeros((n, _kernels.N_STATE))
        self.ring = np.zeros((n, _kernels.N_RING, _kernels.N_ENTRY))
        self.light = np.zeros((n, 2))
        self._drift_rad = self._drift_of_a_day()
        self._pool = ThreadPoolExecutor(load_numba().get_num_threads(), "rfpose-track")

    # -- beginning -----------------------------------------------------------------------------------------

    def rest(self, first_count: FloatArray) -> None:
        """Forget what motors did and what was measured; azimuth motors begin near counts (mirror,)."""
        for values in (self.state, self.ring, self.light):
            values[:] = 0.0
        self.state[:, _kernels.NEXT] = first_count

    def grow_old(self, days: float) -> None:
        """Trust what was learned less, so many days later."""
        sigma = 1e-3 * self._plant.scenario.tracking.radio_model.forget_mrad_per_sqrt_day
        every = np.arange(len(self._free))
        self.cov[:, every, every] += sigma**2 * days

    def begin_anew(self, who: npt.NDArray[np.bool_], model: FloatArray) -> None:
        """Let some mirrors (mirror,) take over a model of all, nothing learned."""
        self.model[who] = model[who]
        self.cov[who] = _FIRST_SIGMA_RAD**2 * np.eye(len(self._free))

    # -- going on ------------------------------------------------------------------------------------------

    def stretch(
        self, day: Day, steps: slice, draws: StretchDraws, tally: _kernels.Tally, courses: _kernels.Courses
    ) -> _kernels.Stretch:
        """Return all that mirrors go through steps of a day with; true mounts are a copy, to be changed."""
        plant, field = self._plant, self._plant.field
        settings = plant.scenario.tracking.radio_model
        walk = (1e-3 * settings.forget_mrad_per_sqrt_day) ** 2 * settings.learn_interval_s / 86_400.0
        learned = LEARNED if self.method.learns else ()
        return _kernels.Stretch(
            step0=steps.start,
            steering=self._steering,
            mounts=_kernels.Mounts(field.at(day.since_first), field.constant, field.lean_rad, field.target),
            models=_kernels.Models(self.model, self.cov, self._free, scales_of(learned), np.full(len(learned), walk)),
            surroundings=_kernels.Weather(
                sun=day.sun_enu[steps.start : steps.stop + self.loop.interval + 1].copy(),
                # negative: the field is not to work
                power=np.where(day.works, day.power_w_per_m2, -1.0)[steps].copy(),
                heat=day.heat[steps].copy(),
                hour_of=day.hour[steps].astype(np.int64),
                mean_speed=draws.mean_mps,
                bend=plant.gusts.bend,
                gust=draws.gust,
                swing=draws.swing,
            ),
            readings=_kernels.Readings(
                noise=draws.noise,
                spread=draws.spread,
                bias=draws.bias,
                lost=draws.lost,
                outage=draws.outage,
                pattern=draws.pattern,
                drift=self._drift_rad,
                null=field.sensor_bias_rad,
            ),
            memory=_kernels.Memory(self.state, self.ring, self.light),
            tally=tally,
            courses=courses,
        )

    def go(self, stretch: _kernels.Stretch, tasks: _kernels.Tasks, first: int, end: int) -> None:
        """Take all mirrors through steps ``first`` to before ``end`` of a stretch, mirrors side by side."""
        n, n_thread = len(self.state), int(load_numba().get_num_threads())
        n_part = min(4 * n_thread, n * (end - first) // _PART, n) if n_thread > 1 else 1
        if n_part < 2:
            _kernels.advance(0, n, first, end, tasks, stretch)
            return
        edges = [n * i // n_part for i in range(n_part + 1)]
        # kernels let go of the interpreter, and no mirror knows of another
        parts = [
            self._pool.submit(_kernels.advance, row, end_row, first, end, tasks, stretch)
            for row, end_row in itertools.pairwise(edges)
        ]
        for part in parts:
            part.result()

    def _drift_of_a_day(self) -> FloatArray:
        """(mirror,) amplitude of what the method's instrument drifts by in a day [rad]."""
        plant = self._plant
        if self.method.feedback != _kernels.SUN_SENSOR:
            return plant.field.plate_drift_rad
        draw = generator(plant.seed, 7).standard_normal(len(plant.field))
        return np.asarray(0.5e-3 * plant.scenario.tracking.sun_sensor.drift_mrad * draw)

    # -- interruption --------------------------------------------------------------------------------------

    def arrays(self) -> Arrays:
        """Return all that going on depends on, by name."""
        return {"model": self.model, "cov": self.cov, "state": self.state, "ring": self.ring, "light": self.light}


def always_track(plant: Plant) -> _kernels.Tasks:
    """Return what mirrors do without field control: track their aim, by a sun that is known."""
    n = len(plant.field)
    return _kernels.Tasks(
        duty=np.full(n, _kernels.TRACK),
        renew=np.zeros(n, np.uint8),
        scored=np.ones(n, np.uint8),
        mode=np.full(n, int(Mode.TRACK)),
        aim=plant.field.target[:, :3].copy(),
        goal=np.zeros((n, 2)),
        heard=np.zeros((n, 1, 3)),
        age=np.full((n, 1), np.nan),
    )


def empty_tally(n: int, n_outage: int) -> _kernels.Tally:
    """Return sums of ``n`` mirrors, nothing added up yet."""
    return _kernels.Tally(
        total=np.zeros((n, _kernels.N_SUM)),
        by_mode=np.zeros((n, len(Mode), 3)),
        by_outage=np.zeros((n, max(n_outage, 1), 4)),
        hours=np.zeros((n, 24, 2)),
        histogram=np.zeros((n, _kernels.N_BIN), np.int32),
    )


def empty_courses(n: int, stored: npt.NDArray[np.int64], n_step: int, stride: int) -> _kernels.Courses:
    """Return room for what is kept of ``n`` mirrors each ``stride`` of a stretch's steps; of ``stored`` all of it."""
    n_kept = -(-n_step // stride)
    row = np.full(n, -1, np.int64)
    row[stored] = np.arange(len(stored))
    return _kernels.Courses(
        stride=stride,
        error=np.full((n, n_kept), np.nan),
        light=np.zeros((n, n_kept, 2)),
        stored=row,
        trace=np.full((max(len(stored), 1), n_kept, 8), np.nan),
    )
