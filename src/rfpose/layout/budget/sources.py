"""Error sources: how each moves the ranges, to first order and exactly.

Every source says both in its own way: ``effects`` multiplies the estimator's gain by slopes; ``disturb`` changes the
world in which ranges are then computed and solved. Neither uses the other, so that each checks the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rfpose.checks import FloatArray
from rfpose.layout.budget.plan import WorkingPoint
from rfpose.layout.budget.world import DrawnSites
from rfpose.scenario import Scenario

__all__ = ["SOURCES", "Effect", "Source"]


@dataclass(frozen=True, slots=True)
class Effect:
    """What independent unit draws do.

    Attributes
    ----------
    slope : (mirror, output, draw)
        ``output``: the normal's two components, then the unknowns that all mirrors share.
    common
        Whether the same draws hold for all mirrors.
    past_solver
        Whether it moves the normal without passing through the solver.
    """

    slope: FloatArray
    common: bool = False
    past_solver: bool = False


class DescribedPoint(Protocol):
    """A working point of any estimator, as far as its site says it all."""

    @property
    def scenario(self) -> Scenario:
        """The site."""

    @property
    def converter_share(self) -> float:
        """Variance of rounding over that of thermal noise."""


class Source(Protocol):
    """One line of the budget."""

    name: str
    remedy: str

    def assumed(self, plan: WorkingPoint) -> str:
        """Return what is assumed, in words; empty where the site does not have this source."""

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        """Return what it does by slopes (mirror, output, group, receiver, transmitter) and (mirror, output, xyz)."""

    def disturb(self, world: DrawnSites) -> None:
        """Draw this source's errors into the world."""


def _calibrated(plan: WorkingPoint) -> bool:
    return bool(plan.scenario.calibration_receiver)


def _of_calibration(plan: WorkingPoint, by_range: FloatArray, root_m: FloatArray) -> Effect:
    """Errors of calibration phases: ``root_m`` (calibration receiver, tone, transmitter, draw) in ranges there [m]."""
    through = by_range[:, :, : plan.waves.n_tone].sum(axis=3)
    return Effect(-np.einsum("magt,gtx->max", through, plan.calibration_mean(root_m)), common=True)


def _diagonal(sigma_m: FloatArray) -> FloatArray:
    """(calibration receiver, tone, transmitter) to (…, draw), one draw each."""
    return np.asarray((sigma_m.reshape(-1)[:, None] * np.eye(sigma_m.size)).reshape(*sigma_m.shape, sigma_m.size))


def _flat(slope: FloatArray) -> FloatArray:
    return slope.reshape(*slope.shape[:2], -1)


class Thermal:
    """Receivers' own noise."""

    name = "thermal noise"
    remedy = "longer frames or several of them (error falls as 1/√time), more power, a shorter wavelength"

    def assumed(self, plan: DescribedPoint) -> str:
        s = plan.scenario
        return f"{s.simulation.tone_snr_db:g} dB a sample, {s.radio.frame_samples} samples"

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        return [Effect(_flat(by_range * plan.thermal_m[:, None]))]

    def disturb(self, world: DrawnSites) -> None:
        world.range_m += world.plan.thermal_m * world.normal(*world.range_m.shape)


class Quantisation:
    """Rounding by the converter, in mirrors' and calibration receivers."""

    name = "quantisation"
    remedy = "more converter bits, less headroom, longer frames"

    def assumed(self, plan: DescribedPoint) -> str:
        if plan.converter_share == 0.0:
            return ""
        return f"{plan.scenario.simulation.adc_bits} bits, {plan.scenario.simulation.headroom_db:g} dB headroom"

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        share = np.sqrt(plan.converter_share)
        found = [Effect(_flat(by_range * (share * plan.thermal_m[:, None])))]
        if _calibrated(plan):
            found.append(_of_calibration(plan, by_range, _diagonal(share * plan.calibration_thermal_m)))
        return found

    def disturb(self, world: DrawnSites) -> None:
        share = np.sqrt(world.plan.converter_share)
        world.range_m += share * world.plan.thermal_m * world.normal(*world.range_m.shape)
        shape = world.calibration_m.shape
        world.calibration_m += share * world.plan.calibration_thermal_m * world.normal(*shape)


