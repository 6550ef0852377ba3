"""An antenna pattern out of recordings: against currents of the test's own making, through samples and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import rfpose as rf
from rfpose import geometry
from rfpose.antenna import dipole_pattern, learn
from rfpose.cli._app import app
from rfpose.errors import InvalidInputError, ScenarioError
from rfpose.feedback.correlated import AXES_AND_ZEROS
from rfpose.feedback.mount import Mount, command, posture
from rfpose.pipeline.formats.antenna_file import read_pattern
from rfpose.pipeline.learn import learn_from_frames
from rfpose.pipeline.postures import commanded_normals
from rfpose.pipeline.site.frames import measured_frames
from rfpose.pipeline.survey import SurveyKnowledge, survey_frames
from told import undocumented, unseen

RF_HZ = 433e6
SPEED = 299_792_458.0
PLACES = np.array([[0.35, 0.1, 0.1], [-0.2, 0.35, 0.1], [-0.2, -0.3, 0.12]])
N_FRAME, N_MIRROR = 12, 4
OFF_RAD = 3e-3


def true_vectors(direction, receiver):
    """Effective lengths (n, xyz) of a dipole with currents at places of their own, off any grid, on the plate."""
    rng = np.random.default_rng([5, receiver])
    place = np.column_stack([rng.uniform(-0.33, 0.33, (12, 2)), np.zeros(12)]) - PLACES[receiver]
    size = 0.15 * 0.2 / np.maximum(np.linalg.norm(place, axis=1), 0.1)
    current = size[:, None] * (rng.standard_normal((12, 2)) + 1j * rng.standard_normal((12, 2)))
    turned = np.exp(2j * np.pi * RF_HZ / SPEED * (direction @ place.T))
    whole = np.pad(turned @ current, ((0, 0), (0, 1))) + np.array([0.0, 0.9 + 0.1j, 0.0])
    return whole - np.sum(whole * direction, axis=1, keepdims=True) * direction


def table(path, site, normal):
    """Write the direct rays of one posture, weighed by the true antennas, as a ray table."""
    rot = geometry.rot_enu_from_mirror(normal)
    names, places, columns = [], [], []
    for h, r in zip(site.heliostat, rot, strict=True):
        for k in range(len(PLACES)):
            here = h.pivot_enu_m + r @ PLACES[k]
            to = site.transmitter_enu_m - here
            length = np.linalg.norm(to, axis=1)
            to = to / length[:, None]
            theta = np.column_stack(
                [to[:, 2:] * to[:, :2] / np.hypot(to[:, 0], to[:, 1])[:, None], -np.hypot(to[:, 0], to[:, 1])]
            )
            voltage = np.sum((theta @ r) * true_vectors(to @ r, k), axis=1)
            size = SPEED / RF_HZ / (4.0 * np.pi * length)
            for t in range(len(to)):
                columns.append(
                    (
                        len(names),
                        t,
                        size[t] * voltage[t],
                        length[t],
                        np.arccos(to[t, 2]),
                        np.arctan2(to[t, 1], to[t, 0]),
                    )
                )
            names.append(h.receiver_ids[k])
            places.append(here)
    rx, tx, amplitude, length, theta, phi = (np.array(x) for x in zip(*columns, strict=True))
    np.savez(
        path, rx=rx, tx=tx, a_theta=amplitude, a_phi=np.zeros_like(amplitude), length_m=length, theta_t=theta,
        theta_r=theta, phi_r=phi, code=np.full(len(rx), ""), rx_names=np.array(names), rx_enu_m=np.array(places),
        tx_enu_m=np.array(site.transmitter_enu_m), frequency_hz=RF_HZ,
    )  # fmt: skip


def write_postures(path, names, normal):
    lines = ["id,frame,normal_e,normal_n,normal_u"]
    for f, one in enumerate(normal.tolist()):
        lines += [f"{name},{f},{n[0]},{n[1]},{n[2]}" for name, n in zip(names, one, strict=True)]
    path.write_text("\n".join(lines))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("lessons")


@pytest.fixture(scope="module")
def lessons(folder):
    """The site, its recording, and the true normals; postures are told to 3 mrad."""
    base = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    told = {
        "pivot_sigma_m": 0.003, "receiver_delay_sigma_s": 0.0, "receiver_mirror_m": PLACES.tolist(), "width_m": 0.7,
        "height_m": 0.7,
    }  # fmt: skip
    rng = np.random.default_rng(3)
    site = base.changed(
        heliostat=[h.changed(**told) for h in base.heliostat[:N_MIRROR]],
        transmitter=[t.changed(carrier_hz=-495e3 + 110e3 * k) for k, t in enumerate(base.transmitter)],
        calibration_receiver=[],
        site={"aim_enu_m": [0.0, 0.0, 50.0]},
        radio={"frame_samples": 20_000, "centre_frequency_hz": RF_HZ},
        multipath={"foresee": [], "visibility": False},
        simulation={"frame_count": N_FRAME, "sun_azimuth_deg": [100.0, 260.0], "sun_elevation_deg": [15.0, 65.0]},
    )
    normal = commanded_normals(site, np.full(N_FRAME, np.nan))
    names = list(site.heliostat_ids)
    paths = [str(folder / f"table{f}.npz") for f in range(N_FRAME)]
    for path, one in zip(paths, normal, strict=True):
        table(path, site, one)
    off = OFF_RAD / np.sqrt(2.0) * rng.standard_normal(normal.shape)
    write_postures(folder / "true.csv", names, normal)
    write_postures(folder / "told.csv", names, geometry.unit(normal + off))
    site = site.changed(posture={"csv": str(folder / "told.csv"), "sigma_rad": OFF_RAD})
    recording = rf.simulate(site.changed(simulation={"paths": paths}), seed=1)
    return site, recording, normal


def errors(pattern, heard=None, n=600):
    """Errors of effective lengths (n, xyz) after the best common factor, and their told sigma (n,).

    With ``heard``, where rays came from alone.
    """
    direction = geometry.unit(np.random.default_rng(9).standard_normal((n, 3)))
    receiver = np.arange(n) % len(PLACES)
    if heard is not None:
        n_polar, n_azimuth = heard.shape[1:]
        polar = np.rint(np.arccos(direction[:, 2]) / np.pi * (n_polar - 1)).astype(int)
        azimuth = np.rint(np.arctan2(direction[:, 1], direction[:, 0]) / (2.0 * np.pi) * n_azimuth).astype(int)
        told = heard[receiver, polar, azimuth % n_azimuth] > 0
        direction, receiver = direction[told], receiver[told]
    found, _, sigma = pattern.table(RF_HZ).vector_and_slope(direction, receiver)
    truth = np.array([true_vectors(d[None], r)[0] for d, r in zip(direction, receiver, strict=True)])
    factor = np.vdot(found, truth) / np.vdot(found, found)
    return factor * found - truth, abs(factor) * sigma


@pytest.fixture(scope="module")
def learned(folder, lessons):
    site, recording, _ = lessons
    path = folder / "learned.h5"
    return rf.learn_pattern(recording, path, scenario=site), path


def test_a_pattern_is_learned_from_samples(learned):
    found, _ = learned
    error, sigma = errors(found.pattern, found.heard)
    lone, _ = errors(dipole_pattern(PLACES, [0, 1, 0], RF_HZ), found.heard)
    assert np.linalg.norm(error) < 0.25 * np.linalg.norm(lone)
    # true currents lie off the grid that stands for them: errors up to twice what is told, see the docs
    assert 0.4 < np.mean(np.sum(np.abs(error) ** 2, axis=1) / (4.0 * sigma**2)) < 5.0
    for said in ("48 postures", "in postures held out", "that no ray came from", "undetermined: a factor"):
        assert said in found.report()


def test_poses_with_the_learned_pattern_are_better(lessons, learned):
    site, recording, normal = lessons
    # as badly told as control would have it
    site = site.changed(posture={"sigma_rad": 0.02})

    def rms(antenna):
        found = rf.process(recording, scenario=site.changed(antenna=antenna), pose="site").poses.normal_enu
        return np.sqrt(np.nanmean(geometry.angle_between_rad(found, normal) ** 2))

    assert rms({"pattern": str(learned[1])}) < 0.3 * rms({"receiver": "dipole"})
    assert read_pattern(learned[1]).made_by["learned_from"] == "48 postures"


def test_the_command_writes_and_reports(lessons, folder):
    site, recording, _ = lessons
    recording.save(folder / "lessons.h5")
    (folder / "site.toml").write_text(site.to_toml())
    words = ["antenna", "learn", str(folder / "lessons.h5"), "--scenario", str(folder / "site.toml"), "-o"]
    run = CliRunner().invoke(app, [*words, str(folder / "one.h5"), "--json"])
    assert run.exit_code == 0, run.output
    report = json.loads(run.stdout)
    assert (report["postures"], report["settled"], len(report["unheard"])) == (48, True, 3)
    assert report["explained"] > 0.8
    assert not undocumented("antenna learn", [report])
    assert not unseen("antenna learn", [report])
    again = CliRunner().invoke(app, [*words, str(folder / "one.h5")])
    assert again.exit_code == 3
    assert "exists already" in again.output


def test_what_has_not_settled_is_not_written(lessons, folder, monkeypatch):
    site, recording, _ = lessons
    monkeypatch.setattr(learn, "_MOST_ROUNDS", 2)
    with pytest.raises(InvalidInputError, match=r"did not settle: .* of 48 postures believed to 3 mrad; record more"):
        rf.learn_pattern(recording, folder / "unsettled.h5", scenario=site)
    assert not (folder / "unsettled.h5").exists()


def test_a_posture_that_is_repeated_counts_once(lessons, folder):
    site, recording, normal = lessons
    write_postures(folder / "still.csv", site.heliostat_ids, np.repeat(normal[:1], N_FRAME, axis=0))
    still = site.changed(posture={"csv": str(folder / "still.csv")})
    with pytest.raises(InvalidInputError, match=r"4 postures .* of 48 mirrors in 12 frames .* from 10 or more"):
        rf.learn_pattern(recording, scenario=still)
    frames, _ = measured_frames(recording, site, follow_links=False)
    deaf = replace(frames, carrier=np.where(np.arange(N_FRAME)[:, None, None] < 2, frames.carrier, np.nan))
    with pytest.raises(InvalidInputError, match=r"8 postures .* of 8 mirrors in 12 frames that were heard"):
        learn_from_frames([deaf], site)


def without_outline(site):
    return site.changed(heliostat={"width_m": None, "height_m": None})


def one_larger(site):
    one, other, *more = site.heliostat
    return site.changed(heliostat=[one, other.changed(width_m=0.8), *more])


def test_carriers_too_far_apart_for_one_pattern_are_refused(lessons):
    site, _, _ = lessons
    wide = [t.changed(carrier_hz=36.0 * t.carrier_hz) for t in site.transmitter]
    with pytest.raises(ScenarioError, match=r"reach from 415\.18 to 450\.82 MHz, and a learned .* within 2 %"):
        learn_from_frames([], site.changed(transmitter=wide))


@pytest.mark.parametrize(
    ("change", "said"),
    [(without_outline, "`H01` has no outline"), (one_larger, "`H01` and `H02` differ in `width_m`")],
)
def test_mirrors_that_are_no_type_are_refused(lessons, change, said):
    site, recording, _ = lessons
    with pytest.raises(ScenarioError, match=said):
        rf.learn_pattern(recording, scenario=change(site))


def test_a_surveys_mounts_tell_where_mirrors_stand(lessons, learned, folder):
    site, recording, normal = lessons
    rng = np.random.default_rng(6)
    names = list(site.heliostat_ids)
    planned = [Mount(pivot_enu_m=np.array(h.pivot_enu_m)) for h in site.heliostat]
    off = 0.03 * rng.standard_normal((N_MIRROR, len(AXES_AND_ZEROS))) * [0.2, 0.2, 1.0, 1.0, 0.05]
    true = [m.replace(**dict(zip(AXES_AND_ZEROS, o, strict=True))) for m, o in zip(planned, off.tolist(), strict=True)]
    told = np.stack(
        [
            posture(p, command(m, sun_enu=normal[:, i], mode="dish").count).normal_enu
            for i, (m, p) in enumerate(zip(true, planned, strict=True))
        ],
        axis=1,
    )
    write_postures(folder / "control.csv", names, told)
    site = site.changed(posture={"csv": str(folder / "control.csv"), "sigma_rad": 0.02})
    frames, _ = measured_frames(recording, site, follow_links=False)
    two = replace(frames, carrier=frames.carrier[:2], sigma=frames.sigma[:2], unix_s=frames.unix_s[:2])
    found = survey_frames([two], site.changed(antenna={"receiver": "dipole"}), SurveyKnowledge(mounts=planned))
    exact = replace(found.mounts, parameter=off, normal_sigma_rad=np.full(found.mounts.normal_sigma_rad.shape, 1e-3))
    as_known = replace(
        found, mounts=exact, pivot_enu_m=site.pivot_enu_m, transmitter_enu_m=np.array(site.transmitter_enu_m),
        receiver_mirror_m=np.tile(PLACES, (N_MIRROR, 1, 1)),
    )  # fmt: skip
    with_survey = learn_from_frames([frames], site, survey=as_known)
    assert with_survey.floor < 1.2 * learned[0].floor
    error, _ = errors(with_survey.pattern)
    as_told, _ = errors(learned[0].pattern)
    assert np.linalg.norm(error) < 1.2 * np.linalg.norm(as_told)
