"""The main job: a recording in, a result file out; resumable, and nothing half written."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfpose import __version__
from rfpose.errors import InvalidInputError, RecordingError, ScenarioError
from rfpose.files import claim
from rfpose.pipeline._journal import Journal
from rfpose.recording import Recording, check_against, frame_starts, note_doubts, open_recording
from rfpose.recording.members import members
from rfpose.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from rfpose.pipeline.choice import PoseChoice
    from rfpose.pipeline.result import Result

__all__ = ["process"]

_log = logging.getLogger(__name__)


def process(
    recording_path: str | Path,
    result_path: str | Path,
    *,
    scenario_path: str | Path | None = None,
    estimator: str = "hilbert",
    pose: str = "rigid",
    reflection: str | None = None,
    integrity: bool | None = None,
    filtered: bool | None = None,
    follow_links: bool = False,
    force: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
    resume: bool = True,
) -> Result:
    """Find receiver positions and mirror normals in a recording and write them to a file.

    Measured tone phases are kept in the directory ``RESULT.partial`` until the result is written. After an
    interruption the same call goes on from there and gives the same bytes as an undisturbed one.

    Parameters
    ----------
    recording_path
        Whatever `rfpose.recording.open_recording` opens.
    result_path
        File to write, format ``rfpose-result``.
    scenario_path
        Site description; wins over the one in the recording.
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
    follow_links
        As for `rfpose.recording.open_recording`.
    force
        Overwrite an existing result, and discard unfinished work of another job on the same result.
    on_progress
        Called with (rows done, rows in all); a row is one receiver in one frame.
    resume
        False: measure everything again even if unfinished work of the same job is there.

    Raises
    ------
    RecordingError
        A file that is missing, damaged, exists already, is both read and to be written, or cannot be written.
    ScenarioError
        No scenario, or one that disagrees with the recording or cannot be solved.
    GeometryError
        The site admits no solution, or an ambiguous one.
    InvalidInputError
        Unknown ``estimator``, ``pose`` or ``reflection``, or a choice that the pose cannot follow.
    """
    recording_path, result_path = Path(recording_path), Path(result_path)
    kept = result_path.with_name(f"{result_path.name}.partial")
    inputs = [recording_path, *members(recording_path), scenario_path, kept]
    with claim(result_path, inputs=inputs, force=force) as job:
        given = None if scenario_path is None else load_scenario(scenario_path)
        with open_recording(recording_path, follow_links=follow_links) as recording:
            scenario = _choose_scenario(recording, given)
            check_against(recording, scenario)
            starts = _frames(recording, scenario)
            # compiled code, which none of the refusals above should wait for
            from rfpose.dsp import ESTIMATORS
            from rfpose.pipeline.choice import choose
            from rfpose.pipeline.measure import journal_key, measure_tones
            from rfpose.pipeline.result_file import write_result
            from rfpose.pipeline.solve import check_solvable, solve
            from rfpose.pipeline.truth_rows import align_truth

            if estimator not in ESTIMATORS:
                raise InvalidInputError(f"`estimator` must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
            choice = choose(scenario, pose=pose, reflection=reflection, integrity=integrity, filtered=filtered)
            check_solvable(scenario, pose=pose, choice=choice)
            _note_differing_receivers(recording, scenario)
            note_doubts(recording)
            key = journal_key(recording, scenario, estimator)
            journal = Journal(kept, key, restart=force, resume=resume)
            tones = measure_tones(
                recording, scenario, starts, estimator=estimator, journal=journal, on_progress=on_progress
            )
            asked = {"reflection": reflection, "integrity": integrity, "filter": filtered}
            settings = _settings(
                recording, scenario, choice, estimator=estimator, asked=asked, scenario_path=scenario_path
            )
            truth = None if recording.truth is None else align_truth(recording.truth, scenario)
        result = solve(tones, scenario, settings=settings, truth=truth)
        write_result(result, result_path)
        job.afterwards(journal.remove)
        return result


def _choose_scenario(recording: Recording, given: Scenario | None) -> Scenario:
    embedded = recording.scenario
    if given is None:
        if embedded is None:
            raise ScenarioError(
                f"{recording.path}: holds no scenario; describe the site in TOML and give --scenario FILE"
            )
        return embedded
    if embedded is not None and embedded != given:
        _log.warning("%s: its scenario differs from the given one; the given one is used", recording.path)
    return given


def _note_differing_receivers(recording: Recording, scenario: Scenario) -> None:
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


def _settings(
    recording: Recording,
    scenario: Scenario,
    choice: PoseChoice,
    *,
    estimator: str,
    asked: Mapping[str, object],
    scenario_path: str | Path | None,
) -> dict[str, str]:
    """Return what the result depends on, without places and times: equal work gives equal bytes."""
    command = f"rfpose process {recording.path.name} --estimator {estimator} --pose {choice.pose}"
    if scenario_path is not None:
        command += f" --scenario {Path(scenario_path).name}"
    if asked["reflection"] is not None:
        command += f" --reflection {asked['reflection']}"
    if asked["integrity"] is not None:
        command += " --integrity" if asked["integrity"] else " --no-integrity"
    if asked["filter"] is not None:
        command += " --filter" if asked["filter"] else " --no-filter"
    from rfpose.pipeline.mirrors import mirror_groups

    learns = choice.pose == "rigid" and any(group.learns_delays for group in mirror_groups(scenario))
    return {
        "version": __version__,
        "command": command,
        "recording": recording.path.name,
        "recording_format": recording.format,
        "sample_rate": str(recording.sample_rate),
        "scenario_from": "recording" if scenario_path is None else "file",
        "estimator": estimator,
        **choice.as_settings(),
        "delays": "learned" if learns else "as the scenario says",
    }
