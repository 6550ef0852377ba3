"""What plants calibrate mounts from, and the models that come of it: camera, drone, radio.

Each instrument looks at the true mirror, bent by wind and heat, slack in its gears, on days before the one that is
simulated; thousands of mirrors are fitted in one call.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.feedback import _kernels
from rfpose.feedback.calibration import PARAMETER_SETS, FitSettings, solve
from rfpose.feedback.drone import drone_sigma_rad
from rfpose.feedback.mount import PARAMETERS, aim_rows
from rfpose.feedback.optics import reflect
from rfpose.feedback.sun import Site, sun_position
from rfpose.feedback.tracking.hidden import Field, generator
from rfpose.feedback.tracking.methods import Method
from rfpose.feedback.tracking.radio import RadioModel
from rfpose.feedback.tracking.timeline import Day, day_of, hour_of_day, site_of
from rfpose.feedback.tracking.wind import Gusts
from rfpose.scenario import Scenario

__all__ = ["LEARNED", "Workshop", "correct_zeros"]

LEARNED = (
    "pedestal_tilt_north_rad", "pedestal_tilt_east_rad", "axis_1_zero_rad", "axis_2_zero_rad",
    "nonorthogonality_rad", "gravity_sag_rad", "worm_1_sin_rad", "worm_1_cos_rad", "worm_2_sin_rad",
    "worm_2_cos_rad",
)  # fmt: skip
"""What radio corrects in the model of a mount."""

_INDEX = {name: i for i, name in enumerate(PARAMETERS)}
_PLATE = (_INDEX["receiver_plane_right_rad"], _INDEX["receiver_plane_up_rad"])
_PRIORS = {
    "location_east_m": (0.0, 0.05),
    "location_north_m": (0.0, 0.05),
    "location_up_m": (0.0, 0.05),
    "gravity_sag_rad": (0.0, 1e-3),
    "worm_1_sin_rad": (0.0, 2e-3),
    "worm_1_cos_rad": (0.0, 2e-3),
    "worm_2_sin_rad": (0.0, 2e-3),
    "worm_2_cos_rad": (0.0, 2e-3),
}
_WORMS = ("worm_1_sin_rad", "worm_1_cos_rad", "worm_2_sin_rad", "worm_2_cos_rad")
_LARGE = (0.0, 0.03)
_STEEP = 0.3
_TURNS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class _Look:
    """Mirrors as an instrument finds them; (mirror, look, …)."""

    count: FloatArray
    normal_enu: FloatArray
    centre_enu_m: FloatArray
    sun_enu: FloatArray
    """(look, xyz)"""
    heat: FloatArray
    """(look,) as `Day.heat`"""

    def at_turns(self, turn_of: npt.NDArray[np.int64]) -> _Look:
        """Return one look a mirror; its sun is no longer the same for all and left out."""
        row = np.arange(len(turn_of))
        return _Look(
            count=self.count[row, turn_of][:, None],
            normal_enu=self.normal_enu[row, turn_of][:, None],
            centre_enu_m=self.centre_enu_m[row, turn_of][:, None],
            sun_enu=np.empty((0, 3)),
            heat=np.empty(0),
        )

    def axes(self) -> tuple[FloatArray, FloatArray]:
        """Return the mirrors' right and up."""
        rot = geometry.rot_enu_from_mirror(self.normal_enu)
        return rot[..., 0], rot[..., 1]

    def tilted(self, right_up_rad: FloatArray) -> FloatArray:
        """Return the normals turned by small angles (mirror, look, 2)."""
        right, up = self.axes()
        return geometry.unit(self.normal_enu + right_up_rad[..., :1] * right + right_up_rad[..., 1:] * up)


