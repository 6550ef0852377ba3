"""A recording's mirrors as arrays for the rigid solvers: which phases, clocks and priors go in, by the scenario."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import PhaseCalibration, TonePhases
from rfpose.dsp.calibration import PhaseAverage
from rfpose.measurement import Estimator, Wavelengths, estimator_of, wavelengths_of
from rfpose.measurement.wavelengths import CARRIER
from rfpose.multilat import FixStatus, RangeDifferences
from rfpose.multilat.ground import CalibrationSight
from rfpose.multilat.rigid import MirrorKnowledge, MirrorProblem, Observation, part_of
from rfpose.multilat.rigid.start import align_points, rotations_from_differences
from rfpose.pipeline.choice import PoseChoice
from rfpose.pipeline.formats.result import FixTable
from rfpose.scenario import Scenario

IntArray = npt.NDArray[np.int64]
_Number = TypeVar("_Number", bound=np.generic)

__all__ = [
    "MirrorGroup",
    "RigidInputs",
    "calibration_sight",
    "carrier_sigma_rad",
    "mirror_groups",
    "mirror_problems",
    "noise_beside_survey",
]

_VAGUE_RATIO = 100.0
"""A calibration off by so many times what the pivot is off by tells nothing of the pose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorGroup:
    """Heliostats that differ in nothing but place: solved in one call.

    Attributes
    ----------
    column : (heliostat,)
    rows : (heliostat, receiver)
        Of the receiver axis.
    places_m : (heliostat, receiver, xyz)
        From the pivot, in the mirror frame [m].
    pivot_enu_m : (heliostat, xyz)
        [m].
    estimator
        What is known of them.
    waves
        What is seen of them.
    """

    column: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    places_m: FloatArray
    pivot_enu_m: FloatArray
    estimator: Estimator
    waves: Wavelengths

    def knowledge(self, n_frame: int) -> MirrorKnowledge:
        """Return what is known of these mirrors, one row a frame and heliostat."""
        return replace(self.estimator, pivot_enu_m=np.tile(self.pivot_enu_m, (n_frame, 1)))

    def of_mirrors(self, values: npt.NDArray[_Number]) -> npt.NDArray[_Number]:
        """Take values (frame, receiver axis, …) apart: (frame × heliostat, receiver, …)."""
        picked = values[:, self.rows]
        return picked.reshape(-1, *picked.shape[2:])

    def range_noise(
        self, tone_rad: FloatArray, carrier_rad: FloatArray, calibration_rad: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return phases' noise as that of ranges; first axis frame × heliostat.

        Parameters
        ----------
        tone_rad, carrier_rad : (frame, receiver axis, transmitter, tone), (frame, receiver axis, transmitter)
            Own noise [rad].
        calibration_rad : (frame, transmitter, tone)
            Of the electronic phases [rad]; None: nothing measures them.

        Returns
        -------
        sigma_m : (mirror, group, receiver, transmitter)
        transmitter_sigma_m : (mirror, group, transmitter)
            Common to all receivers; infinity where nothing tells.
        """
        sigma, common = [], []
        for q, wavelength in zip(self.waves.tone, self.waves.wavelength_m, strict=True):
            to_m = wavelength / (2.0 * np.pi)
            sigma.append(self.of_mirrors(to_m * (carrier_rad if q == CARRIER else tone_rad[..., q])))
            per_frame = np.full(carrier_rad[:, 0].shape, np.inf)
            if q != CARRIER and calibration_rad is not None:
                per_frame = to_m * calibration_rad[..., q]
            common.append(np.repeat(per_frame, len(self.column), axis=0))
        return np.stack(sigma, axis=1), np.stack(common, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidInputs:
    """What the stages before found, and how to go on.

    Attributes
    ----------
    tones, calibration, ranges, fixes
        See `rfpose.pipeline.rigid.solve_rigid_poses`.
    scenario, choice
        The site, and the estimator.
    average
        How the calibration became of its receivers, where a reflection they see as well is in the model.
    """

    tones: TonePhases
    calibration: PhaseCalibration
    ranges: RangeDifferences
    fixes: FixTable
    scenario: Scenario
    choice: PoseChoice
    average: PhaseAverage | None

    @property
    def n_frame(self) -> int:
        """Frames."""
        return len(self.tones.frame_start_index)


def mirror_groups(scenario: Scenario) -> Iterator[MirrorGroup]:
    """Sort heliostats by number of receivers and by what is known of them."""
    kinds: dict[tuple[int, Estimator], list[int]] = {}
    for i, h in enumerate(scenario.heliostat):
        kinds.setdefault((len(h.receiver_ids), estimator_of(scenario, h)), []).append(i)
    for (_, estimator), members in kinds.items():
        helio = [scenario.heliostat[i] for i in members]
        arm = np.array([[0.0, 0.0, h.arm_m] for h in helio])
        yield MirrorGroup(
            column=np.array(members),
            rows=np.array([np.arange(len(scenario.receivers))[scenario.receiver_rows(i)] for i in members]),
            places_m=np.array([h.receiver_mirror_m for h in helio]) + arm[:, None],
            pivot_enu_m=scenario.pivot_enu_m[members],
            estimator=estimator,
            waves=wavelengths_of(scenario, carrier=estimator.carrier),
        )


def mirror_problems(
    inputs: RigidInputs,
) -> Iterator[tuple[MirrorGroup, MirrorProblem, list[tuple[IntArray, MirrorProblem]]]]:
    """Yield the problem that each group's mirrors pose, one row a frame and heliostat.

    Some of its mirrors may begin elsewhere, too: their rows, and where.
    """
    for group in mirror_groups(inputs.scenario):
        problem = _problem_of(inputs, group)
        direct = inputs.choice.reflection == "none"
        yield group, problem, _either_side(inputs, group, problem) if direct else []


def _problem_of(inputs: RigidInputs, group: MirrorGroup) -> MirrorProblem:
    """Return the problem that a group's mirrors pose, one row a frame and heliostat."""
    places = np.tile(group.places_m, (inputs.n_frame, 1, 1))
    pivot, rot = align_points(places, _located(inputs, group))
    problem = MirrorProblem.of_observations(
        inputs.scenario.transmitter_enu_m,
        places,
        _observations(inputs, group),
        start_pivot_enu_m=pivot,
        start_rot_enu_from_mirror=rot,
        knowledge=group.knowledge(inputs.n_frame),
    )
    if inputs.choice.reflection == "none":
        problem = _without_vague_calibration(problem)
    known, weak = problem.knowledge, np.flatnonzero(_are_vague(inputs, group, places))
    if known.pivot_enu_m is not None and np.isfinite(known.pivot_sigma_m) and weak.size:
        pivot[weak] = known.pivot_enu_m[weak]
        rot[weak] = rotations_from_differences(part_of(replace(problem, start_pivot_enu_m=pivot), mirrors=weak))
    return replace(problem, start_pivot_enu_m=pivot, start_rot_enu_from_mirror=rot)


def _observations(inputs: RigidInputs, group: MirrorGroup) -> list[Observation]:
    """Phases of a group's mirrors as ranges, in the order of its wavelengths; first axis frame × heliostat.

    Without calibration receivers the transmitters' own phases stay in, unknown: differences between receivers tell.
    """
    tones, calibration = inputs.tones, inputs.calibration
    calibrated = inputs.scenario.is_calibrated
    sigma_rad = calibration.sigma_rad if calibrated else None
    if inputs.average is not None:
        sigma_rad = noise_beside_survey(inputs.average, calibration.sigma_rad)
    sigma, common = group.range_noise(tones.sigma_rad, carrier_sigma_rad(tones), sigma_rad)
    out = []
    for k, q in enumerate(group.waves.tone):
        wavelength = group.waves.wavelength_m[k]
        if q == CARRIER:
            phase = np.where(np.isfinite(tones.phase_rad[..., 0]), np.angle(tones.carrier), np.nan)
        else:
            phase = tones.phase_rad[..., q] - (calibration.phase_rad[:, None, :, q] if calibrated else 0.0)
        z = group.of_mirrors(-wavelength / (2.0 * np.pi) * phase)
        if k == 0 and not calibrated:
            z = _coarse_uncalibrated(z, float(wavelength[0]))
        elif k == 0:
            reference = group.of_mirrors(inputs.ranges.reference.astype(np.float64))
            z = _coarse(z, group.of_mirrors(inputs.ranges.range_difference_m), reference, float(wavelength[0]))
        out.append(
            Observation(
                range_m=z,
                sigma_m=sigma[:, k],
                transmitter_sigma_m=common[:, k],
                wavelength_m=np.array(wavelength),
                clock_class=int(group.waves.clock_class[k]),
                carrier=q == CARRIER,
            )
        )
    return out


def noise_beside_survey(average: PhaseAverage, sigma_rad: FloatArray) -> FloatArray:
    """Return the electronic phases' noise where `calibration_sight` counts how well their receivers are surveyed.

    Parameters
    ----------
    average
    sigma_rad : (frame, transmitter, tone)
        With the survey [rad]; stays where a frame has no measurement of its own.
    """
    noise = average.noise_rad
    return np.where(np.isfinite(noise), noise, sigma_rad)


def carrier_sigma_rad(tones: TonePhases) -> FloatArray:
    """(frame, receiver, transmitter) standard deviation of the carriers' phases [rad]."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(tones.carrier_sigma / np.abs(tones.carrier))


def _coarse(z: FloatArray, difference_m: FloatArray, reference: FloatArray, wavelength: float) -> FloatArray:
    """Give the coarsest tone's ranges the whole wavelengths that the range differences know.

    A row's reference range keeps its own noise; the rows of a mirror are brought within half a wavelength of each
    other, as near as its receivers are.
    """
    index = np.maximum(reference.astype(np.int64), 0)[..., None]
    base = np.take_along_axis(z, index, axis=-1)
    first = np.nan_to_num(np.take_along_axis(base, np.argmax(np.isfinite(base), axis=1)[:, None], axis=1))
    base = base - wavelength * np.rint((base - first) / wavelength)
    expected = base + difference_m
    return z + wavelength * np.rint((expected - z) / wavelength)


def _coarse_uncalibrated(z: FloatArray, wavelength: float) -> FloatArray:
    """Give the coarsest tone's ranges whole wavelengths that bring a mirror's receivers together.

    Receivers lie within a fraction of the wavelength of each other, up to their clocks, which may be anything. Which
    branch a transmitter's ranges are on does not matter: its own phase is unknown.
    """
    turn = 2.0 * np.pi / wavelength
    seen = np.isfinite(z)
    phasor = np.where(seen, np.exp(1j * turn * np.nan_to_num(z)), 0.0)
    most = np.argmax(seen.sum(axis=2), axis=1)[:, None, None]
    reference = np.take_along_axis(phasor, most, axis=1)
    clock = np.angle((phasor * reference.conj()).sum(axis=2, keepdims=True)) / turn
    common = np.angle((phasor * np.exp(-1j * turn * clock)).sum(axis=1, keepdims=True)) / turn
    left = z - clock - common
    return np.asarray(left - wavelength * np.rint(left / wavelength) + common + clock)


def _located(inputs: RigidInputs, group: MirrorGroup) -> FloatArray:
    """(mirror, receiver, xyz) where each receiver was located by itself [m]."""
    return group.of_mirrors(inputs.fixes.position_enu_m)


def _either_side(
    inputs: RigidInputs, group: MirrorGroup, problem: MirrorProblem
) -> list[tuple[IntArray, MirrorProblem]]:
    """Mirrors with a fix that may be on either side of the transmitters' plane: all below it, then all above it."""
    rows = np.flatnonzero((group.of_mirrors(inputs.fixes.status) == FixStatus.AMBIGUOUS).any(axis=1))
    if not rows.size:
        return []
    middle = problem.transmitter_enu_m.mean(axis=0)
    up = np.linalg.svd(problem.transmitter_enu_m - middle)[2][-1]
    up = up if up[2] >= 0.0 else -up
    located = _located(inputs, group)
    height = ((located - middle) @ up)[..., None]
    sides = []
    for sign in (-1.0, 1.0):
        pivot, rot = align_points(problem.receiver_mirror_m, located + (sign * np.abs(height) - height) * up)
        begun = replace(problem, start_pivot_enu_m=pivot, start_rot_enu_from_mirror=rot)
        sides.append((rows, part_of(begun, mirrors=rows)))
    return sides


def _without_vague_calibration(problem: MirrorProblem) -> MirrorProblem:
    """Leave an old calibration out where the pivot is known far better than it could tell: differences remain.

    What it adds is next to nothing, and so little that the clocks' equations would be singular to working precision.
    """
    common = problem.transmitter_sigma_m
    vague = common > _VAGUE_RATIO * problem.knowledge.pivot_sigma_m
    return replace(problem, transmitter_sigma_m=np.where(vague, np.inf, common))


def _are_vague(inputs: RigidInputs, group: MirrorGroup, places: FloatArray) -> npt.NDArray[np.bool_]:
    """(mirror,) whether a receiver's fix, if there is one, is less certain than the mirror is wide.

    So it is without calibration receivers, or with a calibration that is old.
    """
    variance = np.trace(group.of_mirrors(inputs.fixes.cov_enu_m2), axis1=-2, axis2=-1)
    width = np.linalg.norm(places - places.mean(axis=1, keepdims=True), axis=-1).max(axis=1)
    return np.asarray(~(np.sqrt(variance) < width[:, None]).all(axis=1))


def calibration_sight(
    average: PhaseAverage, scenario: Scenario, frame: npt.NDArray[np.int64], *, surveyed: bool = True
) -> CalibrationSight:
    """Return how the calibration receivers' reflections and places get into ranges.

    Parameters
    ----------
    average
        Of these receivers' phases.
    scenario
    frame : (mirror,)
        Of each mirror that is to be solved.
    surveyed
        Count how well their places are known, which noise then must not hold (`noise_beside_survey`); else they are
        exact.
    """
    order = wavelengths_of(scenario).tone
    per_m = (2.0 * np.pi / scenario.wavelength_m)[:, None]

    def change_m(shift_m: FloatArray, frames: npt.NDArray[np.int64]) -> FloatArray:
        shift = np.zeros(shift_m.shape)
        shift[:, :, order] = shift_m
        # a longer path turns a phase back: Φ without the shifts is what receivers' phases turned forward give
        return (average.change_rad(per_m * shift, frames) / per_m)[:, :, order]

    sigma = np.array([r.survey_sigma_m if surveyed else 0.0 for r in scenario.calibration_receiver])
    return CalibrationSight(
        place_enu_m=scenario.calibration_enu_m, survey_sigma_m=sigma, frame=frame, change_m=change_m
    )
