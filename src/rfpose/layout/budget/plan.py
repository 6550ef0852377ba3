"""What a solver will believe about a site, and how its ranges respond to what is off: the budget's working point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.errors import GeometryError, InvalidInputError
from rfpose.layout.gain import Gain, ReflectionBend, normal_gain
from rfpose.layout.maps import PosedMirrors, check_site
from rfpose.measurement import (
    Estimator,
    GroundHandling,
    Wavelengths,
    calibration_sigma_m,
    estimators_of,
    ground_handling,
    noise_of,
    simulated_ground,
    wavelengths_of,
)
from rfpose.multilat import check_unambiguous
from rfpose.multilat.ground import Reflector, range_shift_m
from rfpose.multilat.rigid import MirrorProblem
from rfpose.multilat.rigid.integers import solve_ladder
from rfpose.scenario import Scenario

__all__ = ["WorkingPoint", "converter_share_of", "working_point"]

_STEP_M = 1e-3
_COEFFICIENT_STEP = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkingPoint:
    """The working point: expected poses, wavelengths used, and what the solver assumes; arrays are read-only.

    Attributes
    ----------
    scenario, mirrors
        The site, and the expected poses of its mirrors.
    estimator
        As `rfpose process` would solve them.
    ground
        What the solver does about a ground that reflects.
    waves
        The wavelengths used; a group is one of them.
    thermal_m : (mirror, group, receiver, transmitter)
        Own noise without the converter's [m].
    calibration_thermal_m : (calibration receiver, tone, transmitter)
        [m].
    converter_share
        Variance of rounding over that of thermal noise.
    by_place, by_transmitter : (mirror, group, receiver, transmitter, xyz)
        Slope of each range by the receiver's and by the transmitter's place.
    calibration_by_place, calibration_by_transmitter : (calibration receiver, tone, transmitter, xyz)
        The same at the calibration receivers.
    stray_m : (mirror, group, receiver, transmitter), optional
        What reflections of neighbours, tower and own plate add to ranges [m]; None: nothing is known of them.
    calibration_stray_m : (calibration receiver, tone, transmitter), optional
        The same at the calibration receivers [m].
    """

    scenario: Scenario
    mirrors: PosedMirrors
    estimator: Estimator
    ground: GroundHandling
    waves: Wavelengths
    thermal_m: FloatArray
    calibration_thermal_m: FloatArray
    converter_share: float
    by_place: FloatArray
    by_transmitter: FloatArray
    calibration_by_place: FloatArray
    calibration_by_transmitter: FloatArray
    stray_m: FloatArray | None = None
    calibration_stray_m: FloatArray | None = None

    @property
    def sigma_m(self) -> FloatArray:
        """(mirror, group, receiver, transmitter) own noise that the solver assumes [m]."""
        return np.asarray(self.thermal_m * np.sqrt(1.0 + self.converter_share))

    @property
    def survey_sigma_m(self) -> FloatArray:
        """(calibration receiver,) survey in each axis [m]."""
        return np.array([r.survey_sigma_m for r in self.scenario.calibration_receiver])

    @property
    def calibration_sigma_m(self) -> FloatArray:
        """(calibration receiver, tone, transmitter) error of each one's phases that the solver assumes [m]."""
        variance = self.calibration_thermal_m**2 * (1.0 + self.converter_share)
        return np.asarray(np.sqrt(variance + self.survey_sigma_m[:, None, None] ** 2))

    @property
    def calibration_weight(self) -> FloatArray:
        """(calibration receiver, tone, transmitter) share of each in the calibration, as `rfpose.dsp` weighs them."""
        weight = self.calibration_sigma_m**-2.0
        return np.asarray(weight / weight.sum(axis=0))

    @property
    def transmitter_sigma_m(self) -> FloatArray:
        """(group, transmitter) error common to all receivers that the solver assumes; infinity: uncalibrated [m].

        Where it knows a reflection, without what the calibration's survey adds: that is `survey_slope`.
        """
        out = self.direct_sigma_m
        if self.reflects and len(self.survey_sigma_m):
            noise = self.calibration_weight * self.calibration_thermal_m * np.sqrt(1.0 + self.converter_share)
            out[: self.waves.n_tone] = np.sqrt((noise**2).sum(axis=0))
        return out

    @property
    def direct_sigma_m(self) -> FloatArray:
        """(group, transmitter) `transmitter_sigma_m` of a solver that knows no reflection: surveys are noise [m]."""
        out = np.full(self.waves.wavelength_m.shape, np.inf)
        noise = self.calibration_thermal_m * np.sqrt(1.0 + self.converter_share)
        out[: self.waves.n_tone] = calibration_sigma_m(noise, self.survey_sigma_m)
        return out

    @property
    def survey_slope(self) -> FloatArray:
        """(group, transmitter, draw) of calibrated ranges by unit draws of the calibration receivers' places [m]."""
        n = len(self.survey_sigma_m)
        root = np.einsum("cgta,c,cd->cgtda", self.calibration_by_place, self.survey_sigma_m, np.eye(n))
        out = np.zeros((*self.waves.wavelength_m.shape, 3 * n))
        out[: self.waves.n_tone] = -self.calibration_mean(root.reshape(*root.shape[:3], 3 * n))
        return out

    def calibration_mean(self, range_m: FloatArray) -> FloatArray:
        """(tone, transmitter, …) what ranges of the calibration receivers (…, tone, transmitter, …) come to [m]."""
        return np.asarray(np.einsum("cgt,cgt...->gt...", self.calibration_weight, range_m))

    @property
    def reflects(self) -> bool:
        """Whether the ground reflects and the solver knows it."""
        return self.scenario.simulation.ground is not None and self.ground != "ignored"

    @property
    def estimates_ground(self) -> bool:
        """Whether the solver finds the reflection's coefficient itself."""
        return self.reflects and self.ground == "estimated"

    def reflector(self, coefficient: complex | None, height_offset_m: float = 0.0) -> Reflector:
        """Return the ground with a coefficient (None: to be estimated), at another height."""
        return simulated_ground(self.scenario, coefficient=coefficient, height_offset_m=height_offset_m)

    def shift_m(
        self, transmitter_enu_m: FloatArray, point_enu_m: FloatArray, reflector: Reflector, *, tones_only: bool = False
    ) -> FloatArray:
        """Return what a reflection adds to ranges, (..., transmitter, group) of points (..., xyz) [m]."""
        tone = self.waves.tone_hz[: self.waves.n_tone] if tones_only else self.waves.tone_hz
        out = range_shift_m(
            transmitter_enu_m,
            point_enu_m.reshape(-1, 3),
            reflectors=(reflector,),
            carrier_rf_hz=self.scenario.carrier_rf_hz,
            tone_hz=tone,
            free_space=self.scenario.simulation.path_loss == "free_space",
            propagation_speed_mps=self.scenario.radio.propagation_speed_mps,
        )
        return out.reshape(*point_enu_m.shape[:-1], *out.shape[1:])

    def calibrated_shift_m(self, reflector: Reflector) -> FloatArray:
        """(mirror, group, receiver, transmitter) what a reflection adds to calibrated ranges [m]."""
        transmitter = self.scenario.transmitter_enu_m
        shift = np.moveaxis(self.shift_m(transmitter, self.mirrors.receiver_enu_m, reflector), -1, 1)
        if self.scenario.calibration_receiver:
            there = self.shift_m(transmitter, self.scenario.calibration_enu_m, reflector, tones_only=True)
            shift[:, : self.waves.n_tone] -= self.calibration_mean(np.swapaxes(there, 1, 2))[:, None]
        return shift

    @property
    def places_m(self) -> FloatArray:
        """(mirror, receiver, xyz) where the solver believes receivers to be, from the pivot [m]."""
        places = self.mirrors.receiver_mirror_m
        return np.broadcast_to(places, (len(self.mirrors.pivot_enu_m), *places.shape[1:]))

    def problem(self, range_m: FloatArray, surveyed_pivot_enu_m: FloatArray) -> MirrorProblem:
        """Return what the solver gets, one row a draw and mirror; it begins at the expected poses.

        Parameters
        ----------
        range_m : (draw, mirror, group, receiver, transmitter)
            What is measured [m].
        surveyed_pivot_enu_m : (draw, mirror, xyz)
            What it is told [m].
        """
        n_draw, waves = len(range_m), self.waves
        problem = MirrorProblem.of(
            self.scenario.transmitter_enu_m,
            np.tile(self.places_m, (n_draw, 1, 1)),
            range_m.reshape(-1, *range_m.shape[2:]),
            sigma_m=np.tile(self.sigma_m, (n_draw, 1, 1, 1)),
            transmitter_sigma_m=self.transmitter_sigma_m,
            clock_class=waves.clock_class,
            start_pivot_enu_m=np.tile(self.mirrors.pivot_enu_m, (n_draw, 1)),
            start_rot_enu_from_mirror=np.tile(self.mirrors.rot_enu_from_mirror, (n_draw, 1, 1)),
            knowledge=replace(self.estimator, pivot_enu_m=surveyed_pivot_enu_m.reshape(-1, 3)),
        )
        return replace(problem, wavelength_m=waves.wavelength_m, is_carrier=waves.is_carrier)

    def gain(self) -> Gain:
        """Return what each range does to each normal at the working point."""
        reflection = None
        if self.reflects:
            direct = _directions(self.scenario.transmitter_enu_m, self.mirrors.receiver_enu_m)
            reflection = ReflectionBend(
                place_slope=self.by_place - direct[:, None],
                shared_slope=self._coefficient_slope(),
                survey_slope=self.survey_slope,
            )
        return normal_gain(
            self.scenario.transmitter_enu_m,
            self.mirrors,
            self.sigma_m,
            self.transmitter_sigma_m,
            self.waves.clock_class,
            self.estimator,
            reflection=reflection,
        )

    def coefficient_slope(self) -> FloatArray:
        """(mirror, group, receiver, transmitter, 2) of calibrated ranges by the coefficient's two parts [m]."""
        ground = self.scenario.simulation.ground
        assert ground is not None
        value = complex(*ground.coefficient)
        columns = [
            self.calibrated_shift_m(self.reflector(value + step))
            - self.calibrated_shift_m(self.reflector(value - step))
            for step in (_COEFFICIENT_STEP, 1j * _COEFFICIENT_STEP)
        ]
        return np.stack(columns, axis=-1) / (2.0 * _COEFFICIENT_STEP)

    def height_slope(self) -> FloatArray:
        """(mirror, group, receiver, transmitter) of calibrated ranges by the ground's height."""
        ground = self.scenario.simulation.ground
        assert ground is not None
        value = complex(*ground.coefficient)
        above, below = (self.calibrated_shift_m(self.reflector(value, h)) for h in (_STEP_M, -_STEP_M))
        return (above - below) / (2.0 * _STEP_M)

    def _coefficient_slope(self) -> FloatArray:
        if self.estimates_ground:
            return self.coefficient_slope()
        return np.zeros((*self.thermal_m.shape, 0))


