"""Radio poses as the loop gets them: the estimator's own covariance in each posture, and where it fails.

Measurement level: no phases are drawn; noise has the covariance that `rfpose.multilat.rigid.rigid_bound` gives for the
posture, the transmitters in sight and the clocks, pivots and carrier as the scenario has them. What estimating a ground
reflection costs on top, or what ignoring it does, comes from `rfpose.multilat.ground.solve_with_ground` on phases of a
sample of the mirrors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.measurement import estimator_of, noise_of, simulated_ground, wavelengths_of
from rfpose.multilat.ground import CalibrationSight, solve_with_ground
from rfpose.multilat.ground.model import range_shift_m
from rfpose.multilat.rigid import MirrorProblem, Observation, part_of, rigid_bound
from rfpose.multilat.transmitters import check_transmitters
from rfpose.scenario import Scenario

__all__ = ["RadioByPosture", "RadioErrors"]

_BLOCK = 1000
"""Mirrors taken at a time, to bound the memory."""
_SAMPLE = 200
"""Mirrors from which the effect of a reflection is taken over to all."""
_SAFE_WAVELENGTHS = 1.0 / 12.0
"""Six sigma within half a wavelength: from then on the carrier's whole wavelengths are found."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioErrors:
    """Errors of one frame's normals in given postures; right and up are those of the mirror.

    Attributes
    ----------
    spread_rad : (mirror, 3)
        Lower triangle of the noise: right; up with right, up [rad].
    bias_rad : (mirror, 2)
        What a reflection that is not modelled does, right and up [rad].
    solved : (mirror,)
        Whether there is a pose at all.
    """

    spread_rad: FloatArray
    bias_rad: FloatArray
    solved: npt.NDArray[np.bool_]

    @property
    def sigma_rad(self) -> FloatArray:
        """(mirror,) rms angle of the noise [rad]."""
        return np.asarray(np.sqrt(np.sum(self.spread_rad**2, axis=1)))


