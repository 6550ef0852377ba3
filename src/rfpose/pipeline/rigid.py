"""Rigid poses of a recording's mirrors: which phases, clocks and priors go in, by the scenario."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from rfpose.checks import FloatArray
from rfpose.dsp import Calibration, TonePhases
from rfpose.dsp.bounds import phase_bound_rad
from rfpose.geometry import azimuth_elevation_from_enu, rot_enu_from_mirror
from rfpose.multilat import PoseStatus, RangeDifferences
from rfpose.multilat.rigid import Knowledge, RigidStatus, rigid_bound, tilt_sigma_rad
from rfpose.multilat.rigid.integers import Observation, align_points, solve_ladder
from rfpose.pipeline.result_file import FixTable, PoseTable, Result
from rfpose.scenario import Heliostat, Scenario
from rfpose.truth import Truth

__all__ = ["rigid_normal_bound", "solve_rigid_poses"]

_RESIDUAL_PROBABILITY = 1e-9
"""A pose whose residuals are rarer than this under the reported noise is marked."""

_STATUS = {
    RigidStatus.OK: PoseStatus.OK,
    RigidStatus.SINGULAR: PoseStatus.UNDETERMINED,
    RigidStatus.NOT_CONVERGED: PoseStatus.NOT_CONVERGED,
    RigidStatus.NO_START: PoseStatus.TOO_FEW,
    RigidStatus.TOO_FEW: PoseStatus.TOO_FEW,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Group:
    """Heliostats that differ in nothing but place: solved in one call."""

    column: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    """(heliostat, receiver) rows of the receiver axis."""
    places_m: FloatArray
    """(heliostat, receiver, xyz) from the pivot, in the mirror frame [m]."""
    pivot_enu_m: FloatArray
    kind: Heliostat

    @property
    def uses_carrier(self) -> bool:
        """Whether carriers can be compared between the receivers: only on one oscillator do their phases cancel."""
        return self.kind.oscillator == "shared" and self.kind.carrier_phase

    def knowledge(self, scenario: Scenario, n_frame: int) -> Knowledge:
        """Return what the scenario knows of these mirrors, one row a frame and heliostat."""
        kind = self.kind
        delay = kind.receiver_delay_sigma_s
        shared = kind.oscillator == "shared" and delay is not None
        return Knowledge(
            clock_sigma_m=float(delay or 0.0) * scenario.radio.propagation_speed_mps if shared else np.inf,
            pivot_enu_m=np.tile(self.pivot_enu_m, (n_frame, 1)) if kind.pivot_sigma_m is not None else None,
            pivot_sigma_m=np.inf if kind.pivot_sigma_m is None else kind.pivot_sigma_m,
            two_axis=kind.mount == "azimuth_elevation",
        )


def _groups(scenario: Scenario) -> Iterator[_Group]:
    """Sort heliostats by number of receivers and by what is known of them."""
    kinds: dict[tuple[object, ...], list[int]] = {}
    for i, h in enumerate(scenario.heliostat):
        key = (
            len(h.receiver_ids),
            h.oscillator,
            h.receiver_delay_sigma_s,
            h.pivot_sigma_m,
            h.mount,
            h.carrier_phase,
        )
        kinds.setdefault(key, []).append(i)
    for members in kinds.values():
        helio = [scenario.heliostat[i] for i in members]
        arm = np.array([[0.0, 0.0, h.arm_m] for h in helio])
        yield _Group(
            column=np.array(members),
            rows=np.array([np.arange(len(scenario.receivers))[scenario.receiver_rows(i)] for i in members]),
            places_m=np.array([h.receiver_mirror_m for h in helio]) + arm[:, None],
            pivot_enu_m=scenario.pivot_enu_m[members],
            kind=helio[0],
        )


def solve_rigid_poses(
    tones: TonePhases,
    calibration: Calibration,
    ranges: RangeDifferences,
    fixes: FixTable,
    independent: PoseTable,
    scenario: Scenario,
) -> PoseTable:
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
    """
    table = {name: np.array(getattr(independent, name)) for name in PoseTable.__dataclass_fields__}
    for name in ("normal_enu", "cov_enu", "sigma_rad", "azimuth_rad", "elevation_rad", "centre_enu_m", "integer_risk"):
        table[name][:] = np.nan
    n_frame = len(tones.frame_start_index)
    for group in _groups(scenario):
        n = n_frame * len(group.column)
        places = np.tile(group.places_m, (n_frame, 1, 1))
        start, rot = align_points(places, fixes.position_enu_m[:, group.rows].reshape(n, -1, 3))
        solution = solve_ladder(
            scenario.transmitter_enu_m,
            places,
            _observations(tones, calibration, ranges, scenario, group),
            start_pivot_enu_m=start,
            start_rot_enu_from_mirror=rot,
            knowledge=group.knowledge(scenario, n_frame),
        )
        poses = solution.poses
        normal = poses.normal_enu
        azimuth, elevation = azimuth_elevation_from_enu(normal)
        turn = poses.cov[:, 3:, 3:]
        cross = _cross_matrix(normal)
        centre = poses.pivot_enu_m + np.einsum("mab,mb->ma", poses.rot_enu_from_mirror, places.mean(axis=1))
        status = np.array([_STATUS[RigidStatus(s)] for s in poses.status])
        with np.errstate(invalid="ignore"):
            rare = chi2_distribution.sf(poses.chi2, np.maximum(poses.dof, 1.0)) < _RESIDUAL_PROBABILITY
        status[(status == PoseStatus.OK) & rare] = PoseStatus.RESIDUAL
        found = {
            "normal_enu": normal,
            "cov_enu": cross @ turn @ cross.swapaxes(1, 2),
            "sigma_rad": poses.tilt_sigma_rad,
            "azimuth_rad": azimuth,
            "elevation_rad": elevation,
            "centre_enu_m": centre,
            "n_receiver": np.where(np.isfinite(normal[:, 0]), group.rows.shape[1], 0),
            "n_wavelength": solution.fixed.sum(axis=1),
            "integer_risk": np.where(solution.fixed, solution.wrong_risk, 0.0).max(axis=1),
            "status": status,
        }
        for name, values in found.items():
            table[name][:, group.column] = values.reshape(n_frame, len(group.column), *values.shape[1:])
    return PoseTable(**table)


