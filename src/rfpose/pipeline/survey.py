"""A survey of a site by its own radio: recordings of many postures in, what does not change out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError, RecordingError, ScenarioError
from rfpose.feedback.correlated import AXES_AND_ZEROS, CorrelatedFit
from rfpose.feedback.mount import Mount
from rfpose.files import claim
from rfpose.multilat.site import (
    FieldAt,
    PostureCorrelation,
    ReferencePoses,
    SiteObservations,
    Survey,
    SurveyConstants,
    SurveyPrior,
    survey_site,
)
from rfpose.pipeline.formats.mount_file import MountFile, read_models
from rfpose.pipeline.formats.survey_file import SurveyedMounts, SurveyFile, write_survey
from rfpose.pipeline.mirrors import MirrorGroup, mirror_groups
from rfpose.pipeline.postures import read_postures
from rfpose.pipeline.site.field import SiteField, antenna_of
from rfpose.pipeline.site.frames import Frames, Recordings, commanded_in, frames_of, inputs_of, listed
from rfpose.pipeline.site.mounts import commanded_counts, planned_mounts, surveyed_mounts
from rfpose.pipeline.site.poses import knowledge_of, rotations, settings_of, wavenumbers_of
from rfpose.scenario import Scenario

__all__ = ["Frames", "SurveyKnowledge", "survey", "survey_frames"]


def survey(
    recordings: Recordings,
    output: str | Path | None = None,
    *,
    scenario: Scenario | str | Path | None = None,
    reference: str | Path | None = None,
    reference_sigma_rad: float = 1e-4,
    mounts: str | Path | MountFile | None = None,
    motors: str | Path | None = None,
    follow_links: bool = False,
    force: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> SurveyFile:
    """Find what does not change over the postures of recordings.

    Parameters
    ----------
    recordings
        Of one site. Paths that hold the same receivers are recordings by themselves; where some hold others, all are
        parts of one, as are those of a directory or a manifest, and of a list within the list.
    output
        File to write, format ``rfpose-survey``.
    scenario
        The site; wins over those in the recordings.
    reference
        Table of normals that something else measured, as `rfpose.pipeline.postures.read_postures` reads it; frames are
        counted through all recordings.
    reference_sigma_rad
        How good they are, in each of two directions [rad].
    mounts
        Mounts that control believed in, format ``rfpose-mount``; without it azimuth over elevation.
    motors
        Log of motor positions, in the counts of ``mounts``: CSV with time_utc, heliostat, axis_1, axis_2. Without it
        they stood where those mounts have the commanded normals.
    follow_links, force
        As for `rfpose.pipeline.process.process`.
    on_progress
        Called with (steps done, steps in all).

    Raises
    ------
    RecordingError
        A file that is missing, damaged, or cannot be written.
    ScenarioError
        No scenario, or one that pose ``site`` cannot solve, or whose mirrors know no posture.
    InvalidInputError
        No recording; a sigma that is not above zero; motors without mounts.

    Examples
    --------
    >>> import rfpose as rf
    >>> site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    >>> mirror = {"pivot_sigma_m": 0.003, "receiver_delay_sigma_s": 0.0}
    >>> site = site.changed(
    ...     heliostat=[h.changed(**mirror) for h in site.heliostat[:2]],
    ...     radio={"frame_samples": 20_000, "centre_frequency_hz": 433e6},
    ...     multipath={"foresee": [], "visibility": False},
    ... )
    >>> found = rf.survey(rf.simulate(site, seed=1))
    >>> found
    <SurveyFile 'Table 2, 100 m field': 2 of 2 heliostats in 5 frames or fewer>
    >>> found.undetermined[0][0]
    'rotation of the receivers against the plate about x'
    """
    many = listed(recordings, follow_links=follow_links)
    if not reference_sigma_rad > 0.0:
        raise InvalidInputError(f"`reference_sigma_rad` must be greater than zero, got {reference_sigma_rad}")
    if motors is not None and mounts is None:
        raise InvalidInputError("`motors` are counted as the mounts' drives have it: give `mounts=FILE` with them")
    files = [f for f in (scenario, reference, mounts, motors) if isinstance(f, str | Path)]
    with claim(output, inputs=[*inputs_of(many), *files], force=force):
        parts, site = frames_of(many, scenario, follow_links=follow_links)
        besides = SurveyKnowledge.read(site, parts, reference, reference_sigma_rad, mounts, motors)
        found = survey_frames(parts, site, besides, on_progress=on_progress)
        if output is not None:
            write_survey(output, found, force=True)
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyKnowledge:
    """What is known besides recordings.

    Attributes
    ----------
    reference_enu : (frame, heliostat, xyz)
        Normals from elsewhere; NaN: none. None: of no frame.
    reference_sigma_rad
        How good they are [rad].
    mounts
        That control believes in, by heliostat.
    count : (frame, heliostat, axis)
        Where motors stood; NaN: unknown. None: where those mounts have the commanded normals.
    correlation
        Of errors over posture; None: found from residuals.
    """

    mounts: list[Mount]
    reference_enu: FloatArray | None = None
    reference_sigma_rad: float = 1e-4
    count: FloatArray | None = None
    correlation: PostureCorrelation | None = None

    @classmethod
    def read(
        cls,
        site: Scenario,
        parts: list[Frames],
        reference: str | Path | None,
        reference_sigma_rad: float,
        mounts: str | Path | MountFile | None,
        motors: str | Path | None,
    ) -> SurveyKnowledge:
        """Read the files that `survey` was given."""
        unix_s = np.concatenate([part.unix_s for part in parts])
        given = read_models(mounts) if isinstance(mounts, str | Path) else mounts
        known = None if given is None else {name: stored.mount for name, stored in given.heliostats.items()}
        count = None
        if motors is not None:
            from rfpose.pipeline.calibration_sources import MotorLog  # knows cameras, too

            log = MotorLog.read(Path(motors))
            nowhere = (np.nan, np.nan)
            count = np.array([[log.count(h, t) or nowhere for h in site.heliostat_ids] for t in unix_s.tolist()])
            if np.isnan(count).all():
                raise RecordingError(
                    f"{motors}: has no entry of the site's heliostats within 1 s of a frame; check times and names"
                )
        return cls(
            mounts=planned_mounts(site, known),
            reference_enu=None if reference is None else read_postures(reference, list(site.heliostat_ids), unix_s),
            reference_sigma_rad=reference_sigma_rad,
            count=count,
        )


def survey_frames(
    parts: list[Frames],
    site: Scenario,
    besides: SurveyKnowledge,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> SurveyFile:
    """Find what does not change over frames; see `survey`."""
    commanded = commanded_in(parts, site)
    groups = list(mirror_groups(site))
    if len(groups) > 1 and any(t.survey_sigma_m > 0.0 for t in site.transmitter):
        raise ScenarioError(
            f"scenario `{site.name}` has mirrors of {len(groups)} kinds, and transmitters are surveyed by mirrors of "
            "one kind alone; leave `survey_sigma_m` of [[transmitter]] out"
        )
    count = besides.count
    if count is None:
        count = commanded_counts(besides.mounts, commanded[:, : len(site.heliostat)])
    out = _Tables(site)
    for g, group in enumerate(groups):

        def told(done: int, total: int, g: int = g) -> None:
            if on_progress is not None:
                on_progress(g * total + done, len(groups) * total)

        found = _survey_group(parts, site, group, commanded, besides, told)
        out.put(group, found)
        out.put_mounts(group, surveyed_mounts(found, group, besides.mounts, count))
    if on_progress is not None:
        on_progress(1, 1)
    return out.outcome()


def _survey_group(
    parts: list[Frames],
    site: Scenario,
    group: MirrorGroup,
    commanded: FloatArray,
    besides: SurveyKnowledge,
    on_round: Callable[[int, int], None],
) -> Survey:
    told = rotations(commanded[:, group.column].reshape(-1, 3))
    antenna = antenna_of(site)
    known = group.estimator
    first = site.heliostat[int(group.column[0])]
    given = SurveyConstants(
        receiver_mirror_m=group.places_m,
        pivot_enu_m=group.pivot_enu_m,
        transmitter_enu_m=np.array(site.transmitter_enu_m),
        delay_m=np.zeros(group.rows.shape),
    )
    standing = rotations(commanded)
    for i in group.column:
        if site.heliostat[int(i)].receiver_survey_sigma_m != first.receiver_survey_sigma_m:
            raise ScenarioError(
                f"`receiver_survey_sigma_m` of heliostats `{first.id}` and `{site.heliostat[int(i)].id}` differ, and "
                "mirrors that are alike are surveyed together; give one for all"
            )

    def field_for(now: SurveyConstants) -> FieldAt:
        placed = zip(site.transmitter, now.transmitter_enu_m, strict=True)
        moved = site.changed(transmitter=[t.changed(position_enu_m=place) for t, place in placed])
        there = replace(group, places_m=now.receiver_mirror_m, pivot_enu_m=now.pivot_enu_m)
        return SiteField(moved, there, standing, antenna)

    poses = None
    if besides.reference_enu is not None:
        picked = besides.reference_enu[:, group.column].reshape(-1, 3)
        poses = ReferencePoses(normal_enu=picked, sigma_rad=np.full(len(picked), besides.reference_sigma_rad))
    return survey_site(
        SiteObservations(
            carrier=np.concatenate([group.of_mirrors(p.carrier) for p in parts]),
            sigma=np.concatenate([group.of_mirrors(p.sigma) for p in parts]),
            wavenumber_radpm=wavenumbers_of(site),
        ),
        knowledge_of(site, group, told, np.full(len(told), site.posture.sigma_rad), antenna),
        given,
        field_for,
        prior=SurveyPrior(
            place_sigma_m=first.receiver_survey_sigma_m,
            pivot_sigma_m=known.pivot_sigma_m,
            transmitter_sigma_m=np.array([t.survey_sigma_m for t in site.transmitter]),
            delay_sigma_m=known.clock_sigma_m,
            correlation=besides.correlation,
        ),
        settings=settings_of(site),
        reference=poses,
        on_round=on_round,
    )


class _Tables:
    """The survey's tables, filled group by group."""

    def __init__(self, site: Scenario) -> None:
        n = len(site.heliostat)
        most = max(len(h.receiver_mirror_m) for h in site.heliostat)
        self._site = site
        self._words: list[tuple[str, ...]] = [()] * n
        self._transmitters: tuple[str, ...] = ()
        self._place, self._place_cov = np.full((n, most, 3), np.nan), np.full((n, 3 * most, 3 * most), np.nan)
        self._pivot, self._pivot_sigma = np.empty((n, 3)), np.empty((n, 3))
        self._delay, self._delay_sigma = np.full((n, most), np.nan), np.full((n, most), np.nan)
        self._frames, self._rank = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self._worth, self._share, self._angle = np.zeros(n), np.zeros(n), np.zeros(n)
        self._mounts: dict[int, CorrelatedFit] = {}
        self._normal = np.empty((n, 4))
        self._transmitter: FloatArray = np.array(site.transmitter_enu_m)
        self._transmitter_sigma: FloatArray = np.zeros(self._transmitter.shape)
        self._soil = (np.zeros(2), np.zeros(2))

    def put(self, group: MirrorGroup, found: Survey) -> None:
        """Write one group."""
        n = group.rows.shape[1]
        arm = np.array([[0.0, 0.0, self._site.heliostat[i].arm_m] for i in group.column])
        c, at = group.column, found.constants
        self._place[c, :n] = at.receiver_mirror_m - arm[:, None]
        self._place_cov[c, : 3 * n, : 3 * n] = found.cov[:, : 3 * n, : 3 * n]
        self._pivot[c] = at.pivot_enu_m
        self._pivot_sigma[c] = np.sqrt(np.einsum("mpp->mp", found.cov)[:, 3 * n : 3 * n + 3])
        self._delay[c, :n], self._delay_sigma[c, :n] = at.delay_m, found.delay_sigma_m
        self._frames[c], self._rank[c] = found.n_frame, found.rank
        self._worth[c] = found.n_independent
        self._share[c], self._angle[c] = found.correlation.share, found.correlation.angle_rad
        self._normal[c] = found.normal_sigma_rad
        for i, words in zip(c.tolist(), found.undetermined, strict=True):
            self._words[i] = words
        self._transmitter = at.transmitter_enu_m
        self._transmitter_sigma = np.sqrt(np.diag(found.transmitter_cov)).reshape(-1, 3)
        self._transmitters = found.transmitters_undetermined
        common = found.poses.common
        change = complex(common.soil_change)
        self._soil = (np.array([change.real, change.imag]), np.array(common.soil_sigma))

    def put_mounts(self, group: MirrorGroup, mounts: list[CorrelatedFit]) -> None:
        """Write one group's mounts."""
        self._mounts.update(zip(group.column.tolist(), mounts, strict=True))

    def outcome(self) -> SurveyFile:
        """Return the survey."""
        fits = [self._mounts[i] for i in range(len(self._words))]
        mounts = SurveyedMounts(
            parameter=np.array([[fit.mount.parameters[name] for name in AXES_AND_ZEROS] for fit in fits]),
            cov=np.array([fit.covariance for fit in fits]),
            rank=np.array([fit.rank for fit in fits], np.int64),
            scatter=np.array([fit.scatter for fit in fits]),
            normal_sigma_rad=np.array([fit.normal_sigma_rad for fit in fits]),
            undetermined=tuple(fit.undetermined for fit in fits),
        )
        return SurveyFile(
            scenario=self._site, receiver_mirror_m=self._place, receiver_cov_m2=self._place_cov,
            pivot_enu_m=self._pivot, pivot_sigma_m=self._pivot_sigma, transmitter_enu_m=self._transmitter,
            transmitter_sigma_m=self._transmitter_sigma, delay_m=self._delay, delay_sigma_m=self._delay_sigma,
            permittivity_change=self._soil[0],
            permittivity_sigma=self._soil[1], frame_count=self._frames, frame_worth=self._worth,
            correlation_share=self._share, correlation_rad=self._angle, rank=self._rank, mounts=mounts,
            normal_sigma_rad=self._normal, undetermined=tuple(self._words),
            transmitters_undetermined=self._transmitters,
        )  # fmt: skip
