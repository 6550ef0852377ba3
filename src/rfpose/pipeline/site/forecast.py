"""What pose ``site`` would make of mirrors in a posture, before anything is measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.measurement import noise_of
from rfpose.multilat import PoseStatus
from rfpose.multilat.site import ForeseenMirrors
from rfpose.pipeline.mirrors import mirror_groups
from rfpose.pipeline.site.field import SiteField, antenna_of
from rfpose.pipeline.site.poses import check_site_solvable, knowledge_of, settings_of, wavenumbers_of
from rfpose.scenario import Scenario

__all__ = ["SiteForecast", "forecast_normals", "foreseen_mirrors"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteForecast:
    """What pose ``site`` would state of a scenario's mirrors.

    Attributes
    ----------
    sigma_rad : (heliostat,)
        Standard deviation of the normal, both axes together [rad]; NaN: not solved.
    status : (heliostat,)
        `PoseStatus`.
    """

    sigma_rad: FloatArray
    status: npt.NDArray[np.int64]


def forecast_normals(
    scenario: Scenario, rot_enu_from_mirror: FloatArray, *, tone_snr_db: float | None = None
) -> SiteForecast:
    """Forecast what pose ``site`` states of one frame in which all mirrors stand as commanded.

    Carriers are what the foreseen rays bring; their noise is that of the radio plan, by `noise_of`, for an antenna of
    the same gain in all directions: how much less a direction of low gain receives is in the carriers. For the rest see
    `rfpose.multilat.site.ForeseenMirrors`.

    Parameters
    ----------
    scenario
    rot_enu_from_mirror : (mirror, 3, 3)
        Of `Scenario.mirrors`, heliostats and plates. NaN: unknown, left out.
    tone_snr_db
        Overrides ``[simulation] tone_snr_db``.

    Raises
    ------
    ScenarioError
        Mirrors that pose ``site`` cannot solve; a pattern of other receivers.
    RecordingError
        The pattern's file is missing or damaged.
    """
    sigma_rad = np.full(len(scenario.heliostat), np.nan)
    status = np.full(len(scenario.heliostat), PoseStatus.NO_POSTURE, np.int64)
    for column, foreseen in foreseen_mirrors(scenario, rot_enu_from_mirror, tone_snr_db=tone_snr_db):
        found = foreseen.poses()
        status[column] = found.status
        both = np.sqrt(np.trace(found.normal_cov, axis1=1, axis2=2))
        sigma_rad[column] = np.where(found.status == PoseStatus.OK, both, np.nan)
    return SiteForecast(sigma_rad=sigma_rad, status=status)


def foreseen_mirrors(
    scenario: Scenario, rot_enu_from_mirror: FloatArray, *, tone_snr_db: float | None = None
) -> Iterator[tuple[npt.NDArray[np.int64], ForeseenMirrors]]:
    """Foresee what mirrors receive in one posture, those together that are alike, with their rows in the field.

    Parameters
    ----------
    scenario, rot_enu_from_mirror, tone_snr_db
        As `forecast_normals`.

    Raises
    ------
    ScenarioError, RecordingError
        As `forecast_normals`.
    """
    check_site_solvable(scenario)
    noise = noise_of(scenario, tone_snr_db=tone_snr_db)
    assert noise.carrier_sigma_m is not None  # or no carrier could be compared
    wavenumber = wavenumbers_of(scenario)
    antenna = antenna_of(scenario)
    for group in mirror_groups(scenario):
        known = knowledge_of(
            scenario,
            group,
            rot_enu_from_mirror[group.column],
            np.full(len(group.column), scenario.posture.sigma_rad),
            antenna,
        )
        phase = wavenumber * noise.carrier_sigma_m * noise.loss(scenario.transmitter_enu_m, group.pivot_enu_m)
        sigma = np.repeat((phase * known.unit_field)[:, None], group.places_m.shape[1], axis=1)
        field_at = SiteField(scenario, group, rot_enu_from_mirror[None], antenna)
        yield group.column, ForeseenMirrors.of(sigma, wavenumber, known, field_at, settings_of(scenario))