def _cross_matrix(v: FloatArray) -> FloatArray:
    """(…, 3, 3) with ``m @ x = v × x``."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _observations(
    tones: TonePhases, calibration: Calibration, ranges: RangeDifferences, scenario: Scenario, group: _Group
) -> list[Observation]:
    """Phases of a group's mirrors as ranges, coarsest tone first, carrier last; first axis frame × heliostat."""
    n_frame, n_helio = len(tones.frame_start_index), len(group.column)
    n_receiver, n_transmitter = group.rows.shape[1], len(scenario.transmitter)

    def of_mirrors(values: npt.NDArray[np.float64]) -> FloatArray:
        return values[:, group.rows].reshape(n_frame * n_helio, n_receiver, *values.shape[2:])

    out = []
    for k, q in enumerate(np.argsort(-scenario.wavelength_m)):
        wavelength = float(scenario.wavelength_m[q])
        to_m = wavelength / (2.0 * np.pi)
        z = of_mirrors(-to_m * (tones.phase_rad[..., q] - calibration.phase_rad[:, None, :, q]))
        if k == 0:
            z = _coarse(
                z, of_mirrors(ranges.range_difference_m), of_mirrors(ranges.reference.astype(np.float64)), wavelength
            )
        per_frame = to_m * np.repeat(calibration.sigma_rad[..., q], n_helio, axis=0)
        out.append(
            Observation(
                range_m=z,
                sigma_m=of_mirrors(to_m * tones.sigma_rad[..., q]),
                transmitter_sigma_m=per_frame,
                wavelength_m=np.full(n_transmitter, wavelength),
                clock_class=k,
            )
        )
    if group.uses_carrier:
        carrier_m = scenario.radio.propagation_speed_mps / (scenario.radio.centre_frequency_hz + scenario.carrier_hz)
        to_m_each = carrier_m / (2.0 * np.pi)
        seen = np.isfinite(tones.phase_rad[..., 0])
        phase = np.where(seen, np.angle(tones.carrier), np.nan)
        out.append(
            Observation(
                range_m=of_mirrors(-to_m_each * phase),
                sigma_m=of_mirrors(to_m_each * tones.carrier_sigma / np.abs(tones.carrier)),
                transmitter_sigma_m=np.full((n_frame * n_helio, n_transmitter), np.inf),
                wavelength_m=carrier_m,
                clock_class=len(out),
            )
        )
    return out


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


