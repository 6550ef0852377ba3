"""From tone phases to mirror normals: calibration, ranges, fixes, poses."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfpose.checks import read_only
from rfpose.dsp import CalibrationStatus, PhaseCalibration, TonePhases, calibrate
from rfpose.multilat import (
    Fixes,
    FixStatus,
    Poses,
    RangeDifferences,
    RangeStatus,
    range_differences,
    solve_poses,
)
from rfpose.multilat.fix import Side
from rfpose.pipeline.choice import PoseChoice
from rfpose.pipeline.formats.choice_text import settings_of
from rfpose.pipeline.formats.result import FixTable, PoseTable, Result
from rfpose.pipeline.rigid import RigidMemory, RigidOutcome, solve_rigid_poses
from rfpose.pipeline.solvable import check_solvable
from rfpose.pipeline.stages import Stopwatch
from rfpose.scenario import Heliostat, Scenario
from rfpose.truth import Truth

if TYPE_CHECKING:
    from rfpose.pipeline.site import SiteOutcome

__all__ = ["no_calibration", "solve", "solve_calibrated"]

_UNSURVEYED_M = 3.0
"""How far a pivot may be from where the scenario has it, if it is not surveyed."""

_SURVEY_SIGMAS = 6.0
"""How many standard deviations a surveyed place may be off."""


def solve(
    tones: TonePhases,
    scenario: Scenario,
    choice: PoseChoice,
    *,
    sample_rate: Fraction,
    settings: Mapping[str, str],
    truth: Truth | None = None,
    stages: Stopwatch | None = None,
) -> Result:
    """Find receiver positions and mirror normals from tone phases.

    Parameters
    ----------
    tones
        Along the scenario's receiver axis.
    scenario
        The site.
    choice
        The estimator of poses.
    sample_rate
        Of the recording [1/s].
    settings
        What else the result depends on, kept with it; must hold ``estimator``, that of the tones.
    truth
        Kept with the result.
    stages
        Takes the time of the calibration.

    Raises
    ------
    InvalidInputError, ScenarioError, GeometryError
        As `rfpose.pipeline.solvable.check_solvable`. A receiver or mirror that cannot be solved is NaN with a status.
    """
    check_solvable(scenario, pose=choice.pose, choice=choice)
    with contextlib.nullcontext() if stages is None else stages.during("calibration"):
        calibration = calibrate(tones, scenario) if scenario.is_calibrated else no_calibration(tones)
    return solve_calibrated(
        tones, calibration, scenario, choice, sample_rate=sample_rate, settings=settings, truth=truth
    )


def solve_calibrated(
    tones: TonePhases,
    calibration: PhaseCalibration,
    scenario: Scenario,
    choice: PoseChoice,
    *,
    sample_rate: Fraction,
    settings: Mapping[str, str],
    truth: Truth | None = None,
    memory: RigidMemory | None = None,
) -> Result:
    """Find receiver positions and mirror normals where the transmitters' phases are known already; see `solve`.

    Parameters
    ----------
    tones, scenario, choice, sample_rate, settings, truth
        As for `solve`.
    calibration
        Of the same frames.
    memory
        Of the frames before these, of pose ``rigid``; it takes these in.
    """
    ranges = _ranges(tones, calibration, scenario) if scenario.is_calibrated else _no_ranges(tones)
    poses = solve_poses(
        scenario.transmitter_enu_m,
        ranges.range_difference_m,
        sigma_m=ranges.sigma_m,
        calibration_sigma_m=ranges.calibration_sigma_m,
        mirror_rows=[scenario.receiver_rows(i) for i in range(len(scenario.heliostat))],
        receiver_mirror_m=[heliostat.receiver_mirror_m for heliostat in scenario.heliostat],
        side=_sides(scenario),
    )
    n_frame, n_receiver = tones.phase_rad.shape[:2]
    fixes = _fix_table(poses.fixes, n_frame, n_receiver)
    if not scenario.is_calibrated:
        fixes = replace(fixes, status=np.where(_received(tones).any(axis=2), FixStatus.UNCALIBRATED, fixes.status))
    independent = _pose_table(poses, len(scenario.tone))
    found: RigidOutcome | SiteOutcome | None = None
    if choice.pose == "site":
        from rfpose.pipeline.site import solve_site_poses  # propagation, which other poses do without

        found = solve_site_poses(tones, scenario, independent, sample_rate=sample_rate, simulated=truth is not None)
    elif choice.pose == "rigid":
        found = solve_rigid_poses(
            tones,
            calibration,
            ranges,
            fixes,
            independent,
            scenario,
            choice,
            sample_rate=sample_rate,
            memory=memory,
        )
    result = Result(
        scenario=scenario,
        sample_rate=sample_rate,
        choice=choice,
        settings={**settings, "sample_rate": str(sample_rate), **settings_of(choice)},
        frame_start_index=tones.frame_start_index,
        tones=tones,
        calibration=calibration,
        ranges=ranges,
        fixes=fixes,
        poses=independent,
        truth=truth,
    )
    if found is None:
        return result
    return replace(result, **{name: getattr(found, name) for name in found.__dataclass_fields__})


def _sides(scenario: Scenario) -> list[Side]:
    """Return on which side of the transmitters' plane each receiver is known to be: as far as its mirror can reach."""
    middle = scenario.transmitter_enu_m.mean(axis=0)
    up = np.linalg.svd(scenario.transmitter_enu_m - middle)[2][-1]
    up = up if up[2] >= 0.0 else -up

    def side(place: npt.ArrayLike, reach: float) -> Side:
        height = float((np.array(place) - middle) @ up)
        return None if abs(height) <= reach else "above" if height > 0.0 else "below"

    def of_mirror(mirror: Heliostat) -> Side:
        off = _UNSURVEYED_M if mirror.pivot_sigma_m is None else _SURVEY_SIGMAS * mirror.pivot_sigma_m
        width = np.linalg.norm(np.array(mirror.receiver_mirror_m), axis=1).max()
        return side(mirror.pivot_enu_m, float(width) + mirror.arm_m + off)

    calibration = [side(c.position_enu_m, _SURVEY_SIGMAS * c.survey_sigma_m) for c in scenario.calibration_receiver]
    mirrors = [of_mirror(mirror) for mirror in scenario.heliostat]
    out: list[Side] = []
    for receiver in scenario.receivers:
        if receiver.heliostat is None:
            assert receiver.calibration is not None
            out.append(calibration[receiver.calibration])
        else:
            out.append(mirrors[receiver.heliostat])
    return out


