"""A recording that is being written, made into poses frame by frame."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np

from rfpose.dsp import TonePhases
from rfpose.dsp.calibration import CalibrationWindow
from rfpose.engine import is_elsewhere
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.files import claim
from rfpose.interruption import check
from rfpose.pipeline.choice import PoseChoice
from rfpose.pipeline.formats.choice_text import settings_of
from rfpose.pipeline.formats.journal import partial_of
from rfpose.pipeline.formats.live_result import LiveResult, probe_in
from rfpose.pipeline.formats.result import Result
from rfpose.pipeline.formats.result_file import write_result
from rfpose.pipeline.formats.survey_file import SurveyFile
from rfpose.pipeline.formats.truth_rows import align_truth
from rfpose.pipeline.measure import FrameByFrame
from rfpose.pipeline.process import Asked, note_differing_receivers
from rfpose.pipeline.rigid import RigidMemory
from rfpose.pipeline.solve import no_calibration, solve, solve_calibrated
from rfpose.recording import (
    GapError,
    Recording,
    frame_starts,
    note_doubts,
    open_recording,
    recorded_runs,
)
from rfpose.recording.segments import open_growing
from rfpose.scenario import Scenario
from rfpose.truth import Truth

__all__ = ["Follow", "follow_recording"]

_log = logging.getLogger(__name__)

_LOOK_S: Final = 0.01
"""Least time between two looks at what was recorded."""
_REMEMBERED: Final = 32
"""Frames that are solved again after a restart, so that filters know what they knew."""
_PROBE_SAMPLES: Final = 1024


@dataclass(frozen=True, slots=True)
class Follow:
    """A recording that is being written, and how it is followed.

    Attributes
    ----------
    path
        Of one recording: a Digital RF directory, or a directory of closed rfpose-iq files; it may appear later.
    idle_timeout_s
        The recording has ended when nothing came for so long [s]; None: only an interruption or ``until_s`` ends it.
    until_s
        Frames that begin then or later are left out, and the first such ends it [s since 1970 UTC]; None: no such time.
    lateness_s
        How long a complete frame of some receivers waits for the others, before it is solved without them [s].
    on_frame
        Called with each frame's result, one frame long.

    Raises
    ------
    InvalidInputError
        A time that is not greater than zero.
    """

    path: str | Path
    _: KW_ONLY
    idle_timeout_s: float | None = 60.0
    until_s: Fraction | None = None
    lateness_s: float = 1.0
    on_frame: Callable[[Result], None] | None = None

    def __post_init__(self) -> None:
        if self.idle_timeout_s is not None and not self.idle_timeout_s > 0.0:
            raise InvalidInputError(f"`idle_timeout_s` must be greater than zero, got {self.idle_timeout_s}")
        if not self.lateness_s >= 0.0:
            raise InvalidInputError(f"`lateness_s` must not be negative, got {self.lateness_s}")


def follow_recording(
    follow: Follow,
    output: str | Path | None,
    asked: Asked,
    *,
    follow_links: bool,
    force: bool,
) -> Result:
    """Solve each frame of a recording when it is complete; at the end all of them as `process` does.

    Parameters
    ----------
    follow
        The recording, when to end, and for whom to wait.
    output, follow_links, force
        As for `rfpose.process`; there must be an output.
    asked
        What is to be made of it.

    Raises
    ------
    RecordingError
        Nothing was recorded in time, what is there is damaged or another recording than before, or the output cannot
        be written.
    InvalidInputError
        No output, or others are to measure.
    ScenarioError, GeometryError
        As `rfpose.process`.
    """
    path = Path(follow.path)
    if output is None:
        raise InvalidInputError("what follows a recording keeps frames beside the result and needs `output`")
    if is_elsewhere():
        raise InvalidInputError("a recording that is followed is measured here, where frames arrive; leave workers out")
    kept = partial_of(output)
    with claim(output, inputs=[path, *asked.files, kept], force=force) as job, contextlib.ExitStack() as open_files:
        opened = open_files.enter_context(_wait_for(path, follow, follow_links=follow_links))
        site, surveyed = asked.site_of(opened)
        choice = asked.choice_for(site)
        note_differing_receivers(opened, site)
        note_doubts(opened)
        settings = asked.settings(opened, site, choice)
        grid = _Grid(opened, site, follow)
        full = settings | {"sample_rate": str(opened.sample_rate), **settings_of(choice)}
        probe = _probe(opened, site, grid, probe_in(kept))
        live = LiveResult(kept, site, full, probe=probe, restart=force)
        poses = _Poses(opened.sample_rate, site, choice, settings, surveyed)
        before = None
        if live.n_frame:
            before = live.tones(max(0, live.n_frame - _REMEMBERED))
            poses.remember(before)
            grid.go_on_after(int(before.frame_start_index[-1]))
        measure = open_files.enter_context(FrameByFrame(opened, site, estimator=asked.estimator, before=before))
        for start in grid.frames(between=live.tidy):
            result = poses.of_frame(measure.measure(start))
            live.append(result)
            if follow.on_frame is not None:
                follow.on_frame(result)
            opened.forget(start)
        tones = live.tones()
        truth = _truth(path, opened, tones, site, follow_links=follow_links)
        complete = poses.of_all(tones, truth)
        write_result(complete, output)
        job.afterwards(live.remove)
        return complete


def _wait_for(path: Path, follow: Follow, *, follow_links: bool) -> Recording:
    """Open the recording as soon as there is something."""
    since = time.monotonic()
    while True:
        check()
        found = open_growing(path, follow_links=follow_links)
        if found is not None:
            return found
        if follow.idle_timeout_s is not None and time.monotonic() - since > follow.idle_timeout_s:
            raise RecordingError(
                f"{path}: nothing was recorded there within {follow.idle_timeout_s:g} s; check the path and the "
                "recorder, or wait longer, `idle_timeout_s=SECONDS`"
            )
        time.sleep(10 * _LOOK_S)


def _probe(recording: Recording, site: Scenario, grid: _Grid, told: str | None) -> str:
    """Return what tells the recording from others: its first frame, as far as it is still there.

    ``told`` is what was told of it before an interruption.
    """
    n_sample = site.radio.frame_samples
    with contextlib.suppress(ValueError, TypeError, KeyError):
        known = json.loads(told or "")
        found = _first_samples(recording, int(known["start"]), n_sample)
        if all(known["samples"].get(name, text) == text for name, text in found.items()):
            return str(told)
    start = grid.first()
    if start is None:
        raise RecordingError(
            f"{recording.path}: no stretch as long as a frame of {n_sample} samples came; shorten radio.frame_samples"
        )
    return json.dumps({"start": start, "samples": _first_samples(recording, start, n_sample)}, sort_keys=True)


def _first_samples(recording: Recording, start: int, n_sample: int) -> dict[str, str]:
    """Return a digest of how a frame begins, by receiver."""
    found = {}
    for name in recording.receiver_ids:
        begin = recording.frame_at(name, start, n_sample)
        if begin is not None:
            with contextlib.suppress(GapError):
                samples = recording.read(name, begin, min(_PROBE_SAMPLES, n_sample))
                found[name] = hashlib.sha256(samples.tobytes()).hexdigest()[:16]
    return found


def _truth(path: Path, opened: Recording, tones: TonePhases, site: Scenario, *, follow_links: bool) -> Truth | None:
    """Return the truth of a simulated recording, all of whose parts are there now."""
    if opened.truth is None:
        return None
    with open_recording(path, follow_links=follow_links) as whole:
        starts = frame_starts(whole, site.radio.frame_samples)
        if not np.array_equal(starts, tones.frame_start_index):
            _log.warning("%s: its frames would lie elsewhere, had all been there from the beginning", path)
        return None if whole.truth is None else align_truth(whole.truth, site)


class _Poses:
    """Solves frames one by one, remembering what one tells the next; and all at once."""

    def __init__(
        self,
        sample_rate: Fraction,
        site: Scenario,
        choice: PoseChoice,
        settings: dict[str, str],
        surveyed: SurveyFile | None,
    ) -> None:
        self._rate, self._site, self._choice, self._settings = sample_rate, site, choice, settings
        self._surveyed = surveyed
        self._memory = RigidMemory()
        self._window = CalibrationWindow(site, _REMEMBERED) if site.is_calibrated else None

    def of_frame(self, tones: TonePhases) -> Result:
        """Return the result of one frame, the next."""
        tones = tones if self._surveyed is None else self._surveyed.without_delays(tones, self._site)
        result = solve_calibrated(
            tones,
            no_calibration(tones) if self._window is None else self._window.add(tones),
            self._site,
            self._choice,
            sample_rate=self._rate,
            settings=self._settings,
            memory=self._memory,
        )
        return result if self._surveyed is None else self._surveyed.widened(result)

    def remember(self, tones: TonePhases) -> None:
        """Take in frames that were solved before an interruption."""
        for i in range(len(tones.frame_start_index)):
            self.of_frame(_frame(tones, i))

    def of_all(self, tones: TonePhases, truth: Truth | None) -> Result:
        """Return the result of all frames together."""
        tones = tones if self._surveyed is None else self._surveyed.without_delays(tones, self._site)
        result = solve(tones, self._site, self._choice, sample_rate=self._rate, settings=self._settings, truth=truth)
        return result if self._surveyed is None else self._surveyed.widened(result)


def _frame(tones: TonePhases, i: int) -> TonePhases:
    axes = {"receiver_ids", "transmitter_ids", "tone_hz"}
    return TonePhases(
        **{
            name: getattr(tones, name) if name in axes else getattr(tones, name)[i : i + 1]
            for name in TonePhases.__dataclass_fields__
        }
    )


class _Grid:
    """Finds the next frame, and when it is complete.

    Frames lie as `rfpose.recording.frame_starts` lays them over what is there when the first of a stretch is complete.
    """

    def __init__(self, recording: Recording, site: Scenario, follow: Follow) -> None:
        self._recording, self._follow = recording, follow
        self._n_sample = site.radio.frame_samples
        self._wanted = set(site.receiver_ids)
        self._position: int | None = None
        """Where the last frame ended."""
        self._waiting: tuple[int, float] | None = None
        """A frame that is complete but for receivers that lag, and since when."""
        self._absent: set[str] = set()
        """Receivers that lagged too long, for which nobody waits until they are back."""

    def go_on_after(self, start: int) -> None:
        """Begin after a frame that was solved already."""
        self._position = start + self._n_sample
        self._recording.forget(self._position - self._n_sample)

    def first(self) -> int | None:
        """Return where the first frame begins, once it is complete; None: it never was."""
        return next(self.frames(), None)

    def frames(self, between: Callable[[], None] = lambda: None) -> Iterator[int]:
        """Yield the first sample of each frame as it is complete, until the recording has ended.

        Parameters
        ----------
        between
            Called while nothing is to be done.
        """
        news_at, known = time.monotonic(), self._recording.reached()
        until = None if self._follow.until_s is None else self._follow.until_s * self._recording.sample_rate
        while True:
            start = self._next()
            if start is not None:
                if until is not None and start >= until:
                    return
                yield start
                self._position = start + self._n_sample
                news_at = time.monotonic()
                continue
            if not self._recording.grows and self._waiting is None:
                return
            if not self._wait_for_news(known, news_at, between):
                return
            reached = self._recording.reached()
            if reached != known:
                news_at, known = time.monotonic(), reached

    def _wait_for_news(self, known: dict[str, int], since: float, between: Callable[[], None]) -> bool:
        """Wait until more was recorded, or a receiver may not be waited for any more; False: nothing came in time."""
        while True:
            check()
            between()
            looked_at = time.monotonic()
            self._recording.refresh()
            now = time.monotonic()
            if self._recording.reached() != known:
                return True
            if self._follow.idle_timeout_s is not None and now - since > self._follow.idle_timeout_s:
                return False
            # a recording of many channels takes long to look at, and the recorder needs the disk too
            time.sleep(max(_LOOK_S, 2.0 * (now - looked_at)))
            if self._waiting is not None:
                return True

    def _next(self) -> int | None:
        """Return the next frame if it is complete."""
        runs = recorded_runs(self._recording)
        for run, count in runs.tolist():
            end = run + count
            if self._position is not None and end - self._position < self._n_sample:
                continue
            if self._position is not None and run <= self._position:
                start = self._position
            else:
                starts = frame_starts(self._recording, self._n_sample)
                starts = starts[(starts >= run) & (starts < end)]
                if not len(starts):
                    continue
                start = int(starts[0])
            return start if self._is_ready(start) else None
        self._waiting = None
        return None

    def _is_ready(self, start: int) -> bool:
        """Tell whether all receivers have recorded a frame, or are not waited for any more."""
        reached = self._recording.reached()
        lagging = {
            name for name in reached if name in self._wanted and not self._has_passed(name, start, reached[name])
        }
        self._absent &= lagging
        lagging -= self._absent
        if not lagging:
            self._waiting = None
            return True
        now = time.monotonic()
        if self._waiting is None or self._waiting[0] != start:
            self._waiting = start, now
        if now - self._waiting[1] < self._follow.lateness_s:
            return False
        self._absent |= lagging
        self._waiting = None
        names = sorted(lagging)
        more = f" and {len(names) - 5} more" if len(names) > 5 else ""
        _log.warning(
            "%s: frame at sample %d: %s%s lag by more than %g s; solved without, until they are back",
            self._recording.path, start, ", ".join(names[:5]), more, self._follow.lateness_s,
        )  # fmt: skip
        return True

    def _has_passed(self, name: str, start: int, reached: int) -> bool:
        if self._recording.covers(name, start, self._n_sample):
            return True
        # it may have a frame of its own a little later, see `Recording.frame_at`
        return reached >= start + self._n_sample + self._n_sample // 4
