"""A survey by radio from recordings to the poses that use it, and its file."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

import rfpose as rf
from damage import damage_hdf5
from rfpose.errors import RecordingError, RfposeError, ScenarioError
from rfpose.pipeline.formats.survey_file import read_survey


@pytest.fixture(scope="module")
def site():
    base = rf.load_scenario(rf.shipped_scenario("table2_100m.toml"))
    return base.changed(
        heliostat=[
            {**h.model_dump(exclude_none=True), "pivot_sigma_m": 0.003, "receiver_delay_sigma_s": 0.0}
            for h in base.heliostat[:3]
        ],
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
            {
                **h.model_dump(exclude_none=True),
                "receiver_mirror_m": (np.array(h.receiver_mirror_m) + 1e-3 * rng.standard_normal((3, 3))).tolist(),
            }
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


def rms_mrad(result):
    return rf.evaluate(result).normal_error_mrad.rms


def test_poses_with_a_survey_are_better_and_know_it(site, recording, surveyed):
    before = rf.process(recording, scenario=site, pose="site")
    after = rf.process(recording, scenario=site, pose="site", survey=surveyed)
    was, now = rms_mrad(before), rms_mrad(after)
    assert was > 0.4
    assert now < 0.35 * was
    assert now < 3.0 * 1e3 * np.sqrt(np.mean(after.poses.sigma_rad**2))


def test_what_was_written_comes_back(surveyed):
    found = read_survey(surveyed)
    again = surveyed.with_name("again.h5")
    found.save(again)
    assert again.read_bytes() == surveyed.read_bytes()
    assert rf.__version__ in h5py.File(again).attrs["made_by"]


def test_a_survey_of_another_site_is_refused(site, surveyed):
    found = read_survey(surveyed)
    other = [{**h.model_dump(exclude_none=True), "id": f"X{k}"} for k, h in enumerate(site.heliostat)]
    with pytest.raises(ScenarioError, match="another site: it has no heliostat `X0`"):
        found.applied(site.changed(heliostat=other))
    east, *rest = site.heliostat[0].pivot_enu_m
    moved = [{**site.heliostat[0].model_dump(exclude_none=True), "pivot_enu_m": [east + 1.0, *rest]}]
    with pytest.raises(ScenarioError, match="pivot of heliostat `H01`"):
        found.applied(site.changed(heliostat=moved))


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
