"""A world with errors in it: what receivers then measure, and what the solver makes of it.

Ranges are exact distances, not linear ones; calibration goes through `rfpose.dsp.calibration.average_phases`, poses
through `solve_rigid`, `solve_with_ground` or `solve_poses`. Whole wavelengths count as resolved.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp.calibration import PhaseAverage, average_phases
from rfpose.layout.budget.plan import WorkingPoint
from rfpose.multilat import range_differences, solve_poses
from rfpose.multilat.ground import CalibrationSight, solve_with_ground
from rfpose.multilat.rigid import solve_rigid

__all__ = ["DrawnSites"]

_NODES = np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
_NODE_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
"""Gauss-Legendre: instants of a frame that stand for its mean."""


class DrawnSites:
    """Several draws of a site with errors; sources add theirs before `normal_errors`.

    Attributes
    ----------
    plan, rng, n_draw
        The working point; the draws' generator; how many frames are drawn at once.
    transmitter_enu_m, calibration_enu_m : (draw, transmitter, xyz), (draw, calibration receiver, xyz)
        True places [m].
    receiver_mirror_m : (draw, mirror, receiver, xyz)
        True places, from the pivot [m].
    surveyed_pivot_enu_m : (draw, mirror, xyz)
        What the solver is told [m].
    range_m : (draw, mirror, group, receiver, transmitter)
        Added to measured ranges [m].
    calibration_m : (draw, calibration receiver, tone, transmitter)
        Added to ranges measured by the calibration receivers [m].
    range_scale : (draw,)
        Share by which all measured ranges are longer.
    glass_tilt_rad : (draw, mirror, xy)
        Normal of the glass against that of the receivers, along the mirror's axes [rad].
    turn_rate_rad_per_s : (draw, mirror, xy)
        Rate of the normal along the mirror's axes [rad/s].
    latency_s
        From the frame's end to the instant whose pose counts [s].
    with_ground, coefficient, ground_height_m
        Whether the ground reflects, how (draw,), and how much higher it lies than assumed (draw,) [m].
    """

    def __init__(self, plan: WorkingPoint, n_draw: int, rng: np.random.Generator) -> None:
        self.plan, self.rng, self.n_draw = plan, rng, n_draw
        scenario, mirrors = plan.scenario, plan.mirrors
        n_mirror, n_group, n_receiver, n_transmitter = plan.thermal_m.shape
        n_calibration = len(scenario.calibration_receiver)
        self.transmitter_enu_m = np.tile(scenario.transmitter_enu_m, (n_draw, 1, 1))
        self.calibration_enu_m = np.tile(scenario.calibration_enu_m, (n_draw, 1, 1))
        places = np.broadcast_to(mirrors.receiver_mirror_m, (n_mirror, n_receiver, 3))
        self.receiver_mirror_m = np.tile(places, (n_draw, 1, 1, 1))
        self.surveyed_pivot_enu_m = np.tile(mirrors.pivot_enu_m, (n_draw, 1, 1))
        self.range_m = np.zeros((n_draw, n_mirror, n_group, n_receiver, n_transmitter))
        self.calibration_m = np.zeros((n_draw, n_calibration, plan.waves.n_tone, n_transmitter))
        self.range_scale = np.zeros(n_draw)
        self.glass_tilt_rad = np.zeros((n_draw, n_mirror, 2))
        self.turn_rate_rad_per_s = np.zeros((n_draw, n_mirror, 2))
        self.latency_s = 0.0
        self._average: PhaseAverage | None = None
        self.with_ground = plan.reflects
        ground = scenario.simulation.ground
        self.coefficient = np.full(n_draw, 0j if ground is None else complex(*ground.coefficient))
        self.ground_height_m = np.zeros(n_draw)

    def normal(self, *shape: int) -> FloatArray:
        """Return standard normal numbers."""
        return np.asarray(self.rng.standard_normal(shape))

    def normal_errors(self) -> FloatArray:
        """Measure and solve: (draw, mirror, xy) solved less true normals along the mirrors' axes [rad]; NaN failed."""
        normal = self._solve(self._measured())
        rot = self.plan.mirrors.rot_enu_from_mirror
        glass = np.concatenate([self.glass_tilt_rad, np.ones((*self.glass_tilt_rad.shape[:2], 1))], axis=2)
        glass /= np.linalg.norm(glass, axis=2, keepdims=True)
        error = np.einsum("mxa,dmx->dma", rot, normal) - glass
        return np.asarray(error[..., :2])

    # -- what is measured ------------------------------------------------------------------------------------

    def _measured(self) -> FloatArray:
        """(draw, mirror, group, receiver, transmitter) phases as ranges, calibration not yet off [m]."""
        if not np.any(self.turn_rate_rad_per_s):
            return self._ranges(self._receivers(np.zeros_like(self.turn_rate_rad_per_s))) + self.range_m
        radio = self.plan.scenario.radio
        frame_s = radio.frame_samples / radio.sample_rate_hz
        # the pose that counts is the nominal one; the frame shows earlier ones
        before_s = self.latency_s + 0.5 * frame_s * (1.0 - _NODES)
        seen = [
            weight * self._ranges(self._receivers(-time * self.turn_rate_rad_per_s))
            for time, weight in zip(before_s, _NODE_WEIGHTS, strict=True)
        ]
        return np.asarray(np.sum(seen, axis=0) + self.range_m)

    def _receivers(self, tilt_rad: FloatArray) -> FloatArray:
        """(draw, mirror, receiver, xyz) places of the receivers with the normal tilted along the mirror's axes."""
        mirrors = self.plan.mirrors
        turn = np.stack([-tilt_rad[..., 1], tilt_rad[..., 0], np.zeros_like(tilt_rad[..., 0])], axis=-1)
        places = self.receiver_mirror_m
        # rotation by a small vector, to second order: what is left of 1 mrad is 1e-9
        once = np.cross(turn[:, :, None], places)
        places = places + once + 0.5 * np.cross(turn[:, :, None], once)
        turned = np.einsum("mab,dmrb->dmra", mirrors.rot_enu_from_mirror, places)
        return np.asarray(mirrors.pivot_enu_m[None, :, None] + turned)

    def _ranges(self, receiver_enu_m: FloatArray) -> FloatArray:
        """(draw, mirror, group, receiver, transmitter) distances, air and ground included [m]."""
        offset = receiver_enu_m[:, :, :, None] - self.transmitter_enu_m[:, None, None]
        distance = np.linalg.norm(offset, axis=-1) * (1.0 + self.range_scale)[:, None, None, None]
        out = np.repeat(distance[:, :, None], len(self.plan.waves.tone_hz), axis=2)
        for d in range(self.n_draw if self.with_ground else 0):
            reflector = self.plan.reflector(complex(self.coefficient[d]), float(self.ground_height_m[d]))
            shift = self.plan.shift_m(self.transmitter_enu_m[d], receiver_enu_m[d], reflector)
            out[d] += np.moveaxis(shift, -1, 1)
        return out

    def _calibration_ranges(self) -> FloatArray:
        """(draw, calibration receiver, tone, transmitter) [m]."""
        offset = self.calibration_enu_m[:, :, None] - self.transmitter_enu_m[:, None]
        distance = np.linalg.norm(offset, axis=-1) * (1.0 + self.range_scale)[:, None, None]
        out = np.repeat(distance[:, :, None], self.plan.waves.n_tone, axis=2) + self.calibration_m
        for d in range(self.n_draw if self.with_ground else 0):
            reflector = self.plan.reflector(complex(self.coefficient[d]), float(self.ground_height_m[d]))
            shift = self.plan.shift_m(self.transmitter_enu_m[d], self.calibration_enu_m[d], reflector, tones_only=True)
            out[d] += np.moveaxis(shift, -1, 1)
        return out

    # -- what is made of it ----------------------------------------------------------------------------------

    def _solve(self, range_m: FloatArray) -> FloatArray:
        """(draw, mirror, xyz) normals."""
        range_m = self._calibrate(range_m)
        if not self.plan.estimator.rigid:
            return self._solve_independent(range_m)
        if self.plan.estimates_ground:
            return np.stack([self._solve_ground(range_m[d : d + 1], slice(d, d + 1)) for d in range(self.n_draw)])[:, 0]
        if self.plan.reflects:
            return self._solve_ground(range_m, slice(None))
        plan, n_draw = self.plan, self.n_draw
        poses = solve_rigid(plan.problem(range_m, self.surveyed_pivot_enu_m))
        return poses.normal_enu.reshape(n_draw, -1, 3)

    def _calibrate(self, range_m: FloatArray) -> FloatArray:
        """Take the electronic phases off the tones, whole wavelengths put back as the true pose has them."""
        plan = self.plan
        if not plan.scenario.calibration_receiver:
            return range_m
        per_m = 2.0 * np.pi / plan.waves.wavelength_m[: plan.waves.n_tone, 0]
        found = self._calibration_ranges()
        self._average = average_phases(
            np.moveaxis(-found * per_m[:, None], 2, 3),
            np.broadcast_to(np.moveaxis(plan.calibration_thermal_m * per_m[:, None], 1, 2), found.swapaxes(2, 3).shape)
            * np.sqrt(1.0 + plan.converter_share),
            calibration_enu_m=plan.scenario.calibration_enu_m,
            transmitter_enu_m=plan.scenario.transmitter_enu_m,
            wavelength_m=plan.waves.wavelength_m[: plan.waves.n_tone, 0],
            survey_sigma_m=plan.survey_sigma_m,
        )
        electronic = np.moveaxis(self._average.phase_rad, 2, 1)[:, None, :, None] / per_m[:, None, None]
        out = range_m.copy()
        tones = out[:, :, : plan.waves.n_tone]
        tones += electronic
        wavelength = plan.waves.wavelength_m[: plan.waves.n_tone, 0][:, None, None]
        tones -= wavelength * np.rint((tones - range_m[:, :, : plan.waves.n_tone]) / wavelength)
        return out

    def _solve_ground(self, range_m: FloatArray, draws: slice) -> FloatArray:
        plan, n_draw = self.plan, len(range_m)
        ground = plan.scenario.simulation.ground
        assert ground is not None
        coefficient = None if plan.estimates_ground else complex(*ground.coefficient)
        solution = solve_with_ground(
            plan.problem(range_m, self.surveyed_pivot_enu_m[draws]),
            carrier_rf_hz=plan.scenario.carrier_rf_hz,
            reflectors=(plan.reflector(coefficient),),
            calibration_enu_m=self._calibration_sight(np.repeat(np.arange(self.n_draw)[draws], range_m.shape[1])),
            free_space=plan.scenario.simulation.path_loss == "free_space",
            min_probability=0.0,
            propagation_speed_mps=plan.scenario.radio.propagation_speed_mps,
        )
        resolved: npt.NDArray[np.bool_] = np.asarray(solution.fixed.all(axis=1))
        normal = np.where(resolved[:, None], solution.poses.normal_enu, np.nan)
        return normal.reshape(n_draw, -1, 3)

    def _calibration_sight(self, draw: npt.NDArray[np.int64]) -> CalibrationSight | None:
        """Return how reflections at the calibration receivers get into the ranges of mirrors of these draws."""
        plan, average = self.plan, self._average
        if average is None:
            return None
        per_m = (2.0 * np.pi / plan.waves.wavelength_m[: plan.waves.n_tone, 0])[:, None]
        return CalibrationSight(
            place_enu_m=plan.scenario.calibration_enu_m,
            survey_sigma_m=plan.survey_sigma_m,
            frame=draw,
            change_m=lambda shift_m, draws: average.change_rad(per_m * shift_m, draws) / per_m,
        )

    def _solve_independent(self, range_m: FloatArray) -> FloatArray:
        plan, scenario = self.plan, self.plan.scenario
        n_draw, n_mirror, n_group, n_receiver, n_transmitter = range_m.shape
        per_m = (2.0 * np.pi / plan.waves.wavelength_m[:, 0])[:, None]
        phase = np.moveaxis(-range_m * per_m[:, None], 2, -1).reshape(n_draw, -1, n_transmitter, n_group)
        sigma = np.moveaxis(plan.sigma_m * per_m[:, None], 1, -1).reshape(-1, n_transmitter, n_group)
        ranges = range_differences(
            phase,
            np.broadcast_to(sigma, phase.shape),
            np.zeros(phase.shape[2:]),
            (plan.transmitter_sigma_m * per_m).T,
            plan.waves.wavelength_m[:, 0],
            scenario.transmitter_enu_m,
        )
        poses = solve_poses(
            scenario.transmitter_enu_m,
            ranges.range_difference_m,
            sigma_m=ranges.sigma_m,
            calibration_sigma_m=ranges.calibration_sigma_m,
            mirror_rows=[slice(k * n_receiver, (k + 1) * n_receiver) for k in range(n_mirror)],
            receiver_mirror_m=list(plan.places_m),
        )
        return poses.normals.normal_enu.reshape(n_draw, n_mirror, 3)
