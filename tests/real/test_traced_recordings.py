"""Recordings made of ray tables that this project did not write carry what the tables sum up to, through the DSP."""

import re
from pathlib import Path

import numpy as np
import pytest

import rfpose as rf
from rfpose.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data" / "traced" / "paths"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"{DATA} is absent")
SPEED = 299_792_458.0
RF_HZ = 433e6


@pytest.mark.parametrize(("variant", "without"), [("field", None), ("edges", "D:ground")])
def test_carriers_and_sidebands_are_the_sums_of_the_tables(variant, without, figure):
    """Products of two receivers' lines, which know no common phase, against sums written here: off by noise alone."""
    site = load_scenario(ROOT / "benchmarks" / "real_field.toml").changed(
        simulation={
            "frame_count": 2,
            "frame_interval_s": 60.0,
            "sun_azimuth_deg": (120.0, 180.0),
            "sun_elevation_deg": (35.0, 60.0),
            "paths": [str(DATA / f"{variant}_433MHz_sun{k}.npz") for k in (0, 1)],
            "paths_without": () if without is None else (without,),
            "reference_range_m": 60.0,
            "tone_snr_db": 50.0,
            "sample_format": "complex64",
        }
    )
    recording = rf.simulate(site, seed=1)
    tones = rf.process(recording, estimator="correlator").tones
    owner = [r.oscillator for r in site.receivers]
    pairs = [(r, owner.index(o)) for r, o in enumerate(owner) if owner.index(o) != r]
    share = np.array([1.0, 0.225, 0.225, 0.225, 0.225])
    sigma = 0.45 * 10.0 ** (-50.0 / 20.0) / np.sqrt(2.0 * site.radio.frame_samples)
    off = []
    for frame in (0, 1):
        expected, place = summed(site, variant, frame, without)
        np.testing.assert_array_equal(recording.truth.receiver_enu_m[frame], place)
        seen = np.concatenate(
            [tones.carrier[frame][..., None], tones.sideband[frame].reshape(len(owner), 10, 4)], axis=2
        )
        lines = expected * share
        for a, b in pairs:
            wrong = seen[a] * seen[b].conj() - lines[a] * lines[b].conj()
            spread = sigma * np.sqrt(np.abs(lines[a]) ** 2 + np.abs(lines[b]) ** 2 + 2.0 * sigma**2)
            off.append(wrong.real / spread)
    rms = float(np.sqrt(np.mean(np.square(off))))
    figure(f"lines of traced rays ({variant}) against their sums, over noise", rms, "")
    assert abs(rms - 1.0) < 5.0 / np.sqrt(2.0 * 0.3 * np.size(off))  # pairs share a receiver: fewer are independent


def summed(site, variant, frame, without):
    """(receiver, transmitter, line) sums over a table's rays at each line's own frequency, and the places."""
    with np.load(DATA / f"{variant}_433MHz_sun{frame}.npz") as table:
        t = {key: table[key] for key in table.files}
    keep = np.array([without is None or re.search(without, str(c)) is None for c in t["code"]])
    names = [str(n) for n in t["rx_names"]]
    rows = [names.index(f"front:{n}") if f"front:{n}" in names else names.index(n) for n in site.receiver_ids]
    scale = 4.0 * np.pi * 60.0 * RF_HZ / SPEED
    out = np.zeros((len(names), 10, 5), complex)
    for k, offset in enumerate((0.0, 750e3, -750e3, 7.5e6, -7.5e6)):
        f = RF_HZ + site.carrier_hz[t["tx"]] + offset
        ray = scale * t["a_theta"] * np.exp(-2j * np.pi * f * t["length_m"] / SPEED)
        np.add.at(out[:, :, k], (t["rx"][keep], t["tx"][keep]), ray[keep])
    return out[rows], t["rx_enu_m"][rows]
