"""What amplitudes would add to phases where the ground reflects: bounds with and without them.

    python benchmarks/reflection_amplitudes.py

Field and noise of docs/ground-reflection.md: 80 µrad, tones 0.75 and 7.5 MHz, pivots to 5 mm, one clock, no
calibration. Amplitudes are the ratios |U|/|C| and |L|/|C| of sidebands to carrier, which no path loss changes; each is
as noisy as its sideband, or uncertain by the flatness of the receiver's filters. The modulation is known, or unknown
for each transmitter and tone at each mirror, which leaves differences between its receivers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rfpose.geometry import rot_enu_from_mirror
from rfpose.scenario import load_scenario

SITE = load_scenario(Path(__file__).resolve().parents[1] / "data" / "table2_100m.toml")
TRANSMITTER, PLACES = SITE.transmitter_enu_m, np.array(SITE.heliostat[0].receiver_mirror_m)
SPEED, PHASE_SIGMA, G = 299_792_458.0, 80e-6, np.array([-0.3, 0.1])
TONE_HZ = np.array([0.75e6, 7.5e6])
IMAGE = TRANSMITTER * np.array([1.0, 1.0, -1.0])
N_MIRROR = 12


def lines(pivot: np.ndarray, rot: np.ndarray, unknown: np.ndarray, rf_hz: float) -> np.ndarray:
    """Complex lines C, then U, L of each tone at one mirror (line, receiver, transmitter); path loss left out."""
    turned = Rotation.from_rotvec(unknown[3:6]).as_matrix() @ rot
    receiver = pivot + unknown[:3] + PLACES @ turned.T
    direct = np.linalg.norm(receiver[:, None] - TRANSMITTER, axis=-1)
    reflected = np.linalg.norm(receiver[:, None] - IMAGE, axis=-1)
    k = 2.0 * np.pi * (rf_hz + SITE.carrier_hz) / SPEED
    offset = np.concatenate([[0.0], *([f, -f] for f in 2.0 * np.pi * TONE_HZ / SPEED)])
    k = k + offset[:, None, None]
    gain = (unknown[6] + 1j * unknown[7]) * direct / reflected
    return np.exp(-1j * k * direct) + gain * np.exp(-1j * k * reflected)


def observables(pivot: np.ndarray, rot: np.ndarray, unknown: np.ndarray, rf_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Tone phases (tone, receiver, transmitter), and logarithms of sidebands over carrier (tone × 2, …)."""
    line = lines(pivot, rot, unknown, rf_hz)
    carrier, upper, lower = line[0], line[1::2], line[2::2]
    tone = upper * carrier.conj() + (lower * carrier.conj()).conj()
    return np.angle(tone), np.log(np.abs(line[1:]) / np.abs(carrier))


def slopes(pivot: np.ndarray, rot: np.ndarray, rf_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives of both by pivot, rotation and coefficient."""
    phase, amplitude = [], []
    base = np.concatenate([np.zeros(6), G])
    for a in range(8):
        step = np.zeros(8)
        step[a] = 1e-6
        up, down = (observables(pivot, rot, base + s * step, rf_hz) for s in (1, -1))
        phase.append(np.angle(np.exp(1j * (up[0] - down[0]))) / 2e-6)
        amplitude.append((up[1] - down[1]) / 2e-6)
    return np.stack(phase, axis=-1), np.stack(amplitude, axis=-1)


def information(slope: np.ndarray, sigma: float, free: bool) -> np.ndarray:
    """Of (group, receiver, transmitter, unknown); ``free``: the mean over receivers is anything."""
    left = slope - slope.mean(axis=1, keepdims=True) if free else slope
    flat = left.reshape(-1, slope.shape[-1])
    return flat.T @ flat / sigma**2


def bound(rf_hz: float, amplitude_sigma: float | None, known_modulation: bool) -> tuple[float, float]:
    """Return the normal's rms bound over mirrors [mrad], and the coefficient's sigma."""
    rng = np.random.default_rng(4)
    radius, angle = 100.0 * np.sqrt(rng.uniform(0.02, 0.9, N_MIRROR)), rng.uniform(0, 2 * np.pi, N_MIRROR)
    own, cross, total = [], [], np.zeros((2, 2))
    normals = rng.standard_normal((N_MIRROR, 3)) + np.array([0.0, 0.0, 1.5])
    for r, a, normal in zip(radius, angle, normals, strict=True):
        rot = rot_enu_from_mirror(normal)
        phase, amplitude = slopes(np.array([r * np.cos(a), r * np.sin(a), 2.5]), rot, rf_hz)
        info = information(phase, PHASE_SIGMA, True)
        info[:3, :3] += np.eye(3) / 0.005**2
        if amplitude_sigma is not None:
            info += information(amplitude, amplitude_sigma, not known_modulation)
        inverse = np.linalg.inv(info[:6, :6])
        own.append((inverse, rot[:, 2]))
        cross.append(-inverse @ info[:6, 6:])
        total += info[6:, 6:] - info[6:, :6] @ inverse @ info[:6, 6:]
    shared = np.linalg.inv(total)
    tilt = []
    for (inverse, normal), follow in zip(own, cross, strict=True):
        cov = (inverse + follow @ shared @ follow.T)[3:, 3:]
        tilt.append(np.trace(cov) - normal @ cov @ normal)
    return 1e3 * float(np.sqrt(np.mean(tilt))), float(np.sqrt(np.trace(shared)))


def main() -> None:
    """Print the table of docs/ground-reflection.md."""
    forms = {
        "phases": (None, True),
        "noise only, modulation known": (np.sqrt(2.0) * PHASE_SIGMA, True),
        "noise only, modulation unknown": (np.sqrt(2.0) * PHASE_SIGMA, False),
        "filters flat to 0.1 %": (1e-3, False),
        "filters flat to 1 %": (1e-2, False),
    }
    print("| RF [MHz] | " + " | ".join(forms) + " |")
    print("|---" * (1 + len(forms)) + "|")
    for rf_hz in (30e6, 100e6, 433e6):
        cells = [bound(rf_hz, *form) for form in forms.values()]
        print(f"| {rf_hz / 1e6:.0f} | " + " | ".join(f"{tilt:.4f}, {sigma:.1e}" for tilt, sigma in cells) + " |")


if __name__ == "__main__":
    main()
