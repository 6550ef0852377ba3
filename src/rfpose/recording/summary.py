"""Whether a recording is sound, and whether it fits a scenario."""

from __future__ import annotations

import logging
import math
from fractions import Fraction
from typing import Any

import numpy as np

from rfpose.errors import InvalidInputError, RecordingError, ScenarioError
from rfpose.recording.base import IndexArray, Recording, count_fill, frame_starts, own_frames, recorded_runs
from rfpose.recording.parts import coverage
from rfpose.recording.stamps import stamp_text
from rfpose.scenario import Scenario

__all__ = ["check_against", "describe", "note_doubts"]

_log = logging.getLogger(__name__)

_SAMPLES_LOOKED_AT = 2**20
"""A receiver, at most, in `_PIECES` pieces spread over what it recorded."""
_PIECES = 16
_RUN_PER_EDGE = 4
"""A receiver that began or ended within this part of a stretch beside the others did not lose samples there."""
_RATE_TOLERANCE = 1e-9
"""Relative; a scenario gives its rate as a decimal number."""
_CLIPPED_FRACTION = 1e-5
"""Of the I and Q values looked at. Below this the distortion lies under the noise of any 16-bit digitiser, and
a peak that just touches full scale is no fault."""


def check_against(recording: Recording, scenario: Scenario) -> None:
    """Refuse a scenario that does not describe a recording.

    Raises
    ------
    ScenarioError
        Sample rate or centre frequency differ, or the recording has none of the scenario's receivers. The
        message names both values.
    """
    disagreements = _disagreements(recording, scenario)
    if disagreements:
        raise ScenarioError(f"{recording.path}: {disagreements[0]}; correct the scenario `{scenario.name}`")


def _disagreements(recording: Recording, scenario: Scenario) -> list[str]:
    found = []
    wanted_rate = scenario.radio.sample_rate
    if abs(recording.sample_rate - wanted_rate) > _RATE_TOLERANCE * wanted_rate:
        found.append(
            f"recorded at {float(recording.sample_rate):.12g} samples/s, but the scenario says "
            f"`radio.sample_rate_hz` = {scenario.radio.sample_rate_hz:.12g}"
        )
    found += _untuned(recording, scenario)
    if not set(recording.receiver_ids) & set(scenario.receiver_ids):
        found.append(
            f"holds receivers {_some(recording.receiver_ids)}, but the scenario names {_some(scenario.receiver_ids)}: "
            "none in common"
        )
    return found


def _untuned(recording: Recording, scenario: Scenario) -> list[str]:
    """Tell what tunings do not fit: none is as told, those of a mirror differ, a line is outside a band."""
    wanted = scenario.radio.centre_frequency_hz
    others = {}
    for name in recording.receiver_ids:
        tuned = recording.tuning_of(name)
        if tuned is not None and abs(tuned - wanted) > max(1e-3, _RATE_TOLERANCE * abs(wanted)):
            others[name] = tuned
    if not others:
        return []
    said = f"but the scenario says `radio.centre_frequency_hz` = {wanted:.12g}"
    if len(others) == len(recording.receiver_ids):
        return [f"tuned to {next(iter(others.values())):.12g} Hz, {said}"]
    for mirror in scenario.heliostat:
        there = [name for name in mirror.receiver_ids if name in recording.receiver_ids]
        recorded = {name: tuned for name in there if (tuned := recording.tuning_of(name)) is not None}
        if len(set(recorded.values())) > 1:
            shown = ", ".join(f"`{name}` {tuned:.12g} Hz" for name, tuned in recorded.items())
            return [
                f"the receivers of heliostat `{mirror.id}` are tuned apart ({shown}), and their carriers can be "
                "compared only from one oscillator"
            ]
    half = float(recording.sample_rate) / 2.0
    for name, tuned in others.items():
        line_hz = wanted + np.ravel(scenario.line_hz)
        furthest = float(line_hz[np.argmax(np.abs(line_hz - tuned))])
        if abs(furthest - tuned) >= half:
            return [
                f"receiver `{name}` is tuned to {tuned:.12g} Hz, {said}, and the line at {furthest:.12g} Hz lies "
                f"outside its band of {half:.12g} Hz to each side"
            ]
    return []


def note_doubts(recording: Recording) -> None:
    """Log what a recording says of itself that cannot be right, or does not say and should; one line each."""
    problems = _Problems()
    problems.of_doubts(recording)
    for line in problems.lines():
        _log.warning("%s: %s", recording.path, line)


