"""A recording's mirrors as arrays for the rigid solvers: which phases, clocks and priors go in, by the scenario."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import PhaseCalibration, TonePhases
from rfpose.dsp.calibration import PhaseAverage
from rfpose.measurement import Estimator, Wavelengths, estimator_of, wavelengths_of
from rfpose.measurement.wavelengths import CARRIER
from rfpose.multilat import RangeDifferences
from rfpose.multilat.ground import CalibrationSight
from rfpose.multilat.rigid import MirrorKnowledge, Observation
from rfpose.scenario import Scenario

_Number = TypeVar("_Number", bound=np.generic)

__all__ = ["MirrorGroup", "calibration_sight", "is_calibrated", "mirror_groups", "observations"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorGroup:
    """Heliostats that differ in nothing but place: solved in one call.

    Attributes
    ----------
    column : (heliostat,)
    rows : (heliostat, receiver)
        Of the receiver axis.
    places_m : (heliostat, receiver, xyz)
        From the pivot, in the mirror frame [m].
    pivot_enu_m : (heliostat, xyz)
        [m].
    estimator
        What is known of them.
    waves
        What is seen of them.
    """

    column: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    places_m: FloatArray
    pivot_enu_m: FloatArray
    estimator: Estimator
    waves: Wavelengths

    @property
    def learns_delays(self) -> bool:
        """Whether delays between receivers are learned over frames."""
        return self.estimator.delay_drift_m_per_sqrt_s is not None

    def knowledge(self, n_frame: int) -> MirrorKnowledge:
        """Return what is known of these mirrors, one row a frame and heliostat."""
        return self.estimator.knowledge(np.tile(self.pivot_enu_m, (n_frame, 1)))

    def of_mirrors(self, values: npt.NDArray[_Number]) -> npt.NDArray[_Number]:
        """Take values (frame, receiver axis, …) apart: (frame × heliostat, receiver, …)."""
        picked = values[:, self.rows]
        return picked.reshape(-1, *picked.shape[2:])

    def range_noise(
        self, tone_rad: FloatArray, carrier_rad: FloatArray, calibration_rad: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return phases' noise as that of ranges; first axis frame × heliostat.

        Parameters
        ----------
        tone_rad, carrier_rad : (frame, receiver axis, transmitter, tone), (frame, receiver axis, transmitter)
            Own noise [rad].
        calibration_rad : (frame, transmitter, tone)
            Of the electronic phases [rad]; None: nothing measures them.

        Returns
        -------
        sigma_m : (mirror, group, receiver, transmitter)
        transmitter_sigma_m : (mirror, group, transmitter)
            Common to all receivers; infinity where nothing tells.
        """
        sigma, common = [], []
        for q, wavelength in zip(self.waves.tone, self.waves.wavelength_m, strict=True):
            to_m = wavelength / (2.0 * np.pi)
            sigma.append(self.of_mirrors(to_m * (carrier_rad if q == CARRIER else tone_rad[..., q])))
            per_frame = np.full(carrier_rad[:, 0].shape, np.inf)
            if q != CARRIER and calibration_rad is not None:
                per_frame = to_m * calibration_rad[..., q]
            common.append(np.repeat(per_frame, len(self.column), axis=0))
        return np.stack(sigma, axis=1), np.stack(common, axis=1)


def mirror_groups(scenario: Scenario) -> Iterator[MirrorGroup]:
    """Sort heliostats by number of receivers and by what is known of them."""
    kinds: dict[tuple[int, Estimator], list[int]] = {}
    for i, h in enumerate(scenario.heliostat):
        kinds.setdefault((len(h.receiver_ids), estimator_of(scenario, h)), []).append(i)
    for (_, estimator), members in kinds.items():
        helio = [scenario.heliostat[i] for i in members]
        arm = np.array([[0.0, 0.0, h.arm_m] for h in helio])
        yield MirrorGroup(
            column=np.array(members),
            rows=np.array([np.arange(len(scenario.receivers))[scenario.receiver_rows(i)] for i in members]),
            places_m=np.array([h.receiver_mirror_m for h in helio]) + arm[:, None],
            pivot_enu_m=scenario.pivot_enu_m[members],
            estimator=estimator,
            waves=wavelengths_of(scenario, carrier=estimator.carrier),
        )


