"""`rfpose track`: what it prints, writes and refuses, and that it goes on where it stopped."""

import csv
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from threadpoolctl import threadpool_info, threadpool_limits

from rfpose.cli import _app
from rfpose.cli.track import _METHODS
from rfpose.errors import RecordingError
from rfpose.feedback.fieldcontrol.modes import Mode
from rfpose.feedback.tracking import METHODS
from rfpose.pipeline.formats.track_file import is_track, open_track
from rfpose.pipeline.track import TrackChanges, track
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
    out, table, picture, series = (tmp_path / name for name in ("run.h5", "run.csv", "run.png", "series.csv"))
    methods = "open-loop,camera-model,radio-both"
    shown = run(
        site,
        "-o",
        out,
        "--methods",
        methods,
        "--heliostats",
        4,
        "--csv",
        table,
        "--series",
        series,
        "--picture",
        picture,
        "--json",
    )
    assert shown.exit_code == 0, shown.output
    found = json.loads(shown.stdout)
    assert found["ranking"] == ["radio-both", "camera-model", "open-loop"]
    assert found["heliostats"] == 4
    assert found["days"] == ["2026-03-20"]
    assert found["methods"]["radio-both"]["normal_mrad"]["rms"] < 0.3
    assert found["methods"]["open-loop"]["outages"] == []
    assert picture.read_bytes().startswith(b"\x89PNG")
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12
    assert is_track(out)
    kept = open_track(out)
    written = ("result", "csv", "parquet", "series", "picture")
    assert kept.as_dict() == {k: v for k, v in found.items() if k not in written}
    mirror = [float(row["normal_rms_mrad"]) for row in rows if row["method"] == "radio-both"]
    np.testing.assert_allclose(mirror, 1e3 * kept.methods["radio-both"].scores["heliostat_rms_rad"], rtol=1e-5)
    with series.open() as file:
        course = [row for row in csv.DictReader(file) if row["method"] == "radio-both"]
    assert len(course) == len(kept.unix_s)
    flux = [float(row["flux"] or "nan") for row in course]
    np.testing.assert_allclose(flux, kept.methods["radio-both"].series["flux"], rtol=1e-5)
    error = [float(row["normal_H01_mrad"] or "nan") for row in course]
    np.testing.assert_allclose(error, 1e3 * kept.methods["radio-both"].series["error_rad"][:, 0], rtol=1e-5)
    tracking = [int(row["mirrors_track"]) for row in course]
    assert tracking == kept.methods["radio-both"].series["mode_count"][:, Mode.TRACK].tolist()
    assert kept.scenario == load_scenario(site)
    assert kept.methods["radio-both"].series["normal_enu"].shape == (len(kept.unix_s), len(kept.stored), 3)
    plain = run(site, "-o", tmp_path / "again.h5", "--methods", "open-loop", "--heliostats", 4)
    assert plain.exit_code == 0
    assert "open-loop" in plain.output


def test_stopped_and_resumed_equals_undisturbed(site, tmp_path):
    whole, parts = tmp_path / "whole.h5", tmp_path / "parts.h5"
    job = partial(track, site, methods=("bias", "radio-both"), heliostats=3)
    job(whole, seed=5)

    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        job(parts, seed=5, checkpoint_s=0.0, on_progress=stop)
    assert not parts.exists()
    with pytest.raises(RecordingError, match=r"another job \(different: seed\)"):
        job(parts, seed=6)
    state = tmp_path / ".parts.h5.state"
    kept = state.read_bytes()
    with np.load(state) as stored:
        arrays = dict(stored)
    arrays["key.json"] = np.array(
        str(arrays["key.json"]).replace('"layout of the state": "3"', '"layout of the state": "1"')
    )
    with state.open("wb") as file:
        np.savez(file, **arrays)
    with pytest.raises(RecordingError, match=r"another job \(different: layout of the state\)"):
        job(parts, seed=5)
    state.write_bytes(kept)
    seen = []
    resumed = job(parts, seed=5, on_progress=lambda done, total: seen.append(done))
    assert seen == [3]
    assert parts.read_bytes() == whole.read_bytes()
    assert resumed.settings["seed"] == "5"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["parts.h5", "site.toml", "whole.h5"]
    # a damaged state is no obstacle: the run begins anew
    (tmp_path / ".third.h5.state").write_bytes(b"PK not a state")
    job(tmp_path / "third.h5", seed=5)
    assert (tmp_path / "third.h5").read_bytes() == whole.read_bytes()