class Workshop:
    """Makes the models that methods steer by, for a run's field.

    Parameters
    ----------
    scenario, field
        The run.
    radio
        Errors of radio poses; None without radio.
    gusts
        The wind.
    seed
        Of the run.
    """

    def __init__(self, scenario: Scenario, field: Field, radio: RadioModel | None, gusts: Gusts, *, seed: int) -> None:
        self._scenario, self._field, self._radio, self._gusts, self._seed = scenario, field, radio, gusts, seed
        self._site: Site = site_of(scenario)
        self._plate: FloatArray | None = None

    def model(self, method: Method, day: Day) -> FloatArray:
        """Return what a method believes of the mounts on the morning of a day (mirror, 31)."""
        p = self._field.nominal.copy()
        if method.radio:
            p[:, _PLATE] = self._plate_estimate()
        plan = self._scenario.tracking
        if method.knowledge == "camera":
            return self._camera_fit(p, self._last(day, plan.camera.interval_days))
        if method.knowledge == "drone":
            return self._drone_fit(p, self._last(day, plan.drone.interval_days))
        if method.knowledge == "bias":
            return self._centre(p, self._last(day, plan.camera.bias_interval_days), corrections=1, tolerance_m=0.0)
        if method.knowledge == "berenguel":
            camera = plan.camera
            return self._centre(
                p,
                self._last(day, camera.berenguel_interval_days),
                corrections=camera.berenguel_corrections,
                tolerance_m=1e-3 * camera.berenguel_tolerance_mm,
            )
        if method.knowledge == "radio":
            return self._radio_fit(p, self._last(day, plan.radio_model.interval_days))
        return p

    # -- when ----------------------------------------------------------------------------------------------

    @staticmethod
    def _last(day: Day, interval_days: float) -> int:
        """Days from the run's first to a method's last calibration; on the first day it is half an interval old."""
        half = interval_days / 2.0
        cycles = np.floor((day.since_first - 1 + half) / interval_days)
        return int(np.floor(cycles * interval_days - half))

    def _times(self, since_first: int, n: int) -> FloatArray:
        """Instants evenly spread over a day's sunshine."""
        date = self._scenario.tracking.date + datetime.timedelta(days=since_first)
        unix_s = day_of(self._scenario, date, since_first, whole=True).unix_s
        return np.linspace(unix_s[0], unix_s[-1], n + 2)[1:-1]

    # -- looking -------------------------------------------------------------------------------------------

    def _look(
        self, model: FloatArray, unix_s: FloatArray, since_first: int, rng: np.random.Generator, target: FloatArray
    ) -> _Look:
        """Steer all mirrors by a model at some instants and see where they really point."""
        field, plan = self._field, self._scenario.tracking
        sun = sun_position(unix_s, self._site).direction_enu
        n, m = len(field), len(unix_s)
        dish = bool(field.target[0, 3])
        goal = np.broadcast_to(sun[None], (n, m, 3)) if dish else np.broadcast_to(target[:, None], (n, m, 3))
        rows = aim_rows(np.broadcast_to(sun[None], (n, m, 3)), goal, source_is_point=False, target_is_point=not dish)
        count, _ = _kernels.command_batch(model, field.constant, np.ascontiguousarray(rows))
        step = float(plan.drive.microsteps)
        count = np.rint(count / step) * step
        per_rad = field.constant[:, None, 13:15]
        slack = 0.5e-3 * np.array(plan.drive.backlash_mrad) * rng.uniform(-1.0, 1.0, (n, m, 2))
        heat = np.cos(2.0 * np.pi * (hour_of_day(unix_s, self._site) - 15.0) / 24.0)
        normal, centre = np.empty((n, m, 3)), np.empty((n, m, 3))
        built = field.at(since_first)
        for j in range(m):
            p = built.copy()
            p[:, :2] += field.lean_rad * heat[j]
            out = _kernels.posture_batch(p, field.constant, (count + slack * per_rad)[:, j : j + 1].copy(), 0.0)
            normal[:, j], centre[:, j] = out[:, 0, 2:5], out[:, 0, 5:]
        look = _Look(count=count, normal_enu=normal, centre_enu_m=centre, sun_enu=sun, heat=heat)
        bent = look.tilted(self._gusts.bend_rad(self._gusts.draw(rng, (n, m))) + self._gusts.swing_rad(rng, (n, m)))
        return _Look(count=count, normal_enu=bent, centre_enu_m=centre, sun_enu=sun, heat=heat)

    def _camera_target(self) -> FloatArray:
        place = self._scenario.tracking.camera.target_enu_m
        target = self._field.target[:, :3].copy()
        if place is not None:
            target[:] = place
        return target

    def _camera_errors(
        self, look: _Look, target: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Errors of normals seen by camera (mirror, look, 2) and their sigma (mirror, look) [rad]."""
        distance = np.linalg.norm(target[:, None] - look.centre_enu_m, axis=-1)
        if self._field.target[0, 3]:
            distance = np.full(distance.shape, 50.0)
        sigma = np.maximum(0.5e-3 * self._scenario.tracking.camera.spot_sigma_mm / distance, 1e-6)
        noise = sigma[..., None] * rng.standard_normal((*sigma.shape, 2))
        return noise + self._field.camera_bias_rad[:, None], sigma

    # -- models --------------------------------------------------------------------------------------------

    def _fit(
        self, start: FloatArray, look: _Look, rows: FloatArray, free: tuple[str, ...], seen: npt.NDArray[np.bool_]
    ) -> FloatArray:
        """Fit all mirrors; one that cannot be fitted keeps its start."""
        priors = {name: _PRIORS.get(name, _LARGE) for name in free}
        rows = np.where(np.isfinite(rows), rows, 0.0)
        use = seen & np.isfinite(look.count).all(axis=-1)
        count = np.where(use[..., None], look.count, 0.0)
        rows[~use] = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0])
        found = solve(
            start, self._field.constant, np.ascontiguousarray(count), np.ascontiguousarray(rows), use, free,
            FitSettings(sigma_known=True, huber=3.0, priors=priors),
        )  # fmt: skip
        p = start.copy()
        index = np.array([_INDEX[name] for name in free])
        good = np.isfinite(found.working).all(axis=1)
        p[np.ix_(good, index)] = found.working[good]
        return p

    def _camera_fit(self, start: FloatArray, since_first: int) -> FloatArray:
        rng = generator(self._seed, 20, since_first + 100_000)
        camera = self._scenario.tracking.camera
        target = self._camera_target()
        unix_s = self._times(since_first, camera.points_per_day)
        look = self._look(start, unix_s, since_first, rng, target)
        error, sigma = self._camera_errors(look, target, rng)
        beam = reflect(look.tilted(error), np.broadcast_to(look.sun_enu, look.normal_enu.shape))
        distance = np.linalg.norm(target[:, None] - look.centre_enu_m, axis=-1)
        spot = look.centre_enu_m + distance[..., None] * beam
        rows = aim_rows(np.broadcast_to(look.sun_enu, spot.shape), spot, source_is_point=False, target_is_point=True)
        # the model's own faults scatter as well: wind, gears, steps
        rows[..., 8] = np.hypot(sigma, self._scatter_rad())
        free = PARAMETER_SETS["malan"] + (_WORMS if camera.worm else ())
        return self._fit(start, look, rows, free, np.isfinite(beam[..., 0]))

    def _drone_fit(self, start: FloatArray, since_first: int) -> FloatArray:
        rng = generator(self._seed, 21, since_first + 100_000)
        drone = self._scenario.tracking.drone
        unix_s = self._times(since_first, drone.points)
        look = self._look(start, unix_s, since_first, rng, self._field.target[:, :3])
        sigma = drone_sigma_rad(
            look.centre_enu_m + drone.distance_m * look.sun_enu,
            look.centre_enu_m,
            target_enu_m=np.broadcast_to(self._field.target[:, None, :3], look.centre_enu_m.shape),
        )
        noise = rng.standard_normal((*look.count.shape[:2], 2))
        error = sigma[..., None] * noise + self._field.drone_bias_rad[:, None]
        normal = look.tilted(error)
        rows = aim_rows(normal, normal, source_is_point=False, target_is_point=False)
        rows[..., 8] = np.hypot(sigma, self._scatter_rad())
        return self._fit(start, look, rows, PARAMETER_SETS["edwards-4"] + ("nonorthogonality_rad",), _finite(normal))

    def _radio_fit(self, start: FloatArray, since_first: int) -> FloatArray:
        rng = generator(self._seed, 22, since_first + 100_000)
        unix_s = self._times(since_first, self._scenario.tracking.radio_model.points_per_day)
        look = self._look(start, unix_s, since_first, rng, self._field.target[:, :3])
        error, sigma = self._radio_errors(look, rng)
        normal = look.tilted(error)
        rows = aim_rows(normal, normal, source_is_point=False, target_is_point=False)
        rows[..., 8] = np.hypot(sigma, self._scatter_rad())[:, None]
        rows[..., 9] = 1.0
        return self._fit(start, look, rows, LEARNED, _finite(normal))

    def _radio_errors(self, look: _Look, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Errors of radio normals (mirror, look, 2), right and up, plate included, and their sigma (mirror) [rad]."""
        assert self._radio is not None
        m = look.count.shape[1]
        plate = self._field.true[:, _PLATE]
        out = np.empty((*look.count.shape[:2], 2))
        for j in range(m):
            if j % 8 == 0:
                errors = self._radio.errors(np.nan_to_num(look.normal_enu[:, j], nan=0.577), rng)
            noise = rng.standard_normal((len(plate), 2))
            spread = errors.spread_rad
            drift = self._field.plate_drift_rad * look.heat[j]
            out[:, j, 0] = plate[:, 0] + drift + errors.bias_rad[:, 0] + spread[:, 0] * noise[:, 0]
            out[:, j, 1] = plate[:, 1] + errors.bias_rad[:, 1] + spread[:, 1] * noise[:, 0] + spread[:, 2] * noise[:, 1]
            out[~errors.solved, j] = np.nan
        return out, np.maximum(errors.sigma_rad / np.sqrt(2.0), 1e-6)

    def _scatter_rad(self) -> float:
        """Return what a single posture is off for wind, steps and slack, one component [rad]."""
        drive = self._scenario.tracking.drive
        step = 2.0 * np.pi / drive.steps_per_turn * drive.microsteps / np.sqrt(12.0)
        slack = 1e-3 * float(np.mean(drive.backlash_mrad)) / np.sqrt(12.0)
        return float(np.sqrt(self._gusts.variance_rad2 + step**2 + slack**2))

    def _plate_estimate(self) -> FloatArray:
        """(mirror, 2) right and up: radio less camera on the camera's first day, or nothing."""
        if self._plate is None:
            self._plate = np.zeros((len(self._field), 2))
            plan = self._scenario.tracking
            if plan.radio.plate_calibration == "camera":
                rng = generator(self._seed, 23)
                target = self._camera_target()
                since_first = -max(int(plan.camera.interval_days // 2), 1)
                unix_s = self._times(since_first, plan.camera.points_per_day)
                look = self._look(self._field.nominal, unix_s, since_first, rng, target)
                seen, _ = self._camera_errors(look, target, rng)
                radio, _ = self._radio_errors(look, rng)
                self._plate = np.nan_to_num(np.nanmean(radio - seen, axis=1))
        return self._plate

    def _centre(self, start: FloatArray, since_first: int, *, corrections: int, tolerance_m: float) -> FloatArray:
        """Take off both axes what a camera sees the spot to be off, once a mirror, in whole motor steps."""
        rng = generator(self._seed, 24, since_first + 100_000, corrections)
        target = self._camera_target()
        when = self._times(since_first, _TURNS)
        # mirrors take turns at the target, each at its own time of the day
        turn_of = rng.integers(_TURNS, size=len(self._field))
        when_sun = sun_position(when, self._site).direction_enu
        p = start.copy()
        per_rad = self._field.constant[:, 13:15] / self._scenario.tracking.drive.microsteps
        for _ in range(corrections):
            look = self._look(p, when, since_first, rng, target).at_turns(turn_of)
            error, _ = self._camera_errors(look, target, rng)
            wanted = geometry.bisector_enu(target - look.centre_enu_m[:, 0], when_sun[turn_of])
            distance = np.linalg.norm(target - look.centre_enu_m[:, 0], axis=1)
            seen = look.tilted(error)[:, 0]
            far = 2.0 * distance * np.linalg.norm(wanted - seen, axis=1) > tolerance_m
            correct_zeros(p, np.where(far[:, None], wanted, seen), seen, per_rad=per_rad)
        return p


def correct_zeros(
    model: FloatArray, wanted_enu: FloatArray, seen_enu: FloatArray, *, per_rad: FloatArray | float = np.inf
) -> None:
    """Take off both axes' zeros what mirrors were seen to be off, in place.

    Parameters
    ----------
    model : (mirror, 34)
        What is believed of the mounts.
    wanted_enu, seen_enu : (mirror, xyz)
        Normals; one that was not seen, NaN, changes nothing.
    per_rad : (mirror, axis)
        Turns are rounded to whole parts of this [1/rad]; infinite: not at all.
    """
    rot = geometry.rot_enu_from_mirror(wanted_enu)
    off = wanted_enu - seen_enu
    right_off, up_off = (np.sum(off * rot[:, :, i], axis=1) for i in (0, 1))
    cosine = np.maximum(np.hypot(wanted_enu[:, 0], wanted_enu[:, 1]), 0.05)
    # near the zenith azimuth says little about where a mirror looks, and would be turned far for it
    turn = np.stack([np.where(cosine > _STEEP, -right_off / cosine, 0.0), up_off], axis=1)
    if np.all(np.isfinite(per_rad)):
        turn = np.rint(turn * per_rad) / per_rad
    turn[~np.isfinite(turn).all(axis=1)] = 0.0
    # the model is told that the axes stand short by what they have to turn further
    model[:, _INDEX["axis_1_zero_rad"]] -= turn[:, 0]
    model[:, _INDEX["axis_2_zero_rad"]] -= turn[:, 1]


def _finite(normal: FloatArray) -> npt.NDArray[np.bool_]:
    return np.asarray(np.isfinite(normal).all(axis=-1))