def working_point(scenario: Scenario, mirrors: PosedMirrors, *, pose: str = "rigid") -> WorkingPoint:
    """Return the working point of a scenario's budget.

    Finer tones and the carrier take part where the solver would trust their whole wavelengths on every mirror.

    Parameters
    ----------
    scenario
        Heliostats alike in receivers' number, clocks, pivots and mount.
    mirrors
        Its mirrors in their postures; several postures are several rows.
    pose
        ``rigid``, or ``independent`` for separately located receivers.

    Raises
    ------
    ScenarioError
        A ground that reflects carriers without a radio frequency.
    InvalidInputError
        Unknown ``pose``; ground known or estimated with separately located receivers.
    GeometryError
        Heliostats that differ; transmitters too few, on a line or plane; a field too wide for the longest tone.
    """
    if pose not in ("rigid", "independent"):
        raise InvalidInputError(f"`pose` must be rigid or independent, got {pose!r}")
    check_site(scenario.mast_enu_m)
    transmitter = scenario.transmitter_enu_m
    if scenario.simulation.ground is not None:
        scenario.need_rf_carriers("[simulation] `ground`")
    check_unambiguous(transmitter, scenario.wavelength_m)
    estimator = _estimator(scenario, pose)
    noise = noise_of(scenario)
    own, _ = noise.groups(carrier=estimator.carrier)
    receiver = mirrors.receiver_enu_m
    plan = WorkingPoint(
        scenario=scenario,
        mirrors=mirrors,
        estimator=estimator,
        ground=ground_handling(scenario) if estimator.rigid or scenario.budget.ground else "ignored",
        waves=wavelengths_of(scenario, carrier=estimator.carrier),
        thermal_m=read_only(own[:, None] * noise.loss(transmitter, receiver)[:, None]),
        calibration_thermal_m=read_only(
            noise.tone_sigma_m * noise.loss(transmitter, scenario.calibration_enu_m)[:, None]
        ),
        converter_share=converter_share_of(scenario, receiver),
        by_place=np.empty(0),
        by_transmitter=np.empty(0),
        calibration_by_place=np.empty(0),
        calibration_by_transmitter=np.empty(0),
    )
    if plan.reflects and not estimator.rigid:
        raise InvalidInputError("[budget] `ground` must be ignored with pose independent, which knows no reflection")
    if estimator.rigid:
        plan = _with_trusted_groups(plan)
    return _with_slopes(plan)


