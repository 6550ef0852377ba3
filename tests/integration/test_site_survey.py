"""A survey by radio from recordings to the poses that use it, and its file."""

import json
from dataclasses import replace
from datetime import UTC, datetime

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import chi2

import rfpose as rf
from damage import damage_hdf5
from rfpose.cli._app import app
from rfpose.errors import InvalidInputError, RecordingError, RfposeError, ScenarioError
from rfpose.feedback.correlated import AXES_AND_ZEROS
from rfpose.feedback.mount import Mount, command, posture
from rfpose.multilat.site import lever_to_turn
from rfpose.pipeline.formats.survey_file import read_survey
from rfpose.pipeline.site.frames import frames_of, inputs_of, listed
from rfpose.recording import RecordingWriter, frame_starts


@pytest.fixture(scope="module")
def site():
    base = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    return base.changed(
        heliostat=[h.changed(pivot_sigma_m=0.003, receiver_delay_sigma_s=0.0) for h in base.heliostat[:3]],
        site={"aim_enu_m": [0.0, 0.0, 50.0]},
        radio={"frame_samples": 20_000, "centre_frequency_hz": 433e6},
        posture={"sigma_rad": 0.005},
        multipath={"foresee": [], "visibility": False},
        simulation={"frame_count": 12, "sun_azimuth_deg": [110.0, 250.0], "sun_elevation_deg": [30.0, 60.0]},
    )


@pytest.fixture(scope="module")
def recording(site):
    rng = np.random.default_rng(4)
    built = site.changed(
        heliostat=[
            h.changed(receiver_mirror_m=(np.array(h.receiver_mirror_m) + 1e-3 * rng.standard_normal((3, 3))).tolist())
            for h in site.heliostat
        ]
    )
    return rf.simulate(built, seed=2)


