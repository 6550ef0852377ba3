"""Records of the DSP stage: tone phases with the amplitudes they came from, their noise and a status."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray

__all__ = ["FrameTones", "LineStatus", "TonePhases"]

ComplexArray = npt.NDArray[np.complex128]


class LineStatus(IntEnum):
    """Why a transmitter's tone phase at a receiver is missing."""

    OK = 0
    ABSENT = 1
    WEAK = 2
    CLIPPED = 3
    NOT_FINITE = 4
    NO_SIGNAL = 5
    MISSING_SAMPLES = 6
    GAP = 7
    NOT_RECORDED = 8

    @property
    def reason(self) -> str:
        """The status in words."""
        return _REASON[self]


_REASON = {
    LineStatus.OK: "measured",
    LineStatus.ABSENT: "carrier not found above the noise",
    LineStatus.WEAK: "tone too weak for a phase",
    LineStatus.CLIPPED: "samples at full scale",
    LineStatus.NOT_FINITE: "NaN or infinite samples",
    LineStatus.NO_SIGNAL: "all samples are zero",
    LineStatus.MISSING_SAMPLES: "stretches of zero or fill samples",
    LineStatus.GAP: "samples of the frame were not recorded",
    LineStatus.NOT_RECORDED: "receiver not in the recording",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTones:
    """One frame of one receiver.

    Attributes
    ----------
    phase_rad : (transmitter, tone)
        Phase of each demodulated tone at the frame's centre, in the receiver's own time, in (−π, π] [rad]. Only
        differences between transmitters mean anything by themselves; NaN where ``status`` is not OK.
    sigma_rad : (transmitter, tone)
        Its standard deviation, from noise measured in this frame [rad].
    carrier : (transmitter,)
        Complex amplitude of the carrier at the frame's centre [units of the samples].
    carrier_sigma : (transmitter,)
        Standard deviation of its real (or imaginary) part.
    sideband : (transmitter, tone, 2)
        Complex amplitudes of upper and lower sideband at the frame's centre.
    sideband_sigma : (transmitter, tone, 2)
        Standard deviation of the real (or imaginary) part.
    clock_ppm, clock_sigma_ppm
        The receiver's clock offset measured in this frame [ppm].
    noise_variance
        Variance of the complex noise in the recorded band, per sample, from the noise about the lines.
    clipped_fraction
        Fraction of samples at full scale.
    status : (transmitter,)
        `LineStatus`.
    """

    phase_rad: FloatArray
    sigma_rad: FloatArray
    carrier: ComplexArray
    carrier_sigma: FloatArray
    sideband: ComplexArray
    sideband_sigma: FloatArray
    clock_ppm: float
    clock_sigma_ppm: float
    noise_variance: float
    clipped_fraction: float
    status: npt.NDArray[np.uint8]

    @classmethod
    def failed(
        cls, n_transmitter: int, n_tone: int, status: LineStatus, *, clipped_fraction: float = np.nan
    ) -> FrameTones:
        """Return a frame without measurements, for one reason."""
        nan = np.full((n_transmitter, n_tone), np.nan)
        return cls(
            phase_rad=nan,
            sigma_rad=nan,
            carrier=np.full(n_transmitter, np.nan, np.complex128),
            carrier_sigma=np.full(n_transmitter, np.nan),
            sideband=np.full((n_transmitter, n_tone, 2), np.nan, np.complex128),
            sideband_sigma=np.full((n_transmitter, n_tone, 2), np.nan),
            clock_ppm=np.nan,
            clock_sigma_ppm=np.nan,
            noise_variance=np.nan,
            clipped_fraction=clipped_fraction,
            status=np.full(n_transmitter, status, np.uint8),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TonePhases:
    """`FrameTones` of every frame and receiver: the DSP stage's output.

    Attributes
    ----------
    receiver_ids, transmitter_ids
        Names along the axes.
    tone_hz : (tone,)
        [Hz].
    frame_start_index : (frame,)
        First sample of each frame, counted from the Unix epoch at the nominal rate.
    phase_rad, sigma_rad, carrier, carrier_sigma, sideband, sideband_sigma, status
        As in `FrameTones` with axes (frame, receiver) in front.
    clock_ppm, clock_sigma_ppm, noise_variance, clipped_fraction : (frame, receiver)
        As in `FrameTones`.
    """

    receiver_ids: tuple[str, ...]
    transmitter_ids: tuple[str, ...]
    tone_hz: FloatArray
    frame_start_index: npt.NDArray[np.int64]
    phase_rad: FloatArray
    sigma_rad: FloatArray
    carrier: ComplexArray
    carrier_sigma: FloatArray
    sideband: ComplexArray
    sideband_sigma: FloatArray
    clock_ppm: FloatArray
    clock_sigma_ppm: FloatArray
    noise_variance: FloatArray
    clipped_fraction: FloatArray
    status: npt.NDArray[np.uint8]

    @classmethod
    def empty(
        cls,
        *,
        receiver_ids: tuple[str, ...],
        transmitter_ids: tuple[str, ...],
        tone_hz: FloatArray,
        frame_start_index: npt.NDArray[np.int64],
    ) -> TonePhases:
        """Return NaN everywhere with status NOT_RECORDED, to be filled with `put`."""
        frame_receiver = (len(frame_start_index), len(receiver_ids))
        n_transmitter, n_tone = len(transmitter_ids), len(tone_hz)
        per_tone = (*frame_receiver, n_transmitter, n_tone)
        return cls(
            receiver_ids=receiver_ids,
            transmitter_ids=transmitter_ids,
            tone_hz=tone_hz,
            frame_start_index=frame_start_index,
            phase_rad=np.full(per_tone, np.nan),
            sigma_rad=np.full(per_tone, np.nan),
            carrier=np.full((*frame_receiver, n_transmitter), np.nan, np.complex128),
            carrier_sigma=np.full((*frame_receiver, n_transmitter), np.nan),
            sideband=np.full((*per_tone, 2), np.nan, np.complex128),
            sideband_sigma=np.full((*per_tone, 2), np.nan),
            clock_ppm=np.full(frame_receiver, np.nan),
            clock_sigma_ppm=np.full(frame_receiver, np.nan),
            noise_variance=np.full(frame_receiver, np.nan),
            clipped_fraction=np.full(frame_receiver, np.nan),
            status=np.full((*frame_receiver, n_transmitter), LineStatus.NOT_RECORDED, np.uint8),
        )
