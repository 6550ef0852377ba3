"""Mounts of mirrors from a survey's poses: how their axes lie, and where they have their zeros."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import ScenarioError
from rfpose.feedback.correlated import AXES_AND_ZEROS, CorrelatedFit, fit_correlated
from rfpose.feedback.mount import Mount, command, posture
from rfpose.feedback.selection import PLANNED_SIGMA
from rfpose.multilat import PoseStatus
from rfpose.multilat.site import Survey
from rfpose.pipeline.formats.survey_file import SurveyedMounts
from rfpose.pipeline.mirrors import MirrorGroup
from rfpose.scenario import Scenario

__all__ = ["commanded_counts", "normals_by_mounts", "planned_mounts", "surveyed_mounts"]


def planned_mounts(scenario: Scenario, given: Mapping[str, Mount] | None) -> list[Mount]:
    """Return the mounts that control believes in, by heliostat: as given, or azimuth over elevation without error.

    Raises
    ------
    ScenarioError
        Mounts were given, and not of all heliostats.
    """
    if given is None:
        return [Mount(pivot_enu_m=np.array(h.pivot_enu_m)) for h in scenario.heliostat]
    missing = [h.id for h in scenario.heliostat if h.id not in given]
    if missing:
        raise ScenarioError(f"the mounts given lack heliostat `{missing[0]}` of scenario `{scenario.name}`; add it")
    return [given[h.id] for h in scenario.heliostat]


def surveyed_mounts(found: Survey, group: MirrorGroup, mounts: list[Mount], count: FloatArray) -> list[CorrelatedFit]:
    """Fit the mounts of a group to the poses that its survey found.

    Parameters
    ----------
    found
        Of this group.
    group
    mounts
        As planned, of the scenario's heliostats.
    count : (frame, heliostat, axis)
        Where motors stood, likewise; NaN: unknown.
    """
    n_mirror = len(group.column)
    normal = np.where((found.poses.status == PoseStatus.OK)[:, None], found.poses.normal_enu, np.nan)
    return [
        fit_correlated(
            mounts[column],
            count[:, column],
            normal[m::n_mirror],
            found.normal_cov(m),
            prior_sigma={name: PLANNED_SIGMA[name] for name in AXES_AND_ZEROS},
        )
        for m, column in enumerate(group.column.tolist())
    ]


def commanded_counts(mounts: list[Mount], normal_enu: FloatArray) -> FloatArray:
    """Return where control put motors (frame, heliostat, axis) that were to give these normals (frame, heliostat, xyz).

    By the mounts that it believes in. NaN: no normal, or one that the mount cannot take.
    """
    count = np.full((*normal_enu.shape[:2], 2), np.nan)
    for i, mount in enumerate(mounts):
        told = np.flatnonzero(np.isfinite(normal_enu[:, i]).all(axis=1))
        if len(told):
            count[told, i] = command(mount, sun_enu=normal_enu[told, i], mode="dish").count
    return count


def normals_by_mounts(mounts: list[Mount], found: SurveyedMounts, commanded_enu: FloatArray) -> FloatArray:
    """Return where mirrors point (frame, heliostat, xyz) that were told to point somewhere, by surveyed mounts.

    Parameters
    ----------
    mounts
        That control believes in.
    found
        What they are off by, in the same order.
    commanded_enu : (frame, heliostat, xyz)
        Normals; NaN: unknown.
    """
    count = commanded_counts(mounts, commanded_enu)
    out = np.full(commanded_enu.shape, np.nan)
    for i, mount in enumerate(mounts):
        true = mount.replace(**dict(zip(AXES_AND_ZEROS, found.parameter[i].tolist(), strict=True)))
        told = np.flatnonzero(np.isfinite(count[:, i]).all(axis=1))
        if len(told):
            out[told, i] = posture(true, count[told, i]).normal_enu
    return out