@pytest.fixture(scope="module")
def reference(recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("camera") / "camera.csv"
    truth = recording.truth
    lines = ["id,frame,normal_e,normal_n,normal_u"]
    for f in range(0, 12, 2):
        lines += [
            f"{name},{f},{n[0]},{n[1]},{n[2]}" for name, n in zip(truth.heliostat_ids, truth.normal_enu[f], strict=True)
        ]
    path.write_text("\n".join(lines))
    return path


@pytest.fixture(scope="module")
def surveyed(site, recording, reference, tmp_path_factory):
    path = tmp_path_factory.mktemp("found") / "survey.h5"
    rf.survey([recording], path, scenario=site, reference=reference)
    return path


def test_parts_are_one_recording(site, recording, tmp_path):
    """Receivers in files of their own; each file alone would know nothing of how transmitters' phases drift."""
    folder = tmp_path / "night"
    folder.mkdir()
    names = np.array_split(np.array(recording.receiver_ids), 2)
    settings = {
        key: getattr(recording, key) for key in ("sample_rate", "centre_frequency_hz", "sample_format", "full_scale")
    }
    for k, part in enumerate(names):
        path = folder / f"{k}.h5"
        with RecordingWriter(path, scenario=site, receiver_ids=part.tolist(), provenance={}, **settings) as writer:
            for name in part.tolist():
                for start, count in recording.blocks(name).tolist():
                    writer.write(name, start, recording.read(name, start, count))
    parts = sorted(folder.iterdir())
    for given in (parts, [folder], [parts]):
        many = listed(given)
        assert len(many) == 1
        assert set(inputs_of(many)) >= set(parts)
    (wanted,), _ = frames_of([recording], site, follow_links=False)
    (found,), _ = frames_of(listed(parts), site, follow_links=False)
    assert np.isfinite(found.carrier).all()
    assert found.carrier.tobytes() == wanted.carrier.tobytes()
    assert found.unix_s.tobytes() == wanted.unix_s.tobytes()
    # nights of the same receivers stand by themselves
    recording.save(tmp_path / "whole.h5")
    assert listed([tmp_path / "whole.h5"] * 2) == [tmp_path / "whole.h5"] * 2


def rms_mrad(result):
    return rf.evaluate(result).normal_error_mrad.rms


def test_poses_with_a_survey_are_better_and_know_it(site, recording, surveyed):
    before = rf.process(recording, scenario=site, pose="site")
    after = rf.process(recording, scenario=site, pose="site", survey=surveyed)
    was, now = rms_mrad(before), rms_mrad(after)
    assert was > 0.4
    assert now < 0.35 * was
    assert now < 3.0 * 1e3 * np.sqrt(np.mean(after.poses.sigma_rad**2))
    # what the survey leaves open of a turn of the receivers is in every pose, and hardly anything else
    found = read_survey(surveyed)
    levers = [lever_to_turn(place)[:2] for place in found.receiver_mirror_m]
    left = [lever @ cov @ lever.T for lever, cov in zip(levers, found.receiver_cov_m2, strict=True)]
    turn = np.sqrt([np.trace(one) for one in left])
    assert np.all(turn > 1e-5)
    np.testing.assert_allclose(after.poses.sigma_rad, np.broadcast_to(turn, after.poses.sigma_rad.shape), rtol=0.01)
    worst = np.sqrt([np.linalg.eigvalsh(one)[-1] for one in left])
    level = np.sqrt(-2.0 * np.log(site.integrity.missed_detection)) * worst
    assert after.integrity is not None
    np.testing.assert_allclose(
        after.integrity.protection_level_rad, np.broadcast_to(level, after.poses.sigma_rad.shape), rtol=0.1
    )


def test_what_was_written_comes_back(surveyed):
    found = read_survey(surveyed)
    again = surveyed.with_name("again.h5")
    found.save(again)
    assert again.read_bytes() == surveyed.read_bytes()
    assert rf.__version__ in h5py.File(again).attrs["made_by"]


def test_all_that_was_surveyed_gets_into_the_scenario(site, surveyed):
    found = read_survey(surveyed)
    told = site.changed(
        transmitter=[t.changed(survey_sigma_m=0.01) for t in site.transmitter],
        reflection={"model": "fresnel", "permittivity": 10.0, "conductivity_s_per_m": 0.01},
    )
    moved = np.add(site.transmitter_enu_m, (0.01, -0.02, 0.03))
    known = replace(
        found, transmitter_enu_m=moved, permittivity_change=np.array([0.2, -0.1]),
        permittivity_sigma=np.array([0.03, 0.02]),
    )  # fmt: skip
    after = known.applied(told)
    np.testing.assert_allclose(after.transmitter_enu_m, moved)
    np.testing.assert_allclose(after.pivot_enu_m, found.pivot_enu_m)
    np.testing.assert_allclose([h.receiver_mirror_m for h in after.heliostat], found.receiver_mirror_m)
    imaginary = 0.01 / (2.0 * np.pi * 433e6 * 8.8541878128e-12)
    complex_permittivity = (10.0 - 1j * imaginary) * (1.2 - 0.1j)
    assert after.reflection.permittivity == pytest.approx(complex_permittivity.real, rel=1e-3)
    conductivity = -complex_permittivity.imag * 2.0 * np.pi * 433e6 * 8.8541878128e-12
    assert after.reflection.conductivity_s_per_m == pytest.approx(conductivity, rel=1e-3)
    assert after.multipath.permittivity_sigma == (0.03, 0.02)
    assert {h.pivot_sigma_m for h in after.heliostat} == {float(np.sqrt(np.mean(found.pivot_sigma_m**2)))}


def changed(site, i, **keys):
    """The heliostats of a site, one of them otherwise."""
    return site.changed(heliostat=[h.changed(**keys) if k == i else h for k, h in enumerate(site.heliostat)])


OTHERS = {
    "no heliostat `X0`": lambda site: changed(site, 0, id="X0"),
    "heliostat `H02` has another number": lambda site: changed(
        site, 1, receiver_mirror_m=[*site.heliostat[1].receiver_mirror_m, (0.1, 0.2, 0.3)],
        receiver_ids=[*site.heliostat[1].receiver_ids, "more"],
    ),
    "receivers of heliostat `H03`": lambda site: changed(
        site, 2, receiver_mirror_m=[(x + 0.02, y, z) for x, y, z in site.heliostat[2].receiver_mirror_m]
    ),
    "pivot of heliostat `H01`": lambda site: changed(
        site, 0, pivot_enu_m=tuple(np.add(site.heliostat[0].pivot_enu_m, (1.0, 0.0, 0.0)))
    ),
    "no transmitter `Y`": lambda site: site.changed(
        transmitter=[site.transmitter[0].changed(id="Y"), *site.transmitter[1:]]
    ),
    "transmitter `T1` is": lambda site: site.changed(
        transmitter=[
            site.transmitter[0].changed(position_enu_m=(90.0, 1.0, 20.0)),
            *site.transmitter[1:],
        ]
    ),
}  # fmt: skip


@pytest.mark.parametrize("said", OTHERS)
def test_a_survey_of_another_site_is_refused(site, recording, surveyed, said):
    other = OTHERS[said](site)
    with pytest.raises(ScenarioError, match=f"another site: .*{said}"):
        read_survey(surveyed).applied(other)
    if "transmitter" not in said and "number" not in said:
        with pytest.raises(ScenarioError, match="another site"):
            rf.process(recording, scenario=other, pose="site", survey=surveyed)


def test_surveyed_delays_are_taken_out_of_what_is_processed(site, tmp_path):
    sigma_s = 3e-11  # a centimetre
    built = site.changed(simulation={"receiver_delay_s": sigma_s})
    recording = rf.simulate(built, seed=3)
    told = site.changed(heliostat={"receiver_delay_sigma_s": sigma_s})
    found = rf.survey(recording, tmp_path / "delays.h5", scenario=told)
    true = 299_792_458.0 * recording.truth.receiver_delay_s[0, :9].reshape(3, 3)
    off = found.delay_m - true
    off -= off.mean(axis=1, keepdims=True)
    assert np.sqrt(np.mean(off**2)) < 0.2 * 299_792_458.0 * sigma_s
    # two of three are free about their mean
    assert np.sum((off / found.delay_sigma_m) ** 2) < chi2.ppf(1.0 - 1e-3, 6) * 1.5
    # places as built, so that nothing but delays is in the way: well known, they have to be out
    exact = replace(found, receiver_mirror_m=np.array([h.receiver_mirror_m for h in site.heliostat]),
                    receiver_cov_m2=np.zeros_like(found.receiver_cov_m2), pivot_enu_m=site.pivot_enu_m)  # fmt: skip
    exact.save(tmp_path / "exact.h5")
    before = rf.process(recording, scenario=told, pose="site")
    after = rf.process(recording, scenario=told, pose="site", survey=tmp_path / "exact.h5")
    as_object = rf.process(recording, scenario=told, pose="site", survey=exact)
    assert np.array_equal(as_object.poses.normal_enu, after.poses.normal_enu, equal_nan=True)
    assert np.sqrt(np.mean(after.poses.sigma_rad**2)) < np.sqrt(np.mean(before.poses.sigma_rad**2))
    assert rms_mrad(after) < 3.0 * 1e3 * np.sqrt(np.mean(after.poses.sigma_rad**2))


# -- mounts --------------------------------------------------------------------------------------------------


SURVEYED_TURN_RAD = 1e-3 / np.sqrt(1.5)
"""What receivers that are known to a millimetre leave open of a turn: three on a circle of a metre."""


class Control:
    """Mounts that are not as planned, and what control, which does not know, makes of the normals that are true."""

    def __init__(self, recording, folder):
        truth, rng = recording.truth, np.random.default_rng(8)
        sizes = dict(zip(AXES_AND_ZEROS, (3e-3, 3e-3, 8e-3, 8e-3, 1e-3), strict=True))
        self.planned = [Mount(pivot_enu_m=p) for p in recording.scenario.pivot_enu_m]
        self.true = [
            mount.replace(**{name: size * rng.standard_normal() for name, size in sizes.items()})
            for mount in self.planned
        ]
        self.count = [command(m, sun_enu=truth.normal_enu[:, i], mode="dish").count for i, m in enumerate(self.true)]
        lines = ["id,frame,normal_e,normal_n,normal_u"]
        for i, name in enumerate(truth.heliostat_ids):
            told = posture(self.planned[i], self.count[i]).normal_enu
            lines += [f"{name},{f},{n[0]},{n[1]},{n[2]}" for f, n in enumerate(told.tolist())]
        self.csv = folder / "commanded.csv"
        self.csv.write_text("\n".join(lines))

    def errors(self, found):
        true = [[mount.parameters[name] for name in AXES_AND_ZEROS] for mount in self.true]
        return found.mounts.parameter - np.array(true)


@pytest.fixture(scope="module")
def control(recording, tmp_path_factory):
    return Control(recording, tmp_path_factory.mktemp("control"))


@pytest.fixture(scope="module")
def told_site(site, control):
    return site.changed(posture={"csv": str(control.csv), "sigma_rad": 0.02})


@pytest.fixture(scope="module")
def with_mounts(told_site, recording, reference):
    return rf.survey(recording, scenario=told_site, reference=reference)


def test_mounts_are_found_within_their_covariance(control, with_mounts):
    off, cov = control.errors(with_mounts), with_mounts.mounts.cov
    total = float(np.einsum("mp,mpq,mq->", off, np.linalg.inv(cov), off))
    assert total < chi2.ppf(1.0 - 1e-3, off.size)
    assert np.all(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)) < 1e-3)
    zero = AXES_AND_ZEROS.index("axis_2_zero_rad")
    assert np.all(np.sqrt(cov[:, zero, zero]) < 0.3 * SURVEYED_TURN_RAD)
    assert with_mounts.mounts.rank.tolist() == [5, 5, 5]


