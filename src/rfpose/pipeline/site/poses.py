"""Poses of a recording's mirrors by pose ``site``, written into the result's tables."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose import geometry
from rfpose.checks import FloatArray
from rfpose.dsp import TonePhases
from rfpose.errors import ScenarioError
from rfpose.geometry import azimuth_elevation_from_enu
from rfpose.multilat import PoseStatus
from rfpose.multilat.integrity import IntegrityStatus
from rfpose.multilat.site import SiteKnowledge, SiteObservations, SitePoses, SiteSettings, fit_site
from rfpose.pipeline.formats.result import IntegrityTable, PoseTable, SiteTable
from rfpose.pipeline.mirrors import MirrorGroup, mirror_groups
from rfpose.pipeline.postures import commanded_normals
from rfpose.pipeline.site.field import ReceivingAntenna, SiteField, antenna_of
from rfpose.propagation import RayKind
from rfpose.scenario import Scenario

__all__ = ["SiteOutcome", "check_site_solvable", "rotations", "settings_of", "solve_site_poses"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteOutcome:
    """Poses, and what their estimator found."""

    poses: PoseTable
    integrity: IntegrityTable
    site: SiteTable


def check_site_solvable(scenario: Scenario) -> None:
    """Refuse a site whose mirrors pose ``site`` cannot solve.

    Raises
    ------
    ScenarioError
        A mirror whose receivers do not compare carriers, or whose pivot is not surveyed.
    """
    for heliostat in scenario.heliostat:
        if not scenario.compares_carriers(heliostat):
            raise ScenarioError(
                f"pose `site` compares carriers between a mirror's receivers, and heliostat `{heliostat.id}` does not: "
                'it needs `oscillator = "shared"`, `carrier_phase = true` and `radio.centre_frequency_hz` above zero'
            )
        if heliostat.pivot_sigma_m is None:
            raise ScenarioError(
                f"pose `site` foresees rays from where mirrors stand, and the pivot of heliostat `{heliostat.id}` is "
                "not surveyed; give `pivot_sigma_m`"
            )
    scenario.need_rf_carriers("pose `site`")


def solve_site_poses(
    tones: TonePhases, scenario: Scenario, cold: PoseTable, *, sample_rate: Fraction, simulated: bool
) -> SiteOutcome:
    """Solve every mirror of every frame with the site in the model.

    Parameters
    ----------
    tones
        Along the scenario's receiver axis.
    scenario
    cold
        Poses from tones, where to begin without a commanded posture; see `PoseStatus.NO_POSTURE`.
    sample_rate
        Of the recording.
    simulated
        Whether it was simulated: then mirrors follow the simulated sun, not that of the time.
    """
    check_site_solvable(scenario)
    unix_s = np.array([float(Fraction(int(s)) / sample_rate) for s in tones.frame_start_index])
    commanded = commanded_normals(scenario, unix_s, simulated=simulated)
    tables = _Tables(tones, scenario, cold)
    antenna = antenna_of(scenario)
    for group in mirror_groups(scenario):
        tables.put(group, _solve_group(tones, scenario, group, commanded, cold, antenna))
    return tables.outcome()


def _solve_group(
    tones: TonePhases,
    scenario: Scenario,
    group: MirrorGroup,
    commanded_enu: FloatArray,
    cold: PoseTable,
    antenna: ReceivingAntenna,
) -> SitePoses:
    n_frame, n_helio = len(tones.frame_start_index), len(group.column)
    own = commanded_enu[:, group.column]
    told = np.asarray(np.isfinite(own).all(axis=2))
    start = np.where(told[..., None], own, cold.normal_enu[:, group.column])
    standing = commanded_enu.copy()
    standing[:, group.column] = start
    sigma_rad = np.where(told, scenario.posture.sigma_rad, np.inf).ravel()
    return fit_site(
        SiteObservations(
            carrier=np.ascontiguousarray(group.of_mirrors(tones.carrier)),
            sigma=np.ascontiguousarray(group.of_mirrors(tones.carrier_sigma)),
            wavenumber_radpm=wavenumbers_of(scenario),
        ),
        knowledge_of(scenario, group, rotations(start.reshape(n_frame * n_helio, 3)), sigma_rad, antenna),
        SiteField(scenario, group, rotations(standing), antenna),
        settings_of(scenario),
    )


def wavenumbers_of(scenario: Scenario) -> FloatArray:
    """(transmitter,) 2π/λ of each carrier [rad/m]."""
    return np.asarray(2.0 * np.pi * scenario.carrier_rf_hz / scenario.radio.propagation_speed_mps)


def knowledge_of(
    scenario: Scenario,
    group: MirrorGroup,
    commanded_rot: FloatArray,
    posture_sigma_rad: FloatArray,
    antenna: ReceivingAntenna,
) -> SiteKnowledge:
    """Return what is known of a group's mirrors that were told to stand so (frame × heliostat, 3, 3)."""
    n_frame = len(commanded_rot) // len(group.column)
    pivot = np.tile(group.pivot_enu_m, (n_frame, 1))
    reach = np.linalg.norm(scenario.transmitter_enu_m - pivot[:, None], axis=2)
    known = group.estimator
    return SiteKnowledge(
        receiver_mirror_m=np.tile(group.places_m, (n_frame, 1, 1)),
        pivot_enu_m=pivot,
        pivot_sigma_m=known.pivot_sigma_m,
        commanded_rot=commanded_rot,
        posture_sigma_rad=posture_sigma_rad,
        roll_sigma_rad=known.roll_sigma_rad if known.two_axis else np.inf,
        clock_sigma_m=known.clock_sigma_m,
        unit_field=antenna.strength / reach,
        mast=scenario.mast,
    )