class Clock:
    """Delays between a mirror's receivers."""

    name = "clock"
    remedy = "measure the delays, learn them over frames, or leave them unknown (one clock a receiver)"

    def _sigma_m(self, plan: WorkingPoint) -> float:
        s = plan.scenario.budget.receiver_delay_sigma_s
        own = plan.scenario.heliostat[0].receiver_delay_sigma_s
        return float((own or 0.0) if s is None else s) * plan.scenario.radio.propagation_speed_mps

    def assumed(self, plan: WorkingPoint) -> str:
        delay_ns = 1e9 * self._sigma_m(plan) / plan.scenario.radio.propagation_speed_mps
        if np.isinf(plan.estimator.clock_sigma_m) or not plan.estimator.rigid:
            return "delays between receivers unknown, solved for in every frame"
        return f"{delay_ns:.3g} ns between a mirror's receivers"

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        return [Effect(self._sigma_m(plan) * by_range.sum(axis=(2, 4)))]

    def disturb(self, world: DrawnSites) -> None:
        n_draw, n_mirror, _, n_receiver, _ = world.range_m.shape
        delay = self._sigma_m(world.plan) * world.normal(n_draw, n_mirror, n_receiver)
        world.range_m += delay[:, :, None, :, None]


class CalibrationNoise:
    """Noise of the calibration receivers."""

    name = "calibration noise"
    remedy = "more calibration receivers, or average their phases over frames"

    def assumed(self, plan: WorkingPoint) -> str:
        n = len(plan.scenario.calibration_receiver)
        return f"{n} receiver{'s' if n > 1 else ''}, noise like the mirrors'" if n else ""

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        return [_of_calibration(plan, by_range, _diagonal(plan.calibration_thermal_m))]

    def disturb(self, world: DrawnSites) -> None:
        world.calibration_m += world.plan.calibration_thermal_m * world.normal(*world.calibration_m.shape)


class CalibrationSurvey:
    """Surveyed places of the calibration receivers."""

    name = "calibration survey"
    remedy = "survey the calibration receivers better; use more of them"

    def assumed(self, plan: WorkingPoint) -> str:
        return f"{1e3 * plan.survey_sigma_m.max():.3g} mm in each axis" if np.any(plan.survey_sigma_m > 0.0) else ""

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        # a solver that knows no reflection takes the sigma in each axis for one of each range by itself
        return [Effect(np.einsum("magrt,gtx->max", by_range, plan.survey_slope), common=True)]

    def disturb(self, world: DrawnSites) -> None:
        world.calibration_enu_m += world.plan.survey_sigma_m[:, None] * world.normal(*world.calibration_enu_m.shape)


class TransmitterSurvey:
    """Surveyed places of the transmitters, the same for all receivers."""

    name = "transmitter survey"
    remedy = "survey the antennas better, or solve for them from many mirrors' poses"

    def assumed(self, plan: DescribedPoint) -> str:
        sigma_mm = 1e3 * plan.scenario.budget.transmitter_survey_sigma_m
        return f"{sigma_mm:.3g} mm in each axis" if sigma_mm > 0.0 else ""

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        sigma = plan.scenario.budget.transmitter_survey_sigma_m
        direct = np.einsum("magrt,mgrtx->matx", by_range, plan.by_transmitter)
        found = [sigma * direct.reshape(*direct.shape[:2], -1)]
        if _calibrated(plan):
            n = len(plan.scenario.transmitter)
            root = np.einsum("cgta,ts->cgtsa", plan.calibration_by_transmitter, sigma * np.eye(n))
            found.append(_of_calibration(plan, by_range, root.reshape(*root.shape[:3], -1)).slope)
        return [Effect(np.sum(found, axis=0), common=True)]

    def disturb(self, world: DrawnSites) -> None:
        sigma = world.plan.scenario.budget.transmitter_survey_sigma_m
        world.transmitter_enu_m += sigma * world.normal(*world.transmitter_enu_m.shape)


