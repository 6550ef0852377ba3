"""Recorders whose clocks are seconds off: found by where parts lie in time, and by the transmitters' tones.

A clock that runs in GPS time or TAI, or that was set a second wrong, gives a part the wrong time. Transmitters have
oscillators of their own, whose tones wander against each other. Receivers hear the same wandering at the same time:
what one hears minus what another hears stays, but for the mirrors' motion, which is millimetres in hundreds of metres.
At a wrong time it does not. Where the tones do not wander measurably, only where parts lie can tell.
"""

from __future__ import annotations

import functools
import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import numpy as np

from rfpose.checks import FloatArray
from rfpose.errors import RecordingError
from rfpose.pipeline.measure import extractors
from rfpose.recording import GapError
from rfpose.recording.base import IndexArray, merge_rows
from rfpose.recording.parts import PartsRecording
from rfpose.scenario import Scenario

__all__ = ["LAGS_S", "settle_clocks"]

_log = logging.getLogger(__name__)

LAGS_S: Final[Mapping[int, str]] = {
    1: "a second",
    -1: "a second",
    18: "GPS time in place of UTC",
    -18: "UTC in place of GPS time",
    37: "TAI in place of UTC",
    -37: "UTC in place of TAI",
    19: "TAI in place of GPS time",
    -19: "GPS time in place of TAI",
}
"""How far a clock may be ahead [s], and what that would be."""

_FRAMES: Final = 6
"""Compared for each part, spread over it."""
_FEWEST: Final = 3
"""Frames, and tones, without which nothing can be told."""
_SIGMAS: Final = 5.0
_MOTION_RAD: Final = 2e-3
"""What mirrors that move do to the phase of a tone between frames: a decimetre of 400 m."""
_CLEARER: Final = 4.0
"""A lag is believed if it explains the phases so many times better than none."""
_BESIDE, _TOGETHER = 0.5, 0.9
"""Parts of which less than the first share lies where others recorded, and of which so much would."""


@dataclass(frozen=True, slots=True)
class _Spread:
    """How far phase differences scatter over frames [rad], and how far noise lets them."""

    rad: float
    noise_rad: float

    @property
    def fits(self) -> bool:
        return self.rad <= _SIGMAS * self.noise_rad + _MOTION_RAD


def settle_clocks(recording: PartsRecording, scenario: Scenario) -> PartsRecording:
    """Look for parts whose clocks are seconds off.

    Parameters
    ----------
    recording
        Open.
    scenario
        The site.

    Returns
    -------
    PartsRecording
        The same; or, where parts have ``offset_s = "find"`` in their manifest and it was found, another one with their
        clocks set right.

    Raises
    ------
    RecordingError
        A clock is off by one of `LAGS_S` by the tones' phases, and its offset is not to be found but taken as told. The
        message names part, offset and remedy.
    """
    blocks = {name: of_part for name, _, of_part in recording.parts()}
    if len(blocks) < 2:
        return recording
    comparison = _Comparison(recording, scenario)
    reference = _reference(recording, scenario)
    ahead_s: dict[str, int] = {}
    beside: dict[str, int] = {}
    for name, mine in blocks.items():
        if reference not in mine and mine:
            lag = comparison.ahead_s(mine, reference)
            if lag:
                ahead_s[name] = lag
            elif lag is None and (suspect := _beside(name, blocks, recording.sample_rate)):
                beside[name] = suspect
    others = sum(reference not in mine for mine in blocks.values())
    if ahead_s:
        lag, count = Counter(ahead_s.values()).most_common(1)[0]
        if 2 * count > others and others > 1:  # most agree with each other: it is the reference that is off
            ahead_s = {name: -lag for name, mine in blocks.items() if reference in mine} | {
                name: other - lag for name, other in ahead_s.items() if other != lag
            }
    found: dict[str, Fraction] = {}
    notes = []
    for name, lag in ahead_s.items():
        what = f"the clock of {name} is {_words(lag)}, by the phases of the tones"
        if name not in recording.sought:
            raise RecordingError(
                f"{recording.path}: {what}; say so in a manifest (recording.toml): `offset_s = {-lag}` for it, or "
                '`offset_s = "find"`'
            )
        found[name] = Fraction(-lag)
        notes.append(f"{what}, and is set right")
    for name, lag in beside.items():
        what = f"{name} lies beside the other parts in time, and would not if its clock were {_words(lag)}"
        if name in recording.sought:
            found[name] = Fraction(-lag)
            notes.append(f"{what}: it is taken to be")
        else:
            recording.notes.append(f"{what}; the tones cannot tell: if it is, give `offset_s = {-lag}` in a manifest")
    if not found:
        return recording
    recording.close()
    return recording.moved(found, notes)


def _words(lag: int) -> str:
    why = LAGS_S.get(lag)
    return f"{abs(lag)} s {'ahead' if lag > 0 else 'behind'}" + (f" ({why}?)" if why else "")


def _reference(recording: PartsRecording, scenario: Scenario) -> str:
    """Return the receiver that others are compared with: of those for calibration, then of all, who recorded most."""
    fixed = [receiver.id for receiver in scenario.calibration_receiver if receiver.id in recording.receiver_ids]
    return max(fixed or recording.receiver_ids, key=lambda name: int(recording.blocks(name)[:, 1].sum()))


def _beside(name: str, blocks: Mapping[str, Mapping[str, IndexArray]], rate: Fraction) -> int | None:
    """Return by how much a clock is ahead if that would bring a part to where others recorded; None: it is there."""
    rest = [rows for other, of_part in blocks.items() if other != name for rows in of_part.values()]
    if not rest:
        return None
    rows = np.concatenate(rest)
    runs = merge_rows(rows[np.argsort(rows[:, 0], kind="stable")])
    mine = np.concatenate(list(blocks[name].values()))
    if _shared(mine, runs) >= _BESIDE:
        return None
    shares = {lag: _shared(mine - np.array([round(lag * rate), 0]), runs) for lag in LAGS_S}
    best = max(shares, key=lambda lag: shares[lag])
    return best if shares[best] >= _TOGETHER else None


