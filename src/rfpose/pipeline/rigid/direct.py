"""Poses by the direct ray alone, wavelength by wavelength, guarded."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rfpose.checks import FloatArray
from rfpose.multilat import FixStatus, PoseStatus
from rfpose.multilat.fix import APART_SIGMA, DECISIVE_CHI2
from rfpose.multilat.integrity import GuardedPoses, TransmitterStatus, solve_with_integrity
from rfpose.multilat.rigid import Knowledge, solve_rigid
from rfpose.multilat.rigid.integers import Observation, solve_ladder
from rfpose.pipeline.mirrors import (
    MirrorGroup,
)
from rfpose.pipeline.rigid.found import (
    RESIDUAL_PROBABILITY,
    Found,
    IntArray,
    Stages,
    are_doubted,
    joined,
    keep_where,
    pose_status,
    put_rows,
    residual_probability,
    rows_of,
    where_known,
)
from rfpose.pipeline.rigid.inputs import either_side, inputs_of
from rfpose.scenario import Scenario

_LEFT_OUT_CHI2 = 2.0 * DECISIVE_CHI2
"""What each transmitter or prior that was left out counts, where two poses of a mirror are compared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Begin:
    """Mirrors, what is measured and known of them, and where each begins; first axis mirror."""

    places: FloatArray
    phases: list[Observation]
    pivot: FloatArray
    rot: FloatArray
    known: Knowledge

    def take(self, rows: IntArray) -> _Begin:
        """Select some."""
        known = self.known
        if known.pivot_enu_m is not None:
            known = replace(known, pivot_enu_m=known.pivot_enu_m[rows])
        return _Begin(
            places=self.places[rows],
            phases=[rows_of(o, rows) for o in self.phases],
            pivot=self.pivot[rows],
            rot=self.rot[rows],
            known=known,
        )


def solve_direct(stages: Stages, group: MirrorGroup) -> Found:
    """Solve by the direct ray: leave out what is wrong in the coarsest tone, climb, test all wavelengths together.

    Where a receiver's fix may be on either side of the transmitters' plane, the mirror is solved from both.
    """
    places, start, rot, phases = inputs_of(stages, group)
    known = group.knowledge(len(stages.tones.frame_start_index))
    begin = _Begin(places=places, phases=phases, pivot=start, rot=rot, known=known)
    status = stages.fixes.status[:, group.rows].reshape(len(places), -1)
    twofold = np.flatnonzero((status == FixStatus.AMBIGUOUS).any(axis=1))
    found = _solve_from(stages, begin)
    for pivot, turned in either_side(stages, group) if twofold.size else ():
        again = replace(begin, pivot=pivot, rot=turned).take(twofold)
        found = _decided(found, twofold, _solve_from(stages, again))
    return found


def _decided(found: Found, rows: IntArray, other: Found) -> Found:
    """Keep the better of two poses of some mirrors; where neither is clearly better, say so."""
    doubted = (PoseStatus.OK, PoseStatus.AMBIGUOUS)
    here, there = np.isin(found.status[rows], doubted), other.status == PoseStatus.OK
    gain = _cost(found)[rows] - _cost(other)
    apart = np.linalg.norm(found.poses.normal_enu[rows] - other.poses.normal_enu, axis=1)
    with np.errstate(invalid="ignore"):
        one = apart <= APART_SIGMA * np.maximum(found.poses.tilt_sigma_rad[rows], other.poses.tilt_sigma_rad)
        better = np.flatnonzero(there & (~here | (gain > 0.0)))
        alike = here & there & ~one & (np.abs(gain) <= DECISIVE_CHI2)
        settled = here & there & (gain > DECISIVE_CHI2)
    status = found.status.copy()
    kept = status[rows]
    kept[settled] = PoseStatus.OK
    kept[there & ~here] = PoseStatus.OK
    kept[alike] = PoseStatus.AMBIGUOUS
    status[rows] = kept
    return replace(put_rows(found, rows[better], other, better), status=status)


