"""Picture of a recording. matplotlib is loaded when it is drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rfpose.checks import FloatArray
from rfpose.drawing import SERIES, WIDTH_INCH, new_figure
from rfpose.errors import InvalidInputError, RecordingError
from rfpose.recording.base import Recording, frame_starts
from rfpose.recording.parts import blocks_by_part
from rfpose.recording.stamps import stamp_text
from rfpose.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_coverage", "draw_spectrum"]

_LEAST_SHARE = 0.004
"""Of the width, that a stretch is drawn: bursts of a plant's recorders are short beside the time between them."""
_MOST_NAMES = 60
"""Receivers beyond that are drawn without their names."""
_LEGEND = 12
"""Parts beyond that are not named."""
_LINES_PER_TONE = 16
_FLOOR = 1e-20


def draw_spectrum(recording: Recording, *, scenario: Scenario | None = None, receiver_id: str | None = None) -> Figure:
    """Draw the spectrum of one receiver's first whole frame with every carrier and sideband marked.

    Raises
    ------
    InvalidInputError
        No scenario, no such receiver, or no whole frame.
    RecordingError
        The recording is damaged.
    """
    scenario = scenario or recording.scenario
    if scenario is None:
        raise InvalidInputError("`scenario` must be given: the recording holds none")
    receiver_id = receiver_id or recording.receiver_ids[0]
    frequency_hz, power_db = _spectrum(recording, scenario, receiver_id)
    figure, axes = new_figure(11.0, 5.2)
    axes.plot(1e-6 * frequency_hz, power_db, color="0.35", lw=0.6)
    tuned_hz = recording.tuning_of(receiver_id) if recording.tunings else scenario.radio.centre_frequency_hz
    tuned_hz = scenario.radio.centre_frequency_hz if tuned_hz is None else tuned_hz
    line_mhz = 1e-6 * (scenario.line_hz + (scenario.radio.centre_frequency_hz - tuned_hz))
    level_db = np.interp(line_mhz, 1e-6 * frequency_hz, _widened(power_db))
    axes.plot(line_mhz[:, 0], level_db[:, 0] + 2.0, "v", color="#0072B2", ms=6, label="carrier")
    axes.plot(
        line_mhz[:, 1:].ravel(), level_db[:, 1:].ravel() + 2.0, ".", color="#D55E00", ms=7, label="tone's sideband"
    )
    for name, x, y in zip(scenario.transmitter_ids, line_mhz[:, 0], level_db[:, 0], strict=True):
        axes.annotate(name, (x, y + 2.0), (0, 6), textcoords="offset points", ha="center", fontsize=8)
    axes.set_xlabel(f"frequency from {1e-6 * tuned_hz:g} MHz [MHz]")
    full_scale = np.isfinite(recording.full_scale)
    axes.set_ylabel("power in one bin [dB of full scale]" if full_scale else "power in one bin [dB]")
    axes.set_xlim(1e-6 * frequency_hz[0], 1e-6 * frequency_hz[-1])
    axes.set_ylim(top=float(level_db.max()) + 12.0)
    axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    bin_khz = 1e-3 * (frequency_hz[1] - frequency_hz[0])
    axes.set_title(f"Receiver {receiver_id}: {len(line_mhz)} transmitters (bins of {bin_khz:.3g} kHz)")
    return figure


def draw_coverage(recording: Recording) -> Figure:
    """Draw who recorded when: a line a receiver, each part of the recording in its colour.

    Raises
    ------
    RecordingError
        The recording is damaged, or holds no samples.
    """
    row = {name: i for i, name in enumerate(recording.receiver_ids)}
    parts = blocks_by_part(recording)
    starts = [int(rows[0, 0]) for _, blocks in parts for rows in blocks.values() if len(rows)]
    if not starts:
        raise RecordingError(f"{recording.path}: no samples were recorded; check it with `rfpose info`")
    ends = [int(rows[-1].sum()) for _, blocks in parts for rows in blocks.values() if len(rows)]
    first, rate = min(starts), float(recording.sample_rate)
    least_s = _LEAST_SHARE * (max(ends) - first) / rate
    figure, axes = new_figure(WIDTH_INCH, 1.4 + 0.22 * min(len(row), _MOST_NAMES))
    for k, (name, blocks) in enumerate(parts):
        label: str | None = name if k < _LEGEND else None
        for receiver_id, rows in blocks.items():
            spans = np.stack([rows[:, 0] - first, rows[:, 1]], axis=1) / rate
            axes.broken_barh(
                [(float(begin), max(float(lasts), least_s)) for begin, lasts in spans],
                (row[receiver_id] - 0.35, 0.7),
                facecolors=SERIES[k % len(SERIES)],
                label=label,
            )
            label = None
    axes.set_ylim(len(row) - 0.5, -0.5)
    if len(row) <= _MOST_NAMES:
        axes.set_yticks(range(len(row)), list(row))
    else:
        axes.set_ylabel("receiver")
    since = f" since {stamp_text(first, recording.sample_rate)[:-10]}Z" if recording.time_known else ""
    axes.set_xlabel(f"time{since} [s]")
    axes.grid(alpha=0.3, axis="x")
    handles, labels = axes.get_legend_handles_labels()
    if len(parts) > 1:
        more = f"and {len(parts) - _LEGEND} more" if len(parts) > _LEGEND else None
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, title=more)
    axes.set_title(f"{recording.path.name}: who recorded when")
    return figure


def _spectrum(recording: Recording, scenario: Scenario, receiver_id: str) -> tuple[FloatArray, FloatArray]:
    """Return frequencies (bin,) from the centre [Hz] and power of a sinusoid in each bin [dB]."""
    from scipy.signal import welch

    n_sample = scenario.radio.frame_samples
    found = (recording.frame_at(receiver_id, int(s), n_sample) for s in frame_starts(recording, n_sample))
    start = next((s for s in found if s is not None), None)
    if start is None:
        raise InvalidInputError(f"`receiver_id` {receiver_id} has no frame of {n_sample} samples without a gap")
    counts = recording.read(receiver_id, start, n_sample).astype(np.float32)
    signal = counts[:, 0] + 1j * counts[:, 1]
    rate_hz = float(recording.sample_rate)
    wanted = _LINES_PER_TONE * rate_hz / float(scenario.tone_hz.min())
    n_bin = min(n_sample, 1 << int(np.ceil(np.log2(max(wanted, 4096)))))
    frequency_hz, power = welch(
        signal, rate_hz, "blackmanharris", n_bin, return_onesided=False, detrend=False, scaling="spectrum"
    )
    order = np.argsort(frequency_hz)
    reference = recording.full_scale**2 if np.isfinite(recording.full_scale) else 1.0
    return frequency_hz[order], 10.0 * np.log10(np.maximum(power[order] / reference, _FLOOR))


def _widened(power_db: FloatArray) -> FloatArray:
    """Return the largest of each bin and its neighbours, so that a line between two bins shows its level."""
    return np.asarray(np.maximum.reduce([np.roll(power_db, k) for k in (-2, -1, 0, 1, 2)]))
