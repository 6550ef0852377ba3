"""Whatever is in a scenario, a truth, a result or a tracking run: our own errors that name the file, or none."""

import contextlib
import json
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import tomli_w

from damage import as_json, copied, damage_bytes, damage_hdf5, damage_values
from rfpose.errors import RecordingError, RfposeError, ScenarioError
from rfpose.feedback.camera.render import Beam, CameraView, Target, render
from rfpose.feedback.mount import Mount
from rfpose.feedback.paint import read_heliostat
from rfpose.feedback.series import Quantity, read_series_csv
from rfpose.pipeline.aim import plan_commands
from rfpose.pipeline.calibrate import calibrate
from rfpose.pipeline.calibration_sources import read_camera, read_drone, read_radio
from rfpose.pipeline.evaluate import evaluate, read_truth
from rfpose.pipeline.formats.mount_file import read_models
from rfpose.pipeline.formats.result_file import open_result
from rfpose.pipeline.formats.result_summary import write_poses_csv
from rfpose.pipeline.formats.track_file import open_track
from rfpose.pipeline.inspect import inspect_file
from rfpose.pipeline.pictures.field_view import field_of_result, field_of_scenario, history
from rfpose.pipeline.pictures.track_view import picture_of_track
from rfpose.pipeline.process import process
from rfpose.pipeline.samples.paint import write_json, write_paint
from rfpose.pipeline.simulate import simulate
from rfpose.pipeline.track import track
from rfpose.scenario import Scenario, load_scenario, read_positions
from rfpose.sun import Location
from rfpose.tables import write_csv

# what is wrong may well give NaN, of which numpy warns
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")

DATA = Path(__file__).resolve().parents[2] / "data"


