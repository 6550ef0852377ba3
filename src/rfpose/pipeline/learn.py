"""An antenna pattern out of recordings: what mirrors of one type received in many postures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose.antenna import LearnedPattern, MirrorType, PostureCarriers
from rfpose.antenna import learn_pattern as learn_from_carriers
from rfpose.antenna.pattern import BEYOND
from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.files import claim
from rfpose.multilat.site import Common
from rfpose.pipeline.formats.antenna_file import read_pattern, write_pattern
from rfpose.pipeline.formats.mount_file import MountFile, read_models
from rfpose.pipeline.formats.survey_file import SurveyFile, read_survey
from rfpose.pipeline.mirrors import MirrorGroup, mirror_groups
from rfpose.pipeline.site.field import SiteField, antenna_of
from rfpose.pipeline.site.frames import Frames, Recordings, commanded_in, frames_of, inputs_of, listed
from rfpose.pipeline.site.mounts import normals_by_mounts, planned_mounts
from rfpose.pipeline.site.poses import rotations
from rfpose.propagation import RayKind
from rfpose.scenario import Scenario

__all__ = ["learn_from_frames", "learn_pattern"]

IntArray = npt.NDArray[np.int64]

_NEW_RAD = np.radians(1.0)
"""A frame of a mirror that stands nearer than this to one taken before tells nothing new, and would be held out as if
it did."""
_FEWEST = 10
"""Fewer postures leave none to be held out, and nothing would tell what the pattern is worth."""


def learn_pattern(
    recordings: Recordings,
    output: str | Path | None = None,
    *,
    scenario: Scenario | str | Path | None = None,
    start: str | Path | None = None,
    survey: str | Path | SurveyFile | None = None,
    mounts: str | Path | MountFile | None = None,
    follow_links: bool = False,
    force: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> LearnedPattern:
    """Learn the pattern of the receivers on a type of mirror from recordings of many postures.

    Mirrors are taken to stand where they were told to, to ``sigma_rad`` of ``[posture]``; with a survey, where its
    mounts have them.

    Parameters
    ----------
    recordings
        Of one site, whose mirrors are alike; several, or parts of one, as for `rfpose.survey`.
    output
        File to write, format ``rfpose-antenna``, for ``[antenna] pattern``.
    scenario
        The site; wins over those in the recordings.
    start
        Pattern that the true one is near to, as NEC gives it: fewer postures are enough.
    survey
        File of `rfpose.survey`: pivots, transmitters, the ground, and how mounts stand.
    mounts
        Mounts that control believed in, as `rfpose.survey` was told; without it azimuth over elevation.
    follow_links, force
        As for `rfpose.process`.
    on_progress
        Called with (rounds done, rounds at most).

    Raises
    ------
    RecordingError
        A file that is missing, damaged, or cannot be written.
    ScenarioError
        No scenario, mirrors that are not alike, have no outline or know no posture; a survey of another site.
    InvalidInputError
        No recording, too few postures, or what was learned did not come to rest: nothing is written.
    """
    many = listed(recordings, follow_links=follow_links)
    files = [f for f in (scenario, start, survey, mounts) if isinstance(f, str | Path)]
    with claim(output, inputs=[*inputs_of(many), *files], force=force):
        parts, site = frames_of(many, scenario, follow_links=follow_links)
        surveyed = read_survey(survey) if isinstance(survey, str | Path) else survey
        given = read_models(mounts) if isinstance(mounts, str | Path) else mounts
        found = learn_from_frames(parts, site, start=start, survey=surveyed, mounts=given, on_progress=on_progress)
        if output is not None:
            settings = {"learned_from": f"{found.n_posture} postures", "scenario": site.name}
            write_pattern(output, found.pattern, settings=settings, force=True)
        return found


def learn_from_frames(
    parts: list[Frames],
    site: Scenario,
    *,
    start: str | Path | None = None,
    survey: SurveyFile | None = None,
    mounts: MountFile | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> LearnedPattern:
    """Learn a pattern from frames; see `learn_pattern`."""
    mirror = _mirror_type(site)
    frequency_hz = _frequency_hz(site)
    near = None if start is None else read_pattern(start).pattern
    commanded = commanded_in(parts, site)
    sigma_rad = site.posture.sigma_rad
    if survey is not None:
        site = survey.applied(site)
        planned = planned_mounts(site, None if mounts is None else {k: m.mount for k, m in mounts.heliostats.items()})
        commanded[:, : len(site.heliostat)] = normals_by_mounts(
            planned, survey.mounts_of(site), commanded[:, : len(site.heliostat)]
        )
        both = survey.mounts.normal_sigma_rad[:, 1]
        sigma_rad = float(np.sqrt(0.5 * np.nanmean(both**2))) if np.isfinite(both).any() else sigma_rad
    # the pattern holds the mirror's own plate: no rays of it are foreseen, whatever antenna weighs them
    without_plate = [kind for kind in site.multipath.foresee if kind != "own_plate"]
    site = site.changed(multipath={"foresee": without_plate}, antenna={"pattern": None})
    (group,) = mirror_groups(site)
    amplitude = np.concatenate([group.of_mirrors(part.carrier) for part in parts])
    told = (np.isfinite(amplitude).sum(axis=1) >= 2).any(axis=1).reshape(len(commanded), -1)
    rows = _new_postures(np.where(told[..., None], commanded[:, group.column], np.nan))
    n_known = int((told & np.isfinite(commanded[:, group.column]).all(axis=2)).sum())
    if len(rows) < _FEWEST:
        raise InvalidInputError(
            f"{len(rows)} postures of mirrors more than {np.degrees(_NEW_RAD):.0f} degree apart, of {n_known} mirrors "
            f"in {len(commanded)} frames that were heard and know where they stand: a pattern is learned from "
            f"{_FEWEST} or more, five of each of eight mirrors are few and thirty plenty; record more postures"
        )
    rot = rotations(commanded)
    pivot = np.tile(group.pivot_enu_m, (len(commanded), 1))
    own_rot = np.full((len(pivot), 3, 3), np.nan)
    own_rot[rows] = rot[:, group.column].reshape(-1, 3, 3)[rows]
    rays = SiteField(site, group, rot, antenna_of(site))(pivot, own_rot, _nothing_learned()).rays
    # the other rows have no rays
    first = rays.first[:-1].reshape(len(pivot), -1)[rows].ravel()
    found = learn_from_carriers(
        PostureCarriers(
            amplitude=amplitude[rows],
            rays=replace(rays, first=np.append(first, rays.n_ray)),
            pivot_enu_m=pivot[rows],
            rot_enu_from_mirror=own_rot[rows],
            wavelength_m=site.radio.propagation_speed_mps / site.carrier_rf_hz,
            rotation_sigma_rad=sigma_rad,
            pivot_sigma_m=_pivot_sigma_m(group),
        ),
        mirror,
        frequency_hz=frequency_hz,
        start=near,
        on_progress=on_progress,
    )
    if not found.settled:
        raise InvalidInputError(
            f"the pattern did not settle: {found.floor:.2f} of the direct field are left, {found.floor_dipole:.2f} "
            f"with lone dipoles, of {found.n_posture} postures believed to {1e3 * sigma_rad:.0f} mrad; record more "
            "postures, tell them better ([posture], or `survey=FILE`), or begin near the truth (`start=PATTERN`)"
        )
    return found


def _mirror_type(site: Scenario) -> MirrorType:
    """Return what all mirrors have in common, or say what they have not."""
    first = site.heliostat[0]
    for h in site.heliostat:
        if h.width_m is None or h.height_m is None:
            raise ScenarioError(
                f"heliostat `{h.id}` has no outline, which its plate has; give `width_m` and `height_m`"
            )
        for key in ("width_m", "height_m", "receiver_mirror_m"):
            if getattr(h, key) != getattr(first, key):
                raise ScenarioError(
                    f"heliostats `{first.id}` and `{h.id}` differ in `{key}`, and a pattern is of one type of mirror; "
                    "learn from a scenario that has one type alone"
                )
    if len(list(mirror_groups(site))) > 1:
        raise ScenarioError(f"scenario `{site.name}` has heliostats of several kinds; learn from one kind alone")
    assert first.width_m is not None
    assert first.height_m is not None
    return MirrorType(
        receiver_mirror_m=np.array(first.receiver_mirror_m),
        axis_mirror=np.array(site.antenna.axis_mirror),
        plate_m=(first.width_m, first.height_m),
    )


def _frequency_hz(site: Scenario) -> float:
    """Return the middle of the carriers, which a pattern of one frequency must hold for."""
    low, high = float(site.carrier_rf_hz.min()), float(site.carrier_rf_hz.max())
    middle = 0.5 * (low + high)
    if high > middle * (1.0 + BEYOND):
        raise ScenarioError(
            f"the carriers of scenario `{site.name}` reach from {low / 1e6:.6g} to {high / 1e6:.6g} MHz, and a learned "
            f"pattern holds within {100.0 * BEYOND:.0f} % of its frequency; make one with scripts/antenna_pattern.py"
        )
    return middle


def _new_postures(normal_enu: FloatArray) -> IntArray:
    """Return which rows (frame × mirror) stand where their mirror has not stood before."""
    new = np.zeros(normal_enu.shape[:2], np.bool_)
    for m in range(normal_enu.shape[1]):
        kept = np.zeros((0, 3))
        for f in np.flatnonzero(np.isfinite(normal_enu[:, m]).all(axis=1)):
            if not len(kept) or np.max(kept @ normal_enu[f, m]) < np.cos(_NEW_RAD):
                kept = np.concatenate([kept, normal_enu[f : f + 1, m]])
                new[f, m] = True
    return np.flatnonzero(new)


def _pivot_sigma_m(group: MirrorGroup) -> float:
    return max(group.estimator.pivot_sigma_m, 1e-6)


def _nothing_learned() -> Common:
    """Return what rays are foreseen with: the ground as given."""
    return Common(floor=0.05, tail=3.0, factor_scale=np.ones(len(RayKind)), soil_change=0j, soil_sigma=(0.0, 0.0))