class TransmitterDrift:
    """Electronic phases of the transmitters since their calibration."""

    name = "phase drift"
    remedy = "calibrate more often; thermostats or references at the transmitters"

    def _sigma_m(self, plan: WorkingPoint) -> FloatArray:
        """(tone, transmitter)."""
        s = plan.scenario
        rate = s.simulation.transmitter_phase_drift_rad_per_sqrt_h / 60.0
        span = age = s.budget.calibration_age_s
        if s.budget.drift_time_scale_s is not None:
            scale = s.budget.drift_time_scale_s
            span = scale * (1.0 - np.exp(-age / scale))
        return np.asarray(rate * np.sqrt(span) * plan.waves.wavelength_m[: plan.waves.n_tone] / (2.0 * np.pi))

    def assumed(self, plan: WorkingPoint) -> str:
        s = plan.scenario
        if not _calibrated(plan) or not np.any(self._sigma_m(plan) > 0.0):
            return ""
        scale = s.budget.drift_time_scale_s
        levels = "" if scale is None else f", levelling off after {scale:g} s"
        rate = s.simulation.transmitter_phase_drift_rad_per_sqrt_h
        return f"{1e3 * rate:.3g} mrad/√h, calibration {s.budget.calibration_age_s:g} s old{levels}"

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        slope = by_range[:, :, : plan.waves.n_tone].sum(axis=3) * self._sigma_m(plan)
        return [Effect(_flat(slope), common=True)]

    def disturb(self, world: DrawnSites) -> None:
        sigma = self._sigma_m(world.plan)
        drift = sigma * world.normal(world.n_draw, *sigma.shape)
        world.range_m[:, :, : world.plan.waves.n_tone] += drift[:, None, :, None]


class ReceiverPlacement:
    """Places of the receivers on their mirror."""

    name = "receiver places"
    remedy = "measure the receivers on the mirror better, set them farther apart; constant, so calibration takes it out"

    def assumed(self, plan: DescribedPoint) -> str:
        sigma_mm = 1e3 * plan.scenario.budget.receiver_mirror_sigma_m
        return f"{sigma_mm:.3g} mm in each axis" if sigma_mm > 0.0 else ""

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        sigma = plan.scenario.budget.receiver_mirror_sigma_m
        slope = np.einsum("magrt,mgrtx,mxb->marb", by_range, plan.by_place, plan.mirrors.rot_enu_from_mirror)
        return [Effect(_flat(sigma * slope))]

    def disturb(self, world: DrawnSites) -> None:
        sigma = world.plan.scenario.budget.receiver_mirror_sigma_m
        world.receiver_mirror_m += sigma * world.normal(*world.receiver_mirror_m.shape)


class Misalignment:
    """Angle between the receivers' plane and the glass, which no radio sees."""

    name = "receiver plane to glass"
    remedy = "calibrate against a camera or the sun once; constant for a mirror"

    def assumed(self, plan: DescribedPoint) -> str:
        sigma = plan.scenario.budget.receiver_plane_sigma_mrad
        return f"{sigma:.3g} mrad about each axis" if sigma > 0.0 else ""

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        sigma = 1e-3 * plan.scenario.budget.receiver_plane_sigma_mrad
        return [_turned(plan, by_range, sigma)]

    def disturb(self, world: DrawnSites) -> None:
        sigma = 1e-3 * world.plan.scenario.budget.receiver_plane_sigma_mrad
        world.glass_tilt_rad += sigma * world.normal(*world.glass_tilt_rad.shape)


