"""Rigid poses of a recording's mirrors by the chosen estimator, direct or two-ray, and the result's tables of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import PhaseCalibration, TonePhases
from rfpose.dsp.calibration import frame_times, phase_average
from rfpose.geometry import azimuth_elevation_from_enu, cross_matrix
from rfpose.measurement import reflectors_of
from rfpose.multilat import FilterSettings, FilterStatus, PoseStatus, RangeDifferences, filter_poses
from rfpose.multilat.estimation import PoseEstimates, ReflectionModel, protected, solve_direct, solve_two_ray
from rfpose.multilat.filtering import FilterState
from rfpose.multilat.integrity import Alarms
from rfpose.multilat.rigid import MirrorProblem, full_covariance
from rfpose.multilat.rigid.delays import DelayState, learn_delays
from rfpose.multilat.rigid.integers import IntegerMethod
from rfpose.pipeline.choice import PoseChoice
from rfpose.pipeline.formats.result import (
    DelayTable,
    FilteredTable,
    FixTable,
    IntegrityTable,
    PoseTable,
    ReflectionTable,
)
from rfpose.pipeline.mirrors import MirrorGroup, RigidInputs, calibration_sight, mirror_problems
from rfpose.scenario import Scenario

__all__ = ["RigidMemory", "RigidOutcome", "solve_rigid_poses"]

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


@dataclass(slots=True)
class RigidMemory:
    """What poses rest on besides their own frame, from call to call: with it, frames can come a few at a time.

    Attributes
    ----------
    origin_index
        First sample of the first frame, from which times count; None: before that.
    delays, filters
        By the number of the mirrors' group.
    """

    origin_index: int | None = None
    delays: dict[int, DelayState] = field(default_factory=dict)
    filters: dict[int, FilterState] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidOutcome:
    """Poses, and what else their estimator found; None where it does not look for it."""

    poses: PoseTable
    integrity: IntegrityTable | None
    reflection: ReflectionTable | None
    delays: DelayTable | None
    filtered: FilteredTable | None


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
    memory: RigidMemory | None = None,
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
    memory
        Of the frames before these; it takes these in.
    """
    average = None
    if choice.reflection != "none":
        average = phase_average(tones.phase_rad, tones.sigma_rad, scenario, frame_times(tones, scenario))
    inputs = RigidInputs(
        tones=tones,
        calibration=calibration,
        ranges=ranges,
        fixes=fixes,
        scenario=scenario,
        choice=choice,
        average=average,
    )
    tables = _Tables(inputs, independent)
    start = tones.frame_start_index
    memory = RigidMemory() if memory is None else memory
    if memory.origin_index is None and len(start):
        memory.origin_index = int(start[0])
    time_s = np.array([float((int(s) - (memory.origin_index or 0)) / sample_rate) for s in start])
    for i_group, (group, problem, again) in enumerate(mirror_problems(inputs)):
        found = _solved(inputs, group, problem, again)
        if group.estimator.delay_drift_m_per_sqrt_s is not None:
            found, memory.delays[i_group] = tables.put_delays(group, found, time_s, state=memory.delays.get(i_group))
            found = protected(found, scenario.integrity.missed_detection)
        tables.put(group, found)
        if choice.filtered:
            memory.filters[i_group] = tables.put_filtered(
                group,
                found,
                time_s,
                exposure_s=float(scenario.radio.frame_samples / sample_rate),
                state=memory.filters.get(i_group),
            )
    return tables.outcome()