def rigid_normal_bound(
    result: Result, truth: Truth, rows: npt.NDArray[np.int64], normal_true: FloatArray
) -> FloatArray:
    """Cramér–Rao bound of each mirror's normal for the rigid model (frame, heliostat) [rad].

    Parameters
    ----------
    result
        A result of pose ``rigid``.
    truth
        With ``tone_snr``; else the result's own sigmas are used.
    rows : (frame,)
        The truth's row of each frame, −1 none.
    normal_true : (frame, heliostat, xyz)
        True normals.
    """
    scenario = result.scenario
    tone_sigma, carrier_sigma, calibration_sigma = _phase_noise(result, truth, rows)
    out = np.full(normal_true.shape[:2], np.nan)
    n_frame = len(rows)
    for group in _groups(scenario):
        n = n_frame * len(group.column)
        rot = rot_enu_from_mirror(normal_true[:, group.column].reshape(n, 3))
        sigma, common = [], []
        for q, wavelength in enumerate(scenario.wavelength_m):
            to_m = wavelength / (2.0 * np.pi)
            sigma.append(to_m * tone_sigma[..., q][:, group.rows].reshape(n, *group.rows.shape[1:], -1))
            common.append(to_m * np.repeat(calibration_sigma[..., q], len(group.column), axis=0))
        if group.uses_carrier:
            carrier_m = scenario.radio.propagation_speed_mps / (
                scenario.radio.centre_frequency_hz + scenario.carrier_hz
            )
            sigma.append(carrier_m / (2 * np.pi) * carrier_sigma[:, group.rows].reshape(n, *group.rows.shape[1:], -1))
            common.append(np.full((n, len(scenario.transmitter)), np.inf))
        cov = rigid_bound(
            scenario.transmitter_enu_m,
            np.tile(group.places_m, (n_frame, 1, 1)),
            np.tile(group.pivot_enu_m, (n_frame, 1)),
            rot,
            sigma_m=np.stack(sigma, axis=1),
            transmitter_sigma_m=np.stack(common, axis=1),
            clock_class=np.arange(len(sigma)),
            knowledge=group.knowledge(scenario, n_frame),
        )
        out[:, group.column] = tilt_sigma_rad(cov, rot[:, :, 2]).reshape(n_frame, -1)
    return out


def _phase_noise(
    result: Result, truth: Truth, rows: npt.NDArray[np.int64]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sigma of tone phases, of carrier phases, and of the calibration [rad]; from the truth where it knows."""
    tones = result.tones
    if truth.tone_snr is None:
        return tones.sigma_rad, tones.carrier_sigma / np.abs(tones.carrier), result.calibration.sigma_rad
    scenario = result.scenario
    snr = np.array(truth.tone_snr[np.maximum(rows, 0)])
    snr[rows < 0] = np.nan
    seen = np.isfinite(tones.phase_rad)
    with np.errstate(invalid="ignore"):
        tone = phase_bound_rad(scenario.radio.frame_samples, np.where(snr > 0, snr, np.nan))
    tone = np.where(seen, tone, np.nan)
    # a carrier has 2/m² times the tone's power, and all of its phase's noise
    carrier = tone[..., 0] * scenario.tone[0].modulation_index / np.sqrt(2.0)
    is_calibration = np.array([r.calibration is not None for r in scenario.receivers], bool)
    with np.errstate(divide="ignore"):
        calibration = np.nansum(tone[:, is_calibration] ** -2.0, axis=1) ** -0.5
    return tone, carrier, calibration