def _turned(plan: WorkingPoint, by_range: FloatArray, sigma_rad: float) -> Effect:
    slope = np.zeros((*by_range.shape[:2], 2))
    slope[:, 0, 0] = slope[:, 1, 1] = sigma_rad
    return Effect(slope, past_solver=True)


class Pivot:
    """Survey of the pivots, where the solver uses it."""

    name = "pivot survey"
    remedy = "survey the pivots better; with calibrated transmitters it may be left out"

    def assumed(self, plan: WorkingPoint) -> str:
        sigma = plan.estimator.pivot_sigma_m
        return f"{1e3 * sigma:.3g} mm in each axis" if plan.estimator.rigid and np.isfinite(sigma) else ""

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        return [Effect(plan.estimator.pivot_sigma_m * by_pivot)]

    def disturb(self, world: DrawnSites) -> None:
        world.surveyed_pivot_enu_m += world.plan.estimator.pivot_sigma_m * world.normal(
            *world.surveyed_pivot_enu_m.shape
        )


class GroundReflection:
    """The ground's second ray: ignored, known with an uncertainty, or estimated with the poses."""

    name = "ground reflection"
    remedy = 'model it ([budget] ground = "estimated"); survey the ground\'s height; antennas that do not see it'

    def assumed(self, plan: WorkingPoint) -> str:
        ground, settings = plan.scenario.simulation.ground, plan.scenario.budget
        if ground is None:
            return ""
        value = complex(*ground.coefficient)
        text = f"coefficient {value.real:g}{value.imag:+g}j, {plan.ground}"
        if plan.ground == "ignored":
            return text
        if plan.ground == "known":
            text += f" to {settings.ground_coefficient_sigma:g}"
        return f"{text}, height to {1e3 * settings.ground_height_sigma_m:g} mm"

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        ground, settings = plan.scenario.simulation.ground, plan.scenario.budget
        assert ground is not None
        if not plan.reflects:
            bias = plan.calibrated_shift_m(plan.reflector(complex(*ground.coefficient)))
            return [Effect(np.einsum("magrt,mgrt->ma", by_range, bias)[..., None], common=True)]
        height = settings.ground_height_sigma_m * plan.height_slope()
        found = [Effect(np.einsum("magrt,mgrt->ma", by_range, height)[..., None], common=True)]
        if not plan.estimates_ground:
            by_part = settings.ground_coefficient_sigma * plan.coefficient_slope()
            found.append(Effect(np.einsum("magrt,mgrtx->max", by_range, by_part), common=True))
        return found

    def disturb(self, world: DrawnSites) -> None:
        settings = world.plan.scenario.budget
        world.with_ground = True
        if not world.plan.reflects:
            return
        world.ground_height_m += settings.ground_height_sigma_m * world.normal(world.n_draw)
        if not world.plan.estimates_ground:
            re, im = settings.ground_coefficient_sigma * world.normal(2, world.n_draw)
            world.coefficient += re + 1j * im


class ForeseenReflections:
    """Rays off neighbours, the tower and the mirror's own plate, foreseen from their geometry."""

    name = "reflections of the site"
    remedy = "pose `site`, which has them in its model; its own budget says what they cost then"

    def assumed(self, plan: WorkingPoint) -> str:
        return "" if plan.stray_m is None else "rays foreseen from outlines and [site.structures]"

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        assert plan.stray_m is not None
        assert plan.calibration_stray_m is not None
        shift = plan.stray_m.copy()
        if _calibrated(plan):
            shift[:, : plan.waves.n_tone] -= plan.calibration_mean(plan.calibration_stray_m)[:, None]
        return [Effect(np.einsum("magrt,mgrt->ma", by_range, shift)[..., None], common=True)]

    def disturb(self, world: DrawnSites) -> None:
        plan = world.plan
        assert plan.stray_m is not None
        assert plan.calibration_stray_m is not None
        world.range_m += plan.stray_m
        world.calibration_m += plan.calibration_stray_m


