"""Poses by the direct ray alone, wavelength by wavelength, guarded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rfpose.checks import FloatArray
from rfpose.multilat import PoseStatus
from rfpose.multilat.integrity import GuardedPoses, TransmitterStatus, solve_with_integrity
from rfpose.multilat.rigid import Knowledge, solve_rigid
from rfpose.multilat.rigid.integers import Observation, solve_ladder
from rfpose.pipeline.mirrors import (
    MirrorGroup,
)
from rfpose.pipeline.rigid.found import (
    RESIDUAL_PROBABILITY,
    Found,
    Stages,
    are_doubted,
    joined,
    keep_where,
    pose_status,
    residual_probability,
    where_known,
)
from rfpose.pipeline.rigid.inputs import inputs_of
from rfpose.scenario import Scenario


def solve_direct(stages: Stages, group: MirrorGroup) -> Found:
    """Solve by the direct ray: leave out what is wrong in the coarsest tone, climb, test all wavelengths together."""
    scenario = stages.scenario
    places, start, rot, phases = inputs_of(stages, group)
    known = group.knowledge(scenario, len(stages.tones.frame_start_index))
    first: GuardedPoses | None = None
    if stages.choice.integrity:
        first = _guard(scenario, places, phases[:1], start, rot, known)
        phases = keep_where(phases, first.used)
    ladder = solve_ladder(
        scenario.transmitter_enu_m,
        places,
        phases,
        start_pivot_enu_m=start,
        start_rot_enu_from_mirror=rot,
        knowledge=known,
    )
    found = Found(
        poses=ladder.poses,
        status=pose_status(ladder.poses.status),
        fixed=ladder.fixed,
        wrong_risk=ladder.wrong_risk,
        method=ladder.method,
        ranges=[replace(o, range_m=z) for o, z in zip(phases, ladder.range_m, strict=True)],
        known=known,
    )
    probability = residual_probability(ladder.poses)
    if first is None:
        found.status[(found.status == PoseStatus.OK) & (probability < RESIDUAL_PROBABILITY)] = PoseStatus.RESIDUAL
        return found
    at, at_rot = where_known(ladder.poses.pivot_enu_m, start), where_known(ladder.poses.rot_enu_from_mirror, rot)
    guard = joined(first, _guard(scenario, places, found.ranges, at, at_rot, known))
    status = pose_status(guard.poses.status)
    status[(status == PoseStatus.OK) & are_doubted(guard)] = PoseStatus.UNEXPLAINED
    return replace(
        found,
        poses=guard.poses,
        status=status,
        ranges=keep_where(found.ranges, guard.used),
        guard=guard,
        probability_all=_probability_of_all(stages, group, first, probability),
    )


def _guard(
    scenario: Scenario,
    places: FloatArray,
    phases: list[Observation],
    pivot: FloatArray,
    rot: FloatArray,
    known: Knowledge,
) -> GuardedPoses:
    """Solve, test and leave out, with integers resolved."""
    table = scenario.integrity
    return solve_with_integrity(
        scenario.transmitter_enu_m,
        places,
        np.stack([o.range_m for o in phases], axis=1),
        sigma_m=np.stack([o.sigma_m for o in phases], axis=1),
        transmitter_sigma_m=np.stack([o.transmitter_sigma_m for o in phases], axis=1),
        clock_class=[o.clock_class for o in phases],
        start_pivot_enu_m=pivot,
        start_rot_enu_from_mirror=rot,
        knowledge=known,
        false_alarm=table.false_alarm,
        missed_detection=table.missed_detection,
        max_excluded=table.max_excluded,
    )


def _probability_of_all(stages: Stages, group: MirrorGroup, first: GuardedPoses, probability: FloatArray) -> FloatArray:
    """Probability of the residuals with nothing left out: where something was, of the coarsest tone's."""
    out = probability.copy()
    rows = np.flatnonzero((first.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1))
    if not rows.size:
        return out
    places, start, rot, phases = inputs_of(stages, group)
    known = group.knowledge(stages.scenario, len(stages.tones.frame_start_index))
    if known.pivot_enu_m is not None:
        known = replace(known, pivot_enu_m=known.pivot_enu_m[rows])
    coarse = phases[0]
    poses = solve_rigid(
        stages.scenario.transmitter_enu_m,
        places[rows],
        coarse.range_m[rows][:, None],
        sigma_m=coarse.sigma_m[rows][:, None],
        transmitter_sigma_m=coarse.transmitter_sigma_m[rows][:, None],
        clock_class=[0],
        start_pivot_enu_m=start[rows],
        start_rot_enu_from_mirror=rot[rows],
        knowledge=known,
    )
    out[rows] = residual_probability(poses)
    return out