def describe(recording: Recording) -> dict[str, Any]:
    """Summarise a recording and judge whether it is sound.

    At most 2**20 samples a receiver are looked at, so that it takes seconds whatever the size.

    Returns
    -------
    dict
        Ready for JSON: numbers, text, lists, None; no NaN or infinity. ``sound`` is true when ``problems``,
        a list of one-line texts, is empty. Levels are relative to full scale [dB], None where there is none.
        ``parts``, of a recording of many, says who covers what; see `rfpose.recording.parts.coverage`.
        ``lost_samples`` are those that a receiver missed while others recorded; a pause of all is none.
    """
    problems = _Problems()
    readable = []
    for receiver_id in recording.receiver_ids:
        try:
            recording.blocks(receiver_id)
            readable.append(receiver_id)
        except RecordingError as error:
            problems.of(receiver_id, str(error))
    all_readable = len(readable) == len(recording.receiver_ids)
    runs = recorded_runs(recording, readable)
    starts = None
    if recording.scenario is not None and all_readable:
        starts = frame_starts(recording, recording.scenario.radio.frame_samples)
    receivers: dict[str, dict[str, Any]] = {}
    for receiver_id in recording.receiver_ids:
        receivers[receiver_id] = {"readable": False}
        try:
            if receiver_id in readable:
                receivers[receiver_id] = _describe_receiver(recording, receiver_id, runs, starts, problems)
        except RecordingError as error:
            problems.of(receiver_id, str(error))
    problems.of_doubts(recording)
    scenario = recording.scenario
    summary: dict[str, Any] = {
        "path": str(recording.path),
        "format": recording.format,
        "sample_rate_hz": float(recording.sample_rate),
        "sample_rate_exact": str(recording.sample_rate),
        "centre_frequency_hz": recording.centre_frequency_hz,
        "sample_format": recording.sample_format,
        "full_scale": recording.full_scale if math.isfinite(recording.full_scale) else None,
        "receivers": receivers,
        "scenario": None if scenario is None else scenario.name,
        "has_truth": recording.truth is not None,
        "provenance": recording.provenance,
    }
    summary |= _describe_time(recording, runs, starts, problems, all_readable=all_readable)
    if recording.format == "parts":
        summary["parts"] = coverage(recording)
    found = problems.lines()
    if scenario is not None:
        found += _disagreements(recording, scenario)
        missing = [name for name in scenario.receiver_ids if name not in recording.receiver_ids]
        if missing:
            number = (
                "1 receiver of the scenario is"
                if len(missing) == 1
                else f"{len(missing)} receivers of the scenario are"
            )
            found.append(f"{number} not in the recording: {_some(missing)}")
        summary["receivers_not_in_scenario"] = [
            name for name in recording.receiver_ids if name not in scenario.receiver_ids
        ]
    summary["problems"] = found
    summary["sound"] = not found
    return summary


class _Problems:
    """Collects problems; what several receivers share is one line."""

    def __init__(self) -> None:
        self._receivers: dict[str, list[str]] = {}

    def of(self, receiver_id: str, text: str) -> None:
        """Add a problem of one receiver."""
        self._receivers.setdefault(text, []).append(receiver_id)

    def of_doubts(self, recording: Recording) -> None:
        """Add what a recording itself doubts."""
        for note in recording.notes:
            self.add(note)
        for receiver_id, doubts in recording.doubts.items():
            for doubt in doubts:
                self.of(receiver_id, doubt)

    def add(self, text: str) -> None:
        """Add a problem of the whole recording."""
        self._receivers.setdefault(text, [])

    def lines(self) -> list[str]:
        """Return one line a problem."""
        return [
            text
            if not names
            else f"{names[0] if len(names) == 1 else f'{len(names)} receivers ({_some(names)})'}: {text}"
            for text, names in self._receivers.items()
        ]


def _describe_time(
    recording: Recording, runs: IndexArray, starts: IndexArray | None, problems: _Problems, *, all_readable: bool
) -> dict[str, Any]:
    about: dict[str, Any] = dict.fromkeys(
        ("start_index", "start_unix_s", "start_utc", "end_utc", "span_s", "recorded_s", "stretches", "frames")
    )
    if not all_readable:
        return about
    if len(runs) == 0:
        problems.add("no samples were recorded")
        return about | {"span_s": 0.0, "recorded_s": 0.0, "stretches": 0, "frames": 0}
    rate, first, end = recording.sample_rate, int(runs[0, 0]), int(runs[-1].sum())
    about |= {
        "span_s": float((end - first) / rate),
        "recorded_s": float(int(runs[:, 1].sum()) / rate),
        "stretches": len(runs),
        "frames": None if starts is None else len(starts),
    }
    if recording.time_known:
        about |= {
            "start_index": first,
            "start_unix_s": float(first / rate),
            "start_utc": _utc(first, rate),
            "end_utc": _utc(end, rate),
        }
    if starts is not None and len(starts) == 0 and recording.scenario is not None:
        problems.add(f"no stretch is as long as a frame of {recording.scenario.radio.frame_samples} samples")
    return about


def _utc(index: int, rate: Fraction) -> str | None:
    """Return a sample's time to the nanosecond, None beyond the calendar."""
    try:
        return f"{stamp_text(index, rate)[:-4]}Z"
    except InvalidInputError:
        return None


