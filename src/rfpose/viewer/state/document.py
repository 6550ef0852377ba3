"""What was opened: a recording, a result, a scenario or a tracking run, ready to draw."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from rfpose.errors import RfposeError
from rfpose.kinds import is_live, kind_of
from rfpose.pipeline.formats.journal import partial_of
from rfpose.pipeline.formats.live_result import n_frame_in, open_live
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import is_result, open_result
from rfpose.pipeline.formats.track_file import is_track, open_track
from rfpose.pipeline.pictures.field_view import FieldPicture, field_of_result, field_of_scenario
from rfpose.pipeline.pictures.spectra import SharedRecording, viewing_frames
from rfpose.pipeline.pictures.track_view import TrackPicture, picture_of_track, site_of_run
from rfpose.recording import Recording, open_recording
from rfpose.scenario import Scenario, load_scenario

__all__ = ["NEWEST_FRAMES", "Document", "Followed", "Kind", "open_document"]

NEWEST_FRAMES = 500
"""Of a result that is being made, so many are shown."""

Kind = Literal["recording", "result", "scenario", "track"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """An open file and what belongs to it.

    Attributes
    ----------
    path, kind
        What was opened.
    scenario, field
        The site; None for a recording that brings none.
    recording, frame_start_index, frame_samples
        Open recording with its frames; None and empty where there is none.
    result
        For a result.
    track
        For a tracking run.
    notes
        What the user should know, one line each.
    """

    path: Path
    kind: Kind
    scenario: Scenario | None = None
    field: FieldPicture | None = None
    recording: Recording | None = None
    frame_start_index: npt.NDArray[np.int64]
    frame_samples: int = 0
    result: Result | None = None
    track: TrackPicture | None = None
    notes: tuple[str, ...] = ()

    @property
    def n_frame(self) -> int:
        """Frames of the result, else of the recording."""
        return len(self.result.frame_start_index) if self.result is not None else len(self.frame_start_index)

    @property
    def receiver_ids(self) -> tuple[str, ...]:
        """Receivers of the recording, else those measured."""
        if self.recording is not None:
            return self.recording.receiver_ids
        return self.scenario.receiver_ids if self.result is not None and self.scenario is not None else ()

    def close(self) -> None:
        """Let go of the recording's files."""
        if self.recording is not None:
            self.recording.close()


class Followed:
    """A result that is being made: where it can be read now, and whether there is more than at the last look.

    Attributes
    ----------
    shown
        What to open.
    complete
        It is no longer being made.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._partial = self._path if is_live(self._path) else partial_of(self._path)
        self._seen: tuple[str, int] | None = None
        self.shown = self._path
        self.complete = False

    def has_changed(self) -> bool:
        """Look; true once for each change."""
        n_frame = n_frame_in(self._partial)
        self.complete = not self._partial.exists() and self._path.is_file()
        if not n_frame and not self.complete:
            return False
        self.shown = self._path if self.complete else self._partial
        seen = (str(self.shown), n_frame)
        changed, self._seen = seen != self._seen, seen
        return changed


def open_document(path: str | Path, *, scenario_path: str | Path | None = None, follow_links: bool = False) -> Document:
    """Open whatever of ours a path holds.

    Parameters
    ----------
    path
        A scenario (.toml), a result, also one that is being made (``RESULT.partial``), a tracking run, or a
        recording in any format.
    scenario_path
        Site of a recording that brings none; wins over its own.
    follow_links
        As for `rfpose.recording.open_recording`.

    Raises
    ------
    RfposeError
        Missing, damaged, or none of these; the message names the file, the place and the remedy.
    """
    path = Path(path)
    if path.suffix == ".toml" and kind_of(path) != "recording":
        scenario = load_scenario(path)
        return Document(
            path=path, kind="scenario", scenario=scenario, field=field_of_scenario(scenario), frame_start_index=_none()
        )
    if path.is_file() and is_result(path):
        return _result(path)
    if is_live(path):
        return _growing(path)
    if path.is_file() and is_track(path):
        track = open_track(path)
        site = site_of_run(track)
        return Document(
            path=path,
            kind="track",
            scenario=site,
            field=field_of_scenario(site),
            track=picture_of_track(track),
            frame_start_index=_none(),
        )
    given = None if scenario_path is None else load_scenario(scenario_path)
    return _recording(SharedRecording(open_recording(path, scenario=given, follow_links=follow_links)))


def _none() -> npt.NDArray[np.int64]:
    return np.empty(0, np.int64)


def _recording(recording: Recording) -> Document:
    try:
        scenario = recording.scenario
        starts, n_sample = viewing_frames(recording, scenario)
        notes: tuple[str, ...] = ()
        if scenario is None:
            notes = (
                f"{recording.path.name} brings no scenario: carriers are not marked and phases not measured; "
                "use File, Scenario for this recording, or put scenario.toml beside it",
            )
        return Document(
            path=recording.path,
            kind="recording",
            scenario=scenario,
            field=None if scenario is None else field_of_scenario(scenario),
            recording=recording,
            frame_start_index=starts,
            frame_samples=n_sample,
            notes=notes,
        )
    except BaseException:
        recording.close()
        raise


def _growing(path: Path) -> Document:
    result = open_live(path, max(0, n_frame_in(path) - NEWEST_FRAMES))
    return Document(
        path=path,
        kind="result",
        scenario=result.scenario,
        field=field_of_result(result),
        frame_start_index=_none(),
        result=result,
    )


def _result(path: Path) -> Document:
    result = open_result(path)
    recording: Recording | None = None
    notes: tuple[str, ...] = ()
    starts, n_sample = _none(), 0
    name = result.settings.get("recording", "")
    beside = path.parent / name
    if name and beside.exists():
        try:
            recording = SharedRecording(open_recording(beside, scenario=result.scenario))
            starts, n_sample = viewing_frames(recording, result.scenario)
        except RfposeError as error:
            if recording is not None:
                recording.close()
            recording, notes = None, (f"the recording of this result cannot be shown: {error}",)
    else:
        notes = (
            f"the recording `{name}` is not beside {path.name}: spectra are not shown; put it into {path.parent} and "
            "open the result again",
        )
    return Document(
        path=path,
        kind="result",
        scenario=result.scenario,
        field=field_of_result(result),
        recording=recording,
        frame_start_index=starts,
        frame_samples=n_sample,
        result=result,
        notes=notes,
    )