def _cost(found: Found) -> FloatArray:
    """(mirror,) how badly a pose fits: what was left out for it counts, lest it fits by leaving out."""
    poses = found.poses
    cost = poses.chi2 - poses.dof
    if found.guard is not None:
        out = (found.guard.transmitter_status > TransmitterStatus.NOT_RECEIVED).sum(axis=1)
        cost = cost + _LEFT_OUT_CHI2 * (out + found.guard.prior_rejected.sum(axis=1))
    return np.asarray(cost)


def _solve_from(stages: Stages, begin: _Begin) -> Found:
    """Solve from where mirrors begin."""
    scenario, phases = stages.scenario, begin.phases
    first: GuardedPoses | None = None
    if stages.choice.integrity:
        first = _guard(scenario, begin)
        phases = keep_where(phases, first.used)
    ladder = solve_ladder(
        scenario.transmitter_enu_m,
        begin.places,
        phases,
        start_pivot_enu_m=begin.pivot,
        start_rot_enu_from_mirror=begin.rot,
        knowledge=begin.known,
    )
    found = Found(
        poses=ladder.poses,
        status=pose_status(ladder.poses.status),
        fixed=ladder.fixed,
        wrong_risk=ladder.wrong_risk,
        method=ladder.method,
        ranges=[replace(o, range_m=z) for o, z in zip(phases, ladder.range_m, strict=True)],
        known=begin.known,
    )
    probability = residual_probability(ladder.poses)
    if first is None:
        found.status[(found.status == PoseStatus.OK) & (probability < RESIDUAL_PROBABILITY)] = PoseStatus.RESIDUAL
        return found
    climbed = replace(
        begin,
        phases=found.ranges,
        pivot=where_known(ladder.poses.pivot_enu_m, begin.pivot),
        rot=where_known(ladder.poses.rot_enu_from_mirror, begin.rot),
    )
    guard = joined(first, _guard(scenario, climbed, all_wavelengths=True))
    status = pose_status(guard.poses.status)
    status[(status == PoseStatus.OK) & are_doubted(guard)] = PoseStatus.UNEXPLAINED
    return replace(
        found,
        poses=guard.poses,
        status=status,
        ranges=keep_where(found.ranges, guard.used),
        guard=guard,
        probability_all=_probability_of_all(scenario, begin, first, probability),
    )


def _guard(scenario: Scenario, begin: _Begin, *, all_wavelengths: bool = False) -> GuardedPoses:
    """Solve, test and leave out: by the coarsest tone, or by all wavelengths, their integers resolved."""
    table = scenario.integrity
    phases = begin.phases if all_wavelengths else begin.phases[:1]
    return solve_with_integrity(
        scenario.transmitter_enu_m,
        begin.places,
        np.stack([o.range_m for o in phases], axis=1),
        sigma_m=np.stack([o.sigma_m for o in phases], axis=1),
        transmitter_sigma_m=np.stack([o.transmitter_sigma_m for o in phases], axis=1),
        clock_class=[o.clock_class for o in phases],
        start_pivot_enu_m=begin.pivot,
        start_rot_enu_from_mirror=begin.rot,
        knowledge=begin.known,
        false_alarm=table.false_alarm,
        missed_detection=table.missed_detection,
        max_excluded=table.max_excluded,
    )


def _probability_of_all(scenario: Scenario, begin: _Begin, first: GuardedPoses, probability: FloatArray) -> FloatArray:
    """Probability of the residuals with nothing left out: where something was, of the coarsest tone's."""
    out = probability.copy()
    rows = np.flatnonzero((first.transmitter_status > TransmitterStatus.NOT_RECEIVED).any(axis=1))
    if not rows.size:
        return out
    some = begin.take(rows)
    coarse = some.phases[0]
    poses = solve_rigid(
        scenario.transmitter_enu_m,
        some.places,
        coarse.range_m[:, None],
        sigma_m=coarse.sigma_m[:, None],
        transmitter_sigma_m=coarse.transmitter_sigma_m[:, None],
        clock_class=[0],
        start_pivot_enu_m=some.pivot,
        start_rot_enu_from_mirror=some.rot,
        knowledge=some.known,
    )
    out[rows] = residual_probability(poses)
    return out
