"""Frames of recordings of one site, as what carriers tell in them."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.pipeline.measure import measure_tones
from rfpose.pipeline.postures import commanded_normals
from rfpose.pipeline.site.poses import check_site_solvable
from rfpose.recording import Recording, check_against, frame_starts, open_recording
from rfpose.scenario import Scenario, scenario_of

__all__ = ["Frames", "Recordings", "commanded_in", "frames_of", "listed", "measured_frames"]

Recordings = Recording | str | Path | Sequence[Recording | str | Path]
"""One, or several of one site."""


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


def listed(recordings: Recordings) -> list[Recording | str | Path]:
    """Return recordings of which one may stand by itself.

    Raises
    ------
    InvalidInputError
        None at all.
    """
    many = [recordings] if isinstance(recordings, Recording | str | Path) else list(recordings)
    if not many:
        raise InvalidInputError("`recordings` must name one recording or more")
    return many


def frames_of(
    recordings: Sequence[Recording | str | Path], scenario: Scenario | str | Path | None, *, follow_links: bool
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
    recording: Recording | str | Path, site: Scenario | None, *, follow_links: bool
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
    with opened as one:
        chosen = one.scenario if site is None else site
        if chosen is None:
            raise ScenarioError(f"{one.path}: holds no scenario; describe the site in TOML and give `scenario=FILE`")
        check_against(one, chosen)
        check_site_solvable(chosen)
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
