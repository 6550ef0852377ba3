"""Recorders whose clocks are seconds off are found by the wandering of the transmitters' tones, or named."""

from pathlib import Path

import numpy as np
import pytest

import rfpose as rf
from rfpose.errors import RecordingError
from rfpose.recording import RecordingWriter, open_recording
from rfpose.scenario import load_scenario

SCENARIO = load_scenario(Path(__file__).resolve().parents[2] / "data" / "table2_100m.toml")


def simulated(folder, **simulation):
    site = SCENARIO.changed(
        heliostat=SCENARIO.heliostat[:2], radio={"frame_samples": 8000},
        simulation={"frame_interval_s": 1.0, "sun_azimuth_deg": 170.0} | simulation,
    )  # fmt: skip
    rf.simulate(site, seed=3).save(folder / "whole.h5")
    return folder / "whole.h5"


@pytest.fixture(scope="module")
def wandering(tmp_path_factory):
    """Tones that wander by 0.3 rad in a second."""
    return simulated(tmp_path_factory.mktemp("wandering"), frame_count=25, transmitter_phase_drift_rad_per_sqrt_h=20.0)


def cut(path, folder, ahead_s, frames=slice(None)):
    """Write the receivers of each mirror and those for calibration into files of their own, with clocks ahead."""
    with open_recording(path) as source:
        groups = {"H01": [], "H02": [], "cal": []}
        for name in source.receiver_ids:
            groups[name[:3] if name[:3] in groups else "cal"].append(name)
        for group, names in groups.items():
            with RecordingWriter(
                folder / f"{group}.h5", scenario=source.scenario, receiver_ids=names, sample_rate=source.sample_rate,
                centre_frequency_hz=source.centre_frequency_hz, sample_format=source.sample_format,
                full_scale=source.full_scale, provenance={},
            ) as writer:  # fmt: skip
                for name in names:
                    for start, count in source.blocks(name)[frames].tolist():
                        shift = round(ahead_s.get(group, 0) * source.sample_rate)
                        writer.write(name, start + shift, source.read(name, start, count))
    return [folder / f"{group}.h5" for group in groups]


@pytest.mark.parametrize(
    ("ahead_s", "words"),
    [
        ({"H02": 18}, r"the clock of H02.h5 is 18 s ahead \(GPS time in place of UTC\?\), .*`offset_s = -18`"),
        ({"H01": -1}, r"the clock of H01.h5 is 1 s behind \(a second\?\), .*`offset_s = 1`"),
        ({"cal": 1}, r"the clock of cal.h5 is 1 s ahead"),
    ],
)
def test_a_clock_that_is_seconds_off_is_refused(wandering, tmp_path, ahead_s, words):
    with pytest.raises(RecordingError, match=words):
        rf.process(cut(wandering, tmp_path, ahead_s))


@pytest.mark.parametrize("offset", ["-18", '"find"'])
def test_an_offset_that_is_told_or_found_gives_the_same(wandering, tmp_path, offset):
    wanted = rf.process(wandering)
    cut(wandering, tmp_path, {"H02": 18})
    (tmp_path / "recording.toml").write_text(
        'format = "rfpose-recording"\n[[part]]\nfiles = ["H01.h5", "cal.h5"]\n'
        f'[[part]]\nfiles = "H02.h5"\noffset_s = {offset}\n'
    )
    found = rf.process(tmp_path)
    assert found.poses.normal_enu.tobytes() == wanted.poses.normal_enu.tobytes()
    assert found.tones.phase_rad.tobytes() == wanted.tones.phase_rad.tobytes()
    assert np.all(found.poses.status == 0)


def test_right_clocks_are_left_alone(wandering, tmp_path):
    assert len(rf.process(cut(wandering, tmp_path, {})).frame_start_index) == 25


def test_delays_of_the_receivers_that_wander_too_are_no_hindrance(tmp_path):
    path = simulated(
        tmp_path, frame_count=25, transmitter_phase_drift_rad_per_sqrt_h=20.0, receiver_delay_drift_s_per_sqrt_min=4e-8
    )
    with pytest.raises(RecordingError, match=r"the clock of H02.h5 is 18 s ahead"):
        rf.process(cut(path, tmp_path, {"H02": 18}))


@pytest.mark.parametrize("frame_count", [4, 24], ids=["none in common", "some in common"])
def test_tones_that_do_not_wander_cannot_tell_and_it_is_said(tmp_path, caplog, frame_count):
    given = cut(simulated(tmp_path, frame_count=frame_count), tmp_path, {"H02": 18})
    rf.process(given)
    (said,) = [record.message for record in caplog.records if "beside the other parts" in record.message]
    assert "H02.h5 lies beside the other parts in time, and would not if its clock were 18 s ahead" in said
    assert "give `offset_s = -18` in a manifest" in said