def _received(tones: TonePhases) -> npt.NDArray[np.bool_]:
    """(frame, receiver, transmitter) whether any tone has a phase."""
    return np.asarray(np.isfinite(tones.phase_rad).any(axis=3))


def no_calibration(tones: TonePhases) -> PhaseCalibration:
    """Return that nothing is known of the transmitters' phases."""
    n_frame, _, n_transmitter, n_tone = tones.phase_rad.shape
    unknown = read_only(np.full((n_frame, n_transmitter, n_tone), np.nan))
    return PhaseCalibration(
        phase_rad=unknown,
        sigma_rad=unknown,
        drift_rad_per_sqrt_s=read_only(np.full(n_tone, np.nan)),
        status=read_only(np.full((n_frame, n_transmitter), CalibrationStatus.MISSING, np.uint8)),
    )


def _no_ranges(tones: TonePhases) -> RangeDifferences:
    received = _received(tones)
    unknown = read_only(np.full(received.shape, np.nan))
    status = np.where(received, RangeStatus.UNCALIBRATED, RangeStatus.NOT_RECEIVED).astype(np.int8)
    return RangeDifferences(
        range_difference_m=unknown,
        sigma_m=unknown,
        calibration_sigma_m=unknown,
        reference=read_only(np.full(received.shape[:2], -1, np.int64)),
        status=read_only(status),
    )


def _ranges(tones: TonePhases, calibration: PhaseCalibration, scenario: Scenario) -> RangeDifferences:
    return range_differences(
        tones.phase_rad,
        tones.sigma_rad,
        calibration.phase_rad[:, None],
        calibration.sigma_rad[:, None],
        scenario.wavelength_m,
        scenario.transmitter_enu_m,
    )


def _fix_table(fixes: Fixes, n_frame: int, n_receiver: int) -> FixTable:
    """Give the flat rows of `Fixes` their two axes back."""
    arrays = {name: np.asarray(getattr(fixes, name)) for name in FixTable.__dataclass_fields__}
    return FixTable(**{name: array.reshape(n_frame, n_receiver, *array.shape[1:]) for name, array in arrays.items()})


def _pose_table(poses: Poses, n_tone: int) -> PoseTable:
    own = {"centre_enu_m", "n_wavelength", "integer_risk", "integer_method"}
    names = [name for name in PoseTable.__dataclass_fields__ if name not in own]
    shape = poses.normals.sigma_rad.shape
    return PoseTable(
        **{name: getattr(poses.normals, name) for name in names},
        centre_enu_m=poses.centre_enu_m,
        n_wavelength=np.zeros(shape, np.int16),
        integer_risk=np.full(shape, np.nan),
        integer_method=np.zeros((*shape, n_tone + 1), np.int8),
    )