def _solved(
    inputs: RigidInputs, group: MirrorGroup, problem: MirrorProblem, again: list[tuple[IntArray, MirrorProblem]]
) -> PoseEstimates:
    """Solve one group of mirrors by the chosen estimator."""
    alarms = _alarms(inputs)
    if inputs.average is None:
        return solve_direct(problem, alarms, again)
    scenario = inputs.scenario
    row = np.arange(len(problem.range_m)).reshape(inputs.n_frame, -1)
    frame, heliostat = (index.ravel() for index in np.indices(row.shape))
    reflections = ReflectionModel(
        reflectors=reflectors_of(scenario, inputs.choice.reflection),
        carrier_rf_hz=scenario.carrier_rf_hz,
        calibration=calibration_sight(inputs.average, scenario, frame),
        free_space=scenario.reflection.spreading == "free_space",
        propagation_speed_mps=scenario.radio.propagation_speed_mps,
    )
    return solve_two_ray(
        problem,
        reflections,
        alarms,
        surveyed_enu_m=np.tile(group.pivot_enu_m, (inputs.n_frame, 1)),
        heliostat=heliostat,
        shared={"recording": [row.ravel()], "frame": list(row), "mirror": list(row.T)}[scenario.reflection.shared],
    )


def _alarms(inputs: RigidInputs) -> Alarms | None:
    """When to leave something out; None: never."""
    table = inputs.scenario.integrity
    if not inputs.choice.integrity:
        return None
    return Alarms(
        false_alarm=table.false_alarm, missed_detection=table.missed_detection, max_excluded=table.max_excluded
    )