def small_site() -> Scenario:
    site = load_scenario(DATA / "table2_100m.toml")
    return site.changed(
        heliostat=site.heliostat[:2],
        radio={"frame_samples": 4000},
        simulation={"frame_count": 3, "ground": {"coefficient": [-0.1, 0.05]}},
        reflection={"model": "known", "coefficient": [-0.1, 0.05]},
        motion={"filtered": True},
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("sound")
    paths = {name: folder / f"{name}.h5" for name in ("recording", "result")}
    paths["scenario"] = folder / "site.toml"
    paths["scenario"].write_text(small_site().to_toml())
    simulate(paths["scenario"], seed=1).save(paths["recording"])
    process(paths["recording"], paths["result"], estimator="correlator")
    return paths


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracked")
    day = load_scenario(DATA / "tracking_100m.toml")
    hours = {"first_hour": 11.0, "last_hour": 11.3, "settle_s": 60.0, "event": [{"hour": 11.2, "what": "emergency"}]}
    day.changed(heliostat=day.heliostat[:3], tracking=hours).save(folder / "day.toml")
    track(folder / "day.toml", folder / "run.h5", methods=("radio", "open-loop"))
    return folder / "run.h5"


def refused(path: Path, read, how: str):
    """Return what is read, or None where it is refused in our words, with the file's name."""
    try:
        return read(path)
    except RfposeError as error:
        message = str(error)
    assert path.name in message, f"{how}: {message}"
    assert len(message) < 2000
    return None


@pytest.mark.parametrize("seed", range(6))
def test_damaged_results(files, tmp_path, seed):
    rng = np.random.default_rng(seed)
    for k in range(25):
        path = copied(files["result"], tmp_path)
        how = damage_bytes(path, rng) if k % 5 == 0 else damage_hdf5(path, rng)
        try:
            refused(path, inspect_file, how)
            result = refused(path, open_result, how)
            if result is None:
                continue
            write_poses_csv(result, tmp_path / "poses.csv")
            field_of_result(result)
            history(result, 0)
            with contextlib.suppress(RfposeError):
                evaluate(result)
        except Exception as error:
            raise AssertionError(f"seed {seed}, {k}, {how}: {error!r}") from error


@pytest.mark.parametrize("seed", range(4))
def test_damaged_tracking_runs(tracked, tmp_path, seed):
    rng = np.random.default_rng(seed)
    for k in range(15):
        path = copied(tracked, tmp_path)
        how = damage_bytes(path, rng) if k % 5 == 0 else damage_hdf5(path, rng)
        try:
            refused(path, inspect_file, how)
            run = refused(path, open_track, how)
            if run is not None:
                picture_of_track(run)
                write_csv(tmp_path / "run.csv", *run.table())
        except Exception as error:
            raise AssertionError(f"seed {seed}, {k}, {how}: {error!r}") from error


def test_damaged_values_in_a_runs_tables(tracked, tmp_path):

    rng = np.random.default_rng(7)
    for k in range(60):
        path = copied(tracked, tmp_path)
        with h5py.File(path, "r+") as file:
            group = file["method/radio"]
            if k % 2:
                table = json.loads(group.attrs["summary"])
                how = damage_values(table, rng)
                group.attrs["summary"] = as_json(table)
            else:
                table = json.loads(group["happened"].asstr()[()])
                how = damage_values(table, rng)
                del group["happened"]
                group["happened"] = as_json(table)
        try:
            run = refused(path, open_track, how)
            if run is not None:
                run.ranking()
                picture_of_track(run)
        except Exception as error:
            raise AssertionError(f"{k}, {how}: {error!r}") from error


@pytest.mark.parametrize("seed", range(6))
def test_damaged_scenarios(files, tmp_path, seed):
    rng = np.random.default_rng(seed)
    whole = load_scenario(DATA / "tracking_100m.toml").model_dump(mode="json", exclude_none=True)
    whole["heliostat"] = whole["heliostat"][:2]
    small = small_site().model_dump(mode="json", exclude_none=True)
    for k in range(60):
        path = tmp_path / "damaged.toml"
        if k % 6 == 0:
            path.write_text(tomli_w.dumps(small))
            how = damage_bytes(path, rng)
        else:
            data = json.loads(json.dumps(small if k % 2 else whole))
            how = damage_values(data, rng)
            try:
                path.write_text(tomli_w.dumps(data), encoding="utf-8")
            except (TypeError, ValueError):  # no TOML says such a thing
                continue
        try:
            refused(path, inspect_file, how)
            scenario = refused(path, load_scenario, how)
            if scenario is not None:
                field_of_scenario(scenario)
                assert scenario.to_toml()
        except Exception as error:
            raise AssertionError(f"seed {seed}, {k}, {how}: {error!r}") from error


def test_damaged_truths(files, tmp_path):
    rng = np.random.default_rng(3)
    result = open_result(files["result"])
    sound = {
        "heliostats": [
            {
                "id": name,
                "normal_enu": result.truth.normal_enu[0, i].tolist(),
                "receivers_enu_m": result.truth.receiver_enu_m[0, result.scenario.receiver_rows(i)].tolist(),
            }
            for i, name in enumerate(result.scenario.heliostat_ids)
        ]
    }
    path = tmp_path / "truth.json"
    path.write_text("\ufeff" + json.dumps(sound), encoding="utf-8")
    assert np.isfinite(evaluate(result, read_truth(path, result.scenario)).normal_error_mrad.rms)
    for k in range(150):
        data = json.loads(json.dumps(sound))
        how = damage_values(data, rng)
        path.write_text(as_json(data))
        if k % 5 == 0:
            how = damage_bytes(path, rng)
        try:
            found = refused(path, lambda p: read_truth(p, result.scenario), how)
            if found is not None:
                with contextlib.suppress(RfposeError):
                    evaluate(result, found)
        except Exception as error:
            raise AssertionError(f"{k}, {how}: {error!r}") from error
    for text, message in (
        ('{"heliostats": ' + "[" * 5000, "nested deeper"),
        ('{"heliostats": [{"id": "H01", "normal_enu": [1e999, 0, 1], "receivers_enu_m": []}]}', "normal_enu"),
        ('{"heliostats": [{"id": "elsewhere", "normal_enu": [0, 0, 1], "receivers_enu_m": []}]}', "knows none"),
        ("[1, 2]", "`heliostats` is missing"),
    ):
        path.write_text(text)
        with pytest.raises(RecordingError, match=message):
            read_truth(path, result.scenario)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 100_000, "nested deeper"),
        ("a." * 5000 + "b = 1", "more than 64 parts"),
        ("[simulation]\nstart_unix_s = 99999999999999999999999", "64 bits"),
        ("[simulation]\nstart_unix_s = 999999999999", "start_unix_s"),
        ("[radio]\nsample_rate_hz = 1e300", "sample_rate_hz"),
        ("[radio]\nsample_rate_hz = 1e-9", "sample_rate_hz"),
        ("scale = 1e300", "scale"),
        ("mirror = 5", "mirror"),
        ("mirror = {arm_m = -1}", "`mirror.arm_m`"),
    ],
)
def test_scenario_texts_that_ask_for_too_much(files, tmp_path, text, message):
    path = tmp_path / "site.toml"
    base = files["scenario"].read_text()
    head, _, tail = text.rpartition("\n")
    table = f"{head}\n" if head.startswith("[") else ""
    changed = base.replace(table, f"{text}\n", 1) if table and table in base else f"{text}\n{base}"
    key = tail.split(" ")[0]
    lines = [line for line in changed.splitlines() if line == tail or not line.startswith(f"{key} =")]
    path.write_text("\n".join(lines))
    with pytest.raises(ScenarioError, match=message) as error:
        load_scenario(path)
    assert str(path) in str(error.value)


