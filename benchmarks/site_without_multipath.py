"""What pose `site` loses where there is no multipath: its normals beside pose `rigid`'s and the bound.

    python benchmarks/site_without_multipath.py [--frames 100]

Table 2 at 100 m, twelve heliostats, carriers of 433 MHz, pivots surveyed to 5 mm, a shared oscillator; direct rays and
noise alone, simulated as IQ samples at several signal-to-noise ratios. Rms error of the normal in mrad, its ratio and
that of the stated sigma to the bound of pose `rigid` with all tones and carriers, and the tail found (Student's t).
"""

from __future__ import annotations

import argparse

import rfpose as rf

SNR_DB = (10.0, 30.0, 50.0)


def site(snr_db: float, frames: int) -> rf.Scenario:
    """Return the scenario."""
    plain = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    known = {"pivot_sigma_m": 0.005, "oscillator": "shared", "receiver_delay_sigma_s": 0.0}
    return plain.changed(
        heliostat=known,
        radio={"frame_samples": 20_000, "centre_frequency_hz": 433e6},
        simulation={"tone_snr_db": snr_db, "frame_count": frames, "sample_format": "complex64"},
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=100)
    frames = parser.parse_args().frames
    print("| tone SNR [dB] | pose | solved | rms [mrad] | over the bound | stated over the bound | tail |")
    print("|---|---|---|---|---|---|---|")
    for snr_db in SNR_DB:
        recording = rf.simulate(site(snr_db, frames), seed=1)
        for pose in ("rigid", "site"):
            result = rf.process(recording, estimator="correlator", pose=pose)
            found = rf.evaluate(result).as_dict()
            rms, bound = found["normal_error_mrad"]["rms"], found["bound_mrad"]["rms"]
            stated = found["sigma_mrad"]["rms"] / bound
            solved = f"{found['solved']}/{found['solved'] + found['failed']}"
            tail = "" if result.site is None else f"{result.site.tail[0]:g}"
            ratios = f"{rms / bound:.3f} | {stated:.3f}"
            print(f"| {snr_db:g} | {pose} | {solved} | {rms:.4g} | {ratios} | {tail} |", flush=True)


if __name__ == "__main__":
    main()
