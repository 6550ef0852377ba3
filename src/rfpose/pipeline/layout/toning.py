"""Tones for a scenario: which reach a wanted accuracy of the mirror normals, safely."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rfpose.dsp.bounds import phase_bound_rad
from rfpose.errors import GeometryError, InvalidInputError, ScenarioError
from rfpose.layout import maps
from rfpose.layout.maps import ESTIMATORS
from rfpose.measurement import SCENARIO, Noise, first_snr
from rfpose.multilat.tones import MAX_TONE, Share, ToneDesign, design_tones
from rfpose.pipeline.layout.site import Site
from rfpose.scenario import Scenario, naming, scenario_of

__all__ = ["SiteTones", "design_site_tones"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteTones:
    """Tones for a site, and what the normals are then known to.

    Attributes
    ----------
    scenario, estimator
        Names.
    tones
        The set.
    normal_mrad
        Rms over the field of the bound of the mirror normal.
    per_tone_index
        Modulation index of each tone.
    """

    scenario: str
    estimator: str
    tones: ToneDesign
    normal_mrad: float
    per_tone_index: float

    def as_dict(self) -> dict[str, Any]:
        """Return the set with stable keys; angles in mrad of the normal."""
        return {
            "scenario": self.scenario,
            "estimator": self.estimator,
            "tone_hz": self.tones.frequency_hz,
            "wavelength_m": self.tones.wavelength_m,
            "modulation_index": self.per_tone_index,
            "phase_sigma_rad": self.tones.phase_sigma_rad,
            "range_sigma_m": self.tones.range_sigma_m,
            "normal_mrad": self.normal_mrad,
            "step_risk": self.tones.step_risk,
            "wrong_risk": self.tones.wrong_risk,
        }


def _check_wishes(
    accuracy_mrad: float, success: float, band_hz: tuple[float, float] | None, n_tone: int | None
) -> None:
    """Refuse what nobody can wish for, by the names that the command line has for it."""
    if not 0.0 < accuracy_mrad < np.inf:
        raise InvalidInputError(f"`accuracy_mrad` must be a number greater than zero, got {accuracy_mrad}")
    if not 0.0 < success < 1.0:
        raise InvalidInputError(f"`success` must lie between 0 and 1, got {success}")
    if band_hz is not None and not 0.0 <= band_hz[0] < band_hz[1]:
        raise InvalidInputError(f"`band_hz` must begin at 0 Hz or above and end higher, got {band_hz}")
    if n_tone is not None and not 1 <= n_tone <= MAX_TONE:
        raise InvalidInputError(f"`n_tone` must lie between 1 and {MAX_TONE}, got {n_tone}")


def _by_carriers(scenario: Scenario, accuracy_mrad: float) -> str:
    """Say where the scenario's own solver, which compares carriers besides, reaches the accuracy with other tones."""
    if not any(scenario.compares_carriers(h) for h in scenario.heliostat):
        return ""
    try:
        bound = maps.study_of(scenario, SCENARIO).bound(maps.mirrors_of(scenario))
    except (GeometryError, InvalidInputError):
        return ""
    reached = 1e3 * float(np.sqrt(np.mean(bound**2)))
    if not reached <= accuracy_mrad:
        return ""
    return (
        f"; or leave it to the carriers, which `rfpose process` compares besides tones: {reached:.3g} mrad with the "
        "scenario's own tones (estimator `scenario` of a layout map), where their whole wavelengths are found"
    )


def design_site_tones(
    scenario: Site,
    *,
    accuracy_mrad: float,
    success: float = 1.0 - 1e-6,
    band_hz: tuple[float, float] | None = None,
    n_tone: int | None = None,
    estimator: str = "rigid",
    tone_snr_db: float | None = None,
    share: Share = "index",
) -> SiteTones:
    """Choose a site's tones for a wanted accuracy of its mirrors' normals.

    Noise of one phase is the Cramér–Rao bound of a single tone of the scenario's first tone's SNR; the field's geometry
    turns range noise into that of the normal.

    Parameters
    ----------
    scenario
        The site, or its TOML file; its own tones matter for nothing but the first one's modulation index.
    accuracy_mrad
        Wanted rms of the normal's bound over the field [mrad].
    success
        Wanted probability that all whole wavelengths of a mirror are right.
    band_hz
        Lowest and highest tone [Hz]; by default up to half the least distance of two carriers, so that sidebands keep
        apart, or unlimited with one carrier.
    n_tone, share
        See `rfpose.multilat.tones.design_tones`.
    estimator
        ``independent``, ``rigid`` or ``shared-clock``.
    tone_snr_db
        Overrides ``[simulation] tone_snr_db``.

    Raises
    ------
    InvalidInputError
        A wish out of its range.
    ScenarioError
        The scenario is bad, or no tones do; the message begins with the file, if there is one.
    """
    _check_wishes(accuracy_mrad, success, band_hz, n_tone)
    site, scenario = scenario, scenario_of(scenario)
    snr = first_snr(scenario, tone_snr_db)
    try:
        transmitter = maps.check_site(scenario.mast_enu_m)
        mirrors = maps.mirrors_of(scenario)
        unit = maps.normal_map(transmitter, mirrors, Noise.uniform(len(transmitter)), ESTIMATORS[estimator])
        if not np.any(np.isfinite(unit)):
            raise GeometryError("no mirror's normal is determined; add transmitters or receivers")
        rad_per_m = float(np.sqrt(np.nanmean(unit**2)))
        apart = np.linalg.norm(transmitter[:, None] - transmitter, axis=2)
        carriers = np.sort(scenario.carrier_hz)
        spacing = float(np.min(np.diff(carriers))) if len(carriers) > 1 else 2.0 * np.inf
        tones = design_tones(
            reach_m=float(apart.max(axis=1).min()),
            phase_sigma_rad=float(phase_bound_rad(scenario.radio.frame_samples, snr)),
            range_sigma_m=1e-3 * accuracy_mrad / rad_per_m,
            success=success,
            band_hz=(0.0, spacing / 2.0) if band_hz is None else band_hz,
            n_tone=n_tone,
            n_difference=mirrors.receiver_mirror_m.shape[1] * (len(transmitter) - 1),
            share=share,
            speed_mps=scenario.radio.propagation_speed_mps,
            shown=(1e3 * rad_per_m, "mrad of the normal"),
        )
    except (GeometryError, InvalidInputError) as error:
        with naming(site):
            raise ScenarioError(f"{error}{_by_carriers(scenario, accuracy_mrad)}") from error
    index = scenario.tone[0].modulation_index
    return SiteTones(
        scenario=scenario.name,
        estimator=estimator,
        tones=tones,
        normal_mrad=1e3 * rad_per_m * tones.range_sigma_m,
        per_tone_index=index / len(tones.frequency_hz) if share == "index" else index,
    )