def test_without_a_reference_pose_a_mount_is_known_as_well_as_its_receivers_are(control, told_site, recording):
    found = rf.survey(recording, scenario=told_site)
    zero = AXES_AND_ZEROS.index("axis_2_zero_rad")
    places = found.normal_sigma_rad[:, 1]
    assert np.all(np.sqrt(found.mounts.cov[:, zero, zero]) > 0.5 * places)
    _, now, pointed = found.mounts.normal_sigma_rad.T
    assert np.all(now > places)
    assert np.all(pointed < 0.6 * now)
    off = control.errors(found)
    total = float(np.einsum("mp,mpq,mq->", off, np.linalg.inv(found.mounts.cov), off))
    assert total < chi2.ppf(1.0 - 1e-3, off.size)


def test_logged_motors_take_the_place_of_commands(control, told_site, recording, reference, with_mounts, tmp_path):
    starts = frame_starts(recording, told_site.radio.frame_samples)
    rate = float(recording.sample_rate)
    lines = ["time_utc,heliostat,axis_1,axis_2"]
    for i, name in enumerate(told_site.heliostat_ids):
        for start, count in zip(starts.tolist(), control.count[i].tolist(), strict=True):
            at = datetime.fromtimestamp((start + 0.5 * told_site.radio.frame_samples) / rate, UTC).isoformat()
            lines.append(f"{at},{name},{1e3 * count[0] + 5.0},{1e3 * count[1]}")
    motors = tmp_path / "motors.csv"
    motors.write_text("\n".join(lines))
    mounts = tmp_path / "planned.toml"
    text = 'format = "rfpose-mount"\nversion = 1\n'
    for h in told_site.heliostat:
        drives = "actuators = [{counts_per_unit = 1000.0}, {counts_per_unit = 1000.0}]"
        text += f"[heliostat.{h.id}]\npivot_enu_m = {list(h.pivot_enu_m)}\n{drives}\n"
    mounts.write_text(text)
    found = rf.survey(recording, scenario=told_site, reference=reference, mounts=mounts, motors=motors)
    # the log has axis 1 five milliradians further than control had it, so that its zero is that much less
    expected = with_mounts.mounts.parameter - 5e-3 * (np.array(AXES_AND_ZEROS) == "axis_1_zero_rad")
    np.testing.assert_allclose(found.mounts.parameter, expected, atol=1e-4)
    with pytest.raises(InvalidInputError, match=r"give `mounts=FILE`"):
        rf.survey(recording, scenario=told_site, motors=motors)
    motors.write_text("\n".join(lines).replace("H0", "K0"))
    with pytest.raises(RecordingError, match=r"motors\.csv: has no entry of the site's heliostats"):
        rf.survey(recording, scenario=told_site, mounts=mounts, motors=motors)
    mounts.write_text(text.replace("H02", "K02"))
    with pytest.raises(ScenarioError, match="lack heliostat `H02`"):
        rf.survey(recording, scenario=told_site, mounts=mounts)