class StrayRay:
    """One stray ray for every receiver and transmitter, of random phase and detour."""

    name = "other multipath"
    remedy = "receivers clear of metal, antennas with a pattern; a larger modulation frequency; average over postures"

    def assumed(self, plan: WorkingPoint) -> str:
        s = plan.scenario.budget
        return "" if s.multipath_db is None else f"{s.multipath_db:g} dB, detour {s.multipath_excess_m:g} m on average"

    def _root_m(self, plan: WorkingPoint) -> tuple[FloatArray, FloatArray]:
        """Factor of the covariance of tones' shifts (tone, tone), and sigma of the carriers' (transmitter,) [m].

        A weak ray of relative amplitude a, phase α and detour Δ shifts a tone of wavenumber κ by a cos α sin(κΔ)/κ and
        a carrier of wavenumber k by a sin α/k.
        """
        s = plan.scenario.budget
        assert s.multipath_db is not None
        a = 10.0 ** (s.multipath_db / 20.0)
        speed = plan.scenario.radio.propagation_speed_mps
        kappa = 2.0 * np.pi * plan.waves.tone_hz[: plan.waves.n_tone] / speed

        def mean_cos(k: FloatArray) -> FloatArray:
            return np.asarray(1.0 / (1.0 + (k * s.multipath_excess_m) ** 2))

        both = 0.5 * (mean_cos(kappa[:, None] - kappa) - mean_cos(kappa[:, None] + kappa))
        cov = 0.5 * a**2 * both / (kappa[:, None] * kappa)
        values, vectors = np.linalg.eigh(cov)
        carrier_k = 2.0 * np.pi * plan.scenario.carrier_rf_hz / speed
        return vectors * np.sqrt(np.maximum(values, 0.0)), a / np.sqrt(2.0) / carrier_k

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        root, carrier = self._root_m(plan)
        n = plan.waves.n_tone
        found = [Effect(_flat(np.einsum("magrt,gx->marxt", by_range[:, :, :n], root)))]
        if by_range.shape[2] > n:
            found.append(Effect(_flat(by_range[:, :, n:] * carrier)))
        if _calibrated(plan):
            n_cal, _, n_transmitter = plan.calibration_weight.shape
            each = np.einsum("gx,cd,ts->cgtdsx", root, np.eye(n_cal), np.eye(n_transmitter))
            found.append(_of_calibration(plan, by_range, each.reshape(*each.shape[:3], -1)))
        return found

    def disturb(self, world: DrawnSites) -> None:
        s = world.plan.scenario.budget
        assert s.multipath_db is not None
        a = 10.0 ** (s.multipath_db / 20.0)
        waves, shape = world.plan.waves, world.range_m[:, :, 0].shape
        world.range_m += _stray_m(world, a, s.multipath_excess_m, shape, waves.tone_hz)
        if _calibrated(world.plan):
            shape = world.calibration_m[:, :, 0].shape
            world.calibration_m += _stray_m(world, a, s.multipath_excess_m, shape, waves.tone_hz[: waves.n_tone])


def _stray_m(world: DrawnSites, a: float, excess_m: float, shape: tuple[int, ...], tone_hz: FloatArray) -> FloatArray:
    """Exact shift of ranges (draw, place, group, …, transmitter) by one weak ray each; ``shape`` without the group."""
    phase = 2.0 * np.pi * world.rng.random(shape)
    detour = world.rng.exponential(excess_m, shape)
    speed = world.plan.scenario.radio.propagation_speed_mps
    k = 2.0 * np.pi * world.plan.scenario.carrier_rf_hz / speed
    carrier = 1.0 + a * np.exp(-1j * phase)
    out = []
    for hz in tone_hz:
        if hz == 0.0:
            out.append(-np.angle(carrier) / k)
            continue
        kappa = 2.0 * np.pi * hz / speed
        upper, lower = (1.0 + a * np.exp(-1j * (phase + sign * kappa * detour)) for sign in (1.0, -1.0))
        out.append(-np.angle(upper * carrier.conj() + lower.conj() * carrier) / kappa)
    return np.stack(out, axis=2)