def test_blas_keeps_to_one_thread(site):
    def threads(*_now):
        return [lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"]

    seen = []
    with threadpool_limits(2, user_api="blas"):
        track(site, methods=("open-loop",), heliostats=1, on_progress=lambda *now: seen.extend(threads(*now)))
        assert set(threads()) == {2}
    assert set(seen) == {1}


def test_blas_that_comes_later_keeps_to_one_thread_too(site):
    """Scipy brings one of its own, which a fresh process does not have yet when the track begins."""
    text = (
        "import sys, rfpose as rf; from threadpoolctl import threadpool_info\n"
        "def told(*_): print(*(lib['num_threads'] for lib in threadpool_info() if lib['user_api'] == 'blas'))\n"
        "rf.track(sys.argv[1], methods=['radio'], heliostats=1, on_progress=told)"
    )
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", text, site], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.splitlines()) == {"1 1"}


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


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--event", "9.2 stow H99"], "names heliostat 'H99', which is not tracked; tracked are H01 to H12"),
        (["--event", "9.2 cluster-fails #1"], "names cluster 1; 12 heliostats make clusters 0 to 0"),
        (["--event", "9.2 stow", "--event", "9.2 defocus H03"], "`stow` and `defocus` contradict each other"),
        (["--event", "2:9.2 stow"], "is on day 2, and only 1 are simulated"),
        (["--event", "9.2 emergency H01"], "concerns the whole field; name nobody"),
        (["--event", "9.2 cluster-fails"], "needs the number of a `cluster`"),
        (["--event", "9.2 dance"], "what"),
        (["--event", "11:30 emergency"], "hour"),
        (["--event", "nan emergency"], "hour"),
        (["--event", "9.2 emergency", "--without-field-control"], "events need field control to act on"),
    ],
)
def test_events_that_cannot_be_are_one_line(site, tmp_path, arguments, complaint):
    shown = run(site, "-o", tmp_path / "x.h5", "--methods", "open-loop", *arguments)
    assert shown.exit_code == 3, shown.output
    assert complaint in shown.output
    assert str(site) in shown.output
    told = [line for line in shown.output.splitlines() if line.strip()]
    assert len(told) == 1, told
    assert sorted(p.name for p in tmp_path.iterdir()) == ["site.toml"]


@pytest.mark.parametrize(
    "text", ["", "emergency", "noon emergency", "9 calibrate H01, H02", "1.5:9 stow", "9 stow #two"]
)
def test_events_that_cannot_be_read_are_the_commands_fault(site, tmp_path, text):
    shown = run(site, "-o", tmp_path / "x.h5", "--event", text)
    assert shown.exit_code == 2, shown.output
    assert "--event" in shown.output
    assert "'11.5 emergency'" in shown.output
    assert sorted(p.name for p in tmp_path.iterdir()) == ["site.toml"]


@pytest.mark.parametrize(
    ("old", "new", "event", "complaint"),
    [
        ("calibration_target_enu_m = [0.0, 0.0, 40.0]", "", "9.2 calibrate", "needs a target"),
        ("[tracking.wind]", 'collector = "dish"\n[tracking.wind]', "9.2 defocus", "is for heliostats"),
    ],
)
def test_events_that_the_site_has_no_means_for(site, tmp_path, old, new, event, complaint):
    text = site.read_text()
    assert old in text
    text = text.replace(old, new)
    if "dish" in new:
        text = text.replace('collector = "dish"\n', "").replace("date = 2026", 'collector = "dish"\ndate = 2026')
    site.write_text(text)
    shown = run(site, "-o", tmp_path / "x.h5", "--methods", "open-loop", "--event", event)
    assert shown.exit_code == 3
    assert complaint in shown.output
    assert not (tmp_path / "x.h5").exists()