def test_byte_order_marks_and_semicolons(files, tmp_path):
    site = tmp_path / "bom.toml"
    site.write_text("\ufeff" + files["scenario"].read_text(), encoding="utf-8")
    assert load_scenario(site) == small_site()
    table = tmp_path / "field.csv"
    table.write_text("\ufeffid;east_m;north_m\nA;1,5;2\n", encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"field\.csv: columns are separated by `;`"):
        read_positions(table)
    table.write_text("\ufeffid,east_m,north_m\nA,1.5,2\n", encoding="utf-8")
    assert read_positions(table)[0] == ("A",)
    wind = Quantity(name="speed", units={"mps": 1.0}, unit="m/s", most=100.0, beyond="any wind")
    for text, message in (
        ("unix_s;speed_mps\n0;1\n1;2\n", "separated by `;`"),
        ("unix_s,speed_mps\n0,1\n1e15,2\n", "from 1970 to 9999"),
        ("unix_s,speed_mps\n0,1\n200000000000,2\n", "spans 2314815 days"),
        ('unix_s,speed_mps\n0,"1\n2",3\n', "line 3"),
        ("unix_s,speed_mps\n0,nan\n1,2\n3,4\n", "must not be negative"),
    ):
        table.write_text(text)
        with pytest.raises(RfposeError, match=message) as error:
            read_series_csv(table, wind, interval_s=1.0, longest_gap_s=10.0)
        assert "field.csv" in str(error.value)


def test_values_that_stand_in_another_file_are_not_read(files, tracked, tmp_path):
    for source, place, read in (
        (files["result"], "poses/normal_enu", open_result),
        (files["result"], "scenario", open_result),
        (tracked, "time/unix_s", open_track),
        (tracked, "method/radio/happened", open_track),
    ):
        path = copied(source, tmp_path)
        with h5py.File(path, "r+") as file:
            del file[place]
            file[place] = h5py.ExternalLink(str(source), place)
        with pytest.raises(RecordingError, match=rf"damaged\.h5: `/{place}` stands in another file"):
            read(path)


@pytest.fixture(scope="module")
def paint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_paint(tmp_path_factory.mktemp("paint"), {"AA11": (20.0, 80.0, 1.5)}, n_record=3)


@pytest.mark.parametrize("seed", range(3))
def test_damaged_paint_directories(paint, tmp_path, seed):
    rng = np.random.default_rng(seed)
    sound = sorted(paint.rglob("*.json"))
    for k in range(60):
        folder = tmp_path / str(k)
        for path in sound:
            write_json(folder / path.relative_to(paint), json.loads(path.read_text()))
        path = folder / sound[rng.integers(len(sound))].relative_to(paint)
        if k % 4 == 0:
            how = damage_bytes(path, rng)
        else:
            data = json.loads(path.read_text())
            how = damage_values(data, rng)
            path.write_text(as_json(data))
        try:
            found = refused(path, lambda _, folder=folder: read_heliostat(folder, "AA11", algorithm="any"), how)
            if found is not None:
                assert np.isfinite(found.spot_enu_m).all()
                assert all(path.name in reason for reason in found.skipped.values())
        except Exception as error:
            raise AssertionError(f"seed {seed}, {k}, {path.name}, {how}: {error!r}") from error


@pytest.mark.parametrize("seed", range(2))
def test_damaged_models(paint, tmp_path, seed):
    rng = np.random.default_rng(seed)
    model = tmp_path / "model.json"
    calibrate(paint, parameters="offsets").save(model)
    content = model.read_text()
    for k in range(60):
        model.write_text(content)
        if k % 4 == 0:
            how = damage_bytes(model, rng)
        else:
            data = json.loads(content)
            how = damage_values(data, rng)
            model.write_text(as_json(data))
        try:
            known = refused(model, read_models, how)
            if known is not None and k % 6 == 1:
                with contextlib.suppress(RfposeError):
                    plan_commands(model, target_enu_m=(0.0, 0.0, 36.0), start="2026-06-21T08:00Z", hours=1.0)
        except Exception as error:
            raise AssertionError(f"seed {seed}, {k}, {how}: {error!r}") from error


