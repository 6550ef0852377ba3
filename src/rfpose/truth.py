"""What was really there: the simulator writes it, the evaluation reads it, the estimators never see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray

__all__ = ["Truth"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """True state of a site, one row a frame; arrays that are not known are None.

    Attributes
    ----------
    heliostat_ids, receiver_ids, transmitter_ids
        Names along the axes.
    normal_enu : (frame, heliostat, xyz)
        Mirror normals, unit length.
    receiver_enu_m : (frame, receiver, xyz)
        Receiver positions, site ENU [m].
    frame_start_index : (frame,)
        First sample of each frame, counted from the Unix epoch at the nominal rate. One row without an index
        means that the truth holds for every frame.
    transmitter_phase_rad : (frame, transmitter, tone)
        Electronic phase of each transmitter's tone [rad].
    clock_ppm : (receiver,)
        Offset of each receiver's oscillator from nominal [ppm].
    receiver_delay_s : (frame, receiver)
        Hardware delay [s].
    tone_snr : (frame, receiver, transmitter, tone)
        Linear, per sample: ``(a m)² / σ²``, σ² the variance of all complex noise in the recorded band,
        quantisation included.
    """

    heliostat_ids: tuple[str, ...]
    receiver_ids: tuple[str, ...]
    transmitter_ids: tuple[str, ...]
    normal_enu: FloatArray
    receiver_enu_m: FloatArray
    frame_start_index: npt.NDArray[np.int64] | None = None
    transmitter_phase_rad: FloatArray | None = None
    clock_ppm: FloatArray | None = None
    receiver_delay_s: FloatArray | None = None
    tone_snr: FloatArray | None = None
