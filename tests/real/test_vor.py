"""P4: the bearing to a real VOR beacon as the phase difference of two demodulated tones."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import wavfile
from scipy.signal import firwin, hilbert, oaconvolve

from rfpose.dsp.phase_difference import hilbert_phase_difference

VOR = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "vor"
RECORDINGS = sorted(VOR.glob("*.wav"))

TONE_HZ = 30.0
SUBCARRIER_HZ = 9960.0
# twice the deviation of ±480 Hz holds the frequency modulation with its sidebands
HALF_BAND_HZ = 1000.0
BLOCK = 100  # 48 kHz to 480 Hz, sixteen samples a cycle of the tone
PASS_HZ = (20.0, 40.0)

pytestmark = pytest.mark.skipif(not RECORDINGS, reason=f"no VOR recordings in shared data ({VOR.name} is absent)")


def demodulate(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the two 30 Hz tones, of amplitude and of frequency modulation, and their sample rate."""
    rate_hz, channels = wavfile.read(path)
    audio = channels[:, 0].astype(float)
    taps = firwin(1025, [SUBCARRIER_HZ - HALF_BAND_HZ, SUBCARRIER_HZ + HALF_BAND_HZ], pass_zero=False, fs=rate_hz)
    subcarrier = hilbert(oaconvolve(audio, taps, mode="same"))
    frequency = np.angle(subcarrier[1:] * subcarrier[:-1].conj())
    amplitude = 0.5 * (audio[1:] + audio[:-1])  # at the same half-sample instants
    n_block = len(frequency) // BLOCK
    low_rate = [x[: n_block * BLOCK].reshape(n_block, BLOCK).mean(axis=1) for x in (amplitude, frequency)]
    return low_rate[0], low_rate[1], rate_hz / BLOCK


def bearing_rad(path: Path) -> float:
    am, fm, rate_hz = demodulate(path)
    return float(hilbert_phase_difference(am, fm, bandpass=(PASS_HZ[0] / rate_hz, PASS_HZ[1] / rate_hz)))


def test_p4_bearings_after_one_common_offset(figure):
    true_rad = np.radians([float(re.match(r"(\d+)deg", path.name)[1]) for path in RECORDINGS])
    error = np.exp(1j * (np.array([bearing_rad(path) for path in RECORDINGS]) - true_rad))
    residual_deg = np.degrees(np.angle(error / error.mean()))
    rms_deg = np.sqrt(np.mean(residual_deg**2))
    listing = ", ".join(f"{path.name} {r:+.2f}°" for path, r in zip(RECORDINGS, residual_deg, strict=True))
    figure("P4 bearing to a VOR beacon: error, rms", rms_deg, "°")
    assert len(RECORDINGS) == 5
    assert rms_deg <= 0.8, listing


def test_p4_the_tones_are_there():
    for path in RECORDINGS:
        for tone, rate_hz in ((t, demodulate(path)[2]) for t in demodulate(path)[:2]):
            spectrum = np.abs(np.fft.rfft((tone - tone.mean()) * np.hanning(len(tone)), 1 << 16))
            peak_hz = np.argmax(spectrum) * rate_hz / (1 << 16)
            assert peak_hz == pytest.approx(TONE_HZ, abs=0.5)