@pytest.mark.parametrize("seed", range(2))
def test_damaged_tables_of_motors_and_drones(files, tmp_path, seed):
    rng = np.random.default_rng(seed)
    mounts = {"A": Mount(pivot_enu_m=np.array([0.0, 80.0, 3.0]))}
    places = ",".join(f"{what}_{axis}_m" for what in ("drone", "target") for axis in ("east", "north", "up"))
    tables = {
        "flight.csv": f"time_utc,heliostat,axis_1,axis_2,{places}\n"
        + "2026-06-21T08:00:00Z,A,0.1,0.3,5.0,20.5,60.0,0.0,0.0,20.0\n" * 3,
        "motors.csv": "time_utc,heliostat,axis_1,axis_2\n" + "1970-01-01T00:00:00Z,H001,0.1,0.3\n" * 3,
    }
    readers = {
        "flight.csv": lambda path: read_drone(path, mounts),
        "motors.csv": lambda path: read_radio([files["result"]], path),
    }
    for k in range(80):
        name = ("flight.csv", "motors.csv")[k % 2]
        path = tmp_path / name
        path.write_text(tables[name])
        if k % 4 < 2:
            how = damage_bytes(path, rng)
        else:
            lines = [line.split(",") for line in tables[name].splitlines()]
            row = lines[rng.integers(len(lines))]
            how = row[at := int(rng.integers(len(row)))] = ("", "nan", "1e999", "x" * 500, '"', ";", "-1e300")[k % 7]
            path.write_text("\n".join(",".join(line) for line in lines))
            how = f"column {at}: {how!r:.30}"
        try:
            refused(path, readers[name], how)
        except Exception as error:
            raise AssertionError(f"seed {seed}, {k}, {name}, {how}: {error!r}") from error


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from skimage import io

    folder = tmp_path_factory.mktemp("pictures")
    picture = render(Target(), CameraView(), (Beam(centre_m=(0.2, 0.1)),), rng=np.random.default_rng(1))
    io.imsave(folder / "1.png", picture, check_contrast=False)
    (folder / "pictures.csv").write_text(
        "file,time_utc,heliostat,axis_1,axis_2\n1.png,2026-06-21T08:00:00Z,A,0.1,0.3\n"
    )
    board = {"centre_enu_m": [0.0, 0.0, 12.0], "normal_enu": [0.0, 1.0, 0.0], "mm_per_px": 2.0, "spot_sigma_m": 0.002}
    (folder / "board.toml").write_text(tomli_w.dumps(board))
    return folder


def read_pictures(folder: Path) -> object:
    site = Location(latitude_rad=0.66, longitude_rad=-0.04, altitude_m=500.0)
    return read_camera(folder, {"A": Mount(pivot_enu_m=np.array([0.0, 80.0, 3.0]))}, site)


@pytest.mark.parametrize("name", ["pictures.csv", "board.toml", "1.png"])
def test_damaged_pictures(pictures, tmp_path, name):
    assert read_pictures(pictures)
    rng = np.random.default_rng(5)
    odd = ("", "nan", "1e999", "x" * 500, "-1e300", "[[1,2]]", "'b'", "0", "-1")
    for k in range(25):
        shutil.copytree(pictures, tmp_path / f"{k}")
        path = tmp_path / f"{k}" / name
        if name == "1.png" or k % 2:
            how = damage_bytes(path, rng)
        else:
            words = re.split(r"([,\s=\[\]]+)", path.read_text())
            at = 2 * int(rng.integers(len(words) // 2))
            words[at] = how = odd[k // 2 % len(odd)]
            path.write_text("".join(words))
        try:
            refused(path.parent, read_pictures, how)
        except Exception as error:
            raise AssertionError(f"{k}, {name}, {how}: {error!r}") from error


def test_pictures_outside_their_folder_are_not_read(pictures, tmp_path):
    shutil.copytree(pictures, tmp_path / "sent")
    shutil.copy(pictures / "1.png", tmp_path / "mine.png")
    table = tmp_path / "sent" / "pictures.csv"
    table.write_text(table.read_text().replace("1.png", "../mine.png"))
    with pytest.raises(RfposeError, match=r"mine\.png"):
        read_pictures(tmp_path / "sent")