class MirrorMotion:
    """The mirror's turn between the frame's middle, which its phases show, and the instant the pose is taken for."""

    name = "motion in a frame"
    remedy = "shorter frames, or predict the pose from the drive's rate"

    def angle_rad(self, plan: DescribedPoint) -> float:
        """Return by how much the normal turns."""
        s = plan.scenario
        frame_s = s.radio.frame_samples / s.radio.sample_rate_hz
        return 1e-3 * s.budget.mirror_rate_mrad_per_s * (0.5 * frame_s + s.budget.latency_s)

    def assumed(self, plan: DescribedPoint) -> str:
        rate, latency = plan.scenario.budget.mirror_rate_mrad_per_s, plan.scenario.budget.latency_s
        if rate == 0.0:
            return ""
        frame_s = plan.scenario.radio.frame_samples / plan.scenario.radio.sample_rate_hz
        return f"{rate:.3g} mrad/s, frame of {1e3 * frame_s:g} ms" + (f", {latency:g} s later" if latency else "")

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        return [_turned(plan, by_range, self.angle_rad(plan) / np.sqrt(2.0))]

    def disturb(self, world: DrawnSites) -> None:
        direction = 2.0 * np.pi * world.rng.random(world.glass_tilt_rad.shape[:2])
        s = world.plan.scenario
        rate = 1e-3 * s.budget.mirror_rate_mrad_per_s
        world.turn_rate_rad_per_s += rate * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
        world.latency_s = s.budget.latency_s


class Wavelength:
    """Air's refractive index: all ranges by the same share."""

    name = "wavelength (air)"
    remedy = "set `propagation_speed_mps` to that of the site's air, from temperature, pressure and humidity"

    def sigma(self, plan: DescribedPoint) -> float:
        """Return the relative error of all ranges."""
        stated = plan.scenario.budget.refractivity_sigma_ppm
        vacuum = plan.scenario.radio.propagation_speed_mps == 299_792_458.0
        return 1e-6 * ((300.0 if vacuum else 20.0) if stated is None else stated)

    def assumed(self, plan: DescribedPoint) -> str:
        sigma = self.sigma(plan)
        return f"refractive index to {1e6 * sigma:g} ppm" if sigma > 0.0 else ""

    def effects(self, plan: WorkingPoint, by_range: FloatArray, by_pivot: FloatArray) -> list[Effect]:
        transmitter = plan.scenario.transmitter_enu_m
        distance = np.linalg.norm(plan.mirrors.receiver_enu_m[:, :, None] - transmitter, axis=-1)
        slope = np.einsum("magrt,mrt->ma", by_range, distance)[..., None]
        found = [self.sigma(plan) * slope]
        if _calibrated(plan):
            there = np.linalg.norm(plan.scenario.calibration_enu_m[:, None] - transmitter, axis=-1)
            root = np.repeat(there[:, None, :, None], plan.waves.n_tone, axis=1)
            found.append(_of_calibration(plan, by_range, self.sigma(plan) * root).slope)
        return [Effect(np.sum(found, axis=0), common=True)]

    def disturb(self, world: DrawnSites) -> None:
        world.range_scale += self.sigma(world.plan) * world.normal(world.n_draw)


SOURCES: tuple[Source, ...] = (
    Thermal(),
    Quantisation(),
    Clock(),
    CalibrationNoise(),
    CalibrationSurvey(),
    TransmitterSurvey(),
    TransmitterDrift(),
    ReceiverPlacement(),
    Misalignment(),
    Pivot(),
    GroundReflection(),
    ForeseenReflections(),
    StrayRay(),
    MirrorMotion(),
    Wavelength(),
)
"""All sources, in the order in which they are asked."""
