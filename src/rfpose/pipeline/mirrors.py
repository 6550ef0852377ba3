"""A recording's mirrors as arrays for the rigid solvers: which phases, clocks and priors go in, by the scenario."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.dsp import Calibration, TonePhases
from rfpose.dsp.calibration import PhaseAverage
from rfpose.multilat import RangeDifferences
from rfpose.multilat.ground import CalibrationSight
from rfpose.multilat.rigid import Knowledge
from rfpose.multilat.rigid.integers import Observation
from rfpose.scenario import Heliostat, Scenario

__all__ = [
    "MirrorGroup",
    "calibration_sight",
    "group_hz",
    "is_calibrated",
    "mirror_groups",
    "observations",
]


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
    kind
        The first of them.
    uses_carrier
        Whether carriers are compared between the receivers.
    """

    column: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    places_m: FloatArray
    pivot_enu_m: FloatArray
    kind: Heliostat
    uses_carrier: bool

    @property
    def learns_delays(self) -> bool:
        """Whether delays between receivers are learned over frames."""
        return self.kind.receiver_delay_drift_s_per_sqrt_min is not None

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

    def drift_m_per_sqrt_s(self, scenario: Scenario) -> float:
        """Random-walk rate of the delays [m/√s]."""
        rate = self.kind.receiver_delay_drift_s_per_sqrt_min or 0.0
        return rate / math.sqrt(60.0) * scenario.radio.propagation_speed_mps


def mirror_groups(scenario: Scenario) -> Iterator[MirrorGroup]:
    """Sort heliostats by number of receivers and by what is known of them."""
    kinds: dict[tuple[object, ...], list[int]] = {}
    for i, h in enumerate(scenario.heliostat):
        key = (
            len(h.receiver_ids),
            h.oscillator,
            h.receiver_delay_sigma_s,
            h.receiver_delay_drift_s_per_sqrt_min,
            h.pivot_sigma_m,
            h.mount,
            h.carrier_phase,
        )
        kinds.setdefault(key, []).append(i)
    for members in kinds.values():
        helio = [scenario.heliostat[i] for i in members]
        arm = np.array([[0.0, 0.0, h.arm_m] for h in helio])
        yield MirrorGroup(
            column=np.array(members),
            rows=np.array([np.arange(len(scenario.receivers))[scenario.receiver_rows(i)] for i in members]),
            places_m=np.array([h.receiver_mirror_m for h in helio]) + arm[:, None],
            pivot_enu_m=scenario.pivot_enu_m[members],
            kind=helio[0],
            uses_carrier=scenario.compares_carriers(helio[0]),
        )


def is_calibrated(scenario: Scenario) -> bool:
    """Whether the transmitters' electronic phases are measured; if not, receivers of a mirror are compared."""
    return bool(scenario.calibration_receiver)


def group_hz(scenario: Scenario, group: MirrorGroup) -> FloatArray:
    """(wavelength,) tones as `observations` orders them [Hz]; zero stands for the carrier."""
    tones = scenario.tone_hz[np.argsort(-scenario.wavelength_m)]
    return np.append(tones, 0.0) if group.uses_carrier else tones


def observations(
    tones: TonePhases, calibration: Calibration, ranges: RangeDifferences, scenario: Scenario, group: MirrorGroup
) -> list[Observation]:
    """Phases of a group's mirrors as ranges, coarsest tone first, carrier last; first axis frame × heliostat.

    Without calibration receivers the transmitters' own phases stay in, unknown: differences between receivers tell.
    """
    n_frame, n_helio = len(tones.frame_start_index), len(group.column)
    n_receiver, n_transmitter = group.rows.shape[1], len(scenario.transmitter)

    def of_mirrors(values: npt.NDArray[np.float64]) -> FloatArray:
        return values[:, group.rows].reshape(n_frame * n_helio, n_receiver, *values.shape[2:])

    out = []
    for k, q in enumerate(np.argsort(-scenario.wavelength_m)):
        wavelength = float(scenario.wavelength_m[q])
        to_m = wavelength / (2.0 * np.pi)
        electronic = calibration.phase_rad[:, None, :, q] if is_calibrated(scenario) else 0.0
        z = of_mirrors(-to_m * (tones.phase_rad[..., q] - electronic))
        if k == 0 and not is_calibrated(scenario):
            z = _coarse_uncalibrated(z, wavelength)
        elif k == 0:
            z = _coarse(
                z, of_mirrors(ranges.range_difference_m), of_mirrors(ranges.reference.astype(np.float64)), wavelength
            )
        per_frame = np.full((n_frame * n_helio, n_transmitter), np.inf)
        if is_calibrated(scenario):
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
        carrier_m = scenario.radio.propagation_speed_mps / scenario.carrier_rf_hz
        to_m_each = carrier_m / (2.0 * np.pi)
        seen = np.isfinite(tones.phase_rad[..., 0])
        phase = np.where(seen, np.angle(tones.carrier), np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            sigma = tones.carrier_sigma / np.abs(tones.carrier)
        out.append(
            Observation(
                range_m=of_mirrors(-to_m_each * phase),
                sigma_m=of_mirrors(to_m_each * sigma),
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
    order = np.argsort(-scenario.wavelength_m)
    per_m = (2.0 * np.pi / scenario.wavelength_m)[:, None]

    def change_m(shift_m: FloatArray, frames: npt.NDArray[np.int64]) -> FloatArray:
        shift = np.zeros(shift_m.shape)
        shift[:, :, order] = shift_m
        # a longer path turns a phase back: Φ without the shifts is what receivers' phases turned forward give
        return (average.change_rad(per_m * shift, frames) / per_m)[:, :, order]

    return CalibrationSight(place_enu_m=scenario.calibration_enu_m, frame=frame, change_m=change_m)