class RadioByPosture:
    """Errors of radio poses, posture by posture.

    Parameters
    ----------
    scenario
        Transmitters, tones, receivers, clocks; ``[tracking.radio]`` for what the loop does with them.
    pivot_enu_m : (mirror, xyz)
        Where the mirrors stand [m]. All carry the receivers of the scenario's first heliostat.
    usual_normal_enu : (mirror, xyz)
        Postures in which to find out what estimating a reflection costs.

    Raises
    ------
    ScenarioError
        No heliostat that says where receivers are; a ground that reflects carriers without a radio frequency.
    GeometryError
        Transmitters that fix no position.
    """

    def __init__(self, scenario: Scenario, pivot_enu_m: FloatArray, *, usual_normal_enu: FloatArray) -> None:
        if not scenario.heliostat:
            raise ScenarioError("no [[heliostat]] says where receivers are on a mirror; add one, or leave radio out")
        check_transmitters(scenario.transmitter_enu_m)
        self._scenario = scenario
        self._pivot = np.array(pivot_enu_m)
        kind = scenario.heliostat[0]
        self._places = np.array(kind.receiver_mirror_m) + np.array([0.0, 0.0, kind.arm_m])
        self._estimator = estimator_of(scenario, kind)
        self._waves = wavelengths_of(scenario, carrier=self._estimator.carrier)
        self._noise = noise_of(scenario, tone_snr_db=scenario.tracking.radio.tone_snr_db)
        self._own_m, self._common_m = self._noise.groups(carrier=self._estimator.carrier)
        ground = scenario.simulation.ground
        self._handling = "none" if ground is None else scenario.tracking.radio.ground
        if self._handling != "none":
            scenario.need_rf_carriers("[simulation] `ground`")
        self._nearest = self._neighbours()
        self.excess = 1.0
        """How much larger the noise is for estimating the reflection too."""
        if self._handling == "estimated":
            self.excess = self._estimation_excess(geometry.rot_enu_from_mirror(usual_normal_enu))

    def errors(self, normal_enu: FloatArray, rng: np.random.Generator) -> RadioErrors:
        """Return the errors of poses with these normals; ``rng`` draws which transmitters are hidden.

        Parameters
        ----------
        normal_enu : (mirror, xyz)
            Postures.
        """
        rot = geometry.rot_enu_from_mirror(normal_enu)
        shape = (len(rot), 1, self._places.shape[0], len(self._scenario.transmitter))
        share = self._scenario.tracking.radio.hidden_transmitters
        hidden = np.zeros(shape, np.bool_)
        if share > 0.0:
            hidden[:] = (rng.random((shape[0], shape[3])) < share)[:, None, None, :]
        turn = self._covariance(rot, hidden)
        right, up = rot[:, :, 0], rot[:, :, 1]
        # a turn θ moves the normal by θ × n: by θ·up to the right, by −θ·right upwards
        rr = np.einsum("ma,mab,mb->m", up, turn, up)
        uu = np.einsum("ma,mab,mb->m", right, turn, right)
        ru = -np.einsum("ma,mab,mb->m", up, turn, right)
        solved = np.isfinite(rr) & (rr > 0.0)
        first = np.sqrt(np.where(solved, rr, 1.0))
        cross = np.where(solved, ru, 0.0) / first
        spread = np.stack([first, cross, np.sqrt(np.maximum(np.where(solved, uu, 1.0) - cross**2, 0.0))], axis=1)
        bias = np.zeros((len(rot), 2))
        spread *= self.excess
        if self._handling == "ignored":
            bias = self._bias_if_ignored(rot)
        spread[~solved] = 0.0
        return RadioErrors(spread_rad=spread, bias_rad=bias, solved=solved)

    def _covariance(self, rot: FloatArray, hidden: npt.NDArray[np.bool_]) -> FloatArray:
        """(mirror, 3, 3) of the rotation; the carrier takes part where the tones find its whole wavelengths."""
        hidden = np.broadcast_to(hidden, (len(rot), *hidden.shape[1:]))
        blocks = [slice(i, i + _BLOCK) for i in range(0, len(rot), _BLOCK)]
        return np.concatenate([self._covariance_of(self._pivot[b], rot[b], hidden[b]) for b in blocks])

    def _covariance_of(self, pivot: FloatArray, rot: FloatArray, hidden: npt.NDArray[np.bool_]) -> FloatArray:
        """Return the same of some mirrors."""
        sigma = np.where(hidden, np.inf, self._sigma_m(pivot, rot))
        n_tone = self._waves.n_tone
        mirrors = MirrorProblem.expected(
            self._scenario.transmitter_enu_m,
            self._places,
            pivot,
            rot,
            sigma_m=sigma,
            transmitter_sigma_m=self._common_m,
            clock_class=self._waves.clock_class,
            knowledge=replace(self._estimator, pivot_enu_m=pivot),
        )
        turn = rigid_bound(part_of(mirrors, groups=slice(n_tone)))[:, 3:, 3:]
        if sigma.shape[1] == n_tone:
            return turn
        wavelength = self._waves.wavelength_m[-1]
        extent = float(np.linalg.norm(self._places - self._places[0], axis=1).max())
        finds = extent * np.sqrt(np.trace(turn, axis1=1, axis2=2)) < _SAFE_WAVELENGTHS * float(wavelength.min())
        return np.where(finds[:, None, None], rigid_bound(mirrors)[:, 3:, 3:], turn)

    # -- what goes into a pose -----------------------------------------------------------------------------

    def _sigma_m(self, pivot: FloatArray, rot: FloatArray) -> FloatArray:
        """(mirror, group, receiver, transmitter) own noise of ranges [m]."""
        receiver = pivot[:, None] + np.einsum("mab,rb->mra", rot, self._places)
        return self._own_m[:, None] * self._noise.loss(self._scenario.transmitter_enu_m, receiver)[:, None]

    def _spreads(self) -> bool:
        """Whether the longer ray is the weaker one."""
        return self._scenario.simulation.path_loss == "free_space"

    # -- reflections ---------------------------------------------------------------------------------------

    def _neighbours(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Which mirrors stand for the field, and which of them stands for each mirror."""
        from scipy.spatial import KDTree

        sample = np.unique(np.linspace(0, len(self._pivot) - 1, min(_SAMPLE, len(self._pivot))).astype(np.int64))
        nearest = KDTree(self._pivot[sample]).query(self._pivot)[1]
        return sample, np.asarray(nearest, np.int64)

    def _observations(self, pivot: FloatArray, rot: FloatArray, common: FloatArray) -> list[Observation]:
        """Ranges of mirrors over the reflecting ground, without noise; ``common`` sigma of Φ (group, transmitter)."""
        scenario, ground, waves = self._scenario, self._scenario.simulation.ground, self._waves
        assert ground is not None
        mirror = simulated_ground(scenario, coefficient=complex(*ground.coefficient))
        receiver = (pivot[:, None] + np.einsum("mab,rb->mra", rot, self._places)).reshape(-1, 3)
        distance = np.linalg.norm(receiver[:, None] - scenario.transmitter_enu_m, axis=-1)

        def shift(points: FloatArray) -> FloatArray:
            return range_shift_m(
                scenario.transmitter_enu_m,
                points,
                reflectors=[mirror],
                carrier_rf_hz=scenario.carrier_rf_hz,
                tone_hz=waves.tone_hz,
                free_space=self._spreads(),
                propagation_speed_mps=scenario.radio.propagation_speed_mps,
            )

        z = distance[..., None] + shift(receiver)
        if scenario.calibration_receiver:
            z = z - shift(scenario.calibration_enu_m).mean(axis=0) * np.isfinite(common.T)
        z = z.reshape(len(pivot), len(self._places), len(scenario.transmitter), -1)
        sigma = self._sigma_m(pivot, rot)
        return [
            Observation(
                range_m=np.ascontiguousarray(z[..., g]),
                sigma_m=np.ascontiguousarray(sigma[:, g]),
                transmitter_sigma_m=np.broadcast_to(common[g], (len(pivot), common.shape[1])).copy(),
                wavelength_m=waves.wavelength_m[g],
                clock_class=int(waves.clock_class[g]),
                carrier=bool(waves.is_carrier[g]),
            )
            for g in range(len(waves.tone))
        ]

    def _noise_beside_survey_m(self) -> FloatArray:
        """(group, transmitter) sigma of Φ where the calibration receivers are exactly where they are surveyed [m]."""
        exact = [c.changed(survey_sigma_m=0.0) for c in self._scenario.calibration_receiver]
        scenario = self._scenario.changed(calibration_receiver=exact)
        noise = noise_of(scenario, tone_snr_db=scenario.tracking.radio.tone_snr_db)
        return noise.groups(carrier=self._estimator.carrier)[1]

    def _solve(self, rot: FloatArray, *, estimate: bool) -> tuple[FloatArray, FloatArray]:
        """Return normals and rotation covariances of the sampled mirrors by the solver itself."""
        sample = self._nearest[0]
        pivot, rot = self._pivot[sample], rot[sample]
        scenario, sight, common = self._scenario, None, self._common_m
        if scenario.calibration_receiver:
            surveyed = CalibrationSight(
                place_enu_m=scenario.calibration_enu_m,
                survey_sigma_m=np.array([c.survey_sigma_m for c in scenario.calibration_receiver]),
            )
            # a solver that knows of the reflection counts the survey as places, not as noise of each range
            sight = surveyed if estimate else scenario.calibration_enu_m
            common = self._noise_beside_survey_m() if estimate else common
        mirrors = MirrorProblem.of_observations(
            self._scenario.transmitter_enu_m,
            self._places,
            self._observations(pivot, rot, common),
            start_pivot_enu_m=pivot,
            start_rot_enu_from_mirror=rot,
            knowledge=replace(self._estimator, pivot_enu_m=pivot),
        )
        found = solve_with_ground(
            mirrors,
            carrier_rf_hz=self._scenario.carrier_rf_hz,
            reflectors=(simulated_ground(self._scenario),) if estimate else (),
            calibration_enu_m=sight,
            free_space=self._spreads(),
            propagation_speed_mps=self._scenario.radio.propagation_speed_mps,
            min_probability=0.0,
        )
        return found.poses.normal_enu, found.poses.cov[:, 3:, 3:]

    def _estimation_excess(self, rot: FloatArray) -> float:
        """Return the ratio of the noise with the reflection estimated to that without one."""
        sample = self._nearest[0]
        _, turn = self._solve(rot, estimate=True)
        alone = self._covariance(rot, np.zeros((len(rot), 1, 1, 1), np.bool_))[sample]
        both = np.isfinite(turn[:, 0, 0]) & np.isfinite(alone[:, 0, 0])
        if not both.any():
            raise ScenarioError(
                "the ground reflection cannot be estimated with these poses: give pivots (`pivot_sigma_m`), a longer "
                'frame or a finer tone, or set [tracking.radio] ground = "ignored" to see what that does'
            )
        ratio = np.trace(turn[both], axis1=1, axis2=2) / np.trace(alone[both], axis1=1, axis2=2)
        return float(np.sqrt(np.median(ratio)))

    def _bias_if_ignored(self, rot: FloatArray) -> FloatArray:
        """(mirror, 2) what the reflection does to normals that are solved without it [rad]."""
        sample, nearest = self._nearest
        normal, _ = self._solve(rot, estimate=False)
        off = normal - rot[sample][:, :, 2]
        bias = np.stack([np.sum(off * rot[sample][:, :, i], axis=1) for i in (0, 1)], axis=1)
        return np.asarray(np.nan_to_num(bias)[nearest])