def settings_of(scenario: Scenario) -> SiteSettings:
    """Return how a scenario wants its poses fitted."""
    table = scenario.multipath
    return SiteSettings(
        floor=table.floor,
        tail=table.tail,
        factor_sigma={
            RayKind.DIRECT: (0.0, 0.0),
            RayKind.GROUND: table.ground_sigma,
            RayKind.SPECULAR: table.specular_sigma,
            RayKind.DIFFRACTED: table.diffracted_sigma,
            RayKind.OWN_PLATE: table.own_plate_sigma,
        },
        soil_sigma=table.permittivity_sigma,
        detour_m=table.detour_m,
        missed_detection=scenario.integrity.missed_detection,
        rounds=table.rounds,
    )


def rotations(normal: FloatArray) -> FloatArray:
    """Return orientations of mirrors with a horizontal x axis; NaN where the normal is not known."""
    known = np.asarray(np.isfinite(normal).all(axis=-1))
    out = geometry.rot_enu_from_mirror(np.where(known[..., None], normal, [0.0, 0.0, 1.0]))
    return np.where(known[..., None, None], out, np.nan)


class _Tables:
    """The result's tables, filled group by group."""

    def __init__(self, tones: TonePhases, scenario: Scenario, cold: PoseTable) -> None:
        self._n_frame = n_frame = len(tones.frame_start_index)
        mirror = (n_frame, len(scenario.heliostat))
        link = (n_frame, len(scenario.receivers), len(scenario.transmitter))
        self._poses = {name: np.array(getattr(cold, name)) for name in PoseTable.__dataclass_fields__}
        for values in self._poses.values():
            values[:] = np.nan if values.dtype.kind == "f" else 0
        self._integrity = IntegrityTable.unsolved(scenario, n_frame)
        self._site: dict[str, npt.NDArray[Any]] = {
            "weight": np.full(link, np.nan),
            "residual_rad": np.full(link, np.nan),
            "sigma_rad": np.full(link, np.nan),
            "floor": np.full(mirror, np.nan),
            "tail": np.full(mirror[1], np.nan),
            "factor_scale": np.full((mirror[1], len(RayKind)), np.nan),
            "permittivity_change": np.full(mirror[1], np.nan, np.complex128),
            "permittivity_sigma": np.full((mirror[1], 2), np.nan),
        }

    def put(self, group: MirrorGroup, found: SitePoses) -> None:
        """Write one group."""
        solved = np.isfinite(found.normal_enu[:, 0])
        azimuth, elevation = azimuth_elevation_from_enu(found.normal_enu)
        cov = found.normal_cov
        places = np.tile(group.places_m, (self._n_frame, 1, 1))
        centre = found.pivot_enu_m + np.einsum("mab,mb->ma", found.rot_enu_from_mirror, places.mean(axis=1))
        used = np.isfinite(found.weight).any(axis=2).sum(axis=1)
        self._put(self._poses, group, {
            "normal_enu": found.normal_enu, "cov_enu": cov,
            "sigma_rad": np.sqrt(np.trace(cov, axis1=1, axis2=2)), "azimuth_rad": azimuth,
            "elevation_rad": elevation, "centre_enu_m": centre, "n_receiver": np.where(solved, used, 0),
            "n_wavelength": solved.astype(np.int16), "status": found.status,
        })  # fmt: skip
        self._put(self._integrity, group, {
            "status": np.where(found.status == PoseStatus.OK, IntegrityStatus.OK, IntegrityStatus.NOT_SOLVED),
            "protection_level_rad": np.where(solved, found.protection_level_rad, np.nan),
        })  # fmt: skip
        self._put(self._site, group, {"floor": found.floor})
        shape = (self._n_frame, *group.rows.shape, -1)
        self._integrity["used"][:, group.rows] = (np.isfinite(found.weight) & solved[:, None, None]).reshape(shape)
        for name in ("weight", "residual_rad", "sigma_rad"):
            self._site[name][:, group.rows] = getattr(found, name).reshape(shape)
        common = found.common
        self._site["tail"][group.column] = common.tail
        self._site["factor_scale"][group.column] = common.factor_scale
        self._site["permittivity_change"][group.column] = common.soil_change
        self._site["permittivity_sigma"][group.column] = common.soil_sigma

    def _put(self, table: dict[str, npt.NDArray[Any]], group: MirrorGroup, values: dict[str, Any]) -> None:
        for name, array in values.items():
            table[name][:, group.column] = array.reshape(self._n_frame, len(group.column), *array.shape[1:])

    def outcome(self) -> SiteOutcome:
        """Return the tables."""
        return SiteOutcome(
            poses=PoseTable(**self._poses), integrity=IntegrityTable(**self._integrity), site=SiteTable(**self._site)
        )
