"""The models that methods begin a day with: what was calibrated on days before, by which instrument, and how.

Each instrument looks at the true mirror, bent by wind and heat, slack in its gears; thousands of mirrors are fitted in
one call.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.feedback import _kernels
from rfpose.feedback.calibration import PARAMETER_SETS, FitSettings, solve
from rfpose.feedback.columns import M, columns_of, constant
from rfpose.feedback.mount import aim_rows
from rfpose.feedback.tracking.hidden import TILTS, WORMS, ZEROS, generator
from rfpose.feedback.tracking.instruments import CameraSpots, DroneFlights, Instrument, RadioPoses, measure, plate_looks
from rfpose.feedback.tracking.methods import Knowledge, Method
from rfpose.feedback.tracking.plant import Plant
from rfpose.feedback.tracking.postures import PosturesInTime, aimed
from rfpose.feedback.tracking.radio import RadioByPosture
from rfpose.feedback.tracking.timeline import Day, heat_of, hour_of_day, look_times, site_of
from rfpose.sun import sun_position

__all__ = [
    "LEARNED",
    "STEEP",
    "ZERO_NAMES",
    "CalibrationPlan",
    "Calibrator",
    "calibration_of",
    "correct_zeros",
    "posture_scatter_rad",
    "prior_sigma",
]

ZERO_NAMES = ("axis_1_zero_rad", "axis_2_zero_rad")
LEARNED = (
    "pedestal_tilt_north_rad", "pedestal_tilt_east_rad", *ZERO_NAMES, "nonorthogonality_rad", "gravity_sag_rad", *WORMS,
)  # fmt: skip
"""What radio corrects in the model of a mount."""
STEEP = 0.3
"""Cosine of the elevation below which azimuth says too little to correct its zero."""

_PRIORS = {
    "location_east_m": 0.05,
    "location_north_m": 0.05,
    "location_up_m": 0.05,
    "gravity_sag_rad": 1e-3,
    **dict.fromkeys(WORMS, 2e-3),
}
_LARGE = 0.03
_TURNS = 12
_PLATE = columns_of(("receiver_plane_right_rad", "receiver_plane_up_rad"))
_DAYS_BEFORE = 100_000
_NO_ROW = aim_rows(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]), source_is_point=False, target_is_point=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationPlan:
    """How a model of a mount is made from looks at it.

    Attributes
    ----------
    instrument
        What looks.
    interval_days, n_look
        Days from one calibration to the next, and looks at each mirror in the course of one.
    free
        What is fitted to all looks, or corrected after one of them.
    corrections, tolerance_m
        0: a fit. Else both zeros are corrected so often, by whole motor steps, after a look that each mirror has at a
        time of its own, as long as its spot is further off than this.
    place
        Of its random numbers.
    """

    instrument: Instrument
    interval_days: float
    n_look: int
    free: tuple[str, ...]
    corrections: int = 0
    tolerance_m: float = 0.0
    place: int = 0

    def last(self, day: Day) -> int:
        """Return days from the run's first to the last calibration before a day; on the first it is half as old."""
        half = self.interval_days / 2.0
        cycles = np.floor((day.since_first - 1 + half) / self.interval_days)
        return int(np.floor(cycles * self.interval_days - half))


def calibration_of(knowledge: Knowledge, plant: Plant, radio: RadioByPosture | None) -> CalibrationPlan | None:
    """Return how a method comes to its knowledge; None: it keeps to the mounts as planned."""
    plan = plant.scenario.tracking
    camera, drone, by_radio = plan.camera, plan.drone, plan.radio_model
    if knowledge == "camera":
        return CalibrationPlan(
            instrument=CameraSpots(plant), interval_days=camera.interval_days, n_look=camera.points_per_day,
            free=PARAMETER_SETS["malan"] + (WORMS if camera.worm else ()), place=20,
        )  # fmt: skip
    if knowledge == "drone":
        return CalibrationPlan(
            instrument=DroneFlights(plant), interval_days=drone.interval_days, n_look=drone.points,
            free=(*PARAMETER_SETS["edwards-4"], "nonorthogonality_rad"), place=21,
        )  # fmt: skip
    if knowledge == "radio":
        assert radio is not None
        return CalibrationPlan(
            instrument=RadioPoses(plant, radio), interval_days=by_radio.interval_days, n_look=by_radio.points_per_day,
            free=LEARNED, place=22,
        )  # fmt: skip
    if knowledge == "bias":
        return CalibrationPlan(
            instrument=CameraSpots(plant), interval_days=camera.bias_interval_days, n_look=_TURNS, free=ZERO_NAMES,
            corrections=1, place=24,
        )  # fmt: skip
    if knowledge == "berenguel":
        return CalibrationPlan(
            instrument=CameraSpots(plant), interval_days=camera.berenguel_interval_days, n_look=_TURNS, free=ZERO_NAMES,
            corrections=camera.berenguel_corrections, tolerance_m=1e-3 * camera.berenguel_tolerance_mm, place=24,
        )  # fmt: skip
    return None


