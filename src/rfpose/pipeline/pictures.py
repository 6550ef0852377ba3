"""Pictures of a result and of a recording, as PNG or SVG. matplotlib is loaded when one is drawn."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.errors import InvalidInputError
from rfpose.files import write_atomically
from rfpose.multilat import PoseStatus
from rfpose.pipeline.evaluate import Evaluation
from rfpose.pipeline.result import Result
from rfpose.recording import Recording, frame_starts
from rfpose.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_field_map", "draw_spectrum"]

_FORMATS = (".png", ".svg")
_COLOURS = "cividis"  # reads the same with and without colour vision deficiency, and in grey
_GREY = "0.6"
_LINES_PER_TONE = 16
_FLOOR = 1e-20


def draw_field_map(result: Result, path: str | Path, *, evaluation: Evaluation | None = None) -> None:
    """Draw the field from above: transmitters, heliostats, their normals, and how far off these are.

    With ``evaluation`` a mirror's colour is its RMS error over the frames, else the sigma that the result reports.
    Arrows are the normals' horizontal parts in the first frame in which the mirror was solved.

    Raises
    ------
    InvalidInputError
        ``path`` ends neither in .png nor in .svg.
    RecordingError
        The file cannot be written.
    """
    figure, axes = _new_figure(8.4, 7.2)
    scenario = result.scenario
    places = scenario.pivot_enu_m
    length_m = 0.18 * float(np.ptp(scenario.transmitter_enu_m[:, :2], axis=0).max())
    frame = _first_solved(result)
    column = np.arange(len(places))
    if evaluation is None:
        mrad = np.array([1e3 * _rms(result.poses.sigma_rad[:, i]) for i in column])
        label = "sigma of the mirror normal, RMS over frames [mrad]"
    else:
        mrad = np.array([row.normal_error_mrad.rms for row in evaluation.heliostats])
        label = "error of the mirror normal, RMS over frames [mrad]"
        if result.truth is not None and len(result.truth.normal_enu) == len(result.frame_start_index):
            true_tip = places + length_m * result.truth.normal_enu[frame, column]
            axes.plot(*_segments(places, true_tip), color=_GREY, lw=6, solid_capstyle="butt", label="true normal")
    measured = result.poses.normal_enu[frame, column]
    _arrows(axes, places, length_m * measured)
    solved = np.isfinite(mrad)
    dots = axes.scatter(
        places[solved, 0], places[solved, 1], c=mrad[solved], cmap=_COLOURS, vmin=0.0, s=90, edgecolors="k", zorder=4
    )
    figure.colorbar(dots, ax=axes, label=label, shrink=0.85)
    if not solved.all():
        x, y = places[~solved, :2].T
        axes.scatter(x, y, s=80, marker="x", color="k", zorder=4, label="heliostat, not solved")
    for name, place, value, offset in zip(scenario.heliostat_ids, places, mrad, _behind(measured), strict=True):
        text = f"{name}\n{value:.2g}" if np.isfinite(value) else name
        axes.annotate(text, place[:2], offset, textcoords="offset points", fontsize=7, ha="center", va="center")
    _mark(axes, scenario.transmitter_enu_m, scenario.transmitter_ids, marker="^", label="transmitter")
    names = tuple(receiver.id for receiver in scenario.calibration_receiver)
    _mark(axes, scenario.calibration_enu_m, names, marker="s", label="calibration receiver")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.margins(0.08)
    axes.set_title(f"{scenario.name}: mirror normals measured by radio")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    _save(figure, path)


def draw_spectrum(
    recording: Recording, path: str | Path, *, scenario: Scenario | None = None, receiver_id: str | None = None
) -> None:
    """Draw the spectrum of one receiver's first whole frame with every carrier and sideband marked.

    Raises
    ------
    InvalidInputError
        No scenario, no such receiver, no whole frame, or ``path`` ends neither in .png nor in .svg.
    RecordingError
        The recording is damaged, or the file cannot be written.
    """
    scenario = scenario or recording.scenario
    if scenario is None:
        raise InvalidInputError("`scenario` must be given: the recording holds none")
    receiver_id = receiver_id or recording.receiver_ids[0]
    frequency_hz, power_db = _spectrum(recording, scenario, receiver_id)
    figure, axes = _new_figure(11.0, 5.2)
    axes.plot(1e-6 * frequency_hz, power_db, color="0.35", lw=0.6)
    line_mhz = 1e-6 * scenario.line_hz
    level_db = np.interp(line_mhz, 1e-6 * frequency_hz, _widened(power_db))
    axes.plot(line_mhz[:, 0], level_db[:, 0] + 2.0, "v", color="#0072B2", ms=6, label="carrier")
    axes.plot(
        line_mhz[:, 1:].ravel(), level_db[:, 1:].ravel() + 2.0, ".", color="#D55E00", ms=7, label="tone's sideband"
    )
    for name, x, y in zip(scenario.transmitter_ids, line_mhz[:, 0], level_db[:, 0], strict=True):
        axes.annotate(name, (x, y + 2.0), (0, 6), textcoords="offset points", ha="center", fontsize=8)
    axes.set_xlabel(f"frequency from {1e-6 * scenario.radio.centre_frequency_hz:g} MHz [MHz]")
    full_scale = np.isfinite(recording.full_scale)
    axes.set_ylabel("power in one bin [dB of full scale]" if full_scale else "power in one bin [dB]")
    axes.set_xlim(1e-6 * frequency_hz[0], 1e-6 * frequency_hz[-1])
    axes.set_ylim(top=float(level_db.max()) + 12.0)
    axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    bin_khz = 1e-3 * (frequency_hz[1] - frequency_hz[0])
    axes.set_title(f"Receiver {receiver_id}: {len(line_mhz)} transmitters (bins of {bin_khz:.3g} kHz)")
    _save(figure, path)


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


def _first_solved(result: Result) -> npt.NDArray[np.intp]:
    """Return (heliostat,) the first frame in which each was solved, else the first."""
    return np.asarray(np.argmax(result.poses.status == PoseStatus.OK, axis=0))


def _rms(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def _arrows(axes: Axes, places: FloatArray, offset_m: FloatArray) -> None:
    """Draw the horizontal parts of measured normals from their mirrors."""
    seen = np.isfinite(offset_m).all(axis=1)
    axes.quiver(
        *places[seen, :2].T, *offset_m[seen, :2].T,
        angles="xy", scale_units="xy", scale=1.0, width=0.003, headwidth=4, color="k", zorder=3,
        label="measured normal",
    )  # fmt: skip


def _segments(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return (2, 3·point) coordinates of separate lines, each from a start to an end, NaN between them."""
    return np.stack([start[:, :2], end[:, :2], np.full((len(start), 2), np.nan)], axis=1).reshape(-1, 2).T


def _behind(normal_enu: FloatArray) -> FloatArray:
    """Return (point, 2) where to put a mirror's name so that its arrow does not cross it [points]."""
    flat = np.nan_to_num(normal_enu[:, :2])
    size = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.where(size > 1e-9, -18.0 * flat / np.maximum(size, 1e-9), [0.0, -18.0])


def _mark(axes: Axes, places: FloatArray, names: tuple[str, ...], *, marker: str, label: str) -> None:
    axes.scatter(places[:, 0], places[:, 1], marker=marker, color="#D55E00", s=60, zorder=3, label=label)
    for name, place in zip(names, places, strict=True):
        axes.annotate(name, place[:2], (6, -11), textcoords="offset points", fontsize=8, color="#A04000")


def _new_figure(width_inch: float, height_inch: float) -> tuple[Figure, Axes]:
    """Return a figure that needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inch, height_inch), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def _save(figure: Figure, path: str | Path) -> None:
    path = Path(path)
    if path.suffix not in _FORMATS:
        raise InvalidInputError(f"`path` must end in {' or '.join(_FORMATS)}, got {path.name}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix[1:], dpi=130)
    write_atomically(path, buffer.getvalue())