def is_calibrated(scenario: Scenario) -> bool:
    """Whether the transmitters' electronic phases are measured; if not, receivers of a mirror are compared."""
    return bool(scenario.calibration_receiver)


def observations(
    tones: TonePhases, calibration: PhaseCalibration, ranges: RangeDifferences, scenario: Scenario, group: MirrorGroup
) -> list[Observation]:
    """Phases of a group's mirrors as ranges, in the order of its wavelengths; first axis frame × heliostat.

    Without calibration receivers the transmitters' own phases stay in, unknown: differences between receivers tell.
    """
    calibrated = is_calibrated(scenario)
    sigma, common = group.range_noise(
        tones.sigma_rad, tones.carrier_sigma_rad, calibration.sigma_rad if calibrated else None
    )
    out = []
    for k, q in enumerate(group.waves.tone):
        wavelength = group.waves.wavelength_m[k]
        if q == CARRIER:
            phase = np.where(np.isfinite(tones.phase_rad[..., 0]), np.angle(tones.carrier), np.nan)
        else:
            phase = tones.phase_rad[..., q] - (calibration.phase_rad[:, None, :, q] if calibrated else 0.0)
        z = group.of_mirrors(-wavelength / (2.0 * np.pi) * phase)
        if k == 0 and not calibrated:
            z = _coarse_uncalibrated(z, float(wavelength[0]))
        elif k == 0:
            reference = group.of_mirrors(ranges.reference.astype(np.float64))
            z = _coarse(z, group.of_mirrors(ranges.range_difference_m), reference, float(wavelength[0]))
        out.append(
            Observation(
                range_m=z,
                sigma_m=sigma[:, k],
                transmitter_sigma_m=common[:, k],
                wavelength_m=np.array(wavelength),
                clock_class=int(group.waves.clock_class[k]),
                carrier=q == CARRIER,
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


def _coarse_uncalibrated(z: FloatArray, wavelength: float) -> FloatArray:
    """Give the coarsest tone's ranges whole wavelengths that bring a mirror's receivers together.

    Receivers lie within a fraction of the wavelength of each other, up to their clocks, which may be anything. Which
    branch a transmitter's ranges are on does not matter: its own phase is unknown.
    """
    turn = 2.0 * np.pi / wavelength
    seen = np.isfinite(z)
    phasor = np.where(seen, np.exp(1j * turn * np.nan_to_num(z)), 0.0)
    most = np.argmax(seen.sum(axis=2), axis=1)[:, None, None]
    reference = np.take_along_axis(phasor, most, axis=1)
    clock = np.angle((phasor * reference.conj()).sum(axis=2, keepdims=True)) / turn
    common = np.angle((phasor * np.exp(-1j * turn * clock)).sum(axis=1, keepdims=True)) / turn
    left = z - clock - common
    return np.asarray(left - wavelength * np.rint(left / wavelength) + common + clock)


def calibration_sight(average: PhaseAverage, scenario: Scenario, frame: npt.NDArray[np.int64]) -> CalibrationSight:
    """Return how the calibration receivers' reflections get into ranges.

    Parameters
    ----------
    average
        Of these receivers' phases.
    scenario
    frame : (mirror,)
        Of each mirror that is to be solved.
    """
    order = wavelengths_of(scenario).tone
    per_m = (2.0 * np.pi / scenario.wavelength_m)[:, None]

    def change_m(shift_m: FloatArray, frames: npt.NDArray[np.int64]) -> FloatArray:
        shift = np.zeros(shift_m.shape)
        shift[:, :, order] = shift_m
        # a longer path turns a phase back: Φ without the shifts is what receivers' phases turned forward give
        return (average.change_rad(per_m * shift, frames) / per_m)[:, :, order]

    return CalibrationSight(place_enu_m=scenario.calibration_enu_m, frame=frame, change_m=change_m)
