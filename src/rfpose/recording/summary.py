"""Whether a recording is sound, and whether it fits a scenario."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rfpose.errors import RecordingError, ScenarioError
from rfpose.recording.base import Recording, count_fill, frame_starts, recorded_runs
from rfpose.scenario import Scenario

__all__ = ["check_against", "describe"]

_SAMPLES_LOOKED_AT = 2**20
"""A receiver, at most, in `_PIECES` pieces spread over what it recorded."""
_PIECES = 16
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
    tuned, wanted = recording.centre_frequency_hz, scenario.radio.centre_frequency_hz
    if tuned is not None and abs(tuned - wanted) > max(1e-3, _RATE_TOLERANCE * abs(wanted)):
        found.append(f"tuned to {tuned:.12g} Hz, but the scenario says `radio.centre_frequency_hz` = {wanted:.12g}")
    if not set(recording.receiver_ids) & set(scenario.receiver_ids):
        found.append(
            f"holds receivers {_some(recording.receiver_ids)}, but the scenario names {_some(scenario.receiver_ids)}: "
            "none in common"
        )
    return found


def describe(recording: Recording) -> dict[str, Any]:
    """Summarise a recording and judge whether it is sound.

    At most 2**20 samples a receiver are looked at, so that it takes seconds whatever the size.

    Returns
    -------
    dict
        Ready for JSON: numbers, text, lists, None; no NaN or infinity. ``sound`` is true when ``problems``,
        a list of one-line texts, is empty. Levels are relative to full scale [dB], None where there is none.
    """
    problems: list[str] = []
    receivers = {}
    for receiver_id in recording.receiver_ids:
        try:
            receivers[receiver_id] = _describe_receiver(recording, receiver_id, problems)
        except RecordingError as error:
            problems.append(f"{receiver_id}: {error}")
            receivers[receiver_id] = {"readable": False}
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
    summary |= _describe_time(recording, receivers, problems)
    if scenario is not None:
        problems += _disagreements(recording, scenario)
        missing = [name for name in scenario.receiver_ids if name not in recording.receiver_ids]
        if missing:
            problems.append(f"{len(missing)} receivers of the scenario are not in the recording: {_some(missing)}")
        summary["receivers_not_in_scenario"] = [
            name for name in recording.receiver_ids if name not in scenario.receiver_ids
        ]
    summary["problems"] = problems
    summary["sound"] = not problems
    return summary


def _describe_time(recording: Recording, receivers: dict[str, Any], problems: list[str]) -> dict[str, Any]:
    if not all(entry.get("readable") for entry in receivers.values()):
        return {"start_unix_s": None, "span_s": None, "recorded_s": None, "stretches": None, "frames": None}
    runs = recorded_runs(recording)
    if len(runs) == 0:
        problems.append("no samples were recorded")
        return {"start_unix_s": None, "span_s": 0.0, "recorded_s": 0.0, "stretches": 0, "frames": 0}
    first, end = int(runs[0, 0]), int(runs[-1].sum())
    frames = None
    if recording.scenario is not None:
        frame_samples = recording.scenario.radio.frame_samples
        frames = len(frame_starts(recording, frame_samples))
        if frames == 0:
            problems.append(f"no stretch is as long as a frame of {frame_samples} samples")
    return {
        "start_unix_s": float(first / recording.sample_rate),
        "span_s": float((end - first) / recording.sample_rate),
        "recorded_s": float(int(runs[:, 1].sum()) / recording.sample_rate),
        "stretches": len(runs),
        "frames": frames,
    }


def _describe_receiver(recording: Recording, receiver_id: str, problems: list[str]) -> dict[str, Any]:
    blocks = recording.blocks(receiver_id)
    n_recorded = int(blocks[:, 1].sum())
    entry: dict[str, Any] = {"readable": True, "samples": n_recorded, "blocks": len(blocks)}
    entry["lost_samples"] = int(blocks[-1].sum() - blocks[0, 0]) - n_recorded if len(blocks) else 0
    if n_recorded == 0:
        problems.append(f"{receiver_id}: no samples")
        return entry
    sample = _look_at(recording, receiver_id)
    n_fill = count_fill(sample)
    values = sample.astype(np.float64)
    bad = ~np.isfinite(values)
    magnitude = np.abs(values[~bad])
    full_scale = recording.full_scale
    rms = float(np.sqrt(np.mean(np.square(magnitude)))) if magnitude.size else 0.0
    clipped = float(np.mean(magnitude >= full_scale)) if magnitude.size else 0.0
    entry |= {
        "looked_at": len(sample),
        "rms": rms,
        "peak": float(magnitude.max()) if magnitude.size else 0.0,
        "rms_dbfs": 20.0 * math.log10(rms / full_scale) if rms > 0.0 and math.isfinite(full_scale) else None,
        "clipped_fraction": clipped,
        "fill_samples": n_fill,
        "non_finite_values": int(bad.sum()) - (2 * n_fill if sample.dtype.kind == "f" else 0),
    }
    if n_fill:
        problems.append(f"{receiver_id}: {n_fill} of {len(sample)} samples looked at hold the fill value: lost samples")
    if entry["non_finite_values"]:
        problems.append(f"{receiver_id}: {entry['non_finite_values']} of {values.size} values looked at are NaN or Inf")
    if rms == 0.0:
        problems.append(f"{receiver_id}: all samples looked at are zero: is the receiver connected?")
    if clipped > _CLIPPED_FRACTION:
        problems.append(f"{receiver_id}: {100.0 * clipped:.3g} % of the values looked at are clipped: reduce the gain")
    return entry


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