def test_what_happened_is_told_and_kept(site, tmp_path):
    out = tmp_path / "alarm.h5"
    events = ("9.2 emergency", "9.3 approach H02", "1:9.4 release")
    arguments = ["--methods", "open-loop", "--heliostats", "3", *(a for e in events for a in ("--event", e))]
    shown = run(site, "-o", out, "--json", *arguments)
    assert shown.exit_code == 0, shown.output
    found = json.loads(shown.stdout)["methods"]["open-loop"]
    (day,) = found["field_control"]
    assert day["day"] == "2026-03-20"
    assert [e["what"] for e in day["events"]] == ["emergency", "approach", "release"]
    assert list(day["events"][1]["refused"].values()) == [1]
    (alarm,) = day["alarms"]
    assert alarm["stowed_s"] < 300.0
    modes = found["modes"]
    assert sum(mode["hours"] for mode in modes.values()) == pytest.approx(0.7, abs=0.01)
    assert modes["stow"]["lost_kwh_per_m2"] == pytest.approx(modes["stow"]["offered_kwh_per_m2"])
    lost = sum(m["lost_kwh_per_m2"] for m in modes.values())
    offered = sum(m["offered_kwh_per_m2"] for m in modes.values())
    assert found["availability"] == pytest.approx(1.0 - lost / offered)
    assert found["energy_kwh_per_m2"] == pytest.approx(offered - lost)
    kept = open_track(out)
    assert kept.as_dict()["methods"]["open-loop"] == found
    assert [event.what for event in kept.scenario.tracking.event] == ["emergency", "approach", "release"]
    assert kept.methods["open-loop"].happened[0] == day
    plain = run(site, "-o", tmp_path / "again.h5", *arguments)
    assert "flux below a tenth after" in plain.output
    assert "1 mirrors: APPROACH refused: emergency since" in plain.output
    assert (tmp_path / "again.h5").read_bytes() == out.read_bytes()
    off = run(site, "-o", tmp_path / "off.h5", "--methods", "open-loop", "--without-field-control", "--json")
    without = json.loads(off.stdout)["methods"]["open-loop"]
    assert "field_control" not in without
    assert list(without["modes"]) == ["track"]
    assert open_track(tmp_path / "off.h5").scenario.tracking.field_control is None


def test_stopped_in_an_emergency_and_resumed_equals_undisturbed(site, tmp_path):
    whole, parts = tmp_path / "whole.h5", tmp_path / "parts.h5"
    # a stretch ends a quarter of an hour after nine
    events = [{"hour": 9.24, "what": "emergency"}, {"hour": 9.4, "what": "release"}]
    arguments = {
        "methods": ("open-loop", "encoder"),
        "heliostats": 3,
        "seed": 5,
        "changes": TrackChanges(events=events),
    }
    track(site, whole, **arguments)

    def stop(done, total):
        raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            track(site, parts, **arguments, checkpoint_s=0.0, on_progress=stop)
    with pytest.raises(RecordingError, match="another job"):
        track(site, parts, **arguments | {"changes": TrackChanges(events=events[:1])})
    with pytest.raises(RecordingError, match="another job"):
        track(site, parts, **arguments | {"changes": TrackChanges(without_field_control=True)})
    seen = []
    resumed = track(site, parts, **arguments, on_progress=lambda done, total: seen.append(done))
    assert seen == [3]
    assert parts.read_bytes() == whole.read_bytes()
    assert resumed.methods["encoder"].happened[0]["alarms"][0]["stowed_s"] is not None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["parts.h5", "site.toml", "whole.h5"]


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
        open_track(other)