def _estimator(scenario: Scenario, pose: str) -> Estimator:
    """Return the solver's settings, as `rfpose process` takes them from a scenario."""
    if not scenario.heliostat:
        raise GeometryError("the scenario has no heliostats; add some, or a field from CSV")
    if pose == "independent":
        return Estimator(name=pose, rigid=False)
    kinds = estimators_of(scenario)
    if len(kinds) > 1:
        raise GeometryError(
            "heliostats differ in oscillator, delays, pivot survey, mount or carrier phase; study them in separate "
            "scenarios"
        )
    return next(iter(kinds))


def converter_share_of(scenario: Scenario, receiver_enu_m: FloatArray) -> float:
    """Return the variance of a converter's rounding over that of thermal noise; see docs/simulation.md.

    Parameters
    ----------
    scenario
    receiver_enu_m : (..., xyz)
        Mirrors' receivers [m].
    """
    plan = scenario.simulation
    if plan.sample_format != "int16":
        return 0.0
    noise = scenario.tone[0].modulation_index * 10.0 ** (-plan.tone_snr_db / 20.0) / np.sqrt(2.0)
    place = np.concatenate([receiver_enu_m.reshape(-1, 3), scenario.calibration_enu_m])
    amplitude = np.array([t.amplitude for t in scenario.transmitter])
    free = plan.path_loss == "free_space"
    loss = plan.reference_range_m / _ranges(scenario.transmitter_enu_m, place) if free else 1.0
    total = np.broadcast_to(amplitude * loss, (len(place), len(amplitude))).sum(axis=1)
    if plan.ground is not None:
        image = scenario.transmitter_enu_m * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * plan.ground.height_m]
        loss = plan.reference_range_m / _ranges(image, place) if free else 1.0
        reflected = np.broadcast_to(amplitude * loss, (len(place), len(amplitude))).sum(axis=1)
        total = total + abs(complex(*plan.ground.coefficient)) * reflected
    peak = (1.0 + sum(t.modulation_index for t in scenario.tone)) * float(total.max()) + 4.0 * noise
    step = peak * 10.0 ** (plan.headroom_db / 20.0) / (2.0 ** (plan.adc_bits - 1) - 1.0)
    return float(step**2 / 12.0 / noise**2)


