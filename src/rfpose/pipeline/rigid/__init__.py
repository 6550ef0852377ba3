"""Rigid poses of a recording's mirrors by the chosen estimator: direct or two-ray, guarded, delays learned."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from rfpose.dsp import PhaseCalibration, TonePhases
from rfpose.multilat import RangeDifferences
from rfpose.multilat.estimation import protected, without_vague
from rfpose.pipeline.choice import PoseChoice
from rfpose.pipeline.formats.result import FixTable, PoseTable
from rfpose.pipeline.mirrors import mirror_groups
from rfpose.pipeline.rigid.inputs import RigidInputs, solve_group
from rfpose.pipeline.rigid.tables import RigidOutcome, RigidTables
from rfpose.scenario import Scenario

__all__ = ["RigidOutcome", "solve_rigid_poses"]


def solve_rigid_poses(
    tones: TonePhases,
    calibration: PhaseCalibration,
    ranges: RangeDifferences,
    fixes: FixTable,
    independent: PoseTable,
    scenario: Scenario,
    choice: PoseChoice,
    *,
    sample_rate: Fraction,
) -> RigidOutcome:
    """Solve every mirror of every frame as a rigid body.

    The coarsest tone comes first, finer tones and the carrier follow where their whole wavelengths are safe. The
    carrier is used between receivers on one oscillator.

    Parameters
    ----------
    tones, calibration, ranges, fixes
        The stages before.
    independent
        Normals of separately located receivers: where a mirror cannot be solved as a whole, its status.
    scenario
        The site.
    choice
        The estimator; its ``pose`` is ``rigid``.
    sample_rate
        Of the recording, for the time between frames [1/s].
    """
    stages = RigidInputs(
        tones=tones, calibration=calibration, ranges=ranges, fixes=fixes, scenario=scenario, choice=choice
    )
    tables = RigidTables(stages, independent)
    start = tones.frame_start_index
    time_s = np.array([float((int(s) - int(start[0])) / sample_rate) for s in start])
    for group in mirror_groups(scenario):
        missed = scenario.integrity.missed_detection
        found = without_vague(protected(solve_group(stages, group), missed))
        if group.learns_delays:
            found = protected(tables.put_delays(group, found, time_s), missed)
        tables.put(group, found)
        if choice.filtered:
            tables.put_filtered(group, found, time_s, exposure_s=float(scenario.radio.frame_samples / sample_rate))
    return tables.outcome()
