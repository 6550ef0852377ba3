"""`rfpose track`: what it prints, writes and refuses, and that it goes on where it stopped."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rfpose.cli import _app
from rfpose.cli.track import _METHODS
from rfpose.errors import RecordingError
from rfpose.feedback.tracking import METHODS
from rfpose.pipeline.track import track
from rfpose.pipeline.track_file import is_track, read_track
from rfpose.scenario import load_scenario

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "tracking_100m.toml"


@pytest.fixture
def site(tmp_path):
    """Three quarters of an hour, one stretch of 15 minutes after the other."""
    text = SHIPPED.read_text().replace("date = 2026-03-20", "date = 2026-03-20\nfirst_hour = 9.0\nlast_hour = 9.7")
    path = tmp_path / "site.toml"
    path.write_text(text)
    return path


def run(*arguments):
    return CliRunner().invoke(_app.app, ["track", *(str(a) for a in arguments)])


def test_table_json_csv_and_picture(site, tmp_path):
    out, table, picture = tmp_path / "run.h5", tmp_path / "run.csv", tmp_path / "run.png"
    methods = "open-loop,camera-model,radio-both"
    shown = run(site, "-o", out, "--methods", methods, "--csv", table, "--picture", picture, "--json")
    assert shown.exit_code == 0, shown.output
    found = json.loads(shown.stdout)
    assert found["ranking"] == ["radio-both", "camera-model", "open-loop"]
    assert found["heliostats"] == 12
    assert found["days"] == ["2026-03-20"]
    assert found["methods"]["radio-both"]["normal_mrad"]["rms"] < 0.3
    assert found["methods"]["open-loop"]["outage"]["rms_mrad"] is None
    assert picture.read_bytes().startswith(b"\x89PNG")
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 36
    assert is_track(out)
    kept = read_track(out)
    assert kept.as_dict() == {k: v for k, v in found.items() if k not in ("result", "csv", "picture")}
    mirror = [float(row["normal_rms_mrad"]) for row in rows if row["method"] == "radio-both"]
    np.testing.assert_allclose(mirror, 1e3 * kept.methods["radio-both"].scores["heliostat_rms_rad"], rtol=1e-5)
    assert kept.scenario == load_scenario(site)
    assert kept.methods["radio-both"].series["normal_enu"].shape == (len(kept.unix_s), len(kept.stored), 3)
    plain = run(site, "-o", tmp_path / "again.h5", "--methods", "open-loop")
    assert plain.exit_code == 0
    assert "open-loop" in plain.output


def test_stopped_and_resumed_equals_undisturbed(site, tmp_path):
    whole, parts = tmp_path / "whole.h5", tmp_path / "parts.h5"
    track(site, whole, methods=("bias", "radio-both"), seed=5)

    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track(site, parts, methods=("bias", "radio-both"), seed=5, checkpoint_s=0.0, on_progress=stop)
    assert not parts.exists()
    with pytest.raises(RecordingError, match=r"another job \(different: seed\)"):
        track(site, parts, methods=("bias", "radio-both"), seed=6)
    seen = []
    resumed = track(
        site, parts, methods=("bias", "radio-both"), seed=5, on_progress=lambda done, total: seen.append(done)
    )
    assert seen == [3]
    assert parts.read_bytes() == whole.read_bytes()
    assert resumed.settings["seed"] == "5"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["parts.h5", "site.toml", "whole.h5"]
    # a damaged state is no obstacle: the run begins anew
    (tmp_path / ".third.h5.state").write_bytes(b"PK not a state")
    track(site, tmp_path / "third.h5", methods=("bias", "radio-both"), seed=5)
    assert (tmp_path / "third.h5").read_bytes() == whole.read_bytes()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--heliostats", "0"], "one heliostat or more, got 0"),
        (["--methods", "sonar"], "no tracking method is called 'sonar'"),
        (["--methods", "sun-sensor"], "cannot steer a heliostat"),
    ],
)
def test_bad_requests_are_one_line(site, tmp_path, arguments, complaint):
    shown = run(site, "-o", tmp_path / "x.h5", *arguments)
    assert shown.exit_code == 3
    assert complaint in shown.output
    assert str(site) in shown.output
    assert not (tmp_path / "x.h5").exists()


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("latitude_deg = -33.93\n", "", "`latitude_deg` and `longitude_deg` are missing"),
        ("latitude_deg = -33.93", "latitude_deg = 89.0", "the sun is never above"),
        ("latency_s = 1.0", "latency_s = 1.0\ngain_per_s = 0.5", "gain margin"),
        ("aim_enu_m = [0.0, 0.0, 50.0]", "", "`aim_enu_m` is missing"),
    ],
)
def test_bad_sites_are_one_line(site, tmp_path, old, new, complaint):
    text = site.read_text()
    assert old in text
    site.write_text(text.replace(old, new))
    shown = run(site, "-o", tmp_path / "x.h5")
    assert shown.exit_code == 3
    assert complaint in shown.output


def test_radio_without_transmitters_is_refused(site, tmp_path):
    text = site.read_text()
    first, last = text.index("[[transmitter]]"), text.index("[[calibration_receiver]]")
    site.write_text(text[:first] + text[last:])
    assert "transmitter" in run(site, "-o", tmp_path / "x.h5").output
    one = text[first : text.index("[[transmitter]]", first + 5)]
    site.write_text(text[:first] + one + text[last:])
    shown = run(site, "-o", tmp_path / "x.h5", "--methods", "radio")
    assert shown.exit_code == 3
    assert "transmitters" in shown.output
    assert run(site, "-o", tmp_path / "x.h5", "--methods", "open-loop").exit_code == 0


def test_the_commands_names_are_the_librarys():
    assert tuple(METHODS) == _METHODS


def test_a_file_of_another_kind_is_told(site, tmp_path):
    other = tmp_path / "other.h5"
    other.write_bytes(b"no HDF5")
    assert not is_track(other)
    with pytest.raises(RecordingError, match="truncated or another kind"):
        read_track(other)
