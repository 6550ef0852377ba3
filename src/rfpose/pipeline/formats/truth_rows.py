"""Bringing a truth into the order of a scenario and of a result's frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rfpose.scenario import Scenario
from rfpose.truth import Truth

__all__ = ["align_truth", "truth_rows"]


def truth_rows(truth: Truth, frame_start_index: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return (frame,) which row of a truth holds for each frame: the last that began by then, −1 for none."""
    if truth.frame_start_index is None:
        return np.zeros(len(frame_start_index), np.int64)
    return np.asarray(np.searchsorted(truth.frame_start_index, frame_start_index, side="right") - 1, np.int64)


def align_truth(truth: Truth, scenario: Scenario) -> Truth:
    """Put a truth's rows into the order of a scenario's; what it does not know becomes NaN."""
    heliostat = _order(truth.heliostat_ids, scenario.heliostat_ids)
    receiver = _order(truth.receiver_ids, scenario.receiver_ids)
    transmitter = _order(truth.transmitter_ids, scenario.transmitter_ids)
    snr = _taken(truth.tone_snr, receiver, axis=1)
    return Truth(
        heliostat_ids=scenario.heliostat_ids,
        receiver_ids=scenario.receiver_ids,
        transmitter_ids=scenario.transmitter_ids,
        normal_enu=_taken(truth.normal_enu, heliostat, axis=1),
        receiver_enu_m=_taken(truth.receiver_enu_m, receiver, axis=1),
        frame_start_index=truth.frame_start_index,
        transmitter_phase_rad=_taken(truth.transmitter_phase_rad, transmitter, axis=1),
        clock_ppm=_taken(truth.clock_ppm, receiver, axis=0),
        receiver_delay_s=_taken(truth.receiver_delay_s, receiver, axis=1),
        tone_snr=_taken(snr, transmitter, axis=2),
    )


def _order(found: Sequence[str], wanted: Sequence[str]) -> npt.NDArray[np.int64]:
    """Return where each wanted name stands among those found, −1 for nowhere."""
    place = {name: i for i, name in enumerate(found)}
    return np.array([place.get(name, -1) for name in wanted], np.int64)


def _taken(array: Any, index: npt.NDArray[np.int64], *, axis: int) -> Any:
    if array is None:
        return None
    shape = [len(index) if i == axis else n for i, n in enumerate(array.shape)]
    out = np.full(shape, np.nan)
    known = np.flatnonzero(index >= 0)
    np.moveaxis(out, axis, 0)[known] = np.moveaxis(array, axis, 0)[index[known]]
    return out
