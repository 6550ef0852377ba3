"""Scatter of tone phases over the bound, for a table in docs/tone-phases.md.

Ten carriers 4 MHz apart, one 750 kHz tone, 40 MS/s, receiver clock 20 ppm off. Usage:

    python benchmarks/bound_dsp.py [--runs 600] [--samples 40000]
"""

from __future__ import annotations

import argparse

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from rfpose.dsp import LinePlan, ToneExtractor
from rfpose.dsp.bounds import phase_bound_rad

CARRIER_HZ = np.arange(-18e6, 19e6, 4e6)
RATE_HZ, CENTRE_HZ, TONE_HZ, MODULATION, CLOCK_PPM = 40e6, 100e6, 750e3, 0.8, 20.0


def samples(n: int, snr: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """One frame from the formula; phases refer to its centre."""
    k = 1.0 + CLOCK_PPM * 1e-6
    t = (np.arange(n) - 0.5 * (n - 1)) / (RATE_HZ * k)
    phase = rng.uniform(-np.pi, np.pi, len(CARRIER_HZ))
    x = MODULATION / np.sqrt(2 * snr) * (rng.standard_normal(n) + 1j * rng.standard_normal(n))
    for f, p in zip(CARRIER_HZ, phase, strict=True):
        tone = 1 + MODULATION * np.cos(2 * np.pi * TONE_HZ * t + p)
        x += tone * np.exp(1j * (rng.uniform(0, 2 * np.pi) + 2 * np.pi * (CENTRE_HZ + f - CENTRE_HZ * k) * t))
    return np.stack([x.real, x.imag], axis=-1).astype(np.float32), phase


def main() -> None:
    """Print rms error over bound and reported sigma over rms error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=600)
    parser.add_argument("--samples", type=int, default=40_000)
    parser.add_argument("--snr-db", type=float, nargs="*", default=[50, 40, 30, 20, 10, 0, -10, -20])
    args = parser.parse_args()
    plan = LinePlan.create(CARRIER_HZ, np.array([TONE_HZ]), sample_rate_hz=RATE_HZ, centre_frequency_hz=CENTRE_HZ)
    names = ("hilbert", "correlator")
    extractors = {name: ToneExtractor(plan, name, full_scale=np.inf) for name in names}
    table = Table(
        "SNR [dB]", *(f"{name} {what}" for name in names for what in ("rms / bound", "bias / bound", "sigma / rms"))
    )
    for snr_db in args.snr_db:
        rng = np.random.default_rng(1)
        snr = 10 ** (snr_db / 10)
        error: dict[str, list] = {name: [] for name in names}
        sigma: dict[str, list] = {name: [] for name in names}
        for _ in track(range(args.runs), f"{snr_db:+.0f} dB", console=Console(stderr=True), transient=True):
            x, phase = samples(args.samples, snr, rng)
            for name in names:
                found = extractors[name].measure(x, clock_ppm=CLOCK_PPM + rng.uniform(-0.1, 0.1))
                e = np.angle(np.exp(1j * (found.phase_rad[:, 0] - phase)))
                error[name].append(e - np.nanmean(e))
                sigma[name].append(found.sigma_rad[:, 0])
        row = [f"{snr_db:+.0f}"]
        n = len(CARRIER_HZ)
        bound = phase_bound_rad(args.samples, snr)
        for name in names:
            e = np.array(error[name]) * np.sqrt(n / (n - 1))  # taking the common clock off takes 1/n of the variance
            rms = np.sqrt(np.nanmean(e**2))
            bias = np.sqrt(np.mean(np.nanmean(e, axis=0) ** 2))
            row += [
                f"{rms / bound:.3f}",
                f"{bias / bound:.3f}",
                f"{np.sqrt(np.nanmean(np.square(sigma[name]))) / rms:.3f}",
            ]
        table.add_row(*row)
    Console().print(table)


if __name__ == "__main__":
    main()
