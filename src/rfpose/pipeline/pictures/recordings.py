"""Figures of a recording: what the band holds, in one frame and over all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rfpose.drawing import BLUE, COLOUR_MAP, VERMILION, WIDTH_INCH, foreground, new_figure
from rfpose.errors import InvalidInputError
from rfpose.pipeline.pictures.spectra import spectrum, viewing_frames, waterfall
from rfpose.recording import Recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_band", "draw_waterfall"]

_NAMES = 40


def draw_band(recording: Recording, *, receiver_id: str | None = None, frame: int = 0) -> Figure:
    """Draw the spectrum of one receiver's frame, with every carrier and sideband where the scenario has it.

    Raises
    ------
    InvalidInputError
        No such receiver, no such frame, or samples of it are missing.
    """
    receiver_id, starts, n_sample = _chosen(recording, receiver_id, frame)
    found = spectrum(recording, receiver_id, int(starts[frame]), n_sample, scenario=recording.scenario)
    if found is None:
        raise InvalidInputError(f"`frame` {frame} of receiver {receiver_id} has samples missing; choose another")
    figure, axes = new_figure(WIDTH_INCH, 3.6)
    axes.plot(1e-6 * found.frequency_hz, found.power_db, color=foreground(), alpha=0.7, lw=0.6)
    top = float(found.power_db.max())
    if found.line_hz.size:
        carrier, sideband = 1e-6 * found.line_hz[:, 0], 1e-6 * found.line_hz[:, 1:].ravel()
        axes.plot(carrier, found.line_db[:, 0] + 2.0, "v", color=BLUE, ms=5, label="carrier")
        axes.plot(sideband, found.line_db[:, 1:].ravel() + 2.0, ".", color=VERMILION, ms=5, label="tone's sideband")
        top = float(found.line_db.max())
        names = recording.scenario.transmitter_ids if recording.scenario is not None else ()
        if len(names) <= _NAMES:
            for name, x, y in zip(names, carrier, found.line_db[:, 0], strict=True):
                axes.annotate(name, (x, y + 2.0), (0, 6), textcoords="offset points", ha="center", fontsize=7)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    axes.set_xlabel(_frequency(recording))
    axes.set_ylabel("power in one bin\n[dB of full scale]" if found.full_scale else "power in one bin [dB]")
    axes.set_xlim(1e-6 * found.frequency_hz[0], 1e-6 * found.frequency_hz[-1])
    axes.set_ylim(float(np.median(found.power_db)) - 15.0, top + 15.0)
    axes.grid(alpha=0.3)
    axes.set_title(f"Receiver {receiver_id}, frame {frame + 1} of {len(starts)}")
    return figure


def draw_waterfall(recording: Recording, *, receiver_id: str | None = None) -> Figure:
    """Draw the spectra of one receiver over all frames; what was not recorded stays blank.

    Raises
    ------
    InvalidInputError
        No such receiver.
    """
    from matplotlib.ticker import MaxNLocator

    receiver_id, starts, n_sample = _chosen(recording, receiver_id, 0)
    found = waterfall(recording, receiver_id, starts, n_sample, n_row=min(200, 8 * len(starts)))
    figure, axes = new_figure(WIDTH_INCH, 3.6)
    known = found.power_db[np.isfinite(found.power_db)]
    low, high = (float(v) for v in np.percentile(known, [5.0, 99.9])) if known.size else (0.0, 1.0)
    low_mhz, high_mhz = (1e-6 * f for f in found.band_hz)
    image = axes.imshow(
        found.power_db, aspect="auto", cmap=COLOUR_MAP, vmin=low, vmax=max(high, low + 1.0), interpolation="nearest",
        extent=(low_mhz, high_mhz, len(starts) + 0.5, 0.5), rasterized=True,
    )  # fmt: skip
    scale = "dB of full scale" if np.isfinite(recording.full_scale) else "dB"
    figure.colorbar(image, ax=axes, label=f"power in one bin [{scale}]")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylabel("frame")
    axes.set_xlabel(_frequency(recording))
    axes.set_title(f"Receiver {receiver_id}")
    return figure


def _frequency(recording: Recording) -> str:
    centre_hz = recording.centre_frequency_hz
    return f"frequency from {'the centre' if centre_hz is None else f'{1e-6 * centre_hz:g} MHz'} [MHz]"


def _chosen(recording: Recording, receiver_id: str | None, frame: int) -> tuple[str, np.ndarray, int]:
    receiver_id = receiver_id or recording.receiver_ids[0]
    if receiver_id not in recording.receiver_ids:
        known = ", ".join(recording.receiver_ids[:5])
        raise InvalidInputError(f"`receiver` must be one of {known}, …, got {receiver_id!r}")
    starts, n_sample = viewing_frames(recording, recording.scenario)
    if not 0 <= frame < len(starts):
        raise InvalidInputError(f"`frame` must lie between 0 and {len(starts) - 1}, got {frame}")
    return receiver_id, starts, n_sample