def prior_sigma(name: str) -> float:
    """Return what fits know of a parameter beforehand, about zero."""
    return _PRIORS.get(name, _LARGE)


def posture_scatter_rad(plant: Plant) -> float:
    """Return what a single posture is off for wind, steps and slack, one component [rad]."""
    drive = plant.scenario.tracking.drive
    step = drive.step_rad / np.sqrt(12.0)
    slack = 1e-3 * float(np.mean(drive.backlash_mrad)) / np.sqrt(12.0)
    return float(np.sqrt(plant.gusts.variance_rad2 + step**2 + slack**2))


class Calibrator:
    """Makes the models that methods steer by.

    Parameters
    ----------
    plant
        Its mirrors are looked at.
    radio
        Errors of radio poses; None without radio.
    """

    def __init__(self, plant: Plant, radio: RadioByPosture | None) -> None:
        self._plant, self._radio = plant, radio
        self._plate: FloatArray | None = None

    def model(self, method: Method, day: Day) -> FloatArray:
        """Return what a method believes of the mounts on the morning of a day (mirror, parameter)."""
        p = self._plant.field.nominal.copy()
        if method.radio:
            p[:, _PLATE] = self._plate_estimate()
        calibration = calibration_of(method.knowledge, self._plant, self._radio)
        if calibration is None:
            return p
        since = calibration.last(day)
        return (
            self._corrected(p, calibration, since) if calibration.corrections else self._fitted(p, calibration, since)
        )

    def _look(
        self, model: FloatArray, unix_s: FloatArray, since_first: int, rng: np.random.Generator, target: FloatArray
    ) -> PosturesInTime:
        """Steer all mirrors by a model at some instants and see where they really point."""
        field, plan, gusts = self._plant.field, self._plant.scenario.tracking, self._plant.gusts
        site = site_of(self._plant.scenario)
        sun = sun_position(unix_s, site).direction_enu
        count, _, rows = aimed(model, field.constant, sun, None if field.is_dish else target)
        n, m = count.shape[:2]
        step = float(plan.drive.microsteps)
        count = np.rint(count / step) * step
        per_rad = constant(field.constant, "counts_per_unit")[:, None]
        slack = 0.5e-3 * np.array(plan.drive.backlash_mrad) * rng.uniform(-1.0, 1.0, (n, m, 2))
        heat = heat_of(hour_of_day(unix_s, site))
        normal, centre = np.empty((n, m, 3)), np.empty((n, m, 3))
        built = field.at(since_first)
        for j in range(m):
            p = built.copy()
            p[:, TILTS] += field.lean_rad * heat[j]
            out = _kernels.posture_batch(p, field.constant, (count + slack * per_rad)[:, j : j + 1].copy(), 0.0)
            normal[:, j], centre[:, j] = out[:, 0, 2:5], out[:, 0, 5:]
        seen = np.asarray(np.isfinite(count).all(axis=-1))
        look = PosturesInTime(
            sun_enu=sun, heat=heat, count=count, seen=seen, rows=rows, normal_enu=normal, centre_enu_m=centre,
        )  # fmt: skip
        bent = look.tilted(gusts.bend_rad(gusts.draw(rng, (n, m))) + gusts.swing_rad(rng, (n, m)))
        return replace(look, normal_enu=bent)

    def _fitted(self, start: FloatArray, calibration: CalibrationPlan, since_first: int) -> FloatArray:
        """Fit all mirrors; one that cannot be fitted keeps its start."""
        plant, free = self._plant, calibration.free
        rng = generator(plant.seed, calibration.place, since_first + _DAYS_BEFORE)
        unix_s = look_times(plant.scenario, since_first, calibration.n_look)
        look = self._look(start, unix_s, since_first, rng, calibration.instrument.target_enu_m)
        rows = measure(calibration.instrument, look, rng)
        # the model's own faults scatter as well: wind, gears, steps
        rows[..., M.sigma_rad] = np.hypot(rows[..., M.sigma_rad], posture_scatter_rad(plant))
        use = np.isfinite(rows).all(axis=-1) & look.seen
        count = np.where(use[..., None], look.count, 0.0)
        rows[~use] = _NO_ROW
        found = solve(
            start, plant.field.constant, np.ascontiguousarray(count), np.ascontiguousarray(rows), use, free,
            FitSettings(sigma_known=True, huber=3.0, priors={name: (0.0, prior_sigma(name)) for name in free}),
        )  # fmt: skip
        p = start.copy()
        good = np.isfinite(found.working).all(axis=1)
        p[np.ix_(good, columns_of(free))] = found.working[good]
        return p

    def _corrected(self, start: FloatArray, calibration: CalibrationPlan, since_first: int) -> FloatArray:
        """Take off both axes what a camera sees the spot to be off, once a mirror, in whole motor steps."""
        plant, target = self._plant, calibration.instrument.target_enu_m
        rng = generator(plant.seed, calibration.place, since_first + _DAYS_BEFORE, calibration.corrections)
        when = look_times(plant.scenario, since_first, calibration.n_look)
        # mirrors take turns at the target, each at its own time of the day
        turn_of = rng.integers(calibration.n_look, size=len(plant.field))
        sun = sun_position(when, site_of(plant.scenario)).direction_enu[turn_of]
        p = start.copy()
        per_rad = constant(plant.field.constant, "counts_per_unit") / plant.scenario.tracking.drive.microsteps
        for _ in range(calibration.corrections):
            look = self._look(p, when, since_first, rng, target).of_turns(turn_of)
            error, _ = calibration.instrument.draw(look, rng)
            wanted = geometry.bisector_enu(target - look.centre_enu_m[:, 0], sun)
            distance = np.linalg.norm(target - look.centre_enu_m[:, 0], axis=1)
            seen = look.tilted(error)[:, 0]
            far = 2.0 * distance * np.linalg.norm(wanted - seen, axis=1) > calibration.tolerance_m
            correct_zeros(p, np.where(far[:, None], wanted, seen), seen, per_rad=per_rad)
        return p

    def _plate_estimate(self) -> FloatArray:
        """(mirror, 2) right and up: radio less camera on the camera's first day, or nothing."""
        if self._plate is None:
            plant = self._plant
            self._plate = np.zeros((len(plant.field), 2))
            found = plate_looks(plant)
            if found is not None:
                assert self._radio is not None
                camera = CameraSpots(plant)
                since_first, n_look = found
                rng = generator(plant.seed, 23)
                unix_s = look_times(plant.scenario, since_first, n_look)
                look = self._look(plant.field.nominal, unix_s, since_first, rng, camera.target_enu_m)
                seen, _ = camera.draw(look, rng)
                radio, _ = RadioPoses(plant, self._radio).draw(look, rng)
                self._plate = np.nan_to_num(np.nanmean(radio - seen, axis=1))
        return self._plate


def correct_zeros(
    model: FloatArray, wanted_enu: FloatArray, seen_enu: FloatArray, *, per_rad: FloatArray | float = np.inf
) -> None:
    """Take off both axes' zeros what mirrors were seen to be off, in place.

    Parameters
    ----------
    model : (mirror, parameter)
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
    turn = np.stack([np.where(cosine > STEEP, -right_off / cosine, 0.0), up_off], axis=1)
    if np.all(np.isfinite(per_rad)):
        turn = np.rint(turn * per_rad) / per_rad
    turn[~np.isfinite(turn).all(axis=1)] = 0.0
    # the model is told that the axes stand short by what they have to turn further
    model[:, ZEROS] -= turn