class _Tables:
    """The result's tables, filled group by group."""

    def __init__(self, inputs: RigidInputs, independent: PoseTable) -> None:
        scenario, choice = inputs.scenario, inputs.choice
        self._scenario = scenario
        n_frame = self._n_frame = len(inputs.tones.frame_start_index)
        frame_mirror = (n_frame, len(scenario.heliostat))
        n_receiver = len(scenario.receivers)
        self._poses = {name: np.array(getattr(independent, name)) for name in PoseTable.__dataclass_fields__}
        for values in self._poses.values():
            if values.dtype.kind == "f":
                values[:] = np.nan
        self._integrity: dict[str, npt.NDArray[Any]] = {}
        if choice.integrity:
            self._integrity = IntegrityTable.unsolved(scenario, n_frame)
        self._reflection: dict[str, npt.NDArray[Any]] = {}
        if choice.reflection != "none":
            n_plane = 1 + len(scenario.reflection.plane)
            self._reflection = {
                "coefficient": np.full((*frame_mirror, n_plane), np.nan, np.complex128),
                "coefficient_sigma": np.full((*frame_mirror, n_plane, 2), np.nan),
                "probability_direct": np.full(frame_mirror, np.nan),
            }
        self._filtered: dict[str, npt.NDArray[Any]] = {}
        if choice.filtered:
            self._filtered = {
                name: np.full((*frame_mirror, *shape), np.nan)
                for name, shape in (
                    ("normal_enu", (3,)),
                    ("cov_enu", (3, 3)),
                    ("sigma_rad", ()),
                    ("pivot_enu_m", (3,)),
                    ("rate_enu_radps", (3,)),
                )
            }
            self._filtered["status"] = np.full(frame_mirror, FilterStatus.UNKNOWN, np.int8)
        self._delays: dict[str, npt.NDArray[Any]] = {}
        if scenario.learns_delays:
            n_clock = len(scenario.tone) + 1
            self._delays = {
                "delay_s": np.full((n_frame, n_receiver, n_clock), np.nan),
                "sigma_s": np.full((n_frame, n_receiver, n_clock), np.nan),
                "jumped": np.zeros(frame_mirror, np.bool_),
            }

    def put(self, group: MirrorGroup, found: PoseEstimates) -> None:
        """Write one group's poses and tests."""
        poses = found.poses
        normal = poses.normal_enu
        azimuth, elevation = azimuth_elevation_from_enu(normal)
        cross = cross_matrix(normal)
        places = np.tile(group.places_m, (self._n_frame, 1, 1))
        self._put(
            self._poses,
            group,
            {
                "normal_enu": normal,
                "cov_enu": cross @ poses.cov[:, 3:, 3:] @ cross.swapaxes(1, 2),
                "sigma_rad": poses.tilt_sigma_rad,
                "azimuth_rad": azimuth,
                "elevation_rad": elevation,
                "centre_enu_m": poses.pivot_enu_m
                + np.einsum("mab,mb->ma", poses.rot_enu_from_mirror, places.mean(axis=1)),
                "n_receiver": np.where(np.isfinite(normal[:, 0]), group.rows.shape[1], 0),
                "n_wavelength": found.fixed.sum(axis=1),
                "integer_method": self._methods(group, found),
                "integer_risk": np.where(found.fixed, found.wrong_risk, 0.0).max(axis=1),
                "status": found.status,
            },
        )
        guard = found.guard
        if self._integrity and guard is not None:
            level = np.where(np.isfinite(normal[:, 0]), guard.protection_level_rad, np.nan)
            self._put(
                self._integrity,
                group,
                {
                    "status": guard.status,
                    "transmitter_status": guard.transmitter_status,
                    "prior_rejected": guard.prior_rejected,
                    "prior_testable": guard.prior_testable,
                    "probability_all": found.probability_all,
                    "probability": guard.chi2_probability,
                    "protection_level_rad": level,
                    "worst_transmitter": guard.worst_transmitter,
                },
            )
            used = guard.used & np.isfinite(normal[:, :1, None])
            self._integrity["used"][:, group.rows] = used.reshape(self._n_frame, *group.rows.shape, -1)
        if self._reflection:
            names = ("coefficient", "coefficient_sigma", "probability_direct")
            self._put(self._reflection, group, {name: getattr(found, name) for name in names})

    def _methods(self, group: MirrorGroup, found: PoseEstimates) -> IntArray:
        """(mirror, clock) how integers were found; what a pose that failed rests on says nothing."""
        out = np.full((len(found.method), len(self._scenario.tone) + 1), IntegerMethod.FLOAT, np.int64)
        out[:, : found.method.shape[1]] = np.where(np.isfinite(found.poses.tilt_sigma_rad)[:, None], found.method, 0)
        return out

    def put_filtered(
        self,
        group: MirrorGroup,
        found: PoseEstimates,
        time_s: FloatArray,
        *,
        exposure_s: float,
        state: FilterState | None,
    ) -> FilterState:
        """Filter a group's poses over frames, write them and return the state; poses that are doubted are left out."""

        def by_frame(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
            return array.reshape(self._n_frame, len(group.column), *array.shape[1:])

        poses, table = found.poses, self._scenario.motion
        tracked = filter_poses(
            by_frame(poses.pivot_enu_m),
            by_frame(poses.rot_enu_from_mirror),
            by_frame(poses.cov),
            time_s=time_s + 0.5 * exposure_s,
            exposure_s=exposure_s,
            usable=by_frame(found.status == PoseStatus.OK),
            motion=FilterSettings(
                rate_walk_radps_per_sqrt_s=table.rate_walk_radps_per_sqrt_s,
                rate_sigma_radps=table.rate_sigma_radps,
                gate_probability=table.gate_probability,
                restart_after=table.restart_after,
                max_coast_s=np.inf if table.max_coast_s is None else table.max_coast_s,
            ),
            state=state,
        )
        cross = cross_matrix(tracked.normal_enu)
        values = {
            "normal_enu": tracked.normal_enu,
            "cov_enu": cross @ tracked.cov[..., 3:6, 3:6] @ cross.swapaxes(-1, -2),
            "sigma_rad": tracked.tilt_sigma_rad,
            "pivot_enu_m": tracked.pivot_enu_m,
            "rate_enu_radps": tracked.rate_enu_radps,
            "status": tracked.status,
        }
        for name, array in values.items():
            self._filtered[name][:, group.column] = array
        return tracked.state

    def _put(self, table: dict[str, npt.NDArray[Any]], group: MirrorGroup, values: dict[str, Any]) -> None:
        for name, array in values.items():
            table[name][:, group.column] = array.reshape(self._n_frame, len(group.column), *array.shape[1:])

    def put_delays(
        self, group: MirrorGroup, found: PoseEstimates, time_s: FloatArray, *, state: DelayState | None
    ) -> tuple[PoseEstimates, DelayState]:
        """Learn the delays of a group over frames, write them, and return its poses refined by them, and the state."""
        scenario = self._scenario
        speed = scenario.radio.propagation_speed_mps
        n_frame, n_helio = self._n_frame, len(group.column)
        poses, whole = found.poses, _with_clocks(found)
        # poses that are doubted, or rest on fewer priors than the rest, teach nothing
        whole[found.status != PoseStatus.OK] = np.nan
        if found.guard is not None:
            whole[found.guard.prior_rejected.any(axis=1)] = np.nan
        n_class = poses.clock_m.shape[1]
        observed = _observed_clocks(found.problem, n_class)

        def by_frame(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
            return array.reshape(n_frame, n_helio, *array.shape[1:])

        learned = learn_delays(
            by_frame(poses.pivot_enu_m),
            by_frame(poses.rot_enu_from_mirror),
            by_frame(np.where(observed, poses.clock_m, 0.0)),
            by_frame(whole),
            time_s=time_s,
            drift_m_per_sqrt_s=group.estimator.delay_drift_m_per_sqrt_s or 0.0,
            observed=by_frame(observed),
            state=state,
        )
        n_receiver = group.rows.shape[1]
        shape = (n_frame, n_helio, n_class, n_receiver - 1)
        variance = np.einsum("fmdd->fmd", learned.difference_cov_m2).reshape(shape)
        for name, values in (("delay_s", learned.difference_m.reshape(shape)), ("sigma_s", np.sqrt(variance))):
            known = np.isfinite(values) & (variance < learned.unseen_m**2 / 2.0)
            rows = np.where(known, values / speed, np.nan).swapaxes(2, 3)
            self._delays[name][:, group.rows[:, 1:], :n_class] = rows
            self._delays[name][:, group.rows[:, 0], :n_class] = np.where(known.any(axis=3), 0.0, np.nan)
        self._delays["jumped"][:, group.column] = learned.jumped
        refined = np.isfinite(learned.cov).all(axis=(2, 3)).reshape(-1)
        values = {
            "pivot_enu_m": learned.pivot_enu_m,
            "rot_enu_from_mirror": learned.rot_enu_from_mirror,
            "cov": learned.cov,
        }
        arrays = {}
        for name, array in values.items():
            flat = array.reshape(n_frame * n_helio, *array.shape[2:])
            arrays[name] = np.where(refined.reshape(-1, *[1] * (flat.ndim - 1)), flat, getattr(poses, name))
        return replace(found, poses=replace(poses, **arrays)), learned.state

    def outcome(self) -> RigidOutcome:
        """Return the tables, those that were asked for."""
        return RigidOutcome(
            poses=PoseTable(**self._poses),
            integrity=IntegrityTable(**self._integrity) if self._integrity else None,
            reflection=ReflectionTable(**self._reflection) if self._reflection else None,
            delays=DelayTable(**self._delays) if self._delays else None,
            filtered=FilteredTable(**self._filtered) if self._filtered else None,
        )


def _with_clocks(found: PoseEstimates) -> FloatArray:
    """Covariance of pose and clocks of every mirror."""
    if found.full_cov is not None:
        return np.array(found.full_cov)
    poses = found.poses
    ended = replace(
        found.problem,
        start_pivot_enu_m=np.nan_to_num(poses.pivot_enu_m),
        start_rot_enu_from_mirror=np.nan_to_num(poses.rot_enu_from_mirror),
    )
    return full_covariance(ended)


def _observed_clocks(problem: MirrorProblem, n_class: int) -> BoolArray:
    """(mirror, class, receiver) whether any range tells of a clock."""
    seen: BoolArray = np.asarray(np.isfinite(problem.range_m).any(axis=3))
    out = np.zeros((len(seen), n_class, seen.shape[2]), np.bool_)
    for k, clock in enumerate(problem.clock_class):
        out[:, clock] |= seen[:, k]
    return out