def _with_trusted_groups(plan: WorkingPoint) -> WorkingPoint:
    """Keep the wavelengths whose integers the solver resolves on every mirror."""
    mirrors, transmitter = plan.mirrors, plan.scenario.transmitter_enu_m
    distance = _ranges(transmitter, mirrors.receiver_enu_m)[None, :, None]
    exact = np.repeat(distance, len(plan.waves.tone), axis=2)
    problem = plan.problem(exact, mirrors.pivot_enu_m[None])
    common = np.broadcast_to(plan.direct_sigma_m, problem.transmitter_sigma_m.shape)
    solution = solve_ladder(replace(problem, transmitter_sigma_m=common))
    kept: npt.NDArray[np.bool_] = np.asarray(solution.fixed.all(axis=0))
    return replace(
        plan,
        waves=plan.waves.kept(kept),
        thermal_m=plan.thermal_m[:, kept],
        calibration_thermal_m=plan.calibration_thermal_m[:, kept[: plan.waves.n_tone]],
    )


def _with_slopes(plan: WorkingPoint) -> WorkingPoint:
    """Add the slopes of ranges by receivers' and transmitters' places, reflections included where they are solved."""
    transmitter, there = plan.scenario.transmitter_enu_m, plan.scenario.calibration_enu_m
    receiver = plan.mirrors.receiver_enu_m
    place = np.repeat(_directions(transmitter, receiver)[:, None], len(plan.waves.tone_hz), axis=1)
    tower = -place
    calibration_place = np.repeat(_directions(transmitter, there)[:, None], plan.waves.n_tone, axis=1)
    calibration_tower = -calibration_place
    if plan.reflects:
        ground = plan.scenario.simulation.ground
        assert ground is not None
        reflector = plan.reflector(complex(*ground.coefficient))
        for axis, step in enumerate(_STEP_M * np.eye(3)):
            at = plan.shift_m(transmitter, receiver + step, reflector) - plan.shift_m(
                transmitter, receiver - step, reflector
            )
            by = plan.shift_m(transmitter + step, receiver, reflector) - plan.shift_m(
                transmitter - step, receiver, reflector
            )
            place[..., axis] += np.moveaxis(at, -1, 1) / (2.0 * _STEP_M)
            tower[..., axis] += np.moveaxis(by, -1, 1) / (2.0 * _STEP_M)
            if not len(there):
                continue
            at = plan.shift_m(transmitter, there + step, reflector, tones_only=True)
            at = at - plan.shift_m(transmitter, there - step, reflector, tones_only=True)
            by = plan.shift_m(transmitter + step, there, reflector, tones_only=True)
            by = by - plan.shift_m(transmitter - step, there, reflector, tones_only=True)
            calibration_place[..., axis] += np.moveaxis(at, -1, 1) / (2.0 * _STEP_M)
            calibration_tower[..., axis] += np.moveaxis(by, -1, 1) / (2.0 * _STEP_M)
    return replace(
        plan,
        by_place=read_only(place),
        by_transmitter=read_only(tower),
        calibration_by_place=read_only(calibration_place),
        calibration_by_transmitter=read_only(calibration_tower),
    )


def _ranges(transmitter: FloatArray, point: FloatArray) -> FloatArray:
    """(..., transmitter) distances [m]."""
    return np.asarray(np.linalg.norm(point[..., None, :] - transmitter, axis=-1))


def _directions(transmitter: FloatArray, point: FloatArray) -> FloatArray:
    """(..., transmitter, xyz) unit vectors from transmitters to points."""
    offset = point[..., None, :] - transmitter
    return np.asarray(offset / np.linalg.norm(offset, axis=-1, keepdims=True))
