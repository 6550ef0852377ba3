"""What a survey by radio makes of receivers that are 1 mm off: errors of normals before and after, no multipath.

    python benchmarks/site_survey.py

Five heliostats of table2_100m.toml at 433 MHz, pivots known to 3 mm, 12 postures of a day, receivers off by 1 mm in
each axis; a camera measures every second posture to 0.1 mrad.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

import rfpose as rf
from rfpose.geometry import unit

SEED = 4
N_HELIOSTAT = 5
CAMERA_RAD = 1e-4


def sites():
    """Return the site as it is known, and as it is built."""
    rng = np.random.default_rng(SEED)
    base = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    told = {"pivot_sigma_m": 0.003, "receiver_delay_sigma_s": 0.0}
    known = base.changed(
        heliostat=[{**h.model_dump(exclude_none=True), **told} for h in base.heliostat[:N_HELIOSTAT]],
        site={"aim_enu_m": [0.0, 0.0, 50.0]},
        radio={"frame_samples": 20_000, "centre_frequency_hz": 433e6},
        posture={"sigma_rad": 0.005},
        multipath={"foresee": [], "visibility": False},
        simulation={"frame_count": 12, "sun_azimuth_deg": [110.0, 250.0], "sun_elevation_deg": [30.0, 60.0]},
    )
    heliostats = []
    for h in known.heliostat:
        places = np.array(h.receiver_mirror_m) + 1e-3 * rng.standard_normal((len(h.receiver_mirror_m), 3))
        heliostats.append({**h.model_dump(exclude_none=True), "receiver_mirror_m": places.tolist()})
    return known, known.changed(heliostat=heliostats), rng


def show(name, result):
    """Print error and stated sigma of a result's normals."""
    error = rf.evaluate(result).normal_error_mrad.rms
    print(f"{name:40s} {error:8.4f} {1e3 * np.sqrt(np.nanmean(result.poses.sigma_rad**2)):8.4f}")


def main():
    """Print the table."""
    known, built, rng = sites()
    recording = rf.simulate(built, seed=2)
    truth = recording.truth
    with tempfile.TemporaryDirectory() as folder:
        camera = Path(folder) / "camera.csv"
        lines = ["id,frame,normal_e,normal_n,normal_u"]
        for f in range(0, 12, 2):
            measured = unit(truth.normal_enu[f] + CAMERA_RAD * rng.standard_normal(truth.normal_enu[f].shape))
            lines += [f"{h},{f},{n[0]},{n[1]},{n[2]}" for h, n in zip(truth.heliostat_ids, measured, strict=True)]
        camera.write_text("\n".join(lines))
        print(f"{'normals [mrad]':40s} {'error':>8s} {'sigma':>8s}")
        show("places as surveyed by hand", rf.process(recording, scenario=known, pose="site"))
        show("places as built", rf.process(recording, scenario=built, pose="site"))
        for name, reference in (("survey by radio", None), ("survey by radio and camera", camera)):
            begin = time.perf_counter()
            path = Path(folder) / "survey.h5"
            found = rf.survey([recording], path, scenario=known, reference=reference, force=True)
            took = time.perf_counter() - begin
            show(name, rf.process(recording, scenario=known, pose="site", survey=path))
            print(
                f"  {took:.0f} s; {known.heliostat_ids[0]}: {found.as_dict()['heliostats']['H01']['normal_sigma_mrad']}"
            )
            print(f"  not determined: {'; '.join(found.undetermined[0])}")


if __name__ == "__main__":
    main()
