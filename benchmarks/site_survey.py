"""What a survey by radio makes of receivers that are 1 mm off, and of mounts in a real field.

    python benchmarks/site_survey.py
    python benchmarks/site_survey.py --traced ../shared/data/traced --tables TABLES --patterns PATTERNS

Without tables there is no multipath: five heliostats of table2_100m.toml at 433 MHz, pivots known to 3 mm, 12 postures
of a day, receivers off by 1 mm in each axis; a camera measures every second posture to 0.1 mrad. Errors of normals
before and after.

With tables (`benchmarks/real_field.py` says what they are; ``open_433MHz_sun0`` and on, a posture each) eight mirrors
stand in the traced field with all that it has: ground, tower, neighbours, the own plate by moments, its pattern given.
Their mounts lean by 3 mrad, have zeros that are 8 mrad off and axes 1 mrad out of square; control knows nothing of it.
What a survey of the first so many postures finds of that is held against the truth, its covariance with it; "white"
takes frames for independent, as they are not.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import rfpose as rf
from rfpose.feedback.correlated import AXES_AND_ZEROS
from rfpose.feedback.mount import Mount, command, posture
from rfpose.geometry import unit
from rfpose.multilat.site import PostureCorrelation

SEED = 4
N_HELIOSTAT = 5
CAMERA_RAD = 1e-4
MOUNT_SIGMA = dict(zip(AXES_AND_ZEROS, (3e-3, 3e-3, 8e-3, 8e-3, 1e-3), strict=True))
POSTURES = (5, 10, 20)


def sites():
    """Return the site as it is known, and as it is built."""
    rng = np.random.default_rng(SEED)
    base = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    told = {"pivot_sigma_m": 0.003, "receiver_delay_sigma_s": 0.0}
    known = base.changed(
        heliostat=[h.changed(**told) for h in base.heliostat[:N_HELIOSTAT]],
        site={"aim_enu_m": [0.0, 0.0, 50.0]},
        radio={"frame_samples": 20_000, "centre_frequency_hz": 433e6},
        posture={"sigma_rad": 0.005},
        multipath={"foresee": [], "visibility": False},
        simulation={"frame_count": 12, "sun_azimuth_deg": [110.0, 250.0], "sun_elevation_deg": [30.0, 60.0]},
    )
    heliostats = []
    for h in known.heliostat:
        places = np.array(h.receiver_mirror_m) + 1e-3 * rng.standard_normal((len(h.receiver_mirror_m), 3))
        heliostats.append(h.changed(receiver_mirror_m=places.tolist()))
    return known, known.changed(heliostat=heliostats), rng


def show(name, result):
    """Print error and stated sigma of a result's normals."""
    error = rf.evaluate(result).normal_error_mrad.rms
    print(f"{name:40s} {error:8.4f} {1e3 * np.sqrt(np.nanmean(result.poses.sigma_rad**2)):8.4f}")


def without_multipath():
    """Print the table of places."""
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
            report = found.as_dict()["heliostats"]["H01"]
            print(f"  {took:.0f} s; {known.heliostat_ids[0]}: {report['normal_sigma_mrad']}")
            print(f"  mount: {report['mount']['normal_sigma_mrad']}, scatter {report['mount']['scatter']:.2f}")
            print(f"  not determined: {'; '.join(found.undetermined[0])}")


# -- mounts in the traced field ------------------------------------------------------------------------------


def true_mounts(site):
    """Return mounts as they are, and as control believes them to be."""
    rng = np.random.default_rng([SEED, 1])
    planned = [Mount(pivot_enu_m=np.array(h.pivot_enu_m)) for h in site.heliostat]
    off = [{name: sigma * float(rng.standard_normal()) for name, sigma in MOUNT_SIGMA.items()} for _ in planned]
    return [mount.replace(**values) for mount, values in zip(planned, off, strict=True)], planned


def traced_case(folders, spec, suns):
    """Return a case whose mirrors were told by control, which knows no error of their mounts, and those mounts."""
    import real_field

    case = real_field.case_of(spec, folders, suns)
    if isinstance(case, str):
        sys.exit(f"{folders.own}: {case}; trace it with benchmarks/real_field_tables.py")
    mounts, planned = true_mounts(case.scenario)
    told = real_field.told_normals(case)
    for i, (true, believed) in enumerate(zip(mounts, planned, strict=True)):
        count = command(true, sun_enu=case.normal_true_enu[:, i], mode="dish").count
        told[:, i] = posture(believed, count).normal_enu
    csv = real_field.posture_table(case.scenario, told)
    return replace(case, scenario=case.scenario.changed(posture={"csv": str(csv)})), mounts


