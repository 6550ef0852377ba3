"""The random part of a recording: everything drawn from the seed, each purpose from a stream of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfpose.checks import FloatArray
from rfpose.scenario import Scenario

__all__ = ["RecordingDraws", "draw", "noise_generator"]

_CARRIER, _OSCILLATOR, _TONE, _DELAY, _NOISE = range(5)
_TWO_PI = 2.0 * np.pi


@dataclass(frozen=True, slots=True)
class RecordingDraws:
    """What chance decided for one recording.

    Attributes
    ----------
    carrier_phase_rad : (transmitter,)
        θ, constant over the recording, the same for all receivers.
    tone_phase_rad : (frame, transmitter, tone)
        Φ in (−π, π].
    clock_ppm, oscillator_phase_rad, sampling_phase : (receiver,)
        Offset of the oscillator, its phase ψ, and the sampling instant as a fraction of a sample in [0, 1);
        equal for receivers that share an oscillator.
    delay_s : (frame, receiver)
        Hardware delay.
    """

    carrier_phase_rad: FloatArray
    tone_phase_rad: FloatArray
    clock_ppm: FloatArray
    oscillator_phase_rad: FloatArray
    sampling_phase: FloatArray
    delay_s: FloatArray


def draw(scenario: Scenario, *, seed: int, frame_time_s: FloatArray) -> RecordingDraws:
    """Draw all random quantities but the noise.

    Parameters
    ----------
    scenario
    seed
    frame_time_s : (frame,)
        Start of each frame since the first [s]; drifts grow with it.
    """
    simulation = scenario.simulation
    n_transmitter, n_tone = len(scenario.transmitter), len(scenario.tone)
    carrier_phase_rad = _stream(seed, _CARRIER).uniform(0.0, _TWO_PI, n_transmitter)

    tone_stream = _stream(seed, _TONE)
    start_rad = tone_stream.uniform(0.0, _TWO_PI, (n_transmitter, n_tone))
    per_sqrt_s = simulation.transmitter_phase_drift_rad_per_sqrt_h / np.sqrt(3600.0)
    tone_phase_rad = start_rad + per_sqrt_s * _random_walk(tone_stream, frame_time_s, start_rad.shape)

    n_receiver = len(scenario.receivers)
    delay_stream = _stream(seed, _DELAY)
    start_s = simulation.receiver_delay_s * delay_stream.standard_normal(n_receiver)
    per_sqrt_s = simulation.receiver_delay_drift_s_per_sqrt_min / np.sqrt(60.0)
    delay_s = start_s + per_sqrt_s * _random_walk(delay_stream, frame_time_s, start_s.shape)

    oscillators = list(dict.fromkeys(r.oscillator for r in scenario.receivers))
    of_receiver = np.array([oscillators.index(r.oscillator) for r in scenario.receivers])
    unit_draw = _stream(seed, _OSCILLATOR).uniform(size=(len(oscillators), 3))[of_receiver]
    return RecordingDraws(
        carrier_phase_rad=carrier_phase_rad,
        tone_phase_rad=_wrap(tone_phase_rad),
        clock_ppm=simulation.clock_offset_ppm * (2.0 * unit_draw[:, 0] - 1.0),
        oscillator_phase_rad=_TWO_PI * unit_draw[:, 1],
        sampling_phase=unit_draw[:, 2],
        delay_s=delay_s,
    )


def noise_generator(seed: int, *, i_frame: int, i_receiver: int, i_chunk: int) -> np.random.Generator:
    """Return the generator of one chunk's noise, which depends on nothing but the arguments."""
    # SFC64 is the fastest of numpy's bit generators here, by a quarter
    return np.random.Generator(
        np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(_NOISE, i_frame, i_receiver, i_chunk)))
    )


def _stream(seed: int, purpose: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(purpose,)))


def _random_walk(stream: np.random.Generator, time_s: FloatArray, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Return (frame, *shape): a walk from zero whose variance grows by one a second."""
    step = stream.standard_normal((len(time_s), *shape))
    step *= np.sqrt(np.diff(time_s, prepend=time_s[0])).reshape(-1, *(1 for _ in shape))
    return np.cumsum(step, axis=0)


def _wrap(phase_rad: FloatArray) -> FloatArray:
    """Wrap to (−π, π]."""
    return np.asarray(np.pi - np.mod(np.pi - phase_rad, _TWO_PI))
