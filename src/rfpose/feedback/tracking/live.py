"""A small field tracked by radio, one control interval at a time, and disturbed on the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray, as_positive, read_only
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.feedback.columns import constant
from rfpose.feedback.fieldcontrol.control import ControlledField
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import _kernels
from rfpose.feedback.tracking.calibrations import Calibrator
from rfpose.feedback.tracking.engine import MethodEngine, StretchDraws, always_track, empty_courses, empty_tally
from rfpose.feedback.tracking.hidden import generator
from rfpose.feedback.tracking.loops import check_gains
from rfpose.feedback.tracking.methods import METHODS
from rfpose.feedback.tracking.plant import Plant
from rfpose.feedback.tracking.radio import RadioByPosture, RadioErrors
from rfpose.scenario import Scenario

__all__ = ["MOST_MIRRORS", "FieldMoment", "LiveField", "live_scenario"]

MOST_MIRRORS = 50
"""A live field has no more mirrors than this: the first of the scenario."""
_AIM_ENU_M = (0.0, 0.0, 50.0)
_PLACE_DEG = (37.1, -2.4)
_LEAST_WIND_MPS = 1e-3
_RADIO_EVERY_S = 60.0
_CALM_MPS = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldMoment:
    """A field at the end of a step; rows are mirrors.

    Attributes
    ----------
    unix_s
        [s since 1970 UTC].
    sun_enu : (xyz)
        Towards the sun.
    normal_enu : (mirror, xyz)
        True normals.
    error_rad : (mirror,)
        Angle between true and wanted normal [rad]; NaN: aim point out of reach.
    radio_sigma_rad : (mirror,)
        What one radio frame knows the normal to [rad]; NaN: no pose.
    wind_mps
        Mean wind and the gust under way [m/s].
    mode : (mirror,)
        `Mode` of each.
    stopped : (mirror,)
        Whose motors stand.
    dead : (transmitter,)
        Which are off the air.
    """

    unix_s: float
    sun_enu: FloatArray
    normal_enu: FloatArray
    error_rad: FloatArray
    radio_sigma_rad: FloatArray
    wind_mps: float
    mode: npt.NDArray[np.int8]
    stopped: npt.NDArray[np.bool_]
    dead: npt.NDArray[np.bool_]

    @property
    def rms_rad(self) -> float:
        """Rms normal error of the mirrors that have one [rad]; NaN: none."""
        known = self.error_rad[np.isfinite(self.error_rad)]
        return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


class _Radio(RadioByPosture):
    """The radio model with transmitters off the air."""

    def __init__(self, scenario: Scenario, pivot_enu_m: FloatArray, *, usual_normal_enu: FloatArray) -> None:
        self.dead = np.zeros(len(scenario.transmitter), np.bool_)
        super().__init__(scenario, pivot_enu_m, usual_normal_enu=usual_normal_enu)

    def _covariance(self, rot: FloatArray, hidden: npt.NDArray[np.bool_]) -> FloatArray:
        return super()._covariance(rot, hidden | self.dead)


def live_scenario(scenario: Scenario) -> Scenario:
    """Return a scenario for one day, with a place on Earth and an aim point where it has none.

    Without ``latitude_deg`` and ``longitude_deg`` the field stands at 37.1 degrees north, 2.4 west; without
    ``aim_enu_m`` it aims 50 m above the origin.

    Raises
    ------
    ScenarioError
        A field of dishes, or no mirrors.
    """
    if scenario.tracking.collector != "heliostat":
        raise ScenarioError("a live field steers heliostats; set [tracking] `collector` to heliostat")
    if not scenario.heliostat:
        raise ScenarioError("the scenario has no heliostats to steer live; add some [[heliostat]]")
    site = scenario.site
    changes: dict[str, object] = {}
    if site.latitude_deg is None or site.longitude_deg is None:
        changes |= {"latitude_deg": _PLACE_DEG[0], "longitude_deg": _PLACE_DEG[1]}
    if site.aim_enu_m is None:
        changes["aim_enu_m"] = _AIM_ENU_M
    return scenario.model_copy(
        update={
            "site": site.model_copy(update=changes),
            "tracking": scenario.tracking.model_copy(update={"days": 1, "field_control": None, "event": ()}),
        }
    )


class LiveField:
    """A field in closed radio loop on the scenario's first day; go on with `step`, disturb it at any time.

    Mounts, drives, wind, radio and loop are those of `Simulation`, whose step this takes one control interval at a
    time. In an emergency `ControlledField` tells where the axes go, at the drives' speed.

    Parameters
    ----------
    scenario
        As `live_scenario` gives it.
    seed
        The same seed and the same disturbances at the same steps give the same course.
    start_hour
        Local mean solar time of the first step [h]; within the day.

    Raises
    ------
    ScenarioError, GeometryError, InvalidInputError
        See `Simulation`.
    """

    def __init__(self, scenario: Scenario, *, seed: int = 0, start_hour: float = 10.0) -> None:
        check_gains(scenario)
        self._plant = plant = Plant(scenario, count=min(MOST_MIRRORS, len(scenario.heliostat)), seed=int(seed))
        plant.check_reach()
        self.field, self._day = plant.field, plant.days[0]
        self._engine = MethodEngine(METHODS["radio"], plant)
        self._scenario = scenario
        self._servo_s = scenario.tracking.servo_interval_s
        self._interval = self._engine.loop.interval
        late = int(np.searchsorted(self._day.hour, start_hour))
        last = len(self._day.unix_s) - self._interval
        self._at = max(min(late, last) // self._interval * self._interval, 0)
        self._radio = _Radio(scenario, self.field.pivot_enu_m, usual_normal_enu=plant.usual_normal_enu())
        self._engine.model[:] = Calibrator(plant, self._radio).model(METHODS["radio"], self._day)
        self._gust_state = plant.gusts.process.start(generator(plant.seed, 11, 0), len(self.field))
        self._gusts: list[tuple[float, float, float]] = []
        self._stopped = np.zeros(len(self.field), np.bool_)
        self._renew = np.zeros(len(self.field), np.bool_)
        self._control: ControlledField | None = None
        self._radio_due = self._at
        self._radio_errors = self._measure()
        self._engine.rest(self._nearest_count())

    # -- what it is ----------------------------------------------------------------------------------------

    @property
    def step_s(self) -> float:
        """How far one step goes [s]."""
        return self._interval * self._servo_s

    @property
    def transmitter_ids(self) -> tuple[str, ...]:
        """Names of the transmitters, as `kill_transmitter` takes them."""
        return self._scenario.transmitter_ids

    @property
    def over(self) -> bool:
        """Whether the day is over, so that there is no further step."""
        return self._at + self._interval > len(self._day.unix_s)

    # -- disturbances --------------------------------------------------------------------------------------

    def gust(self, speed_mps: float = 15.0, duration_s: float = 40.0) -> None:
        """Let the wind rise by so much over all mirrors and fall again, as one minus a cosine, from now on."""
        now = float(self._day.unix_s[min(self._at, len(self._day.unix_s) - 1)])
        self._gusts.append((now, as_positive("duration_s", duration_s), as_positive("speed_mps", speed_mps)))

    def kill_transmitter(self, name: str) -> None:
        """Take a transmitter off the air.

        Raises
        ------
        InvalidInputError
            No transmitter of this name.
        """
        if name not in self.transmitter_ids:
            raise InvalidInputError(f"no transmitter is called {name!r}; known are {', '.join(self.transmitter_ids)}")
        self._radio.dead[self.transmitter_ids.index(name)] = True
        self._radio_due = self._at

    def stop_motor(self, name: str) -> None:
        """Let both motors of a mirror stand.

        Raises
        ------
        InvalidInputError
            No mirror of this name.
        """
        if name not in self.field.ids:
            raise InvalidInputError(f"no mirror is called {name!r}; known are {', '.join(self.field.ids[:8])}")
        self._stopped[self.field.ids.index(name)] = True

    def emergency(self) -> None:
        """Order the field off its target at full speed, then into stow."""
        if self._control is None:
            self._control = ControlledField(
                aim_enu_m=self.field.target[:, :3],
                pivot_enu_m=self.field.pivot_enu_m,
                mode=Mode.TRACK,
                start_s=self._at * self._servo_s,
                rng=generator(self._plant.seed, 12, self._at),
            )
            self._control.emergency()

    def normal(self) -> None:
        """End all disturbances: the wind calms, all transmitters and motors work, mirrors go back to the target."""
        self._gusts.clear()
        self._radio.dead[:] = False
        self._radio_due = self._at
        self._stopped[:] = False
        if self._control is not None:
            self._control = None
            self._renew[:] = True
            self._engine.ring[:] = 0.0

    # -- going on ------------------------------------------------------------------------------------------

    def step(self) -> FieldMoment:
        """Go on by one control interval and return what is then.

        Raises
        ------
        InvalidInputError
            The day is over.
        """
        if self.over:
            raise InvalidInputError(f"the day {self._day.date} is over; start anew")
        if self._at >= self._radio_due:
            self._radio_errors = self._measure()
        steps = slice(self._at, self._at + self._interval)
        extra = self._gust_mps(self._day.unix_s[steps])
        normal, error, mode = self._go(steps, extra)
        self._at += self._interval
        sigma = np.where(self._radio_errors.solved, self._radio_errors.sigma_rad, np.nan)
        return FieldMoment(
            unix_s=float(self._day.unix_s[steps][-1]),
            sun_enu=read_only(self._day.sun_enu[self._at - 1].copy()),
            normal_enu=read_only(normal),
            error_rad=read_only(error),
            radio_sigma_rad=read_only(sigma),
            wind_mps=float(self._plant.gusts.mean_mps + extra[-1]),
            mode=mode,
            stopped=self._stopped.copy(),
            dead=self._radio.dead.copy(),
        )

    def _measure(self) -> RadioErrors:
        self._radio_due = self._at + round(_RADIO_EVERY_S / self._servo_s)
        wanted = self._plant.wanted_normal_enu(self._day, self._at)
        return self._radio.errors(wanted, generator(self._plant.seed, 13, self._at))

    def _nearest_count(self) -> FloatArray:
        """Azimuth motors' counts towards the first wanted normals, nearest to the middle of their travel."""
        azimuth = geometry.azimuth_elevation_from_enu(self._plant.wanted_normal_enu(self._day, self._at))[0]
        home, per_rad = (constant(self.field.constant, name)[:, 0] for name in ("angle_at_zero_rad", "counts_per_unit"))
        way = np.mod(azimuth - home + np.pi, 2.0 * np.pi) - np.pi
        return np.asarray(way * per_rad)

    def _gust_mps(self, unix_s: FloatArray) -> FloatArray:
        """(step,) what the gusts under way add to the wind; those that have passed are forgotten."""
        self._gusts = [gust for gust in self._gusts if unix_s[0] <= gust[0] + gust[1]]
        total = np.zeros(len(unix_s))
        for begin, duration, speed in self._gusts:
            part = (unix_s - begin) / duration
            total += np.where(part <= 1.0, 0.5 * speed * (1.0 - np.cos(2.0 * np.pi * part)), 0.0)
        return total

    def _go(self, steps: slice, extra_mps: FloatArray) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int8]]:
        """Take all mirrors through a step; true normals, errors and modes at its end."""
        n, engine = len(self.field), self._engine
        courses = empty_courses(n, np.arange(n), self._interval, 1)
        stretch = engine.stretch(self._day, steps, self._draw(steps, extra_mps), empty_tally(n, 0), courses)
        tasks = always_track(self._plant)
        tasks.renew[:] = self._renew
        self._renew[:] = False
        modes = np.full(n, Mode.TRACK, np.int8)
        # in an emergency field control has its say each second
        each = self._interval if self._control is None else 1
        for first in range(0, self._interval, each):
            if self._control is not None:
                modes = self._obey(self._control, steps.start + first, tasks)
            tasks.duty[self._stopped] = _kernels.GO
            tasks.goal[self._stopped] = engine.state[self._stopped, _kernels.MOTOR : _kernels.MOTOR + 2]
            engine.go(stretch, tasks, first, first + each)
        return courses.trace[:, -1, :3], courses.error[:, -1], modes

    def _draw(self, steps: slice, extra_mps: FloatArray) -> StretchDraws:
        """Draw wind and radio frames of a step."""
        n, plant, n_step = len(self.field), self._plant, self._interval
        mean = max(plant.gusts.mean_mps, _LEAST_WIND_MPS)
        wind = plant.gusts.run(self._gust_state, generator(plant.seed, 14, self._at), self._day.unix_s[steps]).astype(
            np.float64
        )
        rng = generator(plant.seed, 15, self._at)
        noise = rng.standard_normal((n, 1, 2), dtype=np.float32)
        lost = (rng.random((n, 1), dtype=np.float32) < self._scenario.tracking.radio.lost_frames).astype(np.uint8)
        lost[~self._radio_errors.solved] = 1
        return StretchDraws(
            mean_mps=mean,
            # the kernel's push is V² + 2 V g: what makes it the square of the speed with the gust
            gust=(wind + ((mean + wind) * extra_mps + 0.5 * extra_mps**2) / mean).astype(np.float32),
            swing=plant.gusts.draw_swing(generator(plant.seed, 16, self._at), (n, n_step)),
            noise=noise,
            lost=lost,
            outage=np.zeros((1, n_step), np.uint8),
            pattern=np.zeros(n, np.int64),
            spread=self._radio_errors.spread_rad,
            bias=self._radio_errors.bias_rad,
        )

    def _obey(self, control: ControlledField, i_step: int, tasks: _kernels.Tasks) -> npt.NDArray[np.int8]:
        """Let field control say where the axes go; return the modes."""
        home = constant(self.field.constant, "angle_at_zero_rad").copy()
        per_rad = constant(self.field.constant, "counts_per_unit")
        home[:, 0] -= 2.0 * np.pi * np.rint(home[:, 0] / (2.0 * np.pi))
        axis = home + self._engine.state[:, _kernels.MOTOR : _kernels.MOTOR + 2] / per_rad
        orders = control.step(
            i_step * self._servo_s, axis_rad=axis, aim_axis_rad=axis, sun_enu=self._day.sun_enu[i_step],
            wind_mps=_CALM_MPS,
        )  # fmt: skip
        goes = np.asarray(np.isfinite(orders.target_axis_rad).all(axis=1))
        tasks.duty[:] = np.where(goes, _kernels.GO, _kernels.TRACK)
        tasks.goal[:] = np.where(goes[:, None], (orders.target_axis_rad - home) * per_rad, 0.0)
        return orders.mode