class Judged:
    """What surveys found of mounts, against the truth."""

    def __init__(self):
        self.error, self.cov, self.normal, self.normal_sigma = [], [], [], []

    def take(self, parameter, cov, true, normal_true, normal_sigma):
        """Take one mirror: its parameters, their covariance, the mount as it is, postures to be held against."""
        self.error.append(parameter - np.array([true.parameters[name] for name in AXES_AND_ZEROS]))
        self.cov.append(cov)
        found = true.replace(**dict(zip(AXES_AND_ZEROS, parameter.tolist(), strict=True)))
        count = command(true, sun_enu=normal_true, mode="dish").count
        self.normal.append(posture(found, count).normal_enu - normal_true)
        self.normal_sigma.append(normal_sigma)

    def row(self):
        """Return rms of normals and what was stated, NEES of parameters, and their rms."""
        error = np.array(self.error)
        nees = np.einsum("mp,mpq,mq->", error, np.linalg.inv(np.array(self.cov)), error) / error.size
        normal = np.sqrt(np.mean(np.sum(np.array(self.normal) ** 2, axis=-1)))
        stated = np.sqrt(np.mean(np.square(self.normal_sigma)))
        return 1e3 * normal, 1e3 * stated, nees, 1e3 * np.sqrt(np.mean(error**2, axis=0))


def in_the_field(options):
    """Print the table of mounts."""
    import real_field

    from rfpose.pipeline.site.mounts import planned_mounts
    from rfpose.pipeline.survey import Frames, SurveyKnowledge, survey_frames

    folders = real_field.Folders(given=options.traced, own=options.tables, patterns=options.patterns)
    suns = [sun for sun in range(40) if folders.table("open", 433.0, sun) is not None]
    name = f"everything, 433 MHz, pattern {options.told}; {options.place}"
    spec = next(s for s in real_field.specs() if s.name == name)
    case, mounts = traced_case(folders, spec, suns)
    site, tones = case.scenario, case.tones
    print(f"{options.place}, pattern {options.told}; {len(suns)} tables")
    print(
        "| postures | worth | share, angle | mount's normal rms, stated [mrad] | NEES | tilts, zeros, square [mrad] |"
    )
    print("|---|---|---|---|---|---|", flush=True)
    white = PostureCorrelation(share=0.0, angle_rad=1.0)
    runs = [(n, None) for n in options.postures] + [(max(options.postures), white)]
    for n, correlation in runs:
        if n > len(suns):
            print(f"| {n} | no so many tables |")
            continue
        frames = Frames(carrier=tones.carrier[:n], sigma=tones.carrier_sigma[:n], unix_s=np.full(n, np.nan))
        begin = time.perf_counter()
        found = survey_frames(
            [frames], site, SurveyKnowledge(mounts=planned_mounts(site, None), correlation=correlation)
        )
        took = time.perf_counter() - begin
        judged = Judged()
        for i, true in enumerate(mounts):
            own = found.mounts
            judged.take(own.parameter[i], own.cov[i], true, case.normal_true_enu[:, i], own.normal_sigma_rad[i, 1])
        rms, stated, nees, each = judged.row()
        angle, share = np.degrees(found.correlation_rad[0]), found.correlation_share[0]
        alike = f"{share:.2f}, {angle:.1f}°" if correlation is None else "taken for white"
        parameters = ", ".join(f"{x:.2f}" for x in each)
        print(
            f"| {n} | {found.frame_worth.mean():.1f} | {alike} | {rms:.2f}, {stated:.2f} | {nees:.2f} | {parameters} |"
        )
        print(f"{took:.0f} s; scatter {np.round(found.mounts.scatter, 2)}", file=sys.stderr, flush=True)


def main():
    """Print the tables asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--traced", type=Path, help="../shared/data/traced: mounts in the traced field")
    parser.add_argument("--tables", type=Path, help="ray tables of one's own")
    parser.add_argument("--patterns", type=Path, help="antenna patterns")
    parser.add_argument("--place", choices=("beside", "front"), default="beside")
    parser.add_argument("--told", choices=("given", "learned", "none", "other mesh"), default="given")
    parser.add_argument("--postures", type=int, nargs="*", default=POSTURES)
    options = parser.parse_args()
    if options.traced is None:
        without_multipath()
    else:
        in_the_field(options)


if __name__ == "__main__":
    main()