def _shared(rows: IndexArray, runs: IndexArray) -> float:
    """Return which part of ``rows`` lies within ``runs``."""
    ends = runs.sum(axis=1)
    reached = np.concatenate([[0], np.cumsum(runs[:, 1])])

    def recorded_before(index: IndexArray) -> IndexArray:
        i = np.searchsorted(ends, index)
        within = np.zeros(len(index), np.int64)
        inside = i < len(runs)
        within[inside] = np.maximum(0, index[inside] - runs[i[inside], 0])
        total: IndexArray = reached[i] + within
        return total

    shared = recorded_before(rows.sum(axis=1)) - recorded_before(rows[:, 0])
    return float(shared.sum() / max(1, rows[:, 1].sum()))


class _Comparison:
    """Compares what receivers hear of the transmitters, at lags."""

    def __init__(self, recording: PartsRecording, scenario: Scenario) -> None:
        self._recording = recording
        self._n_sample = scenario.radio.frame_samples
        self._extractor_of = extractors(recording, scenario)
        self._heard: dict[tuple[str, int], tuple[FloatArray, FloatArray] | None] = {}
        self._known = set(scenario.receiver_ids)
        self._wanders = functools.cache(self._changes_enough)

    def ahead_s(self, blocks: Mapping[str, IndexArray], reference: str) -> int | None:
        """Return by how many seconds a part's clock is ahead; 0: it is right; None: the tones cannot tell."""
        name = next((name for name in blocks if name in self._known and len(blocks[name])), None)
        if name is None or reference not in self._known:
            return None
        now = self._spread(name, reference, 0)
        if now is not None and now.fits and not self._wanders(reference):
            return None
        if now is not None and now.fits:
            return 0
        found = {lag: spread for lag in LAGS_S if (spread := self._spread(name, reference, lag)) is not None}
        good = {lag: spread for lag, spread in found.items() if spread.fits}
        if not good:
            return None
        best = min(good, key=lambda lag: good[lag].rad)
        if now is None:  # it lies beside: one lag must fit where others do not
            return best if len(found) > 1 and len(good) == 1 else None
        return best if now.rad > _CLEARER * good[best].rad else None

    def _changes_enough(self, reference: str) -> bool:
        """Whether the tones change enough for a wrong time to be seen."""
        own = (self._spread(reference, reference, lag) for lag in LAGS_S if lag > 0)
        return any(spread is not None and not spread.fits for spread in own)

    def _spread(self, name: str, reference: str, lag_s: int) -> _Spread | None:
        """Return how far what two receivers hear differs over frames; None: too few frames in common."""
        shift = round(lag_s * self._recording.sample_rate)
        pairs = []
        for start in self._common(name, reference, shift):
            mine, theirs = self._phases(name, start + shift), self._phases(reference, start)
            if mine is not None and theirs is not None:
                pairs.append((mine, theirs))
        if len(pairs) < _FEWEST:
            return None
        difference = np.stack([mine[0] - theirs[0] for mine, theirs in pairs])
        noise = np.stack([np.hypot(mine[1], theirs[1]) for mine, theirs in pairs])
        heard = np.isfinite(difference).all(axis=0)
        if np.count_nonzero(heard) < _FEWEST:
            return None
        difference, noise = difference[:, heard], noise[:, heard]
        # what moves all transmitters alike is the receiver's, not theirs
        turned = np.exp(1j * difference)
        turned *= np.exp(-1j * np.angle(np.mean(turned, axis=1, keepdims=True)))
        middle = np.mean(turned, axis=0, keepdims=True)
        away = np.angle(turned * np.conj(middle))
        return _Spread(float(np.sqrt(np.mean(away**2))), float(np.sqrt(np.mean(noise**2))))

    def _common(self, name: str, reference: str, shift: int) -> Sequence[int]:
        """Return starts of frames that the reference recorded, and the other a lag later."""
        n = self._n_sample
        starts: list[int] = []
        mine, theirs = self._recording.blocks(reference), self._recording.blocks(name) - np.array([shift, 0])
        mine_ends, their_ends = mine.sum(axis=1), theirs.sum(axis=1)
        first = np.searchsorted(their_ends, mine[:, 0], side="right")
        behind = np.searchsorted(theirs[:, 0], mine_ends, side="left")
        for k in np.flatnonzero(first < behind):
            for i in range(first[k], behind[k]):
                low, high = int(max(mine[k, 0], theirs[i, 0])), int(min(mine_ends[k], their_ends[i]))
                if high - low >= n:
                    starts += [low] if high - low < 2 * n else [low, (low + high - n) // 2, high - n]
        n_chosen = min(_FRAMES, len(starts))
        return [starts[round(k)] for k in np.linspace(0, len(starts) - 1, n_chosen).tolist()]

    def _phases(self, name: str, start: int) -> tuple[FloatArray, FloatArray] | None:
        """Return phases and their sigma of all tones in one frame, None where nothing was heard; kept for the next."""
        key = name, start
        if key not in self._heard:
            try:
                tones = self._extractor_of(name).measure(self._recording.read(name, start, self._n_sample))
            except GapError:
                tones = None
            heard = None if tones is None else (tones.phase_rad.ravel(), tones.sigma_rad.ravel())
            self._heard[key] = None if heard is None or np.isfinite(heard[0]).sum() < _FEWEST else heard
        return self._heard[key]
