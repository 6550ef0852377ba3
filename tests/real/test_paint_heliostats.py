"""Real heliostats: calibration records of the Jülich solar tower (verification rows P1, P2, P3)."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from rfpose.drawing import save_figure
from rfpose.errors import RecordingError
from rfpose.feedback.alarms import alarms
from rfpose.feedback.calibration import FitStatus, fit
from rfpose.feedback.measurements import Measurements
from rfpose.feedback.mount import CommandStatus, command
from rfpose.feedback.paint import heliostat_ids, read_heliostat
from rfpose.feedback.prediction import normal_errors_rad
from rfpose.feedback.selection import fit_chosen
from rfpose.feedback.validation import chronological_split, leave_one_out_rad, random_splits
from rfpose.geometry import enu_from_wgs84
from rfpose.pipeline.calibrate import calibrate
from rfpose.sun import sun_position

PAINT = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "paint"
pytestmark = pytest.mark.skipif(not PAINT.is_dir(), reason=f"the PAINT records are not at {PAINT}")

QUIET = ("BF57", "BH36")


def measured(name):
    data = read_heliostat(PAINT, name)
    return data, Measurements.from_spots(
        data.count, sun_enu=data.sun_enu, spot_enu_m=data.spot_enu_m, unix_s=data.record_ids
    )


def test_sun_is_where_the_plant_logged_it(figure):
    # P1. Times are when the plant's database made the record, in whole seconds: after the sun was worked out. They lie
    # 0.45 s after it on average, evenly over a second; that alone is 0.04 mrad of azimuth.
    # On the sky (times cos elevation) and with it:
    azimuth, elevation, sky = [], [], []
    for name in heliostat_ids(PAINT):
        data = read_heliostat(PAINT, name)
        timed = np.isfinite(data.unix_s)
        sun = sun_position(data.unix_s[timed], data.site)
        da = np.mod(sun.azimuth_rad - data.sun_azimuth_rad[timed] + np.pi, 2 * np.pi) - np.pi
        azimuth.append(da)
        elevation.append(sun.elevation_rad - data.sun_elevation_rad[timed])
        sky.append(da * np.cos(sun.elevation_rad))
    rms_mrad = [1e3 * np.sqrt(np.mean(np.concatenate(part) ** 2)) for part in (elevation, sky, azimuth)]
    for what, value in zip(("elevation", "azimuth on the sky", "azimuth"), rms_mrad, strict=True):
        figure(f"P1 sun against the plant's log, {what}: rms", value, "mrad")
    assert rms_mrad[0] <= 0.03
    assert rms_mrad[1] <= 0.05
    assert rms_mrad[2] <= 0.052  # 0.0512: a hair beyond the 0.05 of P1, see above


def test_sun_without_the_half_second_of_the_log():
    # P1, with the one second's rounding of the log taken out: three heliostats, one shift for all
    for name in heliostat_ids(PAINT):
        data = read_heliostat(PAINT, name)
        timed = np.isfinite(data.unix_s)
        sun = sun_position(data.unix_s[timed] - 0.45, data.site)
        da = np.mod(sun.azimuth_rad - data.sun_azimuth_rad[timed] + np.pi, 2 * np.pi) - np.pi
        assert 1e3 * np.sqrt(np.mean(da**2)) <= 0.035


@pytest.mark.parametrize(
    ("free", "bf57_mrad", "bh36_mrad"),
    [
        ("offsets", 3.57, 2.14),
        ("level-4", 0.87, 0.61),
        ("level-7", 0.63, 0.61),
        ("level-8", 0.63, 0.61),
        ("level-location", 0.37, 0.53),
        ("level-full", 0.30, 0.42),  # with the mirror's canting about its upright: what the usual eight lack
    ],
)
def test_held_out_medians(free, bf57_mrad, bh36_mrad, figure):
    # P2: random 60 % fitted, 40 % held out, ten splits, median error of the mirror normal
    for name, wanted in zip(QUIET, (bf57_mrad, bh36_mrad), strict=True):
        data, made = measured(name)
        got = random_splits(data.mount, made, free=free, rng=np.random.default_rng(0))
        median_mrad = 1e3 * got.test_median_rad.mean()
        figure(f"P2 {name}, {free}: held-out median of the normal (wanted {wanted})", median_mrad, "mrad")
        assert median_mrad <= wanted


def test_later_records_are_predicted_too(figure):
    # stated in docs/heliostat-calibration.md: 0.41 and 0.58 mrad
    for name, wanted in zip(QUIET, (0.45, 0.64), strict=True):
        data, made = measured(name)
        median_mrad = 1e3 * chronological_split(data.mount, made, free="level-full").test_median_rad[0]
        figure(f"P2 {name}, level-full, later 40 %: median of the normal", median_mrad, "mrad")
        assert median_mrad <= wanted


def test_the_collinear_parameter_of_the_usual_eight_is_named():
    data, made = measured("BF57")
    found = fit(data.mount, made, free="level-8")
    assert found.field.rank[0] == 7
    assert found.undetermined == (("pedestal_tilt_north_rad", "axis_1_zero_rad"),)
    assert found.field.status[0] == FitStatus.OK
    assert np.isnan(found.estimate["axis_1_zero_rad"])


def test_left_out_ones_are_as_well_predicted():
    data, made = measured("BF57")
    assert 1e3 * np.nanmedian(leave_one_out_rad(data.mount, made, free="level-full")) <= 0.3


def test_a_jumping_heliostat_is_flagged_and_quiet_ones_are_not():
    # P3
    data, made = measured("BE61")
    raised = alarms(fit(data.mount, made, free="level-full"))
    assert sum(alarm.kind == "outlier" for alarm in raised) > 20
    shifts = [alarm for alarm in raised if alarm.kind == "shift"]
    assert max(abs(alarm.size_rad) for alarm in shifts) > 5e-3
    assert {alarm.axis for alarm in shifts} == {1}
    for name in QUIET:
        data, made = measured(name)
        assert alarms(fit(data.mount, made, free="level-full")) == ()


@pytest.mark.parametrize("n", [2, 4, 6, 24, 29])
def test_few_records_choose_no_more_than_they_carry(n):
    # where the fixed four go on, auto is at most half as bad again; the rest of the records judge
    for name in QUIET:
        data, made = measured(name)
        index = np.linspace(0, len(made) - 1, n).astype(int)
        rest = made.take(np.setdiff1d(np.arange(len(made)), index))
        chosen = fit_chosen(data.mount, made.take(index))
        four = fit(data.mount, made.take(index), free="level-4")
        auto_rad, four_rad = (float(np.nanmedian(normal_errors_rad(m.mount, rest))) for m in (chosen, four))
        assert auto_rad < 1.5 * four_rad, (name, n)
        assert chosen.field.carried[0] <= 2 * n


def test_a_jumping_heliostat_is_flagged_with_chosen_parameters_too():
    data, made = measured("BE61")
    raised = alarms(fit_chosen(data.mount, made))
    assert any(alarm.kind == "shift" and abs(alarm.size_rad) > 5e-3 for alarm in raised)
    for name in QUIET:
        data, made = measured(name)
        assert not any(alarm.kind != "outlier" for alarm in alarms(fit_chosen(data.mount, made)))


def test_commands_of_the_calibrated_mount_are_those_that_were_driven():
    data, made = measured("BH36")
    found = fit(data.mount, made, free="level-full")
    wanted = command(found.mount, sun_enu=data.sun_enu, target_enu_m=data.spot_enu_m)
    assert np.all(wanted.status == CommandStatus.OK)
    # 0.3 mrad of the normal at about 50 counts a milliradian
    assert np.median(np.abs(wanted.count - data.count)) < 25.0


def test_algorithms_agree_and_lone_ones_are_left_out():
    data = read_heliostat(PAINT, "BF57")
    assert len(data.record_ids) == 145
    assert set(data.skipped) == {"245895", "253841"}
    assert "UTIS" in data.skipped["245895"]
    assert np.median(data.disagreement_m) < 0.15
    assert len(read_heliostat(PAINT, "BF57", algorithm="HeliOS").record_ids) == 147
    assert set(data.target) <= set(data.targets)


def test_models_and_pictures_are_written(tmp_path):
    reports = calibrate(PAINT, heliostats=("BH36",))
    reports.save(tmp_path / "m.json")
    model = json.loads((tmp_path / "m.json").read_text())["heliostat"]["BH36"]
    assert model["parameters"]["canting_right_rad"] == pytest.approx(0.012, abs=0.004)
    with pytest.raises(RecordingError, match="`force=True`"):
        reports.save(tmp_path / "m.json")
    reports.save(tmp_path / "m.toml")
    save_figure(reports.plot(), tmp_path / "e.png")
    assert (tmp_path / "e.png").stat().st_size > 5000
    told = reports[0].as_dict()
    assert told["held_out_median_mrad"] < 0.42
    assert told["alarms"] == []


def test_the_origin_is_the_origin():
    origin = [50.913421122592574, 6.387824755874856, 87.0]
    np.testing.assert_allclose(enu_from_wgs84(origin, origin), 0.0, atol=1e-9)
    north = enu_from_wgs84([50.914421122592574, 6.387824755874856, 87.0], origin)
    np.testing.assert_allclose(north, [0.0, 111.26, 0.0], atol=0.02)  # a meridian's degree at 51°: 111.26 km


@pytest.fixture
def copy(tmp_path):
    """A small copy of the directory to spoil."""
    (tmp_path / "BF57" / "calibration").mkdir(parents=True)
    shutil.copy(PAINT / "BF57" / "BF57_properties.json", tmp_path / "BF57")
    shutil.copytree(PAINT / "tower", tmp_path / "tower")
    for path in sorted((PAINT / "BF57" / "calibration").iterdir())[:6]:
        shutil.copy(path, tmp_path / "BF57" / "calibration")
    for path in tmp_path.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    return tmp_path


def first_record(directory):
    return sorted((directory / "BF57" / "calibration").iterdir())[0]


def test_without_times_records_go_by_their_numbers(copy):
    data = read_heliostat(copy, "BF57")
    assert np.isnan(data.unix_s).all()
    assert np.all(np.diff(data.record_ids) > 0)


def test_a_record_without_a_spot_is_left_out(copy):
    path = first_record(copy)
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"focal_spot": {}}))
    data = read_heliostat(copy, "BF57")
    assert data.skipped[path.name.split("_")[0]] == f"{path}: no focal spot; measure again"
    path.write_text(json.dumps(record | {"sun_elevation": -3.0}))
    assert "horizon" in read_heliostat(copy, "BF57").skipped[path.name.split("_")[0]]


def test_a_spot_off_the_target_is_left_out(copy):
    path = first_record(copy)
    record = json.loads(path.read_text())
    number = path.name.split("_")[0]
    assert number not in read_heliostat(copy, "BF57").skipped
    for step, text in (([0.0, 0.0, 9.0], "from its centre"), ([2e-5, 0.0, 0.0], "behind its plane")):
        spots = {name: [a + b for a, b in zip(s, step, strict=True)] for name, s in record["focal_spot"].items()}
        path.write_text(json.dumps(record | {"focal_spot": spots}))
        reason = read_heliostat(copy, "BF57").skipped[number]
        assert "focal spot off the target" in reason
        assert text in reason


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "one JSON object"),
        ('{"focal_spot": {"HeliOS": [50, 6, 9], "UTIS": [50, 6, 9]}}', "motor_position"),
        (
            '{"focal_spot": {"HeliOS": [50, 6, 9], "UTIS": [50, 6, 9]}, "sun_azimuth": 1, "sun_elevation": 9,'
            ' "motor_position": {"axis_1_motor_position": "far", "axis_2_motor_position": 1}}',
            "number was expected",
        ),
    ],
)
def test_broken_records_are_named(copy, text, message):
    # one of them is left out, all of them are an error
    path = first_record(copy)
    path.write_text(text)
    data = read_heliostat(copy, "BF57")
    assert len(data.record_ids) == 5
    assert message in data.skipped[path.name.split("_")[0]]
    assert path.name in data.skipped[path.name.split("_")[0]]
    for other in path.parent.iterdir():
        other.write_text(text)
    with pytest.raises(RecordingError, match=message) as caught:
        read_heliostat(copy, "BF57")
    assert path.name in str(caught.value)


def test_missing_files_are_named(copy, tmp_path):
    with pytest.raises(RecordingError, match="No such file or directory"):
        heliostat_ids(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="known heliostats: BF57"):
        read_heliostat(copy, "XX99")
    (copy / "BF57" / "BF57_properties.json").unlink()
    with pytest.raises(RecordingError, match="heliostat's properties"):
        read_heliostat(copy, "BF57")
    shutil.rmtree(copy / "tower")
    with pytest.raises(RecordingError, match="tower's measurements"):
        read_heliostat(copy, "BF57")
