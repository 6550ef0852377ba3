"""The Cramér–Rao bound of mirror normals, for any scenario and any choice of estimator."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp.calibration import phase_average
from rfpose.geometry import rot_enu_from_mirror
from rfpose.measurement import reflectors_of
from rfpose.multilat import normal_bound
from rfpose.multilat.ground import ground_bound
from rfpose.multilat.rigid import MirrorProblem, full_covariance, part_of, tilt_sigma_rad
from rfpose.multilat.rigid.delays import learn_delays
from rfpose.pipeline.choice import PoseChoice
from rfpose.pipeline.mirrors import MirrorGroup, calibration_sight, mirror_groups, noise_beside_survey
from rfpose.pipeline.noise import PhaseNoise
from rfpose.scenario import Scenario

__all__ = ["normal_bound_rad"]


def normal_bound_rad(
    scenario: Scenario,
    choice: PoseChoice,
    noise: PhaseNoise,
    *,
    normal_enu: FloatArray,
    receiver_enu_m: FloatArray,
    frame_start_index: npt.NDArray[np.int64],
    sample_rate: Fraction,
    coefficient: FloatArray | None = None,
) -> FloatArray:
    """Bound of the angle of each mirror's normal, both axes together (frame, heliostat) [rad].

    All wavelengths count as resolved and no transmitter as left out. Learned delays count what all frames up to each
    one tell; estimated coefficients what all mirrors that share them tell.

    Parameters
    ----------
    scenario
        Clocks, priors, reflecting planes.
    choice
        The estimator; the bound of pose ``site`` is that of pose ``rigid``: what noise alone allows.
    noise
        Of every phase.
    normal_enu : (frame, heliostat, xyz)
        True normals.
    receiver_enu_m : (frame, receiver, xyz)
        True places, for pose ``independent`` [m].
    frame_start_index : (frame,)
        First sample of each frame.
    sample_rate
        [1/s].
    coefficient : (reflector,), optional
        True reflection coefficients, complex; needed where ``choice`` has any.
    """
    if choice.pose == "independent":
        return _independent(scenario, noise, receiver_enu_m)
    start = frame_start_index
    time_s = np.array([float((int(s) - int(start[0])) / sample_rate) for s in start])
    out = np.full(normal_enu.shape[:2], np.nan)
    for group in mirror_groups(scenario):
        rot = rot_enu_from_mirror(normal_enu[:, group.column].reshape(-1, 3))
        cov = _rigid(scenario, choice, noise, group, rot, coefficient)
        if group.estimator.delay_drift_m_per_sqrt_s is not None:
            cov = _learned(group, rot, cov, time_s)
        out[:, group.column] = tilt_sigma_rad(cov[:, :6, :6], rot[:, :, 2]).reshape(len(start), -1)
    return out


def _independent(scenario: Scenario, noise: PhaseNoise, receiver_enu_m: FloatArray) -> FloatArray:
    bound = np.full((len(receiver_enu_m), len(scenario.heliostat)), np.nan)
    received = np.isfinite(noise.own_m) & np.isfinite(noise.calibration_m)
    own_m, calibration_m = (np.where(received, a, np.nan) for a in (noise.own_m, noise.calibration_m))
    for i, heliostat in enumerate(scenario.heliostat):
        rows = scenario.receiver_rows(i)
        bound[:, i] = normal_bound(
            scenario.transmitter_enu_m,
            receiver_enu_m[:, rows],
            own_m[:, rows],
            calibration_m[:, rows],
            receiver_mirror_m=heliostat.receiver_mirror_m,
        ).sigma_rad
    return bound


def _rigid(
    scenario: Scenario,
    choice: PoseChoice,
    noise: PhaseNoise,
    group: MirrorGroup,
    rot: FloatArray,
    coefficient: FloatArray | None,
) -> FloatArray:
    """Covariance of pose and clocks of a group's mirrors, first axis frame × heliostat."""
    n_frame = len(noise.tone_rad)
    calibration = noise.calibration_rad if scenario.is_calibrated else None
    average, surveyed = None, noise.source == "result"  # in a simulation everything is where it is surveyed
    if choice.reflection != "none":
        average = phase_average(np.where(np.isfinite(noise.tone_rad), 0.0, np.nan), noise.tone_rad, scenario)
        if surveyed:
            calibration = noise_beside_survey(average, noise.calibration_rad)
    sigma, common = group.range_noise(noise.tone_rad, noise.carrier_rad, calibration)
    mirrors = MirrorProblem.expected(
        scenario.transmitter_enu_m,
        np.tile(group.places_m, (n_frame, 1, 1)),
        np.tile(group.pivot_enu_m, (n_frame, 1)),
        rot,
        sigma_m=sigma,
        transmitter_sigma_m=common,
        clock_class=group.waves.clock_class,
        knowledge=group.knowledge(n_frame),
    )
    if average is None:
        return full_covariance(mirrors)
    reflectors = reflectors_of(scenario, choice.reflection)
    truth = np.zeros(len(reflectors), np.complex128) if coefficient is None else np.asarray(coefficient)
    n_helio = len(group.column)
    row = np.arange(len(rot)).reshape(n_frame, -1)
    shared = {"recording": [row.ravel()], "frame": list(row), "mirror": list(row.T)}[scenario.reflection.shared]
    out = np.full((len(rot), *2 * (6 + sigma.shape[1] * sigma.shape[2],)), np.nan)
    for rows in shared:
        out[rows] = ground_bound(
            part_of(mirrors, mirrors=rows),
            carrier_rf_hz=scenario.carrier_rf_hz,
            tone_hz=group.waves.tone_hz,
            reflectors=reflectors,
            coefficient=[complex(c) for c in truth],
            calibration_enu_m=calibration_sight(average, scenario, rows // n_helio, surveyed=surveyed),
            free_space=scenario.reflection.spreading == "free_space",
            propagation_speed_mps=scenario.radio.propagation_speed_mps,
        )
    return out


def _learned(group: MirrorGroup, rot: FloatArray, cov: FloatArray, time_s: FloatArray) -> FloatArray:
    """Let earlier frames' delays count: the filter's own covariances, at the true poses."""
    n_frame, n_helio, n_receiver = len(time_s), len(group.column), group.rows.shape[1]
    n_class = (cov.shape[1] - 6) // n_receiver

    def by_frame(array: FloatArray) -> FloatArray:
        return array.reshape(n_frame, n_helio, *array.shape[1:])

    learned = learn_delays(
        by_frame(np.tile(group.pivot_enu_m, (n_frame, 1))),
        by_frame(rot),
        np.zeros((n_frame, n_helio, n_class, n_receiver)),
        by_frame(cov),
        time_s=time_s,
        drift_m_per_sqrt_s=group.estimator.delay_drift_m_per_sqrt_s or 0.0,
    )
    return learned.cov.reshape(-1, 6, 6)