def _lost(blocks: IndexArray, runs: IndexArray) -> int:
    """Count the samples that a receiver missed while others recorded.

    That it started or stopped a little beside the others in a stretch is no loss. A receiver alone has nobody who
    recorded meanwhile, so its own gaps are losses.
    """
    if len(blocks) == 0:
        return int(runs[:, 1].sum())
    gap = blocks[1:, 0] - blocks[:-1].sum(axis=1)
    i_run = np.searchsorted(runs[:, 0], blocks[:, 0], side="right") - 1
    lost = int(gap[i_run[1:] == i_run[:-1]].sum())
    present, first = np.unique(i_run, return_index=True)
    last = np.append(first[1:], len(blocks)) - 1
    missed = np.setdiff1d(np.arange(len(runs)), present)
    lost += int(runs[missed, 1].sum())
    for edge in (blocks[first, 0] - runs[present, 0], runs[present].sum(axis=1) - blocks[last].sum(axis=1)):
        lost += int(edge[edge > runs[present, 1] // _RUN_PER_EDGE].sum())
    return lost


def _describe_receiver(
    recording: Recording, receiver_id: str, runs: IndexArray, starts: IndexArray | None, problems: _Problems
) -> dict[str, Any]:
    blocks = recording.blocks(receiver_id)
    n_recorded = int(blocks[:, 1].sum())
    entry: dict[str, Any] = {"readable": True, "samples": n_recorded, "blocks": len(blocks)}
    if len(recording.receiver_ids) == 1:
        entry["lost_samples"] = int(blocks[-1].sum() - blocks[0, 0]) - n_recorded if len(blocks) else 0
    else:
        entry["lost_samples"] = _lost(blocks, runs)
    if recording.scenario is not None and starts is not None:
        entry["frames"] = _count_frames(blocks, starts, recording.scenario.radio.frame_samples, receiver_id, problems)
    if n_recorded == 0:
        problems.of(receiver_id, "no samples")
        return entry
    sample = _look_at(recording, receiver_id)
    n_fill = count_fill(sample)
    full_scale = recording.full_scale
    is_float = sample.dtype.kind == "f"
    with np.errstate(invalid="ignore", over="ignore"):  # what is no number is counted, not warned of
        values = sample.astype(np.float64).ravel()
    finite = values[np.isfinite(values)] if is_float else values
    peak = max(float(finite.max()), -float(finite.min())) if finite.size else 0.0
    rms = math.sqrt(np.einsum("i,i", finite, finite) / finite.size) if finite.size else 0.0
    clipped = float(np.mean(np.abs(finite) >= full_scale)) if peak >= full_scale else 0.0
    entry |= {
        "looked_at": len(sample),
        "rms": rms,
        "peak": peak,
        "rms_dbfs": 20.0 * math.log10(rms / full_scale) if rms > 0.0 and math.isfinite(full_scale) else None,
        "clipped_fraction": clipped,
        "fill_samples": n_fill,
        "non_finite_values": values.size - finite.size - (2 * n_fill if is_float else 0),
    }
    if n_fill:
        problems.of(receiver_id, f"{n_fill} of {len(sample)} samples looked at hold the fill value: lost samples")
    if entry["non_finite_values"]:
        problems.of(receiver_id, f"{entry['non_finite_values']} of {values.size} values looked at are NaN or Inf")
    if rms == 0.0:
        problems.of(receiver_id, "all samples looked at are zero: is the receiver connected?")
    if clipped > _CLIPPED_FRACTION:
        problems.of(receiver_id, f"{100.0 * clipped:.3g} % of the values looked at are clipped: reduce the gain")
    return entry


def _count_frames(
    blocks: IndexArray, starts: IndexArray, frame_samples: int, receiver_id: str, problems: _Problems
) -> int:
    """Count a receiver's frames; one that has enough samples, but beside the others', is a problem."""
    n_frame = int(np.count_nonzero(own_frames(blocks, starts, frame_samples) >= 0))
    possible = int((blocks[:, 1] // frame_samples).sum())
    if possible > 2 * n_frame:
        problems.of(
            receiver_id,
            f"recorded {possible} frames of {frame_samples} samples, but lies so far beside the others that {n_frame} "
            "of them are in common; set the receivers' starts closer together, or shorten `radio.frame_samples`",
        )
    return n_frame


def _look_at(recording: Recording, receiver_id: str) -> np.ndarray[Any, Any]:
    """Return (sample, 2) in pieces spread evenly over what a receiver recorded."""
    blocks = recording.blocks(receiver_id)
    ends = np.cumsum(blocks[:, 1])
    n_recorded = int(ends[-1])
    n_piece = 1 if n_recorded <= _SAMPLES_LOOKED_AT else _PIECES
    length = min(n_recorded, _SAMPLES_LOOKED_AT) // n_piece
    pieces = []
    for position in np.linspace(0, n_recorded - length, n_piece).astype(np.int64):
        wanted, at = length, int(position)  # `at` counts recorded samples only; a piece may run across gaps
        while wanted:
            i = int(np.searchsorted(ends, at, side="right"))
            take = min(wanted, int(ends[i]) - at)
            start = int(blocks[i].sum()) - (int(ends[i]) - at)
            pieces.append(recording.read(receiver_id, start, take))
            wanted, at = wanted - take, at + take
    return np.concatenate(pieces)


def _some(names: tuple[str, ...] | list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
