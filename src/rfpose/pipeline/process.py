"""The main job: a recording in, a result out; into a file resumable, and nothing half written."""

from __future__ import annotations

import contextlib
import logging
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rfpose import __version__
from rfpose.engine import is_elsewhere
from rfpose.errors import InvalidInputError, RecordingError, ScenarioError
from rfpose.files import claim
from rfpose.pipeline.formats.journal import Journal, partial_of
from rfpose.pipeline.stages import Stopwatch
from rfpose.recording import (
    Recording,
    RecordingSource,
    check_against,
    files_of,
    frame_starts,
    note_doubts,
    open_recording,
)
from rfpose.recording.parts import PartsRecording
from rfpose.scenario import Scenario, scenario_of

if TYPE_CHECKING:
    from rfpose.pipeline.choice import PoseChoice
    from rfpose.pipeline.follow import Follow
    from rfpose.pipeline.formats.result import Result
    from rfpose.pipeline.formats.survey_file import SurveyFile
    from rfpose.pipeline.measure import OtherProcesses

__all__ = ["Asked", "note_differing_receivers", "process"]

_log = logging.getLogger(__name__)


def process(
    recording: Recording | RecordingSource | Follow,
    output: str | Path | None = None,
    *,
    scenario: Scenario | str | Path | None = None,
    estimator: str = "hilbert",
    pose: str = "rigid",
    reflection: str | None = None,
    integrity: bool | None = None,
    filtered: bool | None = None,
    survey: SurveyFile | str | Path | None = None,
    follow_links: bool = False,
    force: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Find receiver positions and mirror normals in a recording.

    With ``output``, measured tone phases are kept in the directory ``OUTPUT.partial`` until the result is written.
    After an interruption the same call goes on from there and gives the same bytes as an undisturbed one.

    Parameters
    ----------
    recording
        Open, or whatever `rfpose.recording.open_recording` opens. A `rfpose.pipeline.follow.Follow`: one that is
        being written, each frame of which is solved when it is complete; needs ``output``, and frames so far are in
        ``OUTPUT.partial``, which `rfpose.open_result` reads meanwhile.
    output
        File to write, format ``rfpose-result``; None: none, see `Result.save`.
    scenario
        The site, or its TOML file; wins over the one in the recording.
    estimator
        How tone phases are measured, one of `rfpose.dsp.ESTIMATORS`.
    pose
        How normals follow from phases, one of `rfpose.pipeline.choice.POSES`.
    reflection
        One of `rfpose.pipeline.choice.REFLECTIONS`; None: as the scenario's ``[reflection]`` says.
    integrity
        Whether residuals are tested and bad transmitters left out; None: as the scenario's ``[integrity]`` says.
    filtered
        Whether poses are filtered over frames besides; None: as the scenario's ``[motion]`` says.
    survey
        As `rfpose.survey` gives it, or the file of one: where receivers, pivots and transmitters are.
    follow_links
        As for `rfpose.recording.open_recording`.
    force
        Overwrite an existing result, and discard unfinished work of another job on the same result.
    on_progress
        Called with (rows done, rows in all); a row is one receiver in one frame.

    Raises
    ------
    ClusterError
        Of the `rfpose.engine.Engine` that is used, the scheduler or workers cannot be reached, or have another version.
    RecordingError
        A file that is missing, damaged, exists already, is both read and to be written, or cannot be written.
    ScenarioError
        No scenario, or one that disagrees with the recording or cannot be solved.
    GeometryError
        The site admits no solution, or an ambiguous one.
    InvalidInputError
        Unknown ``estimator``, ``pose`` or ``reflection``, or a choice that the pose cannot follow.

    Examples
    --------
    >>> import rfpose as rf
    >>> site = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    >>> short = site.changed(
    ...     heliostat=site.heliostat[:2], radio={"frame_samples": 40_000}, simulation={"frame_count": 2}
    ... )
    >>> result = rf.process(rf.simulate(short, seed=1))
    >>> result
    <Result 'Table 2, 100 m field': 2 frames, 2 heliostats, 4 of 4 poses solved>
    >>> result.poses.normal_enu.shape
    (2, 2, 3)
    """
    asked = Asked(
        scenario=scenario,
        estimator=estimator,
        pose=pose,
        reflection=reflection,
        integrity=integrity,
        filtered=filtered,
        survey=survey,
    )
    if not isinstance(recording, Recording | str | Path | Sequence):  # spares loading what follows
        from rfpose.pipeline.follow import follow_recording

        return follow_recording(recording, output, asked, follow_links=follow_links, force=force)
    stages = Stopwatch()
    kept = None if output is None else partial_of(output)
    read = recording.files() if isinstance(recording, Recording) else files_of(recording)
    with claim(output, inputs=[*read, *asked.files, kept], force=force) as job:
        with contextlib.ExitStack() as open_files:
            with stages.during("open"):
                opened = open_files.enter_context(_opened(recording, follow_links=follow_links))
                site, surveyed = asked.site_of(opened)
                if isinstance(opened, PartsRecording):
                    from rfpose.pipeline.clocks import settle_clocks

                    settled = settle_clocks(opened, site)
                    if settled is not opened:
                        _refuse_found_clocks(settled)
                    opened = settled
                    open_files.callback(opened.close)
                starts = _frames(opened, site)
                # compiled code, which none of the refusals above should wait for
                from rfpose.pipeline.formats.result_file import write_result
                from rfpose.pipeline.formats.truth_rows import align_truth
                from rfpose.pipeline.measure import journal_key, measure_tones
                from rfpose.pipeline.solve import solve

                elsewhere = _elsewhere(recording, follow_links=follow_links)
                choice = asked.choice_for(site)
                note_differing_receivers(opened, site)
                note_doubts(opened)
                journal = None
                if kept is not None:
                    journal = Journal(kept, journal_key(opened, site, estimator), restart=force)
            tones = measure_tones(
                opened,
                site,
                starts,
                estimator=estimator,
                journal=journal,
                on_progress=on_progress,
                stages=stages,
                elsewhere=elsewhere,
            )
            settings = asked.settings(opened, site, choice)
            truth = None if opened.truth is None else align_truth(opened.truth, site)
        with stages.during("poses"):
            if surveyed is not None:
                tones = surveyed.without_delays(tones, site)
            rate = opened.sample_rate
            result = solve(tones, site, choice, sample_rate=rate, settings=settings, truth=truth, stages=stages)
            if surveyed is not None:
                result = surveyed.widened(result)
        stages.seconds["poses"] -= stages.seconds["calibration"]
        if output is not None:
            with stages.during("write"):
                write_result(result, output)
        if journal is not None:
            job.afterwards(journal.remove)
        return replace(result, profile=_profile(stages))


def _profile(stages: Stopwatch) -> dict[str, Any]:
    """Return seconds by stage, samples a second of reading and tones, and the stage that takes longest.

    ``read`` and ``tones`` are shared by ``cores``: their seconds are divided by that.
    """
    shared = {name: stages.seconds[name] / stages.cores for name in ("read", "tones")}
    seconds = stages.seconds | shared
    busy = sum(shared.values())
    return {
        "seconds": seconds,
        "cores": stages.cores,
        "samples": stages.samples,
        "samples_per_s": stages.samples / busy if busy > 0.0 else None,
        "bound_by": max(seconds, key=seconds.__getitem__),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What is to be made of a recording: the arguments of `process` that say how."""

    scenario: Scenario | str | Path | None
    estimator: str
    pose: str
    reflection: str | None
    integrity: bool | None
    filtered: bool | None
    survey: SurveyFile | str | Path | None

    @property
    def files(self) -> list[str | Path]:
        """What is read besides the recording."""
        return [given for given in (self.scenario, self.survey) if isinstance(given, str | Path)]

    def site_of(self, recording: Recording) -> tuple[Scenario, SurveyFile | None]:
        """Return the site, as far as a survey knows it better, and the survey.

        Raises
        ------
        RecordingError, ScenarioError
            There is none, or it does not fit the recording.
        """
        site = _choose_scenario(recording, None if self.scenario is None else scenario_of(self.scenario))
        surveyed = None
        if self.survey is not None:
            from rfpose.pipeline.formats.survey_file import read_survey

            surveyed = read_survey(self.survey) if isinstance(self.survey, str | Path) else self.survey
            site = surveyed.applied(site)
        check_against(recording, site)
        return site, surveyed

    def choice_for(self, site: Scenario) -> PoseChoice:
        """Return the estimator of poses.

        Raises
        ------
        InvalidInputError, ScenarioError, GeometryError
            There is none of this name, or it cannot solve the site.
        """
        from rfpose.dsp import ESTIMATORS
        from rfpose.pipeline.choice import choose
        from rfpose.pipeline.solvable import check_solvable

        if self.estimator not in ESTIMATORS:
            raise InvalidInputError(f"`estimator` must be one of {', '.join(ESTIMATORS)}, got {self.estimator!r}")
        choice = choose(
            site, pose=self.pose, reflection=self.reflection, integrity=self.integrity, filtered=self.filtered
        )
        check_solvable(site, pose=self.pose, choice=choice)
        return choice

    def settings(self, recording: Recording, site: Scenario, choice: PoseChoice) -> dict[str, str]:
        """Return what the result depends on, without places and times: equal work gives equal bytes."""
        command = f"rfpose process {shlex.join(recording.names)} --estimator {self.estimator} --pose {choice.pose}"
        if isinstance(self.scenario, str | Path):
            command += f" --scenario {Path(self.scenario).name}"
        if self.survey is not None:
            command += f" --survey {Path(self.survey).name if isinstance(self.survey, str | Path) else 'GIVEN'}"
        if self.reflection is not None:
            command += f" --reflection {self.reflection}"
        if self.integrity is not None:
            command += " --integrity" if self.integrity else " --no-integrity"
        if self.filtered is not None:
            command += " --filter" if self.filtered else " --no-filter"
        learns = choice.pose == "rigid" and site.learns_delays
        given = self.scenario
        return {
            "version": __version__,
            "command": command,
            "recording": recording.path.name,
            "recording_format": recording.format,
            "scenario_from": "recording" if given is None else "caller" if isinstance(given, Scenario) else "file",
            "estimator": self.estimator,
            "delays": "learned" if learns else "as the scenario says",
        }


def _opened(
    recording: Recording | RecordingSource, *, follow_links: bool
) -> contextlib.AbstractContextManager[Recording]:
    """Open a recording for the block; one that the caller opened stays open."""
    if isinstance(recording, Recording):
        return contextlib.nullcontext(recording)
    return open_recording(recording, follow_links=follow_links)


def _refuse_found_clocks(recording: Recording) -> None:
    """Others open the parts by themselves, and do not know what was found of their clocks here."""
    if is_elsewhere():
        raise RecordingError(
            f"{recording.path}: offsets of clocks are found where a recording is processed, and workers do not hear of "
            'them; process it without workers, or write what `offset_s = "find"` found into the manifest'
        )


def _elsewhere(recording: Recording | RecordingSource, *, follow_links: bool) -> OtherProcesses | None:
    """Return how others get at the recording, if they are to measure it."""
    if not is_elsewhere():
        return None
    from rfpose.pipeline.measure import OtherProcesses

    if isinstance(recording, Recording):
        raise InvalidInputError(
            "`recording` must be paths where others measure: workers open it themselves, by what it says of itself; "
            "what is to be told of raw samples goes into a manifest (recording.toml), whose path they can be given"
        )
    paths = (recording,) if isinstance(recording, str | Path) else recording
    return OtherProcesses(paths=tuple(map(Path, paths)), follow_links=follow_links)


def _choose_scenario(recording: Recording, given: Scenario | None) -> Scenario:
    embedded = recording.scenario
    if given is None:
        if embedded is None:
            raise ScenarioError(
                f"{recording.path}: holds no scenario; describe the site in TOML and give `scenario=FILE`"
            )
        return embedded
    if embedded is not None and embedded != given:
        _log.warning("%s: its scenario differs from the given one; the given one is used", recording.path)
    return given


def note_differing_receivers(recording: Recording, scenario: Scenario) -> None:
    """Tell of receivers that only the recording, or only the scenario has."""
    missing = [name for name in scenario.receiver_ids if name not in recording.receiver_ids]
    if missing:
        _log.warning("%s: lacks %s of the scenario; marked as not recorded", recording.path, _listed(missing))
    unknown = [name for name in recording.receiver_ids if name not in scenario.receiver_ids]
    if unknown:
        _log.warning("%s: has %s, which the scenario does not name; left out", recording.path, _listed(unknown))


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"receiver{'s' if len(names) > 1 else ''} {', '.join(names[:5])}{more}"


def _frames(recording: Recording, scenario: Scenario) -> npt.NDArray[np.int64]:
    n_sample = scenario.radio.frame_samples
    starts = frame_starts(recording, n_sample)
    if not len(starts):
        raise RecordingError(
            f"{recording.path}: no stretch as long as a frame of {n_sample} samples; shorten radio.frame_samples"
        )
    return starts