def test_one_posture_leaves_most_undetermined_and_says_so(site, tmp_path):
    short = site.changed(simulation={"frame_count": 1, "sun_azimuth_deg": 150.0, "sun_elevation_deg": 40.0})
    rf.simulate(short, seed=3).save(tmp_path / "one.h5")
    run = CliRunner().invoke(app, ["survey", str(tmp_path / "one.h5"), "-o", str(tmp_path / "s.h5"), "--json"])
    assert run.exit_code == 0, run.output
    report = json.loads(run.stdout)["heliostats"]["H01"]
    assert (report["frames"], report["mount"]["rank"]) == (1, 2)
    assert report["mount"]["scatter"] is None
    assert any("nonorthogonality_rad" in words for words in report["mount"]["undetermined"])
    assert any("rotation of the receivers" in words for words in report["undetermined"])
    run = CliRunner().invoke(app, ["survey", str(tmp_path / "one.h5"), "-o", str(tmp_path / "s.h5"), "--force"])
    assert run.exit_code == 0, run.output
    assert "3 heliostats, of the mount not determined" in run.output


@pytest.mark.parametrize("seed", range(40))
def test_damaged_files_are_taken_or_refused_in_our_words(surveyed, tmp_path, seed):
    path = tmp_path / "survey.h5"
    path.write_bytes(surveyed.read_bytes())
    what = damage_hdf5(path, np.random.default_rng(seed))
    try:
        read_survey(path).as_dict()
    except RfposeError as error:
        said = str(error)
    else:
        said = str(path)
    assert "survey.h5" in said, what


def test_a_sigma_below_zero_is_damage(surveyed, tmp_path):
    path = tmp_path / "survey.h5"
    found = read_survey(surveyed)
    replace(found, pivot_sigma_m=-found.pivot_sigma_m).save(path)
    with pytest.raises(RecordingError, match="pivot_sigma_m"):
        read_survey(path)
