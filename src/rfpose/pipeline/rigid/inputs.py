"""From the stages before to the problem that one group of mirrors poses, and to the estimator that solves it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rfpose.checks import FloatArray
from rfpose.dsp import PhaseCalibration, TonePhases
from rfpose.dsp.calibration import frame_times, phase_average
from rfpose.measurement import reflectors_of
from rfpose.multilat import FixStatus, RangeDifferences
from rfpose.multilat.estimation import PoseEstimates, ReflectionModel, solve_direct, solve_two_ray
from rfpose.multilat.integrity import Alarms
from rfpose.multilat.rigid import MirrorProblem
from rfpose.multilat.rigid.integers import align_points
from rfpose.multilat.rigid.start import rotations_from_differences
from rfpose.pipeline.choice import PoseChoice
from rfpose.pipeline.formats.result import FixTable
from rfpose.pipeline.mirrors import MirrorGroup, calibration_sight, observations
from rfpose.scenario import Scenario

_VAGUE_RATIO = 100.0
"""A calibration off by so many times what the pivot is off by tells nothing of the pose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidInputs:
    """What the stages before found, and how to go on."""

    tones: TonePhases
    calibration: PhaseCalibration
    ranges: RangeDifferences
    fixes: FixTable
    scenario: Scenario
    choice: PoseChoice

    @property
    def n_frame(self) -> int:
        """Frames."""
        return len(self.tones.frame_start_index)

    @property
    def alarms(self) -> Alarms | None:
        """When to leave something out; None: never."""
        table = self.scenario.integrity
        if not self.choice.integrity:
            return None
        return Alarms(
            false_alarm=table.false_alarm,
            missed_detection=table.missed_detection,
            max_excluded=table.max_excluded,
        )


def solve_group(inputs: RigidInputs, group: MirrorGroup) -> PoseEstimates:
    """Solve one group of mirrors by the chosen estimator."""
    problem = problem_of(inputs, group)
    if inputs.choice.reflection == "none":
        return solve_direct(problem, inputs.alarms, _either_side(inputs, group, problem))
    scenario, tones = inputs.scenario, inputs.tones
    row = np.arange(len(problem.range_m)).reshape(inputs.n_frame, -1)
    frame, heliostat = (index.ravel() for index in np.indices(row.shape))
    average = phase_average(tones.phase_rad, tones.sigma_rad, scenario, frame_times(tones, scenario))
    reflections = ReflectionModel(
        reflectors=reflectors_of(scenario, inputs.choice.reflection),
        carrier_rf_hz=scenario.carrier_rf_hz,
        calibration=calibration_sight(average, scenario, frame),
        free_space=scenario.reflection.spreading == "free_space",
        propagation_speed_mps=scenario.radio.propagation_speed_mps,
    )
    return solve_two_ray(
        problem,
        reflections,
        inputs.alarms,
        surveyed_enu_m=np.tile(group.pivot_enu_m, (inputs.n_frame, 1)),
        heliostat=heliostat,
        shared={"recording": [row.ravel()], "frame": list(row), "mirror": list(row.T)}[scenario.reflection.shared],
    )


def problem_of(inputs: RigidInputs, group: MirrorGroup) -> MirrorProblem:
    """Return the problem that a group's mirrors pose, one row a frame and heliostat."""
    places = np.tile(group.places_m, (inputs.n_frame, 1, 1))
    pivot, rot = align_points(places, _located(inputs, group))
    problem = MirrorProblem.of_observations(
        inputs.scenario.transmitter_enu_m,
        places,
        observations(inputs.tones, inputs.calibration, inputs.ranges, inputs.scenario, group),
        start_pivot_enu_m=pivot,
        start_rot_enu_from_mirror=rot,
        knowledge=group.knowledge(inputs.n_frame),
    )
    if inputs.choice.reflection == "none":
        problem = _without_vague_calibration(problem)
    known, weak = problem.knowledge, np.flatnonzero(_are_vague(inputs, group, places))
    if known.pivot_enu_m is not None and weak.size:
        pivot[weak] = known.pivot_enu_m[weak]
        rot[weak] = rotations_from_differences(replace(problem, start_pivot_enu_m=pivot).take(weak))
    return replace(problem, start_pivot_enu_m=pivot, start_rot_enu_from_mirror=rot)


def _located(inputs: RigidInputs, group: MirrorGroup) -> FloatArray:
    """(mirror, receiver, xyz) where each receiver was located by itself [m]."""
    return group.of_mirrors(inputs.fixes.position_enu_m)


def _either_side(
    inputs: RigidInputs, group: MirrorGroup, problem: MirrorProblem
) -> Iterator[tuple[np.ndarray[tuple[int], np.dtype[np.int64]], MirrorProblem]]:
    """Mirrors with a fix that may be on either side of the transmitters' plane: all below it, then all above it."""
    rows = np.flatnonzero((group.of_mirrors(inputs.fixes.status) == FixStatus.AMBIGUOUS).any(axis=1))
    if not rows.size:
        return
    middle = problem.transmitter_enu_m.mean(axis=0)
    up = np.linalg.svd(problem.transmitter_enu_m - middle)[2][-1]
    up = up if up[2] >= 0.0 else -up
    located = _located(inputs, group)
    height = ((located - middle) @ up)[..., None]
    for sign in (-1.0, 1.0):
        pivot, rot = align_points(problem.receiver_mirror_m, located + (sign * np.abs(height) - height) * up)
        yield rows, replace(problem, start_pivot_enu_m=pivot, start_rot_enu_from_mirror=rot).take(rows)


def _without_vague_calibration(problem: MirrorProblem) -> MirrorProblem:
    """Leave an old calibration out where the pivot is known far better than it could tell: differences remain.

    What it adds is next to nothing, and so little that the clocks' equations would be singular to working precision.
    """
    common = problem.transmitter_sigma_m
    vague = common > _VAGUE_RATIO * problem.knowledge.pivot_sigma_m
    return replace(problem, transmitter_sigma_m=np.where(vague, np.inf, common))


def _are_vague(
    inputs: RigidInputs, group: MirrorGroup, places: FloatArray
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """(mirror,) whether a receiver's fix, if there is one, is less certain than the mirror is wide.

    So it is without calibration receivers, or with a calibration that is old.
    """
    variance = np.trace(group.of_mirrors(inputs.fixes.cov_enu_m2), axis1=-2, axis2=-1)
    width = np.linalg.norm(places - places.mean(axis=1, keepdims=True), axis=-1).max(axis=1)
    return np.asarray(~(np.sqrt(variance) < width[:, None]).all(axis=1))
