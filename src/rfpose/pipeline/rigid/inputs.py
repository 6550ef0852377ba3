"""What the estimators begin with: ranges of one group of mirrors, and a start."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rfpose.checks import FloatArray
from rfpose.multilat.rigid import Knowledge
from rfpose.multilat.rigid.integers import Observation, align_points
from rfpose.multilat.rigid.start import rotations_from_differences
from rfpose.pipeline.mirrors import (
    MirrorGroup,
    observations,
)
from rfpose.pipeline.rigid.found import BoolArray, Stages

_VAGUE_RATIO = 100.0
"""A calibration off by so many times what the pivot is off by tells nothing of the pose."""


def inputs_of(stages: Stages, group: MirrorGroup) -> tuple[FloatArray, FloatArray, FloatArray, list[Observation]]:
    """Places of receivers, poses to begin with (pivot, rotation), and phases as ranges."""
    n_frame = len(stages.tones.frame_start_index)
    places = np.tile(group.places_m, (n_frame, 1, 1))
    located = stages.fixes.position_enu_m[:, group.rows].reshape(len(places), -1, 3)
    start, rot = align_points(places, located)
    phases = observations(stages.tones, stages.calibration, stages.ranges, stages.scenario, group)
    known = group.knowledge(n_frame)
    if stages.choice.reflection == "none":
        phases = [_without_vague_calibration(o, known) for o in phases]
    weak = np.flatnonzero(_are_vague(stages, group, places))
    if known.pivot_enu_m is not None and weak.size:
        start[weak] = known.pivot_enu_m[weak]
        rot[weak] = rotations_from_differences(
            stages.scenario.transmitter_enu_m,
            places[weak],
            start[weak],
            phases[0].range_m[weak],
            sigma_m=phases[0].sigma_m[weak],
            clock_sigma_m=known.clock_sigma_m,
        )
    return places, start, rot, phases


def either_side(stages: Stages, group: MirrorGroup) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Poses to begin with (pivot, rotation), all receivers below the transmitters' plane, then all above it."""
    middle = stages.scenario.transmitter_enu_m.mean(axis=0)
    up = np.linalg.svd(stages.scenario.transmitter_enu_m - middle)[2][-1]
    up = up if up[2] >= 0.0 else -up
    places = np.tile(group.places_m, (len(stages.tones.frame_start_index), 1, 1))
    located = stages.fixes.position_enu_m[:, group.rows].reshape(len(places), -1, 3)
    height = ((located - middle) @ up)[..., None]
    for sign in (-1.0, 1.0):
        yield align_points(places, located + (sign * np.abs(height) - height) * up)


def _without_vague_calibration(phases: Observation, known: Knowledge) -> Observation:
    """Leave an old calibration out where the pivot is known far better than it could tell: differences remain.

    What it adds is next to nothing, and so little that the clocks' equations would be singular to working precision.
    """
    common = phases.transmitter_sigma_m
    vague = common > _VAGUE_RATIO * known.pivot_sigma_m
    return replace(phases, transmitter_sigma_m=np.where(vague, np.inf, common))


def _are_vague(stages: Stages, group: MirrorGroup, places: FloatArray) -> BoolArray:
    """(mirror,) whether a receiver's fix, if there is one, is less certain than the mirror is wide.

    So it is without calibration receivers, or with a calibration that is old.
    """
    variance = np.trace(stages.fixes.cov_enu_m2[:, group.rows], axis1=-2, axis2=-1).reshape(places.shape[:2])
    width = np.linalg.norm(places - places.mean(axis=1, keepdims=True), axis=-1).max(axis=1)
    return np.asarray(~(np.sqrt(variance) < width[:, None]).all(axis=1))
