"""Signals for tests, written from the formula and from nothing in the package."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

FIGURE = "figure: "


def _fdm_samples(
    n_sample: int,
    rng: np.random.Generator,
    *,
    carrier_hz: Any,
    tone_hz: Any,
    rate_hz: float,
    centre_hz: float,
    snr: float = np.inf,
    clock_ppm: float = 0.0,
    modulation: float = 0.8,
    dtype: Any = np.int16,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Full-carrier AM on every carrier; returns (samples, tone phase (transmitter, tone), carrier phase).

    Phases refer to the frame's centre. ``snr`` is (a m)²/σ² of one tone, a = 1.
    """
    k = 1.0 + clock_ppm * 1e-6
    t = (np.arange(n_sample) - 0.5 * (n_sample - 1)) / (rate_hz * k)
    tone_hz = np.atleast_1d(tone_hz)
    m = modulation / len(tone_hz)
    phase = rng.uniform(-np.pi, np.pi, (len(carrier_hz), len(tone_hz)))
    theta = rng.uniform(-np.pi, np.pi, len(carrier_hz))
    x = np.zeros(n_sample, np.complex128)
    for i, f in enumerate(carrier_hz):
        envelope = 1.0 + sum(m * np.cos(2 * np.pi * w * t + phase[i, q]) for q, w in enumerate(tone_hz))
        x += envelope * np.exp(1j * (theta[i] + 2 * np.pi * (centre_hz + f - centre_hz * k) * t))
    if np.isfinite(snr):
        scale = m / np.sqrt(2.0 * snr)
        x += scale * (rng.standard_normal(n_sample) + 1j * rng.standard_normal(n_sample))
    pair = np.stack([x.real, x.imag], axis=-1)
    if dtype == np.int16:
        pair = np.rint(pair * (32000.0 / np.max(np.abs(pair))))
    return pair.astype(dtype), phase, theta


@pytest.fixture
def fdm_samples() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """A function that makes one frame of an FDM recording from the formula."""
    return _fdm_samples


@pytest.fixture
def figure(record_property: Callable[[str, object], None]) -> Callable[[str, float, str], None]:
    """A function that states what a test measured; the run's summary lists it: ``figure(what, value, unit)``."""

    def state(what: str, value: float, unit: str = "") -> None:
        record_property(FIGURE + what, f"{value:.3g} {unit}".strip())

    return state


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """List the figures that the tests stated."""
    stated = [
        (name.removeprefix(FIGURE), value)
        for outcome in ("passed", "failed")
        for report in terminalreporter.getreports(outcome)
        for name, value in report.user_properties
        if name.startswith(FIGURE)
    ]
    if stated:
        terminalreporter.section("measured")
        for what, value in sorted(stated):
            terminalreporter.write_line(f"{what}: {value}")


# A run in the background ignores Ctrl-C, and so would the programs that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)
