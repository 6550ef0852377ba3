"""Noise of each phase: what signal-to-noise ratios make of tones, carriers and calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray, read_only
from rfpose.dsp.bounds import phase_bound_rad
from rfpose.errors import InvalidInputError
from rfpose.measurement.wavelengths import wavelengths_of
from rfpose.scenario import Scenario

__all__ = ["Noise", "calibration_sigma_m", "first_snr", "noise_of", "phase_sigma_rad"]

_MAX_DB = 300.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Range noise of the tones, coarsest first, and of the carrier; arrays are read-only.

    Attributes
    ----------
    tone_sigma_m : (tone, transmitter)
        A receiver's own noise of one transmitter's range, at ``reference_range_m`` if that is given [m].
    calibration_sigma_m : (tone, transmitter)
        Of the transmitter phases, the same for all receivers of a frame [m]; infinity: nothing measures them.
    carrier_sigma_m : (transmitter,) or None
        Own noise of the carrier's phase as a range [m]; None: carriers have no wavelength.
    reference_range_m
        Noise grows with range over this (free space); None: noise is the same everywhere.
    """

    tone_sigma_m: FloatArray
    calibration_sigma_m: FloatArray
    carrier_sigma_m: FloatArray | None = None
    reference_range_m: float | None = None

    @classmethod
    def uniform(cls, n_transmitter: int, sigma_m: float = 1.0, calibration_sigma_m: float = 0.0) -> Noise:
        """Return one tone, all transmitters alike."""
        if not sigma_m > 0.0 or calibration_sigma_m < 0.0:
            raise InvalidInputError("`sigma_m` must be greater than zero and `calibration_sigma_m` not negative")
        shape = (1, n_transmitter)
        return cls(
            tone_sigma_m=read_only(np.full(shape, float(sigma_m))),
            calibration_sigma_m=read_only(np.full(shape, float(calibration_sigma_m))),
        )

    def groups(self, *, carrier: bool) -> tuple[FloatArray, FloatArray]:
        """Return own noise and that common to all receivers, both (group, transmitter) [m]: tones, then the carrier.

        What a carrier's phase is at its transmitter nothing measures: only receivers are compared.

        Raises
        ------
        InvalidInputError
            A carrier that has no wavelength.
        """
        if not carrier:
            return self.tone_sigma_m, self.calibration_sigma_m
        if self.carrier_sigma_m is None:
            raise InvalidInputError("`noise` must hold the carrier's for an estimator that compares carriers")
        unknown = np.full_like(self.carrier_sigma_m, np.inf)
        return np.vstack([self.tone_sigma_m, self.carrier_sigma_m]), np.vstack([self.calibration_sigma_m, unknown])

    def loss(self, transmitter_enu_m: FloatArray, point_enu_m: FloatArray) -> FloatArray:
        """(..., transmitter) by how much own noise is larger at points (..., xyz) than at the reference range."""
        return _loss(transmitter_enu_m, point_enu_m, self.reference_range_m)

    def without(self, transmitter: int) -> Noise:
        """Return it with one transmitter lost."""
        return Noise(
            tone_sigma_m=np.delete(self.tone_sigma_m, transmitter, axis=1),
            calibration_sigma_m=np.delete(self.calibration_sigma_m, transmitter, axis=1),
            carrier_sigma_m=None if self.carrier_sigma_m is None else np.delete(self.carrier_sigma_m, transmitter),
            reference_range_m=self.reference_range_m,
        )


def first_snr(scenario: Scenario, tone_snr_db: float | None = None) -> float:
    """Return the first tone's SNR, amplitude one at the reference range; ``tone_snr_db`` instead of the scenario's.

    Raises
    ------
    InvalidInputError
        No number of decibels.
    """
    if tone_snr_db is not None and not abs(tone_snr_db) <= _MAX_DB:
        raise InvalidInputError(f"`tone_snr_db` must be a number of decibels within ±{_MAX_DB:g}, got {tone_snr_db}")
    return float(10.0 ** ((scenario.simulation.tone_snr_db if tone_snr_db is None else tone_snr_db) / 10.0))


