"""Frames of recordings of one site, as what carriers tell in them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError, RecordingError, ScenarioError
from rfpose.pipeline.clocks import settle_clocks
from rfpose.pipeline.measure import measure_tones
from rfpose.pipeline.postures import commanded_normals
from rfpose.pipeline.site.poses import check_site_solvable
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

__all__ = ["Frames", "Recordings", "commanded_in", "frames_of", "inputs_of", "listed", "measured_frames"]

Recordings = Recording | str | Path | Sequence[Recording | RecordingSource]
"""One, or several of one site; see `listed`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """What one recording tells.

    Attributes
    ----------
    carrier, sigma : (frame, receiver axis, transmitter)
        As `rfpose.dsp.TonePhases` has them.
    unix_s : (frame,)
        Their middle [s since 1970 UTC]; NaN: unknown.
    simulated
        Whether it was simulated: then mirrors follow the simulated sun, not that of the time.
    """

    carrier: npt.NDArray[np.complex128]
    sigma: FloatArray
    unix_s: FloatArray
    simulated: bool = False


def listed(recordings: Recordings, *, follow_links: bool = False) -> list[Recording | RecordingSource]:
    """Return recordings of which each stands by itself.

    One may be a directory or a manifest of parts, or a list of them. Paths that hold the same receivers are recordings
    by themselves; where some hold others, all are parts of one, as for `rfpose.process`.

    Raises
    ------
    InvalidInputError
        None at all.
    """
    alone = isinstance(recordings, Recording | str | Path)
    many: list[Recording | RecordingSource] = [recordings] if alone else list(recordings)  # type: ignore[list-item, arg-type]
    if not many:
        raise InvalidInputError("`recordings` must name one recording or more")
    paths = [one for one in many if isinstance(one, str | Path)]
    if len(paths) == len(many) > 1 and len(set(_receivers(paths, follow_links=follow_links))) > 1:
        return [paths]
    return many


def _receivers(paths: Sequence[str | Path], *, follow_links: bool) -> Iterator[frozenset[str]]:
    """Yield who is in each recording; one that cannot be read is for its reader to tell."""
    for path in paths:
        with contextlib.suppress(RecordingError, ScenarioError), open_recording(path, follow_links=follow_links) as one:
            yield frozenset(one.receiver_ids)


def inputs_of(recordings: Sequence[Recording | RecordingSource]) -> list[Path]:
    """Return the files that recordings are read from."""
    return [file for one in recordings for file in (one.files() if isinstance(one, Recording) else files_of(one))]


def frames_of(
    recordings: Sequence[Recording | RecordingSource], scenario: Scenario | str | Path | None, *, follow_links: bool
) -> tuple[list[Frames], Scenario]:
    """Measure the carriers of recordings of one site: that given, or the first recording's own.

    Parameters
    ----------
    recordings, scenario, follow_links
        As `measured_frames`, for each recording.

    Raises
    ------
    RecordingError, ScenarioError
        As `measured_frames`.
    """
    site = None if scenario is None else scenario_of(scenario)
    parts = []
    for recording in recordings:
        part, site = measured_frames(recording, site, follow_links=follow_links)
        parts.append(part)
    assert site is not None  # there is a recording, and it was refused without one
    return parts, site


def measured_frames(
    recording: Recording | RecordingSource, site: Scenario | None, *, follow_links: bool
) -> tuple[Frames, Scenario]:
    """Measure the carriers of a recording.

    Parameters
    ----------
    recording
    site
        None: the recording's own.
    follow_links
        See `rfpose.recording.open_recording`.

    Returns
    -------
    Frames
    Scenario
        The site.

    Raises
    ------
    RecordingError
        It is missing or damaged.
    ScenarioError
        No scenario, or one that pose ``site`` cannot solve.
    """
    opened: contextlib.AbstractContextManager[Recording] = (
        contextlib.nullcontext(recording)
        if isinstance(recording, Recording)
        else open_recording(recording, follow_links=follow_links)
    )
    with contextlib.ExitStack() as stack:
        one = stack.enter_context(opened)
        chosen = one.scenario if site is None else site
        if chosen is None:
            raise ScenarioError(f"{one.path}: holds no scenario; describe the site in TOML and give `scenario=FILE`")
        check_against(one, chosen)
        check_site_solvable(chosen)
        if isinstance(one, PartsRecording):
            one = settle_clocks(one, chosen)
            stack.callback(one.close)
        note_doubts(one)
        starts = frame_starts(one, chosen.radio.frame_samples)
        if not len(starts):
            raise ScenarioError(f"{one.path}: no stretch as long as a frame; shorten radio.frame_samples")
        tones = measure_tones(one, chosen, starts, estimator="hilbert")
        half = Fraction(chosen.radio.frame_samples, 2)
        middle = np.array([float((int(s) + half) / one.sample_rate) for s in starts])
        frames = Frames(
            carrier=tones.carrier, sigma=tones.carrier_sigma, unix_s=middle, simulated=one.truth is not None
        )
        return frames, chosen


def commanded_in(parts: list[Frames], site: Scenario) -> FloatArray:
    """Return where mirrors were told to point in all frames (frame, mirror, xyz).

    Raises
    ------
    ScenarioError
        No heliostat is known to have been told anything.
    """
    commanded = np.concatenate([commanded_normals(site, part.unix_s, simulated=part.simulated) for part in parts])
    if np.isnan(commanded[:, : len(site.heliostat)]).all():
        raise ScenarioError(
            f"scenario `{site.name}` says of no mirror where it was told to point; give [posture] csv, or `normal_enu`"
        )
    return commanded