def phase_sigma_rad(scenario: Scenario, tone_snr: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the Cramér–Rao bounds of phases: tones (..., tone) and carriers (...) [rad].

    Parameters
    ----------
    scenario
    tone_snr : (..., tone)
        (a m)²/σ² a sample, in the scenario's order of tones; zero or NaN = not received.
    """
    snr = np.asarray(tone_snr, np.float64)
    with np.errstate(invalid="ignore"):
        tone = phase_bound_rad(scenario.radio.frame_samples, np.where(snr > 0.0, snr, np.nan))
    # a carrier has 2/m² times the tone's power, and all of its phase's noise
    return tone, tone[..., 0] * scenario.tone[0].modulation_index / np.sqrt(2.0)


def calibration_sigma_m(own_sigma_m: FloatArray, survey_sigma_m: FloatArray) -> FloatArray:
    """Return what the phases of all calibration receivers together are off by, as ranges (tone, transmitter) [m].

    Parameters
    ----------
    own_sigma_m : (calibration receiver, tone, transmitter)
        Noise of each [m].
    survey_sigma_m : (calibration receiver,)
        Of their places [m].

    Returns
    -------
    (tone, transmitter)
        Infinity without any receiver.
    """
    information = (1.0 / (own_sigma_m**2 + survey_sigma_m[:, None, None] ** 2)).sum(axis=0)
    with np.errstate(divide="ignore"):
        return np.asarray(information**-0.5)


def noise_of(scenario: Scenario, *, tone_snr_db: float | None = None) -> Noise:
    """Return the noise that a scenario's radio plan allows: each phase at its Cramér–Rao bound.

    Tones: σ_φ = 1/√(n·snr), snr = (a m)²/σ² as `[simulation] tone_snr_db` counts it. Carrier: σ = 1/√(2n)·σ/a.
    Calibration: all calibration receivers, weighed by their noise and the survey of their places.

    Parameters
    ----------
    scenario
        With ``[simulation] path_loss = "free_space"``, noise grows with range.
    tone_snr_db
        Overrides ``[simulation] tone_snr_db``.

    Raises
    ------
    InvalidInputError
        ``tone_snr_db`` is no number of decibels.
    """
    waves = wavelengths_of(scenario)
    index = np.array([t.modulation_index for t in scenario.tone])
    amplitude = np.array([t.amplitude for t in scenario.transmitter])
    snr = first_snr(scenario, tone_snr_db) * (amplitude[:, None] * index / index[0]) ** 2
    tone_rad, carrier_rad = phase_sigma_rad(scenario, snr)
    tone = np.ascontiguousarray(waves.wavelength_m / (2.0 * np.pi) * tone_rad.T[waves.tone])
    carrier = None
    if scenario.has_rf_carriers:
        carrier = scenario.radio.propagation_speed_mps / (2.0 * np.pi * scenario.carrier_rf_hz) * carrier_rad
    plan = scenario.simulation
    reference = plan.reference_range_m if plan.path_loss == "free_space" else None
    loss = _loss(scenario.transmitter_enu_m, scenario.calibration_enu_m, reference)
    survey = np.array([r.survey_sigma_m for r in scenario.calibration_receiver])
    return Noise(
        tone_sigma_m=read_only(tone),
        calibration_sigma_m=read_only(calibration_sigma_m(tone * loss[:, None], survey)),
        carrier_sigma_m=carrier,
        reference_range_m=reference,
    )


def _loss(transmitter_enu_m: FloatArray, point_enu_m: FloatArray, reference_range_m: float | None) -> FloatArray:
    if reference_range_m is None:
        return np.ones((*point_enu_m.shape[:-1], len(transmitter_enu_m)))
    offset = point_enu_m[..., None, :] - transmitter_enu_m
    return np.asarray(np.linalg.norm(offset, axis=-1) / reference_range_m)
